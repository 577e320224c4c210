"""Comparison: agreement, refusal to compare, pooling over trials, units, equal bytes."""

import html
import json
import math
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import cellquant as cq
from cellquant.compare.comparison import (
    AGREE,
    DIFFER,
    NOT_COMPARABLE,
    Comparison,
    judge,
    unit_mapping,
)
from cellquant.compare.comparison_page import command_of
from cellquant.compare.comparison_tables import units_section
from cellquant.compare.groups import Group, read_groups
from cellquant.compare.layers import n_moments
from cellquant.compare.matched_figures import scattering_figure
from cellquant.compare.matching import Matched, matched_scalars
from cellquant.compare.page import format_value
from cellquant.compare.results import Result
from cellquant.compare.study_figures import crowding_figure
from cellquant.compare.units import STERIC_AREA
from cellquant.errors import InputError
from cellquant.pipeline import observe_source
from compare_examples import make_layer


@pytest.fixture(scope="module")
def movie():
    return make_layer(seed=1, n_frames=8)


@pytest.fixture(scope="module")
def model():
    return make_layer(seed=2, n_frames=8, simulated=True, tau=200.0, shape=3.83)


def write_study(folder: Path) -> Path:
    """Two conditions with three trials, one of them with two stacks."""
    for c, condition in enumerate(["untreated", "low nutrient"]):
        for trial in range(3):
            for stack in range(2 if trial == 0 else 1):
                layer = make_layer(seed=trial, n_frames=3, side=5, size=80, tau=40 + 10 * c + trial)
                layer.summary["shape_index"]["mean"] = 3.9 + 0.05 * c + 0.01 * trial + 0.04 * stack
                layer.record["settings"] |= {"condition": condition, "trial": f"t{trial}"}
                layer.write(folder / "stacks" / condition / f"t{trial}" / f"s{stack}")
    (folder / "run.json").write_text(
        json.dumps({"settings": {"condition": [{"name": "untreated"}, {"name": "low nutrient"}]}})
    )
    return folder


def write_sweep(folder: Path) -> Path:
    """A grid of two v0, two eta and two phi with two seeds each."""
    for phi in (0.95, 0.97):
        for v0 in (0.01, 0.03):
            for eta in (0.01, 0.03):
                for seed in (1, 2):
                    layer = make_layer(
                        seed=seed, n_frames=3, side=5, size=80, simulated=True, tau=6 * phi / v0
                    )
                    layer.summary["shape_index"]["mean"] = 3.7 + 3 * v0 - eta + 0.01 * seed
                    scene = {"phi": phi, "v0": v0, "eta": eta}
                    layer.record["settings"] |= {"scene": scene, "seed": seed}
                    layer.write(folder / f"{phi}-{v0}-{eta}" / f"seed-{seed}")
    return folder


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    return write_study(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("sweep"))


def number(value: float, error: float, **more: object) -> Matched:
    return Matched("key", "label", value, error, "rule", **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [
        (number(3.9, 0.01), number(3.92, 0.01), AGREE),
        (number(3.9, 0.01), number(3.94, 0.01), DIFFER),
        (number(3.9, 0.0), number(3.9, 0.0), NOT_COMPARABLE),
        (number(3.9, math.nan), number(3.9, 0.1), NOT_COMPARABLE),
        (number(math.nan, 0.1), number(3.9, 0.1), NOT_COMPARABLE),
        (number(3.9, 0.1, reason="no"), number(3.9, 0.1), NOT_COMPARABLE),
        (number(1.0, 0.1, interval=0.1), number(1.0, 0.1, interval=0.12), AGREE),
        (number(1.0, 0.1, interval=0.1), number(1.0, 0.1, interval=0.3), NOT_COMPARABLE),
    ],
)
def test_verdicts(first: Matched, second: Matched, verdict: str) -> None:
    found = judge(first, second)
    assert found.verdict == verdict
    assert bool(found.reason) == (verdict == NOT_COMPARABLE)


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(0.01, 5), st.floats(0.01, 5))
def test_verdict_does_not_depend_on_the_order(a: float, b: float, s: float, t: float) -> None:
    one, other = judge(number(a, s), number(b, t)), judge(number(b, t), number(a, s))
    assert one.verdict == other.verdict
    assert one.difference == -other.difference


