"""Moving all variables of a graph by one tangent step, in one compiled call."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from unifg.codegen.jit import compiled
from unifg.lie.retraction import move_of, move_point
from unifg.modeling.terms import Fix
from unifg.problem.columns import Columns, Values
from unifg.typing import Array, IntArray


class Retraction:
    """x [+] d for every variable; fixed ones take their values.

    Attributes:
        parts: one row per component of a family, for :func:`retract_parts`.
        fixed, fixed_values: stored numbers that do not move, and what they are.
        places: of the values of each fix among ``fixed_values``.
    """

    def __init__(self, columns: Columns, fixes: Sequence[Fix]) -> None:
        """Lay out the parts of every family."""
        self._columns = columns
        self._python = []
        self._kept = []  # addresses are good for as long as the functions live
        parts = []
        for family in columns.families:
            moves = [move_of(leaf) for leaf, _, _ in columns.leaves[family]]
            if None in moves:
                self._python.append(family)
                continue
            self._kept.append(moves)
            for (leaf, storage, tangent), found in zip(columns.leaves[family], moves, strict=True):
                assert found is not None
                parts.append(
                    [
                        found.where,
                        family.count,
                        columns.storage[family] + storage,
                        family.manifold.storage,
                        leaf.storage,
                        columns.offsets[family] + tangent,
                        family.manifold.dim,
                        leaf.dim,
                    ]
                )
        self.parts = np.array(parts, dtype=np.int64).reshape(-1, 8)
        places = [columns.starts(fix.selection)[:, None] + np.arange(fix.selection.manifold.storage) for fix in fixes]
        self.fixed: IntArray = np.concatenate([np.zeros(0, dtype=np.int64), *(place.ravel() for place in places)])
        self.fixed_values = np.zeros(len(self.fixed))
        ends = np.cumsum([0, *(place.size for place in places)]).tolist()
        self.places = [
            np.arange(first, last).reshape(place.shape)
            for (first, last), place in zip(pairwise(ends), places, strict=True)
        ]

    @property
    def compiled(self) -> bool:
        """True if every family has a compiled retraction."""
        return not self._python

    def fix(self, values: Values) -> None:
        """Write the values of fixed variables."""
        values.flat[self.fixed] = self.fixed_values

    def __call__(self, values: Values, step: Array) -> Values:
        """Move the unknowns by a tangent step."""
        columns = self._columns
        full = np.zeros(columns.width)
        moved = Values(columns, values.flat.copy())
        retract_parts(self.parts, columns.free, np.ascontiguousarray(step), full, values.flat, moved.flat)
        for family in self._python:
            offset, dim = columns.offsets[family], family.manifold.dim
            part = full[offset : offset + family.count * dim].reshape(family.count, dim)
            moved[family][:] = family.manifold.retract(values[family], part)
        self.fix(moved)  # retractions wrap and renormalise; a fixed value stays as given
        return moved


@compiled
def retract_parts(parts: IntArray, free: IntArray, step: Array, full: Array, values: Array, moved: Array) -> None:
    """Spread the step over the tangent space and move every part."""
    for k in range(len(free)):
        full[free[k]] = step[k]
    for p in range(len(parts)):
        where, count, storage, stride, size, tangent, hop, dim = parts[p]
        for i in range(count):
            x, d = storage + i * stride, tangent + i * hop
            move_point(where, values, x, size, full, d, dim, moved, x)
