"""How far a variable is from a reference, in standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache
from typing import cast

from unifg.errors import GraphError
from unifg.kernels.kernel import Kernel
from unifg.kernels.residuals import Residual, residual
from unifg.lie import LieGroup, Manifold, Rn
from unifg.lie.functions import functions_of
from unifg.machine.jit import compiled
from unifg.typing import Array


@compiled
def _of_vector(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Difference over the standard deviations, which follow the reference in ``p``."""
    size = len(r)
    for i in range(size):
        r[i] = (v[i] - p[i]) / p[size + i]
        if len(J):
            for k in range(size):
                J[i, k] = 1.0 / p[size + i] if i == k else 0.0


def _of_group(group: LieGroup) -> Callable[..., None]:
    functions = functions_of(group)
    if functions is None:
        raise GraphError(f"standardised: {group.name} has no compiled functions")
    storage, dim = group.storage, group.dim
    local, inverse_jacobian = functions.local, functions.right_jacobian_inverse

    @compiled
    def of_group(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        local(p, v, r)
        if len(J):
            inverse_jacobian(r, J)
        for i in range(dim):
            r[i] /= p[storage + i]
            if len(J):
                for k in range(dim):
                    J[i, k] /= p[storage + i]

    return of_group


def standardised(manifold: Manifold) -> Residual:
    """``standardised(M)(x, reference, sigma)``: Log(reference^-1 x) / sigma, row by row, (n, d).

    reference: (n, storage). sigma: (n, d), positive.

    Raises:
        GraphError: for a manifold that is no group with compiled functions.
    """
    return _made(cast(Hashable, manifold))


@cache
def _made(manifold: Hashable) -> Residual:
    if not isinstance(manifold, LieGroup):
        raise GraphError(f"standardised needs a Lie group, found {cast(Manifold, manifold).name}")
    arguments = (manifold, (manifold.storage,), (manifold.dim,))
    if isinstance(manifold, Rn):
        return residual(Kernel(_of_vector, arguments, manifold.dim, name="standardised", linear=True))
    return residual(Kernel(_of_group(manifold), arguments, manifold.dim, name="standardised"))
