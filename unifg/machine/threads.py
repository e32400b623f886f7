"""How many threads share the work of one solve: one, unless more are asked for.

Compiled passes let other threads run, so that the parts of a large pass can run at once. What is shared out, and how,
does not depend on the machine: the same number of threads gives the same answer.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from unifg.errors import UnifgError
from unifg.machine.waiting import changes

__all__ = ["at_once", "cores", "threads", "use_threads"]

T = TypeVar("T")

logger = logging.getLogger("unifg")


class Batch(Generic[T]):
    """Jobs of one call of :func:`at_once`, and what they answered."""

    def __init__(self, jobs: Sequence[Callable[[], T]], helpers: int) -> None:
        """Nobody has begun with any of them."""
        self.waiting = deque(enumerate(jobs))
        self.entered = list[int]()
        self.left = np.zeros(helpers, np.int64)
        self.results = dict[int, T]()
        self.failures = dict[int, BaseException]()

    def help(self, helper: int) -> None:
        """Work as one of the helpers, who say so before they look for a job: none is taken unseen."""
        self.entered.append(helper)
        try:
            self.work()
        finally:
            self.left[helper] = 1

    def work(self) -> None:
        """Take one job after the other until none is left."""
        while True:
            try:
                k, job = self.waiting.popleft()
            except IndexError:
                return
            try:
                self.results[k] = job()
            except BaseException as failure:
                self.failures[k] = failure


class Crew:
    """Threads that look out for new jobs for a while before they sleep: to wake one takes longer than many a pass."""

    def __init__(self, count: int) -> None:
        """Start so many threads; they end with the process, or when they are told to leave."""
        self.calls = deque[tuple[Batch[Any], int]]()
        self.posted = np.zeros(1, np.int64)
        self.bell = threading.Condition()
        self.leaving = False
        self.size = count
        changes(self.posted.ctypes.data, 0, 1)  # compiled, where it has not been, before anybody waits for it
        for k in range(count):
            threading.Thread(target=self._stay, name=f"unifg {k + 1}", daemon=True).start()

    def post(self, batch: Batch[Any]) -> None:
        """Call for the helpers of a batch."""
        self.calls.extend((batch, helper) for helper in range(len(batch.left)))
        self._ring()

    def leave(self) -> None:
        """Let all threads end when they have done what has been posted."""
        self.leaving = True
        self._ring()

    def finish(self, batch: Batch[Any]) -> None:
        """Let nobody begin with a job any more, and wait for all helpers that may have."""
        batch.waiting.clear()
        for k in tuple(batch.entered):
            if not batch.left[k] and not changes(batch.left.ctypes.data, k, 0):
                with self.bell:
                    self.bell.wait_for(lambda k=k: bool(batch.left[k]))  # type: ignore[misc]

    def _ring(self) -> None:
        with self.bell:
            self.posted[0] += 1
            self.bell.notify_all()

    def _stay(self) -> None:
        while True:
            seen = int(self.posted[0])
            try:
                batch, helper = self.calls.popleft()
            except IndexError:
                if self.leaving:
                    return
                if not changes(self.posted.ctypes.data, 0, seen):
                    with self.bell:
                        self.bell.wait_for(lambda seen=seen: self.posted[0] != seen)  # type: ignore[misc]
                continue
            batch.help(helper)
            del batch  # or its arrays would live until the next one
            with self.bell:
                self.bell.notify_all()


_crew: Crew | None = None


def use_threads(count: int) -> None:
    """Let large solves of this process use several threads: least squares' linearisation and elimination.

    A warning is logged where there are fewer cores.

    Args:
        count: threads, at least one; one is the default, and right where several processes share a machine.

    Raises:
        UnifgError: it is no such number.
    """
    global _crew
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise UnifgError(f"use_threads takes a whole number of threads, at least 1, got {count!r}")
    if count == threads():
        return
    if count > cores():
        logger.warning(
            "use_threads(%d): this process may use %d cores; threads that wait take time from those that work",
            count, cores(),
        )  # fmt: skip
    last, _crew = _crew, Crew(count - 1) if count > 1 else None
    if last is not None:
        last.leave()


def threads() -> int:
    """How many there are."""
    return 1 if _crew is None else 1 + _crew.size


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def at_once(jobs: Sequence[Callable[[], T]]) -> list[T]:
    """Results of jobs in their order; whoever is free, this thread among them, takes the next one.

    Raises:
        BaseException: what the first job that failed has raised, when none is at work any more.
    """
    crew = _crew
    if crew is None or len(jobs) < 2:
        return [job() for job in jobs]
    batch = Batch(jobs, min(crew.size, len(jobs) - 1))
    crew.post(batch)
    try:
        batch.work()
    finally:  # what jobs write to may be gone when this returns
        crew.finish(batch)
    if batch.failures:
        raise batch.failures[min(batch.failures)]
    return [batch.results[k] for k in range(len(jobs))]


def _after_fork() -> None:
    """In a forked child there are no threads, whatever the crew believes."""
    global _crew
    if _crew is not None:
        _crew = Crew(_crew.size)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
