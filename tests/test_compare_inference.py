"""Ranking and estimation of parameters: known answers come back, doubt is admitted."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import cellquant as cq
from cellquant.compare.calibration import Forecast, inflation_for, smallest_region
from cellquant.compare.emulator import Emulator, folds_of, train
from cellquant.compare.groups import Group, read_groups
from cellquant.compare.inference import fit_parameters, sensitivity
from cellquant.compare.processes import Scatter, learn
from cellquant.compare.ranking import (
    REDUCED_UNITS,
    Units,
    features_of,
    rank_candidates,
    units_of_file,
)
from cellquant.compare.results import Result
from cellquant.errors import InputError


def toy(
    phi: float, v0: float, eta: float, *, seed: int, noise: float = 1.0, scale: float = 1.0
) -> Result:
    """Observables as smooth functions of the parameters, with errors that are what they say.

    `scale` multiplies lengths by 20 and times by 1/6 when it is not 1, as a movie would.
    """
    rng = np.random.default_rng(seed)
    length, time = (1.0, 1.0) if scale == 1.0 else (20.0, 1 / 6)

    def draw(value: float, error: float) -> tuple[float, float]:
        return value + noise * error * rng.standard_normal(), error

    mean, mean_error = draw(3.72 + 2.2 * v0 - 1.8 * eta + 0.4 * (phi - 0.9), 0.004)
    std, std_error = draw(0.05 + 1.1 * v0 - 0.6 * eta, 0.003)
    skew, skew_error = draw(1.0 + 6 * v0, 0.1)
    tau = 8 / v0 * (1 + 20 * (phi - 0.9) ** 2 + 5 * eta)
    tau, tau_error = draw(tau, 0.06 * tau)
    speed, speed_error = draw(v0 * (1.2 - phi), 0.002 * v0)
    p = np.linspace(3.5, 4.6, 200)
    density = np.exp(-0.5 * ((p - mean) / std) ** 2)
    density /= density.sum() * (p[1] - p[0])
    summary = {
        "length_unit": "L0" if scale == 1.0 else "um",
        "time_unit": "t0" if scale == 1.0 else "min",
        "n_frames": 10,
        "n_tracks": 100,
        "shape_index": {"mean": mean, "std_error": mean_error, "std": std,
                        "std_std_error": std_error, "skewness": skew,
                        "skewness_std_error": skew_error, "n": 1000},
        "tau_alpha": {"value": tau * time, "std_error": tau_error * time},
        "speed": {"mean": speed * length / time, "std_error": speed_error * length / time,
                  "dt": 1.0 * time},
        "processing": {"smoothing_points": 1},
    }  # fmt: skip
    table = pd.DataFrame({"shape_index": p, "value": density, "std_error": 0.02 * density})
    scene = {"phi": phi, "v0": v0, "eta": eta} if scale == 1.0 else {}
    record = {"settings": {"scene": scene, "seed": seed}}
    name = f"phi {phi:g}, v0 {v0:g}, eta {eta:g}"
    return Result(name, summary, {"shape_index": table}, record)


def grid(seeds: int = 1) -> list[Group]:
    groups = []
    for i, phi in enumerate((0.88, 0.92, 0.96, 1.0)):
        for j, v0 in enumerate((0.01, 0.03, 0.05, 0.07)):
            for k, eta in enumerate((0.01, 0.03, 0.05)):
                base = 1000 * i + 100 * j + 10 * k
                trials = {str(s): (toy(phi, v0, eta, seed=base + s),) for s in range(seeds)}
                scene = {"phi": phi, "v0": v0, "eta": eta}
                groups.append(Group(f"{phi}-{v0}-{eta}", True, trials, scene))
    return groups


@pytest.fixture(scope="module")
def sweep() -> list[Group]:
    return grid()


FEATURES = ("shape_index.mean", "shape_index.std", "shape_index.skewness", "tau_alpha.value",
            "speed.mean")  # fmt: skip


@pytest.fixture(scope="module")
def emulator(sweep: list[Group]) -> Emulator:
    return train(sweep, FEATURES)


def target(phi: float, v0: float, eta: float, seed: int) -> Group:
    (group,) = read_groups([toy(phi, v0, eta, seed=seed)])
    return group


def test_the_true_scene_ranks_first(sweep: list[Group]) -> None:
    found = rank_candidates(target(0.96, 0.05, 0.03, 7), sweep, units=REDUCED_UNITS)
    first = found.ranks[0]
    assert first.scene == {"phi": 0.96, "v0": 0.05, "eta": 0.03}
    assert first.distance < 2
    assert first.distance < found.ranks[1].distance
    assert "P(p)" in found.features
    assert sum(rank.best_probability for rank in found.ranks) == pytest.approx(1.0)
    assert (
        found.statement()
        == f"{first.name} is closest, in {first.best_probability:.0%} of the draws."
    )


def test_equal_candidates_are_not_distinguishable(sweep: list[Group]) -> None:
    twins = [
        Group(name, True, {"1": (toy(0.96, 0.05, 0.03, seed=seed),)}, {})
        for name, seed in (("one", 11), ("two", 12))
    ]
    found = rank_candidates(target(0.96, 0.05, 0.03, 7), [*twins, sweep[0]], units=REDUCED_UNITS)
    assert {rank.name for rank in found.not_distinguishable} == {"one", "two"}
    assert "not distinguishable from" in found.statement()
    assert found.ranks[-1].best_probability == 0.0
    assert found.ranks[-1].interval == (3, 3)


def test_chance_of_being_the_closest_is_that_of_the_errors() -> None:
    """One number, errors of 1 and 2 combined apart: the chance from ten thousand plain draws."""

    def layer(name: str, mean: float) -> Group:
        result = toy(0.92, 0.03, 0.03, seed=0)
        summary = {**result.summary, "tau_alpha": {}, "speed": {},
                   "shape_index": {"mean": mean, "std_error": 0.004, "n": 9}}  # fmt: skip
        return Group(name, True, {"1": (replace(result, summary=summary, tables={}),)}, {})

    apart = 0.004 * np.sqrt(2)
    scenes = [layer("near", 3.8), layer("off", 3.8 + apart), layer("far", 3.8 + 8 * apart)]
    found = {rank.name: rank for rank in rank_candidates(layer("t", 3.8), scenes).ranks}
    rng = np.random.default_rng(1)
    ours = rng.normal(3.8, 0.004, 10_000)
    theirs = [rng.normal(3.8 + step * apart, 0.004, 10_000) for step in (0, 1, 8)]
    closest = np.argmin([np.abs(one - ours) for one in theirs], axis=0)
    for number, name in enumerate(("near", "off", "far")):
        assert found[name].best_probability == pytest.approx((closest == number).mean(), abs=0.03)
    assert 0.1 < found["off"].best_probability < 0.4
    ranking = rank_candidates(layer("t", 3.8), scenes)
    assert ranking.statement() == "near is closest, but not distinguishable from off."
    lone = rank_candidates(layer("t", 3.8 - 3 * apart), scenes[1:])
    assert lone.statement() == (
        "off is closest, in 100% of the draws. "
        "It does not match: 4.00 combined standard errors apart."
    )


def test_ranking_depends_on_the_seed_alone(sweep: list[Group]) -> None:
    wanted = target(0.92, 0.03, 0.01, 3)
    assert rank_candidates(wanted, sweep) == rank_candidates(wanted, sweep)
    other = rank_candidates(wanted, sweep, seed=1)
    assert [r.name for r in other.ranks] == [r.name for r in rank_candidates(wanted, sweep).ranks]


def test_units_bring_times_and_lengths_into_play() -> None:
    movie = Group("movie", False, {"1": (toy(0.92, 0.03, 0.01, seed=5, scale=2.0),)}, {})
    model = target(0.92, 0.03, 0.01, 5)
    pure = features_of(movie, None)
    assert "tau_alpha.value" not in pure
    units = Units((20.0, 0.0), (1 / 6, 0.0))
    ours, theirs = features_of(movie, units), features_of(model, REDUCED_UNITS)
    for name in theirs:
        assert ours[name].value == pytest.approx(theirs[name].value)
        assert ours[name].std_error == pytest.approx(theirs[name].std_error)
    doubtful = features_of(movie, Units((20.0, 2.0), (1 / 6, 1 / 60)))
    assert doubtful["speed.mean"].std_error > math.hypot(0.1, 0.1)


def test_speed_of_another_frame_interval_is_left_out(sweep: list[Group]) -> None:
    wanted = toy(0.92, 0.03, 0.01, seed=3)
    wanted.summary["speed"]["dt"] = 5.0
    found = rank_candidates(read_groups([wanted])[0], sweep, units=REDUCED_UNITS)
    assert "speed.mean" in found.left_out


def test_known_parameters_come_back(sweep: list[Group], emulator: Emulator) -> None:
    rng = np.random.default_rng(2)
    inside = 0
    widths = []
    for case in range(20):
        truth = {
            "phi": rng.uniform(0.89, 0.99),
            "v0": rng.uniform(0.015, 0.065),
            "eta": rng.uniform(0.012, 0.048),
        }
        found = fit_parameters(
            target(**truth, seed=9000 + case),
            sweep,
            units=REDUCED_UNITS,
            emulator=emulator,
            n_points=512,
        )
        inside += found.contains(truth)
        low, _, high = found.interval("v0")
        widths.append(high - low)
    assert inside >= 18
    # The region is worth something: a small part of the range of the sweep.
    assert np.median(widths) < 0.2 * 0.06


def test_region_does_not_hold_a_wrong_answer(sweep: list[Group], emulator: Emulator) -> None:
    wanted = target(0.92, 0.05, 0.02, 4)
    found = fit_parameters(wanted, sweep, units=REDUCED_UNITS, emulator=emulator)
    assert not found.contains({"phi": 0.92, "v0": 0.02, "eta": 0.02})
    assert not found.at_edge("v0")
    effect = sensitivity(found)
    assert abs(effect["speed.mean"]["v0"]) > abs(effect["speed.mean"]["eta"])


def test_independent_features_are_found_independent(emulator: Emulator) -> None:
    apart = emulator.correlation - np.diag(np.diag(emulator.correlation))
    assert apart.shape == (len(FEATURES), len(FEATURES))
    assert np.abs(apart).max() < 0.5


def test_what_is_refused(sweep: list[Group]) -> None:
    wanted = target(0.92, 0.03, 0.01, 3)
    with pytest.raises(InputError, match="ranking needs two or more"):
        rank_candidates(wanted, sweep[:1])
    with pytest.raises(InputError, match="needs eight or more"):
        fit_parameters(wanted, sweep[:5])
    with pytest.raises(InputError, match="no parameter varies"):
        fit_parameters(wanted, sweep[:1] * 9)
    bare = Group("bare", False, {"1": (Result("bare", {"length_unit": "um", "time_unit": "min"},
                                              {}, {}),)}, {})  # fmt: skip
    with pytest.raises(InputError, match="no feature with a standard error in common"):
        rank_candidates(bare, sweep)


def test_scatter_beyond_the_errors_is_found(sweep: list[Group]) -> None:
    """Noise of 2.5 times the error that is stated, larger at one end than at the other."""
    rng = np.random.default_rng(5)
    x = rng.random((200, 2))
    law = np.array([-3.0, 1.0, 0.0])
    error = np.exp(law[0] + x @ law[1:])
    expected = np.sin(3 * x[:, 0]) + x[:, 1]
    process = learn(x, expected + 2.5 * error * rng.standard_normal(200), law)
    assert process.scatter == pytest.approx(2.5, rel=0.15)
    mean, deviation = process.predict(x)
    assert np.sqrt((((mean - expected) / deviation) ** 2).mean()) < 1.5
    assert np.median(deviation / error) < 0.6  # the mean is known better than one scene


def test_slope_of_the_scatter_is_its_derivative() -> None:
    x = np.random.default_rng(0).random((4, 2))
    kernel = Scatter(1.7, law=(-1.0, 0.3, 0.2))
    covariance, slope = kernel(x, eval_gradient=True)
    above, below = (kernel.clone_with_theta(kernel.theta + step)(x) for step in (1e-5, -1e-5))
    np.testing.assert_allclose(slope[..., 0], (above - below) / 2e-5, rtol=1e-6)
    np.testing.assert_allclose(np.diag(covariance), kernel.diag(x))
    assert (kernel(x, x) == 0).all()


def test_few_noisy_scenes_are_not_explained_by_ripples() -> None:
    """Pure noise, of which the scenes state half: it must be found as noise, not as a signal."""
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        x = rng.random((32, 3))
        process = learn(x, 0.2 * rng.standard_normal(32), np.array([np.log(0.1), 0.0, 0.0, 0.0]))
        found.append(process.scatter)
    assert np.median(found) == pytest.approx(2.0, rel=0.2)
    assert min(found) > 1.3


def test_scenes_are_predicted_by_processes_that_never_saw_them(sweep: list[Group]) -> None:
    parts = folds_of(len(sweep))
    assert sorted(scene for part in parts for scene in part) == list(range(len(sweep)))
    assert len(parts) == 8
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    # One scene that is far off: the others do not explain it, and say so.
    names = ("shape_index.mean",)
    fair = train(sweep, names)
    odd = toy(0.92, 0.03, 0.03, seed=1, noise=0.0)
    odd.summary["shape_index"]["mean"] += 0.2
    place = [dict(g.scene) for g in sweep].index({"phi": 0.92, "v0": 0.03, "eta": 0.03})
    spoilt = [*sweep[:place], replace(sweep[place], trials={"1": (odd,)}), *sweep[place + 1 :]]
    assert train(spoilt, names).inflation[0] > fair.inflation[0]


@pytest.mark.parametrize("overstated", [0.4, 1.0, 2.0])
def test_regions_are_widened_by_as_much_as_errors_are_too_small(overstated: float) -> None:
    """One parameter measured directly, 400 times, with an error of 0.02 called something else."""
    rng = np.random.default_rng(3)
    said = 0.02 * overstated
    prior = (np.arange(4096) + 0.5) / 4096
    forecasts = []
    for truth in rng.uniform(0.2, 0.8, 400):
        seen = truth + 0.02 * rng.standard_normal()
        place = np.append(prior, truth)
        forecasts.append(
            Forecast(((place - seen) / said) ** 2, np.full(4097, np.log(said)), 100_000)
        )
    found = inflation_for(forecasts, size=1)
    assert found == pytest.approx(max(1.0, 1 / overstated), rel=0.12)
    for level in (0.68, 0.95):
        held = np.mean([smallest_region(f, found, size=1) <= level for f in forecasts])
        assert held >= level


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("batch", [0, 1, 2])
def test_parameters_of_simulated_layers_come_back(batch: int) -> None:
    """Reduced problem: 36 cells for 100 t0; 64 scenes to learn from, 20 to recover."""
    from scipy.stats import qmc

    low, high = np.array([0.88, 0.02, 0.01]), np.array([1.0, 0.08, 0.06])

    def layer(point: np.ndarray, seed: int) -> Group:
        phi, v0, eta = (float(v) for v in point)
        scene = cq.Scene(phi=phi, v0=v0, eta=eta, n_cells=36, seed=seed)
        run = cq.simulate(scene, duration=100.0, transient=40.0, save_every=2.0)
        found = cq.observe(run, only=["shape_index", "speed", "msd"])
        known = {"phi": phi, "v0": v0, "eta": eta}
        result = Result(f"seed {seed}", found.summary, found.tables, {"settings": known})
        return Group(f"seed {seed}", True, {"1": (result,)}, known)

    points = low + qmc.Sobol(3, seed=batch).random(64) * (high - low)
    sweep = [layer(point, 1000 * batch + seed) for seed, point in enumerate(points)]
    features = ("shape_index.mean", "shape_index.std", "speed.mean", "msd.diffusion_coefficient",
                "msd.exponent")  # fmt: skip
    emulator = train(sweep, features)
    rng = np.random.default_rng(100 + batch)
    inside = 0
    for case in range(20):
        truth = low + (0.08 + 0.84 * rng.random(3)) * (high - low)
        wanted = layer(truth, 22000 + 1000 * batch + case)
        found = fit_parameters(wanted, sweep, units=REDUCED_UNITS, emulator=emulator)
        inside += found.contains(wanted.scene)
    assert inside >= 18


def test_fit_is_part_of_the_comparison(sweep: list[Group], tmp_path: Path) -> None:
    wanted = toy(0.93, 0.04, 0.02, seed=4, scale=2.0)
    scenes = [group.members[0] for group in sweep[::2]]
    units = tmp_path / "my units.toml"
    units.write_text(
        "[measured]\nL0 = { value = 20, std_error = 0.2 }\nt0 = { value = 10, std_error = 0.12 }\n"
    )
    one, two = (
        cq.compare(wanted, *scenes, fit=True, units=units, seed=1) for _ in range(2)
    )  # fmt: skip
    one.to_json(tmp_path / "one.json")
    two.to_json(tmp_path / "two.json")
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()
    one.to_html(tmp_path / "one.html")
    two.to_html(tmp_path / "two.html")
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()
    (fit,) = one.as_dict()["fits"]
    low, high = fit["parameters"]["v0"]["interval_95"]
    assert low < 0.04 < high
    assert len(fit["ranking"]) == len(scenes)
    assert one.settings["units"] == str(units)
    page = (tmp_path / "one.html").read_text()
    assert "Parameters that match" in page
    assert 'data-name="posterior-1-v0"' in page


def test_too_few_scenes_are_ranked_but_not_fitted(sweep: list[Group], tmp_path: Path) -> None:
    scenes = [group.members[0] for group in sweep[:4]]
    comparison = cq.compare(toy(0.93, 0.04, 0.02, seed=3, scale=2.0), *scenes, fit=True)
    (fit,) = comparison.as_dict()["fits"]
    assert fit["parameters"] is None
    assert "needs eight or more" in fit["reason"]
    comparison.to_html(tmp_path / "r.html")
    assert "Parameters were not estimated" in (tmp_path / "r.html").read_text()


def test_units_file_must_fix_length_and_time(tmp_path: Path) -> None:
    path = tmp_path / "units.toml"
    path.write_text("[measured]\nL0 = { value = 20, std_error = 1 }\nt0 = 12\n")
    units = units_of_file(path)
    assert units.length == (20.0, 1.0)
    assert units.time == (pytest.approx(0.2), 0.0)
    path.write_text("[measured]\nL0 = 20\n")
    with pytest.raises(InputError, match="does not fix t0"):
        units_of_file(path)
