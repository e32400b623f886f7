"""``unifg run SCENARIO --live``: a run in a browser while it goes on, tick by tick or iterate by iterate."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

from unifg.scenarios.episode import Progress
from unifg.scenarios.logs.columns import SoFar, watched
from unifg.scenarios.scenes.numbers import Number, declare, show
from unifg.solution.history import Iteration
from unifg.view import Live, Scene
from unifg.view.canvas import Frame

__all__ = ["Announce", "watching_iterates", "watching_ticks"]

REMAINDER = 0.9  # that an iteration leaves
Announce: TypeAlias = Callable[[str], None]
"""Receives the address of the scene; None without a viewer."""


NUMBERS = (
    Number("iteration", lambda row, k: str(k)),
    Number("cost", lambda row, k: f"{row.cost:.6g}", lambda row, k: row.cost),
    Number("stationarity", None, lambda row, k: row.stationarity, plot={"log": True}),
    Number(
        "violation", lambda row, k: f"{row.violation:.1e}", lambda row, k: row.violation,
        plot={"log": True, "colour": "moving"},
    ),
)  # fmt: skip
"""Lines and curves of iterates."""


@contextmanager
def watching_ticks(
    announce: Announce | None, begin: Callable[[Any], Scene], draw: Callable[[Scene, Frame, Any, int], None]
) -> Iterator[None]:
    """Show every tick that is recorded meanwhile.

    Args:
        announce: see `Announce`.
        begin: makes the scene of a record in the making; called for each record.
        draw: what a tick of it shows.
    """
    if announce is None:
        yield
        return
    scene: Scene | None = None
    live: Live | None = None
    shown: SoFar | None = None

    def watch(log: SoFar) -> None:
        nonlocal scene, live, shown
        if scene is None or not log.follows(shown):
            if live is not None:
                live.close()
            scene = begin(log)
            live = scene.live()
            announce(live.url)
        shown = log
        with scene.frame() as frame:
            draw(scene, frame, log, log.ticks - 1)

    try:
        with watched(watch):
            yield
    finally:
        if live is not None:
            live.close()


@contextmanager
def watching_iterates(
    announce: Announce | None, scene: Scene, draw: Callable[[Frame, Iteration], None], progress: Progress
) -> Iterator[Callable[[Iteration], None]]:
    """Callback of a solver that tells of every iterate and shows it, where there is a viewer.

    Args:
        announce: see `Announce`.
        scene: with what stays.
        draw: what an iterate shows, besides its numbers.
        progress: told of every iterate; as their number is unknown, each leaves the same share of the remainder.
    """

    def tell(row: Iteration) -> None:
        text = f"iteration {row.number}, cost {row.cost:.6g}, violation {row.violation:.1e}"
        progress(1.0 - REMAINDER**row.number, text)

    if announce is None:
        yield tell
        return
    declare(scene, NUMBERS)

    def watch(row: Iteration) -> None:
        tell(row)
        with scene.frame() as frame:
            draw(frame, row)
            show(frame, row, row.number, NUMBERS)

    with scene.live() as live:
        announce(live.url)
        yield watch
