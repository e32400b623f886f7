"""Where each variable's tangent coordinates stand, and which of them are unknown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unifg.terms import Fix
from unifg.typing import IntArray
from unifg.variables import Family, Selection


class Columns:
    """Numbering of the full tangent space and of the unknowns within it.

    Attributes:
        offsets: first column of each family.
        width: number of columns, fixed variables included.
        free: (size,) columns that are unknown.
        unknown: (width,) number of each column among the unknowns, -1 where fixed.
        fixed: (n, d) columns of each fix, by its name.
    """

    def __init__(self, families: Sequence[Family], fixes: Sequence[Fix]) -> None:
        """Number the families in the order given, members in theirs."""
        self.families = list(families)
        self.offsets: dict[Family, int] = {}
        self.width = 0
        for family in families:
            self.offsets[family] = self.width
            self.width += family.count * family.manifold.dim
        is_free = np.ones(self.width, dtype=bool)
        self.fixed: dict[str, IntArray] = {}
        for fix in fixes:
            self.fixed[fix.name] = self.of(fix.selection)
            is_free[self.fixed[fix.name]] = False
        self.free = np.flatnonzero(is_free)
        self.unknown = np.full(self.width, -1, dtype=np.intp)
        self.unknown[self.free] = np.arange(len(self.free))

    @property
    def size(self) -> int:
        """Number of unknown coordinates."""
        return len(self.free)

    def of(self, selection: Selection) -> IntArray:
        """(n, d) columns of a selection."""
        family = selection.family
        base = self.offsets[family] + selection.indices * family.manifold.dim
        columns: IntArray = base[:, None] + np.arange(selection.tangent.start, selection.tangent.stop)
        return columns

    def all_fixed(self, family: Family) -> bool:
        """Whether nothing of the family is unknown."""
        offset = self.offsets[family]
        return bool((self.unknown[offset : offset + family.count * family.manifold.dim] < 0).all())

    def name(self, column: int) -> tuple[str, int]:
        """Family and member of a column."""
        for family in reversed(self.families):
            if column >= self.offsets[family]:
                return family.name, (column - self.offsets[family]) // family.manifold.dim
        raise IndexError(column)
