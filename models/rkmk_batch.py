"""One step of a Runge-Kutta-Munthe-Kaas method, for batches, in NumPy: for fields and groups without compiled code.

The same equations as in :mod:`unifg.models.rkmk_kernel`, in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from unifg.kernels.differences import jacobian
from unifg.lie import LieGroup, Manifold, Rn
from unifg.models.rkmk_kernel import BEFORE, END, FLAT, WEIGHT
from unifg.models.tableau import Tableau
from unifg.typing import Array

Field: TypeAlias = Callable[..., Array]
FieldJacobian: TypeAlias = Callable[..., Sequence[Array]]

BEND_STEP = 2e-3
"""Of fourth-order differences of dexp_inv, whose scale is its singularity at 2 pi: the error is near 1e-13."""


class StepDefect:
    """xi - h Phi of (x, inputs, x_next, h), (n, dim); picklable when the field is.

    Args:
        group: of x and x_next.
        field: F(x, inputs), (n, dim).
        tableau: the method.
        derivative: of F along x and every input; None: by differences.
    """

    def __init__(self, group: LieGroup, field: Field, tableau: Tableau, derivative: FieldJacobian | None) -> None:
        """Keep them."""
        self.group = group
        self.field = field
        self.tableau = tableau
        self.derivative = derivative

    def __call__(self, x: Array, *rest: Any) -> Array:
        """(n, dim) defects of ``(x, *inputs, x_next, h)``."""
        return self._run(x, rest, False)[0]

    def jacobian(self, x: Array, *rest: Any) -> list[Array]:
        """(n, dim, d) derivatives along x, every input and x_next."""
        by_all = self._run(x, rest, True)[1]
        sizes = [self.group.dim, *(part.shape[1] for part in rest[:-2]), self.group.dim]
        return np.split(by_all, np.cumsum(sizes)[:-1], axis=2)

    def _run(self, x: Array, rest: Sequence[Any], derive: bool) -> tuple[Array, Array]:
        *inputs, after, step = rest
        group, dim = self.group, self.group.dim
        count = max(len(part) for part in (x, *inputs, after))
        x, *inputs, after = (np.broadcast_to(part, (count, part.shape[1])) for part in (x, *inputs, after))
        h = np.reshape(step, (-1, 1))  # one, or one for each factor
        ahead = slice(dim, -dim)  # columns of the inputs
        xi = group.local(x, after)
        defect, by_xi, by_defect = xi, np.zeros(0), np.zeros(0)
        if derive:
            by_xi = np.zeros((count, dim, 2 * dim + sum(part.shape[1] for part in inputs)))
            inverse = group.right_jacobian_inverse(xi)  # Log(x^-1 x_next Exp(d)) = xi + dexp_inv(xi) d
            by_xi[:, :, :dim] = -inverse @ group.adjoint(group.between(after, x))
            by_xi[:, :, -dim:] = inverse
            by_defect = by_xi.copy()
        speeds: list[Array] = []
        derivatives: list[Array] = []
        for row in self.tableau.rows:
            before = row[BEFORE : BEFORE + len(speeds)]
            inside = bool(before.any()) or row[END] not in (0.0, 1.0)
            sigma = row[END] * xi + h * sum(a * k for a, k in zip(before, speeds, strict=True))
            point = group.retract(x, sigma) if inside else after if row[END] else x
            speed = self.field(point, *inputs)
            flat = bool(row[FLAT]) or not (inside or row[END])
            weight = group.right_jacobian_inverse(sigma)
            speeds.append(speed if flat else times(weight, speed))
            defect = defect - h * row[WEIGHT] * speeds[-1]
            if not derive:
                continue
            by_x, *by_inputs = self._field_derivatives(point, inputs)
            slopes = sum(a * k for a, k in zip(before, derivatives, strict=True))
            by_sigma = row[END] * by_xi + h[:, :, None] * slopes
            by_field = np.zeros_like(by_xi)
            if inside:
                by_field += by_x @ group.right_jacobian(sigma) @ by_sigma
                by_field[:, :, :dim] += by_x @ group.adjoint(group.exp(-sigma))
            else:
                by_field[:, :, -dim if row[END] else 0 : None if row[END] else dim] = by_x
            if by_inputs:
                by_field[:, :, ahead] += np.concatenate(by_inputs, axis=2)
            derivatives.append(by_field if flat else weight @ by_field + self._bend(sigma, speed) @ by_sigma)
            by_defect = by_defect - (h * row[WEIGHT])[:, :, None] * derivatives[-1]
        return defect, by_defect

    def _field_derivatives(self, x: Array, inputs: Sequence[Array]) -> Sequence[Array]:
        if self.derivative is not None:
            return self.derivative(x, *inputs)
        spaces: list[Manifold] = [self.group, *(Rn(part.shape[1]) for part in inputs)]
        return jacobian(self.field, [x, *inputs], spaces)

    def _bend(self, sigma: Array, velocity: Array) -> Array:
        """(n, dim, dim) derivative of dexp_inv(sigma) v along sigma, by differences of the closed form."""
        inverse_jacobian = self.group.right_jacobian_inverse
        columns = []
        for direction in BEND_STEP * np.eye(self.group.dim):
            near = inverse_jacobian(sigma + direction) - inverse_jacobian(sigma - direction)
            far = inverse_jacobian(sigma + 2.0 * direction) - inverse_jacobian(sigma - 2.0 * direction)
            columns.append(times((8.0 * near - far) / (12.0 * BEND_STEP), velocity))
        return np.stack(columns, axis=-1)


def times(matrices: Array, vectors: Array) -> Array:
    """(n, d) products of (n, d, d) matrices and (n, d) vectors."""
    product: Array = np.einsum("nij,nj->ni", matrices, vectors)
    return product
