"""Where tasks run: in this process, in local worker processes, or on a Dask cluster.

A task is a function of one JSON-like argument that writes its own result to disk and returns
nothing; finished work is recognised by its key, so a task may be run again after any fault.
"""

import itertools
import multiprocessing
import os
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from cellquant.errors import InputError
from cellquant.storage import finished_key

Task = dict[str, Any]
TRIES = 3


@dataclass(frozen=True)
class Outcome:
    """How one task ended.

    Attributes
    ----------
    index
        Place of the task in the sequence given.
    error
        None when it succeeded; one sentence for wrong input; a traceback for a fault of ours.
    is_input_error
        Whether the input was wrong, rather than the program.
    """

    index: int
    error: str | None = None
    is_input_error: bool = False


@dataclass(frozen=True)
class BatchOutcome:
    """What a batch of resumable tasks came to.

    Attributes
    ----------
    done, skipped
        Number of tasks worked on now, and finished by an earlier call.
    failures
        Reason by label, for those that failed.
    only_input_errors
        Whether every failure is one of the input, none of the program.
    """

    done: int
    skipped: int
    failures: dict[str, str]
    only_input_errors: bool

    def as_lines(self, noun: str) -> list[str]:
        """What was done, what was there already, what failed and why."""
        return [
            f"{noun}: {self.done} done, {self.skipped} finished before, "
            f"{len(self.failures)} failed",
            *(f"failed: {name}: {reason}" for name, reason in self.failures.items()),
        ]


def run_tasks(
    function: Callable[[Task], None],
    tasks: Sequence[Task],
    *,
    command: str,
    workers: int = 1,
    scheduler: str | None = None,
    on_finished: Callable[[int, int], None] | None = None,
) -> BatchOutcome:
    """Run those tasks whose finished work is not there yet.

    Parameters
    ----------
    function, workers, scheduler
        See `execute`.
    tasks
        Each with ``key``, ``folder`` and ``label``; finished is a task whose folder holds a
        manifest of `command` with its key.
    command
        Name in the manifests.
    on_finished
        Called with (tasks finished, tasks in all) whenever one has ended.
    """
    waiting = [t for t in tasks if finished_key(Path(t["folder"]), command) != t["key"]]
    skipped = len(tasks) - len(waiting)
    outcomes: list[Outcome] = []
    for outcome in execute(function, waiting, workers=workers, scheduler=scheduler):
        outcomes.append(outcome)
        if on_finished is not None:
            on_finished(skipped + len(outcomes), len(tasks))
    failed = sorted((o for o in outcomes if o.error is not None), key=lambda o: o.index)
    return BatchOutcome(
        done=len(waiting) - len(failed),
        skipped=skipped,
        failures={waiting[o.index]["label"]: str(o.error) for o in failed},
        only_input_errors=all(o.is_input_error for o in failed),
    )


def execute(
    function: Callable[[Task], None],
    tasks: Sequence[Task],
    *,
    workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[Outcome]:
    """Run every task once and yield how each ended, in the order in which they end.

    Parameters
    ----------
    function
        A module-level function of one task.
    tasks
        The tasks; JSON-like dictionaries.
    workers
        Local processes; 1 runs the tasks in this process with all kernel threads.
    scheduler
        Address or scheduler file of a Dask cluster; used instead of local processes.

    Raises
    ------
    InputError
        If the number of workers is below one, or the scheduler cannot be reached.
    """
    if workers < 1:
        raise InputError(f"--workers must be at least 1, got {workers}.")
    if scheduler is not None:
        yield from _on_dask(function, tasks, scheduler)
    elif workers > 1 and len(tasks) > 1:
        yield from _in_processes(function, tasks, min(workers, len(tasks)))
    else:
        for index, task in enumerate(tasks):
            yield attempt(function, task, index)


def attempt(function: Callable[[Task], None], task: Task, index: int) -> Outcome:
    """Run one task and turn an exception into an outcome."""
    try:
        function(task)
    except InputError as error:
        return Outcome(index, str(error), is_input_error=True)
    except Exception:
        return Outcome(index, traceback.format_exc())
    return Outcome(index)


def _one_kernel_thread() -> None:
    # Before Numba is imported: as many workers as cores, one kernel thread each.
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"


def _in_processes(
    function: Callable[[Task], None], tasks: Sequence[Task], workers: int
) -> Iterator[Outcome]:
    tries = [0] * len(tasks)
    waiting = list(range(len(tasks)))
    while waiting:
        # A killed worker breaks the whole pool, and every task in flight is a suspect. One that
        # has been a suspect too often gets its last try alone, where it can only blame itself.
        last = [index for index in waiting if tries[index] == TRIES - 1]
        batch = last[:1] or waiting
        in_flight: set[int] = set()
        for outcome in _until_broken(function, tasks, batch, workers, in_flight):
            waiting.remove(outcome.index)
            yield outcome
        for index in in_flight:
            tries[index] += 1
            if tries[index] == TRIES:
                waiting.remove(index)
                yield Outcome(
                    index,
                    f"its worker process was killed {TRIES} times while this task was under way; "
                    "look for a lack of memory, or use fewer workers.",
                )


def _until_broken(
    function: Callable[[Task], None],
    tasks: Sequence[Task],
    batch: Sequence[int],
    workers: int,
    in_flight: set[int],
) -> Iterator[Outcome]:
    """Run a batch in one pool; when the pool breaks, stop with the suspects left in flight."""
    context = multiprocessing.get_context("spawn")
    queue = iter(batch)
    with ProcessPoolExecutor(min(workers, len(batch)), context, _one_kernel_thread) as pool:
        futures: set[Future[Outcome]] = set()
        try:
            while True:
                for index in itertools.islice(queue, workers - len(futures)):
                    in_flight.add(index)
                    futures.add(pool.submit(attempt, function, tasks[index], index))
                if not futures:
                    return
                finished, futures = wait(futures, return_when=FIRST_COMPLETED)
                for future in finished:
                    outcome = future.result()
                    in_flight.discard(outcome.index)
                    yield outcome
        except BrokenProcessPool:
            return
        except GeneratorExit:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _on_dask(
    function: Callable[[Task], None], tasks: Sequence[Task], scheduler: str
) -> Iterator[Outcome]:
    try:
        dask: Any = import_module("distributed")
    except ImportError as error:
        raise InputError(
            "--scheduler needs Dask, which is not installed; install 'cellquant[cluster]'."
        ) from error
    where = {"scheduler_file": scheduler} if Path(scheduler).is_file() else {"address": scheduler}
    try:
        client = dask.Client(**where, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {scheduler} ({error}); start one with 'dask scheduler' "
            "and give its address or its scheduler file."
        ) from error
    with client:
        futures = {
            client.submit(attempt, function, task, index, pure=False, retries=TRIES): index
            for index, task in enumerate(tasks)
        }
        for future in dask.as_completed(futures):
            if future.status == "finished":
                yield future.result()
            else:
                yield Outcome(
                    futures[future],
                    f"the cluster lost this task ({future.status}); run the same command again.",
                )
