"""The tree of cliques: which of them a change touches, and what taking them out leaves behind."""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address
from unifg.elimination.ordering import filled
from unifg.smoothing.memory import give_list, give_numbers, length_of_front
from unifg.smoothing.priors import relinearize
from unifg.smoothing.state import LINEAR, SLOTS_MAX, STALE, opened
from unifg.typing import Array, IntArray


@compiled
def mark_path(memory: Address, c: int, update: int, chain: int) -> int:
    """Put the cliques from one to its root into the chain of those to dissolve."""
    state = opened(memory)
    cliques = state.cliques
    while c >= 0 and cliques[c].marked != update:
        cliques[c].marked = update
        cliques[c].next = chain
        chain = c
        c = cliques[c].parent
    return chain


@compiled
def mark_factor(memory: Address, f: int, update: int, chain: int) -> int:
    """Put the cliques between the variables of a factor and their roots into the chain of those to dissolve."""
    state = opened(memory)
    lists, variables, factor = state.lists, state.variables, state.factors[f]
    for s in range(state.types[factor.type].slots):
        chain = mark_path(memory, variables[lists[factor.variables + s]].clique, update, chain)
    return chain


@compiled
def move_points(memory: Address, limit: float, update: int, chain: int, scratch: Array) -> tuple[int, int]:
    """Relinearise variables with a step beyond the limit; returns the chain of cliques to dissolve, and how many."""
    state = opened(memory)
    variables, factors, numbers, counters = state.variables, state.factors, state.numbers, state.counters[0]
    lists, types, cliques = state.lists, state.types, state.cliques
    v, count = counters.candidates, 0
    counters.candidates = -1
    while v >= 0:
        largest, step = 0.0, variables[v].value + variables[v].storage
        for d in range(variables[v].dim):
            largest = max(largest, abs(numbers[step + d]))
        variables[v].candidate = 0
        if largest > limit and variables[v].frozen != 1:  # a prior may have frozen it since
            count += 1
            relinearize(memory, v, scratch)
            for c in range(counters.clique_end if variables[v].frozen == 2 else 0):
                if cliques[c].prior:
                    chain = mark_path(memory, cliques[c].parent, update, chain)
            link = variables[v].link
            while link >= 0:
                f = link // SLOTS_MAX
                if factors[f].state == LINEAR:
                    factors[f].state = STALE
                    chain = mark_factor(memory, f, update, chain)
                link = lists[factors[f].variables + types[factors[f].type].slots + link % SLOTS_MAX]
        v = variables[v].next_candidate
    return chain, count


@compiled
def release(memory: Address, c: int) -> None:
    """Give back the memory of a clique."""
    state = opened(memory)
    clique = state.cliques[c]
    give_list(memory, clique.count, clique.list)
    give_numbers(memory, length_of_front(clique.size), clique.front)
    clique.filled, clique.prior, clique.marked, clique.next = 0, 0, 0, state.counters[0].clique_free
    state.counters[0].clique_free = c


@compiled
def dissolve(memory: Address, chain: int, update: int) -> tuple[IntArray, IntArray]:
    """Take a chain of cliques out of the tree.

    Returns:
        The variables to eliminate, new ones included and numbered in their field ``local``, and the cliques that have
        lost their parent.
    """
    state = opened(memory)
    variables, cliques, lists, counters = state.variables, state.cliques, state.lists, state.counters[0]
    members, lost = np.empty(counters.variable_end, np.int64), np.empty(counters.clique_end, np.int64)
    count, orphans, c = 0, 0, chain
    while c >= 0:
        for k in range(cliques[c].list, cliques[c].list + cliques[c].pivots):
            members[count] = lists[k]
            count += 1
        child = cliques[c].child
        while child >= 0:
            if cliques[child].marked != update:
                lost[orphans] = child
                orphans += 1
            child = cliques[child].sibling
        c = cliques[c].next
    while chain >= 0:  # only now: a released clique no longer says that it was marked
        c, chain = chain, cliques[chain].next
        release(memory, c)
    if counters.failed >= 0:  # nothing but priors is left
        for c in range(counters.clique_end):
            if cliques[c].filled:
                lost[orphans] = c
                orphans += 1
        counters.failed = -1
    v = counters.new_variables
    counters.new_variables = -1
    while v >= 0:
        members[count] = v
        count += 1
        v = variables[v].next
    for i in range(count):
        variables[members[i]].clique = -1
        variables[members[i]].mark = update
        variables[members[i]].local = i
    return members[:count], lost[:orphans]


@compiled
def give_up(memory: Address, failed: int) -> None:
    """After a vanished pivot: keep nothing but factors and priors; the next update eliminates everything anew."""
    state = opened(memory)
    variables, cliques, counters = state.variables, state.cliques, state.counters[0]
    for c in range(counters.clique_end):
        if cliques[c].filled and cliques[c].prior == 0:
            release(memory, c)
        elif cliques[c].filled:
            cliques[c].parent = -1
            cliques[c].sibling = -1
    counters.new_variables = -1
    for v in range(counters.variable_end - 1, -1, -1):
        if variables[v].alive:
            variables[v].clique = -1
            variables[v].next = counters.new_variables
            counters.new_variables = v
    counters.failed = failed


@compiled
def sort_by_age(memory: Address, members: IntArray) -> None:
    """Sort variables in place, oldest stamp first, then in the order of creation (D. Shell's method, 1959)."""
    state = opened(memory)
    variables, count = state.variables, len(members)
    gap = 1
    while gap < count // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, count):
            v, k = members[i], i
            while k >= gap:
                other = members[k - gap]
                a, b = variables[other], variables[v]
                if not (a.stamp > b.stamp or (a.stamp == b.stamp and a.sequence > b.sequence)):
                    break
                members[k] = other
                k -= gap
            members[k] = v
        gap //= 3


@compiled
def paths(memory: Address, chosen: IntArray) -> tuple[IntArray, int]:
    """First row of each clique between some variables and their roots in a stack of their pivots, or -1; its height."""
    state = opened(memory)
    cliques, offset, rows = state.cliques, filled(state.counters[0].clique_end, -1), 0
    for k in range(len(chosen)):
        c = state.variables[chosen[k]].clique
        while c >= 0 and offset[c] < 0:
            offset[c] = rows
            for q in range(cliques[c].list, cliques[c].list + cliques[c].pivots):
                rows += state.variables[state.lists[q]].dim
            c = cliques[c].parent
    return offset, rows
