"""Layouts: the corridor and the obstacle course of Ta, Kobilarov and Dellaert (ICUAS 2014), section V.

A layout depends on its seed alone. The seeds of the studies are fixed here, apart from those open to tuning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.planning.passage import obstacle_distance, widest_way
from unifg.typing import Array

__all__ = [
    "CORRIDOR_SEEDS",
    "COURSE_SEEDS",
    "TUNING_SEEDS",
    "WAY_CLEARANCE",
    "Layout",
    "corridor",
    "obstacle_course",
]

CORRIDOR_SEEDS = range(100)
"""Seeds of the corridor study. Nothing is tuned on them."""

COURSE_SEEDS = range(200)
"""Seeds of the obstacle course study. Nothing is tuned on them."""

TUNING_SEEDS = range(1000, 1050)
"""Seeds on which settings of either scenario may be chosen."""

WAY_CLEARANCE = 0.5
"""Clearance of the way every corridor offers, from the vehicle's centre line to the nearest surface [m]."""

_CORRIDOR_TAG, _COURSE_TAG = 52, 51  # keep the streams of the two generators apart

_LENGTH, _HALF_WIDTH = 30.0, 4.0  # of the corridor [m]
_INSET, _HEIGHT = 1.0, 1.5  # of start and target [m]
_FREE = 1.5  # around start and target, to every cylinder's surface [m]

_COURSE_START, _COURSE_TARGET = (0.0, 0.0, 0.0), (8.0, 1.0, 1.5)
_COURSE_WALLS = (((2.0, -3.0), (2.0, 0.6)), ((4.0, -0.8), (4.0, 3.0)), ((5.5, -2.4), (7.0, -1.0)))
_COURSE_CYLINDER = (6.0, 0.1, 0.5)
_COURSE_AREA = ((1.0, 7.0), (-2.5, 2.5))  # of the centres of obstacles: x, y [m]
_COURSE_FREE = 0.5  # around start and target, to every surface [m]


@dataclass(frozen=True)
class Layout:
    """Start, target and upright obstacles of one episode, world frame, z up.

    Attributes:
        start: (3,) where the vehicle starts, at rest [m].
        target: (3,) where it is to go [m].
        cylinders: (M, 3) x, y, radius [m]; they have no top.
        walls: (W, 2, 2) segments on the ground plane [m]; they have no top and no thickness.
        size: (2, 2) lowest and highest corner of the ground that pictures show [m].
        name: of the generator, and the seed.
    """

    start: Array
    target: Array
    cylinders: Array
    walls: Array
    size: Array
    name: str = ""

    def __post_init__(self) -> None:
        """Store float64 arrays.

        Raises:
            ScenarioError: if a field has a wrong shape or a number that is not finite, or a radius is not positive.
        """
        shapes = {"start": (3,), "target": (3,), "cylinders": (-1, 3), "walls": (-1, 2, 2), "size": (2, 2)}
        for field, shape in shapes.items():
            value = np.array(getattr(self, field), dtype=np.float64)
            if value.size == 0 and shape[0] == -1:
                value = value.reshape((0, *shape[1:]))
            if value.shape[1:] != shape[1:] or (shape[0] != -1 and value.shape != shape):
                wanted = str(shape).replace("-1", "any")
                raise ScenarioError(f"layout {self.name!r}: {field} must have shape {wanted}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ScenarioError(f"layout {self.name!r}: {field} holds numbers that are not finite")
            value.setflags(write=False)
            object.__setattr__(self, field, value)
        if (self.cylinders[:, 2] <= 0.0).any():
            worst = int(np.argmin(self.cylinders[:, 2]))
            raise ScenarioError(
                f"layout {self.name!r}: cylinder {worst} has radius {self.cylinders[worst, 2]:g} m; "
                "radii must be positive"
            )

    @property
    def corners(self) -> Array:
        """(C, 2) end points of the walls [m], each once, in the order of the walls."""
        points = self.walls.reshape(-1, 2)
        _, first = np.unique(points, axis=0, return_index=True)
        return points[np.sort(first)]

    def distance(self, points: Array) -> Array:
        """(n,) distance from points (n, 2) to the nearest surface [m]; negative inside a cylinder."""
        return obstacle_distance(np.asarray(points, dtype=np.float64), self.cylinders, self.walls)

    def widest_way(self) -> float:
        """Greatest clearance of a way over the ground plane from start to target [m]; see :func:`widest_way`.

        Ways around the far ends of free-standing walls count.
        """
        return widest_way(self.start, self.target, self.cylinders, self.walls)


def corridor(seed: int, count: int = 10) -> Layout:
    """Two parallel walls and cylinders at random between start and target (Ta V-B, Figs. 4 and 5).

    The walls are 8 m apart and 30 m long; start and target lie 28 m apart on the middle line at a height of 1.5 m.
    Radii are uniform in 0.3 to 0.6 m. Centres are uniform over the ground between start and target, as far as the
    cylinder stays between the walls and leaves 1.5 m free around start and target. Cylinders may overlap each other
    and touch walls. All are redrawn only if no way of clearance :data:`WAY_CLEARANCE` leads through.

    Args:
        seed: of the layout; not negative.
        count: number of cylinders.

    Raises:
        ScenarioError: so many cylinders leave no way in a thousand draws.
    """
    rng = np.random.default_rng([_CORRIDOR_TAG, seed])
    start, target = np.array([_INSET, 0.0, _HEIGHT]), np.array([_LENGTH - _INSET, 0.0, _HEIGHT])
    walls = np.array([[[0.0, side], [_LENGTH, side]] for side in (_HALF_WIDTH, -_HALF_WIDTH)])
    far, near = _LENGTH + 10.0, -10.0
    corners = np.array([[near, -_HALF_WIDTH], [far, -_HALF_WIDTH], [far, _HALF_WIDTH], [near, _HALF_WIDTH]])
    fence = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)  # drawn out and joined: no way leads around it
    for _ in range(1000):
        cylinders = np.array([_corridor_cylinder(rng, start, target) for _ in range(count)]).reshape(-1, 3)
        if widest_way(start, target, cylinders, fence) >= WAY_CLEARANCE:
            size = np.array([[0.0, -_HALF_WIDTH], [_LENGTH, _HALF_WIDTH]])
            return Layout(start, target, cylinders, walls, size, f"corridor {seed}")
    raise ScenarioError(
        f"no corridor with {count} cylinders and a way of clearance {WAY_CLEARANCE:g} m was found in 1000 draws of "
        f"seed {seed}; ask for fewer cylinders"
    )


