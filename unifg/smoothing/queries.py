"""Adding variables and factors to a smoother, and asking it for estimates, covariances and costs, in compiled code."""

from __future__ import annotations

import numpy as np

from unifg.machine.jit import compiled
from unifg.smoothing.fields import (
    ALIVE,
    CANDIDATE,
    CHANGED,
    CLIQUE,
    COUNT,
    DATA,
    DIM,
    FACTOR_END,
    FACTOR_FREE,
    FAMILY,
    FRESH,
    FRONT,
    FROZEN,
    KIND,
    LINK,
    LIST,
    LISTS_END,
    MARK,
    MEMBER,
    NEW_FACTORS,
    NEW_VARIABLES,
    NEXT,
    NEXT_FACTOR,
    NUMBERS,
    NUMBERS_END,
    PARENT,
    PIVOT_ROWS,
    PIVOTS,
    PLACE,
    SCRATCH,
    SEQUENCE,
    SEQUENCES,
    SLOTS_MAX,
    STATE,
    STORAGE,
    STRIDE,
    TYPE,
    USED,
    VALUE,
    VARIABLE_END,
    VARIABLE_FREE,
    VARIABLES,
    State,
)
from unifg.smoothing.linear import cost_of, length_of, retract
from unifg.smoothing.memory import more_lists, more_numbers, take_list, take_numbers
from unifg.smoothing.tree import paths
from unifg.typing import Array, IntArray


@compiled
def add_variables(
    state: State, kind: int, dim: int, family: int, first: int, values: Array, stamps: Array, out: IntArray
) -> Array:
    """Add one variable for each row of values; writes their numbers and returns the arena of floats."""
    variables, counters = state.variables, state.counters
    count, storage = values.shape
    numbers = more_numbers(state.numbers, counters[NUMBERS_END], count * (2 * (storage + 3 * dim) + 16))
    state = State(
        variables, state.factors, state.types, state.kinds, state.cliques, counters, state.stamps, state.lists, numbers
    )
    for k in range(count):
        v = counters[VARIABLE_FREE]
        if v >= 0:
            counters[VARIABLE_FREE] = variables[v, NEXT]
        else:
            v = counters[VARIABLE_END]
            counters[VARIABLE_END] = v + 1
        variable, at = variables[v], take_numbers(state, storage + 3 * dim)
        variable[KIND], variable[DIM], variable[STORAGE], variable[VALUE] = kind, dim, storage, at
        variable[CLIQUE], variable[PLACE], variable[LINK], variable[MARK], variable[CHANGED] = -1, 0, -1, 0, 0
        variable[FROZEN], variable[CANDIDATE], variable[ALIVE] = 0, 0, 1
        variable[SEQUENCE], variable[FAMILY], variable[MEMBER] = counters[SEQUENCES], family, first + k
        counters[SEQUENCES] += 1
        variable[NEXT] = counters[NEW_VARIABLES]
        counters[NEW_VARIABLES] = v
        state.stamps[v] = stamps[k]
        for i in range(storage):
            numbers[at + i] = values[k, i]
        for i in range(3 * dim):
            numbers[at + storage + i] = 0.0
        out[k] = v
    return numbers


@compiled
def add_factors(state: State, kind: int, touched: IntArray, data: Array) -> tuple[IntArray, Array]:
    """Add factors of one type: (n, slots) variables, (n, NUMBERS) numbers; returns the arenas."""
    factors, counters, variables = state.factors, state.counters, state.variables
    count, slots = touched.shape
    size = state.types[kind, NUMBERS]
    length = length_of(state.types[kind])
    lists = more_lists(state.lists, counters[LISTS_END], count * (4 * slots + 4))
    numbers = more_numbers(state.numbers, counters[NUMBERS_END], count * (length + length // 3 + 16))
    state = State(variables, factors, state.types, state.kinds, state.cliques, counters, state.stamps, lists, numbers)
    for k in range(count):
        f = counters[FACTOR_FREE]
        if f >= 0:
            counters[FACTOR_FREE] = factors[f, NEXT_FACTOR]
        else:
            f = counters[FACTOR_END]
            counters[FACTOR_END] = f + 1
        factor, at, where = factors[f], take_numbers(state, length), take_list(state, 2 * slots)
        factor[TYPE], factor[VARIABLES], factor[DATA], factor[STATE], factor[USED] = kind, where, at, FRESH, 1
        for i in range(size):
            numbers[at + i] = data[k, i]
        for s in range(slots):
            v = touched[k, s]
            lists[where + s] = v
            lists[where + slots + s] = variables[v, LINK]
            variables[v, LINK] = f * SLOTS_MAX + s
        factor[NEXT_FACTOR] = counters[NEW_FACTORS]
        counters[NEW_FACTORS] = f
    return lists, numbers


@compiled
def estimates(state: State, chosen: IntArray, points: bool, out: Array) -> None:
    """Linearisation points of some variables, or those moved by their steps, one after the other."""
    storage = len(out) // max(len(chosen), 1)
    for k in range(len(chosen)):
        v = chosen[k]
        value = state.variables[v, VALUE]
        if points:
            for i in range(storage):
                out[k * storage + i] = state.numbers[value + i]
        else:
            retract(state, v, value + storage, out, k * storage)


@compiled
def total_cost(state: State) -> float:
    """Sum of the costs of all factors at the estimates."""
    scratch, total = np.empty(state.counters[SCRATCH]), 0.0
    for f in range(state.counters[FACTOR_END]):
        if state.factors[f, USED]:
            total += cost_of(state, f, scratch)
    return total


@compiled
def joint_covariance(state: State, chosen: IntArray) -> Array:
    """Covariance of some variables, in the order given.

    With H = U'U it is Y'Y, where Y solves U'Y = E for the unit columns E of the variables, and is zero outside the
    paths from them to their roots.
    """
    variables, cliques, lists, numbers = state.variables, state.cliques, state.lists, state.numbers
    offset, rows = paths(state, chosen)
    width = 0
    for k in range(len(chosen)):
        width += variables[chosen[k], DIM]
    Y, column = np.zeros((rows, width)), 0
    for k in range(len(chosen)):
        v = chosen[k]
        dim, c = variables[v, DIM], variables[v, CLIQUE]
        for d in range(dim):
            Y[offset[c] + variables[v, PLACE] + d, column + d] = 1.0
        while c >= 0:
            front, stride, pivots, top = cliques[c, FRONT], cliques[c, STRIDE], cliques[c, PIVOT_ROWS], offset[c]
            for i in range(pivots):
                row = front + i * stride
                for d in range(column, column + dim):
                    Y[top + i, d] /= numbers[row + i]
                    for j in range(i + 1, pivots):
                        Y[top + j, d] -= numbers[row + j] * Y[top + i, d]
                j = pivots
                for q in range(cliques[c, LIST] + cliques[c, PIVOTS], cliques[c, LIST] + cliques[c, COUNT]):
                    w = lists[q]
                    below = offset[variables[w, CLIQUE]] + variables[w, PLACE]
                    for b in range(variables[w, DIM]):
                        for d in range(column, column + dim):
                            Y[below + b, d] -= numbers[row + j] * Y[top + i, d]
                        j += 1
            c = cliques[c, PARENT]
        column += dim
    result = np.zeros((width, width))
    for i in range(rows):
        for a in range(width):
            if Y[i, a] != 0.0:
                for b in range(width):
                    result[a, b] += Y[i, a] * Y[i, b]
    return result
