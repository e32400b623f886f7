"""Second derivatives of one factor whose kernel comes without them, by differences along tangent directions.

Most graphs have no such factor, so that passes reach this through an address (:func:`differencing`).
"""

from __future__ import annotations

from functools import cache

from numba import float64, int64

from unifg.codegen.calls import call_residual, call_retraction, matrix, vector
from unifg.codegen.function_pointers import NOTHING, link
from unifg.codegen.jit import compiled, in_order, inlined
from unifg.codegen.work_queue import arrays
from unifg.factors.steps import (
    ANGLE,
    ONE_SIDED,
    OTHER,
    TURN,
    VECTOR,
    largest,
    move,
    rotation,
    step_for,
    step_of,
    to_body,
)
from unifg.factors.steps import SECOND as TWICE
from unifg.lie.so2 import wrap
from unifg.problem.table import ADDRESS, DIFFERENCED, KERNEL_WIDTH, ROWS, STORAGE
from unifg.typing import Array, IntArray


@cache
def differencing() -> int:
    """Address of :func:`difference_twice`, compiled when first asked for."""
    numbers = arrays(float64)
    return link(difference_twice, NOTHING, arrays(int64, 2), arrays(int64), *[numbers] * 9, *[arrays(float64, 2)] * 2)


@in_order
def difference_twice(
    parts: IntArray,
    term: IntArray,
    p: Array,
    table: Array,
    v: Array,
    moved: Array,
    step: Array,
    weights: Array,
    r: Array,
    gradient: Array,
    J: Array,
    R: Array,
    second: Array,
) -> None:
    """Second derivatives of one factor, direction by direction.

    A kernel's own Jacobian is differenced to one side. Where that is made of differences itself, w' r is differenced
    twice from its values alone, at two points for each pair of directions; all steps are then those of the largest
    coordinate, because that is what the residual may round.
    """
    twice = term[DIFFERENCED] != 0
    width, storage = term[KERNEL_WIDTH], term[STORAGE]
    size, h, centre = 0.0, 0.0, 0.0
    for k in range(storage):
        moved[k] = v[k]
    for k in range(width):
        step[k] = 0.0
    if twice:
        for part in range(len(parts)):
            if parts[part, 0] == VECTOR or parts[part, 0] == OTHER:
                size = largest(v, parts[part, 1], parts[part, 2], size)
        h = step_for(size, TWICE)
        centre = _weighted(term, p, table, moved, weights, r)
    else:
        _sloped(term, p, table, moved, weights, r, J, gradient)
    for first in range(len(parts)):
        kind, start, stored, dim, column, turn, own = parts[first]
        for c in range(column, column + dim):
            if twice:
                both = 0.0  # w' r ahead and behind, less twice that at the centre
                for side in range(2):
                    step[c] = h if side == 0 else -h
                    _shift(v, kind, start, stored, dim, own, step, column, c, moved)
                    change = _weighted(term, p, table, moved, weights, r) - centre
                    both += change
                    gradient[c] = (change - gradient[c] if side == 1 else change) / (1.0 if side == 0 else -2.0 * h)
                second[c, c] = both  # over h^2, when all have been found
                for other in range(first + 1):
                    its_kind, its_start, its_stored, its_dim, its_column, _, its_own = parts[other]
                    for d in range(its_column, min(its_column + its_dim, c)):
                        total = -both - second[d, d]
                        for side in range(2):
                            step[c] = step[d] = h if side == 0 else -h
                            _shift(v, kind, start, stored, dim, own, step, column, c, moved)
                            _shift(v, its_kind, its_start, its_stored, its_dim, its_own, step, its_column, d, moved)
                            total += _weighted(term, p, table, moved, weights, r) - centre
                        step[d] = 0.0
                        _shift(v, its_kind, its_start, its_stored, its_dim, its_own, step, its_column, d, moved)
                        second[c, d] = second[d, c] = total / (2.0 * h * h)
            else:
                step[c] = h = step_of(v, kind, start, stored, turn, c - column, ONE_SIDED)
                _shift(v, kind, start, stored, dim, own, step, column, c, moved)
                _sloped(term, p, table, moved, weights, r, J, second[c])
                at = start + c - column
                stepped = h if kind == TURN or kind == OTHER else (v[at] + h) - v[at]
                for d in range(width):
                    second[c, d] = (second[c, d] - gradient[d]) / stepped
            step[c] = 0.0
            for k in range(start, start + stored):
                moved[k] = v[k]
    if twice:
        for c in range(width):
            second[c, c] /= h * h
    for part in range(len(parts)):
        _, _, _, dim, column, turn, _ = parts[part]
        if turn >= 0:
            rotation(v, turn, dim, R)
            if twice:
                to_body(R, dim, second, width, column)
            _turn_rows(R, dim, second, width, column)
            if twice:
                _bend(R, dim, gradient, second, column)


