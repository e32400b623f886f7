"""Parts of scenes that several kinds of flights share: the floor, the vehicle, upright cylinders."""

from __future__ import annotations

import math

import numpy as np

from unifg.lie import SE2
from unifg.models.footprint import Body
from unifg.scenarios.simulation.layouts import Layout
from unifg.typing import Array
from unifg.view import Scene, shapes
from unifg.view.bodies import Part
from unifg.view.canvas import Frame

__all__ = ["CLEAR", "draw_way", "floor", "layout", "lidar_hits", "pillar", "standing", "vehicle"]

CLEAR = 0.6
"""Opacity of obstacles: ways and vehicles behind them are seen."""

_NODES = 16  # of a way that changes from frame to frame
_FLOOR = -0.02  # height of the floor, clear of what stands on it [m]


def floor(scene: Scene, low: Array, high: Array) -> None:
    """Floor between two corners (2,), with lines every metre to judge distances by."""
    (left, near), (right, far) = low.tolist(), high.tolist()
    corners = np.array([[[left, near, _FLOOR], [right, near, _FLOOR], [right, far, _FLOOR], [left, far, _FLOOR]]])
    scene.mesh("floor", shapes.quads(corners), colour="floor", legend="")
    across = [[[x, near], [x, far]] for x in np.arange(math.ceil(left), right + 1e-9)]
    along = [[[left, y], [right, y]] for y in np.arange(math.ceil(near), far + 1e-9)]
    lines = [shapes.ribbon(np.array(line), 0.02, 0.0) for line in across + along]
    scene.mesh("metres", shapes.merge(lines), colour="metres", legend="")


def layout(scene: Scene, placed: Layout, height: float) -> None:
    """Floor, walls of a height [m], start and target of a layout."""
    floor(scene, *placed.size)
    sheets, frames = [], []
    for wall in placed.walls:
        foot, top = (np.column_stack([wall, np.full(2, z)]) for z in (0.0, height))
        sheets.append(shapes.quads(np.concatenate([foot, top[::-1]])[None]))
        frames += [shapes.tube(line, 0.03, 4) for line in (foot, top)]
        frames += [shapes.tube(np.stack([foot[k], top[k]]), 0.03, 4) for k in range(2)]
    if sheets:
        scene.mesh("walls", shapes.merge(sheets), colour="wall", opacity=0.22, legend="walls")
        scene.mesh("wall frames", shapes.merge(frames), colour="wall", lit=True, legend="")
    start, target = placed.start, placed.target
    scene.mesh("start", shapes.ring(start[:2], 0.18, 0.07, 0.012, corners=32), colour="start", legend="")
    rings = [shapes.ring(target[:2], r, 0.07, 0.012, corners=40) for r in (0.12, 0.4)]
    ball = shapes.copies(shapes.sphere(12, 24), target[None], 0.16 * np.eye(3)[None])
    scene.mesh("target", shapes.merge([*rings, ball]), colour="goal", swatch="disc", legend="target")
    scene.label("start", start[:2])
    scene.label("target", target)
    scene.discs("pole", [[target[0], target[1], 0.025]], height=float(target[2]), colour="pole", legend="")


def vehicle(scene: Scene, radius: float, plumb: bool = False) -> None:
    """Quadrotor of that radius [m] and its shadow, perhaps with a plumb line."""
    scene.body("drone", "quadrotor", size=radius, colour="robot", legend="")
    parts = [Part("disc", shapes.ring(np.zeros(2), 0.0, radius, 0.016, corners=24), "start", False, 0.4)]
    if plumb:
        line = shapes.tube(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 0.012)
        parts.append(Part("plumb", line, "start", False, 0.5))
    scene.body("shadow", parts, colour="start", legend="")
    scene.label("drone", follows="drone", above=True)


def draw_way(frame: Frame, name: str, way: Array) -> Array:
    """Draw a way (n, 2 or 3) [m] that changes from frame to frame, if it is finite and leads anywhere; its nodes."""
    if len(way) < 2 or not np.isfinite(way).all():
        return way[:0]
    points = shapes.thin(way, _NODES)
    if len(points) < 2:
        return way[:0]
    frame.way(name, points)
    return points


def lidar_hits(pose: Array, ranges: Array, angles: Array, height: float) -> Array:
    """Points (n, 3) [m] at some height where beams seen from a pose end; dropouts and misses are left out."""
    seen = np.isfinite(ranges)
    ends = ranges[seen, None] * np.column_stack([np.cos(angles[seen]), np.sin(angles[seen])])
    return np.column_stack([SE2.act(pose, ends), np.full(len(ends), height)])


def pillar(radius: float, height: float, colour: str) -> Part:
    """Upright cylinder [m] that hides nothing."""
    return standing(Body.disc(radius), height, colour)._replace(opacity=CLEAR)


def standing(body: Body, height: float, colour: str, wider: float = 0.0) -> Part:
    """Upright body [m], wider than it is."""
    if body.outline:
        corners = np.array(body.outline)
        rim = corners * (1.0 + wider / np.hypot(*corners.T)[:, None])
        low, high = (np.column_stack([rim, np.full(len(rim), z)]) for z in (0.0, height))
        sides = shapes.quads(np.stack([low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high], axis=1))
        fan = np.array([[0, k, k + 1] for k in range(1, len(rim) - 1)], dtype=np.intp)
        return Part("body", shapes.merge([sides, (high, fan)]), colour)
    discs = np.array(body.discs)
    places = np.column_stack([discs[:, :2], np.zeros(len(discs))])
    turns = np.stack([np.diag([radius + wider, radius + wider, height]) for radius in discs[:, 2]])
    return Part("body", shapes.copies(shapes.column(), places, turns), colour)
