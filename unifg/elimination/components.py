"""Connected parts of a graph of pairs."""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import IntArray

__all__ = ["components"]


@compiled
def components(count: int, first: IntArray, second: IntArray) -> IntArray:
    """(count,) number of the part of every node, counted in the order of their first nodes.

    Args:
        count: of nodes.
        first: (m,) ends of pairs.
        second: (m,) their other ends.
    """
    above = np.arange(count)  # a node of the same part with a smaller number; the first node of a part is its own
    for k in range(len(first)):
        a, b = first[k], second[k]
        while above[a] != a:
            above[a] = above[above[a]]
            a = above[a]
        while above[b] != b:
            above[b] = above[above[b]]
            b = above[b]
        above[max(a, b)] = min(a, b)
    parts = 0
    for node in range(count):
        if above[node] == node:
            above[node] = parts
            parts += 1
        else:
            above[node] = above[above[node]]  # which has its number already
    return above
