"""Displacement averages against naive loops, other programs and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import get_num_threads, set_num_threads
from scipy.special import j0, jv

from cellquant.observables import kernels
from cellquant.observables.dynamics import (
    displacement_moments,
    mean_square_displacement,
    non_gaussian_parameter,
    overlap,
    pool,
    scattering_average,
    self_intermediate_scattering,
)
from cellquant.observables.smoothing import from_tracks
from cellquant.observables.trajectories import log_lags
from cellquant.tables import Tracks
from observables_examples import brownian, tracks_of, with_gaps

LAGS = np.array([1, 2, 5, 9])


def naive(tracks: Tracks, lags: np.ndarray, term, *, stride: int = 1) -> tuple:
    """Sum and number of a term of (dx, dy) over all pairs, by a double loop over rows."""
    sums, counts = np.zeros(lags.size), np.zeros(lags.size, dtype=int)
    for _, rows in tracks.table.groupby("track_id"):
        place = {int(f): (x, y) for f, x, y in rows[["frame", "x", "y"]].itertuples(index=False)}
        first = min(place)
        for m, lag in enumerate(lags):
            for frame, (x, y) in place.items():
                if frame + lag in place and (frame - first) % stride == 0:
                    x1, y1 = place[frame + lag]
                    sums[m] += term(x1 - x, y1 - y)
                    counts[m] += 1
    return sums, counts


@pytest.fixture(scope="module")
def gappy() -> Tracks:
    rng = np.random.default_rng(0)
    return with_gaps(brownian(rng, 15, 30, diffusion=0.05), rng, 0.25)


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("gaps", [True, False])
def test_averages_agree_with_a_double_loop(gappy: Tracks, gaps: bool, stride: int) -> None:
    tracks = gappy if gaps else brownian(np.random.default_rng(1), 10, 25, diffusion=0.05)
    q = 5.0
    second, fourth = displacement_moments(tracks, lags=LAGS, stride=stride)
    bessel = scattering_average(tracks, q, lags=LAGS, stride=stride)
    vectors = scattering_average(tracks, q, lags=LAGS, method="vectors", stride=stride)
    angle = np.pi * (np.arange(8) + 0.5) / 8

    def plane_waves(dx: float, dy: float) -> float:
        return float(np.mean(np.cos(q * (np.cos(angle) * dx + np.sin(angle) * dy))))

    for average, term in (
        (second, lambda dx, dy: dx * dx + dy * dy),
        (fourth, lambda dx, dy: (dx * dx + dy * dy) ** 2),
        (bessel, lambda dx, dy: j0(q * np.hypot(dx, dy))),
        (vectors, plane_waves),
    ):
        sums, counts = naive(tracks, LAGS, term, stride=stride)
        assert average.table()["n_pairs"].tolist() == counts.tolist()
        np.testing.assert_allclose(average.value, sums / counts, rtol=1e-12, atol=1e-12)


def test_overlap_and_its_fluctuation_agree_with_a_double_loop(gappy: Tracks) -> None:
    cutoff, lags = 0.4, np.array([1, 4])
    found = overlap(gappy, cutoff, lags=lags)
    sums, counts = naive(gappy, lags, lambda dx, dy: float(np.hypot(dx, dy) <= cutoff))
    np.testing.assert_allclose(found.overlap["value"], sums / counts, rtol=1e-12)
    wide = gappy.table.pivot(index="frame", columns="track_id", values=["x", "y"])
    wide = wide.reindex(range(30))
    for m, lag in enumerate(lags):
        dx = wide["x"].to_numpy()[lag:] - wide["x"].to_numpy()[:-lag]
        dy = wide["y"].to_numpy()[lag:] - wide["y"].to_numpy()[:-lag]
        near = np.where(np.isfinite(dx), np.hypot(dx, dy) <= cutoff, np.nan)
        series, n = np.nanmean(near, axis=1), np.isfinite(near).sum(axis=1).mean()
        squares = [
            (series[i] - series[j]) ** 2
            for i in range(series.size)
            for j in range(i + lag, series.size)
        ]
        expected = n * 0.5 * np.mean(squares)
        assert found.susceptibility["value"][m] == pytest.approx(expected, rel=1e-10)


def test_a_missing_frame_is_neither_a_still_cell_nor_another_lag() -> None:
    # A cell that moves one unit a frame, seen in frames 0, 1, 4, 5: lags 1, 3, 4, 5 exist.
    place = np.full((1, 6, 2), np.nan)
    place[0, [0, 1, 4, 5]] = np.array([0.0, 1, 4, 5])[:, None] * [1, 0]
    table = mean_square_displacement(tracks_of(place), lags=np.arange(1, 6))
    assert table["n_pairs"].tolist() == [2, 0, 1, 2, 1]
    np.testing.assert_array_equal(table["value"], [1, np.nan, 9, 16, 25])


def test_bessel_function_to_round_off() -> None:
    x = np.r_[np.linspace(0, 100, 200001), np.geomspace(100, 1e6, 5000)]
    found = kernels.bessel_j0(x, kernels._J0_TABLE)
    assert np.abs(found[:200001] - j0(x[:200001])).max() < 2e-15
    # Beyond, the argument of the cosine is itself rounded.
    assert np.all(np.abs(found - j0(x)) <= 2e-15 + 4e-16 * np.sqrt(x))


@given(r=st.floats(0, 8), n_vectors=st.integers(4, 12))
@settings(deadline=None, max_examples=30)
def test_directions_differ_from_the_exact_average_by_the_stated_bound(
    r: float, n_vectors: int
) -> None:
    angle = 0.3
    place = np.array([[[0.0, 0.0], [r * np.cos(angle), r * np.sin(angle)]]])
    lags = np.array([1])
    exact = scattering_average(tracks_of(place), 1.0, lags=lags).value[0]
    finite = scattering_average(
        tracks_of(place), 1.0, lags=lags, method="vectors", n_vectors=n_vectors
    ).value[0]
    bound = 2 * sum(abs(jv(2 * n_vectors * k, r)) for k in (1, 2, 3)) + 1e-12
    assert abs(finite - exact) <= bound


def test_results_are_byte_equal_for_any_number_of_threads(gappy: Tracks) -> None:
    before, answers = get_num_threads(), []
    try:
        for threads in {1, before}:
            set_num_threads(threads)
            found = overlap(gappy, 0.4)
            answers.append(
                b"".join(
                    table.to_numpy(float).tobytes()
                    for table in (
                        mean_square_displacement(gappy),
                        self_intermediate_scattering(gappy, 5.0),
                        self_intermediate_scattering(gappy, 5.0, method="vectors"),
                        found.overlap,
                        found.susceptibility,
                    )
                )
            )
    finally:
        set_num_threads(before)
    assert len(set(answers)) == 1


# trackpy 0.7 sums along an axis in a way that pandas 3 announces to change.
@pytest.mark.filterwarnings("ignore:Starting with pandas version")
def test_msd_agrees_with_trackpy(gappy: Tracks) -> None:
    import trackpy

    table = gappy.table.rename(columns={"track_id": "particle"})
    # trackpy averages per track first; with one track the two definitions meet.
    one = table[table["particle"] == 3]
    peer = trackpy.motion.msd(one, mpp=1.0, fps=1.0, max_lagtime=9, detail=True)
    single = Tracks(gappy.table[gappy.table["track_id"] == 3], gappy.units, 1.0, gappy.area, None)
    found = mean_square_displacement(single, lags=np.arange(1, 10))
    np.testing.assert_allclose(found["value"], peer["msd"], rtol=1e-12)


def test_msd_agrees_with_tidynamics() -> None:
    tidynamics = pytest.importorskip("tidynamics", reason="pip install tidynamics")
    tracks = brownian(np.random.default_rng(3), 6, 50)
    place = tracks.table[["x", "y"]].to_numpy().reshape(6, 50, 2)
    peer = np.mean([tidynamics.msd(p) for p in place], axis=0)
    found = mean_square_displacement(tracks, lags=np.arange(1, 50))
    np.testing.assert_allclose(found["value"], peer[1:], rtol=1e-9)


def test_msd_agrees_with_freud() -> None:
    freud = pytest.importorskip("freud", reason="pip install freud-analysis")
    tracks = brownian(np.random.default_rng(4), 6, 40)
    place = tracks.table[["x", "y"]].to_numpy().reshape(6, 40, 2)
    cube = np.zeros((40, 6, 3))
    cube[..., :2] = place.transpose(1, 0, 2)
    peer = freud.msd.MSD(mode="window").compute(cube).msd
    found = mean_square_displacement(tracks, lags=np.arange(1, 40))
    # freud works in single precision.
    np.testing.assert_allclose(found["value"], peer[1:], rtol=2e-4)


def test_ballistic_and_still_cells() -> None:
    t = np.arange(40.0)
    heading = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    place = np.stack([np.cos(heading), np.sin(heading)], axis=1)[:, None] * t[None, :, None]
    ballistic = tracks_of(place)
    table = mean_square_displacement(ballistic)
    np.testing.assert_allclose(table["value"], table["lag_time"] ** 2, rtol=1e-12)
    np.testing.assert_allclose(non_gaussian_parameter(ballistic)["value"], -0.5, atol=1e-10)
    still = tracks_of(np.zeros((5, 30, 2)))
    assert (mean_square_displacement(still)["value"] == 0).all()
    assert non_gaussian_parameter(still)["value"].isna().all()
    assert (self_intermediate_scattering(still, 6.0)["value"] == 1).all()


def test_one_track_has_values_without_errors() -> None:
    table = mean_square_displacement(brownian(np.random.default_rng(5), 1, 30))
    assert table["value"].notna().all()
    assert table["std_error"].isna().all()


def test_no_pair_is_not_a_number() -> None:
    table = self_intermediate_scattering(tracks_of(np.zeros((3, 4, 2))), 1.0, lags=np.array([3, 7]))
    assert table["value"].tolist()[0] == 1
    assert np.isnan(table["value"][1])
    assert table["n_pairs"].tolist() == [3, 0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: scattering_average(t, -1.0), "q must be"),
        (lambda t: scattering_average(t, 1.0, method="both"), "method must be"),
        (lambda t: scattering_average(t, 1.0, method="vectors", n_vectors=1), "n_vectors"),
        (lambda t: displacement_moments(t, lags=np.array([0, 1])), "lags must be"),
        (lambda t: displacement_moments(t, stride=0), "stride must be"),
        (lambda t: overlap(t, 0.0), "cutoff must be"),
    ],
)
def test_impossible_arguments_are_refused(gappy: Tracks, call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(gappy)


@given(st.integers(0, 5000), st.integers(2, 60))
def test_lags_are_distinct_and_reach_both_ends(max_lag: int, n: int) -> None:
    lags = log_lags(max_lag, n)
    assert (np.diff(lags) > 0).all()
    if max_lag >= 1:
        assert lags[-1] == max_lag
        assert lags[0] == 1
    else:
        assert lags.size == 0


def test_pooling_windows_adds_their_pairs(gappy: Tracks) -> None:
    paths, frame = from_tracks(gappy), gappy.table["frame"]
    halves = [paths.inside(0, 15), paths.inside(15, 30)]
    assert sum(int(half.valid.sum()) for half in halves) == len(gappy.table)
    for half, rows in zip(halves, (frame < 15, frame >= 15), strict=True):
        cut = from_tracks(replace(gappy, table=gappy.table[rows]))
        for name in ("x", "y", "start", "centre"):
            np.testing.assert_allclose(getattr(half, name), getattr(cut, name), atol=1e-14)
        for name in ("valid", "offsets", "first_frame", "origin_frame", "n_frames"):
            np.testing.assert_array_equal(getattr(half, name), getattr(cut, name))
    parts = [scattering_average(half, 5.0) for half in halves]
    whole = pool(parts).table()
    assert whole["n_pairs"].sum() == sum(p.counts.sum() for p in parts)
    by_lag = whole.set_index("lag_time")["value"]
    expected = sum(p.sums[:, 0].sum() for p in parts) / sum(p.counts[:, 0].sum() for p in parts)
    assert by_lag.loc[1.0] == pytest.approx(expected)
