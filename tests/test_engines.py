"""The engines: the same outcomes in this process, in worker processes and on a Dask cluster."""

import os
import signal
import time
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


def name_process(task: Task) -> None:
    Path(task["out"]).write_text(str(os.getpid()))


def test_the_workers_stay_for_all_tasks(tmp_path: Path) -> None:
    """Starting a process costs seconds of loading."""
    list(execute(name_process, tasks_for(tmp_path, list(range(12))), workers=2))
    assert len({path.read_text() for path in tmp_path.iterdir()}) <= 2


def test_tasks_of_a_killed_worker_are_done_by_another(tmp_path: Path) -> None:
    (tmp_path / "3").write_text("does not die")
    outcomes = list(execute(die_once, tasks_for(tmp_path, [1, 2, 3]), workers=2))
    assert sorted(o.index for o in outcomes) == [0, 1, 2]
    assert all(o.error is None for o in outcomes)


def test_a_task_that_always_kills_its_worker_is_given_up(tmp_path: Path) -> None:
    outcomes = list(execute(die_always, tasks_for(tmp_path, [1, 2]), workers=2))
    assert len(outcomes) == 2
    assert all(f"killed {TRIES} times" in str(o.error) for o in outcomes)


def test_no_worker_is_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        list(execute(write_square, [], workers=0))
