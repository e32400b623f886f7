"""The simulated truth: a disc robot, walls and unforeseen obstacles in pymunk, a lidar and wheel odometry.

The world is built from an occupancy map and from obstacles that the map does not show. What the robot may
know of it is what `World.scan` and `World.odometry` return; everything else (`World.pose`, `World.clearance`,
...) is ground truth for metrics and pictures.

Two habits of the engine shape this file. A velocity written before ``space.step`` is integrated before
contacts are solved, so a robot driven that way passes through walls: the command is written in
``velocity_func`` instead, and at the start of a tick only without its parts into walls already touched. And
contacts count only once shapes overlap, so a tick is cut into substeps of 5 ms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymunk

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.worlds.rectangles import wall_rectangles
from unifg.scenarios.worlds.unmapped import Mover, Obstacle
from unifg.typing import Array, ArrayLike, BoolArray

__all__ = ["ROBOT_RADIUS", "LidarModel", "Obstacle", "OdometryModel", "Scan", "World"]

ROBOT_RADIUS = 0.17
"""Radius of the robot's disc [m]."""

_SUBSTEP = 0.005  # [s]; at 1 m/s a first contact overlaps by at most 5 mm
_EVENT_GAP = 0.5  # [s]; a contact renewed sooner belongs to the same event
_REST_SPEED = 0.02  # [m/s]; below it the robot counts as being at rest

_ROBOT_CATEGORY = 1
_ROBOT_TYPE = 1
_THING_TYPE = 2  # walls and obstacles
_OTHERS = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ _ROBOT_CATEGORY)


@dataclass(frozen=True)
class Scan:
    """One turn of the lidar, taken at one instant.

    Attributes:
        angles: (B,) beam directions in the body frame [rad].
        ranges: (B,) measured ranges [m]; NaN is a dropout, +inf means nothing within the lidar's range.
    """

    angles: Array
    ranges: Array

    @property
    def valid(self) -> BoolArray:
        """(B,) True for beams that came back."""
        returned: BoolArray = np.isfinite(self.ranges)
        return returned

    def endpoints(self) -> Array:
        """(n, 2) body-frame points [m] of the n beams that came back, in beam order."""
        keep = self.valid
        angles, ranges = self.angles[keep], self.ranges[keep]
        return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)


@dataclass(frozen=True)
class LidarModel:
    """Lidar at the robot's centre, beams evenly over a full turn from -pi.

    Attributes:
        beams: number of beams.
        range_max: beyond it nothing returns [m].
        sigma: standard deviation of a range [m].
        dropout: probability that a beam is lost.
    """

    beams: int = 360
    range_max: float = 12.0
    sigma: float = 0.02
    dropout: float = 0.01


@dataclass(frozen=True)
class OdometryModel:
    """Wheel odometry: measured = true * (1 + scale + noise), for v and omega each on its own.

    Attributes:
        scale_sigma: standard deviation of the scale error drawn once per episode.
        noise_sigma: standard deviation of the relative noise drawn every step.
    """

    scale_sigma: float = 0.05
    noise_sigma: float = 0.02


