"""Dropping variables: what the oldest passed on stays as a prior, a clique without pivots.

In chronological order the oldest variable is a leaf of the tree, and its update matrix *is* the marginal of
everything it knew: nothing has to be computed.
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.ordering import filled
from unifg.machine.jit import compiled
from unifg.smoothing.cliques import add_child
from unifg.smoothing.fields import (
    ALIVE,
    CANDIDATES,
    CHILD,
    CLIQUE,
    COUNT,
    DATA,
    DIM,
    FACTOR_FREE,
    FROZEN,
    LINK,
    LIST,
    LOCAL,
    MADE_MARGINALIZED,
    NEXT,
    NEXT_CANDIDATE,
    NEXT_CLIQUE,
    NEXT_FACTOR,
    PARENT,
    PIVOT_ROWS,
    PIVOTS,
    PRIOR,
    PRIORS,
    SIBLING,
    SIZE,
    SLOTS,
    SLOTS_MAX,
    STORAGE,
    TYPE,
    USED,
    VALUE,
    VARIABLE_END,
    VARIABLE_FREE,
    VARIABLES,
    State,
)
from unifg.smoothing.linear import length_of
from unifg.smoothing.memory import give_list, give_numbers
from unifg.smoothing.tree import release, sort_by_age
from unifg.typing import IntArray


@compiled
def marginalize(state: State, until: float, frozen: int) -> IntArray:
    """Drop all variables with a stamp of at most ``until``; returns their rows, which are free now.

    What their priors touch is marked ``frozen``: 1 keeps its linearisation point, 2 lets it move.
    """
    variables, stamps, counters = state.variables, state.stamps, state.counters
    count = 0
    for v in range(counters[VARIABLE_END]):
        if variables[v, ALIVE] and variables[v, CLIQUE] >= 0 and stamps[v] <= until:
            count += 1
    leaving = np.empty(count, np.int64)
    if count == 0:
        return leaving
    count = 0
    for v in range(counters[VARIABLE_END]):
        if variables[v, ALIVE] and variables[v, CLIQUE] >= 0 and stamps[v] <= until:
            leaving[count] = v
            count += 1
    v, kept = counters[CANDIDATES], -1
    while v >= 0:
        following = variables[v, NEXT_CANDIDATE]
        if stamps[v] > until:
            variables[v, NEXT_CANDIDATE] = kept
            kept = v
        v = following
    counters[CANDIDATES] = kept
    sort_by_age(state, leaving)
    for k in range(count):
        _drop(state, leaving[k], frozen)
    counters[MADE_MARGINALIZED] = count
    return leaving


@compiled
def _drop(state: State, v: int, frozen: int) -> None:
    """Turn the clique of the oldest variable into a prior, and forget the variable with its factors."""
    variables, factors, types, lists = state.variables, state.factors, state.types, state.lists
    cliques, counters = state.cliques, state.counters
    c = variables[v, CLIQUE]
    clique = cliques[c]
    child = clique[CHILD]
    while child >= 0:  # priors, and part of this one
        following = cliques[child, SIBLING]
        _discard(state, child)
        child = following
    clique[CHILD], clique[PRIOR] = -1, 1
    clique[NEXT_CLIQUE] = counters[PRIORS]
    counters[PRIORS] = c
    for q in range(clique[LIST] + clique[PIVOTS], clique[LIST] + clique[COUNT]):
        variables[lists[q], FROZEN] = frozen
    link = variables[v, LINK]
    while link >= 0:
        f, slot = link // SLOTS_MAX, link % SLOTS_MAX
        kind, at = types[factors[f, TYPE]], factors[f, VARIABLES]
        slots = kind[SLOTS]
        link = lists[at + slots + slot]
        for s in range(slots):
            w = lists[at + s]
            if w != v:
                _unlink(state, w, f * SLOTS_MAX + s)
        give_numbers(state, length_of(kind), factors[f, DATA])
        give_list(state, 2 * slots, at)
        factors[f, USED] = 0
        factors[f, NEXT_FACTOR] = counters[FACTOR_FREE]
        counters[FACTOR_FREE] = f
    if clique[COUNT] == clique[PIVOTS]:
        _discard(state, c)
    else:
        _unite(state, c)
    give_numbers(state, variables[v, STORAGE] + 3 * variables[v, DIM], variables[v, VALUE])
    variables[v, ALIVE], variables[v, CLIQUE] = 0, -1
    variables[v, NEXT] = counters[VARIABLE_FREE]
    counters[VARIABLE_FREE] = v


@compiled
def _unlink(state: State, w: int, gone: int) -> None:
    """Take one link out of the chain of a variable, if it is still there."""
    variables, factors, types, lists = state.variables, state.factors, state.types, state.lists
    link, before = variables[w, LINK], -1
    while link >= 0:
        f, slot = link // SLOTS_MAX, link % SLOTS_MAX
        where = factors[f, VARIABLES] + types[factors[f, TYPE], SLOTS] + slot
        if link == gone:
            if before < 0:
                variables[w, LINK] = lists[where]
            else:
                lists[before] = lists[where]
            return
        before, link = where, lists[where]


@compiled
def _unite(state: State, c: int) -> None:
    """Add a new prior to one beside it that knows all its variables, or to it those whose variables it knows."""
    cliques = state.cliques
    parent, other = cliques[c, PARENT], cliques[cliques[c, PARENT], CHILD]
    while other >= 0:
        following = cliques[other, SIBLING]
        if other != c and cliques[other, PRIOR]:
            if _covers(state, other, c):
                _merge(state, c, other, parent)
                return
            if _covers(state, c, other):
                _merge(state, other, c, parent)
        other = following


@compiled
def _covers(state: State, a: int, b: int) -> bool:
    """Whether all variables of the separator of b are in that of a."""
    cliques, lists = state.cliques, state.lists
    for q in range(cliques[b, LIST] + cliques[b, PIVOTS], cliques[b, LIST] + cliques[b, COUNT]):
        found = False
        for p in range(cliques[a, LIST] + cliques[a, PIVOTS], cliques[a, LIST] + cliques[a, COUNT]):
            found = found or lists[p] == lists[q]
        if not found:
            return False
    return True


@compiled
def _merge(state: State, source: int, target: int, parent: int) -> None:
    """Add a prior to another one with the same parent and release it."""
    cliques, variables, lists = state.cliques, state.variables, state.lists
    count = cliques[target, COUNT]
    place, row = filled(count, 0), cliques[target, PIVOT_ROWS]
    for k in range(cliques[target, PIVOTS], count):
        v = lists[cliques[target, LIST] + k]
        variables[v, LOCAL], place[k] = k, row
        row += variables[v, DIM]
    size = cliques[source, SIZE] + 8
    add_child(state, cliques[source], place, cliques[target], filled(size, 0), filled(size, 0))
    if cliques[parent, CHILD] == source:
        cliques[parent, CHILD] = cliques[source, SIBLING]
    else:
        before = cliques[parent, CHILD]
        while cliques[before, SIBLING] != source:
            before = cliques[before, SIBLING]
        cliques[before, SIBLING] = cliques[source, SIBLING]
    _discard(state, source)


@compiled
def _discard(state: State, c: int) -> None:
    """Release a prior."""
    cliques, counters = state.cliques, state.counters
    if counters[PRIORS] == c:
        counters[PRIORS] = cliques[c, NEXT_CLIQUE]
    else:
        before = counters[PRIORS]
        while cliques[before, NEXT_CLIQUE] != c:
            before = cliques[before, NEXT_CLIQUE]
        cliques[before, NEXT_CLIQUE] = cliques[c, NEXT_CLIQUE]
    release(state, c)
