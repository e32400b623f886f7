"""The private sides of Numba that the machine room stands on, a test for each: an upgrade names what it broke."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from unifg.codegen.calls import RETRACTION, address, call_retraction, local_matrix, local_vector, matrix, vector
from unifg.codegen.fingerprint import fingerprint, is_compiled
from unifg.codegen.function_pointers import LAYOUT
from unifg.codegen.jit import compiled, in_order
from unifg.codegen.vectors import load, splat, store, total
from unifg.typing import Array


@compiled
def double(x: Array, d: Array, out: Array) -> None:
    for i in range(len(x)):
        out[i] = 2.0 * x[i] + d[i]


@compiled
def through(where: int, x: Array, d: Array, out: Array) -> None:
    call_retraction(where, x, d, out)


def calls_by_address() -> None:
    out = np.empty(3)
    through(address(double, RETRACTION), np.arange(3.0), np.ones(3), out)
    np.testing.assert_array_equal(out, [1.0, 3.0, 5.0])


@compiled
def borrowed(x: Array, out: Array) -> None:
    kept, block = local_vector(2), local_matrix(2, 2)
    part, square = vector(x, 1, 2), matrix(x, 0, 2, 2)
    for i in range(2):
        kept[i] = part[i]
        for k in range(2):
            block[i, k] = square[i, k]
    out[0], out[1] = kept[0] + block[1, 1], kept[1] + block[0, 1]


def views_without_references() -> None:
    out = np.empty(2)
    borrowed(np.arange(4.0), out)
    np.testing.assert_array_equal(out, [4.0, 3.0])


@compiled
def four(x: Array) -> float:
    store(x, 0, load(x, 4))
    found: float = total(splat(1.5)) + x[3]
    return found


def vectors_of_four() -> None:
    assert four(np.arange(8.0)) == 13.0


def describes_arrays() -> None:
    from numba import types
    from numba.core.datamodel import default_manager

    assert tuple(default_manager[types.Array(types.float64, 1, "C")]._fields) == LAYOUT


def stamps_callees() -> None:
    @compiled
    def caller(x: Array, d: Array, out: Array) -> None:
        double(x, d, out)

    assert is_compiled(caller) and fingerprint(caller) != fingerprint(double)


def test_constants_are_stamped_in_full() -> None:
    """Arrays are compiled in; two that differ in the middle print alike."""

    def reading(table: Array) -> Callable[[int], float]:
        @compiled
        def read(k: int) -> float:
            return float(table[k])

        return read

    table, other = np.zeros(5000), np.zeros(5000)
    other[2500] = 1e-12
    assert repr(table) == repr(other)
    assert fingerprint(reading(table)) != fingerprint(reading(other))
    assert fingerprint(reading(table)) == fingerprint(reading(table.copy()))


@in_order
def rest(x: float, h: float) -> float:
    return (x + h) - x


def keeps_the_order_of_operations() -> None:
    assert rest(1e17, 1.0) == 0.0


SIDES: dict[str, Callable[[], None]] = {
    "addresses of compiled functions (overloads, library.get_pointer_to_function, call_conv)": calls_by_address,
    "arrays that borrow memory (cgutils, populate_array, alloca)": views_without_references,
    "vector registers (a type of its own, intrinsics of llvmlite)": vectors_of_four,
    "how arrays lie in memory (the data model)": describes_arrays,
    "the cache on disk (FunctionCache, Dispatcher)": stamps_callees,
    "flags of floating-point liberties (targetoptions)": keeps_the_order_of_operations,
}


@pytest.mark.parametrize("side", SIDES)
def test_private_sides_of_numba(side: str) -> None:
    from importlib.metadata import version

    try:
        SIDES[side]()
    except Exception as error:
        pytest.fail(f"Numba {version('numba')} broke {side}, on which unifg.codegen stands: {error!r}")
