"""Looking for a number among sorted ones, in compiled code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.jit import compiled
from unifg.typing import IntArray

__all__ = ["first_not_below"]


@compiled
def first_not_below(numbers: IntArray | NDArray[np.int32], low: int, high: int, wanted: int) -> int:
    """The first place from ``low`` on whose number is not below the one wanted; ``high`` where there is none before it.

    Args:
        numbers: sorted from ``low`` to ``high``.
        low: see above.
        high: see above.
        wanted: see above.
    """
    while low < high:
        middle = (low + high) // 2
        if numbers[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low
