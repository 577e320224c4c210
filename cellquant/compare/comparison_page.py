"""The page of a comparison: pairs of figures with the same axes, verdicts, units, methods."""

import json
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cellquant.compare.comparison import LEVEL, Comparison
from cellquant.compare.comparison_tables import (
    MAX_TABLES,
    Pairs,
    counted,
    share,
    sides_section,
    tally,
    units_section,
    verdict_section,
)
from cellquant.compare.fit import fit_sections
from cellquant.compare.groups import Group
from cellquant.compare.layers import (
    MAX_PICTURES,
    add_sources,
    layer_figure,
    path_figures,
    with_pictures,
)
from cellquant.compare.matched_figures import (
    displacement_figure,
    hove_figure,
    scattering_figure,
    shape_figure,
)
from cellquant.compare.matching import matched_scalars
from cellquant.compare.page import (
    Figure,
    Headline,
    Page,
    Section,
    Settings,
    flatten,
    format_value,
)
from cellquant.compare.report import command_lines, methods_section
from cellquant.compare.results import look_up
from cellquant.compare.study_figures import (
    boxes_figure,
    crowding_figure,
    map_figures,
    relaxation_figure,
)
from cellquant.compare.study_tables import statistics_section
from cellquant.compare.units import STERIC_AREA


def build_comparison(comparison: Comparison) -> Page:
    """Put the page of a comparison together."""
    pairs = [(a, b, comparison.verdicts(a, b)) for a, b in comparison.pairs()]
    groups = add_sources(_closest_first(comparison, pairs))
    sections = [
        verdict_section(pairs),
        sides_section(groups),
        *(statistics_section(s, number=i) for i, s in enumerate(comparison.studies, start=1)),
        _figures("layers", "The layers", [layer_figure(groups), *path_figures(groups)], _LAYER),
        _figures("shape", "Shape of the cells",
                 [shape_figure(groups), boxes_figure(groups, "shape_index", "shape index p")],
                 _SHAPE),
        _figures("relaxation", "Memory and relaxation",
                 [scattering_figure(groups), crowding_figure(comparison),
                  relaxation_figure(comparison)], _RELAXATION),
        _figures("motion", "Displacements",
                 [displacement_figure(groups), hove_figure(groups),
                  boxes_figure(groups, "speed", "speed")], _MOTION),
        _figures("maps", "Maps over activity and line tension", map_figures(groups), _MAPS),
        *fit_sections(comparison.fits),
        units_section(comparison, pairs),
        _limits_section(pairs, groups),
        _methods(comparison, groups),
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
    "is given in units of each side's own relaxation time τ_{α}, the mean over its trials. A "
    "single recording falls to 1/e at 1; a mean over recordings that relax at different times need "
    "not, since the fast ones fall first. What is compared is the form of the curves; the scale "
    "above each drawing gives the side's own unit of time.",
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
        parts.append(f"{counted(len(movies), 'experiment')} ({counted(trials, 'trial')})")
    if models:
        seeds = sum(group.n for group in models)
        parts.append(f"{counted(len(models), 'simulated scene')} ({counted(seeds, 'run')})")
    text = (
        f"{' and '.join(parts)}, measured by the same code. Values agree when they differ by no "
        f"more than {LEVEL:g} combined standard errors; what must not be compared is said."
    )
    if any(group.scene for group in models):
        text += (
            " Scenes are named by the parameters of the model: packing fraction φ, self-propulsion "
            "speed v₀ and line tension of the cell edge η, in units of the model."
        )
    return text


def _closest_first(comparison: Comparison, pairs: Pairs) -> list[Group]:
    """The experiments, then the scenes, those first with which most numbers agree.

    Figures show the first few of each side.
    """
    agreeing = dict.fromkeys((group.name for group in comparison.groups), 0.0)
    if comparison.experiments:
        for _, second, verdicts in pairs:
            agreeing[second.name] += share(verdicts)
    models = sorted(comparison.simulations, key=lambda group: -agreeing[group.name])
    return [*comparison.experiments, *models]


def _glance(comparison: Comparison, pairs: Pairs) -> tuple[Headline, ...]:
    items = []
    for group in comparison.groups[:3]:
        mean = matched_scalars(group, area=comparison.area).get("shape_index.mean")
        if mean is not None:
            value = format_value(mean.value, mean.std_error)
            items.append(Headline(f"Mean shape index, {group.name}", value))
    if len(pairs) == 1:
        agree, judged = tally(pairs[0][2])
        items.append(Headline("Comparable numbers that agree", f"{agree} of {judged}"))
    return tuple(items)


def command_of(comparison: Comparison) -> str:
    """The command that makes the page again; empty for results in memory."""
    settings = comparison.settings
    sources = settings.get("sources", ())
    if not sources or "in memory" in [*sources, settings.get("units")]:
        return ""
    words = ["cellquant", "compare", *sources, "-o", "report.html"]
    if settings["steric_area"] != list(STERIC_AREA):
        words += ["--steric-area", *(f"{v:g}" for v in settings["steric_area"])]
    if settings.get("fit"):
        words += ["--fit", "--seed", str(settings["seed"])]
        words += ["--units", settings["units"]] if settings["units"] else []
    return shlex.join(words)


def _whole_commands(comparison: Comparison) -> dict[Path, str]:
    """By folder of a whole study or sweep among the sources, the command that makes it again."""
    found = {}
    for source in comparison.settings.get("sources", ()):
        try:
            record = json.loads((Path(source) / "run.json").read_text("utf-8"))
        except (OSError, ValueError):
            continue
        files = [name for name in record.get("inputs", {}) if name.endswith(".toml")]
        if record.get("command") in {"run", "sweep"} and files:
            words = ["cellquant", record["command"], files[0], "-o", source]
            found[Path(source).resolve()] = shlex.join(words)
    return found


def _methods(comparison: Comparison, groups: Sequence[Group]) -> Section:
    recorded = [(g.name, g.members[0].record) for g in groups if g.members[0].record]
    section = methods_section(recorded[:MAX_TABLES])
    whole = _whole_commands(comparison)
    parts = {
        line
        for group in groups
        for folder in [group.members[0].folder]
        if folder is not None and any(w in folder.resolve().parents for w in whole)
        for record in [*group.members[0].record.get("earlier", []), group.members[0].record]
        for line in command_lines(record)
    }
    single = [line for line in section.commands.splitlines() if line not in parts]
    made = {"level": f"{LEVEL:g} combined standard errors", **comparison.settings}
    section = replace(
        section,
        settings=(Settings("Settings of compare", flatten(made)), *section.settings),
        commands="\n".join(filter(None, (*whole.values(), *single, command_of(comparison)))),
    )
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
    reasons: dict[str, dict[str, None]] = {}
    for _, _, verdicts in pairs:
        for v in verdicts:
            if v.reason:
                reasons.setdefault(v.label, {}).setdefault(v.reason)
    points = [
        f"{label}: {next(iter(found))}" + ("." if len(found) == 1 else "; for other pairs see the "
                                           "verdicts.")
        for label, found in reasons.items()
    ]  # fmt: skip
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
    smoothed = {
        look_up(result.summary, "processing.smoothing_points")
        for group in groups
        for result in group.members
    } - {None}
    if len(smoothed) > 1:
        text.append(
            "Not all trajectories were smoothed alike (see What is compared). Smoothing takes away "
            "motion between frames: with ten frames in a relaxation time, five points lower the "
            "MSD at that time by about 4 % and raise τ_{α} by about 2 %, at shorter times more. "
            "Observe both sides with the same smoothing where that matters."
        )
    return Section("limits", "What is not comparable", tuple(text), tuple(points))
