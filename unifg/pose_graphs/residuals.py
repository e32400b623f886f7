"""Residuals of pose graphs that are not Lie-group logarithms: g2o's own chart, and sightings of landmarks.

Jacobians are in right perturbation, X Exp(d), as everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

from unifg.errors import GraphError
from unifg.kernels.kernel import Kernel
from unifg.kernels.residuals import Residual, residual
from unifg.language.factors import ManifoldResidual
from unifg.lie import SE2, SE3, LieGroup, Manifold, Rn
from unifg.lie.functions import Functions, functions_of
from unifg.lie.so2 import wrap
from unifg.machine.calls import local_matrix, local_vector, vector
from unifg.machine.jit import compiled
from unifg.typing import Array

__all__ = ["bearing", "bearing_range", "chart_between", "distance", "sighting"]


# ---------------------------------------------------------------- g2o's chart


@compiled
def _planar_chart(error: Array, r: Array, after: Array) -> None:
    """(dx, dy, dtheta) of E and its derivative along E Exp(d)."""
    for k in range(3):
        r[k] = error[k]
    if len(after):
        c, s = math.cos(error[2]), math.sin(error[2])
        after[:] = 0.0
        after[0, 0], after[0, 1], after[1, 0], after[1, 1] = c, -s, s, c
        after[2, 2] = 1.0


def _spatial_chart_of(functions: Functions) -> Callable[..., None]:
    """Translation and vector part of the quaternion, scalar part positive, of E, and its derivative along E Exp(d)."""
    homogeneous = functions.matrix

    @compiled
    def chart(error: Array, r: Array, after: Array) -> None:
        sign = -1.0 if error[3] < 0.0 else 1.0
        for k in range(3):
            r[k] = error[k]
            r[3 + k] = sign * error[4 + k]
        if len(after):
            pose = local_matrix(4, 4)
            homogeneous(error, pose)
            w, x, y, z = 0.5 * sign * error[3], 0.5 * r[3], 0.5 * r[4], 0.5 * r[5]
            after[:] = 0.0
            for i in range(3):
                for k in range(3):
                    after[i, k] = pose[i, k]
            # q (1, d/2) has the vector part v + (w I + [v]x) d / 2.
            after[3, 3], after[3, 4], after[3, 5] = w, -z, y
            after[4, 3], after[4, 4], after[4, 5] = z, w, -x
            after[5, 3], after[5, 4], after[5, 5] = -y, x, w

    return chart


def _relative(group: LieGroup, functions: Functions, chart: Callable[..., None]) -> Callable[..., None]:
    """A chart of measured^-1 x^-1 y."""
    storage, dim = group.storage, group.dim
    between, adjoint = functions.between, functions.adjoint

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        x, y = vector(v, 0, storage), vector(v, storage, storage)
        seen, error = local_vector(storage), local_vector(storage)
        between(x, y, seen)
        between(p, seen, error)
        if len(J) == 0:
            chart(error, r, J)
            return
        after, transport = local_matrix(dim, dim), local_matrix(dim, dim)
        chart(error, r, after)
        between(y, x, seen)
        adjoint(seen, transport)
        for i in range(dim):
            for k in range(dim):
                total = 0.0
                for j in range(dim):
                    total += after[i, j] * transport[j, k]
                J[i, k] = -total
                J[i, dim + k] = after[i, k]

    return kernel


@cache
def _chart_kernel(space: bool) -> Kernel:
    group: LieGroup = SE3 if space else SE2
    functions = functions_of(group)
    assert functions is not None
    chart = _spatial_chart_of(functions) if space else _planar_chart
    arguments = (group, group, (group.storage,))
    return Kernel(_relative(group, functions, chart), arguments, group.dim, name="chart between")


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
    error: Array = pose[:, :2] - measured
    return error


position = residual(_position, name="position")


# ---------------------------------------------------------------- sightings


@compiled
def _planar_local(v: Array, local: Array, J: Array) -> None:
    """Write p = pose^-1 landmark in the plane; derivatives [-I, -[1]x p] and R'."""
    c, s = math.cos(v[2]), math.sin(v[2])
    dx, dy = v[3] - v[0], v[4] - v[1]
    local[0], local[1] = c * dx + s * dy, c * dy - s * dx
    if len(J):
        J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4] = -1.0, 0.0, local[1], c, s
        J[1, 0], J[1, 1], J[1, 2], J[1, 3], J[1, 4] = 0.0, -1.0, -local[0], -s, c


