"""Derivatives of a solution with respect to its data, by the implicit function theorem.

At a solution the KKT conditions hold as equations, those of active inequalities with them, and keep holding while a
parameter p moves (A. V. Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming", 1983):

    [H  A'] [dx]       [d grad L]
    [A  0 ] [dl]  =  - [d g     ] ,

H being the Hessian of the Lagrangian, A the active rows, and the right-hand side what p changes at a fixed point
(:mod:`unifg.problem.parameters`). Dx is a right perturbation. The cost changes as the Lagrangian does. The matrix is
factorised once; each column of ``wrt``, or each row of ``of``, is one solve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

import numpy as np

from unifg.codegen.jit import compiled, inlined
from unifg.codegen.views import described
from unifg.elimination.plan import NEGATIVE, POSITIVE, ZERO
from unifg.elimination.saddle import CORRECTIONS, EXACT, NOTHING, prepared
from unifg.elimination.substitution import largest_of, refine, solve
from unifg.errors import GraphError
from unifg.factors.robust import form_of
from unifg.modeling.duplicates import doubles
from unifg.modeling.terms import Constraint, Cost
from unifg.modeling.variables import Data, Family, Selection, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.fixed_columns import FixedColumns
from unifg.problem.hessian import Block, block_of, curve, opened_block, require_second, uncompiled_hessian
from unifg.problem.linearization import Linearization
from unifg.problem.parameters import Parameter, datum, fixed_variables, parts_of
from unifg.problem.systems import KktSystem, Opened, fill, opened
from unifg.problem.table import opened_terms
from unifg.problem.units import cost_size, mean_force
from unifg.solution.covariance import SOLVED
from unifg.solution.gains import REPLACED, SAME, require_data
from unifg.solution.multipliers import size_of_costs, weakest
from unifg.typing import Array, BoolArray, IntArray, Numbers

COST, HEIGHT = "cost", -2  # its name, and its place beside those of the KKT system
ENOUGH, SMALL = 1e-10, 1e-11  # residual of most solves, by size of rows and of the right-hand side
AT_ONCE = 64  # right-hand sides in one call
KEPT = 32  # structures of questions
WEAK = 10.0  # times the root of the tolerance: slack and multiplier of a row that may be active or not
ONE = str, Family, Selection, Data
Named = Variable | str
Weights = Mapping[Family, Numbers] | Mapping[Selection, Numbers] | Mapping[str, Numbers] | Mapping[Named, Numbers]
Wrt = Data | Variable | str
T = TypeVar("T")


class Part(NamedTuple):
    """Places of what is asked for.

    Attributes:
        places: (k,) in the KKT system, `HEIGHT`, or -1 for none.
        columns: (k,) full tangent columns, or -1.
        unknown: whether all of it is unknown variables.
    """

    places: IntArray
    columns: IntArray
    unknown: bool


class Parameters(NamedTuple):
    """Data and fixed variables that derivatives are taken by.

    Attributes:
        each: data and fixed variables.
        starts: first coordinate of each, and the number of all.
        numbers: (parameters, width) coordinate of each full tangent column, -1 for none.
        fixed: columns of fixed variables, None where it moves none.
    """

    each: list[Parameter]
    starts: list[int]
    numbers: IntArray
    fixed: list[FixedColumns | None]


class Structure:
    """Structure that questions about all solutions of a graph share.

    Attributes:
        kkt: of the matrix with all constraint rows.
        probe: (size,) random numbers.
        open: (M,) rows with an unknown.
        scale: (size,) diagonal that equilibrates the first matrix; those of later ones begin there.
        hessian: memory, for who holds the lock of the program.
        terms: address of the arrays of the terms.
        parts, parameters: the ones asked for.
        fixed: columns of fixed variables, by the coordinates.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Find it.

        Raises:
            GraphError: a loss has no second derivative.
        """
        for term in program.cost_terms:
            if isinstance(term.term, Cost) and form_of(term.term.robust) is None:
                raise GraphError(
                    f"sensitivity: the loss of term '{term.name}' has formulas of its own, and no second derivative: "
                    "use a loss that ships",
                    term=term.name,
                )
        self.kkt = program.systems.structure(np.ones(program.constraints.count, dtype=bool))
        self.probe = np.random.default_rng(0).standard_normal(self.kkt.factorization.pattern.size)
        self.open = np.ones(program.constraints.count, dtype=bool)
        self.open[program.fixed_rows()] = False
        self.scale: Array = NOTHING
        self.hessian = np.empty(program.normal.nnz)
        self._words = described(program.arrays)
        self.terms = int(self._words.ctypes.data)
        self.parts: dict[Hashable, Part] = {}
        self.parameters: dict[Hashable, Parameters] = {}
        self.fixed: dict[Hashable, FixedColumns] = {}


def remembered(known: dict[Hashable, T], key: Hashable, find: Callable[[], T]) -> T:
    """Find something for a key once; the latest `KEPT` are kept."""
    if key not in known:
        while len(known) >= KEPT:
            del known[next(iter(known))]
        known[key] = find()
    return known[key]


class Sensitivities:
    """The factorised KKT matrix at a solution, to be asked repeatedly."""

    def __init__(
        self,
        program: CompiledProblem,
        lin: Linearization,
        multipliers: Array,
        equality: BoolArray,
        tolerance: float,
        edition: int,
        limits: tuple[Array, Array],
    ) -> None:
        """Factorise.

        Args:
            program: the compiled graph, with the data of the solution bound.
            lin: linearisation at the solution.
            multipliers: (M,) there.
            equality: (M,) rows that are equalities.
            tolerance: of the solve.
            edition: number of its data.
            limits: of the constraints, (M,) each.

        Raises:
            GraphError: when the data have been replaced, rows are weakly active, or the reduced Hessian is not positive
                definite.
        """
        self._program, self._lin, self._edition, self._limits = program, lin, edition, limits
        self._changes: dict[tuple[Hashable, ...], Change] = {}
        self._multipliers, self._out = np.empty(len(multipliers)), np.zeros(program.size + len(multipliers), dtype=bool)
        self._structure = program.once(Structure)
        self._near = self._structure.scale
        with program.lock, self._structure.kkt.borrowed() as system:
            self._require_data()
            self._dependent = self._settle(system, multipliers, equality, tolerance)

    def _settle(self, system: KktSystem, multipliers: Array, equality: BoolArray, tolerance: float) -> str:
        """Find which rows are held, factorise, and solve for random numbers, of which singular directions leave some.

        Returns:
            Description of a row that depends on others, empty where there is none.

        Raises:
            GraphError: as of the class.
        """
        program, lin, structure, saddle = self._program, self._lin, self._structure, system.saddle
        block, extra = block_of(program, lin), NOTHING
        require_second(program)
        held = *self._limits, multipliers, structure.open, equality, self._multipliers, self._out
        if program.batched:
            weakest(lin.constraints, *held, size_of_costs(program, lin))
            extra = uncompiled_hessian(program, lin, self._multipliers) - lin.hessian
        self._entries, system.loaded = np.empty(system.pattern.nnz), None
        row, slack, force, left, regular = settle(
            structure.terms, system.address, block, held, program.normal.diagonal, extra, self._near, structure.probe,
            self._entries, structure.hessian,
        )  # fmt: skip
        if row >= 0 and max(slack, force) < (least := WEAK * math.sqrt(tolerance)):
            row, slack, force = self._weakest(multipliers, equality, size_of_costs(program, lin))
        if row >= 0 and max(slack, force) < least:
            term, factor, place = self._place(row)
            raise GraphError(
                f"sensitivity: {place} is weakly active, its slack {slack:.1e} and its multiplier "
                f"{force:.1e} both below {least:.1e}: on either side of the present data the derivative is "
                "another. Solve with a smaller tolerance if one of them is not that small, else ask at other data",
                term=term,
                index=factor,
            )
        if not (saddle.adopt(self._entries, left >= 0.0) or system.load(self._entries, self._near)):
            raise GraphError("sensitivity: the Hessian is not finite at the solution")
        system.loaded, dependent = self._entries, ""
        if not len(structure.scale):
            structure.scale = saddle.scale.copy()
        if not 0.0 <= left <= SOLVED:
            dependent = self._singular(system, np.where(self._out, 0.0, structure.probe / saddle.scale))
            regular = system.factorization.inertia == (program.size, len(self._out) - program.size, 0)
        if not regular:
            raise GraphError(
                "sensitivity: the reduced Hessian is indefinite: the solution is no strict local minimum, and what "
                "becomes of it when data change is not determined; start elsewhere"
            )
        return dependent

    def _weakest(self, multipliers: Array, equality: BoolArray, unit: float) -> tuple[int, float, float]:
        """Inequality closest to being active or not, where prices of soft constraints say nothing of other rows.

        The limit of a slack is as far as the row that it gives way to, and square prices pull at it, too.

        Returns:
            As :func:`weakest`, which is quicker.
        """
        program, lin = self._program, self._lin
        slack = np.minimum(*(np.abs(lin.constraints - limit) for limit in self._limits))
        force, curvature = np.abs(multipliers), np.append(lin.hessian[program.normal.diagonal], 0.0)
        for before, rows, term in zip(program.slices, program.slices[1:], program.constraint_terms[1:], strict=False):
            if isinstance(term.term, Constraint) and term.term.limits_slacks:
                pull = curvature[program.columns.unknown[np.concatenate(term.columns, axis=1).ravel()]] * slack[rows]
                apart = slack[before].reshape(term.count, -1)
                force[rows] = np.maximum(force[rows], pull)
                slack[rows] = np.maximum(slack[rows], np.tile(apart, (1, pull.size // apart.size)).ravel())
        force /= max(unit, mean_force(program.arrays, multipliers, np.ones(len(force))))
        larger = np.where(self._structure.open & ~equality, np.maximum(slack, force), np.inf)
        row = int(np.argmin(larger))
        return row, float(slack[row]), float(force[row])

    def _require_data(self) -> None:
        """Raise unless the present data are those of the solution: their number, or what they make of its values."""
        program = self._program
        if self._edition == program.binding.edition:
            return
        require_data(program, self._lin)
        if not all(map(partial(np.allclose, rtol=SAME, atol=SAME), (program.lower, program.upper), self._limits)):
            raise GraphError(REPLACED)
        self._edition = program.binding.edition

    def _singular(self, system: KktSystem, right: Array) -> str:
        """Find what the matrix is singular in, from a system that was not solved at once."""
        program, n, rest = self._program, self._program.size, _tried(system, right)[1]
        if rest.max(initial=0.0) <= 1.0:
            return ""
        # multipliers that dependent rows leave open may be too large to see the unknowns beside them
        rest[:n] = _tried(system, np.where(np.arange(len(right)) < n, right, 0.0))[1][:n]
        if not rest[:n].max(initial=0.0) <= 1.0:
            family, index = program.columns.name(int(program.columns.free[np.argmax(rest[:n])]))
            raise GraphError(
                f"sensitivity: the reduced Hessian is singular: {family}[{index}] can move without the costs or the "
                "active constraints noticing; add a prior or fix something",
                family=family,
                index=index,
            )
        return self._place(int(np.argmax(rest[n:])))[2]

    def _place(self, row: int) -> tuple[str, int, str]:
        """Term and factor of a constraint row, and the words for it."""
        term, factor, own = self._program.row_place(row)
        return term, factor, f"'{term}', factor {factor}, row {own},"

    def matrix(self, of: Sequence[Selection | str], wrt: Sequence[Wrt]) -> Array:
        """(k, K) derivatives; arguments and errors as of :meth:`unifg.Solution.sensitivity`."""
        if not (len(of) and len(wrt)):
            raise GraphError("sensitivity() of what? Name families, members or constraints, and data")
        places, columns, unknown = self._rows(of)
        change = self._change(wrt)
        if unknown:
            return self._derivatives(change, places)
        result, asked = np.zeros((len(places), change.count)), np.flatnonzero(places >= 0)
        result[asked] = self._derivatives(change, places[asked])
        if (places == HEIGHT).any():
            result[places == HEIGHT] = self._heights(change)
        of_fixed = change.numbers[:, columns] * (columns >= 0) - (columns < 0)
        which, row = np.nonzero(of_fixed >= 0)
        result[row, of_fixed[which, row]] = 1.0
        return result

    def _derivatives(self, change: Change, places: IntArray) -> Array:
        """(k, K) derivatives of what stands at some places (k,) of the KKT system."""
        result = np.empty((len(places), change.count))
        if self._forward(places) or change.count <= len(places):
            for part in _chunks(change.count if len(places) else 0):
                result[:, part] = self._solved(self._columns(change, part))[0][:, places].T
            return result
        for part in _chunks(len(places)):
            result[part] = self._solved(np.zeros((part.stop - part.start, len(self._out))), change, places[part])[1]
        return result

    def gradient(self, of: Mapping[Selection | str, Array], wrt: Wrt) -> Array:
        """Gradient of a weighted sum; arguments and errors as of :meth:`unifg.Solution.gradient`."""
        change, right = self._change([wrt]), np.zeros(len(self._out))
        total, asked = np.zeros(change.count), False
        for what, weights in of.items():
            places, columns, unknown = self._rows([what])
            given = self._weights(what, weights)
            if not unknown:
                if (places == HEIGHT).any():
                    total += given * self._heights(change)
                own = np.where(columns < 0, -1, change.numbers[0, columns])
                np.add.at(total, own[own >= 0], given[own >= 0])
                given, places = given[places >= 0], places[places >= 0]
            np.add.at(right, places, given)
            asked = asked or len(places) > 0
        if self._dependent and self._forward(np.flatnonzero(right)):
            for part in _chunks(change.count):
                total[part] += self._solved(self._columns(change, part))[0] @ right
        elif asked:
            total += self._solved(right[None], change)[1][0]
        return total.reshape(change.shape)

    def _weights(self, of: Selection | str, weights: Array) -> Array:
        """Weights of what is asked for, one each.

        Raises:
            GraphError: they have another shape, or are not finite.
        """
        if not np.isfinite(weights).all():
            raise GraphError(f"gradient: weights of {of!r} must be finite numbers")
        if not isinstance(of, str):
            shape: tuple[int, ...] = len(of), of.manifold.dim
        else:
            shape = next((shape for name, _, shape in self._program.places if name == of), ())
        try:
            return np.broadcast_to(weights, shape).ravel() if weights.ndim else np.full(shape, weights).ravel()
        except ValueError:
            raise GraphError(f"gradient: weights of {of!r} have shape {weights.shape}, expected {shape}") from None

    def _forward(self, places: IntArray) -> bool:
        """Test whether columns are the only way, because active gradients depend on each other.

        Raises:
            GraphError: multipliers are asked for, which are not unique then.
        """
        if self._dependent and (places >= self._program.size).any():
            raise GraphError(
                f"sensitivity: {self._dependent} has a gradient that depends on those of other active rows, and "
                "multipliers are not unique: state each condition once, or ask for values"
            )
        return bool(self._dependent)

    def _rows(self, of: Sequence[Selection | str]) -> Part:
        """Places of what is asked for, one after the other; those of multipliers only where a row is held."""
        known = self._structure.parts
        part = remembered(known, tuple(map(_called, of)), lambda: _joined([self._part(one) for one in of]))
        if part.unknown:
            return part
        places = part.places
        return part._replace(places=np.where((places >= 0) & self._out[places], -1, places))

    def _part(self, of: Selection | str) -> Part:
        """Places of one part, whether rows are held or not."""
        program = self._program
        if not isinstance(of, str):
            columns = program.columns.of(of).ravel()
            places = program.columns.unknown[columns]
            return Part(places, columns, bool((places >= 0).all()))
        rows = [rows for name, rows, _ in program.places if name == of]
        if not rows and of != COST:
            known = ", ".join([*(one.name for one in program.families), *(p[0] for p in program.places), COST])
            raise GraphError(f"sensitivity: no family or constraint is called '{of}' (there are: {known})", term=of)
        places = program.size + np.arange(rows[0].start, rows[0].stop) if rows else np.array([HEIGHT])
        return Part(places, np.full(len(places), -1), False)

    def _parameter(self, wrt: Wrt) -> Parameter:
        program = self._program
        declared, families = program.graph._data, {family.name: family for family in program.families}
        if isinstance(wrt, str):
            if wrt not in declared and wrt not in families:
                known = ", ".join([*declared, *families])
                raise GraphError(f"sensitivity: no data or family is called '{wrt}' (there are: {known})")
            wrt = declared.get(wrt) or families[wrt]
        if not isinstance(wrt, Data):
            return fixed_variables(program, as_selection(wrt))
        if declared.get(wrt.name) is not wrt:
            raise GraphError(f"data {wrt!r} does not belong to this graph")
        return datum(program, wrt)

    def _change(self, wrt: Sequence[Wrt]) -> Change:
        """Derivatives of the KKT conditions by parameters.

        Raises:
            GraphError: the data of this solution have been replaced, or a parameter has no derivative.
        """
        asked = tuple(map(_called, wrt))
        if asked in self._changes:
            return self._changes[asked]
        program, parts = self._program, []
        given = remembered(self._structure.parameters, asked, partial(self._parameters, wrt))
        heights = np.zeros(given.starts[-1])
        with program.lock:
            self._require_data()
            for first, one, fixed in zip(given.starts, given.each, given.fixed, strict=False):
                if fixed is not None:
                    values = fixed.entries(program, self._lin, self._multipliers, self._out)
                    parts.append((fixed.rows, fixed.coordinates + first if first else fixed.coordinates, values))
                if one.handle is not None:
                    parts += self._of_data(one, first, heights)
        ordered = len(parts) == 1 and given.fixed[0] is not None
        rows, numbers, values = parts[0] if ordered else _ordered(parts, self._out)
        self._changes[asked] = change = Change(given.each[0].shape, rows, numbers, values, heights, given.numbers)
        return change

    def _parameters(self, wrt: Sequence[Wrt]) -> Parameters:
        """Several parameters, one after the other."""
        program, each = self._program, [self._parameter(one) for one in wrt]
        starts = list(accumulate((math.prod(one.shape) for one in each), initial=0))
        moved = [np.where(one.numbers < 0, -1, one.numbers + first) for first, one in zip(starts, each, strict=False)]
        known = self._structure.fixed
        fixed = [
            remembered(known, one.numbers.tobytes(), partial(FixedColumns, program, one.numbers)) if one.fixed else None
            for one in each
        ]
        return Parameters(each, starts, np.array(moved), fixed)

    def _of_data(self, one: Parameter, first: int, heights: Array) -> Iterator[tuple[IntArray, IntArray, Array]]:
        """Places, numbers and values of what data do to the terms that read them; adds to the heights."""
        program = self._program
        starts = dict(zip(program.constraint_terms, (rows.start for rows in program.slices), strict=True))
        for number, part in parts_of(program, self._lin.values, self._multipliers, one):
            term = program.terms[number]
            places = program.columns.unknown[np.concatenate(term.columns, axis=1)]
            if part.rows.shape[1]:
                rows = program.size + starts[term] + np.arange(term.count * term.size).reshape(term.count, -1)
                places = np.concatenate([places, rows], axis=1)
            values = np.concatenate([part.slopes, part.rows], axis=1)
            numbers = part.numbers + first
            spread = [np.broadcast_to(a, values.shape).ravel() for a in (places[:, :, None], numbers[:, None])]
            yield spread[0], spread[1], values.ravel()
            np.add.at(heights, numbers, part.heights)

    def _heights(self, change: Change) -> Array:
        """(K,) derivatives of the Lagrangian."""
        heights = change.heights.copy()
        for numbers in change.numbers:
            if (moved := numbers >= 0).any():
                gradient = self._program.lagrangian_gradient(self._lin, self._multipliers)
                np.add.at(heights, numbers[moved], gradient[moved])
        return heights

    def _columns(self, change: Change, part: slice) -> Array:
        """(k, size) right-hand sides for coordinates that follow each other."""
        size, count = len(self._out), part.stop - part.start
        first, last = np.searchsorted(change.coordinates, [part.start, part.stop])
        places = change.rows[first:last] + size * (change.coordinates[first:last] - part.start)
        right = np.bincount(places, -change.values[first:last], count * size)
        return np.asarray(right, dtype=np.float64).reshape(count, size)

    def _solved(self, right: Array, change: Change | None = None, ones: IntArray | None = None) -> tuple[Array, Array]:
        """Solutions for the rows of (k, size), and (k, K) what they make of a change.

        Args:
            right: right-hand sides.
            change: the change.
            ones: (k,) where each row receives a one.

        Raises:
            GraphError: one has none.
        """
        change, ones = change or NO_CHANGE, NONE if ones is None else ones
        solutions, left, found = np.empty(right.shape), np.empty(len(right)), np.zeros((len(right), change.count))
        with self._structure.kkt.borrowed() as system:
            system.load(self._entries, self._near)
            given = change.rows, change.coordinates, change.values
            if answer(system.address, right, ones, solutions, left, *given, found) <= SOLVED:
                return solutions, found
            for k in np.flatnonzero(~(left <= SOLVED)):
                solutions[k], rest = _tried(system, right[k])
                if not rest.max() <= 1.0:
                    raise GraphError(
                        "sensitivity: after a change of the data the active constraints contradict each other: "
                        f"{self._dependent} depends on other active rows"
                        if self._dependent
                        else "sensitivity: the curvature at the solution is lost to rounding: a direction is hardly "
                        "determined, as where a robust loss leaves hardly any weight"
                    )
        found[:] = 0.0
        pull(*given, solutions, found)
        return solutions, found


def several(named: Any) -> Sequence[Any]:
    """Sequence of names, of one name or of several; a selection is one."""
    return [named] if isinstance(named, ONE) or not isinstance(named, Sequence) else named


def as_weights(of: Named, weights: Numbers) -> Array:
    """Weights of a part as an array; a plain number needs no name for a message."""
    return np.asarray(weights) if type(weights) is float else doubles(f"gradient: weights of {of!r}", weights)


def _called(asked: Named | Wrt) -> Hashable:
    """Data and names by themselves, variables by their members: each ``x[0]`` is another object."""
    if isinstance(asked, Data | str):
        return asked
    if not isinstance(asked, Variable):
        raise GraphError(f"sensitivity: {type(asked).__name__} is no data or variable: state it by graph.data first")
    chosen = as_selection(asked)
    return chosen.family, chosen.component, chosen.indices.tobytes()


def _joined(parts: Sequence[Part]) -> Part:
    """Several parts, one after the other."""
    if len(parts) == 1:
        return parts[0]
    places, columns = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Part(places, columns, all(part.unknown for part in parts))


def _ordered(parts: Sequence[tuple[IntArray, IntArray, Array]], out: BoolArray) -> tuple[IntArray, IntArray, Array]:
    """Rows, coordinates and values of entries, by coordinates, without those of no row or of one that is not held."""
    rows, numbers, values = map(np.concatenate, zip((NONE, NONE, NOTHING), *parts, strict=True))
    kept = np.flatnonzero((rows >= 0) & (values != 0.0) & ~out[rows])
    order = kept[np.argsort(numbers[kept], kind="stable")]
    return rows[order], numbers[order], values[order]


def _tried(system: KktSystem, right: Array) -> tuple[Array, Array]:
    """A solution, refined no more than it needs, and what it leaves of every row, in multiples of what it may."""
    saddle = system.saddle
    solution, rest, most = right, right, SOLVED * float(np.abs(saddle.scale * right).max(initial=0.0)) or 1.0
    for enough in (ENOUGH, EXACT):
        solution, _ = saddle.solve(right, enough)
        rest = np.abs(saddle.residual(solution, right)) / most
        if rest.max(initial=0.0) <= 1.0:
            break
    return solution, rest


def _chunks(count: int) -> Iterator[slice]:
    """Numbers in parts, for each of which right-hand sides are held in memory."""
    return (slice(first, min(first + AT_ONCE, count)) for first in range(0, count, AT_ONCE))


@dataclass(eq=False)
class Change:
    """Change of the KKT conditions by parameters, entry by entry, ordered by parameter.

    Attributes:
        shape: of the coordinates, where there is one parameter.
        rows, coordinates, values: of the entries.
        heights: (K,) derivatives of the Lagrangian, but for what fixed variables do.
        numbers: (parameters, width) coordinate of each full tangent column, -1 for none.
    """

    shape: tuple[int, ...]
    rows: IntArray
    coordinates: IntArray
    values: Array
    heights: Array
    numbers: IntArray

    @property
    def count(self) -> int:
        """Coordinates of all parameters."""
        return len(self.heights)


NONE = np.zeros(0, dtype=np.intp)
NO_CHANGE = Change((), NONE, NONE, NOTHING, NOTHING, np.zeros((0, 0), dtype=np.intp))


@compiled
def settle(
    terms_at: int,
    system_at: int,
    block: Block,
    held: tuple[Array, Array, Array, BoolArray, BoolArray, Array, BoolArray],
    diagonal: IntArray,
    extra: Array,
    near: Array,
    probe: Array,
    entries: Array,
    hessian: Array,
) -> tuple[int, float, float, float, bool]:
    """Factorise the matrix of the rows that are held.

    Args:
        terms_at: address of those of the program.
        system_at: address of the matrix.
        block: linearisation.
        held: arguments of :func:`weakest`, from the limits on.
        diagonal: places of the curvatures in the Hessian of the costs.
        extra: what Python has found of the Hessian besides, the concavity included; empty for that alone.
        near: as of :func:`prepared`.
        probe: (size,) random numbers.
        entries: receive those of the matrix.
        hessian: memory.

    Returns:
        What :func:`weakest` does; what is left of the random numbers, negative where the factorisation fails; whether
        as many pivots are positive as there are unknowns, and all others negative.
    """
    values, residual, jacobian, squares, weights, rows, slopes, gradient, costs, concavity = opened_block(block)
    system, out = opened(system_at), held[6]
    kkt, saddle = system.kkt, system.saddle
    row, slack, force = weakest(rows, *held, cost_size(diagonal, costs, gradient))
    added = extra if len(extra) else concavity
    for k in range(len(hessian)):
        hessian[k] = costs[k] + (added[k] if len(added) else 0.0)
    curve(opened_terms(terms_at), values, residual, jacobian, squares, weights, held[5], hessian)
    fill(kkt, hessian, slopes, entries)
    n, state = kkt.size[0], kkt.plan.state
    for k in range(n, len(out)):
        if out[k]:
            last = saddle.indptr[k + 1] - 1
            entries[saddle.indptr[k] : last], entries[last] = 0.0, -1.0
    if not prepared(kkt.plan, saddle, entries, n, near):
        return row, slack, force, -1.0, False
    right, solution, rest = np.empty(len(out)), np.empty(len(out)), np.empty(len(out))
    for k in range(len(out)):
        right[k] = 0.0 if out[k] else probe[k] / saddle.scale[k]
    left = _solve(system, right, solution, rest, SOLVED)[1]
    return row, slack, force, left, state[POSITIVE] == n and state[NEGATIVE] == kkt.size[1] and state[ZERO] == 0


@inlined
def _solve(system: Opened, right: Array, out: Array, rest: Array, small: float) -> tuple[float, float]:
    """Solve for one right-hand side; ``rest`` is what is left of it.

    Returns:
        The residual, as of :func:`refine`; the largest that is left relative to the right-hand side, both equilibrated,
        which will do below ``small``.
    """
    plan, saddle, scale = system.kkt.plan, system.saddle, system.saddle.scale
    size = largest_of(scale, right)
    best = refine(
        plan, saddle.starts, saddle.rows, saddle.entries, right, scale, system.kkt.size[0], out, rest, ENOUGH,
        small * size, CORRECTIONS,
    )  # fmt: skip
    worst = largest_of(scale, rest)
    return best, (worst / size if size > 0.0 else worst) if best < np.inf else np.inf


@compiled
def answer(
    system_at: int, right: Array, ones: IntArray, out: Array, left: Array, rows: IntArray, numbers: IntArray,
    values: Array, found: Array,
) -> float:  # fmt: skip
    """Solve for the rows of (k, size), and :func:`pull`.

    What the shift of the diagonal leaves of a row, however small, is solved for once more, and not looked at again.

    Args:
        system_at: address of the matrix.
        right: right-hand sides.
        ones: where each row receives a one, or none.
        out: receive the solutions.
        left: (k,) receives what is left of each, as of :func:`_solve`.
        rows: as of :func:`pull`, with what follows.
        numbers: see there.
        values: see there.
        found: see there.

    Returns:
        The largest in ``left``.
    """
    system, rest, most = opened(system_at), np.empty(right.shape[1]), 0.0
    for k in range(len(ones)):
        right[k, ones[k]] = 1.0
    for k in range(len(right)):
        best, left[k] = _solve(system, right[k], out[k], rest, SMALL)
        most = max(most, left[k])
        if best > ENOUGH and left[k] <= SMALL:
            solve(system.kkt.plan, rest, rest)
            for i in range(len(rest)):
                out[k, i] += rest[i]
    pull(rows, numbers, values, out, found)
    return most


@compiled
def pull(rows: IntArray, coordinates: IntArray, values: Array, adjoints: Array, out: Array) -> None:
    """Subtract the products of each adjoint with the entries of every coordinate."""
    for k in range(len(adjoints)):
        for e in range(len(values)):
            out[k, coordinates[e]] -= values[e] * adjoints[k, rows[e]]
