"""One update: mark what changed, take it out of the tree, order and eliminate it anew, and find the steps.

The idea is that of M. Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31 (2012):
a change reaches the cliques of its variables and everything above them; subtrees below keep their update matrices.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address
from unifg.elimination.ordering import filled
from unifg.elimination.symbolic import cliques as find_cliques
from unifg.elimination.symbolic import separators
from unifg.smoothing.cliques import add_child, add_factor, begin_clique, eliminate_clique, substitute
from unifg.smoothing.linear import linearize
from unifg.smoothing.memory import found, grown, length_of_front, more, next_row
from unifg.smoothing.state import LINEAR, SLOTS_MAX, opened
from unifg.smoothing.tree import dissolve, give_up, mark_factor, move_points, sort_by_age
from unifg.typing import Array, IntArray


@compiled
def begin(memory: Address, relinearize: float) -> int:
    """Move linearisation points and find the chain of cliques to dissolve.

    Args:
        memory: address of the description of the smoother's arrays.
        relinearize: largest entry of a step before the variable is relinearised; infinite: not now.
    """
    state = opened(memory)
    counters, factors, chain = state.counters[0], state.factors, -1
    counters.updates += 1
    update = counters.updates
    counters.eliminated = counters.relinearized = counters.substituted = 0
    counters.linearized = counters.marginalized = counters.largest = 0
    if relinearize < np.inf:
        chain, counters.relinearized = move_points(memory, relinearize, update, chain, np.empty(counters.scratch))
    f = counters.new_factors
    counters.new_factors = -1
    while f >= 0:
        chain = mark_factor(memory, f, update, chain)
        f = factors[f].next
    return chain


@compiled
def renew(
    memory: Address, chain: int, limit: float, threshold: float, chronological: bool
) -> tuple[int, IntArray | None, Array | None]:
    """Dissolve a chain of cliques, order and eliminate what they held anew, and find the steps.

    Args:
        memory: address of the description of the smoother's arrays.
        chain: what :func:`begin` found.
        limit: largest entry of a step before the variable is relinearised in a later update.
        threshold: change of a step that back-substitution passes on to subtrees that were not eliminated anew.
        chronological: eliminate by age, one variable to a clique, rather than by minimum degree.

    Returns:
        -1, or the variable whose pivot vanished; longer arenas, or nothing where there was room.
    """
    state, more_lists, more_numbers = opened(memory), np.empty(0, np.int64), np.empty(0)
    counters, variables, cliques = state.counters[0], state.variables, state.cliques
    update = counters.updates
    members, orphans = dissolve(memory, chain, update)
    n = len(members)
    if n == 0:
        return -1, found(more_lists), found(more_numbers)
    inside = _whole_factors(memory, members, update)
    pool, pointer = _elements(memory, orphans, inside)
    weight, given, last = np.empty(n, np.int64), members[: n if chronological else 0].copy(), 0
    stage, alone = filled(n, 0), np.empty(n, np.bool_)
    for i in range(n):
        weight[i], alone[i] = variables[members[i]].dim, chronological
        if variables[members[i]].sequence > variables[members[last]].sequence:
            last = i
    sort_by_age(memory, given)
    for i in range(len(given)):
        given[i] = variables[given[i]].local
    stage[last], alone[last] = 0 if chronological else 1, True
    order, first, parent, _, begin_at, sizes, held = find_cliques(weight, stage, alone, given, False, pool, pointer)
    separator, bounds, home = separators(order, begin_at, sizes, held, first, pool, pointer)
    made = len(parent)
    # Sizes, and room for all of it.
    rows, numbers_needed, lists_needed, largest, longest = np.empty(made, np.int64), 0, 0, 0, 0
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
    for k in range(len(inside)):
        longest = max(longest, state.types[state.factors[inside[k]].type].slots)
    more_lists = more(state.lists, counters.lists_end, lists_needed)
    more_numbers = more(state.numbers, counters.numbers_end, numbers_needed)
    state = grown(memory, more_lists, more_numbers)
    counters.largest, counters.eliminated = largest, n
    # What each clique takes in.
    elements = len(home)
    leading, following = filled(made, -1), filled(elements, -1)
    for e in range(elements):
        if home[e] >= 0:
            following[e] = leading[home[e]]
            leading[home[e]] = e
    place, slot_of, room = np.empty(n, np.int64), filled(made, -1), max(largest, longest) + 8
    relative, runs, x, pivots, signs = (
        np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room), np.empty(room), np.empty(room),
    )  # fmt: skip
    for k in range(made):
        c, counters.clique_free, counters.clique_end = next_row(cliques, counters.clique_free, counters.clique_end)
        slot_of[k] = c
        cliques[c].child = -1
    for k in range(made):
        c = slot_of[k]
        clique = cliques[c]
        begin_clique(
            memory, c, members, order, first[k], first[k + 1], separator, bounds[k], bounds[k + 1], rows[k], place,
        )  # fmt: skip
        e = leading[k]
        while e >= 0:
            if e < len(orphans):
                child = orphans[e]
                cliques[child].parent, cliques[child].sibling = c, clique.child
                clique.child = child
            else:
                add_factor(memory, inside[e - len(orphans)], place, clique, relative, runs)
            e = following[e]
        child = clique.child
        while child >= 0:
            add_child(memory, cliques[child], place, clique, relative, runs)
            child = cliques[child].sibling
        failed = eliminate_clique(memory, clique, x, pivots, signs)
        if failed >= 0:
            give_up(memory, failed)
            return failed, found(more_lists), found(more_numbers)
        if parent[k] >= 0:
            p = slot_of[parent[k]]
            clique.parent, clique.sibling = p, cliques[p].child
            cliques[p].child = c
    for k in range(made - 1, -1, -1):
        substitute(memory, cliques[slot_of[k]], threshold, limit, update, x, pivots)
    counters.substituted = n
    for k in range(len(orphans)):
        counters.substituted += _descend(memory, orphans[k], threshold, limit, update)
    return -1, found(more_lists), found(more_numbers)


@compiled
def _whole_factors(memory: Address, members: IntArray, update: int) -> IntArray:
    """Factors among the members only, linearised: all others are in the update matrices of the orphans."""
    state = opened(memory)
    variables, factors, types, lists, counters = (
        state.variables, state.factors, state.types, state.lists, state.counters[0],
    )  # fmt: skip
    count, inside, scratch = 0, np.empty(counters.factor_end, np.int64), np.empty(counters.scratch)
    for i in range(len(members)):
        link = variables[members[i]].link
        while link >= 0:
            f, slot = link // SLOTS_MAX, link % SLOTS_MAX
            at, slots, whole = factors[f].variables, types[factors[f].type].slots, slot == 0
            for s in range(1, slots if whole else 1):
                whole = whole and variables[lists[at + s]].mark == update
            if whole:
                inside[count] = f
                count += 1
                if factors[f].state != LINEAR:
                    linearize(memory, f, scratch)
                    counters.linearized += 1
            link = lists[at + slots + slot]
    return inside[:count]


@compiled
def _elements(memory: Address, orphans: IntArray, inside: IntArray) -> tuple[IntArray, IntArray]:
    """Variables that touch each other, by their local numbers: separators of the orphans, variables of the factors."""
    state = opened(memory)
    variables, lists, first, length = state.variables, state.lists, len(orphans), 0
    pointer, starts, ends = (
        filled(first + len(inside) + 1, 0),
        filled(first + len(inside), 0),
        filled(first + len(inside), 0),
    )
    for k in range(first):
        clique = state.cliques[orphans[k]]
        starts[k], ends[k] = clique.list + clique.pivots, clique.list + clique.count
    for k in range(len(inside)):
        factor = state.factors[inside[k]]
        starts[first + k], ends[first + k] = factor.variables, factor.variables + state.types[factor.type].slots
    pool = np.empty((ends - starts).sum(), np.int64)
    for k in range(len(starts)):
        for q in range(starts[k], ends[k]):
            local, known = variables[lists[q]].local, False
            for p in range(pointer[k], length if k >= first else pointer[k]):  # a factor may name a variable twice
                known = known or pool[p] == local
            if not known:
                pool[length] = local
                length += 1
        pointer[k + 1] = length
    return pool[:length], pointer


@compiled
def _descend(memory: Address, top: int, threshold: float, limit: float, update: int) -> int:
    """Renew the steps of a subtree as far down as they change; returns the number of variables."""
    state = opened(memory)
    cliques, variables, lists = state.cliques, state.variables, state.lists
    c, count, x, pivots, room = top, 0, np.empty(0), np.empty(0), 0
    while True:
        clique, moved = cliques[c], False
        if clique.prior == 0:
            for q in range(clique.list + clique.pivots, clique.list + clique.count):
                moved = moved or variables[lists[q]].changed == update
        if moved:
            if clique.size > room:
                room = 2 * clique.size
                x, pivots = np.empty(room + 8), np.empty(room + 8)
            substitute(memory, clique, threshold, limit, update, x, pivots)
            count += clique.pivots
            if clique.child >= 0:
                c = clique.child
                continue
        while c != top and cliques[c].sibling < 0:
            c = cliques[c].parent
        if c == top:
            return count
        c = cliques[c].sibling
