"""Numeric elimination: assemble a front, eliminate its pivots, pass the update matrix on.

The factor is a signed Cholesky factor, A = L S L' with S = diag(+-1): all signs positive for a positive definite
matrix, and available in any order for a quasi-definite one (R. Vanderbei, "Symmetric quasidefinite matrices", SIAM
J. Optim. 5 (1995)). In a chain every update matrix falls on the leading part of the next panel: the multifrontal
method is then the block tridiagonal recursion, without an index.
"""

from __future__ import annotations

from unifg.elimination.assembly import add_row
from unifg.elimination.dense import eliminate, subtract_signed
from unifg.elimination.plan import (
    CHILD,
    DIRECT,
    FAILED,
    FIRST,
    FRONTS,
    INDEX,
    NEGATIVE,
    PANEL,
    PANELS,
    PIVOTS,
    POSITIVE,
    ROWS,
    SIBLING,
    STRIDE,
    SURPRISE,
    SURPRISES,
    UPDATE,
    UPDATE_STRIDE,
    ZERO,
    Plan,
)
from unifg.machine.jit import compiled
from unifg.machine.vectors import Address, address, get, put, splat, store
from unifg.typing import Array

BLOCK = 96  # pivots eliminated before the rest of a panel is brought up to date


@compiled
def eliminate_front(
    numbers: Address, panel: int, stride: int, width: int, columns: int, update: int, apart: int, rows: int,
    scale: Address, pivots: Address, signs: Address, first: int,
) -> int:  # fmt: skip
    """Eliminate the pivots of an assembled front, and take from its update matrix what they stand for.

    Args:
        numbers: address of the array of both.
        panel: offset of the panel.
        stride: length of its rows.
        width: its pivots.
        columns: its columns; right-hand sides may follow those of the update matrix.
        update: offset of the update matrix.
        apart: length of its rows.
        rows: its rows.
        scale: size of each pivot before elimination; the front's first is at ``first`` here and in the next two.
        pivots: receives the inverse of the diagonal.
        signs: receives the sign.
        first: see above.

    Returns:
        -1, or the first pivot that vanished.
    """
    begin = 0
    while begin < width:
        end = begin + BLOCK if begin + BLOCK < width else width
        failed = eliminate(numbers, panel, stride, begin, end, columns, scale, pivots, signs, first)
        if failed >= 0:
            return failed
        if end < width:
            subtract_signed(
                numbers, panel + end * (stride + 1), stride, columns - end, panel + begin * stride + end,
                stride, end - begin, signs, first + begin, width - end,
            )  # fmt: skip
        begin = end
    subtract_signed(numbers, update, apart, columns - width, panel + width, stride, width, signs, first, rows)
    return -1


@compiled
def factor(plan: Plan, data: Array, added: Array) -> bool:
    """Assemble and factorise; inertia and failure are left in ``plan.state``.

    Args:
        plan: what `Factorization` prepared.
        data: (nnz,) upper triangle in the order of the pattern.
        added: (n,) added to the diagonal, or empty.
    """
    fronts, state = plan.fronts, plan.state
    numbers, pivots, signs, scale = (
        address(plan.numbers), address(plan.pivots), address(plan.signs), address(plan.work),
    )  # fmt: skip
    slots, relative, runs, order = plan.slots, plan.relative, plan.runs, plan.order
    state[POSITIVE], state[NEGATIVE], state[ZERO], state[FAILED] = 0, 0, 0, -1
    state[SURPRISES], state[SURPRISE] = 0, -1
    negative = 0
    zero = splat(0.0)
    for i in range(0, plan.shape[PANELS], 4):
        store(numbers, i, zero)
    for e in range(len(slots)):
        put(numbers, get(slots, e), get(data, e))
    # Sizes of the pivots before anything is subtracted.
    for s in range(plan.shape[FRONTS]):
        at = fronts[s, PANEL]
        for i in range(fronts[s, FIRST], fronts[s, FIRST] + fronts[s, PIVOTS]):
            if len(added):
                put(numbers, at, get(numbers, at) + get(added, get(order, i)))
            put(scale, i, abs(get(numbers, at)))
            at += fronts[s, STRIDE] + 1
    for s in range(plan.shape[FRONTS]):
        first, width, rows, panel, stride = (
            fronts[s, FIRST], fronts[s, PIVOTS], fronts[s, ROWS], fronts[s, PANEL], fronts[s, STRIDE],
        )  # fmt: skip
        update, apart = fronts[s, UPDATE], fronts[s, UPDATE_STRIDE]
        if fronts[s, DIRECT] == 0:
            for i in range(rows):
                for j in range(update + i * apart + i // 4 * 4, update + (i + 1) * apart, 4):
                    store(numbers, j, zero)
        child = fronts[s, CHILD]
        while child >= 0:
            if fronts[child, DIRECT] == 0:
                size, index, source = fronts[child, ROWS], fronts[child, INDEX], fronts[child, UPDATE]
                step = fronts[child, UPDATE_STRIDE]
                for i in range(size):
                    row = get(relative, index + i)
                    target = panel + row * stride if row < width else update + (row - width) * apart - width
                    add_row(numbers, source, i, size, target, relative, runs, index)
                    source += step
            child = fronts[child, SIBLING]
        failed = eliminate_front(
            numbers, panel, stride, width, width + rows, update, apart, rows, scale, pivots, signs, first
        )  # fmt: skip
        if failed >= 0:
            width = failed
        for i in range(first, first + width):
            sign = get(signs, i)
            if sign < 0.0:
                negative += 1
            if get(plan.expected, i) * sign < 0.0:
                if state[SURPRISES] == 0:
                    state[SURPRISE] = order[i]
                state[SURPRISES] += 1
        if failed >= 0:
            state[POSITIVE], state[NEGATIVE] = first + width - negative, negative
            state[ZERO] = 1
            state[FAILED] = order[first + failed]
            return False
    state[POSITIVE], state[NEGATIVE] = len(order) - negative, negative
    return True
