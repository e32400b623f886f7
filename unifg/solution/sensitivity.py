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

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from unifg.elimination.saddle import EXACT
from unifg.errors import GraphError
from unifg.factors.robust import form_of
from unifg.locks import ReentrantLock
from unifg.modeling.terms import Cost
from unifg.modeling.variables import Data, Family, Selection, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.linearization import Linearization
from unifg.problem.parameters import Parameter, datum, fixed, parts_of
from unifg.problem.systems import fill
from unifg.solution.covariance import SOLVED
from unifg.solution.gains import REPLACED, SAME, unfixed
from unifg.typing import Array, BoolArray, IntArray, Numbers

COST, HEIGHT = "cost", -2  # its name, and its place beside those of the KKT system
LINEARIZED = "cost", "gradient", "hessian", "constraints", "constraint_jacobian"
ENOUGH = 1e-10  # residual of most solves
AT_ONCE = 64  # right-hand sides in one call
WEAK = 10.0  # times the root of the tolerance: slack and multiplier of a row that may be active or not
Named = Variable | str
Weights = Mapping[Family, Numbers] | Mapping[Selection, Numbers] | Mapping[str, Numbers] | Mapping[Named, Numbers]
Wrt = Data | Variable | str


class Sensitivities:
    """The factorised KKT matrix at a solution, to be asked repeatedly."""

    def __init__(
        self,
        program: CompiledProblem,
        lin: Linearization,
        multipliers: Array,
        active: BoolArray,
        tolerance: float,
        edition: int,
        limits: tuple[Array, Array],
    ) -> None:
        """Factorise.

        Args:
            program: the compiled graph, with the data of the solution bound.
            lin: linearisation at the solution.
            multipliers: (M,) there.
            active: (M,) rows that hold as equalities.
            tolerance: of the solve.
            edition: number of its data.
            limits: of the constraints, (M,) each.

        Raises:
            GraphError: when the data have been replaced, rows are weakly active, or the reduced Hessian is not positive
                definite.
        """
        self._program, self._multipliers, self._lock = program, multipliers, ReentrantLock()
        for term in program.cost_terms:
            if isinstance(term.term, Cost) and form_of(term.term.robust) is None:
                raise GraphError(
                    f"sensitivity: the loss of term '{term.name}' has formulas of its own, and no second derivative: "
                    "use a loss that ships",
                    term=term.name,
                )
        self._lin, self._edition, self._limits, self._changes = (
            lin,
            edition,
            limits,
            dict[tuple[Hashable, ...], Change](),
        )
        with program.lock:
            self._require_data()
            self._require_strict(tolerance)
            held = active.copy()
            held[program.fixed_rows()] = False
            self._multipliers = np.where(held, multipliers, 0.0)
            hessian = lagrangian_hessian(program, lin, self._multipliers)
        n, self._system = program.size, program.systems.kkt(np.ones(len(held), dtype=bool))
        entries = np.zeros(self._system.pattern.nnz)
        fill(self._system.arrays, hessian, lin.constraint_jacobian, entries)
        out = np.concatenate([np.zeros(n, dtype=bool), ~held])
        self._number = np.where(held, n + np.arange(len(held)), -1)
        if not self._system.saddle.factor(self._system.without(entries, out)):
            raise GraphError("sensitivity: the Hessian is not finite at the solution")
        self._dependent = self._probe(out)

    def _require_data(self) -> None:
        """Raise unless the present data are those of the solution: their number, or what they make of its values."""
        program, lin = self._program, self._lin
        if self._edition == program.binding.edition:
            return
        here = program.linearize(program.columns.values(lin.values))
        pairs = [(getattr(here, name), getattr(lin, name)) for name in LINEARIZED]
        pairs += zip((program.lower, program.upper), self._limits, strict=True)
        if not all(np.allclose(a, b, rtol=SAME, atol=SAME) for a, b in pairs):
            raise GraphError(REPLACED)
        self._edition = program.binding.edition

    def _require_strict(self, tolerance: float) -> None:
        """Raise for the weakest row that may be active or not."""
        program, least = self._program, WEAK * float(np.sqrt(tolerance))
        force = np.abs(self._multipliers)
        force = force / max(1.0, float(force.mean()) / 100.0) if len(force) else force
        g = self._lin.constraints
        slack = np.minimum(*(np.abs(g - limit) for limit in self._limits))
        size = np.where(program.equality, np.inf, np.maximum(slack, force))
        size[program.fixed_rows()] = np.inf
        if len(size) and (worst := int(np.argmin(size))) >= 0 and size[worst] < least:
            term, factor, place = self._place(worst)
            raise GraphError(
                f"sensitivity: {place} is weakly active, its slack {slack[worst]:.1e} and its multiplier "
                f"{force[worst]:.1e} both below {least:.1e}: on either side of the present data the derivative is "
                "another. Solve with a smaller tolerance if one of them is not that small, else ask at other data",
                term=term,
                index=factor,
            )

    def _probe(self, out: BoolArray) -> str:
        """Solve for random numbers: what is left of them is what the matrix is singular in.

        Returns:
            Description of a row that depends on others, empty where there is none.

        Raises:
            GraphError: the reduced Hessian is singular or indefinite.
        """
        program, system, n = self._program, self._system, self._program.size
        right = np.random.default_rng(0).standard_normal(len(out)) / system.saddle.scale
        right[out] = 0.0
        rest = self._tried(right)[1]
        singular = not rest.max(initial=0.0) <= 1.0
        if singular:  # multipliers that dependent rows leave open may be too large to see the unknowns beside them
            rest[:n] = self._tried(np.where(np.arange(len(out)) < n, right, 0.0))[1][:n]
        if not rest[:n].max(initial=0.0) <= 1.0:
            family, index = program.columns.name(int(program.columns.free[np.argmax(rest[:n])]))
            raise GraphError(
                f"sensitivity: the reduced Hessian is singular: {family}[{index}] can move without the costs or the "
                "active constraints noticing; add a prior or fix something",
                family=family,
                index=index,
            )
        if system.factorization.inertia != (n, len(out) - n, 0):
            raise GraphError(
                "sensitivity: the reduced Hessian is indefinite: the solution is no strict local minimum, and what "
                "becomes of it when data change is not determined; start elsewhere"
            )
        return self._place(int(np.argmax(rest[n:])))[2] if singular else ""

    def _tried(self, right: Array) -> tuple[Array, Array]:
        """A solution, refined no more than it needs, and what it leaves of every row, in multiples of what it may."""
        saddle = self._system.saddle
        solution, rest, most = right, right, SOLVED * float(np.abs(saddle.scale * right).max(initial=0.0)) or 1.0
        for enough in (ENOUGH, EXACT):
            with self._lock:
                solution, _ = saddle.solve(right, enough)
                rest = np.abs(saddle.residual(solution, right)) / most
            if rest.max(initial=0.0) <= 1.0:
                break
        return solution, rest

    def _place(self, row: int) -> tuple[str, int, str]:
        """Term and factor of a constraint row, and the words for it."""
        term, factor, own = self._program.row_place(row)
        return term, factor, f"'{term}', factor {factor}, row {own},"

    def matrix(self, of: Sequence[Selection | str], wrt: Sequence[Wrt]) -> Array:
        """(k, K) derivatives; arguments and errors as of :meth:`unifg.Solution.sensitivity`."""
        if not (of and wrt):
            raise GraphError("sensitivity() of what? Name families, members or constraints, and data")
        places, columns = (np.concatenate(part) for part in zip(*map(self._rows, of), strict=True))
        change = self._change(wrt)
        result = np.zeros((len(places), change.count))
        result[places == HEIGHT] = change.heights
        of_fixed = change.numbers[:, columns] * (columns >= 0) - (columns < 0)
        which, row = np.nonzero(of_fixed >= 0)
        result[row, of_fixed[which, row]] = 1.0
        asked = np.flatnonzero(places >= 0)
        if self._forward(places[asked]) or change.count <= len(asked):
            for part in _chunks(np.arange(change.count if len(asked) else 0)):
                result[np.ix_(asked, part)] = self._solved(self._columns(change, part))[:, places[asked]].T
            return result
        for part in _chunks(asked):
            right = np.zeros((len(part), self._system.pattern.size))
            right[np.arange(len(part)), places[part]] = 1.0
            result[part] = [change.pulled(adjoint) for adjoint in self._solved(right)]
        return result

    def gradient(self, of: Mapping[Selection | str, Array], wrt: Wrt) -> Array:
        """Gradient of a weighted sum; arguments and errors as of :meth:`unifg.Solution.gradient`."""
        change, right = self._change([wrt]), np.zeros(self._system.pattern.size)
        total = np.zeros(change.count)
        for what, weights in of.items():
            places, columns = self._rows(what)
            try:
                given = np.broadcast_to(weights, shape := self._shape(what)).ravel()
            except ValueError:
                raise GraphError(
                    f"gradient: weights of {what!r} have shape {weights.shape}, expected {shape}"
                ) from None
            np.add.at(right, places[places >= 0], given[places >= 0])
            if (places == HEIGHT).any():
                total += given * change.heights
            own = np.where(columns < 0, -1, change.numbers[0, columns])
            np.add.at(total, own[own >= 0], given[own >= 0])
        if self._forward(np.flatnonzero(right)):
            for part in _chunks(np.arange(change.count)):
                total[part] += self._solved(self._columns(change, part)) @ right
        elif right.any():
            total += change.pulled(self._solved(right[None])[0])
        return total.reshape(change.shape)

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

    def _rows(self, of: Selection | str) -> tuple[IntArray, IntArray]:
        """Places (k,) in the KKT system, or `HEIGHT`, or -1 for none; full tangent columns (k,), or -1."""
        program = self._program
        if not isinstance(of, str):
            columns = program.columns.of(of).ravel()
            return program.columns.unknown[columns], columns
        rows = [rows for name, rows, _ in program.places if name == of]
        if not rows and of != COST:
            known = ", ".join([*(name for name, _, _ in program.places), COST])
            raise GraphError(f"sensitivity: no family or constraint is called '{of}' (there are: {known})", term=of)
        places = self._number[rows[0]] if rows else np.array([HEIGHT])
        return places, np.full(len(places), -1)

    def _shape(self, of: Selection | str) -> tuple[int, ...]:
        """Shape of the weights of what is asked for."""
        if not isinstance(of, str):
            return len(of), of.manifold.dim
        return next((shape for name, _, shape in self._program.places if name == of), ())

    def _parameter(self, wrt: Wrt) -> Parameter:
        program = self._program
        declared, families = program.graph._data, {family.name: family for family in program.families}
        if isinstance(wrt, str):
            if wrt not in declared and wrt not in families:
                known = ", ".join([*declared, *families])
                raise GraphError(f"sensitivity: no data or family is called '{wrt}' (there are: {known})")
            wrt = declared.get(wrt) or families[wrt]
        if not isinstance(wrt, Data):
            return fixed(program, as_selection(wrt))
        if declared.get(wrt.name) is not wrt:
            raise GraphError(f"data {wrt!r} does not belong to this graph")
        return datum(program, wrt)

    def _called(self, wrt: Wrt) -> Hashable:
        """Data and names by themselves, variables by their columns: each ``x[0]`` is another object."""
        return wrt if isinstance(wrt, Data | str) else self._program.columns.of(as_selection(wrt)).tobytes()

    def _change(self, wrt: Sequence[Wrt]) -> Change:
        """Derivatives of the KKT conditions by parameters.

        Raises:
            GraphError: the data of this solution have been replaced, or a parameter has no derivative.
        """
        asked = tuple(self._called(one) for one in wrt)
        if asked in self._changes:
            return self._changes[asked]
        program, given = self._program, [self._parameter(one) for one in wrt]
        unknown, ends = program.columns.unknown, np.cumsum([0, *(int(np.prod(one.shape)) for one in given)])
        starts = dict(zip(program.constraint_terms, (rows.start for rows in program.slices), strict=True))
        heights, moved = np.zeros(ends[-1]), np.array([one.numbers for one in given])
        parts = [(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros(0))]
        with program.lock:
            self._require_data()
            for first, one in zip(ends[:-1], given, strict=True):
                if (one.numbers >= 0).any():
                    gradient = program.lagrangian_gradient(self._lin, self._multipliers)
                    np.add.at(heights, first + one.numbers[one.numbers >= 0], gradient[one.numbers >= 0])
                    parts += [(rows, numbers + first, values) for rows, numbers, values in self._of_fixed(one.numbers)]
                for number, part in parts_of(program, self._lin.values, self._multipliers, one):
                    term = program.terms[number]
                    places = unknown[np.concatenate(term.columns, axis=1)]
                    if part.rows.shape[1]:
                        rows = starts[term] + np.arange(term.count * term.size).reshape(term.count, -1)
                        places = np.concatenate([places, self._number[rows]], axis=1)
                    values = np.concatenate([part.slopes, part.rows], axis=1)
                    numbers = part.numbers + first
                    spread = [np.broadcast_to(a, values.shape).ravel() for a in (places[:, :, None], numbers[:, None])]
                    parts.append((spread[0], spread[1], values.ravel()))
                    np.add.at(heights, numbers, part.heights)
        rows, numbers, values = map(np.concatenate, zip(*parts, strict=True))
        kept = np.flatnonzero((rows >= 0) & (values != 0.0))
        order = kept[np.argsort(numbers[kept], kind="stable")]
        moved = np.where(moved < 0, -1, moved + ends[:-1, None])
        change = Change(given[0].shape, rows[order], numbers[order], values[order], heights, moved)
        self._changes[asked] = change
        return change

    def _of_fixed(self, numbers: IntArray) -> list[tuple[IntArray, IntArray, Array]]:
        """Rows, numbers and values of the KKT matrix in the columns of fixed variables, which (width,) numbers name."""
        program, lin, unknown = self._program, self._lin, self._program.columns.unknown
        twin, here = unfixed(program, np.flatnonzero(numbers >= 0), lin)
        hessian = lagrangian_hessian(twin, here, self._multipliers)
        ends = [twin.columns.free[part] for part in (twin.normal.indices, twin.normal.columns)]
        found = []
        for row, column in (ends, ends[::-1]):
            own = np.flatnonzero((numbers[column] >= 0) & (unknown[row] >= 0))
            found.append((unknown[row[own]], numbers[column[own]], hessian[own]))
        own = np.flatnonzero(numbers[program.constraints.columns] >= 0)
        places = self._number[program.constraints.rows[own]]
        return [*found, (places, numbers[program.constraints.columns[own]], lin.constraint_jacobian[own])]

    def _columns(self, change: Change, numbers: IntArray) -> Array:
        """(k, size) right-hand sides for coordinates that follow each other."""
        size = self._system.pattern.size
        first, last = np.searchsorted(change.coordinates, [numbers[0], numbers[-1] + 1])
        places = change.rows[first:last] + size * (change.coordinates[first:last] - numbers[0])
        right = np.bincount(places, -change.values[first:last], len(numbers) * size)
        return np.asarray(right, dtype=np.float64).reshape(-1, size)

    def _solved(self, right: Array) -> Array:
        """Solutions for the rows of (k, size).

        Raises:
            GraphError: one has none.
        """
        with self._lock:
            solutions, left = self._system.saddle.solve_rows(right, ENOUGH)
        for k in np.flatnonzero(~(left <= SOLVED)):
            solutions[k], rest = self._tried(right[k])
            if not rest.max() <= 1.0:
                what = f": {self._dependent} depends on other active rows" if self._dependent else ""
                raise GraphError(
                    f"sensitivity: after a change of the data the active constraints contradict each other{what}"
                )
        return solutions


def _chunks(numbers: IntArray) -> Iterator[IntArray]:
    """Numbers in parts, for each of which right-hand sides are held in memory."""
    return (numbers[first : first + AT_ONCE] for first in range(0, len(numbers), AT_ONCE))


@dataclass(frozen=True)
class Change:
    """Change of the KKT conditions by parameters, entry by entry, ordered by parameter.

    Attributes:
        shape: of the coordinates, where there is one parameter.
        rows, coordinates, values: of the entries.
        heights: (K,) derivatives of the Lagrangian.
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

    def pulled(self, adjoint: Array) -> Array:
        """(K,) derivatives, of the solution for the rows that are asked for."""
        return np.asarray(
            np.bincount(self.coordinates, -self.values * adjoint[self.rows], self.count), dtype=np.float64
        )
