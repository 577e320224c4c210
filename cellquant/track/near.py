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
    """Sort the cells into bins of one on the average, gather those around each point until no
    other can be nearer, and rank the distances."""
    k = found.shape[1]
    m = len(there)
    if m == 0:
        found[:] = -1
        square[:] = np.inf
        return
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
    far, who = np.empty(m + 1), np.empty(m + 1, dtype=np.int64)
    # Within this distance there are somewhat more than k in an even layer.
    usual = np.sqrt(1.25 * k / np.pi)
    first = int(np.ceil(usual))
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        cx = min(max(int(np.floor((x - left) / side)), 0), nx - 1)
        cy = min(max(int(np.floor((y - top) / side)), 0), ny - 1)
        ox, oy = x - left - cx * side, y - top - cy * side
        edge = min(min(ox, side - ox), min(oy, side - oy))
        reach = first
        while True:
            x_low, x_high = max(cx - reach, 0), min(cx + reach, nx - 1)
            y_low, y_high = max(cy - reach, 0), min(cy + reach, ny - 1)
            # All cells nearer than this lie in these bins.
            bound = edge + reach * side
            if reach == first:
                bound = min(bound, usual * side)
            limit = max(bound, 0.0) ** 2
            everywhere = x_high - x_low + 1 == nx and y_high - y_low + 1 == ny
            if everywhere:
                limit = np.inf
            n = 0
            for by in range(y_low, y_high + 1):
                for s in range(begin[by * nx + x_low], begin[by * nx + x_high + 1]):
                    away = (sorted_x[s] - x) ** 2 + (sorted_y[s] - y) ** 2
                    far[n], who[n] = away, order[s]
                    n += away < limit
            if n >= k or everywhere:
                break
            reach += 1
        for q in range(k):
            found[i, q] = -1
            square[i, q] = np.inf
        for c in range(n):
            j, here, rank = who[c], far[c], 0
            for q in range(n):
                rank += far[q] < here
            if rank >= k:
                continue
            # Cells as far as each other have one rank, and stand there in order of their index.
            while rank < k and found[i, rank] >= 0:
                found[i, rank], j = min(found[i, rank], j), max(found[i, rank], j)
                rank += 1
            if rank < k:
                found[i, rank], square[i, rank] = j, here
