"""What a layer shows at any phi, v0 and eta, learned from the scenes of a sweep."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cellquant.compare.calibration import Forecast, inflation_for
from cellquant.compare.groups import SCENE_KEYS, Group
from cellquant.compare.ranking import REDUCED_UNITS, Units, features_of
from cellquant.errors import InputError

if TYPE_CHECKING:
    from cellquant.compare.processes import Process

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
# Of errors inside one recording: 16 to 25 spatial blocks, the smaller number less one.
BLOCK_FREEDOM = 15
FOLDS = 8


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
    processes
        One process per feature.
    error_law
        (1 + parameters, features) logarithm of the error of a run as a linear function.
    widen
        Factor >= 1 on the errors of emulator and single runs, from predicting scenes with
        processes that never saw them.
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
    processes: "tuple[Process, ...]"
    error_law: FloatArray
    widen: FloatArray
    low: FloatArray
    high: FloatArray
    correlation: FloatArray
    inflation: tuple[float, float] = (1.0, 1.0)

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation, (n, features), of the expected feature."""
        scaled = _scaled(points, self.low, self.high)
        pairs = [process.predict(scaled) for process in self.processes]
        deviation = np.column_stack([pair[1] for pair in pairs]) * self.widen
        return np.column_stack([pair[0] for pair in pairs]), deviation

    def single_run_error(self, points: FloatArray, error: FloatArray) -> FloatArray:
        """Errors (n, features) of one recording: its scatter between recordings included.

        The errors that it gives are noisy. Their common size is kept; which feature is known
        better than which follows from the scenes.
        """
        law = _with_constant(_scaled(points, self.low, self.high)) @ self.error_law
        size = (np.log(error) - law).mean(axis=1, keepdims=True)
        scatter = np.array([process.scatter for process in self.processes]) * self.widen
        out: FloatArray = scatter * np.exp(law + size)
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

    def _calibrated(
        self, points: FloatArray, scenes: Sequence[Group], folds: Sequence["Fold"]
    ) -> "Emulator":
        """Widen all errors until scenes that the processes never saw are found in their regions.

        For layers seen once each scene is taken by its first run alone, for others by all it has.
        """
        from scipy.stats import qmc

        size = len(self.names)
        grid = qmc.scale(qmc.Sobol(size, seed=0).random(2 ** (8 + 2 * size)), self.low, self.high)
        several = any(scene.n > 1 for scene in scenes)
        forecasts: dict[bool, list[Forecast]] = {True: [], False: []}
        likeness = np.linalg.cholesky(self.correlation)
        for fold in folds:
            part = replace(self, processes=fold.processes)
            mean, deviation = part.predict(np.vstack([grid, points[fold.scenes]]))
            for place, scene in enumerate(fold.scenes):
                rows = [*range(len(grid)), len(grid) + place]
                where = np.vstack([grid, points[scene : scene + 1]])
                whole = scenes[scene]
                first = replace(whole, trials=dict([next(iter(whole.trials.items()))]))
                for group in (first, whole) if several else (first,):
                    observed = observed_features(group, self.features, REDUCED_UNITS)
                    spread = part._spread(where, deviation[rows], observed)
                    z = np.linalg.solve(likeness, ((observed.value - mean[rows]) / spread).T)
                    forecasts[group is first].append(
                        Forecast((z**2).sum(axis=0), np.log(spread).sum(axis=1), observed.freedom)
                    )
        once = inflation_for(forecasts[True], size=len(self.features))
        often = inflation_for(forecasts[False], size=len(self.features)) if several else once
        return replace(self, inflation=(once, often))


class Fold(NamedTuple):
    """Scenes set aside, and processes that learned from the others alone."""

    scenes: list[int]
    processes: "tuple[Process, ...]"


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

    from cellquant.compare.processes import learn

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
    # The errors of single runs scatter themselves: log-linear functions take their place.
    law = np.linalg.lstsq(_with_constant(scaled), np.log(errors), rcond=None)[0]

    with threadpool_limits(1):  # the matrices are too small for more to pay
        whole = tuple(learn(scaled, values[:, i], law[:, i]) for i in range(len(features)))
        folds = []
        for aside in folds_of(len(scaled)):
            x, y = np.delete(scaled, aside, axis=0), np.delete(values, aside, axis=0)
            folds.append(
                Fold(
                    aside, tuple(learn(x, y[:, i], law[:, i], start=p) for i, p in enumerate(whole))
                )
            )
        residuals = np.vstack([_residuals(fold, scaled, values, law) for fold in folds])
        emulator = Emulator(
            names,
            tuple(features),
            whole,
            law,
            np.maximum(1.0, np.sqrt((residuals**2).mean(axis=0))),
            low,
            high,
            _correlation(residuals),
        )
        return emulator._calibrated(points, [group for group, _ in known], folds)


def folds_of(count: int) -> list[list[int]]:
    """Scenes in up to eight parts of equal size, drawn at random, the same in every run."""
    order = np.random.default_rng(0).permutation(count)
    return [sorted(order[start::FOLDS].tolist()) for start in range(min(count, FOLDS))]


def _residuals(fold: Fold, x: FloatArray, values: FloatArray, law: FloatArray) -> FloatArray:
    """Residuals (scenes, features) of scenes set aside, over their predicted errors."""
    out = np.empty((len(fold.scenes), len(fold.processes)))
    for i, process in enumerate(fold.processes):
        mean, deviation = process.predict(x[fold.scenes])
        noise = process.scatter * np.exp(_with_constant(x[fold.scenes]) @ law[:, i])
        out[:, i] = (values[fold.scenes, i] - mean) / np.hypot(deviation, noise)
    return out


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


def _correlation(residuals: FloatArray) -> FloatArray:
    """Correlation of the features of a run about what its parameters predict.

    Shrunk towards independence by as much as the number of scenes calls for (Ledoit & Wolf 2004).
    """
    from sklearn.covariance import ledoit_wolf

    covariance, _ = ledoit_wolf(residuals)
    deviation = np.sqrt(np.diag(covariance))
    correlation: FloatArray = covariance / np.outer(deviation, deviation)
    return correlation
