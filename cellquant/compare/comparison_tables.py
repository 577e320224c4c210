"""Tables of a comparison: verdicts, sample sizes, units of the two sides."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cellquant.compare.comparison import (
    AGREE,
    DIFFER,
    LEVEL,
    NOT_COMPARABLE,
    Comparison,
    UnitMapping,
    Verdict,
    unit_mapping,
)
from cellquant.compare.groups import Group
from cellquant.compare.matching import Matched, matched_scalars
from cellquant.compare.page import Row, Section, Table, format_value
from cellquant.compare.report import scalar_text
from cellquant.compare.results import (
    Scalar,
    look_up,
    meanings,
    plain_unit,
    pretty_unit,
    scale_of,
    unit_text,
)

if TYPE_CHECKING:
    import pandas as pd

MAX_TABLES = 6
NBSP = "\N{NO-BREAK SPACE}"
Pairs = Sequence[tuple[Group, Group, Sequence[Verdict]]]


def counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def tally(verdicts: Sequence[Verdict]) -> tuple[int, int]:
    judged = [v for v in verdicts if v.verdict != NOT_COMPARABLE]
    return sum(v.verdict == AGREE for v in judged), len(judged)


def verdict_section(pairs: Pairs) -> Section:
    text = [
        "The difference is second minus first; its error combines the errors of both. The verdict: "
        f"two values agree when they are no more than {LEVEL:g} such errors apart, and differ "
        "otherwise. Agreement means that these data do not tell the two apart, not that they are "
        "the same; of twenty numbers that are equal, about one will be called different by chance."
    ]
    tables = []
    shown = closest_pairs(pairs)
    if len(shown) < len(pairs):
        tables.append(_overview_table(pairs))
        text.append(
            f"Of {len(pairs)} pairs, the tables below show for each experiment the scene with "
            "which most numbers agree; all pairs are in comparison.json."
        )
    tables += [
        _verdict_table(index, first, second, verdicts)
        for index, (first, second, verdicts) in enumerate(shown)
    ]
    return Section("verdicts", "What agrees, what differs", tuple(text), tables=tuple(tables))


def closest_pairs(pairs: Pairs) -> Pairs:
    """For each group on the left the partner with which most numbers agree; all of up to three."""
    if len(pairs) <= 3:
        return pairs
    best: dict[str, tuple[Group, Group, Sequence[Verdict]]] = {}
    for pair in pairs:
        kept = best.get(pair[0].name)
        if kept is None or share(pair[2]) > share(kept[2]):
            best[pair[0].name] = pair
    return list(best.values())[:MAX_TABLES]


def share(verdicts: Sequence[Verdict]) -> float:
    agree, judged = tally(verdicts)
    return agree / judged if judged else 0.0


def _overview_table(pairs: Pairs) -> Table:
    firsts = list(dict.fromkeys(first.name for first, _, _ in pairs))
    seconds = list(dict.fromkeys(second.name for _, second, _ in pairs))
    counts = {(first.name, second.name): tally(verdicts) for first, second, verdicts in pairs}
    rows = []
    for second in seconds:
        cells = [second]
        for first in firsts:
            agree, judged = counts.get((first, second), (0, 0))
            cells.append(f"{agree} of {judged}" if judged else "")
        rows.append(Row(tuple(cells)))
    return Table(
        name="overview",
        caption="How many of the comparable numbers agree.",
        columns=("Scene", *firsts),
        classes=("", *("number" for _ in firsts)),
        rows=tuple(rows),
    )


def _verdict_table(index: int, first: Group, second: Group, verdicts: Sequence[Verdict]) -> Table:
    bounds = [group.scalars() for group in (first, second)]
    tones = {AGREE: "good", DIFFER: "bad", NOT_COMPARABLE: "none"}
    rows = []
    for verdict in sorted(verdicts, key=lambda v: v.verdict == NOT_COMPARABLE):
        a, b = verdict.values
        comparable = verdict.verdict != NOT_COMPARABLE
        difference = format_value(verdict.difference, verdict.std_error) if comparable else ""
        if comparable and verdict.difference > 0:
            difference = f"+{difference}"
        words = verdict.verdict if comparable else f"{NOT_COMPARABLE}: {verdict.reason}"
        if comparable:
            words += f": {abs(verdict.difference) / verdict.std_error:.1f} errors apart"
        rows.append(
            Row(
                (
                    verdict.label,
                    *(
                        _with_unit(v, known.get(v.key))
                        for v, known in zip((a, b), bounds, strict=True)
                    ),
                    difference,
                    words,
                ),
                tones[verdict.verdict],
            )
        )
    return Table(
        name=f"verdicts-{index + 1}",
        caption=f"{first.name} and {second.name}.",
        columns=("Quantity", first.name, second.name, "Difference", "Verdict"),
        classes=("", "number", "number", "number", "verdict"),
        rows=tuple(rows),
        data=_verdict_data(verdicts),
    )


def _with_unit(matched: Matched, scalar: Scalar | None) -> str:
    """Value, error and unit; the bound of a number that was not reached."""
    value, known = format_value(matched.value, matched.std_error), math.isfinite(matched.value)
    if not known and scalar is not None and math.isfinite(scalar.censored_at):
        value, known = scalar_text(scalar), True
    return f"{value}{NBSP}{matched.unit}" if matched.unit and known else value


def sides_section(groups: Sequence[Group]) -> Section:
    """What each group rests on: independent repeats, frames, cells, and how it was measured."""
    rows = []
    for group in groups:
        summaries = [result.summary for result in group.members]
        scalars = group.scalars()
        units = group.members[0].units
        shown = []
        for key in ("wave_number.mean_diameter", "tau_alpha.value"):
            scalar = scalars.get(key)
            text = "–" if scalar is None else scalar_text(scalar)
            shown.append(text if text == "–" or scalar is None else f"{text}{NBSP}{scalar.unit}")
        step = look_up(summaries[0], "speed.dt")
        points = look_up(summaries[0], "processing.smoothing_points")
        rows.append(
            Row(
                (
                    group.name,
                    counted(group.n, "run" if group.simulated else "trial").replace(" ", NBSP),
                    str(len(group.members)),
                    _range([s.get("n_frames") for s in summaries]),
                    "–" if step is None else f"{step:g}{NBSP}{pretty_unit(units.time)}",
                    _range([s.get("n_cells_mean") for s in summaries]),
                    str(sum(int(s.get("n_tracks") or 0) for s in summaries)),
                    *shown,
                    {None: "–", 1: "none"}.get(points, f"{points} points"),
                )
            )
        )
    return Section(
        "sides",
        "What is compared",
        text=(
            "A trial or a run is one independent repeat: n, the number on which error bars rest "
            "wherever there is more than one. Cells and frames within one repeat are not "
            "independent of each other.",
        ),
        tables=(
            Table(
                "sides",
                "Sample sizes, and how each side was measured. d is the mean cell diameter; τ_{α} "
                "is the time in which the layer forgets where its cells were.",
                ("Group", "n", "Recordings", "Frames each", "Time between frames",
                 "Cells per frame", "Tracks", "d", "τ_{α}", "Smoothing"),
                ("", *("number",) * 9),
                tuple(rows),
            ),
            _quantities_table(groups),
        ),
    )  # fmt: skip


def _quantities_table(groups: Sequence[Group]) -> Table:
    """What each number is."""
    known = {key for group in groups for key in group.scalars()}
    return Table(
        "quantities",
        "What is measured on both sides, and how.",
        ("Quantity", "How it is obtained"),
        ("", ""),
        tuple(Row(pair) for key, pair in meanings().items() if key in known),
    )


def _range(values: Sequence[float | None]) -> str:
    known = [round(v) for v in values if v is not None]
    if not known:
        return "–"
    low, high = min(known), max(known)
    return str(low) if low == high else f"{low} to {high}"


def _verdict_data(verdicts: Sequence[Verdict]) -> "pd.DataFrame":
    import pandas as pd

    return pd.DataFrame(
        {
            "quantity": [v.key for v in verdicts],
            "first": [v.values[0].value for v in verdicts],
            "first_std_error": [v.values[0].std_error for v in verdicts],
            "second": [v.values[1].value for v in verdicts],
            "second_std_error": [v.values[1].std_error for v in verdicts],
            "difference": [v.difference for v in verdicts],
            "std_error": [v.std_error for v in verdicts],
            "verdict": [v.verdict for v in verdicts],
            "reason": [v.reason for v in verdicts],
        }
    )


def units_section(comparison: Comparison, pairs: Pairs) -> Section | None:
    """What L0 and t0 are in the movie, numbers of both sides in both systems, and the crowding."""
    chosen = closest_pairs(pairs)
    mapped = [(a, b, m) for a, b, _ in chosen if (m := unit_mapping(a, b)) is not None]
    tables = []
    if mapped:
        tables.append(_scales_table(comparison, mapped))
        for index, (movie, model, mapping) in enumerate(mapped, start=1):
            table = _both_systems_table(index, movie, model, mapping)
            if table.rows:
                tables.append(table)
    packing = _packing_rows(comparison)
    area, error = comparison.area
    if packing:
        tables.append(
            Table("packing", f"Effective packing fraction: density × steric cell area, "
                  f"{area:.0f} ± {error:.0f} µm^{{2}}.",
                  ("Experiment", "Density (1/mm^{2})", "φ, effective"),
                  ("", "number", "number"), packing)
        )  # fmt: skip
    if not tables:
        return None
    text = []
    if mapped:
        text.append(
            "The model has no micrometres and no minutes. These are the values that its units take "
            "if the two sides are the same material. They are a choice, and so nothing that was "
            "used for it counts as agreement."
        )
    if packing:
        text.append(
            "No one-to-one map leads from a density to a packing fraction, because real cells "
            "spread and overlap. The effective φ orders the two sides; its error is mostly that "
            "of the cell area, which is shared by all experiments."
        )
    return Section("units", "Units of the two sides", text=tuple(text), tables=tuple(tables))


Mapped = Sequence[tuple[Group, Group, UnitMapping]]


def _scales_table(comparison: Comparison, mapped: Mapped) -> Table:
    """L0, t0 and v0 by pair, and as given."""
    rows = []
    for movie, model, mapping in mapped:
        length, time = (pretty_unit(u) for u in _unit_names(movie))
        cells = [f"{movie.name} and {model.name}"]
        cells.append(f"{format_value(mapping.length, mapping.length_error)}{NBSP}{length}")
        if math.isfinite(mapping.time):
            cells.append(f"{format_value(mapping.time, mapping.time_error)}{NBSP}{time}")
            factor, relative = _scale(mapping, (1, -1))
            active = model.scene.get("v0")
            cells.append(
                "–" if active is None else
                f"{format_value(active * factor, active * factor * relative)}{NBSP}{length}/{time}"
            )  # fmt: skip
        else:
            cells += ["–", "–"]
        rows.append(Row(tuple(cells)))
    caption = "L_{0} so that the mean diameters coincide, t_{0} so that the relaxation times do."
    given = comparison.settings.get("L0"), comparison.settings.get("t0")
    if all(given):
        texts = [format_value(*value) for value in given if value]
        rows.append(
            Row(("as given for the fit", f"{texts[0]}{NBSP}µm", f"{texts[1]}{NBSP}min", "–"))
        )
        caption += " The last row holds what was given for the fit."
    return Table("units", caption, ("Pair", "L_{0}", "t_{0}", "v₀ of the scene"),
                 ("", "number", "number", "number"), tuple(rows))  # fmt: skip


def _unit_names(group: Group) -> tuple[str, str]:
    units = group.members[0].units
    return units.length, units.time


def _scale(mapping: UnitMapping, power: tuple[int, int]) -> tuple[float, float]:
    """L0^a t0^b in the movie's units, and its relative error."""
    terms = ((mapping.length, mapping.length_error), (mapping.time, mapping.time_error))
    used = [(value, error, p) for (value, error), p in zip(terms, power, strict=True) if p]
    return (
        math.prod(value**p for value, _, p in used),
        math.hypot(*(p * error / value for value, error, p in used)),
    )


