"""Where tasks run: in this process, in local worker processes, or on a Dask cluster.

A task is a function of one JSON-like argument that writes its own result to disk and returns
nothing; finished work is recognised by its key, so a task may be run again after any fault.
"""

import itertools
import multiprocessing
import os
import platform
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from cellquant.errors import InputError
from cellquant.fingerprint import code_digest
from cellquant.lock import remove_stale
from cellquant.storage import disk_problem, finished_key

Task = dict[str, Any]
TRIES = 3
# Kernels of one process must not be called by two threads at once.
_one_at_a_time = threading.Lock()


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
        Called with (tasks finished, tasks in all) at the start and whenever one has ended.
    """
    waiting = [t for t in tasks if finished_key(Path(t["folder"]), command) != t["key"]]
    for task in tasks:
        remove_stale(Path(task["folder"]))
    skipped = len(tasks) - len(waiting)
    outcomes: list[Outcome] = []
    if on_finished is not None:
        on_finished(skipped, len(tasks))
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


def check_code(task: Task, room: str) -> None:
    """Refuse a task that was made by other code than that of this worker."""
    if task["code"] != code_digest(room):
        raise InputError(
            f"the worker on {platform.node()} has another version of cellquant than the one that "
            "gives the tasks; install the same version on every machine."
        )


def share(tasks: Sequence[Task], part: str | None) -> list[Task]:
    """The tasks of one part: ``"I/N"`` is every N-th task from number I (0 to N - 1) on.

    Raises
    ------
    InputError
        If `part` is not of that form.
    """
    if part is None:
        return list(tasks)
    try:
        index, number = (int(word) for word in part.split("/"))
        if not 0 <= index < number:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--part takes I/N with I from 0 to N - 1, got {part!r}; e.g. 0/10 for the first of "
            "ten parts."
        ) from None
    return list(tasks[index::number])


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
        Local processes, which share the cores: no more processes than tasks are started, and each
        gets an equal number of kernel threads. With one, the tasks run in this process.
    scheduler
        Address or scheduler file of a Dask cluster; used instead of local processes.

    Raises
    ------
    InputError
        If the number of workers is below one, or the scheduler cannot be reached or is lost.
    """
    if workers < 1:
        raise InputError(f"--workers must be at least 1, got {workers}.")
    if scheduler is not None:
        from cellquant.cluster import execute_on_dask

        yield from execute_on_dask(function, tasks, scheduler)
    elif workers > 1 and len(tasks) > 1:
        yield from _in_processes(function, tasks, min(workers, len(tasks)))
    else:
        for index, task in enumerate(tasks):
            yield attempt(function, task, index)


def attempt(function: Callable[[Task], None], task: Task, index: int) -> Outcome:
    """Run one task and turn an exception into an outcome."""
    try:
        with _one_at_a_time:
            function(task)
    except InputError as error:
        return Outcome(index, str(error), is_input_error=True)
    except Exception as error:
        problem = disk_problem(error)
        if problem is not None:
            return Outcome(index, problem, is_input_error=True)
        return Outcome(index, traceback.format_exc())
    return Outcome(index)


def _start_worker(threads: int, parent: Connection) -> None:
    """Prepare a worker process, before Numba is imported in it."""
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(threads)
    # A terminal sends its interrupt to every process; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def end_with_parent() -> None:
        parent.poll(None)  # readable when the other end is closed, also by a kill
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _in_processes(
    function: Callable[[Task], None], tasks: Sequence[Task], workers: int
) -> Iterator[Outcome]:
    tries = [0] * len(tasks)
    waiting = list(range(len(tasks)))
    while waiting:
        # A killed worker breaks the whole pool, and every task in flight is a suspect. One that
        # has been a suspect too often gets its last try alone, where it can only blame itself.
        last = [index for index in waiting if tries[index] == TRIES - 1]
        batch = last[:1] or list(waiting)  # a copy: the loop takes out what has ended
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
    workers = min(workers, len(batch))
    theirs, ours = context.Pipe(duplex=False)
    start = (max(1, _cores() // workers), theirs)
    with ProcessPoolExecutor(workers, context, _start_worker, start) as pool:
        futures: set[Future[Outcome]] = set()
        try:
            while True:
                # One more than can be worked on, so that no worker waits for this process.
                for index in itertools.islice(queue, workers + 1 - len(futures)):
                    futures.add(pool.submit(attempt, function, tasks[index], index))
                    in_flight.add(index)
                if not futures:
                    return
                finished, futures = wait(futures, return_when=FIRST_COMPLETED)
                # What ended before the pool broke comes first.
                for future in sorted(finished, key=lambda each: each.exception() is not None):
                    outcome = future.result()
                    in_flight.discard(outcome.index)
                    yield outcome
        except BrokenProcessPool:
            return
        finally:
            if futures:
                ours.close()  # ends the workers, and with them what they were at
            theirs.close()


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
