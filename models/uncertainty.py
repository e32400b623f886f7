"""Covariance as a variable of a plan: its recursion along the path, and clearance in standard deviations.

A plan with stochastic motion carries at each node the covariance that a filter will have there. It is a variable like
the pose, stored as the lower triangle of a symmetric matrix, row by row, and its recursion is an equality constraint

    P_k+1 = (M^-1 + H' R^-1 H)^-1 = (I + M L)^-1 M,   M = F P_k F' + Q,   L = H' R^-1 H

of the extended Kalman filter (Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*,
2001, section 10.3), linearised about the planned poses: what is expected to be seen from them is counted, what a plan
costs is not. Without Q the covariance never grows, and a plan learns nothing from it.

Where the robot will be is another question than how well it will know: feedback acts on the estimate, which moves at
each sighting by its innovation. The spread of the estimate about the plan is a second such variable,

    D_k+1 = (F - B K) D_k (F - B K)' + M - P_k+1,

and the truth deviates from the plan by P + D (van den Berg, Abbeel, Goldberg, *LQG-MP*, IJRR 30(7), 2011, section 4).

Everything is plain batched NumPy, to be called from functions that are traced. Errors of a pose lie in its own axes,
X Exp(e), as everywhere in unifg.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from unifg.lie import SE2
from unifg.typing import Array

__all__ = ["confident_clearance", "packed", "pose_recursion", "unpacked", "updated"]

NEAR = 1e-3  # [m]: distances and deviations are rounded off below it, where they have no slope


def packed(matrices: Array) -> Array:
    """(n, d (d + 1) / 2) lower triangles of symmetric matrices (n, d, d), row by row."""
    size = matrices.shape[1]
    return np.stack([matrices[:, i, j] for i in range(size) for j in range(i + 1)], axis=1)


def unpacked(triangles: Array) -> Array:
    """(n, d, d) symmetric matrices of their lower triangles (n, d (d + 1) / 2)."""
    size = int(np.sqrt(2 * triangles.shape[1]))

    def entry(i: int, j: int) -> Array:
        row, column = max(i, j), min(i, j)
        return triangles[:, row * (row + 1) // 2 + column]

    return np.stack([np.stack([entry(i, j) for j in range(size)], axis=1) for i in range(size)], axis=1)


def predicted(covariance: Array, transition: Array, noise: Array) -> Array:
    """(n, d, d) covariance F P F' + Q after a step; all (n, d, d), the noise also (d, d)."""
    return transition @ covariance @ np.swapaxes(transition, 1, 2) + noise


def updated(covariance: Array, information: Array) -> Array:
    """(n, d, d) covariance (P^-1 + L)^-1 after measurements; neither need be invertible. At most four rows trace."""
    return cast(Array, np.linalg.solve(np.eye(covariance.shape[1]) + covariance @ information, covariance))


def pose_transition(x: Array, after: Array) -> Array:
    """(n, 3, 3) F: how errors of poses x (n, 3) in SE(2) arrive at the next ones: the adjoint of after^-1 x."""
    return SE2.adjoint(SE2.between(after, x))


@dataclass(frozen=True)
class BeaconSensor:
    """Bearing and range of beacons that are not too far.

    Attributes:
        sigma_range: standard deviation of a range [m].
        sigma_bearing: of a bearing [rad].
        reach: distance at which every second sighting fails [m].
        softness: over which sightings become rare [m].
    """

    sigma_range: float = 0.1
    sigma_bearing: float = 0.05
    reach: float = 2.5
    softness: float = 0.2

    def chance(self, distance: Array) -> Array:
        """Of a sighting at a distance [m]."""
        return 0.5 - 0.5 * np.tanh(0.5 * (distance - self.reach) / self.softness)


def to_beacon(x: Array, beacon: Array) -> tuple[Array, Array, Array]:
    """Distance (n,) [m] of a beacon (2,) from poses x (n, 3), and where it is in their axes, (n,) and (n,) [m]."""
    cosine, sine = np.cos(x[:, 2]), np.sin(x[:, 2])
    dx, dy = beacon[0] - x[:, 0], beacon[1] - x[:, 1]
    return np.sqrt(dx * dx + dy * dy + NEAR * NEAR), cosine * dx + sine * dy, cosine * dy - sine * dx


def sighting_rows(x: Array, beacon: Array, sensor: BeaconSensor) -> tuple[Array, Array]:
    """Rows (n, 3) of H, whitened: how range and bearing of a beacon (2,) change with the errors of poses x (n, 3)."""
    distance, ahead, aside = to_beacon(x, beacon)
    square, zero = distance * distance, 0.0 * distance
    to_range = np.stack([-ahead / distance, -aside / distance, zero], axis=1) / sensor.sigma_range
    to_bearing = np.stack([aside / square, -ahead / square, zero - 1.0], axis=1) / sensor.sigma_bearing
    return to_range, to_bearing


