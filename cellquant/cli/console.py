"""What the program says while it works: a bar on a terminal, one plain line per step elsewhere.

Results go to standard output; progress and notes go to standard error.
"""

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

ProgressCallback = Callable[[int, int], None]


def say(text: str) -> None:
    """Print a line of the result."""
    print(text)


def note(text: str) -> None:
    """Print a line about the work, on standard error."""
    print(text, file=sys.stderr, flush=True)


def say_json(content: Any) -> None:
    """Print a result for programs: JSON with sorted keys."""
    print(json.dumps(content, indent=2, sort_keys=True, allow_nan=False))


@contextlib.contextmanager
def step(label: str, unit: str = "frames") -> Iterator[ProgressCallback]:
    """Show one step of the work; yields the callback (done, total) that moves it on."""
    started = time.perf_counter()
    last = (0, 0)

    def count() -> str:
        return f", {last[1]} {unit}" if last[1] else ""

    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(label, total=None)

            def move(done: int, total: int) -> None:
                nonlocal last
                last = (done, total)
                bar.update(task, completed=done, total=total)

            yield move
    else:

        def move(done: int, total: int) -> None:
            nonlocal last
            last = (done, total)

        yield move
    note(f"{label}: {time.perf_counter() - started:.1f} s{count()}")
