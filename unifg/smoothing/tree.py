"""The tree of cliques: which of them a change touches, and what taking them out leaves behind."""

from __future__ import annotations

import numpy as np

from unifg.elimination.ordering import filled
from unifg.machine.jit import compiled
from unifg.smoothing.fields import (
    ALIVE,
    CANDIDATE,
    CANDIDATES,
    CHILD,
    CLIQUE,
    CLIQUE_END,
    CLIQUE_FREE,
    COUNT,
    DIM,
    FAILED,
    FILLED,
    FRONT,
    FROZEN,
    LINEAR,
    LINK,
    LIST,
    LOCAL,
    MARK,
    MARKED,
    NEW_VARIABLES,
    NEXT,
    NEXT_CANDIDATE,
    NEXT_CLIQUE,
    PARENT,
    PIVOTS,
    PRIOR,
    PRIORS,
    SEQUENCE,
    SIBLING,
    SIZE,
    SLOTS,
    SLOTS_MAX,
    STALE,
    STATE,
    STORAGE,
    TYPE,
    VALUE,
    VARIABLE_END,
    VARIABLES,
    State,
)
from unifg.smoothing.memory import give_list, give_numbers, length_of_front
from unifg.smoothing.priors import relinearize
from unifg.typing import Array, IntArray


@compiled
def mark_path(state: State, c: int, update: int, chain: int) -> int:
    """Put the cliques from one to its root into the chain of those to dissolve."""
    cliques = state.cliques
    while c >= 0 and cliques[c, MARKED] != update:
        cliques[c, MARKED] = update
        cliques[c, NEXT_CLIQUE] = chain
        chain = c
        c = cliques[c, PARENT]
    return chain


@compiled
def mark_factor(state: State, f: int, update: int, chain: int) -> int:
    """Put the cliques between the variables of a factor and their roots into the chain of those to dissolve."""
    lists, variables, factor = state.lists, state.variables, state.factors[f]
    for s in range(state.types[factor[TYPE], SLOTS]):
        chain = mark_path(state, variables[lists[factor[VARIABLES] + s], CLIQUE], update, chain)
    return chain


@compiled
def move_points(state: State, limit: float, update: int, chain: int, scratch: Array) -> tuple[int, int]:
    """Relinearise variables with a step beyond the limit; returns the chain of cliques to dissolve, and how many."""
    variables, factors, numbers, counters = state.variables, state.factors, state.numbers, state.counters
    lists, types, cliques = state.lists, state.types, state.cliques
    v, count = counters[CANDIDATES], 0
    counters[CANDIDATES] = -1
    while v >= 0:
        largest, step = 0.0, variables[v, VALUE] + variables[v, STORAGE]
        for d in range(variables[v, DIM]):
            largest = max(largest, abs(numbers[step + d]))
        variables[v, CANDIDATE] = 0
        if largest > limit:
            count += 1
            relinearize(state, v, scratch)
            c = counters[PRIORS] if variables[v, FROZEN] == 2 else -1
            while c >= 0:
                chain = mark_path(state, cliques[c, PARENT], update, chain)
                c = cliques[c, NEXT_CLIQUE]
            link = variables[v, LINK]
            while link >= 0:
                f = link // SLOTS_MAX
                if factors[f, STATE] == LINEAR:
                    factors[f, STATE] = STALE
                    chain = mark_factor(state, f, update, chain)
                link = lists[factors[f, VARIABLES] + types[factors[f, TYPE], SLOTS] + link % SLOTS_MAX]
        v = variables[v, NEXT_CANDIDATE]
    return chain, count


@compiled
def release(state: State, c: int) -> None:
    """Give back the memory of a clique."""
    clique = state.cliques[c]
    give_list(state, clique[COUNT], clique[LIST])
    give_numbers(state, length_of_front(clique[SIZE]), clique[FRONT])
    clique[FILLED] = 0
    clique[MARKED] = 0
    clique[NEXT_CLIQUE] = state.counters[CLIQUE_FREE]
    state.counters[CLIQUE_FREE] = c


