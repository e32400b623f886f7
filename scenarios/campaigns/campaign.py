"""A campaign: every episode of a statement run once, a line on file for each, continued where it was stopped."""

from __future__ import annotations

import json
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from unifg.atomic_write import write_atomically
from unifg.errors import ScenarioError
from unifg.scenarios.campaigns.journal import Journal, lines_of
from unifg.scenarios.campaigns.sources import fingerprint
from unifg.scenarios.campaigns.statement import Statement, module_of, read
from unifg.scenarios.campaigns.task import ERROR, FAILED, LOST, OK, Task, lost, run_task
from unifg.scenarios.episode import Progress, silent
from unifg.scenarios.options import find_modules_in
from unifg.scenarios.workers import Workers, cluster, died, finished

__all__ = [
    "EPISODES", "MANIFEST", "Campaign", "code_of", "episodes_of", "manifest_of", "replay_command",
    "run_campaign", "write_manifest",
]  # fmt: skip

EPISODES, MANIFEST = "episodes.jsonl", "campaign.json"
_ROW: dict[str, Any] = {
    "key": str, "labels": dict, "settings": dict, "seed": int | None, "scenario": str, "outcome": str,
    "seconds": int | float, "cpu_seconds": int | float, "metrics": dict,
}  # fmt: skip
_OPTIONAL: dict[str, Any] = {"seconds": 0.0, "cpu_seconds": 0.0, "metrics": {}}  # of episodes without an end


@dataclass
class Campaign:
    """State of a campaign.

    Attributes:
        folder: with its files.
        episodes: how many it has.
        outcomes: how many of them are ok, failed, error, lost.
        ran: how many were run by this call.
        interrupted: whether it was stopped before its end.
        remarks: what the user should know.
    """

    folder: Path
    episodes: int
    outcomes: Counter[str] = field(default_factory=Counter)
    ran: int = 0
    interrupted: bool = False
    remarks: list[str] = field(default_factory=list)

    @property
    def succeeded(self) -> bool:
        """True if every episode was run and succeeded."""
        return self.outcomes[OK] == self.episodes

    @property
    def summary(self) -> str:
        """One line for people."""
        counts = ", ".join(f"{self.outcomes[name]} {name}" for name in (OK, FAILED, ERROR, LOST))
        missing = self.episodes - self.outcomes.total()
        return f"{self.outcomes.total()} of {self.episodes} episodes: {counts}" + (
            f"; {missing} to do: start the same command again" if missing else ""
        )


def run_campaign(
    campaign: Statement | str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    executor: Executor | None = None,
    scheduler: str | None = None,
    again: bool = False,
    any_code: bool = False,
    progress: Progress = silent,
) -> Campaign:
    """Run what is missing of a campaign.

    Args:
        campaign: or the TOML file that states it.
        out: folder of its files; episodes that are on file there are not repeated.
        workers: processes of this machine, one thread each; with an executor, how many episodes it runs at once.
        executor: any of ``concurrent.futures``, instead of processes of our own.
        scheduler: address of a dask.distributed scheduler, instead of either.
        again: repeat episodes that ended in an error or were lost.
        any_code: keep episodes that earlier states of the code have run.
        progress: called several times a second with the share done and a short text; a KeyboardInterrupt it raises ends
            the campaign with what there is.

    Returns:
        What became of it.

    Raises:
        ScenarioError: the statement is wrong, the folder cannot be written or is in use, the disk is full, or there are
            no workers.
    """
    statement = campaign if isinstance(campaign, Statement) else read(campaign)
    folder = Path(out)
    code = code_of(statement)
    found = Campaign(folder, len(statement))
    with Journal(folder / EPISODES) as journal:
        found.remarks += [journal.mended] if journal.mended else []
        known = {episode.key for episode in statement.episodes()}
        done = _on_file(found, known, code, again, any_code)
        _remark_changes(found, statement, code, done)
        write_manifest(folder, statement, code)
        found.outcomes = Counter(done.values())
        beat = partial(_tell, found, time.monotonic(), progress)
        if len(done) == len(known):
            return found
        sources, base = fingerprint(), str(statement.base)
        missing = (episode for episode in statement.episodes() if episode.key not in done)
        tasks = (Task(statement.scenario, episode, base, code, sources) for episode in missing)
        with _executor(statement, workers, executor, scheduler) as (at_work, at_once):
            try:
                for task, future in finished(at_work, run_task, tasks, at_once, beat):
                    error = future.exception()
                    if isinstance(error, ScenarioError):  # of the workers: every other episode would say the same
                        raise error
                    if error is not None and not died(future):
                        raise ScenarioError(f"an episode cannot be handed to a worker: {error!r}") from error
                    text = lost(task, f"the worker died, twice: {error}") if error is not None else future.result()
                    journal.add(text)
                    found.outcomes[json.loads(text)["outcome"]] += 1
                    found.ran += 1
                    beat()
            except BaseException as error:
                if isinstance(at_work, Workers):
                    at_work.kill()
                else:
                    at_work.shutdown(wait=False, cancel_futures=True)
                found.interrupted = isinstance(error, KeyboardInterrupt)
                if not found.interrupted:
                    raise
    return found


def code_of(statement: Statement) -> str:
    """Digest of the library, and of the packages of a scenario, planners and worlds that are not of it."""
    find_modules_in(Path.cwd())
    return fingerprint(*statement.modules)


