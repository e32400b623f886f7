"""Families of unknowns that grow while a robot drives."""

from __future__ import annotations

import numpy as np

from unifg.errors import GraphError
from unifg.lie import Manifold, Rn
from unifg.modeling.variables import Family, Index, Selection
from unifg.typing import IntArray


class GrowingFamily(Family):
    """An array of unknowns without an end; made by ``variables`` of a smoother.

    Members from ``count`` on may be named by their number before they have a value. Slices and negative numbers mean
    the members that have one.

    Attributes:
        number: of the family within its smoother.
        parts: first part of its manifold in the state of its smoother, and how many it has.
        keep: whether a fixed lag leaves its members alone.
    """

    def __init__(self, name: str, manifold: Manifold, number: int, parts: tuple[int, int], keep: bool) -> None:
        """Start without members."""
        super().__init__(name, manifold, 0)
        self.number = number
        self.parts = parts
        self.keep = keep
        self.finite = isinstance(manifold, Rn) or manifold.name in ("SO2", "SE2")  # any finite numbers are a point
        self._rows = np.full(64, -1, dtype=np.int64)
        self._base = 0  # the member that the first of these rows speaks of

    def __getitem__(self, index: Index) -> Selection:
        """Select members; numbers beyond the last are members to come."""
        if type(index) is int:  # the common case, and NumPy is slow at it
            return Selection(self, np.array([self._counted(index)]))
        if isinstance(index, slice):
            return Selection(self, np.arange(self.count)[index])
        indices = np.atleast_1d(np.asarray(index))
        if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "iu"):
            raise GraphError(
                f"family '{self.name}': a selection takes integers or a slice, found {index!r}", family=self.name
            )
        indices = indices.astype(np.intp)
        if (indices < 0).any():
            indices = np.array([self._counted(int(i)) for i in indices], dtype=np.intp)
        return Selection(self, indices)

    def grow(self, rows: IntArray) -> None:
        """Append members that stand in these rows of the smoother."""
        used, count = self.count - self._base, len(rows)
        if used + count > len(self._rows):
            alive = np.flatnonzero(self._rows[:used] >= 0)
            first = int(alive[0]) if len(alive) else used  # the members before it are gone for good
            longer = np.full(2 * (used - first + count) + 64, -1, dtype=np.int64)
            longer[: used - first] = self._rows[first:used]
            self._rows, self._base, used = longer, self._base + first, used - first
        self._rows[used : used + count] = rows
        self.count += count

    def forget(self, member: int) -> None:
        """A member was marginalised."""
        self._rows[member - self._base] = -1

    def alive(self) -> IntArray:
        """Members that have a value and were not marginalised."""
        return np.flatnonzero(self._rows[: self.count - self._base] >= 0) + self._base

    def row(self, member: int) -> int:
        """Row of one member of the smoother; -1: marginalised, -2: no value yet."""
        if member >= self.count:
            return -2
        return int(self._rows[member - self._base]) if member >= self._base else -1

    def lowest(self, members: IntArray) -> int:
        """Lowest of the rows of some members; quick for one."""
        return self.row(int(members[0])) if len(members) == 1 else int(self.rows(members).min())

    def rows(self, members: IntArray) -> IntArray:
        """The same of many members."""
        if len(members) == 1:
            return np.array([self.row(int(members[0]))])
        places = members - self._base
        found = self._rows[np.clip(places, 0, len(self._rows) - 1)]
        return np.where(members >= self.count, -2, np.where(places < 0, -1, found))

    def _counted(self, member: int) -> int:
        """A member, counted from the end where negative."""
        if member >= 0:
            return member
        if member + self.count < 0:
            raise GraphError(
                f"family '{self.name}' has {self.count} members so far, and no member {member}", family=self.name
            )
        return member + self.count
