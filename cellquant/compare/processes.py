"""Gaussian processes that learn a feature from noisy scenes, and how far their noise is known."""

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    ConstantKernel,
    DotProduct,
    Hyperparameter,
    Kernel,
)

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
# Length scales of a feature over the range of a sweep, which is one: the median of the log-normal
# prior and its spread. Without it few scenes are explained by ripples instead of by their noise.
LENGTH_SCALE = (1.0, 0.7)
SMALLEST = 1e-6  # of the variance of a feature, for the numerics


class Scatter(Kernel):  # type: ignore[misc]
    """Independent noise of scenes whose errors are ``exp(law)``, all too small by one factor.

    Parameters
    ----------
    factor
        The scatter in units of these errors.
    factor_bounds
        Its range.
    law
        Coefficients of the logarithm of the error: constant, then one per parameter.
    """

    def __init__(
        self,
        factor: float = 1.0,
        factor_bounds: tuple[float, float] = (1.0, 10.0),
        law: tuple[float, ...] = (0.0,),
    ) -> None:
        self.factor = factor
        self.factor_bounds = factor_bounds
        self.law = law

    @property
    def hyperparameter_factor(self) -> Hyperparameter:
        """What is fitted."""
        return Hyperparameter("factor", "numeric", self.factor_bounds)

    def diag(self, X: FloatArray) -> FloatArray:
        """Variance of the noise at the points (n, parameters)."""
        law = np.array(self.law)
        out: FloatArray = self.factor**2 * np.exp(2 * (law[0] + X @ law[1:]))
        return out

    def __call__(
        self, X: FloatArray, Y: FloatArray | None = None, eval_gradient: bool = False
    ) -> Any:
        """Covariance, and its derivative by the logarithm of the factor."""
        if Y is not None:
            return np.zeros((len(X), len(Y)))
        covariance = np.diag(self.diag(X))
        return (covariance, 2 * covariance[..., None]) if eval_gradient else covariance

    def is_stationary(self) -> bool:
        """The error depends on the parameters."""
        return False


class Process(NamedTuple):
    """What the scenes say of one feature, anywhere in their range.

    Attributes
    ----------
    model
        The fitted process, of the feature less `centre`, in units of `spread`.
    centre, spread
        Mean and standard deviation of the feature over the scenes.
    scatter
        Factor by which the feature scatters between runs more than the errors of the scenes say.
    theta
        Logarithms of all hyperparameters.
    """

    model: GaussianProcessRegressor
    centre: float
    spread: float
    scatter: float
    theta: FloatArray

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Expected feature at x (n, parameters) and its standard deviation, scatter not in it."""
        mean, deviation = self.model.predict(x, return_std=True)
        return self.centre + self.spread * mean, self.spread * deviation


def learn(
    x: FloatArray, y: FloatArray, law: FloatArray, *, start: Process | None = None
) -> Process:
    """Fit a process to the scenes: a linear trend, a smooth remainder, and noise.

    Parameters
    ----------
    x
        (n, parameters) scenes, each parameter on [0, 1].
    y
        (n,) the feature.
    law
        (1 + parameters,) coefficients of the logarithm of its error.
    start
        A process of nearly the same scenes, from whose hyperparameters the search sets out;
        from little and from much noise when None.

    Notes
    -----
    Hyperparameters are the most probable ones: flat prior in their logarithms, but for the length
    scales (`LENGTH_SCALE`).

    References
    ----------
    Rasmussen & Williams, Gaussian Processes for Machine Learning (2006), chapters 2 and 5.
    """
    centre, spread = float(y.mean()), float(y.std()) or 1.0
    smooth = ConstantKernel(1.0, (1e-2, 1e2)) * RBF(np.ones(x.shape[1]), (0.1, 20.0))
    trend = ConstantKernel(1.0, (1e-3, 1e3)) * DotProduct(1.0, (1e-2, 1e2))
    scaled = (float(law[0]) - math.log(spread), *(float(c) for c in law[1:]))
    kernels = [smooth + trend + Scatter(factor, law=scaled) for factor in (1.2, 4.0)]
    if start is not None:
        kernels = [kernels[0].clone_with_theta(start.theta)]
    fitted = [
        GaussianProcessRegressor(kernel, alpha=SMALLEST, optimizer=_most_probable)
        for kernel in kernels
    ]
    values = (y - centre) / spread
    with warnings.catch_warnings():
        # A length scale at its bound: the feature does not depend on that parameter.
        warnings.simplefilter("ignore", ConvergenceWarning)
        for model in fitted:
            model.fit(x, values)
    best = max(fitted, key=lambda model: model.log_marginal_likelihood_value_)
    noise = best.kernel_.k2
    model = GaussianProcessRegressor(
        best.kernel_.k1, alpha=noise.diag(x) + SMALLEST, optimizer=None
    ).fit(x, values)
    return Process(model, centre, spread, float(noise.factor), best.kernel_.theta)


def _most_probable(
    objective: Any, initial: FloatArray, bounds: FloatArray
) -> tuple[FloatArray, float]:
    """Minimise what the data and the prior of the length scales say against hyperparameters.

    Those are logarithms: amplitude and length scales of the remainder, then the others.
    """
    from scipy.optimize import minimize

    median, width = LENGTH_SCALE
    scales = slice(1, len(initial) - 3)

    def against(theta: FloatArray) -> tuple[float, FloatArray]:
        value, slope = objective(theta, eval_gradient=True)
        away = (theta[scales] - math.log(median)) / width
        slope = slope.copy()
        slope[scales] += away / width
        return float(value + 0.5 * (away**2).sum()), slope

    found = minimize(against, initial, method="L-BFGS-B", jac=True, bounds=bounds)
    return found.x, float(found.fun)
