"""Costs that are no squares, in compiled loops: value, slope and curvature of every factor in one pass.

Their Hessians need not be positive: the Gauss-Newton Hessian of a program takes the nearest positive semi-definite
block of each factor, and what is left out is kept apart, for those who use second derivatives as they are.
"""

from __future__ import annotations

from math import isfinite, sqrt

import numpy as np

from unifg.codegen.calls import call_residual, matrix, vector, vector_at
from unifg.codegen.jit import compiled
from unifg.problem.evaluation import gather_variables
from unifg.problem.table import (
    ACTIVE,
    ADDRESS,
    COLUMN,
    COUNT,
    KEEP,
    KERNEL_WIDTH,
    PARAMETER,
    PARAMETERS,
    POSITION,
    ROW,
    SECOND,
    SPREAD,
    STORAGE,
    TABLE,
    TABLE_SIZE,
    WIDTH,
    TermArrays,
)
from unifg.typing import Array

SWEEPS = 50  # of rotations; ten are many
ROUNDING = 1e-12  # of curvature, relative


@compiled
def evaluate_scalars(terms: TermArrays, values: Array, found: Array, scratch: Array) -> float:
    """Write the value of every factor that has a kernel; returns their sum."""
    total = 0.0
    for t in range(len(terms.scalars)):
        term = terms.scalars[t]
        if term[ADDRESS] == 0:
            continue
        v, table = vector(scratch, 0, term[STORAGE]), vector_at(term[TABLE], term[TABLE_SIZE])
        for i in range(term[COUNT]):
            r = vector(found, term[ROW] + i, 1)
            r[0] = 0.0
            if term[ACTIVE] < 0 or terms.active[term[ACTIVE] + i] != 0:
                gather_variables(term, i, terms.gather, terms.sizes, terms.parameters, values, scratch)
                p = vector(terms.parameters, term[PARAMETER] + i * term[SPREAD], term[PARAMETERS])
                call_residual(term[ADDRESS], v, p, table, r, matrix(scratch, 0, 0, 0))
                total += r[0]
    return total


@compiled
def add_scalars(
    terms: TermArrays, values: Array, found: Array, gradient: Array, hessian: Array, concavity: Array, scratch: Array
) -> float:
    """The same, with slopes added to the gradient and second derivatives to the entries of the normal matrix.

    Args:
        terms: of the program.
        values: stored ones.
        found: (n,) values of all factors, to be written.
        gradient: over the full tangent space.
        hessian: takes what is positive.
        concavity: takes the rest.
        scratch: for the variables of a factor.
    """
    columns, positions, sizes = terms.columns, terms.positions, terms.sizes
    widest = 1
    for t in range(len(terms.scalars)):
        widest = max(widest, terms.scalars[t, KERNEL_WIDTH])
    slope, memory, total = np.empty(widest), np.empty(5 * widest * widest), 0.0
    for t in range(len(terms.scalars)):
        term = terms.scalars[t]
        if term[ADDRESS] == 0:
            continue
        v, table = vector(scratch, 0, term[STORAGE]), vector_at(term[TABLE], term[TABLE_SIZE])
        full, width, keep, at = term[KERNEL_WIDTH], term[WIDTH], term[KEEP], term[POSITION]
        J, S, size = matrix(slope, 0, 1, full), matrix(memory, 0, full, full), widest * widest
        B, C = matrix(memory, size, width, width), matrix(memory, 2 * size, width, width)
        A, V = matrix(memory, 3 * size, width, width), matrix(memory, 4 * size, width, width)
        for i in range(term[COUNT]):
            r = vector(found, term[ROW] + i, 1)
            if term[ACTIVE] >= 0 and terms.active[term[ACTIVE] + i] == 0:
                r[0] = 0.0
                at += width * (width + 1) // 2
                continue
            gather_variables(term, i, terms.gather, terms.sizes, terms.parameters, values, scratch)
            p = vector(terms.parameters, term[PARAMETER] + i * term[SPREAD], term[PARAMETERS])
            if term[SECOND] != 0:
                r[0] = 1.0
                call_residual(term[SECOND], v, p, table, r, S)
                for d in range(width):
                    for e in range(width):
                        a, b = d if keep < 0 else sizes[keep + d], e if keep < 0 else sizes[keep + e]
                        B[d, e] = 0.5 * (S[a, b] + S[b, a])
                positive_part(B, A, V, C)
            call_residual(term[ADDRESS], v, p, table, r, J)
            total += r[0]
            for d in range(width):
                gradient[columns[term[COLUMN] + i * width + d]] += slope[d if keep < 0 else sizes[keep + d]]
                for e in range(d + 1):
                    where, times = positions[at], 1.0
                    at += 1
                    if where != -1 and term[SECOND] != 0:
                        if where < 0:
                            where, times = -2 - where, 2.0
                        hessian[where] += times * C[d, e]
                        concavity[where] += times * (B[d, e] - C[d, e])
    return total


