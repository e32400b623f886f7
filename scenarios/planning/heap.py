"""A binary heap of keys and places in two arrays, for searches in compiled code."""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.typing import Array, IntArray

__all__ = ["pop", "push"]


@compiled
def push(keys: Array, places: IntArray, size: int, key: float, place: int) -> int:
    """Add an entry to a heap of a size; the size afterwards."""
    at = size
    while at > 0 and keys[(at - 1) // 2] > key:
        keys[at], places[at] = keys[(at - 1) // 2], places[(at - 1) // 2]
        at = (at - 1) // 2
    keys[at], places[at] = key, place
    return size + 1


@compiled
def pop(keys: Array, places: IntArray, size: int) -> int:
    """Place of the least key, which is taken off a heap of a size."""
    least: int = places[0]
    size -= 1
    key, place, at = keys[size], places[size], 0
    while True:  # the last one sinks from the top of the heap
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[at], places[at], at = keys[child], places[child], child
    keys[at], places[at] = key, place
    return least