@compiled
def _planar_sighting(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """The landmark in the frame of the pose, less where it was seen."""
    _planar_local(v, r, J)
    r[0] -= p[0]
    r[1] -= p[1]


def _spatial_sighting(functions: Functions) -> Callable[..., None]:
    """The same in space; derivatives [-I, [p]x] and R'."""
    homogeneous = functions.matrix

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        pose = local_matrix(4, 4)
        homogeneous(vector(v, 0, 7), pose)
        for i in range(3):
            r[i] = 0.0
            for k in range(3):
                r[i] += pose[k, i] * (v[7 + k] - pose[k, 3])
        if len(J):
            J[:] = 0.0
            x, y, z = r[0], r[1], r[2]
            J[0, 0] = J[1, 1] = J[2, 2] = -1.0
            J[0, 4], J[0, 5], J[1, 3], J[1, 5], J[2, 3], J[2, 4] = -z, y, z, -x, -y, x
            for i in range(3):
                for k in range(3):
                    J[i, 6 + k] = pose[k, i]
        for i in range(3):
            r[i] -= p[i]

    return kernel


@cache
def _sighting_kernel(space: bool) -> Kernel:
    if not space:
        return Kernel(_planar_sighting, (SE2, Rn(2), (2,)), 2, name="sighting")
    functions = functions_of(SE3)
    assert functions is not None
    return Kernel(_spatial_sighting(functions), (SE3, Rn(3), (3,)), 3, name="sighting")


def _build_sighting(manifold: Manifold) -> Residual:
    if manifold not in (SE2, SE3):
        raise GraphError(f"sighting needs poses in SE2 or SE3, found {manifold.name}")
    return residual(_sighting_kernel(manifold == SE3))


sighting = ManifoldResidual(
    "sighting",
    _build_sighting,
    """``sighting(pose, landmark, measured)``: pose^-1 landmark - measured [m], in the plane or in space.""",
)


@compiled
def _polar(v: Array, J: Array, row: int, of_bearing: bool) -> float:
    """Bearing [rad] or distance [m] of the landmark, and its derivatives in a row of J."""
    local, by = local_vector(2), local_matrix(2, 5)
    _planar_local(v, local, by)
    x, y = local[0], local[1]
    length = math.hypot(x, y)
    if len(J):
        first, second = (-y / (length * length), x / (length * length)) if of_bearing else (x / length, y / length)
        for d in range(5):
            J[row, d] = first * by[0, d] + second * by[1, d]
    return math.atan2(y, x) if of_bearing else length


@compiled
def _bearing(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    r[0] = wrap(_polar(v, J, 0, True) - p[0])


@compiled
def _distance(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    r[0] = _polar(v, J, 0, False) - p[0]


@compiled
def _bearing_range(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    r[0] = wrap(_polar(v, J, 0, True) - p[0])
    r[1] = _polar(v, J, 1, False) - p[1]


bearing = residual(
    Kernel(_bearing, (SE2, Rn(2), (1,)), 1, name="bearing"),
    about="""``bearing(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 1) [rad], wrapped.""",
)

distance = residual(
    Kernel(_distance, (SE2, Rn(2), (1,)), 1, name="distance"),
    about="""``distance(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 1) [m].""",
)

bearing_range = residual(
    Kernel(_bearing_range, (SE2, Rn(2), (2,)), 2, name="bearing and range"),
    about="""``bearing_range(pose, landmark, measured)``: SE2 poses, points in the plane, measured (n, 2) [rad, m].""",
)
