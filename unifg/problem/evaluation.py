"""The compiled loops over all terms of a graph: evaluate, linearise, accumulate, multiply.

Terms are rows of an integer table (:mod:`unifg.problem.table`), residuals are addresses; a pass over a whole graph is
one call from Python. Terms without a kernel have been evaluated by NumPy beforehand: their raw residuals and Jacobians
already stand where a kernel would have written them.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from numba import float64, int32, int64, uint8

from unifg.codegen.calls import call_residual, matrix, vector, vector_at
from unifg.codegen.function_pointers import run
from unifg.codegen.jit import compiled, inlined
from unifg.codegen.vectors import Address, address, lane, load, plus, splat
from unifg.codegen.waiting import first_chunk, next_chunk, wait_for
from unifg.codegen.work_queue import arguments_at, arrays, bundle
from unifg.factors.robust import value_of, weight_of
from unifg.factors.whitening import FULL, whiten
from unifg.problem.table import (
    ACTIVE,
    ADDRESS,
    BOUND,
    COLUMN,
    CONSTRAINT,
    COST,
    COUNT,
    ENTRY,
    GATHER,
    HELD,
    KEEP,
    KERNEL_WIDTH,
    KIND,
    LOSS,
    LOSS_AT,
    PAIR_ADDING,
    PAIR_WHITENING,
    PAIRED,
    PARAMETER,
    PARAMETERS,
    POSITION,
    ROW,
    ROWS,
    SIZE,
    SLOTS,
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
from unifg.typing import Array, IntArray


class LinearArrays(NamedTuple):
    """Arrays that a linearisation writes.

    Attributes:
        residual: (C,) whitened rows of costs, scaled by the square roots of robust weights.
        jacobian: entries of their Jacobian.
        constraints: (M,) rows of constraints.
        constraint_jacobian: entries of their Jacobian.
        squares: squared norms of robust factors.
        weights: of robust factors.
        norms: (T,) residual norm of each term; of constraints, of the violation.
        gradient: over the full tangent space; J'r of all costs is added.
        hessian: entries of the normal matrix; J'J of all costs is added.
    """

    residual: Array
    jacobian: Array
    constraints: Array
    constraint_jacobian: Array
    squares: Array
    weights: Array
    norms: Array
    gradient: Array
    hessian: Array


# These take arrays and not the tuples that hold them: taking an array out of a tuple counts references.


@inlined
def gather_variables(
    term: IntArray, i: int, gather: IntArray, sizes: IntArray, parameters: Array, values: Array, out: Array
) -> None:
    """Copy the variables of factor i side by side; negative starts are constants among the parameters."""
    at, slots = 0, term[SLOTS]
    for slot in range(slots):
        start, size = gather[term[GATHER] + i * slots + slot], sizes[term[SIZE] + slot]
        if start >= 0:
            for k in range(size):
                out[at + k] = values[start + k]
        else:
            for k in range(size):
                out[at + k] = parameters[k - start - 1]
        at += size


@inlined
def run_kernel(
    term: IntArray, where: int, i: int, gather: IntArray, sizes: IntArray, parameters: Array, values: Array,
    scratch: Array, r: Array, J: Array,
) -> None:  # fmt: skip
    """Call a kernel of factor i."""
    gather_variables(term, i, gather, sizes, parameters, values, scratch)
    call_residual(
        where,
        vector(scratch, 0, term[STORAGE]),
        vector(parameters, term[PARAMETER] + i * term[SPREAD], term[PARAMETERS]),
        vector_at(term[TABLE], term[TABLE_SIZE]),
        r,
        J,
    )


@inlined
def _violation(value: float, lower: float, upper: float) -> float:
    """Distance outside the limits."""
    return max(value - upper, lower - value, 0.0)


@compiled
def evaluate(
    terms: TermArrays,
    values: Array,
    residual: Array,
    constraints: Array,
    squares: Array,
    weights: Array,
    holding: bool,
    scratch: Array,
) -> float:
    """Whitened residuals, constraints, and squared norms of robust factors; returns the cost.

    Factors whose loss is Python are left out of it, unless ``holding`` says that ``weights`` holds theirs.
    """
    fields, gather, sizes, parameters = terms.fields, terms.gather, terms.sizes, terms.parameters
    whiteners, active = terms.whiteners, terms.active
    cost = 0.0
    for t in range(len(fields)):
        term = fields[t]
        m, kind = term[ROWS], term[KIND]
        target = residual if kind == COST else constraints
        for i in range(term[COUNT]):
            at = term[ROW] + i * m
            r = vector(target, at, m)
            if kind == BOUND:
                r[0] = values[gather[term[GATHER] + i]]
                continue
            if term[ACTIVE] >= 0 and active[term[ACTIVE] + i] == 0:
                r[:] = 0.0
            elif term[ADDRESS] != 0:
                run_kernel(
                    term, term[ADDRESS], i, gather, sizes, parameters, values, scratch, r, matrix(scratch, 0, 0, 0)
                )
            if kind == COST:
                whiten(term[WHITEN], whiteners, term[WHITENER], i, r, matrix(scratch, 0, 0, 0))
                squared = 0.0
                for a in range(m):
                    squared += r[a] * r[a]
                if term[WEIGHT] < 0:
                    cost += 0.5 * squared
                    continue
                squares[term[WEIGHT] + i] = squared
                if term[LOSS] > 0:
                    cost += 0.5 * value_of(
                        term[LOSS], parameters[term[LOSS_AT]], parameters[term[LOSS_AT] + 1], squared
                    )
                elif holding and term[LOSS] == HELD:
                    cost += 0.5 * weights[term[WEIGHT] + i] * squared
    return cost


@compiled
def linearize(
    terms: TermArrays, values: Array, residual: Array, jacobian: Array, constraints: Array, constraint_jacobian: Array,
    squares: Array, weights: Array, norms: Array, gradient: Array, hessian: Array, scratch: Array, share: int,
    shares: int,
) -> float:  # fmt: skip
    """Residuals, Jacobians, gradient and J'J in one pass, scaled by the square roots of robust weights.

    Factors whose loss is Python stop after whitening, see :func:`weigh`. Arrays from ``residual`` to ``hessian`` are
    those of :class:`LinearArrays`, which as a record would count references to each of them; ``scratch`` holds a
    factor's variables, then J with all its columns for terms that keep only some. One of several ``shares`` of the
    factors of every term is done, counted from 0.

    Returns:
        The cost of all these factors but those whose loss is Python.
    """
    fields, gather, sizes, parameters = terms.fields, terms.gather, terms.sizes, terms.parameters
    whiteners, active, columns, positions = terms.whiteners, terms.active, terms.columns, terms.positions
    lower, upper = terms.lower, terms.upper
    cost = 0.0
    for t in range(len(fields)):
        term = fields[t]
        m, width, kind = term[ROWS], term[WIDTH], term[KIND]
        target = residual if kind == COST else constraints
        blocks = jacobian if kind == COST else constraint_jacobian
        where = term[ADDRESS]
        together = term[PAIRED] if term[WHITEN] & FULL else 0
        apart = (term[WHITEN] & 1) * m * m
        total = 0.0
        for i in range(term[COUNT] * share // shares, term[COUNT] * (share + 1) // shares):
            at = term[ROW] + i * m
            entry = term[ENTRY] + i * m * width
            r, J = vector(target, at, m), matrix(blocks, entry, m, width)
            if kind == BOUND:
                r[0] = values[gather[term[GATHER] + i]]
                J[0, 0] = 1.0
                total += _violation(r[0], lower[at], upper[at]) ** 2
                continue
            if term[ACTIVE] >= 0 and active[term[ACTIVE] + i] == 0:
                r[:] = 0.0
                J[:] = 0.0
            elif where != 0:
                if term[KEEP] < 0:
                    run_kernel(term, where, i, gather, sizes, parameters, values, scratch, r, J)
                else:
                    full = matrix(scratch, term[STORAGE], m, term[KERNEL_WIDTH])
                    run_kernel(term, where, i, gather, sizes, parameters, values, scratch, r, full)
                    for a in range(m):
                        for d in range(width):
                            J[a, d] = full[a, sizes[term[KEEP] + d]]
            if kind == CONSTRAINT:
                for a in range(m):
                    total += _violation(r[a], lower[at + a], upper[at + a]) ** 2
                continue
            first_weight = term[WHITENER] + i * apart
            if together:
                places = address(whiteners), first_weight, address(residual), at, address(jacobian), entry
                run(term[PAIR_WHITENING], places)
            else:
                whiten(term[WHITEN], whiteners, term[WHITENER], i, r, J)
            squared = 0.0
            for a in range(m):
                squared += r[a] * r[a]
            total += squared
            if term[WEIGHT] < 0:
                cost += 0.5 * squared
            else:
                squares[term[WEIGHT] + i] = squared
                if term[LOSS] < 0:
                    continue
                first, second = parameters[term[LOSS_AT]], parameters[term[LOSS_AT] + 1]
                cost += 0.5 * value_of(term[LOSS], first, second, squared)
                weight = weights[term[WEIGHT] + i] = weight_of(term[LOSS], first, second, squared)
                if weight != 1.0:
                    _scale(sqrt(weight), r, J)
            _accumulate(term, i, columns, positions, r, J, residual, jacobian, gradient, hessian)
        norms[t] = sqrt(total)
    return cost


TERM_ARRAYS = bundle(
    TermArrays,
    (
        arrays(int64, 2), arrays(int64, 2), *[arrays(int64)] * 4, arrays(int32), arrays(int64, 2), arrays(uint8),
        *[arrays(float64)] * 4,
    ),
)  # fmt: skip
"""Type of what compiled loops read."""
_of_linearize = arguments_at(
    (
        TERM_ARRAYS, arrays(float64), bundle(LinearArrays, [arrays(float64)] * 9), arrays(float64),
        arrays(float64, 2), arrays(float64, 2), arrays(int64), arrays(float64, 2), int64,
    )
)  # fmt: skip


@compiled
def linearize_at_once(where: Address) -> None:
    """Work of one thread in :func:`linearize`: shares of the factors, then of the sums of all shares.

    Args:
        where: address of these arguments: ``terms``, ``values`` and ``out`` as there, but that places are
            those of :func:`unifg.problem.thread_partition.apart`, that gradient and Hessian need not be zero, and that
            behind the entries of the Hessian is room for what all shares but the first one add to those that several
            write to; (S,) cost of each of S shares; (S, T) their norms of each term; (S - 1, n) room for the gradients
            of all shares but the first; (C,) entries that several shares write to; (S, .) scratch; counters, two
            integers for each of three phases, zero.
    """
    terms, values, out, costs, norms, slopes, contested, scratch, counters = _of_linearize(where)
    gradient, hessian = out.gradient, out.hessian
    shares, size, many, entries = len(costs), len(gradient), len(contested), len(hessian)
    nnz = entries - (shares - 1) * many
    k = first_chunk(counters, 0)
    while k < shares:
        for i in range(entries * k // shares, entries * (k + 1) // shares):
            hessian[i] = 0.0
        slope = gradient if k == 0 else slopes[k - 1]
        slope[:] = 0.0
        k = next_chunk(counters, 0)
    wait_for(counters, 0, shares)
    k = first_chunk(counters, 1)
    while k < shares:
        costs[k] = linearize(
            terms, values, out.residual, out.jacobian, out.constraints, out.constraint_jacobian, out.squares,
            out.weights, norms[k], gradient if k == 0 else slopes[k - 1], hessian, scratch[k], k, shares,
        )  # fmt: skip
        k = next_chunk(counters, 1)
    wait_for(counters, 1, shares)
    k = first_chunk(counters, 2)
    while k < shares:
        for share in range(shares - 1):
            for i in range(size * k // shares, size * (k + 1) // shares):
                gradient[i] += slopes[share, i]
            for i in range(many * k // shares, many * (k + 1) // shares):
                hessian[contested[i]] += hessian[nnz + share * many + i]
        k = next_chunk(counters, 2)
    wait_for(counters, 2, shares)


@compiled
def weigh(terms: TermArrays, out: LinearArrays) -> None:
    """Scale factors whose loss is Python by the square root of their weights; add them to gradient and Hessian."""
    fields, columns, positions, residual, jacobian = (
        terms.fields, terms.columns, terms.positions, out.residual, out.jacobian,
    )  # fmt: skip
    weights, gradient, hessian = out.weights, out.gradient, out.hessian
    for t in range(len(fields)):
        term = fields[t]
        if term[LOSS] >= 0:
            continue
        m, width = term[ROWS], term[WIDTH]
        for i in range(term[COUNT]):
            r = vector(residual, term[ROW] + i * m, m)
            J = matrix(jacobian, term[ENTRY] + i * m * width, m, width)
            _scale(sqrt(weights[term[WEIGHT] + i]), r, J)
            _accumulate(term, i, columns, positions, r, J, residual, jacobian, gradient, hessian)


@compiled
def _scale(root: float, r: Array, J: Array) -> None:
    """Multiply residual and Jacobian."""
    for a in range(len(r)):
        r[a] *= root
        for d in range(J.shape[1]):
            J[a, d] *= root


@inlined
def _accumulate(
    term: IntArray, i: int, columns: IntArray, positions: IntArray, r: Array, J: Array, residual: Array,
    jacobian: Array, gradient: Array, hessian: Array,
) -> None:  # fmt: skip
    """Add J'r and the upper triangle of J'J of one factor, whose r and J stand in ``residual`` and ``jacobian``."""
    rows, width = J.shape
    column = term[COLUMN] + i * width
    at = term[POSITION] + i * (width * (width + 1) // 2)
    if term[PAIRED] > 0:
        corner = at + rows * (rows + 1) // 2
        own, shared, other = int64(positions[at]), int64(positions[corner]), int64(positions[corner + rows])
        step, side = positions[at + 1] - own, positions[corner + 1] - shared
        below = corner + rows + 1
        hop, across = positions[below + rows] - other, positions[below] - shared
        places = (
            address(residual), term[ROW] + i * rows, address(jacobian), term[ENTRY] + i * rows * width,
            address(gradient), columns[column], columns[column + rows],
            address(hessian), own, step, other, hop, shared, side, across,
        )  # fmt: skip
        run(term[PAIR_ADDING], places)
    else:
        for d in range(width):
            total = 0.0
            for a in range(rows):
                total += J[a, d] * r[a]
            gradient[columns[column + d]] += total
            for e in range(d + 1):
                where = positions[at + e]
                if where != -1:
                    total = 0.0
                    for a in range(rows):
                        total += J[a, d] * J[a, e]
                    if where >= 0:
                        hessian[where] += total
                    else:
                        hessian[-2 - where] += 2.0 * total
            at += d + 1


@compiled
def add_constraints(terms: TermArrays, constraint_jacobian: Array, weights: Array, hessian: Array) -> None:
    """Add the upper triangle of A' diag(weights) A."""
    fields, positions = terms.fields, terms.positions
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] == COST:
            continue
        m, width, row, entry, start = term[ROWS], term[WIDTH], term[ROW], term[ENTRY], term[POSITION]
        for _ in range(term[COUNT]):
            for _ in range(m):
                w, at = weights[row], start
                if w != 0.0:
                    for d in range(width):
                        scaled = w * constraint_jacobian[entry + d]
                        for e in range(d + 1):
                            where = positions[at + e]
                            if where >= 0:
                                hessian[where] += scaled * constraint_jacobian[entry + e]
                            elif where != -1:
                                hessian[-2 - where] += 2.0 * scaled * constraint_jacobian[entry + e]
                        at += d + 1
                entry += width
                row += 1
            start += width * (width + 1) // 2


