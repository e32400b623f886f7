"""How one argument of a term is read out of the values."""

from __future__ import annotations

import numpy as np

from unifg.language.variables import Selection
from unifg.program.columns import Values
from unifg.typing import Array, IntArray


class Gather:
    """Reads one variable argument of a term out of the values, one row per factor."""

    def __init__(self, selection: Selection, count: int) -> None:
        """Precompute the cheapest way to index."""
        self.family = selection.family
        self.selection = selection
        self.shared = len(selection) == 1 and count > 1
        self.count = count
        indices = selection.indices
        self.rows: slice | IntArray = indices
        if len(indices) == 1 or bool(np.all(np.diff(indices) == 1)):
            self.rows = slice(int(indices[0]), int(indices[-1]) + 1)
        self.columns = None if selection.component is None else selection.storage

    def __call__(self, values: Values) -> Array:
        """(n, storage) values of this argument."""
        part = values[self.family][self.rows]
        if self.columns is not None:
            part = part[:, self.columns]
        return np.broadcast_to(part, (self.count, part.shape[1])) if self.shared else part
