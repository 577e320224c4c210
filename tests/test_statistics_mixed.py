"""Mixed model: the optimum itself, known data, invariance, and designs that have no answer."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from cellquant.statistics import fit_mixed_model

# Reaction times (ms) of 18 subjects over days 0 to 9 of sleep deprivation: Belenky et al.,
# J. Sleep Res. 12, 1 (2003), the data set "sleepstudy" of lme4.
SLEEP = """
249.5600 258.7047 250.8006 321.4398 356.8519 414.6901 382.2038 290.1486 430.5853 466.3535
222.7339 205.2658 202.9778 204.7070 207.7161 215.9618 213.6303 217.7272 224.2957 237.3142
199.0539 194.3322 234.3200 232.8416 229.3074 220.4579 235.4208 255.7511 261.0125 247.5153
321.5426 300.4002 283.8565 285.1330 285.7973 297.5855 280.2396 318.2613 305.3495 354.0487
287.6079 285.0000 301.8206 320.1153 316.2773 293.3187 290.0750 334.8177 293.7469 371.5811
234.8606 242.8118 272.9613 309.7688 317.4629 309.9976 454.1619 346.8311 330.3003 253.8644
283.8424 289.5550 276.7693 299.8097 297.1710 338.1665 332.0265 348.8399 333.3600 362.0428
265.4731 276.2012 243.3647 254.6723 279.0244 284.1912 305.5248 331.5229 335.7469 377.2990
241.6083 273.9472 254.4907 270.8021 251.4519 254.6362 245.4523 235.3110 235.7541 237.2466
312.3666 313.8058 291.6112 346.1222 365.7324 391.8385 404.2601 416.6923 455.8643 458.9167
236.1032 230.3167 238.9256 254.9220 250.7103 269.7744 281.5648 308.1020 336.2806 351.6451
256.2968 243.4543 256.2046 255.5271 268.9165 329.7247 379.4445 362.9184 394.4872 389.0527
250.5265 300.0576 269.8939 280.5891 271.8274 304.6336 287.7466 266.5955 321.5418 347.5655
221.6771 298.1939 326.8785 346.8555 348.7402 352.8287 354.4266 360.4326 375.6406 388.5417
271.9235 268.4369 257.2424 277.6566 314.8222 317.2135 298.1353 348.1229 340.2800 366.5131
225.2640 234.5235 238.9008 240.4730 267.5373 344.1937 281.1481 347.5855 365.1630 372.2288
269.8804 272.4428 277.8989 281.7895 279.1705 284.5120 259.2658 304.6306 350.7807 369.4692
269.4117 273.4740 297.5968 310.6316 287.1726 329.6076 334.4818 343.2199 369.1417 364.1236
"""


def sleep() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    reaction = np.array(SLEEP.split(), dtype=float)
    return np.tile(np.arange(10.0), 18), reaction, np.repeat(np.arange(18), 10)


def design(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Five trials x five densities; a third without slope variance, some without any."""
    rng = np.random.default_rng(seed)
    density = np.sort(rng.uniform(1100, 2600, (5, 5)), axis=1)
    slope = 0.01 + rng.normal(0, [0.0, 0.01, 0.02][seed % 3], (5, 1))
    level = 20 + rng.normal(0, 5, (5, 1))
    tau = level + slope * (density - 1850) + rng.normal(0, 3, (5, 5))
    return density.ravel(), tau.ravel(), np.repeat(np.arange(5), 5)


