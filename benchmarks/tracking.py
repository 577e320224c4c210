"""Tracking: scores beside peers, what each cue brings, motion, faults, reliability, speed.

Needs the extra ``evaluate`` and, for the peers, ``laptrack``; real recordings from CELLQUANT_DATA.
Run ``python benchmarks/tracking.py [scores ablation motion faults reliability speed]``.
"""

import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from cellquant.io import LabelStack, read_labels
from cellquant.segment import measure_cells
from cellquant.tables import Cells, Tracks
from cellquant.track import confidence, track_cells
from cellquant.track.evaluate import Scores, edges, read_truth, score_tables
from cellquant.track.link import by_place
from cellquant.track.movie import flatten
from cellquant.track.solve import Options, solve
from layers import data_folder, shuffled, voronoi_layer

RESULTS = Path(__file__).parent / "results"
SETS = (("epidermis_area1", 1), ("cell_migration", 1), ("cell_migration", 3), ("cell_migration", 7))
# Frames of one layer of 1000 cells, and copies of it side by side.
SIZES = ((20, 1), (40, 1), (80, 1), (145, 1), (5, 1), (5, 2), (5, 5))
LAYERS = (7, 1, 2)  # seeds of the layers that move
LIMITS = (0.35, 0.5, 0.7, 1.0)  # search ranges of the peers, in spacings; the best is shown


def thin_truth(table: pd.DataFrame, step: int) -> pd.DataFrame:
    """Truth of every `step`-th frame: a parent that is never seen is replaced by its own parent."""
    kept = table[table["frame"] % step == 0].copy()
    kept["frame"] //= step
    parent = dict(zip(table["track_id"], table["parent_track_id"], strict=True))
    seen = set(kept["track_id"])

    def known(track: int) -> int:
        while track and track not in seen:
            track = parent.get(track, 0)
        return track

    kept["parent_track_id"] = [known(parent[track]) for track in kept["track_id"]]
    return kept.sort_values(["track_id", "frame"], ignore_index=True)


def load(name: str, step: int) -> tuple[Cells, LabelStack, pd.DataFrame]:
    """Cells of shuffled masks, the masks, and the truth."""
    folder = data_folder() / name / "TRA"
    stack = read_labels(folder, units="pixel")
    masks = np.stack([stack[i] for i in range(0, len(stack), step)])
    new, _ = shuffled(masks)
    labels = LabelStack.from_array(new, units="pixel")
    return measure_cells(labels), labels, thin_truth(read_truth(folder), step)


