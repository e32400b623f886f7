"""A path around obstacles by a B-spline whose control points are pushed out of them, without a distance field.

After the idea of Zhou et al., *EGO-Planner*, IEEE RA-L 2021: a control point inside an obstacle, or on a stretch that
is, is given an anchor p on the surface and a direction v out of it; its distance is taken for (Q - p) . v, so that no
field of distances is needed, and a distance below a margin costs,

    J = smooth sum |jerk|^2 + near sum c(margin - d) + along sum |Q - Q_path|^2

with c(x) = x^3 up to the margin and a parabola of the same slope beyond. Anchors are added and the spline is optimised
again until nothing of it is inside. Nothing in it holds the margin: it is a weight among others, on control points,
which the spline does not pass through.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import minimize

from unifg.scenarios.options import Positive, Settings
from unifg.scenarios.planning.flat_path import Flown, Line
from unifg.scenarios.quadrotor.cbf_mpc import Obstacles
from unifg.typing import Array

__all__ = ["SplinePath", "SplineSettings", "around"]

DEGREE = 3


@dataclass(frozen=True)
class SplineSettings(Settings):
    """Numbers of the planner.

    Attributes:
        margin: beyond the distance to be kept, below which nearness costs [m].
        knot: time between two control points [s].
        smooth: weight of the third differences of control points.
        near: weight of nearness.
        along: weight of the distance from the path.
        rounds: most rounds of anchoring and optimising.
    """

    margin: float = 0.3
    knot: Positive[float] = 0.2
    smooth: float = 1.0
    near: float = 50.0
    along: float = 0.02
    rounds: int = 8


class SplinePath:
    """A cubic B-spline in time that rests after its end."""

    def __init__(self, points: Array, knot: float) -> None:
        """Begin at time zero; ``points`` (n, 3) are ``knot`` seconds apart, from one knot before to one after [m]."""
        places = knot * (np.arange(len(points) + DEGREE + 1) - DEGREE)
        spline = BSpline(places, points, DEGREE)
        self._parts = [spline, *(spline.derivative(k) for k in (1, 2, 3))]
        self.duration = float(places[len(points)])

    def at(self, times: Array) -> Flown:
        """The path at times (n,) [s]."""
        t = np.clip(times, 0.0, self.duration - 1e-9)
        made = [part(t) for part in self._parts]
        outside = (times < 0.0) | (times >= self.duration)
        for part in made[1:]:
            part[outside] = 0.0
        return Flown(*made)


def around(line: Line, obstacles: Obstacles, settings: SplineSettings) -> SplinePath:
    """A spline that follows a line in time and leaves the obstacles, which rest, on one side."""
    s = settings
    count = int(np.ceil(line.duration / s.knot)) + DEGREE + 2
    wanted = line.at(s.knot * (np.arange(count, dtype=np.float64) - 1.0)).position
    points, along = wanted.copy(), (np.array(line.end) - np.array(line.start)) / line.length
    anchors: list[tuple[int, Array, Array]] = []
    for _ in range(s.rounds):
        fresh = _anchors(points, obstacles, along, anchors)
        if not fresh:
            break
        anchors += fresh
        points = _optimised(points, wanted, anchors, s)
    return SplinePath(points, s.knot)


def _anchors(
    points: Array, obstacles: Obstacles, along: Array, known: list[tuple[int, Array, Array]]
) -> list[tuple[int, Array, Array]]:
    """New pairs of anchor and direction for control points inside an obstacle: (point, place, direction)."""
    new = []
    for centre, keep, upright in zip(obstacles.position, obstacles.keep.tolist(), obstacles.upright, strict=True):
        flat = np.array([1.0, 1.0, 0.0]) if upright else np.ones(3)
        away = (points - centre) * flat
        inside = np.flatnonzero(np.linalg.norm(away, axis=1) < keep)
        if not len(inside):
            continue
        # One side for the whole stretch: that on which its middle lies, across the path.
        middle = away[inside].mean(axis=0)
        side = middle - (middle @ along) * along
        side = side if np.linalg.norm(side) > 1e-6 else np.cross([0.0, 0.0, 1.0], along)
        side = side / np.linalg.norm(side)
        for k in inside.tolist():
            ahead = float(away[k] @ along)
            reach = np.sqrt(max(keep * keep - ahead * ahead, 0.0))
            place = centre * flat + points[k] * (1.0 - flat) + ahead * along + reach * side
            if not any(point == k and np.allclose(place, there, atol=0.05) for point, there, _ in known):
                new.append((k, place, side))
    return new


def _optimised(points: Array, wanted: Array, anchors: list[tuple[int, Array, Array]], s: SplineSettings) -> Array:
    """Control points of the least cost; the first and the last three stay."""
    index = np.array([k for k, _, _ in anchors])
    places, sides = np.array([p for _, p, _ in anchors]), np.array([v for _, _, v in anchors])
    free = slice(DEGREE, len(points) - DEGREE)

    def cost(x: Array) -> tuple[float, Array]:
        q = points.copy()
        q[free] = x.reshape(-1, 3)
        third, off = np.diff(q, 3, axis=0), q - wanted
        x_near = s.margin - np.sum((q[index] - places) * sides, axis=1)
        m = s.margin
        deep = x_near > m
        near = np.where(deep, 3.0 * m * x_near**2 - 3.0 * m * m * x_near + m**3, np.maximum(x_near, 0.0) ** 3)
        slope = np.where(deep, 6.0 * m * x_near - 3.0 * m * m, 3.0 * np.maximum(x_near, 0.0) ** 2)
        value = s.smooth * np.sum(third**2) + s.along * np.sum(off**2) + s.near * np.sum(near)
        gradient = 2.0 * s.along * off
        for k, weight in enumerate((-1.0, 3.0, -3.0, 1.0)):
            gradient[k : len(q) - 3 + k] += 2.0 * s.smooth * weight * third
        np.add.at(gradient, index, -s.near * slope[:, None] * sides)
        return float(value), gradient[free].ravel()

    result = minimize(cost, points[free].ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 500})
    best = points.copy()
    best[free] = result.x.reshape(-1, 3)
    return best
