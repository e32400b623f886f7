"""From a manifold to the compiled functions of its points, which solvers and smoothers run.

They stand on the methods of its class, where :func:`unifg.lie.elementwise.elementwise` put them; nothing is registered
anywhere else, and a subclass inherits or replaces them with the methods. The functions of a product are made from those
of its components. It is taken apart down to manifolds that are no products; then the functions of the last two become
those of their pair, this pair and the component before it a pair again, and so on to the front. The compiler copies
them into one another, so the nesting costs nothing at run time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable
from functools import cache
from typing import Any, cast

from unifg.codegen.calls import local_matrix, vector
from unifg.codegen.jit import compiled
from unifg.lie.defaults import RULES
from unifg.lie.elementwise import DIM, LAYOUTS, MATRIX, POINT, STORAGE, Scalar, stated, stated_in
from unifg.lie.manifold import Manifold
from unifg.lie.product import leaves
from unifg.typing import Array

LOG_BETWEEN = "log_between"
KNOWN = {**LAYOUTS, LOG_BETWEEN: LAYOUTS["local"]}


class Functions:
    """Compiled functions of one element, by the names of the manifold's methods: ``functions.retract(x, d, out)``.

    One name more, ``log_between(x, y, out)``, is Log(x^-1 y) of groups: their ``local``, but where a subclass takes
    other steps.

    Attributes:
        name: of the manifold.
    """

    def __init__(self, name: str, find: Callable[[str], Scalar | None]) -> None:
        """Look each one up when it is first asked for."""
        self.name, self._find = name, find

    def __getattr__(self, name: str) -> Any:
        """Find a function.

        Raises:
            AttributeError: when the manifold states none; ``hasattr`` asks.
        """
        found = self._find(name) if name in KNOWN else None
        if found is None:
            raise AttributeError(f"{self.name} has no compiled {name}: state it by fg.elementwise")
        setattr(self, name, found)
        return found


def functions_of(manifold: Manifold) -> Functions | None:
    """The compiled functions of a manifold; None where its points are moved by NumPy alone, or a part's are."""
    return _functions(cast(Hashable, manifold))


@cache
def _functions(manifold: Hashable) -> Functions | None:
    """Made once for all equal manifolds."""
    parts = [(leaf, _of_leaf(leaf)) for leaf, _, _ in leaves(cast(Manifold, manifold))]
    complete = all(hasattr(functions, "retract") and hasattr(functions, "local") for _, functions in parts)
    return _side_by_side(parts) if complete else None


def _of_leaf(leaf: Manifold) -> Functions:
    kind = type(leaf)

    def find(name: str) -> Scalar | None:
        if name != LOG_BETWEEN:
            return stated(kind, name)
        if stated_in(kind, "local") is stated_in(kind, "log"):
            return stated(kind, "local")
        between, log = stated(kind, "between"), stated(kind, "log")
        return None if between is None or log is None else RULES["local"].make(leaf.storage, leaf.dim, between, log)

    return Functions(leaf.name, find)


Part = tuple[Manifold, Functions]


def _side_by_side(parts: list[Part]) -> Functions:
    """The functions of a product, but ``act`` and ``matrix``: nothing compiled moves points by a product."""
    (first, head), rest = parts[0], parts[1:]
    if not rest:
        return head
    tail = _side_by_side(rest)
    sizes = {size: (getattr(first, size), sum(getattr(leaf, size) for leaf, _ in rest)) for size in (STORAGE, DIM)}
    # The cache on disk tells functions apart by their names and those of their callees, in no order.
    label = "_".join(re.sub(r"\W", "_", f"{leaf.name}_{leaf.dim}") for leaf, _ in parts)

    def find(name: str) -> Scalar | None:
        given, result = KNOWN[name]
        if {POINT, MATRIX} & {*given, *result} or not (hasattr(head, name) and hasattr(tail, name)):
            return None
        places = [sizes[size] for size in (*given, result[0])]
        make = (_one, _two)[len(given) - 1] if len(result) == 1 else (_square_of_one, _square_of_two)[len(given) - 1]
        pair = make(getattr(head, name), getattr(tail, name), *places)
        pair.__qualname__ = f"{name}_{label}"
        return compiled(pair)

    return Functions(label, find)


Sizes = tuple[int, int]


def _one(head: Scalar, tail: Scalar, of_x: Sizes, of_out: Sizes) -> Scalar:
    """``f(x, out)`` of a pair: the first part, then all others."""
    (x1, x2), (out1, out2) = of_x, of_out

    def pair(x: Array, out: Array) -> None:
        head(vector(x, 0, x1), vector(out, 0, out1))
        tail(vector(x, x1, x2), vector(out, out1, out2))

    return pair


def _two(head: Scalar, tail: Scalar, of_x: Sizes, of_y: Sizes, of_out: Sizes) -> Scalar:
    """``f(x, y, out)`` of a pair."""
    (x1, x2), (y1, y2), (out1, out2) = of_x, of_y, of_out

    def pair(x: Array, y: Array, out: Array) -> None:
        head(vector(x, 0, x1), vector(y, 0, y1), vector(out, 0, out1))
        tail(vector(x, x1, x2), vector(y, y1, y2), vector(out, out1, out2))

    return pair


def _square_of_one(head: Scalar, tail: Scalar, of_x: Sizes, of_out: Sizes) -> Scalar:
    """``f(x, out)`` with square blocks."""
    (x1, x2), (n1, n2) = of_x, of_out

    def pair(x: Array, out: Array) -> None:
        upper, lower = local_matrix(n1, n1), local_matrix(n2, n2)
        head(vector(x, 0, x1), upper)
        tail(vector(x, x1, x2), lower)
        write_blocks(upper, lower, out)

    return pair


def _square_of_two(head: Scalar, tail: Scalar, of_x: Sizes, of_y: Sizes, of_out: Sizes) -> Scalar:
    """``f(x, y, out)`` with square blocks."""
    (x1, x2), (y1, y2), (n1, n2) = of_x, of_y, of_out

    def pair(x: Array, y: Array, out: Array) -> None:
        upper, lower = local_matrix(n1, n1), local_matrix(n2, n2)
        head(vector(x, 0, x1), vector(y, 0, y1), upper)
        tail(vector(x, x1, x2), vector(y, y1, y2), lower)
        write_blocks(upper, lower, out)

    return pair


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