def laptrack_table(cells: Cells, reach: float) -> pd.DataFrame:
    """LapTrack on the centroids, with splitting, in the columns of a tracks table."""
    from laptrack import LapTrack

    tracker = LapTrack(
        cutoff=reach**2,
        splitting_cutoff=reach**2,
        gap_closing_cutoff=reach**2,
        gap_closing_max_frame_count=1,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table, split, _ = tracker.predict_dataframe(
            cells.table[["frame", "x", "y"]].reset_index(drop=True),
            coordinate_cols=["x", "y"],
            frame_col="frame",
            only_coordinate_cols=False,
        )
    table = table.reset_index(drop=True)
    parent = {}
    if len(split):
        parent = dict(zip(split["child_track_id"], split["parent_track_id"], strict=True))
    table["parent_track_id"] = [parent.get(t, -1) + 1 for t in table["track_id"]]
    table["track_id"] += 1
    return table[["frame", "x", "y", "track_id", "parent_track_id"]]


def trackpy_table(cells: Cells, reach: float) -> pd.DataFrame:
    """trackpy's nearest neighbours, through the baseline linker."""
    return track_cells(cells, linker="trackpy", max_distance=reach, max_gap=0).table


def best(make: Callable[[float], pd.DataFrame], spacing: float, truth: pd.DataFrame) -> Scores:
    """Scores at the search range that suits the truth best: what tuning can give a peer."""
    found = []
    for limit in LIMITS:
        try:
            found.append(score_tables(make(limit * spacing), truth))
        except Exception as error:  # a peer that gives up is part of the result
            print(f"    {limit} spacings: {type(error).__name__}")
    return max(found, key=lambda s: s.edge_f1)


def row(scores: Scores) -> dict[str, float]:
    return {
        "edge_f1": scores.edge_f1,
        "division_f1": scores.division_f1,
        "idf1": scores.idf1,
        "lnk": scores.lnk,
        "tra": scores.tra,
    }


def scores() -> list[dict]:
    lines = []
    for name, step in SETS:
        cells, labels, truth = load(name, step)
        spacing = float(np.median(flatten(cells).spacing))
        made = {
            "cellquant": score_tables(track_cells(cells, labels).table, truth),
            "laptrack": best(lambda r, c=cells: laptrack_table(c, r), spacing, truth),
            "trackpy": best(lambda r, c=cells: trackpy_table(c, r), spacing, truth),
        }
        for tool, score in made.items():
            lines.append({"set": name, "step": step, "tool": tool, **row(score)})
            show(lines[-1])
    return lines


def ablation() -> list[dict]:
    lines = []
    variants = {
        "all cues": {},
        "no neighbours": {"use_neighbours": False},
        "no own path": {"use_path": False},
        "no shape": {"use_shape": False},
        "no images": {"use_images": False},
        "no divisions": {"divisions": False},
        "distance alone": {
            "use_neighbours": False,
            "use_path": False,
            "use_shape": False,
            "use_images": False,
        },
    }
    for name, step in SETS:
        _, labels, truth = load(name, step)
        masks = np.stack([labels[i] for i in range(len(labels))])
        runs: dict[str, list[dict[str, float]]] = {variant: [] for variant in variants}
        for turn in range(8):
            copy, turned_truth = turned(masks, truth, turn)
            labels = LabelStack.from_array(copy, units="pixel")
            cells = by_place(measure_cells(labels))
            movie = flatten(cells)
            if turn == 0:
                solve(movie, Options(), masks=labels)
            for variant, switches in variants.items():
                start = time.process_time()
                state = solve(movie, Options(**switches), masks=labels)
                seconds = time.process_time() - start
                scores = score_tables(numbered(cells, state.links), turned_truth)
                runs[variant].append({"cpu_s": seconds, **row(scores)})
        for variant, found in runs.items():
            line: dict = {"set": name, "step": step, "variant": variant}
            line["copies"] = len(found)
            line["cpu_s"] = float(np.mean([run["cpu_s"] for run in found]))
            for key in ("edge_f1", "division_f1", "idf1"):
                values = np.array([run[key] for run in found], dtype=float)
                lost = np.array([run[key] for run in runs["all cues"]], dtype=float) - values
                line[key] = float(np.mean(values))
                line[f"{key}_lost"] = float(np.mean(lost))
                line[f"{key}_std_error"] = float(np.std(lost, ddof=1) / np.sqrt(len(lost)))
            lines.append(line)
            show(line)
    return lines


def turned(masks: np.ndarray, truth: pd.DataFrame, turn: int) -> tuple[np.ndarray, pd.DataFrame]:
    """One of the eight ways to turn and mirror a movie, with its truth."""
    truth = truth.copy()
    if turn >= 4:
        masks = masks[:, :, ::-1]
        truth["x"] = masks.shape[2] - 1 - truth["x"]
    for _ in range(turn % 4):
        truth["x"], truth["y"] = truth["y"], masks.shape[2] - 1 - truth["x"]
        masks = np.rot90(masks, axes=(1, 2))
    return np.ascontiguousarray(masks), truth


def numbered(cells: Cells, links) -> pd.DataFrame:
    from cellquant.track.link import number_tracks

    track, parent = number_tracks(links.after, links.second)
    table = cells.table.assign(track_id=track, parent_track_id=parent)
    return table.sort_values(["track_id", "frame"], ignore_index=True)


def layer_edges(table: pd.DataFrame, names: list[np.ndarray]) -> float:
    """Edge F1 on a layer without divisions whose true labels are known."""
    table = table.sort_values(["track_id", "frame"], ignore_index=True)
    true = np.array([names[f][n] for f, n in zip(table["frame"], table["label"], strict=True)])
    frame = table["frame"].to_numpy()
    source, target = edges(table)
    good = int(np.sum((true[source] == true[target]) & (frame[target] - frame[source] == 1)))
    # Cells too small to be measured are in no tool's input.
    seen = [np.sort(true[frame == f]) for f in range(len(names))]
    total = sum(len(np.intersect1d(a, b)) for a, b in pairwise(seen))
    return 2 * good / (len(source) + total)


def motion() -> list[dict]:
    lines = []
    for seed in LAYERS:
        for step in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7):
            line = {"step_over_diameter": step, "layer": seed, **moving_layer(step, seed)}
            lines.append(line)
            show(line)
    return lines


