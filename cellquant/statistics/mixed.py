"""Linear mixed model: a trend with an intercept and a slope of its own for every trial."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import optimize, stats

FloatArray = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class MixedModel:
    """Fit of ``y = (b0 + u0_g) + (b1 + u1_g) x + e`` by restricted maximum likelihood.

    Attributes
    ----------
    slope, std_error
        Fixed slope b1 and its standard error.
    df, df_method
        Degrees of freedom of the t statistic, and how they were found.
    t, p_value
        Statistic and two-sided probability of a zero slope.
    interval_95
        Confidence interval of the slope, from t.
    intercept, intercept_std_error
        Fixed intercept b0, at x = 0.
    sd_intercept, sd_slope, correlation
        Standard deviations of u0 (at x = 0) and u1 over trials, and their correlation.
    residual_sd
        Standard deviation of e.
    reml_criterion
        Minus twice the restricted log-likelihood at the optimum.
    singular
        Whether the fitted covariance of (u0, u1) has lost a dimension.
    n, n_groups
        Points and trials.
    reason
        Why values are missing; None when none are.
    """

    slope: float | None = None
    std_error: float | None = None
    df: float | None = None
    df_method: str = "Satterthwaite"
    t: float | None = None
    p_value: float | None = None
    interval_95: tuple[float, float] | None = None
    intercept: float | None = None
    intercept_std_error: float | None = None
    sd_intercept: float | None = None
    sd_slope: float | None = None
    correlation: float | None = None
    residual_sd: float | None = None
    reml_criterion: float | None = None
    singular: bool | None = None
    n: int = 0
    n_groups: int = 0
    reason: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready fields; without the reason when there is none."""
        return {k: v for k, v in asdict(self).items() if k != "reason" or v is not None}


# Random effects this many times the residual leave nothing of X'V^-1 X in double precision.
_LARGEST = 1e5


class _Reml:
    """Profiled restricted likelihood in the three entries of the relative Cholesky factor.

    With design X = Z = [1, z] everything depends on the trials through their own least-squares
    fits b_g, their X'X and the sum of squares within trials, so that an evaluation costs a few
    2 x 2 products per trial and no subtraction of large numbers.
    """

    def __init__(self, z: FloatArray, y: FloatArray, group: Any, n_groups: int) -> None:
        self.n = y.size
        self.cross = np.zeros((3, n_groups))  # n, sum z, sum z^2 of each trial
        self.own = np.zeros((2, n_groups))
        self.within = 0.0
        for g in range(n_groups):
            design = np.column_stack([np.ones(np.sum(group == g)), z[group == g]])
            target = y[group == g]
            self.cross[:, g] = design[:, 0].sum(), design[:, 1].sum(), np.sum(design[:, 1] ** 2)
            self.own[:, g] = np.linalg.lstsq(design, target, rcond=None)[0]
            self.within += float(np.sum((target - design @ self.own[:, g]) ** 2))

    def solve(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray, float]:
        """Sum of log|V_g|, X'V^-1 X, the fixed effects and the weighted residual sum."""
        a, b, c = (float(v) for v in theta)
        s0, s1, s2 = self.cross
        # With L = [[a, 0], [b, c]]: S L = [[p, q], [r, t]] and I + L'S L = [[k, n], [n, m]].
        p, q, r, t = s0 * a + s1 * b, s1 * c, s1 * a + s2 * b, s2 * c
        k, n, m = 1 + a * p + b * r, c * r, 1 + c * t
        det = k * m - n * n
        w0 = s0 - (p * p * m - 2 * p * q * n + q * q * k) / det
        w1 = s1 - (p * r * m - (p * t + q * r) * n + q * t * k) / det
        w2 = s2 - (r * r * m - 2 * r * t * n + t * t * k) / det
        b0, b1 = self.own
        i0, i1, i2 = float(w0.sum()), float(w1.sum()), float(w2.sum())
        h0, h1 = float((w0 * b0 + w1 * b1).sum()), float((w1 * b0 + w2 * b1).sum())
        volume = i0 * i2 - i1 * i1
        beta = np.array([i2 * h0 - i1 * h1, i0 * h1 - i1 * h0]) / volume
        d0, d1 = b0 - beta[0], b1 - beta[1]
        residual = self.within + float((w0 * d0 * d0 + 2 * w1 * d0 * d1 + w2 * d1 * d1).sum())
        information = np.array([[i0, i1], [i1, i2]])
        return float(np.log(det).sum()), information, beta, residual

    def criterion(self, theta: FloatArray) -> float:
        """Minus twice the restricted log-likelihood, profiled over beta and sigma."""
        if np.abs(theta).max() > _LARGEST:
            return 1e12
        log_det, information, _, residual = self.solve(theta)
        free = self.n - 2
        return float(
            log_det
            + np.log(np.linalg.det(information))
            + free * (1 + np.log(2 * np.pi * max(residual, 1e-300) / free))
        )

    def deviance(self, parameters: FloatArray) -> float:
        """The same, not profiled over sigma: parameters are theta and sigma."""
        log_det, information, _, residual = self.solve(parameters[:3])
        variance, free = parameters[3] ** 2, self.n - 2
        return float(
            log_det
            + np.log(np.linalg.det(information))
            + free * np.log(2 * np.pi * variance)
            + residual / variance
        )

    def slope_variance(self, parameters: FloatArray) -> float:
        """Variance of the slope at theta and sigma."""
        information = self.solve(parameters[:3])[1]
        return float(parameters[3] ** 2 * np.linalg.inv(information)[1, 1])


