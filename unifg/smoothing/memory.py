"""Blocks of varying length in one array: a free list for each class of sizes, four classes to every power of two.

A freed block holds, in its first place, where the next one of its class stands. Blocks never move.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address
from unifg.codegen.views import redescribe
from unifg.smoothing.state import CLASSES, State, opened
from unifg.typing import Array, IntArray

LEAST, VECTORS = 4, 16  # the shortest blocks; those of floats are whole vectors of four
LISTS, NUMBERS = (State._fields.index(name) for name in ("lists", "numbers"))
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
def take_list(memory: Address, length: int) -> int:
    """A block of integers; there must be room."""
    state = opened(memory)
    kind, size = rounded(length, LEAST)
    counters, heads = state.counters[0], state.heads
    at = heads[kind]
    if at >= 0:
        heads[kind] = state.lists[at]
        return int(at)
    at = counters.lists_end
    counters.lists_end = at + size
    return int(at)


@compiled
def give_list(memory: Address, length: int, at: int) -> None:
    """Return a block of integers."""
    state = opened(memory)
    kind, _ = rounded(length, LEAST)
    state.lists[at] = state.heads[kind]
    state.heads[kind] = at


@compiled
def take_numbers(memory: Address, length: int) -> int:
    """A block of floats; there must be room."""
    state = opened(memory)
    kind, size = rounded(length, VECTORS)
    counters, heads = state.counters[0], state.heads
    at = heads[CLASSES + kind]
    if at >= 0:
        heads[CLASSES + kind] = int(state.numbers[at])
        return int(at)
    at = counters.numbers_end
    counters.numbers_end = at + size
    return int(at)


@compiled
def give_numbers(memory: Address, length: int, at: int) -> None:
    """Return a block of floats."""
    state = opened(memory)
    kind, _ = rounded(length, VECTORS)
    state.numbers[at] = float(state.heads[CLASSES + kind])
    state.heads[CLASSES + kind] = at


@compiled
def more(array: T, used: int, needed: int) -> T:
    """A longer copy with room for ``needed`` more; nothing where there is room."""
    if used + needed + SPARE <= len(array):
        return np.empty(0, array.dtype)
    result = np.empty(max(2 * len(array), used + needed + SPARE), array.dtype)
    for k in range(used):
        result[k] = array[k]
    return result


@compiled
def found(array: T) -> T | None:
    """Nothing instead of an empty array: what is handed to Python costs a microsecond an array."""
    return array if len(array) else None


@compiled
def grown(memory: Address, lists: IntArray, numbers: Array) -> State:
    """The arrays with longer arenas, where there are any; the caller keeps them."""
    if len(lists):
        redescribe(memory, LISTS, lists)
    if len(numbers):
        redescribe(memory, NUMBERS, numbers)
    return opened(memory)
