"""Tasks on a Dask cluster: whatever happens to its workers or its scheduler, nothing hangs."""

import logging
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from cellquant.engines import TRIES, Outcome, Task, attempt
from cellquant.errors import InputError

POLL = 1.0  # seconds between looks at the connection
PATIENCE = 10  # seconds in which a scheduler that was lost may come back at its address


def execute_on_dask(
    function: Callable[[Task], None], tasks: Sequence[Task], scheduler: str
) -> Iterator[Outcome]:
    """Run tasks on a Dask cluster; see `cellquant.engines.execute`.

    A task whose worker is lost is given to another one; when the scheduler is lost and comes back
    at the same address, what was under way is submitted again, at most
    `cellquant.engines.TRIES` times.

    Raises
    ------
    InputError
        If Dask is not installed, or the scheduler cannot be reached or is lost for good.
    """
    try:
        dask: Any = import_module("distributed")
    except ImportError as error:
        raise InputError(
            "--scheduler needs Dask, which is not installed; install 'cellquant[cluster]'."
        ) from error
    # Its remarks about lost connections would stand beside the one sentence that we raise.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    where = {"scheduler_file": scheduler} if Path(scheduler).is_file() else {"address": scheduler}
    try:
        client = dask.Client(**where, timeout=f"{PATIENCE}s", set_as_default=False)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"no Dask scheduler answers at {scheduler} ({_first_line(error)}); start one with "
            "'dask scheduler' and give its address or its scheduler file."
        ) from error
    try:
        yield from _Submissions(client, function, tasks, scheduler).outcomes()
    finally:
        client.close(timeout=5)


class _Submissions:
    """Tasks that a cluster has been given, and those that it has not ended yet."""

    def __init__(
        self,
        client: Any,
        function: Callable[[Task], None],
        tasks: Sequence[Task],
        scheduler: str,
    ) -> None:
        self.client, self.function, self.tasks = client, function, tasks
        self.scheduler = scheduler
        self.ended: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
        self.futures: dict[int, Any] = {}
        self.tries = [0] * len(tasks)

    def outcomes(self) -> Iterator[Outcome]:
        for index in range(len(self.tasks)):
            self._submit(index)
        while self.futures:
            try:
                index, future = self.ended.get(timeout=POLL)
            except queue.Empty:
                if self.client.status not in ("running", "connecting"):
                    raise self._lost() from None
                continue
            if self.futures.get(index) is not future:
                continue
            outcome = self._outcome(index, future)
            if outcome is not None:
                del self.futures[index]
                yield outcome
            elif self.tries[index] > TRIES:
                raise self._lost()
            else:
                self._wait_for_scheduler()
                self._submit(index)

    def _submit(self, index: int) -> None:
        self.tries[index] += 1
        future = self.client.submit(attempt, self.function, self.tasks[index], index, pure=False)
        self.futures[index] = future
        future.add_done_callback(lambda done: self.ended.put((index, done)))

    def _outcome(self, index: int, future: Any) -> Outcome | None:
        """How a task ended; None where the cluster lost it."""
        if future.status == "error":
            reason = _first_line(future.exception(timeout=PATIENCE))
            return Outcome(
                index,
                f"the cluster gave this task up ({reason}); look for a lack of memory on its "
                "workers, then run the same command again.",
            )
        try:
            outcome = future.result(timeout=PATIENCE) if future.status == "finished" else None
        except Exception:  # whatever Dask calls it: the result went with its scheduler
            return None
        return outcome if isinstance(outcome, Outcome) else None

    def _wait_for_scheduler(self) -> None:
        while self.client.status == "connecting":
            time.sleep(POLL / 10)
        if self.client.status != "running":
            raise self._lost()

    def _lost(self) -> InputError:
        return InputError(
            f"the Dask scheduler at {self.scheduler} was lost with {len(self.futures)} tasks to "
            "do; start it again and run the same command: what is finished is kept."
        )


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
