"""Relaxation times: crossing, censoring, errors, and the stretched exponential."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellquant.observables.dynamics import LagAverage, scattering_average
from cellquant.observables.fits import fit_stretched_exponential
from cellquant.observables.relaxation import crossing_time, relaxation_time
from observables_examples import brownian


def curve(value: np.ndarray, lag_time: np.ndarray, spread: float = 0.0) -> LagAverage:
    """Nine blocks whose averages are spread evenly about the curve."""
    blocks = value + spread * np.linspace(-1.5, 1.5, 9)[:, None]
    return LagAverage(lag_time, 100 * blocks, np.full(blocks.shape, 100.0), "nine blocks")


@given(tau=st.floats(2.0, 50.0), beta=st.floats(0.3, 2.0))
@settings(deadline=None, max_examples=50)
def test_every_stretched_exponential_crosses_where_it_should(tau: float, beta: float) -> None:
    time = np.geomspace(1, 100, 12)
    assert crossing_time(time, np.exp(-((time / tau) ** beta))) == pytest.approx(tau, rel=1e-9)


def test_a_curve_that_jumps_below_zero_is_interpolated_itself() -> None:
    time, value = np.array([1.0, 10.0]), np.array([0.5, -0.5])
    share = (0.5 - np.exp(-1)) / 1.0
    assert crossing_time(time, value) == pytest.approx(10**share)


def test_a_curve_on_the_threshold_crosses_there() -> None:
    assert crossing_time(np.array([1.0, 4.0]), np.array([0.9, np.exp(-1)])) == 4.0


def test_lags_without_data_are_passed_over() -> None:
    time = np.array([1.0, 2.0, 4.0])
    value = np.array([np.exp(-0.5), np.nan, np.exp(-2.0)])
    assert crossing_time(time, value) == pytest.approx(2.0)


def test_the_bias_of_a_noisy_curve_is_told_not_taken_off() -> None:
    time = np.arange(1.0, 24.0)
    exact = relaxation_time(curve(np.exp(-time / 8), time))
    assert exact.value == pytest.approx(8.0)
    assert exact.bias == pytest.approx(0, abs=1e-12)
    noisy = relaxation_time(curve(np.exp(-time / 8), time, 0.05))
    assert noisy.value == pytest.approx(8.0)
    # Half the second derivative of the crossing by F, times the squared error of F.
    error, step = 0.05 * np.linspace(-1.5, 1.5, 9).std(ddof=1) / 3, 1e-4
    low, mid, high = (crossing_time(time, np.exp(-time / 8) + d) for d in (-step, 0.0, step))
    assert noisy.bias == pytest.approx(0.5 * (low - 2 * mid + high) / step**2 * error**2, rel=0.01)


def test_censored_where_it_stays_above() -> None:
    time = np.arange(1.0, 24.0)
    found = relaxation_time(curve(np.exp(-time / 100), time))
    assert found.value is None
    assert found.std_error is None
    assert found.censored_at == 23.0
    assert found.censored_fraction == 1.0
    assert "stays above" in str(found.reason)


def test_bounded_above_where_it_starts_below() -> None:
    time = np.arange(1.0, 9.0)
    found = relaxation_time(curve(np.exp(-time / 0.2), time))
    assert found.value is None
    assert found.censored_at is None
    assert found.below == 1.0
    assert "already" in str(found.reason)


def test_a_crossing_that_half_the_resamples_miss_has_an_open_error() -> None:
    time = np.arange(1.0, 24.0)
    found = relaxation_time(curve(np.exp(-time / 22.4), time, spread=0.05))
    assert found.value is not None
    assert 0.1 < found.censored_fraction < 0.9
    assert found.std_error is None
    assert found.interval[1] is None
    assert "do not cross" in str(found.reason)


def test_one_block_has_no_error() -> None:
    time = np.arange(1.0, 24.0)
    one = LagAverage(time, np.exp(-time / 5)[None], np.ones((1, 23)), "one block")
    found = relaxation_time(one)
    assert found.value == pytest.approx(5)
    assert found.std_error is None
    assert "two replicate blocks" in str(found.reason)


def test_nothing_measured_is_said() -> None:
    empty = LagAverage(np.array([1.0]), np.zeros((3, 1)), np.zeros((3, 1)), "blocks")
    assert relaxation_time(empty).value is None
    assert relaxation_time(empty).reason


def test_equal_seeds_give_equal_errors() -> None:
    time = np.arange(1.0, 24.0)
    noisy = curve(np.exp(-time / 5), time, spread=0.02)
    assert relaxation_time(noisy, seed=3) == relaxation_time(noisy, seed=3)


def test_stretched_exponential_is_recovered() -> None:
    time = np.geomspace(1, 60, 25)
    found = fit_stretched_exponential(curve(np.exp(-((time / 9) ** 0.7)), time))
    assert found.tau == pytest.approx(9, rel=1e-6)
    assert found.beta == pytest.approx(0.7, rel=1e-6)


def test_stretched_exponential_of_walkers_agrees_within_its_error() -> None:
    q, diffusion = 2 * np.pi, 0.002
    tracks = brownian(np.random.default_rng(1), 200, 60, diffusion=diffusion)
    average = scattering_average(tracks, q)
    found = fit_stretched_exponential(average)
    assert found.tau is not None
    assert found.tau_std_error is not None
    assert abs(found.tau - 1 / (diffusion * q**2)) < 3.5 * found.tau_std_error
    assert abs(found.beta - 1) < 3.5 * found.beta_std_error
    direct = relaxation_time(average)
    assert abs(direct.value - found.tau) < 3.5 * direct.std_error


def test_no_stretched_exponential_without_a_decay() -> None:
    time = np.arange(1.0, 30.0)
    assert fit_stretched_exponential(curve(np.full(29, 0.999), time)).reason
    assert fit_stretched_exponential(curve(np.linspace(0.5, 0.9, 29), time)).reason
