"""Solution of a backend, and guesses made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from html import escape
from os import PathLike
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import ref

import numpy as np

from unifg.errors import GraphError, UnifgError, require_kinds
from unifg.modeling.soft import SlackFamily
from unifg.modeling.variables import Data, Family, Selection, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.conditioning import Conditioning, cheap, conditioning
from unifg.solution.covariance import Covariances
from unifg.solution.explain import ambiguous, disagreeing, holding, slow, tolerated, violated, weak
from unifg.solution.fit import Fit, fit_of
from unifg.solution.gains import feedback_gains, require_data
from unifg.solution.guess import Guess
from unifg.solution.history import FactorNorms, History, Iteration, factor_norms
from unifg.solution.marginal import Variables, information, marginal_prior
from unifg.solution.multipliers import hold, size_of_costs
from unifg.solution.optimality import Optimality
from unifg.solution.outlier_report import OutlierReport
from unifg.solution.saved import write_answer
from unifg.solution.sensitivity import COST, Named, Sensitivities, Weights, Wrt, as_weights, several
from unifg.solution.status import Found, Status
from unifg.solution.tube import tube
from unifg.solution.verify import Verified, require_tolerance, verified
from unifg.solution.warm_start import Shifts
from unifg.typing import Array, BoolArray, Figure, Numbers

if TYPE_CHECKING:
    from unifg.plots.shown import Shown

GIVEN_WAY = 1e-6  # of a violation, from which on it is reported


class Solution:
    """The final iterate with its KKT numbers.

    Attributes:
        status: why the solve ended.
        cost: objective, with its 1/2. Soft constraints count by the slacks of the iterate, which without convergence
            are not yet those of :meth:`slack`: the difference is in the violation.
        stationarity, violation, complementarity: KKT numbers, see :mod:`unifg.solution.optimality`. The stationarity of
            pure least squares is its relative offset, free of the unit of cost; above the tolerance, at least this.
        rounding: by how much numerical differentiation may be wrong about the stationarity.
        finite: whether everything could be evaluated there.
        iterations: number of iterations taken.
        restoration_steps: steps besides, of feasibility restoration: descents on the violation alone.
        seconds: wall-clock time of the solve.
        solver: name of the backend.
        tolerance: of the KKT test of the solve.
        returned: number of the iteration that is returned; 0 for the guess. Not the last one where a limit, a stall or
            an interruption ended the solve and an earlier iterate has less cost plus price times violation.
        in_python: seconds of them spent in residuals that Python evaluates, see ``graph.check``.
        verdict: which measurements it believes, from solves that decide that.
        picked: for what the backend was picked, where the caller named none.
        others: answers of the other starts, where several were asked for.
        checked: whether traced functions were evaluated as they were written at this answer, and agreed.
        mistraced: terms left to Python by that check, and the reasons; the solve was repeated without their traces.
    """

    tolerance, _edition = 1e-6, -1
    _data: bytes | None = None  # once they are replaced, or asked for
    in_python = 0.0
    _parts: tuple[float, float, float, float] | None = None
    restoration_steps = 0
    checked = False
    mistraced: Mapping[str, str] = MappingProxyType({})
    picked = ""
    others: tuple[Found, ...] = ()
    verdict: OutlierReport[Solution] | None = None

    def __init__(
        self,
        program: CompiledProblem,
        linearization: Linearization,
        multipliers: Array,
        penalties: Array,
        status: Status,
        measured: Optimality,
        history: list[Iteration] | Callable[[], list[Iteration]],
        iterations: int,
        seconds: float,
        solver: str,
        returned: int,
    ) -> None:
        """Assembled by :class:`unifg.Solver`."""
        self._program, program.binding.holder = program, ref(self)
        self._lin = linearization
        self._multipliers, self._penalties = multipliers, penalties
        self._equality = program.equality
        self._lower, self._upper = program.lower, program.upper
        self.status = status
        self.cost = linearization.cost
        self.stationarity = measured.stationarity
        self.rounding = measured.rounding
        self.finite = measured.finite
        self.violation = measured.violation
        self.complementarity = measured.complementarity
        self._worst_row = measured.worst_row
        self._history = history
        self.iterations = iterations
        self.seconds = seconds
        self.solver = solver
        self.returned = returned

    @property
    def history(self) -> History:
        """One row per iteration, row 0 being the start; ``history.plot()`` draws them.

        The row that is returned is marked in its details, where it is not the last.
        """
        if not isinstance(self._history, History):
            self._history = History(self._history() if callable(self._history) else self._history)
            if self.returned < len(self._history) - 1:
                self._history[self.returned].details["returned"] = 1
        return self._history

    @history.setter
    def history(self, rows: list[Iteration]) -> None:
        self._history = rows

    @property
    def converged(self) -> bool:
        """True if the KKT conditions hold to the tolerance."""
        return self.status.converged

    @property
    def values(self) -> dict[Family, Array]:
        """Copies of the values of every family."""
        return self._program.columns.view(self._lin.values.flat.copy())

    @property
    def multipliers(self) -> dict[str, Array]:
        """Multipliers of every constraint term, (n, m) each."""
        return self._program.by_term(self._multipliers.copy())

    @property
    def penalties(self) -> dict[str, Array]:
        """Penalties the solve ended with, (n, m) for every constraint term; empty when the backend has none."""
        return self._program.by_term(self._penalties.copy()) if self._penalties.any() else {}

    @property
    def residuals(self) -> FactorNorms:
        """(n,) residual norms of the factors of every term at the solution; see :mod:`unifg.solution.history`."""
        g = self._lin.constraints
        outside = np.maximum(g - self._upper, 0.0) - np.maximum(self._lower - g, 0.0)
        return factor_norms(self._program, self._lin, outside)

    @property
    def fit(self) -> Fit | None:
        """Residuals against their weights, of unconstrained least squares with more rows than unknowns; else None."""
        return fit_of(self._program, self._lin, self.residuals) if self._program.least_squares else None

    @property
    def worst(self) -> tuple[str, int] | None:
        """Term and factor with the largest violation, None without constraints."""
        return None if self._worst_row < 0 else self._program.row_name(self._worst_row)

    @property
    def families(self) -> dict[str, Family]:
        """The families of variables by their names: of a solution that another process has sent, its own."""
        return {family.name: family for family in self._program.families}

    def __getitem__(self, variable: Variable | str) -> Array:
        """(n, storage) values of a family, by itself or by its name, or of a selection."""
        if isinstance(variable, Family) and variable in self._program.columns.storage:
            return self._lin.of(variable).copy()
        selection = self._selection(variable)
        return self._lin.of(selection.family)[selection.indices][:, selection.storage].copy()

    def selections(self, term: str) -> list[Selection]:
        """Variable arguments of a term, in order; one of length 1 is shared by all factors.

        Raises:
            GraphError: when no term has that name.
        """
        return self._program.term_named(term).term.selections

    def dual(self, name: str) -> Array:
        """Multipliers of a constraint or bound (n, m), or reaction of fixed variables (n, d).

        Positive at an active upper limit, negative at an active lower one. A reaction nu makes
        grad f + A' lambda + nu vanish on the fixed coordinates.

        Raises:
            GraphError: when no constraint, bound or fix has that name.
        """
        multipliers = self.multipliers
        if name in multipliers:
            return multipliers[name]
        if name in self._program.columns.fixed:
            reaction = -self._program.lagrangian_gradient(self._lin, self._multipliers)
            return reaction[self._program.columns.fixed[name]]
        known = ", ".join([*multipliers, *self._program.columns.fixed]) or "none"
        raise GraphError(f"no constraint, bound or fix is called '{name}' (there are: {known})", term=name)

    def slack(self, name: str) -> Array:
        """(n, m) violation of a soft constraint: positive above an upper limit, negative below a lower one.

        Raises:
            GraphError: when no soft constraint has that name.
        """
        soft = self._program.soft
        if name not in soft:
            known = ", ".join(soft) or "none"
            raise GraphError(f"no soft constraint is called '{name}' (there are: {known})", term=name)
        arrays = self._lin.constraints, self._lower, self._upper
        rows, lower, upper = (self._program.by_term(array)[name] for array in arrays)
        value = rows + soft[name].signed(self._lin.values[soft[name].family])  # a slack may exceed what is needed
        return np.maximum(value - upper, 0.0) - np.maximum(lower - value, 0.0)

    def shifted(self, *families: Family, by: int = 1) -> Guess:
        """A guess moved ``by`` stages towards the end of the horizon, for the next control tick.

        Member k of each family takes the value of member k + by, the last ones repeat the end. The
        multipliers and penalties of a factor move with the stage of its first variable.

        Args:
            *families: the families that run along the horizon.
            by: number of stages, non-negative.
        """
        program = self._program
        stored, rows = program.once(Shifts)(families, by)
        penalties = self._penalties if self._penalties is program.no_penalties else self._penalties.take(rows)
        arrays = self._lin.stored.take(stored), self._multipliers.take(rows), penalties
        return Guess.stored(program, arrays)

    def flat(self, program: CompiledProblem) -> tuple[Array, Array, Array] | None:
        """Stored values, multipliers (M,) and penalties (M,) in one array each, if it is a solution of this program."""
        return (self._lin.stored, self._multipliers, self._penalties) if self._program is program else None

    def covariance(self, *variables: Variable | str) -> Array:
        """(k, k) joint covariance of the selected variables, in their tangent spaces, in the order given.

        What is fixed is known: its rows and columns are zero, as are directions that an active constraint forbids. The
        slope of a norm at zero is taken to be zero: a distance of zero that was measured, as that of a landmark where
        the pose is, adds nothing here. Measure the offset, whose norm it is, instead.

        Raises:
            GraphError: when the system is singular, or nothing is selected.
        """
        if not variables:
            raise GraphError("covariance() of what? Name families or members, as covariance(x[-1])")
        columns = [self._program.columns.of(self._selection(variable)).ravel() for variable in variables]
        return self._covariances.joint(np.concatenate(columns))

    def marginals(self, variable: Variable | str) -> Array:
        """(n, d, d) covariance of each selected variable by itself.

        Without active constraints all of them take about as long as one solve, by the selected inverse; with some there
        is one refined solve for each column.

        Members that are fixed are known: their blocks are zero.

        Raises:
            GraphError: when the system is singular.
        """
        return self._covariances.blocks(self._program.columns.of(self._selection(variable)))

    def pair_covariances(self, first: Variable | str, second: Variable | str) -> Array:
        """(n, k + m, k + m) joint covariances of pairs, as of the present pose and each candidate for a loop.

        Args:
            first: one member, which is paired with all of the second, or as many as there.
            second: (n) members.

        Raises:
            GraphError: when the system is singular, or the selections differ in length.
        """
        ends = [self._selection(variable) for variable in (first, second)]
        count = max(len(end) for end in ends)
        if any(len(end) not in (1, count) for end in ends):
            raise GraphError(f"pairs of {len(ends[0])} and {len(ends[1])} members: give as many of both, or one")
        columns = [self._program.columns.of(end) for end in ends]
        return self._covariances.pairs(*[np.broadcast_to(rows, (count, rows.shape[1])) for rows in columns])

    @cached_property
    def _covariances(self) -> Covariances:
        return Covariances(self._program, self._lin, self._equality | self._held())

    def gains(
        self, states: Variable | str | Sequence[Variable | str], controls: Variable | str | Sequence[Variable | str]
    ) -> Array:
        """(N, m, d) feedback gains: to first order, ``du[k] = K[k] @ dx[k]`` is optimal where a state deviates by dx.

        Deviations are in the tangent spaces, x [+] dx with right perturbation. All that is earlier than a state is
        held, the control before it included. Active inequalities, whose multiplier outweighs the distance to the limit,
        are held as equalities and the others left out, so that gains of a control at its limit are zero. Each stage
        takes one factorisation, with the Hessian of the Lagrangian.

        Args:
            states: those the controls act on, ``x`` or ``x[:-1]``, or several families side by side; one more than
                there are controls is left out. They may be fixed, as the first one of a horizon is.
            controls: ``u``, or several families side by side.

        Raises:
            GraphError: when the solve did not converge, data have been bound since, the numbers differ, or a gain does
                not exist.
        """
        if not self.converged:
            raise GraphError(f"gains need a solution that is CONVERGED, this one is {self.status.name}")
        x, u = ([self._selection(one) for one in several(part)] for part in (states, controls))
        if u and all(len(s) == len(u[0]) + 1 for s in x):
            x = [s[:-1] for s in x]
        if not (x and u) or len({len(s) for s in (*x, *u)}) > 1:
            counts = f"{[len(s) for s in x]} states for {[len(s) for s in u]} controls"
            raise GraphError(f"gains: {counts}: give as many, and at least one")
        if self._edition != self._program.binding.edition:
            require_data(self._program, self._lin)
        return feedback_gains(self._program, self._lin, self._multipliers, self._equality | self._held(), x, u)

    def sensitivity(self, of: Named | Sequence[Named], wrt: Wrt | Sequence[Wrt]) -> Array:
        """(k, K) derivatives of a solution, of every row of ``of`` with respect to every coordinate of ``wrt``.

        Variables and elements of manifolds in tangent coordinates, with right perturbation. Active inequalities, whose
        multiplier outweighs the distance to the limit, are held; so is the set of what a truncated loss leaves out. The
        first question takes one factorisation, each column or row one solve; forward or adjoint, whatever is less.

        Args:
            of: families and members ``x[-1]``, constraints by name for their multipliers, ``"cost"``; one or several,
                whose rows are stacked.
            wrt: data and fixed variables, by themselves or by name. Data may be arguments of terms, what variables are
                fixed at, sigmas, information matrices, limits, prices.

        Raises:
            GraphError: when the solve did not converge, data have been bound since, a row is weakly active (slack and
                scaled multiplier both below 10 times the root of the tolerance), the reduced Hessian is singular or
                indefinite, multipliers are not unique, or a function has a kink.
        """
        return self._sensitivities.matrix([self._part(part) for part in several(of)], several(wrt))

    def gradient(self, of: Weights | str, wrt: Wrt) -> Array:
        """Gradient of a scalar, by one solve: of the cost, or of a weighted sum of whatever :meth:`sensitivity` takes.

        For a loss of the solution, ``{x: slope}`` with the slope (n, d) of the loss along the tangent coordinates.

        Args:
            of: ``"cost"``, or weights, which broadcast to (n, d) of variables, (n, m) of multipliers.
            wrt: a datum, or fixed variables.

        Returns:
            An array in the shape of the data; elements of manifolds by tangent coordinates.

        Raises:
            GraphError: as :meth:`sensitivity`.
        """
        weights = {of: 1.0} if isinstance(of, str) else of
        if not isinstance(weights, Mapping):
            raise GraphError(f'gradient of what? "cost", or {{x: weights}}, found {f"{of!r}"[:80]}')
        parts = {self._part(part): as_weights(part, own) for part, own in weights.items()}
        return self._sensitivities.gradient(parts, wrt)

    def _part(self, named: Named) -> Selection | str:
        """A selection, or the name of a constraint or the cost.

        Raises:
            GraphError: the name is that of several of them.
        """
        if isinstance(named, str):
            known = {"a family": self.families, "a constraint": {name for name, *_ in self._program.places}}
            owners = [what for what, names in (known | {"the cost": {COST}}).items() if named in names]
            if len(owners) > 1:
                raise GraphError(
                    f"sensitivity: '{named}' is the name of {' and of '.join(owners)}: give the family itself, or "
                    "another name to the constraint",
                    term=named,
                )
        return named if isinstance(named, str) and named not in self.families else self._selection(named)

    @cached_property
    def _sensitivities(self) -> Sensitivities:
        if not self.converged:
            raise GraphError(f"sensitivity: needs a solution that is CONVERGED, this one is {self.status.name}")
        given = self._multipliers, self._equality, self.tolerance, self._edition, (self._lower, self._upper)
        return Sensitivities(self._program, self._lin, *given)

    def information(self, terms: Sequence[str], *variables: Variable) -> Array:
        """(d, d) information of the named costs over the selected variables; see :mod:`unifg.solution.marginal`.

        Raises:
            GraphError: no variables, an unknown cost, or one that reaches others.
        """
        if not variables:
            raise GraphError("information: name the variables that it is over")
        columns = np.concatenate([self._program.columns.of(as_selection(v)).ravel() for v in variables])
        return information(self._program, self._lin, terms, columns)[0]

    def marginal_prior(
        self, terms: Sequence[str], remove: Variables, keep: Variables, *, offset: bool = False
    ) -> tuple[Array, Array]:
        """Reference (1, S) and information (D, D) of a prior that replaces variables leaving a window.

        Only the named costs and equality constraints that touch ``remove`` are marginalised, at this solution's
        linearisation point. ``keep`` is one selection, for ``fg.prior``, or several, for ``fg.joint_prior``. With
        ``offset`` the reference (1, S + D) is for ``fg.joint_prior(..., offset=True)``; details and errors in
        :func:`unifg.solution.marginal.marginal_prior`.
        """
        return marginal_prior(self._program, self._lin, terms, remove, keep, self._equality, offset)

    def plot(self, *variables: Variable | str, marginals: bool = False) -> Figure:
        """Draw families, selections or components; all families where none is named.

        Poses are drawn as paths with headings, rotations as angles, vectors over the index of the member, with the
        limits of bounds shaded; see :mod:`unifg.plots.shown`. The figure is a matplotlib ``Figure`` that belongs to
        nobody else.

        Args:
            *variables: what to draw.
            marginals: whether to show two standard deviations of each member, as :meth:`marginals` has them.

        Raises:
            GraphError: for variables of another graph, or when there are no covariances.
            ViewError: when there is more than fits into one figure.
        """
        from unifg.plots.shown import draw_shown  # only who draws loads it

        stated = [family for family in self._program.families if not isinstance(family, SlackFamily)]
        selections = [self._selection(variable) for variable in variables or stated]
        parts = [self._shown(selection, marginals) for selection in selections]
        return draw_shown(parts, f"{self.solver}: {self.status.name.lower().replace('_', ' ')}, cost {self.cost:.6g}")

    def _shown(self, selection: Selection, marginals: bool) -> Shown:
        from unifg.plots.shown import Shown, apart

        program, family = self._program, selection.family
        everywhere = family.count, family.manifold.storage
        lower, upper = np.full(everywhere, -np.inf), np.full(everywhere, np.inf)
        pairs = [np.empty((0, 2), dtype=np.intp)]
        for term, rows in zip(program.constraint_terms, program.slices, strict=True):
            own = term.gathers[0].selection
            if term.is_bound and own.family is family:
                shape, place = (
                    (term.count, term.size),
                    np.ix_(own.indices, np.arange(family.manifold.storage)[own.storage]),
                )
                lower[place] = np.maximum(lower[place], self._lower[rows].reshape(shape))
                upper[place] = np.minimum(upper[place], self._upper[rows].reshape(shape))
        for term in program.terms:
            ends = [s for s in term.term.selections if s.family is family]
            if len(ends) == 2:
                pairs.append(np.stack([np.broadcast_to(s.indices, term.count) for s in ends], axis=1))
        return Shown(
            f"{family.name}.{selection.component}" if selection.component else family.name,
            selection.manifold,
            selection.indices,
            self[selection],
            lower[selection.indices, selection.storage],
            upper[selection.indices, selection.storage],
            apart(np.concatenate(pairs), selection.indices),
            self.marginals(selection) if marginals else None,
        )

    @cached_property
    def conditioning(self) -> Conditioning | None:
        """Conditioning of the normal equations here, and accuracy of their solution; None but for pure least squares.

        One factorisation and a few solves, when first asked for.
        """
        return conditioning(self._program, self._lin) if self._program.least_squares else None

    @property
    def times(self) -> dict[str, float]:
        """Seconds of the solve by its parts; empty where the backend's loop does not take them, and of single solves.

        "evaluation" of terms and derivatives, "linear systems", "search": tests of iterates and steps; "judge": the
        KKT test of the answer; "Python": all that is not compiled.
        """
        if self._parts is None:
            return {}
        evaluation, systems, judge, compiled = self._parts
        parts = {"evaluation": evaluation, "linear systems": systems, "search": compiled - evaluation - systems}
        return {**parts, "judge": judge, "Python": self.seconds - compiled - judge}

    def verify(self, tolerance: float = 1e-6) -> Verified:
        """Check the answer by the functions as they were written, independently of the compiled graph and its engine.

        Values, multipliers and cost are taken as claims: all residuals, limits, manifolds and fixed variables are
        looked at with the data of that solve, slopes are central differences with error bounds, and multipliers are
        also made anew; see :mod:`unifg.solution.verify`. It never raises for a bad answer. What functions read beyond
        their arguments is read as it is now.

        Args:
            tolerance: of violation, stationarity and complementarity, as that of the solver.

        Raises:
            GraphError: for a solution that was not returned: another one has taken its place, and its data; for a
                tolerance that is no positive number.
        """
        require_tolerance(tolerance)
        return verified(*self._claims("verify"), tolerance)

    def save(self, path: str | PathLike[str]) -> None:
        """Write values, multipliers, cost and the data of that solve to a file of NumPy (.npz).

        ``unifg check SCRIPT.py:GRAPH FILE`` checks it; :mod:`unifg.solution.saved` names the arrays.

        Raises:
            GraphError: as of :meth:`verify`, and for a path that is none.
            OSError: the file cannot be written.
        """
        write_answer(path, *self._claims("save"))

    def _claims(self, what: str) -> tuple[CompiledProblem, dict[Family, Array], Array, float, dict[Data, Array]]:
        """The graph and what the solution says of it, with the data of that solve."""
        program, data = self._program, self._program.data_of(self)
        if data is None:
            raise GraphError(f"{what}: the data of this solution were replaced; {what} what the solve returned")
        return program, self.values, self._multipliers, self.cost, data

    def tube(self, term: str, pieces: int = 16) -> Array:
        """(n - 1, m, 2) least and greatest values of a term's rows between each factor and the next, as a proof.

        From one factor to the next all variables and data of the term move in straight lines of their stored numbers,
        headings the short way round. Bounds come from interval arithmetic, so they are never too narrow; they approach
        the true ones as ``pieces`` grow.

        Args:
            term: name of a term whose function is traced, of vectors and poses in the plane.
            pieces: boxes between two factors.

        Raises:
            GraphError: there is no such term, it is of another kind, or its data have been replaced since.
        """
        require_kinds("tube", GraphError, Solution.tube.__annotations__, {"pieces": pieces})
        if pieces < 1:
            raise GraphError(f"tube: pieces must be at least 1, found {pieces}")
        return tube(self._program, self._lin.values, self._claims("tube")[-1], term, pieces)

    def report(self) -> str:
        """The status sentence with the numbers behind it, and the times of the parts."""
        text = self._told()
        if self.times:
            shares = (f"{name} {100.0 * part / self.seconds:.0f} %" for name, part in self.times.items())
            text += f" Of the time: {', '.join(shares)}."
        if self.finite and self._program.least_squares and cheap(self._program) and self.conditioning is not None:
            text += f" {self.conditioning.sentence()}"
        return text

    def _told(self) -> str:
        """All of a report that costs nothing."""
        kkt = (
            f"relative offset {self.stationarity:.1e}"
            if self._program.least_squares
            else f"stationarity {self.stationarity:.1e}, violation {self.violation:.1e}, "
            f"complementarity {self.complementarity:.1e}"
        )
        besides = f" and {self.restoration_steps} steps of restoration" if self.restoration_steps else ""
        who = f"{self.solver} ({self.picked})" if self.picked else self.solver
        text = (
            f"{who}: {self.status.value} Cost {self.cost:.6g} after {self.iterations} iterations{besides} in "
            f"{1e3 * self.seconds:.1f} ms; {kkt}."
        )
        if (fit := self.fit) is not None:
            text += f" {fit.sentence()}."
        if self.worst is not None and self.violation > 0.0 and not self.converged:
            name, index = self.worst
            text += f" Largest violation: '{name}', factor {index}."
        text += "".join(f" {sentence}" for sentence in self._gave_way())
        if self.in_python > 0.01 * self.seconds:
            names = ", ".join(f"'{name}'" for name in self._program.left_to_python)
            share = 100.0 * self.in_python / self.seconds
            text += f" {share:.0f} % of the time went into functions in Python: {names}."
        for name, why in self.mistraced.items():
            text += f" Term '{name}' was left to Python and the solve repeated: {why}."
        if self.verdict is not None:
            text += f" {self.verdict.sentence(self.cost)}"
        return text

    def _gave_way(self) -> list[str]:
        """A sentence on each soft constraint that gives way."""
        found = []
        for name in self._program.soft:
            given_way = np.abs(self.slack(name))
            if rows := int((given_way > GIVEN_WAY).sum()):
                factor = int(np.argmax(given_way.max(axis=1)))
                found.append(
                    f"Soft constraint '{name}' gives way in {rows} of {given_way.size} rows, by up to "
                    f"{given_way.max():.3g} in factor {factor}; that is no violation."
                )
        return found

    def explain(self) -> str:
        """Sentences, one a line, on what shapes this solution and what it took.

        The backend and why it was picked; the status; what violations within the tolerance save; constraints that hold
        the solution, with what a unit of loosening saves; soft ones that give way; measurements that disagree with
        their weights, of least squares; the direction that is hardly determined; terms left to Python. One
        factorisation, where it is cheap, and the rank of up to 500 gradients.
        """
        program, held = self._program, self._equality | self._held()
        sentences = [f"{self.solver} was {self.picked or 'chosen by name'}.", self.status.value]
        told = self.cost, self._multipliers, self._lin.constraints, self._lower, self._upper, self.tolerance
        sentences += tolerated(*told) if self.converged else violated(program, self.worst, self.violation)
        sentences += holding(program, self._multipliers, self._equality, held)
        sentences += [*ambiguous(program, self._lin, held), *self._gave_way()]
        if self.converged and (fit := self.fit) is not None:
            sentences += disagreeing(program, fit)
        sentences += weak(program, self._lin, held)
        return "\n".join([*sentences, *slow(program, self._lin, self.seconds, self.in_python, self.times)])

    def table(self) -> str:
        """The history as a table."""
        return str(self.history)

    def __repr__(self) -> str:
        """The report, of what costs nothing."""
        return f"<Solution {self._told()}>"

    def _repr_html_(self) -> str:
        """The same and the history, for notebooks."""
        rows = f"<details><summary>{self.iterations} iterations</summary>{self.history._repr_html_()}</details>"
        return f"<p>{escape(self._told())}</p>{rows}"

    def __getstate__(self) -> dict[str, Any]:
        """Pickle with the history, and without factorisations, which are found again where somebody asks."""
        self._program.data_of(self)
        kept = {name: value for name, value in self.__dict__.items() if name not in ("_covariances", "_sensitivities")}
        return {**kept, "_history": self.history, "_edition": -1}

    def _held(self) -> BoolArray:
        """Inequalities that are active: the multiplier outweighs the distance to its limit."""
        held: BoolArray = np.empty(len(self._multipliers), dtype=bool)
        unit = size_of_costs(self._program, self._lin)
        hold(self._lin.constraints, self._lower, self._upper, self._multipliers, unit, held)
        return held

    def _selection(self, variable: Variable | str) -> Selection:
        """The selection named, if it is part of this solution."""
        if isinstance(variable, str):
            if variable not in self.families:
                raise GraphError(
                    f"no family is called '{variable}' (there are: {', '.join(self.families)})", family=variable
                )
            variable = self.families[variable]
        selection = as_selection(variable)
        if selection.family not in self._program.columns.storage:
            name = selection.family.name
            hint = ": that of another process has families of its own, by name in solution.families"
            raise GraphError(
                f"family '{name}' is not part of this solution{hint if name in self.families else ''}", family=name
            )
        return selection


class NotConverged(UnifgError, RuntimeError):
    """Raised by ``solve(..., check=True)``; carries the solution that fell short.

    Also a ``RuntimeError``: the input was sound, the solve was not.

    Attributes:
        solution: the iterate the solve ended with, with its status and KKT numbers.
        term: of the constraint violated most, None where none is.
        index: its factor.
    """

    def __init__(self, solution: Solution) -> None:
        """Keep the solution and repeat its report as the message."""
        worst = solution.worst if solution.violation > 0.0 else None
        term, index = worst or (None, None)
        super().__init__(solution.report(), term=term, index=index)
        self.solution = solution

    def __reduce__(self) -> tuple[type[NotConverged], tuple[Solution]]:
        """Made from the solution, not from its report."""
        return type(self), (self.solution,)


AnyGuess: TypeAlias = Mapping[Family, Numbers] | Guess | Solution


def values_of(guess: AnyGuess) -> Mapping[Family, Numbers]:
    """The values of a guess, of whatever form.

    Raises:
        GraphError: when it is none.
    """
    if isinstance(guess, Mapping):
        return guess
    if isinstance(guess, Guess | Solution):
        return guess.values
    raise GraphError(
        f"a guess is {{family: array, ...}}, a Guess or a Solution, found {type(guess).__name__}: {guess!r}"[:200]
    )