class World:
    """One robot in one building, with things the map does not show.

    Each sensor draws from a stream of its own, and draws the same amount whatever it sees: two controllers
    under one seed meet the same noise, and a sensor that is read more often does not shift another.
    """

    def __init__(
        self,
        occupancy: OccupancyMap,
        start: ArrayLike,
        obstacles: Sequence[Obstacle] = (),
        rng: np.random.Generator | None = None,
        *,
        robot_radius: float = ROBOT_RADIUS,
        lidar: LidarModel | None = None,
        odometry: OdometryModel | None = None,
    ) -> None:
        """Build the walls, place the obstacles and the robot.

        Args:
            occupancy: map whose occupied cells are walls; unknown cells are not solid.
            start: (3,) true pose of the robot at time zero [m, m, rad].
            obstacles: discs that are not on the map.
            rng: source of all noise; its children are spawned, itself it is not advanced. None seeds with 0.
            robot_radius: [m].
            lidar: lidar to simulate; None for 360 beams, 12 m, 0.02 m, 1 % dropouts.
            odometry: wheel odometry to simulate; None for 5 % scale error and 2 % noise.

        Raises:
            ScenarioError: if the start is not a finite pose, or the robot would stand in a wall or an
                obstacle.
        """
        pose = np.asarray(start, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ScenarioError(f"start must be three finite numbers x, y, theta; got {start!r}")
        self.occupancy = occupancy
        self.obstacles = tuple(obstacles)
        self.robot_radius = robot_radius
        self.lidar = lidar or LidarModel()
        self._odometry_model = odometry or OdometryModel()
        lidar_rng, odometry_rng = (np.random.default_rng(0) if rng is None else rng).spawn(2)
        self._lidar_rng, self._odometry_rng = lidar_rng, odometry_rng
        self._scale = 1.0 + self._odometry_model.scale_sigma * odometry_rng.standard_normal(2)
        self._measured = np.zeros(2)
        self._angles = -np.pi + 2.0 * np.pi * np.arange(self.lidar.beams) / self.lidar.beams
        self._command = (0.0, 0.0)
        self._time = 0.0
        self.collisions = 0
        self._touching: dict[int, int] = {}
        self._separated: dict[int, float] = {}

        self._space = pymunk.Space()
        self._space.collision_slop = 1e-4  # the engine's default lets shapes overlap by 0.1 m
        self._space.collision_bias = 1e-6
        self._owner: dict[pymunk.Shape, int] = {}  # obstacle index; all walls together are -1
        self._movers: dict[int, Mover] = {}
        self._add_walls()
        self._add_obstacles()
        self._robot, self._robot_shape = self._add_robot(pose)
        self._space.on_collision(_ROBOT_TYPE, _THING_TYPE, begin=self._on_begin, separate=self._on_separate)
        if self.clearance() < 0.0:
            raise ScenarioError(
                f"the robot (radius {robot_radius:g} m) cannot start at ({pose[0]:g}, {pose[1]:g}): "
                f"it would overlap a wall or an obstacle by {-self.clearance():.2f} m; "
                f"choose a start in free space of map {occupancy.name!r}"
            )

    def _add_walls(self) -> None:
        rectangles = wall_rectangles(self.occupancy.occupied)
        low_row, high_row, low_column, high_column = rectangles.T.astype(np.float64)
        corners = np.stack(
            [
                np.stack([low_column, low_row], axis=1),
                np.stack([high_column, low_row], axis=1),
                np.stack([high_column, high_row], axis=1),
                np.stack([low_column, high_row], axis=1),
            ],
            axis=1,
        )
        world_corners = self.occupancy.grid_to_world(corners.reshape(-1, 2)).reshape(-1, 4, 2)
        for polygon in world_corners.tolist():
            shape = pymunk.Poly(self._space.static_body, [(x, y) for x, y in polygon])
            self._add_thing(shape, -1)

    def _add_obstacles(self) -> None:
        for index, obstacle in enumerate(self.obstacles):
            if obstacle.end is not None and obstacle.moving:
                mover = Mover(obstacle, obstacle.end)
                self._movers[index] = mover
                self._space.add(mover.body)
                self._add_thing(pymunk.Circle(mover.body, obstacle.radius), index)
            else:
                offset = (float(obstacle.centre[0]), float(obstacle.centre[1]))
                self._add_thing(pymunk.Circle(self._space.static_body, obstacle.radius, offset), index)

    def _add_thing(self, shape: pymunk.Shape, owner: int) -> None:
        shape.collision_type = _THING_TYPE
        shape.filter = pymunk.ShapeFilter(categories=pymunk.ShapeFilter.ALL_MASKS() ^ _ROBOT_CATEGORY)
        self._space.add(shape)
        self._owner[shape] = owner

    def _add_robot(self, pose: Array) -> tuple[pymunk.Body, pymunk.Circle]:
        body = pymunk.Body(mass=1.0, moment=float("inf"))  # a wall stops the robot, it does not turn it
        body.position = (float(pose[0]), float(pose[1]))
        body.angle = float(pose[2])
        body.velocity_func = self._drive
        shape = pymunk.Circle(body, self.robot_radius)
        shape.collision_type = _ROBOT_TYPE
        shape.filter = pymunk.ShapeFilter(categories=_ROBOT_CATEGORY)
        self._space.add(body, shape)
        return body, shape

    # ------------------------------------------------------------------ motion

    def step(self, v: float, omega: float, dt: float = 0.1) -> None:
        """Drive with constant body velocities for a while; walls and obstacles stop the robot.

        Args:
            v: forward velocity [m/s].
            omega: turning rate [rad/s].
            dt: duration [s].

        Raises:
            ScenarioError: if a command or the duration is not a usable number.
        """
        if not (math.isfinite(v) and math.isfinite(omega)):
            raise ScenarioError(
                f"the control (v, omega) = ({v}, {omega}) is not finite; stop the robot, do not drive on it"
            )
        if not (math.isfinite(dt) and dt > 0.0):
            raise ScenarioError(f"the duration of a step must be positive and finite, got {dt}")
        self._command = (float(v), float(omega))
        substeps = max(1, math.ceil(dt / _SUBSTEP - 1e-9))
        pause = dt / substeps
        before, heading_before = self._robot.position, self._robot.angle
        self._start_tick(pause)
        start_time = self._time
        for count in range(substeps):
            resting = self._robot.velocity.length < _REST_SPEED
            for mover in self._movers.values():
                mover.advance(self._robot, self.robot_radius, resting, pause)
            self._time = start_time + (count + 1) * pause
            self._space.step(pause)
        self._measure(before, heading_before, dt)

    def _drive(self, body: pymunk.Body, gravity: tuple[float, float], damping: float, dt: float) -> None:
        """Velocity for the coming substep, along its midpoint heading: the chord of the arc."""
        v, omega = self._command
        heading = body.angle + 0.5 * omega * dt
        body.velocity = (v * math.cos(heading), v * math.sin(heading))
        body.angular_velocity = omega

    def _start_tick(self, pause: float) -> None:
        """Apply a new command at once, but for its parts into things already touched.

        The engine integrates positions before it calls ``velocity_func``: without this the first substep of a
        tick would still run on the last tick's command.
        """
        self._drive(self._robot, (0.0, 0.0), 1.0, pause)
        normals: list[pymunk.Vec2d] = []

        def note(arbiter: pymunk.Arbiter) -> None:
            normal = arbiter.contact_point_set.normal
            normals.append(normal if arbiter.shapes[0] is self._robot_shape else -normal)

        self._robot.each_arbiter(note)
        velocity = self._robot.velocity
        for _ in range(2):  # twice, for a corner whose walls are not square
            for normal in normals:
                velocity -= max(velocity.dot(normal), 0.0) * normal
        self._robot.velocity = velocity

    def _measure(self, before: pymunk.Vec2d, heading_before: float, dt: float) -> None:
        """Read the wheels: forward and turning part of the SE(2) logarithm of the motion really made."""
        turn = self._robot.angle - heading_before
        body_motion = (self._robot.position - before).rotated(-heading_before)
        half = 0.5 * turn
        stretch = half / math.tan(half) if abs(half) > 1e-9 else 1.0
        forward = stretch * body_motion.x + half * body_motion.y
        noise = self._odometry_model.noise_sigma * self._odometry_rng.standard_normal(2)
        self._measured = np.array([forward, turn]) / dt * (self._scale + noise)

    # ---------------------------------------------------------------- contacts

    def _on_begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        owner = self._thing(arbiter)
        touching = self._touching.get(owner, 0)
        self._touching[owner] = touching + 1
        if touching == 0 and self._time - self._separated.get(owner, -math.inf) >= _EVENT_GAP:
            self.collisions += 1

    def _on_separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        owner = self._thing(arbiter)
        self._touching[owner] = self._touching.get(owner, 1) - 1
        self._separated[owner] = self._time

    def _thing(self, arbiter: pymunk.Arbiter) -> int:
        first, second = arbiter.shapes
        return self._owner.get(first, self._owner.get(second, -1))

    # ----------------------------------------------------------------- sensors

    def scan(self) -> Scan:
        """Turn the lidar once at the present pose; every call draws new noise."""
        lidar = self.lidar
        x, y = self._robot.position
        bearing = self._robot.angle + self._angles
        tips = np.stack([x + lidar.range_max * np.cos(bearing), y + lidar.range_max * np.sin(bearing)], axis=1)
        query, origin = self._space.segment_query_first, (x, y)
        hits = [query(origin, (tip[0], tip[1]), 0.0, _OTHERS) for tip in tips.tolist()]
        fraction = np.array([math.inf if hit is None else hit.alpha for hit in hits])
        noise = lidar.sigma * self._lidar_rng.standard_normal(lidar.beams)
        lost = self._lidar_rng.random(lidar.beams) < lidar.dropout
        ranges = fraction * lidar.range_max
        seen = np.isfinite(ranges)
        ranges[seen] = np.clip(ranges[seen] + noise[seen], 0.0, lidar.range_max)
        ranges[lost] = np.nan
        return Scan(self._angles.copy(), ranges)

    def odometry(self) -> tuple[float, float]:
        """Mean body velocities (v [m/s], omega [rad/s]) over the last step, as the wheels report them.

        They are proportional to the motion really made: wheels that a wall holds back do not spin, and
        sliding sideways along a wall is not felt. (0, 0) before the first step.
        """
        return float(self._measured[0]), float(self._measured[1])

    # ------------------------------------------------------------ ground truth

    @property
    def pose(self) -> Array:
        """(3,) true pose of the robot [m, m, rad], theta in [-pi, pi)."""
        x, y = self._robot.position
        return np.array([x, y, (self._robot.angle + math.pi) % (2.0 * math.pi) - math.pi])

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._time

    def clearance(self) -> float:
        """Distance from the robot's hull to the nearest wall or obstacle [m]; negative when they overlap."""
        reach, (x, y) = 2.0, self._robot.position
        while reach < 1000.0:  # the engine tests every shape in reach, so begin near
            nearest = self._space.point_query_nearest((x, y), reach, _OTHERS)
            if nearest is not None:
                return float(nearest.distance) - self.robot_radius
            reach *= 4.0
        return math.inf

    def obstacle_states(self) -> Array:
        """(K, 4) x, y, radius [m] of the obstacles now, and 1 for those that move by design, else 0."""
        states = np.zeros((len(self.obstacles), 4))
        for index, obstacle in enumerate(self.obstacles):
            mover = self._movers.get(index)
            centre = obstacle.centre if mover is None else mover.body.position
            states[index] = centre[0], centre[1], obstacle.radius, mover is not None
        return states
