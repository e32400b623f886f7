"""Arrays that a compiled loop works in, allocated by the annotations of a named tuple."""

from __future__ import annotations

from collections.abc import Hashable
from functools import cache
from typing import Any, TypeVar, get_type_hints

import numpy as np

from unifg.typing import Records

W = TypeVar("W", bound="tuple[object, ...]")


def empty(kind: type[W], **sizes: int) -> W:
    """Arrays of the shapes that the annotations of a named tuple state, all zero.

    Args:
        kind: Named tuple of fields ``Annotated[Array, size, ...]``, or ``Annotated[Records, dtype, size, ...]``.
        sizes: Numbers for the words among the sizes.
    """
    return kind(*[np.zeros([sizes.get(size, size) for size in shape], dtype) for dtype, shape in _fields(kind)])


@cache
def _fields(kind: Hashable) -> list[tuple[Any, list[Any]]]:
    """Type of numbers and shape of each field."""
    found = []
    for hint in get_type_hints(kind, include_extras=True).values():
        dtype, *shape = hint.__metadata__
        if hint.__origin__ != Records:
            dtype, shape = np.float64, [dtype, *shape]
        found.append((dtype, shape))
    return found


class Fields:
    """One record by the names of its fields: NumPy takes a microsecond for each, which a control loop feels."""

    def __init__(self, record: Records) -> None:
        """View the only record of a (1,) array."""
        self._views: dict[str, Any] = {name: record[name].data for name in record.dtype.names or ()}

    def __getitem__(self, name: str) -> Any:
        """A plain float or int."""
        return self._views[name][0]

    def __setitem__(self, name: str, value: float) -> None:
        """Write to the record."""
        self._views[name][0] = value
