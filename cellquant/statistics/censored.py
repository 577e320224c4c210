"""The linear mixed model where some responses are known only as bounds."""

from typing import Any

import numpy as np
from scipy import optimize, special

from cellquant.statistics.mixed import (
    FloatArray,
    MixedModel,
    fit_mixed_model,
    in_units,
    satterthwaite,
)

_NODES = 12  # of the quadrature over each of the two random effects of a trial
_LARGEST = 1e4  # relative random effects beyond which the likelihood is not looked at


class _Censored:
    """Adjusted profile likelihood in the relative Cholesky factor (a, b, c) and sigma.

    With u = L v, v ~ N(0, sigma^2), the observed points of a trial leave v normal with mean
    M^-1 L'X'(y - X beta) and covariance sigma^2 M^-1, M = 1 + L'X'X L. The bounds of the trial
    contribute the mean over v of the product of their normal probabilities.
    """

    def __init__(self, z: FloatArray, y: FloatArray, group: Any, side: Any) -> None:
        self.n = y.size
        design = np.column_stack([np.ones_like(z), z])
        known = side == 0
        n_groups = int(group.max()) + 1
        x, target, trial = design[known], y[known], group[known]
        self.n_known = target.size
        self.cross = np.zeros((n_groups, 2, 2))
        np.add.at(self.cross, trial, x[:, :, None] * x[:, None, :])
        self.right = np.zeros((n_groups, 2))
        np.add.at(self.right, trial, x * target[:, None])
        self.square = float(target @ target)
        # Bounds in the order of their trials, so that a trial's are summed in one stretch.
        bounds = np.flatnonzero(~known)[np.argsort(group[~known], kind="stable")]
        self.x, self.bound, self.trial = design[bounds], y[bounds], group[bounds]
        self.sign = side[bounds].astype(np.float64)
        self.first = np.flatnonzero(np.diff(self.trial, prepend=-1))
        node, weight = np.polynomial.hermite_e.hermegauss(_NODES)
        self.nodes = np.array([(p, q) for p in node for q in node])
        self.log_weight = np.log(np.outer(weight, weight).ravel() / (2 * np.pi))
        self.beta = np.zeros(2)

    def solve(self, parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Minus twice the log-likelihood at the best beta, its information, and that beta."""
        a, b, c, sigma = (float(v) for v in parameters)
        factor = np.array([[a, 0.0], [b, c]])
        inner = np.eye(2) + factor.T @ self.cross @ factor
        inverse = np.linalg.inv(inner)
        shrink = factor @ inverse @ factor.T  # L M^-1 L', per trial
        rest = np.eye(2) - shrink @ self.cross
        base = float(np.log(np.linalg.det(inner)).sum())
        base += self.n_known * float(np.log(2 * np.pi * sigma**2))
        information = (self.cross @ rest).sum(axis=0) / sigma**2
        pull = (self.right - (self.cross @ shrink @ self.right[..., None])[..., 0]) / sigma**2
        pull = pull.sum(axis=0)
        constant = self.square - float(np.einsum("gi,gij,gj->", self.right, shrink, self.right))
        # Of each bound: its design less what the observed points of the trial take up, and the
        # part of its mean that does not depend on beta, at every node.
        carried = np.einsum("ci,cij->cj", self.x, rest[self.trial])
        spread = np.linalg.cholesky(inverse)
        fixed = np.einsum("ci,cij,cj->c", self.x, shrink[self.trial], self.right[self.trial])
        fixed = fixed[:, None] + sigma * np.einsum(
            "ci,ij,cjk,mk->cm", self.x, factor, spread[self.trial], self.nodes
        )
        outer = carried[:, :, None] * carried[:, None, :]

        def parts(beta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
            """Minus twice the log-likelihood, half its gradient, half its Hessian."""
            value = base + constant / sigma**2 - 2 * pull @ beta + beta @ information @ beta
            place = self.sign[:, None] * (fixed + (carried @ beta - self.bound)[:, None]) / sigma
            log_share = special.log_ndtr(place)
            hazard = np.exp(-0.5 * place**2 - log_share) / np.sqrt(2 * np.pi)
            slope = (self.sign[:, None] * hazard / sigma)[..., None] * carried[:, None, :]
            bend = hazard * (place + hazard) / sigma**2
            log_weight = self.log_weight + np.add.reduceat(log_share, self.first)
            top = log_weight.max(axis=1, keepdims=True)
            share = np.exp(log_weight - top)
            total = share.sum(axis=1, keepdims=True)
            share /= total
            value -= 2 * float((top + np.log(total)).sum())
            own = np.add.reduceat(slope, self.first)  # (trials, nodes, 2)
            weighted = share[..., None] * own
            mean = weighted.sum(axis=1)
            of_bound = np.repeat(share, np.diff(np.r_[self.first, self.bound.size]), axis=0)
            hessian = information - np.tensordot(weighted, own, axes=([0, 1], [0, 1]))
            hessian += mean.T @ mean + np.tensordot((of_bound * bend).sum(axis=1), outer, axes=1)
            return float(value), information @ beta - pull - mean.sum(axis=0), hessian

        beta = self.beta.copy()
        value, gradient, hessian = parts(beta)
        for _ in range(60):
            step = np.linalg.solve(hessian, gradient)
            # The decrement of Newton's method: what is still to be gained.
            if float(gradient @ step) < 1e-10:
                break
            size = 1.0
            found = parts(beta - step)
            while found[0] > value and size > 1e-3:
                size /= 2
                found = parts(beta - size * step)
            beta = beta - size * step
            value, gradient, hessian = found
        self.beta = beta
        return value, hessian, beta

    def deviance(self, parameters: FloatArray) -> float:
        """Minus twice the likelihood with beta integrated out by Laplace's method.

        Where nothing is censored this is the restricted likelihood itself.
        """
        if np.abs(parameters[:3]).max() > _LARGEST or not 1e-6 < parameters[3] < 1e6:
            return 1e12
        value, information, _ = self.solve(parameters)
        volume = float(np.linalg.det(information))
        if not volume > 0:
            return 1e12
        return value + float(np.log(volume)) - 2 * float(np.log(2 * np.pi))

    def slope_variance(self, parameters: FloatArray) -> float:
        """Variance of the slope at theta and sigma."""
        return float(np.linalg.inv(self.solve(parameters)[1])[1, 1])


def _minimum(model: _Censored, starts: list[FloatArray]) -> FloatArray:
    """Best (a, b, c, sigma): descents from the starts, then with lost dimensions set to zero."""

    def restricted(point: FloatArray, free: list[int]) -> FloatArray:
        def criterion(values: FloatArray) -> float:
            tried = point.copy()
            tried[free] = values
            tried[3] = np.exp(tried[3])
            return model.deviance(tried)

        point = point.copy()
        point[3] = np.log(point[3])
        # The step of the differences is far above what the inner minimisation leaves open.
        options = {"eps": 1e-5, "gtol": 1e-4, "maxiter": 100}
        found = optimize.minimize(criterion, point[free], method="BFGS", options=options)
        point[free] = found.x
        point[3] = np.exp(point[3])
        return point

    best = min((restricted(start, [0, 1, 2, 3]) for start in starts), key=model.deviance)
    # The likelihood depends on the signs of the diagonal only through its square.
    best[:3] = abs(best[0]), best[1] * (np.sign(best[0]) or 1.0), abs(best[2])
    lowest = model.deviance(best)
    for lost in ((0, 1, 2), (0, 1), (1, 2), (0,), (2,)):
        if any(best[k] > 0.1 for k in lost if k != 1):
            continue
        corner = best.copy()
        corner[list(lost)] = 0.0
        corner = restricted(corner, [k for k in range(4) if k not in lost])
        if model.deviance(corner) <= lowest + 1e-6:
            return corner
    return best


def fit_censored_model(x: Any, y: Any, group: Any, *, lower: Any, upper: Any) -> MixedModel:
    """Linear mixed model in which some responses are only known to lie above or below a bound.

    The model is that of `fit_mixed_model`. A point whose response is not known contributes the
    probability that it lies above ``lower`` or below ``upper`` (type-I censoring; Tobit); the
    random effects of a trial are integrated over by Gauss-Hermite quadrature and the fixed effects
    by Laplace's method (Cox & Reid), which gives the restricted likelihood where nothing is
    censored. The standard error of the slope is that of the information at the optimum.

    Parameters
    ----------
    x
        (n,) predictor.
    y
        (n,) response; NaN where it is only known as a bound.
    group
        (n,) trial of each point.
    lower, upper
        (n,) bound that the response exceeds, or stays below; NaN where there is none.

    Returns
    -------
    MixedModel
        ``n`` counts the bounds. Undefined (None with a reason) where `fit_mixed_model` is, with
        fewer than three known responses, and where bounds do not limit the slope.

    References
    ----------
    Tobin, Econometrica 26, 24 (1958), doi:10.2307/1907382.
    Cox & Reid, J. R. Stat. Soc. B 49, 1 (1987), doi:10.1111/j.2517-6161.1987.tb01422.x.
    """
    predictor, response, low, high = (
        np.asarray(values, dtype=np.float64) for values in (x, y, lower, upper)
    )
    known = np.isfinite(response)
    side = np.where(known, 0, np.where(np.isfinite(low), 1, np.where(np.isfinite(high), -1, 9)))
    level_or_bound = np.where(known, response, np.where(np.isfinite(low), low, high))
    used = np.isfinite(predictor) & (side != 9)
    predictor, target, side = predictor[used], level_or_bound[used], side[used]
    names = np.asarray(group)[used]
    at_bound = fit_mixed_model(predictor, target, names)
    if at_bound.reason is not None or not (side != 0).any():
        return at_bound
    size: dict[str, Any] = {"n": at_bound.n, "n_groups": at_bound.n_groups}
    if (side == 0).sum() < 3:
        return MixedModel(**size, reason="fewer than three responses are known")
    shift, scale = float(predictor.mean()), float(predictor.std())
    level, spread = float(target.mean()), float(target.std())
    _, index = np.unique(names, return_inverse=True)
    model = _Censored((predictor - shift) / scale, (target - level) / spread, index, side)
    assert at_bound.residual_sd is not None
    sigma = max(at_bound.residual_sd / spread, 1e-3)
    starts = [np.array([d, 0.0, d, s]) for d, s in ((0.5, sigma), (2.0, 0.5 * sigma))]
    best = _minimum(model, starts)
    _, information, beta = model.solve(best)
    limited = np.linalg.eigvalsh(information)[0] > 1e-6 and np.abs(beta).max() < 1e3
    if not limited or best[3] < 1e-5:
        return MixedModel(**size, reason="the bounds do not limit the slope or the scatter")
    return in_units(
        best[:3], float(best[3]), beta, np.linalg.inv(information),
        df=satterthwaite(model, best), criterion=model.deviance(best),
        x=(shift, scale), y=(level, spread), size=size,
    )  # fmt: skip
