"""What is done to trajectories before they are measured: cut cells, drift, retention, smoothing."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cellquant.errors import InputError
from cellquant.observables.trajectories import FloatArray, IntArray, Layout, Trajectories
from cellquant.rows import Rows, Scan, rows_of
from cellquant.tables import Tracks

# With n cells the drift estimate carries 1/n of every cell's own motion; below this many cells
# common to two frames it would be motion, not drift, that is taken away.
MIN_DRIFT_CELLS = 8
# Relative error of a position from which a sum of steps has been subtracted, at most.
ROUND_OFF = 64 * float(np.finfo(float).eps)
# Frames per position beyond which tracks are gaps and little else.
MAX_GAPS = 1000


@dataclass(frozen=True)
class Survey:
    """What two readings of a table of tracks find, without holding it.

    Attributes
    ----------
    n_cut
        Rows left out because the border of the image cuts the cell.
    n_rows, n_tracks
        Positions among the others, and their tracks.
    longest_run
        Longest run of consecutive frames with a position.
    kept
        (n_tracks,) which tracks are retained.
    first, last
        (n_tracks,) first and last frame with a position.
    present
        Frames with a position; empty where drift is not removed.
    shift
        (2, n_present) how far the population has moved since the first of them.
    drift
        What was done about drift; None where it was not to be removed.
    """

    n_cut: int
    n_rows: int
    n_tracks: int
    longest_run: int
    kept: Any
    first: IntArray
    last: IntArray
    present: IntArray
    shift: FloatArray
    drift: dict[str, Any] | None


def survey(
    source: Tracks | Scan,
    *,
    keep_cut_cells: bool = True,
    drift: bool = False,
    min_points: int = 1,
) -> Survey:
    """Find the drift of the population and the tracks to retain.

    Parameters
    ----------
    source
        Trajectories, in memory or on disk.
    keep_cut_cells
        Whether positions of cells that the border of the image cuts count. The centroid of what
        is seen of a cut cell moves at about half the speed of the cell across the border, so that
        such positions make motion look slower than it is. Without them a track that touches the
        border for a while has a gap there.
    drift
        Whether the motion of the centre of mass of the population is to be removed:
        ``R(t) = sum_{s <= t} mean_i [r_i(s) - r_i(s - 1)]``, the mean over the cells present in
        both frames, is subtracted from every position. Summing steps of the same cells, instead
        of averaging positions, keeps a cell that enters or leaves from moving the centre of mass.
    min_points
        A track stays, whole, when its longest run of consecutive frames with a position has at
        least this many points, >= 1.

    Returns
    -------
    Survey
        The step between two successive frames is undefined when fewer than 8 cells are common to
        both: it is taken as zero, and counted in ``drift["steps_kept"]``. The mean-square
        displacement of n independent cells comes out low by a factor ``1 - 1/n``.

    Raises
    ------
    ValueError
        If min_points is below 1.
    InputError
        If a track has two rows in one frame.
    """
    if min_points < 1:
        raise ValueError(f"min_points must be >= 1, got {min_points}")
    rows = rows_of(source)
    present = np.empty(0, dtype=np.int64)
    if drift:
        for _, frame, *_ in _positions(rows, keep_cut_cells):
            present = np.union1d(present, frame)
    total, count = np.zeros((2, present.size)), np.zeros(present.size, dtype=np.int64)
    first, last, longest = [], [], []
    n_cut = n_rows = 0
    for track, frame, place, cut in _positions(rows, keep_cut_cells):
        n_cut += cut
        n_rows += track.size
        if not track.size:
            continue
        new = _changes(track)
        starts = np.flatnonzero(new)
        first.append(frame[starts])
        last.append(frame[np.r_[starts[1:], track.size] - 1])
        run = np.flatnonzero(new | np.r_[True, np.diff(frame) != 1])
        length = np.diff(np.r_[run, track.size])
        longest.append(np.maximum.reduceat(length, np.searchsorted(run, starts)))
        if drift:
            index = np.searchsorted(present, frame)
            same = np.flatnonzero((track[1:] == track[:-1]) & (np.diff(index) == 1))
            np.add.at(count, index[same + 1], 1)
            for axis in (0, 1):
                step = place[axis][same + 1] - place[axis][same]
                np.add.at(total[axis], index[same + 1], step)
    trusted = count >= MIN_DRIFT_CELLS
    shift = np.cumsum(np.where(trusted, total / np.maximum(count, 1), 0.0), axis=1)
    steps_kept = int(np.sum(~trusted[1:]))
    run_length = _joined(longest)
    return Survey(
        n_cut=n_cut,
        n_rows=n_rows,
        n_tracks=run_length.size,
        longest_run=int(run_length.max(initial=0)),
        kept=run_length >= min_points,
        first=_joined(first),
        last=_joined(last),
        present=present,
        shift=shift,
        drift={
            "removed": steps_kept < present.size - 1,
            "steps_kept": steps_kept,
            "min_cells": MIN_DRIFT_CELLS,
        }
        if drift
        else None,
    )


def _changes(track: IntArray) -> Any:
    """Which rows are the first of their track."""
    new = np.ones(track.size, dtype=bool)
    new[1:] = track[1:] != track[:-1]
    return new


def _joined(parts: list[IntArray]) -> IntArray:
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)


def _positions(
    rows: Rows, keep_cut_cells: bool
) -> Iterator[tuple[IntArray, IntArray, tuple[FloatArray, FloatArray], int]]:
    """Track, frame and place of the rows with a position that counts, and how many were cut."""
    for piece in rows.pieces("track_id", "frame", "x", "y", "touches_border"):
        track, frame, x, y = (piece[name] for name in ("track_id", "frame", "x", "y"))
        twice = (track[1:] == track[:-1]) & (frame[1:] == frame[:-1])
        if twice.any():
            row = int(np.flatnonzero(twice)[0])
            again = int(np.sum((track == track[row]) & (frame == frame[row])))
            raise InputError(
                f"track {track[row]} has {again} rows in frame {frame[row]}, but a cell has one "
                "position at a time; remove the duplicates or track the masks again."
            )
        counts = np.isfinite(x) & np.isfinite(y)
        cut = 0
        if not keep_cut_cells:
            counts &= ~piece["touches_border"]
            cut = int(piece["touches_border"].sum())
        yield track[counts], frame[counts], (x[counts], y[counts]), cut


def trajectories_of(
    source: Tracks | Scan, found: Survey, *, keep_cut_cells: bool = True
) -> Trajectories:
    """The retained tracks as arrays, relative to the centre of mass where drift is removed.

    Parameters
    ----------
    source
        The tracks that were surveyed.
    found
        What the survey found.
    keep_cut_cells
        As in the survey.
    """
    head = source.head if isinstance(source, Scan) else source
    assert isinstance(head, Tracks)
    kept = found.kept
    number = np.cumsum(kept) - 1
    spans = found.last[kept] - found.first[kept] + 1
    if spans.sum() > MAX_GAPS * max(found.n_rows, 10**4):
        raise InputError(
            f"the tracks span {spans.sum()} frames but have {found.n_rows} positions, with gaps of "
            f"up to {spans.max()} frames; track the masks again."
        )
    layout = Layout(found.first[kept], found.last[kept])
    before = 0
    for track, frame, (x, y), _ in _positions(rows_of(source), keep_cut_cells):
        new = _changes(track)
        index = before + np.cumsum(new) - 1
        before += int(new.sum())
        used = kept[index]
        index, frame, x, y = number[index[used]], frame[used], x[used], y[used]
        if not found.present.size:
            layout.add(index, frame, x, y)
            continue
        moved = found.shift[:, np.searchsorted(found.present, frame)]
        # What is left of cells that move with the others only is round-off, and no motion.
        noise = [ROUND_OFF * (np.abs(v) + np.abs(m)) for v, m in zip((x, y), moved, strict=True)]
        layout.add(index, frame, x - moved[0], y - moved[1], noise=noise)
    return layout.trajectories(frame_interval=head.frame_interval, box=head.box)


def from_tracks(source: Tracks | Scan, **options: Any) -> Trajectories:
    """Lay tracks out as arrays; rows without a finite position count as missing frames.

    Parameters
    ----------
    source
        Trajectories, in memory or on disk.
    options
        Those of `survey`: without any, the tracks as they are.

    Raises
    ------
    InputError
        If a track has two rows in one frame.
    """
    keep = bool(options.get("keep_cut_cells", True))
    return trajectories_of(source, survey(source, **options), keep_cut_cells=keep)


def smooth(paths: Trajectories, points: int = 5, *, overwrite: bool = False) -> Trajectories:
    """Smooth positions with a centred moving average over time.

    ``x'(t) = (2h + 1)^-1 sum_{s=-h..h} x(t + s)`` with ``h = (points - 1)/2`` inside a run of
    consecutive frames. Towards the ends of a run ``h`` shrinks to the distance from the end, so
    that the first and last point stay as measured and no point is lost. A missing frame ends a
    run: averages never reach across it.

    Parameters
    ----------
    paths
        Trajectories.
    points
        Width of the average in frames, odd; 1 returns them unchanged.
    overwrite
        Whether the arrays of `paths` are used for the result, which saves their memory.

    Returns
    -------
    Trajectories

    Raises
    ------
    ValueError
        If points is even or below 1.
    """
    if points < 1 or points % 2 == 0:
        raise ValueError(f"points must be an odd number >= 1, got {points}")
    if points == 1:
        return paths
    reach = (points - 1) // 2
    out = (paths.x, paths.y) if overwrite else (paths.x.copy(), paths.y.copy())
    centre = paths.centre.copy()
    for first, last in paths.spans():
        entries, track = paths.rows_of(first, last)
        valid = paths.valid[entries]
        place, length = _runs(track, valid)
        half = np.minimum(np.minimum(place, length - 1 - place), reach)
        half = np.where(valid, np.maximum(half, 0), 0)
        size = np.maximum(np.bincount(track - first, weights=valid, minlength=last - first), 1)
        for axis, (values, target) in enumerate(((paths.x, out[0]), (paths.y, out[1]))):
            here = values[entries]
            total = here.copy()
            for offset in range(1, reach + 1):
                rows = np.flatnonzero(half >= offset)
                total[rows] += here[rows - offset] + here[rows + offset]
            total /= 2 * half + 1
            target[entries] = total
            mean = np.bincount(track - first, weights=total, minlength=last - first) / size
            centre[first:last, axis] = paths.start[first:last, axis] + mean
    return replace(paths, x=out[0], y=out[1], centre=centre)


def _runs(track: IntArray, valid: Any) -> tuple[IntArray, IntArray]:
    """Place of each entry in its run of entries with a position, and the length of that run."""
    new = np.ones(track.size, dtype=bool)
    new[1:] = (track[1:] != track[:-1]) | (valid[1:] != valid[:-1])
    run = np.cumsum(new) - 1
    first = np.flatnonzero(new)
    return np.arange(track.size) - first[run], np.diff(np.r_[first, track.size])[run]
