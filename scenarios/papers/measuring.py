"""Times of calls, and of contestants that take turns in random order.

On a shared machine milliseconds move by a factor of two from one minute to the next. Contestants that run right after
one another meet the same machine, so their ratio is what counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from unifg.solution.status import Status
from unifg.typing import Array

R = TypeVar("R")


def words(status: Status) -> str:
    """Status as tables name it."""
    return status.name.lower().replace("_", " ")


def clocked(
    function: Callable[..., R], *given: Any, by: Callable[[], float] = time.thread_time, **named: Any
) -> tuple[R, float]:
    """Result of a call and the time it took, by a clock: processor time of this thread, or another [s]."""
    begin = by()
    result = function(*given, **named)
    return result, by() - begin


def clock(action: Callable[[], Any]) -> float:
    """Processor time of one call [s]."""
    return clocked(action, by=time.process_time)[1]


def interleave(
    contestants: Mapping[str, Callable[[], float]], rounds: int, warm: int = 1, slow: float = np.inf
) -> dict[str, Array]:
    """Run every contestant once a round, in shuffled order; (rounds,) of what each returns.

    Args:
        contestants: each returns the time that counts, so that its preparations do not.
        rounds: that count.
        warm: rounds before them, for compilation and caches.
        slow: a contestant that once took longer does not run again, and has fewer rounds.
    """
    rng = np.random.default_rng(0)
    names = list(contestants)
    result: dict[str, list[float]] = {name: [] for name in names}
    for index in range(-warm, rounds):
        for k in rng.permutation(len(names)):
            name = names[k]
            if max(result[name], default=0.0) > slow:
                continue
            value = contestants[name]()
            if index >= 0:
                result[name].append(value)
    return {name: np.array(values) for name, values in result.items()}