def moving_layer(step: float, seed: int) -> dict[str, float]:
    """Edge F1 of every tool on one crowded layer."""
    new, names = shuffled(voronoi_layer(500, 20, step=step, seed=seed).masks)
    labels = LabelStack.from_array(new, units="pixel")
    cells = measure_cells(labels)
    spacing = float(np.median(flatten(cells).spacing))

    def peer(make: Callable[[float], pd.DataFrame]) -> float:
        found = []
        for limit in LIMITS:
            try:
                table = make(limit * spacing)
            except Exception:
                continue
            if "label" not in table:
                table = table.merge(
                    cells.table[["frame", "x", "y", "label"]], on=["frame", "x", "y"]
                )
            found.append(layer_edges(table, names))
        return max(found, default=float("nan"))

    return {
        "cellquant": layer_edges(track_cells(cells, labels).table, names),
        "laptrack": peer(lambda r: laptrack_table(cells, r)),
        "trackpy": peer(lambda r: trackpy_table(cells, r)),
    }


def damage(cells: Cells, kind: str, share: float, seed: int = 3) -> tuple[Cells, np.ndarray]:
    """Cells with a share deleted, split in two, or merged with the nearest; labels left intact."""
    rng = np.random.default_rng(seed)
    table = cells.table.copy()
    hit = rng.random(len(table)) < share
    if kind == "deleted":
        return replace(cells, table=table[~hit].reset_index(drop=True)), hit
    if kind == "split":
        parts = table[hit].copy()
        angle, size = parts["orientation"], 0.4 * np.sqrt(parts["area"] / np.pi)
        for sign, part in ((1, parts), (-1, parts.copy())):
            part["x"] += sign * size * np.cos(angle)
            part["y"] += sign * size * np.sin(angle)
            part["area"] /= 2
            part["label"] = 10**6 + np.arange(len(part)) * 2 + (sign > 0)
            table = pd.concat((table, part))
        table = table[np.append(~hit, np.ones(2 * hit.sum(), dtype=bool))]
    else:
        movie = flatten(cells)
        other = movie.neighbours[:, 0]
        both = hit & ~hit[other]
        gone = np.zeros(len(table), dtype=bool)
        gone[other[both]] = True
        both &= ~gone
        gone[:] = False
        gone[other[both]] = True
        weight = table["area"].to_numpy()
        for axis in ("x", "y"):
            value = table[axis].to_numpy().copy()
            o = other[both]
            value[both] = (weight[both] * value[both] + weight[o] * value[o]) / (
                weight[both] + weight[o]
            )
            table[axis] = value
        area = weight.copy()
        area[both] += weight[other[both]]
        table["area"] = area
        table.loc[both, "label"] += 10**6
        table = table[~gone]
        hit = both | gone
    return replace(cells, table=table.sort_values(["frame", "label"], ignore_index=True)), hit


def faults() -> list[dict]:
    lines = []
    for name, step in SETS[:3]:
        cells, _, truth = load(name, step)
        spacing = float(np.median(flatten(cells).spacing))
        intact_truth = match_truth(cells, truth)
        for kind in ("deleted", "split", "merged"):
            for share in (0.0, 0.02, 0.05, 0.1):
                damaged, hit = damage(cells, kind, share)
                makers = {
                    "cellquant": lambda d=damaged: track_cells(d).table,
                    "laptrack": lambda d=damaged, s=spacing: laptrack_table(d, 0.7 * s),
                }
                line = {"set": name, "step": step, "kind": kind, "share": share}
                for tool, make in makers.items():
                    line[tool] = intact_f1(make(), cells, hit, intact_truth)
                lines.append(line)
                show(line)
    return lines


BANDS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)


