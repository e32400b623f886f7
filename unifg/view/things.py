"""Things of a scene, kept as numbers and drawn when it is shown: ways, poses, points, ellipses, discs, boxes, maps.

Every thing is drawn by a function of this file that is given a stage, a path on it, and how many of its members may be
drawn at most. Things in the plane lie in layers, one a little above the other, so that none hides another by chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2, SE3
from unifg.plots.shown import every
from unifg.typing import Array
from unifg.view import bodies, shapes
from unifg.view.page import Key
from unifg.view.shapes import Mesh

__all__ = [
    "MOST",
    "Layer",
    "Thing",
    "draw_arrows",
    "draw_boxes",
    "draw_discs",
    "draw_ellipses",
    "draw_ellipsoids",
    "draw_mesh",
    "draw_points",
    "draw_segments",
    "draw_triads",
    "draw_walls",
    "draw_way",
]

MOST = 20_000  # members of a thing that are drawn, for surfaces that do not ask for fewer

_CORNERS = 28  # of an ellipse


class Surface(Protocol):
    """Destination of drawings: a stage for a browser, or axes of matplotlib; ``stroke`` is half a line's width [m]."""

    @property
    def stroke(self) -> float:
        """Half the width of a line that is to be seen well [m]."""

    def mesh(self, path: str, mesh: Mesh, colour: str, *, lit: bool = False, opacity: float = 1.0) -> None:
        """Draw a mesh."""

    def points(self, path: str, points: Array, colour: str, pixels: float) -> None:
        """Draw dots (n, 3) [m] of a size on the screen."""

    def lines(self, path: str, lines: Array, colour: str) -> None:
        """Draw thin straight lines (n, 2, 3) [m]."""


@dataclass
class Layer:
    """Everything of one name.

    Attributes:
        path: of its objects.
        level: rank from the ground up.
        key: its line of the legend, None for none.
        colour: of everything drawn.
        width: of lines where they are not given one [m].
    """

    path: str
    level: int
    key: Key | None
    colour: str
    width: float | None = None


@dataclass(frozen=True, eq=False)
class Thing:
    """Something to be drawn, or a part of it.

    Attributes:
        draw: called with the stage, the path, the most members to draw, the layer, and ``given``.
        given: its numbers.
        corners: (n, 3) places that a view of it must hold [m].
        members: how many points, poses, ... it has.
        budget: how many of them a whole scene may hold, over all its frames.
        slack: absolute change of its numbers that is not worth drawing anew.
    """

    draw: Callable[..., None]
    given: dict[str, Any]
    corners: Array
    members: int = 1
    budget: int = 10**9
    slack: float = 0.0

    def put(self, stage: Surface, path: str, most: int, layer: Layer) -> None:
        """Draw at most so many of its members."""
        if self.members:
            self.draw(stage, path, most, layer, **self.given)

    def same(self, other: Thing | None) -> bool:
        """Test whether another one looks the same."""
        if other is None or self.draw is not other.draw or self.given.keys() != other.given.keys():
            return False
        return all(self._alike(value, other.given[name]) for name, value in self.given.items())

    def _alike(self, one: Any, other: Any) -> bool:
        if one is other:
            return True
        if isinstance(one, tuple):
            return all(self._alike(*pair) for pair in zip(one, other, strict=True))
        if not isinstance(one, np.ndarray):
            return bool(one == other)
        return one.shape == other.shape and bool((np.abs(one - other) <= self.slack).all())


def lift(stage: Surface, layer: Layer) -> float:
    """Height of a layer [m]."""
    return 0.25 * stage.stroke * layer.level


def raised(places: Array, height: float) -> Array:
    """The same places (..., 3), higher [m]."""
    higher: Array = places + np.array([0.0, 0.0, height])
    return higher


def draw_way(
    stage: Surface, path: str, most: int, layer: Layer, *, points: Array, flat: bool, width: float | None
) -> None:
    """A line through points (n, 3) [m]."""
    kept = shapes.thin(points, most)
    if len(kept) < 2:
        return
    if flat:
        mesh = shapes.ribbon(kept, 2.0 * stage.stroke if width is None else width, lift(stage, layer))
    else:
        mesh = shapes.tube(kept, 0.8 * stage.stroke if width is None else 0.5 * width)
    stage.mesh(path, mesh, layer.colour)


def draw_points(
    stage: Surface, path: str, most: int, layer: Layer, *, points: Array, flat: bool, pixels: float
) -> None:
    """Dots at (n, 3) [m]."""
    kept = points[every(len(points), most)]
    stage.points(path, raised(kept, lift(stage, layer) if flat else 0.0), layer.colour, pixels)


def draw_segments(
    stage: Surface, path: str, most: int, layer: Layer, *, lines: Array, flat: bool, width: float | None
) -> None:
    """Straight lines (n, 2, 3) [m]; hair-thin ones where the width is None."""
    kept = raised(lines[every(len(lines), most)], lift(stage, layer) if flat else 0.0)
    if width is None:
        stage.lines(path, kept, layer.colour)
    else:
        stage.mesh(path, shapes.strips(kept, width, not flat), layer.colour)


