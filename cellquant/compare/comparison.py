"""Experiment and simulation side by side: which numbers may be compared, and whether they agree."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant import __version__
from cellquant.compare.groups import Group, read_groups
from cellquant.compare.matching import Matched, matched_scalars, product_of
from cellquant.compare.results import Scalar, plain_unit
from cellquant.compare.study_tables import Study, read_study
from cellquant.compare.units import STERIC_AREA
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
    settings
        How it was made: sources as given, and options.
    studies
        Statistics over the conditions of whole experiments.
    """

    groups: tuple[Group, ...]
    area: tuple[float, float] = STERIC_AREA
    fits: "tuple[Fit, ...]" = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    studies: tuple[Study, ...] = ()

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
            "settings": dict(self.settings),
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
    units: "Units | str | Path | None" = None,
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
        L0 and t0 in the experiments' units, for the fit, or a file that fixes them; pure numbers
        only when None.
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
    named = [str(s) if isinstance(s, str | Path) else "in memory" for s in sources]
    settings: dict[str, Any] = {
        "sources": named,
        "steric_area": list(steric_area),
        "fit": fit,
    }
    if fit:
        origin = None if units is None else "in memory"
        if isinstance(units, str | Path):
            from cellquant.compare.ranking import units_of_file

            origin, units = str(units), units_of_file(units)
        settings |= {"seed": seed, "units": origin, "L0": units and list(units.length),
                     "t0": units and list(units.time)}  # fmt: skip
    found = [read_study(s) for s in sources if isinstance(s, str | Path)]
    studies = tuple(study for study in found if study is not None)
    comparison = Comparison(tuple(groups), steric_area, settings=settings, studies=studies)
    if not fit:
        return comparison
    from cellquant.compare.fit import fit_groups

    known = None if isinstance(units, str | Path) else units
    return replace(comparison, fits=tuple(fit_groups(comparison, units=known, seed=seed)))


def judge(first: Matched, second: Matched) -> Verdict:
    """Agreement within two combined standard errors, where the two may be compared at all."""
    difference = second.value - first.value
    error = math.hypot(first.std_error, second.std_error)
    unknown = [side.reason for side in (first, second) if not math.isfinite(side.value)]
    reason = next(filter(None, (*unknown, first.reason, second.reason)), "")
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
    product = product_of("", "", [(top, 1), (bottom, -1)])
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
                "unit": plain_unit(s.unit),
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
