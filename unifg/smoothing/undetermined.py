"""Causes of a vanished pivot of a smoother: too few factors, numbers that are none, or lose what enough of them say."""

from __future__ import annotations

import numpy as np

from unifg.elimination.components import components
from unifg.smoothing.state import State
from unifg.typing import Array, IntArray, Records

NOBODY: IntArray = np.zeros(0, dtype=np.int64)


def enough(state: State, variable: int) -> bool:
    """Test whether as many rows as unknowns, one of them from a single variable, touch all neighbours of a variable.

    That does not prove that they determine it, but where it does not hold they cannot. A factor has no more rows than
    columns that are not zero, as one without information.

    Args:
        state: of the smoother.
        variable: whose pivot has vanished.
    """
    variables, count = state.variables, int(state.counters[0]["variable_end"])
    touched, rows, single = list[IntArray](), list[int](), list[bool]()
    for factor in state.factors[state.factors["used"] == 1]:
        kind, at = state.types[factor["type"]], factor["variables"]
        touched.append(state.lists[at : at + kind["slots"]])
        rows.append(min(kind["rows"], np.count_nonzero(_diagonal(state, factor, kind))))
        single.append(kind["slots"] == 1)
    for clique in state.cliques[state.cliques["prior"] == 1]:
        at = clique["list"]
        touched.append(state.lists[at + clique["pivots"] : at + clique["count"]])
        rows.append(clique["size"] - clique["pivot_rows"])
        single.append(True)  # a prior speaks of where its variables are
    numbers = np.repeat(np.arange(len(touched)), [len(part) for part in touched])
    label = components(count + len(touched), count + numbers, np.concatenate([NOBODY, *touched]))
    component = label[variable]
    alive = variables["alive"][:count].astype(bool) & (label[:count] == component)
    spoken = label[count:] == component
    unknowns = int(variables["dim"][:count][alive].sum())
    return bool(np.array(rows)[spoken].sum() >= unknowns and np.array(single)[spoken].any())


def sloped(state: State) -> bool:
    """Test whether the Jacobians of all factors are finite, by the diagonals of J'J that they keep."""
    used = state.factors[state.factors["used"] == 1]
    return all(np.isfinite(_diagonal(state, factor, state.types[factor["type"]])).all() for factor in used)


def _diagonal(state: State, factor: Records, kind: Records) -> Array:
    """Diagonal (width,) of J'J of a factor; one column more stands beside it."""
    at, width = int(factor["data"] + kind["numbers"]), int(kind["width"])
    found: Array = state.numbers[at : at + width * (width + 2) : width + 2]
    return found
