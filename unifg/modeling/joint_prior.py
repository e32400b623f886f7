"""A prior about several variables at once: what marginalisation leaves behind, or any correlated belief.

The residual stacks the local differences of all its variables from a joint reference; the ``information=`` of the
term, over the stacked tangent spaces, holds how they are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import accumulate
from typing import cast

import numpy as np

from unifg.codegen.calls import local_matrix, vector
from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE2, SE3, SE23, SO2, SO3, LieGroup, Manifold, Rn, se2, se3, se23, so2, so3
from unifg.lie.product import Product, leaves
from unifg.typing import Array

VECTOR = 0  # how a leaf is compared; groups by their numbers in GROUPS
GROUPS: dict[Manifold, int] = {SO2: 1, SE2: 2, SO3: 3, SE3: 4, SE23: 5}


def joint_prior(*manifolds: Manifold, offset: bool = False) -> Residual:
    """Stacked Log(m_k^-1 x_k) of variables x_k from the parts m_k of one reference, less an offset if there is one.

    ``graph.minimize(fg.joint_prior(fg.SE2, fg.Rn(1)), x[0], bias, reference, information=omega)``: the last argument
    is the reference, (S,) or (n, S), the storage of all variables side by side; ``information`` is (D, D) over their
    tangent spaces in the same order. :meth:`unifg.Solution.marginal_prior` gives both.

    A quadratic model made at a point, as marginalisation leaves it, has its lowest point far away where it says little:
    farther than a turn, or than the curvature of a group allows. With ``offset`` the reference is that point, followed
    by the step (D,) in the tangent spaces that leads to the lowest one, and the model stays what it was.

    Args:
        *manifolds: of the variables, in order.
        offset: whether the reference is (S + D,) or (n, S + D), the last D an offset that is subtracted.

    Returns:
        A residual with D rows; compiled when every component is a vector or one of the library's groups.

    Raises:
        GraphError: without a manifold.
    """
    if not manifolds:
        raise GraphError("joint_prior: name the manifold of at least one variable")
    parts = {f"part{k}": manifold for k, manifold in enumerate(manifolds)}
    offsets = {"offset": Rn(sum(manifold.dim for manifold in manifolds))} if offset else {}
    reference: Manifold = Product(**parts, **offsets)
    return replace(_complete(manifolds, offset), elements=tuple(enumerate([*manifolds, reference])))


@cache
def _complete(manifolds: tuple[Manifold, ...], offset: bool) -> Residual:
    parts = [leaf for manifold in manifolds for leaf, _, _ in leaves(manifold)]
    storage, dim = (sum(getattr(part, size) for part in parts) for size in ("storage", "dim"))
    if all(_kind(leaf) is not None for leaf in parts):
        table = [[cast(int, _kind(leaf)), leaf.storage, leaf.dim] for leaf in parts]
        return residual(
            Kernel(
                _stacked,
                (*manifolds, (storage + dim * offset,)),
                dim,
                np.array(table, dtype=np.float64).ravel(),
                name="joint prior",
                linear=all(isinstance(leaf, Rn) for leaf in parts),
            )
        )
    groups = [manifold for manifold in manifolds if isinstance(manifold, LieGroup)]
    slopes = partial(_slopes, groups) if len(groups) == len(manifolds) else None
    return residual(partial(_differences, manifolds), slopes, "joint prior")


def _kind(leaf: Manifold) -> int | None:
    """Comparison of elements of ``leaf`` by the kernel; None when it has none."""
    if isinstance(leaf, Rn):
        return VECTOR
    return GROUPS.get(leaf)


@compiled
def _stacked(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Leaf after leaf; the table holds kind, storage and dimension of each. What follows the reference is an offset."""
    derive = len(J) > 0
    if derive:
        J[:] = 0.0
    at = row = 0
    block = local_matrix(9, 9)
    for leaf in range(len(table) // 3):
        kind, storage, dim = int(table[3 * leaf]), int(table[3 * leaf + 1]), int(table[3 * leaf + 2])
        if kind == 0:
            for i in range(dim):
                r[row + i] = v[at + i] - p[at + i]
                if derive:
                    J[row + i, row + i] = 1.0
        else:
            here, reference, out = vector(v, at, storage), vector(p, at, storage), vector(r, row, dim)
            square = block.reshape(-1)[: dim * dim].reshape(dim, dim)
            if kind == 1:
                so2.between(reference, here, out)
                square[0, 0] = 1.0
            elif kind == 2:
                se2.local(reference, here, out)
                se2.right_jacobian_inverse(out, square)
            elif kind == 3:
                so3.local(reference, here, out)
                so3.right_jacobian_inverse(out, square)
            elif kind == 4:
                se3.local(reference, here, out)
                se3.right_jacobian_inverse(out, square)
            else:
                se23.local(reference, here, out)
                se23.right_jacobian_inverse(out, square)
            if derive:
                for i in range(dim):
                    for k in range(dim):
                        J[row + i, row + k] = square[i, k]
        at += storage
        row += dim
    if len(p) > at:
        for i in range(row):
            r[i] -= p[at + i]


def _differences(manifolds: Sequence[Manifold], *arguments: Array) -> Array:
    """(n, D) the same of variables (n, storage_k) and references (n, S) or (S,) in NumPy, for other manifolds."""
    *points, reference = arguments
    bounds = list(accumulate((manifold.storage for manifold in manifolds), initial=0))
    parts = zip(manifolds, points, bounds, bounds[1:], strict=False)
    found = [np.atleast_2d(manifold.local(reference[..., a:b], point)) for manifold, point, a, b in parts]
    count, offset = max(map(len, found)), reference[..., bounds[-1] :]
    stacked = np.concatenate([np.broadcast_to(part, (count, part.shape[-1])) for part in found], axis=1)
    return stacked - offset if offset.shape[-1] else stacked


def _slopes(groups: Sequence[LieGroup], *arguments: Array) -> list[Array]:
    """One (n, D, d_k) array per variable."""
    *points, reference = arguments
    total, blocks = _differences(groups, *points, reference[..., : sum(group.storage for group in groups)]), []
    for group, row in zip(groups, accumulate((group.dim for group in groups), initial=0), strict=False):
        block = np.zeros((*total.shape, group.dim))
        block[:, row : row + group.dim] = group.right_jacobian_inverse(total[:, row : row + group.dim])
        blocks.append(block)
    return blocks
