"""Memory for linearisations, used again once nobody looks at it.

A large linearisation is megabytes of fresh pages, and the system takes longer to hand them out than the compiled pass
takes to fill them. The last few sets of arrays are kept; a set to which nothing else refers any more is used again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np

from unifg.typing import Array

LARGE = 50_000  # numbers; smaller arrays come from memory that the process already has
SETS = 4


class Buffers:
    """Arrays of fixed sizes, handed out in sets."""

    def __init__(self, sizes: Sequence[int]) -> None:
        """Remember the sizes."""
        self._sizes = tuple(sizes)
        self._kept: list[list[Array]] = []
        self._large = sum(sizes) >= LARGE

    def take(self) -> list[Array]:
        """A set of arrays with arbitrary contents that belong to the caller for as long as it refers to them."""
        if not self._large:
            return [np.empty(size) for size in self._sizes]
        for arrays in self._kept:
            # One reference from the list and one from the call: everybody else has let go.
            if all(sys.getrefcount(arrays[k]) == 2 for k in range(len(arrays))):
                return list(arrays)
        fresh = [np.empty(size) for size in self._sizes]
        self._kept = [*self._kept, fresh][-SETS:]
        return list(fresh)

    def __reduce__(self) -> tuple[type[Buffers], tuple[tuple[int, ...]]]:
        """Pickle the sizes alone."""
        return Buffers, (self._sizes,)


class Block:
    """Arrays that stand side by side in memory, so that one copy is a copy of all.

    Attributes:
        arrays: of the sizes asked for, all zero at first.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        """Make room."""
        ends = list(accumulate(sizes, initial=0))
        self._parts = [slice(*part) for part in pairwise(ends)]
        self._flat = np.zeros(ends[-1])
        self.arrays = [self._flat[part] for part in self._parts]

    def copied(self) -> list[Array]:
        """Copies of the arrays."""
        flat = self._flat.copy()
        return [flat[part] for part in self._parts]
