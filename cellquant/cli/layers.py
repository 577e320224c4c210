"""Commands of the simulation side: simulate, render, convergence."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from cellquant.cli.console import Progress, ProgressOption, note, say, step

SceneFile = Annotated[
    Path | None, typer.Argument(help="scene.toml; options given besides override it.")
]


class Contact(StrEnum):
    exact = "exact"
    quadrature = "quadrature"


def simulate(
    output: Annotated[Path, typer.Option("-o", "--output", help="The run, e.g. RUN.zarr.")],
    scene: SceneFile = None,
    phi: Annotated[float | None, typer.Option(help="Packing fraction.")] = None,
    v0: Annotated[float | None, typer.Option(help="Self-propulsion speed, L0/t0.")] = None,
    eta: Annotated[float | None, typer.Option(help="Line tension, k L0.")] = None,
    cells: Annotated[int | None, typer.Option(help="Number of cells.")] = None,
    polydispersity: Annotated[
        float | None, typer.Option(help="Spread of the radii over their mean.")
    ] = None,
    modes: Annotated[int | None, typer.Option(help="Highest contour mode; 1 is rigid.")] = None,
    duration: Annotated[float | None, typer.Option(help="Saved time, t0.")] = None,
    transient: Annotated[float | None, typer.Option(help="Time before it, t0, not saved.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    contact: Annotated[Contact | None, typer.Option(help="Contact rule.")] = None,
    points: Annotated[
        int | None, typer.Option(help="Contour points of the quadrature rule.")
    ] = None,
    integrator: Annotated[str | None, typer.Option(help="Name of the integrator.")] = None,
    dt: Annotated[float | None, typer.Option(help="Time step, t0.")] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Error tolerance of the adaptive integrator, L0.")
    ] = None,
    save_every: Annotated[float | None, typer.Option(help="Time between saved states, t0.")] = None,
    progress: ProgressOption = Progress.auto,
) -> None:
    """Simulate one layer; run the same command again to resume one that was interrupted."""
    from cellquant.cli.text import run_lines
    from cellquant.config import SceneConfig, load, read_toml, validate
    from cellquant.pipeline import simulate_scene

    given: dict[str, Any] = {
        "phi": phi,
        "v0": v0,
        "eta": eta,
        "cells": cells,
        "polydispersity": polydispersity,
        "modes": modes,
        "duration": duration,
        "transient": transient,
        "seed": seed,
        "contact": None if contact is None else contact.value,
        "points": points,
        "integrator": integrator,
        "dt": dt,
        "tolerance": tolerance,
        "save_every": save_every,
    }
    content = {} if scene is None else read_toml(scene)
    if scene is not None:
        load(scene, SceneConfig)
    content |= {key: value for key, value in given.items() if value is not None}
    config = validate(content, SceneConfig, where=str(scene or "options"))
    run = simulate_scene(config, output, step=lambda label: step(label, unit="t0"))
    for line in run_lines(run):
        say(line)
    note(f"wrote {output}")


def render(
    run: Annotated[Path, typer.Argument(help="RUN.zarr")],
    output: Annotated[Path, typer.Option("-o", "--output", help="TIFF of the label masks.")],
    pixel_size: Annotated[float, typer.Option(help="Edge of a pixel in um.", metavar="UM")],
    length: Annotated[
        float, typer.Option(help="One L0 (mean cell diameter) in um.", metavar="UM_PER_L0")
    ] = 10.0,
    time: Annotated[
        float, typer.Option(help="One t0 in min; 10 s by default.", metavar="MIN_PER_T0")
    ] = 1.0 / 6.0,
    phase_contrast: Annotated[
        Path | None, typer.Option(help="TIFF of a movie that looks like phase contrast.")
    ] = None,
) -> None:
    """Render a run as label masks, with its true tracks and contours in OUTPUT_truth."""
    from cellquant.sim import open_run
    from cellquant.sim import render as render_run
    from cellquant.storage import check_output

    check_output(output.parent)
    with step("render") as progress:
        done = render_run(
            open_run(run),
            output,
            pixel_size=pixel_size,
            length=length,
            time=time,
            phase_contrast=phase_contrast,
            progress=progress,
        )
    height, width = done.shape
    say(f"masks: {done.masks}, {width} x {height} px")
    say(f"true tracks: {done.truth}, {done.tracks.n_tracks} tracks")


def convergence(
    output: Annotated[Path, typer.Option("-o", "--output", help="Output folder.")],
    scene: SceneFile = None,
    cells: Annotated[int | None, typer.Option(help="Number of cells.")] = None,
    duration: Annotated[float, typer.Option(help="Time of the comparison, t0.")] = 4.0,
    transient: Annotated[float, typer.Option(help="Time before it, t0.")] = 60.0,
    weak_duration: Annotated[
        float, typer.Option(help="Length of the runs for the errors of averages, t0; 0 for none.")
    ] = 200.0,
    seeds: Annotated[
        list[int] | None, typer.Option("--seed", help="A repetition; may be given repeatedly.")
    ] = None,
    points: Annotated[
        list[int] | None,
        typer.Option(help="Contour points of the quadrature rule; may be given repeatedly."),
    ] = None,
    integrators: Annotated[
        list[str] | None,
        typer.Option("--integrator", help="One to measure; may be given repeatedly."),
    ] = None,
) -> None:
    """Measure error against run time of contact rules, integrators and steps."""
    from cellquant.config import SceneConfig, read_toml, validate
    from cellquant.sim import Scene
    from cellquant.sim import convergence as measure
    from cellquant.storage import check_output

    check_output(output)
    content = {"cells": 144} if scene is None else read_toml(scene)
    if cells is not None:
        content["cells"] = cells
    config = validate(content, SceneConfig, where=str(scene or "options"))
    with step("convergence", unit="runs") as progress:
        found = measure(
            Scene.from_config(config),
            output,
            duration=duration,
            transient=transient,
            weak_duration=weak_duration,
            seeds=seeds or (1, 2, 3),
            points=points or (40,),
            integrators=integrators,
            progress=progress,
        )
    say(found.recommendation["text"])
    note(f"wrote {output / 'convergence.parquet'}")


def register(app: typer.Typer) -> None:
    """Add these commands to the program."""
    for command in (simulate, render, convergence):
        app.command()(command)
