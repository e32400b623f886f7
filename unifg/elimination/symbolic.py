"""From an order of elimination to a tree of dense fronts.

Columns with one structure form a supernode; small supernodes are merged with their parents where the arithmetic on
explicit zeros costs less than another front would. Sources: J. Liu, "The role of elimination trees in sparse
factorization", SIAM J. Matrix Anal. Appl. 11 (1990); C. Ashcraft, R. Grimes, "The influence of relaxed supernode
partitions on the multifrontal method", ACM TOMS 15 (1989).
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.typing import Array, IntArray

# Nanoseconds of a front, of an entry added into the parent, and of a multiplication with an addition.
FRONT, ENTRY, PRODUCT = 180.0, 0.7, 0.12


@compiled
def front_cost(width: int, rows: int) -> float:
    """Predicted nanoseconds to eliminate ``width`` scalars of a front that passes on ``rows``."""
    w, r = float(width), float(rows)
    products = w * w * w / 6.0 + 0.5 * w * w * r + 0.5 * w * r * r
    return FRONT + ENTRY * (0.5 * r * r + w * (r + 0.5 * w)) + PRODUCT * products


@compiled
def supernodes(
    pointer: IntArray, neighbours: IntArray, weight: IntArray, order: IntArray
) -> tuple[IntArray, IntArray, IntArray, IntArray, Array]:
    """Elimination tree, supernodes and their merging.

    Args:
        pointer: symmetric graph of the nodes.
        neighbours: see above.
        weight: (nodes,) scalars of each node.
        order: (nodes,) order of elimination.

    Returns:
        The final order (a postorder, equivalent to the one given), pointers of the S supernodes into it, the parent of
        each supernode or -1, the scalars it passes on to the parent, and (flops, predicted nanoseconds).
    """
    nodes = len(weight)
    position = np.empty(nodes, np.int64)
    for k in range(nodes):
        position[order[k]] = k
    parent, ancestor = filled(nodes, -1), filled(nodes, -1)
    for i in range(nodes):
        node = order[i]
        for e in range(pointer[node], pointer[node + 1]):
            k = position[neighbours[e]]
            while 0 <= k < i:
                above = ancestor[k]
                ancestor[k] = i
                if above < 0:
                    parent[k] = i
                k = above
    # Postorder.
    first, following = filled(nodes + 1, -1), filled(nodes, -1)
    for k in range(nodes - 1, -1, -1):
        p = parent[k] if parent[k] >= 0 else nodes
        following[k] = first[p]
        first[p] = k
    post, stack = np.empty(nodes, np.int64), np.empty(nodes + 1, np.int64)
    count, depth = 0, 0
    stack[0] = nodes
    while depth >= 0:
        k = stack[depth]
        child = first[k]
        if child >= 0:
            first[k] = following[child]
            depth += 1
            stack[depth] = child
        else:
            depth -= 1
            if k < nodes:
                post[count] = k
                count += 1
    ordered, size, up, renamed = filled(nodes, 0), filled(nodes, 0), filled(nodes, -1), filled(nodes, 0)
    for k in range(nodes):
        ordered[k] = order[post[k]]
        size[k] = weight[ordered[k]]
        renamed[post[k]] = k
        position[ordered[k]] = k
    for k in range(nodes):
        if parent[post[k]] >= 0:
            up[k] = renamed[parent[post[k]]]
    # Scalars below the diagonal of each column: every row walks its subtree once.
    below, mark = filled(nodes, 0), filled(nodes, -1)
    for i in range(nodes):
        mark[i] = i
        for e in range(pointer[ordered[i]], pointer[ordered[i] + 1]):
            k = position[neighbours[e]]
            if k < i:
                while mark[k] != i:
                    mark[k] = i
                    below[k] += size[i]
                    k = up[k]
    # Fundamental supernodes: runs of columns with one structure.
    member = np.empty(nodes, np.int64)
    fronts = 0
    for k in range(nodes):
        if k == 0 or up[k - 1] != k or below[k - 1] != below[k] + size[k]:
            fronts += 1
        member[k] = fronts - 1
    width, rows, above_s, into = filled(fronts, 0), filled(fronts, 0), filled(fronts, -1), filled(fronts, 0)
    for k in range(nodes):
        s = member[k]
        width[s] += size[k]
        rows[s] = below[k]
        if up[k] >= 0 and member[up[k]] != s:
            above_s[s] = member[up[k]]
    # Merge children into parents where it pays, from the leaves up.
    head, sibling = filled(fronts + 1, -1), filled(fronts, -1)
    for s in range(fronts - 1, -1, -1):
        p = above_s[s] if above_s[s] >= 0 else fronts
        sibling[s] = head[p]
        head[p] = s
        into[s] = s
    for p in range(fronts):
        kept, child = -1, head[p]
        while child >= 0:
            after = sibling[child]
            wide = width[p] + width[child]
            apart = front_cost(width[p], rows[p]) + front_cost(width[child], rows[child])
            if front_cost(wide, rows[p]) <= apart:
                into[child] = p
                width[p] = wide
                grandchild = head[child]
                while grandchild >= 0:
                    later = sibling[grandchild]
                    sibling[grandchild] = kept
                    kept = grandchild
                    grandchild = later
            else:
                sibling[child] = kept
                kept = child
            child = after
        head[p] = kept
    # Postorder of what is left.
    number, named, stack_s = filled(fronts, -1), filled(fronts, 0), filled(fronts + 1, 0)
    stack_s[0] = fronts
    depth, count = 0, 0
    while depth >= 0:
        s = stack_s[depth]
        child = head[s]
        if child >= 0:
            head[s] = sibling[child]
            depth += 1
            stack_s[depth] = child
        else:
            depth -= 1
            if s < fronts:
                number[s] = count
                named[count] = s
                count += 1
    final_parent, final_rows, forecast = filled(count, -1), filled(count, 0), np.empty(2)
    forecast[0], forecast[1] = 0.0, 0.0
    for k in range(count):
        s = named[k]
        final_rows[k] = rows[s]
        p = above_s[s]
        while p >= 0 and into[p] != p:
            p = into[p]
        if p >= 0:
            final_parent[k] = number[p]
        w, r = float(width[s]), float(rows[s])
        forecast[0] += w * w * w / 3.0 + w * w * r + w * r * r
        forecast[1] += front_cost(width[s], rows[s])
    bounds, fill, result = filled(count + 1, 0), filled(count, 0), filled(nodes, 0)
    for k in range(nodes):
        s = member[k]
        while into[s] != s:
            s = into[s]
        member[k] = number[s]
        bounds[member[k] + 1] += 1
    for k in range(count):
        bounds[k + 1] += bounds[k]
        fill[k] = bounds[k]
    for k in range(nodes):
        result[fill[member[k]]] = ordered[k]
        fill[member[k]] += 1
    return result, bounds, final_parent, final_rows, forecast
