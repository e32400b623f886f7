"""Flying along a path by differential flatness: what the state must be, and the controller that brings it there.

With drag that is the same across the body, D = diag(d, d, d_z), the force along the third axis of the body is

    f = m (a + g e3) + d v,    T = f . R e3 + (d_z - d) v . R e3,    R e3 = f / |f|

for a path with acceleration a and velocity v, because R D R' v = d v + (d_z - d) (v . R e3) R e3. The rates follow
from the jerk. :class:`FlatnessController` adds feedback to that (Sun et al., *A comparative study of nonlinear MPC and
differential-flatness-based control for quadrotor agile flight*, IEEE T-RO 2022, section III-B): of position and
velocity to the acceleration, and of the attitude to the rates, the tilt by itself and the heading by itself
(Brescianini and D'Andrea 2018), because only the tilt moves the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.scenarios.options import Positive, Settings
from unifg.scenarios.planning.flat_path import Flown
from unifg.typing import Array

__all__ = ["TUNED", "FlatnessController", "Gains", "flat_flight"]

_AHEAD = np.array([1.0, 0.0, 0.0])  # where the nose points


def flat_flight(flown: Flown, parameters: quadrotor.Parameters) -> tuple[Array, Array]:
    """States (n, 10) and controls (n, 4) of a vehicle that is on a path, its nose along x.

    Wind and updraft are accelerations that the thrust has to make up for; their change is none.
    """
    mass, (dx, dy, dz) = parameters.mass, parameters.drag
    across = 0.5 * (dx + dy)
    blow = np.array([*parameters.wind, parameters.updraft])
    force = mass * (flown.acceleration + quadrotor.GRAVITY * quadrotor.UP - blow) + across * flown.velocity
    change = mass * flown.jerk + across * flown.acceleration
    size = np.linalg.norm(force, axis=1, keepdims=True)
    up = force / size
    turn = (change - np.sum(change * up, axis=1, keepdims=True) * up) / size
    side = np.cross(up, _AHEAD)
    reach = np.linalg.norm(side, axis=1, keepdims=True)
    left = side / reach
    front = np.cross(left, up)
    bend = np.cross(turn, _AHEAD)
    swing = (bend - np.sum(bend * left, axis=1, keepdims=True) * left) / reach
    rates = np.stack([-np.sum(left * turn, 1), np.sum(front * turn, 1), -np.sum(front * swing, 1)], axis=1)
    attitude = SO3.from_matrix(np.stack([front, left, up], axis=2))
    lost = (dz - across) * np.sum(flown.velocity * up, axis=1, keepdims=True)
    states = np.concatenate([flown.position, attitude, flown.velocity], axis=1)
    return states, np.concatenate([rates, size + lost], axis=1)


@dataclass(frozen=True)
class Gains(Settings):
    """Of the feedback.

    Attributes:
        position: of the error of the position [1/s^2], in the plane and in height.
        velocity: of the velocity [1/s], in the plane and in height.
        tilt: of the error of the tilt [1/s].
        heading: of the error of the heading [1/s].
    """

    position: Positive[tuple[float, float]] = (6.0, 6.0)
    velocity: Positive[tuple[float, float]] = (4.0, 4.0)
    tilt: Positive[float] = 8.0
    heading: Positive[float] = 2.0


TUNED = Gains((225.0, 644.0), (32.8, 25.6), 65.5, 2.0)
"""Gains found by a search on a flight that appears in no table, from the gains of a new :class:`Gains`."""


class FlatnessController:
    """Follows a path.

    Attributes:
        gains: of the feedback.
        least, most: limits (4,) of the controls.
    """

    def __init__(self, gains: Gains, least: Array, most: Array) -> None:
        """Keep the numbers."""
        self.gains, self.least, self.most = gains, least, most

    def wanted(self, state: Array, flown: Flown) -> Array:
        """(3,) acceleration to be had in a state (10,) beside the path at one time."""
        plane, height = np.array(self.gains.position), np.array(self.gains.velocity)
        stiff, damp = plane[[0, 0, 1]], height[[0, 0, 1]]
        wanted: Array = (
            flown.acceleration[0] + stiff * (flown.position[0] - state[:3]) + damp * (flown.velocity[0] - state[7:])
        )
        return wanted

    def control(self, state: Array, flown: Flown, parameters: quadrotor.Parameters) -> Array:
        """(4,) control in a state (10,) beside the path at one time."""
        return self.steer(state, self.wanted(state, flown), flown.jerk[0], parameters)

    def steer(self, state: Array, acceleration: Array, jerk: Array, parameters: quadrotor.Parameters) -> Array:
        """(4,) control that brings about an acceleration (3,) which changes by a jerk (3,)."""
        one = Flown(state[None, :3], state[None, 7:], acceleration[None], jerk[None])
        states, controls = flat_flight(one, parameters)
        meant = states[0, 3:7]
        error = SO3.compose(SO3.inverse(state[3:7]), meant)
        w, x, y, z = error if error[0] >= 0.0 else -error
        # The error as a tilt followed by a turn about the third axis.
        tip = np.hypot(w, z)
        tilt = 2.0 * np.array([w * x - y * z, w * y + x * z, 0.0]) / max(tip, 1e-9)
        turn = 2.0 * np.array([0.0, 0.0, z]) / max(tip, 1e-9)
        fed = SO3.act(error, controls[0, :3])
        rates = fed + self.gains.tilt * tilt + self.gains.heading * turn
        along = SO3.act(state[3:7], quadrotor.UP)
        thrust = controls[0, 3] * max(float(along @ SO3.act(meant, quadrotor.UP)), 0.0)
        control: Array = np.clip(np.concatenate([rates, [thrust]]), self.least, self.most)
        return control
