"""Trajectories as arrays: one stretch per track, a frame without a position marked as missing."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellquant.observables.smoothing import FloatArray, IntArray, ordered_rows
from cellquant.tables import Tracks

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Trajectories:
    """Positions of many tracks, laid end to end.

    Track k covers the entries ``offsets[k]:offsets[k + 1]``, one per frame from its first to its
    last, and ``valid`` is False in frames where it has no position. The difference of two indices
    is therefore always the difference of two frame numbers.

    Attributes
    ----------
    x, y
        (M,) positions relative to the first position of their track, in length units; 0 where
        not valid.
    valid
        (M,) whether there is a position.
    offsets
        (n_tracks + 1,) first entry of each track.
    first_frame
        (n_tracks,) frame number of each track's first entry, relative to ``origin_frame``.
    start
        (n_tracks, 2) first position of each track, unwrapped; ``x`` and ``y`` are relative to it.
    centre
        (n_tracks, 2) mean position of each track, unwrapped.
    origin_frame
        Smallest frame number of the source.
    n_frames
        Number of frames from the smallest to the largest frame number.
    frame_interval
        Time between consecutive frame numbers.
    box
        Edges of the periodic box, or None.
    """

    x: FloatArray
    y: FloatArray
    valid: BoolArray
    offsets: IntArray
    first_frame: IntArray
    start: FloatArray
    centre: FloatArray
    origin_frame: int
    n_frames: int
    frame_interval: float
    box: tuple[float, float] | None

    @property
    def n_tracks(self) -> int:
        """Number of tracks."""
        return int(self.first_frame.size)

    @property
    def max_lag(self) -> int:
        """Largest frame difference inside one track."""
        return int(np.max(np.diff(self.offsets), initial=1)) - 1


def from_tracks(tracks: Tracks) -> Trajectories:
    """Lay a table of tracks out as arrays.

    Parameters
    ----------
    tracks
        Trajectories; rows without a finite position count as missing frames.

    Returns
    -------
    Trajectories

    Raises
    ------
    InputError
        If a track has two rows in one frame.
    """
    table = ordered_rows(tracks.table)
    x, y = table["x"].to_numpy(dtype=np.float64), table["y"].to_numpy(dtype=np.float64)
    track = table["track_id"].to_numpy(dtype=np.int64)
    frame = table["frame"].to_numpy(dtype=np.int64)
    finite = np.isfinite(x) & np.isfinite(y)
    x, y, track, frame = x[finite], y[finite], track[finite], frame[finite]
    starts = np.flatnonzero(np.r_[True, track[1:] != track[:-1]]) if track.size else track[:0]
    stops = np.r_[starts[1:], track.size] if track.size else starts
    first, last = frame[starts], frame[stops - 1]
    offsets = np.r_[0, np.cumsum(last - first + 1)].astype(np.int64)
    row = np.repeat(np.arange(starts.size), stops - starts)
    entry = offsets[row] + frame - first[row]
    layout = {name: np.zeros(int(offsets[-1])) for name in ("x", "y")}
    layout["x"][entry] = x - x[starts][row]
    layout["y"][entry] = y - y[starts][row]
    valid = np.zeros(int(offsets[-1]), dtype=bool)
    valid[entry] = True
    size = np.maximum(stops - starts, 1)
    centre = np.column_stack(
        [np.bincount(row, weights=v, minlength=starts.size) / size for v in (x, y)]
    )
    origin = int(frame.min()) if frame.size else 0
    return Trajectories(
        x=layout["x"],
        y=layout["y"],
        valid=valid,
        offsets=offsets,
        first_frame=first - origin,
        start=np.column_stack([x[starts], y[starts]]),
        centre=centre,
        origin_frame=origin,
        n_frames=int(frame.max()) - origin + 1 if frame.size else 0,
        frame_interval=tracks.frame_interval,
        box=tracks.box,
    )


def log_lags(max_lag: int, n: int = 35) -> IntArray:
    """Lags in frames, evenly spaced in the logarithm as far as integers allow.

    Parameters
    ----------
    max_lag
        Largest lag, in frames.
    n
        Number of lags before duplicates are dropped; all of ``1..max_lag`` when there are at
        most that many.

    Returns
    -------
    numpy.ndarray
        Increasing integers from 1 to max_lag; empty when max_lag < 1.
    """
    if max_lag <= n:
        return np.arange(1, max(max_lag, 0) + 1, dtype=np.int64)
    return np.unique(np.round(np.geomspace(1, max_lag, n)).astype(np.int64))
