"""One step of a Runge-Kutta-Munthe-Kaas method, in NumPy: traced where F can be, and its derivatives where it cannot.

The derivatives follow the stages by the chain rule, in the columns (x_i, inputs, x_{i+1}): with xi' the derivatives of
xi and sigma' those of sigma,

    xi' = (-Jr^-1(xi) Ad(x_{i+1}^-1 x_i), 0, Jr^-1(xi)),
    F' = F_x (Ad(Exp(-sigma)) x_i' + Jr(sigma) sigma') + F_u u',
    k' = dexp_inv(sigma) F' + (d/dsigma dexp_inv(sigma) F) sigma'.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np

from unifg.kernels.differences import jacobian
from unifg.lie import LieGroup, Manifold, Rn
from unifg.typing import Array

Field: TypeAlias = Callable[..., Array]
FieldJacobian: TypeAlias = Callable[..., Sequence[Array]]
Rows: TypeAlias = Sequence[Sequence[float]]
WEIGHT, END, FLAT, BEFORE = 0, 1, 2, 3  # columns of Tableau.rows

BEND_STEP = 2e-3
"""Of fourth-order differences of dexp_inv, whose scale is its singularity at 2 pi: the error is near 1e-13."""


def step_defect(group: LieGroup, field: Field, rows: Rows, x: Array, *rest: Any) -> Array:
    """Xi - h Phi of (x, inputs, x_next, h), (n, dim).

    Args:
        group: of x and x_next.
        field: F(x, inputs), (n, dim).
        rows: of the method's :class:`~unifg.models.tableau.Tableau`.
        x: (n, storage).
        rest: inputs (n, k) each, x_next (n, storage), h one or (n,).
    """
    *inputs, after, step = rest
    x, after, *inputs = alike(x, after, *inputs)
    xi = group.local(x, after)
    defect = xi
    for part in _parts(group, field, rows, x, inputs, np.reshape(step, (-1, 1)), xi, after):
        defect = defect - part
    return defect


def travel(group: LieGroup, field: Field, rows: Rows, x: Array, *rest: Any) -> Array:
    """H Phi of (x, inputs, h), (n, dim), for an explicit method."""
    *inputs, step = rest
    x, *inputs = alike(x, *inputs)
    total: Array = sum(_parts(group, field, rows, x, inputs, np.reshape(step, (-1, 1))))  # type: ignore[assignment]
    return total


def alike(*parts: Array) -> list[Array]:
    """The same arrays, those of a single row repeated."""
    count = max(len(part) for part in parts)
    return [np.broadcast_to(part, (count, part.shape[1])) for part in parts]


def _parts(
    group: LieGroup,
    field: Field,
    rows: Rows,
    x: Array,
    inputs: Sequence[Array],
    h: Array,
    xi: Array | float = 0.0,
    after: Array | None = None,
) -> Iterator[Array]:
    """H b k of every stage, (n, dim)."""
    speeds: list[Array] = []
    for row in rows:
        before = row[BEFORE : BEFORE + len(speeds)]
        inside = any(before) or row[END] not in (0.0, 1.0)
        sigma = row[END] * xi + h * sum(a * k for a, k in zip(before, speeds, strict=True))
        point = group.retract(x, sigma) if inside else after if row[END] else x
        speed = field(point, *inputs)
        if (inside or row[END]) and not row[FLAT]:
            speed = times(group.right_jacobian_inverse(sigma), speed)
        speeds.append(speed)
        yield h * row[WEIGHT] * speed


class StepJacobian:
    """Derivatives of :func:`step_defect`; picklable when the field is.

    Args:
        group: of x and x_next.
        field: F(x, inputs), (n, dim).
        rows: of the method.
        derivative: of F along x and every input; None: by differences.
    """

    def __init__(self, group: LieGroup, field: Field, rows: Rows, derivative: FieldJacobian | None) -> None:
        """Keep them."""
        self.group, self.field, self.rows, self.derivative = group, field, rows, derivative

    def __call__(self, x: Array, *rest: Any) -> list[Array]:
        """(n, dim, d) derivatives along x, every input and x_next."""
        *inputs, after, step = rest
        group, dim = self.group, self.group.dim
        x, after, *inputs = alike(x, after, *inputs)
        h = np.reshape(step, (-1, 1))  # one, or one for each factor
        ahead = slice(dim, -dim)  # columns of the inputs
        xi = group.local(x, after)
        by_xi = np.zeros((len(x), dim, 2 * dim + sum(part.shape[1] for part in inputs)))
        inverse = group.right_jacobian_inverse(xi)  # Log(x^-1 x_next Exp(d)) = xi + dexp_inv(xi) d
        by_xi[:, :, :dim] = -inverse @ group.adjoint(group.between(after, x))
        by_xi[:, :, -dim:] = inverse
        by_defect = by_xi.copy()
        speeds: list[Array] = []
        derivatives: list[Array] = []
        for row in self.rows:
            before = row[BEFORE : BEFORE + len(speeds)]
            inside = any(before) or row[END] not in (0.0, 1.0)
            sigma = row[END] * xi + h * sum(a * k for a, k in zip(before, speeds, strict=True))
            point = group.retract(x, sigma) if inside else after if row[END] else x
            speed = self.field(point, *inputs)
            flat = bool(row[FLAT]) or not (inside or row[END])
            weight = group.right_jacobian_inverse(sigma)
            speeds.append(speed if flat else times(weight, speed))
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
        ends = np.cumsum([dim, *(part.shape[1] for part in inputs)])
        return np.split(by_defect, ends, axis=2)

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
