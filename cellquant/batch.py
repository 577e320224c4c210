"""A whole study: every stack of every trial of every condition, resumable and in parallel.

Each stack is a task with a folder of its own. The folder's ``run.json`` is written last and holds
the key of the work (configuration, code, digest of the input): a task whose key is there is not
done again, and one whose configuration, code or input has changed is. Tracking has a key of its
own, so that other observables are measured on the tracks that are there.
"""

import glob
import shutil
from collections.abc import Callable
from pathlib import Path

from cellquant.config import ConditionConfig, ExperimentConfig, TrialConfig, load
from cellquant.engines import BatchOutcome, Task, check_code, run_tasks, share
from cellquant.errors import InputError
from cellquant.fingerprint import code_digest
from cellquant.lock import LOCK, only_writer
from cellquant.storage import (
    FINISHED,
    MANIFEST,
    STARTED,
    RunRecord,
    begin,
    check_output,
    clear_disk_errors,
    content_key,
    digest,
    earlier_record,
    finished_key,
    make_folder,
    remove_partial,
    write_json,
)
from cellquant.study import write_study

Progress = Callable[[int, int], None]


def find_stacks(config: ExperimentConfig, base: Path) -> list[Task]:
    """List the stacks of an experiment, in the order of the file and then of the names.

    Raises
    ------
    InputError
        If a pattern matches nothing, two stacks of a trial share a name, or the raw movies are
        not as many as the stacks.
    """
    tasks: list[Task] = []
    for condition in config.condition:
        for trial in condition.trial:
            stacks = _matches(trial.stacks, base, condition, trial)
            raw = _matches(trial.raw, base, condition, trial) if trial.raw else []
            if raw and len(raw) != len(stacks):
                raise InputError(
                    f"trial {trial.name!r} of {condition.name!r} has {len(stacks)} mask stacks "
                    f"and {len(raw)} raw movies; give one raw movie for each stack, or none."
                )
            names = [stack.stem for stack in stacks]
            for index, stack in enumerate(stacks):
                if stack.stem.startswith("."):
                    raise InputError(f"{stack} is a hidden file or folder; rename it.")
                if names.count(stack.stem) > 1:
                    raise InputError(
                        f"trial {trial.name!r} of {condition.name!r} has two stacks named "
                        f"{stack.stem!r}; rename one of them or make it another trial."
                    )
                tasks.append(
                    {
                        "label": f"{condition.name}/{trial.name}/{stack.stem}",
                        "condition": condition.name,
                        "trial": trial.name,
                        "name": stack.stem,
                        "masks": str(stack),
                        "raw": str(raw[index]) if raw else None,
                        "calibration": config.calibration.model_dump(),
                        "tracking": config.tracking.model_dump(),
                        "observables": config.observables.model_dump(),
                    }
                )
    return tasks


def count_stacks(path: str | Path) -> int:
    """Number of stacks of an experiment file."""
    path = Path(path)
    return len(find_stacks(load(path, ExperimentConfig), path.parent))


def _matches(
    patterns: list[str], base: Path, condition: ConditionConfig, trial: TrialConfig
) -> list[Path]:
    found: list[Path] = []
    for pattern in patterns:
        paths = sorted(glob.glob(str(base / pattern), recursive=True))
        if not paths:
            raise InputError(
                f"trial {trial.name!r} of {condition.name!r}: nothing matches {pattern!r} "
                f"in {base}; relative paths start at the experiment file."
            )
        found += [Path(path) for path in paths]
    return found


def task_folder(out: Path, task: Task) -> Path:
    """Where the results of one stack are kept."""
    return Path(out, "stacks", task["condition"], task["trial"], task["name"])


def work_on_stack(task: Task) -> None:
    """Track and observe one stack, as far as that is not done already."""
    check_code(task, "batch")
    folder = make_folder(task["folder"])
    with only_writer(folder, wait=True):
        if finished_key(folder, "run") != task["key"]:
            begin(folder, task["tracking_key"])
            _track_and_observe(task, folder)