def draw_arrows(stage: Surface, path: str, most: int, layer: Layer, *, poses: Array, length: float | None) -> None:
    """Arrow heads at poses in the plane (n, 3), pointing along their x."""
    kept = poses[every(len(poses), most)]
    size = 8.0 * stage.stroke if length is None else length
    turns = SE2.matrix(kept * (0.0, 0.0, 1.0))
    places = np.column_stack([kept[:, :2], np.full(len(kept), lift(stage, layer))])
    stage.mesh(path, shapes.copies(shapes.wedge(size, 0.0), places, turns), layer.colour)


def draw_triads(stage: Surface, path: str, most: int, layer: Layer, *, poses: Array, length: float | None) -> None:
    """Axes of poses in space (n, 7): x red, y green, z blue."""
    matrices = SE3.matrix(poses[every(len(poses), most)])
    for beam in bodies.beams(10.0 * stage.stroke if length is None else length):
        mesh = shapes.copies(beam.mesh, matrices[:, :3, 3], matrices[:, :3, :3])
        stage.mesh(f"{path}/{beam.name}", mesh, beam.colour)


def draw_ellipses(stage: Surface, path: str, most: int, layer: Layer, *, centres: Array, axes: Array) -> None:
    """Outlines around (n, 3) [m]: the unit circle under axes (n, 2, 2) [m]."""
    chosen = every(len(centres), most)
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    outer = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes[chosen].transpose(0, 2, 1)
    reach = np.linalg.norm(outer, axis=2, keepdims=True)
    inner = outer * np.maximum(1.0 - stage.stroke / np.maximum(reach, 1e-300), 0.0)
    places = raised(centres[chosen], lift(stage, layer))[:, None]
    rows = [np.concatenate([row, np.zeros((*row.shape[:2], 1))], axis=2) + places for row in (outer, inner)]
    rim = np.stack([rows[0][:, :-1], rows[0][:, 1:], rows[1][:, 1:], rows[1][:, :-1]], axis=2)
    stage.mesh(f"{path}/edge", shapes.quads(rim.reshape(-1, 4, 3)), layer.colour)
    turns = np.zeros((len(chosen), 3, 3))
    turns[:, :2, :2] = axes[chosen]
    disc = shapes.ring(np.zeros(2), 0.0, 1.0, 0.0, corners=_CORNERS)
    stage.mesh(f"{path}/disc", shapes.copies(disc, places[:, 0], turns), layer.colour, opacity=0.13)


def draw_ellipsoids(stage: Surface, path: str, most: int, layer: Layer, *, centres: Array, axes: Array) -> None:
    """Surfaces around (n, 3) [m]: the unit sphere under axes (n, 3, 3) [m]."""
    number = every(len(centres), most)
    mesh = shapes.copies(shapes.sphere(), centres[number], axes[number])
    stage.mesh(path, mesh, layer.colour, lit=True, opacity=0.3)


def draw_discs(
    stage: Surface, path: str, most: int, layer: Layer, *, rows: Array, height: float, base: float, opacity: float
) -> None:
    """Discs (n, 3) x, y, radius [m], upright cylinders where there is a height [m]."""
    kept = rows[every(len(rows), most)]
    turns = np.zeros((len(kept), 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = kept[:, 2]
    turns[:, 2, 2] = max(height, 0.0) or 1.0
    shape = shapes.column() if height > 0.0 else shapes.ring(np.zeros(2), 0.0, 1.0, 0.0, corners=32)
    z = base if height > 0.0 else base + lift(stage, layer)
    mesh = shapes.copies(shape, np.column_stack([kept[:, :2], np.full(len(kept), z)]), turns)
    stage.mesh(path, mesh, layer.colour, lit=height > 0.0, opacity=opacity)


def draw_boxes(
    stage: Surface, path: str, most: int, layer: Layer, *, poses: Array, sizes: Array, opacity: float
) -> None:
    """Boxes of sizes (n, 3) [m] around poses in space (n, 7)."""
    number = every(len(poses), most)
    matrices = SE3.matrix(poses[number])
    turns = matrices[:, :3, :3] * sizes[number][:, None, :]
    mesh = shapes.copies(shapes.box(np.zeros(3), np.ones(3)), matrices[:, :3, 3], turns)
    stage.mesh(path, mesh, layer.colour, lit=True, opacity=opacity)


def draw_walls(stage: Surface, path: str, most: int, layer: Layer, *, occupancy: OccupancyMap, height: float) -> None:
    """The free cells of a map as floor, the occupied ones as walls of a height [m]."""
    if occupancy.free.any():
        stage.mesh(f"{path}/floor", shapes.flat(occupancy, occupancy.free, -0.01 * height), "floor")
    if occupancy.occupied.any():
        stage.mesh(f"{path}/walls", shapes.extrude(occupancy, height), "wall", lit=True)


def draw_mesh(stage: Surface, path: str, most: int, layer: Layer, *, mesh: Mesh, lit: bool, opacity: float) -> None:
    """A mesh as it is."""
    stage.mesh(path, mesh, layer.colour, lit=lit, opacity=opacity)
