"""Image correlation: how alike two cells look when they are laid on each other."""

from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.track.cues import Look
from cellquant.track.movie import LOG_AREA, FloatArray, IntArray, Movie
from cellquant.track.shape_kernels import overlap_shares, patch_correlations

if TYPE_CHECKING:
    from cellquant.io import ImageStack, LabelStack

# Cells are sampled on a grid that leaves about this many pixels of a typical cell.
_SAMPLES = 200.0
_SLIGHT = 0.05  # intersection over union below which differences do not matter
_MEET = 0.7  # roots of the area; round cells of one size touch at 1.1


class PairImages:
    """Compares cells of successive frames in the masks, and in the raw movie when there is one.

    Frames are read when they are asked for, and two are kept at a time.
    """

    def __init__(
        self,
        movie: Movie,
        masks: "LabelStack",
        raw: "ImageStack | None",
        pixel_size: float,
    ) -> None:
        self._movie = movie
        self._masks, self._raw = masks, raw
        self._index_of = {frame: index for index, frame in enumerate(masks.frame_numbers)}
        self._pixels = movie.position / pixel_size
        self._pixel_size = pixel_size
        self._expected = self._pixels
        self._area = np.exp(movie.shape[:, LOG_AREA]) / pixel_size**2
        elongation = np.exp(np.hypot(movie.shape[:, 1], movie.shape[:, 2]))
        self._half = 1.5 * np.sqrt(self._area * elongation / np.pi) + 2.0
        typical = float(np.median(self._area))
        self._stride = max(1, int(np.sqrt(typical / _SAMPLES)))
        self._patch = max(2, round(1.2 * float(np.sqrt(typical / np.pi))))
        self._kept: dict[tuple[bool, int], np.ndarray[Any, Any]] = {}

    def expect(self, place: FloatArray) -> None:
        """Set where each cell (N, 2) is expected in the next frame."""
        self._expected = place / self._pixel_size

    def _frame(self, index: int, *, raw: bool) -> np.ndarray[Any, Any]:
        key = (raw, index)
        if key not in self._kept:
            for old in [k for k in self._kept if k[0] == raw and abs(k[1] - index) > 1]:
                del self._kept[old]
            place = self._index_of[int(self._movie.time[index])]
            stack = self._raw if raw and self._raw is not None else self._masks
            self._kept[key] = stack[place]
        return self._kept[key]

    def families(self, cells: IntArray) -> list[Look]:
        """Compare mothers with two daughters taken together, laid on each other; cells (L, 3).

        The first look is at the logarithm of the intersection over union, and depends on either
        change of area; the second is as that of `pairs`. Rows are in the order of their mothers.
        """
        frame = self._movie.frame_index[cells[:, 0]]
        parts = []
        for index in np.unique(frame).tolist():
            first, last = np.searchsorted(frame, (index, index + 1))
            parts.append(self._compare_families(index, *cells[first:last].T))
        known = np.concatenate(parts)
        values = known[:, : len(known[0]) - 5]
        return [Look(value, known[:, -5:-1], known[:, -1]) for value in values.T]

    def _compare_families(
        self, index: int, mother: IntArray, one: IntArray, two: IntArray
    ) -> FloatArray:
        pixels, area = self._pixels, self._area
        both = area[one] + area[two]
        weight = (area[one] / both)[:, None]
        target = weight * pixels[one] + (1.0 - weight) * pixels[two]
        daughters = np.column_stack((one, two))
        share = self._shares(index, mother, target - pixels[mother], daughters).sum(axis=1)
        common = np.minimum(share * area[mother], both)
        columns = [np.log(common / (area[mother] + both - common) + _SLIGHT)]
        if self._raw is not None:
            columns.append(self._correlations(index, mother, target))
        context, distance = self._context(mother, target, both)
        context[:, -1] = np.abs(context[:, -1])
        return np.column_stack((*columns, context, distance))

    def pairs(self, index: int, source: IntArray, targets: IntArray) -> list[Look]:
        """Compare cells of frame `index` with cells of the next.

        Parameters
        ----------
        index
            Index of the frame of the sources.
        source
            (L,) cells of this frame.
        targets
            (L, K) cells of the next frame; -1 where there is none.

        Returns
        -------
        list of Look
            Each of L K pairs. First the share of the source's mask that falls on the target when
            it is put where it is expected, unless that is too far for them to meet; then, with a
            raw movie, the normalised cross-correlation of the patches.
        """
        share = self._shares(index, source, self._expected[source] - self._pixels[source], targets)
        sources, target = np.repeat(source, targets.shape[1]), targets.reshape(-1)
        place = self._pixels[target]
        context, distance = self._context(sources, place, self._area[target])
        meet = (target >= 0) & (distance < _MEET)
        looks = [Look(np.where(meet, share.reshape(-1), np.nan), context, distance)]
        if self._raw is not None:
            alike = self._correlations(index, sources, place)
            looks.append(Look(np.where(target >= 0, alike, np.nan), context, distance))
        return looks

    def _shares(
        self, index: int, source: IntArray, shift: FloatArray, targets: IntArray
    ) -> FloatArray:
        share = np.empty(targets.shape)
        overlap_shares(
            self._frame(index, raw=False),
            self._frame(index + 1, raw=False),
            self._movie.label[source],
            self._pixels[source],
            self._half[source],
            np.rint(shift).astype(np.int64),
            np.where(targets >= 0, self._movie.label[targets], 0),
            self._stride,
            share,
        )
        return share

    def _correlations(self, index: int, source: IntArray, place: FloatArray) -> FloatArray:
        correlation = np.empty(len(source))
        patch_correlations(
            self._frame(index, raw=True),
            self._frame(index + 1, raw=True),
            np.rint(self._pixels[source]).astype(np.int64),
            np.rint(place).astype(np.int64),
            self._patch,
            self._stride,
            correlation,
        )
        alike: FloatArray = np.arctanh(np.clip(correlation, -0.999, 0.999))
        return alike

    def _context(
        self, source: IntArray, place: FloatArray, area: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Constant, distance up to 1, its square, change of area (L, 4); and the distance (L,)."""
        away = np.hypot(*(place - self._expected[source]).T) / np.sqrt(self._area[source])
        near = np.minimum(away, 1.0)
        change = np.log(area / self._area[source])
        return np.column_stack((np.ones(len(source)), near, near**2, change)), away
