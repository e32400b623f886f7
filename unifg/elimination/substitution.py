"""Forward and backward substitution through the fronts."""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.codegen.vectors import Address, address, blend, get, load, minus, plus_products, put, splat, store, total
from unifg.elimination.plan import ADJACENT, FIRST, FRONTS, INDEX, PANEL, PIVOTS, ROWS, SCALARS, STRIDE, Plan
from unifg.typing import Array, IntArray

MEMORY = 4  # corrections that are combined
PATIENCE = 2  # of them in a row that may fail to halve the residual
ROUNDING = 1e-7  # of what the rows of unknowns have on the right


@compiled
def forward(
    x: Address,
    local: int,
    numbers: Address,
    panel: int,
    stride: int,
    width: int,
    size: int,
    pivots: Address,
    signs: Address,
    first: int,
) -> None:
    """X <- S P^-T x for the pivots of a panel, and what they take from the rest of its ``size`` scalars."""
    for top in range(0, width, 4):
        height = width - top
        r0 = panel + top * (stride + 1)
        r1 = r0 + stride if height > 1 else r0
        r2 = r1 + stride if height > 2 else r0
        r3 = r2 + stride if height > 3 else r0
        at, pivot = local + top, first + top
        v0, v1, v2, v3 = get(x, at) * get(pivots, pivot), 0.0, 0.0, 0.0
        put(x, at, v0 * get(signs, pivot))
        if height > 1:
            v1 = (get(x, at + 1) - get(numbers, r0 + 1) * v0) * get(pivots, pivot + 1)
            put(x, at + 1, v1 * get(signs, pivot + 1))
        if height > 2:
            v2 = (get(x, at + 2) - get(numbers, r0 + 2) * v0 - get(numbers, r1 + 2) * v1) * get(pivots, pivot + 2)
            put(x, at + 2, v2 * get(signs, pivot + 2))
        if height > 3:
            v3 = get(x, at + 3) - get(numbers, r0 + 3) * v0 - get(numbers, r1 + 3) * v1
            v3 = (v3 - get(numbers, r2 + 3) * v2) * get(pivots, pivot + 3)
            put(x, at + 3, v3 * get(signs, pivot + 3))
            height = 4
        for j in range(height, size - top, 4):
            old = load(x, at + j)
            new = minus(minus(old, v0, load(numbers, r0 + j)), v1, load(numbers, r1 + j))
            new = minus(minus(new, v2, load(numbers, r2 + j)), v3, load(numbers, r3 + j))
            store(x, at + j, blend(new, old, size - top - j))


