"""The Hessian of the Lagrangian: what Gauss-Newton leaves out is sum of w_a times the Hessian of r_a, for every factor.

The weights w are the multipliers of constraints and the whitened residuals of costs, times their robust weights,
carried back through the whitening. The Hessian is that of t -> r(x Exp(t)), symmetric. A kernel that does not come with
it has its Jacobian differenced along every tangent direction; where that is made of differences itself, the residual is
differenced twice. A robust loss adds the slope of its weight (:func:`add_losses`).
"""

from __future__ import annotations

from math import sqrt
from time import perf_counter

import numpy as np

from unifg.codegen.calls import call_residual, call_retraction, matrix, vector, vector_at
from unifg.codegen.jit import compiled, in_order, inlined
from unifg.factors.robust import bend_of, form_of
from unifg.factors.steps import (
    ANGLE,
    ONE_SIDED,
    OTHER,
    TURN,
    VECTOR,
    largest,
    move,
    rotation,
    step_for,
    step_of,
    to_body,
)
from unifg.factors.steps import SECOND as TWICE
from unifg.factors.whitening import DIAGONAL, FULL
from unifg.lie.so2 import wrap
from unifg.modeling.terms import Cost
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import gather_variables
from unifg.problem.linearization import Linearization
from unifg.problem.table import (
    ACTIVE,
    ADDRESS,
    COST,
    COUNT,
    DIFFERENCED,
    ENTRY,
    KEEP,
    KERNEL_WIDTH,
    KIND,
    LOSS,
    LOSS_AT,
    PARAMETER,
    PARAMETERS,
    PART,
    PARTS,
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
    TermArrays,
)
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray


