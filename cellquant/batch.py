"""A whole study: every stack of every trial of every condition, resumable and in parallel.

Each stack is a task with a folder of its own. The folder's ``run.json`` is written last and holds
the key of the work (configuration, version, digest of the input): a task whose key is there is not
done again, and one whose configuration or input has changed is.
"""

import glob
import shutil
from collections.abc import Callable
from pathlib import Path

from cellquant.config import ConditionConfig, ExperimentConfig, TrialConfig, load
from cellquant.engines import BatchOutcome, Task, run_tasks
from cellquant.errors import InputError
from cellquant.storage import (
    RunRecord,
    check_output,
    content_key,
    digest,
    finished_key,
    only_writer,
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
    """Track and observe one stack, unless its finished result is there already."""
    from cellquant.compare.report import experiment_report
    from cellquant.io import read_images, read_labels
    from cellquant.pipeline import observe_into, track_movie

    folder = Path(task["folder"])
    if finished_key(folder, "run") == task["key"]:
        return
    shutil.rmtree(folder, ignore_errors=True)
    calibration = task["calibration"]
    masks = read_labels(
        task["masks"],
        pixel_size=calibration["pixel_size"],
        frame_interval=calibration["frame_interval"],
        units="pixel" if calibration["units"] == "pixel" else None,
    )
    raw = None if task["raw"] is None else read_images(task["raw"])
    cells, tracks, record = track_movie(masks, folder, raw=raw, options=task["tracking"])
    observables = observe_into(
        tracks,
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
            tracks=tracks,
            observables=observables,
            settings=record.as_dict(),
            out=folder / "report.html",
            stack=masks,
            raw=raw,
            cells=cells,
        )
    record.write(folder)


def run_experiment(
    path: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
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
    folder = check_output(out)
    tasks = find_stacks(config, path.parent)
    record = RunRecord("run", config.model_dump())
    record.add_input(path)
    folder.mkdir(parents=True, exist_ok=True)
    with only_writer(folder):
        for task in tasks:
            task["key"] = content_key(
                {
                    "task": {k: v for k, v in task.items() if k not in {"masks", "raw"}},
                    "masks": digest(task["masks"]),
                    "raw": None if task["raw"] is None else digest(task["raw"]),
                }
            )
            task["folder"] = str(task_folder(folder, task))
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
        if finished:
            with record.stage("study"):
                write_study(folder, finished, record.as_dict())
        write_json(folder / "failures.json", outcome.failures)
        record.write(folder)
    return outcome
