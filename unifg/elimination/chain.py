"""Chains: graphs that a narrow cut sweeps from end to end, such as horizons and smoothing windows.

However its nodes are numbered (states, then controls, then multipliers), a chain shows when nodes are eliminated one
after the other so that the frontier, the nodes touched but not yet eliminated, stays small: I. King, "An automatic
reordering scheme for simultaneous equations derived from network systems", Int. J. Numer. Methods Eng. 2 (1970).
Cutting the order into stages is then a shortest-path problem.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.typing import IntArray

FRONTIER = 24  # nodes
STAGE = 96  # scalars
HUGE = 1 << 60
# Nanoseconds of a stage, of an entry of its panel, and of a multiplication with an addition.
START, ENTRY, PRODUCT = 45.0, 0.35, 0.11


@compiled
def stages(
    pointer: IntArray, neighbours: IntArray, weight: IntArray
) -> tuple[bool, tuple[IntArray, IntArray, IntArray, IntArray], float]:
    """Cut a chain into stages, each of which touches only the next.

    Args:
        pointer: symmetric graph of the nodes.
        neighbours: see above.
        weight: (nodes,) scalars of each node.

    Returns:
        True for a chain, and then what `symbolic.postordered` returns of a tree, and the predicted nanoseconds of its
        elimination. In a stage, the nodes that the previous stage touches come first.
    """
    nodes = len(weight)
    none = filled(0, 0)
    order, entered, position = filled(nodes, 0), filled(nodes, -1), filled(nodes, -1)
    level, queue, frontier = filled(nodes, -1), filled(nodes, 0), filled(FRONTIER + 1, 0)
    cut = filled(nodes + 1, 0)  # weight of the frontier after so many nodes
    waiting, size, seed = 0, 0, 0
    for k in range(nodes):
        if waiting == 0:
            # A new component: start from a far end of it.
            while position[seed] >= 0:
                seed += 1
            start = seed
            for sweep in range(3):
                queue[0], tail = start, 1
                level[start] = sweep + 3 * k
                i = 0
                while i < tail:
                    node = queue[i]
                    for e in range(pointer[node], pointer[node + 1]):
                        if level[neighbours[e]] != sweep + 3 * k:
                            level[neighbours[e]] = sweep + 3 * k
                            queue[tail] = neighbours[e]
                            tail += 1
                    i += 1
                start = queue[tail - 1]
            frontier[0], waiting, size = start, 1, weight[start]
            entered[start] = k
        best, least = 0, HUGE
        for i in range(waiting):
            node = frontier[i]
            new = 0
            for e in range(pointer[node], pointer[node + 1]):
                if entered[neighbours[e]] < 0:
                    new += weight[neighbours[e]]
            if new < least:
                best, least = i, new
        node = frontier[best]
        waiting -= 1
        for i in range(best, waiting):
            frontier[i] = frontier[i + 1]
        order[k], position[node] = node, k
        size += least - weight[node]
        for e in range(pointer[node], pointer[node + 1]):
            other = neighbours[e]
            if entered[other] < 0:
                if waiting == FRONTIER:
                    return False, (none, none, none, none), np.inf
                entered[other] = k + 1
                frontier[waiting] = other
                waiting += 1
        cut[k + 1] = size
    # A stage that begins after k nodes must hold all the frontier there.
    last = filled(nodes + 1, 0)
    for k in range(nodes):
        for t in range(entered[order[k]], k + 1):
            last[t] = k + 1
    cost, previous = np.empty(nodes + 1), filled(nodes + 1, -1)
    cost[0] = 0.0
    for b in range(1, nodes + 1):
        cost[b] = np.inf
        width = 0
        r = float(cut[b])
        for a in range(b - 1, -1, -1):
            width += weight[order[a]]
            if width > STAGE and a < b - 1:
                break
            if last[a] > b:
                continue
            w = float(width)
            products = w * w * w / 6.0 + 0.5 * w * w * r + 0.5 * w * r * r
            total = cost[a] + START + ENTRY * w * (w + r) + PRODUCT * products
            if total < cost[b]:
                cost[b], previous[b] = total, a
    if not cost[nodes] < np.inf:
        return False, (none, none, none, none), np.inf
    count, b = 0, nodes
    while b > 0:
        count += 1
        b = previous[b]
    bounds, parent, passed = filled(count + 1, 0), filled(count, -1), filled(count, 0)
    b = nodes
    for s in range(count - 1, -1, -1):
        bounds[s + 1], passed[s] = b, cut[b]
        if cut[b] > 0:
            parent[s] = s + 1
        b = previous[b]
    # In a stage, what the previous one touches comes first.
    result = filled(nodes, 0)
    for s in range(count):
        fill = bounds[s]
        for sweep in range(2):
            for k in range(bounds[s], bounds[s + 1]):
                touched = s > 0 and entered[order[k]] <= bounds[s] and cut[bounds[s]] > 0
                if touched == (sweep == 0):
                    result[fill] = order[k]
                    fill += 1
    return True, (result, bounds, parent, passed), cost[nodes]
