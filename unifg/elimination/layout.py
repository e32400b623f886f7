"""Where everything goes: panels, update matrices, row indices, and each entry of the pattern."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unifg.elimination.plan import CHILD, COLUMNS, ENTRY, FIRST, INDEX, PANEL, ROWS, SIBLING, UPDATE, WIDTH
from unifg.jit import compiled
from unifg.typing import IntArray

Narrow = NDArray[np.int32]


@compiled
def lay_out(
    indptr: IntArray,
    indices: IntArray,
    starts: IntArray,
    pointer: IntArray,
    neighbours: IntArray,
    order: IntArray,
    bounds: IntArray,
    parent: IntArray,
    passed: IntArray,
) -> tuple[IntArray, IntArray, Narrow, Narrow, Narrow, Narrow, int]:
    """Lay out the fronts of a tree.

    Args:
        indptr, indices: upper triangle of the scalar pattern by columns.
        starts: (nodes + 1,) first scalar of each node.
        pointer, neighbours: symmetric graph of the nodes.
        order, bounds, parent, passed: as `symbolic.supernodes` returns them.

    Returns:
        ``fronts``, ``order``, ``rows``, ``relative``, ``entries``, ``slots`` of a `Plan`, and the size of its ``updates``.
    """
    nodes, count, scalars = len(order), len(parent), len(indptr) - 1
    fronts = np.zeros((count + 1, COLUMNS), np.int64)
    member, offset, position = np.empty(nodes, np.int64), np.zeros(nodes + 1, np.int64), np.empty(nodes, np.int64)
    scalar_order, place, owner = (
        np.empty(scalars, np.int64), np.empty(scalars, np.int64), np.empty(scalars, np.int64),
    )  # fmt: skip
    for s in range(count):
        for k in range(bounds[s], bounds[s + 1]):
            node = order[k]
            member[k] = s
            position[node] = k
            offset[k + 1] = offset[k] + starts[node + 1] - starts[node]
            for i in range(starts[node + 1] - starts[node]):
                scalar_order[offset[k] + i] = starts[node] + i
                place[starts[node] + i] = offset[k] + i
                owner[offset[k] + i] = s
    # Offsets, children, and two stacks of update matrices: a front and its children never share one.
    fronts[:, CHILD] = -1
    fronts[:, SIBLING] = -1
    level = np.zeros(count, np.int64)
    for s in range(count - 1, -1, -1):
        p = parent[s]
        if p >= 0:
            level[s] = 1 - level[p]
            fronts[s, SIBLING] = fronts[p, CHILD]
            fronts[p, CHILD] = s
    top, peak = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for s in range(count):
        fronts[s, FIRST] = offset[bounds[s]]
        w, r = offset[bounds[s + 1]] - offset[bounds[s]], passed[s]
        fronts[s, WIDTH], fronts[s, ROWS] = w, r
        fronts[s + 1, PANEL] = fronts[s, PANEL] + w * (w + r)
        fronts[s + 1, INDEX] = fronts[s, INDEX] + r
        child = fronts[s, CHILD]
        if child >= 0:
            top[1 - level[s]] = fronts[child, UPDATE]
        fronts[s, UPDATE] = top[level[s]]
        top[level[s]] += r * r
        peak[level[s]] = max(peak[level[s]], top[level[s]])
    fronts[count, FIRST] = scalars
    for s in range(count):
        if level[s] == 1:
            fronts[s, UPDATE] += peak[0]
    # Rows: every node walks up from its earlier neighbours to its own front, in order, so lists come sorted.
    rows, relative = np.empty(fronts[count, INDEX], np.int32), np.empty(fronts[count, INDEX], np.int32)
    fill, mark = fronts[:, INDEX].copy(), np.full(count, -1, np.int64)
    for k in range(nodes):
        node, mine = order[k], member[k]
        mark[mine] = k
        for e in range(pointer[node], pointer[node + 1]):
            if position[neighbours[e]] < k:
                s = member[position[neighbours[e]]]
                while mark[s] != k:
                    mark[s] = k
                    for i in range(offset[k], offset[k + 1]):
                        rows[fill[s]] = i
                        fill[s] += 1
                    s = parent[s]
    for s in range(count):
        p = parent[s]
        if p < 0:
            continue
        base, last, other = fronts[p, FIRST], fronts[p, FIRST] + fronts[p, WIDTH], fronts[p, INDEX]
        for i in range(fronts[s, INDEX], fronts[s + 1, INDEX]):
            if rows[i] < last:
                relative[i] = rows[i] - base
            else:
                while rows[other] != rows[i]:
                    other += 1
                relative[i] = fronts[p, WIDTH] + other - fronts[p, INDEX]
    # Entries belong to the front that eliminates the earlier of their two scalars.
    total = indptr[scalars]
    for column in range(scalars):
        b = place[column]
        for e in range(indptr[column], indptr[column + 1]):
            fronts[owner[min(b, place[indices[e]])] + 1, ENTRY] += 1
    for s in range(count):
        fronts[s + 1, ENTRY] += fronts[s, ENTRY]
    fill = fronts[:, ENTRY].copy()
    entries, slots = np.empty(total, np.int32), np.empty(total, np.int32)
    pairs = np.empty((total, 2), np.int32)
    for column in range(scalars):
        b = place[column]
        for e in range(indptr[column], indptr[column + 1]):
            a = place[indices[e]]
            s = owner[min(a, b)]
            entries[fill[s]] = e
            pairs[fill[s], 0], pairs[fill[s], 1] = min(a, b), max(a, b)
            fill[s] += 1
    local = np.empty(scalars, np.int64)
    for s in range(count):
        base, w = fronts[s, FIRST], fronts[s, WIDTH]
        m = w + fronts[s, ROWS]
        for i in range(w):
            local[base + i] = i
        for i in range(fronts[s, ROWS]):
            local[rows[fronts[s, INDEX] + i]] = w + i
        for e in range(fronts[s, ENTRY], fronts[s + 1, ENTRY]):
            slots[e] = fronts[s, PANEL] + (pairs[e, 0] - base) * m + local[pairs[e, 1]]
    return fronts, scalar_order, rows, relative, entries, slots, peak[0] + peak[1]
