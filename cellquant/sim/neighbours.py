"""The list of neighbours: pairs of cells and images that may touch, and how far it has aged."""

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)
def find_pairs(
    position: Any, reach: Any, box: Any, skin: float, capacity: int
) -> tuple[Any, Any, Any, Any]:
    """List pairs (i, image of j) whose circles of radius `reach` come closer than `skin`.

    Every pair stands once, with i < j, or i == j and a positive image. Images are enumerated, so
    boxes smaller than a cell are right as well.

    Returns
    -------
    first : (N + 1,) start of the pairs of each cell
    other : (pairs,) the cell j
    shift : (pairs, 2) displacement to be added to the unwrapped position of j
    needed : (1,) number of pairs found; larger than `capacity` where the list did not fit
    """
    n_cells = position.shape[0]
    lx, ly = box[0], box[1]
    largest = 0.0
    for i in range(n_cells):
        largest = max(largest, reach[i])
    cutoff = 2.0 * largest + skin
    nx = max(1, min(int(lx / cutoff), 4096))
    ny = max(1, min(int(ly / cutoff), 4096))
    rx = math.ceil(cutoff / (lx / nx))
    ry = math.ceil(cutoff / (ly / ny))
    head = np.full(nx * ny, -1, np.int64)
    link = np.empty(n_cells, np.int64)
    wrap = np.empty((n_cells, 2), np.float64)
    bin_x = np.empty(n_cells, np.int64)
    bin_y = np.empty(n_cells, np.int64)
    for i in range(n_cells - 1, -1, -1):
        wrap[i, 0] = lx * math.floor(position[i, 0] / lx)
        wrap[i, 1] = ly * math.floor(position[i, 1] / ly)
        bin_x[i] = min(nx - 1, int((position[i, 0] - wrap[i, 0]) / lx * nx))
        bin_y[i] = min(ny - 1, int((position[i, 1] - wrap[i, 1]) / ly * ny))
        bin_index = bin_x[i] * ny + bin_y[i]
        link[i] = head[bin_index]
        head[bin_index] = i
    first = np.zeros(n_cells + 1, np.int64)
    other = np.empty(capacity, np.int64)
    shift = np.empty((capacity, 2), np.float64)
    count = 0
    for i in range(n_cells):
        for ox in range(bin_x[i] - rx, bin_x[i] + rx + 1):
            image_x = math.floor(ox / nx)
            for oy in range(bin_y[i] - ry, bin_y[i] + ry + 1):
                image_y = math.floor(oy / ny)
                j = head[int(ox - image_x * nx) * ny + int(oy - image_y * ny)]
                while j >= 0:
                    itself = j == i and (image_x > 0 or (image_x == 0 and image_y > 0))
                    if j > i or itself:
                        sx = image_x * lx + wrap[i, 0] - wrap[j, 0]
                        sy = image_y * ly + wrap[i, 1] - wrap[j, 1]
                        dx = position[j, 0] + sx - position[i, 0]
                        dy = position[j, 1] + sy - position[i, 1]
                        limit = reach[i] + reach[j] + skin
                        if dx * dx + dy * dy < limit * limit:
                            if count < capacity:
                                other[count] = j
                                shift[count, 0] = sx
                                shift[count, 1] = sy
                            count += 1
                    j = link[j]
        first[i + 1] = count
    kept = min(count, capacity)
    needed = np.empty(1, np.int64)
    needed[0] = count
    return first, other[:kept], shift[:kept], needed


@njit(cache=True)
def transpose_pairs(first: Any, other: Any) -> tuple[Any, Any, Any]:
    """Index the pairs by their second cell: start per cell, pair numbers, and first cells."""
    n_cells = first.shape[0] - 1
    start = np.zeros(n_cells + 1, np.int64)
    for p in range(other.shape[0]):
        start[other[p] + 1] += 1
    for i in range(n_cells):
        start[i + 1] += start[i]
    fill = start[:-1].copy()
    pairs = np.empty(other.shape[0], np.int64)
    cells = np.empty(other.shape[0], np.int64)
    for i in range(n_cells):
        for p in range(first[i], first[i + 1]):
            pairs[fill[other[p]]] = p
            cells[fill[other[p]]] = i
            fill[other[p]] += 1
    return start, pairs, cells


@njit(cache=True)
def inspect(record: Any, reference: Any) -> tuple[float, int, float]:
    """How far the neighbour list has aged, the first faulty cell, and the smallest radius.

    The age is the largest sum of displacement and growth of the reach since the list was made.
    The cell is -1 where every number is finite. The smallest radius is that of the sharpest waist
    in units of its A0.
    """
    age = 0.0
    fault = -1
    narrowest = 1.0
    for i in range(record.shape[0]):
        if not math.isfinite(record[i, 4] + record[i, 0] + record[i, 1] + record[i, 3]):
            fault = i
            break
        dx = record[i, 0] - reference[i, 0]
        dy = record[i, 1] - reference[i, 1]
        age = max(age, math.sqrt(dx * dx + dy * dy) + record[i, 3] - reference[i, 2])
        narrowest = min(narrowest, record[i, 4] / record[i, 2])
    return age, fault, narrowest
