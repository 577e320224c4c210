"""What the engines cost: throughput of two workers, overhead per task, Dask against processes.

    python benchmarks/engines.py [--repeats 3] [--scenes 20] [--only two dask] [--append]

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
ENGINES = ("one", "two", "dask")


def nothing(task: Task) -> None:
    """A task without work."""


@dataclass(frozen=True)
class Rate:
    """Finished runs per second, by the clock and with cores of their own for the workers."""

    by_clock: float
    undisturbed: float
    cpu_per_run: float


def used(pids: Sequence[int]) -> tuple[float, float]:
    """Seconds that these processes ran, and that their main threads waited for a core."""
    ran = waited = 0.0
    for pid in pids:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ran += (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        waited += int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9
    return ran, waited


def children() -> list[int]:
    own = Path(f"/proc/{os.getpid()}/task")
    found = [int(pid) for file in own.glob("*/children") for pid in file.read_text().split()]
    return [pid for pid in found if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def rate(sweep: Path, out: Path, pids: Sequence[int] | None, **engine: Any) -> Rate:
    """Throughput between the second and the last finished run.

    Processes of the workers: as given, or the child processes where None.
    """
    samples: list[tuple[float, float, float]] = []

    def sample(done: int, total: int) -> None:
        samples.append((time.perf_counter(), *used(children() if pids is None else pids)))

    run_sweep(sweep, out, progress=sample, **engine)
    runs = len(samples) - 3  # the first call comes before anything is done
    wall, ran, waited = (last - first for first, last in zip(samples[2], samples[-1], strict=True))
    n_workers = 1 if engine.get("workers") == 1 else 2
    idle = max(0.0, n_workers * wall - ran - waited)
    return Rate(runs / wall, runs * n_workers / (ran + idle), ran / runs)


def overhead(workers: int, scheduler: str | None) -> float:
    """Seconds per empty task, once the workers are there."""
    tasks: list[Task] = [{"number": number} for number in range(EMPTY)]
    times = []
    for _ in execute(nothing, tasks, workers=workers, scheduler=scheduler):
        times.append(time.perf_counter())
    return (times[-1] - times[workers]) / (len(times) - workers - 1)


class Cluster:
    """A Dask scheduler and two worker processes with one thread each, where they are wanted."""

    def __init__(self, folder: Path, wanted: bool) -> None:
        self.scheduler = str(folder / "scheduler.json")
        self.processes: list[subprocess.Popen[bytes]] = []
        dask = [sys.executable, "-m", "dask"]
        commands = [[*dask, "scheduler", "--host", "127.0.0.1", "--port", "0"]]
        commands += [[*dask, "worker", "--nworkers", "1", "--nthreads", "1", "--no-nanny"]] * 2
        paths = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
        for command in commands if wanted else ():
            process = subprocess.Popen(
                [*command, "--no-dashboard", "--scheduler-file", self.scheduler],
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": paths},
            )
            self.processes.append(process)
        while wanted and not Path(self.scheduler).exists():
            time.sleep(0.1)
        self.workers = [process.pid for process in self.processes[1:]]

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *error: object) -> None:
        for process in self.processes:
            process.kill()


def repetition(sweep: Path, out: Path, pair: Sequence[str], cluster: "Cluster") -> dict[str, Any]:
    """The sweep on these engines."""
    engines: dict[str, tuple[Sequence[int] | None, dict[str, Any]]] = {
        "one": ([os.getpid()], {"workers": 1}),
        "two": (None, {"workers": 2}),
        "dask": (cluster.workers, {"scheduler": cluster.scheduler}),
    }
    row: dict[str, Any] = {"load": os.getloadavg()[0]}
    for engine in pair:
        pids, options = engines[engine]
        row[engine] = asdict(rate(sweep, out / engine, pids, **options))
        print(engine, row[engine], file=sys.stderr, flush=True)
    return row


def ratios(rows: list[dict[str, Any]], above: str, below: str) -> dict[str, Any]:
    """Median and range of a ratio over the repetitions that have both engines."""
    pairs = [(row[above], row[below]) for row in rows if above in row and below in row]
    found: dict[str, Any] = {"repetitions": len(pairs)}
    for kind in ("by_clock", "undisturbed"):
        values = [one[kind] / other[kind] for one, other in pairs]
        if values:
            found[kind] = {
                "median": statistics.median(values),
                "least": min(values),
                "most": max(values),
            }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=ENGINES, help="engines; no empty tasks then")
    parser.add_argument("--empty", action="store_true", help="empty tasks alone")
    parser.add_argument("--append", action="store_true")
    arguments = parser.parse_args()
    before = json.loads(RESULTS.read_text()) if arguments.append else {}
    rows = before.get("repetitions", [])
    empty = before.get("ms per empty task", {"two": [], "dask": []})
    pair = () if arguments.empty else arguments.only or ENGINES
    with (
        tempfile.TemporaryDirectory() as name,
        Cluster(Path(name), "dask" in pair or arguments.empty) as cluster,
    ):
        sweep = Path(name) / "sweep.toml"
        sweep.write_text(
            f"seeds = {list(range(1, arguments.scenes + 1))}\n"
            "[scene]\ncells = 64\ntransient = 2\nduration = 30\n"
        )
        for number in range(arguments.repeats):
            if pair:
                row = repetition(sweep, Path(name) / str(number), pair, cluster)
                rows.append({"scenes": arguments.scenes, **row})
            if not arguments.only:
                empty["two"].append(1e3 * overhead(2, None))
                empty["dask"].append(1e3 * overhead(2, cluster.scheduler))
    content = {
        "cores": len(os.sched_getaffinity(0)),
        "two workers over one": ratios(rows, "two", "one"),
        "Dask over two processes": ratios(rows, "dask", "two"),
        "overhead_ms": {key: statistics.median(values) for key, values in empty.items() if values},
        "ms per empty task": empty,
        "repetitions": rows,
    }
    RESULTS.write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps({k: v for k, v in content.items() if k != "repetitions"}, indent=2))


if __name__ == "__main__":
    main()