def test_two_observables_in_one_line_as_the_readme_promises(movie, model, tmp_path: Path) -> None:
    comparison = cq.compare(movie.result("movie"), model.result("model"))
    comparison.to_html(tmp_path / "report.html")
    comparison.to_json(tmp_path / "comparison.json")
    again = cq.compare(movie.result("movie"), model.result("model"))
    again.to_html(tmp_path / "again.html")
    again.to_json(tmp_path / "again.json")
    for name in ("report.html", "comparison.json"):
        twin = name.replace("report", "again").replace("comparison", "again")
        assert (tmp_path / name).read_bytes() == (tmp_path / twin).read_bytes()
    content = json.loads((tmp_path / "comparison.json").read_text())
    (pair,) = content["pairs"]
    verdicts = {v["key"]: v["verdict"] for v in pair["verdicts"]}
    assert verdicts["shape_index.mean"] == DIFFER
    assert verdicts["van_hove.sigma2"] == AGREE
    assert verdicts["tau_alpha.value"] == NOT_COMPARABLE
    page = (tmp_path / "report.html").read_text()
    assert len(page) < 1_000_000
    ids = re.findall(r' id="([^"]*)"', page)
    assert len(ids) == len(set(ids))


def test_matched_drawings_share_their_axes(movie, model, tmp_path: Path) -> None:
    cq.compare(movie.result("movie"), model.result("model")).to_html(tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    for figure in ("shape-index", "self-intermediate-scattering", "van-hove"):
        labels = []
        for side in (1, 2):
            start = page.index(f'data-name="{figure}-{side}"')
            drawing = page[start : page.index("</svg>", start)]
            texts = re.findall(r"<text[^>]*x=\"([\d.]*)\" y=\"([\d.]*)\"[^>]*>([^<]*)<", drawing)
            bottom = [t for t in texts if float(t[1]) > 150]
            labels.append(bottom)
        assert labels[0] == labels[1]
        assert labels[0]


def test_unit_mapping_makes_diameters_and_relaxation_times_coincide(movie, model) -> None:
    first, second = read_groups([movie.result("a"), model.result("b")])
    mapping = unit_mapping(first, second)
    assert mapping is not None
    d = [layer.summary["wave_number"]["mean_diameter"] for layer in (movie, model)]
    assert mapping.length == pytest.approx(d[0] / d[1])
    assert mapping.length_error == pytest.approx(mapping.length * math.hypot(0.004, 0.004))
    assert mapping.time == pytest.approx(40 / 200)
    assert mapping.time_error == pytest.approx(mapping.time * math.hypot(0.06, 0.06))
    assert unit_mapping(second, first) is None


def test_numbers_with_a_unit_stand_in_the_units_of_both_sides(movie, model) -> None:
    comparison = cq.compare(movie.result("a"), model.result("b"))
    (pair,) = comparison.pairs()
    section = units_section(comparison, [(*pair, comparison.verdicts(*pair))])
    assert section is not None
    table = next(t for t in section.tables if t.name == "both-systems-1")
    rows = table.data.set_index("quantity")
    mapping = unit_mapping(*pair)
    assert mapping is not None
    speeds = [layer.summary["speed"] for layer in (movie, model)]
    unit = mapping.length / mapping.time
    spread = math.hypot(mapping.length_error / mapping.length, mapping.time_error / mapping.time)
    row = rows.loc["speed.mean"]
    assert (row["unit"], row["model_unit"]) == ("µm/min", "L0/t0")
    assert row["experiment"] == pytest.approx(speeds[0]["mean"])
    assert row["experiment_in_model_unit"] == pytest.approx(speeds[0]["mean"] / unit)
    assert row["simulation_in_model_unit"] == pytest.approx(speeds[1]["mean"])
    assert row["simulation"] == pytest.approx(speeds[1]["mean"] * unit)
    for side, speed in (("experiment_in_model_unit", speeds[0]), ("simulation", speeds[1])):
        own = speed["std_error"] / speed["mean"]
        told = row[f"{side}_std_error"] / row[side]
        assert told == pytest.approx(math.hypot(own, spread))
    # Densities are shown per mm^2, the model's per L0^2.
    density = rows.loc["density.mean"]
    assert density["experiment_in_model_unit"] == pytest.approx(
        density["experiment"] * 1e-6 * mapping.length**2
    )
    assert not {"tau_alpha.value", "wave_number.mean_diameter"} & set(rows.index)


def test_a_bound_is_named_as_the_reason() -> None:
    bound = number(math.nan, math.nan, reason="only a bound is known, > 5 t0")
    known = number(3.0, 0.1, reason="it sets the unit")
    for verdict in (judge(known, bound), judge(bound, known)):
        assert verdict.reason == bound.reason


def test_a_group_that_relaxes_in_part_is_drawn_in_its_own_time(movie, model) -> None:
    summary = {**movie.summary, "tau_alpha": {"value": None, "censored_at": 70.0}}
    slow = replace(movie.result("slow"), summary=summary)
    figure = scattering_figure(read_groups([slow, model.result("b")]))
    assert figure is not None
    table = movie.tables["self_intermediate_scattering"]
    drawn = figure.data[figure.data["result"] == "Experiment: slow"]
    # The curve passes 1/e at 1.
    at_one = np.interp(1.0, drawn["lag_over_tau_alpha"], drawn["value"])
    assert at_one == pytest.approx(math.exp(-1), abs=1e-6)
    scale = table["lag_time"].to_numpy() / drawn["lag_over_tau_alpha"].to_numpy()
    np.testing.assert_allclose(scale, scale[0])


def test_pages_with_large_layers_hold_fewer_moments() -> None:
    assert [n_moments(n) for n in (0, 600, 6000, 60_000)] == [5, 5, 2, 1]


def test_effective_packing_fraction_is_that_of_the_area_and_of_the_scene(movie, model) -> None:
    groups = read_groups([movie.result("a"), model.result("b")])
    ours, theirs = (matched_scalars(g, area=STERIC_AREA)["packing_fraction"] for g in groups)
    density = movie.summary["density"]["mean"]
    assert ours.value == pytest.approx(density * 450)
    assert ours.std_error == pytest.approx(ours.value * math.hypot(0.01, STERIC_AREA[1] / 450))
    assert theirs.value == 0.97


def test_trials_are_the_unit_of_replication(study: Path) -> None:
    untreated, low = read_groups([study])
    assert [g.name for g in (untreated, low)] == ["untreated", "low nutrient"]
    assert untreated.n == 3
    assert len(untreated.members) == 4
    mean = untreated.scalars()["shape_index.mean"]
    trials = np.array([3.9 + 0.02, 3.91, 3.92])  # the first trial has two stacks
    assert mean.value == pytest.approx(trials.mean())
    assert mean.std_error == pytest.approx(trials.std(ddof=1) / math.sqrt(3))
    assert mean.n == "3 trials"


def test_one_censored_trial_leaves_only_a_bound(study: Path, tmp_path: Path) -> None:
    layer = make_layer(n_frames=3, side=5, size=80)
    layer.summary["tau_alpha"] = {"value": None, "std_error": None, "censored_at": 500.0}
    groups = []
    for trial, tau in (("a", 700.0), ("b", None)):
        layer.summary["tau_alpha"]["value"] = tau
        layer.record["settings"] |= {"condition": "c", "trial": trial}
        layer.write(tmp_path / "stacks" / trial)
    (group,) = groups or read_groups([tmp_path])
    tau = group.scalars()["tau_alpha.value"]
    assert math.isnan(tau.value)
    assert tau.censored_at == 600.0  # no less than the mean of 700 and the bound
    assert "1 not reached" in tau.n


def test_a_whole_study_is_made_again_by_one_command(study: Path, movie, tmp_path: Path) -> None:
    folder = tmp_path / "a study"
    shutil.copytree(study, folder)
    record = json.loads((folder / "run.json").read_text())
    record |= {"command": "run", "inputs": {"hela.toml": "0"}}
    (folder / "run.json").write_text(json.dumps(record))
    alone = movie.write(tmp_path / "alone")
    cq.compare(folder, alone).to_html(tmp_path / "r.html")
    page = html.unescape((tmp_path / "r.html").read_text())
    commands = page.split('aria-label="Commands">')[1].split("</pre>")[0].splitlines()
    assert commands[0] == f"cellquant run hela.toml -o {shlex.quote(str(folder))}"
    assert commands[-1].startswith("cellquant compare")
    assert not any("stacks" in line for line in commands[1:-1])


def test_a_bound_stands_where_a_number_was_not_reached(movie, model, tmp_path: Path) -> None:
    slow = model.result("slow")
    slow.summary["tau_alpha"] = {"value": None, "std_error": None, "censored_at": 512.0}
    cq.compare(movie.result("movie"), slow).to_html(tmp_path / "r.html")
    row = (tmp_path / "r.html").read_text().split("Relaxation time τ<sub>α</sub></th>")[1]
    assert "&gt; 512 t<sub>0</sub>" in row.split("</tr>")[0]


def test_study_against_sweep(study: Path, sweep: Path, tmp_path: Path) -> None:
    comparison = cq.compare(study, sweep)
    assert len(comparison.experiments) == 2
    assert len(comparison.simulations) == 8
    assert all(group.n == 2 for group in comparison.simulations)
    comparison.to_html(tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert len(page) < 3_000_000
    assert 'id="map-mean-shape-index"' in page
    assert 'id="relaxation-times"' in page
    assert "8 simulated scenes (16 runs)" in page
    assert f"cellquant compare {shlex.quote(str(study))} {shlex.quote(str(sweep))}" in (
        html.unescape(page)
    )
    content = comparison.as_dict()
    assert len(content["pairs"]) == 16
    json.dumps(content, allow_nan=False)


def test_figures_show_the_scenes_that_agree_most(movie, tmp_path: Path) -> None:
    def scene(number: int) -> Result:
        shape = 4.4 - 0.1 * number
        layer = make_layer(seed=number, n_frames=3, side=5, size=80, simulated=True, shape=shape)
        layer.summary["shape_index"]["mean"] = shape
        layer.record["settings"] |= {"scene": {"phi": 0.9, "v0": 0.01 * (number + 1), "eta": 0.01}}
        return layer.result(f"scene {number}")

    comparison = cq.compare(movie.result("movie"), *map(scene, range(8)))
    share = dict.fromkeys((group.name for group in comparison.simulations), 0.0)
    for pair in comparison.as_dict()["pairs"]:
        judged = [v for v in pair["verdicts"] if v["verdict"] != NOT_COMPARABLE]
        agree = sum(v["verdict"] == AGREE for v in judged)
        share[pair["second"]] += agree / len(judged) if judged else 0.0
    assert len(set(share.values())) > 1
    comparison.to_html(tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Simulation (6 of 8)" in page
    data = re.search(r'download="shape-index.csv" href="data:text/csv[^,]*,([^"]*)"', page)
    assert data is not None
    numbers = unquote(data.group(1))
    shown = [name for name in share if f"{name}," in numbers]
    assert len(shown) == 6
    hidden = [share[name] for name in share if name not in shown]
    assert min(share[name] for name in shown) >= max(hidden)


def test_experiments_alone_and_simulations_alone(study: Path, sweep: Path, tmp_path: Path) -> None:
    for source, title in ((study, "Experiments side by side"), (sweep, "Simulations side by side")):
        comparison = cq.compare(source)
        assert len(comparison.pairs()) == len(comparison.groups) - 1
        comparison.to_html(tmp_path / "r.html")
        assert f"<title>{title}</title>" in (tmp_path / "r.html").read_text()


def test_folder_brings_its_trajectories(movie, model, tmp_path: Path) -> None:
    folder = movie.write(tmp_path / "movie")
    movie.tracks.write(folder / "tracks.parquet")
    cq.compare(folder, model.result("model")).to_html(tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    for view in ("whole", "close"):
        assert f'data-name="paths-{view}-1"' in page
        assert f'data-name="paths-{view}-2"' in page


def test_scene_is_found_in_the_run_behind_a_folder(tmp_path: Path) -> None:
    scene = cq.Scene(phi=0.8, v0=0.05, eta=0.02, n_cells=9)
    cq.simulate(scene, duration=4, output=tmp_path / "RUN.zarr")
    for number in (1, 2):
        observe_source(tmp_path / "RUN.zarr", tmp_path / f"o{number}", only=["shape_index"])
    first, second = read_groups([tmp_path / "o1", tmp_path / "o2"])
    assert dict(first.scene) == {"phi": 0.8, "v0": 0.05, "eta": 0.02}
    assert (first.name, second.name) == (
        "φ = 0.8, v₀ = 0.05, η = 0.02", "φ = 0.8, v₀ = 0.05, η = 0.02 (o2)",
    )  # fmt: skip
    verdicts = cq.compare(tmp_path / "o1", tmp_path / "o2").verdicts(first, second)
    assert all(v.verdict != DIFFER for v in verdicts)


def test_samples_and_units_stand_beside_the_numbers(study: Path, model, tmp_path: Path) -> None:
    comparison = cq.compare(study, model.result("model"))
    comparison.to_html(tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    text = html.unescape(re.sub("<.*?>", "", page)).replace("\N{NO-BREAK SPACE}", " ")
    assert "3 trials" in text
    assert "1 run" in text
    tau = comparison.groups[0].scalars()["tau_alpha.value"]
    assert f"{format_value(tau.value, tau.std_error)} min" in text


def crowded(layer, bins: dict[float, float]):
    """A result with F_s = exp(-t/tau) in the windows of each density bin."""
    lag = np.arange(1.0, 200.0, 2.0)
    rows = [
        pd.DataFrame({"lag_time": lag, "value": np.exp(-lag / tau), "std_error": 0.01,
                      "n_pairs": 9, "scope": "window", "bin_centre": centre})
        for centre, tau in bins.items()
    ]  # fmt: skip
    result = layer.result("movie")
    tables = {**result.tables, "self_intermediate_scattering": pd.concat(rows)}
    return replace(result, tables=tables)


def test_scattering_against_crowding(movie, sweep: Path) -> None:
    trials = {
        "a": (crowded(movie, {1100.0: 40.0, 1600.0: 80.0}),),
        "b": (crowded(movie, {1100.0: 44.0}),),
    }
    group = Group("untreated", False, trials, {})
    figure = crowding_figure(Comparison((group, *read_groups([sweep]))))
    assert figure is not None
    assert [panel.title.split(":")[0] for panel in figure.panels] == ["Experiment", "Simulation"]
    assert figure.data is not None
    named = figure.data.groupby("result")["std_error"].first()
    assert any("1100 (n = 2)" in name for name in named.index)
    assert any("1600 (n = 1)" in name for name in named.index)
    # In units of the relaxation time at 1100: there the mean curve crosses 1/e at one.
    curve = figure.data[figure.data["result"].str.contains("1100")]
    crossing = np.interp(-np.exp(-1), -curve["value"], curve["lag_over_tau_alpha"])
    assert crossing == pytest.approx(1.0, abs=1e-3)
    assert crowding_figure(Comparison((Group("one bin", False, {
        "b": (crowded(movie, {1100.0: 44.0}),)}, {}),))) is None  # fmt: skip


def test_what_is_refused(movie, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs two or more"):
        cq.compare(movie.result("a"))
    with pytest.raises(InputError, match=r"holds no summary\.json, nor does any folder below"):
        cq.compare(movie.result("a"), tmp_path)
    with pytest.raises(InputError, match="3 names are given for 2 results"):
        cq.compare(movie.result("a"), movie.result("b"), names=["x", "y", "z"])
    with pytest.raises(InputError, match="steric_area must be > 0"):
        cq.compare(movie.result("a"), movie.result("b"), steric_area=(0.0, 1.0))


def test_the_command_that_makes_the_page_again_names_what_was_given() -> None:
    def command(**options: object) -> list[str]:
        made = {"sources": ["a study", "sweep"], "steric_area": list(STERIC_AREA), **options}
        return shlex.split(command_of(Comparison((), settings=made)))

    plain = ["cellquant", "compare", "a study", "sweep", "-o", "report.html"]
    assert command(fit=False) == plain
    assert command(fit=True, seed=3, units=None) == [*plain, "--fit", "--seed", "3"]
    given = command(fit=True, seed=3, units="my units.toml")
    assert given == [*plain, "--fit", "--seed", "3", "--units", "my units.toml"]
    assert command(fit=False, steric_area=[300.0, 20.5])[-3:] == ["--steric-area", "300", "20.5"]
    assert command(fit=True, seed=0, units="in memory") == []


def test_same_names_are_told_apart(movie) -> None:
    groups = read_groups([movie.result("a"), movie.result("a")])
    assert [g.name for g in groups] == ["a", "a (2)"]


def test_equal_results_agree_in_everything_that_is_judged(movie) -> None:
    comparison = cq.compare(movie.result("a"), movie.result("b"))
    verdicts = comparison.verdicts(*comparison.groups)
    judged = [v for v in verdicts if v.verdict != NOT_COMPARABLE]
    assert len(judged) > 5
    assert all(v.verdict == AGREE for v in judged)
