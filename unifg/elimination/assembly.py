"""Assembling a front: update matrices of children and products of factors, four entries at a time.

Only the upper triangle of a front is used. Rows are added run by run: entries whose columns follow each other in the
front are added together, and most of them do (J. Liu, "The multifrontal method", SIAM Review 34 (1992)).
"""

from __future__ import annotations

from typing import Any

from unifg.codegen.jit import compiled, inlined
from unifg.codegen.vectors import Address, blend, get, load, plus, put, splat, store
from unifg.typing import IntArray


@inlined
def add_row(
    numbers: Address, source: int, begin: int, end: int, target: int, relative: Any, runs: Any, index: int
) -> None:
    """Add the entries begin..end of a row of an update matrix to a row of its parent's front, run by run.

    Args:
        numbers: address of the array of both.
        source: where the row would begin.
        begin: its first entry, on the diagonal.
        end: one past its last.
        target: where the row of the front would begin.
        relative: integers, column of the front for each entry, ``index`` being that of entry 0.
        runs: how many entries from each on go to columns that follow each other.
        index: see above.
    """
    zero, j = splat(0.0), begin
    while j < end:
        at, length = target + get(relative, index + j), get(runs, index + j)
        for k in range(0, length, 4):
            passed = blend(load(numbers, source + j + k), zero, length - k)
            store(numbers, at + k, plus(load(numbers, at + k), 1.0, passed))
        j += length


@compiled
def add_update(
    numbers: Address, source: int, step: int, count: int, front: int, stride: int, relative: IntArray, runs: IntArray
) -> None:
    """Add an update matrix and its right-hand side, the column after it, to a square front with one of its own.

    Args:
        numbers: address of the array of both.
        source: offset of the update matrix.
        step: length of its rows.
        count: its rows.
        front: offset of the front.
        stride: length of its rows.
        relative: (count + 1,) row of the front for each row, and the column of its right-hand side; any order.
        runs: (count + 1,) scratch.
    """
    rising = True
    for i in range(1, count):
        rising = rising and relative[i] > relative[i - 1]
    if not rising:
        for i in range(count):
            row = relative[i]
            for j in range(i, count + 1):
                column = relative[j]
                at = front + (row * stride + column if row < column else column * stride + row)
                put(numbers, at, get(numbers, at) + get(numbers, source + j))
            source += step
        return
    runs[count] = 1
    for i in range(count - 1, -1, -1):
        runs[i] = runs[i + 1] + 1 if relative[i + 1] == relative[i] + 1 else 1
    for i in range(count):
        add_row(numbers, source, i, count + 1, front + relative[i] * stride, relative, runs, 0)
        source += step


@compiled
def add_products(
    numbers: Address, source: int, width: int, slots: int, rows: IntArray, dims: IntArray,
    front: int, stride: int, size: int,
) -> None:  # fmt: skip
    """Add J'J of a factor to a square front, and -J'r to the column of its right-hand side.

    Args:
        numbers: address of the array of both.
        source: offset of the upper triangle of J'J with J'r as one more column, in rows of ``width + 1``.
        width: columns of J.
        slots: variables of the factor.
        rows: (slots,) row of the front where each begins; where two overlap their columns are
            added.
        dims: (slots,) columns of each.
        front: offset of the front.
        stride: length of its rows.
        size: column of its right-hand side.
    """
    zero, column = splat(0.0), 0
    for s in range(slots):
        row, dim = get(rows, s), get(dims, s)
        for i in range(dim):
            at = front + (row + i) * stride
            put(numbers, at + size, get(numbers, at + size) - get(numbers, source + width))
            at += row + i
            for k in range(0, dim - i, 4):
                passed = blend(load(numbers, source + column + i + k), zero, dim - i - k)
                store(numbers, at + k, plus(load(numbers, at + k), 1.0, passed))
            other = column + dim
            for t in range(s + 1, slots):
                beside, wide = get(rows, t), get(dims, t)
                if row + dim <= beside:
                    at = front + (row + i) * stride + beside
                    for k in range(0, wide, 4):
                        passed = blend(load(numbers, source + other + k), zero, wide - k)
                        store(numbers, at + k, plus(load(numbers, at + k), 1.0, passed))
                elif beside + wide <= row:
                    at = front + beside * stride + row + i
                    for k in range(wide):
                        put(numbers, at, get(numbers, at) + get(numbers, source + other + k))
                        at += stride
                else:
                    for k in range(wide):
                        a, b = row + i, beside + k
                        at = front + (a * stride + b if a < b else b * stride + a)
                        entry = get(numbers, source + other + k)
                        put(numbers, at, get(numbers, at) + (2.0 * entry if a == b else entry))
                other += wide
            source += width + 1
        column += dim
