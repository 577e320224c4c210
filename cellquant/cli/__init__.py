"""The command line: read, call, write; no science.

Heavy modules are imported inside the commands, so that ``cellquant --help`` starts at once.
"""

import os
import signal
import sys
import threading
from types import FrameType

import typer

from cellquant import __version__
from cellquant.cli import batch, layers, movies, reports
from cellquant.cli.console import complain
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


for module in (movies, layers, batch, reports):
    module.register(app)


GRACE = 5  # seconds to end in order after an interruption


class _Interruption:
    """Whether the program was asked to stop."""

    asked = False


def _interrupt(number: int, frame: FrameType | None) -> None:
    _Interruption.asked = True
    # What was under way may swallow the exception: a compiler does, or a finaliser.
    sys.unraisablehook = lambda _: None
    last = threading.Timer(GRACE, os._exit, (130,))
    last.daemon = True
    last.start()
    raise KeyboardInterrupt


def main() -> None:
    """Run the program; exit codes: 0 done, 2 wrong input, 1 a fault of ours, 130 interrupted."""
    # A batch system ends a job with SIGTERM: that is an interruption like any other.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        _run()
    except BaseException:
        # An interruption may arrive as another error, from a library that was being loaded.
        if _Interruption.asked:
            sys.exit(130)
        raise


def _run() -> None:
    try:
        app()
    except InputError as error:
        complain(str(error))
        sys.exit(2)
    except OSError as error:
        from cellquant.storage import disk_problem

        problem = disk_problem(error)
        if problem is None:
            raise
        complain(problem)
        sys.exit(2)
