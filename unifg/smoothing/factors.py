"""From what a user states to the numbers compiled code reads: types of factors, and the parts of manifolds.

A statement is a cost like those of a graph, and the first of its kind is compiled as a graph compiles it
(:class:`unifg.problem.term.CompiledTerm`), with the same demands and messages. After that the kernel is known, and the
next statement only lays out its numbers. What a traced function reaches counts as it is when the factor is stated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.factors.autodiff.captured import Captured, captured_by
from unifg.factors.kernel import Kernel, side_by_side
from unifg.factors.residuals import Residual
from unifg.factors.robust import QUADRATIC, Form, Loss, form_of
from unifg.factors.whitening import whitener_of
from unifg.lie import Manifold
from unifg.lie.product import leaves
from unifg.lie.retraction import ADDITION, move_of
from unifg.modeling.duplicates import doubles
from unifg.modeling.elements import elements_of, nearest, on_manifolds, quaternions_of
from unifg.modeling.factors import prior
from unifg.modeling.model import AnyResidual, complete
from unifg.modeling.probing import rows_of
from unifg.modeling.terms import Cost, Parameter, prepare_arguments
from unifg.modeling.variables import Data, Family, ParameterLike, Selection, undeclared
from unifg.modeling.weights import require_loss
from unifg.problem.columns import Columns
from unifg.problem.term import CompiledTerm
from unifg.problem.traced import Trace, reach_of_value
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.repeated import Key, Kind, key_of, numbers_of
from unifg.smoothing.state import BY_PYTHON, TYPE
from unifg.typing import Array, BoolArray, IntArray

REMEMBERED = 256  # kinds of statements
PLAIN: Form = (QUADRATIC, 0.0, 0.0)
FIELD = {name: place for place, name in enumerate(TYPE.names or ())}
NOBODY = np.zeros(0, dtype=np.int64)


@dataclass(eq=False)
class Staged:
    """Factors that wait for the next update.

    Attributes:
        kind: number of their type.
        families: of their variables, in order.
        members: (n,) for each family, or (1,) where all factors share it.
        data: (n, numbers) parameters and whitener.
        name: for messages.
        term: what evaluates them, where that is Python.
        items: (n,) their numbers within it.
        reach: what a function in Python read when they were stated.
    """

    kind: int
    families: list[GrowingFamily]
    members: list[IntArray]
    data: Array
    name: str
    term: CompiledTerm | None = None
    items: IntArray = field(default_factory=lambda: NOBODY)
    limit: float = 0.0
    reach: Captured | None = None

    def keep(self, wanted: BoolArray) -> None:
        """Leave out the others."""
        self.members = [m if len(m) == 1 else m[wanted] for m in self.members]
        self.data = self.data[wanted]
        self.items = self.items[wanted] if len(self.items) else self.items


class Types:
    """The types of factors of one smoother: a kernel, what it reads, how it is whitened, its loss.

    Attributes:
        fields: one row for each type, as TYPE has them.
        slots: one row for each variable of each type, as SLOT has them.
        scratch: numbers that any of them needs while it is evaluated.
    """

    def __init__(self) -> None:
        """Know none."""
        self.fields: list[tuple[float, ...]] = []
        self.slots: list[tuple[int, ...]] = []
        self.scratch = 8
        self._numbers: dict[tuple[Any, ...], int] = {}  # by kernels, which are kept: compiled code has their addresses
        self._last_read: tuple[Callable[..., Any] | None, Captured | None] = None, None
        self._kernels: dict[tuple[Any, ...], tuple[Kernel, Residual, Trace | None]] = {}
        self._kinds: dict[Key, Kind] = {}  # of single factors

    def __getstate__(self) -> dict[str, Any]:
        """Copy without what is found by the ids of objects, which are others in a copy."""
        return {**self.__dict__, "_kernels": {}, "_kinds": {}, "_last_read": (None, None)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The kernels of a copy stand elsewhere."""
        self.__dict__.update(state)
        for (kernel, *_), number in self._numbers.items():
            row, (where, table, size) = self.fields[number], _places(kernel)
            self.fields[number] = (where, *row[1:6], table, size, *row[8:])

    def stage(
        self,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        sigma: ParameterLike | None,
        information: ParameterLike | None,
        robust: Loss | None,
        active: Any,
        given: str | None,
    ) -> Staged:
        """Lay out the numbers of a statement, which is checked unless one more factor of a kind is stated.

        Raises:
            GraphError: naming the term and what does not fit.
        """
        key = key_of(function, arguments, sigma, information, robust, given) if active is None else None
        kind = self._kinds.get(key) if key is not None else None
        if kind is not None:
            data = numbers_of(kind, arguments, sigma, information)
            if data is not None:
                members = [arguments[place].indices for place in kind.variables]
                return Staged(kind.number, kind.families, members, data, kind.name)
        staged, trace = self._looked_at(function, arguments, sigma, information, robust, active, given)
        if key is not None and staged.term is None and (trace is None or not trace.reached):
            self._learn(key, function, arguments, staged, trace)
        return staged

    def _learn(
        self, key: Key, function: AnyResidual, arguments: tuple[Any, ...], staged: Staged, trace: Trace | None
    ) -> None:
        """Keep what the next factor of its kind needs."""
        inputs = tuple(range(len(arguments))) if trace is None else trace.inputs
        variables = tuple([place for place in inputs if isinstance(arguments[place], Selection)])
        if len(variables) != len(staged.families) or (trace is not None and _compiled_in(trace, arguments)):
            return
        parameters, quaternions, at = [], [], 0
        elements = elements_of(complete(function, arguments))
        for place in inputs:
            if place not in variables:
                found = quaternions_of(elements[place]) if place in elements else []
                if found is None:
                    return
                quaternions += [at + start for start in found]
                parameters.append((place, at, at + arguments[place].size))
                at += arguments[place].size
        row = self.fields[staged.kind]
        whitening, size = int(row[FIELD["whitening"]]), int(row[FIELD["rows"]])
        if len(self._kinds) >= REMEMBERED:
            self._kinds.clear()
        self._kinds[key] = Kind(
            staged.kind, staged.families, variables, tuple(parameters), whitening, size, at, staged.data.shape[1],
            staged.name, function, trace, tuple(quaternions),
        )  # fmt: skip

    def _looked_at(
        self,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        sigma: ParameterLike | None,
        information: ParameterLike | None,
        robust: Loss | None,
        active: Any,
        given: str | None,
    ) -> tuple[Staged, Trace | None]:
        """Check a statement and lay out its numbers; what was traced comes with them."""
        wrapped = complete(function, arguments, given)
        name = given or wrapped.name
        if sigma is not None and information is not None:
            raise GraphError(f"term '{name}': give sigma or information, not both", term=name)
        if robust is not None:
            require_loss(name, robust)
        stated: tuple[Any, Any] = undeclared(name, "sigma", sigma, 2), undeclared(name, "information", information, 3)
        normal, rows, active, count = prepare_arguments(name, arguments, active)
        normal = on_manifolds(name, wrapped, normal, active)
        selections = [argument for argument in normal if isinstance(argument, Selection)]
        families: list[GrowingFamily] = []
        for selection in selections:
            if not isinstance(selection.family, GrowingFamily):
                raise GraphError(
                    f"term '{name}': family '{selection.family.name}' belongs to another graph",
                    term=name,
                    family=selection.family.name,
                )
            families.append(selection.family)
        members = [selection.indices for selection in selections]
        form = form_of(robust)
        key = self._key(wrapped, normal, rows, count)
        known = self._kernels.get(key) if form is not None else None
        if known is None or (known[2] is not None and known[2].outdated):
            size = rows_of(name, wrapped, normal, count)
            alone = _by_itself(normal)
            term = _compiled(Cost(name, wrapped, alone, None, count, size, *stated, robust, rows=rows))
            kernel = term.kernel
            if kernel is not None and len(kernel.manifolds) > len(selections):
                kernel = kernel.knowing([k for k, a in enumerate(normal) if not isinstance(a, Selection)])
            if kernel is None or form is None:
                rest = np.zeros((count, 0))
                kind = self._kind(None, (0, 0, 0, term.size), selections, (), *PLAIN)
                term.named = selections[0]  # its own families begin at zero
                staged = Staged(kind, families, members, rest, name, term, np.arange(count))
                staged.reach = None if term.kernel else self._read_by(wrapped.function)
                return _active(staged, active), None
            known = kernel, wrapped, term.trace
            if term.trace is None or not _compiled_in(term.trace, normal):
                if len(self._kernels) >= REMEMBERED:  # functions made anew for each statement are not kept for ever
                    self._kernels.clear()
                self._kernels[key] = known
        (kernel, _, trace), form = known, form or PLAIN
        values = [argument.value if isinstance(argument, Data) else argument for argument in normal]
        for place, manifold in elements_of(wrapped).items():
            if isinstance(normal[place], Data):
                what = f"term '{name}': argument {place} of {wrapped.name}"
                values[place] = nearest(what, manifold, values[place], None, name)
        filled = [np.empty((1, a.manifold.storage)) if isinstance(a, Selection) else a for a in values]
        if trace is not None:
            filled = trace.arguments(filled)
        try:
            _, parameters, _ = kernel.split(filled, count)
        except GraphError as error:
            raise GraphError(f"term '{name}': {error}", term=name) from None
        shapes = tuple([parameter.shape[1:] for parameter in parameters])
        size = kernel.size(shapes)
        weights = _numbers(name, "sigma", stated[0]), _numbers(name, "information", stated[1])
        whitening, whitener = whitener_of(name, *weights, count, size)
        data = side_by_side([*parameters, whitener.reshape(len(whitener), -1)], count)
        finite = np.isfinite(data).all(axis=1)
        if not finite.all():
            index = int(np.argmin(finite))
            raise GraphError(f"term '{name}': a parameter of factor {index} is not finite", term=name, index=index)
        counts = data.shape[1] - whitener[0].size, data.shape[1], whitening, size
        kind = self._kind(kernel, counts, selections, shapes, *form)
        return _active(Staged(kind, families, members, data, name), active), trace

    def _read_by(self, function: Callable[..., Any]) -> Captured:
        """Reach of a function in Python, looked for again only if that has changed since the last factor."""
        last, reach = self._last_read
        if last is not function or reach is None or reach.changed:
            reach = captured_by(function)
            self._last_read = function, reach
        return reach

    def _kind(
        self,
        kernel: Kernel | None,
        counts: tuple[int, int, int, int],
        selections: Sequence[Selection],
        shapes: tuple[tuple[int, ...], ...],
        loss: int,
        first: float,
        second: float,
    ) -> int:
        """Number of a type."""
        parameters, numbers, whitening, size = counts
        reads = tuple([(s.storage.start, s.manifold.storage, s.tangent.start, s.manifold.dim) for s in selections])
        key = kernel, counts, reads, shapes, loss, first, second
        kind = self._numbers.get(key)
        if kind is not None:
            return kind
        width = sum(read[3] for read in reads)
        storage = sum(read[1] for read in reads) + max(s.family.manifold.storage for s in selections)
        self.scratch = max(self.scratch, storage + size * (1 + width) + 8)
        where, table, table_size = _places(kernel)
        self.fields.append(
            (
                where, size, len(self.slots), len(reads), width, parameters, table, table_size, whitening, loss,
                numbers, first, second,
            )
        )  # fmt: skip
        self.slots += reads
        self._numbers[key] = len(self.fields) - 1
        return len(self.fields) - 1

    def _key(
        self, wrapped: Residual, arguments: Sequence[Any], rows: tuple[bool | None, ...], count: int
    ) -> tuple[Any, ...]:
        """Key of statements that share a kernel."""
        kernel = wrapped.kernel
        if kernel is None and not wrapped.rows:  # what a trace makes of constants depends on all of this
            stated = [a.manifold if isinstance(a, Selection) else _told(a) for a in arguments]
            return id(wrapped.function), id(wrapped.jacobian), wrapped.derivatives, count, rows, *stated
        parts: list[Any] = [
            id(kernel) if kernel is not None else (id(wrapped.function), id(wrapped.jacobian), wrapped.rows),
            rows,
        ]
        for argument in arguments:
            if isinstance(argument, Selection):
                parts.append(argument.manifold)
            else:
                shape = argument.value.shape if isinstance(argument, Data) else np.shape(argument)
                parts.append(("each", shape[1:]) if count > 1 and shape[:1] == (count,) else shape)
        return tuple(parts)


