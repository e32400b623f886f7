"""What is asked of what a user's function returns, beside its shape: numbers it can be differentiated with."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.typing import Array

logger = logging.getLogger("unifg")
FLOAT64 = np.dtype(np.float64)


def as_float64(name: str, result: Any) -> Array:
    """The result of a function as an array.

    Raises:
        GraphError: when it is not made of doubles; of coarser numbers differences are noise.
    """
    array = result if isinstance(result, np.ndarray) else np.asarray(result)
    if array.dtype != FLOAT64:
        raise GraphError(
            f"term '{name}': its function returned {array.dtype}, expected float64: differences of anything else are "
            "noise; convert its inputs, not its result",
            term=name,
        )
    return array


def as_jacobian(name: str, block: Any) -> Array:
    """A block of an attached Jacobian as an array; whole numbers are exact.

    Raises:
        GraphError: when it is made of coarser or complex numbers.
    """
    array = np.asarray(block)
    if array.dtype != FLOAT64 and array.dtype.kind not in "iub":
        raise GraphError(f"term '{name}': its attached Jacobian returned {array.dtype}, expected float64", term=name)
    return np.asarray(array, dtype=np.float64)


def notice_no_information(name: str, whitener: Array) -> None:
    """Say that a term counts for nothing: an infinite sigma may be meant, and a matrix that was never filled is not.

    Of constants only: data switch terms off and on, and the status of a solve says whether anything is missing then.
    """
    if whitener.size and not whitener.any():
        logger.warning("term '%s': its information is zero for every factor, so it counts for nothing", name)
