"""Memory layout: panels, update matrices, row indices, and each entry of the pattern."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.elimination.plan import (
    ADJACENT,
    CHILD,
    COLUMNS,
    DIRECT,
    FIRST,
    INDEX,
    PANEL,
    PIVOTS,
    ROWS,
    SIBLING,
    STRIDE,
    UPDATE,
    UPDATE_STRIDE,
)
from unifg.elimination.subtrees import PARTS, share_out
from unifg.typing import IntArray

Narrow = NDArray[np.int32]
BEYOND = 4  # numbers between what different threads write


@compiled
def lay_out(
    indptr: IntArray, indices: IntArray, starts: IntArray, pointer: IntArray, neighbours: IntArray,
    order: IntArray, bounds: IntArray, parent: IntArray, passed: IntArray,
) -> tuple[IntArray, IntArray, Narrow, Narrow, Narrow, Narrow, IntArray, int]:  # fmt: skip
    """Lay out the fronts of a tree.

    Args:
        indptr: upper triangle of the scalar pattern by columns.
        indices: its rows.
        starts: (nodes + 1,) first scalar of each node.
        pointer: symmetric graph of the nodes.
        neighbours: see above.
        order: this and the following as `symbolic.postordered` returns them.
        bounds: see above.
        parent: see above.
        passed: see above.

    Returns:
        ``fronts``, ``order``, ``rows``, ``relative``, ``runs``, ``slots``, ``part`` of a `Plan`, and how many numbers
        its update matrices hold.
    """
    nodes, count, scalars = len(order), len(parent), len(indptr) - 1
    fronts = np.empty((count + 1, COLUMNS), np.int64)
    for s in range(count + 1):
        for k in range(COLUMNS):
            fronts[s, k] = 0
    offset, position = filled(nodes + 1, 0), filled(nodes, 0)
    member, place, owner, scalar_order = filled(nodes, 0), filled(scalars, 0), filled(scalars, 0), filled(scalars, 0)
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
    level = filled(count + 1, 0)
    for s in range(count - 1, -1, -1):
        p = parent[s]
        fronts[s, CHILD], fronts[s, SIBLING] = -1, -1
        if p >= 0:
            level[s] = 1 - level[p]
            fronts[s, SIBLING] = fronts[p, CHILD]
            fronts[p, CHILD] = s
    for s in range(count):
        fronts[s, FIRST] = offset[bounds[s]]
        w, r = offset[bounds[s + 1]] - offset[bounds[s]], passed[s]
        fronts[s, PIVOTS], fronts[s, ROWS], fronts[s, STRIDE] = w, r, (w + r + 3) // 4 * 4
        fronts[s + 1, INDEX] = fronts[s, INDEX] + r
    shared = share_out(fronts, parent)
    part = filled(count, PARTS)
    for s in range(len(shared)):
        part[s] = shared[s]
    for s in range(count):
        # Kernels write back up to three numbers beyond a row: not into what another thread works on.
        apart = BEYOND if s + 1 < count and part[s + 1] != part[s] else 0
        fronts[s + 1, PANEL] = fronts[s, PANEL] + fronts[s, PIVOTS] * fronts[s, STRIDE] + apart
    fronts[count, FIRST] = scalars
    # Rows: every node walks up from its earlier neighbours to its own front, in order, so lists come sorted.
    size = fronts[count, INDEX]
    rows, relative, runs = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    fill, mark = filled(count + 1, 0), filled(count, -1)
    for s in range(count):
        fill[s] = fronts[s, INDEX]
    for k in range(nodes):
        node = order[k]
        mark[member[k]] = k
        for e in range(pointer[node], pointer[node + 1]):
            if position[neighbours[e]] < k:
                s = member[position[neighbours[e]]]
                while mark[s] != k:
                    mark[s] = k
                    for i in range(offset[k], offset[k + 1]):
                        rows[fill[s]] = i
                        fill[s] += 1
                    s = parent[s]
    # Update matrices go straight into the parent's panel where they are its leading part; else on one of two stacks of
    # their part, of which a front uses one and its children the other. What is passed to another part stays.
    top, peak = filled(2 * PARTS + 2, 0), filled(2 * PARTS + 2, 0)
    for s in range(count):
        stack = 2 * part[s] + level[s]
        beside = 2 * part[s] + 1 - level[s]
        child = fronts[s, CHILD]
        while child >= 0:
            if fronts[child, DIRECT] == 0 and part[child] == part[s] and fronts[child, UPDATE] < top[beside]:
                top[beside] = fronts[child, UPDATE]
            child = fronts[child, SIBLING]
        p, r, begin = parent[s], passed[s], fronts[s, INDEX]
        if p >= 0:
            base, last, other = fronts[p, FIRST], fronts[p, FIRST] + fronts[p, PIVOTS], fronts[p, INDEX]
            for i in range(begin, begin + r):
                if rows[i] < last:
                    relative[i] = rows[i] - base
                else:
                    while rows[other] != rows[i]:
                        other += 1
                    relative[i] = fronts[p, PIVOTS] + other - fronts[p, INDEX]
            for i in range(begin + r - 1, begin - 1, -1):
                follows = i + 1 < begin + r and relative[i + 1] == relative[i] + 1
                runs[i] = runs[i + 1] + 1 if follows else 1
        leading = p >= 0 and r > 0 and r <= fronts[p, PIVOTS] and relative[begin + r - 1] == r - 1
        leading = leading and part[p] == part[s]
        if r > 0 and rows[begin] == fronts[s + 1, FIRST] and rows[begin + r - 1] == fronts[s + 1, FIRST] + r - 1:
            fronts[s, ADJACENT] = 1
        if leading:
            fronts[s, DIRECT] = 1
            fronts[s, UPDATE], fronts[s, UPDATE_STRIDE] = fronts[p, PANEL], fronts[p, STRIDE]
        else:
            fronts[s, UPDATE], fronts[s, UPDATE_STRIDE] = top[stack], (r + 3) // 4 * 4
            top[stack] += r * fronts[s, UPDATE_STRIDE]
            if top[stack] > peak[stack]:
                peak[stack] = top[stack]
    waiting = 0
    for stack in range(2 * PARTS + 2):
        top[stack] = waiting
        waiting += peak[stack] + (BEYOND if peak[stack] > 0 and len(shared) > 0 else 0)
    for s in range(count):
        if fronts[s, DIRECT] == 0:
            fronts[s, UPDATE] += fronts[count, PANEL] + top[2 * part[s] + level[s]]
    # Entries belong to the front that eliminates the earlier of their two scalars: one list of entries per front.
    total = indptr[scalars]
    following, row_of = np.empty(total, np.int32), np.empty(total, np.int32)
    for s in range(count):
        mark[s] = -1
    for column in range(scalars):
        b = place[column]
        for e in range(indptr[column], indptr[column + 1]):
            a = place[indices[e]]
            s = owner[a if a < b else b]
            row_of[e] = column
            following[e] = mark[s]
            mark[s] = e
    slots, local = np.empty(total, np.int32), filled(scalars, 0)
    for s in range(count):
        base, w, stride = fronts[s, FIRST], fronts[s, PIVOTS], fronts[s, STRIDE]
        for i in range(w):
            local[base + i] = i
        for i in range(fronts[s, ROWS]):
            local[rows[fronts[s, INDEX] + i]] = w + i
        e = mark[s]
        while e >= 0:
            a, b = place[indices[e]], place[row_of[e]]
            if a > b:
                a, b = b, a
            slots[e] = fronts[s, PANEL] + (a - base) * stride + local[b]
            e = int(following[e])
    return fronts, scalar_order, rows, relative, runs, slots, shared, waiting
