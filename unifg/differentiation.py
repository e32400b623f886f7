"""Batched numerical differentiation on manifolds.

A factor is evaluated for the whole batch at once, so a Jacobian of d columns costs 2 d batched calls
whatever the number of factors. Perturbations are on the right: ``x [+] d = x Exp(d)``. Steps are those of
:mod:`unifg.steps`. What the function returns is copied at once: it may use the same memory at each call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from itertools import product

import numpy as np

from unifg.lie import Manifold
from unifg.steps import (
    ANGLE,
    EPSILON,
    FAR,
    FIRST,
    OTHER,
    SECOND,
    TURN,
    VECTOR,
    Part,
    parts_of,
    rotations,
    steps_for,
    uncertainties,
)
from unifg.typing import Array


def jacobian(function: Callable[..., Array], points: Sequence[Array], manifolds: Sequence[Manifold]) -> list[Array]:
    """Central differences of a batched function along each tangent direction.

    Args:
        function: maps arrays like ``points`` to (n, m).
        points: one (n, storage_k) array per variable.
        manifolds: the manifold of each variable.

    Returns:
        One (n, m, d_k) array per variable.
    """
    axes, size = _axes(points, manifolds, FIRST)
    far = bool((size >= FAR).any())

    def along(axis: _Axis, times: float) -> Array:
        k = axis.argument
        ahead, behind = (
            _copied(function, [*points[:k], axis.moved(points[k], side), *points[k + 1 :]]) for side in (times, -times)
        )
        difference: Array = (ahead - behind) / (2.0 * times * axis.half[:, None])
        return difference

    columns = []
    for axis in axes:
        found = along(axis, 1.0)
        if far:
            wider = axis.at_least(steps_for(size, FIRST))
            fourth = (4.0 * along(wider, 1.0) - along(wider, 2.0)) / 3.0
            doubt = np.where(wider.half > axis.half, uncertainties(size, axis.half), np.inf)
            believed = (np.abs(fourth - found) <= doubt[:, None]) & (size >= FAR)[:, None]
            found = np.where(believed, fourth, found)
        columns.append(found)
    blocks = np.stack(columns, axis=-1)
    for turned, R in _turns(points, axes):
        blocks[..., turned] = blocks[..., turned] @ R
    return np.split(blocks, np.cumsum([manifold.dim for manifold in manifolds])[:-1], axis=-1)


def gradient_and_hessian(
    function: Callable[..., Array], points: Sequence[Array], manifolds: Sequence[Manifold], together: bool = False
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
        together: whether all steps are those of a factor's largest coordinate, for the Hessians of residuals that may
            round it.
    """
    near, size = _axes(points, manifolds, FIRST)
    axes, _ = _axes(points, manifolds, SECOND)
    if together:
        axes = [axis.at_least(steps_for(size, SECOND)) for axis in axes]

    def at(*moves: tuple[_Axis, float]) -> Array:
        moved = list(points)
        first, times = moves[0]
        if len(moves) == 2 and moves[1][0].part is first.part:
            moved[first.argument] = first.moved(points[first.argument], times, moves[1])
        else:
            for axis, times in moves:
                moved[axis.argument] = axis.moved(moved[axis.argument], times)
        return _copied(function, moved)

    count, total = len(points[0]), len(axes)
    gradient, rounding = np.empty((count, total)), np.empty((count, total))
    hessian = np.empty((count, total, total))
    centre = _copied(function, points)
    noise = EPSILON * np.abs(centre)
    for a, axis in enumerate(axes):
        first, h = near[a], axis.half
        two = (at((first, 1.0)) - at((first, -1.0))) / (2.0 * first.half)
        inside, outside, ahead, behind = (at((axis, times)) for times in (0.5, -0.5, 1.0, -1.0))
        four = (8.0 * (inside - outside) - (ahead - behind)) / (6.0 * h)
        doubt = noise / first.half + np.where(size >= FAR, uncertainties(size, first.half), 0.0)
        believed = np.abs(four - two) <= doubt
        gradient[:, a] = np.where(believed, four, two)
        rounding[:, a] = np.where(believed, 3.0 * noise / h, noise / first.half)
        hessian[:, a, a] = ((ahead - centre) + (behind - centre)) / h**2
        for b, other in enumerate(axes[:a]):
            mixed = sum(s * t * at((axis, s), (other, t)) for s, t in product((1.0, -1.0), repeat=2))
            hessian[:, a, b] = hessian[:, b, a] = mixed / (4.0 * axis.half * other.half)
    _to_body(points, axes, gradient, hessian)
    return gradient, hessian, rounding


