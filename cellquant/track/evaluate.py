"""Scores of tracks against a known truth, by the field's own packages."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from cellquant.errors import InputError
from cellquant.tables import Tracks

if TYPE_CHECKING:
    from traccuracy import TrackingGraph

_TABLES = ("man_track.txt", "res_track.txt")
# Trusted masks have the truth's own centroids; half a radius allows for repaired fragments.
_MATCH_RADIUS = 0.5


@dataclass(frozen=True)
class Scores:
    """How tracks compare with the truth; 1 is perfect in every score.

    ``edge_f1``, ``edge_precision`` and ``edge_recall`` count links; ``division_f1`` counts
    divisions with mother and both daughters right, ``division_f1_tolerant`` the same when a
    division may be ``frame_tolerance`` frames early or late. LNK, TRA and IDF1 as defined by the
    cell tracking challenge and Ristani et al. (2016). A score is NaN where truth and tracks hold
    none of what it counts.
    """

    edge_f1: float
    edge_precision: float
    edge_recall: float
    division_f1: float
    division_f1_tolerant: float
    frame_tolerance: int
    lnk: float
    tra: float
    idf1: float
    n_cells: int
    n_true_cells: int
    n_matched: int
    n_edges: int
    n_true_edges: int
    n_divisions: int
    n_true_divisions: int
    versions: Mapping[str, str]

    def as_dict(self) -> dict[str, Any]:
        """Every score by name, NaN as None."""
        return {
            name: None if isinstance(value, float) and np.isnan(value) else value
            for name, value in asdict(self).items()
        }

    def as_lines(self) -> list[str]:
        """The scores as text."""
        return [
            f"cells: {self.n_matched} of {self.n_true_cells} true cells found "
            f"({self.n_cells} in the tracks)",
            f"edge F1: {self.edge_f1:.4f} (precision {self.edge_precision:.4f}, "
            f"recall {self.edge_recall:.4f}; {self.n_true_edges} true links)",
            f"division F1: {self.division_f1:.4f}, within {self.frame_tolerance} frame(s) "
            f"{self.division_f1_tolerant:.4f} ({self.n_true_divisions} true divisions)",
            f"LNK: {self.lnk:.4f}",
            f"TRA: {self.tra:.4f}",
            f"IDF1: {self.idf1:.4f}",
        ]


def evaluate(tracks: Tracks, truth: str | Path, *, frame_tolerance: int = 1) -> Scores:
    """Score tracks against a CTC folder that holds the true masks and their lineage.

    A cell of the tracks is a cell of the truth when their centroids in the same frame are each
    other's nearest and closer than half a cell radius, so that labels need not agree.

    Parameters
    ----------
    tracks
        Tracks in the coordinates of the true masks.
    truth
        Folder with ``man_track.txt`` and masks, or a folder that holds it as ``TRA``.
    frame_tolerance
        Frames by which a division may be off in `division_f1_tolerant`.

    Returns
    -------
    Scores

    Raises
    ------
    InputError
        If the folder is no CTC folder, or traccuracy and py-ctcmetrics are not installed.

    References
    ----------
    Matula et al. (2015), PLoS ONE 10, e0144959, doi:10.1371/journal.pone.0144959.
    Ristani et al. (2016), ECCV workshops, doi:10.1007/978-3-319-48881-3_2.
    """
    true_table = read_truth(truth, pixel_size=pixel_size_of(tracks))
    return score_tables(tracks.table, true_table, frame_tolerance=frame_tolerance)


def pixel_size_of(tracks: Tracks) -> float:
    """Edge of a pixel in the unit of the tracks."""
    if tracks.units.length == "px":
        return 1.0
    known = tracks.provenance.get("pixel_size")
    if known is None:
        raise InputError(
            f"these tracks are in {tracks.units.length} and do not say their pixel size, so they "
            "cannot be laid over the true masks; track the masks again with cellquant."
        )
    return float(known)


def read_truth(folder: str | Path, *, pixel_size: float = 1.0) -> pd.DataFrame:
    """Read a CTC folder as a table of true cells.

    Returns
    -------
    pandas.DataFrame
        frame, label, x, y, radius, track_id (the label), parent_track_id; ordered by track and
        frame.
    """
    from cellquant.io import read_labels

    folder = Path(folder)
    for place in (folder, folder / "TRA"):
        table = next((place / name for name in _TABLES if (place / name).is_file()), None)
        if table is not None:
            break
    else:
        raise InputError(
            f"{folder} holds no {' or '.join(_TABLES)}; give the folder of a tracking truth in "
            "the format of the Cell Tracking Challenge."
        )
    try:
        lineage = np.loadtxt(table, dtype=np.int64, ndmin=2)
        parent_of = dict(zip(lineage[:, 0].tolist(), lineage[:, 3].tolist(), strict=True))
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{table} is not a table of label, begin, end and parent ({error}); "
            "write one line of four integers per track."
        ) from error
    stack = read_labels(place, units="pixel")
    parts = []
    for index, frame in enumerate(stack.frame_numbers):
        labels = stack[index]
        row, column = np.nonzero(labels)
        name, which, count = np.unique(labels[row, column], return_inverse=True, return_counts=True)
        parts.append(
            pd.DataFrame(
                {
                    "frame": frame,
                    "label": name.astype(np.int64),
                    "x": np.bincount(which, column, len(name)) / count * pixel_size,
                    "y": np.bincount(which, row, len(name)) / count * pixel_size,
                    "radius": np.sqrt(count / np.pi) * pixel_size,
                }
            )
        )
    cells = pd.concat(parts, ignore_index=True)
    known = set(cells["label"].tolist())
    cells["track_id"] = cells["label"]
    cells["parent_track_id"] = [
        parent if (parent := parent_of.get(label, 0)) in known else 0
        for label in cells["label"].tolist()
    ]
    return cells.sort_values(["track_id", "frame"], ignore_index=True)


def score_tables(
    table: pd.DataFrame, true_table: pd.DataFrame, *, frame_tolerance: int = 1
) -> Scores:
    """Score a table of tracks against a table of true cells as `read_truth` gives it."""
    try:
        import ctc_metrics
        import traccuracy
        from ctc_metrics.scripts.evaluate import calculate_metrics
        from traccuracy.matchers import Matched
        from traccuracy.metrics import BasicMetrics, DivisionMetrics
    except ImportError as error:
        raise InputError(
            f"scores need {error.name}; install it with pip install 'cellquant[evaluate]'."
        ) from error
    del ctc_metrics
    table = table.sort_values(["track_id", "frame"], ignore_index=True)
    true_rows, rows = match_cells(true_table, table)
    true_graph, graph = _graph(true_table), _graph(table)
    mapping = list(zip((true_rows + 1).tolist(), (rows + 1).tolist(), strict=True))
    matched = Matched(true_graph, graph, mapping, {"matching type": "one-to-one"})
    import logging
    import warnings

    with warnings.catch_warnings():
        # Movies without links or divisions are told by NaN scores.
        warnings.simplefilter("ignore")
        logging.getLogger("traccuracy").setLevel(logging.ERROR)
        basic = BasicMetrics().compute(matched).results
        division = DivisionMetrics(max_frame_buffer=frame_tolerance).compute(matched).results
    challenge = _challenge_scores(table, true_table, true_rows, rows, calculate_metrics)
    exact = division["Frame Buffer 0"]
    return Scores(
        edge_f1=float(basic["Edge F1"]),
        edge_precision=float(basic["Edge Precision"]),
        edge_recall=float(basic["Edge Recall"]),
        division_f1=float(exact["Division F1"]),
        division_f1_tolerant=float(division[f"Frame Buffer {frame_tolerance}"]["Division F1"]),
        frame_tolerance=frame_tolerance,
        lnk=challenge["LNK"],
        tra=challenge["TRA"],
        idf1=challenge["IDF1"],
        n_cells=len(table),
        n_true_cells=len(true_table),
        n_matched=len(rows),
        n_edges=graph.graph.number_of_edges(),
        n_true_edges=true_graph.graph.number_of_edges(),
        n_divisions=int(exact["Total Predicted Divisions"]),
        n_true_divisions=int(exact["Total GT Divisions"]),
        versions={"traccuracy": traccuracy.__version__, "py-ctcmetrics": _version("py-ctcmetrics")},
    )


def _version(package: str) -> str:
    from importlib.metadata import version

    return version(package)


def match_cells(
    true_table: pd.DataFrame, table: pd.DataFrame
) -> tuple[np.ndarray[Any, np.dtype[np.int64]], np.ndarray[Any, np.dtype[np.int64]]]:
    """Rows of the truth and of the tracks that are the same cell: mutually nearest, and close."""
    true_rows, rows = [], []
    frames = table["frame"].to_numpy()
    true_frames = true_table["frame"].to_numpy()
    place = table[["x", "y"]].to_numpy()
    true_place = true_table[["x", "y"]].to_numpy()
    radius = true_table["radius"].to_numpy()
    for frame in np.intersect1d(frames, true_frames):
        here = np.flatnonzero(frames == frame)
        there = np.flatnonzero(true_frames == frame)
        distance, to = cKDTree(place[here]).query(true_place[there])
        _, back = cKDTree(true_place[there]).query(place[here])
        same = (back[to] == np.arange(len(there))) & (distance < _MATCH_RADIUS * radius[there])
        true_rows.append(there[same])
        rows.append(here[to[same]])
    if not rows:
        none = np.empty(0, dtype=np.int64)
        return none, none
    return np.concatenate(true_rows), np.concatenate(rows)


def edges(
    table: pd.DataFrame,
) -> tuple[np.ndarray[Any, np.dtype[np.int64]], np.ndarray[Any, np.dtype[np.int64]]]:
    """Rows (source, target) of every link of a table ordered by track and frame."""
    track = table["track_id"].to_numpy()
    parent = table["parent_track_id"].to_numpy()
    within = np.flatnonzero(track[1:] == track[:-1])
    first = np.flatnonzero(np.r_[True, track[1:] != track[:-1]])
    last = np.append(first[1:] - 1, len(track) - 1)
    last_of = dict(zip(track[first].tolist(), last.tolist(), strict=True))
    born = [row for row in first.tolist() if parent[row] in last_of]
    mothers = [last_of[parent[row]] for row in born]
    return (
        np.concatenate((within, np.array(mothers, dtype=np.int64))),
        np.concatenate((within + 1, np.array(born, dtype=np.int64))),
    )


def _graph(table: pd.DataFrame) -> "TrackingGraph":
    import networkx as nx
    from traccuracy import TrackingGraph

    graph = nx.DiGraph()
    columns = zip(
        table["frame"].tolist(),
        table["x"].tolist(),
        table["y"].tolist(),
        table["track_id"].tolist(),
        strict=True,
    )
    graph.add_nodes_from(
        (row + 1, {"t": frame, "x": x, "y": y, "segmentation_id": track})
        for row, (frame, x, y, track) in enumerate(columns)
    )
    source, target = edges(table)
    graph.add_edges_from(zip((source + 1).tolist(), (target + 1).tolist(), strict=True))
    return TrackingGraph(graph, location_keys=("x", "y"))


def _lineage(table: pd.DataFrame) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Lines of a CTC track table: label, begin, end, parent; frames counted from 0."""
    grouped = table.groupby("track_id", sort=True)
    lines = np.column_stack(
        (
            grouped["track_id"].first(),
            grouped["frame"].min(),
            grouped["frame"].max(),
            grouped["parent_track_id"].first(),
        )
    )
    return lines.astype(np.int64)


