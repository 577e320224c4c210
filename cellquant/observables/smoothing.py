"""What is done to trajectories before they are measured: cut cells, drift, retention, smoothing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from cellquant.errors import InputError
from cellquant.tables import Tracks

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]

# With n cells the drift estimate carries 1/n of every cell's own motion; below this many cells
# common to two frames it would be motion, not drift, that is taken away.
MIN_DRIFT_CELLS = 8


def ordered_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows sorted by track and frame, after checking that no pair occurs twice.

    Parameters
    ----------
    table
        Columns track_id and frame at least.

    Returns
    -------
    pandas.DataFrame
        The same rows with a fresh index.

    Raises
    ------
    InputError
        If a track has two rows in one frame.
    """
    track, frame = table["track_id"].to_numpy(), table["frame"].to_numpy()
    order = np.lexsort((frame, track))
    if not np.array_equal(order, np.arange(order.size)):
        table = table.iloc[order]
        track, frame = track[order], frame[order]
    twice = (track[1:] == track[:-1]) & (frame[1:] == frame[:-1])
    if twice.any():
        row = int(np.flatnonzero(twice)[0])
        raise InputError(
            f"track {track[row]} has {int(np.sum((track == track[row]) & (frame == frame[row])))} "
            f"rows in frame {frame[row]}, but a cell has one position at a time; remove the "
            "duplicates or track the masks again."
        )
    return table.reset_index(drop=True)


def _segments(track: IntArray, frame: IntArray, finite: Any) -> tuple[IntArray, IntArray]:
    """Position of each row in its run of consecutive frames, and the length of that run.

    Rows without a finite position belong to no run and get length 0.
    """
    n = track.size
    start = np.ones(n, dtype=bool)
    start[1:] = (
        (track[1:] != track[:-1])
        | (frame[1:] != frame[:-1] + 1)
        | (finite[1:] != finite[:-1])
        | ~finite[1:]
    )
    run = np.cumsum(start) - 1
    first = np.flatnonzero(start)
    position = np.arange(n) - first[run]
    length = np.bincount(run, minlength=first.size)[run] if n else np.zeros(0, dtype=np.int64)
    return position.astype(np.int64), np.where(finite, length, 0).astype(np.int64)


def _arrays(table: pd.DataFrame) -> tuple[IntArray, IntArray, FloatArray, FloatArray, Any]:
    x = table["x"].to_numpy(dtype=np.float64, copy=True)
    y = table["y"].to_numpy(dtype=np.float64, copy=True)
    finite = np.isfinite(x) & np.isfinite(y)
    return (
        table["track_id"].to_numpy(dtype=np.int64),
        table["frame"].to_numpy(dtype=np.int64),
        x,
        y,
        finite,
    )


def leave_out_cut_cells(tracks: Tracks) -> Tracks:
    """Leave out the positions of cells that the border of the image cuts.

    The centroid of the visible part of a cut cell moves at about half the speed of the cell
    across the border, so that such positions make motion look slower than it is. A track that
    touches the border for a while has a gap there.

    Parameters
    ----------
    tracks
        Trajectories; not changed.

    Returns
    -------
    Tracks
        The rows that do not touch the border; ``provenance["cut_cells_left_out"]`` counts the
        others.
    """
    whole = ~tracks.table["touches_border"].to_numpy(dtype=bool)
    return replace(
        tracks,
        table=tracks.table[whole],
        provenance={**tracks.provenance, "cut_cells_left_out": int(np.sum(~whole))},
    )


