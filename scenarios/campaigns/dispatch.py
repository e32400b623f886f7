"""Jobs through an executor: a few at a time however many there are, those of a worker that died once more."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from typing import Any, TypeVar

from unifg.errors import ScenarioError
from unifg.scenarios.workers import WorkerDied

__all__ = ["died", "finished"]

J = TypeVar("J")
BEAT = 0.25  # [s]


def died(error: BaseException | None) -> bool:
    """Whether an error says that a worker died, and nothing about the job itself."""
    cluster = sys.modules.get("distributed")
    return _once(error) or (cluster is not None and isinstance(error, cluster.KilledWorker))


def _once(error: BaseException | None) -> bool:
    """Whether it died for the first time; the scheduler of a cluster has tried several before it says so."""
    return isinstance(error, WorkerDied | BrokenExecutor)


def finished(
    executor: Executor,
    task: Callable[[J], Any],
    jobs: Iterable[J],
    at_once: Callable[[], int],
    beat: Callable[[], None] = lambda: None,
) -> Iterator[tuple[J, Future[Any]]]:
    """Jobs as they end, with their finished futures.

    A job whose worker died is given to another one; if that dies as well, the future says so.

    Args:
        executor: does them.
        task: can be pickled, as the jobs can, where the executor asks for that.
        jobs: taken one by one, when there is room.
        at_once: how many may be under way; asked again and again, as machines come and go.
        beat: called several times a second, also while nothing ends; may raise.

    Raises:
        ScenarioError: the executor takes no more jobs.
    """
    coming, again = iter(jobs), deque[J]()
    waiting: dict[Future[Any], tuple[J, bool]] = {}
    empty = False
    while True:
        while len(waiting) < max(1, at_once()) and not (empty and not again):
            try:
                job, first = (again.popleft(), False) if again else (next(coming), True)
            except StopIteration:
                empty = True
                continue
            try:
                waiting[executor.submit(task, job)] = job, first
            except RuntimeError as error:
                raise ScenarioError(
                    f"the executor takes no more jobs ({error}); what ended before is kept: start again"
                ) from error
            if any(future.done() for future in waiting):
                break  # told before more is begun: in one thread nothing runs beside it
        if not waiting:
            return
        done, _ = wait(waiting, BEAT, FIRST_COMPLETED)
        beat()
        for future in done:
            job, first = waiting.pop(future)
            if future.cancelled():
                raise ScenarioError("the executor has dropped its jobs; what ended before is kept: start again")
            if first and _once(future.exception()):
                again.append(job)
            else:
                yield job, future
