"""Residuals of pose graphs that are not Lie-group logarithms: g2o's own chart, and sightings of landmarks.

Jacobians are in right perturbation, X Exp(d), as everywhere.
"""

from __future__ import annotations

import numpy as np

from unifg.factors import ManifoldResidual
from unifg.lie import SE2, LieGroup, Manifold, wrap_angle
from unifg.residuals import Residual, residual
from unifg.typing import Array

__all__ = ["bearing", "bearing_range", "chart_between", "distance", "sighting"]


class _PlanarChart:
    """(dx, dy, dtheta) of Z^-1 Xi^-1 Xj; picklable."""

    def __call__(self, x: Array, y: Array, measured: Array) -> Array:
        return SE2.between(measured, SE2.between(x, y))

    def jacobian(self, x: Array, y: Array, measured: Array) -> list[Array]:
        error = self(x, y, measured)
        after = np.zeros((len(error), 3, 3))
        after[:, :2, :2] = SE2.matrix(error)[:, :2, :2]
        after[:, 2, 2] = 1.0
        return [-after @ SE2.adjoint(SE2.between(y, x)), after]


class _SpatialChart:
    """Translation and vector part of the quaternion, scalar part positive, of Z^-1 Xi^-1 Xj; picklable."""

    def __init__(self, group: LieGroup) -> None:
        self.group = group

    def __call__(self, x: Array, y: Array, measured: Array) -> Array:
        error = self._error(x, y, measured)
        positions = error[:, :3]
        return np.concatenate([positions, error[:, 4:] * _sign(error)], axis=1)

    def jacobian(self, x: Array, y: Array, measured: Array) -> list[Array]:
        group, error = self.group, self._error(x, y, measured)
        sign = _sign(error)
        w, vx, vy, vz = 0.5 * sign.T * error[:, 3:].T
        after = np.zeros((len(error), 6, 6))
        after[:, :3, :3] = group.matrix(error)[:, :3, :3]
        # q (1, d/2) has the vector part v + (w I + [v]x) d / 2.
        after[:, 3, 3], after[:, 3, 4], after[:, 3, 5] = w, -vz, vy
        after[:, 4, 3], after[:, 4, 4], after[:, 4, 5] = vz, w, -vx
        after[:, 5, 3], after[:, 5, 4], after[:, 5, 5] = -vy, vx, w
        return [-after @ group.adjoint(group.between(y, x)), after]

    def _error(self, x: Array, y: Array, measured: Array) -> Array:
        return self.group.between(measured, self.group.between(x, y))


def _sign(error: Array) -> Array:
    """(n, 1) factor that makes the scalar part of the quaternions non-negative."""
    return np.where(error[:, 3:4] < 0.0, -1.0, 1.0)


def _build_chart(manifold: Manifold) -> Residual:
    if manifold.name == "SE2":
        planar = _PlanarChart()
        return Residual(planar, planar.jacobian, "chart between")
    if manifold.name == "SE3" and isinstance(manifold, LieGroup):
        spatial = _SpatialChart(manifold)
        return Residual(spatial, spatial.jacobian, "chart between")
    raise TypeError(f"chart_between needs poses in SE2 or SE3, found {manifold.name}; use between")


chart_between = ManifoldResidual("chart between", _build_chart)
"""``chart_between(x, y, measured)``: the residual of g2o's EdgeSE2 and EdgeSE3.

With E = measured^-1 x^-1 y it is (dx, dy, dtheta) of E in the plane and, in space, E's translation and the vector part
of its quaternion, which is half the angle for small angles. ``between`` is the logarithm of E instead: equal to first
order in the plane, not in space. measured is (storage,) or (n, storage).
"""


class _Sighting:
    """The landmark in the frame of the pose, less where it was seen; picklable."""

    def __init__(self, group: LieGroup) -> None:
        self.group = group

    def __call__(self, pose: Array, landmark: Array, measured: Array) -> Array:
        return self.group.act(self.group.inverse(pose), landmark) - measured

    def jacobian(self, pose: Array, landmark: Array, measured: Array) -> list[Array]:
        return _local_jacobian(self.group, pose, landmark)


