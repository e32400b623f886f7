"""Cores that are timed on, and spreads and ratios of times (:mod:`unifg.scenarios.papers.measuring`)."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
from scipy.stats import bootstrap

from unifg.scenarios.papers.measuring import clock as clock
from unifg.scenarios.papers.measuring import clocked as clocked
from unifg.scenarios.papers.measuring import interleave as interleave
from unifg.typing import Array

Spread: TypeAlias = list[float]
"""Median, lower and upper bound; a list because results are written as JSON."""
Contestants: TypeAlias = dict[str, Callable[[], float]]
"""By name, what measures a time [s]."""


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


def timed(action: Callable[[], Any], per: float = 1.0) -> Callable[[], float]:
    """Contestant of :func:`interleave`: the time of an action over a number, such as its iterations [s]."""
    return lambda: clock(action) / per


def spread(values: Array) -> Spread:
    """Median and quartiles."""
    low, median, high = np.percentile(values, [25.0, 50.0, 75.0])
    return [float(median), float(low), float(high)]


def ratio(times: Array, others: Array) -> Spread:
    """Median ratio of times within a round, and its 95 % bootstrap interval."""
    count = min(len(times), len(others))
    values = times[:count] / others[:count]
    median = float(np.median(values))
    if count < 3:
        return [median, float(values.min()), float(values.max())]
    found = bootstrap((values,), np.median, n_resamples=2000, method="percentile", rng=0).confidence_interval
    return [median, float(found.low), float(found.high)]


def milliseconds(seconds: Array) -> Spread:
    """Median and quartiles [ms]."""
    return spread(1e3 * seconds)


def shown(value: Spread | None) -> str:
    """Median and bounds for a table."""
    if value is None:
        return "-"
    return "{} ({} to {})".format(*map(number, value))


def number(value: float, digits: int = 3) -> str:
    """Significant digits without an exponent."""
    if not np.isfinite(value):
        return "-"
    places = digits if value == 0.0 else max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{min(places, 9)}f}"
