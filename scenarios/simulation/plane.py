"""The simulated truth of a drive: a robot, walls and unforeseen obstacles, a lidar and wheel odometry.

The world is built from an occupancy map and from obstacles that the map does not show. What the robot may
know of it is what `World.scan` and `World.odometry` return; everything else (`World.pose`, `World.clearance`,
...) is ground truth for metrics and pictures.

A velocity written before the engine's step is integrated before contacts are solved, so a robot driven that way passes
through walls: the command is written in ``velocity_func`` instead, and at the start of a tick only without its parts
into walls already touched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pymunk

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2
from unifg.models import unicycle
from unifg.models.footprint import Body
from unifg.models.planar import Base
from unifg.scenarios.options import AtLeastTwo, Positive, Settings, not_negative, option, positive, share
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.simulation.drivetrain import Drivetrain, Wheels
from unifg.scenarios.simulation.rectangles import wall_rectangles
from unifg.scenarios.simulation.space import OTHERS, Mover, Obstacle, Space
from unifg.typing import Array, ArrayLike

__all__ = ["ROBOT_RADIUS", "LidarModel", "OdometryModel", "World"]

ROBOT_RADIUS = 0.17
"""Radius of the robot's disc [m]."""

HULL_SPACING = 0.02  # [m] between places of a hull whose distance from walls and obstacles is measured

EDGE = 0.3
"""Neighbouring beams that differ by more have an edge between them [m]."""

WALLS = -1
"""Owner of all walls together; obstacles are owned by their index."""


@dataclass(frozen=True)
class LidarModel(Settings):
    """Lidar at the robot's centre, beams evenly over its field of view.

    Attributes:
        beams: number of beams.
        range_max: beyond it nothing returns [m].
        sigma: standard deviation of a range, whatever the robot believes of it [m].
        dropout: probability that a beam is lost.
        clutter: probability that a beam returns too soon, from anywhere before what it should have met.
        mixed: probability that a beam beside an edge returns from between what its neighbours meet.
        turn: duration of one turn [s], during which the robot moves.
        field: of view, its middle ahead [rad]; a full turn begins behind.
    """

    beams: AtLeastTwo = 360
    range_max: Positive[float] = 12.0
    sigma: float = option(0.02, text=not_negative, metavar="M", flag="range-sigma")
    dropout: float = option(0.01, text=share, metavar="SHARE")
    clutter: float = option(0.0, text=share, metavar="SHARE")
    mixed: float = option(0.0, text=share, metavar="SHARE")
    turn: float = option(0.0, text=not_negative, metavar="S", flag="scan-time")
    field: float = option(2.0 * math.pi, text=positive, metavar="RAD", flag="field-of-view")

    def __post_init__(self) -> None:
        """Refuse a field of view that is none."""
        super().__post_init__()
        if self.field > 2.0 * math.pi + 1e-9:
            raise ScenarioError(f"the lidar's field of view must be in (0, 2 pi] rad, got {self.field:g}")

    @property
    def angles(self) -> Array:
        """(B,) beam directions in the body frame [rad]."""
        ends = self.beams if self.field >= 2.0 * math.pi - 1e-9 else self.beams - 1
        return -0.5 * self.field + self.field * np.arange(self.beams) / ends


@dataclass(frozen=True)
class OdometryModel(Settings):
    """Wheel odometry: measured = true * (1 + scale + noise), for v and omega each on its own.

    Attributes:
        scale_sigma: standard deviation of the wheels' scale error, drawn once per episode.
        noise_sigma: standard deviation of the wheels' relative noise, drawn every step.
    """

    scale_sigma: float = option(0.05, text=not_negative, metavar="SHARE", flag="odometry-scale")
    noise_sigma: float = option(0.02, text=not_negative, metavar="SHARE", flag="odometry-noise")