def smooth_tracks(tracks: Tracks, points: int = 5) -> Tracks:
    """Smooth positions with a centred moving average over time.

    ``x'(t) = (2h + 1)^-1 sum_{s=-h..h} x(t + s)`` with ``h = (points - 1)/2`` inside a run of
    consecutive frames. Towards the ends of a run ``h`` shrinks to the distance from the end, so
    that the first and last point stay as measured and no point is lost. A missing frame ends a
    run: averages never reach across it.

    Parameters
    ----------
    tracks
        Trajectories; not changed.
    points
        Width of the average in frames, odd; 1 returns the positions unchanged.

    Returns
    -------
    Tracks
        The same table with new x and y, and ``smoothing = points``.

    Raises
    ------
    ValueError
        If points is even or below 1, or the tracks have been smoothed before.
    """
    if points < 1 or points % 2 == 0:
        raise ValueError(f"points must be an odd number >= 1, got {points}")
    if points == 1:
        return tracks
    if tracks.smoothing != 1:
        raise ValueError(
            f"tracks must not be smoothed twice, but they carry smoothing = {tracks.smoothing}; "
            "start from the unsmoothed tracks"
        )
    table = ordered_rows(tracks.table)
    track, frame, x, y, finite = _arrays(table)
    position, length = _segments(track, frame, finite)
    half = np.minimum(np.minimum(position, length - 1 - position), (points - 1) // 2)
    half = np.maximum(half, 0)
    smooth_x, smooth_y = x.copy(), y.copy()
    for offset in range(1, (points - 1) // 2 + 1):
        rows = np.flatnonzero(half >= offset)
        smooth_x[rows] += x[rows - offset] + x[rows + offset]
        smooth_y[rows] += y[rows - offset] + y[rows + offset]
    table = table.assign(x=smooth_x / (2 * half + 1), y=smooth_y / (2 * half + 1))
    return replace(tracks, table=table, smoothing=points)


def remove_drift(tracks: Tracks) -> Tracks:
    """Express trajectories relative to the centre of mass of the population.

    ``R(t) = sum_{s <= t} mean_i [r_i(s) - r_i(s - 1)]``, the mean over the cells present in both
    frames, is subtracted from every position. Summing steps of the same cells, instead of
    averaging positions, keeps a cell that enters or leaves from moving the centre of mass.

    Undefined when fewer than 8 cells are common to two successive frames: that step is then
    taken as zero, and counted in ``provenance["drift"]["steps_kept"]``. The mean-square
    displacement of independent cells comes out low by a factor ``1 - 1/n`` with n common cells.

    Parameters
    ----------
    tracks
        Trajectories; not changed.

    Returns
    -------
    Tracks
        The same table with new x and y; ``provenance["drift"]`` says what was done.
    """
    table = ordered_rows(tracks.table)
    track, frame, x, y, finite = _arrays(table)
    rows = np.flatnonzero(finite)
    present, index = np.unique(frame[rows], return_inverse=True)
    same = (track[rows][1:] == track[rows][:-1]) & (np.diff(index) == 1)
    step = index[1:][same]
    count = np.bincount(step, minlength=present.size)
    trusted = count >= MIN_DRIFT_CELLS
    shift = np.zeros((2, present.size))
    for axis, values in enumerate((x[rows], y[rows])):
        total = np.bincount(step, weights=np.diff(values)[same], minlength=present.size)
        shift[axis] = np.cumsum(np.where(trusted, total / np.maximum(count, 1), 0.0))
    x[rows] -= shift[0, index]
    y[rows] -= shift[1, index]
    kept = int(np.sum(~trusted[1:]))
    drift = {"removed": kept < present.size - 1, "steps_kept": kept, "min_cells": MIN_DRIFT_CELLS}
    return replace(
        tracks,
        table=table.assign(x=x, y=y),
        provenance={**tracks.provenance, "drift": drift},
    )


def longest_runs(table: pd.DataFrame) -> pd.Series:
    """Longest run of consecutive frames with a position, per track.

    Parameters
    ----------
    table
        Columns track_id, frame, x, y, sorted by track and frame.

    Returns
    -------
    pandas.Series
        Number of frames, indexed by track_id.
    """
    track, frame, _, _, finite = _arrays(table)
    _, length = _segments(track, frame, finite)
    return pd.Series(length).groupby(track).max()


def retain(tracks: Tracks, min_points: int = 24) -> Tracks:
    """Keep the tracks that have enough consecutive points.

    A track stays, whole, when its longest run of consecutive frames with a position has at
    least `min_points` points.

    Parameters
    ----------
    tracks
        Trajectories; not changed.
    min_points
        Consecutive points a track must have, >= 1.

    Returns
    -------
    Tracks
        The kept tracks, perhaps none.

    Raises
    ------
    ValueError
        If min_points is below 1.
    """
    if min_points < 1:
        raise ValueError(f"min_points must be >= 1, got {min_points}")
    table = ordered_rows(tracks.table)
    runs = longest_runs(table)
    kept = runs.index[runs.to_numpy() >= min_points]
    table = table[table["track_id"].isin(kept)].reset_index(drop=True)
    return replace(tracks, table=table)
