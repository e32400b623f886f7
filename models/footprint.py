"""Bodies of robots in the plane: a disc, a union of discs, or a convex polygon, with its rows of clearance.

Plans hold discs clear: those of a union, or those that cover a polygon's edges and stick out of it by `EXCESS` (as
Ziegler and Stiller, "Fast collision checking for intelligent vehicle motion planning", 2010, do for cars). Contacts,
the beams of an emergency stop and pictures go by the hull.
"""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from unifg.errors import ModelError, require_positive
from unifg.lie import SE2
from unifg.modeling.duplicates import doubles
from unifg.typing import Array, ArrayLike

EXCESS = 0.03  # [m] by which covering discs may stick out of a polygon
FARTHEST = 30.0  # corner of a polygon [m]
FINE = 61  # places to a side among which discs are chosen
INSIDE = 1e-9  # [m]; on the hull is inside
_STRAIGHT = 1e-9  # [rad] by which a straight side may turn in a corner


@dataclass(frozen=True)
class Body:
    """A body in the axes of its robot: x ahead, y to the left.

    Attributes:
        discs: x, y and radius of the discs whose union it is, or that cover it [m].
        outline: corners of a convex polygon, counterclockwise [m]; empty for a union of discs.
    """

    discs: tuple[tuple[float, float, float], ...]
    outline: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse what is no body.

        Raises:
            ModelError: no disc, a number that is not finite, a radius that is not positive.
        """
        table = doubles("the discs of a body", self.discs, error=ModelError)
        if table.ndim != 2 or table.shape[1:] != (3,) or not np.isfinite(table).all() or not (table[:, 2] > 0.0).all():
            raise ModelError(f"a body is made of discs x, y, radius > 0 [m], got {self.discs}")

    @staticmethod
    def disc(radius: float) -> Body:
        """A disc about the robot's axis."""
        return Body(((0.0, 0.0, radius),))

    @staticmethod
    def polygon(corners: ArrayLike) -> Body:
        """A convex polygon of corners (P, 2) [m], without those that are repeated or lie on a straight side.

        Raises:
            ModelError: fewer than three corners, one that is farther than `FARTHEST` ahead, behind or aside, or a
                polygon that is not convex.
        """
        points = doubles("the corners of a polygon", corners, error=ModelError)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not (np.abs(points) <= FARTHEST).all():
            raise ModelError(
                f"a polygon has at least three corners x, y [m], none farther than {FARTHEST:g} m: found "
                f"{reprlib.repr(points.tolist())}"
            )
        points = points[(points != np.roll(points, -1, axis=0)).any(axis=1)]
        turns, ahead = _turns(points)
        points = points[(np.abs(turns) > _STRAIGHT * np.abs(ahead)) | (ahead <= 0.0)]
        turns, _ = _turns(points)
        if turns.sum() < 0.0:
            points, turns = points[::-1], -turns
        angles = np.unwrap(np.arctan2(*(np.roll(points, -1, axis=0) - points).T[::-1]))
        if len(points) < 3 or not (turns > 0.0).all() or abs(angles[-1] - angles[0]) >= 2.0 * math.pi:
            raise ModelError("the polygon of a body must be convex; give a union of discs for another")
        return Body(tuple(map(tuple, _cover(points).tolist())), tuple(map(tuple, points.tolist())))

    @property
    def round(self) -> bool:
        """True for a disc about the robot's axis: its heading does not matter."""
        return not self.outline and len(self.discs) == 1 and self.discs[0][:2] == (0.0, 0.0)

    @property
    def radius(self) -> float:
        """Radius of the largest disc [m], from which clearances of all discs are measured."""
        return max(radius for _, _, radius in self.discs)

    @cached_property
    def bound(self) -> float:
        """Greatest distance of the hull from the robot's axis [m]."""
        if self.outline:
            return max(math.hypot(*corner) for corner in self.outline)
        return max(math.hypot(x, y) + radius for x, y, radius in self.discs)

    @cached_property
    def smaller(self) -> Array:
        """(K,) by how much each disc is smaller than the largest [m]."""
        return self.radius - np.array(self.discs)[:, 2]

    def places(self, poses: Array) -> Array:
        """(..., K, 2) centres of the discs of bodies at poses (..., 3) [m]."""
        if self.round:
            return poses[..., None, :2]
        return SE2.act(poses[..., None, :], np.array(self.discs)[:, :2])

    def gap(self, points: Array) -> Array:
        """Signed distance (...) of points (..., 2) in the body's axes from its hull [m]."""
        if self.outline:
            return _to_polygon(np.array(self.outline), points)
        table = np.array(self.discs)
        offset = points[..., None, :] - table[:, :2]
        found: Array = (np.hypot(offset[..., 0], offset[..., 1]) - table[:, 2]).min(axis=-1)
        return found

    def rim(self, angles: Array) -> Array:
        """(n,) distance of the hull from the robot's axis in directions (n,) [m], at the last of several crossings."""
        if self.round:
            return np.full(len(angles), self.radius)
        along = np.linspace(0.0, self.bound, 64)
        rays = along[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None]
        within = self.gap(rays) <= INSIDE
        found: Array = (within * along).max(axis=1)
        return found

    def boundary(self, spacing: float) -> Array:
        """(n, 2) points of the hull no farther apart than ``spacing`` along it [m], in the body's axes."""
        if self.outline:
            return _along(np.array(self.outline), spacing)
        rings = [
            np.array([x, y]) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            for x, y, radius in self.discs
            for turn in [np.linspace(0.0, 2.0 * np.pi, math.ceil(2.0 * np.pi * radius / spacing), endpoint=False)]
        ]
        points = np.concatenate(rings)
        return points[self.gap(points) >= -INSIDE]


