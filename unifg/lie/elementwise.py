"""From a compiled function of one element to a method for batches: checks, broadcasting and a compiled loop.

A manifold states a formula once, as a compiled function of one element that writes its result:
``retract(x, d, out)``. :func:`elementwise` makes the batched method of it; compiled code finds the function itself on
the method (:mod:`unifg.lie.functions`). Arguments are float64 arrays, one-dimensional but for (n, n) results; every
entry of ``out`` is written and nothing is allocated or checked. All arguments are read before the first result is
written, so a result may take the place of an argument.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any, TypeAlias, cast, overload

import numpy as np

from unifg.codegen.calls import matrix, vector
from unifg.codegen.fingerprint import is_compiled
from unifg.codegen.jit import compiled
from unifg.errors import UnifgError
from unifg.typing import Array, ArrayLike

Scalar: TypeAlias = Callable[..., None]
One: TypeAlias = Callable[[ArrayLike], Array]
Two: TypeAlias = Callable[[ArrayLike, ArrayLike], Array]
OneMethod: TypeAlias = Callable[[Any, ArrayLike], Array]
TwoMethod: TypeAlias = Callable[[Any, ArrayLike, ArrayLike], Array]

STORAGE, DIM, POINT, MATRIX = "storage", "dim", "point_dim", "matrix_dim"
LAYOUTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "exp": ((DIM,), (STORAGE,)),
    "log": ((STORAGE,), (DIM,)),
    "inverse": ((STORAGE,), (STORAGE,)),
    "compose": ((STORAGE, STORAGE), (STORAGE,)),
    "between": ((STORAGE, STORAGE), (STORAGE,)),
    "retract": ((STORAGE, DIM), (STORAGE,)),
    "local": ((STORAGE, STORAGE), (DIM,)),
    "act": ((STORAGE, POINT), (POINT,)),
    "matrix": ((STORAGE,), (MATRIX, MATRIX)),
    "hat": ((DIM,), (MATRIX, MATRIX)),
    "adjoint": ((STORAGE,), (DIM, DIM)),
    "ad": ((DIM,), (DIM, DIM)),
    "right_jacobian": ((DIM,), (DIM, DIM)),
    "right_jacobian_inverse": ((DIM,), (DIM, DIM)),
    "left_jacobian": ((DIM,), (DIM, DIM)),
    "left_jacobian_inverse": ((DIM,), (DIM, DIM)),
}
"""Functions of one element: the sizes of the arguments, and of the result, as attributes of the manifold."""


@overload
def elementwise(function: Callable[[Array, Array], None], over: OneMethod | None = None) -> OneMethod: ...
@overload
def elementwise(function: Callable[[Array, Array, Array], None], over: TwoMethod | None = None) -> TwoMethod: ...
def elementwise(function: Callable[..., None], over: Callable[..., Array] | None = None) -> Callable[..., Array]:
    """State a method of a manifold by a compiled function of one element.

    In the class it reads ``log = elementwise(log)``. The sizes of its arguments and its result follow from that name.
    What is stated this way is compiled into every solver; what is stated as an ordinary method is called from Python.

    Args:
        function: compiled, such as by Numba's ``njit``: ``f(x, out)`` or ``f(x, y, out)``.
        over: what to call for batches, where NumPy is quicker than a loop.

    Raises:
        UnifgError: when the function is not compiled; by the class, when the method is none of those in ``LAYOUTS``; by
            the method, when the last axis of an argument has another length.
    """
    if not is_compiled(function):
        raise UnifgError(f"elementwise takes a function compiled by Numba's njit, found {function!r}")
    return cast(Callable[..., Array], _Statement(function, over))


class _Statement:
    """A method until its class exists."""

    def __init__(self, function: Scalar, over: Callable[..., Array] | None) -> None:
        self.function, self.over = function, over

    def __set_name__(self, owner: type, name: str) -> None:
        if name not in LAYOUTS:
            raise UnifgError(
                f"{owner.__name__}.{name} cannot be stated for one element; these can: {', '.join(LAYOUTS)}"
            )
        setattr(owner, name, method(owner, name, self.function, self.over))


def method(owner: type, name: str, function: Scalar, over: Callable[..., Array] | None = None) -> Callable[..., Array]:
    """The batched method; it carries the function as ``compiled``."""
    given, result = LAYOUTS[name]
    loop = over_one if len(given) == 1 else over_two
    made: Any
    if over is not None:
        made = FunctionType(over.__code__, over.__globals__, name, over.__defaults__, over.__closure__)
    elif all(isinstance(getattr(owner, size, None), int) for size in (*given, *result)):
        batched: Any = loop(function, *[getattr(owner, size) for size in (*given, *result)])
        made = (lambda self, x, /: batched(x)) if len(given) == 1 else (lambda self, x, y, /: batched(x, y))
    else:  # sizes belong to the instance

        def made(self: Any, *arguments: ArrayLike) -> Array:
            sized: Any = loop(function, *[getattr(self, size) for size in (*given, *result)])
            return cast(Array, sized(*arguments))

    inherited = getattr(super(owner, owner), name, None)
    texts = [text for text in (getattr(inherited, "__doc__", None), function.__doc__) if text]
    made.__name__, made.__qualname__, made.__module__ = name, f"{owner.__qualname__}.{name}", owner.__module__
    made.__doc__, made.compiled = "\n\n".join(dict.fromkeys(texts)), function
    return cast(Callable[..., Array], made)


def stated(owner: type, name: str) -> Scalar | None:
    """The compiled function behind a method of a class, if there is one."""
    found = getattr(owner, name, None)
    return found.compiled if isinstance(found, FunctionType) and hasattr(found, "compiled") else None


def stated_in(owner: type, name: str) -> type | None:
    """The class among the bases that states a method."""
    return next((kind for kind in owner.__mro__ if name in vars(kind)), None)


@cache
def over_one(function: Scalar, given: int, *shape: int) -> One:
    """Make a batched function, (..., given) to (..., *shape), of a compiled ``function(x, out)``.

    Args:
        function: reads a (given,) vector and writes every entry of a vector or matrix.
        given: length of the argument.
        shape: of the result of one call, one or two numbers.

    Raises:
        UnifgError: by the function made, when the last axis of its argument has another length.
    """
    size, (rows, columns) = int(np.prod(shape)), (*shape, 0)[:2]

    if len(shape) == 1:

        def loop(count: int, x: Array, out: Array) -> None:
            for i in range(count):
                function(vector(x, i * given, given), vector(out, i * size, size))

    else:

        def loop(count: int, x: Array, out: Array) -> None:
            for i in range(count):
                function(vector(x, i * given, given), matrix(out, i * size, rows, columns))

    run: Any = None

    def batched(x: ArrayLike) -> Array:
        nonlocal run
        run = run or _named(loop, function)
        x = _contiguous(x, given, function)
        result = np.empty(x.shape[:-1] + shape)
        run(x.size // given, x.reshape(-1), result.reshape(-1))
        return result

    return batched


@cache
def over_two(function: Scalar, first: int, second: int, *shape: int) -> Two:
    """Make a batched function, (..., first) and (..., second) to (..., *shape), of ``function(x, y, out)``.

    The leading axes broadcast as in NumPy; an argument that is a single vector is read again and again, not copied.

    Raises:
        UnifgError: by the function made, when the last axis of an argument has another length.
        ValueError: by the function made, when the leading axes do not broadcast.
    """
    size, (rows, columns) = int(np.prod(shape)), (*shape, 0)[:2]

    if len(shape) == 1:

        def loop(count: int, step_x: int, step_y: int, x: Array, y: Array, out: Array) -> None:
            for i in range(count):
                function(vector(x, i * step_x, first), vector(y, i * step_y, second), vector(out, i * size, size))

    else:

        def loop(count: int, step_x: int, step_y: int, x: Array, y: Array, out: Array) -> None:
            for i in range(count):
                found = matrix(out, i * size, rows, columns)
                function(vector(x, i * step_x, first), vector(y, i * step_y, second), found)

    run: Any = None

    def batched(x: ArrayLike, y: ArrayLike) -> Array:
        nonlocal run
        run = run or _named(loop, function)
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
        result = np.empty(batch + shape)
        run(result.size // size, step_x, step_y, x.reshape(-1), y.reshape(-1), result.reshape(-1))
        return result

    return batched


def _contiguous(x: ArrayLike, length: int, function: Scalar) -> Array:
    """Return (..., length) float64 numbers as compiled loops take them: in order, and writeable as far as types go."""
    array = np.asarray(x, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != length:
        where = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
        raise UnifgError(f"{where} takes (..., {length}) arrays; got shape {array.shape}")
    return array if array.flags.carray else np.array(array, order="C")


def _named(loop: Callable[..., None], function: Scalar) -> Callable[..., None]:
    """Compile, at its first call, a loop under a name of its own: the cache tells functions apart by name and line."""
    group = function.__module__.rpartition(".")[2]
    loop.__qualname__ = f"loop_{group}_{function.__name__}"
    return compiled(loop)
