"""Traces of functions of one factor, and of batched ones: the row structure from traces of batches of several rows.

A kernel stands for a batched function if every row of the result is the same expression of that row's own arguments.
Distinct symbols stand for the rows of each argument, so that this is seen in the expressions; no numbers are involved.
A trace at two lengths serves batches of any length, unless the function reads the length for more than making arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, TypeAlias

import numpy as np

from unifg.codegen.fingerprint import is_compiled
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.manifolds import moved
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import Length, Symbol, Symbols, TraceError, node_of, symbols
from unifg.factors.autodiff.tables import Interpolator, kind_of
from unifg.factors.autodiff.tape import Tape
from unifg.factors.autodiff.trace import Rebound, run
from unifg.factors.kernel import Argument
from unifg.lie import Manifold
from unifg.typing import Array

SHORTEST = 2  # rows of a batch


@dataclass(frozen=True)
class Common:
    """A variable that all factors share."""

    manifold: Manifold


@dataclass(frozen=True)
class Each:
    """An argument with a row for each factor; ``shape`` is that of a row."""

    shape: tuple[int, ...]


@dataclass(frozen=True)
class Shared:
    """An argument that all factors share, whose numbers may change."""

    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Fixed:
    """An argument that all factors share and that a trace fixes; ``key`` tells it from others, None if nothing can."""

    value: Any
    key: Hashable | None


Given: TypeAlias = Manifold | Common | Each | Shared | Fixed


class RowsError(TraceError):
    """Rows of a batch that are not the same expression of their own arguments.

    Attributes:
        row: the first such row.
        mixed: places of inputs other rows of which it depends on.
    """

    def __init__(self, message: str, row: int, mixed: frozenset[int] = frozenset()) -> None:
        """State which row depends on what."""
        super().__init__(message)
        self.row, self.mixed = row, mixed


def argument_of(part: Given) -> Argument | None:
    """Kernel argument that stands for a term's argument; None where it is compiled in."""
    if isinstance(part, Fixed):
        return None
    if isinstance(part, Each | Shared):
        return part.shape
    return part.manifold if isinstance(part, Common) else part


def lengths_for(given: Sequence[Given]) -> tuple[int, int]:
    """The two shortest lengths of a batch that are no dimension of an argument, so that axes are told apart."""
    sizes: set[int] = set()
    for part in given:
        argument = argument_of(part)
        shape = np.shape(part.value) if isinstance(part, Fixed) and isinstance(part.value, np.ndarray) else argument
        sizes.update(shape if isinstance(shape, tuple) else () if shape is None else (shape.storage,))  # type: ignore[union-attr]
    first, second = [n for n in range(SHORTEST, SHORTEST + len(sizes) + 2) if n not in sizes][:2]
    return first, second


def traced(function: Callable[..., Any], arguments: Sequence[Argument], rows: int = 0, name: str = "") -> Expression:
    """Run a function once and keep what it computes.

    Args:
        function: batched NumPy, ``(1, storage)`` arrays of variables and ``(1, ...)`` arrays of parameters to
            ``(1, m)``; or compiled for one factor.
        arguments: the manifold of each variable, the shape of each parameter for one factor.
        rows: m of a compiled function.
        name: for messages.

    Raises:
        TraceError: the function does what cannot be traced, or returns another shape.
    """
    inputs: list[Given] = []
    for argument in arguments:
        if isinstance(argument, int):
            raise TraceError("the shape of a parameter is not known")
        inputs.append(Each(argument) if isinstance(argument, tuple) else argument)
    batch, rebound, single = _Batch(inputs), Rebound(), is_compiled(function)
    given = batch.arrays(1, rebound)
    if single:
        given = [array[0] for array in given]
    result = np.asarray(run(function, given, batch.tape, rebound, rows), dtype=object)
    if not single and (result.ndim != 2 or len(result) != 1):
        raise TraceError(f"returns an array of shape {result.shape} for one factor, expected (1, m)")
    nodes = tuple(node_of(batch.tape, e) for e in result.ravel())
    return Expression(batch.tape, nodes, batch.width, name or "residual", tuple(_conjuncts(batch.tape)))


