"""The jobs of a measuring module: run once each, kept line by line in out/benchmarks, told by its command line.

A job is a dataclass whose fields say everything about it: these fields stand in its row as well.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import Field, fields
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from tqdm import tqdm

from benchmarks.comparison import Key, Row
from benchmarks.report import OUT, commit
from unifg.errors import UnifgError
from unifg.scenarios.campaigns.dispatch import finished
from unifg.scenarios.campaigns.journal import Journal, lines_of
from unifg.scenarios.workers import Inline, Workers


class Job(Protocol):
    """Any dataclass with fields of strings and numbers."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Setting = TypeVar("Setting")
JobT = TypeVar("JobT", bound=Job)


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
        rows = recorded(task, batch, OUT / f"{name}.jsonl", commit(), how)
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
        code: commit that is measured; rows of another one are not used.
        chosen: of :func:`options`; ``report`` runs nothing, and like ``any_code`` uses rows of any state of the code.
            One worker is this process, which is the only way to times that mean something.

    Returns:
        What the task returned, with "key" (a tuple) and "code"; jobs of earlier calls too.
    """
    any_code = chosen.report or chosen.any_code
    rows = {tuple(row["key"]): row for row in lines_of(store) if any_code or row["code"] == code}
    missing = {key: job for key, job in jobs.items() if not chosen.report and (chosen.fresh or key not in rows)}
    if missing:
        alone = chosen.workers == 1
        with (
            Journal(store) as journal,
            Inline() if alone else Workers(chosen.workers) as executor,
            tqdm(total=len(missing)) as bar,
        ):
            try:
                for key, row in _rows(executor, task, missing, chosen.workers):
                    rows[key] = {"key": key, "code": code, **row}
                    journal.add(json.dumps(rows[key]))
                    bar.set_postfix_str(", ".join(map(str, key)))
                    bar.update()
            except BaseException:
                if isinstance(executor, Workers):
                    executor.kill()
                raise
    return [{**row, "key": key} for key, row in rows.items()]


def _rows(
    executor: Executor, task: Callable[[Setting], Row], jobs: Mapping[Key, Setting], workers: int
) -> Iterable[tuple[Key, Row]]:
    keys = {id(job): key for key, job in jobs.items()}
    for job, future in finished(executor, task, jobs.values(), lambda: workers):
        yield keys[id(job)], future.result()
