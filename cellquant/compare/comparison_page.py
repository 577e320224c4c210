"""The page of a comparison: pairs of figures with the same axes, verdicts, units, methods."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from cellquant.compare.comparison import (
    AGREE,
    DIFFER,
    LEVEL,
    NOT_COMPARABLE,
    Comparison,
    Verdict,
    matched_scalars,
    unit_mapping,
)
from cellquant.compare.fit import fit_sections
from cellquant.compare.groups import Group
from cellquant.compare.matched_figures import (
    MAX_PICTURES,
    add_sources,
    displacement_figure,
    hove_figure,
    layer_figure,
    paths_figure,
    scattering_figure,
    shape_figure,
    with_pictures,
)
from cellquant.compare.page import (
    Figure,
    Headline,
    Page,
    Row,
    Section,
    Table,
    format_value,
)
from cellquant.compare.report import methods_section
from cellquant.compare.results import pretty_unit
from cellquant.compare.study_figures import boxes_figure, map_figures, relaxation_figure

if TYPE_CHECKING:
    import pandas as pd

MAX_TABLES = 6


def build_comparison(comparison: Comparison) -> Page:
    """Put the page of a comparison together."""
    pairs = [(a, b, comparison.verdicts(a, b)) for a, b in comparison.pairs()]
    groups = add_sources(_closest_first(comparison, pairs))
    sections = [
        _verdict_section(pairs),
        _figures("layers", "The layers", [layer_figure(groups), paths_figure(groups)], _LAYER),
        _figures("shape", "Shape of the cells",
                 [shape_figure(groups), boxes_figure(groups, "shape_index", "shape index p")],
                 _SHAPE),
        _figures("relaxation", "Memory and relaxation",
                 [scattering_figure(groups), relaxation_figure(comparison)], _RELAXATION),
        _figures("motion", "Displacements",
                 [displacement_figure(groups), hove_figure(groups),
                  boxes_figure(groups, "speed", "speed")], _MOTION),
        _figures("maps", "Maps over activity and line tension", map_figures(groups), _MAPS),
        *fit_sections(comparison.fits),
        _units_section(comparison, pairs),
        _limits_section(pairs, groups),
        _methods(groups),
    ]  # fmt: skip
    movies, models = comparison.experiments, comparison.simulations
    title = "Experiment and simulation" if movies and models else (
        "Experiments side by side" if movies else "Simulations side by side"
    )  # fmt: skip
    return Page(
        title=title,
        lede=_lede(movies, models),
        glance=_glance(comparison, pairs),
        sections=tuple(section for section in sections if section is not None),
    )


_LAYER = (
    "What each side looks like. Colours tell neighbouring cells apart and mean nothing else. Where "
    "there are many scenes, these and the figures below show those with which most numbers of the "
    "experiments agree.",
)
_SHAPE = (
    "The shape index p = P/√A compares the outline of a cell with its area: 3.54 for a disc, "
    "3.72 for a regular hexagon, larger for long or ragged cells. It has no unit, so that both "
    "sides are compared directly.",
)
_RELAXATION = (
    "F_{s}(q, t) tells how much of the layer is still where it was, at the scale of a cell. Time "
    "is given in units of each side's own relaxation time τ_{α}, so the curves meet at 1/e by "
    "construction and their form is what is compared; the scale above each drawing gives the "
    "side's own unit of time.",
)
_MOTION = ("Distances are in units of the mean cell diameter d, times in units of τ_{α}.",)
_MAPS = (
    "Each field is one scene of the sweep. Numbers are means over the seeds, ± their standard "
    "error.",
)


def _figures(
    name: str, title: str, figures: Sequence[Figure | None], text: tuple[str, ...]
) -> Section | None:
    shown = tuple(figure for figure in figures if figure is not None)
    return Section(name, title, text=text, figures=shown) if shown else None


def _lede(movies: Sequence[Group], models: Sequence[Group]) -> str:
    parts = []
    if movies:
        trials = sum(group.n for group in movies)
        parts.append(f"{_count(len(movies), 'experiment')} ({_count(trials, 'trial')})")
    if models:
        seeds = sum(group.n for group in models)
        parts.append(f"{_count(len(models), 'simulated scene')} ({_count(seeds, 'run')})")
    return (
        f"{' and '.join(parts)}, measured by the same code. Values agree when they differ by no "
        f"more than {LEVEL:g} combined standard errors; what must not be compared is said."
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


Pairs = Sequence[tuple[Group, Group, Sequence[Verdict]]]


def _closest_first(comparison: Comparison, pairs: Pairs) -> list[Group]:
    """The experiments, then the scenes, those first with which most numbers agree.

    Figures show the first few of each side.
    """
    share = dict.fromkeys((group.name for group in comparison.groups), 0.0)
    if comparison.experiments:
        for _, second, verdicts in pairs:
            share[second.name] += _share(verdicts)
    models = sorted(comparison.simulations, key=lambda group: -share[group.name])
    return [*comparison.experiments, *models]


def _glance(comparison: Comparison, pairs: Pairs) -> tuple[Headline, ...]:
    items = []
    for group in comparison.groups[:3]:
        mean = matched_scalars(group, area=comparison.area).get("shape_index.mean")
        if mean is not None:
            value = format_value(mean.value, mean.std_error)
            items.append(Headline(f"Mean shape index, {group.name}", value))
    if len(pairs) == 1:
        agree, judged = _tally(pairs[0][2])
        items.append(Headline("Comparable numbers that agree", f"{agree} of {judged}"))
    return tuple(items)


def _tally(verdicts: Sequence[Verdict]) -> tuple[int, int]:
    judged = [v for v in verdicts if v.verdict != NOT_COMPARABLE]
    return sum(v.verdict == AGREE for v in judged), len(judged)


def _verdict_section(pairs: Pairs) -> Section:
    text = [
        "The difference is second minus first; its error combines the errors of both. Agreement "
        "means that these data do not tell the two apart, not that they are the same."
    ]
    tables = []
    shown = list(pairs)
    if len(pairs) > 3:
        tables.append(_overview_table(pairs))
        # Of each group on the left, the partner with which most numbers agree.
        best: dict[str, tuple[Group, Group, Sequence[Verdict]]] = {}
        for pair in pairs:
            kept = best.get(pair[0].name)
            if kept is None or _share(pair[2]) > _share(kept[2]):
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


def _share(verdicts: Sequence[Verdict]) -> float:
    agree, judged = _tally(verdicts)
    return agree / judged if judged else 0.0


def _overview_table(pairs: Pairs) -> Table:
    firsts = list(dict.fromkeys(first.name for first, _, _ in pairs))
    seconds = list(dict.fromkeys(second.name for _, second, _ in pairs))
    tally = {(first.name, second.name): _tally(verdicts) for first, second, verdicts in pairs}
    rows = []
    for second in seconds:
        cells = [second]
        for first in firsts:
            agree, judged = tally.get((first, second), (0, 0))
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
            words += f", {abs(verdict.difference) / verdict.std_error:.1f} errors apart"
        rows.append(
            Row(
                (
                    verdict.label,
                    format_value(a.value, a.std_error),
                    format_value(b.value, b.std_error),
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


def _units_section(comparison: Comparison, pairs: Pairs) -> Section | None:
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


def _methods(groups: Sequence[Group]) -> Section:
    recorded = [(g.name, g.members[0].record) for g in groups if g.members[0].record]
    section = methods_section(recorded[:MAX_TABLES])
    more = len(recorded) - MAX_TABLES
    if more <= 0:
        return section
    text = (
        *section.text,
        f"Settings of the first {MAX_TABLES} groups are listed; those of the other {more} stand "
        "in run.json beside their tables.",
    )
    return replace(section, text=text)


def _limits_section(pairs: Pairs, groups: Sequence[Group]) -> Section:
    points: dict[str, str] = {}
    for _, _, verdicts in pairs:
        for v in verdicts:
            if v.reason:
                points.setdefault(v.key, f"{v.label}: {v.reason}.")
    single = [g.name for g in groups if g.n == 1]
    text = []
    if single:
        text.append(
            f"Errors of {', '.join(single[:6])}{' and others' if len(single) > 6 else ''} come "
            "from inside a single recording or run. They do not hold the spread between "
            "independent experiments, which is usually larger."
        )
    pictured = with_pictures(groups)
    bare = [g.name for g in groups if g not in pictured]
    if bare and len(groups) <= 2 * MAX_PICTURES:
        text.append(
            f"No picture of {', '.join(bare[:6])}{' and others' if len(bare) > 6 else ''}: the "
            "trajectories are not beside the results."
        )
    if not points:
        text.append("All numbers that both sides have were compared.")
    return Section("limits", "What is not comparable", tuple(text), tuple(points.values()))
