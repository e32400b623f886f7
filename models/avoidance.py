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

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from unifg.errors import GraphError, ModelError, require_positive
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import Rn
from unifg.models.profile import plain
from unifg.typing import Array

__all__ = ["cylinder_clearance", "inverse_distance", "inverse_distance_root", "sphere_clearance"]


NEAR = 1e-9  # distance below which there is no direction; gradient and curvature are zero


def to_balls(p: Array, centre: Array, radius: Array) -> Array:
    """``|p - c| - radius``, (n, M), for centres (n, M, d); of positions the first d axes count."""
    offset = p[:, None, : centre.shape[-1]] - centre
    return _length(np.sum(offset * offset, axis=-1)) - radius


def _length(square: Array) -> Array:
    return np.sqrt(np.maximum(square, NEAR * NEAR))


def count(name: str, dimension: int, what: str, centre: tuple[int, ...], radius: tuple[int, ...]) -> int:
    """Number of obstacles, from the shapes of centres and radii for one position.

    Raises:
        GraphError: when these do not fit.
    """
    if centre != (*radius, dimension):
        raise GraphError(
            f"{name}: centre must be (M, {dimension}) or (n, M, {dimension}) and radius (M,) or (n, M), found "
            f"{centre} and {radius} for each {what}"
        )
    return centre[0]


def _balls(name: str, dimension: int) -> StatedKernel:
    rows = partial(count, name, dimension, "position")
    return StatedKernel(to_balls, (Rn(3), 2, 1), rows, name=name)


cylinder_clearance = residual(
    _balls("cylinder clearance", 2),
    takes=("m in W", "m in W", "m"),
    about="""``cylinder_clearance(p, centre, radius)``: |(p_x, p_y) - c| - radius [m], one column per cylinder, (n, M).

p: (n, 3) positions. centre: (M, 2), or (n, M, 2) for moving ones. radius: (M,) or (n, M), with the vehicle's added.
""",
)

sphere_clearance = residual(
    _balls("sphere clearance", 3),
    takes=("m in W", "m in W", "m"),
    about="""
``sphere_clearance(p, centre, radius)``: |p - c| - radius [m] in space, (n, M), for centres (M, 3), radii (M,).""",
)


def _to_landmark(p: Array, l: Array, radius: Array) -> Array:  # noqa: E741
    return to_balls(p, l[:, None], radius[:, None])


landmark_clearance = residual(
    StatedKernel(_to_landmark, (Rn(3), Rn(2), ()), 1, name="landmark clearance"),
    takes=("m in W", "m in W", "m"),
    about="""``landmark_clearance(p, l, radius)``: |(p_x, p_y) - l| - radius [m], (n, 1).

p: (n, 3) positions. l: (n, 2) centres of cylinders, variables of the map or constants. radius: a number or (n,).
""",
)


def _to_segments(p: Array, segments: Array, margin: Array) -> Array:
    """Distance to the nearer end, or across the wall where the position is beside it."""
    wall, start = segments[..., 1, :] - segments[..., 0, :], p[:, None, :2] - segments[..., 0, :]
    end = p[:, None, :2] - segments[..., 1, :]
    square, along = np.sum(wall * wall, axis=-1), np.sum(wall * start, axis=-1)
    beside = (along > 0.0) & (along < square)
    # What is along the wall cancels without a remainder.
    across = np.where(beside, wall[..., 0] * start[..., 1] - wall[..., 1] * start[..., 0], 0.0)
    away = np.where((along < square) | (square == 0.0), np.sum(start * start, axis=-1), np.sum(end * end, axis=-1))
    beside_it = np.abs(across) / np.sqrt(np.where(beside, square, 1.0))
    return np.where(beside, beside_it, _length(away)) - margin


def _segments(segments: tuple[int, ...], margin: tuple[int, ...]) -> int:
    if segments != (*margin, 2, 2):
        raise GraphError(
            "segment clearance: segments must be (W, 2, 2) or (n, W, 2, 2) and margin (W,) or (n, W), found "
            f"{segments} and {margin} for each position"
        )
    return segments[0]


segment_clearance = residual(
    StatedKernel(_to_segments, (Rn(3), 3, 1), _segments, name="segment clearance"),
    takes=("m in W", "in W", "m"),
    about="""
``segment_clearance(p, segments, margin)``: distance to walls less a margin [m], one column per wall, (n, W).

p: (n, 3) positions. segments: (W, 2, 2) end points of upright walls without thickness; margin: (W,). The distance has
no sign: a wall holds between nodes only if no step is longer than twice the margin.
""",
)


def inverse_distance_root(clearance: Residual, nearest: float = 0.1) -> Residual:
    """Ta's potential as least squares: sqrt(2 phi(d)), same shape as the clearance, so that 1/2 r^2 = phi(d).

    It is the same objective as :func:`inverse_distance`, and any backend takes it. A sigma of s weighs 1/d with 1/s^2.

    Args:
        clearance: d, one of those of this module, or a residual of a plain function.
        nearest: d0, where the parabola takes over [m].

    Raises:
        ModelError: when ``nearest`` is not positive, or the clearance is compiled by hand.
    """
    require_positive("1/d", ModelError, nearest=nearest)
    made = plain(clearance, partial(_root, nearest), f"root of 1/{clearance.name}")
    if made is None:
        raise ModelError(f"1/d needs a clearance that is a plain function, found '{clearance.name}'")
    return made


def _root(nearest: float, d: Array) -> Array:
    """sqrt(2 phi)."""
    depth, beyond = d / nearest - 1.0, d >= nearest
    phi = np.where(beyond, 1.0 / np.where(beyond, d, 1.0), (1.0 - depth + depth * depth) / nearest)
    return np.sqrt(2.0 * phi)


def inverse_distance(clearance: Residual, nearest: float = 0.1, weight: float = 1.0) -> Callable[..., Array]:
    """Ta's potential for ``minimize_scalar``: weight times the sum of phi(d) over the columns of a clearance, (n,).

    Args:
        clearance: d, as for :func:`inverse_distance_root`.
        nearest: d0, where the parabola takes over [m].
        weight: factor [m].

    Raises:
        ModelError: when ``nearest`` is not positive, or the clearance is compiled by hand.
    """
    root = inverse_distance_root(clearance, nearest)
    half = 0.5 * weight

    def potential(*arguments: Any) -> Array:
        r = root(*arguments)
        total: Array = half * np.einsum("nm,nm->n", r, r)
        return total

    potential.__name__ = f"1/{clearance.name}"
    return potential
