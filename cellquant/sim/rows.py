"""The rows of a simulated run as a table of tracks, made a few cells at a time."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cellquant import rows
from cellquant.rows import Piece, Rows, Scan
from cellquant.sim.shapes import measure_shapes
from cellquant.tables import TRACK_COLUMNS

if TYPE_CHECKING:
    from cellquant.sim.archive import Run

Floats = NDArray[np.float64]
SHAPE_COLUMNS = ("perimeter", "shape_index", "aspect_ratio", "orientation")
# Frames lie on disk one after the other and rows are wanted cell by cell: a pass over the rows
# decodes the run once for each group of cells, of which one at a time is held.
GROUPS = 8


@dataclass(frozen=True)
class RunScan(Scan):
    """A simulated run that is read as a table of tracks without being one.

    Attributes
    ----------
    run
        The run.
    """

    run: "Run"

    @property
    def rows(self) -> "RunRows":
        """Its rows, made when they are asked for."""
        return RunRows(self.run)


class RunRows(Rows):
    """Rows of a run, all frames of the first cell first.

    Label and track_id are the index of the cell plus one; x, y the unwrapped centres; no cell
    touches a border.
    """

    linked = True

    def __init__(self, run: "Run") -> None:
        self._run = run

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self._run.radius) * self._run.n_frames

    @cached_property
    def _in_order(self) -> bool:
        return True

    def _stretches(self, names: list[str]) -> Iterator[Piece]:
        n_cells, n_frames = len(self._run.radius), self._run.n_frames
        counts = self._run.count_neighbours() if "n_neighbours" in names else None
        at_once = max(1, rows.PIECE // n_frames)
        size = max(-(-n_cells // GROUPS), at_once)
        for first in range(0, n_cells, size):
            group = slice(first, min(first + size, n_cells))
            series = self._series(group, names)
            if counts is not None:
                series["n_neighbours"] = counts[:, group].T
            for start in range(group.start, group.stop, at_once):
                cells = np.arange(start, min(start + at_once, group.stop))
                yield {
                    name: self._column(name, series, cells, cells - group.start) for name in names
                }

    def _series(self, group: slice, names: list[str]) -> dict[str, Any]:
        """(n_group, n_frames) arrays of what changes with time."""
        run, n = self._run, group.stop - group.start
        series = {
            name: np.empty((n, run.n_frames))
            for name in names
            if name in ("x", "y", *SHAPE_COLUMNS)
        }
        shapes = [name for name in SHAPE_COLUMNS if name in names]
        for frames in run.stretches() if series else ():
            if "x" in series or "y" in series:
                position = run.read("position", frames)[:, group]
                for axis, name in enumerate("xy"):
                    if name in series:
                        series[name][:, frames] = position[:, :, axis].T
            if shapes:
                modes, polarity = (run.read(k, frames)[:, group] for k in ("modes", "polarity"))
                table = measure_shapes(
                    modes.reshape(-1, *modes.shape[2:]),
                    polarity.ravel(),
                    np.tile(run.radius[group], len(modes)),
                )
                for name in shapes:
                    series[name][:, frames] = table[name].to_numpy().reshape(-1, n).T
        return series

    def _column(self, name: str, series: dict[str, Any], cells: Any, places: Any) -> Any:
        run = self._run
        n_frames, size = run.n_frames, len(cells) * run.n_frames
        if name in series:
            return series[name][places].ravel()
        if name in ("frame", "time"):
            return np.tile(np.arange(n_frames) if name == "frame" else run.time, len(cells))
        if name in ("label", "track_id"):
            return np.repeat(cells + 1, n_frames)
        if name == "area":
            return np.repeat(math.pi * run.radius[cells] ** 2, n_frames)
        return np.zeros(size, TRACK_COLUMNS[name])  # touches_border, parent_track_id
