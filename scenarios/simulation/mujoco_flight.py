"""The truth of a flight in MuJoCo: a rigid body with four rotors, an autopilot that holds its body rates, contact.

Geometry, rotors and inertia are those of the AscTec Hummingbird as RotorS has it (ethz-asl/rotors_simulator,
rotors_description/urdf/hummingbird.xacro), the inertia in proportion to the mass. The pilots command body rates and a
thrust. The autopilot makes torques of the error of the engine's gyro, a mixer forces of the rotors, which follow with a
lag of first order. Drag, wind and disturbances are those of :mod:`unifg.scenarios.simulation.air`, as forces; noise of
the rates disturbs what the autopilot is told.

Of the readings, body rates and specific force are the engine's gyro and accelerometer, and its rays decide what is
visible. Bearing, range, height and tilt are the scenario's own sensors at the engine's pose.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pymunk

from unifg.models import quadrotor
from unifg.scenarios.simulation.air import FLOOR, SOFT, VEHICLE_RADIUS, QuadrotorWorld, usable
from unifg.scenarios.simulation.body_rate import Loops
from unifg.scenarios.simulation.mujoco_engine import Engine, box, cylinder
from unifg.typing import Array, ArrayLike

__all__ = ["MujocoQuadrotor"]

ARM = 0.17
"""Distance of the rotors from the middle, ahead, to the left, behind and to the right [m]."""

YAW = 0.016
"""Moment that a rotor has by its drag, per thrust [m]."""

ROTOR = 8.54858e-6 * 838.0**2
"""Greatest thrust of a rotor [N]: its motor constant times the square of its greatest speed."""

INERTIA = np.array([0.007, 0.007, 0.012]) / 0.716
"""Moments of inertia about the axes of the body, per mass [m^2]."""

HALF_HEIGHT = 0.06
"""Of the hull, a cylinder of `VEHICLE_RADIUS` [m]; the floor lies as far below a height of zero."""

LOOPS = Loops()
"""Gain of the autopilot [1/s] and lag of the motors [s], between 0.0125 s up and 0.025 s down; its link is not used."""

WALL = 0.005  # half of the thickness of walls [m]
TURNS = (1.0, -1.0, 1.0, -1.0)  # senses of the rotors' moments
PLACES = ARM * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
MIXER = np.linalg.inv(np.array([np.ones(4), PLACES[:, 1], -PLACES[:, 0], YAW * np.array(TURNS)]))
"""(4, 4) forces of the rotors per thrust [N] and moments about the axes [N m]."""


class MujocoQuadrotor(QuadrotorWorld):
    """The world of :class:`QuadrotorWorld`, whose vehicle moves, feels, sees and touches in MuJoCo.

    Attributes:
        physics: the engine.
    """

    def add_vehicle(self) -> None:
        """Build the engine's model, at the start, with the rotors' thrust at hover."""
        standing, corners = self.layout.cylinders.tolist(), self.layout.corners
        first = len(standing) + len(corners)
        things = [(owner, cylinder(*row)) for owner, row in enumerate(standing)]
        for owner, (begin, end) in enumerate(self.layout.walls, start=first + len(self.movers)):
            (x, y), along = (0.5 * (begin + end)).tolist(), end - begin
            half, heading = 0.5 * float(np.hypot(*along)), float(np.arctan2(along[1], along[0]))
            things.append((owner, box(x, y, half, WALL, heading)))
        rotors = "".join(f'<site name="r{k}" pos="{x} {y} 0"/>' for k, (x, y) in enumerate(PLACES.tolist()))
        motors = "".join(
            f'<general site="r{k}" gear="0 0 1 0 0 {turn * YAW}" dyntype="filterexact" dynprm="{LOOPS.lag}" '
            f'ctrllimited="true" ctrlrange="0 {ROTOR}"/>'
            for k, turn in enumerate(TURNS)
        )
        mass = self.parameters.mass
        inertial = f'mass="{mass!r}" diaginertia="{" ".join(map(str, mass * INERTIA))}"'
        vehicle = (
            f'<body name="vehicle"><freejoint/><inertial pos="0 0 0" {inertial}/><site name="imu"/>'
            f'<geom type="cylinder" size="{VEHICLE_RADIUS} {HALF_HEIGHT}" contype="0" conaffinity="3"/>{rotors}</body>'
        )
        rest = f'<actuator>{motors}</actuator><sensor><gyro site="imu"/><accelerometer site="imu"/></sensor>'
        self.physics = Engine(things, self.discs(), first, vehicle, rest, (FLOOR, -HALF_HEIGHT))
        self.physics.touching = {FLOOR} if self.touches(FLOOR) else set()
        self.physics.data.act[:] = 0.25 * quadrotor.hover(self.parameters)[3]
        self.physics.place(self._state[:3], self._state[3:7], self._state[7:])
        self._shapes = {owner: shape for shape, owner in self._owner.items()}

    def _weigh(self) -> None:
        """Give the body the mass of the parameters, which a load changes."""
        model, mass = self.physics.model, self.parameters.mass
        if model.body_mass[self.physics.vehicle] != mass:
            model.body_mass[self.physics.vehicle], model.body_inertia[self.physics.vehicle] = mass, mass * INERTIA
            mujoco.mj_setConst(model, mujoco.MjData(model))

    def step(self, control: ArrayLike, dt: float = 0.05) -> None:
        """Fly under a held control for a while; see :meth:`QuadrotorWorld.step`."""
        told, physics, felt = usable(control), self.physics, list[Array]()
        self._weigh()
        self.grounded = False
        for pause in self.substeps(dt):
            noise = self._disturbances.draw(pause)
            self.advance(pause)  # movers do not wait: their path is the same in every flight
            physics.carry(self.discs())
            for _ in range(physics.steps(pause)):
                self._push(told, noise)
                soft = float(np.linalg.norm(physics.data.qvel[:3])) <= SOFT
                physics.step()
                physics.report(self, (FLOOR,) if soft else ())
                self.grounded |= FLOOR in physics.touching
                felt.append(physics.data.sensordata.copy())
        self._rates, self._force = np.split(np.mean(felt, axis=0), 2)
        self._state = np.concatenate([physics.data.qpos, physics.data.qvel[:3]])

    def _push(self, told: Array, noise: Array) -> None:
        """Tell the rotors what makes body rates and thrust ``told`` (4,); drag, wind and noise (6,) push the body."""
        data, p = self.physics.data, self.parameters
        rates, inertia = data.sensordata[:3], p.mass * INERTIA
        spun = inertia * rates
        moment = LOOPS.gain * inertia * (told[:3] + noise[:3] - rates)
        moment += np.array([  # gyroscopic
            rates[1] * spun[2] - rates[2] * spun[1], rates[2] * spun[0] - rates[0] * spun[2],
            rates[0] * spun[1] - rates[1] * spun[0],
        ])  # fmt: skip
        most = 0.5 * YAW * told[3]  # roll and pitch come before yaw, whose moment is weak
        moment[2] = min(max(moment[2], -most), most)
        data.ctrl[:] = MIXER @ [told[3], *moment]  # the engine keeps them between nothing and the most
        rotation = data.xmat[self.physics.vehicle].reshape(3, 3)
        blow = noise[3:] + np.array([*p.wind, p.updraft])
        data.xfrc_applied[self.physics.vehicle, :3] = p.mass * blow - rotation @ (p.drag * (data.qvel[:3] @ rotation))

    def first_met(self, origin: tuple[float, float], tip: tuple[float, float]) -> pymunk.Shape | None:
        """First shape that a ray of the engine meets between two places [m]; None for none."""
        way = np.array([tip[0] - origin[0], tip[1] - origin[1], 0.0])
        reach = float(np.linalg.norm(way))
        found, owners = self.physics.rays((*origin, float(self._state[2])), way[None] / reach, reach)
        return self._shapes[int(owners[0])] if found[0] < np.inf else None
