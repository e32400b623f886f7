"""From a function of one element to a method for batches: checks, broadcasting and a compiled loop."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from unifg.errors import UnifgError
from unifg.machine.calls import matrix, vector
from unifg.machine.jit import compiled
from unifg.typing import Array, ArrayLike

Scalar = Callable[..., None]
One = Callable[[ArrayLike], Array]
Two = Callable[[ArrayLike, ArrayLike], Array]


def over_one(function: Scalar, given: int, *shape: int) -> One:
    """Make a batched function, (..., given) to (..., *shape), of a compiled ``function(x, out)``.

    Args:
        function: reads a (given,) vector and writes every entry of a vector or matrix.
        given: length of the argument.
        shape: of the result of one call, one or two numbers.

    Raises:
        UnifgError: by the function made, when the last axis of its argument has another length.
    """

    def batched(x: ArrayLike) -> Array:
        x = _contiguous(x, given, function)
        result = np.empty(x.shape[:-1] + shape)
        loop_over_one(function, given, shape)(x.size // given, x.reshape(-1), result.reshape(-1))
        return result

    return batched


def over_two(function: Scalar, first: int, second: int, length: int) -> Two:
    """Make a batched function, (..., first) and (..., second) to (..., length), of ``function(x, y, out)``.

    The leading axes broadcast as in NumPy; an argument that is a single vector is read again and again, not copied.

    Raises:
        UnifgError: by the function made, when the last axis of an argument has another length.
        ValueError: by the function made, when the leading axes do not broadcast.
    """

    def batched(x: ArrayLike, y: ArrayLike) -> Array:
        x, y = _contiguous(x, first, function), _contiguous(y, second, function)
        batch, step_x, step_y = x.shape[:-1], first, second
        if batch != y.shape[:-1]:
            if y.size == second and y.ndim <= x.ndim:
                step_y = 0
            elif x.size == first and x.ndim <= y.ndim:
                batch, step_x = y.shape[:-1], 0
            else:
                batch = np.broadcast_shapes(batch, y.shape[:-1])
                x = np.array(np.broadcast_to(x, (*batch, first)), order="C")
                y = np.array(np.broadcast_to(y, (*batch, second)), order="C")
        result = np.empty((*batch, length))
        loop = loop_over_two(function, first, second, length)
        loop(result.size // length, step_x, step_y, x.reshape(-1), y.reshape(-1), result.reshape(-1))
        return result

    return batched


def _contiguous(x: ArrayLike, length: int, function: Scalar) -> Array:
    """Return (..., length) float64 numbers as compiled loops take them: in order, and writeable as far as types go."""
    array = np.asarray(x, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != length:
        where = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
        raise UnifgError(f"{where} takes (..., {length}) arrays; got shape {array.shape}")
    return array if array.flags.carray else np.array(array, order="C")


@cache
def loop_over_one(function: Scalar, given: int, shape: tuple[int, ...]) -> Any:
    """Compile, at its first call, the loop of ``function`` over flat arrays."""
    size = int(np.prod(shape))
    if len(shape) == 1:

        def loop(count: int, x: Array, out: Array) -> None:
            for i in range(count):
                function(vector(x, i * given, given), vector(out, i * size, size))

    else:
        rows, columns = shape

        def loop(count: int, x: Array, out: Array) -> None:
            for i in range(count):
                function(vector(x, i * given, given), matrix(out, i * size, rows, columns))

    return _named(loop, function)


@cache
def loop_over_two(function: Scalar, first: int, second: int, length: int) -> Any:
    """Compile, at its first call, the loop of ``function`` over flat arrays; a step of 0 repeats an argument."""

    def loop(count: int, step_x: int, step_y: int, x: Array, y: Array, out: Array) -> None:
        for i in range(count):
            function(vector(x, i * step_x, first), vector(y, i * step_y, second), vector(out, i * length, length))

    return _named(loop, function)


def _named(loop: Callable[..., None], function: Scalar) -> Callable[..., None]:
    """Compile a loop under a name of its own, as the cache tells functions apart by name and line."""
    group = function.__module__.rpartition(".")[2]
    loop.__qualname__ = f"loop_{group}_{function.__name__}"
    return compiled(loop)
