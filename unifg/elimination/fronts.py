"""Numeric elimination: assemble a front, eliminate its pivots, pass the update matrix on.

The factor is a signed Cholesky factor, A = L S L' with S = diag(+-1): all signs positive for a positive definite
matrix, and available in any order for a quasi-definite one (R. Vanderbei, "Symmetric quasidefinite matrices", SIAM
J. Optim. 5 (1995)). In a chain every update matrix falls on the leading part of the next panel: the multifrontal
method is then the block tridiagonal recursion, without an index.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled, inlined
from unifg.codegen.vectors import Address, address, get, put, splat, store
from unifg.elimination.assembly import add_row
from unifg.elimination.dense import complete, eliminate, subtract_signed
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
    UPDATE,
    UPDATE_STRIDE,
    ZERO,
    Plan,
)
from unifg.typing import Array, IntArray

ALL = -1  # in the place of a part
BLOCK = 96  # pivots eliminated before the rest of a panel is brought up to date
WIDE = 192  # columns of a front beyond which its pivots are eliminated among themselves before its other columns follow


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
    for begin in range(0, width, BLOCK):
        end = begin + BLOCK if begin + BLOCK < width else width
        within = columns if columns <= WIDE else end
        failed = eliminate(numbers, panel, stride, begin, end, within, scale, pivots, signs, first)
        if failed >= 0:
            return failed
        if within < columns:
            complete(numbers, panel, stride, begin, end, end, columns, pivots, signs, first)
        if end < width:
            subtract_signed(
                numbers, panel + end * (stride + 1), stride, columns - end, panel + begin * stride + end,
                stride, end - begin, signs, first + begin, 0, width - end,
            )  # fmt: skip
    subtract_signed(numbers, update, apart, columns - width, panel + width, stride, width, signs, first, 0, rows)
    return -1


@compiled
def factor(plan: Plan, data: Array, added: Array) -> bool:
    """Assemble and factorise; inertia and failure are left in ``plan.state``.

    Args:
        plan: what `Factorization` prepared.
        data: (nnz,) upper triangle in the order of the pattern.
        added: (n,) added to the diagonal, or empty.
    """
    numbers = address(plan.numbers)
    clear(numbers, 0, plan.shape[PANELS])
    scatter(plan, numbers, data, 0, len(plan.slots))
    size_up(plan, numbers, added, 0, plan.shape[FRONTS])
    return eliminate_part(plan, ALL, plan.state)


@compiled
def clear(numbers: Address, start: int, stop: int) -> None:
    """Write zeros to start..stop, and up to three more."""
    zero = splat(0.0)
    for i in range(start, stop, 4):
        store(numbers, i, zero)


@compiled
def scatter(plan: Plan, numbers: Address, data: Array, start: int, stop: int) -> None:
    """Write entries start..stop of a matrix where they belong in the panels."""
    slots = plan.slots
    for e in range(start, stop):
        put(numbers, get(slots, e), get(data, e))


@compiled
def size_up(plan: Plan, numbers: Address, added: Array, start: int, stop: int) -> None:
    """Add to the diagonal of fronts start..stop, and note the sizes of the pivots before anything is subtracted."""
    fronts, order, scale = plan.fronts, plan.order, address(plan.work)
    for s in range(start, stop):
        at = fronts[s, PANEL]
        for i in range(fronts[s, FIRST], fronts[s, FIRST] + fronts[s, PIVOTS]):
            if len(added):
                put(numbers, at, get(numbers, at) + get(added, get(order, i)))
            put(scale, i, abs(get(numbers, at)))
            at += fronts[s, STRIDE] + 1


@inlined
def clear_update(plan: Plan, numbers: Address, s: int, start: int, stop: int) -> None:
    """Write zeros to rows start..stop of the update matrix of a front, where it has one of its own."""
    update, apart, zero = plan.fronts[s, UPDATE], plan.fronts[s, UPDATE_STRIDE], splat(0.0)
    if plan.fronts[s, DIRECT] == 0:
        for i in range(start, stop):
            for j in range(update + i * apart + i // 4 * 4, update + (i + 1) * apart, 4):
                store(numbers, j, zero)


@inlined
def add_child(plan: Plan, numbers: Address, s: int, child: int, start: int, stop: int) -> None:
    """Add rows start..stop of the update matrix of a child to a front, where it is not written there in any case."""
    fronts, relative, runs = plan.fronts, plan.relative, plan.runs
    if fronts[child, DIRECT] == 1:
        return
    width, panel, stride, update, apart = (
        fronts[s, PIVOTS], fronts[s, PANEL], fronts[s, STRIDE], fronts[s, UPDATE], fronts[s, UPDATE_STRIDE],
    )  # fmt: skip
    size, index, step = fronts[child, ROWS], fronts[child, INDEX], fronts[child, UPDATE_STRIDE]
    source = fronts[child, UPDATE] + start * step
    for i in range(start, stop):
        row = get(relative, index + i)
        target = panel + row * stride if row < width else update + (row - width) * apart - width
        add_row(numbers, source, i, size, target, relative, runs, index)
        source += step


@inlined
def begin_count(state: IntArray) -> None:
    """Nothing has been eliminated, nothing has failed."""
    state[POSITIVE], state[NEGATIVE], state[ZERO], state[FAILED] = 0, 0, 0, -1


@inlined
def count_front(plan: Plan, s: int, failed: int, state: IntArray) -> None:
    """Count the pivots of a front that has been eliminated, up to the one that vanished."""
    first, order = plan.fronts[s, FIRST], plan.order
    width = failed if failed >= 0 else plan.fronts[s, PIVOTS]
    negative = 0
    for i in range(first, first + width):
        if get(plan.signs, i) < 0.0:
            negative += 1
    state[POSITIVE] += width - negative
    state[NEGATIVE] += negative
    if failed >= 0:
        state[ZERO] = 1
        state[FAILED] = order[first + failed]


@compiled
def eliminate_part(plan: Plan, part: int, state: IntArray) -> bool:
    """Eliminate the fronts of one part, or of ALL, whose children have been eliminated or belong to it.

    Args:
        plan: with a matrix in its panels.
        part: see above.
        state: (4,) receives what ``plan.state`` holds, of these fronts.
    """
    fronts, shared = plan.fronts, plan.part
    numbers, pivots, signs, scale = (
        address(plan.numbers), address(plan.pivots), address(plan.signs), address(plan.work),
    )  # fmt: skip
    begin_count(state)
    for s in range(plan.shape[FRONTS]):
        if part != ALL and shared[s] != part:
            continue
        width, rows = fronts[s, PIVOTS], fronts[s, ROWS]
        clear_update(plan, numbers, s, 0, rows)
        child = fronts[s, CHILD]
        while child >= 0:
            add_child(plan, numbers, s, child, 0, fronts[child, ROWS])
            child = fronts[child, SIBLING]
        failed = eliminate_front(
            numbers, fronts[s, PANEL], fronts[s, STRIDE], width, width + rows, fronts[s, UPDATE],
            fronts[s, UPDATE_STRIDE], rows, scale, pivots, signs, fronts[s, FIRST],
        )  # fmt: skip
        count_front(plan, s, failed, state)
        if failed >= 0:
            return False
    return True


@compiled
def weakest(order: IntArray, signs: Array, roots: Array, diagonal: Array, size: int) -> float:
    """Smallest pivot, signs / roots^2, relative to the diagonal; 0 where one is not positive."""
    least = np.inf
    for k in range(size):
        pivot, scale = signs[k], diagonal[order[k]] * roots[k] * roots[k]
        if not pivot > least * scale:
            if not pivot > 0.0:
                return 0.0
            least = pivot / scale
    return least
