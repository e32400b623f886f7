"""Dropping variables: what the oldest passed on stays as a prior, a clique without pivots.

In chronological order the oldest variable is a leaf of the tree, and its update matrix *is* the marginal of
everything it knew: nothing has to be computed.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address
from unifg.elimination.ordering import filled
from unifg.smoothing.cliques import add_child
from unifg.smoothing.linear import length_of
from unifg.smoothing.memory import give_list, give_numbers
from unifg.smoothing.state import SLOTS_MAX, opened
from unifg.smoothing.tree import release, sort_by_age
from unifg.typing import IntArray


@compiled
def marginalize(memory: Address, until: float, frozen: int) -> IntArray:
    """Drop all variables with a stamp of at most ``until``; returns their rows, which are free now.

    What their priors touch is marked ``frozen``: 1 keeps its linearisation point, 2 lets it move.
    """
    state = opened(memory)
    variables, counters, count = state.variables, state.counters[0], 0
    leaving = np.empty(counters.variable_end, np.int64)
    for v in range(counters.variable_end):
        if variables[v].alive and variables[v].clique >= 0 and variables[v].stamp <= until:
            leaving[count] = v
            count += 1
    leaving = leaving[:count]
    if count == 0:
        return leaving
    v, kept = counters.candidates, -1
    while v >= 0:
        following = variables[v].next_candidate
        if variables[v].stamp > until:
            variables[v].next_candidate = kept
            kept = v
        v = following
    counters.candidates = kept
    sort_by_age(memory, leaving)
    for k in range(count):
        _drop(memory, leaving[k], frozen)
    counters.marginalized = count
    return leaving


@compiled
def _drop(memory: Address, v: int, frozen: int) -> None:
    """Turn the clique of the oldest variable into a prior, and forget the variable with its factors."""
    state = opened(memory)
    variables, factors, types, lists = state.variables, state.factors, state.types, state.lists
    cliques, counters = state.cliques, state.counters[0]
    c = variables[v].clique
    clique = cliques[c]
    child = clique.child
    while child >= 0:  # priors, and part of this one
        following = cliques[child].sibling
        release(memory, child)
        child = following
    clique.child, clique.prior = -1, 1
    for q in range(clique.list + clique.pivots, clique.list + clique.count):
        variables[lists[q]].frozen = frozen
    link = variables[v].link
    while link >= 0:
        f, slot = link // SLOTS_MAX, link % SLOTS_MAX
        kind, at = types[factors[f].type], factors[f].variables
        slots = kind.slots
        link = lists[at + slots + slot]
        if factors[f].used == 0:
            continue  # gone already: the variable occurs in it twice
        for s in range(slots):
            w = lists[at + s]
            if w != v:
                _unlink(memory, w, f * SLOTS_MAX + s)
        give_numbers(memory, length_of(kind), factors[f].data)
        give_list(memory, 2 * slots, at)
        factors[f].used = 0
        factors[f].next = counters.factor_free
        counters.factor_free = f
    if clique.count == clique.pivots:
        release(memory, c)
    else:
        _unite(memory, c)
    give_numbers(memory, variables[v].length, variables[v].value)
    variables[v].alive, variables[v].clique = 0, -1
    variables[v].next = counters.variable_free
    counters.variable_free = v


@compiled
def _unlink(memory: Address, w: int, gone: int) -> None:
    """Take one link out of the chain of a variable, if it is still there."""
    state = opened(memory)
    variables, factors, types, lists = state.variables, state.factors, state.types, state.lists
    link, before = variables[w].link, -1
    while link >= 0:
        f, slot = link // SLOTS_MAX, link % SLOTS_MAX
        where = factors[f].variables + types[factors[f].type].slots + slot
        if link == gone:
            if before < 0:
                variables[w].link = lists[where]
            else:
                lists[before] = lists[where]
            return
        before, link = where, lists[where]


@compiled
def _unite(memory: Address, c: int) -> None:
    """Add a new prior to one beside it that knows all its variables, or to it those whose variables it knows."""
    state = opened(memory)
    cliques = state.cliques
    parent, other = cliques[c].parent, cliques[cliques[c].parent].child
    while other >= 0:
        following = cliques[other].sibling
        if other != c and cliques[other].prior:
            if _covers(memory, other, c):
                _merge(memory, c, other, parent)
                return
            if _covers(memory, c, other):
                _merge(memory, other, c, parent)
        other = following


@compiled
def _covers(memory: Address, a: int, b: int) -> bool:
    """Test whether all variables of the separator of b are in that of a."""
    state = opened(memory)
    cliques, lists = state.cliques, state.lists
    for q in range(cliques[b].list + cliques[b].pivots, cliques[b].list + cliques[b].count):
        found = False
        for p in range(cliques[a].list + cliques[a].pivots, cliques[a].list + cliques[a].count):
            found = found or lists[p] == lists[q]
        if not found:
            return False
    return True


@compiled
def _merge(memory: Address, source: int, target: int, parent: int) -> None:
    """Add a prior to another one with the same parent and release it."""
    state = opened(memory)
    cliques, variables, lists = state.cliques, state.variables, state.lists
    count = cliques[target].count
    place, row = filled(count, 0), cliques[target].pivot_rows
    for k in range(cliques[target].pivots, count):
        v = lists[cliques[target].list + k]
        variables[v].local, place[k] = k, row
        row += variables[v].dim
    size = cliques[source].size + 8
    add_child(memory, cliques[source], place, cliques[target], filled(size, 0), filled(size, 0))
    if cliques[parent].child == source:
        cliques[parent].child = cliques[source].sibling
    else:
        before = cliques[parent].child
        while cliques[before].sibling != source:
            before = cliques[before].sibling
        cliques[before].sibling = cliques[source].sibling
    release(memory, source)
