"""Symbolic elimination: an order of the nodes, and the tree of cliques or dense fronts that it leaves behind.

The graph is given by its cliques alone: every pair of neighbours, every factor, and every eliminated subtree, is an
*element*, a list of nodes that all touch each other. Eliminating a node unites its elements into a new one, whose list
is the separator of the new clique: ordering and symbolic factorisation are one pass. Degrees are bounded as in
P. Amestoy, T. Davis, I. Duff, "An approximate minimum degree ordering algorithm", SIAM J. Matrix Anal. Appl. 17 (1996),
with weighted nodes (a pose weighs its degrees of freedom). Small cliques are merged with their parents where the
arithmetic on explicit zeros costs less than another front would: C. Ashcraft, R. Grimes, "The influence of relaxed
supernode partitions on the multifrontal method", ACM TOMS 15 (1989).
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.typing import BoolArray, IntArray

# Nanoseconds of a front, of an entry added into the parent, and of a multiplication with an addition.
FRONT, ENTRY, PRODUCT = 180.0, 0.7, 0.12


@compiled
def front_cost(width: int, rows: int) -> float:
    """Predicted nanoseconds to eliminate ``width`` scalars of a front that passes on ``rows``."""
    w, r = float(width), float(rows)
    products = w * w * w / 6.0 + 0.5 * w * w * r + 0.5 * w * r * r
    return FRONT + ENTRY * (0.5 * r * r + w * (r + 0.5 * w)) + PRODUCT * products


@compiled
def cliques(
    weight: IntArray, stage: IntArray, alone: BoolArray, given: IntArray, twins: bool, pool: IntArray,
    pointer: IntArray,
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray]:  # fmt: skip
    """Order nodes, and find the cliques.

    Args:
        weight: (n,) scalars of each node.
        stage: (n,) non-negative; nodes of a lower stage are eliminated before those of a higher one.
        alone: (n,) nodes whose cliques no other one joins.
        given: the order, (n,), instead of minimum degree, for one stage; empty: none.
        twins: merge nodes found to touch the same elements; separators then lack some of their nodes.
        pool: nodes of the elements, one list after the other.
        pointer: (E + 1,) begin of each.

    Returns:
        Nodes clique after clique and (K + 1,) pointers to it; parent of each clique or -1, which comes later; scalars
        of each separator; its nodes in no order, as begin and length in a pool of lists.
    """
    elements = len(pointer) - 1
    pivots, first, absorber, start, length, heavy, lists = _eliminate(weight, stage, given, twins, pool, pointer)
    count, n = len(first) - 1, len(weight)
    rows, into = filled(count, 0), filled(count, 0)
    for k in range(count):
        into[k] = k
        for q in range(first[k], first[k + 1]):
            rows[k] += weight[pivots[q]]
    for k in range(count):
        p, below = absorber[elements + k], heavy[elements + k]
        if p < 0 or alone[pivots[first[p]]]:
            continue
        above = heavy[elements + p]
        if front_cost(rows[p] + rows[k], above) <= front_cost(rows[p], above) + front_cost(rows[k], below):
            into[k] = p
            rows[p] += rows[k]
    number, kept = filled(count, -1), 0
    for k in range(count):
        if into[k] == k:
            number[k] = kept
            kept += 1
    for k in range(count - 1, -1, -1):
        number[k] = number[into[k]]
    bounds, fill, place, clique = filled(kept + 1, 0), filled(kept, 0), filled(n, 0), filled(n, 0)
    for k in range(count):
        bounds[number[k] + 1] += first[k + 1] - first[k]
    for k in range(kept):
        bounds[k + 1] += bounds[k]
        fill[k] = bounds[k]
    order, passed, parent = filled(n, 0), filled(kept, 0), filled(kept, -1)
    begin, size = filled(kept, 0), filled(kept, 0)
    for k in range(count):
        c = number[k]
        for q in range(first[k], first[k + 1]):
            order[fill[c]], place[pivots[q]], clique[pivots[q]] = pivots[q], fill[c], c
            fill[c] += 1
    # The parent has the first of the separator: a clique that united it with others may have none of its nodes.
    for k in range(count):
        if into[k] == k:
            c, earliest = number[k], n
            begin[c], size[c], passed[c] = start[elements + k], length[elements + k], heavy[elements + k]
            for q in range(begin[c], begin[c] + size[c]):
                if place[lists[q]] < earliest:
                    earliest = place[lists[q]]
                    parent[c] = clique[lists[q]]
    return order, bounds, parent, passed, begin, size, lists


@compiled
def _link(i: int, d: int, head: IntArray, following: IntArray, previous: IntArray) -> None:
    """Put a node first into the list of its degree."""
    previous[i], following[i] = -1, head[d]
    if head[d] >= 0:
        previous[head[d]] = i
    head[d] = i


@compiled
def _unlink(i: int, d: int, head: IntArray, following: IntArray, previous: IntArray) -> None:
    """Take a node out of the list of its degree."""
    if previous[i] >= 0:
        following[previous[i]] = following[i]
    else:
        head[d] = following[i]
    if following[i] >= 0:
        previous[following[i]] = previous[i]


@compiled
def _append(i: int, after: IntArray, gone: IntArray, pivots: IntArray, done: int) -> int:
    """Write a node and those merged with it to the pivots; returns how many there are then."""
    while i >= 0:
        gone[i], pivots[done] = 1, i
        done += 1
        i = after[i]
    return done


@compiled
def _begin_stage(
    now: int, stage: IntArray, size: IntArray, absorber: IntArray, start: IntArray, length: IntArray, lists: IntArray,
    elements: int, own: IntArray, count: IntArray, touching: IntArray, later: IntArray, degree: IntArray,
) -> int:  # fmt: skip
    """Find the elements of every node of a stage, and its degree; returns the number of nodes."""
    listed = 0
    for i in range(len(stage)):
        if stage[i] == now:
            count[i], degree[i] = 0, 0
            listed += 1
    for e in range(elements):
        if absorber[e] < 0:
            heavy, later[e] = 0, 0
            for k in range(start[e], start[e] + length[e]):
                heavy += size[lists[k]]
                later[e] += size[lists[k]] if stage[lists[k]] > now else 0
            for k in range(start[e], start[e] + length[e]):
                i = lists[k]
                if stage[i] == now:
                    touching[own[i] + count[i]] = e
                    count[i] += 1
                    degree[i] += heavy - size[i]
    return listed


@compiled
def _merge_twins(
    begin: int, end: int, now: int, stage: IntArray, lists: IntArray, own: IntArray, count: IntArray,
    touching: IntArray, key: IntArray, bucket: IntArray, beside: IntArray, mark: IntArray, stamp: int,
    size: IntArray, gone: IntArray, after: IntArray, last: IntArray,
) -> tuple[int, int]:  # fmt: skip
    """Merge nodes of a list that touch the same elements; returns how many are gone, and the last stamp of a mark."""
    merged = 0
    for k in range(begin, end):
        i = lists[k]
        if stage[i] == now:
            total = 0
            for q in range(own[i], own[i] + count[i]):
                total += touching[q]
            key[i] = total % len(bucket)
            beside[i] = bucket[key[i]]
            bucket[key[i]] = i
    for k in range(begin, end):
        if stage[lists[k]] != now or gone[lists[k]]:
            continue
        i = bucket[key[lists[k]]]
        bucket[key[lists[k]]] = -1
        while i >= 0 and beside[i] >= 0:
            stamp += 1
            for q in range(own[i], own[i] + count[i]):
                mark[touching[q]] = stamp
            before, j = i, beside[i]
            while j >= 0:
                same, q = count[i] == count[j], own[j]
                while same and q < own[j] + count[j]:
                    same = mark[touching[q]] == stamp
                    q += 1
                if same:
                    size[i] += size[j]
                    gone[j], after[last[i]], last[i] = 1, j, last[j]
                    merged += 1
                    beside[before] = beside[j]
                else:
                    before = j
                j = beside[j]
            i = beside[i]
    return merged, stamp


@compiled
def _within(begin: int, end: int, lists: IntArray, seen: IntArray, made: int, gone: IntArray) -> bool:
    """Test whether all nodes of a list that are left belong to the new element."""
    for k in range(begin, end):
        if gone[lists[k]] == 0 and seen[lists[k]] != made:
            return False
    return True


@compiled
def _eliminate(
    weight: IntArray, stage: IntArray, given: IntArray, twins: bool, pool: IntArray, pointer: IntArray
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Eliminate all nodes; arguments as for :func:`cliques`.

    Returns:
        Nodes in the order of elimination; (K + 1,) pointers of the cliques into it; of each element, the E given and
        the K separators: the clique that united it with others or -1, begin and length of its list, its weight; lists.
    """
    n, elements, ordered = len(weight), len(pointer) - 1, len(given) > 0
    start, length, absorber = filled(elements + n, 0), filled(elements + n, 0), filled(elements + n, -1)
    outside, seen_by, heavy = filled(elements + n, 0), filled(elements + n, -1), filled(elements + n, 0)
    later, mark, own = filled(elements + n, 0), filled(elements + n, 0), filled(n + 1, 0)
    for e in range(elements):
        start[e], length[e] = pointer[e], pointer[e + 1] - pointer[e]
        for k in range(pointer[e], pointer[e + 1]):
            own[pool[k] + 1] += 1
            heavy[e] += weight[pool[k]]
    total, size = 0, np.empty(n, np.int64)  # of each node with those merged
    for i in range(n):
        own[i + 1] += own[i]
        total += weight[i]
        size[i] = weight[i]
    count, touching, degree = filled(n, 0), filled(own[n], 0), filled(n, 0)  # of each node: the elements it is in
    head, following, previous = filled(total + 1, -1), filled(n, -1), filled(n, -1)
    key, bucket, beside, after, last = filled(n, 0), filled(n, -1), filled(n, -1), filled(n, -1), np.arange(n)
    seen, gone, pivots, first = filled(n, -1), filled(n, 0), filled(n, 0), filled(n + 1, 0)
    lists, free = np.empty(4 * len(pool) + n + 16, np.int64), len(pool)
    for k in range(len(pool)):
        lists[k] = pool[k]
    done = made = stamp = first[0]  # a literal 0 is a type of its own, for which callees would be compiled, too
    remaining, now, listed, lowest = total, -1, 0, 0
    while done < n:
        while listed == 0:
            now, lowest = now + 1, 0
            listed = _begin_stage(
                now, stage, size, absorber, start, length, lists, elements + made, own, count, touching, later, degree
            )
            for i in range(n):
                if stage[i] == now and not ordered:
                    degree[i] = min(degree[i], remaining - size[i])
                    _link(i, degree[i], head, following, previous)
        if ordered:
            p = given[done]
        else:
            while head[lowest] < 0:
                lowest += 1
            p = head[lowest]
            _unlink(p, lowest, head, following, previous)
        new = elements + made
        done = _append(p, after, gone, pivots, done)
        listed -= 1
        remaining -= size[p]
        if free + n > len(lists):
            longer = np.empty(2 * len(lists) + n, np.int64)
            for k in range(free):
                longer[k] = lists[k]
            lists = longer
        begin, united = free, 0
        seen[p] = made
        for q in range(own[p], own[p] + count[p]):
            e = touching[q]
            absorber[e] = made
            for k in range(start[e], start[e] + length[e]):
                i = lists[k]
                if gone[i] == 0 and seen[i] != made:
                    seen[i] = made
                    lists[free] = i
                    free += 1
                    united += size[i]
                    if stage[i] > now:
                        later[new] += size[i]
                    elif not ordered:
                        _unlink(i, degree[i], head, following, previous)
        for k in range(begin, free if not ordered else begin):
            i = lists[k]
            for q in range(own[i], own[i] + (count[i] if stage[i] == now else 0)):
                e = touching[q]
                if absorber[e] < 0:
                    if seen_by[e] != made:
                        seen_by[e], outside[e] = made, heavy[e] - later[e]
                    outside[e] -= size[i]
        end, free = free, begin
        for k in range(begin, end):
            i = lists[k]
            if stage[i] == now:
                put, beyond = own[i], 0
                for q in range(own[i], own[i] + count[i]):
                    e = touching[q]
                    if absorber[e] >= 0:
                        continue
                    if (
                        not ordered
                        and outside[e] == 0
                        and (later[e] == 0 or _within(start[e], start[e] + length[e], lists, seen, made, gone))
                    ):
                        absorber[e] = made  # a part of the new element
                    else:
                        touching[put] = e
                        put += 1
                        beyond += outside[e] + later[e]
                if put == own[i] and not ordered:  # leaves with the pivot
                    done = _append(i, after, gone, pivots, done)
                    listed -= 1
                    remaining -= size[i]
                    united -= size[i]
                    continue
                touching[put] = new
                count[i] = put + 1 - own[i]
                degree[i] = min(degree[i], beyond)
            lists[free] = i
            free += 1
        if twins and not ordered and free > begin + 1:
            merged, stamp = _merge_twins(
                begin, free, now, stage, lists, own, count, touching, key, bucket, beside, mark, stamp, size, gone,
                after, last,
            )  # fmt: skip
            listed -= merged
        end, free = free, begin
        for k in range(begin, end):
            i = lists[k]
            if gone[i]:
                continue
            lists[free] = i
            free += 1
            if stage[i] == now and not ordered:
                # What it touched, and what the new element brings: never more than what is left.
                degree[i] = min(degree[i] + united - size[i], remaining - size[i])
                _link(i, degree[i], head, following, previous)
                lowest = min(lowest, degree[i])
        start[new], length[new], heavy[new] = begin, free - begin, united
        made += 1
        first[made] = done
    return pivots, first[: made + 1], absorber, start, length, heavy, lists


