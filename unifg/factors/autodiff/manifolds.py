"""Manifolds on symbols: the closed forms where there are some, else what a manifold states, run on symbols.

A group of one's own states compiled functions of one element, or methods for batches; both are run as any other
function that is traced. Points are moved by

    x Exp(d) = m(x, e + E d + B(d, d) / 2 + ...),   E = dExp(0),   B(a, b) = (m_12(E a, E b) + m_12(E b, E a)) / 2

with m_12 the mixed second derivative of the product m at (e, e): Exp(s d) Exp(t d) = Exp((s + t) d) differentiated by s
and t. First derivatives of the exponential are all this takes, so that one which is a short series, or a constant below
a threshold, near zero has exact second derivatives all the same. A manifold that is no group is moved by its retraction
as it is written. What comes out is compared with the manifold's own retraction, once.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from types import FunctionType
from typing import Any, TypeAlias, cast

import numpy as np

from unifg.factors.autodiff.branches import every_way
from unifg.factors.autodiff.calculus import hessian, jacobian
from unifg.factors.autodiff.groups import GROUPS, closed_form, moved_closed
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import Symbol, Symbols, TraceError, holds_symbols, node_of, symbols
from unifg.factors.autodiff.tape import Tape
from unifg.lie import LieGroup, Manifold, Product
from unifg.lie.elementwise import LAYOUTS, MATRIX, POINT, stated
from unifg.typing import Array

Source: TypeAlias = Callable[[Any], Callable[..., Any]]
"""Makes of a function one that can be run on symbols."""
Numbers: TypeAlias = Sequence[Any]
NEAR = 1e-3  # step of the differences that a retraction is compared by
POINTS = 2
CLOSE = 1e-5  # how well they agree
_ways: dict[Hashable, Callable[..., list[Any]] | None] = {}  # how the points of a manifold are moved rightly

_exponentials: dict[Hashable, tuple[Array, Array]] = {}  # their derivatives at zero


def stated_closed() -> dict[int, Callable[..., None]]:
    """The compiled functions of the groups here, by their ids, as closed forms that write symbols."""

    def writer(closed: Callable[..., Any]) -> Callable[..., None]:
        def write(*arguments: Any) -> None:
            *given, out = arguments
            out[...] = np.array(closed(*(list(part) for part in given)), dtype=object)

        return write

    found = {}
    for group in GROUPS:
        for name in LAYOUTS:
            function, closed = stated(type(group), name), closed_form(group, name)
            if function is not None and closed is not None:
                found[id(function)] = writer(closed)
    return found


class Symbolic:
    """A manifold whose methods take symbols; numbers go to the manifold itself."""

    def __init__(self, manifold: Manifold, source: Source) -> None:
        """Stand in for a manifold."""
        self._manifold, self._source = manifold, source

    def __getattr__(self, name: str) -> Any:
        """An operation on symbols, or what the manifold has of that name."""
        manifold, plain = self._manifold, getattr(self._manifold, name)
        if not callable(plain) or name.startswith("__"):
            return plain

        def method(*arguments: Any, **named: Any) -> Any:
            given = (*arguments, *named.values())
            if not any(isinstance(part, Symbol) or holds_symbols(part) for part in given):
                return plain(*map(_numbers, arguments), **{key: _numbers(part) for key, part in named.items()})
            if isinstance(manifold, Product) and name == "pack":
                return _packed(manifold, named)
            if isinstance(manifold, Product) and name == "unpack":
                return {key: arguments[0][..., part.storage] for key, part in manifold.components.items()}
            if name in LAYOUTS:
                return _over(partial(operate, manifold, name, self._source), arguments)
            if isinstance(written := getattr(type(manifold), name), FunctionType):
                return self._source(written)(self, *arguments, **named)
            raise TraceError(f"calls {manifold.name}.{name}, which cannot be traced")

        return method


def _numbers(part: Any) -> Any:
    return np.asarray(part, dtype=np.float64) if isinstance(part, Symbols) else part


def _packed(product: Product, parts: dict[str, Any]) -> Any:
    arrays = [np.asarray(parts[name], dtype=object) for name in product.components]
    shape = np.broadcast_shapes(*(array.shape[:-1] for array in arrays))
    return np.concatenate([np.broadcast_to(array, (*shape, array.shape[-1])) for array in arrays], axis=-1).view(
        Symbols
    )


def _over(one: Callable[..., Any], given: Sequence[Any]) -> Any:
    """An operation of every element of its arguments, broadcast over their leading axes."""
    arguments = [np.asarray(part, dtype=object) for part in given]
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in arguments))
    full = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in arguments]
    results = {place: np.array(one(*(list(part[place]) for part in full)), dtype=object) for place in np.ndindex(shape)}
    stacked = symbols((*shape, *next(iter(results.values())).shape))
    for place, result in results.items():
        stacked[place] = result
    return stacked


# ---------------------------------------------------------------- one element


def operate(manifold: Manifold, name: str, source: Source, *arguments: Numbers) -> Any:
    """Result of a method of a manifold for single elements, as a list or as a list of rows.

    Args:
        manifold: any.
        name: one of ``LAYOUTS``.
        source: makes functions that can be run on symbols.
        arguments: elements, tangent vectors or points.

    Raises:
        TraceError: when the method cannot be traced.
    """
    if isinstance(manifold, Product):
        return _of_product(manifold, name, source, arguments)
    closed = closed_form(manifold, name)
    if closed is not None:
        return closed(*arguments)
    function = stated(type(manifold), name)
    tape = next(item.tape for part in arguments for item in part if isinstance(item, Symbol))
    shape = tuple(getattr(manifold, size) for size in LAYOUTS[name][1])
    if function is not None:
        made = source(function)

        def run() -> list[int]:
            out = symbols(shape)
            made(*map(_vector, arguments), out)
            return [node_of(tape, entry) for entry in out.ravel()]
    else:
        made = source(getattr(type(manifold), name))

        def run() -> list[int]:
            out = made(Symbolic(manifold, source), *(_vector(part) for part in arguments))
            return [node_of(tape, entry) for entry in np.asarray(out, dtype=object).reshape(shape).ravel()]

    entries = [Symbol.of(tape, node) for node in every_way(tape, run)]
    return entries if len(shape) == 1 else [entries[k * shape[1] : (k + 1) * shape[1]] for k in range(shape[0])]


def _vector(values: Numbers) -> Any:
    vector = symbols((len(values),))
    vector[:] = values
    return vector


def _of_product(product: Product, name: str, source: Source, arguments: Sequence[Numbers]) -> Any:
    """Component by component: side by side, or as blocks on the diagonal."""
    given, result = LAYOUTS[name]
    begins = dict.fromkeys((*given, *result), 0)
    found = []
    for part in product.components.values():
        sizes = {size: getattr(part.manifold, size) for size in begins}
        if any(sizes[size] == 0 for size in begins if size in (POINT, MATRIX)):
            raise TraceError(f"calls {product.name}.{name}, which {part.manifold.name} does not have")
        cut = [
            argument[begins[size] : begins[size] + sizes[size]] for argument, size in zip(arguments, given, strict=True)
        ]
        found.append(operate(part.manifold, name, source, *cut))
        begins = {size: begin + sizes[size] for size, begin in begins.items()}
    if len(result) == 1:
        return [entry for entries in found for entry in entries]
    size, begin = begins[result[0]], 0
    rows = []
    for block in found:
        rows += [[*[0.0] * begin, *row, *[0.0] * (size - begin - len(block))] for row in block]
        begin += len(block)
    return rows


# ---------------------------------------------------------------- points moved


def moved(manifold: Manifold, point: Numbers, step: Numbers, source: Source) -> list[Any]:
    """A point moved by a small step, exact to second order: what derivatives along the retraction need.

    Args:
        manifold: of the point.
        point: storage.
        step: tangent coordinates.
        source: makes functions that can be run on symbols.

    Raises:
        TraceError: when the retraction cannot be traced, or its second derivatives are not those it has.
    """
    if isinstance(manifold, Product):
        result: list[Any] = []
        for part in manifold.components.values():
            result += moved(part.manifold, point[part.storage], step[part.tangent], source)
        return result
    closed = moved_closed(manifold, point, step)
    if closed is not None:
        return closed
    key = cast(Hashable, manifold)
    if key not in _ways:
        ways = (_by_product, _by_retraction) if isinstance(manifold, LieGroup) else (_by_retraction,)
        _ways[key] = next((way for way in ways if _is_right(manifold, way, source)), None)
    way = _ways[key]
    if way is None:
        raise TraceError(
            f"a variable lies on {manifold.name}, whose retraction as it is written has other second derivatives at "
            "zero than it has near it: a series there needs terms up to the second"
        )
    return way(manifold, point, step, source)


def _by_retraction(manifold: Manifold, point: Numbers, step: Numbers, source: Source) -> list[Any]:
    return list(operate(manifold, "retract", source, point, step))


def _by_product(group: Any, point: Numbers, step: Numbers, source: Source) -> list[Any]:
    if group not in _exponentials:
        _exponentials[group] = _exponential(group, source)
    by_step, bend = _exponentials[group]
    small = list(group.identity())
    for i in range(group.storage):
        for j in range(group.dim):
            small[i] = small[i] + by_step[i, j] * step[j]
            for k in range(j, group.dim):
                entry = bend[i, j, k] * (0.5 if j == k else 1.0)
                small[i] = small[i] + (entry * step[j] * step[k] if entry != 0.0 else 0.0)
    return list(operate(group, "compose", source, point, small))


def _exponential(group: LieGroup, source: Source) -> tuple[Array, Array]:
    """First and second derivatives of the exponential at zero, (storage, dim) and (storage, dim, dim)."""
    tape, dim, storage = Tape(), group.dim, group.storage
    step = [Symbol(tape, tape.leaf(Op.TANGENT, k)) for k in range(dim)]
    rows = [node_of(tape, entry) for entry in operate(group, "exp", source, step)]
    first = _at_rest(tape, jacobian(tape, rows, dim), (storage, dim))
    tape = Tape()
    sides = [[Symbol(tape, tape.leaf(Op.TANGENT, s * dim + k)) for k in range(dim)] for s in range(2)]
    near = [[e + sum(first[i, k] * t[k] for k in range(dim)) for i, e in enumerate(group.identity())] for t in sides]
    second = np.zeros((storage, dim, dim))
    for i, entry in enumerate(operate(group, "compose", source, *near)):
        found = _at_rest(tape, hessian(tape, [node_of(tape, entry)], 2 * dim), (2 * dim, 2 * dim))
        second[i] = 0.5 * (found[:dim, dim:] + found[:dim, dim:].T)
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise TraceError(f"the exponential of {group.name} has no derivative at zero as it is written")
    return first, second


def _at_rest(tape: Tape, entries: dict[tuple[int, int], int], shape: tuple[int, int]) -> Array:
    """Values of entries that know only tangent coordinates, where these are zero and all weights one."""
    found = np.zeros(shape)
    if entries:
        for place, value in zip(entries, tape.evaluate(list(entries.values()), (), ()), strict=True):
            found[place] = value
    return found


def _is_right(manifold: Manifold, way: Callable[..., list[Any]], source: Source) -> bool:
    """Test whether points moved this way have the derivatives that the manifold's own retraction has."""
    dim, storage = manifold.dim, manifold.storage
    tape = Tape()
    step = [Symbol(tape, tape.leaf(Op.TANGENT, k)) for k in range(dim)]
    point = [Symbol(tape, tape.leaf(Op.VARIABLE, k)) for k in range(storage)]
    try:
        rows = [node_of(tape, entry) for entry in way(manifold, point, step, source)]
    except TraceError:
        if way is _by_product:  # its exponential may be out of reach where its retraction is not
            return False
        raise
    first, second = jacobian(tape, rows, dim), [hessian(tape, [row], dim) for row in rows]
    units, pairs = NEAR * np.eye(dim), [(j, k) for j in range(dim) for k in range(j, dim)]
    corners = np.array([a * units[j] + b * units[k] for j, k in pairs for a, b in _CORNERS])
    for x in np.asarray(manifold.random(np.random.default_rng(0), (POINTS,)), dtype=np.float64):
        moved_there = np.asarray(manifold.retract(x, corners)).reshape(len(pairs), len(_CORNERS), storage)
        bend = np.einsum("c,pcs->ps", _SIGNS, moved_there) / (4.0 * NEAR**2)
        slope = np.asarray(manifold.retract(x, units)) - np.asarray(manifold.retract(x, -units))
        scale = 1.0 + float(np.abs(x).max())
        values = dict(zip(first, tape.evaluate(list(first.values()), x.tolist(), ()), strict=True))
        found = np.array([[values.get((i, k), 0.0) for i in range(storage)] for k in range(dim)])
        if not np.abs(found - slope / (2.0 * NEAR)).max() <= CLOSE * scale:
            return False
        for i, entries in enumerate(second):
            values = dict(zip(entries, tape.evaluate(list(entries.values()), x.tolist(), ()), strict=True))
            if not np.abs(np.array([values.get(pair, 0.0) for pair in pairs]) - bend[:, i]).max() <= CLOSE * scale:
                return False
    return True


_CORNERS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])