def lagrangian_hessian(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
    """Hessian of the objective plus multipliers' g, in the order of ``CompiledProblem.normal``.

    Terms evaluated by NumPy are differenced in batches. Weights of losses whose formulas are Python count as constant.

    Args:
        program: the compiled graph.
        lin: where.
        multipliers: (M,).
    """
    program.table.require_second()
    entries = lin.hessian + lin.concavity if len(lin.concavity) else lin.hessian.copy()
    add_curvature(program.arrays, lin.values.flat, lin.residual, lin.weights, multipliers, entries)
    if program.table.robust:
        add_losses(program.arrays, lin.residual, lin.jacobian, lin.squares, lin.weights, entries)
    for term in program.batched:
        _add(program, term, lin, multipliers, entries)
    return entries


def constraint_curvature(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
    """Hessian of multipliers' g alone, in the order of ``CompiledProblem.normal``; arguments as above."""
    program.table.require_second()
    entries = np.zeros(program.normal.nnz)
    add_curvature(program.arrays, lin.values.flat, np.zeros(len(lin.residual)), lin.weights, multipliers, entries)
    for term in program.batched:
        if not isinstance(term.term, Cost):
            _add(program, term, lin, multipliers, entries)
    return entries


def _add(program: CompiledProblem, term: CompiledTerm, lin: Linearization, multipliers: Array, entries: Array) -> None:
    """Second derivatives of a term without a kernel."""
    began = perf_counter()
    second = term.second_derivatives(lin.values, row_weights(program, term, lin, multipliers))
    program.python_seconds += perf_counter() - began
    if second.any():
        program.add_pairs(term, second, entries)


def row_weights(program: CompiledProblem, term: CompiledTerm, lin: Linearization, multipliers: Array) -> Array:
    """(n, m) what the Hessian of every row of a term counts in that of the Lagrangian."""
    if not isinstance(term.term, Cost):
        return program.rows_of(term, lin.residual, multipliers)
    weights = term.carry_back(program.rows_of(term, lin.residual, lin.constraints))
    return weights if term.term.robust is None else weights * np.sqrt(_of_factors(term, lin.weights))[:, None]


def loss_curvature(term: CompiledTerm, lin: Linearization) -> Array:
    """(n, D, D) of one robust term what :func:`add_losses` adds for all."""
    m, width, start = (int(term.place[field]) for field in (ROWS, WIDTH, ENTRY))
    J = lin.jacobian[start : start + term.count * m * width].reshape(term.count, m, width)
    r = lin.residual[term.place[ROW] : term.place[ROW] + term.count * m].reshape(term.count, m)
    weights, form = _of_factors(term, lin.weights), form_of(term.term.robust) if isinstance(term.term, Cost) else None
    if form is None:
        return np.zeros((term.count, width, width))
    slope = np.einsum("nad,na->nd", J, r) / np.where(weights == 0.0, np.inf, weights)[:, None]
    bends = np.array([2.0 * bend_of(*form, squared) for squared in _of_factors(term, lin.squares)])
    return np.asarray(bends[:, None, None] * slope[:, :, None] * slope[:, None, :])


def _of_factors(term: CompiledTerm, robust: Array) -> Array:
    """(n,) of an array with one number for every robust factor."""
    return robust[term.place[WEIGHT] : term.place[WEIGHT] + term.count]


@compiled
def add_curvature(
    terms: TermArrays, values: Array, residual: Array, robust: Array, multipliers: Array, hessian: Array
) -> None:
    """Add the curvature of every term with a kernel to the entries of the normal matrix.

    Args:
        terms: of the program.
        values: stored ones.
        residual: as linearised, whitened and scaled by the square roots of robust weights.
        robust: those weights.
        multipliers: (M,) of the constraint rows.
        hessian: entries to add to.
    """
    fields = terms.fields
    storage = rows = width = 1
    for t in range(len(fields)):
        storage, rows = max(storage, fields[t, STORAGE]), max(rows, fields[t, ROWS])
        width = max(width, fields[t, KERNEL_WIDTH])
    v, moved, step = np.empty(storage), np.empty(storage), np.empty(width)
    weights, r, gradient = np.empty(rows), np.empty(rows), np.empty(width)
    J, second, R = np.empty(rows * width), np.empty(width * width), np.empty((3, 3))
    for t in range(len(fields)):
        term = fields[t]
        if term[PARTS] == 0 or term[ADDRESS] == 0:
            continue
        m, full, table = term[ROWS], term[KERNEL_WIDTH], vector_at(term[TABLE], term[TABLE_SIZE])
        S = matrix(second, 0, full, full)
        for i in range(term[COUNT]):
            if term[ACTIVE] >= 0 and terms.active[term[ACTIVE] + i] == 0:
                continue
            at = term[ROW] + i * m
            if term[KIND] == COST:
                carry_back(term, i, terms.whiteners, vector(residual, at, m), weights)
                if term[WEIGHT] >= 0:
                    root = sqrt(robust[term[WEIGHT] + i])
                    for a in range(m):
                        weights[a] *= root
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
                parts = terms.parts[term[PART] : term[PART] + term[PARTS]]
                _difference(parts, term, p, table, v, moved, step, weights, r, gradient, J, R, S)
            _write(terms.sizes, terms.positions, term, i, S, hessian)


@compiled
def add_losses(
    terms: TermArrays, residual: Array, jacobian: Array, squares: Array, robust: Array, hessian: Array
) -> None:
    """Add 2 rho''(s) J'r r'J of every robust factor, r and J without the root of its weight that they carry here."""
    fields, positions, parameters = terms.fields, terms.positions, terms.parameters
    width = 1
    for t in range(len(fields)):
        width = max(width, fields[t, WIDTH])
    slope = np.empty(width)
    for t in range(len(fields)):
        term = fields[t]
        if term[LOSS] <= 0:
            continue
        m, width, at = term[ROWS], term[WIDTH], term[POSITION]
        first, second = parameters[term[LOSS_AT]], parameters[term[LOSS_AT] + 1]
        for i in range(term[COUNT]):
            weight, squared = robust[term[WEIGHT] + i], squares[term[WEIGHT] + i]
            bend = 2.0 * bend_of(term[LOSS], first, second, squared)
            if bend == 0.0 or weight == 0.0:
                at += width * (width + 1) // 2
                continue
            r = vector(residual, term[ROW] + i * m, m)
            J = matrix(jacobian, term[ENTRY] + i * m * width, m, width)
            for d in range(width):
                slope[d] = 0.0
                for a in range(m):
                    slope[d] += J[a, d] * r[a] / weight
                for e in range(d + 1):
                    where = positions[at]
                    at += 1
                    if where >= 0:
                        hessian[where] += bend * slope[d] * slope[e]
                    elif where != -1:
                        hessian[-2 - where] += 2.0 * bend * slope[d] * slope[e]


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


@in_order
def _difference(
    parts: IntArray,
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
    R: Array,
    second: Array,
) -> None:
    """Second derivatives of one factor, direction by direction.

    A kernel's own Jacobian is differenced to one side. Where that is made of differences itself, w' r is differenced
    twice from its values alone, at two points for each pair of directions; all steps are then those of the largest
    coordinate, because that is what the residual may round.
    """
    twice = term[DIFFERENCED] != 0
    width, storage = term[KERNEL_WIDTH], term[STORAGE]
    size, h, centre = 0.0, 0.0, 0.0
    for k in range(storage):
        moved[k] = v[k]
    for k in range(width):
        step[k] = 0.0
    if twice:
        for part in range(len(parts)):
            if parts[part, 0] == VECTOR or parts[part, 0] == OTHER:
                size = largest(v, parts[part, 1], parts[part, 2], size)
        h = step_for(size, TWICE)
        centre = _weighted(term, p, table, moved, weights, r)
    else:
        _sloped(term, p, table, moved, weights, r, J, gradient)
    for first in range(len(parts)):
        kind, start, stored, dim, column, turn, own = parts[first]
        for c in range(column, column + dim):
            if twice:
                both = 0.0  # w' r ahead and behind, less twice that at the centre
                for side in range(2):
                    step[c] = h if side == 0 else -h
                    _shift(v, kind, start, stored, dim, own, step, column, c, moved)
                    change = _weighted(term, p, table, moved, weights, r) - centre
                    both += change
                    gradient[c] = (change - gradient[c] if side == 1 else change) / (1.0 if side == 0 else -2.0 * h)
                second[c, c] = both  # over h^2, when all have been found
                for other in range(first + 1):
                    its_kind, its_start, its_stored, its_dim, its_column, _, its_own = parts[other]
                    for d in range(its_column, min(its_column + its_dim, c)):
                        total = -both - second[d, d]
                        for side in range(2):
                            step[c] = step[d] = h if side == 0 else -h
                            _shift(v, kind, start, stored, dim, own, step, column, c, moved)
                            _shift(v, its_kind, its_start, its_stored, its_dim, its_own, step, its_column, d, moved)
                            total += _weighted(term, p, table, moved, weights, r) - centre
                        step[d] = 0.0
                        _shift(v, its_kind, its_start, its_stored, its_dim, its_own, step, its_column, d, moved)
                        second[c, d] = second[d, c] = total / (2.0 * h * h)
            else:
                step[c] = h = step_of(v, kind, start, stored, turn, c - column, ONE_SIDED)
                _shift(v, kind, start, stored, dim, own, step, column, c, moved)
                _sloped(term, p, table, moved, weights, r, J, second[c])
                at = start + c - column
                stepped = h if kind == TURN or kind == OTHER else (v[at] + h) - v[at]
                for d in range(width):
                    second[c, d] = (second[c, d] - gradient[d]) / stepped
            step[c] = 0.0
            for k in range(start, start + stored):
                moved[k] = v[k]
    if twice:
        for c in range(width):
            second[c, c] /= h * h
    for part in range(len(parts)):
        _, _, _, dim, column, turn, _ = parts[part]
        if turn >= 0:
            rotation(v, turn, dim, R)
            if twice:
                to_body(R, dim, second, width, column)
            _turn_rows(R, dim, second, width, column)
            if twice:
                _bend(R, dim, gradient, second, column)


@compiled
def _retract(own: int, v: Array, start: int, stored: int, step: Array, column: int, dim: int, out: Array) -> None:
    """Move a part by a retraction of its own: rare, and no code in the loops over all others."""
    call_retraction(own, vector(v, start, stored), vector(step, column, dim), vector(out, start, stored))


@inlined
def _shift(
    v: Array,
    kind: int,
    start: int,
    stored: int,
    dim: int,
    own: int,
    step: Array,
    column: int,
    which: int,
    out: Array,
) -> None:
    """Write what a changed step along one direction changes of a part."""
    if kind == VECTOR:
        place = start + which - column
        out[place] = v[place] + step[which]
    elif kind == ANGLE:
        out[start] = wrap(v[start] + step[which])
    elif kind == OTHER:
        _retract(own, v, start, stored, step, column, dim, out)
    else:
        move(v, kind, start, 3, step, column, out)


@inlined
def _weighted(term: IntArray, p: Array, table: Array, v: Array, weights: Array, r: Array) -> float:
    """Value of w' r of one factor."""
    m, nothing = term[ROWS], matrix(r, 0, 0, 0)
    call_residual(term[ADDRESS], vector(v, 0, term[STORAGE]), p, table, vector(r, 0, m), nothing)
    total = 0.0
    for a in range(m):
        total += weights[a] * r[a]
    return total


@inlined
def _sloped(term: IntArray, p: Array, table: Array, v: Array, weights: Array, r: Array, J: Array, out: Array) -> None:
    """Write J' w of one factor."""
    m, width = term[ROWS], term[KERNEL_WIDTH]
    call_residual(term[ADDRESS], vector(v, 0, term[STORAGE]), p, table, vector(r, 0, m), matrix(J, 0, m, width))
    for d in range(width):
        out[d] = 0.0
        for a in range(m):
            out[d] += weights[a] * J[a * width + d]


@compiled
def _turn_rows(R: Array, dim: int, second: Array, width: int, column: int) -> None:
    """Make the derivatives in the rows of a position those along the axes of the body: R' S, in place."""
    for d in range(width):
        x, y = second[column, d], second[column + 1, d]
        z = second[column + 2, d] if dim == 3 else 0.0
        for c in range(dim):
            second[column + c, d] = R[0, c] * x + R[1, c] * y + (R[2, c] * z if dim == 3 else 0.0)


@compiled
def _bend(R: Array, dim: int, gradient: Array, second: Array, column: int) -> None:
    """Add half of the gradient along r x t to the mixed entries of translation t and rotation r."""
    x = y = z = 0.0
    for k in range(dim):
        slope = 0.5 * gradient[column + k]
        x += R[k, 0] * slope
        y += R[k, 1] * slope
        z += R[k, 2] * slope if dim == 3 else 0.0
    if dim == 2:
        _add_pair(second, column, column + 2, y)
        _add_pair(second, column + 1, column + 2, -x)
    else:
        _add_pair(second, column + 1, column + 3, z)
        _add_pair(second, column + 2, column + 3, -y)
        _add_pair(second, column + 2, column + 4, x)
        _add_pair(second, column, column + 4, -z)
        _add_pair(second, column, column + 5, y)
        _add_pair(second, column + 1, column + 5, -x)


@compiled
def _add_pair(second: Array, row: int, column: int, value: float) -> None:
    """Add to an entry and to the one across the diagonal."""
    second[row, column] += value
    second[column, row] += value


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
