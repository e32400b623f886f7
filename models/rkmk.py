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
from functools import cache
from types import ModuleType
from typing import Literal, TypeAlias

import numpy as np

from unifg.calls import local_matrix, local_vector, vector
from unifg.differentiation import FIRST_STEP, jacobian
from unifg.jit import compiled
from unifg.kernels import Kernel
from unifg.lie import LieGroup, Rn
from unifg.lie.lookup import functions_of
from unifg.lie.scalar import rn as scalar_rn
from unifg.models.compiled_field import CompiledField, differences
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
        field: F(x, u), velocities in the body frame, (n, dim), for states (n, storage) and controls (n, k). A
            :class:`CompiledField` makes the residual a kernel, where the group has compiled functions too.
        form: "full" with dexp_inv, "simplified" without; both of second order in the step h [s].
        jacobian: (n, dim, dim) and (n, dim, k) derivatives of F along the right perturbation of x and along u;
            by differences when absent. A compiled field brings its own.

    Raises:
        ValueError: on an unknown form, or a compiled field whose dimension is not that of the group.
    """
    if form not in ("full", "simplified"):
        raise ValueError(f"trapezoid: form must be 'full' or 'simplified', found {form!r}")
    name = f"{form} trapezoid"
    if isinstance(field, CompiledField):
        if field.dim != group.dim:
            raise ValueError(f"trapezoid: the field has {field.dim} velocities, {group.name} takes {group.dim}")
        functions = scalar_rn if isinstance(group, Rn) else functions_of(group)
        if functions is not None and jacobian in (None, field.jacobian):
            kernel = _kernel(functions, field, group.storage, form == "full")
            return residual(Kernel(kernel, (group, Rn(field.controls), group, 0), group.dim, name=name))
        jacobian = jacobian or (field.jacobian if field.derivative is not None else None)
    function = _Trapezoid(group, field, form, jacobian)
    return residual(function, function.jacobian, name)


# ---------------------------------------------------------------- compiled


@compiled
def _add_product(first: Array, second: Array, scale: float, out: Array, column: int) -> None:
    """Add ``scale`` times a product to the columns of ``out`` from ``column`` on."""
    for i in range(len(out)):
        for j in range(len(second)):
            factor = scale * first[i, j]
            for k in range(second.shape[1]):
                out[i, column + k] += factor * second[j, k]


@cache
def _kernel(functions: ModuleType, field: CompiledField, storage: int, full: bool) -> Callable[..., None]:
    """Write the defect of a step, ``xi - h/2 (F + W F')``, and its derivatives; W is dexp_inv(xi) or I."""
    local, between, adjoint = functions.local, functions.between, functions.adjoint
    inverse_jacobian, unit = functions.right_jacobian_inverse, scalar_rn.unit
    velocity, dim, controls, step = field.function, field.dim, field.controls, FIRST_STEP
    derivative = field.derivative or differences(field, functions, storage)

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        x, u, after = vector(v, 0, storage), vector(v, storage, controls), vector(v, storage + controls, storage)
        tangent, here, ahead = local_vector(dim), local_vector(dim), local_vector(dim)
        weight = local_matrix(dim, dim)
        half = 0.5 * p[0]
        local(x, after, tangent)
        velocity(x, u, here)
        velocity(after, u, ahead)
        if full:
            inverse_jacobian(tangent, weight)
        else:
            unit(weight)
        for i in range(dim):
            total = here[i]
            for j in range(dim):
                total += weight[i, j] * ahead[j]
            r[i] = tangent[i] - half * total
        if len(J) == 0:
            return

        by_x, by_u, inverse = local_matrix(dim, dim), local_matrix(dim, controls), local_matrix(dim, dim)
        by_tangent, by_next, transport = local_matrix(dim, dim), local_matrix(dim, dim), local_matrix(dim, dim)
        unit(by_tangent)
        if full:  # the derivative of W F' along xi, by differences of the closed form
            for d in range(dim):
                held = tangent[d]
                tangent[d] = held + step
                inverse_jacobian(tangent, by_x)
                tangent[d] = held - step
                inverse_jacobian(tangent, inverse)
                tangent[d] = held
                for i in range(dim):
                    bend = 0.0
                    for j in range(dim):
                        bend += (by_x[i, j] - inverse[i, j]) * ahead[j]
                    by_tangent[i, d] -= half * bend / (2.0 * step)
        inverse_jacobian(tangent, inverse)
        pose = local_vector(storage)
        between(after, x, pose)
        adjoint(pose, transport)
        for i in range(dim):
            for k in range(dim):
                by_next[i, k] = 0.0
            for k in range(2 * dim + controls):
                J[i, k] = 0.0
        _add_product(by_tangent, inverse, 1.0, by_next, 0)  # Log(x^-1 x_next Exp(d)) = xi + dexp_inv(xi) d
        _add_product(by_next, transport, -1.0, J, 0)
        derivative(after, u, by_x, by_u)
        _add_product(weight, by_u, -half, J, dim)
        _add_product(weight, by_x, -half, J, dim + controls)
        derivative(x, u, by_x, by_u)
        for i in range(dim):
            for k in range(dim):
                J[i, k] -= half * by_x[i, k]
                J[i, dim + controls + k] += by_next[i, k]
            for k in range(controls):
                J[i, dim + k] -= half * by_u[i, k]

    return kernel


@compiled
def _unicycle(x: Array, u: Array, out: Array) -> None:
    out[0] = u[0]
    out[1] = 0.0
    out[2] = u[1]


@compiled
def _unicycle_derivative(x: Array, u: Array, by_x: Array, by_u: Array) -> None:
    for i in range(3):
        for j in range(3):
            by_x[i, j] = 0.0
        by_u[i, 0] = 1.0 if i == 0 else 0.0
        by_u[i, 1] = 1.0 if i == 2 else 0.0


unicycle_field = CompiledField(_unicycle, 3, 2, _unicycle_derivative)
"""F of a unicycle on SE(2), (n, 3): (v, 0, omega) for controls (n, 2) [m/s, rad/s], whatever the pose."""

unicycle_field_jacobian = unicycle_field.jacobian
"""Derivatives of :data:`unicycle_field` along the pose (n, 3, 3) and the control (n, 3, 2)."""
