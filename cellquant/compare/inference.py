"""Parameters of the model that agree with a layer, with credible regions, from a sweep."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellquant.compare.groups import SCENE_KEYS, Group
from cellquant.compare.ranking import REDUCED_UNITS, Units, common_features, features_of
from cellquant.errors import InputError

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
# Of errors inside one recording: 16 to 25 spatial blocks, the smaller number less one.
BLOCK_FREEDOM = 15
FACTORS = (1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6, 6.0)


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
        Features of the target, their own errors, the errors that they share, whether they come
        from a single recording, and the degrees of freedom of the errors.
    """

    names: tuple[str, ...]
    samples: FloatArray
    log_density: FloatArray
    features: tuple[str, ...]
    bounds: Mapping[str, tuple[float, float]]
    emulator: "Emulator"
    target: tuple[FloatArray, FloatArray, FloatArray, bool, int]

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """Low end, median and high end of the central interval of one parameter."""
        column = self.samples[:, self.names.index(name)]
        low, middle, high = np.quantile(column, [(1 - level) / 2, 0.5, (1 + level) / 2])
        return float(low), float(middle), float(high)

    def contains(self, scene: Mapping[str, float], level: float = 0.95) -> bool:
        """Whether a point lies in the region of highest posterior density of this probability."""
        point = np.array([[scene[name] for name in self.names]])
        density = float(self.emulator.log_likelihood(point, *self.target)[0])
        return density >= float(np.quantile(self.log_density, 1 - level))

    def at_edge(self, name: str) -> bool:
        """Whether the posterior leans on an end of the sweep's range, and so may go beyond it."""
        low, high = self.bounds[name]
        near = 0.05 * (high - low)
        column = self.samples[:, self.names.index(name)]
        return bool(max((column < low + near).mean(), (column > high - near).mean()) > 0.2)


