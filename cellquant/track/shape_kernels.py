"""Compiled loops over places and masks: gaps between neighbours, overlap, correlation."""

from typing import Any

import numpy as np
from numba import njit

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]


@njit(cache=True)
def widest_gaps(position: FloatArray, neighbours: IntArray, out: FloatArray) -> None:
    """Widest angle out (N,) around each cell that holds none of its neighbours (N, K), K >= 1."""
    k = neighbours.shape[1]
    angle = np.empty(k)
    for i in range(len(position)):
        for c in range(k):
            j = neighbours[i, c]
            value = np.arctan2(position[j, 1] - position[i, 1], position[j, 0] - position[i, 0])
            place = c
            while place > 0 and angle[place - 1] > value:
                angle[place] = angle[place - 1]
                place -= 1
            angle[place] = value
        out[i] = angle[0] + 2.0 * np.pi - angle[k - 1]
        for c in range(1, k):
            out[i] = max(out[i], angle[c] - angle[c - 1])


@njit(cache=True)
def overlap_shares(
    here: IntArray,
    there: IntArray,
    label: IntArray,
    centre: FloatArray,
    half: FloatArray,
    shift: IntArray,
    targets: IntArray,
    stride: int,
    share: FloatArray,
) -> None:
    """Share (L, K) of each cell that falls on the labels `targets` after an integer shift.

    Only every `stride`-th row and column of the box ``centre +- half`` is visited; label 0 is no
    target.
    """
    height, width = here.shape
    for p in range(len(label)):
        top = max(int(centre[p, 1] - half[p]), 0)
        bottom = min(int(centre[p, 1] + half[p]) + 2, height)
        left = max(int(centre[p, 0] - half[p]), 0)
        right = min(int(centre[p, 0] + half[p]) + 2, width)
        size = 0
        share[p, :] = 0.0
        for y in range(top, bottom, stride):
            v = y + shift[p, 1]
            for x in range(left, right, stride):
                if here[y, x] != label[p]:
                    continue
                size += 1
                u = x + shift[p, 0]
                if u < 0 or v < 0 or u >= width or v >= height or there[v, u] == 0:
                    continue
                for c in range(targets.shape[1]):
                    if there[v, u] == targets[p, c]:
                        share[p, c] += 1.0
                        break
        for c in range(targets.shape[1]):
            share[p, c] = share[p, c] / size if size > 0 else np.nan


@njit(cache=True)
def patch_correlations(
    here: FloatArray,
    there: FloatArray,
    source: IntArray,
    target: IntArray,
    half: int,
    stride: int,
    correlation: FloatArray,
) -> None:
    """Normalised cross-correlation (L,) of square patches around pixels (L, 2) of two images.

    NaN where less than half of the patch lies inside both images or one of them is flat.
    """
    height, width = here.shape
    side = len(range(-half, half + 1, stride))
    for p in range(len(source)):
        n = 0
        sa = sb = saa = sbb = sab = 0.0
        for dy in range(-half, half + 1, stride):
            ya, yb = source[p, 1] + dy, target[p, 1] + dy
            if ya < 0 or yb < 0 or ya >= height or yb >= height:
                continue
            for dx in range(-half, half + 1, stride):
                xa, xb = source[p, 0] + dx, target[p, 0] + dx
                if xa < 0 or xb < 0 or xa >= width or xb >= width:
                    continue
                a, b = float(here[ya, xa]), float(there[yb, xb])
                n += 1
                sa += a
                sb += b
                saa += a * a
                sbb += b * b
                sab += a * b
        correlation[p] = np.nan
        if 2 * n >= side * side:
            va, vb = saa - sa * sa / n, sbb - sb * sb / n
            if va > 1e-9 * max(saa, 1e-300) and vb > 1e-9 * max(sbb, 1e-300):
                correlation[p] = (sab - sa * sb / n) / np.sqrt(va * vb)
