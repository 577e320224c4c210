"""The movie as flat arrays: one entry per cell, frames as ranges."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellquant.tables import Cells
from cellquant.track.near import nearest_cells
from cellquant.track.shape_kernels import widest_gaps

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]

NEAR, WIDE = 6, 18  # neighbours that carry the local flow, at two scales
_RING = 8  # neighbours that surround a cell inside the layer
_OPEN_ANGLE = 0.8 * np.pi
LOG_AREA = 0  # column of Movie.shape


@dataclass(frozen=True)
class Movie:
    """Cells of a movie, in order of frame and place.

    Attributes
    ----------
    position
        (N, 2) x, y.
    shape
        (N, F) descriptors compared between frames: logarithm of the area, elongation as a vector
        ``ln(aspect ratio) (cos 2 theta, sin 2 theta)``, logarithm of the shape index.
    frame
        (N,) frame number.
    label
        (N,) label in the masks.
    start
        (P + 1,) first cell of each frame that holds cells, and N.
    time
        (P,) frame number of each frame that holds cells.
    neighbours
        (N, WIDE) nearest cells of the same frame as indices into all cells, nearest first; the
        cell itself where there are not so many.
    spacing
        (P,) typical distance between nearest neighbours.
    density
        (N,) cells per area around each cell.
    margin
        (N,) distance to the edge of the field of view.
    cut
        (N,) whether the cell touches that edge, so that its shape is not its own.
    rim
        (N,) whether the cell lies at the rim of the layer: no neighbour on one side.
    frame_index
        (N,) index of the cell's frame in `time`.
    elapsed
        (N,) frame numbers from the cell's frame to the next that holds cells; 1 in the last.
    """

    position: FloatArray
    shape: FloatArray
    frame: IntArray
    label: IntArray
    start: IntArray
    time: IntArray
    neighbours: IntArray
    spacing: FloatArray
    density: FloatArray
    margin: FloatArray
    cut: BoolArray
    rim: BoolArray
    frame_index: IntArray
    elapsed: FloatArray
    field_of_view: tuple[float, float]

    @property
    def n_cells(self) -> int:
        """Number of cells in all frames."""
        return len(self.frame)

    def cells_of(self, index: int) -> slice:
        """Range of the cells in the frame of this index."""
        return slice(int(self.start[index]), int(self.start[index + 1]))


@dataclass(frozen=True)
class Links:
    """Who follows whom, as indices into all cells; -1 where nobody does.

    ``after`` (N,) the next cell, ``second`` (N,) the other daughter of a division, ``before``
    (N,) the previous cell or the mother, ``confidence`` (N,) of the link that ends in the cell.
    """

    after: IntArray
    second: IntArray
    before: IntArray
    confidence: FloatArray


def flatten(cells: Cells) -> Movie:
    """Arrange measured cells for linking.

    Parameters
    ----------
    cells
        Table ordered by frame.

    Returns
    -------
    Movie
    """
    table = cells.table
    frame = table["frame"].to_numpy(np.int64)
    time, start = np.unique(frame, return_index=True)
    start = np.append(start, len(frame)).astype(np.int64)
    position = np.ascontiguousarray(table[["x", "y"]].to_numpy(np.float64))
    neighbours = np.empty((len(frame), WIDE), dtype=np.int64)
    spacing = np.empty(len(time))
    density = np.empty(len(frame))
    width, height = cells.field_of_view
    for index in range(len(time)):
        here = slice(int(start[index]), int(start[index + 1]))
        found, spacing[index], density[here] = _surroundings(position[here], width * height)
        neighbours[here] = found + start[index]
    open_angle = np.empty(len(frame))
    widest_gaps(position, neighbours[:, :_RING], open_angle)
    x, y = position[:, 0], position[:, 1]
    margin = np.minimum.reduce([x, y, width - cells.pixel_size - x, height - cells.pixel_size - y])
    return Movie(
        position=position,
        shape=_descriptors(cells),
        frame=frame,
        label=table["label"].to_numpy(np.int64),
        start=start,
        time=time,
        neighbours=neighbours,
        spacing=spacing,
        density=density,
        margin=margin,
        cut=table["touches_border"].to_numpy(np.bool_),
        rim=open_angle > _OPEN_ANGLE,
        frame_index=np.repeat(np.arange(len(time)), np.diff(start)),
        elapsed=np.repeat(np.append(np.diff(time), 1), np.diff(start)).astype(np.float64),
        field_of_view=(width, height),
    )


def _surroundings(position: FloatArray, area: float) -> tuple[IntArray, float, FloatArray]:
    n = len(position)
    k = min(WIDE, n - 1)
    found = np.repeat(np.arange(n)[:, None], WIDE, axis=1)
    if k == 0:
        return found, float(np.sqrt(area)), np.full(n, 1.0 / area)
    nearest, square = nearest_cells(position, position, k + 1)
    distance = np.sqrt(square)
    # Coinciding centroids can put another cell first; the own index is then somewhere in the row.
    own = nearest == np.arange(n)[:, None]
    own[~own.any(axis=1), -1] = True
    found[:, :k] = nearest[~own].reshape(n, k)
    spacing = float(np.median(distance[:, 1]))
    if spacing == 0.0:
        spacing = float(np.sqrt(area / n))
    reach = np.maximum(distance[:, min(k, NEAR)], spacing / 2)
    return found, spacing, np.maximum(min(k, NEAR) / (np.pi * reach**2), 1.0 / area)


def _descriptors(cells: Cells) -> FloatArray:
    table = cells.table
    elongation = np.log(np.maximum(table["aspect_ratio"].to_numpy(np.float64), 1.0))
    angle = 2.0 * table["orientation"].to_numpy(np.float64)
    shape_index = table["shape_index"].to_numpy(np.float64)
    known = np.isfinite(shape_index) & (shape_index > 0)
    typical = float(np.median(shape_index[known])) if known.any() else 1.0
    columns = (
        np.log(table["area"].to_numpy(np.float64)),
        elongation * np.cos(angle),
        elongation * np.sin(angle),
        np.log(np.where(known, shape_index, typical)),
    )
    shape = np.column_stack(columns)
    return np.ascontiguousarray(np.where(np.isfinite(shape), shape, 0.0))