def _places(kernel: Kernel | None) -> tuple[int, int, int]:
    """Addresses of machine code and table of a kernel, and the length of the table."""
    if kernel is None:
        return 0, NOBODY.ctypes.data, 0
    return kernel.address, kernel.table.ctypes.data, kernel.table.size


def _by_itself(arguments: Sequence[Any]) -> tuple[Any, ...]:
    """The same arguments with a family for each selection that has as many members as the selection."""
    result = []
    for argument in arguments:
        if isinstance(argument, Selection):
            family = Family(argument.family.name, argument.family.manifold, len(argument))
            result.append(Selection(family, np.arange(len(argument)), argument.component))
        else:
            result.append(argument)
    return tuple(result)


def _compiled_in(trace: Trace, arguments: Sequence[Any]) -> bool:
    """Test whether floats among the arguments are part of a trace and not its parameters."""
    others = [argument for place, argument in enumerate(arguments) if place not in trace.inputs]
    return any(isinstance(a, Data) or np.asarray(a).dtype.kind == "f" for a in others)


def _told(argument: Any) -> Any:
    """Key of a constant that a trace treats differently from others."""
    if isinstance(argument, Data):
        return argument.value.shape, argument.value.dtype
    if isinstance(argument, float | np.floating | np.ndarray) and np.asarray(argument).dtype.kind == "f":
        return np.shape(argument), "float"
    return reach_of_value(argument) or id(argument)


