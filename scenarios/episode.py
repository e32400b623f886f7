"""What every episode does alike: tick until it is over, tell how far it has come, and stop when the user asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

__all__ = ["Progress", "run_ticks", "silent"]

Progress: TypeAlias = Callable[[float, str], None]
"""Called with the fraction done and a short text, once a tick; may raise KeyboardInterrupt."""


def silent(done: float, text: str) -> None:
    """Tell nobody."""


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
    progress(1.0, "done")
    return interrupted
