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
    Verdict,
    unit_mapping,
)
from cellquant.compare.groups import Group
from cellquant.compare.matching import Matched, matched_scalars
from cellquant.compare.page import Row, Section, Table, format_value
from cellquant.compare.report import scalar_text
from cellquant.compare.results import Scalar, look_up, pretty_unit

if TYPE_CHECKING:
    import pandas as pd

MAX_TABLES = 6
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
    shown = list(pairs)
    if len(pairs) > 3:
        tables.append(_overview_table(pairs))
        # Of each group on the left, the partner with which most numbers agree.
        best: dict[str, tuple[Group, Group, Sequence[Verdict]]] = {}
        for pair in pairs:
            kept = best.get(pair[0].name)
            if kept is None or share(pair[2]) > share(kept[2]):
                best[pair[0].name] = pair
        shown = list(best.values())[:MAX_TABLES]
        text.append(
            f"Of {len(pairs)} pairs, the tables below show for each experiment the scene with "
            "which most numbers agree; all pairs are in comparison.json."
        )
    tables += [
        _verdict_table(index, first, second, verdicts)
        for index, (first, second, verdicts) in enumerate(shown)
    ]
    return Section("verdicts", "What agrees, what differs", tuple(text), tables=tuple(tables))


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
    return f"{value} {matched.unit}" if matched.unit and known else value


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
            shown.append(text if text == "–" or scalar is None else f"{text} {scalar.unit}")
        step = look_up(summaries[0], "speed.dt")
        points = look_up(summaries[0], "processing.smoothing_points")
        rows.append(
            Row(
                (
                    group.name,
                    counted(group.n, "run" if group.simulated else "trial").replace(
                        " ", "\N{NO-BREAK SPACE}"
                    ),
                    str(len(group.members)),
                    _range([s.get("n_frames") for s in summaries]),
                    "–" if step is None else f"{step:g} {pretty_unit(units.time)}",
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
        ),
    )  # fmt: skip


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
    rows = []
    for first, second, _ in pairs[:MAX_TABLES]:
        mapping = unit_mapping(first, second)
        if mapping is None:
            continue
        length = pretty_unit(first.members[0].units.length)
        time = pretty_unit(first.members[0].units.time)
        cells = [f"{first.name} and {second.name}"]
        cells.append(f"{format_value(mapping.length, mapping.length_error)} {length}")
        if math.isfinite(mapping.time):
            cells.append(f"{format_value(mapping.time, mapping.time_error)} {time}")
            speed = mapping.length / mapping.time
            relative = math.hypot(
                mapping.length_error / mapping.length, mapping.time_error / mapping.time
            )
            active = second.scene.get("v0")
            shown = (
                "" if active is None else format_value(active * speed, active * speed * relative)
            )
            cells.append(f"{shown} {length}/{time}" if shown else "")
        else:
            cells += ["", ""]
        rows.append(Row(tuple(cells)))
    packing = [
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
    ]
    tables = []
    if rows:
        tables.append(
            Table("units", "L_{0} so that the mean diameters coincide, t_{0} so that the "
                  "relaxation times coincide.",
                  ("Pair", "L_{0}", "t_{0}", "v₀ of the scene"),
                  ("", "number", "number", "number"), tuple(rows))
        )  # fmt: skip
    area, error = comparison.area
    if packing:
        tables.append(
            Table("packing", f"Effective packing fraction: density × steric cell area, "
                  f"{area:.0f} ± {error:.0f} µm^{{2}}.",
                  ("Experiment", "Density (1/mm^{2})", "φ, effective"),
                  ("", "number", "number"), tuple(packing))
        )  # fmt: skip
    if not tables:
        return None
    return Section(
        "units",
        "Units of the two sides",
        text=(
            "The model has no micrometres and no minutes. These are the values that its units take "
            "if the two sides are the same material. They are a choice, and so nothing that was "
            "used for it counts as agreement.",
            "No one-to-one map leads from a density to a packing fraction, because real cells "
            "spread and overlap. The effective φ orders the two sides; its error is mostly that "
            "of the cell area, which is shared by all experiments.",
        ),
        tables=tuple(tables),
    )
