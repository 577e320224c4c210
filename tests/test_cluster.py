"""A real Dask cluster over TCP: a scheduler and worker processes that are killed on the way."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import tifffile

from cellquant import cluster
from cellquant.engines import Task, execute
from cellquant.errors import InputError
from cellquant.sweep import run_sweep
from examples import drifting_discs, shuffled

pytest.importorskip("distributed", reason="Dask is not installed")

SWEEP = """
seeds = [1, 2]
[scene]
cells = 9
transient = 1
duration = 30
[grid]
phi = [0.9, 0.94, 0.98]
[observables]
only = ["shape_index", "msd"]
"""


def write_square(task: Task) -> None:
    if task["value"] < 0:
        raise InputError(f"value must be positive, got {task['value']}")
    if task["value"] == 13:
        raise RuntimeError("thirteen")
    Path(task["out"]).write_text(str(task["value"] ** 2))


class Cluster:
    """A scheduler and two workers with one thread each, as processes."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.file = folder / "scheduler.json"
        self.folder = folder
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        one = ("worker", "--nworkers", "1", "--nthreads", "1", "--no-nanny")
        self.workers = [self._start(*one) for _ in range(2)]
        while not self.file.exists():
            assert self.scheduler.poll() is None, "the scheduler does not start"
            time.sleep(0.1)

    def _start(self, *arguments: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard"]
        paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "NUMBA_NUM_THREADS": "1",
        }
        with (self.folder / "log").open("a") as log:
            return subprocess.Popen(
                [*command, "--scheduler-file", str(self.file)],
                stdout=log,
                stderr=log,
                env=environment,
            )

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait(timeout=30)


@pytest.fixture
def start_cluster(tmp_path: Path) -> Iterator[Callable[[], Cluster]]:
    started: list[Cluster] = []

    def start() -> Cluster:
        started.append(Cluster(tmp_path / f"cluster{len(started)}"))
        return started[-1]

    yield start
    for each in started:
        each.stop()


def tables(folder: Path) -> dict[str, bytes]:
    kinds = ("*.parquet", "summary.json", "statistics.json")
    files = [path for kind in kinds for path in folder.rglob(kind)]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def wait_for(count: int, folder: Path) -> None:
    """Wait until so many runs are finished."""
    deadline = time.monotonic() + 200
    while len(list(folder.glob("runs/*/run.json"))) < count:
        assert time.monotonic() < deadline, "no run is finished"
        time.sleep(0.02)


def test_a_sweep_outlives_its_worker_and_its_scheduler(
    start_cluster: Callable[[], Cluster], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 3)
    file = tmp_path / "sweep.toml"
    file.write_text(SWEEP)
    out = tmp_path / "out"
    first = start_cluster()

    def kill() -> None:
        wait_for(1, out)
        first.workers[0].kill()
        wait_for(2, out)
        first.scheduler.kill()

    killing = threading.Thread(target=kill)
    killing.start()
    with pytest.raises(InputError, match=r"was lost with [1-6] tasks to do"):
        run_sweep(file, out, scheduler=str(first.file))
    killing.join()
    assert (out / "sweep.parquet").is_file(), "partial results are there"
    assert not (out / "run.json").exists()
    first.stop()

    second = start_cluster()
    outcome = run_sweep(file, out, scheduler=str(second.file))
    assert outcome.failures == {}
    assert outcome.skipped >= 2
    assert outcome.done + outcome.skipped == 6
    run_sweep(file, tmp_path / "alone")
    assert tables(out) == tables(tmp_path / "alone")


STUDY = """
[calibration]
pixel_size = 0.65
frame_interval = 10
[[condition]]
name = "c"
[[condition.trial]]
name = "day"
stacks = ["*.tif"]
"""
LARGE = """
seeds = [1, 2]
[scene]
cells = 600
transient = 0
duration = 6
[grid]
phi = [0.9, 0.97]
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("command", ["run", "sweep"])
def test_threads_workers_and_cluster_give_the_same_bytes(
    command: str, start_cluster: Callable[[], Cluster], tmp_path: Path
) -> None:
    """Layers large enough for two threads, and four tasks for four workers."""
    file = tmp_path / f"{command}.toml"
    file.write_text({"run": STUDY, "sweep": LARGE}[command])
    for number in range(4):
        movie = shuffled(drifting_discs(26, side=3, step=(0.5, 0.1 * number)), number)
        tifffile.imwrite(tmp_path / f"{number}.tif", movie)
    found = {}
    for name, threads, options in (
        ("one thread", "1", []),
        ("two threads", "2", []),
        ("four workers", "2", ["--workers", "4"]),
        ("cluster", "2", ["--scheduler", str(start_cluster().file)]),
    ):
        words = ["-m", "cellquant", command, str(file), "-o", str(tmp_path / name), *options]
        environment = {**os.environ, "NUMBA_NUM_THREADS": threads}
        subprocess.run([sys.executable, *words], check=True, env=environment)
        found[name] = tables(tmp_path / name)
    assert len(found["one thread"]) > 20
    for name, content in found.items():
        assert content.keys() == found["one thread"].keys(), name
        assert [key for key in content if content[key] != found["one thread"][key]] == [], name


@pytest.mark.slow
def test_a_dask_cluster_does_what_this_process_does(
    start_cluster: Callable[[], Cluster], tmp_path: Path
) -> None:
    tasks = [{"value": value, "out": str(tmp_path / str(value))} for value in (3, -1, 13, 4)]
    outcomes = sorted(
        execute(write_square, tasks, scheduler=str(start_cluster().file)), key=lambda o: o.index
    )
    assert [o.is_input_error for o in outcomes] == [False, True, False, False]
    assert "RuntimeError: thirteen" in str(outcomes[2].error)
    assert (tmp_path / "3").read_text() == "9"
    assert (tmp_path / "4").read_text() == "16"


def test_an_absent_scheduler_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 1)
    with pytest.raises(InputError, match="no Dask scheduler answers at"):
        list(execute(write_square, [{"value": 1}], scheduler="tcp://127.0.0.1:1"))
