"""The engines: the same outcomes in this process, in worker processes and on a Dask cluster."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cellquant.engines import TRIES, Task, execute
from cellquant.errors import InputError


def write_square(task: Task) -> None:
    if task["value"] < 0:
        raise InputError(f"value must be positive, got {task['value']}")
    if task["value"] == 13:
        raise RuntimeError("thirteen")
    Path(task["out"]).write_text(str(task["value"] ** 2))


def die_once(task: Task) -> None:
    marker = Path(task["out"])
    if not marker.exists():
        marker.write_text("died")
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.01)


def die_always(task: Task) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def tasks_for(folder: Path, values: list[int]) -> list[Task]:
    return [{"value": value, "out": str(folder / str(value))} for value in values]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failing_task_does_not_stop_the_others(tmp_path: Path, workers: int) -> None:
    tasks = tasks_for(tmp_path, [3, -1, 13, 4])
    outcomes = sorted(execute(write_square, tasks, workers=workers), key=lambda o: o.index)
    assert [o.index for o in outcomes] == [0, 1, 2, 3]
    assert outcomes[1].is_input_error
    assert "got -1" in str(outcomes[1].error)
    assert "RuntimeError: thirteen" in str(outcomes[2].error)
    assert not outcomes[2].is_input_error
    assert (tmp_path / "3").read_text() == "9"
    assert (tmp_path / "4").read_text() == "16"


def test_tasks_of_a_killed_worker_are_done_by_another(tmp_path: Path) -> None:
    outcomes = list(execute(die_once, tasks_for(tmp_path, [1, 2, 3]), workers=2))
    assert sorted(o.index for o in outcomes) == [0, 1, 2]
    assert all(o.error is None for o in outcomes)


def test_a_task_that_always_kills_its_worker_is_given_up(tmp_path: Path) -> None:
    outcomes = list(execute(die_always, tasks_for(tmp_path, [1, 2]), workers=2))
    assert len(outcomes) == 2
    assert all(f"killed {TRIES} times" in str(o.error) for o in outcomes)


@pytest.fixture
def dask_cluster(tmp_path: Path) -> Iterator[str]:
    """A real scheduler and two worker processes over TCP; yields the scheduler file."""
    pytest.importorskip("distributed", reason="Dask is not installed")
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    commands = [
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        *([[*dask, "worker", "--nworkers", "1", "--nthreads", "1", "--no-dashboard"]] * 2),
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    processes = []
    for index, command in enumerate(commands):
        with (tmp_path / f"process{index}.log").open("w") as log:
            processes.append(
                subprocess.Popen(
                    [*command, "--scheduler-file", str(file)],
                    stdout=log,
                    stderr=log,
                    env=environment,
                )
            )
    while not file.exists():
        assert processes[0].poll() is None, (tmp_path / "process0.log").read_text()
        time.sleep(0.1)
    try:
        yield str(file)
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(timeout=30)


@pytest.mark.slow
def test_a_dask_cluster_does_what_this_process_does(dask_cluster: str, tmp_path: Path) -> None:
    tasks = tasks_for(tmp_path, [3, -1, 13, 4])
    outcomes = sorted(execute(write_square, tasks, scheduler=dask_cluster), key=lambda o: o.index)
    assert [o.is_input_error for o in outcomes] == [False, True, False, False]
    assert "RuntimeError: thirteen" in str(outcomes[2].error)
    assert (tmp_path / "3").read_text() == "9"
    assert (tmp_path / "4").read_text() == "16"


def test_no_worker_is_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        list(execute(write_square, [], workers=0))


def test_an_absent_scheduler_is_named(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    with pytest.raises(InputError, match="no Dask scheduler answers at"):
        list(execute(write_square, tasks_for(tmp_path, [1]), scheduler="tcp://127.0.0.1:1"))