def traced_rows(
    function: Callable[..., Any],
    given: Sequence[Given],
    reached: Sequence[tuple[Array, bool]],
    lengths: Sequence[int],
    scalar: bool = False,
    name: str = "",
) -> Expression:
    """Expression of one row of a batched function.

    Args:
        function: batched NumPy.
        given: what stands in the place of each argument.
        reached: arrays that the function has names for and that are parameters too, and whether each has a row for
            every factor.
        lengths: of the batches that are traced; of several, the expression holds for batches of any length.
        scalar: whether the function returns (n,) instead of (n, m).
        name: for messages.

    Raises:
        RowsError: rows depend on rows of other factors, or differ.
        TraceError: the function does what cannot be traced, or returns another shape.
    """
    inputs = [*given, *(Each(array.shape[1:]) if each else Shared(array.shape) for array, each in reached)]
    batch = _Batch(inputs)
    found: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    for length in lengths:
        results, used = batch.run(function, length, [array for array, _ in reached], scalar, len(lengths) > 1)
        demands = batch.required(length)
        rows = [batch.canonical(row, nodes, demands[row]) for row, nodes in enumerate(results)]
        if used:
            raise RowsError("its rows may depend on which factor they belong to, by the length of the batch", 0)
        found = found or rows[0]
        if other := [row for row, nodes in enumerate(rows) if nodes != found]:
            raise RowsError("its rows depend on which factor they belong to", other[0])
    assert found is not None
    return Expression(batch.common, found[0], batch.width, name or "residual", found[1])


