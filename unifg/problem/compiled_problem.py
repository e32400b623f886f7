"""A compiled graph: offsets, ordering and sparsity once; values, Jacobians and gradients as often as needed.

Backends see only this. Rows of costs are whitened and weighted, so the objective is 1/2 |r|^2 plus scalar
costs; rows of constraints read ``lower <= g <= upper``. Columns are tangent coordinates of the unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property
from time import perf_counter
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from unifg.codegen.buffers import Buffers
from unifg.codegen.threads import threads
from unifg.elimination.symmetric import Symmetric
from unifg.errors import GraphError
from unifg.factors.differences import convexified
from unifg.locks import ReentrantLock
from unifg.modeling.model import Model
from unifg.modeling.soft import are_prices, require_prices
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.modeling.variables import Data, Family
from unifg.problem import evaluation
from unifg.problem import table as stacking
from unifg.problem.binding import Binding, Holder
from unifg.problem.branches import Branches
from unifg.problem.by_term import ByTerm, Places
from unifg.problem.columns import Columns, Values
from unifg.problem.evaluation import LinearArrays
from unifg.problem.guess import GuessReader
from unifg.problem.limits import clip, outside
from unifg.problem.linearization import Evaluation, Linearization, Rows
from unifg.problem.retraction import Retraction
from unifg.problem.scalars import add_scalars, evaluate_scalars
from unifg.problem.soft_terms import softened
from unifg.problem.systems import Systems
from unifg.problem.table import ENTRY, PARAMETER, POSITION, ROW, WIDTH, TermArrays, TermTable
from unifg.problem.term import CompiledTerm
from unifg.problem.thread_partition import Shares, linearize_shared
from unifg.problem.units import Units, unit_memory
from unifg.problem.verification import Verification
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

T = TypeVar("T")
WORTH = 150_000  # entries of Jacobians below which threads bring nothing


class Reader(NamedTuple):
    """Reader of a datum.

    Attributes:
        bound: terms that have to work something out from it.
        told: terms whose kernels find it among their parameters, already renewed.
    """

    bound: list[CompiledTerm]
    told: list[CompiledTerm]


class CompiledProblem:
    """The compiled form of a graph.

    Attributes:
        graph: what was compiled, as it was then.
        columns: numbering of the tangent coordinates.
        size: number of unknown ones.
        costs, constraints: patterns of the stacked Jacobians.
        normal: pattern of the Gauss-Newton Hessian of the objective plus A'A.
        blocks: (size,) the variable that every unknown belongs to.
        lower, upper: (M,) limits with the present data.
        equality, sided: (M,) whether a row's are the same, and whether those of some row are not.
        unlimited: rows without a limit, those of factors that are not active among them.
        cost_terms, scalar_terms, constraint_terms: compiled terms in row order.
        slices: rows of each constraint term.
        places: name, rows and shape of each constraint term.
        bound_rows: (M,) whether a row bounds an unknown itself.
        systems: the normal equations and KKT matrices, their structure found once.
        table: all terms as compiled loops take them.
        least_squares: whether the objective is a sum of squares, robust or not, and nothing constrains it.
        differenced: whether some derivative comes from differences, which round.
        batched: terms without a kernel, evaluated by NumPy.
        retraction: moves all variables.
        reader: of guesses.
        readers: of every datum.
        branches: comparisons of traces that are watched.
        scratch: memory for compiled loops.
        rebinds: whether something else than numbers for kernels and fixed variables is made of data.
        python_seconds: time spent so far in terms that Python evaluates.
        buffers: memory for linearisations.
        soft: slack variables of soft constraints, by their names.
        verifications: of the traced terms, once a guess has been read.
        demanding: those of functions that assert something.
        no_penalties: (M,) zeros, of backends without penalties.
        workspaces: of single solves: backend, options, memory.
        binding: the present values of all data.
        turn: held by who binds data, until nobody needs them any more, and while anything is evaluated.
    """

    def __init__(self, graph: Model) -> None:
        """Compile; see :func:`compile_graph`."""
        if not graph.families:
            raise GraphError("the graph has no variables: add a family with graph.variables(...)")
        declared = graph._data
        self.graph = graph.snapshot()
        limits = [t for t in self.graph.terms if isinstance(t, Constraint)]
        self.soft = {t.name: t.slack for t in limits if t.slack}
        self._prices = [
            (price, which, t)
            for t in limits
            for which, price in (vars(t.slack.soft).items() if t.slack else ())
            if isinstance(price, Data)
        ]
        graph = softened(graph.snapshot()) if self.soft else self.graph
        self.lock = ReentrantLock()
        self.families = list(graph.families.values())
        self.columns = Columns(self.families, graph.fixes)
        self.size = self.columns.size
        self.terms = [CompiledTerm(term, self.columns) for term in graph.terms]
        self.cost_terms = [c for c in self.terms if isinstance(c.term, Cost)]
        self.scalar_terms = [c for c in self.terms if isinstance(c.term, ScalarCost)]
        self.constraint_terms = [c for c in self.terms if isinstance(c.term, Constraint)]
        stacking.require_touched(self.terms, self.columns)
        variable, starts = self.columns.nodes()
        self.blocks, every = variable[self.columns.free], self.cost_terms + self.scalar_terms + self.constraint_terms
        self.normal = stacking.block_pattern(every, variable, starts)
        stacked = self.cost_terms + self.constraint_terms
        self.table = TermTable(stacked, self.scalar_terms, self.columns, self.normal)
        self.least_squares = bool(self.cost_terms) and not (self.scalar_terms or self.constraint_terms)
        self.differenced = self.table.differenced or any(term.trace is None for term in self.scalar_terms)
        self.batched = [term for term in stacked if term.kernel is None and not term.is_bound]
        self._general = [term for term in self.scalar_terms if term.kernel is None]  # that Python evaluates
        self.costs = Rows(self.table, self.cost_terms, True, self.size)
        self.constraints = Rows(self.table, self.constraint_terms, False, self.size)
        self.systems = Systems(self.normal, self.blocks, self.constraints)
        self.workspaces: list[tuple[type, dict[str, Any], Any]] = []
        self._found: dict[Callable[[CompiledProblem], Any], Any] = {}
        self._pairs: dict[CompiledTerm, tuple[IntArray, IntArray, IntArray, Array, IntArray]] = {}
        self.slices = [stacking.rows_in_stack(term) for term in self.constraint_terms]
        shaped = zip(self.constraint_terms, self.slices, strict=True)
        self.places: Places = [(term.name, rows, (term.count, term.size)) for term, rows in shaped]
        self.bound_rows = np.zeros(self.constraints.count, dtype=bool)
        for term, rows in zip(self.constraint_terms, self.slices, strict=True):
            self.bound_rows[rows] = term.is_bound
        self.retraction = Retraction(self.columns, graph.fixes)
        self.reader = GuessReader(graph, self.columns, self.retraction)
        self._names = [term.name for term in stacked]
        self.scratch = np.empty(self.table.scratch)
        self.no_penalties = np.zeros(self.constraints.count)
        self.no_penalties.flags.writeable = False
        self._shares: Shares | None = None
        self.buffers = Buffers([*self.table.sizes, self.columns.width, self.normal.nnz])
        self._watched: list[CompiledTerm] = []
        self.verifications: list[Verification] = []
        self.demanding: list[Verification] = []
        self._watching = False
        self.branches: Branches | None = None
        self.python_seconds = 0.0
        read = {value for term in self.terms for value in term.data}
        read |= {fix.value for fix in graph.fixes if isinstance(fix.value, Data)}
        self.binding = Binding(declared, filter(read.__contains__, declared.values()), graph.terms)
        self._vetted = False
        self._bind_first()

    @property
    def arrays(self) -> TermArrays:
        """Arrays of the terms for compiled loops, with the present data."""
        return self.table.arrays

    @property
    def left_to_python(self) -> list[str]:
        """Names of the terms that Python evaluates."""
        return [term.name for term in self.batched + self.scalar_terms if term.trace is None]

    @property
    def fully_compiled(self) -> bool:
        """True if a compiled loop can do without Python: every term a kernel, every loss and retraction compiled."""
        return not (self.batched or self._general or self.table.weighed) and self.retraction.compiled

    @property
    def hessian(self) -> Symmetric:
        """Pattern of the Gauss-Newton Hessian of the objective alone."""
        return self._objective[0]

    @property
    def objective_places(self) -> IntArray:
        """Positions of the entries of ``hessian`` in ``normal``."""
        return self._objective[1]

    # ---------------------------------------------------------------- data and values

    def bind(self, data: Mapping[Data, ArrayLike]) -> None:
        """Take new data; everything not named returns to its default.

        Raises:
            GraphError: on unknown data, a changed shape, NaN, crossed limits, or prices below zero.
        """
        changed = self.binding.take(data)
        for handle in changed:
            for term in self.readers[handle].told:
                term.forget()
        try:
            for price, which, stated in self._prices:
                if price in changed:
                    value = self.binding.present[price]
                    require_prices(stated.name, which, np.broadcast_to(value, (stated.count, stated.size)))
            if self.rebinds:
                self._rebind([term for handle in changed for term in self.readers[handle].bound])
        except GraphError:
            self.binding.forget()
            raise

    def rows(self, data: Mapping[Data, Array], count: int) -> Array | None:
        """(count, D) numbers of all data of many instances; None where single solves have to look at them."""
        prices = [data[price] for price, *_ in self._prices if price in data]
        return self.binding.rows(data, count) if all(are_prices(price).all() for price in prices) else None

    def data_of(self, holder: Holder) -> dict[Data, Array] | None:
        """Values of all data that a solution was found with; None where they were replaced by way of another one."""
        with self.lock:
            if holder._data is None and self.binding.holder is not None and self.binding.holder() is holder:
                holder._data, self.binding.holder = self.binding.kept(), None
            return None if holder._data is None else self.binding.named(holder._data)

    def _rebind(self, terms: Sequence[CompiledTerm]) -> None:
        """Work out anew what terms make of their data."""
        rebound = list(dict.fromkeys(terms))
        for term in rebound:
            term.bind(self.binding.present)
        if any(isinstance(term.term, Constraint) for term in rebound):
            self._bind_limits()
        if rebound:
            self.table.bind(rebound, self.lower, self.upper)

    def _bind_first(self) -> None:
        """Take the defaults, and find out what has to be done when a datum changes."""
        binding, retraction = self.binding, self.retraction
        binding.take({})
        for term in self.terms:
            if term.data:
                term.bind(binding.present)
        self._bind_limits()
        self.table.bind(self.terms, self.lower, self.upper)
        self.readers: dict[Data, Reader] = {}
        sources, targets = [], []
        for handle in binding.present:
            reader = self.readers[handle] = Reader([], [])
            for term in self.terms:
                if handle not in term.data:
                    continue
                places = term.parameters_of(handle)
                (reader.bound if places is None else reader.told).append(term)
                for place in places or ():
                    sources.append(np.broadcast_to(binding.place(handle).reshape(-1, place.shape[1]), place.shape))
                    targets.append(int(term.place[PARAMETER]) + place)
        self.rebinds = any(reader.bound for reader in self.readers.values())
        moved = sources, targets, self.arrays.parameters
        sources, targets = [], []
        for fix, where in zip(self.graph.fixes, retraction.places, strict=True):
            if isinstance(fix.value, Data):
                sources.append(np.broadcast_to(binding.place(fix.value), where.shape))
                targets.append(where)
                retraction.fixed_values[where] = binding.present[fix.value]
            else:
                retraction.fixed_values[where] = np.asarray(fix.value)
        binding.carry(moved, (sources, targets, retraction.fixed_values))

    def by_term(self, stacked: Array) -> ByTerm:
        """(M,) numbers of the constraint rows, viewed as (n, m) of every term."""
        return ByTerm(self.places, stacked)

    def _bind_limits(self) -> None:
        self.lower = _side_by_side([c.lower for c in self.constraint_terms])
        self.upper = _side_by_side([c.upper for c in self.constraint_terms])
        crossed = np.flatnonzero(self.lower > self.upper)
        if len(crossed):
            name, index = self.row_name(int(crossed[0]))
            raise GraphError(f"term '{name}': lower exceeds upper in factor {index}", term=name, index=index)
        self.equality = self.lower == self.upper
        self.sided = not self.equality.all()
        self.unlimited = np.flatnonzero((self.lower == -np.inf) & (self.upper == np.inf))

    def values_from(self, guess: Mapping[Family, ArrayLike] | Array) -> Values:
        """Copy and check a guess, by families or as it is stored, and give fixed variables their values.

        Raises:
            GraphError: naming the family and index of what is missing, misshapen, NaN or off its manifold.
        """
        values = self.reader(guess)
        if not self._vetted:
            for term in self.terms:
                term.require_clean(values)
                if not term.stands(values):
                    self._give_up(term)
            self._vetted = True
            self.renew_verifications()
            self._watched = [term for term in self.terms if term.trace is not None and not term.trace.constant]
        for term in self._watched:
            if term.trace is None or not term.trace.changed:
                continue
            if not (outdated := term.trace.outdated):
                term.refresh()
            elif term.trace_again(values):
                self.table.renew(term)
            else:
                self._give_up(term)
            if term.trace is not None:
                self.table.bind([term], self.lower, self.upper)
            if outdated:
                self.renew_verifications()
        if self.soft:
            self._start_slacks(values)
        return values

    def stored_from(self, guess: Array) -> Array:
        """The same of a guess as it is stored, which is viewed by families only where somebody has to look at them."""
        moved, stored = any(term.trace.changed for term in self._watched if term.trace), guess.copy()
        plain = self._vetted and not (moved or self.soft or self.reader.particular)
        return stored if plain and self.reader.settles(stored) else self.values_from(guess).flat

    def _start_slacks(self, values: Values) -> None:
        """Set slack variables to what the limits of soft constraints are violated by."""
        for slack in self.soft.values():
            values[slack.family][:] = 0.0
        beyond = np.nan_to_num(self.violation(self.evaluate(values).constraints), posinf=0.0, neginf=0.0)
        above, below = self.by_term(np.maximum(beyond, 0.0)), self.by_term(np.maximum(-beyond, 0.0))
        for name, slack in self.soft.items():
            values[slack.family][:] = slack.stored(above[name], below[name])

    def mistraced(self, values: Values, slopes: bool, seed: int) -> dict[str, str]:
        """Leave to Python the terms whose traces are not their functions at an answer.

        Args:
            values: the answer.
            slopes: whether derivatives are compared as well.
            seed: of the direction along which they are.

        Returns:
            Reasons by the names of these terms.
        """
        found: dict[str, str] = {}
        step = np.random.default_rng(seed).uniform(-1.0, 1.0, self.size) if slopes else np.ones(self.size)
        direction = np.zeros(self.columns.width)
        direction[self.columns.free] = step

        @cache
        def move(length: float) -> Values:
            return self.retract(values, length * step)

        with np.errstate(all="ignore"):
            differences = [
                verification.difference(values, direction, move, slopes) for verification in self.verifications
            ]
        for verification, why in zip(self.verifications, differences, strict=True):
            if why:
                verification.term.leave(why)
                self._give_up(verification.term)
                found[verification.term.name] = why
        if found:
            self.renew_verifications()
        return found

    def broken(self, values: Values) -> bool:
        """Test whether by a trace an assertion of its function fails at an answer, though the function raises nothing.

        Raises:
            Exception: of a function whose assertion fails.
        """
        with np.errstate(all="ignore"):
            return any([verification.broken(values) for verification in self.demanding])

    def watch_conditions(self) -> None:
        """Compile the comparisons of traces, for :meth:`new_branches` in a loop."""
        self._watching = True
        self.renew_verifications()

    def new_branches(self, stored: Array, verified: bool) -> bool:
        """Test whether comparisons in watched traces come out as at no verified answer; ``verified``: this is one."""
        return self.branches is not None and bool(self.branches) and self.branches.new(stored, verified)

    def renew_verifications(self) -> None:
        """Keep what verifies the present traces."""
        kept = {(known.term, known.kernel): known for known in self.verifications}
        self.verifications = [
            kept.get((term, term.trace.kernel)) or Verification(term) for term in self.terms if term.trace is not None
        ]
        self.demanding = [known for known in self.verifications if known.demanding]
        if self._watching:
            self.branches = Branches(self.table, [known.term for known in self.verifications], self.scratch)

    def _give_up(self, term: CompiledTerm) -> None:
        """Leave a term that was traced to Python."""
        self.differenced = True
        self.table.give_up(term)
        if term.kernel is None:
            (self._general if isinstance(term.term, ScalarCost) else self.batched).append(term)

    def retract(self, values: Values, step: Array) -> Values:
        """Move the unknowns by a tangent step; fixed variables stay."""
        return self.retraction(values, step)

    def within_bounds(self, values: Values) -> Values:
        """The nearest values that respect every bound of an unknown; ``values`` itself when all do."""
        moved = Values(self.columns, values.flat.copy())
        clip(moved.flat, self.bounded, np.flatnonzero(self.bound_rows), self.lower, self.upper)
        self.retraction.fix(moved)
        return values if np.array_equal(moved.flat, values.flat) else moved

    @cached_property
    def bounded(self) -> IntArray:
        """Places of stored values with a bound, in the order of their rows."""
        places, found = self.columns.view(np.arange(self.columns.stored, dtype=np.float64)), [np.zeros(0)]
        for term in self.constraint_terms:
            if term.is_bound:
                selection = term.gathers[0].selection
                found.append(places[selection.family][selection.indices, selection.storage].ravel())
        return np.concatenate(found).astype(np.int64)

    @property
    def large(self) -> bool:
        """True if linearising is worth more than one thread."""
        return self.table.entries + self.table.constraint_entries > WORTH

    # ---------------------------------------------------------------- evaluation

    def evaluate(self, values: Mapping[Family, Array], weights: Array | None = None) -> Evaluation:
        """Objective and constraints; ``weights`` are those of the linearisation whose line search this is."""
        table = self.table
        values = values if isinstance(values, Values) else self.columns.values(values)
        residual, constraints = np.empty(table.residuals), np.empty(table.constraints)
        squares = np.empty(table.weights)
        with self.lock, np.errstate(all="ignore"):
            if self.batched:
                began = perf_counter()
                for term in self.batched:
                    self.rows_of(term, residual, constraints)[:] = term.residual(values)
                self.python_seconds += perf_counter() - began
            holding, held = weights is not None, squares if weights is None else weights
            cost = evaluation.evaluate(
                table.arrays, values.flat, residual, constraints, squares, held, holding, self.scratch
            )
            for loss, part in table.weighed:
                if not (holding and loss.held):
                    cost += 0.5 * float(loss.value(squares[part]).sum())
            if self.scalar_terms:
                cost += evaluate_scalars(table.arrays, values.flat, np.empty(table.scalars), self.scratch)
                if general := self._general:
                    began = perf_counter()
                    cost += sum(float(term.residual(values).sum()) for term in general)
                    self.python_seconds += perf_counter() - began
        return Evaluation(cost, constraints)

    def unit_memory(self) -> Units:
        """Units of one, with memory to find others at a point (:mod:`unifg.problem.units`)."""
        table = self.table
        return unit_memory(self.columns, self.normal.diagonal, table.blocks, table.constraints)

    def linearize(self, values: Mapping[Family, Array], search: bool = False) -> Linearization:
        """Everything a backend needs at ``values``; with ``search``, by search Jacobians where a residual has one."""
        values = values if isinstance(values, Values) else self.columns.values(values)
        with self.lock:
            return self._linearize(values, search)

    def _linearize(self, values: Values, search: bool) -> Linearization:
        table = self.table
        shares = self._shared()
        buffers = self.buffers if shares is None else shares.buffers
        residual, jacobian, constraints, constraint_jacobian, gradient, room = buffers.take()
        hessian = room if shares is None else room[: self.normal.nnz]
        squares, weights = np.empty(table.weights), np.empty(table.weights)
        size = np.empty(len(table.arrays.fields))
        found = np.empty(table.scalars)
        concavity = np.zeros(self.normal.nnz if self.scalar_terms else 0)
        rounding = np.zeros(self.columns.width if self.scalar_terms else 0)
        batched, terms = self.batched, table.arrays
        if search:  # kernels know no search Jacobians
            searched = [term for term in self.terms if term.kernel is not None and term.term.residual.search]
            batched, terms = [*batched, *searched], table.without(searched)
        with np.errstate(all="ignore"):
            if batched:
                began = perf_counter()
                for term in batched:
                    self.rows_of(term, residual, constraints)[:] = term.residual(values)
                    self._entries_of(term, jacobian, constraint_jacobian, term.jacobians(values, search=search))
                self.python_seconds += perf_counter() - began
            out = LinearArrays(
                residual, jacobian, constraints, constraint_jacobian, squares, weights, size, gradient, hessian
            )
            if shares is not None:
                cost = linearize_shared(shares, terms, values.flat, out._replace(hessian=room))
            else:
                gradient[:], hessian[:] = 0.0, 0.0
                cost = evaluation.linearize(terms, values.flat, *out, self.scratch, 0, 1)
            if table.weighed:
                for loss, part in table.weighed:
                    weights[part] = loss.weight(squares[part])
                    cost += 0.5 * float(loss.value(squares[part]).sum())
                evaluation.weigh(table.arrays, out)
            if self.scalar_terms:
                cost += self._add_scalars(values, found, gradient, hessian, concavity, rounding)
        norms, scalars = self.norms(size, found), self.by_scalar(found)
        arrays = residual, jacobian, constraints, constraint_jacobian, gradient, hessian
        return Linearization(values, cost, *arrays, norms, weights, concavity, squares, scalars, rounding)

    def _shared(self) -> Shares | None:
        """Shares of the factors for every thread, where that is worth it."""
        if not self.large or (count := threads()) == 1:
            return None
        if self._shares is None or self._shares.count != count:
            self._shares = Shares(self.table, self.columns.width, self.normal.nnz, count)
        return self._shares

    def scalar_part(self, values: Values) -> tuple[Array, Array]:
        """Gradient (n,) and convex part of the Hessian of the scalar costs alone; empty where there are none.

        Args:
            values: where.
        """
        if not self.scalar_terms:
            return np.zeros(0), np.zeros(0)
        gradient, hessian = np.zeros(self.columns.width), np.zeros(self.normal.nnz)
        rest = np.zeros_like(hessian), np.zeros_like(gradient)
        self._add_scalars(values, np.empty(self.table.scalars), gradient, hessian, *rest)
        return gradient[self.columns.free], hessian

    def _add_scalars(
        self, values: Values, found: Array, gradient: Array, hessian: Array, concavity: Array, rounding: Array
    ) -> float:
        """Add the slopes and second derivatives of costs that are no squares; return what they cost."""
        arrays = self.arrays, values.flat, found, gradient, hessian, concavity, self.scratch
        cost = float(add_scalars(*arrays, True))
        if not (general := self._general):
            return cost
        began = perf_counter()
        for term in general:
            value = term.residual(values)
            cost += float(value.sum())
            found[term.place[ROW] : term.place[ROW] + term.count] = value
            slope, curvature, doubt = term.scalar_derivatives(values)
            columns = np.concatenate(term.columns, axis=1).ravel()
            np.add.at(gradient, columns, slope.ravel())
            np.add.at(rounding, columns, doubt.ravel())
            convex = convexified(curvature)
            self.add_pairs(term, convex, hessian)
            self.add_pairs(term, curvature - convex, concavity)
        self.python_seconds += perf_counter() - began
        return cost

    def add_pairs(self, term: CompiledTerm, blocks: Array, entries: Array) -> None:
        """Add (n, D, D) symmetric blocks of a term, by its tangent columns, to entries in the order of ``normal``."""
        width = blocks.shape[1]
        start, pairs = int(term.place[POSITION]), width * (width + 1) // 2
        if term not in self._pairs:
            where = self.arrays.positions[start : start + term.count * pairs].reshape(term.count, pairs)
            row, column = np.tril_indices(width)
            factor, pair = np.nonzero(where != -1)
            place = where[factor, pair]
            times, place = np.where(place < -1, 2.0, 1.0), np.where(place < -1, -2 - place, place)
            self._pairs[term] = factor, row[pair], column[pair], times, place
        factor, rows, columns, times, place = self._pairs[term]
        np.add.at(entries, place, times * blocks[factor, rows, columns])

    def norms(self, sizes: Array, scalars: Array | None = None) -> dict[str, float]:
        """Residual norms of the terms by name, as compiled loops leave them, and of the values of scalar costs."""
        norms = dict(zip(self._names, sizes.tolist(), strict=True))
        if scalars is not None and len(scalars):
            norms |= {name: float(np.abs(found).sum()) for name, found in self.by_scalar(scalars).items()}
        return norms

    def by_scalar(self, found: Array) -> dict[str, Array]:
        """(n,) values of every scalar cost by name, of those of all."""
        starts = [(term, int(term.place[ROW])) for term in self.scalar_terms]
        return {term.name: found[start : start + term.count] for term, start in starts}

    def rows_of(self, term: CompiledTerm, residual: Array, constraints: Array) -> Array:
        """(n, m) rows of a term in the stacked residuals."""
        target = residual if isinstance(term.term, Cost) else constraints
        return target[stacking.rows_in_stack(term)].reshape(term.count, term.size)

    def _entries_of(self, term: CompiledTerm, costs: Array, constraints: Array, blocks: list[Array]) -> None:
        """Copy (n, m, d_k) blocks side by side into the stacked Jacobian."""
        start, width = int(term.place[ENTRY]), int(term.place[WIDTH])
        target = costs if isinstance(term.term, Cost) else constraints
        own = target[start : start + term.count * term.size * width].reshape(term.count, term.size, width)
        at = 0
        for block in blocks:
            own[:, :, at : at + block.shape[2]] = block
            at += block.shape[2]

    # ---------------------------------------------------------------- products backends need

    def hessian_entries(self, lin: Linearization) -> Array:
        """Gauss-Newton Hessian of the objective in the order of ``hessian``."""
        return lin.hessian[self.objective_places]

    def normal_entries(self, lin: Linearization, row_weights: Array) -> Array:
        """Gauss-Newton Hessian plus A' diag(row_weights) A, in the order of ``normal``."""
        entries = lin.hessian.copy()
        evaluation.add_constraints(self.table.arrays, lin.constraint_jacobian, row_weights, entries)
        return entries

    def lagrangian_gradient(self, lin: Linearization, multipliers: Array) -> Array:
        """Gradient of the objective plus A' multipliers, over the full tangent space."""
        if not self.constraints.count:
            return lin.gradient
        return lin.gradient + self.constraints.transposed_times(lin.constraint_jacobian, multipliers)

    @property
    def inequalities(self) -> BoolArray:
        """(M,) rows that have a limit and are no equalities."""
        return cast(BoolArray, (np.isfinite(self.lower) | np.isfinite(self.upper)) & ~self.equality)

    def violation(self, constraints: Array) -> Array:
        """(M,) signed distance outside the limits: positive above, negative below, zero inside."""
        found = np.empty(len(constraints))
        outside(constraints, self.lower, self.upper, found)
        return found

    def fixed_rows(self) -> IntArray:
        """Constraint rows none of whose variables is unknown."""
        return self.once(_fixed_rows)

    def once(self, find: Callable[[CompiledProblem], T]) -> T:
        """Result of a function of this program, found when first asked for and kept as long as the program."""
        if find not in self._found:
            self._found[find] = find(self)
        return cast(T, self._found[find])

    def __reduce__(self) -> tuple[Callable[[Model], CompiledProblem], tuple[Model]]:
        """Pickle the graph: addresses of machine code mean nothing elsewhere, nor do views of arrays."""
        return compile_graph, (self.graph,)

    def term_named(self, name: str) -> CompiledTerm:
        """The term of a name.

        Raises:
            GraphError: there is none.
        """
        known = {term.name: term for term in self.terms}
        if name not in known:
            raise GraphError(f"no term is called '{name}' (there are: {', '.join(known) or 'none'})", term=name)
        return known[name]

    def row_place(self, row: int) -> tuple[str, int, int]:
        """Term, factor and row of the factor of a constraint row."""
        for name, rows, (_, size) in self.places:
            if rows.start <= row < rows.stop:
                return name, *divmod(row - rows.start, size)
        raise GraphError(f"row {row} belongs to no constraint", index=row)

    def row_name(self, row: int) -> tuple[str, int]:
        """Term and factor of a constraint row."""
        return self.row_place(row)[:2]

    @cached_property
    def _objective(self) -> tuple[Symmetric, IntArray]:
        """Pattern of the objective's Hessian and where its entries stand in ``normal``."""
        if not self.constraint_terms:
            return self.normal, np.arange(self.normal.nnz)
        pattern = stacking.block_pattern(self.cost_terms + self.scalar_terms, *self.columns.nodes())
        columns = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
        return pattern, self.normal.positions(pattern.indices, columns)


def _fixed_rows(program: CompiledProblem) -> IntArray:
    touched = np.zeros(program.constraints.count, dtype=bool)
    touched[program.constraints.free_rows] = True
    return np.flatnonzero(~touched)


def _side_by_side(parts: list[Array]) -> Array:
    """One flat array, also of nothing."""
    return np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0)


def compile_graph(graph: Model) -> CompiledProblem:
    """Offsets, ordering and sparsity; computed once and kept until the graph changes.

    Raises:
        GraphError: when it is no graph, has no variable, or a variable no term touches.
    """
    if not isinstance(graph, Model):
        raise GraphError(f"a solve takes a graph, as fg.Graph(), and then a guess; found {f'{graph!r}'[:80]}")
    if not isinstance(graph.compiled, CompiledProblem):
        program = CompiledProblem(graph)
        program.graph.compiled = graph.compiled = program
        return program  # another thread may have compiled it, too
    return graph.compiled


def idle_problem(graph: Model) -> CompiledProblem:
    """The same, or a program of its own where this thread is in the midst of a solve of it, as in a callback.

    Raises:
        GraphError: as :func:`compile_graph`.
    """
    program = compile_graph(graph)
    return CompiledProblem(graph) if program.lock.mine else program
