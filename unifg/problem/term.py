"""One term with its shapes known: where its numbers stand, and how to evaluate it by itself.

Solvers run all terms at once through :mod:`unifg.problem.table`; the batched functions here serve terms without a
kernel, checks, and messages.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, TypeAlias

import numpy as np

from unifg.errors import GraphError, place_error
from unifg.factors.batched import FLOAT64, Batched, changes
from unifg.factors.differences import (
    Directions,
    Moves,
    Near,
    Steps,
    directions_of,
    scalar_slopes,
    slopes,
    weighted_hessian,
)
from unifg.factors.kernel import Kernel, evaluate_rows, side_by_side
from unifg.factors.per_factor import per_factor
from unifg.factors.whitening import DIAGONAL, FULL, whitener_of
from unifg.lie import Manifold
from unifg.modeling.probing import blocks_of, size_of, told, tried
from unifg.modeling.terms import Constraint, Cost, Parameter, ScalarCost, Term
from unifg.modeling.variables import Data, Selection
from unifg.problem.columns import Columns, Values
from unifg.problem.traced import Batch, Trace, find, has_rows, reason, unclear_places
from unifg.typing import Array, BoolArray, IntArray

Bound: TypeAlias = Mapping[Data, Array]
logger = logging.getLogger("unifg")
_told: set[tuple[str, str]] = set()  # what the log knows: loops state the same graph again and again
CHANGES = 3  # of what a traced function reads beyond its arguments, before it is left to Python


class Gather:
    """Reads one variable argument of a term out of the values, one row per factor."""

    def __init__(self, selection: Selection, count: int) -> None:
        """Precompute the cheapest way to index."""
        self.family = selection.family
        self.selection = selection
        self.shared = selection.count == 1 and count > 1
        self.count = count
        indices = selection.indices
        self.rows: slice | IntArray = indices
        if len(indices) == 1 or bool(np.all(np.diff(indices) == 1)):
            self.rows = slice(int(indices[0]), int(indices[-1]) + 1)
        self.columns = None if selection.component is None else selection.storage

    def places(self, starts: IntArray) -> IntArray:
        """(n, storage) places of this argument among all stored numbers, given the start of each member."""
        own = starts[:, None] + np.arange(self.selection.manifold.storage)
        return np.broadcast_to(own, (self.count, own.shape[1]))

    def __call__(self, values: Values) -> Array:
        """(n, storage) values of this argument."""
        part = values[self.family][self.rows]
        if self.columns is not None:
            part = part[:, self.columns]
        return np.broadcast_to(part, (self.count, part.shape[1])) if self.shared else part


@dataclass
class Layout:
    """Positions of the numbers of a term.

    Attributes:
        count, rows: factors and the rows of each; a bound is a factor of one row for each scalar.
        gather: (n, slots) starts of the variables in the stored values, negative for constants.
        sizes: storage of each slot.
        columns: (n, D) full tangent columns.
        kernel_width: tangent columns the kernel writes.
        keep: those of them that are no constants here; None for all.
    """

    count: int
    rows: int
    gather: IntArray
    sizes: list[int]
    columns: IntArray
    kernel_width: int
    keep: list[int] | None


class CompiledTerm:
    """A term with its shapes known.

    Attributes:
        term: what the user stated.
        name: the term's name.
        count: factors n.
        size: residual dimension m.
        dims: tangent dimension of each variable argument.
        columns: (n, d_k) full tangent columns of each variable argument.
        data: all data the term reads.
        named: variables by whose members errors say where.
        differenced: whether the Jacobian of a term that is no scalar cost is made of differences.
        trace: of a plain function that has been traced.
        route: how it is evaluated and differentiated, in words.
    """

    parameters: Array
    whitener: Array
    whitening: int
    _packed: Array

    def __init__(self, term: Term, columns: Columns) -> None:
        """Find the residual's dimension by one evaluation at identity elements; trace its function if possible."""
        self.term = term
        self.name = term.name
        self.count = term.count
        selections = term.selections
        self.gathers, self.named = [Gather(s, term.count) for s in selections], selections[0]
        self.starts = [columns.starts(s) for s in selections]
        self.columns = [np.broadcast_to(part, (term.count, part.shape[1])) for part in map(columns.of, selections)]
        self.manifolds = [s.manifold for s in selections]
        self.dims = [manifold.dim for manifold in self.manifolds]
        self._places = [k for k, a in enumerate(term.arguments) if isinstance(a, Selection)]
        self._jacobian = term.residual.jacobian
        self._batched = Batched(self.name, term.residual.function)
        self._attached: Batched | None = None
        self.is_bound = isinstance(term, Constraint) and term.is_bound
        self.kernel = None if isinstance(term, ScalarCost) else term.residual.kernel
        self.place: IntArray = np.zeros(0, dtype=np.int64)
        self._shaping, self.data = frozenset(term.shaping), frozenset(term.data)
        self._blocks: dict[int, tuple[int, int]] = {}
        self._inputs = tuple(range(len(term.arguments)))
        self.trace: Trace | None = None
        self._each: tuple[int, ...] | None = None  # arguments that were found to have a row for each factor
        self._changes = 0
        self._weighed = False
        self.bind({})
        self.route = "" if not term.residual.rows or isinstance(term, ScalarCost) else self._choose_single()
        self._require_stated_size()
        self.size = term.size
        self.shape = (self.count,) if isinstance(term, ScalarCost) else (self.count, self.size)
        self.route = self.route or self._choose_route()
        self.differenced = (
            self._jacobian is None and not self.is_bound if self.kernel is None else self.kernel.differenced
        )
        self._bind_parameters({})
        if isinstance(self.term, Cost) and isinstance(self.term.information, np.ndarray):
            _notice_no_information(self.name, self.whitener)

    def remedy(self, index: int) -> str:
        """Advice on a residual that is not finite at a factor: the point may be to blame, or a constant."""
        for place, argument in enumerate(self.term.arguments):
            if isinstance(argument, np.ndarray) and argument.dtype.kind == "f":
                row = argument[index] if argument.ndim and len(argument) == self.count else argument
                if not np.isfinite(row).all():
                    return f"argument {place}, a constant, is {row} there: leave such factors out with active="
        return "move the guess away from the singularity, or guard the residual"

    def _require_stated_size(self) -> None:
        """Call a function again: what it reads beyond its arguments may have changed since it was stated.

        Raises:
            GraphError: it returns another shape.
        """
        if self.kernel is not None or self.is_bound:
            return
        term, identities = self.term, [np.tile(m.identity(), (self.count, 1)) for m in self.manifolds]
        found = tried(self._batched, identities, lambda: told(term.arguments, self.count))
        size = size_of(found, self.name, term.arguments, self.count, isinstance(term, ScalarCost))
        if size != term.size:
            raise GraphError(
                f"term '{self.name}': its function returns {size} rows now and returned {term.size} when it was "
                "stated: something that it reads has changed; state the term when that is known, or pass it as data",
                term=self.name,
            )

    def _choose_route(self) -> str:
        """Trace a plain function if that is possible; how the term is evaluated.

        Raises:
            GraphError: it must be traced, and cannot be; or its rows depend on other factors.
        """
        own = self.term.residual
        if self.is_bound:
            return "the variable itself"
        if own.kernel is not None:
            return "a kernel that ships, its derivatives exact"
        asked, attached = own.derivatives == "trace", own.jacobian is not None
        why = "it has a search Jacobian" if own.search else ""
        if own.derivatives == "differences":
            why = "as it was asked to be"
        traceable = not why and (not attached or asked)
        if traceable or unclear_places(self._arguments, self.term.rows, self.count):
            found, reason = find(self.batch, own.function, asked)  # also for how arrays as long as the batch are read
            self._each = None if found is None else found.each
            self._bind_batched(self._batched)
            if traceable:
                self.trace, why = found, reason
        if self.trace is None and attached:
            return "evaluated by Python, its derivatives attached" + (f": {why}" if traceable else "")
        if self.trace is None:
            return self._said("evaluated by Python", why)
        self.kernel, self._inputs = self.trace.kernel, self.trace.inputs
        self._jacobian = None if isinstance(self.term, ScalarCost) else self._exact
        return self._traced()

    def _choose_single(self) -> str:
        """The same of a function of one factor that is compiled: traced from its source, or called as it is."""
        own, why = self.term.residual, "as it was asked to be"
        asked = own.derivatives == "trace"
        if asked or (own.jacobian is None and own.derivatives != "differences"):
            self.size = own.rows
            self.trace, why = find(self.batch, own.function, asked)
            del self.size
        if self.trace is None:
            self._call_single()
            if own.jacobian is not None:
                return "compiled by Numba, its derivatives attached"
            return self._said("compiled by Numba", why)
        self.kernel = self.trace.kernel
        self._batched.function, self._jacobian = self.kernel, self._exact
        return self._traced()

    def _call_single(self) -> None:
        """Have a function of one factor called as it is."""
        self.kernel = self._own_kernel()
        self._batched.function, self._jacobian = self.kernel, self.kernel.jacobian

    def _traced(self) -> str:
        assert self.trace is not None
        how = "traced on the whole batch" if self.trace.whole else "traced"
        logger.info("term '%s' was %s: its derivatives are exact", self.name, how)
        return f"{how}, its derivatives exact"

    def _said(self, how: str, why: str) -> str:
        if self.term.residual.derivatives != "differences" and (self.name, why) not in _told:
            _told.add((self.name, why))
            logger.warning("term '%s' is %s and differenced: %s", self.name, how, why)
        return f"{how}, its derivatives by differences: {why}"

    @property
    def batch(self) -> Batch:
        """The term's function and what it is called with at present."""
        shared = [gather.shared for gather in self.gathers]
        return Batch(
            self.name,
            self._batched,
            self.term.arguments,
            self._arguments,
            self.manifolds,
            shared,
            self.count,
            self.size,
            self.term.rows,
            isinstance(self.term, ScalarCost),
            self.term.residual.function if self.term.residual.rows else None,
        )

    def _exact(self, *arguments: Any) -> list[Array]:
        """Jacobian of a derived kernel, of the arguments of the function it was derived from."""
        assert self.trace is not None
        return self.trace.kernel.jacobian(*self.trace.arguments(arguments))

    @property
    def packed(self) -> Array:
        """(n or 1, P) present parameters of the kernel."""
        return self._packed

    def _for_kernel(self, points: list[Array]) -> list[Any]:
        """The arguments that the kernel takes, variables at these points."""
        filled = self._batched.fill(points)
        return filled if self.trace is None else self.trace.arguments(filled)

    def stands(self, values: Values) -> bool:
        """Test whether the trace of a function computes what the function does at a guess; otherwise it is given up.

        Raises:
            GraphError: rows of a factor depend on other factors; or there is no such trace, and the user insists.
        """
        if self.trace is None:
            return True
        points = self.points(values)
        if not self.trace.agrees(self.batch, points):
            if self.trace.outdated:  # since it was traced, which it will be again
                return True
            self.leave(reason(self.batch, points))
            return False
        if (index := self._undefined(points)) is None:
            return True
        self.leave(f"its derivatives are not finite at the guess (factor {index})")
        return False

    def _undefined(self, points: list[Array]) -> int | None:
        """The first active factor whose exact derivatives are not finite though differences are; None for none."""
        assert self.trace is not None
        with np.errstate(all="ignore"):
            exact = np.concatenate(self.trace.kernel.jacobian(*self._for_kernel(points)), axis=2)
            wrong = ~np.isfinite(self._masked(exact)).all(axis=(1, 2))
            if not wrong.any():
                return None
            if self.term.residual.rows:  # its differences would have to be compiled to be looked at
                return int(np.argmax(wrong))
            if isinstance(self.term, ScalarCost):
                found = scalar_slopes(self._batched, self._directions, points)[0]
            else:
                found = np.concatenate(slopes(self._batched, self._directions, points), axis=2)
            wrong &= np.isfinite(found.reshape(self.count, -1)).all(axis=1)
        return int(np.argmax(wrong)) if wrong.any() else None

    def trace_again(self, values: Values) -> bool:
        """Trace a function anew that reads something else than before; whether the term has a trace still.

        Raises:
            GraphError: as for :meth:`stands`.
        """
        assert self.trace is not None
        old = self.trace
        asked = self.term.residual.derivatives == "trace"
        found, why = find(self.batch, self.term.residual.function, asked)
        if found is not None and found.layout != old.layout:
            found, why = None, "what it reads beyond its arguments has changed its shape"
        same = found is not None and found.kernel is old.kernel
        self._changes += not same
        if self._changes > CHANGES and not asked:
            found, why = None, "what it reads beyond its arguments keeps changing: declare it by graph.data"
        if found is None or found.each != self._each:
            self._each = None
            self.leave(why or "what it reads beyond its arguments has changed their meaning")
            return False
        self.trace, self.kernel = found, found.kernel
        self._bind_parameters(self._data)
        try:
            return same or self.stands(values)
        except BaseException:  # the old trace is still the one that runs, and out of date: the next solve looks again
            self.trace, self.kernel, self._changes = old, old.kernel, self._changes - (not same)
            self._bind_parameters(self._data)
            raise

    def refresh(self) -> None:
        """Take the present content of arrays that are parameters of a trace and belong to the user."""
        assert self.trace is not None
        self.trace = self.trace.refreshed()
        self._bind_parameters(self._data)

    def leave(self, why: str) -> None:
        """Leave to Python what was traced."""
        if self.term.residual.derivatives == "trace":
            raise GraphError(f"term '{self.name}': cannot be traced: {why}", term=self.name)
        self.trace = self.kernel = self._jacobian = None
        self._inputs = tuple(range(len(self.term.arguments)))
        if self.term.residual.rows:
            self._call_single()
            self.route = self._said("compiled by Numba", why)
        else:
            self.route = self._said("evaluated by Python", why)
        self.differenced = True
        self._bind_parameters(self._data)

    def bind(self, data: Bound) -> None:
        """Take the present value of every data argument."""
        self._data = data
        self._arguments: list[Any] = [data.get(a, a.value) if isinstance(a, Data) else a for a in self.term.arguments]
        active = self.term.active
        mask = data.get(active, active.value) if isinstance(active, Data) else active
        self.active: BoolArray | None = None if mask is None or mask.all() else mask.astype(bool)
        self._bind_batched(self._batched)
        if self._attached is not None:
            self._bind_batched(self._attached)
        if hasattr(self, "size"):
            self._bind_parameters(data)

    def parameters_of(self, handle: Data) -> list[IntArray] | None:
        """Positions of a datum in the kernel's parameters: (rows, numbers) for each argument it is.

        None when more than parameters of the kernel are made of it.
        """
        places = [k for k, argument in enumerate(self.term.arguments) if argument is handle]
        kept = all(place in self._blocks for place in places) and handle.value.dtype == FLOAT64
        if self.kernel is None or handle in self._shaping or not kept:
            return None
        packed = np.arange(self._packed.size).reshape(self._packed.shape)
        return [packed[:, first : first + size] for first, size in map(self._blocks.__getitem__, places)]

    def forget(self) -> None:
        """Data have changed in place."""
        self._batched.forget()
        if self._attached is not None:
            self._attached.forget()

    def settle(self, parameters: Array) -> None:
        """Keep the parameters where the compiled loops read them."""
        self.parameters = parameters
        if self.kernel is not None:
            self._packed = parameters[: self._packed.size].reshape(self._packed.shape)

    @cached_property
    def _directions(self) -> Directions:
        """Tangent directions of the variables."""
        return directions_of(tuple(self.manifolds))

    def points(self, values: Values) -> list[Array]:
        """(n, storage_k) values of each variable argument."""
        return [gather(values) for gather in self.gathers]

    def residual(self, values: Values) -> Array:
        """(n, m) residuals, zero where inactive, not whitened; (n,) for a scalar cost."""
        points = self.points(values)
        try:
            found = self._batched.at(points)
        except Exception as error:
            self._place(error, points)
            raise
        return self._masked(self._checked(found))

    def call_as_written(self, values: Values) -> None:
        """Call a function that was traced, for all factors; its exception is passed on with notes.

        Raises:
            Exception: of the function.
        """
        points = self.points(values)
        try:
            self.batch.original(points)
        except Exception as error:
            error.add_note("at the answer of a solve, where what the function asserts is tested")
            self._place(error, points)
            raise

    def _place(self, error: Exception, points: list[Array]) -> None:
        """Say of an error of the user's function which factor raises it."""
        if getattr(error, "index", None) is not None:
            return
        factor = self._batched.culprit(points, self.count)
        if factor is not None:
            first = self.named
            place_error(error, first.family.name, int(first.indices[factor % len(first)]), factor)

    def jacobians(self, values: Values, numerical: bool = False, search: bool = False) -> list[Array]:
        """One (n, m, d_k) array per variable argument, zero where inactive.

        Args:
            values: where to differentiate.
            numerical: differentiate numerically even when a Jacobian is attached.
            search: prefer the residual's search Jacobian, which is not a derivative.
        """
        attached = self.term.residual.search if search and self.term.residual.search else self._jacobian
        points = self.points(values)
        if attached is None or numerical:
            try:
                blocks = slopes(self._batched, self._directions, points)
            except Exception as error:
                self._place(error, points)
                raise
        else:
            found = attached(*self._batched.fill(points))
            blocks = blocks_of(self.name, found, self.term.arguments, self.count, self.size)
        return [self._masked(block) for block in blocks]

    def require_clean(self, values: Values) -> None:
        """Call a user's function once at the guess, and refuse one that changes its arguments or leaves rows out.

        Raises:
            GraphError: naming the term and the argument or row.
        """
        if self.is_bound:
            return
        with np.errstate(all="ignore"):
            if self.kernel is None or self.trace is not None or isinstance(self.term, ScalarCost):
                self._batched.require_clean(self.points(values))
            elif self.term.residual.rows:
                self._require_all_rows(self.kernel, self.points(values))

    def _require_all_rows(self, kernel: Kernel, points: list[Array]) -> None:
        """The same of a function that a user has compiled for one factor."""
        variables, parameters, count = kernel.split(self._batched.fill(points), self.count)
        packed, shared = side_by_side(variables, count), side_by_side(parameters)
        v, p = packed.copy(), shared.copy()
        twice = []
        for filled in (np.nan, 0.0):
            rows = np.full((count, self.size), filled)
            evaluate_rows(kernel.address, v, p, kernel.table, rows, np.empty((0, 0, 0)))
            twice.append(rows)
        if v.tobytes() != packed.tobytes() or p.tobytes() != shared.tobytes():
            place = 0 if v.tobytes() != packed.tobytes() else len(variables)
            raise GraphError(changes(self.name, place), term=self.name)
        missing = np.isnan(twice[0]) & ~np.isnan(twice[1])
        if missing.any():
            index, row = (int(k) for k in np.argwhere(missing)[0])
            raise GraphError(
                f"term '{self.name}': its function does not write row {row} of factor {index}",
                term=self.name,
                index=index,
            )

    def carry_back(self, residual: Array) -> Array:
        """(n, m) W' r for whitened residuals."""
        if self.whitening & DIAGONAL:
            return residual * self.whitener
        if self.whitening & FULL:
            carried: Array = np.einsum(
                "nab,na->nb", np.broadcast_to(self.whitener, (self.count, self.size, self.size)), residual
            )
            return carried
        return residual

    def second_derivatives(self, values: Values, weights: Array) -> Array:
        """(n, D, D) Hessians of weights' r, weights (n, m), zero where inactive; by differences unless traced."""
        points = self.points(values)
        with np.errstate(all="ignore"):
            if self.trace is not None:
                return self._masked(self.trace.kernel.second_derivatives(weights, *self._for_kernel(points)))
            if self._jacobian is None or self.differenced:
                return self._masked(weighted_hessian(self._batched, self._directions, points, weights))
            if self._attached is None:
                self._attached = Batched(self.name, self._side_by_side)
                self._bind_batched(self._attached)
            many = self._attached

            def slope(near: Near, steps: Steps, moves: Moves) -> Array:
                return np.asarray(np.einsum("nm,knmd->knd", weights, many(near, steps, moves)))

            second = np.concatenate(slopes(slope, self._directions, points), axis=2)
        return self._masked(0.5 * (second + np.swapaxes(second, 1, 2)))

    def scalar_derivatives(self, values: Values) -> tuple[Array, Array, Array]:
        """Gradient (n, D), Hessian (n, D, D), rounding of the gradient (n, D) of a scalar cost, zero where inactive."""
        points = self.points(values)
        if self.trace is not None:
            kernel, given = self.trace.kernel, self._for_kernel(points)
            slopes = np.concatenate(kernel.jacobian(*given), axis=2)[:, 0]
            bent = kernel.second_derivatives(np.ones((self.count, 1)), *given)
            return self._masked(slopes), self._masked(bent), np.zeros(slopes.shape)
        found = scalar_slopes(self._batched, self._directions, points)
        gradient, hessian, rounding = (self._masked(array) for array in found)
        return gradient, hessian, rounding

    def layout(self, parameters: int) -> Layout:
        """Positions of this term's numbers, when its parameters begin at ``parameters``."""
        joined = np.concatenate(self.columns, axis=1)
        starts = [np.broadcast_to(start, (self.count,)) for start in self.starts]
        sizes = [manifold.storage for manifold in self.manifolds]
        if self.is_bound:
            scalars = (starts[0][:, None] + np.arange(self.size)).reshape(-1, 1)
            return Layout(self.count * self.size, 1, scalars, [1], joined.reshape(-1, 1), 1, None)
        if self.kernel is None:
            return Layout(self.count, self.size, np.stack(starts, axis=1), sizes, joined, joined.shape[1], None)
        constants = parameters + self.parameter_count * (self.count if self.parameter_spread else 1)
        gather: list[IntArray] = []
        keep: list[int] = []
        sizes, width = [], 0
        for place, expected in zip(self._inputs, self.kernel.arguments, strict=False):
            argument = self.term.arguments[place]
            if isinstance(expected, int | tuple):
                continue
            sizes.append(expected.storage)
            if isinstance(argument, Selection):
                gather.append(starts.pop(0))
                keep += range(width, width + expected.dim)
            else:
                own = self._constants[len(gather)]
                spread = expected.storage if len(own) > 1 else 0
                gather.append(-1 - constants - spread * np.arange(self.count))
                constants += own.size
            width += expected.dim
        return Layout(
            self.count,
            self.size,
            np.stack(gather, axis=1),
            sizes,
            joined,
            width,
            None if len(keep) == width else keep,
        )

    def _bind_parameters(self, data: Bound) -> None:
        term = self.term
        if not self._weighed:
            self.whitening, self.whitener = self._weights(data)
            self._weighed = not (
                isinstance(term, Cost) and (isinstance(term.sigma, Data) or isinstance(term.information, Data))
            )
        if isinstance(term, Constraint):
            self.lower = self._limit(resolve(term.lower, data), "lower", -np.inf)
            self.upper = self._limit(resolve(term.upper, data), "upper", np.inf)
        self.parameters = self._packed = np.zeros(0)
        self.parameter_count = self.parameter_spread = 0
        if self.kernel is not None:
            self._pack(self.kernel)

    def _weights(self, data: Bound) -> tuple[int, Array]:
        """Whitening of the residuals, and its matrices."""
        weights = (self.term.sigma, self.term.information) if isinstance(self.term, Cost) else (None, None)
        sigma, information = (None if weight is None else resolve(weight, data) for weight in weights)
        how, by = whitener_of(self.name, sigma, information, self.count, self.size)
        return how | (how > 0 and len(by) > 1), by

    def _pack(self, kernel: Kernel) -> None:
        """Put the kernel's parameters side by side, and after them the constants in the place of variables."""
        points = [np.empty((1, m.storage)) for m in self.manifolds]
        try:
            variables, parameters, _ = kernel.split(self._for_kernel(points), self.count)
        except GraphError as error:
            raise GraphError(f"term '{self.name}': {error}", term=self.name) from None
        self.kernel = kernel.of_shapes([part.shape[1:] for part in parameters])
        packed = side_by_side(parameters)
        self.parameter_count = packed.shape[1]
        self.parameter_spread = packed.shape[1] if len(packed) > 1 else 0
        accepted = list(zip(self._inputs, kernel.arguments, strict=False))  # others are no arguments of the term
        places = [k for k, expected in accepted if not isinstance(expected, int | tuple)]
        given = {slot: v for slot, (k, v) in enumerate(zip(places, variables, strict=True)) if k not in self._places}
        self._constants = given
        self.parameters = np.concatenate([packed.ravel(), *(array.ravel() for array in given.values())])
        self._packed = self.parameters[: packed.size].reshape(packed.shape)
        slots = [k for k, expected in accepted if isinstance(expected, int | tuple)]
        sizes = [prod(part.shape[1:]) for part in parameters]
        starts = np.cumsum([0, *sizes]).tolist()
        self._blocks = {k: (start, size) for k, start, size in zip(slots, starts, sizes, strict=False) if size}

    def _own_kernel(self) -> Kernel:
        """Compile the user's function of one factor for the manifolds and shapes it is used with."""
        arguments: list[Manifold | int] = []
        shapes = []
        for given, argument, declared in zip(self._arguments, self.term.arguments, self.term.rows, strict=True):
            if isinstance(argument, Selection):
                arguments.append(argument.manifold)
                continue
            shape = np.shape(given)
            shapes.append(shape[1:] if has_rows(given, declared) else shape)
            arguments.append(len(shapes[-1]))
        own = self.term.residual
        return per_factor(own.function, own.jacobian, own.rows, arguments, shapes, self.name)

    def _limit(self, limit: Array, which: str, none: float) -> Array:
        try:
            full = np.array(np.broadcast_to(limit, (self.count, self.size)))
        except ValueError as error:
            raise GraphError(
                f"term '{self.name}': {which} has shape {limit.shape}, which does not fit {self.shape}",
                term=self.name,
            ) from error
        if self.active is not None:
            full[~self.active] = none
        return full

    def _bind_batched(self, batched: Batched) -> None:
        each = [k for k, declared in enumerate(self.term.rows) if declared]
        unclear = unclear_places(self._arguments, self.term.rows, self.count) if self._each is None else ()
        batched.bind(self._arguments, self._places, each if self._each is None else list(self._each), bool(unclear))

    def _side_by_side(self, *arguments: Any) -> Array:
        """(n, m, D) attached Jacobian."""
        assert self._jacobian is not None
        blocks = [np.asarray(block) for block in self._jacobian(*arguments)]
        own = blocks if len(blocks) == len(self.dims) else [blocks[place] for place in self._places]
        return np.concatenate(own, axis=2, dtype=np.float64)

    def _checked(self, residual: Array) -> Array:
        if residual.shape != self.shape:
            raise GraphError(
                f"term '{self.name}': its function returned shape {residual.shape}, and {self.shape} before",
                term=self.name,
            )
        return residual

    def _masked(self, array: Array) -> Array:
        if self.active is None:
            return array
        shape = (-1,) + (1,) * (array.ndim - 1)
        return np.where(self.active.reshape(shape), array, 0.0)


def resolve(parameter: Parameter, data: Bound) -> Array:
    """The present value of a parameter."""
    if isinstance(parameter, Data):
        return data.get(parameter, parameter.value)
    return np.asarray(parameter, dtype=np.float64)


def _notice_no_information(name: str, whitener: Array) -> None:
    """Say that a term counts for nothing: an infinite sigma may be meant, and a matrix that was never filled is not.

    Of constants only: data switch terms off and on, and the status of a solve says whether anything is missing then.
    """
    if whitener.size and not whitener.any():
        logger.warning("term '%s': its information is zero for every factor, so it counts for nothing", name)
