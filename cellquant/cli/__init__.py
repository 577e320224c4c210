"""The command line: read, call, write; no science.

Heavy modules are imported inside the commands, so that ``cellquant --help`` starts at once.
"""

import sys

import typer

from cellquant import __version__
from cellquant.cli import layers, movies, reports
from cellquant.errors import InputError

app = typer.Typer(
    name="cellquant",
    help="Trajectories, glassy dynamics and simulations of dense cell layers, side by side.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(show: bool) -> None:
    if show:
        print(f"cellquant {__version__}")
        raise typer.Exit


@app.callback()
def _program(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


for module in (movies, layers, reports):
    module.register(app)


def main() -> None:
    """Run the program; exit codes: 0 done, 2 wrong input, 1 a fault of ours, 130 interrupted."""
    try:
        app()
    except InputError as error:
        print(f"cellquant: error: {error}", file=sys.stderr)
        sys.exit(2)
