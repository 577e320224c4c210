"""What a layer shows at any phi, v0 and eta, learned from the scenes of a sweep."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cellquant.compare.calibration import Forecast, inflation_for
from cellquant.compare.groups import SCENE_KEYS, Group
from cellquant.compare.ranking import REDUCED_UNITS, Units, features_of
from cellquant.errors import InputError

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
LeftOut = Callable[[int, Sequence[int]], tuple[FloatArray, FloatArray]]
# Of errors inside one recording: 16 to 25 spatial blocks, the smaller number less one.
BLOCK_FREEDOM = 15
FACTORS = (1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6, 6.0)
CALIBRATION_SCENES = 100  # at most this many scenes are left out in turn
CALIBRATION_POINTS = 2**22  # points times scenes, which bounds the memory


@dataclass(frozen=True)
class Observed:
    """Features of one layer and how well they are known.

    Attributes
    ----------
    value, error
        (features,) values, with the errors that belong to each alone.
    shared
        (features, sources) errors that several features have in common.
    single
        The errors were estimated inside one recording.
    freedom
        Degrees of freedom of the errors.
    """

    value: FloatArray
    error: FloatArray
    shared: FloatArray
    single: bool
    freedom: int


def observed_features(group: Group, features: Sequence[str], units: Units | None) -> Observed:
    """The features of a layer as the likelihood takes them.

    Raises
    ------
    InputError
        If one of the features is not known of the layer, or has no error.
    """
    found = features_of(group, units)
    absent = [name for name in features if name not in found]
    if absent:
        raise InputError(
            f"{group.name} lacks {', '.join(absent)} or its error; observe it in full, or train "
            "the emulator without."
        )
    single = group.n == 1
    return Observed(
        np.array([found[f].value for f in features]),
        np.array([found[f].own_error for f in features]),
        np.array([found[f].unit_error for f in features]),
        single,
        BLOCK_FREEDOM if single else group.n - 1,
    )


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
    inflation
        Factor on all errors, for layers seen once and for others, with which the regions of left
        out scenes hold them as often as they should (`cellquant.compare.calibration`).
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
    inflation: tuple[float, float] = (1.0, 1.0)

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

    def log_likelihood(self, points: FloatArray, observed: Observed) -> FloatArray:
        """Logarithm of the probability of the observed features at each point (n, parameters).

        A multivariate t law: the size of the errors is itself known from few replicates.
        """
        mean, deviation = self.predict(points)
        spread = self._spread(points, deviation, observed)
        spread *= self.inflation[0 if observed.single else 1]
        shared = observed.shared @ observed.shared.T
        total = self.correlation * spread[:, :, None] * spread[:, None, :] + shared
        size = len(self.features)
        factor = np.linalg.cholesky(total)
        z = np.linalg.solve(factor, (observed.value - mean)[..., None])[..., 0]
        volume = np.log(factor[:, np.arange(size), np.arange(size)]).sum(axis=1)
        tail = np.log1p((z**2).sum(axis=1) / observed.freedom)
        out: FloatArray = -0.5 * (observed.freedom + size) * tail - volume
        return out

    def _spread(self, points: FloatArray, deviation: FloatArray, observed: Observed) -> FloatArray:
        """Errors (n, features) of emulator and layer together."""
        error = observed.error
        own = self.single_run_error(points, error) if observed.single else error
        out: FloatArray = np.hypot(deviation, own)
        return out

    def _calibrated(self, points: FloatArray, scenes: Sequence[Group]) -> "Emulator":
        """Widen all errors until scenes left out of the sweep are found in their regions.

        For layers seen once each scene is taken by its first run alone, for others by all it has.
        """
        from scipy.stats import qmc

        count, size = points.shape
        number = 2 ** int(np.log2(min(2 ** (10 + 2 * size), CALIBRATION_POINTS / count)))
        grid = self.low + qmc.Sobol(size, seed=0).random(number) * (self.high - self.low)
        chosen = np.unique(np.linspace(0, count - 1, min(count, CALIBRATION_SCENES)).astype(int))
        forecasts: dict[bool, list[Forecast]] = {True: [], False: []}
        left_out = [
            _left_out_predictions(model, _scaled(np.vstack([grid, points]), self.low, self.high))
            for model in self.models
        ]
        for scene in chosen:
            rows = [*range(number), number + scene]
            pairs = [one(scene, rows) for one in left_out]
            mean = np.column_stack([pair[0] for pair in pairs])
            deviation = np.column_stack([pair[1] for pair in pairs]) * self.widen
            place = np.vstack([grid, points[scene : scene + 1]])
            whole = scenes[scene]
            first = replace(whole, trials=dict([next(iter(whole.trials.items()))]))
            for single, group in ((True, first), (False, whole)):
                observed = observed_features(group, self.features, REDUCED_UNITS)
                spread = self._spread(place, deviation, observed)
                z = np.linalg.solve(
                    np.linalg.cholesky(self.correlation), ((observed.value - mean) / spread).T
                )
                forecasts[single].append(
                    Forecast((z**2).sum(axis=0), np.log(spread).sum(axis=1), observed.freedom)
                )
        widths = (inflation_for(forecasts[True], size=len(self.features)),
                  inflation_for(forecasts[False], size=len(self.features)))  # fmt: skip
        return replace(self, inflation=widths)


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
    emulator = Emulator(
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
    with threadpool_limits(1):
        return emulator._calibrated(points, [group for group, _ in known])


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


def _left_out_predictions(model: Any, points: FloatArray) -> "LeftOut":
    """Predictions at points (n, parameters) of a process that has not seen one of its data.

    With ``w = K(points, X) K^-1``, leaving out datum i lowers the mean by
    ``w_i [K^-1 y]_i / [K^-1]_ii`` and raises the variance by
    ``w_i^2 / [K^-1]_ii``; the hyperparameters are kept.
    """
    kernel, data = model.kernel_, model.X_train_
    inverse = np.linalg.inv(kernel(data) + np.diag(model.alpha))
    between = kernel(points, data)
    weight = between @ inverse
    mean = weight @ model.y_train_
    variance = kernel.diag(points) - (weight * between).sum(axis=1)
    scale, offset = model._y_train_std, model._y_train_mean
    pull = inverse @ model.y_train_

    def without(datum: int, rows: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        own, part = inverse[datum, datum], weight[rows, datum]
        middle = (mean[rows] - part * pull[datum] / own) * scale + offset
        spread = np.sqrt(np.maximum(variance[rows] + part**2 / own, 0.0)) * scale
        return middle, spread

    return without


def _correlation(residuals: FloatArray) -> FloatArray:
    """Correlation of the features of a run about what its parameters predict.

    Shrunk towards independence by as much as the number of scenes calls for (Ledoit & Wolf 2004).
    """
    from sklearn.covariance import ledoit_wolf

    covariance, _ = ledoit_wolf(residuals)
    deviation = np.sqrt(np.diag(covariance))
    correlation: FloatArray = covariance / np.outer(deviation, deviation)
    return correlation
