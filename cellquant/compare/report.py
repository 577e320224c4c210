"""The report of one experiment: from masks to numbers, on one page."""

import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant import __version__
from cellquant.compare import panels
from cellquant.compare.page import (
    Figure,
    Headline,
    Page,
    Row,
    Section,
    Settings,
    Table,
    flatten,
    format_value,
    write_page,
)
from cellquant.compare.results import (
    Result,
    Scalar,
    look_up,
    plain_unit,
    pretty_unit,
    read_result,
    read_scalars,
    reasons,
)

if TYPE_CHECKING:
    from cellquant.io import ImageStack, LabelStack
    from cellquant.observables import Observables
    from cellquant.tables import Cells, Tracks

_LIBRARIES = ("numpy", "scipy", "numba", "pandas", "opencv-python-headless", "matplotlib")
PURE = "none"  # the unit of a pure number, where a table has a column of units
_HEADLINES = ("density.mean", "shape_index.mean", "tau_alpha.value", "speed.mean")
# What the counts of faults mean, in words; others are listed under their own name.
_FAULTS = {
    "fragments": "labels in several pieces: the largest piece was measured",
    "specks": "pieces of a few pixels: left out",
    "holes": "cells with a hole: the hole was filled for the contour",
    "enclosed_cells": "cells inside another cell",
    "border_cells": "cells cut by the edge of the image: tracked, but left out of all shapes",
    "too_small_for_contour": "cells too small for a contour: tracked, but left out of all shapes",
    "duplicated_frames": "frames equal to the one before",
    "empty_frames": "frames without a cell",
}