def reliability() -> list[dict]:
    """How often links and divisions are true that are stated with a confidence."""
    heats = {name: getattr(confidence, name) for name in ("_FAMILY_HEAT", "_LINK_HEAT")}
    movies = [(name, step, *load(name, step)) for name, step in SETS]
    for step, seed in ((0.3, 11), (0.4, 11)):
        new, names = shuffled(voronoi_layer(500, 20, step=step, seed=seed).masks)
        labels = LabelStack.from_array(new, units="pixel")
        cells = measure_cells(labels)
        truth = cells.table.copy()
        pairs = zip(truth["frame"], truth["label"], strict=True)
        truth["track_id"] = [int(names[f][n]) for f, n in pairs]
        truth["parent_track_id"] = 0
        truth["radius"] = np.sqrt(truth["area"] / np.pi)
        truth = truth.sort_values(["track_id", "frame"], ignore_index=True)
        movies.append((f"layer moving {step} diameters", 1, cells, labels, truth))
    lines = []
    for name, step, cells, labels, truth in movies:
        wanted = match_truth(cells, truth)
        daughters = pd.Series([b for _, b in wanted]).groupby([a for a, _ in wanted]).apply(set)
        stated = judged(cells, labels, wanted, daughters)
        confidence._FAMILY_HEAT, confidence._LINK_HEAT = 1.0, 0.0
        before = judged(cells, labels, wanted, daughters)
        for key, value in heats.items():
            setattr(confidence, key, value)
        for kind in ("links", "divisions"):
            (sure, true), (raw, _) = stated[kind], before[kind]
            if len(sure) == 0:
                continue
            line = {"set": name, "step": step, "kind": kind, "n": len(sure)}
            line |= {"true": float(true.mean()), "stated": float(sure.mean())}
            line |= {"log_loss": log_loss(sure, true), "stated_before": float(raw.mean())}
            line["log_loss_before"] = log_loss(raw, true)
            for low, high in pairwise(BANDS):
                band = (sure >= low) & ((sure < high) | (high == 1.0))
                text = f"{true[band].mean():.3f} ({band.sum()})" if band.any() else "none"
                line[f"true of {low:g} to {high:g}"] = text
            lines.append(line)
            show(line)
    return lines