def dense_reml(x: np.ndarray, y: np.ndarray, group: np.ndarray) -> tuple[float, float, float]:
    """Slope, its error and the criterion, from whole matrices and a global search.

    Another parametrisation (log variances and atanh correlation), another algebra (full V) and
    another optimiser (differential evolution) than the function under test.
    """
    z = (x - x.mean()) / x.std()
    scale = y.std()
    response = (y - y.mean()) / scale
    fixed = np.column_stack([np.ones_like(z), z])
    same = group[:, None] == group[None]

    def parts(p: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        a, b, e = np.exp(p[0]), np.exp(p[1]), np.exp(p[3])
        c = np.tanh(p[2]) * np.sqrt(a * b)
        v = same * (a + c * (z[:, None] + z[None]) + b * np.outer(z, z)) + e * np.eye(z.size)
        inverse = np.linalg.inv(v)
        information = fixed.T @ inverse @ fixed
        beta = np.linalg.solve(information, fixed.T @ inverse @ response)
        rest = response - fixed @ beta
        value = np.linalg.slogdet(v)[1] + np.linalg.slogdet(information)[1]
        value += rest @ inverse @ rest + (z.size - 2) * np.log(2 * np.pi)
        return float(value), beta, information

    bounds = [(-25, 6), (-25, 6), (-12, 12), (-12, 3)]
    found = differential_evolution(
        lambda p: parts(p)[0], bounds, seed=1, tol=1e-10, maxiter=600, popsize=12, polish=True
    )
    value, beta, information = parts(found.x)
    error = np.sqrt(np.linalg.inv(information)[1, 1])
    criterion = value + 2 * np.log(x.std()) + 2 * (x.size - 2) * np.log(scale)
    return beta[1] * scale / x.std(), error * scale / x.std(), criterion


def test_sleepstudy_to_four_digits() -> None:
    found = fit_mixed_model(*sleep())
    assert round(found.intercept, 3) == 251.405
    assert round(found.slope, 3) == 10.467
    assert round(found.intercept_std_error, 3) == 6.825
    assert round(found.std_error, 3) == 1.546
    assert round(found.reml_criterion, 3) == 1743.628
    assert found.df == pytest.approx(17, abs=0.01)  # lmerTest
    assert found.df_method == "Satterthwaite"
    assert found.sd_intercept == pytest.approx(24.741, abs=2e-3)
    assert found.sd_slope == pytest.approx(5.922, abs=1e-3)
    assert found.correlation == pytest.approx(0.066, abs=1e-3)
    assert found.residual_sd == pytest.approx(25.592, abs=1e-3)
    assert found.singular is False
    assert found.interval_95[0] == pytest.approx(10.467 - 2.1098 * 1.5458, abs=1e-3)


@pytest.mark.parametrize("seed", [1])
def test_designs_reach_the_optimum_light(seed: int) -> None:
    data = design(seed)
    found = fit_mixed_model(*data)
    slope, error, criterion = dense_reml(*data)
    assert found.reml_criterion <= criterion + 1e-6
    assert found.slope == pytest.approx(slope, rel=0.01)
    assert found.std_error == pytest.approx(error, rel=0.01)


@pytest.mark.slow
def test_sixty_of_sixty_designs_reach_the_optimum() -> None:
    singular = 0
    for seed in range(60):
        data = design(seed)
        found = fit_mixed_model(*data)
        slope, error, criterion = dense_reml(*data)
        singular += bool(found.singular)
        assert found.reml_criterion <= criterion + 1e-6, seed
        assert found.slope == pytest.approx(slope, rel=0.01), seed
        assert found.std_error == pytest.approx(error, rel=0.01), seed
    assert singular >= 20


@pytest.mark.parametrize("seed", [4, 8])
def test_affine_changes_of_the_predictor_change_nothing(seed: int) -> None:
    x, y, group = design(seed)
    one, other = fit_mixed_model(x, y, group), fit_mixed_model(0.003 * x - 40, y, group)
    assert other.slope * 0.003 == pytest.approx(one.slope, rel=1e-6)
    assert other.std_error * 0.003 == pytest.approx(one.std_error, rel=1e-6)
    assert other.p_value == pytest.approx(one.p_value, rel=1e-4)
    assert other.singular == one.singular
    flipped = fit_mixed_model(-x, y, group)
    assert flipped.slope == pytest.approx(-one.slope, rel=1e-5)


def test_affine_changes_of_the_response_scale_the_slope() -> None:
    x, y, group = design(5)
    one, other = fit_mixed_model(x, y, group), fit_mixed_model(x, 60 * y + 1e4, group)
    assert other.slope == pytest.approx(60 * one.slope, rel=1e-6)
    assert other.df == pytest.approx(one.df, rel=1e-3)


def test_names_of_trials_and_order_of_rows_do_not_matter() -> None:
    x, y, group = design(7)
    order = np.random.default_rng(0).permutation(x.size)
    named = np.array([f"trial {chr(101 - g)}" for g in group])
    one, other = fit_mixed_model(x, y, group), fit_mixed_model(x[order], y[order], named[order])
    assert other.slope == pytest.approx(one.slope, rel=1e-6)
    assert other.std_error == pytest.approx(one.std_error, rel=1e-6)


def test_no_variation_between_trials_is_singular_and_the_common_line() -> None:
    x, _, group = design(0)
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 1, 25)
    design_matrix = np.column_stack([np.ones(25), x])
    # Take out each trial's own line: what is left has less than no variance between trials.
    for g in range(5):
        own = design_matrix[group == g]
        noise[group == g] -= own @ np.linalg.lstsq(own, noise[group == g], rcond=None)[0]
    found = fit_mixed_model(x, 3 + 0.01 * x + noise, group)
    assert found.singular is True
    assert found.slope == pytest.approx(0.01, rel=1e-6)
    assert found.sd_slope == pytest.approx(0, abs=1e-6)


