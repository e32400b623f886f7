"""Dense kernels of a front, in tiles of four rows and eight columns.

A panel holds pivots as rows: row k, from the diagonal on, is row k of P in A = P' S P, S = diag(+-1). Arrays are
flat; a matrix in one is an offset and the length of its rows.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled, inlined
from unifg.codegen.vectors import (
    Address,
    address,
    blend,
    get,
    inverse_root,
    lane,
    load,
    minus,
    pack,
    plus,
    put,
    splat,
    store,
    times,
)

VANISHED = 8.9e-16  # pivots below this part of their original diagonal are rounding errors
STRIP, DEPTH = 64, 192  # columns and products handled together: what stays in the second-level cache
MANY, DEEP = 64, 32  # rows and products from which on putting factors side by side pays


@compiled
def subtract_products(
    numbers: Address, target: int, stride: int, height: int, length: int,
    factors: Address, left: int, skip: int, right: int, step: int, hop: int, depth: int, sign: float,
) -> None:  # fmt: skip
    """target[i, j] -= sign * sum_k left[k, i] right[k, j] over i < height <= 4, j < length, k < depth.

    Up to three numbers beyond the last column are written as they were.

    Args:
        numbers: address of the array of the target.
        target: its offset.
        stride: length of its rows.
        height: its rows.
        length: its columns.
        factors: address of the array of both factors.
        left: offset of the left factor.
        skip: from one of its rows to the next.
        right: offset of the right factor.
        step: from one of its rows to the next.
        hop: from eight of its columns to the next eight.
        depth: rows of both.
        sign: see above.
    """
    zero, columns = splat(0.0), right
    for j in range(0, length, 8):
        a0, a1, a2, a3, b0, b1, b2, b3 = zero, zero, zero, zero, zero, zero, zero, zero
        p, q = left, columns
        columns += hop
        for _ in range(depth):
            v, w = load(factors, q), load(factors, q + 4)
            x0, x1, x2, x3 = get(factors, p), get(factors, p + 1), get(factors, p + 2), get(factors, p + 3)
            a0, b0 = plus(a0, x0, v), plus(b0, x0, w)
            a1, b1 = plus(a1, x1, v), plus(b1, x1, w)
            a2, b2 = plus(a2, x2, v), plus(b2, x2, w)
            a3, b3 = plus(a3, x3, v), plus(b3, x3, w)
            p += skip
            q += step
        rest, t = length - j, target + j
        if rest < 8:
            a0, a1, a2, a3 = blend(a0, zero, rest), blend(a1, zero, rest), blend(a2, zero, rest), blend(a3, zero, rest)
            rest -= 4
            b0, b1, b2, b3 = blend(b0, zero, rest), blend(b1, zero, rest), blend(b2, zero, rest), blend(b3, zero, rest)
            rest += 4
        store(numbers, t, minus(load(numbers, t), sign, a0))
        if rest > 4:
            store(numbers, t + 4, minus(load(numbers, t + 4), sign, b0))
        if height > 1:
            t += stride
            store(numbers, t, minus(load(numbers, t), sign, a1))
            if rest > 4:
                store(numbers, t + 4, minus(load(numbers, t + 4), sign, b1))
        if height > 2:
            t += stride
            store(numbers, t, minus(load(numbers, t), sign, a2))
            if rest > 4:
                store(numbers, t + 4, minus(load(numbers, t + 4), sign, b2))
        if height > 3:
            t += stride
            store(numbers, t, minus(load(numbers, t), sign, a3))
            if rest > 4:
                store(numbers, t + 4, minus(load(numbers, t + 4), sign, b3))


@compiled
def subtract_signed(
    numbers: Address, target: int, stride: int, size: int, left: int, step: int, depth: int,
    signs: Address, first: int, start: int, rows: int,
) -> None:  # fmt: skip
    """Upper triangle of target -= left' S left, in blocks of four rows.

    Args:
        numbers: address of the array both matrices live in.
        target: offset of the target.
        stride: length of its rows.
        size: its columns.
        left: offset of the factor, a (depth, size) matrix.
        step: length of its rows.
        depth: its rows.
        signs: diagonal of S, from ``first`` on.
        first: see above.
        start: first row of the target to subtract from, a multiple of four.
        rows: one past the last.
    """
    begin = 0
    while begin < depth:
        sign, end = get(signs, first + begin), begin + 1
        while end < depth and end < begin + DEPTH and get(signs, first + end) == sign:
            end += 1
        base = left + begin * step
        if rows - start >= MANY and end - begin >= DEEP:
            _subtract_side_by_side(numbers, target, stride, size, base, step, end - begin, sign, start, rows)
        else:
            for strip in range(0, size, STRIP):
                last = strip + STRIP if strip + STRIP < size else size
                for i in range(start, rows if rows < last else last, 4):
                    j = i if i > strip else strip
                    subtract_products(
                        numbers, target + i * stride + j, stride, 4 if rows - i > 4 else rows - i, last - j,
                        numbers, base + i, step, base + j, step, 8, end - begin, sign,
                    )  # fmt: skip
        begin = end


@compiled
def _subtract_side_by_side(
    numbers: Address, target: int, stride: int, size: int, left: int, step: int, depth: int, sign: float,
    start: int, rows: int,
) -> None:  # fmt: skip
    """The same for one sign; a strip of the factor is copied before it is used for all rows, and columns for each.

    Rows of a large front are so far apart that every eight numbers of the factor come from another page.
    """
    room = np.empty(depth * (STRIP + 4))
    copy, columns = address(room), depth * STRIP
    for strip in range(start // STRIP * STRIP, size, STRIP):
        last, at = strip + STRIP if strip + STRIP < size else size, 0
        for j in range(strip, last, 8):
            source = left + j
            for _ in range(depth):
                store(copy, at, load(numbers, source))
                store(copy, at + 4, load(numbers, source + 4))
                at, source = at + 8, source + step
        for i in range(start, rows if rows < last else last, 4):
            at, source = columns, left + i
            for _ in range(depth):
                store(copy, at, load(numbers, source))
                at, source = at + 4, source + step
            j, height = i if i > strip else strip, 4 if rows - i > 4 else rows - i
            if j % 8 != 0:  # the diagonal begins in the midst of eight columns
                subtract_products(
                    numbers, target + i * stride + j, stride, height, 4 if last - j > 4 else last - j,
                    copy, columns, 4, (j - 4 - strip) * depth + 4, 8, 8 * depth, depth, sign,
                )  # fmt: skip
                j += 4
            if j < last:
                subtract_products(
                    numbers, target + i * stride + j, stride, height, last - j,
                    copy, columns, 4, (j - strip) * depth, 8, 8 * depth, depth, sign,
                )  # fmt: skip


@inlined
def finish_rows(
    numbers: Address, row: int, stride: int, start: int, stop: int, height: int,
    g0: float, g1: float, g2: float, g3: float,
    f01: float, f02: float, f12: float, f03: float, f13: float, f23: float,
) -> None:  # fmt: skip
    """Solve with a corner of up to four pivots, L D L' of it known, for columns start..stop of its rows.

    Args:
        numbers: address of the array of the panel.
        row: offset of the corner's first row.
        stride: length of its rows.
        start: first column, from that offset on.
        stop: one past the last.
        height: rows of the corner.
        g0: sign over root of the first pivot, and so on.
        g1: see above.
        g2: see above.
        g3: see above.
        f01: L', first row, second column, and so on.
        f02: see above.
        f12: see above.
        f03: see above.
        f13: see above.
        f23: see above.
    """
    for j in range(start, stop, 4):
        rest, t0 = stop - j, row + j
        t1, t2, t3 = t0 + stride, t0 + 2 * stride, t0 + 3 * stride
        y0 = load(numbers, t0)
        store(numbers, t0, blend(times(g0, y0), y0, rest))
        if height > 1:
            y1 = load(numbers, t1)
            e1 = minus(y1, f01, y0)
            store(numbers, t1, blend(times(g1, e1), y1, rest))
            if height > 2:
                y2 = load(numbers, t2)
                e2 = minus(minus(y2, f02, y0), f12, e1)
                store(numbers, t2, blend(times(g2, e2), y2, rest))
                if height > 3:
                    y3 = load(numbers, t3)
                    e3 = minus(minus(minus(y3, f03, y0), f13, e1), f23, e2)
                    store(numbers, t3, blend(times(g3, e3), y3, rest))


@compiled
def eliminate(
    numbers: Address, panel: int, stride: int, begin: int, end: int, columns: int,
    scale: Address, pivots: Address, signs: Address, first: int,
) -> int:  # fmt: skip
    """Eliminate pivots begin..end of a panel within its columns begin..columns; others are left to :func:`complete`.

    Args:
        numbers: address of the array of the panel.
        panel: its offset.
        stride: length of its rows.
        begin: first pivot, from 0.
        end: one past the last.
        columns: one past the last column.
        scale: size of each pivot before elimination; the panel's first pivot is at ``first`` here and in the next two.
        pivots: receives 1 / diagonal.
        signs: receives the sign.
        first: see above.

    Returns:
        -1, or the pivot that vanished.
    """
    for top in range(begin, end, 4):
        height = 4 if end - top > 4 else end - top
        corner = panel + top * (stride + 1)
        subtract_signed(
            numbers, corner, stride, columns - top, panel + begin * stride + top, stride, top - begin,
            signs, first + begin, 0, height,
        )  # fmt: skip
        # The corner, in registers: L D L' first, roots afterwards, so that pivots wait for one division each.
        c1, c2, c3 = corner + stride, corner + 2 * stride, corner + 3 * stride
        x00, x01, x02, x03 = get(numbers, corner), 0.0, 0.0, 0.0
        x11, x12, x13, x22, x23, x33 = 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
        if height > 1:
            x01, x11 = get(numbers, corner + 1), get(numbers, c1 + 1)
        if height > 2:
            x02, x12, x22 = get(numbers, corner + 2), get(numbers, c1 + 2), get(numbers, c2 + 2)
        if height > 3:
            x03, x13, x23, x33 = (
                get(numbers, corner + 3),
                get(numbers, c1 + 3),
                get(numbers, c2 + 3),
                get(numbers, c3 + 3),
            )
        at = first + top
        inverse = 1.0 / x00
        f01, f02, f03 = x01 * inverse, x02 * inverse, x03 * inverse
        x11, x12, x13 = x11 - f01 * x01, x12 - f01 * x02, x13 - f01 * x03
        x22, x23, x33 = x22 - f02 * x02, x23 - f02 * x03, x33 - f03 * x03
        inverse = 1.0 / x11
        f12, f13 = x12 * inverse, x13 * inverse
        x22, x23, x33 = x22 - f12 * x12, x23 - f12 * x13, x33 - f13 * x13
        f23 = x23 / x22
        x33 -= f23 * x23
        if not (abs(x00) > VANISHED * get(scale, at) and abs(x00) < np.inf):
            return top
        if height > 1 and not (abs(x11) > VANISHED * get(scale, at + 1) and abs(x11) < np.inf):
            return top + 1
        if height > 2 and not (abs(x22) > VANISHED * get(scale, at + 2) and abs(x22) < np.inf):
            return top + 2
        if height > 3 and not (abs(x33) > VANISHED * get(scale, at + 3) and abs(x33) < np.inf):
            return top + 3
        roots = inverse_root(pack(x00, x11, x22, x33))
        s0, s1 = 1.0 if x00 > 0.0 else -1.0, 1.0 if x11 > 0.0 else -1.0
        s2, s3 = 1.0 if x22 > 0.0 else -1.0, 1.0 if x33 > 0.0 else -1.0
        if height > 3:
            store(pivots, at, roots)
            store(signs, at, pack(s0, s1, s2, s3))
        else:  # what follows belongs to another front, perhaps to another thread
            put(pivots, at, lane(roots, 0))
            put(signs, at, s0)
            if height > 1:
                put(pivots, at + 1, lane(roots, 1))
                put(signs, at + 1, s1)
            if height > 2:
                put(pivots, at + 2, lane(roots, 2))
                put(signs, at + 2, s2)
        g0, g1, g2, g3 = s0 * lane(roots, 0), s1 * lane(roots, 1), s2 * lane(roots, 2), s3 * lane(roots, 3)
        # All columns, the corner's included: below the diagonal of the corner no one looks.
        finish_rows(
            numbers, corner, stride, 0, columns - top, height, g0, g1, g2, g3, f01, f02, f12, f03, f13, f23
        )  # fmt: skip
        if columns == end:  # below the diagonal no one looks but `complete`
            if height > 1:
                put(numbers, c1, f01)
            if height > 2:
                put(numbers, c2, f02)
                put(numbers, c2 + 1, f12)
            if height > 3:
                put(numbers, c3, f03)
                put(numbers, c3 + 1, f13)
                put(numbers, c3 + 2, f23)
    return -1


@compiled
def complete(
    numbers: Address, panel: int, stride: int, begin: int, end: int, start: int, stop: int,
    pivots: Address, signs: Address, first: int,
) -> None:  # fmt: skip
    """Bring columns start..stop up to date with pivots begin..end, eliminated by :func:`eliminate` up to ``end``.

    Columns are independent of each other: apart by a multiple of eight, they may be completed at once.

    Args:
        numbers: address of the array of the panel.
        panel: its offset.
        stride: length of its rows.
        begin: first pivot, from 0.
        end: one past the last.
        start: first column, beyond the pivots.
        stop: one past the last.
        pivots: 1 / diagonal; the panel's first pivot is at ``first`` here and in the next one.
        signs: its signs.
        first: see above.
    """
    for strip in range(start, stop, STRIP):
        last = strip + STRIP if strip + STRIP < stop else stop
        for top in range(begin, end, 4):
            height = 4 if end - top > 4 else end - top
            corner = panel + top * (stride + 1)
            r0 = panel + top * stride
            done = begin
            while done < top:
                sign, same = get(signs, first + done), done + 1
                while same < top and get(signs, first + same) == sign:
                    same += 1
                subtract_products(
                    numbers, r0 + strip, stride, height, last - strip, numbers, panel + done * stride + top, stride,
                    panel + done * stride + strip, stride, 8, same - done, sign,
                )  # fmt: skip
                done = same
            at, c1, c2, c3 = first + top, corner + stride, corner + 2 * stride, corner + 3 * stride
            g0, g1, g2, g3 = get(signs, at) * get(pivots, at), 0.0, 0.0, 0.0
            f01, f02, f12, f03, f13, f23 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            if height > 1:
                g1, f01 = get(signs, at + 1) * get(pivots, at + 1), get(numbers, c1)
            if height > 2:
                g2 = get(signs, at + 2) * get(pivots, at + 2)
                f02, f12 = get(numbers, c2), get(numbers, c2 + 1)
            if height > 3:
                g3 = get(signs, at + 3) * get(pivots, at + 3)
                f03, f13, f23 = get(numbers, c3), get(numbers, c3 + 1), get(numbers, c3 + 2)
            finish_rows(
                numbers, r0, stride, strip, last, height, g0, g1, g2, g3, f01, f02, f12, f03, f13, f23
            )  # fmt: skip
