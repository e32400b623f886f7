"""Products of vectors in one thread.

From ten thousand numbers on OpenBLAS shares a product out among threads. Beside other programs these wait for each
other for milliseconds, where the product itself takes microseconds, and its last digits depend on how many there are.
"""

from __future__ import annotations

import numpy as np

from unifg.typing import Array

__all__ = ["inner"]


def inner(a: Array, b: Array) -> float:
    """The inner product of two vectors (n,)."""
    return float(np.einsum("i,i->", a, b))
