"""The main job: the embedded recording from masks to numbers, and a loop with known truth."""

import shutil
from dataclasses import replace
from importlib.resources import as_file, files
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.closed_loop import GUARD, LENGTH, MSD, PIXEL, TIME, Loop, close_loop
from cellquant.config import SceneConfig
from cellquant.pipeline import Step, observe_into, silent, track_movie
from cellquant.storage import RunRecord, atomic_path, check_output, write_json

if TYPE_CHECKING:
    from cellquant.compare.groups import Group
    from cellquant.compare.page import Headline, Page, Section, Table


def demo_scene(seed: int) -> SceneConfig:
    """A layer that relaxes several times within the run, seen in ten frames per relaxation."""
    return SceneConfig(
        cells=256,
        phi=0.92,
        v0=0.07,
        eta=0.01,
        rotational_diffusion=0.02,
        transient=40,
        duration=210,
        save_every=3.5,
        seed=seed,
    )


def run_demo(out: str | Path, *, seed: int = 1, step: Step = silent) -> Path:
    """Analyse the embedded recording, close the loop on a simulated layer, and report both.

    Parameters
    ----------
    out
        Output folder: ``report.html``; ``recording`` with the masks, tables and ``summary.json``
        of the embedded recording; ``layer`` with the simulated run, its masks, and what was
        measured on both.
    seed
        Seed of the simulated layer.
    step
        Gives a progress callback for each stage.

    Returns
    -------
    pathlib.Path
        The report.

    Raises
    ------
    InputError
        If the output cannot be written.
    """
    from cellquant.compare.page import write_page

    folder = check_output(out)
    scene = demo_scene(seed)
    record = RunRecord("demo", {"seed": seed})
    page = _analyse_recording(folder / "recording", record, step)
    loop = close_loop(scene, folder / "layer", step=step)
    record.stages += loop.record.stages
    record.settings = {**record.settings, "closed_loop": dict(loop.settings)}
    report = folder / "report.html"
    with record.stage("report"), step("report"):
        section = _loop_section(folder / "layer", loop, scene)
        write_page(_joined(page, section, loop), report)
    record.write(folder)
    return report


def _analyse_recording(folder: Path, record: RunRecord, step: Step) -> "Page":
    """From the masks of the embedded recording to its report."""
    from cellquant.compare.report import build_report
    from cellquant.compare.results import read_result
    from cellquant.io import inspect_labels, read_labels

    with as_file(files("cellquant") / "demo_data") as embedded:
        for name in ("masks.tif", "NOTICE.md"):
            with atomic_path(folder / name) as path:
                shutil.copyfile(embedded / name, path)
    masks = read_labels(folder / "masks.tif", units="pixel")
    with step("inspect") as progress:
        write_json(folder / "inspection.json", inspect_labels(masks, progress=progress).as_dict())
    cells, tracks, made = track_movie(masks, folder, step=step)
    observables = observe_into(tracks, folder, made, step=step)
    made.command = "demo"
    made.inputs = {Path(name).name: digest for name, digest in made.inputs.items()}
    made.settings = {**record.settings, **made.settings}
    made.write(folder)
    record.stages += made.stages
    title = "T98G glioma cells, phase contrast"
    return build_report(
        title=title,
        tracks=tracks,
        result=read_result(observables, name=title),
        settings=made.as_dict(),
        stack=masks,
        cells=cells,
    )


def _joined(recording: "Page", loop_section: "Section", loop: Loop) -> "Page":
    """The closed loop first, then the recording, on one page."""
    from cellquant.compare.page import Settings, flatten

    first, *others, methods = recording.sections
    settings = Settings("Settings of the closed loop", flatten(loop.settings))
    methods = replace(methods, settings=(settings, *methods.settings))
    opened = replace(
        first,
        title="A real recording: results",
        text=(
            f"{recording.title}; from here on the page is about this recording. {recording.lede}",
            *first.text,
        ),
    )
    return replace(
        recording,
        title="Simulation beside experiment",
        lede="Part one: a simulated layer is filmed, measured like any movie, and held against "
        "what is known of it. Part two: a real recording, measured by the same program. The "
        "numbers below say how far the measurement was off.",
        glance=_headlines(loop),
        sections=(loop_section, opened, *others, methods),
    )


def _headlines(loop: Loop) -> "tuple[Headline, ...]":
    """Errors of the measurement on masks, by quantity."""
    from cellquant.compare.page import Headline

    errors = loop.table.set_index("quantity")["error"]
    return tuple(
        Headline(f"Error of the {name}", _per_cent(float(errors[name])))
        for name in (
            "mean shape index",
            "mean diameter",
            "mean speed",
            MSD.label,
            "relaxation time",
        )
    )


_SMOOTHED = ("mean speed", MSD.label, "relaxation time")
_UNITS = {
    "1": "none",
    "L0": "L_{0}",
    "L0^2": "L_{0}^{2}",
    "t0": "t_{0}",
    "L0/t0": "L_{0}/t_{0}",
    "d": "d",
    "d^2": "d^{2}",
}


def _per_cent(share: float) -> str:
    if isnan(share):
        return "not known"
    return f"{_signed(100 * share)}\N{NO-BREAK SPACE}%"


def _signed(value: float) -> str:
    """A number with its sign, to two digits after the point; zero has none."""
    from cellquant.compare.page import MINUS

    rounded = round(value, 2)
    return f"{rounded:+.2f}".replace("-", MINUS) if rounded else "0.00"


