"""Page around a scene: title, facts, legend, labels, numbers of the moment, plots, and views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from unifg.typing import Array

__all__ = ["Key", "Label", "Page", "Plot", "Readout", "View"]


@dataclass
class Key:
    """One line of the legend: a swatch (disc, ghost, ring, line, thin, dots, block, flag) in a colour of the palette.

    Objects named as parts can be switched off there.
    """

    colour: str
    shape: str
    text: str
    parts: list[str] = field(default_factory=list)


@dataclass
class Label:
    """A word at a place (x, y, z) [m] or with a moving object; a minor one yields to those before it."""

    text: str
    at: list[float] | None = None
    follows: str | None = None
    above: bool = False
    minor: bool = False


@dataclass
class Readout:
    """A number that changes: one text per frame, those of alarms in red."""

    name: str
    texts: list[str]
    alarms: list[bool] = field(default_factory=list)


@dataclass
class Plot:
    """A number over the frames, in the strip below the picture.

    Attributes:
        name: of it.
        values: one per frame; None leaves a gap.
        unit: of it.
        log: whether on a logarithmic axis.
        limit: a dashed line.
        colour: of the curve.
    """

    name: str
    values: list[float | None] = field(default_factory=list)
    unit: str = ""
    log: bool = False
    limit: float | None = None
    colour: str = "robot"


@dataclass
class View:
    """Camera with a button: it looks from ``direction`` at everything, or at something that moves.

    Attributes:
        name: in the address of a picture, ``#t=12.5&view=NAME``.
        text: of the button.
        direction: from what is looked at to the camera, in the world.
        fov: vertical angle of view [deg].
        follows: the object to go along with; None to see everything.
        distance: from that object [m].
        ahead: of that object, the place in the middle of the picture [m].
    """

    name: str
    text: str
    direction: Sequence[float]
    fov: float
    follows: str | None = None
    distance: float = 0.0
    ahead: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass
class Page:
    """The words and numbers around the picture, and what the camera must see.

    Attributes:
        title: what this is.
        outcome: how it ended.
        good: whether that is what was asked for.
        facts: names and values; empty values are left out.
        corners: (n, 3) [m] that a view of everything must hold.
        legend: what is drawn, from top to bottom.
        labels: words in the picture.
        readouts: numbers of the moment.
        views: of the camera, the first one at the start.
        speeds: to choose from; none leaves out the choice.
        counts: what the slider counts; "time" in seconds, anything else by ``numbers``.
        numbers: what is counted, one per frame.
        plots: numbers over the frames.
    """

    title: str
    outcome: str
    good: bool
    facts: dict[str, str]
    corners: Array
    legend: list[Key]
    labels: list[Label]
    readouts: list[Readout]
    views: list[View]
    speeds: tuple[float, ...] = ()
    counts: str = "time"
    numbers: list[int] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
