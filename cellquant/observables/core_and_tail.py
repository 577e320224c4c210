"""Gaussian core and exponential tail of displacement lengths, by maximum likelihood."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import erfcx

from cellquant.observables.blocks import jackknife_error
from cellquant.observables.trajectories import FloatArray, IntArray

CORE_REACH = 1.5  # the core ends at this many standard deviations
TAIL_EXCESS = 10.0  # the tail begins where it holds this many times what the core predicts
GAUSSIAN_TAIL = 3.0  # where it never does, at this many standard deviations: 1.1 % of a Gaussian
MIN_COUNT = 30
_STRIDE = 256
STANDS_OUT = f"from where it holds {TAIL_EXCESS:g} times what the core predicts"
END_OF_CORE = (
    f"from {GAUSSIAN_TAIL:g} standard deviations of one component of the core, beyond which "
    f"nowhere {TAIL_EXCESS:g} times what the core predicts is found"
)
Range = tuple[float, float]


class Core(NamedTuple):
    """Fit of exp(-r^2/sigma2) per area on [low, high], with the displacements inside.

    sigma2 is the mean of r^2, twice the variance of one component.
    """

    low: float
    high: float
    n: int
    sigma2: float
    reason: str | None = None

    @property
    def component(self) -> float:
        """Standard deviation of one component."""
        return float(np.sqrt(self.sigma2 / 2))

    def beyond(self, r: Any) -> Any:
        """Displacements longer than r that the fit predicts."""
        return self.n / self.share * np.exp(-(np.asarray(r) ** 2) / self.sigma2)

    @property
    def share(self) -> float:
        """Share of the fitted law that lies inside the range."""
        inside = np.exp(-(self.low**2) / self.sigma2) - np.exp(-(self.high**2) / self.sigma2)
        return float(inside)


class Tail(NamedTuple):
    """Fit of exp(-r/xi) per area on [low, high]; n_core of the n inside belong to the core.

    ``excess`` is how many times what the core predicts the range holds, NaN without a core.
    """

    low: float
    high: float
    n: int
    n_core: float
    xi: float
    rule: str
    excess: float = float("nan")
    reason: str | None = None


@dataclass(frozen=True)
class _Lengths:
    """Increasing lengths with their running sums, so that a range costs two searches.

    ``first`` and ``second`` are the sums of the lengths and of their squares before every
    `_STRIDE`-th. Those of one block may be taken as absent: ``gone`` holds them, ``place`` where
    they stand.
    """

    r: FloatArray
    first: FloatArray
    second: FloatArray
    gone: "_Lengths | None" = None
    place: IntArray | None = None

    @classmethod
    def of(cls, r: FloatArray) -> "_Lengths":
        pieces = [r[start : start + _STRIDE] for start in range(0, r.size, _STRIDE)]
        sums = np.array([(piece.sum(), (piece * piece).sum()) for piece in pieces]).reshape(-1, 2)
        first, second = np.vstack([np.zeros(2), np.cumsum(sums, axis=0)]).T
        return cls(r, first, second)

    def _before(self, rank: int) -> tuple[float, float]:
        """Sums of the lengths and of their squares of the first so many."""
        k = rank // _STRIDE
        rest = self.r[k * _STRIDE : rank]
        return float(self.first[k] + rest.sum()), float(self.second[k] + (rest * rest).sum())

    def without(self, place: IntArray) -> "_Lengths":
        """The same without the lengths that stand at these places."""
        return replace(self, gone=_Lengths.of(self.r[place]), place=place)

    @property
    def size(self) -> int:
        return self.r.size - (self.gone.size if self.gone else 0)

    def at(self, rank: int) -> float:
        """The length with so many below it."""
        if self.place is not None:
            # So many of those that are left stand before each that is gone.
            left_before = self.place - np.arange(self.place.size)
            rank += int(np.searchsorted(left_before, rank, side="right"))
        return float(self.r[rank])

    def beyond(self, places: Any) -> Any:
        """Number of lengths at or beyond each place."""
        n = self.r.size - np.searchsorted(self.r, places)
        return n - self.gone.beyond(places) if self.gone else n

    def between(self, low: float, high: float) -> tuple[int, float, float]:
        """Number of lengths in [low, high], their sum, and the sum of their squares."""
        a, b = np.searchsorted(self.r, low), np.searchsorted(self.r, high, side="right")
        above, below = self._before(int(b)), self._before(int(a))
        n, one, two = int(b - a), above[0] - below[0], above[1] - below[1]
        if self.gone:
            less = self.gone.between(low, high)
            return n - less[0], one - less[1], two - less[2]
        return n, one, two


def fit_core_and_tail(
    r: FloatArray,
    block: IntArray,
    n_blocks: int,
    *,
    core_range: Range | None = None,
    tail_range: Range | None = None,
) -> tuple[Core, float, Tail, float]:
    r"""Fit the core and the tail of a distribution of displacement lengths.

    The core is ``exp(-r^2/sigma2)`` and the tail ``exp(-r/xi)``, both per area, both by maximum
    likelihood inside their range, so that no bin enters. Of a tail that stands out from the core
    the displacements that the core predicts there are taken out first.

    Parameters
    ----------
    r
        (n,) increasing lengths, some above zero.
    block
        (n,) replicate block of each length.
    n_blocks
        Number of blocks.
    core_range
        From 0 to 1.5 standard deviations of a component, found in four steps from the median,
        when None.
    tail_range
        From where it holds ten times what the core predicts, at least 2 standard deviations, to
        infinity when None; where it nowhere does, from 3 standard deviations on, and xi is then
        the local decay length of the core itself.

    Returns
    -------
    core : Core
    sigma2_std_error : float
    tail : Tail
    xi_std_error : float
        Errors by the jackknife: the whole procedure, its choice of ranges included, without
        each block in turn. NaN where there is no fit, and where there is none without a block.

    Undefined (NaN with a reason)
        The core, with fewer than 30 lengths in its range or when they do not fall off; the tail
        likewise.
    """
    lengths = _Lengths.of(r)
    core, tail = _fit(lengths, core_range, tail_range)
    present = np.flatnonzero(np.bincount(block, minlength=n_blocks))
    if present.size < 2:
        return core, float("nan"), tail, float("nan")
    rest = [
        _fit(lengths.without(np.flatnonzero(block == b)), core_range, tail_range) for b in present
    ]
    errors = jackknife_error(np.array([[c.sigma2, t.xi] for c, t in rest]))
    return core, float(errors[0]), tail, float(errors[1])


def _fit(
    lengths: _Lengths, core_range: Range | None, tail_range: Range | None
) -> tuple[Core, Tail]:
    core = _fit_core(lengths, core_range)
    return core, _fit_tail(lengths, tail_range, core)


def _fit_core(lengths: _Lengths, given: Range | None) -> Core:
    """A truncated Rayleigh law: r^2 is a truncated exponential."""
    low, high = given or (0.0, 0.0)
    if given is None:
        high = CORE_REACH * lengths.at(lengths.size // 2) / np.sqrt(2 * np.log(2))
        for _ in range(3):
            n, _, squares = lengths.between(0.0, high)
            sigma2 = _truncated_scale(squares / max(n, 1), 0.0, high**2)
            if not np.isfinite(sigma2):
                break
            high = CORE_REACH * float(np.sqrt(sigma2 / 2))
    n, _, squares = lengths.between(low, high)
    if n < MIN_COUNT:
        few = f"fewer than {MIN_COUNT} displacements lie in the core"
        return Core(low, high, n, float("nan"), few)
    sigma2 = _truncated_scale(squares / n, low**2, high**2)
    reason = None if np.isfinite(sigma2) else "the core does not fall off inside its range"
    return Core(low, high, n, sigma2, reason)


def _truncated_scale(mean: float, low: float, high: float) -> float:
    """Scale s of exp(-u/s) on [low, high] whose mean is the given one; NaN where there is none."""
    width, target = high - low, mean - low
    if not 0 < target < width / 2:
        return float("nan")

    def excess(s: float) -> float:
        ratio = width / s
        return s - (width / np.expm1(ratio) if ratio < 700 else 0.0) - target

    return float(brentq(excess, target / 2, width * 1e6, xtol=1e-14 * width, rtol=1e-13))


def _fit_tail(lengths: _Lengths, given: Range | None, core: Core) -> Tail:
    nan = float("nan")
    known = bool(np.isfinite(core.sigma2))
    if given is not None:
        (low, high), rule = given, "given"
    elif not known:
        unknown = "the tail is placed by the width of the core, which is not known"
        return Tail(nan, nan, 0, 0.0, nan, "none", reason=unknown)
    else:
        low, rule = _tail_start(lengths, core)
        high = float("inf")
    n, total, _ = lengths.between(low, high)
    predicted = float(core.beyond(low) - core.beyond(high)) if known else nan
    excess = n / predicted if predicted > 0 else nan
    if n < MIN_COUNT:
        few = f"fewer than {MIN_COUNT} displacements lie in the tail"
        return Tail(low, high, n, 0.0, nan, rule, excess, few)
    n_core = 0.0
    if rule == STANDS_OUT:
        n_core = predicted
        total -= n_core * _rayleigh_mean(low, core.component)
    xi = _tail_length(total / (n - n_core), low, high)
    reason = None if np.isfinite(xi) else "the tail does not fall off inside its range"
    return Tail(low, high, n, n_core, xi, rule, excess, reason)


def _tail_start(lengths: _Lengths, core: Core) -> tuple[float, str]:
    """First r, in tenths of a standard deviation from two on, that the core does not explain."""
    places = core.component * (2 + 0.1 * np.arange(61))
    beyond = lengths.beyond(places)
    good = np.flatnonzero((beyond >= TAIL_EXCESS * core.beyond(places)) & (beyond >= MIN_COUNT))
    if good.size:
        return float(places[good[0]]), STANDS_OUT
    return GAUSSIAN_TAIL * core.component, END_OF_CORE


def _rayleigh_mean(low: float, sigma: float) -> float:
    """Mean of r beyond `low` under the density r exp(-r^2/(2 sigma^2))."""
    return float(low + sigma * np.sqrt(np.pi / 2) * erfcx(low / (sigma * np.sqrt(2))))


def _tail_length(mean: float, low: float, high: float) -> float:
    """Length xi of the density r exp(-r/xi) on [low, high] whose mean is the given one."""

    def excess(xi: float) -> float:
        a = low / xi
        above, below = a * a + 2 * a + 2, a + 1
        if np.isfinite(high):
            b = high / xi
            gone = np.exp(a - b)
            above -= (b * b + 2 * b + 2) * gone
            below -= (b + 1) * gone
        return float(xi * above / below - mean)

    bottom, top = (mean - low) / 4, 1e3 * mean
    if not bottom > 0 or excess(bottom) >= 0 or excess(top) <= 0:
        return float("nan")
    return float(brentq(excess, bottom, top, xtol=1e-14 * mean, rtol=1e-13))
