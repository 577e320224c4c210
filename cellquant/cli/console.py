"""What the program says while it works: a bar on a terminal, plain lines elsewhere, or JSON.

Results go to standard output; progress, notes and errors go to standard error.
"""

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from enum import StrEnum
from typing import Annotated, Any

import typer

ProgressCallback = Callable[[int, int], None]
LINE_EVERY = 30.0  # seconds between plain lines of a long step
JSON_EVERY = 1.0  # seconds between JSON lines


class Progress(StrEnum):
    auto = "auto"
    plain = "plain"
    json = "json"


_chosen = Progress.auto


def _choose(progress: Progress) -> Progress:
    global _chosen
    _chosen = progress
    return progress


ProgressOption = Annotated[
    Progress,
    typer.Option(
        "--progress",
        callback=_choose,
        help="'auto' is a bar on a terminal and plain lines elsewhere; 'json' is one JSON object "
        "per line on standard error.",
    ),
]


def say(text: str) -> None:
    """Print a line of the result."""
    print(text)


def note(text: str) -> None:
    """Print a line about the work, on standard error."""
    if _chosen is Progress.json:
        _emit("note", text=text)
    else:
        print(text, file=sys.stderr, flush=True)


def complain(text: str) -> None:
    """Print the one sentence with which a command ends in error, on standard error."""
    if _chosen is Progress.json:
        _emit("error", text=text)
    else:
        print(f"cellquant: error: {text}", file=sys.stderr, flush=True)


def say_json(content: Any) -> None:
    """Print a result for programs: JSON with sorted keys."""
    print(json.dumps(content, indent=2, sort_keys=True, allow_nan=False))


def _emit(event: str, **content: Any) -> None:
    line = json.dumps({"event": event, **content}, sort_keys=True, allow_nan=False)
    print(line, file=sys.stderr, flush=True)


class _Clock:
    """How far a step is and how long it will take; work found done at the start costs nothing."""

    def __init__(self) -> None:
        self.started = time.monotonic()
        self.first: int | None = None
        self.done = self.total = 0

    def move(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        if self.first is None:
            self.first = done

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.started

    @property
    def speed(self) -> float | None:
        """Units of work per second so far; None before anything is done."""
        worked = self.done - (self.first or 0)
        return worked / self.elapsed if worked > 0 and self.elapsed > 0.0 else None

    @property
    def left(self) -> float | None:
        """Seconds left at the speed so far; None before anything is done."""
        return None if self.speed is None else (self.total - self.done) / self.speed


@contextlib.contextmanager
def step(label: str, unit: str = "frames") -> Iterator[ProgressCallback]:
    """Show one step of the work; yields the callback (done, total) that moves it on."""
    clock = _Clock()
    if _chosen is Progress.json:
        _emit("start", step=label)
        yield _in_json(label, unit, clock)
        _emit("end", step=label, unit=unit, done=clock.done, total=clock.total, **_times(clock))
        return
    if _chosen is Progress.auto and sys.stderr.isatty():
        with _bar(label, unit, clock) as move:
            yield move
    else:
        yield _in_lines(label, unit, clock)
    count = f", {clock.total} {unit}" if clock.total else ""
    note(f"{label}: {clock.elapsed:.1f} s{count}")


@contextlib.contextmanager
def _bar(label: str, unit: str, clock: _Clock) -> Iterator[ProgressCallback]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None, speed="")

        def move(done: int, total: int) -> None:
            clock.move(done, total)
            bar.update(task, completed=done, total=total, speed=_speed(clock, unit))

        yield move


def _in_lines(label: str, unit: str, clock: _Clock) -> ProgressCallback:
    last = clock.started

    def move(done: int, total: int) -> None:
        nonlocal last
        clock.move(done, total)
        if time.monotonic() - last >= LINE_EVERY and done < total:
            last = time.monotonic()
            left = (
                f", {_speed(clock, unit)}, about {_duration(clock.left)} left" if clock.left else ""
            )
            note(f"{label}: {done} of {total} {unit} after {_duration(clock.elapsed)}{left}")

    return move


def _in_json(label: str, unit: str, clock: _Clock) -> ProgressCallback:
    last = -JSON_EVERY

    def move(done: int, total: int) -> None:
        nonlocal last
        clock.move(done, total)
        if time.monotonic() - last >= JSON_EVERY or done == total:
            last = time.monotonic()
            _emit("progress", step=label, unit=unit, done=done, total=total, **_times(clock))

    return move


def _times(clock: _Clock) -> dict[str, float | None]:
    left, speed = clock.left, clock.speed
    return {
        "elapsed_s": round(clock.elapsed, 3),
        "left_s": None if left is None else round(left, 3),
        "per_s": None if speed is None else float(f"{speed:.4g}"),
    }


def _speed(clock: _Clock, unit: str) -> str:
    """Speed so far in words, e.g. ``12 t0/s``."""
    return "" if clock.speed is None else f"{clock.speed:.3g} {unit}/s"


def _duration(seconds: float) -> str:
    """A duration in words, e.g. ``45 s``, ``12 min``, ``3.4 h``, ``2.1 days``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172_800 else f"{seconds / 86_400:.1f} days"
