"""One factor at a time: values of its variables, whitened residual and Jacobian, robust weight, cost."""

from __future__ import annotations

from math import log1p, sqrt

from unifg.kernels.whitening import DIAGONAL, FULL
from unifg.machine.calls import call_residual, call_retraction, matrix, vector, vector_at
from unifg.machine.jit import compiled
from unifg.machine.vectors import get, load, plus, put, splat, store
from unifg.smoothing.fields import (
    ADDRESS,
    DATA,
    DIM,
    FRESH,
    KIND,
    LINEAR,
    LOSS,
    NUMBERS,
    PARAMETERS,
    ROWS,
    SLOTS,
    STATE,
    STORAGE,
    TABLE,
    TABLE_SIZE,
    TYPE,
    VALUE,
    VARIABLES,
    WHITENING,
    WIDTH,
    State,
)
from unifg.typing import Array, IntArray

PART = 6  # numbers that describe a part of a manifold
QUADRATIC, HUBER, CAUCHY, TUKEY, GEMAN_MCCLURE, DCS_LOSS = range(6)


@compiled
def length_of(kind: IntArray) -> int:
    """Numbers that a factor of some type keeps: parameters, whitener, loss, and the rows of [J'J, J'r]."""
    return int(kind[NUMBERS] + kind[WIDTH] * (kind[WIDTH] + 1) + 4)


@compiled
def robust_weight(loss: int, parameter: float, squared: float) -> float:
    """rho'(s), see :mod:`unifg.kernels.robust`; ``parameter`` is the squared scale, or Phi."""
    if loss == HUBER:
        return 1.0 if squared <= parameter else sqrt(parameter / squared)
    if loss == CAUCHY:
        return 1.0 / (1.0 + squared / parameter)
    if loss == TUKEY:
        return (1.0 - min(squared / parameter, 1.0)) ** 2
    if loss == GEMAN_MCCLURE:
        return (parameter / (parameter + squared)) ** 2
    if loss == DCS_LOSS:
        return min(1.0, 2.0 * parameter / (parameter + squared)) ** 2
    return 1.0


@compiled
def robust_value(loss: int, parameter: float, squared: float) -> float:
    """rho(s)."""
    if loss == HUBER:
        return squared if squared <= parameter else 2.0 * sqrt(parameter * squared) - parameter
    if loss == CAUCHY:
        return parameter * log1p(squared / parameter)
    if loss == TUKEY:
        return parameter / 3.0 * (1.0 - (1.0 - min(squared / parameter, 1.0)) ** 3)
    if loss == GEMAN_MCCLURE:
        return parameter * squared / (parameter + squared)
    if loss == DCS_LOSS:
        return squared if squared <= parameter else 4.0 * parameter * squared / (parameter + squared) - parameter
    return squared


@compiled
def retract(state: State, v: int, step: int, out: Array, at: int) -> None:
    """Write the linearisation point of a variable, moved by the step that stands at ``step``, to ``out[at:]``."""
    kinds, numbers = state.kinds, state.numbers
    kind, value = state.variables[v, KIND], state.variables[v, VALUE]
    for part in range(kinds[kind]):
        k = kind + 1 + PART * part
        where, storage, size, tangent, dim = kinds[k], kinds[k + 2], kinds[k + 3], kinds[k + 4], kinds[k + 5]
        if where == 0:
            for i in range(size):
                out[at + storage + i] = numbers[value + storage + i] + numbers[step + tangent + i]
        else:
            call_retraction(
                where,
                vector(numbers, value + storage, size),
                vector(numbers, step + tangent, dim),
                vector(out, at + storage, size),
            )


@compiled
def whiten(kind: int, whiteners: Array, r: Array, J: Array) -> None:
    """W r and W J in place; a full W is upper triangular."""
    rows, width = len(r), J.shape[1]
    if kind == DIAGONAL:
        for a in range(rows):
            r[a] *= whiteners[a]
            if len(J):
                for d in range(width):
                    J[a, d] *= whiteners[a]
    elif kind == FULL:
        for a in range(rows):
            total = 0.0
            for b in range(a, rows):
                total += whiteners[a * rows + b] * r[b]
            r[a] = total
            if len(J):
                w = whiteners[a * rows + a]
                for d in range(width):
                    J[a, d] *= w
                for b in range(a + 1, rows):
                    w = whiteners[a * rows + b]
                    for d in range(width):
                        J[a, d] += w * J[b, d]


