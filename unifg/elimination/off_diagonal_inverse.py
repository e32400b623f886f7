"""Entries of the inverse between scalars anywhere in the tree, from the paths between them and their roots.

With A = P' S P, column a of P^-T is zero outside of the path from a to its root, and the entry (a, b) of the inverse is
the product of two such columns over what their paths share, which is their end: nothing else of the tree is looked at.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address, address, get, put
from unifg.elimination.plan import ADJACENT, FIRST, FRONTS, INDEX, PANEL, PIVOTS, ROWS, SCALARS, STRIDE, Plan
from unifg.elimination.substitution import forward
from unifg.typing import Array, IntArray


@compiled
def heights(plan: Plan, parent: IntArray) -> IntArray:
    """(S,) pivots of all fronts from each to its root, itself included."""
    count = plan.shape[FRONTS]
    result = np.empty(count, np.int64)
    for s in range(count - 1, -1, -1):
        result[s] = plan.fronts[s, PIVOTS] + (result[parent[s]] if parent[s] >= 0 else 0)
    return result


@compiled
def climb(plan: Plan, parent: IntArray, start: int, scalar: int, clean: Array, out: Array) -> None:
    """Column of S P^-T along the path from a scalar to its root.

    Args:
        plan: with its factorisation.
        parent: of each front.
        start: the front that eliminates the scalar.
        scalar: in the order of elimination.
        clean: zeros, as many as ``plan.work`` has; so they are afterwards.
        out: (height,) receives what stands on the path.
    """
    x, s, at = address(clean), start, 0
    put(x, scalar, 1.0)
    while s >= 0:
        eliminate(plan, s, x, out, at)
        at += plan.fronts[s, PIVOTS]
        s = parent[s]


@compiled
def eliminate(plan: Plan, s: int, x: Address, out: Array, at: int) -> None:
    """Forward substitution of one front: its pivots go from ``x`` to ``out``, the rest of ``x`` is updated."""
    fronts, rows, scalars = plan.fronts, plan.rows, plan.shape[SCALARS]
    first, width, below, panel, stride = (
        fronts[s, FIRST], fronts[s, PIVOTS], fronts[s, ROWS], fronts[s, PANEL], fronts[s, STRIDE],
    )  # fmt: skip
    index, local = fronts[s, INDEX], first
    if fronts[s, ADJACENT] == 0 and below > 0:
        local = scalars
        for i in range(width):
            put(x, local + i, get(x, first + i))
        for i in range(below):
            put(x, local + width + i, get(x, get(rows, index + i)))
    numbers, pivots, signs = address(plan.numbers), address(plan.pivots), address(plan.signs)
    forward(x, local, numbers, panel, stride, width, width + below, pivots, signs, first)
    for i in range(width):
        out[at + i] = get(x, local + i)
        put(x, first + i, 0.0)
    if local == scalars:
        for i in range(below):
            put(x, get(rows, index + i), get(x, local + width + i))
        for i in range(width + below):
            put(x, local + i, 0.0)


@compiled
def products(
    plan: Plan, parent: IntArray, owner: IntArray, starts: IntArray, places: IntArray, values: Array, clean: Array
) -> Array:
    """(c, d, d) products B' A^-1 B with matrices B (n, d) of few rows: only paths to the root are looked at.

    Args:
        plan: with its factorisation.
        parent: of each front.
        owner: (n,) front that eliminates each scalar.
        starts: (c + 1,) first entry of each matrix among ``places``.
        places: (k,) rows of the matrices, in the order of elimination; of a row that occurs twice, the sum counts.
        values: (k, d).
        clean: see :func:`climb`.
    """
    count, size, fronts = len(starts) - 1, values.shape[1], plan.fronts
    result, x = np.zeros((count, size, size)), address(clean)
    marked, path = np.zeros(plan.shape[FRONTS], np.bool_), np.empty(plan.shape[FRONTS], np.int64)
    for c in range(count):
        length, height = 0, 0
        for e in range(starts[c], starts[c + 1]):
            s = owner[places[e]]
            while s >= 0 and not marked[s]:
                marked[s], path[length] = True, s
                length, height, s = length + 1, height + fronts[s, PIVOTS], parent[s]
        order = np.sort(path[:length])  # parents have larger numbers
        columns, signs, at = np.empty((size, height)), np.empty(height), 0
        for s in order:
            marked[s] = False
            for i in range(fronts[s, PIVOTS]):
                signs[at] = plan.signs[fronts[s, FIRST] + i]
                at += 1
        for k in range(size):
            for e in range(starts[c], starts[c + 1]):
                put(x, places[e], get(x, places[e]) + values[e, k])
            at = 0
            for s in order:
                eliminate(plan, s, x, columns[k], at)
                at += fronts[s, PIVOTS]
            for j in range(k + 1):
                total = 0.0
                for i in range(height):
                    total += columns[k, i] * signs[i] * columns[j, i]
                result[c, k, j] = result[c, j, k] = total
    return result


@compiled
def climb_all(plan: Plan, parent: IntArray, owner: IntArray, chosen: IntArray, clean: Array, columns: Array) -> None:
    """:func:`climb` from some scalars; columns (k, longest)."""
    for i in range(len(chosen)):
        climb(plan, parent, owner[chosen[i]], chosen[i], clean, columns[i])


@compiled
def multiply(
    plan: Plan, parent: IntArray, height: IntArray, s: int, t: int, left: Array, right: Array, out: Array
) -> None:
    """Products of the columns climbed from front ``s`` with those from front ``t``: entries of the inverse.

    Args:
        plan: with its factorisation.
        parent: of each front.
        height: see :func:`heights`.
        s: see above.
        t: see above.
        left: (k, longest).
        right: (m, longest).
        out: (k, m).
    """
    fronts, signs, a, b = plan.fronts, plan.signs, s, t
    while a != b and a >= 0 and b >= 0:  # parents have larger numbers
        if a < b:
            a = parent[a]
        else:
            b = parent[b]
    for i in range(len(left)):
        for j in range(len(right)):
            out[i, j] = 0.0
    if a != b or a < 0:
        return
    p, q = height[s] - height[a], height[t] - height[a]
    while a >= 0:
        first, width = fronts[a, FIRST], fronts[a, PIVOTS]
        for i in range(len(left)):
            for j in range(len(right)):
                total = 0.0
                for k in range(width):
                    total += left[i, p + k] * signs[first + k] * right[j, q + k]
                out[i, j] += total
        p += width
        q += width
        a = parent[a]


@compiled
def block_of(plan: Plan, parent: IntArray, owner: IntArray, height: IntArray, chosen: IntArray, clean: Array) -> Array:
    """(k, k) entries of the inverse between some scalars, in the order of elimination."""
    count, longest = len(chosen), 0
    for i in range(count):
        longest = max(longest, height[owner[chosen[i]]])
    columns, result = np.empty((count, longest)), np.empty((count, count))
    climb_all(plan, parent, owner, chosen, clean, columns)
    for i in range(count):
        for j in range(i + 1):
            one = result[i : i + 1, j : j + 1]
            multiply(
                plan, parent, height, owner[chosen[i]], owner[chosen[j]], columns[i : i + 1], columns[j : j + 1], one
            )
            result[j, i] = one[0, 0]
    return result


@compiled
def blocks_of_pairs(
    plan: Plan, parent: IntArray, owner: IntArray, height: IntArray, first: IntArray, second: IntArray, clean: Array
) -> Array:
    """(n, k + m, k + m) entries of the inverse between pairs of nodes.

    Args:
        plan: with its factorisation.
        parent: of each front.
        owner: (n,) front that eliminates each scalar.
        height: see :func:`heights`.
        first: (n, k) scalars of one node, in the order of elimination; climbed from once where it stays the same.
        second: (n, m) of the other.
        clean: see :func:`climb`.
    """
    count, k, m, longest = len(first), first.shape[1], second.shape[1], 0
    for n in range(count):
        longest = max(longest, height[owner[first[n, 0]]], height[owner[second[n, 0]]])
    left, right, result = np.empty((k, longest)), np.empty((m, longest)), np.empty((count, k + m, k + m))
    for n in range(count):
        s, t = owner[first[n, 0]], owner[second[n, 0]]
        if n == 0 or first[n, 0] != first[n - 1, 0]:
            climb_all(plan, parent, owner, first[n], clean, left)
        if n == 0 or second[n, 0] != second[n - 1, 0]:
            climb_all(plan, parent, owner, second[n], clean, right)
        multiply(plan, parent, height, s, s, left, left, result[n, :k, :k])
        multiply(plan, parent, height, s, t, left, right, result[n, :k, k:])
        multiply(plan, parent, height, t, t, right, right, result[n, k:, k:])
        for i in range(k):
            for j in range(m):
                result[n, k + j, i] = result[n, i, k + j]
    return result
