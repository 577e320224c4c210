"""The Brownian paths of the polarities, as a tree: any refinement sees the same path.

For an interval of length h the tree knows the increment W and the space-time area
H = (1/h) integral (W(t) - t W / h) dt ~ N(0, h/12). Halving an interval draws both halves from
their distribution given W and H (Foster, Lyons & Oberhauser, SIAM J. Numer. Anal. 2020), so that a
rejected step is refined on the same path, and runs with steps h, h/2, h/4 share it.
"""

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class BrownianTree:
    """Independent standard Brownian paths of all cells, addressed by interval.

    Parameters
    ----------
    seed
        Seed of the paths.
    n_cells
        Number of paths.
    span
        Length of a root interval, t0. Root interval r covers [r span, (r + 1) span]; its numbers
        are those of a counter-based generator with key `seed` and counter r, whatever was drawn
        before.
    """

    def __init__(self, seed: int, n_cells: int, span: float) -> None:
        self.seed = seed
        self.n_cells = n_cells
        self.span = span
        self._root = -1
        self._levels: list[tuple[Floats, Floats]] = []
        self._rng = np.random.Generator(np.random.Philox(0))

    def level(self, root: int, depth: int) -> tuple[Floats, Floats]:
        """Increments W and areas H of the 2^depth parts of a root interval, each (2^depth, N)."""
        if root != self._root:
            counter = [0, 0, root, 0]
            self._rng = np.random.Generator(np.random.Philox(key=self.seed, counter=counter))
            w = math.sqrt(self.span) * self._rng.standard_normal((1, self.n_cells))
            h = math.sqrt(self.span / 12.0) * self._rng.standard_normal((1, self.n_cells))
            self._root, self._levels = root, [(w, h)]
        while len(self._levels) <= depth:
            self._levels.append(self._halve(len(self._levels) - 1))
        return self._levels[depth]

    def _halve(self, depth: int) -> tuple[Floats, Floats]:
        w, h = self._levels[depth]
        length = self.span * 0.5**depth
        z = math.sqrt(length / 16.0) * self._rng.standard_normal(w.shape)
        n = math.sqrt(length / 48.0) * self._rng.standard_normal(w.shape)
        halves_w = np.empty((2 * len(w), self.n_cells))
        halves_h = np.empty_like(halves_w)
        halves_w[0::2] = 0.5 * w + 1.5 * h + z
        halves_w[1::2] = w - halves_w[0::2]
        common = 0.25 * h - 0.5 * z
        halves_h[0::2] = common + n
        halves_h[1::2] = common - n
        return halves_w, halves_h
