"""Analysis windows and density bins."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cellquant.errors import InputError
from cellquant.observables.trajectories import FloatArray, IntArray
from cellquant.rows import Piece, Scan, rows_of
from cellquant.tables import Cells, Tracks, Units

BIN_WIDTH = 250.0
BIN_CENTRES = (1100.0, 1350.0, 1600.0, 1850.0, 2100.0, 2350.0, 2600.0)
WINDOW_POINTS = 24
MAX_FRAMES = 10**7
DENSITY_RULE = (
    "cells per area that cells can occupy; a cell cut by the border of the image counts one half, "
    "since the image shows one of the two fields such a cell belongs to"
)


@dataclass(frozen=True)
class Window:
    """A stretch of consecutive frames.

    Attributes
    ----------
    start, stop
        Half-open range of frame numbers.
    """

    start: int
    stop: int


def split_frames(first: int, n_frames: int, points: int) -> list[Window]:
    """Cut frames into non-overlapping windows.

    Parameters
    ----------
    first
        Smallest frame number.
    n_frames
        Frames from the smallest to the largest number.
    points
        Frames in a window, >= 2.

    Returns
    -------
    list of Window
        From the first frame on; frames left over at the end, fewer than a window, are not used.

    Raises
    ------
    ValueError
        If points is below 2.
    """
    if points < 2:
        raise ValueError(f"a window needs >= 2 points, got {points}")
    return [Window(first + k * points, first + (k + 1) * points) for k in range(n_frames // points)]


def density_per_frame(
    source: Tracks | Cells | Scan, census: "Census | None" = None
) -> pd.DataFrame:
    """Number density of every frame.

    Parameters
    ----------
    source
        Tracks or cells; all rows count, whatever the length of their track.
    census
        Its rows, where they have been counted.

    Returns
    -------
    pandas.DataFrame
        frame, n_cells, density (inverse length squared, half weight for cells that touch the
        border), count_per_area (the plain count). Frames without cells count as zero.
    """
    head = source.head if isinstance(source, Scan) else source
    found = count_by_frame(source) if census is None else census
    if isinstance(head, Cells):
        first, n, area = 0, head.n_frames, head.occupied_area
    else:
        first, n = found.first_frame, found.n_frames
        area = np.full(n, head.area)
    count, halves = np.zeros(n), np.zeros(n)
    place = found.frame - first
    count[place], halves[place] = found.n_cells, 0.5 * found.n_cut
    with np.errstate(divide="ignore", invalid="ignore"):
        return pd.DataFrame(
            {
                "frame": np.arange(first, first + n),
                "n_cells": count.astype(np.int64),
                "density": np.where(area > 0, (count - halves) / area, np.nan),
                "count_per_area": np.where(area > 0, count / area, np.nan),
            }
        )


@dataclass(frozen=True)
class Census:
    """Rows of a table, counted.

    Attributes
    ----------
    frame, n_cells, n_cut
        Frames with a row, their rows, and how many of these touch the border of the image.
    n_rows, n_tracks
        Rows, and distinct tracks (0 of cells).
    """

    frame: Any
    n_cells: Any
    n_cut: Any
    n_rows: int
    n_tracks: int

    @property
    def first_frame(self) -> int:
        """Smallest frame number, 0 where there is no row."""
        return int(self.frame[0]) if self.frame.size else 0

    @property
    def n_frames(self) -> int:
        """Frames from the smallest to the largest number."""
        return int(self.frame[-1]) - self.first_frame + 1 if self.frame.size else 0


def count_by_frame(source: Tracks | Cells | Scan) -> Census:
    """Count the rows of each frame, and the tracks.

    Raises
    ------
    InputError
        If the frame numbers span more frames than any movie has.
    """
    rows = rows_of(source)
    columns = ("frame", "touches_border", *(("track_id",) if rows.linked else ()))
    n_rows = n_tracks = 0
    frames = [np.empty(0, dtype=np.int64)]
    cells, cut = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for piece in rows.pieces(*columns):
        present, index = np.unique(piece["frame"], return_inverse=True)
        frames.append(present)
        cells.append(np.bincount(index, minlength=present.size))
        cut.append(np.bincount(index[piece["touches_border"]], minlength=present.size))
        n_rows += piece["frame"].size
        if rows.linked:
            n_tracks += int(np.sum(piece["track_id"][1:] != piece["track_id"][:-1])) + 1
    frame, index = np.unique(np.concatenate(frames), return_inverse=True)
    n_cells, n_cut = np.zeros(frame.size, np.int64), np.zeros(frame.size, np.int64)
    np.add.at(n_cells, index, np.concatenate(cells))
    np.add.at(n_cut, index, np.concatenate(cut))
    if frame.size and int(frame[-1]) - int(frame[0]) >= MAX_FRAMES:
        raise InputError(
            f"the frame numbers run from {frame[0]} to {frame[-1]}, more than {MAX_FRAMES} frames; "
            "number the frames of the table from 0 on, one by one."
        )
    return Census(frame, n_cells, n_cut, n_rows, n_tracks)


def mean_of_series(values: FloatArray, points: int) -> tuple[float, float, str]:
    """Mean of a series of frames, with the error from stretches of `points` frames.

    Returns
    -------
    value, std_error : float
        The error is NaN with fewer than two stretches.
    method : str
    """
    known = values[np.isfinite(values)]
    if known.size == 0:
        return float("nan"), float("nan"), "no frame"
    stretches = known.size // points
    method = f"spread of {stretches} stretches of {points} frames"
    if stretches < 2:
        return float(known.mean()), float("nan"), method
    means = np.array([part.mean() for part in np.array_split(known, stretches)])
    error = float(means.std(ddof=1) / np.sqrt(stretches))
    return float(known.mean()), error, method


def bin_density(
    density: float, *, centres: Sequence[float] = BIN_CENTRES, width: float = BIN_WIDTH
) -> float | None:
    """Centre of the bin a density falls into.

    Parameters
    ----------
    density
        In the unit of the centres.
    centres
        Bin centres.
    width
        Bin width; a bin is half open, from ``centre - width/2`` up to ``centre + width/2``.

    Returns
    -------
    float or None
        None outside every bin.
    """
    inside = [c for c in centres if c - width / 2 <= density < c + width / 2]
    return min(inside, key=lambda c: abs(c - density)) if inside else None


def density_scale(units: Units) -> tuple[float, str] | None:
    """Factor and unit that turn an inverse squared length into the unit of the density bins.

    None when the length unit is not physical, and the bins do not apply.
    """
    return (1e6, "1/mm^2") if units.length == "um" else None


def usable_area(piece: Piece) -> Any:
    """Which rows have an area that counts for the mean diameter: away from the border, > 0."""
    area = piece["area"]
    return np.isfinite(area) & (area > 0) & ~piece["touches_border"]


def diameter_by_frame(source: Tracks | Cells | Scan, frames: IntArray) -> tuple[Any, Any]:
    """Sum and number of the diameters ``sqrt(4 A/pi)`` of cells away from the border, per frame.

    Parameters
    ----------
    frames
        Increasing frame numbers, all that occur.
    """
    total, count = np.zeros(frames.size), np.zeros(frames.size)
    for piece in rows_of(source).pieces("frame", "area", "touches_border"):
        used = usable_area(piece)
        index = np.searchsorted(frames, piece["frame"][used])
        np.add.at(total, index, np.sqrt(4 * piece["area"][used] / np.pi))
        np.add.at(count, index, 1.0)
    return total, count
