"""Loops over arrays in compiled code, for which Numba's own may raise errors or call a library for linear algebra."""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.typing import Array


@compiled
def copy_to(source: Array, out: Array) -> None:
    """Copy an array of one axis."""
    for k in range(len(out)):
        out[k] = source[k]


@compiled
def dot(a: Array, b: Array) -> float:
    """Sum of the products of two vectors."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total
