"""Keeping off things that stand upright, as a constraint and as Ta's potential (Ta et al. 2014, section V).

Clearances are residuals on positions (n, 3), as ``x.p`` of a quadrotor: to be held at ``lower=0``, or to be made a
cost. Those of cylinders, landmarks and walls are measured in the ground plane; the obstacles have no top.

Ta's potential is 1/d. It has a pole at the surface and, read literally, is negative inside, where a solver that steps
across is drawn further in. Below a small distance d0 it is continued by its own parabola,

    phi(d) = 1/d  for d >= d0,    1/d0 - (d - d0)/d0^2 + (d - d0)^2/d0^3  for d < d0,

which is finite, twice continuously differentiable, and pushes out the harder the deeper. It is a cost and no barrier:
solutions closer than d0, inside among them, are possible, and only a constraint forbids them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from unifg.codegen.jit import compiled, inlined
from unifg.errors import GraphError, ModelError
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import Rn
from unifg.models.profile import of_distance
from unifg.typing import Array

__all__ = [
    "cylinder_clearance",
    "inverse_distance",
    "inverse_distance_root",
    "landmark_clearance",
    "segment_clearance",
    "sphere_clearance",
]

Towards: TypeAlias = tuple[float, float, float, bool]

NEAR = 1e-9  # below this distance the direction is undefined; gradient and curvature are taken as zero


@inlined
def _length(x: float, y: float, z: float) -> float:
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _bend(x: float, y: float, z: float, space: bool, weight: float, S: Array) -> None:
    """Add to the upper triangle of S the Hessian of the weighted length of a vector, in the plane or in space."""
    square = x * x + y * y + z * z
    length = math.sqrt(square)
    if length < NEAR:
        return
    scale = weight / (square * length)
    S[0, 0] += scale * (y * y + z * z)
    S[0, 1] -= scale * x * y
    S[1, 1] += scale * (x * x + z * z)
    if space:
        S[0, 2] -= scale * x * z
        S[1, 2] -= scale * y * z
        S[2, 2] += scale * (x * x + y * y)


@compiled
def _clear(S: Array) -> None:
    for i in range(len(S)):
        for k in range(len(S)):
            S[i, k] = 0.0


def _clearance(
    name: str, towards: Callable[..., Towards], space: bool, shape: tuple[int, ...], rows: Callable[..., int]
) -> Kernel:
    """Distance of a position to many things, less a margin for each.

    Args:
        name: for messages.
        towards: compiled; of position, parameters and the number of a thing, the vector from its nearest point to the
            position, and whether that point stays where it is as the position moves.
        space: whether things stand in space; in the ground plane the vector has no third entry.
        shape: of the numbers that stand for a thing; margins come after all things.
        rows: from the shapes of both to the number of things.
    """
    width = math.prod(shape)

    @compiled
    def first(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        count = len(r)
        for k in range(count):
            x, y, z, _ = towards(v, p, k)
            length = _length(x, y, z)
            r[k] = length - p[width * count + k]
            if len(J):
                per = 1.0 / max(length, NEAR)
                J[k, 0], J[k, 1], J[k, 2] = per * x, per * y, per * z

    @compiled
    def second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
        _clear(S)
        for k in range(len(w)):
            x, y, z, fixed = towards(v, p, k)
            if fixed:
                _bend(x, y, z, space, w[k], S)
        S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]

    return Kernel(first, (Rn(3), 1 + len(shape), 1), rows, name=name, second=second)


# ---------------------------------------------------------------- cylinders


@inlined
def _to_cylinder(v: Array, p: Array, k: int) -> Towards:
    return v[0] - p[2 * k], v[1] - p[2 * k + 1], 0.0, True


def _round(name: str, dimension: int) -> Callable[..., int]:
    """Check the shapes of centres and radii for one position; the number of obstacles."""

    def rows(centre: tuple[int, ...], radius: tuple[int, ...]) -> int:
        if centre != (*radius, dimension):
            raise GraphError(
                f"{name}: centre must be (M, {dimension}) or (n, M, {dimension}) and radius (M,) or (n, M), found "
                f"{centre} and {radius} for each position"
            )
        return centre[0]

    return rows


cylinder_clearance = residual(
    _clearance("cylinder clearance", _to_cylinder, False, (2,), _round("cylinder clearance", 2)),
    about="""``cylinder_clearance(p, centre, radius)``: |(p_x, p_y) - c| - radius [m], one column per cylinder, (n, M).

p: (n, 3) positions. centre: (M, 2), or (n, M, 2) for moving ones. radius: (M,) or (n, M), with the vehicle's added.
""",
)


# ---------------------------------------------------------------- one landmark, itself unknown


@compiled
def _landmark(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    x, y = v[0] - v[3], v[1] - v[4]
    length = _length(x, y, 0.0)
    r[0] = length - p[0]
    if len(J):
        per = 1.0 / max(length, NEAR)
        x, y = per * x, per * y
        J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4] = x, y, 0.0, -x, -y


@compiled
def _landmark_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    _clear(S)
    _bend(v[0] - v[3], v[1] - v[4], 0.0, False, w[0], S)
    S[1, 0] = S[0, 1]
    for i in range(2):
        for k in range(2):
            S[3 + i, 3 + k] = S[i, k]
            S[i, 3 + k] = S[3 + i, k] = -S[i, k]


landmark_clearance = residual(
    Kernel(_landmark, (Rn(3), Rn(2), 0), 1, name="landmark clearance", second=_landmark_second),
    about="""``landmark_clearance(p, l, radius)``: |(p_x, p_y) - l| - radius [m], (n, 1).

