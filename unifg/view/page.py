"""Entries of the page around a scene: lines of the legend, labels, plots, and views of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

__all__ = ["Key", "Label", "Plot", "View"]


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