def _track_and_observe(task: Task, folder: Path) -> None:
    from cellquant.compare.report import experiment_report
    from cellquant.io import read_images, read_labels
    from cellquant.pipeline import observe_into, track_movie
    from cellquant.rows import scan_tracks
    from cellquant.tables import read_cells, read_tracks

    calibration = task["calibration"]
    masks = read_labels(
        task["masks"],
        pixel_size=calibration["pixel_size"],
        frame_interval=calibration["frame_interval"],
        units="pixel" if calibration["units"] == "pixel" else None,
    )
    raw = None if task["raw"] is None else read_images(task["raw"])
    done = earlier_record(folder, "track", task["tracking_key"])
    if done is None:
        record = track_movie(
            masks, folder, raw=raw, options=task["tracking"], key=task["tracking_key"]
        )[2]
    else:
        record = RunRecord.from_dict(done)
        _keep_tracks_only(folder, record)
    # From the disk in either case, so that a resumed stack gives the same bytes.
    observables = observe_into(
        scan_tracks(folder),
        folder,
        record,
        options={
            **task["observables"],
            "condition": task["condition"],
            "trial": task["trial"],
        },
    )
    record.command = "run"
    record.settings = {name: value for name, value in task.items() if name != "folder"}
    with record.stage("report"):
        experiment_report(
            title=f"{task['condition']}, {task['trial']}, {task['name']}",
            tracks=read_tracks(folder),
            observables=observables,
            settings=record.as_dict(),
            out=folder / "report.html",
            stack=masks,
            raw=raw,
            cells=read_cells(folder),
        )
    record.write(folder)


def _keep_tracks_only(folder: Path, record: RunRecord) -> None:
    """Remove what was measured on the tracks with another configuration."""
    write_json(folder / MANIFEST, record.as_dict())
    kept = {MANIFEST, STARTED, LOCK, "cells.parquet", "tracks.parquet"}
    for entry in folder.iterdir():
        if entry.name not in kept:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def run_experiment(
    path: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    part: str | None = None,
    progress: Progress | None = None,
) -> BatchOutcome:
    """Work through an experiment file: every stack, then the study's tables and report.

    Parameters
    ----------
    path
        The experiment file.
    out
        Output folder; a folder of an earlier, interrupted or changed run is taken up again.
    workers, scheduler
        See `cellquant.engines.execute`.
    part
        ``"I/N"``: work on every N-th stack from number I on and leave the study's tables and
        report to a last call without `part`. Several parts may be worked on at the same time.
    progress
        Called with (stacks finished, stacks in all).

    Raises
    ------
    InputError
        If the file is wrong, a pattern matches nothing, or the output cannot be written. A stack
        that fails does not raise: its reason stands in the outcome.
    """
    path = Path(path)
    config = load(path, ExperimentConfig)
    return run_config(
        config,
        path.parent,
        out,
        source=path,
        workers=workers,
        scheduler=scheduler,
        part=part,
        progress=progress,
    )


@clear_disk_errors()
def run_config(
    config: ExperimentConfig,
    base: Path,
    out: str | Path,
    *,
    source: Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    part: str | None = None,
    progress: Progress | None = None,
) -> BatchOutcome:
    """Work through an experiment; as `run_experiment`, with the configuration already read.

    Parameters
    ----------
    base
        Folder at which relative paths start.
    source
        The file that the configuration was read from, for the record.
    """
    folder = check_output(out)
    tasks = find_stacks(config, base)
    record = RunRecord("run", {**config.model_dump(), "base": str(base.resolve())})
    if source is not None:
        record.add_input(source)
    for task in share(tasks, part):
        _add_keys(task, folder)
    folder = make_folder(folder)
    if part is not None:
        return run_tasks(
            work_on_stack,
            share(tasks, part),
            command="run",
            workers=workers,
            scheduler=scheduler,
            on_finished=progress,
        )
    with only_writer(folder):
        remove_partial(folder, below=False)
        with record.stage("stacks"):
            outcome = run_tasks(
                work_on_stack,
                tasks,
                command="run",
                workers=workers,
                scheduler=scheduler,
                on_finished=progress,
            )
        record.counts = {"stacks": len(tasks), "failed": len(outcome.failures)}
        record.notes = [f"{name}: {reason}" for name, reason in outcome.failures.items()]
        finished = [t for t in tasks if finished_key(Path(t["folder"]), "run") == t["key"]]
        write_json(folder / FINISHED, [str(task_folder(Path(), t)) for t in finished])
        if finished:
            with record.stage("study"):
                write_study(folder, finished, record.as_dict())
        write_json(folder / "failures.json", outcome.failures)
        record.write(folder)
    return outcome


def _add_keys(task: Task, out: Path) -> None:
    """Say what decides the result of a stack, and where it goes."""
    named = {k: v for k, v in task.items() if k not in {"masks", "raw", "tracking", "calibration"}}
    task["tracking_key"] = content_key(
        {
            "code": code_digest("pipeline"),
            "calibration": task["calibration"],
            "tracking": task["tracking"],
            "masks": digest(task["masks"]),
            "raw": None if task["raw"] is None else digest(task["raw"]),
        }
    )
    task["code"] = code_digest("batch")
    task["key"] = content_key(
        {"code": task["code"], "tracking": task["tracking_key"], "task": named}
    )
    task["folder"] = str(task_folder(out, task))
