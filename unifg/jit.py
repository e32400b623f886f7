"""The one way functions are compiled here: Numba with a cache on disk, and floating-point liberties that keep NaN.

``fastmath`` in full may delete the checks for NaN that solvers rely on; contraction, reassociation, signed zeros
and reciprocals are what loops need to vectorise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

LIBERTIES = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: F) -> F:
    """Compile on the first call, from the cache where there is one; callable from other compiled functions."""
    return cast(F, numba.njit(cache=True, error_model="numpy", fastmath=LIBERTIES)(function))
