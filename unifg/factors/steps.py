"""Step lengths and directions of differences: one rule for all derivatives by differences.

A central difference over +-h is wrong by about h^2 of the third derivative, and by eps M / h where the function rounds
numbers of size M. Coordinates far from the origin are such numbers, so h grows with the cube root of their size; it
never falls below 2^17 spacings of x, so that x + h and x - h are numbers of their own, and it does not grow in
proportion to x, which a disc a metre away would not forgive. Steps are powers of two: x + h and x - h are then exact
but for a change of binade, and what was really stepped, (x + h) - (x - h), divides the difference.

A factor far from the origin may also round what is near it: y - (x + h f(u)) takes h f(u) to the spacing of x, and a
step of u that is right at the origin differences little but that. So where any coordinate of a factor is FAR, each
derivative is taken a second time, from four points at the step that belongs to the largest coordinate. It is believed
where it agrees with the first as nearly as such rounding lets it, and not where the function bends too much for it.

For the same reason positions move along the axes in which they are stored. A pose of SE(2) or SE(3) far from the
origin cannot be moved by a short step along its own axes without rounding. Its derivatives are taken along the
coordinates of its position, which a turn afterwards makes derivatives along the axes of the body: a translation
``x Exp(v, 0)`` moves the position by R v and nothing else. Rotations are stored in numbers of size one at any place.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np

from unifg.codegen.calls import RETRACTION, address, vector
from unifg.codegen.jit import compiled
from unifg.lie import SE2, SE3, SO2, SO3, Manifold, Rn, so3
from unifg.lie.functions import functions_of
from unifg.lie.product import leaves
from unifg.lie.so2 import wrap
from unifg.typing import Array, IntArray

ONE_SIDED, FIRST, SECOND = 2, 3, 4
"""Roots in the rules: h of first derivatives by a step to one side grows with the square root, of those by two points
with the cube root, of second ones, and first ones by four points, with the fourth root."""
SHORTEST = {ONE_SIDED: -23, FIRST: -17, SECOND: -13}  # exponents of two: near eps^(1/2), eps^(1/3) and eps^(1/4)
EPSILON = float(np.finfo(np.float64).eps)
SMALLEST_EXPONENT = -1074  # of a double, as math.frexp gives it
SPACINGS = 17  # h is at least so many powers of two above the spacing of x

FAR = 4096.0  # size of coordinates from which on two points alone are wrong by more than 1e-8
ROUNDINGS = 4.0  # of the largest coordinate in what a derivative by two points divides

VECTOR, ANGLE, TURN, OTHER = range(4)
"""Kinds of parts of a variable: numbers that are added to, an angle, a quaternion, a retraction of its own."""


class Part(NamedTuple):
    """Coordinates of a variable that move together, among variables side by side.

    Attributes:
        kind: VECTOR, ANGLE, TURN or OTHER.
        start: where it begins in storage.
        storage: numbers it is stored in.
        dim: of its tangent space.
        column: where it begins in the tangent space.
        turn: where the rotation stands that takes axes of the body to those of storage; -1: they are the same.
    """

    kind: int
    start: int
    storage: int
    dim: int
    column: int
    turn: int


def parts_of(*manifolds: Manifold) -> tuple[tuple[Part, Manifold], ...]:
    """The parts of several variables side by side, and the manifold of each; poses fall into position and rotation."""
    return _parts_of(cast(tuple[Hashable, ...], manifolds))


@lru_cache(maxsize=256)
def _parts_of(keys: tuple[Hashable, ...]) -> tuple[tuple[Part, Manifold], ...]:
    manifolds = cast(tuple[Manifold, ...], keys)
    parts: list[tuple[Part, Manifold]] = []
    start = column = 0
    for manifold in manifolds:
        for leaf, at, tangent in leaves(manifold, start, column):
            if isinstance(leaf, Rn):
                parts.append((Part(VECTOR, at, leaf.dim, leaf.dim, tangent, -1), leaf))
            elif leaf == SO2:
                parts.append((Part(ANGLE, at, 1, 1, tangent, -1), leaf))
            elif leaf == SO3:
                parts.append((Part(TURN, at, 4, 3, tangent, -1), leaf))
            elif leaf == SE2:
                parts += [
                    (Part(VECTOR, at, 2, 2, tangent, at + 2), Rn(2)),
                    (Part(ANGLE, at + 2, 1, 1, tangent + 2, -1), SO2),
                ]
            elif leaf == SE3:
                parts += [
                    (Part(VECTOR, at, 3, 3, tangent, at + 3), Rn(3)),
                    (Part(TURN, at + 3, 4, 3, tangent + 3, -1), SO3),
                ]
            else:
                parts.append((Part(OTHER, at, leaf.storage, leaf.dim, tangent, -1), leaf))
        start, column = start + manifold.storage, column + manifold.dim
    return tuple(parts)


def movable_parts(manifolds: Sequence[Manifold]) -> list[tuple[int, ...]]:
    """The parts of several variables, each with the address of its retraction, 0 for those that :func:`move` moves.

    Nothing when one of them has a retraction that is not compiled.
    """
    found = [(part, functions_of(leaf) if part.kind == OTHER else None) for part, leaf in parts_of(*manifolds)]
    if any(part.kind == OTHER and functions is None for part, functions in found):
        return []
    return [(*part, 0 if functions is None else address(functions.retract, RETRACTION)) for part, functions in found]


def _table(root: int) -> Array:
    """Steps for the exponents that doubles have, from the smallest on."""
    exponent = np.arange(SMALLEST_EXPONENT, 1025)
    grown = SHORTEST[root] + np.maximum(exponent - 1, 0) // root
    result: Array = np.ldexp(1.0, np.maximum(grown, exponent - 53 + SPACINGS))
    return result


_TABLES = {root: _table(root) for root in SHORTEST}


def steps_for(sizes: Array, root: int) -> Array:
    """Steps for coordinates of some size."""
    return _TABLES[root].take(np.frexp(sizes)[1] - SMALLEST_EXPONENT, mode="clip")


def uncertainties(size: Array, steps: Array) -> Array:
    """Error bounds of derivatives by two points where numbers of these sizes are rounded."""
    return ROUNDINGS * EPSILON * size / (2.0 * steps)


SHORTEST_OF = tuple(SHORTEST.get(root, 0) for root in range(5))


@compiled
def step_for(size: float, root: int) -> float:
    """The step for a coordinate of some size."""
    exponent = math.frexp(size)[1] if size >= 1.0 else 0
    return math.ldexp(1.0, max(SHORTEST_OF[root] + max(exponent - 1, 0) // root, exponent - 53 + SPACINGS))


@compiled
def step_of(v: Array, kind: int, start: int, stored: int, turn: int, axis: int, root: int) -> float:
    """The step along one axis of a part.

    All axes of a position that turns, or of a part with a retraction of its own, have the step of its largest number.
    """
    if kind == TURN:
        return step_for(1.0, root)
    if turn < 0 and kind != OTHER:
        return step_for(abs(v[start + axis]), root)
    return step_for(largest(v, start, stored, 0.0), root)


@compiled
def largest(v: Array, start: int, dim: int, least: float) -> float:
    """The largest of some sizes and ``least``."""
    size = least
    for k in range(start, start + dim):
        size = max(size, abs(v[k]))
    return size


@compiled
def uncertainty(size: float, step: float) -> float:
    """Error bound of a derivative by two points where numbers of this size are rounded."""
    return ROUNDINGS * EPSILON * size / (2.0 * step)


@compiled
def move(v: Array, kind: int, start: int, dim: int, step: Array, column: int, out: Array) -> None:
    """Write one part of ``v``, moved by ``step[column:column + dim]``, into its place in ``out``."""
    if kind == VECTOR:
        for k in range(dim):
            out[start + k] = v[start + k] + step[column + k]
    elif kind == ANGLE:
        out[start] = wrap(v[start] + step[column])
    else:
        so3.retract(vector(v, start, 4), vector(step, column, 3), vector(out, start, 4))


@compiled
def rotation(v: Array, turn: int, dim: int, out: Array) -> None:
    """Write the rotation of a pose whose angle or quaternion stands at ``turn``, (dim, dim)."""
    if dim == 2:
        c, s = math.cos(v[turn]), math.sin(v[turn])
        out[0, 0] = c
        out[0, 1] = -s
        out[1, 0] = s
        out[1, 1] = c
    else:
        so3.write_matrix(v[turn], v[turn + 1], v[turn + 2], v[turn + 3], out, 0)


@compiled
def to_body(R: Array, dim: int, J: Array, rows: int, column: int) -> None:
    """Make derivatives along the coordinates of a position derivatives along the axes of the body: J R, in place."""
    for a in range(rows):
        x, y = J[a, column], J[a, column + 1]
        z = J[a, column + 2] if dim == 3 else 0.0
        for d in range(dim):
            J[a, column + d] = x * R[0, d] + y * R[1, d] + (z * R[2, d] if dim == 3 else 0.0)


def as_table(parts: Sequence[tuple[int, ...]]) -> IntArray:
    """Rows of :func:`movable_parts` for compiled code."""
    return np.array(parts, dtype=np.int64).reshape(-1, len(Part._fields) + 1)
