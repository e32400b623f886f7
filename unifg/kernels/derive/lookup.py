"""Numbers looked up in a table, in functions that are traced."""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.kernels.derive.operations import Op
from unifg.kernels.derive.symbols import Symbol, holds_symbols, plain, wrapped
from unifg.typing import Array, ArrayLike


class Lookup:
    """A function of a table that never changes: a traced function may call it, and carries the table with it.

    A subclass states ``__call__`` by NumPy and by :meth:`take`, so that arrays and traces run the same lines.

    Attributes:
        table: flat numbers, read-only.
    """

    def __init__(self, table: ArrayLike) -> None:
        """Keep a copy of the table."""
        self.table: Array = np.array(table, dtype=np.float64).ravel()
        self.table.flags.writeable = False

    def take(self, place: Any) -> Any:
        """Entries at whole numbers, as floats, of any shape; the first where that is not a number."""
        if isinstance(place, Symbol):
            return self._entry(place)
        if not holds_symbols(place):
            place = np.asarray(place, dtype=np.float64)
            return self.table[np.where(np.isnan(place), 0.0, place).astype(np.int64)]
        return wrapped(np.frompyfunc(self._entry, 1, 1)(plain(place)))

    def _entry(self, place: Any) -> Any:
        if not isinstance(place, Symbol):
            return float(self.table[int(place)])
        tape = place.tape
        begin = tape.constant(float(tape.table(self.table)))
        return Symbol(tape, tape.apply(Op.GATHER, tape.add(place.node, begin)))
