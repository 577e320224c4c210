"""Commands that bring things together: demo, run, config."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cellquant.cli.console import note, say, step


class ConfigKind(StrEnum):
    experiment = "experiment"
    scene = "scene"
    sweep = "sweep"


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Output folder.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
) -> None:
    """Run the main job on the embedded recording: masks to tracks to observables to a report."""
    from cellquant.demo import run_demo

    report = run_demo(output, seed=seed, step=step)
    note(f"open {report}")


def run(
    experiment: Annotated[Path, typer.Argument(help="experiment.toml")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Output folder.")],
    workers: Annotated[int, typer.Option(help="Local worker processes.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address or scheduler file of a Dask cluster.")
    ] = None,
) -> None:
    """Work through a whole study; run it again to resume, finished stacks are not repeated."""
    from cellquant.batch import describe, run_experiment

    with step("stacks", unit="stacks") as progress:
        outcome = run_experiment(
            experiment, output, workers=workers, scheduler=scheduler, progress=progress
        )
    for line in describe(outcome):
        say(line)
    if outcome.failures:
        raise typer.Exit(2 if outcome.only_input_errors else 1)


config = typer.Typer(help="Configuration files.", no_args_is_help=True)


@config.command("init")
def config_init(
    kind: Annotated[ConfigKind, typer.Argument(help="Which file.")],
) -> None:
    """Print a commented template."""
    from cellquant.config import TEMPLATES

    say(TEMPLATES[kind.value].rstrip("\n"))


def register(app: typer.Typer) -> None:
    """Add these commands to the program."""
    app.command()(demo)
    app.command()(run)
    app.add_typer(config, name="config")
