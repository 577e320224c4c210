"""Compiled search for divisions."""

from typing import Any

import numpy as np
from numba import njit

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


@njit(cache=True)
def division_gains(
    position: FloatArray,
    shape: FloatArray,
    cut: BoolArray,
    candidates: IntArray,
    orphan: BoolArray,
    middle: FloatArray,
    width: FloatArray,
    tail: float,
    separation: FloatArray,
    ratios: FloatArray,
    population: FloatArray,
    stretch: FloatArray,
    prior: FloatArray,
    leave: FloatArray,
    appear: FloatArray,
    least: float,
    most: int,
    out_cells: IntArray,
    out_gain: FloatArray,
) -> int:
    """Log odds of divisions with at least one daughter that has no sure mother; their number.

    The middle of the daughters stays near the predicted place (Student density), their distance
    against their size is log-normal, and so are the sum of their areas against the mother's and
    their ratio, unless (with chance 1 - ratios[3]) their sizes tell nothing. Mother and daughters
    are elongated along their line by `stretch` (mother, daughters, any cell: mean, width along,
    width across; Student density). Each kind of family has such laws of its own, first axis of
    width, separation, ratios, stretch and prior. population (N,) is the log density of sizes at
    each cell. Writes (mother, daughter, daughter), at most `most` per mother, best first.
    """
    k = candidates.shape[1]
    nu = 5.0
    last = 0
    for i in range(len(candidates)):
        first = last
        for c in range(k):
            j = candidates[i, c]
            if j < 0 or not orphan[j]:
                continue
            for d in range(k):
                h = candidates[i, d]
                if h < 0 or h == j or (orphan[h] and h < j):
                    continue
                dx = position[h, 0] - position[j, 0]
                dy = position[h, 1] - position[j, 1]
                apart = np.sqrt(dx * dx + dy * dy)
                if apart <= 0.0:
                    continue
                mx = (position[h, 0] + position[j, 0]) / 2 - middle[i, 0]
                my = (position[h, 1] + position[j, 1]) / 2 - middle[i, 1]
                both = np.log(np.exp(shape[j, 0]) + np.exp(shape[h, 0]))
                # Elongation along and across the line between the daughters.
                along = (dx * dx - dy * dy) / (apart * apart)
                across = 2.0 * dx * dy / (apart * apart)
                at_edge = cut[i] or cut[j] or cut[h]
                size = max(both, shape[i, 0]) if at_edge else both
                value = -np.inf
                for m in range(len(prior)):
                    if at_edge != (m == 1):
                        continue
                    w = width[m, i]
                    one = prior[m, i] - np.log(2 * np.pi * w * w)
                    one -= (tail / 2 + 1) * np.log1p((mx * mx + my * my) / (w * w * tail))
                    z = (np.log(apart) - size / 2 - separation[m, 0]) / separation[m, 1]
                    one -= 0.5 * z * z + np.log(separation[m, 1] * np.sqrt(2 * np.pi))
                    r = ratios[m]
                    z = (both - shape[i, 0] - r[0]) / r[1]
                    sizes = -0.5 * z * z - np.log(2 * np.pi * r[1] * r[2])
                    z = (shape[j, 0] - shape[h, 0]) / r[2]
                    sizes -= 0.5 * z * z
                    sizes -= population[j] + population[h]
                    one += np.log(1.0 - r[3] + r[3] * np.exp(sizes))
                    for g, role in ((i, 0), (j, 1), (h, 1)):
                        if cut[g]:
                            continue
                        law, any_cell = stretch[m, role], stretch[m, 2, 1]
                        e = along * shape[g, 1] + across * shape[g, 2]
                        o = along * shape[g, 2] - across * shape[g, 1]
                        near = ((e - law[0]) / law[1]) ** 2 + (o / law[2]) ** 2
                        far = (e * e + o * o) / any_cell**2
                        one += (nu / 2 + 1) * (np.log1p(far / nu) - np.log1p(near / nu))
                        one += np.log(any_cell**2 / (law[1] * law[2]))
                    value = one if m < 2 else np.logaddexp(value, one)
                value -= np.log(2 * np.pi * apart * apart)
                value -= leave[i] + appear[j] + appear[h]
                if value <= least or (last - first == most and value <= out_gain[last - 1]):
                    continue
                place = last if last - first < most else last - 1
                last = place + 1
                while place > first and out_gain[place - 1] < value:
                    out_gain[place] = out_gain[place - 1]
                    out_cells[place] = out_cells[place - 1]
                    place -= 1
                out_gain[place] = value
                out_cells[place, 0], out_cells[place, 1], out_cells[place, 2] = i, j, h
    return last
