"""Second derivatives that Gauss-Newton leaves out: sum of w_a times the Hessian of r_a, for every factor.

The weights w are the multipliers of constraints and the whitened residuals of costs, carried back through the
whitening. The Hessian is that of t -> r(x Exp(t)), symmetric; a kernel that does not come with it has its Jacobian
differenced along every tangent direction.
"""

from __future__ import annotations

import numpy as np

from unifg.calls import call_residual, call_retraction, matrix, vector, vector_at
from unifg.jit import compiled
from unifg.passes import gather_variables
from unifg.table import (
    ACTIVE,
    ADDRESS,
    COST,
    COUNT,
    KEEP,
    KERNEL_WIDTH,
    KIND,
    LEAF,
    LEAVES,
    PARAMETER,
    PARAMETERS,
    POSITION,
    ROW,
    ROWS,
    SECOND,
    SPREAD,
    STORAGE,
    TABLE,
    TABLE_SIZE,
    WEIGHT,
    WHITEN,
    WHITENER,
    WIDTH,
    Terms,
)
from unifg.typing import Array, IntArray
from unifg.whitening import DIAGONAL, FULL

STEP = 1e-7  # truncation and rounding both near 1e-8 of the Jacobian


@compiled
def add_curvature(terms: Terms, values: Array, residual: Array, multipliers: Array, hessian: Array) -> None:
    """Add the curvature of every term with a kernel, robust costs excepted, to the entries of the normal matrix."""
    fields = terms.fields
    storage = rows = width = 1
    for t in range(len(fields)):
        storage, rows = max(storage, fields[t, STORAGE]), max(rows, fields[t, ROWS])
        width = max(width, fields[t, KERNEL_WIDTH])
    v, moved, step = np.empty(storage), np.empty(storage), np.empty(width)
    weights, r, gradient = np.empty(rows), np.empty(rows), np.empty(width)
    J, second = np.empty(rows * width), np.empty(width * width)
    for t in range(len(fields)):
        term = fields[t]
        if term[LEAVES] == 0 or term[ADDRESS] == 0 or (term[KIND] == COST and term[WEIGHT] >= 0):
            continue
        m, full, table = term[ROWS], term[KERNEL_WIDTH], vector_at(term[TABLE], term[TABLE_SIZE])
        S = matrix(second, 0, full, full)
        for i in range(term[COUNT]):
            if term[ACTIVE] >= 0 and terms.active[term[ACTIVE] + i] == 0:
                continue
            at = term[ROW] + i * m
            if term[KIND] == COST:
                carry_back(term, i, terms.whiteners, vector(residual, at, m), weights)
            else:
                for a in range(m):
                    weights[a] = multipliers[at + a]
            largest = 0.0
            for a in range(m):
                largest = max(largest, abs(weights[a]))
            if largest == 0.0:
                continue
            p = vector(terms.parameters, term[PARAMETER] + i * term[SPREAD], term[PARAMETERS])
            gather_variables(term, i, terms.gather, terms.sizes, terms.parameters, values, v)
            if term[SECOND] != 0:
                call_residual(term[SECOND], vector(v, 0, term[STORAGE]), p, table, vector(weights, 0, m), S)
            else:
                _second(terms.leaves, term, p, table, v, moved, step, weights, r, gradient, J, S)
            _write(terms.sizes, terms.positions, term, i, S, hessian)


@compiled
def carry_back(term: IntArray, i: int, whiteners: Array, residual: Array, out: Array) -> None:
    """W' r for a whitened residual r."""
    m, kind, spread = len(residual), term[WHITEN], term[WHITEN] & 1
    for b in range(m):
        out[b] = residual[b]
    if kind & DIAGONAL:
        start = term[WHITENER] + i * spread * m
        for b in range(m):
            out[b] *= whiteners[start + b]
    elif kind & FULL:
        start = term[WHITENER] + i * spread * m * m
        for b in range(m):
            out[b] = 0.0
            for a in range(b + 1):
                out[b] += whiteners[start + a * m + b] * residual[a]


@compiled
def _second(
    leaves: IntArray,
    term: IntArray,
    p: Array,
    table: Array,
    v: Array,
    moved: Array,
    step: Array,
    weights: Array,
    r: Array,
    gradient: Array,
    J: Array,
    second: Array,
) -> None:
    """Derivative of J' w along every tangent direction of one factor, row by row."""
    m, width, storage = term[ROWS], term[KERNEL_WIDTH], term[STORAGE]
    call_residual(term[ADDRESS], vector(v, 0, storage), p, table, vector(r, 0, m), matrix(J, 0, m, width))
    for d in range(width):
        gradient[d] = 0.0
        for a in range(m):
            gradient[d] += weights[a] * J[a * width + d]
    for k in range(storage):
        moved[k] = v[k]
    for leaf in range(term[LEAF], term[LEAF] + term[LEAVES]):
        where, start, size, dim, column = leaves[leaf]
        for c in range(dim):
            for k in range(dim):
                step[k] = STEP if k == c else 0.0
            if where == 0:
                for k in range(size):
                    moved[start + k] = v[start + k] + step[k]
            else:
                call_retraction(where, vector(v, start, size), vector(step, 0, dim), vector(moved, start, size))
            call_residual(term[ADDRESS], vector(moved, 0, storage), p, table, vector(r, 0, m), matrix(J, 0, m, width))
            for d in range(width):
                total = -gradient[d]
                for a in range(m):
                    total += weights[a] * J[a * width + d]
                second[column + c, d] = total / STEP
        for k in range(start, start + size):
            moved[k] = v[k]


@compiled
def _write(sizes: IntArray, positions: IntArray, term: IntArray, i: int, second: Array, hessian: Array) -> None:
    """Add the symmetric part to the entries of the factor's pairs of columns."""
    width, keep = term[WIDTH], term[KEEP]
    at = term[POSITION] + i * (width * (width + 1) // 2)
    for d in range(width):
        row = d if keep < 0 else sizes[keep + d]
        for e in range(d + 1):
            column = e if keep < 0 else sizes[keep + e]
            where = positions[at]
            at += 1
            if where >= 0:
                hessian[where] += 0.5 * (second[row, column] + second[column, row])
            elif where != -1:
                hessian[-2 - where] += second[row, column] + second[column, row]
