"""One update: mark what changed, take it out of the tree, order and eliminate it anew, and find the steps.

The idea is that of M. Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31 (2012):
a change reaches the cliques of its variables and everything above them; subtrees below keep their update matrices.
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.ordering import filled
from unifg.machine.jit import compiled
from unifg.machine.vectors import splat, store
from unifg.smoothing.cliques import add_child, add_factor, eliminate_clique, substitute
from unifg.smoothing.fields import (
    CHANGED,
    CHILD,
    CLIQUE,
    CLIQUE_END,
    CLIQUE_FREE,
    COUNT,
    DIM,
    FILLED,
    FRONT,
    LARGEST,
    LINEAR,
    LINK,
    LIST,
    LISTS_END,
    LOCAL,
    MADE_ELIMINATED,
    MADE_LINEARIZED,
    MADE_RELINEARIZED,
    MADE_SUBSTITUTED,
    MARK,
    MARKED,
    NEW_FACTORS,
    NEXT_CLIQUE,
    NEXT_FACTOR,
    NUMBERS_END,
    PARENT,
    PIVOT_ROWS,
    PIVOTS,
    PLACE,
    PRIOR,
    SCRATCH,
    SEQUENCE,
    SIBLING,
    SIZE,
    SLOTS,
    SLOTS_MAX,
    STATE,
    STRIDE,
    TYPE,
    UPDATES,
    VARIABLES,
    State,
)
from unifg.smoothing.linear import linearize
from unifg.smoothing.memory import length_of_front, more_lists, more_numbers, take_list, take_numbers
from unifg.smoothing.ordering import arrange
from unifg.smoothing.tree import dissolve, give_up, mark_factor, move_points, sort_by_age
from unifg.smoothing.views import borrow, borrowed
from unifg.typing import Array, IntArray


@compiled
def update_tree(
    state: State, relinearize: float, limit: float, threshold: float, chronological: bool
) -> tuple[int, IntArray, Array]:
    """Bring tree and steps up to date with the factors.

    Args:
        state: of the smoother.
        relinearize: largest entry of a step before the variable is relinearised, now; infinite: not now.
        limit: the same for later updates.
        threshold: change of a step that back-substitution passes on to subtrees that were not eliminated anew.
        chronological: eliminate by age, one variable to a clique, rather than by minimum degree.

    Returns:
        -1, or the variable whose pivot vanished; the arenas, which may have moved.
    """
    kept_lists, kept_numbers = state.lists, state.numbers
    state = borrow(state)
    counters, variables, factors, types = state.counters, state.variables, state.factors, state.types
    cliques = state.cliques
    counters[UPDATES] += 1
    update, scratch, chain = counters[UPDATES], np.empty(counters[SCRATCH]), -1
    for k in range(MADE_ELIMINATED, LARGEST + 1):
        counters[k] = 0
    if relinearize < np.inf:
        chain, counters[MADE_RELINEARIZED] = move_points(state, relinearize, update, chain, scratch)
    f = counters[NEW_FACTORS]
    counters[NEW_FACTORS] = -1
    while f >= 0:
        chain = mark_factor(state, f, update, chain)
        f = factors[f, NEXT_FACTOR]
    members, orphans = dissolve(state, chain, update)
    n = len(members)
    if n == 0:
        return -1, kept_lists, kept_numbers
    # Factors among the members only: all others are in the update matrices of the orphans.
    lists, count, inside = state.lists, 0, np.empty(2 * n + 16, np.int64)
    for i in range(n):
        link = variables[members[i], LINK]
        while link >= 0:
            f, slot = link // SLOTS_MAX, link % SLOTS_MAX
            at, slots = factors[f, VARIABLES], types[factors[f, TYPE], SLOTS]
            if slot == 0:
                whole = True
                for s in range(1, slots):
                    whole = whole and variables[lists[at + s], MARK] == update
                if whole:
                    if count == len(inside):
                        inside = more_lists(inside, count, count)
                    inside[count] = f
                    count += 1
                    if factors[f, STATE] != LINEAR:
                        linearize(state, f, scratch)
                        counters[MADE_LINEARIZED] += 1
            link = lists[at + slots + slot]
    # Elements: separators of the orphans, then variables of the factors.
    elements, length = len(orphans) + count, 0
    for k in range(len(orphans)):
        length += cliques[orphans[k], COUNT] - cliques[orphans[k], PIVOTS]
    for k in range(count):
        length += types[factors[inside[k], TYPE], SLOTS]
    pool, pointer, length = np.empty(length, np.int64), filled(elements + 1, 0), 0
    for k in range(len(orphans)):
        clique = cliques[orphans[k]]
        for q in range(clique[LIST] + clique[PIVOTS], clique[LIST] + clique[COUNT]):
            pool[length] = variables[lists[q], LOCAL]
            length += 1
        pointer[k + 1] = length
    for k in range(count):
        f = inside[k]
        at = factors[f, VARIABLES]
        for s in range(types[factors[f, TYPE], SLOTS]):
            pool[length] = variables[lists[at + s], LOCAL]
            length += 1
        pointer[len(orphans) + k + 1] = length
    weight, given, last = (
        np.empty(n, np.int64),
        np.empty(n if chronological else 0, np.int64),
        variables[members[0], LOCAL],
    )
    for i in range(n):
        weight[i] = variables[members[i], DIM]
        if variables[members[i], SEQUENCE] > variables[members[last], SEQUENCE]:
            last = i
    if chronological:
        for i in range(n):
            given[i] = members[i]
        sort_by_age(state, given)
        for i in range(n):
            given[i] = variables[given[i], LOCAL]
    order, first, separator, bounds, parent, home = arrange(weight, last, given, pool, pointer)
    made = len(parent)
    # Sizes, and room for all of it.
    rows, numbers_needed, lists_needed = np.empty(made, np.int64), 0, 0
    largest = 0
    for k in range(made):
        size = 0
        for q in range(first[k], first[k + 1]):
            size += weight[order[q]]
        for q in range(bounds[k], bounds[k + 1]):
            size += weight[separator[q]]
        rows[k] = size
        largest = max(largest, size)
        numbers_needed += 16 + 5 * length_of_front(size) // 4
        lists_needed += 8 + 2 * (first[k + 1] - first[k] + bounds[k + 1] - bounds[k])
    kept_lists = more_lists(kept_lists, counters[LISTS_END], lists_needed)
    kept_numbers = more_numbers(kept_numbers, counters[NUMBERS_END], numbers_needed)
    state = State(
        variables, factors, types, state.kinds, cliques, counters, state.stamps, borrowed(kept_lists),
        borrowed(kept_numbers),
    )  # fmt: skip
    counters[LARGEST], counters[MADE_ELIMINATED] = largest, n
    # What each clique takes in.
    taken, following = filled(made, -1), filled(elements, -1)
    for e in range(elements):
        if home[e] >= 0:
            following[e] = taken[home[e]]
            taken[home[e]] = e
    lists, numbers = state.lists, state.numbers
    place, row_of, runs = np.empty(n, np.int64), np.empty(largest + 8, np.int64), np.empty(largest + 8, np.int64)
    scale, pivots, signs, slot_of = (
        np.empty(largest + 8),
        np.empty(largest + 8),
        np.empty(largest + 8),
        filled(made, -1),
    )
    zero = splat(0.0)
    for k in range(made):
        c = counters[CLIQUE_FREE]
        if c >= 0:
            counters[CLIQUE_FREE] = cliques[c, NEXT_CLIQUE]
        else:
            c = counters[CLIQUE_END]
            counters[CLIQUE_END] = c + 1
        slot_of[k] = c
        cliques[c, CHILD] = -1
    for k in range(made):
        c = slot_of[k]
        clique, size = cliques[c], rows[k]
        clique[PIVOTS], clique[COUNT] = first[k + 1] - first[k], first[k + 1] - first[k] + bounds[k + 1] - bounds[k]
        clique[SIZE], clique[STRIDE], clique[MARKED], clique[PRIOR], clique[FILLED] = size, size + 1, 0, 0, 1
        clique[LIST], clique[FRONT] = take_list(state, clique[COUNT]), take_numbers(state, length_of_front(size))
        clique[PARENT], clique[SIBLING] = -1, -1
        at, row = clique[LIST], 0
        for q in range(first[k], first[k + 1]):
            i = order[q]
            v = members[i]
            lists[at], place[i] = v, row
            variables[v, CLIQUE], variables[v, PLACE] = c, row
            row += weight[i]
            at += 1
        clique[PIVOT_ROWS] = row
        for q in range(bounds[k], bounds[k + 1]):
            i = separator[q]
            lists[at], place[i] = members[i], row
            row += weight[i]
            at += 1
        at = clique[FRONT]
        for q in range(size):  # from the diagonal on
            for column in range(q, size + 1, 4):
                store(numbers, at + column, zero)
            at += size + 1
        e = taken[k]
        while e >= 0:
            if e < len(orphans):
                child = orphans[e]
                cliques[child, PARENT], cliques[child, SIBLING] = c, clique[CHILD]
                clique[CHILD] = child
            else:
                add_factor(state, inside[e - len(orphans)], place, clique)
            e = following[e]
        child = clique[CHILD]
        while child >= 0:
            add_child(state, cliques[child], place, clique, row_of, runs)
            child = cliques[child, SIBLING]
        failed = eliminate_clique(state, clique, scale, pivots, signs)
        if failed >= 0:
            give_up(state, failed)
            return failed, kept_lists, kept_numbers
        if parent[k] >= 0:
            p = slot_of[parent[k]]
            clique[PARENT], clique[SIBLING] = p, cliques[p, CHILD]
            cliques[p, CHILD] = c
    x = np.empty(largest + 8)
    for k in range(made - 1, -1, -1):
        substitute(state, cliques[slot_of[k]], threshold, limit, update, x)
    counters[MADE_SUBSTITUTED] = n
    for k in range(len(orphans)):
        counters[MADE_SUBSTITUTED] += descend(state, orphans[k], threshold, limit, update)
    return -1, kept_lists, kept_numbers


@compiled
def descend(state: State, top: int, threshold: float, limit: float, update: int) -> int:
    """Renew the steps of a subtree as far down as they change; returns the number of variables."""
    cliques, variables, lists = state.cliques, state.variables, state.lists
    c, count, x, room = top, 0, np.empty(0), 0
    while True:
        clique, moved = cliques[c], False
        if clique[PRIOR] == 0:
            for q in range(clique[LIST] + clique[PIVOTS], clique[LIST] + clique[COUNT]):
                moved = moved or variables[lists[q], CHANGED] == update
        if moved:
            if clique[SIZE] > room:
                room = 2 * clique[SIZE]
                x = np.empty(room + 8)
            substitute(state, clique, threshold, limit, update, x)
            count += clique[PIVOTS]
            if clique[CHILD] >= 0:
                c = clique[CHILD]
                continue
        while c != top and cliques[c, SIBLING] < 0:
            c = cliques[c, PARENT]
        if c == top:
            return count
        c = cliques[c, SIBLING]
