"""Orders in which the nodes of a graph may be eliminated, chosen to keep the factor sparse.

Source of the minimum-degree order: P. Amestoy, T. Davis, I. Duff, "An approximate minimum degree ordering
algorithm", SIAM J. Matrix Anal. Appl. 17 (1996), here with weighted nodes (a pose weighs its degrees of freedom).
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import IntArray


@compiled
def filled(size: int, value: int) -> IntArray:
    """Array of one integer; loops compile far sooner than array expressions."""
    result = np.empty(size, np.int64)
    for k in range(size):
        result[k] = value
    return result


@compiled
def block_graph(indptr: IntArray, indices: IntArray, label: IntArray, nodes: int) -> tuple[IntArray, IntArray]:
    """Graph of the nodes from the scalar pattern.

    Args:
        indptr: upper triangle by columns.
        indices: its rows.
        label: (n,) node of each scalar, non-decreasing from 0 to nodes - 1.
        nodes: number of nodes.

    Returns:
        Pointers (nodes + 1,) and neighbours of each node, both directions, without the node itself.
    """
    scalars = len(label)
    seen, pointer = filled(nodes, -1), filled(nodes + 1, 0)
    first, second = filled(0, 0), filled(0, 0)
    pairs = 0
    for sweep in range(2):
        if sweep == 1:
            first, second = np.empty(pairs, np.int64), np.empty(pairs, np.int64)
            pairs = 0
            for k in range(nodes):
                seen[k] = -1
        for column in range(scalars):
            b = label[column]
            previous = b
            for e in range(indptr[column], indptr[column + 1]):
                a = label[indices[e]]
                if a == previous:  # rows of one node follow each other
                    continue
                previous = a
                if a != b and seen[a] != b:
                    seen[a] = b
                    if sweep == 1:
                        first[pairs], second[pairs] = a, b
                        pointer[a + 1] += 1
                        pointer[b + 1] += 1
                    pairs += 1
    fill = np.empty(nodes, np.int64)
    for k in range(nodes):
        fill[k] = pointer[k]
        pointer[k + 1] += pointer[k]
    neighbours = np.empty(2 * pairs, np.int64)
    for k in range(pairs):
        a, b = first[k], second[k]
        neighbours[fill[a]] = b
        neighbours[fill[b]] = a
        fill[a] += 1
        fill[b] += 1
    return pointer, neighbours


@compiled
def minimum_degree(pointer: IntArray, neighbours: IntArray, weight: IntArray, stage: IntArray) -> IntArray:
    """Approximate minimum degree on the quotient graph.

    Eliminated nodes live on as elements, the cliques they leave behind. A pivot absorbs the elements it touches;
    nodes found indistinguishable are merged, nodes that touch nothing but the new element leave with the pivot.

    Args:
        pointer: symmetric graph without self-loops.
        neighbours: see above.
        weight: (nodes,) scalars of each node, positive.
        stage: (nodes,) non-negative; nodes of a lower stage are eliminated before those of a higher one.

    Returns:
        Nodes in the order of elimination.
    """
    nodes = len(weight)
    capacity = len(neighbours) + len(neighbours) // 2 + 2 * nodes + 16
    lists = np.empty(capacity, np.int64)
    free = len(neighbours)
    for k in range(free):
        lists[k] = neighbours[k]
    start, length = np.empty(nodes, np.int64), np.empty(nodes, np.int64)
    elements = filled(nodes, 0)  # how many entries at the front of a variable's list are elements
    size = np.empty(
        nodes, np.int64
    )  # of a variable; 0 once absorbed or eliminated, negative while in the current element
    total = 0
    for i in range(nodes):
        start[i], length[i], size[i] = pointer[i], pointer[i + 1] - pointer[i], weight[i]
        total += weight[i]
    degree, head = filled(nodes, 0), filled(total + 1, -1)
    following, previous = filled(nodes, -1), filled(nodes, -1)
    bucket, bucket_next, key = filled(nodes, -1), filled(nodes, -1), filled(nodes, 0)
    outside = filled(nodes, 1)  # of an element: tag + weight outside the current one; 0 once absorbed
    alive = filled(nodes, 1)  # its list is still needed
    absorber, marked, stamp = filled(nodes, -1), filled(nodes, 0), 0
    pivots = np.empty(nodes, np.int64)
    count, tag, lowest, remaining = 0, 1, 0, total
    now, listed = -1, 0  # stage of the nodes in the lists of degrees, and their weight
    dense = 16 + int(10.0 * np.sqrt(nodes))
    for i in range(nodes):
        if length[i] > dense:  # nearly every node touches it: last
            size[i] = 0
            alive[i] = 0
            remaining -= weight[i]
    for i in range(nodes):
        if size[i] == 0:
            continue
        for e in range(start[i], start[i] + length[i]):
            degree[i] += size[lists[e]]
    while remaining > 0:
        while listed == 0:
            now, lowest = now + 1, 0
            for i in range(nodes):
                if size[i] > 0 and stage[i] == now:
                    d = degree[i]
                    listed += size[i]
                    previous[i], following[i] = -1, head[d]
                    if head[d] >= 0:
                        previous[head[d]] = i
                    head[d] = i
        while head[lowest] < 0:
            lowest += 1
        p = head[lowest]
        head[lowest] = following[p]
        if following[p] >= 0:
            previous[following[p]] = -1
        pivots[count] = p
        count += 1
        pivot_size = size[p]
        size[p] = -pivot_size
        # Room for the new element: at most what the lists it unites hold.
        bound = length[p]
        for e in range(start[p], start[p] + elements[p]):
            bound += length[lists[e]]
        if free + (bound if bound < nodes else nodes) > capacity:
            packed = np.empty(capacity, np.int64)
            free = 0
            for i in range(nodes):
                if alive[i] == 1:
                    for k in range(length[i]):
                        packed[free + k] = lists[start[i] + k]
                    start[i] = free
                    free += length[i]
            lists = packed
        begin = free
        weight_p = 0
        for k in range(elements[p] + 1):
            if k < elements[p]:
                e = lists[start[p] + k]
                first, last = start[e], start[e] + length[e]
                alive[e] = 0
                outside[e] = 0
            else:
                first, last = start[p] + elements[p], start[p] + length[p]
            for q in range(first, last):
                i = lists[q]
                if size[i] <= 0:
                    continue
                weight_p += size[i]
                size[i] = -size[i]
                lists[free] = i
                free += 1
                if stage[i] != now:
                    continue
                if previous[i] >= 0:
                    following[previous[i]] = following[i]
                else:
                    head[degree[i]] = following[i]
                if following[i] >= 0:
                    previous[following[i]] = previous[i]
        start[p], length[p], elements[p] = begin, free - begin, 0
        tag += total + 1
        for q in range(begin, free):
            i = lists[q]
            for k in range(start[i], start[i] + elements[i]):
                e = lists[k]
                if outside[e] >= tag:
                    outside[e] += size[i]
                elif outside[e] != 0:
                    outside[e] = degree[e] + tag + size[i]
        for q in range(begin, free):
            i = lists[q]
            first = start[i]
            put, external, hashed = first, 0, 0
            for k in range(first, first + elements[i]):
                e = lists[k]
                if outside[e] > tag:
                    external += outside[e] - tag
                    lists[put] = e
                    put += 1
                    hashed += e
                elif outside[e] == tag:  # a part of the new element
                    outside[e] = 0
                    alive[e] = 0
            variables = put
            for k in range(first + elements[i], first + length[i]):
                j = lists[k]
                if size[j] > 0:
                    external += size[j]
                    lists[put] = j
                    put += 1
                    hashed += j
            if external == 0 and stage[i] == now:  # leaves together with the pivot
                absorber[i] = p
                pivot_size -= size[i]
                weight_p += size[i]
                size[i] = 0
                alive[i] = 0
                continue
            lists[put] = lists[variables]
            lists[variables] = lists[first]
            lists[first] = p
            elements[i] = variables - first + 1
            length[i] = put - first + 1
            if external < degree[i]:
                degree[i] = external
            h = hashed % nodes
            key[i] = h
            bucket_next[i] = bucket[h]
            bucket[h] = i
        outside[p] = 1
        degree[p] = weight_p
        for q in range(begin, free):
            if size[lists[q]] == 0:
                continue
            h = key[lists[q]]
            i = bucket[h]
            bucket[h] = -1
            while i >= 0 and bucket_next[i] >= 0:
                stamp += 1
                for k in range(start[i] + 1, start[i] + length[i]):
                    marked[lists[k]] = stamp
                before, j = i, bucket_next[i]
                while j >= 0:
                    same = length[i] == length[j] and elements[i] == elements[j] and stage[i] == stage[j]
                    k = start[j] + 1
                    while same and k < start[j] + length[j]:
                        same = marked[lists[k]] == stamp
                        k += 1
                    if same:  # indistinguishable: one variable from now on
                        absorber[j] = i
                        size[i] += size[j]
                        size[j] = 0
                        alive[j] = 0
                        bucket_next[before] = bucket_next[j]
                    else:
                        before = j
                    j = bucket_next[j]
                i = bucket_next[i]
        free_end = free
        free = begin
        for q in range(begin, free_end):
            i = lists[q]
            if size[i] == 0:
                continue
            size[i] = -size[i]
            d, most = degree[i] + weight_p - size[i], remaining - pivot_size - size[i]
            d = d if d < most else most
            degree[i] = d
            if stage[i] == now:
                previous[i], following[i] = -1, head[d]
                if head[d] >= 0:
                    previous[head[d]] = i
                head[d] = i
                lowest = lowest if lowest < d else d
            lists[free] = i
            free += 1
        length[p] = free - begin
        alive[p] = 1 if length[p] > 0 else 0
        remaining -= pivot_size
        listed -= pivot_size
        size[p] = 0
    # Nodes that left with a pivot follow it.
    rank, place = filled(nodes, count), filled(count + 2, 0)
    for k in range(count):
        rank[pivots[k]] = k
    for i in range(nodes):
        root = i
        while absorber[root] >= 0:
            root = absorber[root]
        rank[i] = rank[root]
        place[rank[i] + 1] += 1
    for k in range(count + 1):
        place[k + 1] += place[k]
    order = np.empty(nodes, np.int64)
    for i in range(nodes):
        order[place[rank[i]]] = i
        place[rank[i]] += 1
    return order


@compiled
def indistinguishable(indptr: IntArray, indices: IntArray) -> IntArray:
    """Label scalars so that consecutive ones with the same neighbours, themselves included, share a label.

    Neighbourhoods are compared by a 64-bit sum of mixed indices.
    """
    scalars = len(indptr) - 1
    digest = filled(scalars, 0)
    mixed = np.empty(scalars, np.int64)
    for i in range(scalars):
        z = (i + 1) * -7046029254386353131
        z = (z ^ (z >> 30)) * -4658895280553007687
        z = (z ^ (z >> 27)) * -7723592293110705685
        mixed[i] = z ^ (z >> 31)
    for column in range(scalars):
        for e in range(indptr[column], indptr[column + 1]):
            row = indices[e]
            digest[column] += mixed[row]
            if row != column:
                digest[row] += mixed[column]
    label = filled(scalars, 0)
    for i in range(1, scalars):
        label[i] = label[i - 1] + (1 if digest[i] != digest[i - 1] else 0)
    return label