def _compiled(cost: Cost) -> CompiledTerm:
    """Compile a statement; refuse a function that changes its arguments or leaves rows out, looking at identities."""
    families = [selection.family for selection in cost.selections]
    columns = Columns(families, ())
    term = CompiledTerm(cost, columns)
    identities = {family: np.tile(family.manifold.identity(), (family.count, 1)) for family in families}
    values = columns.values(identities)
    term.require_clean(values)
    term.stands(values)
    if term.trace is not None and term.trace.kernel.expression.required:
        term.leave("it asserts something about its arguments, and smoothers verify no answers")
    return term


def _active(staged: Staged, active: Any) -> Staged:
    """Leave out what is not active: nothing can switch it on later."""
    if active is not None:
        staged.keep(np.asarray(active.value if isinstance(active, Data) else active, dtype=bool))
    return staged


def _numbers(name: str, which: str, parameter: Parameter | None) -> Array | None:
    """The present value of a parameter of a term; None where there is none."""
    if parameter is None:
        return None
    return parameter.value if isinstance(parameter, Data) else doubles(f"term '{name}': {which}", parameter, term=name)


class Parts:
    """The parts of a smoother's manifolds, as compiled code reads them.

    Attributes:
        fields: one row for each part, as PART has them.
    """

    def __init__(self) -> None:
        """Know none."""
        self.fields: list[tuple[int, ...]] = []
        self._known: list[tuple[Manifold, tuple[int, int]]] = []
        self._kept: list[Any] = []  # addresses are good for as long as the functions live

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the manifolds; their functions stand elsewhere in a copy."""
        return {"manifolds": [manifold for manifold, _ in self._known]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Find them again, in the same places."""
        self.__init__()  # type: ignore[misc]
        for manifold in state["manifolds"]:
            self.of(manifold)

    def of(self, manifold: Manifold) -> tuple[int, int]:
        """First part of a manifold, and how many it has; the whole is one part where NumPy has to move it."""
        for known, place in self._known:
            if known == manifold:
                return place
        rows: list[tuple[int, ...]] = []
        for leaf, storage, tangent in leaves(manifold):
            move, kernel = move_of(leaf), prior.on(leaf).kernel
            if move is None or kernel is None:
                rows = [(BY_PYTHON, BY_PYTHON, 0, manifold.storage, 0, manifold.dim)]
                break
            self._kept += [move.function, kernel]
            deviation = 0 if move.where == ADDITION else kernel.address
            rows.append((move.where, deviation, storage, leaf.storage, tangent, leaf.dim))
        place = len(self.fields), len(rows)
        self.fields += rows
        self._known.append((manifold, place))
        return place

    def by_python(self, place: tuple[int, int]) -> bool:
        """Test whether NumPy moves a manifold."""
        return self.fields[place[0]][0] == BY_PYTHON
