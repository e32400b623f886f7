"""Number of threads that share the work of one solve: one, unless more are asked for.

Compiled passes let other threads run, so that the parts of a large pass can run at once. What is shared out, and how,
does not depend on the machine: the same number of threads gives the same answer.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import Any

from unifg.codegen.vectors import Address
from unifg.codegen.work_queue import empty_mailbox, lead, serve
from unifg.errors import UnifgError

__all__ = ["cores", "share", "threads", "use_threads"]

logger = logging.getLogger("unifg")


class ThreadPool:
    """Threads that look out for calls for a while before they sleep: to wake one takes longer than many a pass."""

    def __init__(self, count: int) -> None:
        """Start so many threads; they end with the process, or when they are told to leave."""
        self.size = count
        self.mailbox = empty_mailbox()
        self.calling = threading.Lock()
        self.bell = threading.Condition()
        self.asleep = 0
        self.leaving = False
        for k in range(count):
            threading.Thread(target=self._stay, name=f"unifg {k + 1}", daemon=True).start()

    def wake(self) -> None:
        """Let all threads look out again."""
        with self.bell:
            self.bell.notify_all()

    def leave(self) -> None:
        """Let all threads end when they have done what they are at."""
        self.leaving = True
        self.wake()

    def _stay(self) -> None:
        seen = 0
        while not self.leaving:
            seen = serve(self.mailbox, seen)
            with self.bell:
                if not self.leaving:  # nobody rings for those who stay awake: who leaves has said so before
                    self.asleep += 1
                    self.bell.wait()
                    self.asleep -= 1


_crew: ThreadPool | None = None


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
    last, _crew = _crew, ThreadPool(count - 1) if count > 1 else None
    if last is not None:
        last.leave()


def threads() -> int:
    """Number of threads."""
    return 1 if _crew is None else 1 + _crew.size


def cores() -> int:
    """Number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share(entrance: Address, arguments: tuple[Any, ...]) -> None:
    """Do a compiled pass with all threads there are; alone, where they help another caller.

    Args:
        entrance: of the pass, see :func:`unifg.codegen.work_queue.entrance`.
        arguments: of the pass, by which those who take part share the work out: it is done whoever comes.
    """
    crew = _crew
    if crew is None or not crew.calling.acquire(blocking=False):
        lead(empty_mailbox(), entrance, arguments)
        return
    try:
        if crew.asleep:
            crew.wake()
        lead(crew.mailbox, entrance, arguments)
    finally:
        crew.calling.release()


def _after_fork() -> None:
    """In a forked child there are no threads, whatever the crew believes."""
    global _crew
    if _crew is not None:
        _crew = ThreadPool(_crew.size)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