def _corridor_cylinder(rng: np.random.Generator, start: Array, target: Array) -> Array:
    """One cylinder (3,), free of walls, start and target."""
    while True:
        radius = rng.uniform(0.3, 0.6)
        x = rng.uniform(start[0], target[0])
        y = rng.uniform(-1.0, 1.0) * (_HALF_WIDTH - radius)
        if min(np.hypot(x - end[0], y - end[1]) for end in (start, target)) >= _FREE + radius:
            return np.array([x, y, radius])


def obstacle_course(seed: int | None = None) -> Layout:
    """Three walls and a cylinder between a start on the ground and a target in the air (Ta V-A, Fig. 3).

    Without a seed the nominal course: a slalom whose straight line is blocked twice. With a seed every obstacle keeps
    its length or radius and is placed anew: its centre uniform over 6 x 5 m between start and target, walls in a
    uniform direction; an obstacle nearer than 0.5 m to start or target is drawn again. Nothing else is guaranteed:
    obstacles may cross, and a course may offer no way (see :meth:`Layout.widest_way`).

    Args:
        seed: of the layout, not negative; None for the nominal course.
    """
    start, target = np.array(_COURSE_START), np.array(_COURSE_TARGET)
    walls, cylinder = np.array(_COURSE_WALLS), np.array(_COURSE_CYLINDER)
    if seed is not None:
        rng = np.random.default_rng([_COURSE_TAG, seed])
        ends = np.stack([start, target])[:, :2]
        lengths = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1)
        walls = np.stack([_placed_wall(rng, float(length), ends) for length in lengths])
        cylinder = _placed_cylinder(rng, float(cylinder[2]), ends)
    size = np.array([[-1.0, -4.0], [9.0, 4.0]])
    return Layout(start, target, cylinder[None], walls, size, "obstacle course" + ("" if seed is None else f" {seed}"))


def _placed_wall(rng: np.random.Generator, length: float, ends: Array) -> Array:
    """A wall (2, 2) of given length, free of start and target."""
    while True:
        centre, angle = rng.uniform(*np.transpose(_COURSE_AREA)), rng.uniform(0.0, np.pi)
        half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
        wall = np.stack([centre - half, centre + half])
        if obstacle_distance(ends, np.zeros((0, 3)), wall[None]).min() >= _COURSE_FREE:
            return wall


def _placed_cylinder(rng: np.random.Generator, radius: float, ends: Array) -> Array:
    """A cylinder (3,) of given radius, free of start and target."""
    while True:
        cylinder = np.append(rng.uniform(*np.transpose(_COURSE_AREA)), radius)
        if obstacle_distance(ends, cylinder[None], np.zeros((0, 2, 2))).min() >= _COURSE_FREE:
            return cylinder