@compiled
def positive_part(S: Array, A: Array, V: Array, out: Array) -> None:
    """Nearest positive semi-definite matrix to a symmetric one; what is not finite stays as it is.

    Args:
        S: (n, n).
        A: (n, n) memory.
        V: the same.
        out: (n, n) to be written.
    """
    n, definite = len(S), True
    for d in range(n):
        for e in range(n):
            out[d, e] = A[d, e] = S[d, e]
            if not isfinite(S[d, e]):
                definite = False
    if not definite:
        return
    if _semidefinite(S, A):
        return
    for d in range(n):
        for e in range(n):
            A[d, e], V[d, e], out[d, e] = S[d, e], 1.0 if d == e else 0.0, 0.0
    for _ in range(SWEEPS):  # Jacobi's rotations
        off = on = 0.0
        for d in range(n):
            on += A[d, d] * A[d, d]
            for e in range(d):
                off += A[d, e] * A[d, e]
        if off <= 1e-34 * on:
            break
        for p in range(n):
            for q in range(p):
                _rotate(A, V, p, q)
    for k in range(n):
        if A[k, k] > 0.0:
            for d in range(n):
                for e in range(n):
                    out[d, e] += A[k, k] * V[d, k] * V[e, k]


@compiled
def _semidefinite(S: Array, A: Array) -> bool:
    """Test by Cholesky's pivots whether a matrix has no negative curvature but for rounding; A is memory.

    A pivot of nothing is in order where its column is nothing, too, as of the energy of an element that may be moved.
    """
    for d in range(len(S)):
        for f in range(d, len(S)):
            total = S[f, d]
            for k in range(d):
                total -= A[f, k] * A[d, k]
            A[f, d] = total
        pivot = A[d, d]
        if pivot > ROUNDING * S[d, d]:
            root = 1.0 / sqrt(pivot)
            for f in range(d, len(S)):
                A[f, d] *= root
            continue
        if not pivot >= -ROUNDING * S[d, d]:
            return False
        for f in range(d, len(S)):
            if not abs(A[f, d]) <= ROUNDING * sqrt(abs(S[d, d] * S[f, f])):
                return False
            A[f, d] = 0.0
    return True


@compiled
def _rotate(A: Array, V: Array, p: int, q: int) -> None:
    """Make one entry of a symmetric matrix zero, and keep count of the rotations (Golub and Van Loan, 8.5.2)."""
    if A[p, q] == 0.0:
        return
    ratio = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
    tangent = 1.0 / (abs(ratio) + sqrt(1.0 + ratio * ratio))
    tangent = tangent if ratio >= 0.0 else -tangent
    cosine = 1.0 / sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    for k in range(len(A)):
        x, y = A[k, p], A[k, q]
        A[k, p], A[k, q] = cosine * x - sine * y, sine * x + cosine * y
    for k in range(len(A)):
        x, y = A[p, k], A[q, k]
        A[p, k], A[q, k] = cosine * x - sine * y, sine * x + cosine * y
    A[p, q] = A[q, p] = 0.0
    for k in range(len(A)):
        x, y = V[k, p], V[k, q]
        V[k, p], V[k, q] = cosine * x - sine * y, sine * x + cosine * y
