"""Analysis windows and density bins."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables.smoothing import FloatArray
from cellquant.tables import Cells, Tracks, Units

BIN_WIDTH = 250.0
BIN_CENTRES = (1100.0, 1350.0, 1600.0, 1850.0, 2100.0, 2350.0, 2600.0)
WINDOW_POINTS = 24
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


class RowsByFrame:
    """The rows of a table found by frame, at the cost of the rows that are found.

    Parameters
    ----------
    table
        Any table with a column frame.
    """

    def __init__(self, table: pd.DataFrame) -> None:
        frame = table["frame"].to_numpy()
        self._table = table
        self._order = np.argsort(frame, kind="stable")
        self._frame = frame[self._order]

    def inside(self, window: Window) -> pd.DataFrame:
        """Rows of the frames of a window, in the order of the table."""
        first, last = np.searchsorted(self._frame, (window.start, window.stop))
        rows: pd.DataFrame = self._table.iloc[np.sort(self._order[first:last])]
        return rows


def density_per_frame(source: Tracks | Cells) -> pd.DataFrame:
    """Number density of every frame.

    Parameters
    ----------
    source
        Tracks or cells; all rows count, whatever the length of their track.

    Returns
    -------
    pandas.DataFrame
        frame, n_cells, density (inverse length squared, half weight for cells that touch the
        border), count_per_area (the plain count). Frames without cells count as zero.
    """
    frame = source.table["frame"].to_numpy(dtype=np.int64)
    first = 0 if isinstance(source, Cells) else int(frame.min(initial=0))
    last = source.n_frames - 1 if isinstance(source, Cells) else int(frame.max(initial=-1))
    if isinstance(source, Tracks) and frame.size:
        first = int(frame.min())
    n = last - first + 1
    border = source.table["touches_border"].to_numpy(dtype=bool)
    count = np.bincount(frame - first, minlength=n)[:n] if frame.size else np.zeros(n)
    weight = np.where(border, 0.5, 1.0)
    weighted = np.bincount(frame - first, weights=weight, minlength=n)[:n] if frame.size else count
    area = source.occupied_area if isinstance(source, Cells) else np.full(n, source.area)
    with np.errstate(divide="ignore", invalid="ignore"):
        return pd.DataFrame(
            {
                "frame": np.arange(first, first + n),
                "n_cells": count.astype(np.int64),
                "density": np.where(area > 0, weighted / area, np.nan),
                "count_per_area": np.where(area > 0, count / area, np.nan),
            }
        )


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


def mean_diameter(table: pd.DataFrame) -> tuple[float, Any]:
    """Mean diameter ``d = <sqrt(4 A / pi)>`` of cells away from the border.

    Parameters
    ----------
    table
        Columns area and touches_border.

    Returns
    -------
    diameter : float
        In length units; NaN without such a cell.
    rows : numpy.ndarray
        Which rows were used.
    """
    area = table["area"].to_numpy(dtype=np.float64)
    usable = np.isfinite(area) & (area > 0)
    rows = usable & ~table["touches_border"].to_numpy(dtype=bool)
    if not rows.any():
        return float("nan"), rows
    return float(np.mean(np.sqrt(4 * area[rows] / np.pi))), rows
