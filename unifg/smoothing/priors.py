"""Priors that marginalisation left behind, and variables that move although a prior knows them.

A prior is the quadratic ``1/2 d' H d - g' d`` in the steps d from the points where it was linearised. When the point of
a variable moves by e, X -> X Exp(e), steps from the new point are ``d = e + Jr(e)^-1 d' + O(d'^2)`` (Sola et al., "A
micro Lie theory", eq. 69), and the quadratic is written anew in d'.
"""

from __future__ import annotations

from unifg.codegen.calls import call_residual, matrix, vector
from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address
from unifg.smoothing.linear import retract
from unifg.smoothing.state import BY_PYTHON, opened
from unifg.typing import Array


@compiled
def relinearize(memory: Address, v: int, scratch: Array) -> None:
    """Move the linearisation point of a variable to its estimate; its step becomes zero."""
    state = opened(memory)
    numbers, variable = state.numbers, state.variables[v]
    value, storage, dim = variable.value, variable.storage, variable.dim
    at = v - v  # zero, of which compiled code does not know it: functions are compiled anew for a literal
    retract(memory, v, scratch, at)
    if variable.frozen == 2:
        for c in range(state.counters[0].clique_end):
            if state.cliques[c].prior:
                _rewrite(memory, c, v, scratch)
    for k in range(storage):
        numbers[value + k] = scratch[k]
    for k in range(2 * dim):
        numbers[value + storage + k] = 0.0
    variable.candidate = 0


@compiled
def _rewrite(memory: Address, c: int, v: int, scratch: Array) -> None:
    """Write a prior in steps from the new point of a variable, which stands in scratch, if it knows the variable."""
    state = opened(memory)
    variables, lists, numbers, clique = state.variables, state.lists, state.numbers, state.cliques[c]
    row, known = clique.pivot_rows, False
    for q in range(clique.list + clique.pivots, clique.list + clique.count):
        if lists[q] == v:
            known = True
            break
        row += variables[lists[q]].dim
    if not known:
        return
    front, stride, size, value = clique.front, clique.stride, clique.size, variables[v].value
    storage, dim = variables[v].storage, variables[v].dim
    step = value + storage
    for k in range(row, row + dim):  # both triangles of what is about the variable
        for i in range(clique.pivot_rows, size):
            low, high = min(i, k), max(i, k)
            numbers[front + high * stride + low] = numbers[front + low * stride + high]
    for i in range(clique.pivot_rows, size):
        total = 0.0
        for d in range(dim):
            total += numbers[front + i * stride + row + d] * numbers[step + d]
        numbers[front + i * stride + size] -= total
    for p in range(variables[v].part, variables[v].part + variables[v].parts):
        part = state.parts[p]
        where, at, length, width = part.deviation, part.start, part.storage, part.dim
        if where == 0:
            continue
        start, first = storage + width, row + part.tangent
        J, moved = matrix(scratch, start, width, width), start + width * width
        if where == BY_PYTHON:
            J = matrix(numbers, step + 3 * dim + storage, width, width)
        else:
            call_residual(
                where,
                vector(scratch, at, length),
                vector(numbers, value + at, length),
                vector(scratch, 0, 0),
                vector(scratch, storage, width),
                J,
            )
        # Its columns from the right, then its rows from the left, those of the right-hand side as well.
        for along, across, end in ((stride, 1, size), (1, stride, size + 1)):
            for i in range(clique.pivot_rows, end):
                entry = front + i * along + first * across
                for b in range(width):
                    total = 0.0
                    for a in range(width):
                        total += numbers[entry + a * across] * J[a, b]
                    scratch[moved + b] = total
                for b in range(width):
                    numbers[entry + b * across] = scratch[moved + b]
