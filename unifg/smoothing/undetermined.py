"""Causes of a vanished pivot of a smoother: too few factors, or numbers that lose what enough of them say."""

from __future__ import annotations

import numpy as np

from unifg.elimination.components import components
from unifg.smoothing.state import State
from unifg.typing import IntArray


def enough(state: State, variable: int) -> bool:
    """Test whether as many rows as unknowns, one of them from a single variable, touch all neighbours of a variable.

    That does not prove that they determine it, but where it does not hold they cannot.

    Args:
        state: of the smoother.
        variable: whose pivot has vanished.
    """
    counters, variables = state.counters[0], state.variables
    count = int(counters["variable_end"])
    ties, rows, single = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=bool)]
    total = 0
    factors = np.flatnonzero(state.factors["used"][: int(counters["factor_end"])])
    for kind in np.unique(state.factors["type"][factors]).tolist():
        own = factors[state.factors["type"][factors] == kind]
        slots = int(state.types["slots"][kind])
        total = _tie(ties, total, [state.lists[at : at + slots] for at in state.factors["variables"][own].tolist()])
        rows.append(np.full(len(own), int(state.types["rows"][kind])))
        single.append(np.full(len(own), slots == 1))
    cliques = state.cliques[: int(counters["clique_end"])]
    priors = np.flatnonzero(cliques["prior"] == 1)
    places = zip(*(cliques[name][priors].tolist() for name in ("list", "pivots", "count")), strict=True)
    total = _tie(ties, total, [state.lists[at + gone : at + n] for at, gone, n in places])
    rows.append((cliques["size"] - cliques["pivot_rows"])[priors].astype(np.int64))
    single.append(np.ones(len(priors), dtype=bool))  # a prior speaks of where its variables are
    pairs = np.concatenate(ties)
    label = components(count + total, pairs[:, 0] + count, np.ascontiguousarray(pairs[:, 1]))
    component = label[variable]
    alive = variables["alive"][:count].astype(bool) & (label[:count] == component)
    spoken = label[count:] == component
    unknowns = int(variables["dim"][:count][alive].sum())
    return bool(np.concatenate(rows)[spoken].sum() >= unknowns and np.concatenate(single)[spoken].any())


def _tie(ties: list[IntArray], begin: int, members: list[IntArray]) -> int:
    """Note which variables each of many things ties, which are numbered from ``begin``; returns the next number."""
    if members:
        numbers = np.repeat(begin + np.arange(len(members)), [len(part) for part in members])
        ties.append(np.column_stack([numbers, np.concatenate(members)]))
    return begin + len(members)
