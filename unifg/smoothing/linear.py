"""One factor at a time: values of its variables, whitened residual and Jacobian, robust weight, cost."""

from __future__ import annotations

from math import sqrt

import numpy as np

from unifg.codegen.calls import call_residual, matrix, vector, vector_at
from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address, get, load, plus, put, splat, store
from unifg.factors.robust import QUADRATIC, value_of, weight_of
from unifg.factors.whitening import whiten
from unifg.lie.retraction import move_point
from unifg.smoothing.state import BY_PYTHON, FRESH, LINEAR, Record, opened
from unifg.typing import Array, IntArray


@compiled
def length_of(kind: Record) -> int:
    """Numbers that a factor of some type keeps: parameters, whitener, and the rows of [J'J, J'r]."""
    return int(kind.numbers + kind.width * (kind.width + 1) + 4)


@compiled
def retract(memory: Address, v: int, out: Array, at: int) -> None:
    """Write the estimate of a variable, its linearisation point moved by its step, to ``out[at:]``."""
    state = opened(memory)
    numbers, variable = state.numbers, state.variables[v]
    value, step = variable.value, variable.value + variable.storage
    for p in range(variable.part, variable.part + variable.parts):
        part = state.parts[p]
        if part.retraction == BY_PYTHON:
            for k in range(part.storage):
                out[at + k] = numbers[step + 3 * variable.dim + k]
        else:
            move_point(
                part.retraction, numbers, value + part.start, part.storage, numbers, step + part.tangent, part.dim,
                out, at + part.start,
            )  # fmt: skip


@compiled
def evaluate(memory: Address, f: int, estimated: bool, scratch: Array) -> tuple[int, float]:
    """Whiten the residual of a factor at the estimates, or with its Jacobian at the linearisation points.

    Args:
        memory: address of the description of the smoother's arrays.
        f: the factor.
        estimated: whether its variables are where their steps lead, and no Jacobian is wanted.
        scratch: takes the values of the variables, the residual and the Jacobian.

    Returns:
        Where the residual begins in scratch, and its squared norm.
    """
    state = opened(memory)
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor.type]
    m, data, at = kind.rows, factor.data, 0
    for s in range(kind.slots):
        slot, v = state.slots[kind.slot + s], lists[factor.variables + s]
        source, begin = numbers, variables[v].value + slot.start
        if estimated:
            retract(memory, v, scratch, at)
            source, begin = scratch, at + slot.start
        for k in range(slot.storage):
            scratch[at + k] = source[begin + k]
        at += slot.storage
    r, J = vector(scratch, at, m), matrix(scratch, at + m, 0 if estimated else m, kind.width)
    call_residual(
        kind.address,
        vector(scratch, 0, at),
        vector(numbers, data, kind.parameters),
        vector_at(kind.table, kind.table_size),
        r,
        J,
    )
    whiten(kind.whitening, numbers, data + kind.parameters, 0, r, J)
    squared = 0.0
    for a in range(m):
        squared += r[a] * r[a]
    return at, squared


@compiled
def linearize(memory: Address, f: int, scratch: Array) -> None:
    """Evaluate a factor at the linearisation points of its variables, and keep what :func:`keep` keeps."""
    state = opened(memory)
    kind = state.types[state.factors[f].type]
    at, squared = evaluate(memory, f, False, scratch)
    if kind.loss != QUADRATIC:
        root = sqrt(weight_of(kind.loss, kind.first, kind.second, squared))
        for k in range(at, at + kind.rows * (1 + kind.width)):
            scratch[k] *= root
    keep(memory, f, scratch, at)


@compiled
def keep(memory: Address, f: int, scratch: Array, at: int) -> None:
    """Keep of a residual and a Jacobian, which stand in ``scratch[at:]``, the upper triangle of ``[J'J, J'r]``.

    That is smaller than J for tall residuals, and ready to be added to a front any number of times. The scales of the
    diagonals follow.
    """
    state = opened(memory)
    numbers, factor = state.numbers, state.factors[f]
    kind = state.types[factor.type]
    m, width, products, zero = kind.rows, kind.width, factor.data + kind.numbers, splat(0.0)
    if factor.state != FRESH:
        _count(memory, f, products, -1.0)
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
    _count(memory, f, products, 1.0)
    factor.state = LINEAR


@compiled
def _count(memory: Address, f: int, products: int, sign: float) -> None:
    """Add the diagonal of J'J to the scales of the variables of a factor."""
    state = opened(memory)
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor.type]
    for s in range(kind.slots):
        variable, slot = variables[lists[factor.variables + s]], state.slots[kind.slot + s]
        scale = variable.value + variable.storage + 2 * variable.dim + slot.tangent
        for d in range(slot.dim):
            put(numbers, scale + d, get(numbers, scale + d) + sign * get(numbers, products))
            products += kind.width + 2


@compiled
def waiting(memory: Address) -> IntArray:
    """Factors that Python has to evaluate before the next elimination."""
    state = opened(memory)
    counters, factors, types = state.counters[0], state.factors, state.types
    result, count = np.empty(counters.factor_end, np.int64), 0
    for f in range(counters.factor_end):
        if factors[f].used and factors[f].state != LINEAR and types[factors[f].type].address == 0:
            result[count] = f
            count += 1
    return result[:count]


@compiled
def take_in(memory: Address, chosen: IntArray, residual: Array, jacobian: Array) -> None:
    """Keep what Python has evaluated: (n, m) and (n, m, D), whitened and weighted."""
    state = opened(memory)
    counters, scratch = state.counters[0], np.empty(state.counters[0].scratch)
    m, width = residual.shape[1], jacobian.shape[2]
    for i in range(len(chosen)):
        for a in range(m):
            scratch[a] = residual[i, a]
            for d in range(width):
                scratch[m + a * width + d] = jacobian[i, a, d]
        keep(memory, chosen[i], scratch, 0)
    counters.linearized += len(chosen)


@compiled
def cost_of(memory: Address, f: int, scratch: Array) -> float:
    """1/2 rho(|W r|^2) of a factor at the estimates of its variables; 0 where Python has to evaluate it."""
    state = opened(memory)
    kind = state.types[state.factors[f].type]
    if kind.address == 0:
        return 0.0
    return 0.5 * value_of(kind.loss, kind.first, kind.second, evaluate(memory, f, True, scratch)[1])
