"""Work-precision: ratios on curves that are known, and a whole measurement of a small scene."""

import json

import numpy as np
import pandas as pd
import pytest

from cellquant.errors import InputError
from cellquant.sim import Scene, convergence
from cellquant.sim.recommendation import recommend


def curve(contact, integrator, points, steps, cost, error, seed):
    """CPU time cost / dt, error as given."""
    return [
        {
            "contact": contact, "points": points, "integrator": integrator, "dt": h,
            "tolerance": np.nan, "seed": seed, "cpu_seconds": cost / h, "error": error(h),
            "shape_error": 0.0, "evaluations": round(4 / h),
        }
        for h in steps
    ]  # fmt: skip


def diagram(seeds=(1, 2, 3)):
    """The published scheme: 0.2 s at 0.005, error 0.01; ours: 0.002 / dt s, error 0.04 dt."""
    rows = []
    for seed in seeds:
        scale = 1.0 + 0.1 * (seed - 2)
        rows += curve("quadrature", "euler", 40, (0.016, 0.008, 0.004), 1e-3, lambda h: 0.01, seed)
        rows += curve(
            "exact", "implicit", 0, (1.0, 0.5, 0.1, 0.02, 0.004), 2e-3,
            lambda h, scale=scale: 0.04 * h * scale, seed,
        )  # fmt: skip
    return pd.DataFrame(rows)


def test_ratios_are_read_off_the_curves():
    found = recommend(diagram(), pd.DataFrame(), "implicit", 40)
    assert found["published_cpu_seconds"]["median"] == pytest.approx(0.2)
    assert found["published_error"]["median"] == pytest.approx(0.01)
    # Error 0.01 at dt 0.25, which costs 8 ms; 0.2 s buy dt 0.01, error 4e-4.
    assert found["dt_at_published_error"]["median"] == pytest.approx(0.25)
    assert found["cpu_ratio"]["median"] == pytest.approx(0.04)
    assert found["dt_at_published_time"]["median"] == pytest.approx(0.01)
    assert found["error_ratio"]["median"] == pytest.approx(0.04)
    assert found["error_ratio"]["least"] == pytest.approx(0.036)
    assert found["error_ratio"]["most"] == pytest.approx(0.044)
    assert "0.04 (0.036 to 0.044)" in found["text"]


def test_what_the_curves_do_not_reach_is_not_claimed():
    table = diagram()
    coarse = (table["integrator"] == "implicit") & (table["dt"] < 0.5)
    found = recommend(table[~coarse], pd.DataFrame(), "implicit", 40)
    assert found["cpu_ratio"] is None
    assert "None of its steps" in found["text"]
    slow = table.copy()
    slow.loc[slow["integrator"] == "implicit", "cpu_seconds"] *= 1e4
    found = recommend(slow, pd.DataFrame(), "implicit", 40)
    assert found["error_ratio"] is None
    assert "no step as quick" in found["text"]
    failed = table.copy()
    failed.loc[failed["contact"] == "quadrature", "error"] = np.nan
    assert "published scheme fails" in recommend(failed, pd.DataFrame(), "implicit", 40)["text"]


def test_a_small_scene_is_measured_whole(tmp_path):
    done = []
    found = convergence(
        Scene(n_cells=16), tmp_path, duration=0.5, transient=2.0, weak_duration=12.8, seeds=(1, 2),
        integrators=("implicit", "adaptive"), progress=lambda n, total: done.append((n, total)),
    )  # fmt: skip
    assert done[-1][0] == done[-1][1] == len(done)
    stored = json.loads((tmp_path / "convergence.json").read_text())
    assert stored["recommendation"]["text"] == found.recommendation["text"]
    assert (tmp_path / "convergence.svg").read_text().startswith("<?xml")
    table = pd.read_parquet(tmp_path / "convergence.parquet")
    assert set(table["integrator"]) == {"implicit", "adaptive", "euler"}
    assert (table["evaluations"] > 0).all()
    assert found.reference_error < 1e-4
    implicit = table[table["integrator"] == "implicit"].groupby("dt")["error"].mean()
    assert implicit.iloc[0] < 0.2 * implicit.iloc[-1]
    published = table[table["contact"] == "quadrature"]["error"].mean()
    assert implicit.iloc[0] < 0.2 * published
    weak = pd.read_parquet(tmp_path / "weak_errors.parquet")
    assert set(weak["observable"]) == {"shape_index", "msd", "scattering", "tau_alpha"}
    shapes = weak[weak["observable"] == "shape_index"]
    assert shapes["difference"].iloc[0] == 0.0
    assert (shapes["sampling_error"] > 0.0).all()
    assert shapes["n"].eq(2).all()
    rows = weak[weak["observable"] == "msd"].set_index(["contact", "integrator", "dt"])
    near = abs(rows.loc[("exact", "euler", 0.01), "difference"])
    assert near < abs(rows.loc[("quadrature", "euler", 0.005), "difference"])


def test_rigid_discs_are_measured_by_explicit_methods():
    scene = Scene(n_cells=9, modes=1, phi=0.8)
    found = convergence(scene, duration=0.5, transient=1.0, weak_duration=0.0, seeds=(1,))
    assert set(found.table["integrator"]) == {"euler", "sra1"}
    assert found.recommendation["integrator"] == "euler"
    assert found.weak.empty


@pytest.mark.parametrize(
    "options",
    [
        {"duration": 0.0}, {"transient": -1.0}, {"weak_duration": -1.0}, {"seeds": ()},
        {"points": ()}, {"integrators": ("magic",)},
    ],
)  # fmt: skip
def test_wrong_options_are_refused(options):
    with pytest.raises(InputError):
        convergence(Scene(n_cells=4), **options)
    with pytest.raises(InputError, match="for this scene"):
        convergence(Scene(n_cells=4, modes=1), integrators=("implicit",))
