"""What the engines cost: throughput of two workers, overhead per task, Dask against processes.

    python benchmarks/engines.py [--repeats 3] [--scenes 20] [--append]

A sweep of small scenes with one worker, with two, and on a Dask cluster of two local worker
processes, in turn, repeated; the throughput counts from the second to the last finished run, since
starting processes costs the same few seconds however long the sweep is. The overhead is that of
tasks that do nothing. Ratios are medians over the repetitions, with their range.

On a machine that others use, a worker waits for a core that it would have alone. The system counts
that time (``/proc/PID/schedstat``), so each ratio stands there twice: as the clock gives it, and
with the time left out in which a worker was ready to run and had no core. Writes
benchmarks/results/engines.json; with --append the repetitions of earlier calls count too.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
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


@dataclass(frozen=True)
class Rate:
    """Finished runs per second, by the clock and with cores of their own for the workers."""

    by_clock: float
    undisturbed: float
    cpu_per_run: float


def used(pids: Sequence[int]) -> tuple[float, float]:
    """Seconds that the threads of these processes ran, and waited for a core."""
    ran = waited = 0.0
    for pid in pids:
        for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            words = file.read_text().split()
            ran, waited = ran + int(words[0]) / 1e9, waited + int(words[1]) / 1e9
    return ran, waited


def children() -> list[int]:
    own = Path(f"/proc/{os.getpid()}/task")
    found = [int(pid) for file in own.glob("*/children") for pid in file.read_text().split()]
    return [pid for pid in found if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def rate(sweep: Path, out: Path, workers: Sequence[int] | None, **engine: Any) -> Rate:
    """Throughput between the second and the last finished run.

    Processes of the workers: as given, or the child processes where None.
    """
    samples: list[tuple[float, float, float]] = []

    def sample(done: int, total: int) -> None:
        samples.append((time.perf_counter(), *used(children() if workers is None else workers)))

    run_sweep(sweep, out, progress=sample, **engine)
    runs = len(samples) - 3  # the first call comes before anything is done
    wall, ran, waited = (last - first for first, last in zip(samples[2], samples[-1], strict=True))
    n_workers = 1 if engine.get("workers") == 1 else 2
    idle = max(0.0, n_workers * wall - ran - waited)
    return Rate(runs / wall, runs * n_workers / (ran + idle), ran / runs)


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
    commands += [[*dask, "worker", "--nworkers", "1", "--nthreads", "1", "--no-nanny"]] * 2
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
    parser.add_argument("--append", action="store_true")
    arguments = parser.parse_args()
    rates: dict[str, list[Rate]] = {"one": [], "two": [], "dask": []}
    empty: dict[str, list[float]] = {"processes": [], "dask": []}
    if arguments.append:
        before = json.loads(RESULTS.read_text())
        rates = {k: [Rate(**each) for each in found] for k, found in before["runs_per_s"].items()}
        empty = before["seconds per empty task"]
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
                out = folder / str(number)
                ours, theirs = [os.getpid()], [process.pid for process in processes[1:]]
                rates["one"].append(rate(sweep, out / "one", ours, workers=1))
                rates["two"].append(rate(sweep, out / "two", None, workers=2))
                rates["dask"].append(rate(sweep, out / "dask", theirs, scheduler=scheduler))
                empty["processes"].append(overhead(2, None))
                empty["dask"].append(overhead(2, scheduler))
        finally:
            for process in processes:
                process.kill()

    def ratio(above: str, below: str) -> dict[str, dict[str, float]]:
        found = {}
        for kind in ("by_clock", "undisturbed"):
            pairs = zip(rates[above], rates[below], strict=True)
            values = [getattr(a, kind) / getattr(b, kind) for a, b in pairs]
            found[kind] = {
                "median": statistics.median(values),
                "least": min(values),
                "most": max(values),
            }
        return found

    content = {
        "scenes": arguments.scenes,
        "repeats": len(rates["one"]),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "runs_per_s": {name: [asdict(each) for each in found] for name, found in rates.items()},
        "two workers over one": ratio("two", "one"),
        "Dask over two processes": ratio("dask", "two"),
        "seconds per empty task": empty,
        "overhead_ms": {key: 1e3 * statistics.median(values) for key, values in empty.items()},
    }
    RESULTS.write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(content, indent=2))


if __name__ == "__main__":
    main()