def experiment_report(
    *,
    title: str,
    tracks: "Tracks",
    observables: "Observables | Result",
    settings: Mapping[str, Any],
    out: str | Path,
    stack: "LabelStack | None" = None,
    raw: "ImageStack | None" = None,
    cells: "Cells | None" = None,
) -> None:
    """Write the report of one experiment as one self-contained HTML page.

    Parameters
    ----------
    title
        Heading of the page.
    tracks
        Trajectories, not smoothed.
    observables
        What `observe` made of them.
    settings
        How the results were made: the content of ``run.json`` (`RunRecord.as_dict`). Times and
        machine are left out, so that equal results give an equal page.
    out
        The HTML file.
    stack
        The label masks, for a picture of the segmented frame.
    raw
        The recorded movie; the outlines of the cells are then drawn on it.
    cells
        The cells table, for the density of each frame and the faults of the masks.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_page(
        build_report(
            title=title,
            tracks=tracks,
            result=read_result(observables, name=title),
            settings=settings,
            stack=stack,
            raw=raw,
            cells=cells,
        ),
        out,
    )


def build_report(
    *,
    title: str,
    tracks: "Tracks",
    result: Result,
    settings: Mapping[str, Any],
    stack: "LabelStack | None" = None,
    raw: "ImageStack | None" = None,
    cells: "Cells | None" = None,
) -> Page:
    """Put the report of `experiment_report` together, without writing it."""
    scalars = read_scalars(result)
    sections = [
        _section("layer", "The layer", _layer_figures(tracks, stack, raw, cells), _LAYER_TEXT),
        _section("shape", "Shape of the cells", [panels.shape_figure([result])], _SHAPE_TEXT),
        _section(
            "motion",
            "Motion and relaxation",
            [
                panels.paths_figure(tracks),
                panels.scattering_figure([result]),
                panels.msd_figure([result]),
            ],
            _MOTION_TEXT,
        ),
        _section("links", "Was the linking safe?", [panels.linking_figure(tracks)], _LINK_TEXT),
    ]
    faults = {} if cells is None else cells.faults
    return Page(
        title=title,
        lede=_lede(tracks, result),
        glance=headlines(scalars),
        sections=(
            Section("results", "Results", text=_RESULTS_TEXT, tables=(scalar_table(scalars),)),
            *[section for section in sections if section is not None],
            warnings_section(faults, settings, tracks.provenance, reasons(result)),
            methods_section([("", settings)], tracks.provenance),
        ),
    )


_RESULTS_TEXT = (
    "Each value stands with its standard error. The error comes from the spread between "
    "independent parts of this recording; it does not hold for other experiments. With one "
    "recording there is one replicate, whatever the number of cells.",
)
_LAYER_TEXT = (
    "What was segmented, and how many cells there were while it was filmed. A cell keeps its "
    "colour as long as it keeps its track.",
)
_SHAPE_TEXT = (
    "The shape index p = P/√A compares the outline of a cell with its area: 3.54 for a disc, "
    "3.72 for a regular hexagon, larger for long or ragged cells.",
)
_MOTION_TEXT = (
    "How far cells go, and how long the layer remembers where they were. F_{s}(q, t) falls from "
    "1 to 0 as cells leave their places; the time at which it reaches 1/e is the relaxation time "
    "τ_{α}.",
)
_LINK_TEXT = (
    "Cells are followed safely when they move much less between frames than the distance to "
    "their nearest neighbour. Where the two distributions overlap, links can be wrong.",
)


def _section(
    name: str, title: str, figures: Sequence[Figure | None], text: tuple[str, ...]
) -> Section | None:
    shown = tuple(figure for figure in figures if figure is not None)
    return Section(name, title, text=text, figures=shown) if shown else None


def _layer_figures(
    tracks: "Tracks",
    stack: "LabelStack | None",
    raw: "ImageStack | None",
    cells: "Cells | None",
) -> list[Figure | None]:
    picture = None if stack is None else panels.masks_figure(stack, tracks, raw=raw)
    return [picture, panels.density_figure(tracks, cells)]


def _lede(tracks: "Tracks", result: Result) -> str:
    frames = result.summary.get("n_frames", tracks.table["frame"].nunique())
    length, time = pretty_unit(tracks.units.length), pretty_unit(tracks.units.time)
    mean = result.summary.get("n_cells_mean")
    count = f"{mean:.0f} cells in each of {frames} frames" if mean else f"{frames} frames"
    if tracks.units.length == "px":
        return (
            f"{count}, followed as {tracks.n_tracks} tracks. The recording has no calibration: "
            "lengths are in pixels (px), times in frames."
        )
    return (
        f"{count}, one every {tracks.frame_interval:g} {time}, followed as {tracks.n_tracks} "
        f"tracks. Lengths are in {length}, times in {time}."
    )


def headlines(scalars: Sequence[Scalar]) -> tuple[Headline, ...]:
    """The few scalars that a reader looks for first."""
    known = {scalar.key: scalar for scalar in scalars}
    return tuple(
        Headline(known[key].label, scalar_text(known[key]), known[key].unit)
        for key in _HEADLINES
        if key in known
    )


def scalar_text(scalar: Scalar) -> str:
    """Value and error, or the bound of a censored value."""
    if not np.isfinite(scalar.value) and np.isfinite(scalar.censored_at):
        return f"> {format_value(scalar.censored_at)}"
    return format_value(scalar.value, scalar.std_error)


def scalar_table(scalars: Sequence[Scalar]) -> Table:
    """All scalars of one result, with unit, sample and rule; the CSV has full precision."""
    import pandas as pd

    return Table(
        name="results",
        caption="Value ± standard error.",
        columns=("Quantity", "Value", "Unit", "Sample", "How it was obtained"),
        classes=("", "number", "", "", "note"),
        rows=tuple(
            Row((s.label, scalar_text(s), s.unit or PURE, s.n, _censored_rule(s))) for s in scalars
        ),
        data=pd.DataFrame(
            {
                "quantity": [s.key for s in scalars],
                "value": [s.value for s in scalars],
                "std_error": [s.std_error for s in scalars],
                "censored_at": [s.censored_at for s in scalars],
                "unit": [plain_unit(s.unit) for s in scalars],
                "sample": [s.n for s in scalars],
            }
        ),
    )  # fmt: skip


def _censored_rule(scalar: Scalar) -> str:
    if np.isfinite(scalar.value) or not np.isfinite(scalar.censored_at):
        return scalar.rule
    return f"{scalar.rule}; the curve does not cross within the recording, so this is a bound"


def _counted(words: str, count: int) -> str:
    """The words with their leading plural noun in the singular where there is one."""
    noun, _, rest = words.partition(" ")
    return f"{noun.removesuffix('s')} {rest}".rstrip() if count == 1 else words


def warnings_section(
    faults: Mapping[str, int],
    settings: Mapping[str, Any],
    provenance: Mapping[str, Any],
    missing: Sequence[str],
) -> Section:
    """What a reader should know before trusting the numbers."""
    points = [
        f"{count} {_counted(_FAULTS.get(name, name.replace('_', ' ')), count)}."
        for name, count in faults.items()
        if count
    ]
    for notes in (settings.get("notes"), provenance.get("notes"), provenance.get("warnings")):
        if isinstance(notes, Sequence) and not isinstance(notes, str):
            points += [str(note) for note in notes]
    points += missing
    text = () if points else ("Nothing was found that needs a warning.",)
    return Section(
        "warnings", "What to know about this recording", text, tuple(dict.fromkeys(points))
    )


def methods_section(
    records: Sequence[tuple[str, Mapping[str, Any]]], provenance: Mapping[str, Any] | None = None
) -> Section:
    """Every setting, version, seed and input digest, and the commands that repeat the work."""
    groups = []
    commands = []
    told: dict[str, tuple[str, frozenset[tuple[str, str]]]] = {}
    for name, record in records:
        every = [*record.get("earlier", []), record]
        for part in every:
            settings = part.get("settings", {} if "command" in part else part)
            label = f"{name}: " if name else ""
            command = str(part.get("command", "analysis"))
            if settings:
                entries = flatten(settings)
                first, known = told.setdefault(command, (name, frozenset(entries)))
                title = f"{label}Settings of {command}"
                if first != name:
                    title += f", where they differ from those of {first}"
                    entries = tuple(entry for entry in entries if entry not in known)
                groups.append(Settings(title, entries))
            inputs = part.get("inputs", {})
            if inputs:
                groups.append(
                    Settings(f"{label}Inputs of {command} (SHA-256)", tuple(inputs.items()))
                )
            commands += command_lines(part)
    if provenance:
        kept = {k: v for k, v in provenance.items() if k not in {"notes", "warnings"}}
        groups.append(Settings("How the tracks were made", flatten(kept)))
    groups.append(Settings("Versions", _versions()))
    return Section(
        "methods",
        "Methods",
        text=("Everything needed to obtain the same numbers again.",),
        settings=tuple(groups),
        commands="\n".join(dict.fromkeys(commands)),
    )


def command_lines(record: Mapping[str, Any]) -> list[str]:
    """The command line that repeats one recorded run, with the options that were set."""
    import shlex

    command = record.get("command")
    settings = record.get("settings", {})
    inputs = list(record.get("inputs", {}))
    if command == "track" and inputs:
        words = ["cellquant", "track", inputs[0], "-o", "RESULTS"]
        if settings.get("raw"):
            words += ["--raw", str(settings["raw"])]
        if settings.get("length_unit") == "px":
            words += ["--units", "pixel"]
        else:
            words += ["--pixel-size", f"{settings.get('pixel_size')}"]
            words += ["--frame-interval", f"{settings.get('frame_interval')}"]
        if settings.get("max_distance") is not None:
            words += ["--max-distance", f"{settings['max_distance']}"]
        if settings.get("divisions") is False:
            words.append("--no-divisions")
        if settings.get("linker", "cues") != "cues":
            words += ["--linker", str(settings["linker"])]
        return [shlex.join(words)]
    if command == "observe":
        words = ["cellquant", "observe", str(settings.get("source", "RESULTS")), "-o", "RESULTS"]
        return [shlex.join([*words, *_observe_options(settings)])]
    if command in {"run", "sweep"}:
        # A stack or a scene is made by the file of the whole.
        given = [name for name in inputs if name.endswith(".toml")]
        file = given[0] if given else {"run": "EXPERIMENT.toml", "sweep": "SWEEP.toml"}[command]
        return [shlex.join(["cellquant", command, file, "-o", "RESULTS"])]
    if command == "demo":
        return [f"cellquant demo --seed {settings.get('seed', 1)} -o RESULTS"]
    if command == "simulate":
        return [shlex.join(["cellquant", "simulate", *inputs[:1], "-o", "RUN.zarr"])]
    return []


_OBSERVE_DEFAULTS = {
    "drift": True,
    "keep_cut_cells": False,
    "wave_number": "2pi/d",
    "scattering": "bessel",
    "stride": 1,
    "max_frames": 32,
}


def _observe_options(settings: Mapping[str, Any]) -> list[str]:
    """Options of observe that were set to something else than the default."""
    words: list[str] = []
    for name, value in settings.items():
        if value is None or name in {"source", "stage"} or value == _OBSERVE_DEFAULTS.get(name):
            continue
        option = f"--{name.replace('_', '-')}"
        if name == "only":
            words += [word for item in value for word in (option, str(item))]
        elif isinstance(value, bool):
            words.append(option if value else f"--no-{option[2:]}")
        elif name in {"core_range", "tail_range"}:
            words += [option, *(f"{v:g}" for v in value)]
        elif isinstance(value, list | tuple):
            words += [option, ",".join(f"{v:g}" for v in value)]
        else:
            words += [option, str(value)]
    return words


def _versions() -> tuple[tuple[str, str], ...]:
    libraries = []
    for name in _LIBRARIES:
        try:
            libraries.append((name, metadata.version(name)))
        except metadata.PackageNotFoundError:
            continue
    return (("cellquant", __version__), ("Python", platform.python_version()), *libraries)


def tau_alpha_of(result: Result) -> tuple[float, float]:
    """Relaxation time and its standard error; NaN where not measured."""
    value = look_up(result.summary, "tau_alpha.value")
    error = look_up(result.summary, "tau_alpha.std_error")
    return (
        float(value) if value is not None else np.nan,
        float(error) if error is not None else np.nan,
    )
