"""Bearing and range of landmarks in space, as a camera with depth, a radar or a sonar see them.

A bearing is a unit vector in the axes of the sensor. What it differs by from the direction of the landmark is the step
on the sphere from the one to the other, two numbers in the plane that touches it at the measured direction [rad]. Their
length is the angle between the two: there is no pole, and no elevation at which an azimuth loses its meaning. For a
sensor that is kept level :mod:`unifg.models.landmarks` has bearing and range in the plane (Ta et al. 2014, eq. 7).

The sensor stands on the body, at ``body_T_sensor``. Noise is alike in both directions across the bearing; the axes of
the plane are those of Duff et al. 2017, *Building an orthonormal basis, revisited*. At zero range there is no
direction, and the residual is not finite, nor is it where the measured direction has no length: a solve refuses such a
factor by its term and number, unless it is inactive. A landmark straight behind the measured direction is half a turn
off.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache
from typing import Any, cast

import numpy as np

from unifg.errors import ModelError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE3, SO3, Manifold, Rn
from unifg.models.rigid import pose_parts
from unifg.typing import Array, ArrayLike

__all__ = ["bearing_3d", "bearing_range_3d", "observe_3d"]

_TAKES = "in W_T_B", "in W", "in S"
ACROSS = 1e-12  # sine below which a direction straight behind is taken to be off along the first axis


def bearing_range_3d(state: Manifold = SE3, body_T_sensor: ArrayLike | None = None) -> Residual:
    """``bearing_range_3d()(x, l, z)``: bearing [rad, rad] and range [m] of landmarks l, less those measured, (n, 3).

    z is (4,) or (n, 4): the measured direction in the sensor's axes, of any length but zero, and the range [m].

    Args:
        state: of x: SE3, SE23, or a product with components p and R, or pose.
        body_T_sensor: (7,) place of the sensor on the body, an element of SE3; by default its axes are the body's.

    Raises:
        ModelError: for another manifold, or a place that is none.
    """
    return residual(_kernel(cast(Hashable, state), _mounted(body_T_sensor), True), takes=_TAKES)


def bearing_3d(state: Manifold = SE3, body_T_sensor: ArrayLike | None = None) -> Residual:
    """``bearing_3d()(x, l, z)``: the bearing alone, (n, 2) [rad, rad], of a camera; z is (3,) or (n, 3).

    Args:
        state: as for :func:`bearing_range_3d`.
        body_T_sensor: as for :func:`bearing_range_3d`.

    Raises:
        ModelError: for another manifold, or a place that is none.
    """
    return residual(_kernel(cast(Hashable, state), _mounted(body_T_sensor), False), takes=_TAKES)


def observe_3d(
    x: ArrayLike, landmarks: ArrayLike, state: Manifold = SE3, body_T_sensor: ArrayLike | None = None
) -> Array:
    """Measure landmarks without noise: (M, 4) unit vectors in the sensor's axes, and ranges [m].

    Args:
        x: (storage,) state.
        landmarks: (M, 3) places [m].
        state: of x.
        body_T_sensor: (7,) place of the sensor on the body.

    Raises:
        ModelError: for another manifold, on another shape, or a place that is none.
    """
    p, R = pose_parts(state, "observe_3d")
    at, places = np.asarray(x, dtype=np.float64)[None], np.asarray(landmarks, dtype=np.float64)
    if at.shape != (1, state.storage) or (places.size and places.shape[-1] != 3):
        raise ModelError(f"observe_3d: a state ({state.storage},), places (M, 3); found {at.shape[1:]}, {places.shape}")
    places = places.reshape(-1, 3)
    seen = _sensor(at[:, p], at[:, R], places, _mounted(body_T_sensor))
    distance = np.linalg.norm(seen, axis=1, keepdims=True)
    return np.concatenate([seen / distance, distance], axis=1)


def _mounted(body_T_sensor: ArrayLike | None) -> tuple[float, ...] | None:
    """The place of a sensor, as a value; None where it is the body's."""
    if body_T_sensor is None:
        return None
    place = np.asarray(body_T_sensor, dtype=np.float64)
    if place.shape != (7,) or not bool(SE3.is_valid(place)):
        raise ModelError(f"body_T_sensor must be an element of SE3, (7,), found {place}")
    return tuple(place.tolist())


def _sensor(p: Array, R: Array, l: Array, mount: tuple[float, ...] | None) -> Array:  # noqa: E741
    """(n, 3) landmarks in the axes of the sensor; places differ before anything is turned."""
    body = SO3.act(SO3.inverse(R), l - p)
    if mount is None:
        return body
    back = SO3.inverse(np.array(mount[3:]))
    return SO3.act(back, body - np.array(mount[:3]))


def _off(seen: Array, measured: Array) -> Array:
    """(n, 2) the step on the sphere from a measured direction to the one in which something is seen."""
    length = np.linalg.norm(measured, axis=1)
    x, y, z = (measured[:, k] / length for k in range(3))
    distance = np.linalg.norm(seen, axis=1)
    u, v, w = (seen[:, k] / distance for k in range(3))
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = (1.0 + sign * x * x * a) * u + sign * b * v - sign * x * w
    second = b * u + (sign + y * y * a) * v - y * w
    near = 0.5 * ((x + u) ** 2 + (y + v) ** 2 + (z + w) ** 2)  # 1 + cos t, with its digits at t = pi
    behind = (near < 1.0) & (first * first + second * second < ACROSS * ACROSS)
    first = np.where(behind, ACROSS, first)
    # The turn by t about an axis across has the quaternion (1 + cos t, sin t axis), up to its length.
    turn = SO3.log(np.stack([near, first, second, 0.0 * near], axis=1))
    return turn[:, :2]


@cache
def _kernel(manifold: Hashable, mount: tuple[float, ...] | None, ranging: bool) -> StatedKernel:
    state = cast(Manifold, manifold)
    p, R = pose_parts(state, "a bearing in space")

    def bearing_in_space(x: Array, l: Array, z: Array) -> Array:  # noqa: E741
        return _off(_sensor(x[:, p], x[:, R], l, mount), z)

    def bearing_and_range_in_space(x: Array, l: Array, z: Array) -> Array:  # noqa: E741
        seen = _sensor(x[:, p], x[:, R], l, mount)
        distance = np.linalg.norm(seen, axis=1) - z[:, 3]
        return np.concatenate([_off(seen, z[:, :3]), distance[:, None]], axis=1)

    function: Callable[..., Any] = bearing_and_range_in_space if ranging else bearing_in_space
    name = "bearing and range in space" if ranging else "bearing in space"
    return StatedKernel(function, (state, Rn(3), (4,) if ranging else (3,)), 3 if ranging else 2, name=name)
