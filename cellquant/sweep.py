"""A sweep: a grid or list of scenes times seeds, each simulated and observed, resumable.

Each scene with its seed is a task with a folder of its own, named by the scene, so that a changed
sweep file reuses what it has in common with an earlier one.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.config import SceneConfig, SweepConfig, load
from cellquant.engines import BatchOutcome, Task, check_code, run_tasks, share
from cellquant.fingerprint import code_digest
from cellquant.lock import only_writer
from cellquant.storage import (
    FINISHED,
    RunRecord,
    atomic_path,
    begin,
    check_output,
    clear_disk_errors,
    content_key,
    finished_key,
    make_folder,
    remove_partial,
    write_json,
)

if TYPE_CHECKING:
    import pandas as pd

Progress = Callable[[int, int], None]

RESULTS = {
    "shape_index": "shape_index.mean",
    "tau_alpha": "tau_alpha.value",
    "speed": "speed.mean",
    "mean_diameter": "wave_number.mean_diameter",
    "sigma2": "van_hove.sigma2",
    "xi": "van_hove.xi",
}
GATHER_SHARE = 0.02  # of the time may go into keeping the tables up to date


def sweep_tasks(config: SweepConfig, folder: Path) -> list[Task]:
    """Tasks of a sweep, in the order of its file."""
    code = code_digest("sweep")
    options = config.observables.model_dump(exclude_none=True)
    varied = {*config.grid, *(name for point in config.points for name in point)}
    names = [n for n in SceneConfig.model_fields if n in {"phi", "v0", "eta", "seed", *varied}]
    tasks = []
    for scene in config.scenes():
        content = scene.model_dump()
        run_key = content_key({"code": code, "scene": content})
        tasks.append(
            {
                "label": ", ".join(f"{name} {content[name]}" for name in names),
                "scene": content,
                "observables": options,
                "code": code,
                "run_key": run_key,
                "key": content_key({"run": run_key, "observables": options}),
                "folder": str(folder / "runs" / content_key(content)[:16]),
            }
        )
    return tasks


def count_runs(path: str | Path) -> int:
    """Number of runs of a sweep file."""
    return len(load(path, SweepConfig).scenes())


def work_on_scene(task: Task) -> None:
    """Simulate and observe one scene, going on from its checkpoint where there is one."""
    check_code(task, "sweep")
    folder = make_folder(task["folder"])
    with only_writer(folder, wait=True):
        if finished_key(folder, "sweep") != task["key"]:
            begin(folder, task["run_key"])
            _simulate_and_observe(task, folder)


def _simulate_and_observe(task: Task, folder: Path) -> None:
    from cellquant.pipeline import observe_into, simulate_scene

    for entry in [*folder.glob("*.parquet"), *folder.glob("*.json")]:
        entry.unlink()  # measured with other options, or not finished
    scene = SceneConfig.model_validate(task["scene"])
    settings = {**task["scene"], **task["observables"], "code": task["code"], "key": task["key"]}
    record = RunRecord("sweep", settings)
    with record.stage("simulate"):
        run = simulate_scene(scene, folder / "run.zarr")
    observe_into(run, folder, record, options=task["observables"])
    record.write(folder)


def run_sweep(
    path: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    part: str | None = None,
    progress: Progress | None = None,
) -> BatchOutcome:
    """Work through a sweep file: simulate, observe, and gather the results of every scene.

    Parameters
    ----------
    path
        The sweep file.
    out
        Output folder: ``runs/SCENE`` for each run, ``sweep.parquet`` with a row per run,
        ``maps.parquet`` with a row per scene (mean and standard error over seeds). Both tables
        are kept up to date while the sweep goes on.
    workers, scheduler
        See `cellquant.engines.execute`.
    part
        ``"I/N"``: work on every N-th run from number I on and leave the tables to a last call
        without `part`. Several parts may be worked on at the same time.
    progress
        Called with (runs finished, runs in all).

    Raises
    ------
    InputError
        If the file is wrong or the output cannot be written. A run that fails does not raise: its
        reason stands in the outcome.
    """
    path = Path(path)
    return sweep_config(
        load(path, SweepConfig),
        out,
        source=path,
        workers=workers,
        scheduler=scheduler,
        part=part,
        progress=progress,
    )


@clear_disk_errors()
def sweep_config(
    config: SweepConfig,
    out: str | Path,
    *,
    source: Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    part: str | None = None,
    progress: Progress | None = None,
) -> BatchOutcome:
    """Work through a sweep; as `run_sweep`, with the configuration already read.

    Parameters
    ----------
    source
        The file that the configuration was read from, for the record.
    """
    folder = check_output(out)
    tasks = sweep_tasks(config, folder)
    mine = share(tasks, part)
    record = RunRecord("sweep", config.model_dump())
    if source is not None:
        record.add_input(source)
    folder = make_folder(folder)
    if part is not None:
        return run_tasks(
            work_on_scene,
            mine,
            command="sweep",
            workers=workers,
            scheduler=scheduler,
            on_finished=progress,
        )
    gathered = _Gathered(folder, tasks)

    def keep_up(done: int, total: int) -> None:
        gathered.keep_up()
        if progress is not None:
            progress(done, total)

    with only_writer(folder):
        remove_partial(folder, below=False)
        try:
            with record.stage("runs"):
                outcome = run_tasks(
                    work_on_scene,
                    tasks,
                    command="sweep",
                    workers=workers,
                    scheduler=scheduler,
                    on_finished=keep_up,
                )
        finally:  # also of a sweep that is interrupted or loses its cluster
            gathered.write()
        record.counts = {"runs": len(tasks), "failed": len(outcome.failures)}
        record.notes = [f"{name}: {reason}" for name, reason in outcome.failures.items()]
        write_json(folder / "failures.json", outcome.failures)
        record.write(folder)
    return outcome


class _Gathered:
    """The tables of a sweep, written again from time to time while it goes on."""

    def __init__(self, folder: Path, tasks: Sequence[Task]) -> None:
        self.folder, self.tasks = folder, tasks
        self.rows: dict[int, dict[str, Any]] = {}
        self.next = 0.0

    def keep_up(self) -> None:
        """Write the tables, unless that was done a short while ago."""
        started = time.monotonic()
        if started >= self.next:
            self.write()
            now = time.monotonic()
            self.next = now + max(1.0, (now - started) / GATHER_SHARE)

    def write(self) -> None:
        """Write the tables of what is finished so far; each run is read once."""
        from cellquant.tables import REDUCED, write_table

        for index, task in enumerate(self.tasks):
            if index not in self.rows:
                row = _row(task)
                if row is not None:
                    self.rows[index] = row
        if not self.rows:
            return
        runs = sweep_table([self.rows[index] for index in sorted(self.rows)])
        with atomic_path(self.folder / "sweep.parquet") as path:
            write_table(runs, path, units=REDUCED)
        with atomic_path(self.folder / "maps.parquet") as path:
            write_table(map_table(runs), path, units=REDUCED)
        write_json(self.folder / FINISHED, [f"runs/{name}" for name in runs["folder"]])


def _row(task: Task) -> dict[str, Any] | None:
    """Scene, seed and every scalar with its standard error; None while the run is not finished."""
    folder = Path(task["folder"])
    if finished_key(folder, "sweep") != task["key"]:
        return None
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    row: dict[str, Any] = {
        name: json.dumps(value) if isinstance(value, list | tuple) else value
        for name, value in task["scene"].items()
        if value is not None
    }
    for name, place in RESULTS.items():
        group, part = place.split(".")
        found: Mapping[str, Any] = summary.get(group) or {}
        error = "std_error" if part in {"mean", "value"} else f"{part}_std_error"
        row[name] = _number(found.get(part))
        row[f"{name}_std_error"] = _number(found.get(error))
    row["tau_alpha_censored_at"] = _number((summary.get("tau_alpha") or {}).get("censored_at"))
    row["folder"] = folder.name
    return row


def sweep_table(rows: Sequence[Mapping[str, Any]]) -> "pd.DataFrame":
    """One row per finished run: its scene, its seed, and every scalar with its standard error."""
    import numpy as np
    import pandas as pd

    table = pd.DataFrame(rows)
    measured = [n for n in table.columns if str(n).startswith(tuple(RESULTS))]
    return table.astype(dict.fromkeys(measured, np.float64))


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def map_table(runs: "pd.DataFrame") -> "pd.DataFrame":
    """One row per scene: mean and standard error over its seeds.

    With one seed the error is that of the run itself. A relaxation time that any seed knows only
    as a bound is NaN, and ``tau_alpha_n_censored`` counts those seeds.
    """
    import numpy as np
    import pandas as pd

    measured = [name for name in runs.columns if name.startswith(tuple(RESULTS))]
    scene = [name for name in runs.columns if name not in {*measured, "seed", "folder"}]
    rows = []
    for values, group in runs.groupby(scene, sort=False, dropna=False):
        row: dict[str, Any] = dict(zip(scene, values, strict=True))
        row["n_seeds"] = len(group)
        censored = int(group["tau_alpha_censored_at"].notna().sum())
        for name in RESULTS:
            each = group[name].to_numpy(np.float64)
            known = not (name == "tau_alpha" and censored)
            row[name] = float(each.mean()) if known else np.nan
            row[f"{name}_std_error"] = (
                np.nan
                if not known
                else float(each.std(ddof=1) / np.sqrt(len(each)))
                if len(each) > 1
                else float(group[f"{name}_std_error"].iloc[0])
            )
        row["tau_alpha_n_censored"] = censored
        rows.append(row)
    return pd.DataFrame(rows)
