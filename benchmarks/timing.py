"""How everything is timed: candidates in turn, many rounds, ratios within a round, medians with quartiles.

On a shared machine milliseconds move by a factor of two from one minute to the next. Candidates that run right after
one another meet the same machine, so their ratio is what counts.
"""

from __future__ import annotations

import functools
import os
import sys
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, TypeAlias

import numpy as np

from unifg.typing import Array

Spread: TypeAlias = list[float]
"""Median, lower and upper quartile; a list because results are written as JSON."""


def pin() -> None:
    """Stay on one core, where the system allows it: peers with thread pools use one thread then."""
    if sys.platform == "linux":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def clock(action: Callable[[], Any]) -> float:
    """Time of one call [s]."""
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


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


class Stopwatch:
    """Adds up the time spent in chosen functions while it is entered.

    Args:
        watched: for each part the owner (module or class) and the name of the function its callers look up there.

    Attributes:
        seconds: by part.
        calls: by part.
    """

    def __init__(self, watched: Mapping[str, tuple[Any, str]]) -> None:
        """Nothing is replaced before it is entered."""
        self._watched = watched
        self._originals = {part: getattr(owner, name) for part, (owner, name) in watched.items()}
        self.seconds = dict.fromkeys(watched, 0.0)
        self.calls = dict.fromkeys(watched, 0)

    def __enter__(self) -> Stopwatch:
        """Start from zero."""
        for part, (owner, name) in self._watched.items():
            self.seconds[part], self.calls[part] = 0.0, 0
            setattr(owner, name, self._timed(part))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Put the functions back."""
        for part, (owner, name) in self._watched.items():
            setattr(owner, name, self._originals[part])

    def _timed(self, part: str) -> Callable[..., Any]:
        original = self._originals[part]

        @functools.wraps(original)
        def call(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            try:
                return original(*arguments, **named)
            finally:
                self.seconds[part] += time.perf_counter() - begin
                self.calls[part] += 1

        return call