@compiled
def _retract(own: int, v: Array, start: int, stored: int, step: Array, column: int, dim: int, out: Array) -> None:
    """Move a part by a retraction of its own: rare, and no code in the loops over all others."""
    call_retraction(own, vector(v, start, stored), vector(step, column, dim), vector(out, start, stored))


@inlined
def _shift(
    v: Array,
    kind: int,
    start: int,
    stored: int,
    dim: int,
    own: int,
    step: Array,
    column: int,
    which: int,
    out: Array,
) -> None:
    """Write what a changed step along one direction changes of a part."""
    if kind == VECTOR:
        place = start + which - column
        out[place] = v[place] + step[which]
    elif kind == ANGLE:
        out[start] = wrap(v[start] + step[which])
    elif kind == OTHER:
        _retract(own, v, start, stored, step, column, dim, out)
    else:
        move(v, kind, start, 3, step, column, out)


@inlined
def _weighted(term: IntArray, p: Array, table: Array, v: Array, weights: Array, r: Array) -> float:
    """Value of w' r of one factor."""
    m, nothing = term[ROWS], matrix(r, 0, 0, 0)
    call_residual(term[ADDRESS], vector(v, 0, term[STORAGE]), p, table, vector(r, 0, m), nothing)
    total = 0.0
    for a in range(m):
        total += weights[a] * r[a]
    return total


@inlined
def _sloped(term: IntArray, p: Array, table: Array, v: Array, weights: Array, r: Array, J: Array, out: Array) -> None:
    """Write J' w of one factor."""
    m, width = term[ROWS], term[KERNEL_WIDTH]
    call_residual(term[ADDRESS], vector(v, 0, term[STORAGE]), p, table, vector(r, 0, m), matrix(J, 0, m, width))
    for d in range(width):
        out[d] = 0.0
        for a in range(m):
            out[d] += weights[a] * J[a * width + d]


@compiled
def _turn_rows(R: Array, dim: int, second: Array, width: int, column: int) -> None:
    """Make the derivatives in the rows of a position those along the axes of the body: R' S, in place."""
    for d in range(width):
        x, y = second[column, d], second[column + 1, d]
        z = second[column + 2, d] if dim == 3 else 0.0
        for c in range(dim):
            second[column + c, d] = R[0, c] * x + R[1, c] * y + (R[2, c] * z if dim == 3 else 0.0)


@compiled
def _bend(R: Array, dim: int, gradient: Array, second: Array, column: int) -> None:
    """Add half of the gradient along r x t to the mixed entries of translation t and rotation r."""
    x = y = z = 0.0
    for k in range(dim):
        slope = 0.5 * gradient[column + k]
        x += R[k, 0] * slope
        y += R[k, 1] * slope
        z += R[k, 2] * slope if dim == 3 else 0.0
    if dim == 2:
        _add_pair(second, column, column + 2, y)
        _add_pair(second, column + 1, column + 2, -x)
    else:
        _add_pair(second, column + 1, column + 3, z)
        _add_pair(second, column + 2, column + 3, -y)
        _add_pair(second, column + 2, column + 4, x)
        _add_pair(second, column, column + 4, -z)
        _add_pair(second, column, column + 5, y)
        _add_pair(second, column + 1, column + 5, -x)


@compiled
def _add_pair(second: Array, row: int, column: int, value: float) -> None:
    """Add to an entry and to the one across the diagonal."""
    second[row, column] += value
    second[column, row] += value
