"""Which data of a graph a solve changes: what stays as it was need not be taken in again."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.language.variables import Data
from unifg.typing import Array, ArrayLike


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
        """Take new values and say which data may not be what they were.

        Raises:
            GraphError: on unknown data, a changed shape, or NaN.
        """
        for handle in data:
            if self._known.get(getattr(handle, "name", "")) is not handle:
                raise GraphError(f"data {handle!r} does not belong to this graph")
        changed = set()
        self.given = {}
        for handle in self._known.values():
            value, before = data.get(handle), self._present.get(handle)
            if value is not None:
                changed.add(handle)
                self.given[handle] = self._present[handle] = _checked(handle, value)
            elif before is None or before.tobytes() != handle.value.tobytes():
                changed.add(handle)
                self._present[handle] = handle.check(handle.value).copy()
        return changed

    def forget(self) -> None:
        """Count everything as changed next time, as after a value that a term has refused."""
        self._present.clear()


def _checked(handle: Data, value: ArrayLike) -> Array:
    """A copy of a new value."""
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == handle.value.shape:
        copy = value.copy()
        flat = copy.reshape(-1)
        squares = flat @ flat
        if handle.value.dtype == np.float64 and squares == squares:  # no NaN: squares are not negative
            return copy
    return handle.check(value).copy()
