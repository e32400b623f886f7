"""Forward and backward substitution through the fronts."""

from __future__ import annotations

import numpy as np

from unifg.elimination.plan import FIRST, FRONTS, INDEX, PANEL, ROWS, SCALARS, WIDTH, Plan
from unifg.jit import compiled
from unifg.typing import Array, IntArray


@compiled
def solve(plan: Plan, right: Array, out: Array) -> None:
    """Solve for one right-hand side (n,) with the last factorisation; ``out`` may be ``right``."""
    fronts, rows, panels, pivots, signs = plan.fronts, plan.rows, plan.panels, plan.pivots, plan.signs
    scalars = plan.shape[SCALARS]
    x, local = plan.work[:scalars], plan.work[scalars:]
    for i in range(scalars):
        x[i] = right[plan.order[i]]
    for s in range(plan.shape[FRONTS]):
        first, width, below, begin = fronts[s, FIRST], fronts[s, WIDTH], fronts[s, ROWS], fronts[s, PANEL]
        stride = width + below
        index = rows[fronts[s, INDEX] : fronts[s, INDEX] + below]
        part = local[:stride]
        for i in range(width):
            part[i] = x[first + i]
        for i in range(below):
            part[width + i] = 0.0
        for k in range(width):
            value = part[k] * pivots[first + k]
            part[k] = value * signs[first + k]
            panel = panels[begin + k * stride : begin + (k + 1) * stride]
            for j in range(k + 1, stride):
                part[j] -= value * panel[j]
        for i in range(width):
            x[first + i] = part[i]
        for i in range(below):
            x[index[i]] += part[width + i]
    for s in range(plan.shape[FRONTS] - 1, -1, -1):
        first, width, below, begin = fronts[s, FIRST], fronts[s, WIDTH], fronts[s, ROWS], fronts[s, PANEL]
        stride = width + below
        index = rows[fronts[s, INDEX] : fronts[s, INDEX] + below]
        part = local[:stride]
        for i in range(width):
            part[i] = x[first + i]
        for i in range(below):
            part[width + i] = x[index[i]]
        for k in range(width - 1, -1, -1):
            panel = panels[begin + k * stride : begin + (k + 1) * stride]
            value = 0.0
            for j in range(k + 1, stride):
                value += panel[j] * part[j]
            part[k] = (part[k] - value) * pivots[first + k]
        for i in range(width):
            x[first + i] = part[i]
    for i in range(scalars):
        out[plan.order[i]] = x[i]


@compiled
def solve_columns(plan: Plan, right: Array, out: Array) -> None:
    """Solve for the columns of (n, k)."""
    column = np.empty(len(right))
    for k in range(right.shape[1]):
        column[:] = right[:, k]
        solve(plan, column, column)
        out[:, k] = column


@compiled
def residual(indptr: IntArray, indices: IntArray, data: Array, x: Array, right: Array, out: Array) -> tuple[float, float]:
    """``out`` = right - A x for the upper triangle of A by columns.

    Returns:
        max |out|, and max (|A| |x| + |right|), what rounding errors of the residual are relative to.
    """
    scalars = len(x)
    size = np.abs(right)
    out[:] = right
    for column in range(scalars):
        value, total, bulk = x[column], 0.0, 0.0
        for e in range(indptr[column], indptr[column + 1]):
            row, entry = indices[e], data[e]
            if row == column:
                total += entry * value
                bulk += abs(entry * value)
            else:
                total += entry * x[row]
                bulk += abs(entry * x[row])
                out[row] -= entry * value
                size[row] += abs(entry * value)
        out[column] -= total
        size[column] += bulk
    return np.abs(out).max(), size.max()


@compiled
def refine(
    plan: Plan, indptr: IntArray, indices: IntArray, data: Array, right: Array, out: Array, tolerance: float, steps: int
) -> float:
    """Solve A x = right for A near the factorised matrix, by iterative refinement from x = 0.

    Args:
        plan: with its factorisation, say of A with something added to the diagonal.
        indptr, indices, data: upper triangle of A.
        right: (n,).
        out: (n,) receives x, the best of the iterates.
        tolerance: of max |right - A x|, relative to max (|A| |x| + |right|).
        steps: corrections at most.

    Returns:
        The relative residual reached.
    """
    scalars = len(right)
    rest, step, trial = right.copy(), np.empty(scalars), np.zeros(scalars)
    best = np.inf
    out[:] = 0.0
    for _ in range(steps + 1):
        solve(plan, rest, step)
        for i in range(scalars):
            trial[i] += step[i]
        error, size = residual(indptr, indices, data, trial, right, rest)
        relative = error / size if size > 0.0 else 0.0
        if not relative < best:
            break
        slow = relative > 0.5 * best
        best = relative
        out[:] = trial
        if best <= tolerance or slow:
            break
    return best
