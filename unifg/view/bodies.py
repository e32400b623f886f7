"""Bodies that are placed again and again, each a few meshes around its own origin, its nose along x."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from unifg.errors import ViewError
from unifg.view import drone
from unifg.view.shapes import Mesh, box, column, copies, merge, ring, sphere, tube, wedge

__all__ = ["BODIES", "Part", "beams", "body_of"]

_AXES = (("x", "moving"), ("y", "closure"), ("z", "robot"))  # red, green, blue


class Part(NamedTuple):
    """A mesh of a body; ``name`` is a path below that of the body."""

    name: str
    mesh: Mesh
    colour: str
    lit: bool = True
    opacity: float = 1.0


def arrow(size: float, colour: str) -> list[Part]:
    """An arrow head of that length."""
    return [Part("head", wedge(size, 0.05 * size), colour, lit=False)]


def beams(size: float) -> list[Part]:
    """Three beams of that length from the origin: x red, y green, z blue."""
    return [
        Part(name, tube(np.stack([np.zeros(3), end]), 0.06 * size, 4), shade, lit=False)
        for (name, shade), end in zip(_AXES, size * np.eye(3), strict=True)
    ]


def axes(size: float, colour: str) -> list[Part]:
    """Axes of that length and a block at their origin."""
    return [*beams(size), Part("origin", box(np.zeros(3), np.full(3, 0.16 * size)), colour)]


def ball(size: float, colour: str) -> list[Part]:
    """A ball of that radius, for what has no attitude."""
    return [Part("ball", copies(sphere(), np.zeros((1, 3)), size * np.eye(3)[None]), colour)]


def disc(size: float, colour: str) -> list[Part]:
    """A round robot of that radius, an arrow on top of it."""
    shape = np.diag([size, size, 1.1 * size])[None]
    return [
        Part("body", copies(column(), np.zeros((1, 3)), shape), colour),
        Part("heading", wedge(1.2 * size, 1.12 * size), "heading", lit=False),
    ]


def ellipse(size: float, colour: str) -> list[Part]:
    """A flat disc of that radius with an edge, to be stretched."""
    edge, face = ring(np.zeros(2), 0.86 * size, 0.14 * size, 0.005, 32), ring(np.zeros(2), 0.0, size, 0.0, 32)
    return [Part("disc", face, colour, False, 0.4), Part("edge", edge, colour, False)]


def car(size: float, colour: str) -> list[Part]:
    """A car of that length between its bumpers, its origin in the middle of the rear axle."""
    along, wide = 0.6 * size, 0.42 * size
    wheels = []
    for x in (0.0, along):
        for side in (-1.0, 1.0):
            wheels.append(box([x, side * 0.47 * wide, 0.09 * size], np.array([0.18, 0.06, 0.18]) * size))
    middle = 0.5 * along
    return [
        Part("body", box([middle, 0.0, 0.15 * size], [size, wide, 0.14 * size]), colour),
        Part("cabin", box([middle - 0.06 * size, 0.0, 0.27 * size], [0.5 * size, 0.86 * wide, 0.11 * size]), "heading"),
        Part("wheels", merge(wheels), "dark"),
    ]


def quadrotor(size: float, colour: str) -> list[Part]:
    """A quadrotor of that radius, rotors included; those at its front have a colour of their own."""
    parts = [
        Part("body", drone.body(size), colour),
        Part("nose", drone.nose(size), "goal"),
        Part("arms", drone.arms(size), "dark"),
    ]
    for name, front, shade in (("front", True, "scan"), ("back", False, "dark")):
        parts.append(Part(f"{name}/rotors", drone.rotors(size, front=front), shade, lit=False))
        parts.append(Part(f"{name}/swept", drone.swept(size, front=front), shade, lit=False, opacity=0.4))
    return parts


BODIES: Mapping[str, Callable[[float, str], list[Part]]] = {
    "arrow": arrow, "axes": axes, "ball": ball, "disc": disc, "ellipse": ellipse, "car": car, "quadrotor": quadrotor,
}  # fmt: skip
"""Kinds of bodies, each made from a size [m] and a colour."""


def body_of(kind: str, size: float, colour: str) -> list[Part]:
    """The parts of a body.

    Raises:
        ViewError: there is none of that kind, or the size is not positive.
    """
    if kind not in BODIES:
        raise ViewError(f"there is no body {kind!r}: take one of {', '.join(BODIES)}")
    if not (np.isfinite(size) and size > 0.0):
        raise ViewError(f"a body of size {size!r}: it must be positive [m]")
    return BODIES[kind](size, colour)