def _turns(points: Array) -> tuple[Array, Array]:
    """Vector and scalar products (P,) [m^2] of the edges that meet in each corner of a polygon (P, 2)."""
    into, out = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    return into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], (into * out).sum(axis=1)


def _to_polygon(corners: Array, points: Array) -> Array:
    """Signed distance (...) of points (..., 2) from a convex polygon (P, 2)."""
    edges = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(*edges.T)
    offset = points[..., None, :] - corners
    share = np.clip((offset * edges).sum(axis=-1) / length**2, 0.0, 1.0)
    away = offset - share[..., None] * edges
    outside = (edges[:, 1] * offset[..., 0] - edges[:, 0] * offset[..., 1]) / length  # of every edge's line
    distance = np.hypot(away[..., 0], away[..., 1]).min(axis=-1)
    found: Array = np.where((outside <= 0.0).all(axis=-1), -distance, distance)
    return found


def _cover(corners: Array) -> Array:
    """Discs (K, 3) that cover the edges of a convex polygon and stick out of it by `EXCESS`: the widest ones first.

    Of all places in the polygon that one is taken whose disc covers most of what is left of the edges.
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes = [np.linspace(a, b, FINE) for a, b in zip(low, high, strict=True)]
    # Pieces of the edges: one is covered by a disc that both of its ends are in, and by that about its own middle.
    rim = _along(corners, min(float(np.ptp(corners, axis=0).max()) / FINE, 1.5 * EXCESS))
    places = np.concatenate(
        [np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2), 0.5 * (rim + np.roll(rim, -1, axis=0))]
    )
    depth = -_to_polygon(corners, places)
    places, radii = places[depth >= -INSIDE], depth[depth >= -INSIDE] + EXCESS
    within = np.hypot(*np.moveaxis(places[:, None] - rim, 2, 0)) <= radii[:, None]
    covers = (within & np.roll(within, -1, axis=1)).astype(np.float32)
    left, discs = np.ones(len(rim), dtype=np.float32), []
    while left.any():
        chosen = int(np.argmax(covers @ left + 1e-3 * radii))
        discs.append([*places[chosen], radii[chosen]])
        left[covers[chosen] > 0.0] = 0.0
    return np.array(discs)


def _along(corners: Array, spacing: float) -> Array:
    """(n, 2) points on the edges of a polygon (P, 2), no farther apart than ``spacing`` [m]."""
    ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    pieces = [(a, b - a, math.ceil(math.dist(a, b) / spacing)) for a, b in ends]
    return np.concatenate([a + np.arange(count)[:, None] / count * way for a, way, count in pieces])


@cache
def body_of(text: str) -> Body:
    """A body as an option gives it: "disc:R", "LENGTHxWIDTH", "polygon:X,Y;X,Y;..." or "discs:X,Y,R;X,Y,R" [m].

    Raises:
        ModelError: for anything else.
    """
    kind, colon, numbers = text.partition(":")
    try:
        if not colon:
            length, width = (0.5 * float(word) for word in kind.split("x"))
            require_positive("a rectangle", ModelError, length=length, width=width)
            return Body.polygon([(length, -width), (length, width), (-length, width), (-length, -width)])
        rows = [[float(word) for word in row.split(",")] for row in numbers.split(";")]
        if kind == "disc":
            return Body.disc(float(numbers))
        if kind == "polygon":
            return Body.polygon(rows)
        if kind == "discs":
            return Body(tuple((x, y, radius) for x, y, radius in rows))
    except (TypeError, ValueError) as error:
        raise ModelError(f"{text!r} is no body: {error}") from error
    raise ModelError(f"{text!r} is no body: give disc:R, LENGTHxWIDTH, polygon:X,Y;X,Y;... or discs:X,Y,R;X,Y,R [m]")