def judged(
    cells: Cells, labels: LabelStack, wanted: set[tuple[int, int]], daughters: pd.Series
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Confidence of every link and every division, and whether it is true."""
    table = track_cells(cells, labels, max_gap=0).table
    key = pd.MultiIndex.from_frame(cells.table[["frame", "label"]])
    row = key.get_indexer(pd.MultiIndex.from_frame(table[["frame", "label"]]))
    source, target = edges(table)
    link = pd.DataFrame(
        {
            "source": row[source],
            "target": row[target],
            "sure": table["link_confidence"].to_numpy()[target],
        }
    )
    divided = link.duplicated("source", keep=False)
    found = link[divided].groupby("source").agg(target=("target", set), sure=("sure", "first"))
    single = link[~divided]
    pairs = zip(single["source"], single["target"], strict=True)
    true = np.array([pair in wanted for pair in pairs], dtype=bool)
    whole = np.array([daughters.get(a) == b for a, b in found["target"].items()], dtype=bool)
    return {
        "links": (single["sure"].to_numpy(), true),
        "divisions": (found["sure"].to_numpy(), whole),
    }


def log_loss(sure: np.ndarray, true: np.ndarray) -> float:
    sure = np.clip(sure, 1e-4, 1.0 - 1e-4)
    return float(-np.mean(np.where(true, np.log(sure), np.log(1.0 - sure))))


def match_truth(cells: Cells, truth: pd.DataFrame) -> set[tuple[int, int]]:
    """True edges as pairs of rows of the cells table."""
    from cellquant.track.evaluate import match_cells

    true_rows, rows = match_cells(truth, cells.table)
    cell_of = dict(zip(true_rows.tolist(), rows.tolist(), strict=True))
    source, target = edges(truth)
    return {
        (cell_of[a], cell_of[b])
        for a, b in zip(source.tolist(), target.tolist(), strict=True)
        if a in cell_of and b in cell_of
    }


def intact_f1(
    table: pd.DataFrame, cells: Cells, hit: np.ndarray, truth: set[tuple[int, int]]
) -> float:
    """Edge F1 among the cells that were left intact, links between successive frames."""
    row_of = {
        key: i
        for i, key in enumerate(
            zip(cells.table["frame"], cells.table["x"], cells.table["y"], strict=True)
        )
        if not hit[i]
    }
    table = table.sort_values(["track_id", "frame"], ignore_index=True)
    row = [row_of.get(k, -1) for k in zip(table["frame"], table["x"], table["y"], strict=True)]
    frame = table["frame"].to_numpy()
    source, target = edges(table)
    found = {
        (row[a], row[b])
        for a, b in zip(source.tolist(), target.tolist(), strict=True)
        if row[a] >= 0 and row[b] >= 0 and frame[b] - frame[a] == 1
    }
    wanted = {(a, b) for a, b in truth if not hit[a] and not hit[b]}
    return 2 * len(found & wanted) / (len(found) + len(wanted))


def tiled(masks: np.ndarray, times: int) -> np.ndarray:
    """A wider layer: `times` by `times` copies side by side, each with labels of its own."""
    height, width = masks.shape[1:]
    wide = np.tile(masks, (1, times, times))
    copy = np.add.outer(
        times * (np.arange(times * height) // height), np.arange(times * width) // width
    )
    return np.where(wide > 0, wide + copy.astype(wide.dtype) * (masks.max() + 1), 0)


def speed() -> list[dict]:
    lines = []
    layer, _ = shuffled(voronoi_layer(1300, 145, step=0.15).masks)
    for n_frames, times in SIZES:
        labels = LabelStack.from_array(tiled(layer[:n_frames], times), units="pixel")
        cells = measure_cells(labels)
        spacing = float(np.median(flatten(cells).spacing))
        makers: dict[str, Callable[[], Tracks | pd.DataFrame]] = {
            "cellquant": lambda c=cells, m=labels: track_cells(c, m),
            "centroids": lambda c=cells: track_cells(c),
            "laptrack": lambda c=cells, s=spacing: laptrack_table(c, 0.7 * s),
        }
        if n_frames != 20:
            del makers["laptrack"]  # its ratio is known from the first movie
        makers["cellquant"]()
        runs: dict[str, list[float]] = {tool: [] for tool in makers}
        for _ in range(3):
            for tool, make in makers.items():
                start = time.process_time()
                make()
                runs[tool].append(time.process_time() - start)
        line = {"cells_per_frame": len(cells.table) / n_frames, "frames": n_frames}
        for tool, values in runs.items():
            line[f"{tool}_cpu_s"] = float(np.median(values))
            line[f"{tool}_spread_s"] = float(np.ptp(values))
        line["us_per_cell"] = 1e6 * line["cellquant_cpu_s"] / len(cells.table)
        peer = line.get("laptrack_cpu_s", float("nan"))
        line["ratio_laptrack_over_centroids"] = peer / line["centroids_cpu_s"]
        lines.append(line)
        show(line)
    return lines


def show(line: dict) -> None:
    print(
        "  ".join(f"{k}={v:.4f}" if isinstance(v, float) else f"{k}={v}" for k, v in line.items()),
        flush=True,
    )


TITLES = {
    "scores": "Scores on the recordings looked at during development. Labels shuffled per frame, "
    "defaults only; the search range of the peers is the best of four (0.35 to 1 spacing) per set, "
    "chosen on the truth; wider ranges and a drift prediction lift LapTrack to 0.565 "
    "and trackpy to 0.747 at every 7th frame",
    "ablation": "What each cue brings, and its CPU time: means over turned and mirrored copies of "
    "each movie (gaps left open); 'lost' is what leaving the cue out costs on the same copy, with "
    "the standard error of its mean",
    "motion": "Edge F1 against root mean square step over cell diameter (crowded layers of 500 "
    "cells by their seed, no divisions; peers with the best of four search ranges on each layer)",
    "faults": "Edge F1 among intact cells when a share of the others is deleted, split or merged "
    "(centroids and moments alone)",
    "reliability": "How often a link or a division is true that is stated with a confidence, in "
    "bands (number in brackets). 'before': belief propagation without the heat of log odds, which "
    "was learned on part of these recordings and on synthetic layers with divisions, not on the "
    "two layers shown (where every division is false)",
    "speed": "CPU seconds on one thread of a busy machine, median of three interleaved runs; "
    "'centroids': cellquant without masks; LapTrack on the centroids of the first movie",
}


def report() -> None:
    """Write docs/accuracy_tracking.md from the results."""
    text = [
        "# Tracking: accuracy and cost",
        "",
        "Written by `benchmarks/tracking.py`; do not edit.",
    ]
    for name, title in TITLES.items():
        path = RESULTS / f"tracking_{name}.json"
        if not path.is_file():
            continue
        lines = json.loads(path.read_text())
        keys = list(lines[0])
        text += ["", f"## {title}", "", "| " + " | ".join(keys) + " |", "|---" * len(keys) + "|"]
        for line in lines:
            values = [line.get(key, float("nan")) for key in keys]
            cells = [f"{v:.4f}" if isinstance(v, float) else str(v) for v in values]
            text.append("| " + " | ".join(cells).replace("nan", "none") + " |")
    target = Path(__file__).resolve().parents[1] / "docs" / "accuracy_tracking.md"
    target.write_text("\n".join(text) + "\n")


def main() -> None:
    parts = {
        "scores": scores,
        "ablation": ablation,
        "motion": motion,
        "faults": faults,
        "reliability": reliability,
        "speed": speed,
    }
    RESULTS.mkdir(exist_ok=True)
    for name in sys.argv[1:] or list(parts):
        print(name)
        (RESULTS / f"tracking_{name}.json").write_text(json.dumps(parts[name](), indent=1) + "\n")
        report()


if __name__ == "__main__":
    main()