def convexified(blocks: Array) -> Array:
    """Hessian blocks of scalar costs with negative curvature removed: a Gauss-Newton step must descend."""
    if not np.isfinite(blocks).all():
        return blocks
    eigenvalues, vectors = np.linalg.eigh(blocks)
    result: Array = (vectors * np.maximum(eigenvalues, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return result


class _Axis:
    """One direction to step along: an axis of a part of one variable.

    Attributes:
        argument: which variable.
        part: of it.
        half: (n,) half of what a step there and one back come to in the numbers that are stored.
    """

    def __init__(self, argument: int, part: Part, leaf: Manifold, axis: int, x: Array | None, step: Array) -> None:
        """Take steps (n,) at the coordinate x (n,), if it is one that is added to."""
        self.argument, self.part, self._leaf, self._axis, self._x = argument, part, leaf, axis, x
        self._take(step)

    def _take(self, step: Array) -> None:
        x = self._x
        self._step, self.half = step, step if x is None else 0.5 * ((x + step) - (x - step))

    def at_least(self, step: Array) -> _Axis:
        """The same axis with steps as long as these, or longer."""
        wider = copy(self)
        wider._take(np.maximum(self._step, step))
        return wider

    def moved(self, point: Array, times: float, also: tuple[_Axis, float] | None = None) -> Array:
        """(n, storage) points so many steps away; ``also`` along another axis of the same part, at the same time."""
        result, part = np.array(point), self.part
        if part.kind == VECTOR:
            result[:, part.start + self._axis] += times * self._step
            if also:
                result[:, part.start + also[0]._axis] += also[1] * also[0]._step
            return result
        tangent = np.zeros((len(point), part.dim))
        tangent[:, self._axis] = times * self._step
        if also:
            tangent[:, also[0]._axis] = also[1] * also[0]._step
        stored = result[:, part.start : part.start + part.storage]
        stored[:] = self._leaf.retract(stored, tangent)
        return result


def _axes(points: Sequence[Array], manifolds: Sequence[Manifold], root: int) -> tuple[list[_Axis], Array]:
    """One for each tangent direction, in order; and (n,) sizes of the largest coordinates of every factor."""
    axes: list[_Axis] = []
    largest = np.zeros(len(points[0]))
    for k, (point, manifold) in enumerate(zip(points, manifolds, strict=True)):
        sizes = np.abs(point)
        own = steps_for(sizes, root)
        for part, leaf in parts_of([manifold]):
            stored = slice(part.start, part.start + part.storage)
            if part.kind in (VECTOR, OTHER):
                size = sizes[:, stored].max(axis=1)
                largest = np.maximum(largest, size)
                if part.turn >= 0 or part.kind == OTHER:
                    own[:, stored] = steps_for(size, root)[:, None]
            if part.kind == TURN:
                own[:, stored] = steps_for(np.ones(()), root)
            for axis in range(part.dim):
                place = part.start + (axis if part.kind != OTHER else 0)
                x = point[:, place] if part.kind in (VECTOR, ANGLE) else None
                axes.append(_Axis(k, part, leaf, axis, x, own[:, place]))
    return axes, largest


def _turns(points: Sequence[Array], axes: Sequence[_Axis]) -> list[tuple[slice, Array]]:
    """Columns of the positions that belong to a rotation, and the (n, d, d) rotations."""
    turns: list[tuple[slice, Array]] = []
    for column, axis in enumerate(axes):
        part = axis.part
        if part.turn >= 0 and (column == 0 or axes[column - 1].part is not part):
            turns.append((slice(column, column + part.dim), rotations(points[axis.argument], part.turn, part.dim)))
    return turns


def _to_body(points: Sequence[Array], axes: Sequence[_Axis], gradient: Array, hessian: Array) -> None:
    """Turn derivatives along stored positions into those along the axes of the body, in place.

    With t the translation and r the rotation that follows it, the position moves by ``R (t + 1/2 r x t + ...)``: to
    second order a mixed entry of t and r also has half of the gradient along ``r x t``.
    """
    for columns, R in _turns(points, axes):
        dim = columns.stop - columns.start
        gradient[:, columns] = np.einsum("nk,nki->ni", gradient[:, columns], R)
        hessian[:, columns, :] = np.swapaxes(R, 1, 2) @ hessian[:, columns, :]
        hessian[:, :, columns] = hessian[:, :, columns] @ R
        slope = gradient[:, columns]
        for i in range(dim):
            for j in range(1 if dim == 2 else 3):
                turned = np.cross(np.eye(3)[2 if dim == 2 else j], np.eye(3)[i])[:dim]
                bent = 0.5 * slope @ turned
                hessian[:, columns.start + i, columns.stop + j] += bent
                hessian[:, columns.stop + j, columns.start + i] += bent


def _copied(function: Callable[..., Array], points: Sequence[Array]) -> Array:
    """What the function returns, safe from its next call."""
    return np.array(function(*points), dtype=np.float64)
