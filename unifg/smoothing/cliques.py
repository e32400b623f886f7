"""Numeric work on one clique: assemble its front, eliminate its pivots, and find its step later.

A front is a square matrix, of which the upper triangle is used, and one more column for the right-hand side: pivots
first, then the separator. Eliminated, its first rows hold U and d of ``U step = d``, the others the update matrix
that the parent adds to its own front (J. Liu, "The multifrontal method", SIAM Review 34 (1992)).
"""

from __future__ import annotations

from unifg.elimination.dense import eliminate, subtract_signed
from unifg.machine.jit import compiled
from unifg.machine.vectors import address, blend, get, load, plus, put, splat, store
from unifg.smoothing.fields import (
    CANDIDATE,
    CANDIDATES,
    CHANGED,
    COUNT,
    DATA,
    DIM,
    FRONT,
    FROZEN,
    LIST,
    LOCAL,
    NEXT_CANDIDATE,
    NUMBERS,
    PIVOT_ROWS,
    PIVOTS,
    SIZE,
    SLOTS,
    STORAGE,
    STRIDE,
    TYPE,
    VALUE,
    VARIABLES,
    WIDTH,
    State,
)
from unifg.typing import Array, IntArray


@compiled
def add_factor(state: State, f: int, place: IntArray, clique: IntArray) -> None:
    """Add J'J and -J'r of a linearised factor to a front; ``place`` has the first row of each variable by number."""
    numbers, lists, variables, factor = state.numbers, state.lists, state.variables, state.factors[f]
    kind = state.types[factor[TYPE]]
    width, slots, front, stride, size = kind[WIDTH], kind[SLOTS], clique[FRONT], clique[STRIDE], clique[SIZE]
    first, source, zero = factor[VARIABLES], factor[DATA] + kind[NUMBERS], splat(0.0)
    column = 0
    for s in range(slots):
        v = get(lists, first + s)
        row, dim = place[variables[v, LOCAL]], variables[v, DIM]
        for i in range(dim):
            at = front + (row + i) * stride
            put(numbers, at + size, get(numbers, at + size) - get(numbers, source + width))
            at += row + i
            for k in range(0, dim - i, 4):
                passed = blend(load(numbers, source + column + i + k), zero, dim - i - k)
                store(numbers, at + k, plus(load(numbers, at + k), 1.0, passed))
            other = column + dim
            for t in range(s + 1, slots):
                w = get(lists, first + t)
                col, wide = place[variables[w, LOCAL]], variables[w, DIM]
                if row < col:
                    at = front + (row + i) * stride + col
                    for k in range(0, wide, 4):
                        passed = blend(load(numbers, source + other + k), zero, wide - k)
                        store(numbers, at + k, plus(load(numbers, at + k), 1.0, passed))
                else:
                    at = front + col * stride + row + i
                    for k in range(wide):
                        put(numbers, at, get(numbers, at) + get(numbers, source + other + k))
                        at += stride
                other += wide
            source += width + 1
        column += dim


@compiled
def add_child(
    state: State, child: IntArray, place: IntArray, clique: IntArray, relative: IntArray, runs: IntArray
) -> None:
    """Add the update matrix of a child to the front of its parent."""
    numbers, lists, variables = state.numbers, state.lists, state.variables
    front, stride, size = clique[FRONT], clique[STRIDE], clique[SIZE]
    step, skip = child[STRIDE], child[PIVOT_ROWS]
    source, count, rising = child[FRONT] + skip * (step + 1), 0, True
    for k in range(child[LIST] + child[PIVOTS], child[LIST] + child[COUNT]):
        v = lists[k]
        row = place[variables[v, LOCAL]]
        rising = rising and (count == 0 or row > relative[count - 1])
        for d in range(variables[v, DIM]):
            relative[count] = row + d
            count += 1
    if not rising:
        for i in range(count):
            row = relative[i]
            for j in range(i, count):
                col = relative[j]
                at = front + (row * stride + col if row < col else col * stride + row)
                put(numbers, at, get(numbers, at) + get(numbers, source + j))
            at = front + row * stride + size
            put(numbers, at, get(numbers, at) + get(numbers, source + count))
            source += step
        return
    relative[count] = size
    runs[count] = 1
    for i in range(count - 1, -1, -1):
        runs[i] = runs[i + 1] + 1 if relative[i + 1] == relative[i] + 1 else 1
    zero = splat(0.0)
    for i in range(count):
        target, j = front + relative[i] * stride, i
        while j <= count:
            at, length = target + relative[j], runs[j]
            for k in range(0, length, 4):
                passed = blend(load(numbers, source + j + k), zero, length - k)
                store(numbers, at + k, plus(load(numbers, at + k), 1.0, passed))
            j += length
        source += step


