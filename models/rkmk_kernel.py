"""One step of a Runge-Kutta-Munthe-Kaas method, for one factor at a time, compiled.

The derivatives follow the stages by the chain rule, in the columns (x_i, inputs, x_{i+1}): with xi' the derivatives of
xi and sigma' those of sigma,

    xi' = (-Jr^-1(xi) Ad(x_{i+1}^-1 x_i), 0, Jr^-1(xi)),
    F' = F_x (Ad(Exp(-sigma)) x_i' + Jr(sigma) sigma') + F_u u',
    k' = dexp_inv(sigma) F' + (d/dsigma dexp_inv(sigma) F) sigma'.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from unifg.lie import LieGroup, rn
from unifg.lie.functions import Functions
from unifg.machine.calls import local_matrix, local_vector, vector
from unifg.machine.jit import compiled
from unifg.models.compiled_field import CompiledField, differences
from unifg.typing import Array

WEIGHT, END, FLAT, BEFORE = 0, 1, 2, 3  # columns of Tableau.rows
AT_START, AT_END, BETWEEN = 0, 1, 2


@compiled
def add_product(first: Array, second: Array, scale: float, out: Array, row: int, column: int, columns: int) -> None:
    """Add ``scale first second``, its first ``columns`` columns, to ``out`` from a row and a column on."""
    for i in range(first.shape[0]):
        for j in range(first.shape[1]):
            factor = scale * first[i, j]
            if factor == 0.0:  # products of groups have block-diagonal matrices
                continue
            for k in range(columns):
                out[row + i, column + k] += factor * second[j, k]


@compiled
def place(row: Array, h: float, xi: Array, k: Array, stage: int, sigma: Array) -> int:
    """Write sigma of a stage; tell whether it stands at the start of the step, at its end, or between them."""
    end = row[END]
    where = AT_START if end == 0.0 else AT_END if end == 1.0 else BETWEEN
    for i in range(len(sigma)):
        sigma[i] = end * xi[i]
    for t in range(stage):
        if row[BEFORE + t] != 0.0:
            where = BETWEEN
            for i in range(len(sigma)):
                sigma[i] += h * row[BEFORE + t] * k[t, i]
    return where


@compiled
def place_derivative(row: Array, h: float, by_xi: Array, by_k: Array, stage: int, columns: int, out: Array) -> None:
    """Write sigma' of a stage."""
    dim = len(out)
    for i in range(dim):
        for d in range(columns):
            out[i, d] = row[END] * by_xi[i, d]
        for t in range(stage):
            scale = h * row[BEFORE + t]
            if scale != 0.0:
                for d in range(columns):
                    out[i, d] += scale * by_k[t * dim + i, d]


@cache
def difference_of(functions: Functions, storage: int, dim: int, inputs: int) -> Callable[..., None]:
    """``difference(x, x_next, out)``: xi' in the columns (x, inputs, x_next)."""
    local, between, adjoint = functions.local, functions.between, functions.adjoint
    inverse_jacobian = functions.right_jacobian_inverse

    @compiled
    def difference(x: Array, after: Array, out: Array) -> None:
        xi, pose = local_vector(dim), local_vector(storage)
        inverse, transport = local_matrix(dim, dim), local_matrix(dim, dim)
        local(x, after, xi)
        inverse_jacobian(xi, inverse)
        between(after, x, pose)
        adjoint(pose, transport)
        out[:] = 0.0
        add_product(inverse, transport, -1.0, out, 0, 0, dim)
        for i in range(dim):
            for d in range(dim):
                out[i, dim + inputs + d] = inverse[i, d]

    return difference


@cache
def move_of(functions: Functions, storage: int, dim: int) -> Callable[..., None]:
    """``move(sigma, by_x, by_sigma, columns, out)``: add F_x (Ad(Exp(-sigma)) x' + Jr(sigma) sigma') to F'."""
    exp, adjoint, jacobian = functions.exp, functions.adjoint, functions.right_jacobian

    @compiled
    def move(sigma: Array, by_x: Array, by_sigma: Array, columns: int, out: Array) -> None:
        back, pose = local_vector(dim), local_vector(storage)
        factor, product = local_matrix(dim, dim), local_matrix(dim, dim)
        for i in range(dim):
            back[i] = -sigma[i]
        exp(back, pose)
        adjoint(pose, factor)
        add_product(by_x, factor, 1.0, out, 0, 0, dim)
        jacobian(sigma, factor)
        product[:] = 0.0
        add_product(by_x, factor, 1.0, product, 0, 0, dim)
        add_product(product, by_sigma, 1.0, out, 0, 0, columns)

    return move


