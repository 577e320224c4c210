"""Measured quantities to the reduced parameters of the model, and back, with their errors.

The model has three scales: the length L0 (mean cell diameter 2 Rbar), the stiffness against
overlap k = Y L0 and the mobility mu_r. All relations are products of powers,

    t0 = 1 / (mu_r Y L0),   eta* = gamma / (Y L0),   v0* = v0 t0 / L0,   D_r* = D_r t0,
    tau_alpha* = tau_alpha / t0,   phi = density x cell area,

so each can be solved for whatever is missing, and errors follow from the powers with which the
given values enter, each of them once, however long the way from them to the result.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from cellquant.config import Positive, read_toml, validate
from cellquant.errors import InputError

# Units that a file may use, as factors to the unit in which results are given (the first one).
_UNITS: dict[str, dict[str, float]] = {
    "measured.L0": {"um": 1.0, "nm": 1e-3, "mm": 1e3, "m": 1e6},
    "measured.Y": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6},
    "measured.gamma": {"N/m": 1.0, "mN/m": 1e-3, "uN/m": 1e-6},
    "measured.mu_r": {"m/(N s)": 1.0, "um/(nN s)": 1e3, "um/(N s)": 1e-6},
    "measured.t0": {"s": 1.0, "min": 60.0, "h": 3600.0},
    "measured.v0": {"um/min": 1.0, "um/s": 60.0, "um/h": 1 / 60, "nm/s": 0.06, "m/s": 6e7},
    "measured.D_r": {"1/s": 1.0, "1/min": 1 / 60, "1/h": 1 / 3600},
    "measured.tau_alpha": {"min": 1.0, "s": 1 / 60, "h": 60.0},
    "measured.density": {"1/mm^2": 1.0, "1/um^2": 1e6, "1/cm^2": 1e-2},
    "measured.cell_area": {"um^2": 1.0, "mm^2": 1e6, "m^2": 1e12},
    "reduced.eta": {"k L0": 1.0},
    "reduced.v0": {"L0/t0": 1.0},
    "reduced.D_r": {"1/t0": 1.0},
    "reduced.tau_alpha": {"t0": 1.0},
    "reduced.phi": {"": 1.0},
}
# Each law: the product of these powers, with every value in SI units, is one.
_LAWS: tuple[tuple[str, dict[str, int]], ...] = (
    ("t0 = 1/(mu_r Y L0)",
     {"measured.t0": 1, "measured.mu_r": 1, "measured.Y": 1, "measured.L0": 1}),
    ("tau_alpha = tau_alpha* t0",
     {"measured.tau_alpha": -1, "reduced.tau_alpha": 1, "measured.t0": 1}),
    ("D_r* = D_r t0", {"reduced.D_r": -1, "measured.D_r": 1, "measured.t0": 1}),
    ("v0* = v0 t0/L0",
     {"reduced.v0": -1, "measured.v0": 1, "measured.t0": 1, "measured.L0": -1}),
    ("eta* = gamma/(Y L0)",
     {"reduced.eta": -1, "measured.gamma": 1, "measured.Y": -1, "measured.L0": -1}),
    ("phi = density cell_area",
     {"reduced.phi": -1, "measured.density": 1, "measured.cell_area": 1}),
)  # fmt: skip
_TO_SI = {
    "measured.L0": 1e-6, "measured.v0": 1e-6 / 60, "measured.tau_alpha": 60.0,
    "measured.density": 1e6, "measured.cell_area": 1e-12,
}  # fmt: skip
# Steric area of a HeLa cell in a dense layer, um^2: anywhere from 400 to 500 (no value of the
# range is preferred, so the standard error is that of a uniform distribution).
STERIC_AREA = (450.0, 100.0 / math.sqrt(12.0))


class Given(BaseModel):
    """A quantity as it stands in a file: a number, or a table with error and unit."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    value: Positive
    std_error: float = Field(0.0, ge=0, allow_inf_nan=False)
    unit: str | None = None


