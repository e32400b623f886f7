"""Entries of the inverse on the pattern of the factor, without the rest of it.

With the panel [U W] of a front, T = U^-1 W, and Z = A^-1 known on the rows R passed to later fronts,
Z_KR = -T Z_RR and Z_KK = U^-1 S U^-T + T Z_RR T': from the root down, every front costs what its elimination did.
Sources: K. Takahashi, J. Fagan, M. Chen, "Formation of a sparse bus impedance matrix", PICA 1973; Y. Campbell,
T. Davis, "Computing the sparse inverse subset: an inverse multifrontal approach", University of Florida, 1995.
"""

from __future__ import annotations

from unifg.codegen.bisect import first_not_below
from unifg.codegen.jit import compiled
from unifg.codegen.vectors import address, get, load, minus, put, splat, store, times
from unifg.elimination.dense import subtract_products, subtract_signed
from unifg.elimination.plan import FIRST, FRONTS, INDEX, PANEL, PIVOTS, ROWS, STRIDE, Plan
from unifg.typing import Array, BoolArray, IntArray


@compiled
def invert(plan: Plan, owner: IntArray, wanted: BoolArray, panels: Array, free: int) -> None:
    """Fill in the entries of the inverse that belong to the panels of some fronts.

    Args:
        plan: with its factorisation.
        owner: (n,) front that eliminates each scalar, in the order of elimination.
        wanted: fronts to fill in; ancestors of a wanted front are wanted or were filled in before.
        panels: laid out as the panels of ``plan.numbers``, then room for six matrices of the largest front.
        free: where that room begins.
    """
    fronts, rows = plan.fronts, plan.rows
    numbers, pivots, signs, inverse = (
        address(plan.numbers), address(plan.pivots), address(plan.signs), address(panels),
    )  # fmt: skip
    zero = splat(0.0)
    for s in range(plan.shape[FRONTS] - 1, -1, -1):
        if not wanted[s]:
            continue
        first, w, r, panel, stride, index = (
            fronts[s, FIRST], fronts[s, PIVOTS], fronts[s, ROWS], fronts[s, PANEL], fronts[s, STRIDE], fronts[s, INDEX],
        )  # fmt: skip
        q = ((w if w > r else r) + 3) // 4 * 4
        known, solved, turned = free, free + r * q, free + (r + w) * q
        across, unit, result = turned + r * q, turned + 2 * r * q, turned + (2 * r + w) * q
        # Z_RR: each of its rows is found in the panel of the front that eliminates it.
        for i in range(r):
            scalar = get(rows, index + i)
            a = owner[scalar]
            base, last, other = fronts[a, FIRST], fronts[a, FIRST] + fronts[a, PIVOTS], fronts[a, INDEX]
            start = fronts[a, PANEL] + (scalar - base) * fronts[a, STRIDE]
            for j in range(i, r):
                wish = get(rows, index + j)
                if wish < last:
                    at = start + wish - base
                else:
                    while get(rows, other) != wish:
                        other += 1
                    at = start + fronts[a, PIVOTS] + other - fronts[a, INDEX]
                value = get(inverse, at)
                put(inverse, known + i * q + j, value)
                put(inverse, known + j * q + i, value)
        # T, by rows from the last, and turned.
        for k in range(w - 1, -1, -1):
            row, source = solved + k * q, panel + k * stride
            for i in range(0, r, 4):
                value = load(numbers, source + w + i)
                for j in range(k + 1, w):
                    value = minus(value, get(numbers, source + j), load(inverse, solved + j * q + i))
                store(inverse, row + i, times(get(pivots, first + k), value))
            for i in range(r):
                put(inverse, turned + i * q + k, get(inverse, row + i))
        for i in range(across, unit, 4):
            store(inverse, i, zero)
        for i in range(0, r, 4):
            subtract_products(
                inverse, across + i * q, q, 4 if r - i > 4 else r - i, w, inverse, known + i, q, turned, q, 8, r, 1.0
            )
        # U^-T, and the negative of Z_KK.
        for i in range(unit, result + w * q, 4):
            store(inverse, i, zero)
        for k in range(w):
            row = unit + k * q
            put(inverse, row + k, get(pivots, first + k))
            for i in range(k - 1, -1, -1):
                source, value = panel + i * stride, 0.0
                for j in range(i + 1, k + 1):
                    value += get(numbers, source + j) * get(inverse, row + j)
                put(inverse, row + i, -value * get(pivots, first + i))
        subtract_signed(inverse, result, q, w, unit, q, w, signs, first, 0, w)
        for i in range(0, w, 4):
            subtract_products(
                inverse, result + i * (q + 1), q, 4 if w - i > 4 else w - i, w - i, inverse, across + i, q, turned + i,
                q, 8, r, -1.0,
            )  # fmt: skip
        for i in range(w):
            row = panel + i * stride
            for j in range(i, w):
                put(inverse, row + j, -get(inverse, result + i * q + j))
            for j in range(r):
                put(inverse, row + w + j, get(inverse, across + j * q + i))


@compiled
def locate(plan: Plan, owner: IntArray, scalars: IntArray, places: IntArray) -> bool:
    """Positions of the entries of the inverse between some scalars.

    Args:
        plan: laid out.
        owner: (n,) front that eliminates each scalar, in the order of elimination.
        scalars: (k,) in the order of elimination.
        places: (k, k) receives offsets.

    Returns:
        False when one of them is in no front.
    """
    fronts, rows = plan.fronts, plan.rows
    for i in range(len(scalars)):
        for j in range(len(scalars)):
            a, b = scalars[i], scalars[j]
            if a > b:
                continue
            s = owner[a]
            if b < fronts[s, FIRST] + fronts[s, PIVOTS]:
                column = b - fronts[s, FIRST]
            else:
                end = fronts[s, INDEX] + fronts[s, ROWS]
                low = first_not_below(rows, fronts[s, INDEX], end, b)
                if low == end or rows[low] != b:
                    return False
                column = fronts[s, PIVOTS] + low - fronts[s, INDEX]
            places[i, j] = fronts[s, PANEL] + (a - fronts[s, FIRST]) * fronts[s, STRIDE] + column
            places[j, i] = places[i, j]
    return True
