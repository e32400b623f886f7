"""One episode, where it is run: settings in, a line out, whatever happens in between."""

from __future__ import annotations

import json
import math
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

import numpy as np

from unifg.errors import ScenarioError, UnifgError
from unifg.scenarios.campaigns.sources import fingerprint
from unifg.scenarios.campaigns.statement import built, module_of
from unifg.scenarios.episode import silent

__all__ = ["ERROR", "FAILED", "LOST", "OK", "Order", "WrongLibrary", "line", "lost", "perform"]

OK, FAILED, ERROR, LOST = "ok", "failed", "error", "lost"
WARM_CALLS = 3  # of its progress, until a warming run is stopped
_one_at_a_time = threading.Lock()  # workers of a cluster may have several threads; a scenario has one
_warm: set[object] = set()


class WrongLibrary(ScenarioError):
    """A worker runs other sources than the one who asks."""


@dataclass(frozen=True)
class Order:
    """An episode to be run.

    Attributes:
        scenario: its name.
        key: of the episode.
        labels: of the axes.
        settings: as stated, by path.
        seed: None where there is none.
        base: folder that paths are relative to.
        code: digest of what the scenario depends on, where it is asked for.
        sources: fingerprint of the library there.
    """

    scenario: str
    key: str
    labels: Mapping[str, str]
    settings: Mapping[str, Any]
    seed: int | None
    base: str
    code: str
    sources: str


def perform(order: Order) -> str:
    """Run an episode.

    Returns:
        A line of JSON: what was asked, "outcome" (ok, failed, error), "metrics" as ``unifg run`` writes them, or
        "error" and "traceback"; when, where and in how many seconds.

    Raises:
        WrongLibrary: this machine has other sources.
    """
    if fingerprint() != order.sources:
        raise WrongLibrary(
            f"{socket.gethostname()} has other sources of unifg ({fingerprint()}) than the campaign ({order.sources}): "
            "install the same everywhere, and leave it alone while a campaign runs"
        )
    with _one_at_a_time:
        began, cpu = time.perf_counter(), time.process_time()
        found: dict[str, Any]
        try:
            module = module_of(order.scenario)
            settings = built(order.scenario, order.settings, order.seed, Path(order.base), order.scenario)
            _warmed(order, module, settings)
            began, cpu = time.perf_counter(), time.process_time()
            outcome = module.run(settings, silent)
            unclear = list[str]()
            found = {"outcome": OK if outcome.succeeded else FAILED, "metrics": _plain(outcome.metrics, unclear)}
            if unclear:
                found["not_finite"] = sorted(unclear)
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            said = f"{type(error).__name__}: {error}" if isinstance(error, UnifgError) else repr(error)
            trace = "".join(traceback.format_exception(error))
            found = {"outcome": ERROR, "error": said, "traceback": trace}
    took = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}
    return line(order, found, took)


def lost(order: Order, why: str) -> str:
    """The line of an episode whose workers died."""
    return line(order, {"outcome": LOST, "error": why}, {})


def line(order: Order, found: Mapping[str, Any], took: Mapping[str, float]) -> str:
    """The line of an episode."""
    row = {
        "key": order.key,
        "code": order.code,
        "scenario": order.scenario,
        "labels": dict(order.labels),
        "settings": dict(order.settings),
        "seed": order.seed,
        **found,
        **{name: round(value, 4) for name, value in took.items()},
        "worker": f"{socket.gethostname()}:{os.getpid()}",
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return json.dumps(row, allow_nan=False, default=str)


def _warmed(order: Order, module: Any, settings: Any) -> None:
    """Run the first moment of an episode once per worker and kind, so that no recorded one compiles.

    Numbers do not change what code is called, words do.
    """
    words = tuple(sorted((path, v) for path, v in order.settings.items() if isinstance(v, str | bool)))
    kind = (order.scenario, words)
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


def _plain(value: Any, unclear: list[str], path: str = "") -> Any:
    """Value as JSON can hold it, None for numbers that are not finite.

    Args:
        value: numbers of Python or NumPy, words, lists and mappings of them.
        unclear: receives the paths of numbers that are not finite.
        path: of the value.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(inner, unclear, f"{path}.{name}".lstrip(".")) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner, unclear, f"{path}.{number}") for number, inner in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        unclear.append(path)
        return None
    return value if value is None or isinstance(value, str | bool | int | float) else str(value)