def _both_systems_table(index: int, movie: Group, model: Group, mapping: UnitMapping) -> Table:
    """Every number with a unit, of both sides, in the units of both sides."""
    import pandas as pd

    ours, theirs = movie.scalars(), model.scalars()
    units, reduced = movie.members[0].units, model.members[0].units
    rows, data = [], []
    for key, scalar in ours.items():
        # The mapping makes these two equal.
        if scalar.power == (0, 0) or key in {"wave_number.mean_diameter", "tau_alpha.value"}:
            continue
        scale, relative = _scale(mapping, scalar.power)
        if not math.isfinite(scale):
            continue
        factor, unit = scale_of(scalar.power, units)
        numbers = [(scalar.value, scalar.std_error)]
        numbers.append(_converted(scalar, 1 / (factor * scale), relative))
        other = theirs.get(key)
        if other is None:
            numbers += [(math.nan, math.nan)] * 2
        else:
            numbers += [_converted(other, factor * scale, relative), (other.value, other.std_error)]
        names = (unit, unit_text(scalar.power, reduced)) * 2
        cells = [
            f"{format_value(*n)}{NBSP}{u}" if math.isfinite(n[0]) else format_value(*n)
            for n, u in zip(numbers, names, strict=True)
        ]
        rows.append(Row((scalar.label, *cells)))
        data.append(
            {"quantity": key, "unit": plain_unit(unit), "model_unit": plain_unit(names[1])}
            | {
                f"{side}{part}": number[k]
                for side, number in zip(
                    ("experiment", "experiment_in_model_unit", "simulation",
                     "simulation_in_model_unit"), numbers, strict=True,
                )
                for k, part in enumerate(("", "_std_error"))
            }
        )  # fmt: skip
    return Table(
        f"both-systems-{index}",
        f"{movie.name} and {model.name} in the units of both sides, through L_{{0}} and t_{{0}} of "
        "this pair. Diameter and relaxation time coincide by that choice and are left out. Not "
        "everything here may be compared: see the verdicts.",
        ("Quantity", "Experiment, in its unit", "Experiment, in units of the model",
         "Simulation, in the unit of the movie", "Simulation, in units of the model"),
        ("",) * 5,
        tuple(rows),
        pd.DataFrame(data),
    )  # fmt: skip


def _converted(scalar: Scalar, factor: float, relative: float) -> tuple[float, float]:
    value = scalar.value * factor
    own = scalar.std_error * factor
    return value, math.hypot(own, value * relative) if math.isfinite(own) else math.nan


def _packing_rows(comparison: Comparison) -> tuple[Row, ...]:
    return tuple(
        Row(
            (
                group.name,
                format_value(density.value, density.std_error),
                format_value(phi.value, phi.std_error),
            )
        )
        for group in comparison.experiments
        if (density := group.scalars().get("density.mean")) is not None
        and math.isfinite(
            (phi := matched_scalars(group, area=comparison.area)["packing_fraction"]).value
        )
    )
