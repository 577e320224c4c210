"""The area that cells can occupy: the field of view without masked margins and large voids.

With the mean spacing s = sqrt(area of the field / number of cells):

- A margin of the field that no cell ever enters is masked when it is wider than s / 2.
- A void is the union of all discs of radius 2 s that hold no pixel of a cell. Their centres lie in
  the field and not within 2 s of two of its edges at once, so that at least half of each disc is
  seen. In a random layer a given disc is empty with the probability exp(-4 pi), about 3e-6, and
  one at the edge of the field with exp(-2 pi), about 2e-3.
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numba as nb
import numpy as np

FloatArray = np.ndarray[Any, np.dtype[np.float64]]

_MARGIN = 0.5
_VOID_RADIUS = 2.0
# Blocks of pixels per mean spacing on which voids are looked for.
_BLOCKS_PER_SPACING = 8


@dataclass
class OccupiedArea:
    """Collects frames one by one; `areas` then gives the area of each in px.

    Parameters
    ----------
    shape
        (H, W) of the frames.
    """

    shape: tuple[int, int]
    _spacings: list[float] = field(default_factory=list)
    _blocks: list[int] = field(default_factory=list)
    _voids: list[np.ndarray[Any, Any] | None] = field(default_factory=list)
    # First and last row and column that ever hold a cell.
    _box: tuple[int, int, int, int] | None = None

    def add(self, labels: np.ndarray[Any, Any], n_cells: int) -> None:
        """Take the next frame with its number of cells."""
        height, width = self.shape
        spacing = float(np.sqrt(height * width / max(n_cells, 1)))
        block = max(1, int(spacing / _BLOCKS_PER_SPACING))
        void = None
        if n_cells:
            empty, box = _coarsen(labels, block)
            self._box = box if self._box is None else _union(self._box, box)
            void = _voids(empty, _VOID_RADIUS * spacing / block)
            self._spacings.append(spacing)
        self._blocks.append(block)
        self._voids.append(None if void is None else np.packbits(void))

    def areas(self) -> FloatArray:
        """(n_frames,) area in px that cells can occupy; the whole field without any cell."""
        height, width = self.shape
        top, bottom, left, right = 0, height, 0, width
        if self._box is not None:
            margin = _MARGIN * float(np.mean(self._spacings))
            first_row, last_row, first_column, last_column = self._box
            top = first_row if first_row > margin else 0
            bottom = last_row + 1 if height - 1 - last_row > margin else height
            left = first_column if first_column > margin else 0
            right = last_column + 1 if width - 1 - last_column > margin else width
        areas = np.full(len(self._blocks), float((bottom - top) * (right - left)))
        for index, (void, block) in enumerate(zip(self._voids, self._blocks, strict=True)):
            if void is None:
                continue
            rows = _overlap(height, block, top, bottom)
            columns = _overlap(width, block, left, right)
            bits = np.unpackbits(void, count=len(rows) * len(columns))
            areas[index] -= rows @ bits.reshape(len(rows), len(columns)).astype(float) @ columns
        return areas


def _union(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def _overlap(size: int, block: int, start: int, stop: int) -> FloatArray:
    """Pixels of each block along one axis that lie between start and stop."""
    edges = np.minimum(np.arange(0, size + block, block), size)
    return np.diff(np.clip(edges, start, stop)).astype(float)


def _voids(
    empty: np.ndarray[Any, np.dtype[np.uint8]], radius: float
) -> np.ndarray[Any, np.dtype[np.bool_]] | None:
    """Blocks within discs of a radius (in blocks) that hold no cell; None without any."""
    if empty.all():
        return None
    distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    across, down = (np.arange(size) + 0.5 for size in (empty.shape[1], empty.shape[0]))
    near_side = np.minimum(across, empty.shape[1] - across) < radius
    near_end = np.minimum(down, empty.shape[0] - down) < radius
    centres = (distance >= radius) & ~(near_end[:, np.newaxis] & near_side)
    if not centres.any():
        return None
    around = cv2.distanceTransform((~centres).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(around < radius)


@nb.njit(cache=True)
def _coarsen(labels, block):  # type: ignore[no-untyped-def]
    """Blocks without a cell as 1, and first and last row and column with one."""
    height, width = labels.shape
    empty = np.ones(((height + block - 1) // block, (width + block - 1) // block), np.uint8)
    top, bottom, left, right = height, -1, width, -1
    for row in range(height):
        coarse_row = row // block
        for coarse_column in range(empty.shape[1]):
            start = coarse_column * block
            stop = min(start + block, width)
            # A block that is known to hold a cell matters only for the box around all cells.
            if empty[coarse_row, coarse_column] == 0 and left <= start and stop - 1 <= right:
                if row > bottom:
                    for column in range(start, stop):
                        if labels[row, column] != 0:
                            bottom = row
                            break
                continue
            for column in range(start, stop):
                if labels[row, column] != 0:
                    empty[coarse_row, coarse_column] = 0
                    top, bottom = min(top, row), max(bottom, row)
                    left, right = min(left, column), max(right, column)
    return empty, (top, bottom, left, right)