@dataclass(frozen=True)
class Emulator:
    """Gaussian processes that give each feature at any point of the sweep, with its error.

    Attributes
    ----------
    names, features
        Parameters and features.
    models
        One process per feature.
    error_law
        (1 + parameters, features) logarithm of the error of a run as a linear function.
    scatter
        Factor by which each feature scatters between runs more than the error estimated inside
        a single one says.
    widen
        Factor >= 1 on the error of each, from predicting every scene without itself.
    low, high
        Range of each parameter in the sweep.
    correlation
        Of the features of a run about what its parameters predict.
    """

    names: tuple[str, ...]
    features: tuple[str, ...]
    models: tuple[Any, ...]
    error_law: FloatArray
    scatter: FloatArray
    widen: FloatArray
    low: FloatArray
    high: FloatArray
    correlation: FloatArray

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation, (n, features), of the expected feature."""
        scaled = _scaled(points, self.low, self.high)
        pairs = [model.predict(scaled, return_std=True) for model in self.models]
        deviation = np.column_stack([p[1] for p in pairs]) * self.widen
        return np.column_stack([p[0] for p in pairs]), deviation

    def single_run_error(self, points: FloatArray, error: FloatArray) -> FloatArray:
        """Errors (n, features) of one recording: its scatter between recordings included.

        The errors that it gives are noisy. Their common size is kept; which feature is known
        better than which follows from the scenes.
        """
        law = _with_constant(_scaled(points, self.low, self.high)) @ self.error_law
        size = (np.log(error) - law).mean(axis=1, keepdims=True)
        out: FloatArray = self.scatter * np.exp(law + size)
        return out

    def log_likelihood(
        self,
        points: FloatArray,
        value: FloatArray,
        error: FloatArray,
        shared: FloatArray,
        single: bool,
        freedom: int,
    ) -> FloatArray:
        """Logarithm of the probability of the observed features at each point.

        A multivariate t law: the size of the errors is itself known from few replicates.

        Parameters
        ----------
        points
            (n, parameters).
        value, error
            (features,) observed, with the errors that belong to each alone.
        shared
            (features, sources) errors that several features have in common.
        single
            The errors were estimated inside one recording.
        freedom
            Degrees of freedom of the errors.
        """
        mean, deviation = self.predict(points)
        spread = np.hypot(deviation, self.single_run_error(points, error) if single else error)
        total = self.correlation * spread[:, :, None] * spread[:, None, :] + shared @ shared.T
        diagonal = np.arange(len(value))
        factor = np.linalg.cholesky(total)
        z = np.linalg.solve(factor, (value - mean)[..., None])[..., 0]
        volume = np.log(factor[:, diagonal, diagonal]).sum(axis=1)
        tail = np.log1p((z**2).sum(axis=1) / freedom)
        out: FloatArray = -0.5 * (freedom + len(value)) * tail - volume
        return out


def train(candidates: Sequence[Group], features: Sequence[str]) -> Emulator:
    """Fit a Gaussian process per feature to the scenes of a sweep, each with its own error.

    Parameters
    ----------
    candidates
        Simulated scenes; those without known phi, v0 and eta, or without a feature, are left out.
    features
        Names of the features.

    Raises
    ------
    InputError
        If there are fewer than eight scenes, or no parameter varies.
    """
    from threadpoolctl import threadpool_limits

    tables = [features_of(group, REDUCED_UNITS) for group in candidates]
    known = [
        (group, table)
        for group, table in zip(candidates, tables, strict=True)
        if len(group.scene) == len(SCENE_KEYS) and all(f in table for f in features)
    ]
    if len(known) < 8:
        raise InputError(
            f"{len(known)} scenes with known phi, v0 and eta are given and an estimate needs "
            "eight or more; add the folder of a sweep."
        )
    names = tuple(k for k in SCENE_KEYS if len({g.scene[k] for g, _ in known}) > 1)
    if not names:
        raise InputError("no parameter varies over the sweep; vary phi, v0 or eta.")
    points = np.array([[group.scene[name] for name in names] for group, _ in known])
    low, high = points.min(axis=0), points.max(axis=0)
    values = np.array([[table[f].value for f in features] for _, table in known])
    errors = np.array([[table[f].std_error for f in features] for _, table in known])
    scaled = _scaled(points, low, high)
    with threadpool_limits(1):
        # The errors of single runs scatter themselves: log-linear functions take their place.
        error_law = np.linalg.lstsq(_with_constant(scaled), np.log(errors), rcond=None)[0]
        smooth = np.exp(_with_constant(scaled) @ error_law)
        fitted = [
            _gaussian_process(scaled, values[:, i], smooth[:, i]) for i in range(len(features))
        ]
    models, factors = zip(*fitted, strict=True)
    residuals = np.column_stack([_left_out_residuals(model) for model in models])
    widen = np.maximum(1.0, np.sqrt((residuals**2).mean(axis=0)))
    return Emulator(
        names,
        tuple(features),
        models,
        error_law,
        np.array(factors),
        widen,
        low,
        high,
        _correlation(residuals),
    )


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
    widened by the factor by which the scenes scatter more than they say. The prior is flat over
    the range of the sweep: nothing is said beyond it.

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
    ours = features_of(target, units)
    absent = [name for name in emulator.features if name not in ours]
    if absent:
        raise InputError(
            f"{target.name} lacks {', '.join(absent)} or its error; observe it in full, or train "
            "the emulator without."
        )
    value = np.array([ours[f].value for f in emulator.features])
    error = np.array([ours[f].own_error for f in emulator.features])
    single = target.n == 1
    freedom = BLOCK_FREEDOM if single else target.n - 1
    shared = np.array([ours[f].unit_error for f in emulator.features])
    low, high = emulator.low, emulator.high
    start = low + qmc.Sobol(len(low), seed=seed).random(n_points) * (high - low)
    with threadpool_limits(1):  # the matrices are too small for more to pay
        samples, density = _sample(
            lambda points: emulator.log_likelihood(points, value, error, shared, single, freedom),
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
        (value, error, shared, single, freedom),
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


def _gaussian_process(x: FloatArray, y: FloatArray, error: FloatArray) -> tuple[Any, float]:
    """Fit a process to a feature, and the factor by which runs scatter more than their errors say.

    The factor is that of the largest marginal likelihood.
    """
    import warnings

    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

    spread = float(y.std()) or 1.0
    best: tuple[Any, float] | None = None
    for factor in FACTORS:
        smooth = ConstantKernel(1.0, (1e-2, 1e3)) * RBF(np.full(x.shape[1], 1.0), (0.15, 20.0))
        trend = ConstantKernel(1.0, (1e-3, 1e3)) * DotProduct(1.0, (1e-2, 1e2))
        model = GaussianProcessRegressor(
            smooth + trend, alpha=(factor * error / spread) ** 2 + 1e-6, normalize_y=True
        )
        with warnings.catch_warnings():
            # A length scale at its bound: the feature does not depend on that parameter.
            warnings.simplefilter("ignore", ConvergenceWarning)
            model.fit(x, y)
        likelihood = model.log_marginal_likelihood_value_
        if best is None or likelihood > best[0].log_marginal_likelihood_value_:
            best = model, factor
    assert best is not None
    return best


def _with_constant(x: FloatArray) -> FloatArray:
    return np.column_stack([np.ones(len(x)), x])


def _scaled(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Parameters on [0, 1]; by their logarithm where the sweep spans more than a factor three."""
    wide = (low > 0) & (high > 3 * low)
    safe = [np.where(wide, v, 1.0) for v in (points, low, high)]
    straight = (points - low) / (high - low)
    curved = np.log(safe[0] / safe[1]) / np.where(wide, np.log(safe[2] / safe[1]), 1.0)
    out: FloatArray = np.where(wide, curved, straight)
    return out


def _left_out_residuals(model: Any) -> FloatArray:
    """Residuals of each scene predicted without itself, over their predicted errors.

    With K the covariance of the data, the residual of point i predicted from the others is
    ``[K^-1 y]_i / [K^-1]_ii`` and its variance ``1 / [K^-1]_ii`` (Rasmussen & Williams, 5.4.2).
    """
    covariance = model.kernel_(model.X_train_) + np.diag(model.alpha)
    inverse = np.linalg.inv(covariance)
    residuals: FloatArray = (inverse @ model.y_train_) / np.sqrt(np.diag(inverse))
    return residuals


def _correlation(residuals: FloatArray) -> FloatArray:
    """Correlation of the features of a run about what its parameters predict.

    Shrunk towards independence by as much as the number of scenes calls for (Ledoit & Wolf 2004).
    """
    from sklearn.covariance import ledoit_wolf

    covariance, _ = ledoit_wolf(residuals)
    deviation = np.sqrt(np.diag(covariance))
    correlation: FloatArray = covariance / np.outer(deviation, deviation)
    return correlation


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
    _, error, shared, single, _ = posterior.target
    if single:
        error = posterior.emulator.single_run_error(middle[None], error)[0]
    deviation = np.sqrt(error**2 + (shared**2).sum(axis=1))
    for i, name in enumerate(posterior.names):
        ends = np.array([middle, middle])
        ends[:, i] = posterior.bounds[name]
        mean, _ = posterior.emulator.predict(ends)
        for j, feature in enumerate(posterior.features):
            out[feature][name] = float((mean[1, j] - mean[0, j]) / deviation[j])
    return out
