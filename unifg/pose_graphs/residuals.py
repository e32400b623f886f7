"""Residuals of pose graphs that are not Lie-group logarithms: g2o's own chart, and sightings of landmarks.

Derivatives are derived; Jacobians are in right perturbation, X Exp(d), as everywhere.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from unifg.errors import GraphError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE2, SE3, Manifold, Rn, wrap_angle
from unifg.modeling.factors import ManifoldResidual
from unifg.typing import Array

__all__ = ["bearing", "bearing_range", "chart_between", "distance", "sighting"]


# ---------------------------------------------------------------- g2o's chart


def _planar_chart(x: Array, y: Array, measured: Array) -> Array:
    """(dx, dy, dtheta) of measured^-1 x^-1 y."""
    return SE2.between(measured, SE2.between(x, y))


def _spatial_chart(x: Array, y: Array, measured: Array) -> Array:
    """Translation and vector part of the quaternion, scalar part positive, of measured^-1 x^-1 y."""
    error = SE3.between(measured, SE3.between(x, y))
    sign = np.where(error[:, 3:4] < 0.0, -1.0, 1.0)
    return np.concatenate([error[:, :3], sign * error[:, 4:]], axis=1)


@cache
def _chart_kernel(space: bool) -> Kernel:
    function, group = (_spatial_chart, SE3) if space else (_planar_chart, SE2)
    return StatedKernel(function, (group, group, (group.storage,)), group.dim, name="chart between")


def _build_chart(manifold: Manifold) -> Residual:
    if manifold not in (SE2, SE3):
        raise GraphError(f"chart_between needs poses in SE2 or SE3, found {manifold.name}; use between")
    elements = tuple((place, manifold) for place in range(3))
    return replace(residual(_chart_kernel(manifold == SE3)), elements=elements)


chart_between = ManifoldResidual(
    "chart between",
    _build_chart,
    """``chart_between(x, y, measured)``: the residual of g2o's EdgeSE2 and EdgeSE3.

With E = measured^-1 x^-1 y it is (dx, dy, dtheta) of E in the plane and, in space, E's translation and the vector part
of its quaternion, which is half the angle for small angles. ``between`` is the logarithm of E instead: equal to first
order in the plane, not in space. measured is (storage,) or (n, storage).
""",
)


def _position(pose: Array, measured: Array) -> Array:
    """Position (n, 2) of planar poses (n, 3) less what was measured (n, 2) [m]: g2o's EdgeSE2XYPrior."""
    return pose[:, :2] - measured


position = residual(_position, name="position")


# ---------------------------------------------------------------- sightings


def _planar_local(pose: Array, landmark: Array) -> tuple[Array, Array]:
    """Ahead and to the left of a planar pose [m]."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    dx, dy = landmark[:, 0] - pose[:, 0], landmark[:, 1] - pose[:, 1]
    return c * dx + s * dy, c * dy - s * dx


def _planar_sighting(pose: Array, landmark: Array, measured: Array) -> Array:
    """The landmark in the frame of the pose, less where it was seen."""
    ahead, aside = _planar_local(pose, landmark)
    return np.stack([ahead - measured[:, 0], aside - measured[:, 1]], axis=1)


def _spatial_sighting(pose: Array, landmark: Array, measured: Array) -> Array:
    """The same in space."""
    turn, away = SE3.matrix(pose), landmark - pose[:, :3]
    local = [turn[:, 0, k] * away[:, 0] + turn[:, 1, k] * away[:, 1] + turn[:, 2, k] * away[:, 2] for k in range(3)]
    return np.stack([local[k] - measured[:, k] for k in range(3)], axis=1)


@cache
def _sighting_kernel(space: bool) -> Kernel:
    function, group, size = (_spatial_sighting, SE3, 3) if space else (_planar_sighting, SE2, 2)
    return StatedKernel(function, (group, Rn(size), (size,)), size, name="sighting")


def _build_sighting(manifold: Manifold) -> Residual:
    if manifold not in (SE2, SE3):
        raise GraphError(f"sighting needs poses in SE2 or SE3, found {manifold.name}")
    return residual(_sighting_kernel(manifold == SE3))


sighting = ManifoldResidual(
    "sighting",
    _build_sighting,
    """``sighting(pose, landmark, measured)``: pose^-1 landmark - measured [m], in the plane or in space.""",
)


def _bearing(pose: Array, landmark: Array, measured: Array) -> Array:
    ahead, aside = _planar_local(pose, landmark)
    return wrap_angle(np.arctan2(aside, ahead) - measured[:, 0])[:, None]


def _distance(pose: Array, landmark: Array, measured: Array) -> Array:
    dx, dy = landmark[:, 0] - pose[:, 0], landmark[:, 1] - pose[:, 1]
    away: Array = np.sqrt(dx * dx + dy * dy) - measured[:, 0]
    return away[:, None]


def _bearing_range(pose: Array, landmark: Array, measured: Array) -> Array:
    parts = _bearing(pose, landmark, measured[:, :1]), _distance(pose, landmark, measured[:, 1:])
    return np.concatenate(parts, axis=1)


bearing = residual(
    StatedKernel(_bearing, (SE2, Rn(2), (1,)), 1, name="bearing"),
    about="""``bearing(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 1) [rad], wrapped.""",
)

distance = residual(
    StatedKernel(_distance, (SE2, Rn(2), (1,)), 1, name="distance"),
    about="""``distance(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 1) [m].""",
)

bearing_range = residual(
    StatedKernel(_bearing_range, (SE2, Rn(2), (2,)), 2, name="bearing and range"),
    about="""``bearing_range(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 2) [rad, m].""",
)