@compiled
def linearize(state: State, f: int, scratch: Array) -> None:
    """Evaluate a factor at the linearisation points of its variables.

    What is kept are the rows of ``[J'J, J'r]``, upper triangle: smaller than J for tall residuals, and ready to be
    added to a front any number of times. The scales of the diagonals follow.
    """
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor[TYPE]]
    m, width, slots, data = kind[ROWS], kind[WIDTH], kind[SLOTS], factor[DATA]
    at = 0
    for s in range(slots):
        v = lists[factor[VARIABLES] + s]
        value = variables[v, VALUE]
        for k in range(variables[v, STORAGE]):
            scratch[at + k] = numbers[value + k]
        at += variables[v, STORAGE]
    r, J = vector(scratch, at, m), matrix(scratch, at + m, m, width)
    parameters, products = kind[PARAMETERS], data + kind[NUMBERS]
    call_residual(
        kind[ADDRESS],
        vector(scratch, 0, at),
        vector(numbers, data, parameters),
        vector_at(kind[TABLE], kind[TABLE_SIZE]),
        r,
        J,
    )
    whiten(kind[WHITENING], vector(numbers, data + parameters, m * m), r, J)
    if kind[LOSS] != QUADRATIC:
        squared = 0.0
        for a in range(m):
            squared += r[a] * r[a]
        root = sqrt(robust_weight(kind[LOSS], numbers[products - 1], squared))
        for k in range(at, at + m + m * width):
            scratch[k] *= root
    if factor[STATE] != FRESH:
        _count(state, factor, products, -1.0)
    zero = splat(0.0)
    for i in range(width):
        row, total = products + i * (width + 1), 0.0
        for j in range(i, width, 4):  # the last lanes reach into the next row, which is written after this one
            acc, source = zero, at + m
            for _ in range(m):
                acc = plus(acc, get(scratch, source + i), load(scratch, source + j))
                source += width
            store(numbers, row + j, acc)
        for a in range(m):
            total += get(scratch, at + m + a * width + i) * get(scratch, at + a)
        put(numbers, row + width, total)
    _count(state, factor, products, 1.0)
    factor[STATE] = LINEAR


@compiled
def _count(state: State, factor: IntArray, products: int, sign: float) -> None:
    """Add the diagonal of J'J to the scales of the variables of a factor."""
    numbers, lists, variables, kind = state.numbers, state.lists, state.variables, state.types[factor[TYPE]]
    for s in range(kind[SLOTS]):
        v = lists[factor[VARIABLES] + s]
        dim = variables[v, DIM]
        scale = variables[v, VALUE] + variables[v, STORAGE] + 2 * dim
        for d in range(dim):
            put(numbers, scale + d, get(numbers, scale + d) + sign * get(numbers, products))
            products += kind[WIDTH] + 2


@compiled
def cost_of(state: State, f: int, scratch: Array) -> float:
    """1/2 rho(|W r|^2) of a factor at the estimates of its variables."""
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor[TYPE]]
    m, data, at = kind[ROWS], factor[DATA], 0
    for s in range(kind[SLOTS]):
        v = lists[factor[VARIABLES] + s]
        retract(state, v, variables[v, VALUE] + variables[v, STORAGE], scratch, at)
        at += variables[v, STORAGE]
    r, none = vector(scratch, at, m), matrix(scratch, 0, 0, 0)
    parameters = kind[PARAMETERS]
    call_residual(
        kind[ADDRESS],
        vector(scratch, 0, at),
        vector(numbers, data, parameters),
        vector_at(kind[TABLE], kind[TABLE_SIZE]),
        r,
        none,
    )
    whiten(kind[WHITENING], vector(numbers, data + parameters, m * m), r, none)
    squared = 0.0
    for a in range(m):
        squared += r[a] * r[a]
    return 0.5 * robust_value(kind[LOSS], numbers[data + kind[NUMBERS] - 1], squared)
