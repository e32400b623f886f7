"""The compiled functions of a product of groups, made from those of its components.

A product is taken apart down to components with functions of their own; then the functions of the last two become
those of their pair, this pair and the component before it a pair again, and so on to the front. The compiler copies
them into one another, so the nesting costs nothing at run time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from types import ModuleType

from unifg.lie.manifold import Manifold
from unifg.lie.product import Product
from unifg.machine.calls import local_matrix, vector
from unifg.machine.jit import compiled
from unifg.typing import Array

Scalar = Callable[..., None]
Part = tuple[ModuleType, int, int]
"""Functions, storage and dimension of a component."""

STORAGE, TANGENT = 0, 1  # what an argument or a result is laid out as
ONE = {"exp": (TANGENT, STORAGE), "log": (STORAGE, TANGENT), "inverse": (STORAGE, STORAGE)}
TWO = {
    "compose": (STORAGE, STORAGE, STORAGE),
    "between": (STORAGE, STORAGE, STORAGE),
    "retract": (STORAGE, TANGENT, STORAGE),
    "local": (STORAGE, STORAGE, TANGENT),
}
SQUARE = {
    "adjoint": STORAGE,
    "right_jacobian": TANGENT,
    "right_jacobian_inverse": TANGENT,
    "left_jacobian": TANGENT,
    "left_jacobian_inverse": TANGENT,
}


def components(manifold: Manifold) -> Iterator[Manifold]:
    """What a manifold is a product of, in order, down to manifolds that are no products."""
    if not isinstance(manifold, Product):
        yield manifold
        return
    for part in manifold.components.values():
        yield from components(part.manifold)


def side_by_side(parts: Sequence[Part]) -> ModuleType:
    """The functions of a product, in a module made for it.

    It offers what the modules of :mod:`unifg.lie.scalar` do, with the same meaning, but not ``act`` and ``matrix``:
    nothing compiled moves points by a product. Adjoints and Jacobians are block diagonal.

    Args:
        parts: the components, in order.
    """
    first, rest = parts[0], parts[1:]
    if not rest:
        return first[0]
    tail = side_by_side(rest)
    sizes = (first[1:], (sum(storage for _, storage, _ in rest), sum(dim for _, _, dim in rest)))
    # The cache on disk tells functions apart by their names and those of their callees, in no order.
    name = "_".join(f"{functions.__name__.rpartition('.')[2]}{dim}" for functions, _, dim in parts)
    module = ModuleType(name, "A product of groups, one element at a time.")
    for key, places in ONE.items():
        setattr(module, key, _one(f"{key}_{name}", getattr(first[0], key), getattr(tail, key), sizes, places))
    for key, layout in TWO.items():
        setattr(module, key, _two(f"{key}_{name}", getattr(first[0], key), getattr(tail, key), sizes, layout))
    for key, place in SQUARE.items():
        setattr(module, key, _square(f"{key}_{name}", getattr(first[0], key), getattr(tail, key), sizes, place))
    return module


Sizes = tuple[tuple[int, ...], tuple[int, ...]]


def _one(name: str, head: Scalar, tail: Scalar, sizes: Sizes, places: tuple[int, int]) -> Scalar:
    """``f(x, out)`` of a pair: the first part, then all others."""
    (x1, out1), (x2, out2) = ([part[place] for place in places] for part in sizes)

    def pair(x: Array, out: Array) -> None:
        head(vector(x, 0, x1), vector(out, 0, out1))
        tail(vector(x, x1, x2), vector(out, out1, out2))

    pair.__qualname__ = name
    return compiled(pair)


def _two(name: str, head: Scalar, tail: Scalar, sizes: Sizes, places: tuple[int, int, int]) -> Scalar:
    """``f(x, y, out)`` of a pair."""
    (x1, y1, out1), (x2, y2, out2) = ([part[place] for place in places] for part in sizes)

    def pair(x: Array, y: Array, out: Array) -> None:
        head(vector(x, 0, x1), vector(y, 0, y1), vector(out, 0, out1))
        tail(vector(x, x1, x2), vector(y, y1, y2), vector(out, out1, out2))

    pair.__qualname__ = name
    return compiled(pair)


def _square(name: str, head: Scalar, tail: Scalar, sizes: Sizes, place: int) -> Scalar:
    """``f(x, out)`` with square blocks."""
    (x1, x2), (n1, n2) = (part[place] for part in sizes), (part[TANGENT] for part in sizes)

    def pair(x: Array, out: Array) -> None:
        upper, lower = local_matrix(n1, n1), local_matrix(n2, n2)
        head(vector(x, 0, x1), upper)
        tail(vector(x, x1, x2), lower)
        write_blocks(upper, lower, out)

    pair.__qualname__ = name
    return compiled(pair)


def bend_side_by_side(parts: Sequence[tuple[Scalar, int]]) -> Scalar:
    """``bend(d, v, out)`` of a product, as in :mod:`unifg.lie.scalar.bend`.

    Args:
        parts: function and dimension of each component, in order.
    """
    (head, n1), rest = parts[0], parts[1:]
    if not rest:
        return head
    tail, n2 = bend_side_by_side(rest), sum(dim for _, dim in rest)

    def pair(d: Array, v: Array, out: Array) -> None:
        upper, lower = local_matrix(n1, n1), local_matrix(n2, n2)
        head(vector(d, 0, n1), vector(v, 0, n1), upper)
        tail(vector(d, n1, n2), vector(v, n1, n2), lower)
        write_blocks(upper, lower, out)

    pair.__qualname__ = "bend_" + "_".join(f"{function.__name__}{dim}" for function, dim in parts)
    return compiled(pair)


@compiled
def write_blocks(upper: Array, lower: Array, out: Array) -> None:
    """Write a block-diagonal matrix; blocks of results are not contiguous, so parts cannot write them themselves."""
    size = len(upper)
    for i in range(size):
        for k in range(size):
            out[i, k] = upper[i, k]
        for k in range(len(lower)):
            out[i, size + k] = 0.0
    for i in range(len(lower)):
        for k in range(size):
            out[size + i, k] = 0.0
        for k in range(len(lower)):
            out[size + i, size + k] = lower[i, k]