class _Batch:
    """Symbols for all rows of all inputs: row r of place p is leaf ``r * total + p``, of a shared input leaf p."""

    def __init__(self, inputs: Sequence[Given]) -> None:
        """Number the leaves of one row."""
        self.inputs = inputs
        self.tape, self.common = Tape(), Tape()
        self.common.tables = self.tape.tables
        self.owners: dict[Op, list[int]] = {Op.VARIABLE: [], Op.TANGENT: [], Op.PARAMETER: []}
        self.starts: list[tuple[int, int]] = []
        for place, part in enumerate(inputs):
            argument = argument_of(part)
            self.starts.append((len(self.owners[Op.VARIABLE]), len(self.owners[Op.TANGENT])))
            if isinstance(argument, tuple):
                self.starts[-1] = len(self.owners[Op.PARAMETER]), 0
                self.owners[Op.PARAMETER] += [place] * prod(argument)
            elif argument is not None:
                assert not isinstance(argument, int)
                self.owners[Op.VARIABLE] += [place] * argument.storage
                self.owners[Op.TANGENT] += [place] * argument.dim
        self.width = len(self.owners[Op.TANGENT])

    def run(
        self, function: Callable[..., Any], length: int, reached: Sequence[Array], scalar: bool, any_length: bool
    ) -> tuple[list[list[int]], bool]:
        """Nodes of the (length, m) result; whether the length was used for more than making arrays."""
        rebound = Rebound()
        arrays = self.arrays(length, rebound)
        first = len(arrays) - len(reached)
        for array, numbers in zip(reached, arrays[first:], strict=True):
            rebound.given[id(array)] = numbers
        kept = [(k, a, list(a.flat)) for k, a in enumerate(arrays[:first]) if isinstance(a, Symbols)]
        Length.batch, Length.used = length if any_length else 0, False
        self.tape.required.clear()
        try:
            result = np.asarray(run(function, arrays[:first], self.tape, rebound), dtype=object)
            used = Length.used
        finally:
            Length.batch, Length.used = 0, False
        for place, array, entries in kept:
            if any(now is not before for now, before in zip(array.flat, entries, strict=True)):
                raise TraceError(f"it changes its argument {place}")
        if result.ndim != (1 if scalar else 2) or len(result) != length:
            raise TraceError(f"returns an array of shape {result.shape} for {length} factors")
        return [[node_of(self.tape, entry) for entry in row] for row in result.reshape(length, -1)], used

    def arrays(self, length: int, rebound: Rebound) -> list[Any]:
        """Arguments of a batch of some length."""
        return [self._array(place, length, rebound) for place in range(len(self.inputs))]

    def _array(self, place: int, length: int, rebound: Rebound) -> Any:
        """The argument of one input."""
        part, (start, column) = self.inputs[place], self.starts[place]
        if isinstance(part, Fixed):
            return Interpolator(part.value) if kind_of(part.value) else part.value
        if isinstance(part, Shared):
            array = self._parameters(part.shape, [start])
            return array if part.shape else array.item()
        if isinstance(part, Each):
            total = len(self.owners[Op.PARAMETER])
            firsts = [row * total + start for row in range(length)]
            return self._parameters(part.shape, firsts).reshape(length, *part.shape)
        manifold, own = (part.manifold, 0) if isinstance(part, Common) else (part, 1)
        totals = len(self.owners[Op.VARIABLE]), self.width
        points = symbols((length, manifold.storage))
        for row in range(length):
            at, along = own * row * totals[0] + start, own * row * totals[1] + column
            point = [Symbol(self.tape, self.tape.leaf(Op.VARIABLE, at + k)) for k in range(manifold.storage)]
            step = [Symbol(self.tape, self.tape.leaf(Op.TANGENT, along + k)) for k in range(manifold.dim)]
            try:
                points[row] = moved(manifold, point, step, rebound.callable)
            except TraceError:
                raise
            except Exception as error:  # of a manifold of the user's own
                raise TraceError(f"a variable lies on {manifold.name}: {type(error).__name__}: {error}") from error
        return points

    def _parameters(self, shape: tuple[int, ...], firsts: Sequence[int]) -> Any:
        """Parameters that begin at some places, one array of that shape after the other."""
        size = prod(shape)
        array = symbols((len(firsts) * size,))
        for k in range(len(array)):
            place = firsts[k // size] + k % size
            array[k] = Symbol(self.tape, self.tape.leaf(Op.PARAMETER, place))
        return array.reshape(shape) if len(firsts) == 1 else array

    def required(self, length: int) -> list[list[int]]:
        """For every row the conditions about it without which the function raises an exception.

        Raises:
            TraceError: a condition is about several rows.
        """
        tape, found = self.tape, [list[int]() for _ in range(length)]
        for node in _conjuncts(tape):
            about = set[int]()
            for i in tape.live([node]):
                if tape.op[i] in (Op.VARIABLE, Op.TANGENT, Op.PARAMETER):
                    owners = self.owners[Op(tape.op[i])]
                    if not isinstance(self.inputs[owners[tape.a[i] % len(owners)]], Shared | Common):
                        about.add(tape.a[i] // len(owners))
            if len(about) > 1:
                raise TraceError("asserts something about several factors together")
            for row in about or range(length):
                found[row].append(node)
        return found

    def canonical(
        self, row: int, nodes: Sequence[int], required: Sequence[int] = ()
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Nodes of a row, and its conditions, on the tape that all rows share, its own leaves those of row 0.

        Raises:
            RowsError: it depends on leaves of other rows.
        """
        tape, common = self.tape, self.common
        place: dict[int, int] = {}
        mixed: set[int] = set()
        for i in tape.live([*nodes, *required]):
            op, a, b, c = tape.op[i], tape.a[i], tape.b[i], tape.c[i]
            if op == Op.CONSTANT:
                place[i] = common.constant(tape.value[i])
            elif op <= Op.TANGENT:
                owners = self.owners[Op(op)]
                at, own = a % len(owners), a // len(owners)
                if own != row and not isinstance(self.inputs[owners[at]], Shared | Common):
                    mixed.add(owners[at])
                place[i] = common.leaf(Op(op), at)
            else:
                place[i] = common.apply(op, place[a], place[b] if b >= 0 else -1, place[c] if c >= 0 else -1)
        if mixed:
            raise RowsError("its rows depend on rows of other factors", row, frozenset(mixed))
        return tuple(place[i] for i in nodes), tuple(sorted({place[i] for i in required}))


def _conjuncts(tape: Tape) -> list[int]:
    """Conditions that all hold if and only if the required ones do: those of a row stand alone then."""
    found, waiting = dict[int, None](), list(tape.required)
    while waiting:
        node = waiting.pop()
        inner = tape.a[node] if tape.op[node] == Op.NOT else -1
        if tape.op[node] == Op.AND:
            waiting += [tape.b[node], tape.a[node]]
        elif inner >= 0 and tape.op[inner] == Op.OR:
            waiting += [tape.apply(Op.NOT, tape.b[inner]), tape.apply(Op.NOT, tape.a[inner])]
        elif inner >= 0 and tape.op[inner] == Op.NOT:
            waiting.append(tape.a[inner])
        elif not (tape.is_constant(node) and tape.value[node] != 0.0):
            found[node] = None
    return list(found)
