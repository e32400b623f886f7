"""Numeric elimination: assemble a front, eliminate its pivots, pass the update matrix on.

The factor is a signed Cholesky factor, A = L S L' with S = diag(+-1): all signs positive for a positive definite
matrix, and available in any order for a quasi-definite one (R. Vanderbei, "Symmetric quasidefinite matrices", SIAM
J. Optim. 5 (1995)).
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.blas import GEMM, GENERAL, LOWER, PLAIN, RIGHT, SYRK, TRANSPOSED, TRSM, fortran
from unifg.elimination.plan import (
    CHILD,
    ENTRY,
    FAILED,
    FIRST,
    FRONTS,
    INDEX,
    NEGATIVE,
    PANEL,
    POSITIVE,
    ROWS,
    SCALARS,
    SIBLING,
    SURPRISE,
    SURPRISES,
    UPDATE,
    WIDTH,
    ZERO,
    Plan,
)  # fmt: skip
from unifg.jit import compiled
from unifg.typing import Array, IntArray

VANISHED = 8.9e-16  # pivots below this part of their original diagonal are rounding errors
BLOCK = 32  # pivots eliminated between two calls of BLAS
LARGE = 24000.0  # multiplications in a front from which BLAS is faster


@compiled
def eliminate(
    panel: Array, stride: int, begin: int, end: int, columns: int, scale: Array, pivots: Array, signs: Array
) -> int:
    """Eliminate pivots begin..end of a panel within its columns begin..columns; -1 or the pivot that vanished.

    Args:
        panel: (pivots, stride) flat.
        stride: length of a row.
        begin, end, columns: see above.
        scale: size of each pivot before elimination.
        pivots, signs: receive 1 / diagonal and sign.
    """
    for i in range(begin, end):
        row = panel[i * stride + i : i * stride + columns]
        size = columns - i
        k = begin
        while k + 4 <= i:
            p0 = panel[k * stride + i : k * stride + columns]
            p1 = panel[(k + 1) * stride + i : (k + 1) * stride + columns]
            p2 = panel[(k + 2) * stride + i : (k + 2) * stride + columns]
            p3 = panel[(k + 3) * stride + i : (k + 3) * stride + columns]
            a0, a1, a2, a3 = signs[k] * p0[0], signs[k + 1] * p1[0], signs[k + 2] * p2[0], signs[k + 3] * p3[0]
            for j in range(size):
                row[j] -= a0 * p0[j] + a1 * p1[j] + a2 * p2[j] + a3 * p3[j]
            k += 4
        while k < i:
            p0 = panel[k * stride + i : k * stride + columns]
            a0 = signs[k] * p0[0]
            for j in range(size):
                row[j] -= a0 * p0[j]
            k += 1
        pivot = row[0]
        bar = abs(pivot)
        if not (bar > VANISHED * scale[i] and bar < np.inf):
            return i
        root = np.sqrt(bar)
        inverse = 1.0 / root
        signs[i] = 1.0 if pivot > 0.0 else -1.0
        pivots[i] = inverse
        row[0] = root
        factor = signs[i] * inverse
        for j in range(1, size):
            row[j] *= factor
    return -1


@compiled
def subtract_products(panel: Array, width: int, rows: int, signs: Array, update: Array) -> None:
    """Update matrix -= P' S P, upper triangle by rows, P the last ``rows`` columns of the panel."""
    stride = width + rows
    for i in range(rows):
        row = update[i * rows + i : i * rows + rows]
        at = width + i
        k = 0
        while k + 4 <= width:
            p0 = panel[k * stride + at : (k + 1) * stride]
            p1 = panel[(k + 1) * stride + at : (k + 2) * stride]
            p2 = panel[(k + 2) * stride + at : (k + 3) * stride]
            p3 = panel[(k + 3) * stride + at : (k + 4) * stride]
            a0, a1, a2, a3 = signs[k] * p0[0], signs[k + 1] * p1[0], signs[k + 2] * p2[0], signs[k + 3] * p3[0]
            for j in range(rows - i):
                row[j] -= a0 * p0[j] + a1 * p1[j] + a2 * p2[j] + a3 * p3[j]
            k += 4
        while k < width:
            p0 = panel[k * stride + at : (k + 1) * stride]
            a0 = signs[k] * p0[0]
            for j in range(rows - i):
                row[j] -= a0 * p0[j]
            k += 1


