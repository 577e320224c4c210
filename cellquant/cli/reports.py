"""Commands that bring things together: demo, compare, convert-units, config."""

from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cellquant.cli.console import note, say, say_json, step


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


def compare(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Results to compare: folders of observe, run or sweep; experiments and runs.",
            metavar="EXPERIMENT_DIR SIMULATION_DIR...",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The HTML page; comparison.json goes beside it.")
    ],
    fit: Annotated[
        bool,
        typer.Option("--fit", help="Rank the scenes of a sweep and estimate phi, v0 and eta."),
    ] = False,
    units: Annotated[
        Path | None,
        typer.Option(
            help="Units file that fixes L0 and t0 (see convert-units), so that the fit may use "
            "lengths and times."
        ),
    ] = None,
    steric_area: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="UM^2 ERROR",
            help="Area that a cell takes in a dense layer and its standard error, for the "
            "effective packing fraction of movies; 400 to 500 um^2 when not given, as for HeLa.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fit.")] = 0,
) -> None:
    """Put experiments and simulations side by side: a report, and comparison.json beside it."""
    from cellquant.compare import compare as compare_results
    from cellquant.compare.comparison import AGREE, DIFFER, NOT_COMPARABLE
    from cellquant.compare.units import STERIC_AREA
    from cellquant.storage import check_output

    check_output(output.parent)
    with step("compare"):
        comparison = compare_results(
            *sources, steric_area=steric_area or STERIC_AREA, fit=fit, units=units, seed=seed
        )
        comparison.to_html(output)
        comparison.to_json(output.with_name("comparison.json"))
    for first, second in comparison.pairs():
        verdicts = comparison.verdicts(first, second)
        counts = Counter(v.verdict for v in verdicts)
        found = ", ".join(f"{counts[word]} {word}" for word in (AGREE, DIFFER, NOT_COMPARABLE))
        say(f"{first.name} and {second.name}: {found}")
    for found_fit in comparison.fits:
        say(f"{found_fit.target}: {found_fit.ranking.statement()}")
    note(f"wrote {output} and {output.with_name('comparison.json')}")


def convert_units(
    file: Annotated[Path, typer.Argument(help="TOML file with [measured] and/or [reduced].")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Turn measured quantities into reduced parameters and back, with propagated errors."""
    from cellquant.compare.units import convert_units_file, render_units

    converted = convert_units_file(file)
    if json:
        say_json(converted)
    else:
        say(render_units(converted))


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
    app.command()(compare)
    app.command()(convert_units)
    app.add_typer(config, name="config")
