"""Adding variables and factors to a smoother, and asking it for estimates, covariances and costs, in compiled code."""

from __future__ import annotations

import numpy as np

from unifg.codegen.calls import vector
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.codegen.vectors import Address
from unifg.elimination.ordering import filled
from unifg.smoothing.linear import cost_of, evaluate, length_of, retract
from unifg.smoothing.memory import found, grown, more, next_row, take_list, take_numbers
from unifg.smoothing.state import BY_PYTHON, FRESH, SLOTS_MAX, opened
from unifg.smoothing.tree import paths
from unifg.typing import Array, IntArray


@compiled
def add_variables(
    memory: Address,
    part: int,
    parts: int,
    dim: int,
    family: int,
    first: int,
    values: Array,
    stamps: Array,
    out: IntArray,
) -> Array | None:
    """Add one variable for each row of values; writes their numbers and returns a longer arena of floats, or nothing.

    Args:
        memory: address of the description of the smoother's arrays.
        part: first part of their manifold.
        parts: how many it has.
        dim: of its tangent space.
        family: number of their family.
        first: number of the first as a member.
        values: (n, storage).
        stamps: (n,).
        out: (n,) receives their numbers.
    """
    state = opened(memory)
    variables, counters = state.variables, state.counters[0]
    count, storage = values.shape
    length = storage + 3 * dim
    if state.parts[part].retraction == BY_PYTHON:
        length += storage + dim * dim
    longer = more(state.numbers, counters.numbers_end, count * (2 * length + 16))
    state = grown(memory, np.empty(0, np.int64), longer)
    numbers = state.numbers
    for k in range(count):
        v, counters.variable_free, counters.variable_end = next_row(
            variables, counters.variable_free, counters.variable_end
        )
        variable, at = variables[v], take_numbers(memory, length)
        variable.part, variable.parts, variable.dim, variable.storage, variable.value = part, parts, dim, storage, at
        variable.clique, variable.place, variable.link, variable.mark, variable.changed = -1, 0, -1, 0, 0
        variable.frozen, variable.candidate, variable.alive, variable.length = 0, 0, 1, length
        variable.sequence, variable.family, variable.member = counters.sequences, family, first + k
        counters.sequences += 1
        variable.next = counters.new_variables
        counters.new_variables = v
        variable.stamp = stamps[k]
        copy_to(values[k], vector(numbers, at, storage))
        numbers[at + storage : at + length] = 0.0
        if length > storage + 3 * dim:
            copy_to(values[k], vector(numbers, at + storage + 3 * dim, storage))
        out[k] = v
    return found(longer)


