"""Campaigns of many jobs: run once each, kept line by line, and what their paired differences say."""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from tqdm import tqdm

from unifg.typing import Array

Setting = TypeVar("Setting")
Result = TypeVar("Result")
Key: TypeAlias = tuple[Any, ...]
Row: TypeAlias = dict[str, Any]

RESAMPLES = 2000


def options(parser: argparse.ArgumentParser) -> None:
    """Add what every campaign can be told."""
    parser.add_argument("--workers", type=int, default=1, help="jobs at once; times mean something for one alone")
    parser.add_argument("--fresh", action="store_true", help="repeat jobs that are on file")
    parser.add_argument("--report", action="store_true", help="run nothing, write the tables from what is on file")


def recorded(
    task: Callable[[Setting], Row],
    jobs: Mapping[Key, Setting],
    store: Path,
    code: str,
    chosen: argparse.Namespace,
) -> list[Row]:
    """Rows on file, after running the jobs that are missing there; a new row is a line as soon as it is there.

    The file only grows: rows of other states of the code stay in it, and of two rows with one key the later one counts.

    Args:
        task: returns what JSON can hold; can be pickled.
        jobs: its settings; a key holds strings and numbers.
        store: the file, one JSON object a line.
        code: digest of what the task depends on; rows of another one are not used.
        chosen: of :func:`options`; ``report`` runs nothing and uses rows of any state of the code.

    Returns:
        What the task returned, with "key" (a tuple) and "code"; jobs of earlier calls too.
    """
    lines = store.read_text(encoding="utf-8").splitlines() if store.is_file() else []
    rows = {tuple(row["key"]): row for row in map(json.loads, lines) if chosen.report or row["code"] == code}
    missing = {key: job for key, job in jobs.items() if not chosen.report and (chosen.fresh or key not in rows)}
    store.parent.mkdir(parents=True, exist_ok=True)
    pool = None
    with ExitStack() as stack:
        file, bar = (stack.enter_context(c) for c in (store.open("a", encoding="utf-8"), tqdm(total=len(missing))))
        if chosen.workers > 1:
            pool = ProcessPoolExecutor(chosen.workers, mp_context=multiprocessing.get_context("spawn"))
            stack.callback(pool.shutdown, cancel_futures=True)
        for key, row in campaign(partial(_keyed, task), missing.items(), pool):
            rows[key] = {"key": key, "code": code, **row}
            file.write(json.dumps(rows[key]) + "\n")
            file.flush()
            bar.set_postfix_str(", ".join(map(str, key)))
            bar.update()
    return [{**row, "key": key} for key, row in rows.items()]


def _keyed(task: Callable[[Setting], Row], job: tuple[Key, Setting]) -> tuple[Key, Row]:
    return job[0], task(job[1])


def campaign(
    task: Callable[[Setting], Result], settings: Iterable[Setting], executor: Executor | None = None
) -> Iterator[Result]:
    """Yield the results of a task for every setting, as they come.

    Args:
        task: a function that can be pickled.
        settings: what it is to be called with.
        executor: where it runs, such as a process pool; None runs one after the other here, which is the only way to
            times that mean something.
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