@compiled
def eliminate_large(
    routines: IntArray, panel: Array, width: int, rows: int, scale: Array, pivots: Array, signs: Array, update: Array,
    work: Array,
) -> int:  # fmt: skip
    """Both of the above through BLAS, which sees the panel as a (stride, width) array by columns."""
    stride = width + rows
    for begin in range(0, width, BLOCK):
        end = min(begin + BLOCK, width)
        failed = eliminate(panel, stride, begin, end, end, scale, pivots, signs)
        if failed >= 0:
            return failed
        if end == stride:
            break
        beneath = panel[begin * stride + end :]
        fortran(
            routines[TRSM],
            (RIGHT, LOWER, TRANSPOSED, GENERAL, stride - end, end - begin, 1.0, panel[begin * stride + begin :], stride,
             beneath, stride),
        )  # fmt: skip
        for k in range(begin, end):
            if signs[k] < 0.0:
                row = panel[k * stride + end : (k + 1) * stride]
                for j in range(len(row)):
                    row[j] = -row[j]
        if end < width:
            signed = signed_copy(panel, stride, begin, end, end, width, signs, work)
            fortran(
                routines[GEMM],
                (PLAIN, TRANSPOSED, stride - end, width - end, end - begin, -1.0, beneath, stride, signed, width - end,
                 1.0, panel[end * stride + end :], stride),
            )  # fmt: skip
    if rows == 0:
        return -1
    sign = signs[0]
    mixed = False
    for k in range(width):
        mixed |= signs[k] != sign
    if not mixed:
        fortran(routines[SYRK], (LOWER, PLAIN, rows, width, -sign, panel[width:], stride, 1.0, update, rows))
        return -1
    for begin in range(0, rows, 64):
        end = min(begin + 64, rows)
        signed = signed_copy(panel, stride, 0, width, width + begin, width + end, signs, work)
        fortran(
            routines[GEMM],
            (PLAIN, TRANSPOSED, rows - begin, end - begin, width, -1.0, panel[width + begin :], stride, signed, end - begin,
             1.0, update[begin * rows + begin :], rows),
        )  # fmt: skip
    return -1


@compiled
def signed_copy(
    panel: Array, stride: int, begin: int, end: int, first: int, last: int, signs: Array, work: Array
) -> Array:
    """Rows begin..end and columns first..last of the panel times the signs, in ``work``."""
    size = last - first
    for k in range(begin, end):
        row, copy = panel[k * stride + first : k * stride + last], work[(k - begin) * size : (k - begin + 1) * size]
        sign = signs[k]
        for j in range(size):
            copy[j] = sign * row[j]
    return work


@compiled
def factor(plan: Plan, data: Array, added: Array) -> bool:
    """Assemble and factorise; inertia and failure are left in ``plan.state``.

    Args:
        plan: what `Factorization` prepared.
        data: (nnz,) upper triangle in the order of the pattern.
        added: (n,) added to the diagonal, or empty.
    """
    fronts, panels, updates, state = plan.fronts, plan.panels, plan.updates, plan.state
    scale = plan.work
    state[POSITIVE], state[NEGATIVE], state[ZERO], state[FAILED] = 0, 0, 0, -1
    state[SURPRISES], state[SURPRISE] = 0, -1
    for s in range(plan.shape[FRONTS]):
        first, width, rows, begin = fronts[s, FIRST], fronts[s, WIDTH], fronts[s, ROWS], fronts[s, PANEL]
        stride = width + rows
        panel = panels[begin : begin + width * stride]
        for i in range(width * stride):
            panel[i] = 0.0
        for e in range(fronts[s, ENTRY], fronts[s + 1, ENTRY]):
            panels[plan.slots[e]] = data[plan.entries[e]]
        if len(added):
            for i in range(width):
                panel[i * stride + i] += added[plan.order[first + i]]
        for i in range(width):
            scale[first + i] = abs(panel[i * stride + i])
        update = updates[fronts[s, UPDATE] : fronts[s, UPDATE] + rows * rows]
        for i in range(rows * rows):
            update[i] = 0.0
        child = fronts[s, CHILD]
        while child >= 0:
            size = fronts[child, ROWS]
            index = plan.relative[fronts[child, INDEX] : fronts[child, INDEX] + size]
            passed = updates[fronts[child, UPDATE] : fronts[child, UPDATE] + size * size]
            split = 0
            while split < size and index[split] < width:
                split += 1
            for i in range(split):
                target, source = panel[index[i] * stride :], passed[i * size :]
                for j in range(i, size):
                    target[index[j]] += source[j]
            for i in range(split, size):
                target, source = update[(index[i] - width) * rows :], passed[i * size :]
                for j in range(i, size):
                    target[index[j] - width] += source[j]
            child = fronts[child, SIBLING]
        pivots, signs = plan.pivots[first : first + width], plan.signs[first : first + width]
        if float(width) * stride * stride > LARGE:
            failed = eliminate_large(
                plan.routines, panel, width, rows, scale[first : first + width], pivots, signs, update,
                plan.work[plan.shape[SCALARS] :],
            )  # fmt: skip
        else:
            failed = eliminate(panel, stride, 0, width, stride, scale[first : first + width], pivots, signs)
            if failed < 0:
                subtract_products(panel, width, rows, signs, update)
        for i in range(failed if failed >= 0 else width):
            negative = signs[i] < 0.0
            state[NEGATIVE if negative else POSITIVE] += 1
            if plan.expected[first + i] * signs[i] < 0.0:
                if state[SURPRISES] == 0:
                    state[SURPRISE] = plan.order[first + i]
                state[SURPRISES] += 1
        if failed >= 0:
            state[ZERO] = 1
            state[FAILED] = plan.order[first + failed]
            return False
    return True