def test_designs_without_an_answer_give_reasons() -> None:
    x, y, group = design(0)
    assert "two trials" in fit_mixed_model(x, y, np.zeros(25)).reason
    assert "five points" in fit_mixed_model(x[:4], y[:4], [0, 0, 1, 1]).reason
    assert "same at every point" in fit_mixed_model(np.full(25, 1600.0), y, group).reason
    flat = fit_mixed_model(x, np.full(25, 7.0), group)
    assert (flat.slope, flat.std_error, flat.intercept) == (0.0, None, 7.0)
    line = fit_mixed_model(x, 2 + 0.5 * x, group)
    assert line.slope == pytest.approx(0.5)
    assert line.p_value is None
    assert "one line" in line.reason
    assert fit_mixed_model([], [], []).n == 0


def test_trials_that_see_one_density_only() -> None:
    rng = np.random.default_rng(3)
    x = np.repeat([1100.0, 1500, 1900, 2300, 2600], 4)
    y = 0.01 * x + rng.normal(0, 1, 20)
    found = fit_mixed_model(x, y, np.repeat(np.arange(5), 4))
    assert found.slope == pytest.approx(0.01, abs=0.005)
    assert np.isfinite(found.std_error)


def test_missing_values_are_left_out() -> None:
    x, y, group = design(2)
    y = y.copy()
    y[[3, 9]] = np.nan
    known = np.isfinite(y)
    one, other = fit_mixed_model(x, y, group), fit_mixed_model(x[known], y[known], group[known])
    assert one == other
    assert one.n == 23


@pytest.mark.slow
def test_p_values_are_uniform_without_a_trend() -> None:
    # Eight trials of five densities with random intercepts and slopes, and no mean slope.
    hits, repetitions = 0, 200
    for seed in range(repetitions):
        rng = np.random.default_rng(seed)
        x = np.sort(rng.uniform(1100, 2600, (8, 5)), axis=1)
        y = 20 + rng.normal(0, 3, (8, 1)) + rng.normal(0, 0.01, (8, 1)) * (x - 1850)
        y = y + rng.normal(0, 3, (8, 5))
        found = fit_mixed_model(x.ravel(), y.ravel(), np.repeat(np.arange(8), 5))
        hits += found.interval_95[0] <= 0 <= found.interval_95[1]
    assert 0.92 <= hits / repetitions <= 0.98
