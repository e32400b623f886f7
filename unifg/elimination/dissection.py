"""Nested dissection: small sets of nodes whose removal splits the graph are eliminated last.

Source: A. George, "Nested dissection of a regular finite element mesh", SIAM J. Numer. Anal. 10 (1973). Separators come
from the levels of a breadth-first search and are then improved node by node, as in C. Ashcraft, J. Liu, "Applications
of the Dulmage-Mendelsohn decomposition and network flow to graph bisection improvement", SIAM J. Matrix Anal. Appl.
19 (1998), without the network flow.
"""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.typing import IntArray

LEAF = 120  # nodes that are not split any further
UNBALANCE = 0.2  # a part holds at least this share of the nodes it came from
HUGE = 1 << 60
SWEEPS = 12  # attempts to improve a separator


@compiled
def separators(pointer: IntArray, neighbours: IntArray, weight: IntArray) -> IntArray:
    """Stage of elimination of each node: 0 inside the smallest parts, later for separators of larger parts.

    Args:
        pointer: symmetric graph.
        neighbours: see above.
        weight: (nodes,) scalars of each node.
    """
    nodes = len(weight)
    members, depth_of, part, side = filled(nodes, 0), filled(nodes, -1), filled(nodes, 0), filled(nodes, 0)
    level, queue, sizes = filled(nodes, -1), filled(nodes, 0), filled(nodes + 1, 0)
    begins, ends, depths = filled(2 * nodes + 2, 0), filled(2 * nodes + 2, 0), filled(2 * nodes + 2, 0)
    for i in range(nodes):
        members[i] = i
    begins[0], ends[0], count, deepest, parts = 0, nodes, 1, 0, 0
    while count > 0:
        count -= 1
        begin, end, depth = begins[count], ends[count], depths[count]
        if end - begin <= LEAF:
            continue
        parts += 1
        heavy = 0
        for i in range(begin, end):
            part[members[i]] = parts
            heavy += weight[members[i]]
        # Levels from a far end.
        start, tail, far = members[begin], 0, 0
        for _ in range(4):
            for i in range(begin, end):
                level[members[i]] = -1
            queue[0], tail, i = start, 1, 0
            level[start] = 0
            while i < tail:
                node = queue[i]
                for e in range(pointer[node], pointer[node + 1]):
                    other = neighbours[e]
                    if part[other] == parts and level[other] < 0:
                        level[other] = level[node] + 1
                        queue[tail] = other
                        tail += 1
                i += 1
            far = level[queue[tail - 1]]
            start = queue[tail - 1]
        for i in range(begin, end):
            side[members[i]] = 1
        if tail == end - begin and far >= 2:
            # The lightest level with enough on either side.
            for i in range(far + 1):
                sizes[i] = 0
            for i in range(tail):
                sizes[level[queue[i]]] += weight[queue[i]]
            before, best, chosen = sizes[0], HUGE, -1
            for i in range(1, far):
                after = heavy - before - sizes[i]
                least = before if before < after else after
                if least >= UNBALANCE * heavy and sizes[i] < best:
                    best, chosen = sizes[i], i
                before += sizes[i]
            if chosen < 0:
                before, i = sizes[0], 1
                while i < far - 1 and 2 * (before + sizes[i]) < heavy:
                    before += sizes[i]
                    i += 1
                chosen = i
            for i in range(tail):
                node = queue[i]
                side[node] = 0 if level[node] < chosen else (1 if level[node] > chosen else 2)
            improve(pointer, neighbours, weight, members, begin, end, part, parts, side, heavy)
        else:  # not connected, or too dense to split
            for i in range(tail):
                side[queue[i]] = 0
            if tail == end - begin:
                continue
        # First part, second part, separator.
        fill = begin
        for s in range(3):
            if s == 1:
                begins[count], ends[count], depths[count] = begin, fill, depth + 1
                count += 1
                begin = fill
            if s == 2:
                begins[count], ends[count], depths[count] = begin, fill, depth + 1
                count += 1
                begin = fill
            for i in range(end - fill):
                if s == 0:
                    queue[i] = members[fill + i]
            if s == 0:
                size = end - fill
                place = fill
                for t in range(3):
                    for i in range(size):
                        if side[queue[i]] == t:
                            members[place] = queue[i]
                            place += 1
            while fill < end and side[members[fill]] == s:
                if s == 2:
                    depth_of[members[fill]] = depth
                fill += 1
        deepest = depth if depth > deepest else deepest
    for i in range(nodes):
        depth_of[i] = deepest - depth_of[i] + 1 if depth_of[i] >= 0 else 0
    return depth_of


@compiled
def improve(
    pointer: IntArray, neighbours: IntArray, weight: IntArray, members: IntArray, begin: int, end: int,
    part: IntArray, number: int, side: IntArray, heavy: int,
) -> None:  # fmt: skip
    """Move nodes out of a separator while that makes it lighter, or as light with better balance.

    Args:
        pointer: symmetric graph.
        neighbours: see above.
        weight: (nodes,) scalars of each node.
        members: nodes of the part, from ``begin`` to ``end``.
        begin: see above.
        end: see above.
        part: (nodes,) which part each node belongs to.
        number: of this part.
        side: (nodes,) 0 or 1, 2 in the separator; changed in place.
        heavy: weight of the part.
    """
    bulk = filled(3, 0)
    for i in range(begin, end):
        bulk[side[members[i]]] += weight[members[i]]
    for _ in range(SWEEPS):
        moved = False
        for i in range(begin, end):
            node = members[i]
            if side[node] != 2:
                continue
            pulled0, pulled1 = 0, 0  # weight that follows into the separator when the node goes to the other side
            for e in range(pointer[node], pointer[node + 1]):
                other = neighbours[e]
                if part[other] == number:
                    if side[other] == 0:
                        pulled0 += weight[other]
                    elif side[other] == 1:
                        pulled1 += weight[other]
            small = 0 if bulk[0] < bulk[1] else 1
            to = small
            gain = weight[node] - (pulled1 if to == 0 else pulled0)
            other_gain = weight[node] - (pulled0 if to == 0 else pulled1)
            if other_gain > gain and bulk[1 - small] + weight[node] <= (1.0 - UNBALANCE) * heavy:
                to, gain = 1 - small, other_gain
            if gain > 0 or (gain == 0 and to == small and bulk[small] + 2 * weight[node] <= bulk[1 - small]):
                moved = True
                side[node] = to
                bulk[2] -= weight[node]
                bulk[to] += weight[node]
                for e in range(pointer[node], pointer[node + 1]):
                    other = neighbours[e]
                    if part[other] == number and side[other] == 1 - to:
                        side[other] = 2
                        bulk[1 - to] -= weight[other]
                        bulk[2] += weight[other]
        if not moved:
            return