p: (n, 3) positions. l: (n, 2) centres of cylinders, variables of the map or constants. radius: a number or (n,).
""",
)


# ---------------------------------------------------------------- walls


@compiled
def _to_segment(v: Array, p: Array, k: int) -> Towards:
    ax, ay, bx, by = p[4 * k], p[4 * k + 1], p[4 * k + 2], p[4 * k + 3]
    ex, ey, x, y = bx - ax, by - ay, v[0] - ax, v[1] - ay
    square = ex * ex + ey * ey
    along = ex * x + ey * y
    if not along > 0.0 or square == 0.0:
        return x, y, 0.0, True
    if along >= square:
        return v[0] - bx, v[1] - by, 0.0, True
    across = (ex * y - ey * x) / square  # what is along the wall cancels without a remainder
    return -across * ey, across * ex, 0.0, False


def _segments(segments: tuple[int, ...], margin: tuple[int, ...]) -> int:
    if segments != (*margin, 2, 2):
        raise GraphError(
            "segment clearance: segments must be (W, 2, 2) or (n, W, 2, 2) and margin (W,) or (n, W), found "
            f"{segments} and {margin} for each position"
        )
    return segments[0]


segment_clearance = residual(
    _clearance("segment clearance", _to_segment, False, (2, 2), _segments),
    about="""
``segment_clearance(p, segments, margin)``: distance to walls less a margin [m], one column per wall, (n, W).

p: (n, 3) positions. segments: (W, 2, 2) end points of upright walls without thickness; margin: (W,). The distance has
no sign: a wall holds between nodes only if no step is longer than twice the margin.
""",
)


# ---------------------------------------------------------------- spheres


@inlined
def _to_sphere(v: Array, p: Array, k: int) -> Towards:
    return v[0] - p[3 * k], v[1] - p[3 * k + 1], v[2] - p[3 * k + 2], True


sphere_clearance = residual(
    _clearance("sphere clearance", _to_sphere, True, (3,), _round("sphere clearance", 3)),
    about="""
``sphere_clearance(p, centre, radius)``: |p - c| - radius [m] in space, (n, M), for centres (M, 3), radii (M,).""",
)


# ---------------------------------------------------------------- one over the distance


@compiled
def _potential(d: float, nearest: float) -> tuple[float, float, float]:
    """Return phi, phi' and phi''."""
    if d >= nearest:
        per = 1.0 / d
        return per, -per * per, 2.0 * per * per * per
    per = 1.0 / nearest
    depth = per * (d - nearest)
    return per * (1.0 - depth + depth * depth), per * per * (2.0 * depth - 1.0), 2.0 * per * per * per


@compiled
def _root(d: float, numbers: Array) -> tuple[float, float, float]:
    """Return rho = sqrt(2 phi), rho' and rho''; the number is d0."""
    value, slope, curvature = _potential(d, numbers[0])
    rho = math.sqrt(2.0 * value)
    return rho, slope / rho, (curvature - slope * slope / (rho * rho)) / rho


def inverse_distance_root(clearance: Residual, nearest: float = 0.1) -> Residual:
    """Ta's potential as least squares: sqrt(2 phi(d)), same shape as the clearance, so that 1/2 r^2 = phi(d).

    It is the same objective as :func:`inverse_distance`, with derivatives in closed form, and any backend takes it.
    A sigma of s weighs 1/d with 1/s^2.

    Args:
        clearance: d, one of those of this module, or any compiled residual with a second derivative.
        nearest: d0, where the parabola takes over [m].

    Raises:
        ModelError: when ``nearest`` is not positive, or the clearance is not compiled.
    """
    if not nearest > 0.0:
        raise ModelError(f"1/d needs a positive distance where its parabola takes over, found nearest={nearest}")
    kernel = clearance.kernel
    if kernel is None or kernel.second is None:
        raise ModelError(f"1/d needs a compiled clearance with a second derivative, found '{clearance.name}'")
    return of_distance(clearance, _root, [nearest], f"root of 1/{clearance.name}", twice=True)


def inverse_distance(clearance: Residual, nearest: float = 0.1, weight: float = 1.0) -> Callable[..., Array]:
    """Ta's potential for ``minimize_scalar``: weight times the sum of phi(d) over the columns of a clearance, (n,).

    Args:
        clearance: d, one of those of this module.
        nearest: d0, where the parabola takes over [m].
        weight: factor [m].

    Raises:
        ModelError: when ``nearest`` is not positive, or the clearance is not compiled.
    """
    root = inverse_distance_root(clearance, nearest)
    half = 0.5 * weight

    def potential(*arguments: Array) -> Array:
        r = root.function(*arguments)
        total: Array = half * np.einsum("nm,nm->n", r, r)
        return total

    potential.__name__ = f"1/{clearance.name}"
    return potential