def expected_information(x: Array, beacons: Array, sensor: BeaconSensor) -> Array:
    """(n, 3, 3) H' R^-1 H that beacons (m, 2) [m] are expected to give at poses x (n, 3)."""
    total = np.zeros((len(x), 3, 3))
    for beacon in beacons:
        chance = sensor.chance(to_beacon(x, beacon)[0])[:, None, None]
        for row in sighting_rows(x, beacon, sensor):
            total = total + chance * row[:, :, None] * row[:, None, :]
    return total


def pose_steering(u: Array, h: Array) -> Array:
    """(n, 3, 2) B: what a change of the controls u = (v, omega) (n, 2), held for h (n, 1) [s], adds to the error.

    To second order in h: a turn also moves the robot aside, and so does speed on an arc.
    """
    step, zero, bent = h[:, 0], 0.0 * h[:, 0], 0.5 * h[:, 0] * h[:, 0]
    rows = ([step, zero], [-bent * u[:, 1], bent * u[:, 0]], [zero, step])
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


class Forecast(NamedTuple):
    """Predicted belief after a step.

    Attributes:
        covariance: (n, 3, 3) of the truth about the estimate.
        spread: (n, 3, 3) of the estimate about the plan.
    """

    covariance: Array
    spread: Array


def pose_forecast(sensor: BeaconSensor) -> Callable[..., Forecast]:
    """``pose_forecast(sensor)(known, x, u, after, h, density, gain, beacons)``: the :class:`Forecast` after a step.

    The filter and the feedback of a unicycle. known: the one before. x, after: poses (n, 3); u: controls (n, 2) [m/s,
    rad/s]; h: (n, 1) duration [s]. density: (3, 3) covariance of the motion noise per second, in the robot's axes.
    gain: (2, 3) of the feedback u - K e on the error e in the axes of the plan. beacons: (m, 2) [m].
    """

    def ahead(
        known: Forecast, x: Array, u: Array, after: Array, h: Array, density: Array, gain: Array, beacons: Array
    ) -> Forecast:
        transition = pose_transition(x, after)
        steered = transition - pose_steering(u, h) @ gain
        before = predicted(known.covariance, transition, h[:, :, None] * density)
        covariance = updated(before, expected_information(after, beacons, sensor))
        return Forecast(covariance, predicted(known.spread, steered, before - covariance))

    return ahead


def pose_recursion(sensor: BeaconSensor) -> Callable[..., Array]:
    """``pose_recursion(sensor)(b, x, u, after, b_after, h, density, gain, beacons)``: defect of a step, (n, 12).

    b, b_after: (n, 12) packed covariances and spreads before and after; the others as for :func:`pose_forecast`.
    """
    ahead = pose_forecast(sensor)

    def defect(
        b: Array,
        x: Array,
        u: Array,
        after: Array,
        b_after: Array,
        h: Array,
        density: Array,
        gain: Array,
        beacons: Array,
    ) -> Array:
        known = Forecast(unpacked(b[:, :6]), unpacked(b[:, 6:]))
        found = ahead(known, x, u, after, h, density, gain, beacons)
        expected: Array = np.concatenate([packed(found.covariance), packed(found.spread)], axis=1)
        return b_after - expected

    return defect


def deviations(P: Array, x: Array, centre: Array) -> Array:
    """(n, m) standard deviation [m] of poses x (n, 3), covariance P (n, 6), in the directions to centres (m, 2)."""
    covariance = unpacked(P)
    offset = x[:, None, :2] - centre
    distance = np.sqrt(np.sum(offset * offset, axis=-1) + NEAR * NEAR)
    nx, ny = offset[:, :, 0] / distance, offset[:, :, 1] / distance
    cosine, sine = np.cos(x[:, 2:3]), np.sin(x[:, 2:3])
    ahead, aside = cosine * nx + sine * ny, cosine * ny - sine * nx
    xx, xy, yy = (covariance[:, i, j][:, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    variance = xx * ahead * ahead + 2.0 * xy * ahead * aside + yy * aside * aside
    found: Array = np.sqrt(np.maximum(variance, 0.0) + NEAR * NEAR)
    return found


def confident_clearance(x: Array, P: Array, centre: Array, radius: Array, k: Array | float) -> Array:
    """Distance of poses x (n, 3) from discs less their radii and k standard deviations, (n, m) [m].

    P: (n, 6) packed covariances. centre: (m, 2), radius: (m,), k: a number.
    """
    offset = x[:, None, :2] - centre
    distance: Array = np.sqrt(np.sum(offset * offset, axis=-1) + NEAR * NEAR)
    return distance - radius - k * deviations(P, x, centre)
