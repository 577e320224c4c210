"""Fits of measured curves, each with its uncertainty, range and goodness."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from cellquant.observables.blocks import jackknife_error, leave_one_out, ratio_with_error
from cellquant.observables.dynamics import LagAverage
from cellquant.observables.trajectories import FloatArray


@dataclass(frozen=True)
class StretchedExponential:
    """Fit of ``F(t) = exp(-(t/tau)^beta)``.

    Attributes
    ----------
    tau, tau_std_error, beta, beta_std_error
        Parameters and jackknife errors; None where not measurable.
    fit_range
        Shortest and longest lag used.
    chi2_per_dof
        Sum of squared residuals over squared standard errors, per degree of freedom. Lags are
        correlated, so values well below 1 are common; well above 1 the form does not fit.
    reason
        Why there is no fit.
    """

    tau: float | None = None
    tau_std_error: float | None = None
    beta: float | None = None
    beta_std_error: float | None = None
    fit_range: tuple[float, float] | None = None
    chi2_per_dof: float | None = None
    reason: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Its fields; without the reason when there is none."""
        return {k: v for k, v in asdict(self).items() if k != "reason" or v is not None}


def fit_stretched_exponential(average: LagAverage) -> StretchedExponential:
    """Fit a stretched exponential to F_s, a second opinion on tau_alpha.

    Weighted least squares of ``F = exp(-(t/tau)^beta)`` over the lags with ``0.05 < F < 0.98``,
    weights from the standard errors; errors by refitting without each block.

    Parameters
    ----------
    average
        F_s by block.

    Returns
    -------
    StretchedExponential
        Without values when fewer than four lags lie in the range.
    """
    value, error = ratio_with_error(average.sums, average.counts)
    used = np.isfinite(value) & (value > 0.05) & (value < 0.98)
    if used.sum() < 4:
        return StretchedExponential(reason="fewer than four lags have 0.05 < F_s < 0.98")
    time = average.lag_time[used]
    span = (float(time[0]), float(time[-1]))
    sigma = error[used]
    floor = 1e-12 + 1e-3 * float(np.nanmax(np.where(np.isfinite(sigma), sigma, 0.0), initial=0.0))
    known = np.isfinite(sigma).all()
    sigma = np.maximum(sigma, floor) if known else np.ones_like(time)
    slope, intercept = np.polyfit(np.log(time), np.log(-np.log(value[used])), 1)
    if not 0.05 < slope < 10:
        return StretchedExponential(reason="F_s does not decay over the range of the fit")
    start = np.array([-intercept / slope, np.log(slope)])

    def fit(curve: FloatArray, first: FloatArray) -> Any:
        def residual(p: FloatArray) -> Any:
            exponent = np.clip(np.exp(p[1]) * (np.log(time) - p[0]), -50, 50)
            return (np.exp(-np.exp(exponent)) - curve) / sigma

        return least_squares(residual, first, method="lm")

    best = fit(value[used], start)
    chi2 = float(2 * best.cost / (used.sum() - 2)) if known else None
    tau, beta = float(np.exp(best.x[0])), float(np.exp(best.x[1]))
    with np.errstate(divide="ignore", invalid="ignore"):
        curves = (leave_one_out(average.sums) / leave_one_out(average.counts))[:, used]
    carries = average.counts[:, used].sum(axis=1) > 0
    curves = curves[carries]
    if not known or len(curves) < 2 or not np.isfinite(curves).all():
        reason = "the errors need at least two replicate blocks at every lag"
        return StretchedExponential(tau, None, beta, None, span, chi2, reason)
    replicates = np.exp(np.array([fit(curve, best.x).x for curve in curves]))
    errors = jackknife_error(replicates)
    return StretchedExponential(tau, float(errors[0]), beta, float(errors[1]), span, chi2)