class _Side(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*", mode="before")
    @classmethod
    def _number_or_table(cls, given: Any) -> Any:
        plain = isinstance(given, int | float) and not isinstance(given, bool)
        return {"value": given} if plain else given


class Measured(_Side):
    """Quantities with units."""

    L0: Given | None = None
    Y: Given | None = None
    gamma: Given | None = None
    mu_r: Given | None = None
    t0: Given | None = None
    v0: Given | None = None
    D_r: Given | None = None
    tau_alpha: Given | None = None
    density: Given | None = None
    cell_area: Given | None = None


class Reduced(_Side):
    """Parameters and results of the model."""

    eta: Given | None = None
    v0: Given | None = None
    D_r: Given | None = None
    tau_alpha: Given | None = None
    phi: Given | None = None


class UnitsFile(BaseModel):
    """The whole of a units file: tables ``[measured]`` and ``[reduced]``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    measured: Measured = Measured()
    reduced: Reduced = Reduced()


@dataclass(frozen=True)
class Quantity:
    """A value with its error, and how it came about.

    Attributes
    ----------
    value, std_error
        In `unit`.
    unit
        Unit of the value; reduced quantities are in L0, t0 and k.
    source
        ``given``, or the law that it follows from.
    powers
        Powers with which the given quantities enter.
    """

    value: float
    std_error: float
    unit: str
    source: str
    powers: Mapping[str, float]


@dataclass(frozen=True)
class Conversion:
    """Everything that follows from the given quantities.

    Attributes
    ----------
    quantities
        By name, ``measured.NAME`` or ``reduced.NAME``.
    checks
        Laws between given quantities that leave nothing to solve for: by how much they miss.
    missing
        Name of each quantity that does not follow, and what it would take.
    """

    quantities: Mapping[str, Quantity]
    checks: tuple[Mapping[str, Any], ...]
    missing: Mapping[str, str]

    def as_dict(self) -> dict[str, Any]:
        """JSON-serialisable: measured, reduced, checks, missing."""
        sides: dict[str, dict[str, Any]] = {"measured": {}, "reduced": {}}
        for name, quantity in self.quantities.items():
            side, key = name.split(".")
            sides[side][key] = {
                "value": quantity.value,
                "std_error": quantity.std_error,
                "unit": quantity.unit,
                "source": quantity.source,
            }
        return {**sides, "checks": [dict(c) for c in self.checks], "missing": dict(self.missing)}


def convert_units(
    *,
    measured: Mapping[str, float | Mapping[str, Any]] | None = None,
    reduced: Mapping[str, float | Mapping[str, Any]] | None = None,
) -> Conversion:
    """Convert measured quantities to reduced parameters, or back.

    Parameters
    ----------
    measured
        Any of L0 (um), Y (Pa), gamma (N/m), mu_r (m/(N s)), t0 (s), v0 (um/min), D_r (1/s),
        tau_alpha (min), density (1/mm^2), cell_area (um^2): a number in the unit named here, or
        a mapping with ``value`` and, where wanted, ``std_error`` and ``unit``.
    reduced
        Any of eta (k L0), v0 (L0/t0), D_r (1/t0), tau_alpha (t0), phi.

    Returns
    -------
    Conversion
        The given quantities and all that follow from them. Standard errors are to first order:
        ``(s/x)^2 = sum_i p_i^2 (s_i/x_i)^2`` over the given quantities, p_i their powers.

    Raises
    ------
    InputError
        If a name or unit is unknown, or a value is not positive.
    """
    content = {"measured": dict(measured or {}), "reduced": dict(reduced or {})}
    return _convert(validate(content, UnitsFile, where="convert_units"), where="convert_units")


def convert_units_file(path: str | Path) -> dict[str, Any]:
    """Convert the quantities of a TOML file with the tables ``[measured]`` and ``[reduced]``.

    Returns
    -------
    dict
        measured, reduced (each NAME: value, std_error, unit, source), checks, missing.

    Raises
    ------
    InputError
        If the file is missing or wrong, names the key.
    """
    config = validate(read_toml(path), UnitsFile, where=str(path))
    return _convert(config, where=str(path)).as_dict()


def _convert(config: UnitsFile, *, where: str) -> Conversion:
    given: dict[str, tuple[float, float]] = {}
    for name, units in _UNITS.items():
        side, key = name.split(".")
        quantity: Given | None = getattr(getattr(config, side), key)
        if quantity is None:
            continue
        unit = next(iter(units)) if quantity.unit is None else quantity.unit
        if unit not in units:
            raise InputError(
                f"{where}: the unit of '{name}' is {unit!r}; use one of "
                f"{', '.join(repr(u) for u in units)}."
            )
        factor = units[unit] * _TO_SI.get(name, 1.0)
        given[name] = (quantity.value * factor, quantity.std_error / quantity.value)
    if not given:
        raise InputError(
            f"{where}: nothing is given; write quantities into [measured] or [reduced], e.g. "
            "L0 = 10 under [measured]."
        )
    return _solve(given)


def _solve(given: Mapping[str, tuple[float, float]]) -> Conversion:
    value = {name: v for name, (v, _) in given.items()}
    powers: dict[str, dict[str, float]] = {name: {name: 1.0} for name in given}
    source = dict.fromkeys(given, "given")
    used: set[str] = set()
    progress = True
    while progress:
        progress = False
        for law, terms in _LAWS:
            unknown = [name for name in terms if name not in value]
            if len(unknown) != 1 or law in used:
                continue
            name = unknown[0]
            known = {n: -p / terms[name] for n, p in terms.items() if n != name}
            value[name] = math.prod(value[n] ** p for n, p in known.items())
            powers[name] = _combine(powers, known)
            source[name] = law
            used.add(law)
            progress = True
            break
    quantities = {}
    for name, units in _UNITS.items():
        if name in value:
            shown = value[name] / _TO_SI.get(name, 1.0)
            error = shown * _relative(powers[name], given)
            quantities[name] = Quantity(shown, error, next(iter(units)), source[name], powers[name])
    checks = tuple(
        _check(law, terms, value, powers, given)
        for law, terms in _LAWS
        if law not in used and all(name in value for name in terms)
    )
    missing = {
        name: " or ".join(
            ", ".join(n for n in terms if n not in value and n != name)
            for _, terms in _LAWS
            if name in terms
        )
        for name in _UNITS
        if name not in value
    }
    return Conversion(quantities, checks, missing)


def _combine(
    powers: Mapping[str, Mapping[str, float]], terms: Mapping[str, float]
) -> dict[str, float]:
    total: dict[str, float] = {}
    for name, power in terms.items():
        for root, inner in powers[name].items():
            total[root] = total.get(root, 0.0) + power * inner
    return total


def _relative(powers: Mapping[str, float], given: Mapping[str, tuple[float, float]]) -> float:
    return math.sqrt(sum((p * given[root][1]) ** 2 for root, p in powers.items()))


def _check(
    law: str,
    terms: Mapping[str, int],
    value: Mapping[str, float],
    powers: Mapping[str, Mapping[str, float]],
    given: Mapping[str, tuple[float, float]],
) -> dict[str, Any]:
    ratio = math.prod(value[name] ** power for name, power in terms.items())
    relative = _relative(_combine(powers, dict(terms)), given)
    miss = abs(math.log(ratio))
    return {
        "law": law,
        "ratio": ratio,
        "std_error": ratio * relative,
        "agrees": miss <= max(2 * relative, 1e-9),
    }


def render_units(converted: Mapping[str, Any]) -> str:
    """Text table of `convert_units_file`, for the terminal."""
    lines = []
    for side, heading in (("measured", "Measured"), ("reduced", "Reduced")):
        lines.append(f"{heading:<12}{'value':>14}{'± error':>14}  {'unit':<10}from")
        for name, q in converted[side].items():
            error = f"{float(format(q['std_error'], '.2g')):g}" if q["std_error"] > 0 else "-"
            lines.append(f"{name:<12}{q['value']:>14.6g}{error:>14}  {q['unit']:<10}{q['source']}")
        lines.append("")
    for check in converted["checks"]:
        verdict = "agrees within errors" if check["agrees"] else "DOES NOT AGREE"
        lines.append(f"check {check['law']}: {verdict}, off by a factor {check['ratio']:.4g}")
    for name, needs in converted["missing"].items():
        lines.append(f"no {name}: give it, or {needs}")
    return "\n".join(lines).rstrip("\n")


def packing_fraction_of(
    density: float, density_error: float = 0.0, *, area: tuple[float, float] = STERIC_AREA
) -> tuple[float, float]:
    """Effective packing fraction of a movie, ``phi = density x steric cell area``.

    There is no one-to-one map: cells that overlap or spread share no area in the model's sense.
    This is a label for ordering the two sides, and its error is mostly that of the area.

    Parameters
    ----------
    density, density_error
        Cells per mm^2 and its standard error.
    area
        Steric area of a cell and its standard error, um^2.

    Returns
    -------
    phi, std_error : float
    """
    phi = density * area[0] * 1e-6
    if phi == 0:
        return 0.0, 0.0
    return phi, phi * math.hypot(density_error / density, area[1] / area[0])
