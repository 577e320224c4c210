"""Sub-pixel contours of labelled cells: area, perimeter, moments and neighbours.

A contour is followed along the cracks between the pixels of a cell and all others, the cell on
the right-hand side; everything is measured on that one closed path. `crackpaths` follows it and
says where it may have corners, `arclength` measures its length.
"""

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from cellquant.segment.arclength import contour_length
from cellquant.segment.crackpaths import (
    DX,
    DY,
    NEIGHBOUR_GAP,
    corners_of_contacts,
    corners_of_lines,
    look_across_lines,
    trace,
)

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]

# A contour has a length from this area (px) and this extent along both axes (px) on.
_MIN_AREA = 10
_MIN_WIDTH = 2
# Share of the contour along lines from which on a cell counts as cut out by them.
_LINED = 0.5


class Outlines(NamedTuple):
    """Measures of n cells in pixels; x to the right, y down, pixel centres at integers."""

    x: FloatArray
    y: FloatArray
    area: FloatArray
    perimeter: FloatArray
    aspect_ratio: FloatArray
    orientation: FloatArray
    touches_border: np.ndarray[Any, np.dtype[np.bool_]]
    n_neighbours: IntArray
    enclosed: np.ndarray[Any, np.dtype[np.bool_]]


def measure_outlines(
    labels: np.ndarray[Any, Any], row: IntArray, column: IntArray, *, gap: int = NEIGHBOUR_GAP
) -> Outlines:
    """Measure the cells whose first pixels in reading order are given.

    Parameters
    ----------
    labels
        (H, W) integer labels without parts that are left out.
    row, column
        (n,) first pixel of each cell.
    gap
        Largest number of background pixels between neighbours, in px.

    Returns
    -------
    Outlines
        perimeter is NaN where the contour is too coarse to have a length.
    """
    values, flags, n_neighbours = _measure(np.ascontiguousarray(labels), row, column, gap)
    return Outlines(
        x=values[:, 0],
        y=values[:, 1],
        area=values[:, 2],
        perimeter=values[:, 3],
        aspect_ratio=values[:, 4],
        orientation=values[:, 5],
        touches_border=flags[:, 0],
        n_neighbours=n_neighbours,
        enclosed=flags[:, 1],
    )


@nb.njit(cache=True)
def _measure(labels, rows, columns, gap):  # type: ignore[no-untyped-def]
    height, width = labels.shape
    n_cells = len(rows)
    values = np.empty((n_cells, 6))
    flags = np.zeros((n_cells, 2), np.bool_)
    n_neighbours = np.zeros(n_cells, np.int64)
    steps = np.empty(1024, np.int8)
    outside = np.empty(1024, np.int64)
    seen = np.empty(64, np.int64)
    touching = np.empty(64, np.int64)
    junctions = np.empty(1024, np.int64)
    across = np.empty(1024, np.int64)
    points = np.empty((1024, 7))
    for cell in range(n_cells):
        row, column = rows[cell], columns[cell]
        label = labels[row, column]
        steps, outside, n = trace(labels, row, column, steps, outside)
        # Sums over the pixels inside, in integers relative to the first pixel: each vertical
        # crack adds (or takes away) the pixels of its row from column to the crack.
        s, sx, sy, sxx, sxy, syy = 0, 0, 0, 0, 0, 0
        x, y = 0, 0
        low_x, high_x, high_y = 0, 0, 0
        n_seen, n_touching = 0, 0
        surrounding = outside[0]
        for i in range(n):
            step = steps[i]
            if step == 1 or step == 3:
                line = y if step == 1 else y - 1
                sign = 1 if step == 1 else -1
                count = sign * x
                first = sign * (x * (x - 1) // 2)
                s += count
                sx += first
                sy += count * line
                sxx += sign * ((x - 1) * x * (2 * x - 1) // 6)
                sxy += first * line
                syy += count * line * line
            beyond = outside[i]
            if beyond != surrounding:
                surrounding = -1
            if beyond == -1:
                flags[cell, 0] = True
            elif beyond == 0:
                # Look across the gap along the normal of the crack (to the left).
                look_x = column + x - (1 if step == 2 or step == 3 else 0)
                look_y = row + y - (1 if step == 0 or step == 3 else 0)
                normal = (step + 3) % 4
                for _ in range(gap):
                    look_x += DX[normal]
                    look_y += DY[normal]
                    if not (0 <= look_x < width and 0 <= look_y < height):
                        break
                    beyond = np.int64(labels[look_y, look_x])
                    if beyond != 0:
                        break
            if outside[i] > 0:
                known = False
                for j in range(n_touching - 1, -1, -1):
                    if touching[j] == beyond:
                        known = True
                        break
                if not known:
                    if n_touching == len(touching):
                        longer = np.empty(2 * n_touching, np.int64)
                        longer[:n_touching] = touching
                        touching = longer
                    touching[n_touching] = beyond
                    n_touching += 1
            if beyond > 0 and beyond != label:
                known = False
                for j in range(n_seen - 1, -1, -1):
                    if seen[j] == beyond:
                        known = True
                        break
                if not known:
                    if n_seen == len(seen):
                        longer = np.empty(2 * n_seen, np.int64)
                        longer[:n_seen] = seen
                        seen = longer
                    seen[n_seen] = beyond
                    n_seen += 1
            x += DX[step]
            y += DY[step]
            low_x, high_x, high_y = min(low_x, x), max(high_x, x), max(high_y, y)
        n_neighbours[cell] = n_seen
        flags[cell, 1] = surrounding > 0
        mean_x, mean_y = sx / s, sy / s
        # Central second moments of unit squares, not of points: hence 1/12.
        xx = sxx / s - mean_x * mean_x + 1.0 / 12.0
        yy = syy / s - mean_y * mean_y + 1.0 / 12.0
        xy = sxy / s - mean_x * mean_y
        spread = np.hypot(0.5 * (xx - yy), xy)
        middle = 0.5 * (xx + yy)
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        values[cell, 0] = column + mean_x
        values[cell, 1] = row + mean_y
        values[cell, 2] = s
        coarse = s < _MIN_AREA or min(high_x - low_x, high_y) < _MIN_WIDTH
        values[cell, 3] = np.nan
        if not coarse:
            if n > len(points):
                points = np.empty((2 * n, 7))
                junctions = np.empty(2 * n, np.int64)
                across = np.empty(2 * n, np.int64)
            n_junctions = corners_of_contacts(outside, n, junctions)
            if n_seen > n_touching + 1:  # two cells at least lie across lines
                n_across = look_across_lines(
                    labels, row, column, steps, outside, n, touching, n_touching, across
                )
                if n_across >= _LINED * n:
                    n_junctions = corners_of_lines(across, n, junctions, n_junctions)
            values[cell, 3] = contour_length(steps, outside, n, junctions, n_junctions, points)
        values[cell, 4] = np.sqrt((middle + spread) / (middle - spread))
        values[cell, 5] = angle if angle > -0.5 * np.pi else 0.5 * np.pi
    return values, flags, n_neighbours
