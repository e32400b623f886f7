"""Trees that span a graph of measurements, grown from the poses that are known.

The tree as a whole is as light as can be (R. C. Prim, Bell System Technical Journal 36, 1957), or every path from what
is known (E. W. Dijkstra, Numerische Mathematik 1, 1959). Both take the cheapest pose next to the tree, one after the
other: by the edge that leads to it, or by the whole path. SciPy has both, and loading it takes longer than a solve.
"""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["spanning_tree"]


def spanning_tree(
    first: IntArray, second: IntArray, cost: Array, roots: IntArray, count: int, shortest: bool
) -> tuple[IntArray, IntArray, BoolArray]:
    """Grow a tree from roots; what cannot be reached is left out.

    Args:
        first: (m,) one end of every edge.
        second: (m,) the other.
        cost: (m,) positive.
        roots: nodes known.
        count: of nodes, n.
        shortest: whether paths are to be short, or the tree light.

    Returns:
        (n + 1,) parents; n, its own parent, is that of every root, and -1 that of nodes that are not reached. (n,) the
        edge to the parent, or -1; (n,) whether it begins at the parent.
    """
    ends = np.stack([first, second], axis=1).ravel()
    beside = np.argsort(ends, kind="stable") // 2  # edges of node after node
    start = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=count))])
    return _grown(first, second, cost, roots, start, beside, shortest)


@compiled
def _grown(
    first: IntArray, second: IntArray, cost: Array, roots: IntArray, start: IntArray, beside: IntArray, shortest: bool
) -> tuple[IntArray, IntArray, BoolArray]:
    """Grow the tree; the edges of node k are ``beside[start[k] : start[k + 1]]``."""
    count = len(start) - 1
    parent, edge, forward = np.full(count + 1, -1), np.full(count, -1), np.zeros(count, np.bool_)
    parent[count] = count
    length, done = np.full(count, np.inf), np.zeros(count, np.bool_)
    heap = [(0.0, root) for root in roots]  # of equal keys the lower number comes first
    heap.sort()
    for root in roots:
        parent[root], length[root] = count, 0.0
    while heap:
        _, node = heappop(heap)
        if done[node]:
            continue
        done[node] = True
        for k in range(start[node], start[node + 1]):
            e = beside[k]
            other = second[e] if first[e] == node else first[e]
            far = cost[e] + (length[node] if shortest else 0.0)
            if not done[other] and far < length[other]:
                length[other], parent[other], edge[other], forward[other] = far, node, e, first[e] == node
                heappush(heap, (far, other))
    return parent, edge, forward
