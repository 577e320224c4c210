"""Nearest cells by a grid of bins, compiled."""

from typing import Any

import numpy as np
from numba import njit

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]


def nearest_cells(points: FloatArray, there: FloatArray, k: int) -> tuple[IntArray, FloatArray]:
    """Indices (n, k) of the cells nearest to each point, and their squared distances.

    Nearest first, and the lower index first where two are as near; -1 and infinity where there
    are not so many. `points` (n, 2), `there` (m, 2).
    """
    found, square = np.empty((len(points), k), dtype=np.int64), np.empty((len(points), k))
    _visit_rings(points, there, found, square)
    return found, square


@njit(cache=True)
def _visit_rings(
    points: FloatArray, there: FloatArray, found: IntArray, square: FloatArray
) -> None:
    """Sort the cells into bins of one on the average, and visit rings of bins around each point
    until none that is left can hold a nearer cell."""
    k = found.shape[1]
    m = len(there)
    if m == 0:
        found[:] = -1
        square[:] = np.inf
        return
    near, who = np.empty(k), np.empty(k, dtype=np.int64)
    left, top = there[:, 0].min(), there[:, 1].min()
    wide, high = there[:, 0].max() - left, there[:, 1].max() - top
    side = max(np.sqrt(wide * high / m), max(wide, high) / (4.0 * m))
    if side <= 0.0:
        side = 1.0
    nx, ny = int(wide / side) + 1, int(high / side) + 1
    begin = np.zeros(nx * ny + 1, dtype=np.int64)
    home = np.empty(m, dtype=np.int64)
    for j in range(m):
        home[j] = int((there[j, 1] - top) / side) * nx + int((there[j, 0] - left) / side)
        begin[home[j] + 1] += 1
    begin[1:] = np.cumsum(begin[1:])
    slot = begin[:-1].copy()
    order = np.empty(m, dtype=np.int64)
    for j in range(m):
        order[slot[home[j]]] = j
        slot[home[j]] += 1
    sorted_x, sorted_y = there[order, 0], there[order, 1]
    for i in range(len(points)):
        near[:] = np.inf
        who[:] = -1
        x, y = points[i, 0], points[i, 1]
        cx = min(max(int(np.floor((x - left) / side)), 0), nx - 1)
        cy = min(max(int(np.floor((y - top) / side)), 0), ny - 1)
        ox, oy = x - left - cx * side, y - top - cy * side
        edge = min(min(ox, side - ox), min(oy, side - oy))
        for ring in range(max(nx, ny)):
            # All cells nearer than this were visited in the rings before.
            bound = edge + (ring - 1) * side
            if bound > 0.0 and near[k - 1] < bound * bound:
                break
            for by in range(max(cy - ring, 0), min(cy + ring, ny - 1) + 1):
                # A row of a ring is one run of bins; of those between only the ends belong to it.
                whole = abs(by - cy) == ring
                for side_of_it in range(1 if whole else 2):
                    left_bin = cx - ring if side_of_it == 0 else cx + ring
                    right_bin = cx + ring if whole else left_bin
                    left_bin, right_bin = max(left_bin, 0), min(right_bin, nx - 1)
                    if left_bin > right_bin:
                        continue
                    for s in range(begin[by * nx + left_bin], begin[by * nx + right_bin + 1]):
                        d = (sorted_x[s] - x) ** 2 + (sorted_y[s] - y) ** 2
                        if d > near[k - 1]:
                            continue
                        j = order[s]
                        if d == near[k - 1] and j > who[k - 1]:
                            continue
                        place = k - 1
                        while place > 0 and (
                            d < near[place - 1] or (d == near[place - 1] and j < who[place - 1])
                        ):
                            near[place] = near[place - 1]
                            who[place] = who[place - 1]
                            place -= 1
                        near[place] = d
                        who[place] = j
        for q in range(k):
            found[i, q] = who[q]
            square[i, q] = near[q]
