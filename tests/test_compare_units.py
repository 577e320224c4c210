"""Measured quantities to reduced parameters and back: the worked example, errors, refusals."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellquant.compare.units import (
    convert_units,
    convert_units_file,
    packing_fraction_of,
    render_units,
)
from cellquant.errors import InputError

# The order-of-magnitude mapping of Pal, Saito, Kawasaki & Ebata.
EXAMPLE = """
[measured]
gamma = 1e-4
Y = { value = 1, unit = "kPa", std_error = 0.1 }
L0 = 10
mu_r = 10
v0 = { value = 5e-9, unit = "m/s" }
D_r = 1e-3
tau_alpha = { value = 1, unit = "h" }
"""


def test_worked_example_of_the_source(tmp_path: Path) -> None:
    path = tmp_path / "units.toml"
    path.write_text(EXAMPLE)
    found = convert_units_file(path)
    reduced = {name: q["value"] for name, q in found["reduced"].items()}
    assert reduced == pytest.approx({"eta": 0.01, "v0": 5e-3, "D_r": 0.01, "tau_alpha": 360.0})
    assert found["measured"]["t0"]["value"] == pytest.approx(10.0)
    assert found["measured"]["v0"]["value"] == pytest.approx(0.3)
    assert 100 <= convert_units(
        measured={"tau_alpha": 24.0, "t0": 10.0}
    ).quantities["reduced.tau_alpha"].value <= 400  # fmt: skip
    json.dumps(found, allow_nan=False)


def test_errors_follow_the_powers_even_through_t0(tmp_path: Path) -> None:
    path = tmp_path / "units.toml"
    path.write_text(EXAMPLE)
    found = convert_units_file(path)
    # Y enters t0, v0*, D_r*, tau* and eta* with the power -1 or +1.
    for q in (*found["reduced"].values(), found["measured"]["t0"]):
        assert q["std_error"] == pytest.approx(0.1 * q["value"])
    # L0 enters v0* = v0/(mu_r Y L0^2) squared, and not as sqrt(1 + 1).
    length = convert_units(
        measured={"L0": {"value": 10, "std_error": 0.5}, "Y": 1e3, "mu_r": 10, "v0": 0.3}
    )
    assert length.quantities["reduced.v0"].std_error == pytest.approx(2 * 0.05 * 5e-3)


def test_errors_agree_with_random_draws() -> None:
    rng = np.random.default_rng(1)
    values = {"gamma": 1e-4, "Y": 1e3, "L0": 10.0, "mu_r": 10.0, "v0": 0.3}
    found = convert_units(
        measured={n: {"value": v, "std_error": 0.02 * v} for n, v in values.items()}
    )
    draw = {n: v * (1 + 0.02 * rng.standard_normal(200_000)) for n, v in values.items()}
    t0 = 1 / (draw["mu_r"] * draw["Y"] * draw["L0"] * 1e-6)
    sampled = {
        "reduced.v0": draw["v0"] * 1e-6 / 60 * t0 / (draw["L0"] * 1e-6),
        "reduced.eta": draw["gamma"] / (draw["Y"] * draw["L0"] * 1e-6),
        "measured.t0": t0,
    }
    for name, sample in sampled.items():
        assert found.quantities[name].std_error == pytest.approx(sample.std(), rel=0.02)


positive = st.floats(1e-3, 1e3)


@given(positive, positive, positive, positive, positive, positive, positive)
def test_there_and_back_again(
    gamma: float, y: float, l0: float, mu: float, v0: float, dr: float, tau: float
) -> None:
    measured = {"gamma": gamma, "Y": y, "L0": l0, "mu_r": mu, "v0": v0, "D_r": dr, "tau_alpha": tau}
    there = convert_units(measured=measured)
    reduced = {
        name.split(".")[1]: q.value
        for name, q in there.quantities.items()
        if name.startswith("reduced")
    }
    scales = {name: measured[name] for name in ("Y", "L0", "mu_r")}
    back = convert_units(measured=scales, reduced=reduced)
    for name, value in measured.items():
        assert back.quantities[f"measured.{name}"].value == pytest.approx(value, rel=1e-9)
    assert not there.checks
    assert not back.checks


def test_relaxation_times_of_both_sides_fix_the_unit_of_time() -> None:
    found = convert_units(
        measured={"tau_alpha": {"value": 60.0, "std_error": 6.0}, "L0": 20.0},
        reduced={"tau_alpha": {"value": 300.0, "std_error": 15.0}, "v0": 0.03},
    )
    t0 = found.quantities["measured.t0"]
    assert t0.value == pytest.approx(12.0)
    assert t0.std_error == pytest.approx(12.0 * math.hypot(0.1, 0.05))
    assert t0.source == "tau_alpha = tau_alpha* t0"
    assert found.quantities["measured.v0"].value == pytest.approx(0.03 * 20 / 12 * 60)
    assert "measured.gamma" in found.missing


@pytest.mark.parametrize(("tau", "agrees"), [(360.0, True), (380.0, True), (700.0, False)])
def test_too_many_given_quantities_are_checked(tau: float, agrees: bool) -> None:
    found = convert_units(
        measured={"t0": {"value": 10.0, "std_error": 1.0}, "tau_alpha": 60.0},
        reduced={"tau_alpha": tau},
    )
    (check,) = found.checks
    assert check["agrees"] is agrees
    assert ("DOES NOT AGREE" in render_units(found.as_dict())) is not agrees


def test_density_becomes_an_effective_packing_fraction() -> None:
    phi, error = packing_fraction_of(2000.0, 0.0)
    assert phi == pytest.approx(0.9)
    assert error == pytest.approx(2000e-6 * 100 / math.sqrt(12))
    assert packing_fraction_of(2000.0, 60.0)[1] > error
    found = convert_units(measured={"density": 2000, "cell_area": 450})
    assert found.quantities["reduced.phi"].value == pytest.approx(0.9)
    assert packing_fraction_of(0.0) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[measured]\ngama = 1", "unknown key 'measured.gama'"),
        ("[mesured]\ngamma = 1", "unknown key 'mesured'"),
        ("[measured]\nY = -5", "measured.Y.value"),
        ("[measured]\nY = 0", "measured.Y.value"),
        ("[measured]\nY = nan", "measured.Y.value"),
        ("[measured]\nY = true", "measured.Y"),
        ('[measured]\nY = "1 kPa"', "measured.Y"),
        ('[measured]\nL0 = { value = 1, unit = "inch" }', "unit of 'measured.L0' is 'inch'"),
        ("[measured]\nL0 = { value = 1, error = 2 }", "unknown key 'measured.L0.error'"),
        ("", "nothing is given"),
        ("[measured", "not valid TOML"),
    ],
)
def test_wrong_files_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "units.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r".*") as caught:
        convert_units_file(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_text_shows_every_quantity_and_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "units.toml"
    path.write_text("[measured]\nL0 = 10\nY = 1000\n[reduced]\neta = 0.01\n")
    text = render_units(convert_units_file(path))
    assert "gamma" in text
    assert "eta* = gamma/(Y L0)" in text
    assert "no measured.mu_r: give it, or measured.t0" in text
