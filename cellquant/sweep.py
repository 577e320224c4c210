"""A sweep: a grid or list of scenes times seeds, each simulated and observed, resumable.

Each scene with its seed is a task with a folder of its own, named by the key of its work, so that
a changed sweep file reuses what it has in common with an earlier one.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.config import SceneConfig, SweepConfig, load
from cellquant.engines import BatchOutcome, Task, run_tasks
from cellquant.storage import (
    RunRecord,
    atomic_path,
    check_output,
    content_key,
    finished_key,
    only_writer,
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
PILOT_TIME = 5.0  # t0 simulated to estimate the cost of a scene


def sweep_tasks(config: SweepConfig, folder: Path) -> list[Task]:
    """Tasks of a sweep, in the order of its file."""
    tasks = []
    for scene in config.scenes():
        key = content_key({"scene": scene.model_dump()})
        names = ("phi", "v0", "eta", "seed")
        tasks.append(
            {
                "label": ", ".join(f"{name} {getattr(scene, name):g}" for name in names),
                "scene": scene.model_dump(),
                "key": key,
                "folder": str(folder / "runs" / key[:16]),
            }
        )
    return tasks


def work_on_scene(task: Task) -> None:
    """Simulate and observe one scene, going on from its checkpoint where there is one."""
    from cellquant.pipeline import observe_into, simulate_scene

    folder = Path(task["folder"])
    if finished_key(folder, "sweep") == task["key"]:
        return
    scene = SceneConfig.model_validate(task["scene"])
    record = RunRecord("sweep", {**task["scene"], "key": task["key"]})
    with record.stage("simulate"):
        run = simulate_scene(scene, folder / "run.zarr")
    observe_into(run.to_tracks(), folder, record)
    record.write(folder)


def run_sweep(
    path: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> BatchOutcome:
    """Work through a sweep file: simulate, observe, and gather the results of every scene.

    Parameters
    ----------
    path
        The sweep file.
    out
        Output folder: ``runs/KEY`` for each run, ``sweep.parquet`` with a row per run,
        ``maps.parquet`` with a row per scene (mean and standard error over seeds). Both tables
        are kept up to date while the sweep goes on.
    workers, scheduler
        See `cellquant.engines.execute`.
    progress
        Called with (runs finished, runs in all).

    Raises
    ------
    InputError
        If the file is wrong or the output cannot be written. A run that fails does not raise: its
        reason stands in the outcome.
    """
    path = Path(path)
    config = load(path, SweepConfig)
    folder = check_output(out)
    tasks = sweep_tasks(config, folder)
    record = RunRecord("sweep", config.model_dump())
    record.add_input(path)
    folder.mkdir(parents=True, exist_ok=True)

    def keep_up(done: int, total: int) -> None:
        _gather(folder, tasks)
        if progress is not None:
            progress(done, total)

    with only_writer(folder):
        with record.stage("runs"):
            outcome = run_tasks(
                work_on_scene,
                tasks,
                command="sweep",
                workers=workers,
                scheduler=scheduler,
                on_finished=keep_up,
            )
        _gather(folder, tasks)
        record.counts = {"runs": len(tasks), "failed": len(outcome.failures)}
        record.notes = [f"{name}: {reason}" for name, reason in outcome.failures.items()]
        write_json(folder / "failures.json", outcome.failures)
        record.write(folder)
    return outcome


def _gather(folder: Path, tasks: Sequence[Task]) -> None:
    """Write the tables of what is finished so far."""
    from cellquant.tables import REDUCED, write_table

    runs = sweep_table(tasks)
    if runs is None:
        return
    with atomic_path(folder / "sweep.parquet") as path:
        write_table(runs, path, units=REDUCED)
    with atomic_path(folder / "maps.parquet") as path:
        write_table(map_table(runs), path, units=REDUCED)


def sweep_table(tasks: Sequence[Task]) -> "pd.DataFrame | None":
    """One row per finished run: its scene, its seed, and every scalar with its standard error.

    Returns
    -------
    pandas.DataFrame or None
        None when no run is finished yet.
    """
    import json

    import numpy as np
    import pandas as pd

    rows = []
    for task in tasks:
        if finished_key(Path(task["folder"]), "sweep") != task["key"]:
            continue
        summary = json.loads((Path(task["folder"]) / "summary.json").read_text("utf-8"))
        row: dict[str, Any] = {k: v for k, v in task["scene"].items() if v is not None}
        for name, place in RESULTS.items():
            group, part = place.split(".")
            found: Mapping[str, Any] = summary.get(group) or {}
            error = "std_error" if part in {"mean", "value"} else f"{part}_std_error"
            row[name] = _number(found.get(part))
            row[f"{name}_std_error"] = _number(found.get(error))
        row["tau_alpha_censored_at"] = _number((summary.get("tau_alpha") or {}).get("censored_at"))
        row["folder"] = Path(task["folder"]).name
        rows.append(row)
    if not rows:
        return None
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


def estimate_cost(path: str | Path, *, workers: int = 1) -> dict[str, Any]:
    """Estimate the cost of a sweep from short pilot runs on this machine.

    For every scene that differs in more than its seed, `PILOT_TIME` is simulated after the
    kernels are compiled, and its processor time is scaled to the whole run.

    Returns
    -------
    dict
        runs, cpu_s (one thread), wall_s (with `workers`), disk_MB.
    """
    import time

    from cellquant.sim import Scene, simulate

    config = load(path, SweepConfig)
    cost: dict[str, float] = {}
    total, disk = 0.0, 0.0
    scenes = config.scenes()
    for scene in scenes:
        content = {k: v for k, v in scene.model_dump().items() if k != "seed"}
        key = content_key(content)
        if key not in cost:
            seconds = []
            for _ in range(2):  # the first compiles
                started = time.process_time()
                simulate(
                    Scene.from_config(scene),
                    duration=PILOT_TIME,
                    contact=scene.contact,
                    points=scene.points,
                    integrator=scene.integrator,
                    dt=scene.dt,
                    tolerance=scene.tolerance,
                )
                seconds.append(time.process_time() - started)
            cost[key] = min(seconds) / PILOT_TIME * (scene.transient + scene.duration)
        total += cost[key]
        frames = scene.duration / (scene.save_every or max(1.0, scene.duration / 2000))
        disk += frames * scene.cells * (3 + 2 * (scene.modes - 1)) * 8 / 1e6
    return {
        "runs": len(scenes),
        "scenes": len(cost),
        "cpu_s": round(total, 1),
        "wall_s": round(total / workers, 1),
        "disk_MB": round(disk, 1),
    }
