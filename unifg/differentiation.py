"""Batched numerical differentiation on manifolds.

A factor is evaluated for the whole batch at once, so a Jacobian of d columns costs 2 d batched calls
whatever the number of factors. Perturbations are on the right: ``x [+] d = x Exp(d)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from unifg.lie import Manifold
from unifg.typing import Array

FIRST_STEP = 6e-6  # eps ** (1/3): balances truncation and rounding of a central difference
SECOND_STEP = 1e-4  # eps ** (1/4)


def jacobian(
    function: Callable[..., Array],
    points: Sequence[Array],
    manifolds: Sequence[Manifold],
    length: float = FIRST_STEP,
) -> list[Array]:
    """Central differences of a batched function along each tangent direction.

    Args:
        function: maps arrays like ``points`` to (n, m).
        points: one (n, storage_k) array per variable.
        manifolds: the manifold of each variable.
        length: of the steps.

    Returns:
        One (n, m, d_k) array per variable.
    """
    result = []
    for k, (point, manifold) in enumerate(zip(points, manifolds, strict=True)):
        columns = []
        for step in _directions(len(point), manifold.dim, length):
            ahead = function(*points[:k], manifold.retract(point, step), *points[k + 1 :])
            behind = function(*points[:k], manifold.retract(point, -step), *points[k + 1 :])
            columns.append((ahead - behind) / (2.0 * length))
        result.append(np.stack(columns, axis=-1))
    return result


def gradient_and_hessian(
    function: Callable[..., Array], points: Sequence[Array], manifolds: Sequence[Manifold]
) -> tuple[Array, Array]:
    """Gradient (n, D) and symmetric Hessian (n, D, D) of a batched scalar function, D = sum of d_k.

    Directions of different variables commute; within one variable the symmetrised second derivative of
    ``t -> f(x Exp(t d))`` is taken, which is the Hessian a Newton step along Exp needs.
    """
    sizes = [manifold.dim for manifold in manifolds]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    count, total = len(points[0]), int(offsets[-1])

    def moved(direction: Array) -> Array:
        steps = [np.broadcast_to(direction[offsets[k] : offsets[k + 1]], (count, sizes[k])) for k in range(len(sizes))]
        return function(*[m.retract(p, s) for m, p, s in zip(manifolds, points, steps, strict=True)])

    basis = np.eye(total)
    gradient = np.empty((count, total))
    hessian = np.empty((count, total, total))
    centre = function(*points)
    for a in range(total):
        gradient[:, a] = (moved(FIRST_STEP * basis[a]) - moved(-FIRST_STEP * basis[a])) / (2.0 * FIRST_STEP)
        ahead, behind = moved(SECOND_STEP * basis[a]), moved(-SECOND_STEP * basis[a])
        hessian[:, a, a] = (ahead - 2.0 * centre + behind) / SECOND_STEP**2
    for a in range(total):
        for b in range(a):
            both, across = SECOND_STEP * (basis[a] + basis[b]), SECOND_STEP * (basis[a] - basis[b])
            mixed = (moved(both) + moved(-both) - moved(across) - moved(-across)) / (4.0 * SECOND_STEP**2)
            hessian[:, a, b] = hessian[:, b, a] = mixed
    return gradient, hessian


def convexified(blocks: Array) -> Array:
    """Hessian blocks of scalar costs with negative curvature removed: a Gauss-Newton step must descend."""
    if not np.isfinite(blocks).all():
        return blocks
    eigenvalues, vectors = np.linalg.eigh(blocks)
    result: Array = (vectors * np.maximum(eigenvalues, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return result


def _directions(count: int, dim: int, step: float) -> list[Array]:
    """One (count, dim) array per tangent direction, scaled by ``step``."""
    scaled = step * np.eye(dim)
    return [np.broadcast_to(row, (count, dim)) for row in scaled]