def _build_sighting(manifold: Manifold) -> Residual:
    if not isinstance(manifold, LieGroup) or manifold.name not in ("SE2", "SE3"):
        raise TypeError(f"sighting needs poses in SE2 or SE3, found {manifold.name}")
    function = _Sighting(manifold)
    return Residual(function, function.jacobian, "sighting")


sighting = ManifoldResidual("sighting", _build_sighting)
"""``sighting(pose, landmark, measured)``: pose^-1 landmark - measured [m], in the plane or in space."""


def _local_jacobian(group: LieGroup, pose: Array, landmark: Array) -> list[Array]:
    """Derivatives of p = pose^-1 landmark: [-I, -[1]x p] or [-I, [p]x], and R'."""
    size = landmark.shape[1]
    local = group.act(group.inverse(pose), landmark)
    by_pose = np.zeros((len(local), size, group.dim))
    by_pose[:, :, :size] = -np.eye(size)
    if size == 2:
        by_pose[:, 0, 2], by_pose[:, 1, 2] = local[:, 1], -local[:, 0]
    else:
        px, py, pz = local.T
        by_pose[:, 0, 4], by_pose[:, 0, 5] = -pz, py
        by_pose[:, 1, 3], by_pose[:, 1, 5] = pz, -px
        by_pose[:, 2, 3], by_pose[:, 2, 4] = -py, px
    rotation = group.matrix(pose)[:, :size, :size]
    return [by_pose, np.swapaxes(rotation, 1, 2)]


def _polar(pose: Array, landmark: Array) -> tuple[Array, Array, Array]:
    """(n, 2) the landmark in the frame of the pose, (n,) its bearing [rad] and distance [m]."""
    local = SE2.act(SE2.inverse(pose), landmark)
    return local, np.arctan2(local[:, 1], local[:, 0]), np.hypot(local[:, 0], local[:, 1])


def _polar_jacobian(pose: Array, landmark: Array) -> list[Array]:
    """Derivatives (n, 2, d) of (bearing, distance) by pose and landmark."""
    local, _, distances = _polar(pose, landmark)
    x, y = (local / distances[:, None]).T
    outer = np.empty((len(local), 2, 2))
    outer[:, 0, 0], outer[:, 0, 1] = -y / distances, x / distances
    outer[:, 1, 0], outer[:, 1, 1] = x, y
    return [outer @ block for block in _local_jacobian(SE2, pose, landmark)]


def _bearing(pose: Array, landmark: Array, measured: Array) -> Array:
    return wrap_angle(_polar(pose, landmark)[1][:, None] - measured)


def _bearing_jacobian(pose: Array, landmark: Array, measured: Array) -> list[Array]:
    return [block[:, :1] for block in _polar_jacobian(pose, landmark)]


def _distance(pose: Array, landmark: Array, measured: Array) -> Array:
    return _polar(pose, landmark)[2][:, None] - measured


def _distance_jacobian(pose: Array, landmark: Array, measured: Array) -> list[Array]:
    return [block[:, 1:] for block in _polar_jacobian(pose, landmark)]


def _bearing_range(pose: Array, landmark: Array, measured: Array) -> Array:
    error: Array = np.stack(_polar(pose, landmark)[1:], axis=1) - measured
    error[:, 0] = wrap_angle(error[:, 0])
    return error


def _bearing_range_jacobian(pose: Array, landmark: Array, measured: Array) -> list[Array]:
    return _polar_jacobian(pose, landmark)


bearing = residual(_bearing, _bearing_jacobian, "bearing")
"""``bearing(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 1) [rad], wrapped."""

distance = residual(_distance, _distance_jacobian, "distance")
"""``distance(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 1) [m]."""

bearing_range = residual(_bearing_range, _bearing_range_jacobian, "bearing and range")
"""``bearing_range(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 2) [rad, m]."""
