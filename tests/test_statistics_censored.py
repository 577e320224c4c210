"""Trends through values known only as bounds, against a direct likelihood and planted slopes."""

import numpy as np
import pytest
from scipy import stats

from cellquant.statistics import fit_censored_model, fit_mixed_model
from cellquant.statistics.censored import _Censored

SLOPE = 0.02


def trials(seed: int, n_trials: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Relaxation times that grow with density, with a line of its own for every trial."""
    rng = np.random.default_rng(seed)
    density = np.tile([1100.0, 1500.0, 1850.0, 2200.0, 2600.0], n_trials)
    group = np.repeat(np.arange(n_trials), 5)
    own = rng.normal(0, 3, n_trials)[group]
    slope = SLOPE + rng.normal(0, 0.004, n_trials)[group]
    return density, 20 + own + slope * (density - 1100) + rng.normal(0, 4, group.size), group


def test_the_likelihood_is_that_of_a_normal_law_and_its_rectangle() -> None:
    """Density of the known points times the probability of the bounds given them, by scipy."""
    rng = np.random.default_rng(0)
    z, y, group = rng.normal(size=9), rng.normal(size=9), np.repeat([0, 1, 2], 3)
    side = np.array([0, 0, 1, 0, -1, 1, 0, 0, 0])
    parameters = np.array([0.7, 0.3, 0.4, 0.6])
    model = _Censored(z, y, group, side)
    value, information, beta = model.solve(parameters)
    factor = np.array([[0.7, 0.0], [0.3, 0.4]])

    def direct(at: np.ndarray) -> float:
        total = 0.0
        for g in range(3):
            rows = group == g
            design = np.column_stack([np.ones(3), z[rows]])
            covariance = 0.36 * (np.eye(3) + design @ factor @ factor.T @ design.T)
            known, bound = np.flatnonzero(side[rows] == 0), np.flatnonzero(side[rows] != 0)
            rest = y[rows] - design @ at
            block = covariance[np.ix_(known, known)]
            total += stats.multivariate_normal(cov=block).logpdf(rest[known])
            if bound.size:
                gain = covariance[np.ix_(bound, known)] @ np.linalg.inv(block)
                left = covariance[np.ix_(bound, bound)] - gain @ covariance[np.ix_(known, bound)]
                # Above a bound is below it with the sign turned.
                sign = side[rows][bound]
                reach = -sign * (rest[bound] - gain @ rest[known])
                left = left * np.outer(sign, sign)
                total += np.log(stats.multivariate_normal(cov=left).cdf(reach))
        return -2 * total

    assert value == pytest.approx(direct(beta), abs=1e-4)
    step = 1e-2 * np.eye(2)
    for k in range(2):  # the best beta, and half the second derivative there
        around = [direct(beta + step[k]), value, direct(beta - step[k])]
        assert around[0] - around[2] == pytest.approx(0, abs=1e-3)
        bend = (around[0] - 2 * around[1] + around[2]) / (2 * 1e-4)
        assert bend == pytest.approx(information[k, k], rel=0.02)


def test_without_bounds_it_is_restricted_maximum_likelihood() -> None:
    density, tau, group = trials(1)
    none = np.full(tau.size, np.nan)
    plain = fit_mixed_model(density, tau, group)
    assert fit_censored_model(density, tau, group, lower=none, upper=none) == plain
    # A bound far below everything says nothing: the fit is that without its point.
    lower, cut = none.copy(), tau.copy()
    lower[7], cut[7] = -1e3, np.nan
    found = fit_censored_model(density, cut, group, lower=lower, upper=none)
    without = fit_mixed_model(density, cut, group)
    assert found.slope == pytest.approx(without.slope, rel=1e-3)
    assert found.std_error == pytest.approx(without.std_error, rel=1e-2)


def test_a_planted_slope_is_recovered_where_both_other_rules_are_low() -> None:
    slopes = []
    for seed in range(3):
        density, tau, group = trials(seed + 10)
        high = tau > 44
        cut, bound = np.where(high, np.nan, tau), np.where(high, 44.0, np.nan)
        none = np.full(tau.size, np.nan)
        found = fit_censored_model(density, cut, group, lower=bound, upper=none)
        low, top = found.interval_95
        assert low < SLOPE < top
        without = fit_mixed_model(density, cut, group).slope
        at_bound = fit_mixed_model(density, np.minimum(tau, 44.0), group).slope
        full = fit_mixed_model(density, tau, group).slope
        slopes.append([found.slope / full, without / full, at_bound / full])
    ours, dropped, at_bound = np.mean(slopes, axis=0)
    assert abs(ours - 1) < 0.08
    assert max(dropped, at_bound) < 0.9


def test_upper_bounds_are_lower_bounds_upside_down() -> None:
    density, tau, group = trials(2)
    low = tau < 22
    cut, bound = np.where(low, np.nan, tau), np.where(low, 22.0, np.nan)
    none = np.full(tau.size, np.nan)
    down = fit_censored_model(density, cut, group, lower=none, upper=bound)
    up = fit_censored_model(density, -cut, group, lower=-bound, upper=none)
    assert down.slope == pytest.approx(-up.slope, rel=1e-3)
    assert down.std_error == pytest.approx(up.std_error, rel=1e-2)
    assert down.n == tau.size


def test_bounds_alone_give_a_reason() -> None:
    density, tau, group = trials(3)
    none = np.full(tau.size, np.nan)
    found = fit_censored_model(density, none, group, lower=tau, upper=none)
    assert found.slope is None
    assert "known" in found.reason
    one = group == 0
    alone = fit_censored_model(density[one], none[one], group[one], lower=tau[one], upper=none[one])
    assert "two trials" in alone.reason