@cache
def step_kernel(functions: Functions, field: CompiledField, group: LieGroup, room: int) -> Callable[..., None]:
    """The defect xi - h Phi of a step, and its derivatives, for all methods of so many stages or fewer.

    The kernel takes x, the inputs and x_next as variables, h as parameter and the rows of a
    :class:`~unifg.models.tableau.Tableau` as table.

    Args:
        functions: of the group, from :func:`unifg.lie.functions.functions_of`.
        field: F.
        group: of the states.
        room: for stages; one compiled function then serves many methods.
    """
    velocity, dim, inputs, storage = field.function, field.dim, field.controls, group.storage
    local, retract, unit = functions.local, functions.retract, rn.unit
    inverse_jacobian, bend = functions.right_jacobian_inverse, functions.bend
    derivative = field.derivative or differences(field, group)
    difference, move = difference_of(functions, storage, dim, inputs), move_of(functions, storage, dim)
    width, all_rows = 2 * dim + inputs, room * dim

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        x, u, after = vector(v, 0, storage), vector(v, storage, inputs), vector(v, storage + inputs, storage)
        xi, sigma, speed, point = local_vector(dim), local_vector(dim), local_vector(dim), local_vector(storage)
        k, weight = local_matrix(room, dim), local_matrix(dim, dim)
        by_x, by_u, by_field = local_matrix(dim, dim), local_matrix(dim, inputs), local_matrix(dim, width)
        by_xi, by_sigma, by_k = local_matrix(dim, width), local_matrix(dim, width), local_matrix(all_rows, width)
        stages = 1
        while stages * (BEFORE + stages) < len(table):
            stages += 1
        length = BEFORE + stages
        h, columns = p[0], dim + inputs  # an explicit velocity knows nothing of x_next
        for s in range(stages):
            if table[s * length + END] != 0.0:
                columns = width
        local(x, after, xi)
        for i in range(dim):
            r[i] = xi[i]
        if len(J):
            difference(x, after, by_xi)
            J[:] = by_xi

        for s in range(stages):
            row = vector(table, s * length, length)
            share, flat = h * row[WEIGHT], row[FLAT] != 0.0
            where = place(row, h, xi, k, s, sigma)
            if where == BETWEEN:
                retract(x, sigma, point)
            else:
                for i in range(storage):
                    point[i] = x[i] if where == AT_START else after[i]
            velocity(point, u, speed)
            flat = flat or where == AT_START
            if flat:
                unit(sigma, weight)
            else:
                inverse_jacobian(sigma, weight)
            for i in range(dim):
                total = 0.0
                for j in range(dim):
                    total += weight[i, j] * speed[j]
                k[s, i] = total
                r[i] = rn.minus(r[i], share * total)
            if len(J) == 0:
                continue

            derivative(point, u, by_x, by_u)
            place_derivative(row, h, by_xi, by_k, s, columns, by_sigma)
            by_field[:] = 0.0
            for i in range(dim):
                for d in range(inputs):
                    by_field[i, dim + d] = by_u[i, d]
            if where == BETWEEN:
                move(sigma, by_x, by_sigma, columns, by_field)
            else:
                column = 0 if where == AT_START else dim + inputs
                for i in range(dim):
                    for d in range(dim):
                        by_field[i, column + d] = by_x[i, d]
            for i in range(dim):
                for d in range(columns):
                    by_k[s * dim + i, d] = 0.0
            add_product(weight, by_field, 1.0, by_k, s * dim, 0, columns)
            if not flat:
                bend(sigma, speed, by_x)
                add_product(by_x, by_sigma, 1.0, by_k, s * dim, 0, columns)
            for i in range(dim):
                for d in range(columns):
                    J[i, d] -= share * by_k[s * dim + i, d]

    return kernel


@cache
def rollout_kernel(kernel: Callable[..., None], functions: Functions, storage: int, dim: int) -> Callable[..., None]:
    """``rollout(v, p, table, u, states)``: take explicit steps, several for every row of the inputs.

    From x to itself the defect is -h Phi, so the step is x Exp(-defect).
    """
    retract = functions.retract

    @compiled
    def rollout(x: Array, h: float, table: Array, u: Array, substeps: int, states: Array) -> None:
        inputs = u.shape[1]
        v, p, r, J = np.empty(2 * storage + inputs), np.empty(1), np.empty(dim), np.empty((0, 0))
        p[0] = h
        for i in range(storage):
            states[0, i] = x[i]
            v[i] = x[i]
        for n in range(len(states) - 1):
            for i in range(inputs):
                v[storage + i] = u[n, i]
            for _ in range(substeps):
                for i in range(storage):
                    v[storage + inputs + i] = v[i]
                kernel(v, p, table, r, J)
                for i in range(dim):
                    r[i] = -r[i]
                retract(vector(v, 0, storage), r, vector(v, 0, storage))
            for i in range(storage):
                states[n + 1, i] = v[i]

    return rollout
