"""Blocks of varying length in one array: a free list for each class of sizes, four classes to every power of two.

A freed block holds, in its first place, where the next one of its class stands. Blocks never move.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from unifg.machine.jit import compiled
from unifg.smoothing.fields import CLASSES, HEADS, LISTS_END, NUMBERS_END, State
from unifg.typing import Array, IntArray

LEAST, VECTORS = 4, 16  # the shortest blocks; those of floats are whole vectors of four
T = TypeVar("T", Array, IntArray)
SPARE = 16  # numbers behind the last block: kernels touch a few beyond the end of a row


@compiled
def rounded(length: int, base: int) -> tuple[int, int]:
    """Class of a block of some length, and how long the blocks of that class are, ``base`` at least."""
    kind = 0
    while 2 * base < length:
        base *= 2
        kind += 4
    quarter = base // 4
    steps = 0
    while base + steps * quarter < length:
        steps += 1
    return kind + steps, base + steps * quarter


@compiled
def length_of_front(size: int) -> int:
    """Numbers of a front with so many rows: the last vector may reach beyond its end."""
    return size * (size + 1) + 4


@compiled
def take_list(state: State, length: int) -> int:
    """A block of integers; there must be room."""
    kind, size = rounded(length, LEAST)
    counters, lists = state.counters, state.lists
    at = counters[HEADS + kind]
    if at >= 0:
        counters[HEADS + kind] = lists[at]
        return int(at)
    at = counters[LISTS_END]
    counters[LISTS_END] = at + size
    return int(at)


@compiled
def give_list(state: State, length: int, at: int) -> None:
    """Return a block of integers."""
    kind, _ = rounded(length, LEAST)
    state.lists[at] = state.counters[HEADS + kind]
    state.counters[HEADS + kind] = at


@compiled
def take_numbers(state: State, length: int) -> int:
    """A block of floats; there must be room."""
    kind, size = rounded(length, VECTORS)
    counters = state.counters
    at = counters[HEADS + CLASSES + kind]
    if at >= 0:
        counters[HEADS + CLASSES + kind] = int(state.numbers[at])
        return int(at)
    at = counters[NUMBERS_END]
    counters[NUMBERS_END] = at + size
    return int(at)


@compiled
def give_numbers(state: State, length: int, at: int) -> None:
    """Return a block of floats."""
    kind, _ = rounded(length, VECTORS)
    state.numbers[at] = float(state.counters[HEADS + CLASSES + kind])
    state.counters[HEADS + CLASSES + kind] = at


@compiled
def more_lists(lists: IntArray, used: int, needed: int) -> IntArray:
    """The same integers with room for ``needed`` more."""
    if used + needed + SPARE <= len(lists):
        return lists
    return _longer(lists, max(2 * len(lists), used + needed + SPARE), used)


@compiled
def more_numbers(numbers: Array, used: int, needed: int) -> Array:
    """The same floats with room for ``needed`` more."""
    if used + needed + SPARE <= len(numbers):
        return numbers
    return _longer(numbers, max(2 * len(numbers), used + needed + SPARE), used)


@compiled
def _longer(array: T, length: int, used: int) -> T:
    """A copy with room at the end."""
    result = np.empty(length, array.dtype)
    for k in range(used):
        result[k] = array[k]
    return result
