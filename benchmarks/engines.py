"""What the engines cost: throughput of two workers, overhead per task, Dask against processes.

    python benchmarks/engines.py [--repeats 3] [--scenes 20]

A sweep of small scenes with one worker, with two, and on a Dask cluster of two local worker
processes, in turn, repeated; the throughput counts from the first to the last finished run, since
starting processes costs the same few seconds however long the sweep is. The overhead is that of
tasks that do nothing. Ratios are medians over the repetitions, with their range; the load of the
machine stands beside them. Writes benchmarks/results/engines.json.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.update(NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")

from cellquant.engines import Task, execute
from cellquant.sweep import run_sweep

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "engines.json"
EMPTY = 200


def nothing(task: Task) -> None:
    """A task without work."""


def rate(sweep: Path, out: Path, **engine: Any) -> float:
    """Finished runs per second, between the first and the last."""
    times: list[float] = []
    run_sweep(sweep, out, progress=lambda done, total: times.append(time.perf_counter()), **engine)
    return (len(times) - 2) / (times[-1] - times[1])


def overhead(workers: int, scheduler: str | None) -> float:
    """Seconds per empty task, once the workers are there."""
    tasks = [{"number": number} for number in range(EMPTY)]
    times = []
    for _ in execute(nothing, tasks, workers=workers, scheduler=scheduler):
        times.append(time.perf_counter())
    return (times[-1] - times[workers]) / (len(times) - workers - 1)


def cluster(folder: Path) -> tuple[str, list["subprocess.Popen[bytes]"]]:
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    commands = [[*dask, "scheduler", "--host", "127.0.0.1", "--port", "0"]]
    commands += [[*dask, "worker", "--nworkers", "1", "--nthreads", "1"]] * 2
    paths = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    processes = [
        subprocess.Popen(
            [*command, "--no-dashboard", "--scheduler-file", str(file)],
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths},
        )
        for command in commands
    ]
    while not file.exists():
        time.sleep(0.1)
    return str(file), processes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scenes", type=int, default=20)
    arguments = parser.parse_args()
    rates: dict[str, list[float]] = {"one": [], "two": [], "dask": []}
    empty: dict[str, list[float]] = {"processes": [], "dask": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sweep = folder / "sweep.toml"
        sweep.write_text(
            f"seeds = {list(range(1, arguments.scenes + 1))}\n"
            "[scene]\ncells = 64\ntransient = 2\nduration = 30\n"
        )
        scheduler, processes = cluster(folder)
        try:
            for number in range(arguments.repeats):
                for engine, options in (
                    ("one", {"workers": 1}),
                    ("two", {"workers": 2}),
                    ("dask", {"scheduler": scheduler}),
                ):
                    rates[engine].append(rate(sweep, folder / f"{engine}{number}", **options))
                empty["processes"].append(overhead(2, None))
                empty["dask"].append(overhead(2, scheduler))
        finally:
            for process in processes:
                process.kill()

    def ratio(above: str, below: str) -> dict[str, float]:
        found = [a / b for a, b in zip(rates[above], rates[below], strict=True)]
        return {"median": statistics.median(found), "least": min(found), "most": max(found)}

    content = {
        "scenes": arguments.scenes,
        "repeats": arguments.repeats,
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "runs_per_s": rates,
        "two workers over one": ratio("two", "one"),
        "Dask over two processes": ratio("dask", "two"),
        "overhead_ms": {key: 1e3 * statistics.median(values) for key, values in empty.items()},
    }
    RESULTS.write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(content, indent=2))


if __name__ == "__main__":
    main()
