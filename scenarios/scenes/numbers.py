"""Numbers of a run beside its scene, declared once for each kind of log: lines of the panel and curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.view import Scene
from unifg.view.canvas import Frame

__all__ = ["Number", "declare", "filled", "in_words", "metres", "show", "spent"]


@dataclass(frozen=True)
class Number:
    """A number of every tick.

    Attributes:
        name: of the line, and of the curve.
        text: ``text(log, tick)`` gives the line; "" leaves it out. None: there is no line.
        value: ``value(log, tick)`` gives the curve. None: there is no curve.
        alarm: ``alarm(log, tick)`` is True where the line is red.
        plot: how the curve is drawn, see :meth:`unifg.view.Scene.plot`.
    """

    name: str
    text: Callable[[Any, int], str] | None = None
    value: Callable[[Any, int], float] | None = None
    alarm: Callable[[Any, int], bool] | None = None
    plot: Mapping[str, Any] = field(default_factory=dict)


def declare(scene: Scene, numbers: Sequence[Number]) -> None:
    """Declare the curves."""
    for number in numbers:
        if number.value is not None:
            scene.plot(number.name, **number.plot)


def show(frame: Frame, log: Any, tick: int, numbers: Sequence[Number]) -> None:
    """Write the lines and the values of a tick."""
    for number in numbers:
        text = "" if number.text is None else number.text(log, tick)
        if text:
            frame.readout(number.name, text, alarm=number.alarm is not None and bool(number.alarm(log, tick)))
        if number.value is not None:
            frame.value(number.name, float(number.value(log, tick)))


def filled(log: Any, begin: Callable[[], Scene], draw: Callable[[Scene, Frame, Any, int], None]) -> Scene:
    """A scene of a log, a frame for each tick.

    Args:
        log: the run.
        begin: makes the scene with what stays.
        draw: draws a tick of the log on a frame of the scene.

    Raises:
        ViewError: there is no tick.
    """
    if log.ticks == 0:
        raise ViewError("there is no tick, and nothing to show")
    scene = begin()
    for tick in range(log.ticks):
        draw(scene, scene.frame(), log, tick)
    return scene


def in_words(state: str, cause: str) -> str:
    """State of health with its cause."""
    return state + (f": {cause}" if cause else "")


def spent(estimate: float, plan: float, compiled: object) -> str:
    """Times of estimate and plan [ms], and whether anything was compiled."""
    return f"{estimate:.1f} ms, {plan:.1f} ms" + " (compiled)" * bool(compiled)


def metres(value: float) -> str:
    """Distance; a dash for none."""
    return f"{value:.2f} m" if np.isfinite(value) else "\u2013"
