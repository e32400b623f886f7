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

import numpy as np

from unifg.errors import GraphError, ModelError
from unifg.kernels.kernel import Kernel
from unifg.kernels.residuals import Residual, residual
from unifg.lie import Rn
from unifg.machine.jit import compiled
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

NEAR = 1e-9  # below this distance the direction is undefined; gradient and curvature are taken as zero


@compiled
def _direction(x: float, y: float) -> tuple[float, float, float]:
    """Return length and direction of a vector in the plane."""
    distance = math.sqrt(x * x + y * y)
    per = 1.0 / max(distance, NEAR)
    return distance, per * x, per * y


@compiled
def _bend(distance: float, x: float, y: float, weight: float, S: Array) -> None:
    """Add to the first 2 by 2 entries the Hessian of a weighted distance, given its direction."""
    if distance < NEAR:
        return
    scale = weight / distance
    S[0, 0] += scale * y * y
    S[0, 1] -= scale * x * y
    S[1, 0] -= scale * x * y
    S[1, 1] += scale * x * x


@compiled
def _clear(S: Array) -> None:
    for i in range(len(S)):
        for k in range(len(S)):
            S[i, k] = 0.0


# ---------------------------------------------------------------- cylinders


@compiled
def _cylinder(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Parameters: M centres, then M radii."""
    count = len(r)
    for k in range(count):
        distance, x, y = _direction(v[0] - p[2 * k], v[1] - p[2 * k + 1])
        r[k] = distance - p[2 * count + k]
        if len(J):
            J[k, 0], J[k, 1], J[k, 2] = x, y, 0.0


@compiled
def _cylinder_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    _clear(S)
    for k in range(len(w)):
        distance, x, y = _direction(v[0] - p[2 * k], v[1] - p[2 * k + 1])
        _bend(distance, x, y, w[k], S)


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
    Kernel(
        _cylinder, (Rn(3), 2, 1), _round("cylinder clearance", 2), name="cylinder clearance", second=_cylinder_second
    ),
    about="""``cylinder_clearance(p, centre, radius)``: |(p_x, p_y) - c| - radius [m], one column per cylinder, (n, M).

p: (n, 3) positions. centre: (M, 2), or (n, M, 2) for moving ones. radius: (M,) or (n, M), with the vehicle's added.
""",
)


# ---------------------------------------------------------------- one landmark, itself unknown


@compiled
def _landmark(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    distance, x, y = _direction(v[0] - v[3], v[1] - v[4])
    r[0] = distance - p[0]
    if len(J):
        J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4] = x, y, 0.0, -x, -y


@compiled
def _landmark_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    _clear(S)
    distance, x, y = _direction(v[0] - v[3], v[1] - v[4])
    _bend(distance, x, y, w[0], S)
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
def _to_segment(v: Array, p: Array, k: int) -> tuple[float, float, bool]:
    """Return the vector from the nearest point of segment k to the position, and whether that is an end of it."""
    ax, ay, bx, by = p[4 * k], p[4 * k + 1], p[4 * k + 2], p[4 * k + 3]
    ex, ey, x, y = bx - ax, by - ay, v[0] - ax, v[1] - ay
    square = ex * ex + ey * ey
    along = ex * x + ey * y
    if not along > 0.0 or square == 0.0:
        return x, y, True
    if along >= square:
        return v[0] - bx, v[1] - by, True
    across = (ex * y - ey * x) / square  # what is along the wall cancels without a remainder
    return -across * ey, across * ex, False


@compiled
def _segment(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Parameters: W segments, then W margins."""
    count = len(r)
    for k in range(count):
        dx, dy, _ = _to_segment(v, p, k)
        distance, x, y = _direction(dx, dy)
        r[k] = distance - p[4 * count + k]
        if len(J):
            J[k, 0], J[k, 1], J[k, 2] = x, y, 0.0


@compiled
def _segment_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    _clear(S)
    for k in range(len(w)):
        dx, dy, end = _to_segment(v, p, k)
        if end:
            distance, x, y = _direction(dx, dy)
            _bend(distance, x, y, w[k], S)


def _segments(segments: tuple[int, ...], margin: tuple[int, ...]) -> int:
    if segments != (*margin, 2, 2):
        raise GraphError(
            "segment clearance: segments must be (W, 2, 2) or (n, W, 2, 2) and margin (W,) or (n, W), found "
            f"{segments} and {margin} for each position"
        )
    return segments[0]


segment_clearance = residual(
    Kernel(_segment, (Rn(3), 3, 1), _segments, name="segment clearance", second=_segment_second),
    about="""
``segment_clearance(p, segments, margin)``: distance to walls less a margin [m], one column per wall, (n, W).

p: (n, 3) positions. segments: (W, 2, 2) end points of upright walls without thickness; margin: (W,). The distance has
no sign: a wall holds between nodes only if no step is longer than twice the margin.
""",
)


# ---------------------------------------------------------------- spheres


@compiled
def _sphere(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Parameters: M centres, then M radii."""
    count = len(r)
    for k in range(count):
        x, y, z = v[0] - p[3 * k], v[1] - p[3 * k + 1], v[2] - p[3 * k + 2]
        distance = math.sqrt(x * x + y * y + z * z)
        r[k] = distance - p[3 * count + k]
        if len(J):
            per = 1.0 / max(distance, NEAR)
            J[k, 0], J[k, 1], J[k, 2] = per * x, per * y, per * z


@compiled
def _sphere_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    _clear(S)
    for j in range(len(w)):
        x, y, z = v[0] - p[3 * j], v[1] - p[3 * j + 1], v[2] - p[3 * j + 2]
        distance = math.sqrt(x * x + y * y + z * z)
        if distance < NEAR:
            continue
        x, y, z, scale = x / distance, y / distance, z / distance, w[j] / distance
        S[0, 0] += scale * (1.0 - x * x)
        S[0, 1] -= scale * x * y
        S[0, 2] -= scale * x * z
        S[1, 1] += scale * (1.0 - y * y)
        S[1, 2] -= scale * y * z
        S[2, 2] += scale * (1.0 - z * z)
    S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]


sphere_clearance = residual(
    Kernel(_sphere, (Rn(3), 2, 1), _round("sphere clearance", 3), name="sphere clearance", second=_sphere_second),
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
