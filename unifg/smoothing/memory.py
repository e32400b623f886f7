"""Blocks of varying length in one array: a free list for each class of sizes, four classes to every power of two.

A freed block holds, in its first place, where the next one of its class stands. Blocks never move.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address
from unifg.codegen.views import redescribe
from unifg.smoothing.state import CLASSES, Record, State, opened
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
def _take(arena: T, heads: IntArray, kind: int, size: int, end: int) -> tuple[int, int]:
    """A block of a class in an arena in use up to some end; where it begins, and the end then."""
    at = int(heads[kind])
    if at < 0:
        return end, end + size
    heads[kind] = int(arena[at])
    return at, end


@compiled
def take_list(memory: Address, length: int) -> int:
    """A block of integers; there must be room."""
    state = opened(memory)
    kind, size = rounded(length, LEAST)
    at, end = _take(state.lists, state.heads, kind, size, state.counters[0].lists_end)
    state.counters[0].lists_end = end
    return at


@compiled
def take_numbers(memory: Address, length: int) -> int:
    """A block of floats; there must be room."""
    state = opened(memory)
    kind, size = rounded(length, VECTORS)
    at, end = _take(state.numbers, state.heads, CLASSES + kind, size, state.counters[0].numbers_end)
    state.counters[0].numbers_end = end
    return at


@compiled
def give_list(memory: Address, length: int, at: int) -> None:
    """Return a block of integers."""
    state = opened(memory)
    kind = rounded(length, LEAST)[0]
    state.lists[at], state.heads[kind] = state.heads[kind], at


@compiled
def give_numbers(memory: Address, length: int, at: int) -> None:
    """Return a block of floats."""
    state = opened(memory)
    kind = CLASSES + rounded(length, VECTORS)[0]
    state.numbers[at], state.heads[kind] = float(state.heads[kind]), at


@compiled
def next_row(table: Record, free: int, end: int) -> tuple[int, int, int]:
    """A free row of a table; the first of the chain of free rows, and where the rows in use end, without it."""
    if free >= 0:
        return free, table[free].next, end
    return end, free, end + 1


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
