"""Arrays of one length, one row per thing."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from unifg.typing import Array, BoolArray, IntArray


@dataclass(frozen=True)
class Rows:
    """Base of classes whose fields are arrays of one length."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._columns()[0])

    def at(self, index: IntArray | BoolArray) -> Self:
        """The rows chosen by an index array or a mask."""
        return type(self)(*(column[index] for column in self._columns()))

    def followed_by(self, others: Self) -> Self:
        """These rows and then the others."""
        pairs = zip(self._columns(), others._columns(), strict=True)
        return type(self)(*(np.concatenate(pair) for pair in pairs))

    def _columns(self) -> list[Array]:
        return [getattr(self, field.name) for field in fields(self)]
