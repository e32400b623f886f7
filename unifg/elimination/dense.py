"""Dense kernels of a front, in tiles of four rows.

A panel holds pivots as rows: row k, from the diagonal on, is row k of the upper factor. With signs S it satisfies A = P' S P.
``signed`` is the panel itself when all signs are positive, else a copy of its rows times their signs.
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.vectors import get, load, minus, put, splat, store, times
from unifg.jit import compiled
from unifg.typing import Array

VANISHED = 8.9e-16  # pivots below this part of their original diagonal are rounding errors


@compiled
def subtract_products(
    target: Array, at: int, stride: int, height: int, length: int,
    left: Array, left_at: int, right: Array, right_at: int, step: int, depth: int,
) -> None:  # fmt: skip
    """target[i, j] -= sum_k left[k, i] right[k, j] over i < height <= 4, j < length, k < depth.

    Arrays are flat; ``at`` are offsets of the first element, ``stride`` and ``step`` lengths of rows. Columns are taken
    in fours: up to three beyond ``length`` are overwritten.
    """
    j = 0
    if height == 4:
        while j + 4 < length:
            t0, t1 = at + j, at + j + stride
            t2, t3 = t1 + stride, t1 + 2 * stride
            a0, b0 = load(target, t0), load(target, t0 + 4)
            a1, b1 = load(target, t1), load(target, t1 + 4)
            a2, b2 = load(target, t2), load(target, t2 + 4)
            a3, b3 = load(target, t3), load(target, t3 + 4)
            p, q = left_at, right_at + j
            for _ in range(depth):
                v, w = load(right, q), load(right, q + 4)
                x0, x1, x2, x3 = get(left, p), get(left, p + 1), get(left, p + 2), get(left, p + 3)
                a0, b0 = minus(a0, x0, v), minus(b0, x0, w)
                a1, b1 = minus(a1, x1, v), minus(b1, x1, w)
                a2, b2 = minus(a2, x2, v), minus(b2, x2, w)
                a3, b3 = minus(a3, x3, v), minus(b3, x3, w)
                p += step
                q += step
            store(target, t0, a0)
            store(target, t0 + 4, b0)
            store(target, t1, a1)
            store(target, t1 + 4, b1)
            store(target, t2, a2)
            store(target, t2 + 4, b2)
            store(target, t3, a3)
            store(target, t3 + 4, b3)
            j += 8
        if j < length:
            t0, t1 = at + j, at + j + stride
            t2, t3 = t1 + stride, t1 + 2 * stride
            a0, a1, a2, a3 = load(target, t0), load(target, t1), load(target, t2), load(target, t3)
            p, q = left_at, right_at + j
            for _ in range(depth):
                v = load(right, q)
                a0 = minus(a0, get(left, p), v)
                a1 = minus(a1, get(left, p + 1), v)
                a2 = minus(a2, get(left, p + 2), v)
                a3 = minus(a3, get(left, p + 3), v)
                p += step
                q += step
            store(target, t0, a0)
            store(target, t1, a1)
            store(target, t2, a2)
            store(target, t3, a3)
        return
    i = 0
    if height >= 2:
        i = 2
        while j < length:
            t0, t1 = at + j, at + j + stride
            a0, a1 = load(target, t0), load(target, t1)
            p, q = left_at, right_at + j
            for _ in range(depth):
                v = load(right, q)
                a0, a1 = minus(a0, get(left, p), v), minus(a1, get(left, p + 1), v)
                p += step
                q += step
            store(target, t0, a0)
            store(target, t1, a1)
            j += 4
    if i < height:
        j = 0
        while j < length:
            t0 = at + i * stride + j
            a0 = load(target, t0)
            p, q = left_at + i, right_at + j
            for _ in range(depth):
                a0 = minus(a0, get(left, p), load(right, q))
                p += step
                q += step
            store(target, t0, a0)
            j += 4


@compiled
def eliminate(
    panel: Array, at: int, stride: int, begin: int, end: int, columns: int,
    scale: Array, pivots: Array, signs: Array, first: int, signed: Array,
) -> int:  # fmt: skip
    """Eliminate pivots begin..end of a panel within its columns begin..columns.

    Args:
        panel: flat, with the panel at offset ``at``.
        at: see above.
        stride: length of a row of the panel.
        begin: first pivot, from 0.
        end: one past the last.
        columns: one past the last column; up to three more are overwritten.
        scale: size of each pivot before elimination; this and the next two start at the pivot ``first``.
        pivots: receives 1 / diagonal.
        signs: receives the sign.
        first: see above.
        signed: room for a copy of the panel, at offset 0.

    Returns:
        -1, or the pivot that vanished; below -1 when no pivot did and some signs are negative (``signed`` is filled).
    """
    negative = False
    for top in range(begin, end, 4):
        height = min(4, end - top)
        corner = at + top * stride + top
        if top > begin:
            if negative:
                subtract_products(
                    panel, corner, stride, height, columns - top, signed, begin * stride + top,
                    panel, at + begin * stride + top, stride, top - begin,
                )  # fmt: skip
            else:
                subtract_products(
                    panel, corner, stride, height, columns - top, panel, at + begin * stride + top,
                    panel, at + begin * stride + top, stride, top - begin,
                )  # fmt: skip
        # The corner, then the rest of its rows.
        for i in range(height):
            diagonal = corner + i * stride + i
            pivot = get(panel, diagonal)
            size = abs(pivot)
            if not (size > VANISHED * get(scale, first + top + i) and size < np.inf):
                return top + i
            root = np.sqrt(size)
            inverse = 1.0 / root
            sign = 1.0 if pivot > 0.0 else -1.0
            put(pivots, first + top + i, inverse)
            put(signs, first + top + i, sign)
            put(panel, diagonal, root)
            inverse *= sign
            for j in range(1, height - i):
                put(panel, diagonal + j, get(panel, diagonal + j) * inverse)
            for k in range(1, height - i):
                factor = sign * get(panel, diagonal + k)
                for j in range(k, height - i):
                    place = diagonal + k * stride + j
                    put(panel, place, get(panel, place) - factor * get(panel, diagonal + j))
            if sign < 0.0 and not negative:
                negative = True
                for k in range(begin, top + i):
                    for j in range(stride):
                        put(signed, k * stride + j, get(signed, k * stride + j))
        if top + height < columns:
            finish(panel, corner, stride, height, columns - top, pivots, signs, first + top)
        if negative:
            pass
    return -1