_SCALES = (0.0, 0.1, 0.4, 1.5, 6.0)
_TILTS = (-3.0, -0.5, 0.0, 0.5, 3.0)


def _descend(model: _Reml, start: FloatArray, free: list[int]) -> FloatArray:
    """Nelder-Mead descent in some of the entries; a gradient would not pay at this size."""

    def restricted(values: FloatArray) -> float:
        point = start.copy()
        point[free] = values
        return model.criterion(point)

    spread = np.maximum(0.2 * np.abs(start[free]), 0.05)
    options = {
        "xatol": 1e-9, "fatol": 1e-11, "maxiter": 3000, "maxfev": 3000,
        "initial_simplex": np.vstack([start[free], start[free] + np.diag(spread)]),
    }  # fmt: skip
    found = optimize.minimize(restricted, start[free], method="Nelder-Mead", options=options)
    point = start.copy()
    point[free] = found.x
    return point


def _best_theta(model: _Reml) -> FloatArray:
    """Global minimum of the criterion: a grid, descents from its best places, and the boundary."""
    grid = [np.array([a, b, c]) for a in _SCALES for b in _TILTS for c in _SCALES]
    grid.sort(key=model.criterion)
    found = [_descend(model, start, [0, 1, 2]) for start in grid[:5]]
    best = _descend(model, min(found, key=model.criterion), [0, 1, 2])
    # The criterion depends on the signs of the diagonal only through its square.
    theta = np.array([abs(best[0]), best[1] * (np.sign(best[0]) or 1.0), abs(best[2])])
    lowest = model.criterion(theta)
    near = {1, *(k for k in (0, 2) if theta[k] < 0.1)}
    for fixed in ((0, 1, 2), (0, 1), (1, 2), (0,), (2,)):
        if not near.issuperset(fixed):
            continue
        corner = theta.copy()
        corner[list(fixed)] = 0.0
        free = [k for k in range(3) if k not in fixed]
        if free:
            corner = _descend(model, corner, free)
        if model.criterion(corner) <= lowest + 1e-9:
            return corner
    return theta