def manifest_of(folder: Path) -> dict[str, Any]:
    """Manifest in the folder of a campaign: "campaign" as stated, "base", "code", "axes", "bundles", "keys".

    Raises:
        ScenarioError: there is no campaign.
    """
    try:
        kept: dict[str, Any] = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        if {"campaign", "base", "code", "axes", "bundles", "compare", "keys"} <= kept.keys():
            return kept
        why = f"entries are missing in {MANIFEST}"
    except FileNotFoundError:
        why = f"there is no {MANIFEST} in it" if folder.is_dir() else "there is no such folder"
    except OSError as error:
        why = f"{MANIFEST} cannot be read: {error.strerror}"
    except (ValueError, AttributeError) as error:
        why = f"{MANIFEST} is damaged: {error}"
    raise ScenarioError(f"{folder}: holds no campaign: {why}")


def episodes_of(folder: Path, unreadable: list[int] | None = None) -> Iterator[dict[str, Any]]:
    """Rows of the episodes of a campaign that are on file.

    Args:
        folder: of the campaign.
        unreadable: is given the numbers of lines that hold none, or only a part of one.
    """

    def whole(row: dict[str, Any]) -> bool:
        told = _OPTIONAL | row
        fits = all(name in told and isinstance(told[name], kind) for name, kind in _ROW.items())
        return fits and told["outcome"] in (OK, FAILED, ERROR, LOST)

    return lines_of(folder / EPISODES, unreadable, whole=whole)


def replay_command(folder: Path, key: str) -> str:
    """Command that runs an episode again."""
    return f"unifg replay {shlex.quote(str(folder))} {key}"


def _on_file(found: Campaign, known: set[str], code: str, again: bool, any_code: bool) -> dict[str, str]:
    """Outcomes of episodes that need not be run, by key."""
    unreadable: list[int] = []
    done: dict[str, str] = {}
    others = Counter[str]()
    left: set[str] = set()
    for row in episodes_of(found.folder, unreadable):
        key, outcome = row["key"], row["outcome"]
        if key not in known:
            left.add(key)
        elif row.get("code") != code and not any_code:
            others[str(row.get("code"))] += 1
        elif again and outcome in (ERROR, LOST):
            done.pop(key, None)
        else:
            done[key] = outcome
    if unreadable:
        found.remarks.append(f"{EPISODES}: line {', '.join(map(str, unreadable))} cannot be read and does not count")
    if others:
        which = ", ".join(f"{count} of {other}" for other, count in others.items())
        found.remarks.append(
            f"the code has changed ({code} now, on file {which}): those episodes are repeated; --any-code keeps them"
        )
    if left:
        found.remarks.append(f"{len(left)} episodes on file are not of this campaign (any more): left alone")
    return done


def _remark_changes(found: Campaign, statement: Statement, code: str, done: dict[str, str]) -> None:
    if not (found.folder / MANIFEST).is_file():
        return
    try:
        before = manifest_of(found.folder)["campaign"]
    except ScenarioError:
        found.remarks.append(f"{MANIFEST} cannot be read: it is written anew")
        return
    if before != json.loads(json.dumps(statement.given, default=str)):
        changed = sorted(
            {word for word in {*before, *statement.given} if before.get(word) != statement.given.get(word)} - {"title"}
        )
        found.remarks.append(
            f"the campaign has changed since it was begun here ({', '.join(changed) or 'title'}): "
            f"{len(done)} episodes on file still belong to it"
        )


def write_manifest(folder: Path, statement: Statement, code: str) -> None:
    """Say in the folder of a campaign which one it is, and by which code it was run last.

    Raises:
        ScenarioError: the folder cannot be written.
    """
    said = {
        "campaign": statement.given,
        "base": str(statement.base),
        "code": code,
        "axes": {axis.name: list(axis.values) for axis in statement.axes},
        "bundles": [axis.name for axis in statement.axes if axis.bundle],
        "compare": statement.compare,
        "keys": [episode.key for episode in statement.episodes()],
    }
    path = folder / MANIFEST
    try:
        write_atomically(path, json.dumps(said, default=str) + "\n")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def _executor(
    statement: Statement, workers: int, executor: Executor | None, scheduler: str | None
) -> Iterator[tuple[Executor, Callable[[], int]]]:
    if executor is not None:
        yield executor, lambda: 2 * workers
    elif scheduler is not None:
        with cluster(scheduler) as there:
            yield there
    else:
        with Workers(workers, partial(_ready, module_of(statement.scenario).__name__)) as ours:
            yield ours, lambda: workers + 1  # the next is at hand when one ends


def _ready(module: str) -> None:
    """Prepare a process for its first episode."""
    import_module(module)
    fingerprint()


def _tell(c: Campaign, began: float, progress: Progress) -> None:
    """Tell how far a campaign is that began at a monotonic time [s], and how long it will take."""
    done = c.outcomes.total()
    bad = ", ".join(f"{c.outcomes[name]} {name}" for name in (FAILED, ERROR, LOST) if c.outcomes[name])
    text = f"{done} of {c.episodes}" + (f", {bad}" if bad else "")
    if c.ran:
        ahead = (time.monotonic() - began) / c.ran * (c.episodes - done)
        text += f", {timedelta(seconds=round(ahead))} left"
    progress(done / max(1, c.episodes), text)
