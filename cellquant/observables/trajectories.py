"""Trajectories as arrays: one stretch per track, a frame without a position marked as missing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]
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

    def spans(self, size: int = 2**15) -> Iterator[tuple[int, int]]:
        """Half-open ranges of tracks that hold about `size` entries each, all tracks in turn.

        What is worked out range by range costs memory for one range at a time.
        """
        first = 0
        while first < self.n_tracks:
            last = int(np.searchsorted(self.offsets, self.offsets[first] + size))
            last = min(max(last, first + 1), self.n_tracks)
            yield first, last
            first = last

    def rows_of(self, first: int, last: int) -> tuple[slice, IntArray]:
        """Entries of a range of tracks, and the track of each entry."""
        length = np.diff(self.offsets[first : last + 1])
        entries = slice(int(self.offsets[first]), int(self.offsets[last]))
        return entries, np.repeat(np.arange(first, last), length)

    def inside(self, start: int, stop: int) -> "Trajectories":
        """The points in the frames from start up to, not including, stop, as tracks of their own.

        Tracks without a point there are left out.
        """
        begin = np.maximum(self.first_frame, start - self.origin_frame)
        end = np.minimum(self.first_frame + np.diff(self.offsets), stop - self.origin_frame)
        length = np.maximum(end - begin, 0)
        row = np.repeat(np.arange(self.n_tracks), length)
        within = np.arange(row.size) - np.repeat(np.cumsum(length) - length, length)
        frame = begin[row] + within
        entry = self.offsets[row] + frame - self.first_frame[row]
        known = self.valid[entry]
        row, frame, entry = row[known], frame[known], entry[known]
        starts = np.flatnonzero(np.diff(row, prepend=-1))
        track = row[starts]
        stops = np.r_[starts[1:], row.size] if starts.size else starts
        layout = Layout(frame[starts] + self.origin_frame, frame[stops - 1] + self.origin_frame)
        number = np.repeat(np.arange(starts.size), stops - starts)
        layout.add(number, frame + self.origin_frame, self.x[entry], self.y[entry])
        layout.start += self.start[track]
        layout.centre += self.start[track]
        return layout.trajectories(frame_interval=self.frame_interval, box=self.box)


class Layout:
    """Trajectories while they are filled in, a few tracks at a time.

    Parameters
    ----------
    first, last
        (n_tracks,) first and last frame number with a position of each track.
    """

    def __init__(self, first: IntArray, last: IntArray) -> None:
        self.first, self.last = first, last
        self.offsets = np.r_[0, np.cumsum(last - first + 1)].astype(np.int64)
        size = int(self.offsets[-1])
        self.x, self.y = np.zeros(size), np.zeros(size)
        self.valid = np.zeros(size, dtype=bool)
        self.start, self.centre = np.zeros((first.size, 2)), np.zeros((first.size, 2))

    def add(
        self,
        track: IntArray,
        frame: IntArray,
        x: FloatArray,
        y: FloatArray,
        *,
        noise: Sequence[FloatArray] = (),
    ) -> None:
        """Fill in whole tracks, given by their number, in the order of track and frame.

        A distance from the first position up to the noise of both, where it is given, is none.
        """
        starts = np.flatnonzero(np.diff(track, prepend=-1))
        if not starts.size:
            return
        number, size = track[starts], np.diff(np.r_[starts, track.size])
        row = np.repeat(np.arange(starts.size), size)
        entry = self.offsets[track] + frame - self.first[track]
        self.valid[entry] = True
        for axis, (values, target) in enumerate(((x, self.x), (y, self.y))):
            away = values - values[starts][row]
            if noise:
                away[np.abs(away) <= noise[axis] + noise[axis][starts][row]] = 0.0
            target[entry] = away
            self.start[number, axis] = values[starts]
            self.centre[number, axis] = np.bincount(row, weights=values) / size

    def trajectories(
        self, *, frame_interval: float, box: tuple[float, float] | None
    ) -> Trajectories:
        """What has been filled in."""
        origin = int(self.first.min()) if self.first.size else 0
        return Trajectories(
            x=self.x,
            y=self.y,
            valid=self.valid,
            offsets=self.offsets,
            first_frame=self.first - origin,
            start=self.start,
            centre=self.centre,
            origin_frame=origin,
            n_frames=int(self.last.max()) - origin + 1 if self.last.size else 0,
            frame_interval=frame_interval,
            box=box,
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
