"""Shared loop of all episodes: warm-up run, ticks, progress, interruption by the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

from unifg.scenarios.logs.columns import watched

__all__ = ["Progress", "rehearse", "run_ticks", "silent"]

Progress: TypeAlias = Callable[[float, str], None]
"""Called with the fraction done and a short text, once a tick; may raise KeyboardInterrupt."""


def silent(done: float, text: str) -> None:
    """Ignore the progress."""


def run_ticks(limit: int, tick: Callable[[int], tuple[float, str] | None], progress: Progress) -> bool:
    """Tick until it is over; an interrupt from the keyboard ends it early and keeps what was recorded.

    Args:
        limit: greatest number of ticks.
        tick: called with the number of the tick; what to tell of it, or None when it was the last one.
        progress: what is told.

    Returns:
        Whether the user stopped it.
    """
    interrupted = False
    try:
        for number in range(limit):
            told = tick(number)
            if told is None:
                break
            progress(min(max(0.0, told[0]), 0.99), told[1])
    except KeyboardInterrupt:
        interrupted = True
    try:
        progress(1.0, "done")
    except KeyboardInterrupt:  # in the last tick, for a sequence of runs
        interrupted = True
    return interrupted


GOOD_TICKS, BAD_TICKS = 3, 4
_rehearsed: set[object] = set()


def rehearse(kind: object, twin: Callable[[], Any]) -> None:
    """Run a few ticks of a twin, once per process and kind of run, so that the ticks of the run itself compile nothing.

    What a pilot calls besides its solvers, and where it turns when they fail, is compiled or read from the disk then.

    Args:
        kind: of the run: what decides which code it calls.
        twin: makes another run like it, with a ``run(progress)`` and a ``pilot``; it is thrown away.
    """
    if kind in _rehearsed:
        return
    _rehearsed.add(kind)
    other, ticks = twin(), 0
    controller = other.pilot.controller

    def after(done: float, text: str) -> None:
        nonlocal ticks
        ticks += 1
        if ticks == GOOD_TICKS:  # from now on no plan is good enough
            controller.settings = replace(controller.settings, feasible=-1.0)
        if ticks == GOOD_TICKS + BAD_TICKS:
            raise KeyboardInterrupt

    with watched(None):  # not shown
        other.run(after)
