"""Which data of a graph a solve changes: what stays as it was need not be taken in again."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.typing import Array, ArrayLike
from unifg.variables import Data


class Binding:
    """The present values of all data of a graph, as copies that nobody else writes to.

    Attributes:
        given: what the last solve named; all other data have their defaults.
    """

    def __init__(self, known: Mapping[str, Data]) -> None:
        """Know the data of a graph by their names; the mapping may grow."""
        self._known = known
        self._present: dict[Data, Array] = {}
        self.given: dict[Data, Array] = {}

    def take(self, data: Mapping[Data, ArrayLike]) -> set[Data]:
        """Take new values and say which data are not what they were.

        Raises:
            GraphError: on unknown data, a changed shape, or NaN.
        """
        for handle in data:
            if self._known.get(getattr(handle, "name", "")) is not handle:
                raise GraphError(f"data {handle!r} does not belong to this graph")
        changed = set()
        self.given = {}
        for handle in self._known.values():
            value, before = data.get(handle, handle.value), self._present.get(handle)
            if before is None or not _same(value, before):
                changed.add(handle)
                before = self._present[handle] = handle.check(value).copy()
            if handle in data:
                self.given[handle] = before
        return changed

    def forget(self) -> None:
        """Count everything as changed next time, as after a value that a term has refused."""
        self._present.clear()


def _same(value: ArrayLike, before: Array) -> bool:
    """Whether a value is what it was, to the last bit; False when that takes a closer look."""
    if not isinstance(value, np.ndarray) or value.dtype != before.dtype or value.shape != before.shape:
        return False
    return bool(value.tobytes() == before.tobytes())
