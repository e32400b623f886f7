"""Priors that marginalisation left behind, and variables that move although a prior knows them.

A prior is the quadratic ``1/2 d' H d - g' d`` in the steps d from the points where it was linearised. When the point of
a variable moves by e, X -> X Exp(e), steps from the new point are ``d = e + Jr(e)^-1 d' + O(d'^2)`` (Sola et al., "A
micro Lie theory", eq. 69), and the quadratic is written anew in d'.
"""

from __future__ import annotations

from unifg.machine.calls import call_residual, matrix, vector
from unifg.machine.jit import compiled
from unifg.smoothing.fields import (
    CANDIDATE,
    COUNT,
    DIM,
    FRONT,
    FROZEN,
    KIND,
    LIST,
    NEXT_CLIQUE,
    PIVOT_ROWS,
    PIVOTS,
    PRIORS,
    SIZE,
    STORAGE,
    STRIDE,
    VALUE,
    State,
)
from unifg.smoothing.linear import PART, retract
from unifg.typing import Array


@compiled
def relinearize(state: State, v: int, scratch: Array) -> None:
    """Move the linearisation point of a variable to its estimate; its step becomes zero."""
    numbers, variable = state.numbers, state.variables[v]
    value, storage, dim = variable[VALUE], variable[STORAGE], variable[DIM]
    at = v - v  # zero, of which compiled code does not know it: functions are compiled anew for a literal
    retract(state, v, value + storage, scratch, at)
    if variable[FROZEN] == 2:
        c = state.counters[PRIORS]
        while c >= 0:
            _rewrite(state, c, v, scratch)
            c = state.cliques[c, NEXT_CLIQUE]
    for k in range(storage):
        numbers[value + k] = scratch[k]
    for k in range(2 * dim):
        numbers[value + storage + k] = 0.0
    variable[CANDIDATE] = 0


@compiled
def _rewrite(state: State, c: int, v: int, scratch: Array) -> None:
    """Write a prior in steps from the new point of a variable, which stands in scratch, if it knows the variable."""
    variables, lists, numbers, clique = state.variables, state.lists, state.numbers, state.cliques[c]
    row, known = clique[PIVOT_ROWS], False
    for q in range(clique[LIST] + clique[PIVOTS], clique[LIST] + clique[COUNT]):
        if lists[q] == v:
            known = True
            break
        row += variables[lists[q], DIM]
    if not known:
        return
    front, stride, size, value = clique[FRONT], clique[STRIDE], clique[SIZE], variables[v, VALUE]
    storage, dim = variables[v, STORAGE], variables[v, DIM]
    step = value + storage
    for i in range(clique[PIVOT_ROWS], size):
        total = 0.0
        for d in range(dim):
            total += numbers[front + _upper(stride, i, row + d)] * numbers[step + d]
        numbers[front + i * stride + size] -= total
    kinds, kind = state.kinds, variables[v, KIND]
    for part in range(kinds[kind]):
        k = kind + 1 + PART * part
        where, at, length, tangent, width = kinds[k + 1], kinds[k + 2], kinds[k + 3], kinds[k + 4], kinds[k + 5]
        if where == 0:
            continue
        start, first = storage + width, row + tangent
        J, moved = matrix(scratch, start, width, width), start + width * width
        call_residual(
            where,
            vector(scratch, at, length),
            vector(numbers, value + at, length),
            vector(scratch, 0, 0),
            vector(scratch, storage, width),
            J,
        )
        for i in range(clique[PIVOT_ROWS], size + 1):
            if first <= i < first + width:
                continue
            for b in range(width):
                total = 0.0
                for a in range(width):
                    total += numbers[front + _upper(stride, i, first + a)] * J[a, b]
                scratch[moved + b] = total
            for b in range(width):
                numbers[front + _upper(stride, i, first + b)] = scratch[moved + b]
        for a in range(width):
            for b in range(width):
                total = 0.0
                for e in range(width):
                    total += numbers[front + _upper(stride, first + a, first + e)] * J[e, b]
                scratch[moved + a * width + b] = total
        for a in range(width):
            for b in range(a, width):
                total = 0.0
                for e in range(width):
                    total += J[e, a] * scratch[moved + e * width + b]
                numbers[front + _upper(stride, first + a, first + b)] = total


@compiled
def _upper(stride: int, i: int, j: int) -> int:
    """Where entry (i, j) of a symmetric matrix stands, of which the upper triangle is stored."""
    return i * stride + j if i < j else j * stride + i