_STEP_TEXTS = (
    "Frame interval: the camera sees one state in five that the run saved; what happens in between "
    "is not seen. σ^{2} and ξ belong to the frame next to the relaxation time.",
    "Finite window: a field of view loses the cells that leave it, the fast ones first, and motion "
    f"with them. So the camera sees the layer, which is periodic, and a strip of {GUARD:g} cell "
    "diameters of its continuation around it; the cells that start inside the strip are followed, "
    "each cell of the layer once, and lost only when they cross the whole strip.",
    "Pixels: cells are drawn on a grid, and where two overlap each pixel goes to one of them.",
    "Linking: cells that were followed wrongly from frame to frame.",
)


def _error_table(loop: Loop) -> "Table":
    """Truth, measurement, error and its parts."""
    from cellquant.compare.page import Row, Table, format_value

    steps = [name for name in loop.table.columns if name.startswith("from_")]
    rows = []
    for row in _records(loop):
        shares = [float(row[name]) for name in ("error", *steps)]
        rows.append(
            Row(
                (
                    row["quantity"],
                    format_value(row["truth"], row["truth_std_error"]),
                    format_value(row["measured"], row["measured_std_error"]),
                    _UNITS[row["unit"]],
                    _per_cent(shares[0]),
                    "–" if isnan(shares[0]) else _signed(row["error_in_std_errors"]),
                    *(_per_cent(share) for share in shares[1:]),
                ),
                "none" if isnan(shares[0]) else "",
            )
        )
    return Table(
        name="closed-loop",
        caption="Truth and measurement of the same layer, value ± standard error, in units of the "
        "model (L_{0}: diameter of a mean cell; t_{0}: time in which contact forces act; d: mean "
        "diameter as measured). Nothing is smoothed. A standard error says how far another layer "
        "of this size would be off; both sides show the same cells, so that they are closer to "
        "each other. In the column after the error, measured minus truth is in standard errors of "
        "the measured value. The four columns on the right are the parts of the error, step by "
        "step as named above. From layer/closed_loop.json.",
        columns=(
            "Quantity",
            "Truth",
            "Measured",
            "Unit",
            "Error",
            "Error in standard errors",
            *(name.replace("_", " ") for name in steps),
        ),
        classes=("", "number", "number", "", "number", "number", *("number" for _ in steps)),
        rows=tuple(rows),
        data=loop.table,
    )


def _smoothing_table(loop: Loop) -> "Table":
    """The same with the smoothing that movies get by default, on both sides."""
    from cellquant.compare.page import Row, Table, format_value

    rows = [
        Row(
            (
                row["quantity"],
                format_value(row["truth_smoothed"], row["truth_smoothed_std_error"]),
                format_value(row["measured_smoothed"], row["measured_smoothed_std_error"]),
                _UNITS[row["unit"]],
                _per_cent(row["error_smoothed"]),
                _per_cent(row["smoothing_adds"]),
            )
        )
        for row in _records(loop)
        if row["quantity"] in _SMOOTHED
    ]
    return Table(
        name="closed-loop-smoothed",
        caption="The same with trajectories smoothed over five points, as those of movies are by "
        "default, on both sides. With ten frames in one relaxation time smoothing changes what is "
        "measured by as much as the last column says: compare a smoothed movie with a smoothed "
        "simulation only. From layer/closed_loop.json.",
        columns=("Quantity", "Truth", "Measured", "Unit", "Error", "Smoothing changes it by"),
        classes=("", "number", "number", "", "number", "number"),
        rows=tuple(rows),
    )


def _records(loop: Loop) -> list[dict[str, Any]]:
    return [{str(k): v for k, v in row.items()} for row in loop.table.to_dict("records")]


def _in_one_period(group: "Group", loop: Loop) -> "Group":
    """The group with its paths drawn in one period of the layer, on masks as in the run."""
    from cellquant.tables import REDUCED

    result = group.members[0]
    if result.tracks is None or result.tracks.units == REDUCED:
        return group
    width, height = (LENGTH * edge for edge in loop.run.box)
    tracks = replace(result.tracks, box=(width, height))
    return replace(group, trials={"1": (replace(result, tracks=tracks),)})


def _loop_section(folder: Path, loop: Loop, scene: SceneConfig) -> "Section":
    """The closed loop on the page: the table of errors and the two sides in matched figures."""
    from cellquant.compare import layers, matched_figures
    from cellquant.compare.groups import read_groups
    from cellquant.compare.page import Section

    tables = (_error_table(loop), _smoothing_table(loop))
    groups = read_groups(
        [folder / "found", folder / "truth"], names=["measured on masks", "known truth"]
    )
    seen = [_in_one_period(group, loop) for group in layers.add_sources(groups)]
    figures = (
        layers.layer_figure(seen),
        *layers.path_figures(seen),
        matched_figures.shape_figure(groups),
        matched_figures.scattering_figure(groups),
        matched_figures.displacement_figure(groups),
        matched_figures.hove_figure(groups),
    )
    return Section(
        "closed-loop",
        "Can the numbers be trusted? A closed loop",
        text=(
            f"A layer of {scene.cells} deformable cells was simulated (φ = {scene.phi:g}, "
            f"v_{{0}} = {scene.v0:g}, η = {scene.eta:g}), drawn as label masks with "
            f"{LENGTH / PIXEL:.0f} pixels per cell diameter and one frame every "
            f"{(scene.save_every or 1) * TIME:g} min, and measured by the same program as the "
            "recording. What it should have found is known exactly.",
        ),
        points=_STEP_TEXTS,
        tables=tables,
        # The recording has figures of the same kinds on the same page.
        figures=tuple(replace(f, name=f"loop-{f.name}") for f in figures if f is not None),
    )
