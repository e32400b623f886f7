"""Wheel odometry: where the wheels say the robot went, and how far to trust them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.lie import SE2
from unifg.models import unicycle
from unifg.typing import Array


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviations that grow with the motion.

    Attributes:
        translation: per metre travelled [m/m].
        rotation: per radian turned [rad/rad].
        drift: per metre travelled, of the heading [rad/m].
        floor: of a step without motion, (x, y, theta) [m, m, rad]: slip, and the time between readings.
    """

    translation: float = 0.07
    rotation: float = 0.07
    drift: float = 0.02
    floor: tuple[float, float, float] = (0.002, 0.002, 0.002)

    def covariance(self, u: Array, dt: float) -> Array:
        """(3, 3) covariance of one step in the frame of its end [m^2, rad^2]."""
        travelled, turned = abs(float(u[0])) * dt, abs(float(u[1])) * dt
        sigma = np.array(self.floor)
        sigma[0] += self.translation * travelled
        sigma[1] += 0.5 * self.translation * travelled * turned + 0.2 * self.translation * travelled
        sigma[2] += self.rotation * turned + self.drift * travelled
        return np.diag(sigma**2)


def predict(pose: Array, covariance: Array, u: Array, dt: float, noise: OdometryNoise) -> tuple[Array, Array]:
    """Move an estimate by measured velocities.

    Args:
        pose: (3,) estimate [m, m, rad].
        covariance: (3, 3) in the tangent space at ``pose``, right perturbation.
        u: (2,) measured v, omega [m/s, rad/s].
        dt: sampling time [s].
        noise: model of the wheels.

    Returns:
        Predicted pose (3,) and covariance (3, 3) in the tangent space there.
    """
    moved = unicycle.step(pose[None, :], np.asarray(u, dtype=np.float64)[None, :], dt)[0]
    transport = SE2.adjoint(SE2.between(moved, pose))
    return moved, transport @ covariance @ transport.T + noise.covariance(u, dt)
