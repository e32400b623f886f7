"""In which order to eliminate some variables, and the cliques that arise.

The graph is given by its cliques alone: every factor, and every eliminated subtree, is an *element*, a list of
variables that all touch each other. Eliminating a variable unites its elements into a new one, whose list is the
separator of the new clique: ordering and symbolic factorisation are one pass. Degrees are bounded as in P. Amestoy,
T. Davis, I. Duff, "An approximate minimum degree ordering algorithm", SIAM J. Matrix Anal. Appl. 17 (1996).
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.typing import IntArray

ZEROS, PART = 36, 0.12  # a clique joins its parent when the zeros this stores are fewer, or a smaller part of both


@compiled
def arrange(
    weight: IntArray, last: int, given: IntArray, pool: IntArray, pointer: IntArray
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Order variables and find the cliques.

    Args:
        weight: (n,) scalars of each variable.
        last: this one is eliminated last and alone, however few it touches; -1: none.
        given: the order, (n,), each variable then being a clique of its own; empty: minimum degree.
        pool: variables of the elements, one list after the other.
        pointer: (E + 1,) where each begins.

    Returns:
        Variables clique after clique and (K + 1,) pointers to it; variables of the separators, in the order of their
        elimination, and (K + 1,) pointers; parent of each clique or -1; clique that takes each element in, (E,), or -1
        for an empty one.
    """
    n, elements = len(weight), len(pointer) - 1
    start, length = filled(elements + n, 0), filled(elements + n, 0)
    taken = filled(elements + n, -1)  # the clique that united an element with others
    outside, heard, heavy = filled(elements + n, 0), filled(elements + n, -1), filled(elements + n, 0)
    own = filled(n + 1, 0)
    for e in range(elements):
        start[e], length[e] = pointer[e], pointer[e + 1] - pointer[e]
        for k in range(pointer[e], pointer[e + 1]):
            own[pool[k] + 1] += 1
            heavy[e] += weight[pool[k]]
    total = 0
    for i in range(n):
        own[i + 1] += own[i]
        total += weight[i]
    count, touching = filled(n, 0), filled(own[n], 0)  # of each variable: the elements it is in
    degree = filled(n, 0)
    for e in range(elements):
        for k in range(pointer[e], pointer[e + 1]):
            i = pool[k]
            touching[own[i] + count[i]] = e
            count[i] += 1
            degree[i] += heavy[e] - weight[i]
    ordered = len(given) == n
    head, following, previous = filled(total + 1 if not ordered else 0, -1), filled(n, -1), filled(n, -1)
    lowest = total
    if not ordered:
        for i in range(n - 1, -1, -1):
            degree[i] = min(degree[i], total - weight[i])
            if i != last:
                d = degree[i]
                following[i] = head[d]
                if head[d] >= 0:
                    previous[head[d]] = i
                head[d] = i
                lowest = min(lowest, d)
    seen, gone = filled(n, -1), filled(n, 0)
    pivots, first = filled(n, 0), filled(n + 1, 0)
    lists, free = np.empty(4 * len(pool) + n + 16, np.int64), len(pool)
    for k in range(len(pool)):
        lists[k] = pool[k]
    done, cliques, remaining = 0, 0, total
    while done < n:
        if ordered:
            p = given[done]
        else:
            while lowest <= total and head[lowest] < 0:
                lowest += 1
            p = head[lowest] if lowest <= total else last
            if p != last:
                head[lowest] = following[p]
                if following[p] >= 0:
                    previous[following[p]] = -1
        new = elements + cliques
        gone[p] = 1
        pivots[done] = p
        done += 1
        remaining -= weight[p]
        if free + n > len(lists):
            longer = np.empty(2 * len(lists) + n, np.int64)
            for k in range(free):
                longer[k] = lists[k]
            lists = longer
        begin, united = free, 0
        seen[p] = cliques
        for q in range(own[p], own[p] + count[p]):
            e = touching[q]
            taken[e] = cliques
            for k in range(start[e], start[e] + length[e]):
                i = lists[k]
                if gone[i] == 0 and seen[i] != cliques:
                    seen[i] = cliques
                    lists[free] = i
                    free += 1
                    united += weight[i]
                    if not ordered and i != last:
                        if previous[i] >= 0:
                            following[previous[i]] = following[i]
                        else:
                            head[degree[i]] = following[i]
                        if following[i] >= 0:
                            previous[following[i]] = previous[i]
        for k in range(begin if not ordered else free, free):
            i = lists[k]
            for q in range(own[i], own[i] + count[i]):
                e = touching[q]
                if taken[e] < 0:
                    if heard[e] != cliques:
                        heard[e] = cliques
                        outside[e] = heavy[e]
                    outside[e] -= weight[i]
        end, free = free, begin
        for k in range(begin, end):
            i = lists[k]
            put, beyond = own[i], 0
            for q in range(own[i], own[i] + count[i]):
                e = touching[q]
                if taken[e] < 0:
                    if not ordered and outside[e] == 0:  # a part of the new element
                        taken[e] = cliques
                    else:
                        touching[put] = e
                        put += 1
                        beyond += outside[e]
            if beyond == 0 and not ordered and i != last:  # leaves with the pivot
                gone[i] = 1
                pivots[done] = i
                done += 1
                remaining -= weight[i]
                united -= weight[i]
                continue
            touching[put] = new
            count[i] = put + 1 - own[i]
            lists[free] = i
            free += 1
            if not ordered:
                degree[i] = min(degree[i], beyond)
        start[new], length[new], heavy[new] = begin, free - begin, united
        if not ordered:
            for k in range(begin, free):
                i = lists[k]
                if i == last:
                    continue
                # What it touched, and what the new element brings: never more than what is left.
                d = min(degree[i] + united - weight[i], remaining - weight[i])
                degree[i] = d
                previous[i] = -1
                following[i] = head[d]
                if head[d] >= 0:
                    previous[head[d]] = i
                head[d] = i
                lowest = min(lowest, d)
        cliques += 1
        first[cliques] = done
    # Cliques join their parents where that stores few zeros.
    rows, zeros, into = filled(cliques, 0), filled(cliques, 0), filled(cliques, 0)
    for k in range(cliques):
        into[k] = k
        for q in range(first[k], first[k + 1]):
            rows[k] += weight[pivots[q]]
    for k in range(cliques):
        p, below = taken[elements + k], heavy[elements + k]
        if ordered or p < 0 or (last >= 0 and p == cliques - 1):
            continue
        wide = rows[p] + heavy[elements + p]
        stored = zeros[k] + zeros[p] + rows[k] * (wide - below)
        if stored <= ZEROS or stored <= PART * (rows[k] + rows[p]) * (rows[k] + wide):
            into[k] = p
            rows[p] += rows[k]
            zeros[p] = stored
    number, kept = filled(cliques, -1), 0
    for k in range(cliques):
        if into[k] == k:
            number[k] = kept
            kept += 1
    for k in range(cliques - 1, -1, -1):
        if into[k] != k:
            number[k] = number[into[k]]
    order, place, bounds = filled(n, 0), filled(n, 0), filled(kept + 1, 0)
    separators, parent, amount = filled(kept + 1, 0), filled(kept, -1), 0
    for k in range(cliques):
        bounds[number[k] + 1] += first[k + 1] - first[k]
        if into[k] == k:
            amount += length[elements + k]
            separators[number[k] + 1] = amount
    for k in range(kept):
        bounds[k + 1] += bounds[k]
    fill, clique_of = filled(kept, 0), filled(n, 0)
    for k in range(cliques):
        c = number[k]
        for q in range(first[k], first[k + 1]):
            at = bounds[c] + fill[c]
            order[at], place[pivots[q]], clique_of[pivots[q]] = pivots[q], at, c
            fill[c] += 1
    members = filled(amount, 0)
    for k in range(cliques):
        if into[k] != k:
            continue
        at, begin = separators[number[k]], start[elements + k]
        for q in range(length[elements + k]):
            i, slot = lists[begin + q], at + q
            while slot > at and place[members[slot - 1]] > place[i]:
                members[slot] = members[slot - 1]
                slot -= 1
            members[slot] = i
    # Everything goes to the clique of its first variable: whoever united it with others may know none of its pivots.
    for k in range(kept):
        if separators[k + 1] > separators[k]:
            parent[k] = clique_of[members[separators[k]]]
    home = filled(elements, -1)
    for e in range(elements):
        earliest = n
        for q in range(pointer[e], pointer[e + 1]):
            if place[pool[q]] < earliest:
                earliest = place[pool[q]]
                home[e] = clique_of[pool[q]]
    return order, bounds, members, separators, parent, home