def satterthwaite(model: Any, parameters: FloatArray) -> float:
    """Degrees of freedom of the slope from the curvature of the deviance in (theta, sigma).

    The model has ``n``, ``slope_variance`` and ``deviance`` of the four parameters.
    """
    step = 1e-4 * np.maximum(np.abs(parameters), 0.1)
    shifts = np.diag(step)
    gradient = np.array(
        [
            (model.slope_variance(parameters + s) - model.slope_variance(parameters - s)) / (2 * h)
            for s, h in zip(shifts, step, strict=True)
        ]
    )
    hessian = np.empty((4, 4))
    for i in range(4):
        for j in range(i + 1):
            corners = [
                model.deviance(parameters + a * shifts[i] + b * shifts[j]) * a * b
                for a in (1, -1)
                for b in (1, -1)
            ]
            hessian[i, j] = hessian[j, i] = sum(corners) / (4 * step[i] * step[j])
    values, vectors = np.linalg.eigh(hessian)
    kept = values > 1e-6 * values.max()
    covariance = 2 * (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    spread = float(gradient @ covariance @ gradient)
    if not spread > 0:
        return float(model.n - 2)
    return float(np.clip(2 * model.slope_variance(parameters) ** 2 / spread, 1.0, model.n - 2))


def fit_mixed_model(x: Any, y: Any, group: Any) -> MixedModel:
    """Linear mixed model with a random intercept and slope per trial.

    ``y = (b0 + u0_g) + (b1 + u1_g) x + e`` with ``(u0, u1)`` normal with any covariance and
    independent normal e, fitted by restricted maximum likelihood. The predictor is standardised
    first, the likelihood profiled over fixed effects and scale, and minimised without
    derivatives from the five best places of a grid; solutions on the boundary are tried
    explicitly. P and interval of the slope use t with Satterthwaite's degrees of freedom.

    Parameters
    ----------
    x
        (n,) predictor, e.g. density.
    y
        (n,) response, e.g. tau_alpha.
    group
        (n,) trial of each point.

    Returns
    -------
    MixedModel
        Points with NaN are left out. Undefined (None with a reason) with fewer than two trials,
        fewer than five points or a constant predictor. Without any scatter about the fit,
        standard error and P are not measurable.

    References
    ----------
    Bates, Maechler, Bolker & Walker, J. Stat. Softw. 67, 1 (2015), doi:10.18637/jss.v067.i01.
    Satterthwaite, Biometrics 2, 110 (1946), doi:10.2307/3002019.
    """
    x_all, y_all = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    known = np.isfinite(x_all) & np.isfinite(y_all)
    x_known, y_known = x_all[known], y_all[known]
    names, index = np.unique(np.asarray(group)[known], return_inverse=True)
    size: dict[str, Any] = {"n": int(known.sum()), "n_groups": int(names.size)}
    if names.size < 2:
        return MixedModel(**size, reason="a random slope per trial needs at least two trials")
    if size["n"] < 5:
        return MixedModel(**size, reason="the model needs at least five points")
    shift, scale = float(x_known.mean()), float(x_known.std())
    if not scale > 1e-12 * max(abs(shift), 1e-300):
        return MixedModel(**size, reason="the predictor is the same at every point")
    level, spread = float(y_known.mean()), float(y_known.std())
    if not spread > 1e-12 * max(abs(level), 1e-300):
        return MixedModel(
            slope=0.0, intercept=level, **size,
            reason="the response is the same at every point, so no error can be estimated",
        )  # fmt: skip
    model = _Reml((x_known - shift) / scale, (y_known - level) / spread, index, names.size)
    _, _, plain, scatter = model.solve(np.array([1.0, 0.0, 1.0]))
    if scatter < 1e-20 * size["n"]:
        slope = float(plain[1] * spread / scale)
        return MixedModel(
            slope=slope, intercept=level + spread * float(plain[0]) - slope * shift, **size,
            reason="the points lie on one line, so no error can be estimated",
        )  # fmt: skip
    theta = _best_theta(model)
    _, information, beta, residual = model.solve(theta)
    sigma = float(np.sqrt(residual / (model.n - 2)))
    return in_units(
        theta, sigma, beta, sigma**2 * np.linalg.inv(information),
        df=satterthwaite(model, np.r_[theta, sigma]), criterion=model.criterion(theta),
        x=(shift, scale), y=(level, spread), size=size,
    )  # fmt: skip


def in_units(
    theta: FloatArray,
    sigma: float,
    beta: FloatArray,
    covariance: Any,
    *,
    df: float,
    criterion: float,
    x: tuple[float, float],
    y: tuple[float, float],
    size: dict[str, Any],
) -> MixedModel:
    """Fit of the standardised data in the units of x and y, given their means and spreads."""
    (shift, scale), (level, spread) = x, y
    # [1, x] = [1, z] T.
    back = np.array([[1.0, -shift / scale], [0.0, 1.0 / scale]])
    effect = spread * back @ beta + np.array([level, 0.0])
    covariance = spread**2 * back @ covariance @ back.T
    relative = np.array([[theta[0], 0.0], [theta[1], theta[2]]])
    factor = sigma * spread * back @ relative
    random = factor @ factor.T
    sd = np.sqrt(np.diag(random))
    error = float(np.sqrt(covariance[1, 1]))
    t = float(effect[1] / error)
    reach = float(stats.t.ppf(0.975, df) * error)
    return MixedModel(
        slope=float(effect[1]),
        std_error=error,
        df=df,
        t=t,
        p_value=float(2 * stats.t.sf(abs(t), df)),
        interval_95=(float(effect[1] - reach), float(effect[1] + reach)),
        intercept=float(effect[0]),
        intercept_std_error=float(np.sqrt(covariance[0, 0])),
        sd_intercept=float(sd[0]),
        sd_slope=float(sd[1]),
        correlation=float(random[0, 1] / (sd[0] * sd[1])) if sd.all() else None,
        residual_sd=sigma * spread,
        reml_criterion=float(criterion + 2 * np.log(scale) + 2 * (size["n"] - 2) * np.log(spread)),
        singular=bool(np.linalg.svd(relative, compute_uv=False)[1] < 1e-4),
        **size,
    )