@compiled
def dissolve(state: State, chain: int, update: int) -> tuple[IntArray, IntArray]:
    """Take a chain of cliques out of the tree.

    Returns:
        The variables to eliminate, new ones included and numbered in their LOCAL field, and the cliques that have
        lost their parent.
    """
    variables, cliques, lists, counters = state.variables, state.cliques, state.lists, state.counters
    rebuild = counters[FAILED] >= 0  # nothing but priors is left
    count, orphans, c = 0, 0, chain
    while c >= 0:
        count += cliques[c, PIVOTS]
        child = cliques[c, CHILD]
        while child >= 0:
            if cliques[child, MARKED] != update:
                orphans += 1
            child = cliques[child, SIBLING]
        c = cliques[c, NEXT_CLIQUE]
    v = counters[NEW_VARIABLES]
    while v >= 0:
        count += 1
        v = variables[v, NEXT]
    if rebuild:
        for c in range(counters[CLIQUE_END]):
            orphans += cliques[c, FILLED]
    members, lost = np.empty(count, np.int64), np.empty(orphans, np.int64)
    count, orphans, c = 0, 0, chain
    while c >= 0:
        following = cliques[c, NEXT_CLIQUE]
        for k in range(cliques[c, LIST], cliques[c, LIST] + cliques[c, PIVOTS]):
            members[count] = lists[k]
            count += 1
        child = cliques[c, CHILD]
        while child >= 0:
            if cliques[child, MARKED] != update:
                lost[orphans] = child
                orphans += 1
            child = cliques[child, SIBLING]
        c = following
    c = chain  # only now: a released clique no longer says that it was marked
    while c >= 0:
        following = cliques[c, NEXT_CLIQUE]
        release(state, c)
        c = following
    if rebuild:
        for c in range(counters[CLIQUE_END]):
            if cliques[c, FILLED]:
                lost[orphans] = c
                orphans += 1
        counters[FAILED] = -1
    v = counters[NEW_VARIABLES]
    counters[NEW_VARIABLES] = -1
    while v >= 0:
        members[count] = v
        count += 1
        v = variables[v, NEXT]
    for i in range(count):
        variables[members[i], CLIQUE] = -1
        variables[members[i], MARK] = update
        variables[members[i], LOCAL] = i
    return members, lost


@compiled
def give_up(state: State, failed: int) -> None:
    """After a vanished pivot: keep nothing but factors and priors; the next update eliminates everything anew."""
    variables, cliques, counters = state.variables, state.cliques, state.counters
    for c in range(counters[CLIQUE_END]):
        if cliques[c, FILLED] and cliques[c, PRIOR] == 0:
            release(state, c)
        elif cliques[c, FILLED]:
            cliques[c, PARENT] = -1
            cliques[c, SIBLING] = -1
    counters[NEW_VARIABLES] = -1
    for v in range(counters[VARIABLE_END] - 1, -1, -1):
        if variables[v, ALIVE]:
            variables[v, CLIQUE] = -1
            variables[v, NEXT] = counters[NEW_VARIABLES]
            counters[NEW_VARIABLES] = v
    counters[FAILED] = failed


@compiled
def sort_by_age(state: State, members: IntArray) -> None:
    """Sort variables in place, oldest stamp first, then in the order of creation (D. Shell's method, 1959)."""
    stamps, variables, count = state.stamps, state.variables, len(members)
    gap = 1
    while gap < count // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, count):
            v, k = members[i], i
            while k >= gap:
                other = members[k - gap]
                later = stamps[other] > stamps[v]
                if not (later or (stamps[other] == stamps[v] and variables[other, SEQUENCE] > variables[v, SEQUENCE])):
                    break
                members[k] = other
                k -= gap
            members[k] = v
        gap //= 3


@compiled
def paths(state: State, chosen: IntArray) -> tuple[IntArray, int]:
    """First row of each clique between some variables and their roots in a stack of their pivots, or -1; its height."""
    cliques, offset, rows = state.cliques, filled(state.counters[CLIQUE_END], -1), 0
    for k in range(len(chosen)):
        c = state.variables[chosen[k], CLIQUE]
        while c >= 0 and offset[c] < 0:
            offset[c] = rows
            for q in range(cliques[c, LIST], cliques[c, LIST] + cliques[c, PIVOTS]):
                rows += state.variables[state.lists[q], DIM]
            c = cliques[c, PARENT]
    return offset, rows
