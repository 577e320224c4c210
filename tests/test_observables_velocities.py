"""Speeds, persistence, velocity correlation and cage-relative motion."""

import numpy as np
import pytest

from cellquant.observables.bonds import neighbour_pairs
from cellquant.observables.correlations import (
    cage_relative,
    persistence_time,
    velocity_autocorrelation,
    velocity_correlation,
)
from cellquant.observables.dynamics import displacement_moments, mean_square_displacement
from cellquant.observables.motion import growth_exponent, speeds
from cellquant.observables.smoothing import from_tracks
from observables_examples import brownian, persistent, tracks_of, with_gaps


def test_speeds_are_those_of_consecutive_frames() -> None:
    rng = np.random.default_rng(0)
    tracks = with_gaps(brownian(rng, 12, 25, frame_interval=10.0), rng)
    values, blocks = speeds(from_tracks(tracks))
    step = tracks.table.groupby("track_id")[["frame", "x", "y"]].diff()
    step = step[step["frame"] == 1]
    np.testing.assert_allclose(values, np.hypot(step["x"], step["y"]) / 10.0, rtol=1e-9)
    assert blocks.n == 12


def test_velocity_autocorrelation_agrees_with_a_double_loop() -> None:
    rng = np.random.default_rng(1)
    tracks = with_gaps(brownian(rng, 8, 25, frame_interval=2.0), rng, 0.1)
    lags = np.array([0, 1, 4])
    found = velocity_autocorrelation(from_tracks(tracks), lags=lags)
    sums, counts = np.zeros(3), np.zeros(3)
    for _, rows in tracks.table.groupby("track_id"):
        place = {int(f): np.array([x, y]) for f, x, y in rows[["frame", "x", "y"]].to_numpy()}
        v = {f: (place[f + 1] - place[f]) / 2.0 for f in place if f + 1 in place}
        for m, lag in enumerate(lags):
            for f in v:
                if f + lag in v:
                    sums[m] += v[f] @ v[f + lag]
                    counts[m] += 1
    np.testing.assert_allclose(found.value, sums / counts, rtol=1e-10)
    assert found.counts.sum(axis=0).tolist() == counts.tolist()


def test_persistent_walk() -> None:
    speed, persistence = 0.1, 4.0
    tracks = persistent(
        np.random.default_rng(2), 200, 80, speed=speed, persistence=persistence, substeps=2
    )
    paths = from_tracks(tracks)
    found = persistence_time(velocity_autocorrelation(paths), first_lag=1, interval=1.0)
    assert abs(found["persistence_time"] - persistence) < 3 * found["persistence_time_std_error"]
    table = mean_square_displacement(paths, lags=np.array([1, 3, 10, 20]))
    t = table["lag_time"] / persistence
    expected = 2 * speed**2 * persistence**2 * (t - 1 + np.exp(-t))
    assert (np.abs(table["value"] - expected) < 3.5 * table["std_error"]).all()


def test_walkers_without_memory_have_no_persistence() -> None:
    paths = from_tracks(brownian(np.random.default_rng(3), 80, 60))
    found = persistence_time(velocity_autocorrelation(paths), first_lag=1, interval=1.0)
    assert found["persistence_time"] is None
    assert "zero" in found["reason"]


def test_growth_exponents() -> None:
    walkers = brownian(np.random.default_rng(4), 200, 100, diffusion=0.02)
    found = growth_exponent(displacement_moments(walkers)[0])
    assert abs(found["exponent"] - 1) < 3 * found["exponent_std_error"]
    error = found["diffusion_coefficient_std_error"]
    assert abs(found["diffusion_coefficient"] - 0.02) < 3 * error
    t = np.arange(60.0)
    line = tracks_of(np.stack([np.stack([t, k * t], axis=1) for k in range(5)]))
    assert growth_exponent(displacement_moments(line)[0])["exponent"] == pytest.approx(2)
    still = displacement_moments(tracks_of(np.zeros((4, 60, 2))))[0]
    assert growth_exponent(still)["reason"] == "no cell moved"
    short = displacement_moments(tracks_of(np.zeros((4, 3, 2))))[0]
    assert growth_exponent(short)["exponent"] is None


