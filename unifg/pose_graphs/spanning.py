"""Trees that span a graph of measurements, grown from the poses that are known.

The tree as a whole is as light as can be (R. C. Prim, Bell System Technical Journal 36, 1957), or every path from what
is known (E. W. Dijkstra, Numerische Mathematik 1, 1959). Both take the cheapest pose next to the tree, one after the
other: by the edge that leads to it, or by the whole path. SciPy has both, and loading it takes longer than a solve.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["spanning_tree"]


@compiled
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
    edges = len(first)
    start = np.zeros(count + 2, np.int64)  # of the neighbours of each node
    for e in range(edges):
        start[first[e] + 2] += 1
        start[second[e] + 2] += 1
    for node in range(count):
        start[node + 2] += start[node + 1]
    beside = np.empty(2 * edges, np.int64)
    for e in range(edges):
        beside[start[first[e] + 1]] = e
        start[first[e] + 1] += 1
        beside[start[second[e] + 1]] = e
        start[second[e] + 1] += 1
    parent, edge, forward = np.full(count + 1, -1), np.full(count, -1), np.zeros(count, np.bool_)
    parent[count] = count
    length, done = np.full(count, np.inf), np.zeros(count, np.bool_)
    keys, nodes = np.empty(2 * edges + len(roots)), np.empty(2 * edges + len(roots), np.int64)  # a heap
    size = 0
    for k in range(len(roots)):
        parent[roots[k]], length[roots[k]] = count, 0.0
        size = _push(keys, nodes, size, 0.0, roots[k])
    while size:
        node = nodes[0]
        size = _pop(keys, nodes, size)
        if done[node]:
            continue
        done[node] = True
        for k in range(start[node], start[node + 1]):
            e = beside[k]
            other = second[e] if first[e] == node else first[e]
            far = cost[e] + (length[node] if shortest else 0.0)
            if not done[other] and far < length[other]:
                length[other], parent[other], edge[other], forward[other] = far, node, e, first[e] == node
                size = _push(keys, nodes, size, far, other)
    return parent, edge, forward


@compiled
def _push(keys: Array, nodes: IntArray, size: int, key: float, node: int) -> int:
    """Add to a heap of so many; how many there are then."""
    k = size
    while k and _before(key, node, keys[(k - 1) // 2], nodes[(k - 1) // 2]):
        keys[k], nodes[k] = keys[(k - 1) // 2], nodes[(k - 1) // 2]
        k = (k - 1) // 2
    keys[k], nodes[k] = key, node
    return size + 1


@compiled
def _pop(keys: Array, nodes: IntArray, size: int) -> int:
    """Take the first from a heap of so many; how many are left."""
    size -= 1
    key, node = keys[size], nodes[size]
    k = 0
    while 2 * k + 1 < size:
        child = 2 * k + 1
        if child + 1 < size and _before(keys[child + 1], nodes[child + 1], keys[child], nodes[child]):
            child += 1
        if not _before(keys[child], nodes[child], key, node):
            break
        keys[k], nodes[k] = keys[child], nodes[child]
        k = child
    keys[k], nodes[k] = key, node
    return size


@compiled
def _before(key: float, node: int, other_key: float, other: int) -> bool:
    """Test whether one entry comes before another: of equal ones the lower number."""
    return key < other_key or (key == other_key and node < other)