@compiled
def times(
    terms: TermArrays, costs: bool, entries: Array, other: Array, out: Array, chosen: IntArray | None = None
) -> None:
    """J v over the unknowns, for the rows of the costs or of the constraints; of ``chosen`` (T,) terms, if given."""
    fields, columns, unknowns = terms.fields, terms.columns, terms.unknown
    for t in range(len(fields)):
        term = fields[t]
        if (term[KIND] == COST) != costs:
            continue
        if chosen is not None and chosen[t] == 0:
            continue
        m, width, row, entry, column = term[ROWS], term[WIDTH], term[ROW], term[ENTRY], term[COLUMN]
        for _ in range(term[COUNT]):
            for a in range(row, row + m):
                out[a] = 0.0
            for d in range(width):  # a sum waits for itself: those of all rows go on together
                unknown = unknowns[columns[column + d]]
                if unknown >= 0:
                    at = entry + d
                    for a in range(row, row + m):
                        out[a] += entries[at] * other[unknown]
                        at += width
            entry += m * width
            row += m
            column += width


@compiled
def transposed_times(terms: TermArrays, costs: bool, entries: Array, other: Array, out: Array) -> None:
    """Add J' v to ``out`` over the full tangent space, fixed variables included."""
    fields, columns, numbers = terms.fields, terms.columns, address(entries)
    for t in range(len(fields)):
        term = fields[t]
        if (term[KIND] == COST) != costs:
            continue
        m, width, row, entry, column = term[ROWS], term[WIDTH], term[ROW], term[ENTRY], term[COLUMN]
        for _ in range(term[COUNT]):
            d = 0
            while d + 3 < width and m > 1:  # four columns at a time, each written once
                total, at = splat(0.0), entry + d
                for a in range(row, row + m):
                    if other[a] != 0.0:
                        total = plus(total, other[a], load(numbers, at))
                    at += width
                for k in range(4):
                    out[columns[column + d + k]] += lane(total, k)
                d += 4
            while d < width:
                rest, at = 0.0, entry + d
                for a in range(row, row + m):
                    if other[a] != 0.0:
                        rest += other[a] * entries[at]
                    at += width
                out[columns[column + d]] += rest
                d += 1
            entry += m * width
            row += m
            column += width