@compiled
def add_factors(
    memory: Address, kind: int, touched: IntArray, data: Array, batch: int, items: IntArray
) -> tuple[IntArray | None, Array | None]:
    """Add factors of one type and return longer arenas, or nothing.

    Args:
        memory: address of the description of the smoother's arrays.
        kind: number of the type.
        touched: (n, slots) variables.
        data: (n, numbers).
        batch: number of the statement, where Python evaluates it.
        items: their numbers there, or nothing.
    """
    state = opened(memory)
    factors, counters, variables = state.factors, state.counters[0], state.variables
    count, slots = touched.shape
    size = state.types[kind].numbers
    length = length_of(state.types[kind])
    more_lists = more(state.lists, counters.lists_end, count * (4 * slots + 4))
    more_numbers = more(state.numbers, counters.numbers_end, count * (length + length // 3 + 16))
    state = grown(memory, more_lists, more_numbers)
    lists, numbers = state.lists, state.numbers
    for k in range(count):
        f, counters.factor_free, counters.factor_end = next_row(factors, counters.factor_free, counters.factor_end)
        factor, at, where = factors[f], take_numbers(memory, length), take_list(memory, 2 * slots)
        factor.type, factor.variables, factor.data, factor.state, factor.used = kind, where, at, FRESH, 1
        factor.batch, factor.item = batch, items[k] if len(items) else k
        copy_to(data[k], vector(numbers, at, size))
        for s in range(slots):
            v = touched[k, s]
            lists[where + s] = v
            lists[where + slots + s] = variables[v].link
            variables[v].link = f * SLOTS_MAX + s
        factor.next = counters.new_factors
        counters.new_factors = f
    return found(more_lists), found(more_numbers)


@compiled
def estimates(memory: Address, chosen: IntArray, points: bool, out: Array) -> None:
    """Linearisation points of some variables, or those moved by their steps, one after the other."""
    state, storage = opened(memory), len(out) // max(len(chosen), 1)
    for k in range(len(chosen)):
        v = chosen[k]
        value = state.variables[v].value
        if points:
            for i in range(storage):
                out[k * storage + i] = state.numbers[value + i]
        else:
            retract(memory, v, out, k * storage)


@compiled
def full_steps(memory: Address, chosen: IntArray, out: Array) -> None:
    """Steps of some variables by back-substitution from their roots down, whatever was passed on before.

    Args:
        memory: address of the description of the smoother's arrays.
        chosen: variables.
        out: receives their steps, one after the other.
    """
    state = opened(memory)
    variables, cliques, lists, numbers = state.variables, state.cliques, state.lists, state.numbers
    offset, rows = paths(memory, chosen)
    steps, known, way, at = np.empty(rows), filled(len(offset), 0), filled(len(offset), 0), 0
    for k in range(len(chosen)):
        c, height = variables[chosen[k]].clique, 0
        while c >= 0 and known[c] == 0:
            known[c], way[height] = 1, c
            height += 1
            c = cliques[c].parent
        while height > 0:
            height -= 1
            clique = cliques[way[height]]
            width, top = clique.pivot_rows, offset[way[height]]
            for i in range(width - 1, -1, -1):
                row = clique.front + i * clique.stride
                total, column = numbers[row + clique.size], width
                for j in range(i + 1, width):
                    total -= numbers[row + j] * steps[top + j]
                for q in range(clique.list + clique.pivots, clique.list + clique.count):
                    v = lists[q]
                    below = offset[variables[v].clique] + variables[v].place
                    for d in range(variables[v].dim):
                        total -= numbers[row + column] * steps[below + d]
                        column += 1
                steps[top + i] = total / numbers[row + i]
        v = chosen[k]
        for d in range(variables[v].dim):
            out[at] = steps[offset[variables[v].clique] + variables[v].place + d]
            at += 1


@compiled
def total_cost(memory: Address) -> float:
    """Sum of the costs of all factors at the estimates."""
    state = opened(memory)
    scratch, total = np.empty(state.counters[0].scratch), 0.0
    for f in range(state.counters[0].factor_end):
        if state.factors[f].used:
            total += cost_of(memory, f, scratch)
    return total


@compiled
def squared_errors(memory: Address, chosen: IntArray, out: Array) -> None:
    """Squared norms (n,) of the whitened residuals of some factors at the estimates."""
    scratch = np.empty(opened(memory).counters[0].scratch)
    for k in range(len(chosen)):
        out[k] = evaluate(memory, chosen[k], True, scratch)[1]


@compiled
def factor_rows(memory: Address, f: int, out: Array) -> None:
    """Whitened residual of a factor at the estimates, and its Jacobian at the linearisation points: (m, 1 + width)."""
    scratch, (m, columns) = np.empty(opened(memory).counters[0].scratch), out.shape
    at, _ = evaluate(memory, f, False, scratch)
    for a in range(m):
        for d in range(columns - 1):
            out[a, 1 + d] = scratch[at + m + a * (columns - 1) + d]
    at, _ = evaluate(memory, f, True, scratch)
    for a in range(m):
        out[a, 0] = scratch[at + a]


@compiled
def covariance_root(memory: Address, chosen: IntArray) -> Array:
    """Y of the covariance Y'Y of some variables, in the order given.

    With H = U'U, Y solves U'Y = E for the unit columns E of the variables, and is zero outside the paths from them to
    their roots.
    """
    state = opened(memory)
    variables, cliques, lists, numbers = state.variables, state.cliques, state.lists, state.numbers
    offset, rows = paths(memory, chosen)
    width = 0
    for k in range(len(chosen)):
        width += variables[chosen[k]].dim
    Y, column = np.zeros((rows, width)), 0
    for k in range(len(chosen)):
        v = chosen[k]
        dim, c = variables[v].dim, variables[v].clique
        for d in range(dim):
            Y[offset[c] + variables[v].place + d, column + d] = 1.0
        while c >= 0:
            front, stride, pivots, top = cliques[c].front, cliques[c].stride, cliques[c].pivot_rows, offset[c]
            for i in range(pivots):
                row = front + i * stride
                for d in range(column, column + dim):
                    Y[top + i, d] /= numbers[row + i]
                    for j in range(i + 1, pivots):
                        Y[top + j, d] -= numbers[row + j] * Y[top + i, d]
                j = pivots
                for q in range(cliques[c].list + cliques[c].pivots, cliques[c].list + cliques[c].count):
                    w = lists[q]
                    below = offset[variables[w].clique] + variables[w].place
                    for b in range(variables[w].dim):
                        for d in range(column, column + dim):
                            Y[below + b, d] -= numbers[row + j] * Y[top + i, d]
                        j += 1
            c = cliques[c].parent
        column += dim
    return Y