@compiled
def eliminate_clique(state: State, clique: IntArray, scale: Array, pivots: Array, signs: Array) -> int:
    """Eliminate the pivots of an assembled front; returns -1, or the variable whose pivot vanished."""
    numbers, lists, variables = state.numbers, state.lists, state.variables
    front, stride, size, width = clique[FRONT], clique[STRIDE], clique[SIZE], clique[PIVOT_ROWS]
    at = 0
    for k in range(clique[LIST], clique[LIST] + clique[PIVOTS]):
        v = lists[k]
        dim = variables[v, DIM]
        start = variables[v, VALUE] + variables[v, STORAGE] + 2 * dim
        for d in range(dim):
            scale[at] = numbers[start + d]
            at += 1
    where, sign = address(numbers), address(signs)
    first = front - front  # zero, of which compiled code does not know it: functions are compiled anew for a literal
    failed = eliminate(
        where, front, stride, first, width, size + 1, address(scale), address(pivots), sign, first
    )  # fmt: skip
    end = width if failed < 0 else failed
    for i in range(end):
        if signs[i] < 0.0:
            failed = i
            break
    if failed < 0:
        rows = size - width
        subtract_signed(
            where, front + width * (stride + 1), stride, rows + 1, front + width, stride, width, sign, first, rows
        )  # fmt: skip
        return -1
    at = 0
    for k in range(clique[LIST], clique[LIST] + clique[PIVOTS]):
        at += variables[lists[k], DIM]
        if failed < at:
            return int(lists[k])
    return int(lists[clique[LIST]])


@compiled
def substitute(state: State, clique: IntArray, threshold: float, limit: float, update: int, x: Array) -> None:
    """Find the step of the pivots, given that of the separator.

    Args:
        state: of the smoother.
        clique: eliminated.
        threshold: variables that moved further than this since they last did are marked.
        limit: steps beyond it make a variable a candidate for relinearisation.
        update: number of this update.
        x: scratch, (size,).
    """
    numbers, lists, variables, counters = state.numbers, state.lists, state.variables, state.counters
    front, stride, size, width = clique[FRONT], clique[STRIDE], clique[SIZE], clique[PIVOT_ROWS]
    at = width
    for k in range(clique[LIST] + clique[PIVOTS], clique[LIST] + clique[COUNT]):
        v = lists[k]
        step = variables[v, VALUE] + variables[v, STORAGE]
        for d in range(variables[v, DIM]):
            x[at] = numbers[step + d]
            at += 1
    for i in range(width - 1, -1, -1):
        row = front + i * stride
        total = get(numbers, row + size)
        for j in range(i + 1, size):
            total -= get(numbers, row + j) * get(x, j)
        x[i] = total / numbers[row + i]
    at = 0
    for k in range(clique[LIST], clique[LIST] + clique[PIVOTS]):
        v = lists[k]
        dim = variables[v, DIM]
        step = variables[v, VALUE] + variables[v, STORAGE]
        moved, largest = 0.0, 0.0
        for d in range(dim):
            numbers[step + d] = x[at]
            largest = max(largest, abs(x[at]))
            moved = max(moved, abs(x[at] - numbers[step + dim + d]))
            at += 1
        if moved > threshold:
            variables[v, CHANGED] = update
            for d in range(dim):
                numbers[step + dim + d] = numbers[step + d]
        if largest > limit and variables[v, CANDIDATE] == 0 and variables[v, FROZEN] != 1:
            variables[v, CANDIDATE] = 1
            variables[v, NEXT_CANDIDATE] = counters[CANDIDATES]
            counters[CANDIDATES] = v
