"""Numbers looked up in a table, in functions that are traced."""

from __future__ import annotations

import hashlib
from functools import cached_property
from typing import Any

import numpy as np

from unifg.errors import ModelError
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import Symbol, holds_symbols, plain, wrapped
from unifg.typing import Array, ArrayLike


class Lookup:
    """A function of a table that never changes: a traced function may call it, and carries the table with it.

    A subclass states ``__call__`` by NumPy and by :meth:`take`, so that arrays and traces run the same lines. It sets
    its own attributes before it hands over the table: none can be set afterwards, and its arrays are read-only.

    Attributes:
        table: flat numbers.
    """

    table: Array

    def __init__(self, table: ArrayLike) -> None:
        """Keep a copy of the table."""
        for part in vars(self).values():
            if isinstance(part, np.ndarray):
                part.flags.writeable = False
        copy = np.array(table, dtype=np.float64).ravel()
        copy.flags.writeable = False
        self.table = copy

    def __setattr__(self, name: str, value: Any) -> None:
        """Only until the table is there."""
        if "table" in vars(self) and name != "digest":
            raise ModelError(f"a {type(self).__name__} never changes: make another one")
        super().__setattr__(name, value)

    @cached_property
    def digest(self) -> bytes:
        """Equal for those that compute the same."""
        digest = hashlib.blake2b(digest_size=16)
        for name, part in sorted(vars(self).items()):
            content = (
                f"{part.shape}".encode() + part.tobytes() if isinstance(part, np.ndarray) else f"{part!r}".encode()
            )
            digest.update(name.encode() + content)
        return digest.digest()

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
