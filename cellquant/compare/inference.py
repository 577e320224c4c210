"""Parameters of the model that agree with a layer, with credible regions, from a sweep."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellquant.compare.emulator import Emulator, Observed, observed_features, train
from cellquant.compare.groups import Group
from cellquant.compare.ranking import Units, common_features

FloatArray = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Posterior:
    """Parameters of the model that agree with a target.

    Attributes
    ----------
    names
        Parameters that vary over the sweep.
    samples
        (n, len(names)) draws from the posterior.
    log_density
        (n,) its logarithm at the draws, up to a constant.
    features
        Features used.
    bounds
        Range of each parameter in the sweep, the support of the flat prior.
    emulator
        What the likelihood was computed with.
    target
        Features of the target and their errors.
    """

    names: tuple[str, ...]
    samples: FloatArray
    log_density: FloatArray
    features: tuple[str, ...]
    bounds: Mapping[str, tuple[float, float]]
    emulator: "Emulator"
    target: Observed

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """Low end, median and high end of the central interval of one parameter."""
        column = self.samples[:, self.names.index(name)]
        low, middle, high = np.quantile(column, [(1 - level) / 2, 0.5, (1 + level) / 2])
        return float(low), float(middle), float(high)

    def contains(self, scene: Mapping[str, float], level: float = 0.95) -> bool:
        """Whether a point lies in the region of highest posterior density of this probability."""
        point = np.array([[scene[name] for name in self.names]])
        density = float(self.emulator.log_likelihood(point, self.target)[0])
        return density >= float(np.quantile(self.log_density, 1 - level))

    def at_edge(self, name: str) -> bool:
        """Whether the posterior leans on an end of the sweep's range, and so may go beyond it."""
        low, high = self.bounds[name]
        near = 0.05 * (high - low)
        column = self.samples[:, self.names.index(name)]
        return bool(max((column < low + near).mean(), (column > high - near).mean()) > 0.2)


def fit_parameters(
    target: Group,
    candidates: Sequence[Group],
    *,
    units: Units | None = None,
    emulator: Emulator | None = None,
    n_points: int = 1024,
    seed: int = 0,
) -> Posterior:
    """Estimate phi, v0 and eta of a target, with credible regions, from a sweep.

    A Gaussian process per feature (anisotropic squared exponential plus a linear trend,
    scikit-learn) is fitted to the scenes; the likelihood of the target's features is a t law
    with the errors of target and emulator, correlated as the scenes scatter about the emulator;
    its degrees of freedom are those of the target's errors, trials or blocks less one.
    The error of a single run or recording says nothing of the scatter between runs, so it is
    widened by the factor by which the scenes scatter more than they say. All errors are then
    widened until the regions hold the scenes of the sweep, each left out in turn, as often as
    they say (`cellquant.compare.calibration`). The prior is flat over the range of the sweep:
    nothing is said beyond it.

    Parameters
    ----------
    target
        The layer to match.
    candidates
        Simulated scenes of a sweep in which at least one parameter varies.
    units
        L0 and t0 in the target's units; pure numbers only when None.
    emulator
        An emulator of the same scenes (`train`); fitted here when None.
    n_points
        Number of draws; they start from a scrambled Sobol sequence over the prior.
    seed
        Seed of everything random; equal seeds give equal posteriors.

    Raises
    ------
    InputError
        If there are fewer than eight scenes, no parameter varies, or no feature is shared.

    References
    ----------
    Rasmussen & Williams, Gaussian Processes for Machine Learning (2006), chapter 2.
    Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 425 (2001), doi:10.1111/1467-9868.00294.
    """
    from scipy.stats import qmc
    from threadpoolctl import threadpool_limits

    if emulator is None:
        emulator = train(candidates, common_features(target, candidates, units)[0])
    observed = observed_features(target, emulator.features, units)
    low, high = emulator.low, emulator.high
    start = low + qmc.Sobol(len(low), seed=seed).random(n_points) * (high - low)
    with threadpool_limits(1):  # the matrices are too small for more to pay
        samples, density = _sample(
            lambda points: emulator.log_likelihood(points, observed),
            start,
            low,
            high,
            np.random.default_rng(seed),
        )
    bounds = {n: (float(a), float(b)) for n, a, b in zip(emulator.names, low, high, strict=True)}
    return Posterior(
        emulator.names,
        samples,
        density,
        emulator.features,
        bounds,
        emulator,
        observed,
    )


def _sample(
    log_density: Callable[[FloatArray], FloatArray],
    points: FloatArray,
    low: FloatArray,
    high: FloatArray,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Carry points from the flat prior to the posterior, by tempering and Metropolis moves.

    The power of the density rises from 0 to 1 in steps that keep half of the points effective;
    after each step the points are drawn again by weight and moved eight times, with steps shaped
    like their covariance (Del Moral, Doucet & Jasra, J. R. Stat. Soc. B 68, 411 (2006)).
    """
    n, d = points.shape
    density = log_density(points)
    power = 0.0
    while power < 1.0:
        step = _next_step(density, 1.0 - power, n / 2)
        power = 1.0 if step >= 1.0 - power else power + step
        weight = np.exp(step * (density - density.max()))
        chosen = rng.choice(n, n, p=weight / weight.sum())
        points, density = points[chosen], density[chosen]
        covariance = np.atleast_2d(np.cov(points, rowvar=False))
        floor = np.diag((1e-5 * (high - low)) ** 2)
        shape = np.linalg.cholesky(covariance * 2.4**2 / d + floor)
        for _ in range(8):
            proposed = points + rng.standard_normal((n, d)) @ shape.T
            inside = ((proposed >= low) & (proposed <= high)).all(axis=1)
            new = np.full(n, -np.inf)
            if inside.any():
                new[inside] = log_density(proposed[inside])
            accept = np.log(rng.random(n)) < power * (new - density)
            points = np.where(accept[:, None], proposed, points)
            density = np.where(accept, new, density)
    return points, density


def _next_step(density: FloatArray, largest: float, effective: float) -> float:
    """Largest rise of the power that leaves that many effective points."""

    def count(step: float) -> float:
        weight = np.exp(step * (density - density.max()))
        return float(weight.sum() ** 2 / (weight**2).sum())

    if count(largest) >= effective:
        return largest
    low, high = 0.0, largest
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if count(middle) >= effective else (low, middle)
    return max(low, 1e-9)


def sensitivity(posterior: Posterior) -> dict[str, dict[str, float]]:
    """Which feature constrains which parameter.

    Change of the emulated feature from one end of a parameter's range to the other, the others
    at their posterior medians, in standard errors of the target.

    Returns
    -------
    dict
        By feature, then by parameter.
    """
    middle = np.array([posterior.interval(name)[1] for name in posterior.names])
    out: dict[str, dict[str, float]] = {feature: {} for feature in posterior.features}
    target = posterior.target
    error = target.error
    if target.single:
        error = posterior.emulator.single_run_error(middle[None], error)[0]
    deviation = np.sqrt(error**2 + (target.shared**2).sum(axis=1))
    for i, name in enumerate(posterior.names):
        ends = np.array([middle, middle])
        ends[:, i] = posterior.bounds[name]
        mean, _ = posterior.emulator.predict(ends)
        for j, feature in enumerate(posterior.features):
            out[feature][name] = float((mean[1, j] - mean[0, j]) / deviation[j])
    return out
