"""Wheel odometry: where the wheels say the robot went, and how far to trust them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unifg.errors import ModelError
from unifg.lie import SE2
from unifg.models import unicycle
from unifg.models.constants import require_constants
from unifg.models.planar import Base
from unifg.typing import Array, ArrayLike

__all__ = ["OdometryNoise", "driven", "held", "predict"]


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviations that grow with the motion.

    Attributes:
        translation: per metre travelled [m/m].
        rotation: per radian turned [rad/rad].
        drift: per metre travelled, of the heading [rad/m].
        floor: of a step without motion, (x, y, theta) [m, m, rad]: slip, and the time between readings.

    Raises:
        ModelError: for one that is negative or not finite.
    """

    translation: float = 0.07
    rotation: float = 0.07
    drift: float = 0.02
    floor: tuple[float, float, float] = (0.002, 0.002, 0.002)

    def __post_init__(self) -> None:
        """Refuse what is no standard deviation."""
        require_constants(self, (), ("translation", "rotation", "drift", "floor"))

    def covariance(self, u: Array, dt: float) -> Array:
        """(3, 3) covariance of one step with body velocities (k,) in the frame of its end [m^2, rad^2]."""
        travelled, turned = math.hypot(*u[:-1].tolist()) * dt, abs(float(u[-1])) * dt
        sigma = np.array(self.floor)
        sigma[0] += self.translation * travelled
        across = 1.0 if len(u) > 2 else 0.2  # wheels that roll ahead do not slide
        sigma[1] += 0.5 * self.translation * travelled * turned + across * self.translation * travelled
        sigma[2] += self.rotation * turned + self.drift * travelled
        return np.diag(sigma**2)


def predict(
    pose: Array, covariance: Array, u: Array, dt: float, noise: OdometryNoise, base: Base = unicycle.BASE
) -> tuple[Array, Array]:
    """Move an estimate by measured velocities.

    Args:
        pose: (3,) estimate [m, m, rad].
        covariance: (3, 3) in the tangent space at ``pose``, right perturbation.
        u: (m,) measured controls: of a unicycle v, omega [m/s, rad/s].
        dt: sampling time [s].
        noise: model of the wheels.
        base: that moves.

    Returns:
        Predicted pose (3,) and covariance (3, 3) in the tangent space there.
    """
    control = np.asarray(u, dtype=np.float64)
    moved = base.step(pose[None, :], control[None, :], dt)[0]
    transport = SE2.adjoint(SE2.between(moved, pose))
    return moved, transport @ covariance @ transport.T + noise.covariance(base.of(control), dt)


def driven(steps: ArrayLike) -> Array:
    """Poses after steps, each an arc of constant curvature, from the identity.

    Args:
        steps: (n, 2) distance and turn of each [m, rad].

    Returns:
        (n + 1, 3) poses x, y, heading [m, m, rad]; the heading is not wrapped.

    Raises:
        ModelError: the array has another shape.
    """
    table = np.asarray(steps, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != 2:
        raise ModelError(f"steps have shape {table.shape}, expected (n, 2): distances and turns")
    heading = np.concatenate([[0.0], np.cumsum(table[:, 1])])
    # An arc is a chord of length s sinc(turn / 2) in the direction half a turn on.
    chord = table[:, 0] * np.sinc(table[:, 1] / (2.0 * np.pi))
    along = heading[:-1] + 0.5 * table[:, 1]
    way = np.cumsum(chord[:, None] * np.column_stack([np.cos(along), np.sin(along)]), axis=0)
    return np.column_stack([np.concatenate([np.zeros((1, 2)), way]), heading])


def held(time: ArrayLike, velocity: ArrayLike, at: ArrayLike) -> Array:
    """Poses under velocities held until the next one, at other times, from the identity at the first of these.

    Args:
        time: (n,) of the velocities, rising [s]; before the first of them nothing moves.
        velocity: (n, 2) forward and turning [m/s, rad/s]; the last one holds on.
        at: (m,) when to look, rising [s].

    Returns:
        (m, 3) poses x, y, heading [m, m, rad]; the heading is not wrapped.

    Raises:
        ModelError: shapes do not fit, or times fall or are no numbers.
    """
    since, speed, when = (np.asarray(part, dtype=np.float64) for part in (time, velocity, at))
    if since.ndim != 1 or speed.shape != (len(since), 2) or when.ndim != 1:
        raise ModelError(
            f"time {since.shape}, velocity {speed.shape} and at {when.shape} must be (n,), (n, 2) and (m,)"
        )
    if not ((np.diff(since) >= 0.0).all() and (np.diff(when) >= 0.0).all()):
        raise ModelError("times of velocities, and those to look at, must be numbers and not fall")
    if not len(when):
        return np.zeros((0, 3))
    inside = since[(since > when[0]) & (since < when[-1])]
    ends = np.unique(np.concatenate([when, inside]))
    valid = np.searchsorted(since, ends[:-1], side="right") - 1
    moving = np.concatenate([np.zeros((1, 2)), speed])[valid + 1]
    path = driven(moving * np.diff(ends)[:, None])
    return path[np.searchsorted(ends, when)]
