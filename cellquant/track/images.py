"""Image correlation: how alike two cells look when they are laid on each other."""

from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.track.cues import STRATA
from cellquant.track.kernels import overlap_shares, patch_correlations
from cellquant.track.movie import LOG_AREA, FloatArray, IntArray, Movie

if TYPE_CHECKING:
    from cellquant.io import ImageStack, LabelStack

CONTEXTS = STRATA + 3
# Cells are sampled on a grid that leaves about this many pixels of a typical cell.
_SAMPLES = 200.0
_FLOOR = 0.05


class PairImages:
    """Compares cells of successive frames in the masks, and in the raw movie when there is one.

    Frames are read when they are asked for, and two are kept at a time; what was compared once is
    remembered.
    """

    def __init__(
        self,
        movie: Movie,
        masks: "LabelStack",
        raw: "ImageStack | None",
        pixel_size: float,
        expected: FloatArray,
    ) -> None:
        self._movie = movie
        self._masks, self._raw = masks, raw
        self._index_of = {frame: index for index, frame in enumerate(masks.frame_numbers)}
        self._pixels = movie.position / pixel_size
        self._expected = expected / pixel_size
        self._area = np.exp(movie.shape[:, LOG_AREA]) / pixel_size**2
        elongation = np.exp(np.hypot(movie.shape[:, 1], movie.shape[:, 2]))
        self._half = 1.5 * np.sqrt(self._area * elongation / np.pi) + 2.0
        typical = float(np.median(self._area))
        self._stride = max(1, int(np.sqrt(typical / _SAMPLES)))
        self._patch = max(2, round(1.2 * float(np.sqrt(typical / np.pi))))
        self._kept: dict[tuple[bool, int], np.ndarray[Any, Any]] = {}
        self._families: dict[tuple[int, int, int], FloatArray] = {}
        self.n_values = 1 if raw is None else 2

    def _frame(self, index: int, *, raw: bool) -> np.ndarray[Any, Any]:
        key = (raw, index)
        if key not in self._kept:
            for old in [k for k in self._kept if k[0] == raw and abs(k[1] - index) > 1]:
                del self._kept[old]
            place = self._index_of[int(self._movie.time[index])]
            stack = self._raw if raw and self._raw is not None else self._masks
            self._kept[key] = stack[place]
        return self._kept[key]

    def families(self, index: int, cells: IntArray) -> tuple[FloatArray, FloatArray]:
        """Compare mothers with two daughters taken together; cells (L, 3), as `pairs`."""
        keys = [tuple(row) for row in cells.tolist()]
        new = np.array([key not in self._families for key in keys], dtype=bool)
        if new.any():
            rows = np.column_stack(self.pairs(index, *cells[new].T))
            for key, row in zip(cells[new].tolist(), rows, strict=True):
                self._families[tuple(key)] = row
        known = np.array([self._families[key] for key in keys])
        return known[:, : self.n_values], known[:, self.n_values :]

    def pairs(
        self, index: int, source: IntArray, one: IntArray, two: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Compare cells of frame `index` with cells of the next, centroids laid on each other.

        Parameters
        ----------
        index
            Index of the frame of the sources.
        source, one
            (L,) cells of this frame and of the next.
        two
            (L,) second cells of the next frame, taken together with the first.

        Returns
        -------
        value : numpy.ndarray
            (L, Y) logarithm of intersection over union and, with a raw movie, the normalised
            cross-correlation of the patches.
        context : numpy.ndarray
            (L, C) what these depend on in any pair: the stratum of the distance from the expected
            place, change of area, change of elongation, and the distance.
        """
        movie, pixels, area = self._movie, self._pixels, self._area
        target, target_area = pixels[one], area[one]
        turned = np.hypot(*(movie.shape[one, 1:3] - movie.shape[source, 1:3]).T)
        if two is not None:
            target_area = area[one] + area[two]
            weight = (area[one] / target_area)[:, None]
            target = weight * pixels[one] + (1.0 - weight) * pixels[two]
            turned = np.zeros(len(source))
        share = np.empty(len(source))
        overlap_shares(
            self._frame(index, raw=False),
            self._frame(index + 1, raw=False),
            movie.label[source],
            pixels[source],
            self._half[source],
            np.rint(target - pixels[source]).astype(np.int64),
            movie.label[one],
            movie.label[one if two is None else two],
            self._stride,
            share,
        )
        common = np.minimum(share * area[source], target_area)
        columns = [np.log(common / (area[source] + target_area - common) + _FLOOR)]
        if self._raw is not None:
            correlation = np.empty(len(source))
            patch_correlations(
                self._frame(index, raw=True),
                self._frame(index + 1, raw=True),
                np.rint(pixels[source]).astype(np.int64),
                np.rint(target).astype(np.int64),
                self._patch,
                self._stride,
                correlation,
            )
            columns.append(np.arctanh(np.clip(correlation, -0.999, 0.999)))
        away = np.hypot(*(target - self._expected[source]).T) / np.sqrt(area[source])
        change = np.abs(np.log(target_area / area[source]))
        stratum = np.minimum((away * STRATA).astype(np.int64), STRATA - 1)
        context = np.column_stack((stratum[:, None] == np.arange(STRATA), change, turned, away))
        return np.column_stack(columns), context
