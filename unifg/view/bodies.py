"""Bodies that are placed again and again, each a few meshes around its own origin, its nose along x."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from unifg.errors import ViewError, require_positive
from unifg.view.shapes import Mesh, box, column, copies, merge, ring, sphere, tube, wedge

__all__ = ["BODIES", "Part", "beams", "body_of"]

_ROTOR = 0.36  # radius of the rotors of a quadrotor over its own
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
    return [Part("ball", copies(sphere(12, 24), np.zeros((1, 3)), size * np.eye(3)[None]), colour)]


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
    places = [[x, side * 0.47 * wide, 0.09 * size] for x in (0.0, along) for side in (-1.0, 1.0)]
    wheels = [box(place, np.array([0.18, 0.06, 0.18]) * size) for place in places]
    middle = 0.5 * along
    return [
        Part("body", box([middle, 0.0, 0.15 * size], [size, wide, 0.14 * size]), colour),
        Part("cabin", box([middle - 0.06 * size, 0.0, 0.27 * size], [0.5 * size, 0.86 * wide, 0.11 * size]), "heading"),
        Part("wheels", merge(wheels), "dark"),
    ]


def quadrotor(size: float, colour: str) -> list[Part]:
    """A quadrotor of that radius, rotors included, its nose along x; the rotors at its front have their own colour."""
    rotor, level = _ROTOR * size, 0.17 * size
    angles = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    hubs = (1.0 - _ROTOR) * size * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(4)])
    beams = [tube(hubs[[k, k + 2]], 0.055 * size, sides=4) for k in range(2)]
    posts = [box(hub + np.array([0.0, 0.0, 0.06 * size]), np.array([0.1, 0.1, 0.2]) * size) for hub in hubs]
    parts = [
        Part("body", box(np.zeros(3), np.array([0.52, 0.34, 0.22]) * size), colour),
        Part("nose", box(np.array([0.34, 0.0, 0.02]) * size, np.array([0.2, 0.26, 0.16]) * size), "goal"),
        Part("arms", merge(beams + posts), "dark"),
    ]
    for name, pair, shade in (("front", hubs[[0, 3], :2], "scan"), ("back", hubs[[1, 2], :2], "dark")):
        meshes = []
        for hub in pair:
            across = 0.9 * rotor * np.array([-hub[1], hub[0]]) / np.linalg.norm(hub)
            blade = np.column_stack([np.stack([hub - across, hub + across]), np.full(2, level)])
            meshes += [ring(hub, 0.84 * rotor, 0.16 * rotor, level, corners=24), tube(blade, 0.05 * size, sides=4)]
        swept = merge([ring(hub, 0.0, rotor, 0.99 * level, corners=24) for hub in pair])
        parts.append(Part(f"{name}/rotors", merge(meshes), shade, lit=False))
        parts.append(Part(f"{name}/swept", swept, shade, lit=False, opacity=0.4))
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
    require_positive("a body", ViewError, size=size)
    return BODIES[kind](size, colour)
