"""Compile counter: functions compiled and read from the cache while the process runs.

A loop that must keep its period looks at the count before and after a tick. The first compilation of a process is
announced, because it may take seconds; what is read from the cache is not. While Numba works it leaves hundreds of
thousands of objects behind that refer to each other: the collector of garbage, which would look through all of them
again and again for a seventh of the time, waits for larger heaps.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from numba.core import event

logger = logging.getLogger("unifg")

PATIENCE = (100_000, 20, 100)  # of the collector; Python's own is 700, 10, 10


@dataclass
class Tally:
    """Names of functions, in order.

    Attributes:
        compiled: by Numba.
        generated: from what comes with the library; only code for this processor was missing.
        read: from the cache on disk, ready to run.
        files: where the cache keeps them.
    """

    compiled: list[str] = field(default_factory=list)
    generated: list[str] = field(default_factory=list)
    read: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)

    @property
    def everything(self) -> int:
        """Number of functions that were not in memory."""
        return len(self.compiled) + len(self.generated) + len(self.read)


tally = Tally()
"""Of this process."""


@contextmanager
def counting() -> Iterator[Tally]:
    """Counts of a block; complete when it is left."""
    marks = {name: len(functions) for name, functions in vars(tally).items()}
    added = Tally()
    try:
        yield added
    finally:
        for name, mark in marks.items():
            vars(added)[name] += vars(tally)[name][mark:]


class _Listener(event.Listener):  # type: ignore[misc]
    """Numba tells it when a compilation begins and ends; callees are compiled while their callers are."""

    def __init__(self) -> None:
        """Nothing is being compiled."""
        self._depth, self._before = 0, gc.get_threshold()
        self.announced = False

    def on_start(self, event: Any) -> None:
        """Count, say so once, and keep the collector waiting."""
        dispatcher = event.data["dispatcher"]
        function = dispatcher.py_func
        tally.compiled.append(f"{function.__module__}.{function.__qualname__}")
        if self._depth == 0:
            self._before = gc.get_threshold()
            gc.set_threshold(*(max(pair) if min(pair) else 0 for pair in zip(PATIENCE, self._before, strict=True)))
        self._depth += 1
        where = getattr(dispatcher._cache, "cache_path", None)
        if where is not None and not self.announced:
            self.announced = True
            logger.warning(
                "unifg compiles %s, and what else it needs, for the first time on this machine: this can take tens of "
                "seconds and is kept in %s; `unifg warmup` compiles all there is at once",
                tally.compiled[-1],
                where,
            )

    def on_end(self, event: Any) -> None:
        """Give the collector its own thresholds back."""
        self._depth -= 1
        if self._depth == 0:
            gc.set_threshold(*self._before)


listener = _Listener()
event.register("numba:compile", listener)
