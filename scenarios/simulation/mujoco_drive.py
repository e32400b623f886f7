"""The truth of a drive in MuJoCo: two driven wheels with friction and a caster, walls that stop the hull, rays.

Wheels are those of a Kobuki (35 mm of radius, 21 mm wide: its driver's "Kobuki Parameters"), apart by the axle that the
fault "wheel-dead" has; the mass is that of a TurtleBot 2. The motors are told what the drivetrain makes of a command,
with its latency, lag and accelerations; they hold speeds with a torque that is limited. Wheels roll and slip by the
engine's friction, and odometry is what their encoders count, with the scale error and the noise of the scenario.
"""

from __future__ import annotations

import math

import numpy as np
import pymunk

from unifg.errors import ScenarioError
from unifg.models import unicycle
from unifg.scenarios.simulation.faults import AXLE
from unifg.scenarios.simulation.mujoco_engine import Engine, box
from unifg.scenarios.simulation.plane import WALLS, World
from unifg.scenarios.simulation.rectangles import wall_rectangles
from unifg.typing import Array, ArrayLike

__all__ = ["MujocoDrive"]

WHEEL, WHEEL_WIDTH = 0.035, 0.021
"""Radius and width of a wheel [m]."""

MASS, WHEEL_MASS = 6.3, 0.1
"""Of the robot and of each wheel [kg]."""

FRICTION = 0.8
"""Of rubber on a floor."""

SCRUB = 0.25 * FRICTION * WHEEL_WIDTH
"""Moment about the vertical that a wheel has where it turns on its line of contact, per load [m]."""

BACK, UP = 0.03, 0.08
"""Place of the centre of mass: behind the axle, above the floor [m]."""

CASTER = 0.12
"""Distance of the caster behind the axle [m]: it carries a quarter of the weight."""

HULL = 0.04, 0.25
"""Heights between which the hull touches things [m]; the lidar turns at the upper one."""

ROTOR = 5e-4
"""Moment of inertia of a motor's rotor as the wheel feels it, through a gear of 50 to 1 [kg m^2]."""

SERVO = 0.3
"""Torque of a motor per error of its wheel's speed [N m s/rad]: the robot follows within 15 ms."""

SETTLING, TRIM = 0.05, 2.0
"""Time in which a motor makes good a steady error of its speed [s], and most that it adds for that [rad/s]."""

TORQUE = 1.0
"""Greatest torque of a motor [N m]: 9 m/s^2, more than the friction holds."""


