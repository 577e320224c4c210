"""The part of an open field that cells can occupy, as the positions of one frame show it."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy import fft

from cellquant.observables.trajectories import FloatArray

VOID_RADIUS = 2.0  # mean spacings, as for the area of the density
MARGIN = 0.5  # mean spacings of the layer between its outermost centres and its edge
REGION_RULE = (
    "without the voids that discs of two mean spacings fit into, less half a spacing around each "
    "centre"
)
_BLOCKS = 8  # per mean spacing
_LARGEST = 512  # blocks along the longer edge


@dataclass(frozen=True)
class Region:
    """A part of a rectangle, in blocks.

    Attributes
    ----------
    mask
        (n_x, n_y) which blocks belong to it.
    block
        (2,) edges of a block in length units.
    """

    mask: np.ndarray[Any, np.dtype[np.bool_]]
    block: FloatArray

    @property
    def share(self) -> float:
        """Share of the rectangle."""
        return float(self.mask.mean())

    @property
    def area(self) -> float:
        """In length units squared."""
        return float(self.mask.sum() * np.prod(self.block))

    def overlap(self, distance: FloatArray) -> FloatArray:
        """Area that the region shares with itself moved by a distance, mean over directions.

        ``gamma(r) = < |W and (W + r e)| >_e``: the measure of the places in W from which a step
        of length r in a random direction ends in W.
        """
        # Room for the largest step keeps the periodic correlation from wrapping around.
        room = [
            fft.next_fast_len(int(n + np.ceil(distance.max() / b) + 2), real=True)
            for n, b in zip(self.mask.shape, self.block, strict=True)
        ]
        wave = fft.rfft2(self.mask.astype(np.float64), room)
        shared = fft.irfft2(np.abs(wave) ** 2, room) * np.prod(self.block)
        angle = np.pi * (np.arange(64) + 0.5) / 64
        # In blocks; a step and its opposite share the same area, so half a circle will do.
        step = [
            np.multiply.outer(distance, turn) / b
            for turn, b in zip((np.cos(angle), np.sin(angle)), self.block, strict=True)
        ]
        low = [np.floor(s).astype(np.int64) for s in step]
        part = [s - k for s, k in zip(step, low, strict=True)]
        total = np.zeros(step[0].shape)
        for i in (0, 1):
            for j in (0, 1):
                weight = (part[0] if i else 1 - part[0]) * (part[1] if j else 1 - part[1])
                total += weight * shared[(low[0] + i) % room[0], (low[1] + j) % room[1]]
        mean: FloatArray = total.mean(axis=1)
        return mean


def find_region(place: FloatArray, edges: FloatArray) -> Region | None:
    """The region of one frame; None where it is the whole rectangle.

    A void is a union of discs of radius 2 s, with their centres in the rectangle, that hold no
    position: the rule by which the density finds the area that cells can occupy. s is the mean
    spacing ``sqrt(area/n)``, first of the rectangle, then of the part of it that this leaves. The
    outermost positions lie inside the layer by about s/2, so that much is taken off the radius of
    each disc. Among random positions a disc is empty with probability exp(-4 pi), 3e-6, or
    exp(-2 pi) at an edge.

    Parameters
    ----------
    place
        (n, 2) positions in the rectangle.
    edges
        (2,) its edges, > 0.
    """
    n = len(place)
    if n < 2:
        return None
    spacing = float(np.sqrt(np.prod(edges) / n))
    size = max(spacing / _BLOCKS, float(edges.max()) / _LARGEST)
    shape = np.maximum(np.ceil(edges / size).astype(np.int64), 1)
    block = edges / shape
    free = np.ones(shape, np.uint8)
    free[tuple(np.minimum((place / block).astype(np.int64), shape - 1).T)] = 0
    # The blocks are squares to within one part in their number along the shorter edge.
    spacing /= float(block.max())
    to_centre = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    for _ in range(2):  # with the spacing of the rectangle, then with that of the part found
        radius = VOID_RADIUS * spacing
        voids = to_centre > radius
        if not voids.any():
            return None
        away = cv2.distanceTransform((~voids).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        spacing = float(np.sqrt(np.sum(away >= radius) / n))
    mask = np.asarray(away >= radius - MARGIN * spacing)
    return Region(mask, block)
