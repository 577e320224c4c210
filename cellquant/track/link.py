"""Cells to tracks: the public entries, and what they report."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from numba import njit
from threadpoolctl import threadpool_limits

from cellquant.errors import InputError
from cellquant.tables import TRACK_COLUMNS, Cells, Tracks
from cellquant.track.baseline import trackpy_links
from cellquant.track.diagnostics import describe
from cellquant.track.gaps import close_gaps
from cellquant.track.movie import FloatArray, IntArray, flatten
from cellquant.track.solve import Options, solve

if TYPE_CHECKING:
    from cellquant.io import ImageStack, LabelStack

Linker = Literal["cues", "trackpy"]
Progress = Callable[[int, int], None]


def track(
    stack: "LabelStack",
    *,
    raw: "ImageStack | None" = None,
    max_distance: float | None = None,
    divisions: bool = True,
    linker: Linker = "cues",
    max_gap: int = 2,
    progress: Progress | None = None,
) -> Tracks:
    """Link the cells of label masks into trajectories; the masks are never altered.

    Measures the cells of `stack` and passes them to `track_cells`, where the options are
    described.

    Parameters
    ----------
    stack
        Label masks with a calibration, one integer per cell; IDs need not run through time.
    raw, max_distance, divisions, linker, max_gap, progress
        See `track_cells`.

    Returns
    -------
    Tracks
    """
    from cellquant.segment import measure_cells

    return track_cells(
        measure_cells(stack),
        stack,
        raw=raw,
        max_distance=max_distance,
        divisions=divisions,
        linker=linker,
        max_gap=max_gap,
        progress=progress,
    )


def track_cells(
    cells: Cells,
    masks: "LabelStack | None" = None,
    *,
    raw: "ImageStack | None" = None,
    max_distance: float | None = None,
    divisions: bool = True,
    linker: Linker = "cues",
    max_gap: int = 2,
    progress: Progress | None = None,
) -> Tracks:
    """Link measured cells into trajectories.

    Every link is worth ``ln[(1 - p_vanish) p(step) p(shape) / (p_vanish q_appear)]``: the odds of
    one cell seen twice against two strangers. The step is predicted from the drift, the
    neighbours' motion and the cell's own path; all scales, rates and weights are estimated from
    the movie itself.

    Parameters
    ----------
    cells
        Measured cells. Their labels and the order of rows do not matter.
    masks
        The label masks that were measured. Not needed for linking by centroid and moments.
    raw
        The recorded movie, frame by frame the same as `masks`; adds image correlation.
    max_distance
        Longest displacement between successive frames, in ``cells.units.length``. Chosen from
        the data when None; give a value to forbid what is physically impossible.
    divisions
        Look for divisions; without them a track never has a parent.
    linker
        ``"cues"``, or ``"trackpy"`` for nearest neighbours alone (needs no shapes, finds no
        divisions).
    max_gap
        Frames that a cell may be missing and still be followed.
    progress
        Called with the number of frames done and of all frames, as it were: every pass goes over
        all of them.

    Returns
    -------
    Tracks
        With the further column ``link_confidence``: probability that the row belongs to the same
        cell as the row before, or to the mother for the first row of a daughter; NaN where a
        track begins without a mother.

    Raises
    ------
    InputError
        If fewer than two frames hold cells.
    """
    if max_distance is not None and not max_distance > 0:
        raise InputError(
            f"max_distance must be > 0 {cells.units.length}, got {max_distance}; "
            "leave it out to have it chosen from the data."
        )
    if max_gap < 0:
        raise InputError(f"max_gap must be >= 0 frames, got {max_gap}.")
    if linker not in ("cues", "trackpy"):
        raise InputError(f"linker must be 'cues' or 'trackpy', got {linker!r}.")
    if cells.n_frames < 2:
        raise InputError(
            f"tracking needs at least two frames, got {cells.n_frames}; "
            "for shapes alone observe the masks directly."
        )
    if cells.table.empty:
        raise InputError(
            f"none of the {cells.n_frames} frames holds a cell; "
            "check that these are label masks and not the raw movie."
        )
    cells = by_place(cells)
    movie = flatten(cells)
    after = np.full(movie.n_cells, -1, dtype=np.int64)
    second, confidence = after.copy(), np.full(movie.n_cells, np.nan)
    report: dict[str, Any]
    if len(movie.time) < 2:
        report = {"divisions": 0, "gaps_closed": 0, "warnings": ["only one frame holds cells"]}
    elif linker == "trackpy":
        after, report = trackpy_links(movie, max_distance=max_distance, max_gap=max_gap)
    else:
        # The matrices are too small for more threads to pay; they would only wait for each other.
        with threadpool_limits(1):
            solution = solve(
                movie,
                Options(
                    divisions=divisions,
                    max_distance=np.inf if max_distance is None else max_distance,
                ),
                masks=masks,
                raw=raw,
                pixel_size=cells.pixel_size,
                progress=progress,
            )
        links = solution.links
        assert links is not None
        after, second = links.after.copy(), links.second
        confidence[links.before >= 0] = links.confidence[links.before >= 0]
        end, start, sure = close_gaps(
            movie,
            solution,
            max_gap=max_gap,
            max_distance=np.inf if max_distance is None else max_distance,
        )
        after[end], confidence[start] = start, sure
        report = describe(movie, solution, cells.units.length, n_gaps=len(end))
    report["pixel_size"] = cells.pixel_size
    report["settings"] = {
        "linker": linker,
        "max_distance": max_distance,
        "divisions": divisions,
        "max_gap": max_gap,
    }
    track_id, parent = number_tracks(after, second)
    return Tracks(
        table=_table(cells, track_id, parent, confidence),
        units=cells.units,
        frame_interval=cells.frame_interval,
        area=float(np.mean(cells.occupied_area)),
        provenance=report,
    )


def by_place(cells: Cells) -> Cells:
    """The cells of each frame in the order of their places: no result depends on their labels."""
    table = cells.table
    frame = table["frame"].to_numpy()
    order = np.argsort(frame, kind="stable")
    columns = [table[name].to_numpy() for name in ("label", "x", "y")]
    # Frame by frame: less than half the time of sorting all at once.
    for here in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        here[:] = here[np.lexsort([column[here] for column in columns])]
    return replace(cells, table=table.iloc[order].reset_index(drop=True))


@njit(cache=True)
def number_tracks(after: IntArray, second: IntArray) -> tuple[IntArray, IntArray]:
    """Give every cell the number of its track and of its parent track, (N,) each.

    Tracks are numbered from 1 in the order of their first cells; a division ends the mother's
    track. A link always points to a later cell.
    """
    n = len(after)
    track, parent = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    tracks = 0
    for cell in range(n):
        if track[cell] == 0:
            tracks += 1
            track[cell] = tracks
        if after[cell] < 0:
            continue
        if second[cell] >= 0:
            parent[after[cell]] = parent[second[cell]] = track[cell]
        else:
            track[after[cell]], parent[after[cell]] = track[cell], parent[cell]
    return track, parent


def _table(
    cells: Cells, track_id: IntArray, parent: IntArray, confidence: FloatArray
) -> pd.DataFrame:
    table = cells.table.assign(
        track_id=track_id,
        parent_track_id=parent,
        time=cells.table["frame"] * cells.frame_interval,
        link_confidence=confidence,
    )
    table = table.astype({**TRACK_COLUMNS, "link_confidence": "float64"})
    order = np.lexsort((table["frame"].to_numpy(), table["track_id"].to_numpy()))
    return table.iloc[order].reset_index(drop=True)


__all__ = ["Linker", "number_tracks", "track", "track_cells"]