class MujocoDrive(World):
    """The world of :class:`World`, whose robot moves, sees and touches in MuJoCo.

    Attributes:
        physics: the engine.
    """

    def add_vehicle(self) -> None:
        """Build the engine's model, at the start.

        Raises:
            ScenarioError: for another base than a unicycle, or a floor that takes a stated share.
        """
        train = self._drivetrain
        if self.base is not unicycle.BASE or train.slip or train.skid:
            raise ScenarioError(
                "the world 'mujoco' has a unicycle on two wheels, which slip by friction: leave --base, --slip and "
                "--skid out"
            )
        cells, turned = wall_rectangles(self.occupancy.occupied).astype(np.float64), self.occupancy.origin[2]
        halves = 0.5 * self.occupancy.resolution * np.diff(cells)[:, [2, 0]]
        centres = self.occupancy.grid_to_world(cells[:, [2, 0]] + 0.5 * np.diff(cells)[:, [2, 0]])
        walls = [(WALLS, box(x, y, a, b, turned)) for x, y, a, b in np.hstack([centres, halves]).tolist()]
        height, middle, mass = HULL[1] - HULL[0], 0.5 * (HULL[0] + HULL[1]), MASS * (1.0 + train.load)
        radius, meets = self.radius, 'contype="0" conaffinity="2"'
        inertia = mass * np.array([3.0 * radius**2 + height**2, 3.0 * radius**2 + height**2, 6.0 * radius**2]) / 12.0
        hull, assets = "", ""
        if self.body.outline:
            points = " ".join(f"{x} {y} {z}" for z in HULL for x, y in self.body.outline)
            assets = f'<asset><mesh name="hull" vertex="{points}" inertia="shell"/></asset>'
            hull = f'<geom type="mesh" mesh="hull" {meets}/>'
        else:
            for x, y, r in self.body.discs:
                hull += f'<geom type="cylinder" pos="{x} {y} {middle}" size="{r} {0.5 * height}" {meets}/>'
        wheels = motors = ""
        for name, side in (("left", 0.5 * AXLE), ("right", -0.5 * AXLE)):
            wheels += (
                f'<body pos="0 {side} {WHEEL}"><joint name="{name}" axis="0 1 0" armature="{ROTOR}"/>'
                f'<geom type="ellipsoid" size="{WHEEL} {0.5 * WHEEL_WIDTH} {WHEEL}" mass="{WHEEL_MASS}" condim="4" '
                f'friction="{FRICTION} {SCRUB}" contype="0" conaffinity="1"/></body>'
            )
            motors += f'<velocity joint="{name}" kv="{SERVO}" forcerange="-{TORQUE} {TORQUE}"/>'
        vehicle = (
            f'<body name="vehicle"><freejoint/>'
            f'<inertial pos="-{BACK} 0 {UP}" mass="{mass}" diaginertia="{" ".join(map(str, inertia))}"/>'
            f'<geom type="sphere" pos="-{CASTER} 0 0.02" size="0.02" condim="1" contype="0" conaffinity="1"/>'
            f"{hull}{wheels}</body>"
        )
        self.physics = Engine(
            walls, self.discs(), 0, vehicle, f"{assets}<actuator>{motors}</actuator>", (WALLS - 1, 0.0)
        )
        self._counted, self._trim = np.zeros(2), np.zeros(2)
        self._put()

    def _put(self) -> None:
        """Put the engine's robot where the world's is, at rest."""
        half = 0.5 * self.vehicle.angle
        self.physics.place((*self.vehicle.position, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half)))
        self.physics.touching = {WALLS - 1} | {owner for owner in self.physics.touching if self.touches(owner)}

    def carry(self, pose: ArrayLike) -> None:
        """Put the robot down at another pose (3,) [m, m, rad], at rest; its wheels do not turn."""
        super().carry(pose)
        self._put()

    # ------------------------------------------------------------------ motion

    def _start_tick(self, pause: float) -> None:
        """Do nothing: forces of the engine act at once."""

    def advance(self, pause: float) -> None:
        """Move discs and robot for a substep [s]."""
        super().advance(pause)
        v, omega = self._wheels.advance(pause).tolist()
        data = self.physics.data
        wanted = np.array([v - 0.5 * AXLE * omega, v + 0.5 * AXLE * omega]) / WHEEL
        self._trim = np.clip(self._trim + pause / SETTLING * (wanted - data.qvel[6:8]), -TRIM, TRIM)
        data.ctrl[:] = wanted + self._trim
        self.physics.carry(self.discs())
        self.physics.step(self.physics.steps(pause))
        self.physics.report(self, (WALLS - 1,))
        w, x, y, z = data.qpos[3:7].tolist()
        heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        turn = (heading - self.vehicle.angle + math.pi) % (2.0 * math.pi) - math.pi
        self.vehicle.position, self.vehicle.angle = tuple(data.qpos[:2].tolist()), self.vehicle.angle + turn
        self.vehicle.velocity = tuple(data.qvel[:2].tolist())

    def _rolled(self, before: pymunk.Vec2d, heading_before: float, dt: float) -> Array:
        """Controls (2,) that the wheels' encoders have counted over ``dt`` [s]."""
        counted = self.physics.data.qpos[7:9] * WHEEL
        left, right = ((counted - self._counted) / dt).tolist()
        self._counted = counted
        return np.array([0.5 * (left + right), (right - left) / AXLE])

    # ----------------------------------------------------------------- sensors

    def _met(self, origins: Array, tips: Array) -> Array:
        """(B,) ranges at which rays of the engine meet something [m]; inf where they do not."""
        reach, ranges = self.lidar.range_max, np.empty(len(origins))
        ways = np.column_stack([(tips - origins) / reach, np.zeros(len(origins))])
        places, which = np.unique(origins, axis=0, return_inverse=True)
        for k, (x, y) in enumerate(places.tolist()):
            ranges[which.ravel() == k] = self.physics.rays((x, y, HULL[1]), ways[which.ravel() == k], reach)[0]
        return ranges