class World(Space):
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
        drivetrain: Drivetrain | None = None,
        base: Base = unicycle.BASE,
        body: Body | None = None,
        people: Sequence[Mover] = (),
    ) -> None:
        """Build the walls, place the obstacles and the robot.

        Args:
            occupancy: map whose occupied cells are walls; unknown cells are not solid.
            start: (3,) true pose of the robot at time zero [m, m, rad].
            obstacles: discs that are not on the map.
            rng: source of all noise; its children are spawned, itself it is not advanced. None seeds with 0.
            robot_radius: of a robot that is a disc [m].
            lidar: lidar to simulate; None for 360 beams, 12 m, 0.02 m, 1 % dropouts.
            odometry: wheel odometry to simulate; None for 5 % scale error and 2 % noise.
            drivetrain: what the base makes of its commands; None for a base that follows them at once.
            base: of the robot.
            body: of the robot; None for a disc.
            people: walk about by social forces.

        Raises:
            ScenarioError: if the start is not a finite pose, or the robot would stand in a wall or an
                obstacle.
        """
        pose = np.asarray(start, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ScenarioError(f"start must be three finite numbers x, y, theta; got {start!r}")
        self.occupancy = occupancy
        self.obstacles = tuple(obstacles)
        self.lidar = lidar or LidarModel()
        self._odometry_model = odometry or OdometryModel()
        lidar_rng, odometry_rng = (np.random.default_rng(0) if rng is None else rng).spawn(2)
        self._lidar_rng, self._odometry_rng = lidar_rng, odometry_rng
        self.base, size = base, base.size
        self._scale = 1.0 + self._odometry_model.scale_sigma * odometry_rng.standard_normal(size)
        self._measured = np.zeros(size)
        self._angles = self.lidar.angles
        self._drivetrain = drivetrain or Drivetrain.ideal()
        self._wheels = Wheels(self._drivetrain, base)
        self._steered = 0.0
        self._velocities = base.of(np.zeros(size)).tolist()
        self._left, self._spun, self._gripped = 0, 0.0, 0.0
        self.computing = 0.0  # [s] of the tick that decided the next control
        super().__init__(pose, body or Body.disc(robot_radius))
        self._boundary = self.body.boundary(HULL_SPACING)
        self._add_walls()
        for index, obstacle in enumerate(self.obstacles):
            self.add_disc(obstacle, index)
        for index, person in enumerate(people, start=len(self.obstacles)):
            self.add_mover(person, index)
        self._trail: list[tuple[float, tuple[float, float, float]]] = [
            (self.time, (*self.vehicle.position, self.vehicle.angle))
        ]
        self.vehicle.velocity_func = self._drive
        self.add_vehicle()
        if self.clearance() < 0.0:
            raise ScenarioError(
                f"the robot (radius {self.radius:g} m) cannot start at ({pose[0]:g}, {pose[1]:g}): "
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
            self.add(pymunk.Poly(self.engine.static_body, [(x, y) for x, y in polygon]), WALLS)

    # ------------------------------------------------------------------ motion

    def step(self, *control: float, dt: float = 0.1) -> None:
        """Tell the wheels a control for a while; walls and obstacles stop the robot.

        Args:
            control: m numbers: of a unicycle forward velocity and turning rate [m/s, rad/s].
            dt: duration [s].

        Raises:
            ScenarioError: if a command or the duration is not a usable number.
        """
        if len(control) != self.base.size or not all(map(math.isfinite, control)):
            raise ScenarioError(
                f"the control {control} is not {self.base.size} finite numbers; stop the robot, do not drive on it"
            )
        self._wheels.tell(control, self.computing)
        before, heading_before = self.vehicle.position, self.vehicle.angle
        self._spun = self._gripped = self._steered = 0.0
        self._trail = [entry for entry in self._trail if entry[0] >= self.time - self.lidar.turn]
        for count, pause in enumerate(self.substeps(dt)):
            if not count:
                self._left = round(dt / pause)
                self._start_tick(pause)
            self.advance(pause)
            self._trail.append((self.time, (*self.vehicle.position, self.vehicle.angle)))
        self._measure(before, heading_before, dt)

    def _drive(self, body: pymunk.Body, gravity: tuple[float, float], damping: float, dt: float) -> None:
        """Velocity for the coming substep, along its midpoint heading: the chord of the arc."""
        grip = 1.0 - self._drivetrain.slip
        if self._left:  # the engine asks once more after the last substep of a tick
            self._left -= 1
            command = self._wheels.advance(dt)
            self._velocities = self.base.of(command).tolist()
            moved = math.fsum(map(abs, self._velocities))
            self._spun, self._gripped = self._spun + moved, self._gripped + moved * grip
            self._steered += float(command[-1]) * dt
        v, *across, omega = (grip * velocity for velocity in self._velocities)
        heading = body.angle + 0.5 * omega * dt
        aside = sum(across) - self._drivetrain.skid * v * omega
        cosine, sine = math.cos(heading), math.sin(heading)
        body.velocity = (v * cosine - aside * sine, v * sine + aside * cosine)
        body.angular_velocity = omega

    def _start_tick(self, pause: float) -> None:
        """Apply a new command at once, but for its parts into things already touched.

        The engine integrates positions before it calls ``velocity_func``: without this the first substep of a
        tick would still run on the last tick's command.
        """
        self._drive(self.vehicle, (0.0, 0.0), 1.0, pause)
        self.vehicle.velocity = self.without_contacts(self.vehicle.velocity, relative=False)

    def _measure(self, before: pymunk.Vec2d, heading_before: float, dt: float) -> None:
        """Read the wheels after a step of ``dt`` [s] from a place and a heading."""
        noise = self._odometry_model.noise_sigma * self._odometry_rng.standard_normal(self.base.size)
        self._measured = self._rolled(before, heading_before, dt) * (self._scale + noise)

    def _rolled(self, before: pymunk.Vec2d, heading_before: float, dt: float) -> Array:
        """Controls (m,) of the wheels: the SE(2) logarithm of the motion made, as far as they roll, and the slip."""
        turn = self.vehicle.angle - heading_before
        body_motion = (self.vehicle.position - before).rotated(-heading_before)
        half = 0.5 * turn
        stretch = half / math.tan(half) if abs(half) > 1e-9 else 1.0
        forward = stretch * body_motion.x + half * body_motion.y
        left = [stretch * body_motion.y - half * body_motion.x] if self.base.slides else []
        grip = self._gripped / self._spun if self._spun > 0.0 else 1.0
        made = np.array([forward, *left, turn]) / (dt * grip)
        if self.base.steering is not None:
            made[-1] = self._steered / dt
        return made

    def power(self, on: bool) -> None:
        """Give the motors power, or cut it: brakes bring the wheels to rest."""
        self._wheels.powered = on

    def carry(self, pose: ArrayLike) -> None:
        """Put the robot down at another pose (3,) [m, m, rad], at rest; its wheels do not turn."""
        place = np.asarray(pose, dtype=np.float64)
        self.vehicle.position, self.vehicle.angle = (float(place[0]), float(place[1])), float(place[2])
        self.vehicle.velocity, self._measured = (0.0, 0.0), np.zeros(self.base.size)
        self.engine.reindex_shapes_for_body(self.vehicle)

    # ----------------------------------------------------------------- sensors

    def scan(self) -> Scan:
        """Turn the lidar once, so that the last beam is one of the present pose; every call draws new noise."""
        lidar, reach = self.lidar, self.lidar.range_max
        places = self._track(lidar.turn * (np.arange(lidar.beams) - (lidar.beams - 1)) / lidar.beams)
        bearing = places[:, 2] + self._angles
        tips = places[:, :2] + reach * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        ranges = self._met(places[:, :2], tips)
        noise = lidar.sigma * self._lidar_rng.standard_normal(lidar.beams)
        lost = self._lidar_rng.random(lidar.beams) < lidar.dropout
        if lidar.clutter or lidar.mixed:
            ranges = self._spoiled(ranges)
        seen = np.isfinite(ranges)
        ranges[seen] = np.clip(ranges[seen] + noise[seen], 0.0, reach)
        ranges[lost] = np.nan
        return Scan(self._angles.copy(), ranges, self.time, lidar.turn)

    def _met(self, origins: Array, tips: Array) -> Array:
        """(B,) ranges at which beams from origins (B, 2) to tips (B, 2) meet something [m]; inf where they do not."""
        query = self.engine.segment_query_first
        hits = [
            query((x, y), (tip[0], tip[1]), 0.0, OTHERS)
            for (x, y), tip in zip(origins.tolist(), tips.tolist(), strict=True)
        ]
        return np.array([math.inf if hit is None else hit.alpha for hit in hits]) * self.lidar.range_max

    def _track(self, times: Array) -> Array:
        """(n, 3) where the robot was at times (n,) from now on, none of them positive [m, m, rad]."""
        then, where = np.array([when for when, _ in self._trail]), np.array([pose for _, pose in self._trail])
        at = np.maximum(self.time + times, then[0])
        return np.column_stack([np.interp(at, then, column) for column in where.T])

    def _spoiled(self, ranges: Array) -> Array:
        """Ranges (B,) with returns that come too soon, and with some from between the two sides of an edge."""
        lidar = self.lidar
        early, where, mixed, between = self._lidar_rng.random((4, lidar.beams))
        met = np.minimum(ranges, lidar.range_max)
        mixed_ranges = np.where(
            (np.abs(met - np.roll(met, 1)) > EDGE) & (mixed < lidar.mixed),
            met + between * (np.roll(met, 1) - met),
            ranges,
        )
        return np.where(early < lidar.clutter, where * np.minimum(mixed_ranges, lidar.range_max), mixed_ranges)

    def odometry(self) -> tuple[float, ...]:
        """Mean controls (m) over the last step, as the wheels report them: of a unicycle v [m/s] and omega [rad/s].

        They are proportional to the motion really made and to what the wheels slipped: wheels that a wall holds back
        do not spin, and sliding sideways, along a wall or in a turn, is not felt. (0, 0) before the first step.
        """
        return tuple(self._measured.tolist())

    # ------------------------------------------------------------ ground truth

    @property
    def pose(self) -> Array:
        """(3,) true pose of the robot [m, m, rad], theta in [-pi, pi)."""
        x, y = self.vehicle.position
        return np.array([x, y, (self.vehicle.angle + math.pi) % (2.0 * math.pi) - math.pi])

    def clearance(self) -> float:
        """Distance from the robot's hull to the nearest wall or obstacle [m]; negative when they overlap."""
        if self.body.round:
            return self._distance(*self.vehicle.position) - self.radius
        hull: Array = SE2.act(self.pose, self._boundary)
        return min(self._distance(x, y) for x, y in hull.tolist())

    def _distance(self, x: float, y: float) -> float:
        """Distance from a place to the nearest wall or obstacle [m]."""
        reach = 2.0
        while reach < 1000.0:  # the engine tests every shape in reach, so begin near
            nearest = self.engine.point_query_nearest((x, y), reach, OTHERS)
            if nearest is not None:
                return float(nearest.distance)
            reach *= 4.0
        return math.inf
