"""Batched numerical differentiation on manifolds.

A factor is evaluated for the whole batch at once, and where the function allows it (:mod:`unifg.kernels.stack`) for
many perturbations at once: a Jacobian is one call then. Perturbations are on the right: ``x [+] d = x Exp(d)``. Steps
are those of :mod:`unifg.kernels.steps`. What the function returns is copied at once: it may use the same memory at each
call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from unifg.kernels.moves import Moves, Near, Steps, directions_of
from unifg.kernels.steps import EPSILON, FAR, FIRST, SECOND, uncertainties
from unifg.lie import Manifold
from unifg.typing import Array, BoolArray

Many: TypeAlias = Callable[[Near, Steps, Moves], Array]
"""(K, n, ...) values of a function after K moves, which the next call may overwrite."""
ROUNDING = 16.0  # of what a residual sums up: a mixed difference of four values below this is no curvature


def jacobian(function: Callable[..., Array], points: Sequence[Array], manifolds: Sequence[Manifold]) -> list[Array]:
    """Central differences of a batched function along each tangent direction.

    Args:
        function: maps arrays like ``points`` to (n, m).
        points: one (n, storage_k) array per variable.
        manifolds: the manifold of each variable.

    Returns:
        One (n, m, d_k) array per variable.
    """
    return slopes(one_by_one(function), Near(directions_of(tuple(manifolds)), points))


def slopes(many: Many, near: Near) -> list[Array]:
    """Central differences of a function (n, m) of many moves: one (n, m, d_k) array per variable."""
    directions = near.directions
    width, steps = directions.width, near.steps(FIRST)
    values = many(near, steps, directions.two_sided)
    found = np.subtract(values[:width], values[width:], out=values[:width])
    found /= 2.0 * steps.half.T[:, :, None]
    far = near.size >= FAR
    if far.any():
        found, wider = found.copy(), near.wider(steps, FIRST)
        values = many(near, wider, directions.four_points)
        ahead, behind, two_ahead, two_behind = values.reshape(4, width, *values.shape[1:])
        half = wider.half.T[:, :, None]
        fourth = (4.0 * ((ahead - behind) / (2.0 * half)) - (two_ahead - two_behind) / (4.0 * half)) / 3.0
        doubt = np.where(wider.half > steps.half, uncertainties(near.size[:, None], steps.half), np.inf).T[:, :, None]
        found = np.where((np.abs(fourth - found) <= doubt) & far[:, None], fourth, found)
    blocks = np.array(np.moveaxis(found, 0, -1), order="C")
    for turned, R in near.rotations():
        along = blocks[..., turned]
        blocks[..., turned] = sum(along[..., k : k + 1] * R[:, None, k] for k in range(R.shape[1]))
    return np.split(blocks, directions.ends, axis=-1)


def gradient_and_hessian(
    function: Callable[..., Array], points: Sequence[Array], manifolds: Sequence[Manifold]
) -> tuple[Array, Array, Array]:
    """Gradient (n, D), symmetric Hessian (n, D, D), and rounding of the gradient (n, D), of a batched scalar function.

    D is the sum of d_k. The gradient comes from two points near the centre, and from four points further away where
    these agree as nearly as rounding of the two lets them: they know more digits of a large value. Directions of
    different variables commute; within one variable the symmetrised second derivative of ``t -> f(x Exp(t d))`` is
    taken, which is the Hessian a Newton step along Exp needs.

    Args:
        function: maps arrays like ``points`` to (n,).
        points: one (n, storage_k) array per variable.
        manifolds: the manifold of each variable.
    """
    return scalar_slopes(one_by_one(function), Near(directions_of(tuple(manifolds)), points))


def scalar_slopes(many: Many, near: Near) -> tuple[Array, Array, Array]:
    """What :func:`gradient_and_hessian` returns, of a function (n,) of many moves."""
    directions, width = near.directions, near.directions.width
    first, steps = near.steps(FIRST), near.steps(SECOND)
    values = many(near, first, directions.two_sided)
    two = (values[:width] - values[width:]).T / (2.0 * first.half)
    values = many(near, steps, directions.scalar)
    centre, values = values[0], values[1:]
    inside, outside, ahead, behind = values[: 4 * width].reshape(4, width, len(centre))
    h, noise = steps.half, EPSILON * np.abs(centre)[:, None]
    four = (8.0 * (inside - outside) - (ahead - behind)).T / (6.0 * h)
    doubt = noise / first.half
    doubt = doubt + np.where((near.size >= FAR)[:, None], uncertainties(near.size[:, None], first.half), 0.0)
    believed = np.abs(four - two) <= doubt
    gradient = np.where(believed, four, two)
    rounding = np.where(believed, 3.0 * noise / h, noise / first.half)
    hessian = np.empty((len(centre), width, width))
    diagonal = np.arange(width)
    hessian[:, diagonal, diagonal] = ((ahead - centre) + (behind - centre)).T / h**2
    a, b = directions.lower
    both, one, other, neither = values[4 * width :].reshape(4, len(a), len(centre))
    hessian[:, a, b] = hessian[:, b, a] = (both - one - other + neither).T / (4.0 * h[:, a] * h[:, b])
    _to_body(near, gradient, hessian)
    return gradient, hessian, rounding


def weighted_hessian(many: Many, near: Near, weights: Array) -> Array:
    """(n, D, D) second differences of weights' r for a residual r (n, m) of many moves.

    All steps are those of a factor's largest coordinate, because that is what the residual may round. Most residuals
    are straight along most of their directions. Which ones is asked anew at every point, because a residual may be
    straight here and bent elsewhere: the mixed differences along each direction and one that lies across all of them
    are, to rounding, zero for all rows that count. Only between directions that bend are pairs looked at.

    Args:
        many: the residual.
        near: the points.
        weights: (n, m).
    """
    directions, width = near.directions, near.directions.width
    hessian = np.zeros((len(weights), width, width))
    if not weights.any():
        return hessian
    steps = near.wider(near.steps(SECOND), SECOND)
    values = many(near, steps, directions.across)
    centre = values[0].copy()
    change = values[1:] - centre
    across = change[0]
    ahead, behind, mixed = change[1:].reshape(3, width, *centre.shape)
    slope = ahead - behind
    reach = 0.5 * (1.0 + np.abs(near.coordinates) / steps.half)
    rounding = ROUNDING * EPSILON * (np.abs(centre) + np.einsum("nc,cnm->nm", reach, np.abs(slope)))
    straight = (np.abs(mixed - ahead - across) <= rounding) | (weights == 0.0)
    bent: BoolArray = ~straight.reshape(width, -1).all(axis=1)
    chosen = np.flatnonzero(bent)
    if len(chosen):
        both = np.einsum("nm,cnm->nc", weights, ahead + behind)
        hessian[:, chosen, chosen] = both[:, chosen] / steps.half[:, chosen] ** 2
    if len(chosen) > 1:
        first, second, moves = directions.pairs(chosen)
        values = many(near, steps, moves) - centre
        pairs = np.einsum("nm,cnm->nc", weights, values[: len(first)] + values[len(first) :])
        pairs -= both[:, first] + both[:, second]
        pairs /= 2.0 * steps.half[:, first] * steps.half[:, second]
        hessian[:, first, second] = hessian[:, second, first] = pairs
    if directions.poses:
        gradient = np.einsum("nm,cnm->nc", weights, slope) / (2.0 * steps.half)
        _to_body(near, gradient, hessian)
    return hessian


def one_by_one(function: Callable[..., Array]) -> Many:
    """Call a function once for each move."""

    def many(near: Near, steps: Steps, moves: Moves) -> Array:
        return np.stack([np.array(function(*near.after(steps, moves, k))) for k in range(moves.count)])

    return many


def convexified(blocks: Array) -> Array:
    """Hessian blocks of scalar costs with negative curvature removed: a Gauss-Newton step must descend."""
    if not np.isfinite(blocks).all():
        return blocks
    eigenvalues, vectors = np.linalg.eigh(blocks)
    result: Array = (vectors * np.maximum(eigenvalues, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return result


def _to_body(near: Near, gradient: Array, hessian: Array) -> None:
    """Turn derivatives along stored positions into those along the axes of the body, in place.

    With t the translation and r the rotation that follows it, the position moves by ``R (t + 1/2 r x t + ...)``: to
    second order a mixed entry of t and r also has half of the gradient along ``r x t``.
    """
    for columns, R in near.rotations():
        stop, turned = columns.stop, _TURNED[columns.stop - columns.start]
        gradient[:, columns] = np.einsum("nk,nki->ni", gradient[:, columns], R)
        hessian[:, columns, :] = np.swapaxes(R, 1, 2) @ hessian[:, columns, :]
        hessian[:, :, columns] = hessian[:, :, columns] @ R
        bent = 0.5 * np.einsum("nk,ijk->nij", gradient[:, columns], turned)
        after = slice(stop, stop + turned.shape[1])
        hessian[:, columns, after] += bent
        hessian[:, after, columns] += np.swapaxes(bent, 1, 2)


_TURNED = {
    2: np.array([[[0.0, 1.0]], [[-1.0, 0.0]]]),
    3: np.array([[np.cross(r, t) for r in np.eye(3)] for t in np.eye(3)]),
}
"""What a turn r makes of a translation t, r x t: axes of t, axes of r, coordinates."""
