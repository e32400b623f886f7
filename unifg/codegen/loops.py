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
def largest(numbers: Array, start: int, stop: int) -> float:
    """Largest magnitude in start..stop; four at a time, since each maximum waits for the one before."""
    a, b, c, d, k = 0.0, 0.0, 0.0, 0.0, start
    while k + 3 < stop:
        a, b = max(a, abs(numbers[k])), max(b, abs(numbers[k + 1]))
        c, d = max(c, abs(numbers[k + 2])), max(d, abs(numbers[k + 3]))
        k += 4
    while k < stop:
        a = max(a, abs(numbers[k]))
        k += 1
    return max(max(a, b), max(c, d))


@compiled
def dot(a: Array, b: Array) -> float:
    """Sum of the products of two vectors."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total