@pytest.mark.parametrize("box", [None, (20.0, 20.0)])
def test_spatial_correlation_of_independent_and_of_common_motion(box) -> None:
    rng = np.random.default_rng(5)
    place = rng.uniform(0, 20, (400, 1, 2))
    alone = tracks_of(place + np.cumsum(rng.normal(0, 0.1, (400, 8, 2)), axis=1), box=box)
    found = velocity_correlation(from_tracks(alone), bin_width=1.0, max_distance=8.0)
    pull = found.table["value"] / found.table["std_error"]
    assert np.abs(pull).max() < 4.5
    common = tracks_of(place + np.cumsum(rng.normal(0, 0.1, (1, 8, 2)), axis=1), box=box)
    found = velocity_correlation(from_tracks(common), bin_width=1.0, max_distance=8.0)
    np.testing.assert_allclose(found.table["value"], 1)
    assert found.summary["correlation_length"] is None
    assert "stays above" in found.summary["reason"]


def test_correlation_length_of_a_wave() -> None:
    # Velocities along y vary as cos(k x): C falls to 1/e well inside half a wave length.
    rng = np.random.default_rng(6)
    place = rng.uniform(0, 20, (800, 1, 2))
    k = 2 * np.pi / 20
    v = np.stack([np.sin(k * place[..., 0]), np.cos(k * place[..., 0])], axis=-1)
    tracks = tracks_of(np.concatenate([place, place + 0.1 * v], axis=1), box=(20.0, 20.0))
    found = velocity_correlation(from_tracks(tracks), bin_width=0.5, max_distance=9.0)
    # <v.v> at distance r is J0(k r).
    assert found.summary["correlation_length"] == pytest.approx(1.755 / k, rel=0.05)
    error = found.summary["correlation_length_std_error"]
    assert 0 < error < 0.1 * found.summary["correlation_length"]


def test_cage_relative_motion_agrees_with_a_loop() -> None:
    rng = np.random.default_rng(7)
    tracks = with_gaps(brownian(rng, 30, 12, diffusion=0.05), rng, 0.15)
    lags = np.array([1, 3])
    square, _, n_origins = cage_relative(from_tracks(tracks), 5.0, lags=lags, max_frames=50)
    place = {
        (int(t), int(f)): np.array([x, y])
        for t, f, x, y in tracks.table[["track_id", "frame", "x", "y"]].to_numpy()
    }
    sums, counts = np.zeros(2), np.zeros(2)
    for frame in range(11):
        ids = [t for t in range(1, 31) if (t, frame) in place]
        pairs, _, _ = neighbour_pairs(np.array([place[t, frame] for t in ids]))
        for m, lag in enumerate(lags):
            for i, t in enumerate(ids):
                around = [ids[b] for a, b in pairs if a == i and (ids[b], frame + lag) in place]
                if (t, frame + lag) in place and around:
                    cage = np.mean(
                        [place[k, frame + lag] - place[k, frame] for k in around], axis=0
                    )
                    sums[m] += np.sum((place[t, frame + lag] - place[t, frame] - cage) ** 2)
                    counts[m] += 1
    assert n_origins == 11
    np.testing.assert_allclose(square.value, sums / counts, rtol=1e-10)


def test_cage_relative_motion_of_a_rigid_layer_is_nothing() -> None:
    rng = np.random.default_rng(8)
    place = rng.uniform(0, 10, (60, 1, 2)) + np.cumsum(rng.normal(0, 1, (1, 20, 2)), axis=1)
    square, wave, _ = cage_relative(from_tracks(tracks_of(place)), 6.0)
    assert np.nanmax(square.value) < 1e-20
    assert np.nanmin(wave.value) > 1 - 1e-12
