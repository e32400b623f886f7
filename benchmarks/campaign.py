"""Campaigns of many jobs: run once each, kept line by line, and what their paired differences say.

Episodes are jobs stated by a dataclass whose fields say everything about them: these fields stand in the row as well.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import Field, fields
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeAlias, TypeVar

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from benchmarks.report import OUT, code_digest, table
from unifg.errors import UnifgError
from unifg.typing import Array


class Job(Protocol):
    """Any dataclass with fields of strings and numbers."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Setting = TypeVar("Setting")
Key: TypeAlias = tuple[Any, ...]
Row: TypeAlias = dict[str, Any]
Read: TypeAlias = Callable[[Row], float | None]
"""A measure of a row; None where it has none."""
JobT = TypeVar("JobT", bound=Job)

RESAMPLES = 2000


def options(parser: argparse.ArgumentParser) -> None:
    """Add what every campaign can be told."""
    parser.add_argument("--workers", type=int, default=1, help="jobs at once; times mean something for one alone")
    parser.add_argument("--fresh", action="store_true", help="repeat jobs that are on file")
    parser.add_argument("--report", action="store_true", help="run nothing, write the tables from what is on file")
    parser.add_argument("--any-code", action="store_true", help="jobs of earlier states of the code count, too")


def seeds(text: str) -> range:
    """A range of seeds from the command line, such as 0:100."""
    begin, _, end = text.partition(":")
    if not (begin.isdecimal() and end.isdecimal() and int(begin) < int(end)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of seeds: expected FIRST:END, such as 0:100")
    return range(int(begin), int(end))


def episodes(
    name: str,
    episode: Callable[[JobT], Row],
    jobs: Iterable[JobT],
    chosen: argparse.Namespace,
    alone: Callable[[JobT], bool] = lambda job: False,
) -> list[Row]:
    """Rows of all episodes on file, after running those of the jobs that are missing there; see :func:`recorded`.

    Args:
        name: of the measuring module, and of the file in out/benchmarks.
        episode: what is kept of a job; a function that can be pickled.
        jobs: to run.
        chosen: of :func:`options`.
        alone: jobs that run one at a time, after the others.

    Returns:
        Rows with the fields of the job, "workers" (how many ran at once), and what was kept, or why it was refused as
        "error".

    Raises:
        SystemExit: when there is nothing on file.
    """
    rows: list[Row] = []
    keyed = {tuple(_stated(job).values()): job for job in jobs}
    for workers, single in ((chosen.workers, False), (1, True)):
        batch = {key: job for key, job in keyed.items() if alone(job) is single}
        how = argparse.Namespace(**{**vars(chosen), "workers": workers})
        task = partial(_episode, episode, workers)
        rows = recorded(task, batch, OUT / f"{name}.jsonl", code_digest(f"benchmarks.{name}"), how)
    if not rows:
        raise SystemExit(f"Nothing on file in {OUT / name}.jsonl for this state of the code.")
    return rows


def _episode(episode: Callable[[JobT], Row], workers: int, job: JobT) -> Row:
    try:
        return {**_stated(job), "workers": workers, **episode(job)}
    except UnifgError as error:
        return {**_stated(job), "workers": workers, "error": str(error)}


def _stated(job: Job) -> Row:
    return {field.name: getattr(job, field.name) for field in fields(job)}


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
        chosen: of :func:`options`; ``report`` runs nothing, and like ``any_code`` uses rows of any state of the code.

    Returns:
        What the task returned, with "key" (a tuple) and "code"; jobs of earlier calls too.
    """
    any_code = chosen.report or chosen.any_code
    rows = {tuple(row["key"]): row for row in lines_of(store) if any_code or row["code"] == code}
    missing = {key: job for key, job in jobs.items() if not chosen.report and (chosen.fresh or key not in rows)}
    store.parent.mkdir(parents=True, exist_ok=True)
    with store.open("a", encoding="utf-8") as file, tqdm(total=len(missing), disable=not missing) as bar:
        if file.tell() and not store.read_bytes().endswith(b"\n"):
            file.write("\n")  # a run that was killed left half a line
        for key, row in _finished(task, missing, chosen.workers):
            rows[key] = {"key": key, "code": code, **row}
            file.write(json.dumps(rows[key]) + "\n")
            file.flush()
            bar.set_postfix_str(", ".join(map(str, key)))
            bar.update()
    return [{**row, "key": key} for key, row in rows.items()]


def _finished(task: Callable[[Setting], Row], jobs: Mapping[Key, Setting], workers: int) -> Iterator[tuple[Key, Row]]:
    """Rows as they come; one worker is this process, which is the only way to times that mean something."""
    if workers == 1 or not jobs:
        yield from ((key, task(job)) for key, job in jobs.items())
        return
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        futures = {pool.submit(task, job): key for key, job in jobs.items()}
        yield from ((futures[future], future.result()) for future in as_completed(futures))
    finally:
        pool.shutdown(cancel_futures=True)


def lines_of(store: Path) -> Iterator[Row]:
    """What is on file; a line that was cut off does not count."""
    for line in store.read_text(encoding="utf-8").splitlines() if store.is_file() else []:
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


# ---------------------------------------------------------------- what the rows say


def where(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Rows with these values, without those that were refused."""
    return [row for row in rows if "error" not in row and all(row[name] == value for name, value in wanted.items())]


def crossed(rows: Iterable[Row], *names: str) -> dict[Key, list[Row]]:
    """Rows by their values of some fields, in the order of seeds; a seed counts when all groups have it."""
    groups: dict[Key, dict[int, Row]] = {}
    for row in where(rows):
        groups.setdefault(tuple(row[name] for name in names), {})[row["seed"]] = row
    common = sorted(set[int].intersection(*map(set, groups.values()))) if groups else []
    return {key: [found[seed] for seed in common] for key, found in groups.items()}


def paired(mine: Iterable[Row], base: Iterable[Row], read: Read) -> tuple[Array, Array]:
    """(n,) values of two variants for the seeds of which both have one."""
    a, b = ({row["seed"]: read(row) for row in rows} for rows in (mine, base))
    both = [(a[seed], b[seed]) for seed in sorted(set(a) & set(b)) if a[seed] is not None and b[seed] is not None]
    values = np.array(both, dtype=np.float64).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def interval(differences: Array) -> tuple[float, float]:
    """95 % bootstrap interval of the mean."""
    rng = np.random.default_rng(0)
    means = rng.choice(differences, (RESAMPLES, len(differences))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def against(mine: Sequence[Row], base: Sequence[Row], read: Read) -> str:
    """Mean of a variant and, in brackets, the interval of its paired difference to the base, which has none.

    The number of pairs is told where some seeds have none.
    """
    values, others = paired(mine, base, read)
    if not len(values):
        return "-"
    if mine is base:
        return f"{values.mean():.3g}"
    low, high = interval(values - others)
    pairs = "" if len(values) == min(len(mine), len(base)) else f", n={len(values)}"
    return f"{values.mean():.3g} ({digits(low, '+')} .. {digits(high, '+')}){pairs}"


def comparison(measures: Mapping[str, Read], variants: Mapping[str, Sequence[Row]], base: str, head: str = "") -> str:
    """A table of measures by variants that have rows, each against the base."""
    flown = {name: rows for name, rows in variants.items() if rows}
    lines = [
        [measure, *(against(rows, flown[base], read) for rows in flown.values())] for measure, read in measures.items()
    ]
    return table([head, *flown], lines)


def share(hits: int, of: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927)."""
    if not of:
        return 0.0, 1.0
    found = binomtest(hits, of).proportion_ci(0.95, "wilson")
    return float(found.low), float(found.high)


def digits(value: float, sign: str = "") -> str:
    """Two significant digits, all of those before the point."""
    return f"{value:{sign}.0f}" if abs(value) >= 10.0 else f"{value:{sign}.2g}"
