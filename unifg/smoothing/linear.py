"""One factor at a time: values of its variables, whitened residual and Jacobian, robust weight, cost."""

from __future__ import annotations

from math import sqrt

from unifg.kernels.robust import QUADRATIC, value_of, weight_of
from unifg.kernels.whitening import whiten
from unifg.lie.moving import move_point
from unifg.machine.calls import call_residual, matrix, vector, vector_at
from unifg.machine.jit import compiled
from unifg.machine.vectors import Address, get, load, plus, put, splat, store
from unifg.smoothing.state import FRESH, LINEAR, Record, opened
from unifg.typing import Array


@compiled
def length_of(kind: Record) -> int:
    """Numbers that a factor of some type keeps: parameters, whitener, and the rows of [J'J, J'r]."""
    return int(kind.numbers + kind.width * (kind.width + 1) + 4)


@compiled
def retract(memory: Address, v: int, step: int, out: Array, at: int) -> None:
    """Write the linearisation point of a variable, moved by the step that stands at ``step``, to ``out[at:]``."""
    state = opened(memory)
    numbers, variable = state.numbers, state.variables[v]
    for p in range(variable.part, variable.part + variable.parts):
        part = state.parts[p]
        move_point(
            part.retraction, numbers, variable.value + part.start, part.storage, numbers, step + part.tangent,
            part.dim, out, at + part.start,
        )  # fmt: skip


@compiled
def linearize(memory: Address, f: int, scratch: Array) -> None:
    """Evaluate a factor at the linearisation points of its variables.

    What is kept are the rows of ``[J'J, J'r]``, upper triangle: smaller than J for tall residuals, and ready to be
    added to a front any number of times. The scales of the diagonals follow.
    """
    state = opened(memory)
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor.type]
    m, width, data, at = kind.rows, kind.width, factor.data, 0
    for s in range(kind.slots):
        variable = variables[lists[factor.variables + s]]
        value = variable.value
        for k in range(variable.storage):
            scratch[at + k] = numbers[value + k]
        at += variable.storage
    r, J = vector(scratch, at, m), matrix(scratch, at + m, m, width)
    products = data + kind.numbers
    call_residual(
        kind.address,
        vector(scratch, 0, at),
        vector(numbers, data, kind.parameters),
        vector_at(kind.table, kind.table_size),
        r,
        J,
    )
    whiten(kind.whitening, numbers, data + kind.parameters, 0, r, J)
    if kind.loss != QUADRATIC:
        squared = 0.0
        for a in range(m):
            squared += r[a] * r[a]
        root = sqrt(weight_of(kind.loss, kind.first, kind.second, squared))
        for k in range(at, at + m + m * width):
            scratch[k] *= root
    if factor.state != FRESH:
        _count(memory, factor, products, -1.0)
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
    _count(memory, factor, products, 1.0)
    factor.state = LINEAR


@compiled
def _count(memory: Address, factor: Record, products: int, sign: float) -> None:
    """Add the diagonal of J'J to the scales of the variables of a factor."""
    state = opened(memory)
    numbers, lists, variables, kind = state.numbers, state.lists, state.variables, state.types[factor.type]
    for s in range(kind.slots):
        variable = variables[lists[factor.variables + s]]
        dim = variable.dim
        scale = variable.value + variable.storage + 2 * dim
        for d in range(dim):
            put(numbers, scale + d, get(numbers, scale + d) + sign * get(numbers, products))
            products += kind.width + 2


@compiled
def cost_of(memory: Address, f: int, scratch: Array) -> float:
    """1/2 rho(|W r|^2) of a factor at the estimates of its variables."""
    state = opened(memory)
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor.type]
    m, data, at = kind.rows, factor.data, 0
    for s in range(kind.slots):
        v = lists[factor.variables + s]
        retract(memory, v, variables[v].value + variables[v].storage, scratch, at)
        at += variables[v].storage
    r, none = vector(scratch, at, m), matrix(scratch, 0, 0, 0)
    call_residual(
        kind.address,
        vector(scratch, 0, at),
        vector(numbers, data, kind.parameters),
        vector_at(kind.table, kind.table_size),
        r,
        none,
    )
    whiten(kind.whitening, numbers, data + kind.parameters, 0, r, none)
    squared = 0.0
    for a in range(m):
        squared += r[a] * r[a]
    return 0.5 * value_of(kind.loss, kind.first, kind.second, squared)