def _challenge_scores(
    table: pd.DataFrame,
    true_table: pd.DataFrame,
    true_rows: np.ndarray[Any, np.dtype[np.int64]],
    rows: np.ndarray[Any, np.dtype[np.int64]],
    calculate_metrics: Any,
) -> dict[str, float]:
    first = int(min(table["frame"].min(), true_table["frame"].min()))
    n_frames = int(max(table["frame"].max(), true_table["frame"].max())) - first + 1

    def per_frame(frame: Any, values: Any) -> list[list[int]]:
        lists: list[list[int]] = [[] for _ in range(n_frames)]
        for index, value in zip((frame - first).tolist(), values.tolist(), strict=True):
            lists[index].append(value)
        return lists

    frame, track = table["frame"].to_numpy(), table["track_id"].to_numpy()
    true_frame, true_track = true_table["frame"].to_numpy(), true_table["track_id"].to_numpy()
    reference, computed = _lineage(true_table), _lineage(table)
    reference[:, 1:3] -= first
    computed[:, 1:3] -= first
    matching = {
        "labels_ref": per_frame(true_frame, true_track),
        "labels_comp": per_frame(frame, track),
        "mapped_ref": per_frame(true_frame[true_rows], true_track[true_rows]),
        "mapped_comp": per_frame(true_frame[true_rows], track[rows]),
        "ious": [],
    }
    found = calculate_metrics(
        computed, reference, matching, {}, metrics=["TRA", "LNK", "IDF1"], is_valid=True
    )
    return {
        name: float("nan") if found[name] is None else float(found[name])
        for name in ("TRA", "LNK", "IDF1")
    }