@compiled
def postordered(
    order: IntArray, bounds: IntArray, parent: IntArray, passed: IntArray
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Renumber cliques so that those of a subtree follow each other; arguments as :func:`cliques` returns them."""
    count = len(parent)
    head, sibling, number = filled(count + 1, -1), filled(count, -1), filled(count, -1)
    for s in range(count - 1, -1, -1):
        p = parent[s] if parent[s] >= 0 else count
        sibling[s] = head[p]
        head[p] = s
    stack, named, depth, numbered = filled(count + 1, count), filled(count, 0), 0, 0
    while depth >= 0:
        s = stack[depth]
        child = head[s]
        if child >= 0:
            head[s] = sibling[child]
            depth += 1
            stack[depth] = child
        else:
            depth -= 1
            if s < count:
                number[s], named[numbered] = numbered, s
                numbered += 1
    result, begin, above, rows = filled(len(order), 0), filled(count + 1, 0), filled(count, -1), filled(count, 0)
    for k in range(count):
        s = named[k]
        begin[k + 1], rows[k] = begin[k] + bounds[s + 1] - bounds[s], passed[s]
        if parent[s] >= 0:
            above[k] = number[parent[s]]
        for q in range(bounds[s + 1] - bounds[s]):
            result[begin[k] + q] = order[bounds[s] + q]
    return result, begin, above, rows


@compiled
def predicted_cost(weight: IntArray, order: IntArray, bounds: IntArray, passed: IntArray) -> float:
    """Predicted nanoseconds to eliminate all cliques; arguments as :func:`cliques` returns them."""
    cost = 0.0
    for k in range(len(passed)):
        width = 0
        for q in range(bounds[k], bounds[k + 1]):
            width += weight[order[q]]
        cost += front_cost(width, passed[k])
    return cost


@compiled
def separators(
    order: IntArray, begin: IntArray, size: IntArray, lists: IntArray, bounds: IntArray, pool: IntArray,
    pointer: IntArray,
) -> tuple[IntArray, IntArray, IntArray]:  # fmt: skip
    """Nodes of the separators in the order of their elimination, and the clique that takes each element in.

    Args:
        order: this and the next four as :func:`cliques` returns them.
        begin: see above.
        size: see above.
        lists: see above.
        bounds: see above.
        pool: nodes of the elements.
        pointer: (E + 1,) begin of each.

    Returns:
        Nodes, separator after separator, and (K + 1,) pointers; (E,) clique of the first node of each element, or -1
        for an empty one.
    """
    count, place, clique, ends = len(begin), filled(len(order), 0), filled(len(order), 0), filled(len(begin) + 1, 0)
    for k in range(count):
        ends[k + 1] = ends[k] + size[k]
        for q in range(bounds[k], bounds[k + 1]):
            place[order[q]], clique[order[q]] = q, k
    members, home = filled(ends[count], 0), filled(len(pointer) - 1, -1)
    for k in range(count):
        for q in range(size[k]):
            i, slot = lists[begin[k] + q], ends[k] + q
            while slot > ends[k] and place[members[slot - 1]] > place[i]:
                members[slot] = members[slot - 1]
                slot -= 1
            members[slot] = i
    for e in range(len(home)):
        earliest = len(order)
        for q in range(pointer[e], pointer[e + 1]):
            if place[pool[q]] < earliest:
                earliest = place[pool[q]]
                home[e] = clique[pool[q]]
    return members, ends, home