@compiled
def backward(
    x: Address,
    local: int,
    numbers: Address,
    panel: int,
    stride: int,
    width: int,
    size: int,
    pivots: Address,
    first: int,
) -> None:
    """X <- P^-1 x for the pivots of a panel, given the rest of its ``size`` scalars."""
    zero = splat(0.0)
    for top in range((width - 1) // 4 * 4, -1, -4):
        height = width - top
        r0 = panel + top * (stride + 1)
        r1 = r0 + stride if height > 1 else r0
        r2 = r1 + stride if height > 2 else r0
        r3 = r2 + stride if height > 3 else r0
        at, pivot = local + top, first + top
        s0, s1, s2, s3 = zero, zero, zero, zero
        for j in range(height if height < 4 else 4, size - top, 4):
            known = blend(load(x, at + j), zero, size - top - j)
            s0, s1 = plus_products(s0, known, load(numbers, r0 + j)), plus_products(s1, known, load(numbers, r1 + j))
            s2, s3 = plus_products(s2, known, load(numbers, r2 + j)), plus_products(s3, known, load(numbers, r3 + j))
        y1, y2, y3 = 0.0, 0.0, 0.0
        if height > 3:
            y3 = (get(x, at + 3) - total(s3)) * get(pivots, pivot + 3)
            put(x, at + 3, y3)
        if height > 2:
            y2 = (get(x, at + 2) - total(s2) - get(numbers, r2 + 3) * y3) * get(pivots, pivot + 2)
            put(x, at + 2, y2)
        if height > 1:
            y1 = get(x, at + 1) - total(s1) - get(numbers, r1 + 3) * y3
            y1 = (y1 - get(numbers, r1 + 2) * y2) * get(pivots, pivot + 1)
            put(x, at + 1, y1)
        y0 = get(x, at) - total(s0) - get(numbers, r0 + 3) * y3 - get(numbers, r0 + 2) * y2
        put(x, at, (y0 - get(numbers, r0 + 1) * y1) * get(pivots, pivot))


@compiled
def solve(plan: Plan, right: Array, out: Array) -> None:
    """Solve for one right-hand side (n,) with the last factorisation; ``out`` may be ``right``."""
    fronts, rows, order = plan.fronts, plan.rows, plan.order
    numbers, pivots, signs, x = address(plan.numbers), address(plan.pivots), address(plan.signs), address(plan.work)
    scalars, count = plan.shape[SCALARS], plan.shape[FRONTS]
    for i in range(scalars):
        put(x, i, get(right, get(order, i)))
    for sweep in range(2):
        for k in range(count):
            s = k if sweep == 0 else count - 1 - k
            first, width, below, panel, stride = (
                fronts[s, FIRST], fronts[s, PIVOTS], fronts[s, ROWS], fronts[s, PANEL], fronts[s, STRIDE],
            )  # fmt: skip
            index, local = fronts[s, INDEX], first
            apart = fronts[s, ADJACENT] == 0 and below > 0
            if apart:
                local = scalars
                for i in range(width):
                    put(x, local + i, get(x, first + i))
                for i in range(below):
                    put(x, local + width + i, get(x, get(rows, index + i)))
            if sweep == 0:
                forward(x, local, numbers, panel, stride, width, width + below, pivots, signs, first)
            else:
                backward(x, local, numbers, panel, stride, width, width + below, pivots, first)
            if apart:
                for i in range(width):
                    put(x, first + i, get(x, local + i))
                if sweep == 0:
                    for i in range(below):
                        put(x, get(rows, index + i), get(x, local + width + i))
    for i in range(scalars):
        put(out, get(order, i), get(x, i))


@compiled
def solve_columns(plan: Plan, right: Array, out: Array) -> None:
    """Solve for the rows of (k, n)."""
    for k in range(right.shape[0]):
        solve(plan, right[k], out[k])


@compiled
def residual(
    indptr: IntArray,
    indices: IntArray,
    data: Array,
    x: Array,
    right: Array,
    scale: Array,
    first: int,
    out: Array,
    bulk: Array,
) -> float:
    """``out`` = right - A x for the upper triangle of A by columns; ``bulk`` = |right| + |A| |x|.

    The rows from ``first`` on, those of multipliers, may ask that unknowns do not move at all: then their own bulk is
    rounding only. So their size is at least that of the unknowns, x / scale, which their entries near one multiply
    (J. Rigal and J. Gaches, "On the compatibility of a given solution with the data of a linear system", J. ACM 14
    (1967)), and at least a small part of what the unknowns' rows have on the right: where nothing moves, rounding of
    these is left. Multipliers do not count, which grow without limit where constraints contradict each other.

    Returns:
        max scale |out| / max scale bulk, what rounding errors of the residual are relative to; the larger ratio of the
        rows before ``first`` and of the others.
    """
    scalars = len(x)
    for i in range(scalars):
        out[i], bulk[i] = right[i], abs(right[i])
    for column in range(scalars):
        value, products, sizes = x[column], 0.0, 0.0
        for e in range(indptr[column], indptr[column + 1]):
            row, entry = indices[e], data[e]
            above = entry * x[row]
            products += above
            sizes += abs(above)
            if row != column:
                out[row] -= entry * value
                bulk[row] += abs(entry * value)
        out[column] -= products
        bulk[column] += sizes
    error, size, least = 0.0, 0.0, 0.0
    for i in range(first):
        error, size = max(error, scale[i] * abs(out[i])), max(size, scale[i] * bulk[i])
        least = max(least, abs(x[i]) / scale[i], ROUNDING * scale[i] * abs(right[i]))
    worst, error, size = error / size if size > 0.0 else error, 0.0, least
    for i in range(first, scalars):
        error, size = max(error, scale[i] * abs(out[i])), max(size, scale[i] * bulk[i])
    worst = max(worst, error / size if size > 0.0 else error)
    total = 0.0  # what is compared loses NaN, a sum does not
    for i in range(scalars):
        total += out[i]
    return worst if total == total else np.nan


@compiled
def refine(
    plan: Plan,
    indptr: IntArray,
    indices: IntArray,
    data: Array,
    right: Array,
    scale: Array,
    first: int,
    out: Array,
    left: Array,
    tolerance: float,
    small: float,
    steps: int,
) -> float:
    """Solve A x = right for A near the factorised matrix, by iterative refinement from x = 0.

    Where a correction alone does not do, it is combined with the last ones so that the residual is least (generalised
    conjugate residuals, S. Eisenstat, H. Elman, M. Schultz, SIAM J. Numer. Anal. 20 (1983)): weak directions, for which
    what was added to the diagonal matters, are few.

    Args:
        plan: with its factorisation, say of A with something added to the diagonal.
        indptr: upper triangle of A by columns.
        indices: its rows.
        data: its entries.
        right: (n,).
        scale: (n,) factors of the rows, where their residuals are compared.
        first: row from which on rows are measured by themselves, say those of multipliers; n for none.
        out: (n,) receives x, the best of the iterates.
        left: (n,) receives right - A x.
        tolerance: of the residual, as :func:`residual` measures it.
        small: scaled residual that will do as well.
        steps: corrections at most.

    Returns:
        The relative residual reached.
    """
    scalars = len(right)
    x, rest, trial, after = np.zeros(scalars), right.copy(), np.empty(scalars), np.empty(scalars)
    step, other, bulk = np.empty(scalars), np.empty(scalars), np.empty(scalars)
    moves, effects = np.empty((MEMORY, scalars)), np.empty((MEMORY, scalars))
    best, idle = np.inf, 0
    out[:] = 0.0
    copy_to(right, left)
    for k in range(steps + 1):
        solve(plan, rest, step)
        for i in range(scalars):
            trial[i] = x[i] + step[i]
        relative = residual(indptr, indices, data, trial, right, scale, first, after, bulk)
        if not relative < np.inf:
            break
        enough = relative <= tolerance or largest_of(scale, after) <= small
        if not enough:
            for i in range(scalars):
                bulk[i] = scale[i] * (rest[i] - after[i])
            kept = min(k + 1, MEMORY)
            _remember(k % MEMORY, step, bulk, moves[:kept], effects[:kept])
            if k > 0:
                _least(x, rest, scale, moves[:kept], effects[:kept], other)
                combined = residual(indptr, indices, data, other, right, scale, first, step, bulk)
                if combined < relative:
                    relative = combined
                    copy_to(other, trial)
                    copy_to(step, after)
        idle = idle + 1 if relative > 0.5 * best else 0
        if relative < best:
            best = relative
            copy_to(trial, out)
            copy_to(after, left)
        if enough or best <= tolerance or idle == PATIENCE:
            break
        copy_to(trial, x)
        copy_to(after, rest)
    return best


@compiled
def largest_of(scale: Array, numbers: Array) -> float:
    """Largest magnitude of numbers times their scales."""
    largest = 0.0
    for i in range(len(numbers)):
        largest = max(largest, scale[i] * abs(numbers[i]))
    return largest


@compiled
def _remember(place: int, step: Array, effect: Array, moves: Array, effects: Array) -> None:
    """Keep a correction and its effect on the scaled residual, without what the others kept do, and of length one."""
    move, own = moves[place], effects[place]
    copy_to(step, move)
    copy_to(effect, own)
    for j in range(len(moves)):
        if j != place:
            share = 0.0
            for i in range(len(own)):
                share += own[i] * effects[j, i]
            for i in range(len(own)):
                move[i] -= share * moves[j, i]
                own[i] -= share * effects[j, i]
    square = 0.0
    for i in range(len(own)):
        square += own[i] ** 2
    length = 1.0 / math.sqrt(square) if square > 0.0 else 0.0
    for i in range(len(own)):
        move[i] *= length
        own[i] *= length


@compiled
def _least(x: Array, rest: Array, scale: Array, moves: Array, effects: Array, out: Array) -> None:
    """``out`` = x and the combination of corrections after which the scaled residual ``rest`` is least."""
    copy_to(x, out)
    for j in range(len(moves)):
        share = 0.0
        for i in range(len(x)):
            share += scale[i] * rest[i] * effects[j, i]
        for i in range(len(x)):
            out[i] += share * moves[j, i]
