"""How everything is timed: candidates in turn, many rounds, ratios within a round, medians with quartiles.

On a shared machine milliseconds move by a factor of two from one minute to the next. Candidates that run right after
one another meet the same machine, so their ratio is what counts.
"""

from __future__ import annotations

import functools
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, TypeAlias
from unittest import mock

import numpy as np

from unifg.typing import Array

Spread: TypeAlias = list[float]
"""Median, lower and upper quartile; a list because results are written as JSON."""


def pin() -> None:
    """Stay on one core, where the system allows it: peers with thread pools use one thread then."""
    if sys.platform == "linux":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


@contextmanager
def all_cores() -> Iterator[None]:
    """Inside, this thread and those it starts may use all cores again."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def clock(action: Callable[[], Any]) -> float:
    """Time of one call [s]."""
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def timed(action: Callable[[], Any], per: float = 1.0) -> Callable[[], float]:
    """A candidate of :func:`interleave`: the time of an action over a number, such as its iterations [s]."""
    return lambda: clock(action) / per


def interleave(
    candidates: Mapping[str, Callable[[], float]], rounds: int, warm: int = 1, slow: float = np.inf
) -> dict[str, Array]:
    """Let every candidate run once per round, in shuffled order; (rounds,) of what each returns.

    Args:
        candidates: each returns the time it wants counted, so that its preparations are not.
        rounds: that count.
        warm: rounds before them, for compilation and caches.
        slow: who once took longer does not run again, and has fewer rounds.
    """
    rng = np.random.default_rng(0)
    names = list(candidates)
    result: dict[str, list[float]] = {name: [] for name in names}
    for index in range(-warm, rounds):
        for k in rng.permutation(len(names)):
            name = names[k]
            if max(result[name], default=0.0) > slow:
                continue
            value = candidates[name]()
            if index >= 0:
                result[name].append(value)
    return {name: np.array(values) for name, values in result.items()}


def spread(values: Array) -> Spread:
    """Median and quartiles."""
    low, median, high = np.percentile(values, [25.0, 50.0, 75.0])
    return [float(median), float(low), float(high)]


def milliseconds(seconds: Array) -> Spread:
    """Median and quartiles [ms]."""
    return spread(1e3 * seconds)


def shown(value: Spread | None, digits: int = 3) -> str:
    """Median and quartiles for a table."""
    if value is None:
        return "-"
    median, low, high = (number(part, digits) for part in value)
    return f"{median} ({low} to {high})"


def number(value: float, digits: int = 3) -> str:
    """Significant digits without an exponent."""
    if not np.isfinite(value):
        return "-"
    places = digits if value == 0.0 else max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{min(places, 9)}f}"


class Split:
    """A candidate of :func:`interleave` that also tells which share of its time chosen functions take.

    Args:
        watched: for each part the owner (module or class) and the name of the function its callers look up there.
        action: timed; called with what ``setup`` returns.
        per: what times are divided by, such as iterations.
        setup: before each round, not timed.

    Attributes:
        parts: times of all rounds by part [s]; "Python" is what no part takes.
        calls: of the last round by part.
    """

    def __init__(
        self,
        watched: Mapping[str, tuple[Any, str]],
        action: Callable[..., Any],
        per: float = 1.0,
        setup: Callable[[], tuple[Any, ...]] = tuple,
    ) -> None:
        """Nothing runs, and nothing is replaced, before it is called."""
        self._watched, self._action, self._per, self._setup = watched, action, per, setup
        self.parts: dict[str, list[float]] = {part: [] for part in (*watched, "Python")}
        self.calls: dict[str, int] = {}

    def __call__(self) -> float:
        """Run once; the time of the whole [s]."""
        given = self._setup()
        spent = dict.fromkeys(self._watched, 0.0)
        self.calls = dict.fromkeys(self._watched, 0)
        with ExitStack() as replaced:
            for part, (owner, name) in self._watched.items():
                replaced.enter_context(mock.patch.object(owner, name, self._timed(part, getattr(owner, name), spent)))
            elapsed = clock(lambda: self._action(*given))
        for part, seconds in (*spent.items(), ("Python", elapsed - sum(spent.values()))):
            self.parts[part].append(seconds / self._per)
        return elapsed / self._per

    def _timed(self, part: str, original: Callable[..., Any], spent: dict[str, float]) -> Callable[..., Any]:
        @functools.wraps(original)
        def call(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            try:
                return original(*arguments, **named)
            finally:
                spent[part] += time.perf_counter() - begin
                self.calls[part] += 1

        return call

    def milliseconds(self, rounds: int) -> dict[str, Spread]:
        """Medians and quartiles of the last rounds by part [ms]."""
        return {part: milliseconds(np.array(values[-rounds:])) for part, values in self.parts.items()}
