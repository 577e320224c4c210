"""`observe`: the contract of its files, what it computes, and input at the edge of sense."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from cellquant.errors import InputError
from cellquant.observables import available_observables, columns_read, needs_tracks, observe
from cellquant.tables import PHYSICAL, PIXEL, Cells, Tracks, read_tracks
from observables_examples import brownian, movie, tracks_of, with_gaps

TABLES = {
    "self_intermediate_scattering": ("lag_time", "value", "std_error", "n_pairs", "window"),
    "van_hove": ("r", "value", "std_error", "unit_integral", "n"),
    "shape_index": ("shape_index", "value", "std_error", "kernel_density", "n"),
    "structure_factor": ("wave_number", "value", "std_error", "n_vectors"),
    "msd": ("lag_time", "value", "std_error", "n_pairs"),
    "overlap": ("lag_time", "value", "std_error", "n_pairs"),
    "chi4": ("lag_time", "value", "std_error", "n_pairs"),
    "windows": ("start", "stop", "density", "bin_centre", "tau_alpha"),
    "relaxation_times": ("condition", "trial", "bin_centre", "density", "tau_alpha", "censored"),
}
SUMMARY = {
    "density": ("mean", "std_error"),
    "shape_index": ("mean", "median", "mode", "std", "skewness", "std_error", "n"),
    "wave_number": ("q", "rule", "mean_diameter", "q_peak"),
    "tau_alpha": ("value", "std_error", "censored_at"),
    "van_hove": (
        "lag_time", "sigma2", "sigma2_std_error", "xi", "xi_std_error", "normalisation",
        "core_range", "tail_range",
    ),
    "msd": ("exponent",),
    "alpha2_peak": ("value",),
    "chi4_peak": ("value",),
    "speed": ("mean", "median", "dt"),
}  # fmt: skip


def numbers(value: object) -> list[float]:
    """Every number in nested summary entries."""
    if isinstance(value, dict):
        return [n for item in value.values() for n in numbers(item)]
    if isinstance(value, list):
        return [n for item in value for n in numbers(item)]
    return [value] if isinstance(value, float) else []


def check_contract(folder: Path) -> dict:
    summary = json.loads((folder / "summary.json").read_text())
    for key in ("n_frames", "n_cells_mean", "n_tracks", "length_unit", "time_unit", "windows"):
        assert key in summary
    for group, keys in SUMMARY.items():
        assert set(keys) <= set(summary[group]), group
        missing = [k for k in keys if summary[group][k] is None]
        explained = any("reason" in key for key in summary[group])
        assert not missing or missing == ["censored_at"] or explained, (group, missing)
    for name, columns in TABLES.items():
        table = pq.read_table(folder / f"{name}.parquet")
        assert set(columns) <= set(table.column_names), name
        assert table.schema.metadata[b"length_unit"].decode() == summary["length_unit"]
    assert "mixed_model" in json.loads((folder / "statistics.json").read_text())
    assert np.isfinite(numbers(summary)).all()
    return summary


def test_a_movie_through_everything(tmp_path: Path) -> None:
    tracks = movie(np.random.default_rng(0))
    observed = observe(tracks, condition="untreated", trial="1")
    observed.write(tmp_path)
    summary = check_contract(tmp_path)
    assert summary["processing"]["smoothing_points"] == 5
    assert summary["processing"]["drift_removed"] is True
    assert summary["density"]["mean"] == pytest.approx(1500e-6)
    assert summary["wave_number"]["q"] == pytest.approx(2 * np.pi / 20)
    assert len(summary["windows"]) == 2
    assert summary["windows"][0]["density"] == pytest.approx(1500)
    assert summary["windows"][0]["bin_centre"] == 1600
    times = observed.tables["relaxation_times"]
    assert times["condition"].tolist() == ["untreated"]
    assert times["n_windows"].tolist() == [2]
    scopes = observed.tables["self_intermediate_scattering"]["scope"].unique().tolist()
    assert scopes == ["all", "window", "bin"]


def test_a_run_through_the_same_code(tmp_path: Path) -> None:
    tracks = brownian(np.random.default_rng(1), 100, 80, diffusion=0.004, box=(10.0, 10.0))

    class Run:
        def scan(self, columns: list[str]) -> Tracks:
            return replace(tracks, table=tracks.table[columns])

    observed = observe(Run())
    observed.write(tmp_path)
    summary = check_contract(tmp_path)
    assert summary["processing"]["smoothing_points"] == 1
    tau = summary["tau_alpha"]
    truth = 1 / (0.004 * (2 * np.pi) ** 2) / (1 - 1 / 100)
    assert abs(tau["value"] - truth) < 4 * tau["std_error"]
    assert len(summary["windows"]) == 1
    assert "um" in summary["windows"][0]["bin_reason"]
    # At tau_alpha of Gaussian motion sigma^2 = 2/q^2, in units of d^2.
    van_hove = summary["van_hove"]
    scale = van_hove["lag_time"] / tau["value"]
    assert abs(van_hove["sigma2"] / scale - 4 / (2 * np.pi) ** 2) < 4 * van_hove["sigma2_std_error"]


@pytest.mark.parametrize("name", sorted(available_observables()))
def test_each_alone_gives_the_same_from_its_own_columns(name: str, tmp_path: Path) -> None:
    movie(np.random.default_rng(3)).write(tmp_path / "tracks.parquet")
    columns = columns_read([name])
    tracks = read_tracks(tmp_path, columns=columns)
    assert list(tracks.table.columns) == columns
    alone = observe(tracks, only=[name])
    together = _everything(3)
    assert set(alone.summary) <= set(together.summary)
    for table, content in alone.tables.items():
        other = together.tables[table]
        if table == "self_intermediate_scattering":
            other = other[other["scope"] == "all"]
        pd.testing.assert_frame_equal(content, other.iloc[: len(content)], check_dtype=False)


_CACHE: dict[int, object] = {}


def _everything(seed: int):
    if seed not in _CACHE:
        _CACHE[seed] = observe(movie(np.random.default_rng(seed)))
    return _CACHE[seed]


def test_shapes_need_no_trajectories() -> None:
    tracks = movie(np.random.default_rng(4))
    columns = ["frame", "label", "x", "y", "area", "shape_index", "touches_border"]
    cells = Cells(
        tracks.table[columns], PHYSICAL, 1.0, 10.0, (283.0, 283.0), 60, np.full(60, 283.0**2)
    )
    names = ["shape_index", "density", "wave_number", "structure_factor", "hexatic_order"]
    observed = observe(cells, only=names)
    assert set(names) - {"wave_number"} <= set(observed.summary)
    assert observed.summary["n_tracks"] is None
    assert "processing" not in observed.summary
    assert not needs_tracks(names)
    with pytest.raises(InputError, match="msd, tau_alpha needs trajectories"):
        observe(cells, only=["tau_alpha", "msd", "shape_index"])


def test_shapes_by_density_bin() -> None:
    # Two windows in two bins: cells are lost half way, and those that stay are rounder.
    rng = np.random.default_rng(14)
    place = rng.uniform(0, 283, (120, 1, 2)) + np.zeros((1, 48, 1))
    place[60:, 24:] = np.nan
    shape = 3.9 + 0.02 * rng.normal(size=(120, 48)) - 0.1 * (np.arange(48) >= 24)
    tracks = tracks_of(place, shape_index=shape, units=PHYSICAL, area=283.0**2)
    options = {"only": ["shape_index"], "bin_centres": [750.0, 1500.0]}
    observed = observe(tracks, **options)
    low, high = observed.summary["shape_index"]["by_bin"]
    assert (low["bin_centre"], low["n"], low["n_windows"]) == (750.0, 60 * 24, 1)
    assert (high["bin_centre"], high["n"]) == (1500.0, 120 * 24)
    assert abs(low["mean"] - 3.8) < 4 * low["std_error"]
    assert abs(high["mean"] - 3.9) < 4 * high["std_error"]
    table = observed.tables["shape_index_by_bin"]
    assert table.groupby("bin_centre")["n"].sum().tolist() == [60 * 24, 120 * 24]
    outside = observe(tracks, only=["shape_index"], bin_centres=[2350.0])
    assert outside.summary["shape_index"]["by_bin"] == []
    assert "all outside the bins" in outside.summary["shape_index"]["by_bin_reason"]


def test_shape_alone_loads_no_dynamics() -> None:
    code = (
        "import sys, numpy as np; sys.path.insert(0, 'tests');"
        "from observables_examples import movie; from cellquant.observables import observe;"
        "observe(movie(np.random.default_rng(0)), only=['shape_index', 'density']);"
        "heavy = {'numba', 'trackpy', 'statsmodels', 'matplotlib'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    root = Path(__file__).resolve().parents[1]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"only": ["msd", "tau"]}, "no observable 'tau'"),
        ({"only": "msd"}, "list of names"),
        ({"smoothing": 4}, "smoothing must be"),
        ({"min_points": 1}, "min_points must be"),
        ({"window": 1}, "window must be"),
        ({"wave_number": -2.0}, "wave_number must be"),
        ({"wave_number": "peak"}, "wave_number must be"),
        ({"scattering": "fft"}, "scattering must be"),
        ({"van_hove_lag": 0.0}, "van_hove_lag must be"),
        ({"lags": [0, 1]}, "lags must be"),
        ({"bin_width": 0.0}, "bin_width must be"),
        ({"core_range": (0.4, 0.2)}, "core_range must be"),
        ({"tail_range": (-1.0, 2.0)}, "tail_range must be"),
    ],
)
def test_impossible_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        observe(movie(np.random.default_rng(5)), **options)


def test_chosen_ranges_of_the_van_hove_fits_are_kept() -> None:
    found = observe(
        movie(np.random.default_rng(5)), only=["van_hove"], core_range=(0.0, 0.3),
        tail_range=(0.3, 0.9), van_hove_lag=10.0,
    ).summary["van_hove"]  # fmt: skip
    assert found["core_range"] == [0.0, 0.3]
    assert found["tail_range"][0] == 0.3
    assert found["tail_range"][1] <= 0.9
    assert found["tail_core_n"] == 0


@pytest.mark.slow
def test_any_number_of_threads_gives_the_same_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(15)
    brownian(rng, 900, 60, box=(30.0, 30.0)).write(tmp_path / "tracks.parquet")
    for threads in ("1", "2"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
        subprocess.run(
            [sys.executable, "-m", "cellquant", "observe", str(tmp_path), "-o", tmp_path / threads],
            env={**os.environ, **dict.fromkeys(names, threads)},
            check=True,
            capture_output=True,
        )
    for file in (tmp_path / "1").iterdir():
        if file.name != "run.json":
            assert file.read_bytes() == (tmp_path / "2" / file.name).read_bytes(), file.name


def test_what_is_not_a_source_is_refused() -> None:
    with pytest.raises(InputError, match="got list"):
        observe([1, 2, 3])
    with pytest.raises(TypeError, match="no option 'colour'"):
        observe(movie(np.random.default_rng(5)), colour=3)


def test_pixels_have_no_density_bins() -> None:
    tracks = movie(np.random.default_rng(6))
    pixels = Tracks(tracks.table, PIXEL, 1.0, tracks.area)
    observed = observe(pixels, only=["windows", "density"])
    assert observed.summary["density"]["unit"] == "1/px^2"
    assert all(w["bin_centre"] is None for w in observed.summary["windows"])
    assert "um" in observed.summary["windows"][0]["bin_reason"]
    assert observed.tables["relaxation_times"]["bin_centre"].isna().all()


def test_densities_outside_every_bin_and_short_movies_leave_reasons() -> None:
    tracks = movie(np.random.default_rng(13))
    sparse = observe(tracks, only=["windows"], bin_centres=[2350.0, 2600.0])
    assert len(sparse.tables["relaxation_times"]) == 0
    assert sparse.statistics["mixed_model"] == {}
    reason = sparse.statistics["mixed_model_reason"]
    assert reason == sparse.summary["windows_reason"]
    assert "1500 to 1500 1/mm^2, all outside the bins from 2225 to 2725" in reason
    short = observe(tracks, only=["windows"], window=61)
    assert short.summary["windows"] == []
    assert "60 frames, fewer than the 61" in short.summary["windows_reason"]
    assert "nothing to compare" in short.statistics["mann_whitney_reason"]


EXTREMES = {
    "no rows": lambda rng: tracks_of(np.empty((0, 30, 2)), area=1.0),
    "one track": lambda rng: brownian(rng, 1, 60),
    "one frame": lambda rng: brownian(rng, 50, 1),
    "two frames": lambda rng: brownian(rng, 50, 2),
    "shorter than a window": lambda rng: brownian(rng, 50, 20),
    "all still": lambda rng: tracks_of(np.repeat(rng.uniform(0, 7, (50, 1, 2)), 40, axis=1)),
    "all on one spot": lambda rng: tracks_of(np.zeros((50, 40, 2))),
    "all alike": lambda rng: tracks_of(
        rng.uniform(0, 7, (50, 1, 2)) + np.arange(40)[None, :, None] * [0.1, 0.0]
    ),
    "ballistic": lambda rng: tracks_of(
        rng.uniform(0, 7, (50, 1, 2)) + rng.normal(size=(50, 1, 2)) * np.arange(40)[None, :, None]
    ),
    "never relaxes": lambda rng: brownian(rng, 50, 40, diffusion=1e-6),
    "relaxes at once": lambda rng: brownian(rng, 50, 40, diffusion=100.0),
    "many gaps": lambda rng: with_gaps(brownian(rng, 80, 60), rng, 0.5),
    "no areas": lambda rng: tracks_of(rng.uniform(0, 7, (50, 30, 2)), cell_area=np.nan),
    "all at the border": lambda rng: brownian(rng, 50, 40, touches_border=True),
    "huge coordinates": lambda rng: brownian(rng, 50, 40, edge=1e9),
    "two cells in a box": lambda rng: brownian(rng, 2, 40, box=(1.5, 1.5)),
}


@pytest.mark.parametrize("case", sorted(EXTREMES))
def test_extreme_input_gives_an_answer_or_a_reason(case: str, tmp_path: Path) -> None:
    tracks = EXTREMES[case](np.random.default_rng(7))
    observe(tracks).write(tmp_path)
    summary = check_contract(tmp_path)
    if case in {"never relaxes", "all still", "all on one spot", "all alike"}:
        assert summary["tau_alpha"]["value"] is None
        assert summary["tau_alpha"]["censored_at"] == 39
        times = pd.read_parquet(tmp_path / "relaxation_times.parquet")
        assert times["censored"].all()
    if case == "relaxes at once":
        assert summary["tau_alpha"]["value"] is None
        assert summary["tau_alpha"]["below"] == 1
    if case in {"one frame", "two frames", "shorter than a window", "no rows"}:
        assert summary["tau_alpha"]["value"] is None
        assert "consecutive points" in summary["tau_alpha"]["reason"] or case == "no rows"
    if case in {"all still", "all on one spot", "all alike"}:
        assert summary["speed"]["mean"] == 0.0
        for name in ("msd", "velocity_autocorrelation", "velocity_correlation"):
            assert summary[name]["reason"] == "no cell moved"
    if case == "ballistic":
        assert summary["velocity_autocorrelation"]["persistence_time"] is None
        assert "does not decay" in summary["velocity_autocorrelation"]["reason"]
        assert summary["msd"]["exponent"] == pytest.approx(2)
    if case in {"one track", "all on one spot"}:
        assert "four cells in view" in summary["cage_relative"]["reason"]
    if case == "one track":
        assert summary["msd"]["diffusion_coefficient_std_error"] is None
        assert "two replicate blocks" in summary["msd"]["std_error_reason"]
        assert summary["processing"]["drift_removed"] is False


def test_smoothing_makes_no_peak_of_the_non_gaussian_parameter() -> None:
    peak = observe(movie(np.random.default_rng(14)), only=["alpha2"]).summary["alpha2_peak"]
    assert peak["lag_time"] >= 50
    assert peak["shortest_lag"] == 5
    assert abs(peak["value"]) < 3.5 * peak["std_error"]


def test_positions_that_are_not_numbers_count_as_missing() -> None:
    tracks = movie(np.random.default_rng(8))
    holes = tracks.table.copy()
    lost = np.random.default_rng(9).random(len(holes)) < 0.02
    holes.loc[lost, ["x", "y"]] = np.nan
    with_nan = Tracks(holes, PHYSICAL, 10.0, tracks.area)
    without = Tracks(holes[~lost].reset_index(drop=True), PHYSICAL, 10.0, tracks.area)
    for name in ("msd", "tau_alpha", "speed", "velocity_correlation", "pair_correlation"):
        one, other = observe(with_nan, only=[name]), observe(without, only=[name])
        for table in one.tables:
            pd.testing.assert_frame_equal(one.tables[table], other.tables[table])


def test_duplicate_frames_are_named() -> None:
    tracks = movie(np.random.default_rng(10))
    twice = pd.concat([tracks.table, tracks.table.iloc[:1]])
    with pytest.raises(InputError, match="track 1 has 2 rows in frame 0"):
        observe(Tracks(twice, PHYSICAL, 10.0, tracks.area), only=["msd"])


def test_frame_numbers_that_no_movie_has_are_named() -> None:
    tracks = movie(np.random.default_rng(15))
    far = tracks.table.copy()
    far.loc[far.index[-1], "frame"] = 10**12
    with pytest.raises(InputError, match="from 0 to 1000000000000"):
        observe(Tracks(far, PHYSICAL, 10.0, tracks.area))
    far.loc[far["frame"] >= 30, "frame"] += 9 * 10**6
    far.loc[far.index[-1], "frame"] = 9 * 10**6 + 59
    with pytest.raises(InputError, match="gaps of up to 9000060 frames"):
        observe(Tracks(far, PHYSICAL, 10.0, tracks.area), only=["msd"])


def test_cells_at_the_border_count_half() -> None:
    # Discs thrown on a plane, seen through a window: every disc that shows is a cell.
    rng = np.random.default_rng(11)
    edge, radius, n = 100.0, 4.0, 1500
    found = []
    for _ in range(60):
        centre = rng.uniform(-50, 150, (n, 2))
        shown = centre[((centre > -radius) & (centre < edge + radius)).all(axis=1)]
        border = ((shown < radius) | (shown > edge - radius)).any(axis=1)
        tracks = tracks_of(
            np.clip(shown, 0, edge)[:, None], touches_border=border[:, None], area=edge**2
        )
        density = observe(tracks, only=["density"]).summary["density"]
        found.append((density["mean"], density["count_per_area"]))
    truth = n / 200**2
    halved, plain = np.mean(found, axis=0)
    error = np.std(found, axis=0)[0] / np.sqrt(60)
    assert abs(halved - truth) < 3 * error
    assert plain > truth + 10 * error


def test_relaxation_grows_with_density_in_eight_trials() -> None:
    # Eight trials, five densities each, diffusion falling with density: the planted trend.
    from cellquant.statistics import tau_alpha_trend

    rng = np.random.default_rng(12)
    rows = []
    for trial in range(8):
        mobility = rng.lognormal(0, 0.1)
        for density in (1100.0, 1500.0, 1850.0, 2200.0, 2600.0):
            n = 80
            edge = np.sqrt(n / (density * 1e-6))
            d = np.sqrt(4 / (np.pi * density * 1e-6))
            tau = 20 + 0.02 * (density - 1100)
            tracks = brownian(
                rng, n, 24, diffusion=mobility * (d / (2 * np.pi)) ** 2 / tau,
                frame_interval=10.0, edge=edge, area=edge**2, units=PHYSICAL,
                cell_area=np.pi * d**2 / 4,
            )  # fmt: skip
            observed = observe(
                tracks, only=["windows"], trial=str(trial), condition="c", smoothing=1,
                bin_width=500.0,
            )  # fmt: skip
            rows.append(observed.tables["relaxation_times"])
    found = tau_alpha_trend(pd.concat(rows, ignore_index=True))["c"]
    assert found["n"] == 40
    assert found["p_value"] < 1e-3
    low, high = found["interval_95"]
    assert low <= 0.02 <= high


@pytest.mark.slow
def test_real_tracks_of_the_gold_standard_go_through(recordings: Path, tmp_path: Path) -> None:
    import cellquant as cq

    folder = recordings / "cell_migration" / "TRA"
    tracks = cq.track(cq.read_labels(folder, pixel_size=1.0, frame_interval=5.0))
    observe(tracks).write(tmp_path)
    summary = check_contract(tmp_path)
    assert summary["n_frames"] == 86
    assert summary["tau_alpha"]["value"] is not None
