"""The implicit trapezoid on a Lie group (Ta et al. 2014, section III).

The state obeys x' = x hat(F(x, u)), F in the Lie algebra and trivialised on the left (eq. 9). In the exponential
coordinates x(t) = x_i Exp(xi(t)) (eq. 10) this is a differential equation in a vector space,

    xi' = dexp_inv(xi) F(x_i Exp(xi), u),   xi(0) = 0                                             (eq. 15, 17)

with Exp(xi)^-1 Exp(xi + d) = Exp(dexp(xi) d): Ta's dexp is the *right* Jacobian and its inverse is
I + ad/2 + ad^2/12 - ...; the formula he cites, (4.5) on page 84 of his [12], trivialises on the right and has -ad/2.
The trapezoid rule with the control held over the step, and eq. 16 for xi, give the two residuals

    full:        xi - h/2 (F(x_i, u) + dexp_inv(xi) F(x_{i+1}, u))      with xi = Log(x_i^-1 x_{i+1})
    simplified:  xi - h/2 (F(x_i, u) + F(x_{i+1}, u))

Both are of second order: dropping dexp_inv changes the step by h^3/8 [F, F'] to leading order, as small as the
trapezoid's own error. Both are exact where F does not depend on the state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import numpy as np

from unifg.differentiation import FIRST_STEP, jacobian
from unifg.lie import LieGroup, Rn
from unifg.residuals import Residual, residual
from unifg.typing import Array

Field: TypeAlias = Callable[[Array, Array], Array]
FieldJacobian: TypeAlias = Callable[[Array, Array], Sequence[Array]]
Form: TypeAlias = Literal["full", "simplified"]


class _Trapezoid:
    def __init__(self, group: LieGroup, field: Field, form: Form, derivative: FieldJacobian | None) -> None:
        self.group = group
        self.field = field
        self.full = form == "full"
        self.derivative = derivative

    def __call__(self, x: Array, u: Array, x_next: Array, step: float) -> Array:
        tangent = self.group.local(x, x_next)
        ahead = self.field(x_next, u)
        if self.full:
            ahead = _times(self.group.right_jacobian_inverse(tangent), ahead)
        return tangent - 0.5 * step * (self.field(x, u) + ahead)

    def jacobian(self, x: Array, u: Array, x_next: Array, step: float) -> list[Array]:
        group = self.group
        tangent = group.local(x, x_next)
        inverse = group.right_jacobian_inverse(tangent)
        by_next = inverse  # Log(x^-1 x_next Exp(d)) = xi + dexp_inv(xi) d
        by_before = -inverse @ group.adjoint(group.between(x_next, x))
        field_x, field_u = self._field_derivatives(x, u)
        next_x, next_u = self._field_derivatives(x_next, u)
        half = 0.5 * step
        if not self.full:
            return [by_before - half * field_x, -half * (field_u + next_u), by_next - half * next_x]
        bend = self._bend(tangent, self.field(x_next, u))
        return [
            by_before - half * (field_x + bend @ by_before),
            -half * (field_u + inverse @ next_u),
            by_next - half * (bend @ by_next + inverse @ next_x),
        ]

    def _field_derivatives(self, x: Array, u: Array) -> Sequence[Array]:
        if self.derivative is not None:
            return self.derivative(x, u)
        return jacobian(self.field, [x, u], [self.group, Rn(u.shape[1])])

    def _bend(self, tangent: Array, velocity: Array) -> Array:
        """(n, dim, dim) derivative of dexp_inv(xi) v along xi, by central differences of the closed form."""
        columns = []
        for direction in FIRST_STEP * np.eye(self.group.dim):
            ahead = self.group.right_jacobian_inverse(tangent + direction)
            behind = self.group.right_jacobian_inverse(tangent - direction)
            columns.append(_times(ahead - behind, velocity) / (2.0 * FIRST_STEP))
        return np.stack(columns, axis=-1)


def _times(matrices: Array, vectors: Array) -> Array:
    """(n, d) products of (n, d, d) matrices and (n, d) vectors."""
    product: Array = np.einsum("nij,nj->ni", matrices, vectors)
    return product


def trapezoid(group: LieGroup, field: Field, form: Form = "full", jacobian: FieldJacobian | None = None) -> Residual:
    """``trapezoid(group, F)(x, u, x_next, h)``: defect of one implicit step, (n, dim).

    Use it with ``constrain(..., lower=0, upper=0)`` or, soft, with ``minimize``.

    Args:
        group: of the states x and x_next, (n, storage).
        field: F(x, u), velocities in the body frame, (n, dim), for states (n, storage) and controls (n, k).
        form: "full" with dexp_inv, "simplified" without; both of second order in the step h [s].
        jacobian: (n, dim, dim) and (n, dim, k) derivatives of F along the right perturbation of x and along u;
            by differences when absent.

    Raises:
        ValueError: on an unknown form.
    """
    if form not in ("full", "simplified"):
        raise ValueError(f"trapezoid: form must be 'full' or 'simplified', found {form!r}")
    function = _Trapezoid(group, field, form, jacobian)
    return residual(function, function.jacobian, f"{form} trapezoid")


def unicycle_field(x: Array, u: Array) -> Array:
    """F of a unicycle on SE(2), (n, 3): (v, 0, omega) for controls (n, 2) [m/s, rad/s], whatever the pose."""
    velocity = np.zeros((len(u), 3))
    velocity[:, 0], velocity[:, 2] = u[:, 0], u[:, 1]
    return velocity


def unicycle_field_jacobian(x: Array, u: Array) -> list[Array]:
    """Derivatives of :func:`unicycle_field` along the pose (n, 3, 3) and the control (n, 3, 2)."""
    control = np.zeros((len(u), 3, 2))
    control[:, 0, 0] = control[:, 2, 1] = 1.0
    return [np.zeros((len(u), 3, 3)), control]
