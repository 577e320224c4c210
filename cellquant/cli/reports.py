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
    app.add_typer(config, name="config")
