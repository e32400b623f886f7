"""Which stored numbers say how large each tangent coordinate is."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from unifg.kernels.steps import OTHER, TURN, parts_of
from unifg.program.program import Program
from unifg.typing import IntArray

_KNOWN: WeakKeyDictionary[Program, tuple[IntArray, IntArray, IntArray]] = WeakKeyDictionary()


def extents(program: Program) -> tuple[IntArray, IntArray, IntArray]:
    """For every tangent coordinate of a graph, found once, what the numbers are whose largest is its size.

    Returns:
        First and last (exclusive) place in storage, and the kind of part in :mod:`unifg.kernels.steps`. All axes of a
        position that turns share its numbers; quaternions have none.
    """
    if program not in _KNOWN:
        columns = program.columns
        first, last, kinds = (np.zeros(columns.width, dtype=np.int64) for _ in range(3))
        for family in columns.families:
            members = np.arange(family.count)
            for part, _ in parts_of([family.manifold]):
                shared = part.turn >= 0 or part.kind == OTHER
                start = columns.storage[family] + members * family.manifold.storage + part.start
                for axis in range(part.dim):
                    column = columns.offsets[family] + members * family.manifold.dim + part.column + axis
                    kinds[column] = part.kind
                    if part.kind != TURN:
                        first[column] = start if shared else start + axis
                        last[column] = start + part.storage if shared else start + axis + 1
        _KNOWN[program] = first, last, kinds
    return _KNOWN[program]
