"""Memory for linearisations, used again once nobody looks at it.

A large linearisation is megabytes of fresh pages, and the system takes longer to hand them out than the compiled pass
takes to fill them. The last few sets of arrays are kept. Arrays are handed out as views of a lease: views of views
refer to it, too, so that the memory is free when the lease is gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from weakref import ReferenceType, ref

import numpy as np

from unifg.typing import Array

LARGE = 50_000  # numbers; smaller arrays come from memory that the process already has
LINE = 8  # numbers of a line of memory, at which arrays begin
SETS = 4


class Buffers:
    """Arrays of fixed sizes, handed out in sets."""

    def __init__(self, sizes: Sequence[int]) -> None:
        """Remember the sizes."""
        self._sizes = tuple(sizes)
        begins = list(accumulate((-(-size // LINE) * LINE for size in sizes), initial=0))
        self._parts = [slice(begin, begin + size) for begin, size in zip(begins, sizes, strict=False)]
        self._total = begins[-1]
        self._kept: list[tuple[Array, ReferenceType[Array]]] = []

    def take(self) -> list[Array]:
        """A set of arrays with arbitrary contents that belong to the caller for as long as it refers to them."""
        if self._total < LARGE:
            return [np.empty(size) for size in self._sizes]
        free = next((k for k, (_, lease) in enumerate(self._kept) if lease() is None), None)
        memory = np.empty(self._total) if free is None else self._kept.pop(free)[0]
        lease = np.frombuffer(memory.data)
        self._kept = [*self._kept, (memory, ref(lease))][-SETS:]
        return [lease[part] for part in self._parts]

    def __reduce__(self) -> tuple[type[Buffers], tuple[tuple[int, ...]]]:
        """Pickle the sizes alone."""
        return Buffers, (self._sizes,)
