"""The Hessian of the Lagrangian: what Gauss-Newton leaves out is sum of w_a times the Hessian of r_a, for every factor.

The weights w are the multipliers of constraints and the whitened residuals of costs, times their robust weights,
carried back through the whitening. The Hessian is that of t -> r(x Exp(t)), symmetric. A kernel that does not come with
it has its Jacobian differenced along every tangent direction; where that is made of differences itself, the residual is
differenced twice. A robust loss adds the slope of its weight (:func:`add_losses`).
"""

from __future__ import annotations

from math import sqrt
from time import perf_counter
from typing import NamedTuple, TypeAlias

import numpy as np

from unifg.codegen.calls import call_residual, matrix, vector, vector_at
from unifg.codegen.function_pointers import run
from unifg.codegen.jit import compiled, inlined
from unifg.factors.robust import bend_of, form_of
from unifg.factors.whitening import DIAGONAL, FULL
from unifg.modeling.terms import Cost
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import gather_variables
from unifg.problem.linearization import Linearization
from unifg.problem.second_differences import differencing
from unifg.problem.snapshot import LinearizationMemory, Snapshot
from unifg.problem.table import (
    ACTIVE,
    ADDRESS,
    COST,
    COUNT,
    DIFFERENCING,
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
    rows_in_stack,
)
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray

ARRAYS = (
    "values", "residual", "jacobian", "squares", "weights", "constraints", "constraint_jacobian", "gradient", "hessian",
    "concavity",
)  # fmt: skip
Views: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array, Array]


class Block(NamedTuple):
    """Arrays of a linearisation as one, of which Python need not view each.

    Attributes:
        flat: all of them.
        places: (10, 2) where each of `ARRAYS` begins and ends there.
    """

    flat: Array
    places: IntArray


def block_of(program: CompiledProblem, lin: Linearization) -> Block:
    """The arrays of a linearisation as one; those of another kind than a solver keeps are copied."""
    if isinstance(lin, Snapshot):
        return Block(lin._flat, program.once(_places))
    arrays = [lin.stored, *(getattr(lin, name) for name in ARRAYS[1:])]
    ends = np.cumsum([len(array) for array in arrays])
    return Block(np.concatenate(arrays), np.stack([ends - [len(array) for array in arrays], ends], axis=1))


def _places(program: CompiledProblem) -> IntArray:
    """Places in the linearisations that solvers keep."""
    parts = LinearizationMemory(program)._parts
    return np.array([(parts[name].start, parts[name].stop) for name in ARRAYS])


@inlined
def opened_block(block: Block) -> Views:
    """Views of `ARRAYS`."""
    a, p = block.flat, block.places
    return (
        a[p[0, 0] : p[0, 1]], a[p[1, 0] : p[1, 1]], a[p[2, 0] : p[2, 1]], a[p[3, 0] : p[3, 1]], a[p[4, 0] : p[4, 1]],
        a[p[5, 0] : p[5, 1]], a[p[6, 0] : p[6, 1]], a[p[7, 0] : p[7, 1]], a[p[8, 0] : p[8, 1]], a[p[9, 0] : p[9, 1]],
    )  # fmt: skip


def require_second(program: CompiledProblem) -> None:
    """Have everything compiled that :func:`add_curvature` comes to need."""
    program.table.require_second(differencing)


def lagrangian_hessian(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
    """Hessian of the objective plus multipliers' g, in the order of ``CompiledProblem.normal``.

    Terms evaluated by NumPy are differenced in batches. Weights of losses whose formulas are Python count as constant.

    Args:
        program: the compiled graph.
        lin: where.
        multipliers: (M,).
    """
    entries = uncompiled_hessian(program, lin, multipliers)
    own = lin.stored, lin.residual, lin.jacobian, lin.squares, lin.weights
    curve(program.arrays, *own, multipliers, entries)
    return entries


def uncompiled_hessian(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
    """The same without what :func:`curve` adds."""
    require_second(program)
    entries = lin.hessian + lin.concavity if len(lin.concavity) else lin.hessian.copy()
    for term in program.batched:
        _add(program, term, lin, multipliers, entries)
    return entries


def constraint_curvature(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
    """Hessian of multipliers' g alone, in the order of ``CompiledProblem.normal``; arguments as above."""
    require_second(program)
    entries = np.zeros(program.normal.nnz)
    add_curvature(program.arrays, lin.stored, np.zeros(len(lin.residual)), lin.weights, multipliers, entries)
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
    r = lin.residual[rows_in_stack(term)].reshape(term.count, m)
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
def curve(
    terms: TermArrays,
    values: Array,
    residual: Array,
    jacobian: Array,
    squares: Array,
    robust: Array,
    multipliers: Array,
    hessian: Array,
) -> None:
    """:func:`add_curvature` and :func:`add_losses`."""
    add_curvature(terms, values, residual, robust, multipliers, hessian)
    if len(robust):
        add_losses(terms, residual, jacobian, squares, robust, hessian)


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
                run(term[DIFFERENCING], (parts, term, p, table, v, moved, step, weights, r, gradient, J, R, S))
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
