"""Columns: storage and tangent coordinates of each variable, and which of them are unknown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from operator import is_

import numpy as np

from unifg.errors import GraphError
from unifg.factors.steps import OTHER, TURN, parts_of
from unifg.lie.product import leaves
from unifg.modeling.terms import Fix
from unifg.modeling.variables import Family, Selection
from unifg.typing import Array, IntArray


class Values(dict[Family, Array]):
    """(count, storage) arrays by family, all of them views of one flat array.

    Attributes:
        columns: the numbering that says where each family stands.
        flat: the storage of all families in their order.
    """

    def __init__(self, columns: Columns, flat: Array) -> None:
        """View ``flat`` by families."""
        self.columns = columns
        self.flat = flat
        for family, part, shape in columns.parts:
            self[family] = flat[part].reshape(shape)
        self._views = tuple(self.values())

    @property
    def intact(self) -> bool:
        """True if ``flat`` still says it all: nobody has put another array in the place of a family's."""
        return len(self) == len(self._views) and all(map(is_, self.values(), self._views))

    def __reduce__(self) -> tuple[type[Values], tuple[Columns, Array]]:
        """Pickle the flat array: views of it would become arrays of their own."""
        return Values, (self.columns, self.columns.values(self).flat)


class Columns:
    """Numbering of the full tangent space and of the unknowns within it.

    Attributes:
        leaves: components of each family's manifold, and where each begins in storage and tangent.
        storage: where each family's storage starts.
        parts: each family with its slice of the stored values and their shape (count, storage).
        stored: length of the storage of all families.
        offsets: first column of each family.
        width: number of columns, fixed variables included.
        dimensions: number of coordinates of all families.
        size: number of unknown ones.
        free: (size,) columns that are unknown.
        unknown: (width,) number of each column among the unknowns, -1 where fixed.
        fixed: (n, d) columns of each fix, by its name.
    """

    def __init__(self, families: Sequence[Family], fixes: Sequence[Fix]) -> None:
        """Number the families in the order given, members in theirs."""
        self.families = list(families)
        self.leaves = {family: list(leaves(family.manifold)) for family in families}
        self.offsets: dict[Family, int] = {}
        self.storage: dict[Family, int] = {}
        self.width = self.stored = 0
        for family in families:
            self.offsets[family], self.storage[family] = self.width, self.stored
            self.width += family.count * family.manifold.dim
            self.stored += family.count * family.manifold.storage
        self.dimensions = sum(family.manifold.dim for family in families)
        self._places = {family: self._place(family) for family in families}
        self.parts = [(family, *place) for family, place in self._places.items()]
        is_free = np.ones(self.width, dtype=bool)
        self.fixed: dict[str, IntArray] = {}
        for fix in fixes:
            self.fixed[fix.name] = self.of(fix.selection)
            is_free[self.fixed[fix.name]] = False
        self.free = np.flatnonzero(is_free)
        self.size = len(self.free)
        self.unknown = np.full(self.width, -1, dtype=np.intp)
        self.unknown[self.free] = np.arange(len(self.free))

    def of(self, selection: Selection) -> IntArray:
        """(n, d) columns of a selection."""
        family = selection.family
        base = self.offsets[family] + selection.indices * family.manifold.dim
        return base[:, None] + np.arange(selection.tangent.start, selection.tangent.stop)

    def starts(self, selection: Selection) -> IntArray:
        """(n,) where the storage of each selected member, or of its selected component, starts."""
        family = selection.family
        first = self.storage[family] + selection.storage.start
        return first + selection.indices * family.manifold.storage

    def values(self, parts: Mapping[Family, Array]) -> Values:
        """One array per family as views of one flat array; values that are such already stay as they are."""
        if isinstance(parts, Values) and parts.intact:
            return parts
        flat = np.empty(self.stored)
        values = Values(self, flat)
        for family in self.families:
            values[family][:] = parts[family]
        return values

    def view(self, flat: Array) -> Values:
        """The families' storage as one array, by families."""
        return Values(self, flat)

    @cached_property
    def coordinates(self) -> IntArray:
        """(width,) number of the coordinate of a family that each column belongs to."""
        each, first = [np.zeros(0, dtype=np.int64)], 0
        for family in self.families:
            each.append(first + np.tile(np.arange(family.manifold.dim), family.count))
            first += family.manifold.dim
        return np.concatenate(each)

    @cached_property
    def extents(self) -> tuple[IntArray, IntArray, IntArray]:
        """For every tangent coordinate, found once, what the numbers are whose largest is its size.

        First and last (exclusive) place in storage, and the kind of part in :mod:`unifg.factors.steps`. All axes of a
        position that turns share its numbers; quaternions have none.
        """
        first, last, kinds = (np.zeros(self.width, dtype=np.int64) for _ in range(3))
        for family in self.families:
            members = np.arange(family.count)
            for part, _ in parts_of(family.manifold):
                shared = part.turn >= 0 or part.kind == OTHER
                start = self.storage[family] + members * family.manifold.storage + part.start
                for axis in range(part.dim):
                    column = self.offsets[family] + members * family.manifold.dim + part.column + axis
                    kinds[column] = part.kind
                    if part.kind != TURN:
                        first[column] = start if shared else start + axis
                        last[column] = start + part.storage if shared else start + axis + 1
        return first, last, kinds

    def nodes(self) -> tuple[IntArray, IntArray]:
        """For every full column its variable, numbered over all families; and the first unknown of each variable.

        Returns:
            (width,) variables, and (V + 1,) where each variable's unknowns start.
        """
        sizes = np.concatenate([np.full(f.count, f.manifold.dim) for f in self.families])
        variable = np.repeat(np.arange(len(sizes)), sizes)
        free = np.bincount(variable[self.free], minlength=len(sizes))
        return variable, np.concatenate([[0], np.cumsum(free)])

    def place(self, family: Family) -> tuple[slice, tuple[int, int]]:
        """Place of a family among the stored values, and its shape (count, storage)."""
        return self._places[family]

    def _place(self, family: Family) -> tuple[slice, tuple[int, int]]:
        first, shape = self.storage[family], (family.count, family.manifold.storage)
        return slice(first, first + shape[0] * shape[1]), shape

    def all_fixed(self, family: Family) -> bool:
        """Test whether nothing of the family is unknown."""
        offset = self.offsets[family]
        return bool((self.unknown[offset : offset + family.count * family.manifold.dim] < 0).all())

    def name(self, column: int) -> tuple[str, int]:
        """Family and member of a column."""
        for family in reversed(self.families):
            if column >= self.offsets[family]:
                return family.name, (column - self.offsets[family]) // family.manifold.dim
        raise GraphError(f"column {column} belongs to no family", index=column)
