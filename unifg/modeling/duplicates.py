"""Numbers as a user gives them, as doubles: what would lose something on the way, or is no number, is refused."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np

from unifg.errors import GraphError, UnifgError
from unifg.typing import Array

_KINDS = {"b": "booleans", "c": "complex numbers", "U": "text", "S": "bytes", "M": "dates", "m": "durations"}


def doubles(
    what: str, given: Any, *, term: str | None = None, flags: bool = False, error: type[UnifgError] = GraphError
) -> Array:
    """An array of float64; arrays of whole or coarser numbers are converted, an array of float64 is not copied.

    Args:
        what: what the numbers are, the subject of the message.
        given: a number, an array, or anything NumPy makes one of.
        term: for the error.
        flags: whether an array of booleans is returned as it is.
        error: what is raised.

    Raises:
        UnifgError: it is ragged or masked, or holds text, booleans, complex numbers or objects.
    """
    if type(given) is np.ndarray and given.dtype == np.float64:
        return given
    if isinstance(given, np.ma.MaskedArray):
        raise error(f"{what} is a masked array: fill it, or leave out what is masked by active=", term=term)
    try:
        array = np.asarray(given)
    except Exception as cause:
        raise error(f"{what} cannot be read as an array of numbers: {cause}", term=term) from cause
    if array.dtype.kind in "fiu":
        return np.asarray(array, dtype=np.float64)
    if flags and array.dtype == bool:
        return array
    found = _KINDS.get(array.dtype.kind, f"an array of {array.dtype} objects") if array.ndim else f"{given!r}"[:80]
    raise error(f"{what} must be real numbers, found {found}: convert to float64 first", term=term)


def kept(given: Any) -> Any:
    """A copy of an array or a list, which the caller may go on to change; anything else as it is."""
    return deepcopy(given) if isinstance(given, np.ndarray | list) else given
