"""Commands over many stacks or scenes: run, sweep, rerun."""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from cellquant.cli.console import Progress, ProgressOption, note, say, say_json, step
from cellquant.errors import InputError


class Emit(StrEnum):
    slurm_array = "slurm-array"


Workers = Annotated[
    int, typer.Option(help="Local worker processes; they share the cores among them.")
]
Scheduler = Annotated[str | None, typer.Option(help="Address or scheduler file of a Dask cluster.")]
Part = Annotated[
    str | None,
    typer.Option(help="Work on part I of N alone, I from 0 on; gathers nothing.", metavar="I/N"),
]
EmitOption = Annotated[
    Emit | None, typer.Option(help="Write a job script into the output folder, and stop.")
]
Parts = Annotated[
    int | None, typer.Option(help="Elements of the job array; one per task by default.")
]


def run(
    experiment: Annotated[Path, typer.Argument(help="experiment.toml")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Output folder.")],
    workers: Workers = 1,
    scheduler: Scheduler = None,
    part: Part = None,
    emit: EmitOption = None,
    parts: Parts = None,
    progress: ProgressOption = Progress.auto,
) -> None:
    """Work through a whole study; run it again to resume, finished stacks are not repeated."""
    from cellquant.batch import count_stacks, run_experiment

    if emit is not None:
        _emit(lambda: count_stacks(experiment), "run", experiment, output, parts)
        return
    _check(workers, scheduler, part, parts)
    with step("stacks", unit="stacks") as move:
        outcome = run_experiment(
            experiment, output, workers=workers, scheduler=scheduler, part=part, progress=move
        )
    _report(outcome, "stacks")
    if part is None:
        note(f"wrote {output / 'report.html'}")


def sweep(
    file: Annotated[Path, typer.Argument(help="sweep.toml", metavar="SWEEP.toml")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Output folder.")] = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
    part: Part = None,
    emit: EmitOption = None,
    parts: Parts = None,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Print what the sweep would cost, and stop.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the estimate as JSON.")] = False,
    progress: ProgressOption = Progress.auto,
) -> None:
    """Simulate a grid or list of scenes with several seeds; run it again to resume."""
    from cellquant.sweep import count_runs, run_sweep

    _check(workers, scheduler, part, parts if emit is None else None)
    if estimate:
        from cellquant.estimate import estimate_sweep

        with step("pilot runs", unit="runs") as move:
            cost = estimate_sweep(file, workers=workers, progress=move)
        if json:
            say_json(cost.as_dict())
        else:
            _say_lines(cost.as_lines())
        return
    if output is None:
        raise InputError("sweep needs an output folder: -o DIR (or '--estimate' for its cost).")
    if emit is not None:
        _emit(lambda: count_runs(file), "sweep", file, output, parts)
        return
    with step("runs", unit="runs") as move:
        outcome = run_sweep(
            file, output, workers=workers, scheduler=scheduler, part=part, progress=move
        )
    _report(outcome, "runs")
    if part is None:
        note(f"wrote {output / 'sweep.parquet'}")


def rerun(
    folder: Annotated[Path, typer.Argument(help="An output folder, or a RUN.zarr.", metavar="DIR")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Keep the repetition here; thrown away by default."),
    ] = None,
    workers: Workers = 1,
    json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
    progress: ProgressOption = Progress.auto,
) -> None:
    """Repeat a recorded run and report any difference; exit code 1 where results differ."""
    from cellquant.rerun import repeat

    _check(workers, None, None, None)
    with step("repeat", unit="tasks") as move:
        found = repeat(folder, output, workers=workers, progress=move)
    if json:
        say_json(found.as_dict())
    else:
        _say_lines(found.as_lines())
    if not found.equal:
        raise typer.Exit(1)


def _check(workers: int, scheduler: str | None, part: str | None, parts: int | None) -> None:
    if workers < 1:
        raise InputError(f"--workers must be at least 1, got {workers}.")
    if parts is not None:
        raise InputError("--parts belongs to '--emit slurm-array'; for one part use --part I/N.")
    if part is not None and scheduler is not None:
        raise InputError("--part and --scheduler exclude each other; leave one of them out.")


def _emit(
    count: Callable[[], int], command: str, file: Path, output: Path, parts: int | None
) -> None:
    from cellquant.slurm import write_array

    script = write_array(command, file, output, n_tasks=count(), parts=parts)
    say(f"submit with: sbatch {script}")


def _report(outcome: Any, noun: str) -> None:
    _say_lines(outcome.as_lines(noun))
    if outcome.failures:
        raise typer.Exit(2 if outcome.only_input_errors else 1)


def _say_lines(lines: list[str]) -> None:
    for line in lines:
        say(line)


def register(app: typer.Typer) -> None:
    """Add these commands to the program."""
    for command in (run, sweep, rerun):
        app.command()(command)
