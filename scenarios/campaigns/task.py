"""One episode in a worker: from settings to a line of JSON, whatever happens in between."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from unifg.errors import ScenarioError, UnifgError
from unifg.scenarios.campaigns.sources import fingerprint
from unifg.scenarios.campaigns.statement import Episode, built, module_of
from unifg.scenarios.episode import silent
from unifg.scenarios.logs.metrics import strict

__all__ = ["ERROR", "FAILED", "LOST", "OK", "Task", "WrongLibrary", "line", "lost", "run_task"]

OK, FAILED, ERROR, LOST = "ok", "failed", "error", "lost"
WARM_CALLS = 3  # of its progress, until a warming run is stopped
_one_at_a_time = threading.Lock()  # workers of a cluster may have several threads; a scenario has one
_warm: set[object] = set()


class WrongLibrary(ScenarioError):
    """The sources of a worker differ from those of the campaign."""


@dataclass(frozen=True)
class Task:
    """Everything a worker needs to run an episode.

    Attributes:
        scenario: its name.
        episode: with settings as stated.
        base: folder that paths are relative to.
        code: digest of what the scenario depends on, where the campaign was started.
        sources: fingerprint of the library there.
    """

    scenario: str
    episode: Episode
    base: str
    code: str
    sources: str


def run_task(task: Task) -> str:
    """Run an episode.

    Returns:
        A line of JSON: what was asked, "outcome" (ok, failed, error), "metrics" as ``unifg run`` writes them, or
        "error" and "traceback"; when, where and in how many seconds.

    Raises:
        WrongLibrary: this machine has other sources.
    """
    if fingerprint() != task.sources:
        raise WrongLibrary(
            f"{socket.gethostname()} has other sources of unifg ({fingerprint()}) than the campaign ({task.sources}): "
            "install the same everywhere, and leave it alone while a campaign runs"
        )
    with _one_at_a_time:
        began, cpu = time.perf_counter(), time.process_time()
        found: dict[str, Any]
        try:
            module = module_of(task.scenario)
            settings = built(task.scenario, task.episode.settings, task.episode.seed, Path(task.base), task.scenario)
            _warmed(task, module, settings)
            began, cpu = time.perf_counter(), time.process_time()
            outcome = module.run(settings, silent)
            if outcome.error is not None:
                raise outcome.error
            unclear = list[str]()
            found = {"outcome": OK if outcome.succeeded else FAILED, "metrics": strict(outcome.metrics, unclear)}
            if unclear:
                found["not_finite"] = sorted(unclear)
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            said = f"{type(error).__name__}: {error}" if isinstance(error, UnifgError) else repr(error)
            trace = "".join(traceback.format_exception(error))
            found = {"outcome": ERROR, "error": said, "traceback": trace}
    took = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}
    return line(task, found, took)


def lost(task: Task, why: str) -> str:
    """The line of an episode whose workers died."""
    return line(task, {"outcome": LOST, "error": why}, {})


def line(task: Task, found: Mapping[str, Any], took: Mapping[str, float]) -> str:
    """The line of an episode."""
    row = {
        **vars(task.episode),
        "code": task.code,
        "scenario": task.scenario,
        **found,
        **{name: round(value, 4) for name, value in took.items()},
        "worker": f"{socket.gethostname()}:{os.getpid()}",
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return json.dumps(row, allow_nan=False, default=str)


def _warmed(task: Task, module: Any, settings: Any) -> None:
    """Run the first moment of an episode once per worker and kind, so that no recorded one compiles.

    Numbers do not change what code is called, words do.
    """
    words = tuple(sorted((path, v) for path, v in task.episode.settings.items() if isinstance(v, str | bool)))
    kind = (task.scenario, words)
    if kind in _warm:
        return
    _warm.add(kind)
    calls = 0

    def stop(done: float, text: str) -> None:
        nonlocal calls
        calls += 1
        if calls >= WARM_CALLS:
            raise KeyboardInterrupt

    try:
        module.run(settings, stop)
    except (Exception, SystemExit, KeyboardInterrupt):
        return  # the episode itself will say so
