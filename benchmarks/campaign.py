"""Campaigns of many episodes: running them, and what their paired differences say."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, as_completed
from typing import TypeVar

import numpy as np

from unifg.typing import Array

Setting = TypeVar("Setting")
Result = TypeVar("Result")

RESAMPLES = 2000


def campaign(
    task: Callable[[Setting], Result], settings: Iterable[Setting], executor: Executor | None = None
) -> Iterator[Result]:
    """Yield the results of a task for every setting, as they come.

    Args:
        task: a function that can be pickled.
        settings: what it is to be called with.
        executor: where it runs, such as a process pool or that of a dask client; None runs one after the other here,
            which is the only way to times that mean something.
    """
    if executor is None:
        yield from map(task, settings)
        return
    for future in as_completed([executor.submit(task, setting) for setting in settings]):
        yield future.result()


def interval(differences: Array) -> tuple[float, float]:
    """95 % bootstrap interval of the mean."""
    rng = np.random.default_rng(0)
    means = rng.choice(differences, (RESAMPLES, len(differences))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)
