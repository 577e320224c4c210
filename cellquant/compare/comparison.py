"""Experiment and simulation side by side: which numbers may be compared, and whether they agree."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant import __version__
from cellquant.compare.groups import Group, read_groups
from cellquant.compare.results import Scalar, look_up
from cellquant.compare.units import STERIC_AREA, packing_fraction_of
from cellquant.errors import InputError
from cellquant.storage import write_json

if TYPE_CHECKING:
    from cellquant.compare.fit import Fit
    from cellquant.compare.ranking import Units

AGREE = "agree within errors"
DIFFER = "differ"
NOT_COMPARABLE = "not comparable"
LEVEL = 2.0  # combined standard errors up to which two values are said to agree

MAX_INTERVAL_RATIO = 1.5  # of the frame intervals of two speeds that may be compared


@dataclass(frozen=True)
class Matched:
    """A number that means the same on both sides, free of units.

    Attributes
    ----------
    key, label
        Its name.
    value, std_error
        NaN where not known.
    reason
        Why it must not be compared, or why it is not known; empty where it may be.
    rule
        How it follows from what was measured.
    interval, smoothing
        Time between frames over tau_alpha, and points of the moving average, for numbers that
        depend on them; NaN otherwise.
    """

    key: str
    label: str
    value: float
    std_error: float
    rule: str
    reason: str = ""
    interval: float = math.nan
    smoothing: float = math.nan


@dataclass(frozen=True)
class Verdict:
    """One number of two groups, held against each other.

    Attributes
    ----------
    key, label
        Its name.
    values
        (first, second), each with value and standard error.
    difference, std_error
        Second minus first, and the errors of both combined.
    verdict
        ``agree within errors``, ``differ`` or ``not comparable``.
    reason
        Why it is not comparable; empty otherwise.
    """

    key: str
    label: str
    values: tuple[Matched, Matched]
    difference: float
    std_error: float
    verdict: str
    reason: str


@dataclass(frozen=True)
class UnitMapping:
    """What one unit of the model is in the movie.

    Attributes
    ----------
    length, length_error
        um (or the movie's unit) per L0.
    time, time_error
        min (or the movie's unit) per t0; NaN where not known.
    rule
        How it was chosen.
    """

    length: float
    length_error: float
    time: float
    time_error: float
    rule: str


@dataclass(frozen=True)
class Comparison:
    """Groups of results and what follows from holding them against each other.

    Attributes
    ----------
    groups
        Experiments first.
    area
        Steric cell area and its standard error, um^2, behind the effective packing fraction.
    fits
        Which scenes and parameters match each experiment, where that was asked for.
    """

    groups: tuple[Group, ...]
    area: tuple[float, float] = STERIC_AREA
    fits: "tuple[Fit, ...]" = ()

    @property
    def experiments(self) -> tuple[Group, ...]:
        """Groups measured in movies."""
        return tuple(group for group in self.groups if not group.simulated)

    @property
    def simulations(self) -> tuple[Group, ...]:
        """Groups measured in simulated runs."""
        return tuple(group for group in self.groups if group.simulated)

    def pairs(self) -> list[tuple[Group, Group]]:
        """Each experiment with each simulation; the first group with the others where all are
        of one kind."""
        if self.experiments and self.simulations:
            return [(e, s) for e in self.experiments for s in self.simulations]
        return [(self.groups[0], other) for other in self.groups[1:]]

    def verdicts(self, first: Group, second: Group) -> list[Verdict]:
        """Hold every number that both groups have against each other."""
        ours, theirs = (matched_scalars(g, area=self.area) for g in (first, second))
        keys = [key for key in ours if key in theirs]
        return [judge(ours[key], theirs[key]) for key in keys]

    def as_dict(self) -> dict[str, Any]:
        """JSON-serialisable: everything that the page shows as numbers, except the curves."""
        return {
            "program": "cellquant",
            "version": __version__,
            "level": LEVEL,
            "steric_area": {"value": self.area[0], "std_error": self.area[1], "unit": "um^2"},
            "groups": [_group_dict(group, self.area) for group in self.groups],
            "pairs": [
                {
                    "first": first.name,
                    "second": second.name,
                    "unit_mapping": _mapping_dict(unit_mapping(first, second)),
                    "verdicts": [_verdict_dict(v) for v in self.verdicts(first, second)],
                }
                for first, second in self.pairs()
            ],
            "fits": [fit.as_dict() for fit in self.fits],
        }

    def to_json(self, path: str | Path) -> None:
        """Write ``comparison.json``; equal comparisons give equal bytes."""
        write_json(path, self.as_dict())

    def to_html(self, path: str | Path) -> None:
        """Write the report as one self-contained page; equal comparisons give equal bytes."""
        from cellquant.compare.comparison_page import build_comparison
        from cellquant.compare.page import write_page

        write_page(build_comparison(self), path)


def compare(
    *sources: Any,
    names: Sequence[str] | None = None,
    steric_area: tuple[float, float] = STERIC_AREA,
    fit: bool = False,
    units: "Units | None" = None,
    seed: int = 0,
) -> Comparison:
    """Hold experiments and simulations against each other.

    Parameters
    ----------
    *sources
        Two or more of: observables in memory, results (`cellquant.compare.results.read_result`),
        folders of `observe`; or folders of a whole experiment or sweep, which count as many.
    names
        A name for each source.
    steric_area
        Area that a cell takes in a dense layer and its standard error, um^2; by default that of
        HeLa cells, anywhere from 400 to 500.
    fit
        Whether to rank the simulated scenes and estimate phi, v0 and eta for each experiment (for
        the first group where all are simulated).
    units
        L0 and t0 in the experiments' units, for the fit; pure numbers only when None.
    seed
        Seed of the fit.

    Returns
    -------
    Comparison
        With ``to_html(path)`` and ``to_json(path)``.

    Raises
    ------
    InputError
        If fewer than two results are found, or one cannot be read.
    """
    groups = read_groups(sources, names=names)
    if len(groups) < 2:
        raise InputError(
            f"{len(groups)} result is given and a comparison needs two or more; "
            "add a folder of another experiment or simulation."
        )
    if not (steric_area[0] > 0 and steric_area[1] >= 0):
        raise InputError(f"steric_area must be > 0 um^2 with an error >= 0, got {steric_area}.")
    comparison = Comparison(tuple(groups), steric_area)
    if not fit:
        return comparison
    from cellquant.compare.fit import fit_groups

    return replace(comparison, fits=tuple(fit_groups(comparison, units=units, seed=seed)))


def judge(first: Matched, second: Matched) -> Verdict:
    """Agreement within two combined standard errors, where the two may be compared at all."""
    difference = second.value - first.value
    error = math.hypot(first.std_error, second.std_error)
    reason = first.reason or second.reason
    if abs(math.log(first.interval / second.interval)) > math.log(MAX_INTERVAL_RATIO):
        reason = reason or (
            f"it depends on the frame interval, which is {first.interval:.2g} τ_{{α}} on one side "
            f"and {second.interval:.2g} τ_{{α}} on the other"
        )
    if abs(first.smoothing - second.smoothing) > 0:
        reason = reason or (
            f"it depends on the smoothing, {first.smoothing:g} points on one side and "
            f"{second.smoothing:g} on the other"
        )
    if not reason and not math.isfinite(difference):
        reason = "one side is not known"
    if not reason and not (math.isfinite(error) and error > 0):
        reason = "an error is not known"
    if reason:
        verdict = NOT_COMPARABLE
    else:
        verdict = AGREE if abs(difference) <= LEVEL * error else DIFFER
    return Verdict(first.key, first.label, (first, second), difference, error, verdict, reason)


_DIRECT = (
    "shape_index.mean", "shape_index.median", "shape_index.mode", "shape_index.std",
    "shape_index.skewness", "van_hove.sigma2", "van_hove.xi", "msd.exponent", "alpha2_peak.value",
)  # fmt: skip


def matched_scalars(group: Group, *, area: tuple[float, float]) -> dict[str, Matched]:
    """The numbers of a group that carry no unit, or whose unit both sides share.

    Lengths are divided by the mean cell diameter d, times by tau_alpha, and the density of a
    movie becomes an effective packing fraction.
    """
    scalars = group.scalars()
    found = {
        key: Matched(key, scalars[key].label, scalars[key].value, scalars[key].std_error,
                     "as measured", _unknown(scalars[key]))
        for key in _DIRECT
        if key in scalars
    }  # fmt: skip
    found["packing_fraction"] = _packing(group, scalars, area)
    found |= _ratios(group, scalars)
    if "chi4_peak.value" in scalars:
        chi4 = scalars["chi4_peak.value"]
        reason = "χ_{4} grows with the number of cells in view, which differs between the sides"
        found["chi4_peak.value"] = Matched(
            chi4.key, chi4.label, chi4.value, chi4.std_error, "as measured", reason
        )
    for key, label, role in (
        ("tau_alpha.value", "Relaxation time τ_{α}", "time"),
        ("wave_number.mean_diameter", "Mean cell diameter d", "length"),
    ):
        if key in scalars:
            scalar = scalars[key]
            unit = scalar.unit
            found[key] = Matched(
                key, label, scalar.value, scalar.std_error, f"in {unit}",
                _unknown(scalar) or f"it sets the unit of {role} in which the sides are compared",
            )  # fmt: skip
    return found


def _unknown(scalar: Scalar) -> str:
    if math.isfinite(scalar.value):
        return ""
    return f"only a bound is known, > {scalar.censored_at:g} {scalar.unit}"


def _packing(group: Group, scalars: Mapping[str, Scalar], area: tuple[float, float]) -> Matched:
    key, label = "packing_fraction", "Packing fraction φ, effective for movies"
    density = scalars.get("density.mean")
    if group.simulated:
        if "phi" in group.scene:
            return Matched(key, label, group.scene["phi"], 0.0, "φ of the scene")
        return Matched(key, label, math.nan, math.nan, "", "φ of the scene is not recorded")
    if density is None or density.unit != "1/mm^{2}":
        return Matched(key, label, math.nan, math.nan, "", "the movie has no density in 1/mm^{2}")
    error = density.std_error if math.isfinite(density.std_error) else 0.0
    value, spread = packing_fraction_of(density.value, error, area=area)
    rule = f"density × steric cell area of {area[0]:.0f} ± {area[1]:.0f} µm^{{2}}"
    reason = (
        "no one-to-one map leads from a density to a packing fraction; the effective value "
        "orders the two sides"
    )
    return Matched(key, label, value, spread, rule, reason)


def _ratios(group: Group, scalars: Mapping[str, Scalar]) -> dict[str, Matched]:
    found = {}
    d, tau = scalars.get("wave_number.mean_diameter"), scalars.get("tau_alpha.value")
    speed, lag = scalars.get("speed.mean"), scalars.get("alpha2_peak.lag_time")
    peak = scalars.get("wave_number.q_peak")
    if d is not None and peak is not None and math.isfinite(peak.value):
        found["q_peak"] = _product(
            "q_peak", "First peak of S(q), q_{peak} d/2π", [(peak, 1), (d, 1)], 1 / (2 * math.pi)
        )
    if tau is None or not math.isfinite(tau.value):
        return found
    if lag is not None:
        found["alpha2_lag"] = _product(
            "alpha2_lag", "Lag of the peak of α_{2}, in τ_{α}", [(lag, 1), (tau, -1)]
        )
    if speed is not None and d is not None:
        product = _product("speed", "Mean speed, in d/τ_{α}", [(speed, 1), (tau, 1), (d, -1)])
        points = look_up(group.members[0].summary, "processing.smoothing_points")
        found["speed"] = replace(
            product,
            interval=_frame_interval(group) / tau.value,
            smoothing=math.nan if points is None else float(points),
        )
    return found


def _frame_interval(group: Group) -> float:
    speed = group.members[0].summary.get("speed", {})
    value = speed.get("dt") if isinstance(speed, Mapping) else None
    return float(value) if value is not None else math.nan


def _product(
    key: str,
    label: str,
    terms: Sequence[tuple[Scalar, int]],
    factor: float = 1.0,
) -> Matched:
    value, squares = factor, 0.0
    for scalar, power in terms:
        value *= scalar.value**power
        squares += (power * scalar.std_error / scalar.value) ** 2
    error = abs(value) * math.sqrt(squares)
    return Matched(key, label, value, error, "ratio of measured values")


def unit_mapping(movie: Group, model: Group) -> UnitMapping | None:
    """L0 and t0 in the movie's units, so that cell diameters and relaxation times coincide.

    Returns
    -------
    UnitMapping or None
        None unless one side is a movie and the other a model with a mean diameter.
    """
    if movie.simulated or not model.simulated:
        return None
    ours, theirs = movie.scalars(), model.scalars()
    length = _ratio(ours.get("wave_number.mean_diameter"), theirs.get("wave_number.mean_diameter"))
    time = _ratio(ours.get("tau_alpha.value"), theirs.get("tau_alpha.value"))
    if length is None:
        return None
    rule = "L_{0} from the mean cell diameters"
    rule += ", t_{0} from the relaxation times" if time else "; t_{0} is not known"
    return UnitMapping(*length, *(time or (math.nan, math.nan)), rule)


def _ratio(top: Scalar | None, bottom: Scalar | None) -> tuple[float, float] | None:
    if top is None or bottom is None:
        return None
    if not (math.isfinite(top.value) and bottom.value > 0):
        return None
    product = _product("", "", [(top, 1), (bottom, -1)])
    return product.value, product.std_error


def _group_dict(group: Group, area: tuple[float, float]) -> dict[str, Any]:
    return {
        "name": group.name,
        "simulated": group.simulated,
        "scene": dict(group.scene),
        "trials": list(group.trials),
        "n_recordings": len(group.members),
        "scalars": {
            s.key: {
                "value": _finite(s.value),
                "std_error": _finite(s.std_error),
                "censored_at": _finite(s.censored_at),
                "unit": s.unit,
                "sample": s.n,
                "rule": s.rule,
            }
            for s in group.scalars().values()
        },
        "matched": {
            m.key: {"value": _finite(m.value), "std_error": _finite(m.std_error), "rule": m.rule}
            for m in matched_scalars(group, area=area).values()
        },
    }


def _verdict_dict(verdict: Verdict) -> dict[str, Any]:
    return {
        "key": verdict.key,
        "first": _finite(verdict.values[0].value),
        "first_std_error": _finite(verdict.values[0].std_error),
        "second": _finite(verdict.values[1].value),
        "second_std_error": _finite(verdict.values[1].std_error),
        "difference": _finite(verdict.difference),
        "std_error": _finite(verdict.std_error),
        "verdict": verdict.verdict,
        "reason": verdict.reason,
    }


def _mapping_dict(mapping: UnitMapping | None) -> dict[str, Any] | None:
    if mapping is None:
        return None
    return {
        "length_per_L0": mapping.length,
        "length_per_L0_std_error": mapping.length_error,
        "time_per_t0": _finite(mapping.time),
        "time_per_t0_std_error": _finite(mapping.time_error),
        "rule": mapping.rule,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
