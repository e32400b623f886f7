"""The frame every backend runs in: checks before, one loop state during, one judge after."""

from __future__ import annotations

import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeAlias
from weakref import ReferenceType, ref

import numpy as np

from unifg.codegen.inner import inner
from unifg.errors import BackendError, GraphError, NotFiniteError, require_kinds
from unifg.factors.steps import EPSILON
from unifg.locks import ReentrantLock
from unifg.modeling.model import Model
from unifg.modeling.soft import SLACK
from unifg.modeling.variables import Data
from unifg.problem.by_term import ByTerm
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem, idle_problem
from unifg.problem.hessian import require_second
from unifg.problem.kinks import beside_a_kink
from unifg.problem.linearization import Linearization, all_finite
from unifg.problem.units import SMALL_FORCES
from unifg.solution.batch import SAMPLED, Batch, Outcomes, solve_batch
from unifg.solution.capabilities import Constraints, require
from unifg.solution.conditioning import HARDLY
from unifg.solution.export import Exported, export
from unifg.solution.history import HEADER, Deferred, Iteration, factor_norms, line, show
from unifg.solution.incumbent import Incumbent, Incumbents
from unifg.solution.multipliers import Slopes, estimated
from unifg.solution.optimality import Optimality, Tolerances, infeasible_stationary, optimality, within_bounds
from unifg.solution.relative_offset import Factored
from unifg.solution.solution import AnyGuess, Guess, NotConverged, Solution, values_of
from unifg.solution.status import Status
from unifg.solution.warmup_run import rehearse
from unifg.typing import Array, Numbers

__all__ = ["Backend", "Prepared", "SolveState", "Solver"]

logger = logging.getLogger("unifg")

Callback: TypeAlias = Callable[[Iteration], bool | None]

UNBOUNDED_COST = -1e20
KEPT = 4  # workspaces of single solves, for each graph
EVERY = 100  # solves of a loop after which answers are verified, besides the 1st, 2nd, 4th, ... and new branches
AT_ONCE, LATER = 4, 256  # verifications of new branches: so many without delay, then one in so many solves
AT_REST = (Status.CONVERGED, Status.HARDLY_DETERMINED, Status.UNDETERMINED)  # where costs are stationary
NEARLY, FEW_DIGITS = 100.0, 1e-4  # times the tolerance: KKT numbers, and rounding of unknowns, that may go together
FEW = 3  # iterations that are asked for as such, one after the other in a control loop
WITHOUT_SUCCESS = (
    Status.ITERATION_LIMIT,
    Status.TIME_LIMIT,
    Status.STALLED,
    Status.SINGULAR,
    Status.NOT_FINITE,
    Status.INTERRUPTED,
)
"""Endings that return the best iterate."""


class Conclusion(NamedTuple):
    """A success that needs no decision of :class:`SolveState`.

    Attributes:
        lin, multipliers, measured: linearisation, multipliers (M,) and KKT numbers at the answer.
        status: CONVERGED or STOP_RULE.
        iterations: taken.
        history: makes their rows.
        parts: as of :class:`SolveState`.
    """

    lin: Linearization
    multipliers: Array
    measured: Optimality
    status: Status
    iterations: int
    history: Callable[[], list[Iteration]]
    parts: tuple[float, float, float, float] | None


class Backend(ABC):
    """Solver of a graph.

    Attributes:
        constraints: which it takes.
        scalar_costs: whether it takes costs that are no squares.
        soft: whether it takes the linear prices of soft constraints in any case.
        states_subproblems: whether rows of its history name the solver of a quadratic program, as their detail "qp".
        rehearses: whether :meth:`Solver.prepare` may take it through small problems of its own
            (:mod:`unifg.solution.warmup_run`).
    """

    constraints: ClassVar[Constraints] = "all"
    scalar_costs: ClassVar[bool] = True
    soft: ClassVar[bool] = False
    states_subproblems: ClassVar[bool] = False
    rehearses: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """The backend's class name."""
        return type(self).__name__

    @abstractmethod
    def solve(
        self,
        graph: Model,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve once.

        Args:
            graph: the problem.
            guess: values per family, or a guess or solution that carries multipliers too.
            data: values of data for this solve; others keep their defaults.
            check: raise instead of returning a solution that did not converge.
            callback: called with every row of the history; returning True ends the solve.

        Raises:
            GraphError: when the graph, guess or data is malformed.
            BackendError: when this backend cannot take this class of problem.
            NotConverged: with ``check=True``.
        """


@dataclass(kw_only=True)
class Solver(Backend):
    """Options common to all backends.

    Attributes:
        tolerance: for the KKT test of :mod:`unifg.solution.optimality`: its stationarity and complementarity.
        feasibility_tolerance: for its violation, in the units of the constraints; None: the same number.
        max_iterations: iterations (linear systems or subproblems solved) before giving up.
        time_limit: seconds before giving up, checked once an iteration.
        verbose: log one line per iteration at level INFO to the logger ``unifg``; where logging is not configured for
            it, the lines go to standard error.
        keep_values: keep the values of every iterate in the history, for pictures of a solve.
        keep_residuals: keep the residual norm of every factor in the history, one number per factor and row.
        search_iterations: the first so many steps use the search Jacobians of residuals that have one, and are taken
            in full without a merit test. Costs and KKT numbers are the true ones throughout.
    """

    tolerance: float = 1e-6
    feasibility_tolerance: float | None = None
    max_iterations: int = 100
    time_limit: float = np.inf
    verbose: bool = False
    keep_values: bool = False
    keep_residuals: bool = False
    search_iterations: int = 0

    def __post_init__(self) -> None:
        """Refuse options no solve could honour."""
        kinds = {field.name: field.type for field in fields(self)} | {"tolerance": "float"}
        require_kinds(self.name, BackendError, kinds, vars(self))
        for name in ("tolerance", "feasibility_tolerance"):
            if vars(self)[name] is not None and not 0.0 < vars(self)[name] < np.inf:
                raise BackendError(f"{self.name}: {name} must be positive and finite, found {vars(self)[name]}")
        if np.isnan(self.time_limit):
            raise BackendError(f"{self.name}: time_limit must be a number of seconds, found {self.time_limit}")
        for name in ("max_iterations", "search_iterations"):
            if vars(self)[name] < 0:
                raise BackendError(f"{self.name}: {name} must not be negative, found {vars(self)[name]}")

    @property
    def tolerances(self) -> Tolerances:
        """Both tolerances of the KKT test."""
        stated = self.feasibility_tolerance
        return Tolerances(self.tolerance, stated or self.tolerance, (stated or 0.0) / self.tolerance)

    def solve(
        self,
        graph: Model,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        duals: Mapping[str, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve as :class:`Backend`; a control loop uses :meth:`prepare` and keeps structure and workspaces.

        ``duals`` are multipliers by term name, overriding those of the guess.
        """
        prepared = self.bound(graph)
        prepared.single = True
        return prepared.solve(guess, data=data, duals=duals, check=check, callback=callback)

    def prepare(self, graph: Model) -> Prepared:
        """Compile the graph, and everything that its solves can reach, for repeated solves.

        Solves in a loop then neither compile anything nor read compiled functions from the disk, however they end.
        """
        prepared = self.bound(graph)
        prepared.allocate()
        prepared.program.watch_conditions()
        if self.rehearses:
            rehearse(self)
        return prepared

    def bound(self, graph: Model) -> Prepared:
        """Compile the graph alone: a single solve compiles what it comes to need."""
        program = idle_problem(graph)
        self.require(program)
        if not program.least_squares:  # there, curvature is asked for in rare cases only
            require_second(program)
        return Prepared(self, program, graph)

    def require(self, program: CompiledProblem) -> None:
        """Raise BackendError when the backend cannot take this class of problem."""
        require(program, self.name, self.constraints, self.scalar_costs, self.soft)

    def runs_alone(self, program: CompiledProblem) -> bool:
        """Test whether :meth:`iterate` evaluates the start and ends with :meth:`SolveState.conclude` if unwatched.

        Such a backend minds the time limit itself.
        """
        return False

    def solves_each(self, program: CompiledProblem) -> bool:
        """Test whether :meth:`solve_each` may be asked; instances then differ in numbers alone."""
        return False

    def solve_each(self, workspace: Any, rows: Array, guesses: Array, duals: Array) -> Outcomes:
        """Solve many instances in compiled code.

        Args:
            workspace: of the backend.
            rows: (K, D) numbers of all data of each.
            guesses: (K or 1, S) stored values.
            duals: (K or 1, M) multipliers.
        """
        raise NotImplementedError

    def entry(self, workspace: Any) -> Exported:
        """The compiled loop of :meth:`solve_each` for one instance, for :meth:`Prepared.export`."""
        raise NotImplementedError

    def at_once(self, workspace: Any, values: Values, multipliers: Array) -> Conclusion | bool:
        """Solve in one compiled call that judges its answer.

        Args:
            workspace: of an earlier solve.
            values: of the guess, checked.
            multipliers: (M,) of the guess.

        Returns:
            The answer; False where there is no such call and nothing has begun; True where :meth:`iterate` has to go on
            from where the workspace is, with ``run.begun``.
        """
        return False

    @abstractmethod
    def workspace(self, program: CompiledProblem) -> Any:
        """Memory that the backend keeps between solves of one structure."""

    @abstractmethod
    def iterate(self, run: SolveState, workspace: Any) -> Status | None:
        """Improve ``run`` until it has a status, or return the reason to stop."""

    def search_step(self, run: SolveState, workspace: Any, lin: Linearization) -> Array | None:
        """The backend's own tangent step for the model ``lin``, which is made of search Jacobians; None for no step."""
        raise BackendError(f"{self.name} has no search_step: set search_iterations=0")


class SolveState:
    """State of one solve: the present iterate, its KKT numbers, and what has been recorded.

    A backend moves with :meth:`accept`; the solve is over when ``status`` is set.

    Attributes:
        program: the compiled graph with its data bound.
        values: at the present iterate.
        lin: linearisation there.
        multipliers: (M,) present multipliers.
        penalties: (M,) those of the guess, for backends that have any, who leave their last ones here; zero for none.
        optimality: KKT numbers of both.
        status: None while the solve goes on.
        history: rows so far.
        iterations: so far.
        restoration_steps: of descents on the violation alone so far.
        parts: seconds of a compiled loop in evaluation, linear systems and the test of the answer, and of all of the
            loop; None where nobody took them.
        begun: whether the workspace holds a first attempt that :meth:`Solver.at_once` has made.
        alone: whether nobody looks before the end; there is no linearisation then until :meth:`conclude`.
        tolerances: of the KKT test.
        lent: the backend's factorisation of a matrix near the Hessian of the objective, which the KKT test of least
            squares may use and overwrite; None where the backend has no such thing.
        slopes: the largest so far, where there are constraints.
        incumbents: iterates one of which is returned without success.
    """

    def __init__(
        self, solver: Solver, program: CompiledProblem, values: Values, multipliers: Array, callback: Callback | None
    ):
        """Linearise at the start and test it, unless the backend does."""
        if callback is not None:
            require_kinds(solver.name, BackendError, {"callback": "Callable"}, {"callback": callback})
        self._solver = solver
        self._callback = callback
        self._started = time.perf_counter()
        self._in_python = program.python_seconds
        self.program = program
        self.tolerances = solver.tolerances
        self.history: list[Iteration] = []
        self.status: Status | None = None
        self.incumbents = Incumbents(program)
        self._recall: Callable[[], list[Iteration]] | None = None
        self._least, self._start = np.inf, values
        self._least_at: Array | None = None
        self._values: Values | None
        self.lent: Factored | None = None
        self.slopes: Slopes | None = None
        self.iterations = self.restoration_steps = 0
        self.begun = False
        self.parts: tuple[float, float, float, float] | None = None
        if solver.verbose:
            show(HEADER)
        self.values, self.multipliers, self.penalties = values, multipliers, program.no_penalties
        self.alone = not (self.watched or solver.search_iterations) and solver.runs_alone(program)
        if not self.alone:
            self.accept(program.linearize(values), multipliers, 0.0, 0.0)

    @property
    def seconds(self) -> float:
        """Time since the solve began."""
        return time.perf_counter() - self._started

    @property
    def out_of_time(self) -> bool:
        """True if the time limit has passed."""
        return self.seconds > self._solver.time_limit

    def accept(
        self,
        lin: Linearization,
        multipliers: Array,
        step_norm: float,
        step_length: float,
        **details: float | int | str,
    ) -> None:
        """Make ``lin`` the present iterate: measure it, record a row, decide whether to go on."""
        self.iterations = len(self.history)
        self._move(lin, multipliers)
        deferred = Deferred(lambda: factor_norms(self.program, lin, self.program.violation(lin.constraints)))
        row = Iteration(
            self.iterations,
            lin.cost,
            self.optimality.stationarity,
            self.optimality.violation,
            self.optimality.complementarity,
            step_norm,
            step_length,
            self.seconds,
            lin.norms,
            dict(details),
            {family: array.copy() for family, array in lin.values.items()} if self._solver.keep_values else None,
            deferred,
        )
        if self._solver.keep_residuals:
            deferred()
        self.history.append(row)
        if self._solver.verbose:
            show(line(row))
        self.status = self._decide_in_time()
        if self._callback is not None and self._callback(row) and self.status is None:
            self.status = Status.INTERRUPTED
        deferred.close()

    @property
    def watched(self) -> bool:
        """True if somebody looks at every iteration: a callback, a log, kept values or residuals."""
        solver = self._solver
        return bool(self._callback or solver.verbose or solver.keep_values or solver.keep_residuals)

    def conclude(
        self,
        lin: Linearization,
        multipliers: Array,
        iterations: int,
        history: Callable[[], list[Iteration]],
        measured: Optimality,
        slopes: Slopes | None,
    ) -> None:
        """Make ``lin`` the last iterate of a solve that ran alone.

        Args:
            lin: linearisation at the last iterate.
            multipliers: (M,) there.
            iterations: how many there were.
            history: makes their rows when somebody asks for them.
            measured: KKT numbers there.
            slopes: along the way; None after a success, and with multipliers of a size that nobody asks about.
        """
        self.iterations, self._recall, self.slopes = iterations, history, slopes
        self._settle(lin, multipliers, measured, slopes is not None)
        self.status = self._decide()

    def _move(self, lin: Linearization, multipliers: Array) -> None:
        self.see(lin.constraint_jacobian, lin.gradient)
        measured = self._measure(lin, multipliers)
        self._settle(lin, multipliers, measured, True)

    def _measure(self, lin: Linearization, multipliers: Array) -> Optimality:
        kkt, unit = self.tolerances.kkt, self.tolerances.violation_unit
        return optimality(self.program, lin, multipliers, kkt, self.lent, self._start.flat, unit)

    def _settle(self, lin: Linearization, multipliers: Array, measured: Optimality, candidate: bool) -> None:
        """Make an iterate the present one; a ``candidate`` may be returned if the solve ends without success."""
        self.lin, self._values, self.multipliers, self.optimality = lin, None, multipliers, measured
        if measured.violation < self._least:
            self._least, self._least_at = measured.violation, lin.stored
        if candidate and measured.finite:
            self.consider(lin.cost, lin.constraints.copy(), lin.stored, multipliers)

    def pass_by(
        self, number: int, violation: float, cost: float, constraints: Array, values: Array, multipliers: Array
    ) -> None:
        """Take note of an iterate that a solve has left behind; all as of :meth:`consider`, finite."""
        self.iterations = number
        if violation < self._least:
            self._least, self._least_at = violation, values
        self.consider(cost, constraints, values, multipliers)

    def go_on(self) -> None:
        """Go on with :meth:`accept` after :meth:`conclude`, which has told of a part of the solve only."""
        assert self._recall is not None
        self.history, self._recall, self.alone = self._recall(), None, False

    def see(self, jacobian: Array, gradient: Array) -> None:
        """Take note of slopes of constraints and cost, as of :class:`unifg.solution.multipliers.Slopes`."""
        if self.slopes is not None:
            self.slopes.see(jacobian, gradient)
        elif len(self.multipliers):
            self.slopes = Slopes(self.program, jacobian, gradient)

    def consider(self, cost: float, constraints: Array, values: Array, multipliers: Array) -> None:
        """Take note of an iterate that may be returned if the solve ends without success.

        Args:
            cost: objective.
            constraints: (M,) there. None of the arrays may be written to any more.
            values: stored ones.
            multipliers: (M,) there.
        """
        self.incumbents.see(Incumbent(self.iterations, cost, constraints, values, multipliers))

    def begin_at(self, lin: Linearization) -> None:
        """Move the start, as onto the bounds, without spending an iteration."""
        self._move(lin, self.multipliers)
        self.status = self._decide_in_time()

    def look_at_fixed(self, constraints: Array) -> None:
        """End before the first iteration where a violated row touches nothing but fixed variables.

        Args:
            constraints: (M,) at the start.
        """
        rows = self.program.fixed_rows()
        if self.status is not None or not len(rows):
            return
        outside = np.abs(self.program.violation(constraints)[rows])
        if outside.max() > self.tolerances.violation:
            if self.alone:
                self.accept(self.program.linearize(self.values), self.multipliers, 0.0, 0.0)
            self.optimality = self.optimality._replace(worst_row=int(rows[outside.argmax()]))
            self.status = Status.INFEASIBLE

    def search(self, workspace: Any) -> None:
        """Take the first steps along the search Jacobians; the multipliers wait, and the true numbers are recorded.

        Without a merit test a step may lead out of the residuals' domain: the search ends before such a step.
        """
        program = self.program
        if not any(term.term.residual.search for term in program.terms):
            return
        while self.status is None and len(self.history) <= self._solver.search_iterations:
            step = self._solver.search_step(self, workspace, program.linearize(self.values, search=True))
            reached = None if step is None else program.linearize(program.retract(self.values, step))
            if step is None or reached is None or not reached.finite:
                return
            self.accept(reached, self.multipliers, math.sqrt(inner(step, step)), 1.0, search=1)

    def keep_with(self, error: Exception) -> None:
        """Hand over what has been reached, if there is anything."""
        if not self.incumbents:
            return
        with suppress(Exception):  # the functions may raise again
            self.status = Status.INTERRUPTED
            hand_over(error, self.finish(None))

    @property
    def least_violated(self) -> Values:
        """Values of least violation among the start and all iterates."""
        if self.alone:  # then nobody has looked at the start
            outside = self.program.violation(self.program.evaluate(self._start).constraints)
            size = float(np.abs(outside).max(initial=0.0))
            if size < self._least:
                self._least, self._least_at = size, None
        return self._start if self._least_at is None else self.program.columns.view(self._least_at)

    @property
    def values(self) -> Values:
        """Values at the present iterate."""
        return self.lin.values if self._values is None else self._values

    @values.setter
    def values(self, values: Values) -> None:
        self._values = values

    @property
    def has_been_feasible(self) -> bool:
        """True if the start or an iterate met the constraints, which proves that they can be met."""
        _ = self.least_violated
        return self._least <= self.tolerances.violation

    @property
    def enough(self) -> float:
        """Gradient of the Lagrangian that is small enough for the KKT test, with something to spare."""
        return 0.1 * self.tolerances.kkt * min(1.0, self.optimality.slope)

    def violates(self, constraints: Array) -> bool:
        """Test whether (M,) values of the constraints are outside their limits."""
        return float(np.abs(self.program.violation(constraints)).max(initial=0.0)) > self.tolerances.violation

    def begin_restoration_step(self) -> bool:
        """Count a step of feasibility restoration; returns whether there is no time for it."""
        if self.out_of_time:
            return True
        self.restoration_steps += 1
        return False

    def infeasible_stationary(self) -> bool:
        """Test whether no nearby point violates the constraints less, though they are violated."""
        return infeasible_stationary(self.program, self.lin, self.tolerances.violation)

    def finish(self, reason: Status | None) -> Solution:
        """Return the last iterate, or after a solve without success the best one, judged by the KKT test.

        No ranking of iterates comes before the backend's own choice where it succeeded, where a stop rule fired, and
        where a step or a few of them are all that was asked for: a step of a real-time iteration may raise every merit,
        and would never be taken from a feasible start.
        """
        status, returned = self.status or reason or Status.STALLED, self.iterations
        if status not in (Status.CONVERGED, Status.STOP_RULE) or not self.optimality.finite:
            status, returned = self._without_success(status)
        measured = self.optimality
        if measured.passes(self.tolerances) and status is not Status.UNBOUNDED:
            status = Status.CONVERGED if measured.weakest > HARDLY else Status.HARDLY_DETERMINED
            if self._excess() > 0.0:
                status = Status.DEGENERATE
        elif measured.holds(self.tolerances) and not measured.determined:
            status = Status.UNDETERMINED
        elif measured.holds(self.tolerances) and status is not Status.UNBOUNDED:
            status = Status.IMPRECISE
        elif status in (Status.STALLED, Status.ITERATION_LIMIT) and self._lost_slope(measured):
            status = Status.DEGENERATE
        elif status in (Status.STALLED, Status.ITERATION_LIMIT) and self._imprecise(measured):
            status = Status.IMPRECISE
        elif status.converged:
            status = Status.STALLED
        solution = Solution(
            self.program,
            self.lin,
            self.multipliers,
            self.penalties,
            status,
            measured,
            self._recall or self.history,
            self.iterations,
            self.seconds,
            self._solver.name,
            returned,
        )
        solution.restoration_steps, solution._parts = self.restoration_steps, self.parts
        solution.tolerance, solution._edition = self.tolerances.kkt, self.program.binding.edition
        solution.in_python = self.program.python_seconds - self._in_python
        return solution

    def _without_success(self, status: Status) -> tuple[Status, int]:
        """Move to what is returned; returns the ending as it is known now, and the number of that iterate."""
        if status is Status.STALLED and self.infeasible_stationary():
            status = Status.LOCALLY_INFEASIBLE
        if status is Status.LOCALLY_INFEASIBLE and self.has_been_feasible:
            status = Status.STALLED
        if status is Status.LOCALLY_INFEASIBLE and (within := within_bounds(self.program, self.lin)) is not self.lin:
            self._move(within, self.multipliers)
        returned = self._return_best(status)
        earlier = status is Status.ITERATION_LIMIT and returned < self.iterations  # the multipliers of a barrier there
        if earlier or status in (Status.STALLED, Status.SINGULAR):
            self._estimate()
        return status, returned

    def _excess(self) -> float:
        """Sum of multipliers that are larger than constraints with a slope ever need, zero elsewhere."""
        return 0.0 if self.slopes is None else self.slopes.excess(self.lin, self.multipliers, self.tolerances.kkt)

    def _lost_slope(self, measured: Optimality) -> bool:
        """Test whether a solve without success is one whose KKT numbers hold in proportion to huge multipliers."""
        if not measured.feasible(self.tolerances):
            return False
        return measured.stationarity <= self.tolerances.kkt * self._excess() / SMALL_FORCES

    def _imprecise(self, measured: Optimality) -> bool:
        """Test whether rounding is what keeps the KKT test from holding, of differences or of large unknowns."""
        kkt, violation, _ = self.tolerances
        if measured.blurred(self.tolerances):
            return True
        rounding = EPSILON * float(np.abs(self.lin.stored).max(initial=0.0))
        return rounding > FEW_DIGITS * kkt and measured.holds(Tolerances(NEARLY * kkt, NEARLY * violation))

    def _estimate(self) -> None:
        """Take multipliers that are made of the gradients here, if all KKT numbers are better with them."""
        before = self.optimality
        if before.violation > self.tolerances.violation:
            return
        found = estimated(self.program, self.lin, self.tolerances.violation)
        if found is None or before.holds(self.tolerances):
            return
        after = self._measure(self.lin, found)
        pairs = zip(after[:3], before[:3], strict=True)
        if all(better <= worse for better, worse in pairs) and after[:3] != before[:3]:
            self.multipliers, self.optimality = found, after

    def returns_best(self, status: Status | None) -> bool:
        """Test whether an ending asks for the best iterate instead of the last."""
        asked = self._solver.max_iterations <= FEW or getattr(self._solver, "step_tolerance", 0.0) == np.inf
        sound = asked or status not in WITHOUT_SUCCESS or self.optimality.holds(self.tolerances)
        return not (self.optimality.finite and sound)

    def _return_best(self, status: Status) -> int:
        """Go back to the best iterate where the ending asks for it; returns the number of what is returned."""
        if not self.returns_best(status):
            return self.iterations
        if not self.incumbents:  # a success of the method that the KKT test does not confirm
            return self.iterations
        best = self.incumbents.best
        if best.values is not self.lin.stored or best.multipliers is not self.multipliers:
            self._move(self.program.linearize(self.program.columns.view(best.values)), best.multipliers)
        return best.number

    def _decide(self) -> Status | None:
        if not self.optimality.finite:
            return Status.NOT_FINITE
        if self.lin.cost < UNBOUNDED_COST:  # out there, derivatives may be lost to rounding and look like zero
            return Status.UNBOUNDED
        if self.optimality.stationarity == np.inf:  # a saddle or maximum, where no model shows a way
            return Status.STALLED
        if self.optimality.holds(self.tolerances):
            if not self.optimality.determined:
                return Status.UNDETERMINED
            return Status.CONVERGED if self.optimality.passes(self.tolerances) else Status.IMPRECISE
        if self.iterations >= self._solver.max_iterations:
            return Status.ITERATION_LIMIT
        return None

    def _decide_in_time(self) -> Status | None:
        return self._decide() or (Status.TIME_LIMIT if self.out_of_time else None)


def hand_over(error: Exception, reached: Solution) -> None:
    """Hand what has been reached along with an error, as its attribute ``reached``, and say so in a note."""
    error.reached = reached  # type: ignore[attr-defined]
    error.add_note(f"after {reached.iterations} iterations; the solution until then is in the error's `reached`")


class Prepared:
    """A backend bound to one compiled graph; solves repeatedly without rebuilding structure.

    It solves the graph as it was when it was prepared: terms that are added, removed or replaced later need another
    :meth:`Solver.prepare`. The first solve after such a change says so, in a warning of the logger ``unifg``.

    It belongs to one thread at a time. Others prepare their own: those of one graph wait for each other, those of
    graphs that were stated twice do not.

    Answers are verified by evaluating traced functions as written. Values: in solves 1, 2, 4, ..., in every 100th, and
    after solves in which comparisons of a trace come out as at no verified answer: four times at once, then once in
    256 solves. Derivatives: in solves 1, 2, 4, ... A term whose trace differs is left to Python, and the solve is
    repeated from there. Where the time limit has passed, the next answer is verified instead.

    Attributes:
        solver: the backend and its options.
        program: the compiled graph.
        single: whether it is for one solve, whose workspace later ones of the graph take over.
    """

    def __init__(self, solver: Solver, program: CompiledProblem, graph: Model | None = None) -> None:
        """Made by :meth:`Solver.prepare`, for the graph that the program was made of."""
        self.solver = solver
        self.program = program
        self._graph = graph or program.graph
        self._edition = self._graph.edition
        self.single = False
        self._workspace: Any = None
        self._solves, self._owed, self._of_branches = 0, False, 0
        self._last: ReferenceType[Solution] | None = None
        self._lock = ReentrantLock()
        self._twins: list[Prepared] = []
        self._constraints = {
            t.name: (t, rows) for t, rows in zip(program.constraint_terms, program.slices, strict=True)
        }

    def solve(
        self,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        duals: Mapping[str, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve from ``guess``; arguments and errors as for :meth:`Solver.solve`.

        Raises:
            BackendError: while another thread solves with this object, or this thread is in the midst of a solve.
            Exception: of a function of the user's. It is passed on with notes on term, factor and variable; where an
                iterate had been reached, its attribute ``reached`` is the solution until then.
        """
        self._enter()
        try:
            return self._solve(guess, data, duals, check, callback)
        finally:
            self._leave()

    def proceed(self) -> Solution:
        """Go on with the last solve, which is :attr:`unfinished`, with its data, for another portion of iterations."""
        self._enter()
        try:
            work, program = self._workspace.work, self.program
            reached = program.values_from(work.values.copy()), work.multipliers.copy(), program.no_penalties
            return self._answered(*reached, None, time.perf_counter())
        finally:
            self._leave()

    @property
    def unfinished(self) -> bool:
        """True if the last solve has ended with its portion of iterations, and not with all that it may make."""
        return getattr(self._workspace, "unfinished", False)

    def portioned(self, count: int | None) -> None:
        """Let solves return after so many iterations, to :meth:`proceed` later; for backends that can."""
        if hasattr(self._workspace, "portion"):
            self._workspace.portion = count

    def solve_many(
        self, guesses: AnyGuess | Sequence[AnyGuess], *, data: Mapping[Data, Numbers] | None = None, threads: int = 1
    ) -> Batch:
        """Solve many instances of the graph, with the statuses that :meth:`solve` has.

        Args:
            guesses: one for all, or one for each.
            data: (K, ...) one value for each instance of every datum named; others keep their defaults.
            threads: solve at once; each but the first compiles the graph for itself, once.

        Raises:
            GraphError: numbers of instances or shapes do not fit, and as of :meth:`solve`.
        """
        require_kinds("solve_many", GraphError, Prepared.solve_many.__annotations__, {"threads": threads})
        if threads < 1:
            raise GraphError(f"solve_many: threads must be at least 1, found {threads}")
        return solve_batch(self, guesses, data or {}, threads)

    def export(self, folder: str | Path, *, name: str = "solver", target: str = "") -> list[Path]:
        """Write the solver as a C function for programs without Python: header, object file and shared object.

        The function takes no memory but the workspace of its caller, and gives the bits of a solve in Python that needs
        one attempt. It verifies no answer by the functions as written: solve here first.

        Args:
            folder: to be made where there is none.
            name: of the files, and what all names in C begin with.
            target: triple of another processor, as "aarch64-unknown-linux-gnu": an object file that is not linked.

        Returns:
            The files; without the shared object where there is no C compiler, which is logged with what to do.

        Raises:
            BackendError: the backend or a part of the graph needs Python, which is named; no solve has been made; or
                the compiler has failed, with what it says.
        """
        options = {"name": name, "target": target}
        require_kinds("export", BackendError, Prepared.export.__annotations__, options, str)
        self._enter()
        try:
            return export(self, Path(folder), name, target)
        finally:
            self._leave()

    def entry(self) -> Exported:
        """The backend's loop, for :func:`unifg.solution.export.export`.

        Raises:
            BackendError: there is none.
        """
        reason = "solve once, so that answers are verified, and export then"
        if type(self.solver).entry is Solver.entry:
            reason = "its loop is Python's: prepare InteriorPoint()"
        elif self.program.least_squares:
            reason = "without constraints or general costs Python judges every step: add a bound"
        elif getattr(self.solver, "time_limit", math.inf) < math.inf:
            reason = "it has a time limit: limit its iterations"
        elif self._workspace is not None and self._solves > 0:
            return self.solver.entry(self._workspace)
        raise BackendError(f"this prepared {self.solver.name} is not exported: {reason}")

    @property
    def solves_each(self) -> bool:
        """True if :meth:`solve_part` may be asked."""
        return self.solver.solves_each(self.program)

    def twins(self, count: int) -> list[Prepared]:
        """Prepared solvers of the same graph that belong to other threads; made once."""
        while len(self._twins) < count:
            twin = Prepared(self.solver, CompiledProblem(self.program.graph), self._graph)
            require_second(twin.program)
            self._twins.append(twin)
        return self._twins[:count]

    def solve_part(self, guesses: tuple[Array, Array], data: Mapping[Data, Array], count: int) -> Outcomes | None:
        """Some instances in one compiled call; None where single solves have to look at their data or answers."""
        self._enter()
        try:
            rows = self.program.rows(data, count)
            if rows is None:
                return None
            self.allocate()
            found = self.solver.solve_each(self._workspace, rows, *guesses)
            for k in range(SAMPLED - 1, count, SAMPLED):
                self.program.binding.forget()
                self.program.bind({handle: value[k] for handle, value in data.items()})
                if self.program.mistraced(self.program.columns.view(found.values[k]), False, k):
                    return None
            return found
        finally:
            self.program.binding.forget()
            self._leave()

    def _enter(self) -> None:
        """Take the locks of this solver and of its graph; refuse other threads, and calls from within a solve."""
        if not self._lock.acquire(False):
            raise BackendError(f"this prepared {self.solver.name} is at work in another thread: prepare one for each")
        try:
            if self.program.lock.mine:
                raise BackendError(
                    f"this prepared {self.solver.name} is asked for a solve from within a solve of its graph, whose "
                    f"data and memory it shares: call {self.solver.name}.solve(graph, ...) there"
                )
            self.program.lock.__enter__()
        except BaseException:
            self._lock.release()
            raise

    def _leave(self) -> None:
        """Let others have the locks."""
        self.program.lock.__exit__()
        self._lock.release()

    def _solve(
        self,
        guess: AnyGuess,
        data: Mapping[Data, Numbers] | None,
        duals: Mapping[str, Numbers] | None,
        check: bool,
        callback: Callback | None,
    ) -> Solution:
        program = self.program
        program.bind(data or {})
        self._say_if_stale()
        if self.unfinished:
            self._workspace.unfinished = False
        values, multipliers, penalties = self.read(guess, duals)
        began = time.perf_counter()
        solution = self._verified(self._answered(values, multipliers, penalties, callback, began), began, callback)
        self._last = ref(solution)
        if check and not solution.converged:
            raise NotConverged(solution)
        return solution

    def _answered(
        self, values: Values, multipliers: Array, penalties: Array, callback: Callback | None, began: float
    ) -> Solution:
        """The solution of a solve from there: by one compiled call, if the backend has one and it succeeds."""
        program, solver = self.program, self.solver
        first = self._workspace is None or callback is not None or self.single
        found = False if first else solver.at_once(self._workspace, values, multipliers)
        if not isinstance(found, bool):
            solution = Solution(
                program, found.lin, found.multipliers, penalties, found.status, found.measured, found.history,
                found.iterations, time.perf_counter() - began, solver.name, found.iterations,
            )  # fmt: skip
            solution._parts, solution.tolerance, solution._edition = (
                found.parts,
                solver.tolerance,
                program.binding.edition,
            )
            return solution
        run = SolveState(solver, program, values, multipliers, callback)
        run._started, run.penalties, run.begun = began, penalties, found
        return self._finished(run)

    def read(self, guess: AnyGuess, duals: Mapping[str, Numbers] | None = None) -> tuple[Values, Array, Array]:
        """Values, multipliers (M,) and penalties (M,) of a guess, checked; fixed variables have their values."""
        program = self.program
        stored = guess.flat(program) if isinstance(guess, Guess | Solution) and not duals else None
        if stored is not None:
            flat, multipliers, penalties = stored
            self._require_finite("multipliers", multipliers)
            if penalties is not program.no_penalties:
                self._require_finite("penalties", penalties)
            return program.values_from(flat), self._pressing(multipliers.copy()), penalties
        values = program.values_from(values_of(guess))
        if duals is not None:
            require_kinds("solve", GraphError, {"duals": "Mapping"}, {"duals": duals}, Mapping)
        carried: Mapping[str, Numbers] = {}
        penalties = program.no_penalties
        if not isinstance(guess, Mapping):
            carried = guess.multipliers
            penalties = self._stacked("penalties", guess.penalties) if guess.penalties else penalties
        multipliers = self._stacked("multipliers", {**carried, **duals} if duals else carried)
        return values, self._pressing(multipliers), penalties

    def _pressing(self, multipliers: Array) -> Array:
        """Multipliers without those of rows that have no limit, as of factors that have been switched off."""
        multipliers[self.program.unlimited] = 0.0
        return multipliers

    def _verified(self, solution: Solution, began: float, callback: Callback | None) -> Solution:
        """Evaluate traced functions as written at an answer, and solve again without the traces that differ."""
        program = self.program
        self._solves += 1
        slopes = self._solves.bit_count() == 1
        if slopes and solution.status in AT_REST:
            beside = beside_a_kink(program, solution._lin, solution._multipliers)
            if beside is not None:
                logger.info("every step from an answer at a kink lowers the cost: the solve goes on beside it")
                solution = self._continued(solution, beside, began, callback)
        solution.checked = not program.verifications
        if solution.checked or not solution.finite or solution.status is Status.INTERRUPTED:
            return solution
        values = solution._lin.values
        broken = bool(program.demanding) and self._broken(solution)
        due = slopes or self._solves % EVERY == 0 or self._owed or broken
        if not due and self._of_branches < AT_ONCE + self._solves // LATER and program.new_branches(values, False):
            due = True
            self._of_branches += 1
        late = time.perf_counter() - began > self.solver.time_limit
        self._owed = due and late and not broken  # verified after the next solve that leaves time for it
        if not due or self._owed:
            return solution
        program.new_branches(values, True)
        mistraced: dict[str, str] = {}
        while found := program.mistraced(values, slopes, self._solves):
            mistraced |= found
            solution = self._continued(solution, program.columns.values(solution.values), began, callback)
            if not solution.finite:
                break
            values = solution._lin.values
            self._broken(solution)
        solution.checked, solution.mistraced = solution.finite, mistraced
        solution.seconds = time.perf_counter() - began
        return solution

    def _continued(self, before: Solution, values: Values, began: float, callback: Callback | None) -> Solution:
        """The solution of another solve, from values and the multipliers of one before."""
        run = SolveState(self.solver, self.program, values, before._multipliers, callback)
        run._started, run.penalties = began, before._penalties
        return self._finished(run)

    def _broken(self, solution: Solution) -> bool:
        """Test what traced functions assert; the exception of one that fails is passed on as within a solve."""
        try:
            return self.program.broken(solution._lin.values)
        except Exception as error:
            solution.status = Status.INTERRUPTED  # the KKT test would pass: it knows no assertions
            hand_over(error, solution)
            raise

    def verify(self, solution: Solution) -> dict[str, str]:
        """Evaluate traced functions as written at the last answer, with the data of that solve.

        For the idle time of a control loop. Sets ``solution.checked``, and ``solution.mistraced`` where a term differs.

        Args:
            solution: returned by the last :meth:`solve`.

        Returns:
            Reasons by the names of terms whose traces differ; from the next solve on they are evaluated by Python.

        Raises:
            BackendError: while another thread solves with this object, within a solve, or for an older solution.
        """
        if self._last is None or solution is not self._last():
            raise BackendError("only the last solution can be verified: the data of others are not kept")
        self._enter()
        try:
            found = self.program.mistraced(solution._lin.values, True, self._solves)
        finally:
            self._leave()
        solution.checked, solution.mistraced, self._owed = not found, {**solution.mistraced, **found}, False
        return found

    def _finished(self, run: SolveState) -> Solution:
        """The solution of a solve that has begun."""
        self._refuse_not_finite(run)
        if not run.alone:  # who runs alone looks for itself
            run.look_at_fixed(run.lin.constraints)
        reason = None
        if run.status is None:
            self.allocate()
            try:
                if self.solver.search_iterations:
                    run.search(self._workspace)
                reason = self.solver.iterate(run, self._workspace)
            except KeyboardInterrupt:
                if not run.incumbents:
                    raise  # there is nothing to return
                run.status = Status.INTERRUPTED
            except Exception as error:
                run.keep_with(error)
                raise
            if run.alone and not run.iterations:
                self._refuse_not_finite(run)
            if self.single:  # it may have compiled, and loaded what was
                run.parts = None
        return run.finish(reason)

    @property
    def stale(self) -> bool:
        """True if the graph has been changed since."""
        return self._graph.edition != self.program.graph.edition

    def _say_if_stale(self) -> None:
        """Say once of every change that it does not reach this solver."""
        if self._graph.edition != self._edition:
            self._edition = self._graph.edition
            logger.warning(
                "a prepared %s solves the graph as it was when it was prepared, and the graph has changed since: "
                "prepare it again", self.solver.name,
            )  # fmt: skip

    def allocate(self) -> None:
        """Make the backend's workspace, unless there is one, or an earlier single solve has left its own."""
        if self._workspace is not None:
            return
        kept = self.program.workspaces
        for solver, options, workspace in kept if self.single else ():
            if solver is type(self.solver) and _same(options, vars(self.solver)):
                self._workspace = workspace
                return
        self._workspace = self.solver.workspace(self.program)
        if self.single:
            kept.append((type(self.solver), dict(vars(self.solver)), self._workspace))
            del kept[:-KEPT]

    def __getstate__(self) -> dict[str, Any]:
        """Workspaces hold compiled objects that do not pickle; they are rebuilt on first use."""
        return {**self.__dict__, "_workspace": None, "_last": None, "_twins": []}

    def _stacked(self, what: str, given: Mapping[str, Numbers]) -> Array:
        """(M,) multipliers or penalties, zero where none are given."""
        if isinstance(given, ByTerm) and given.places is self.program.places and given.intact:
            result = given.flat.copy()
        else:
            result = self._read(what, given)
        if given:
            self._require_finite(what, result)
        return result

    def _require_finite(self, what: str, given: Array) -> None:
        if not all_finite(given):
            name = self.program.row_name(int(np.flatnonzero(~np.isfinite(given))[0]))[0]
            raise GraphError(f"{what} of '{name}' are not finite", term=name)

    def _read(self, what: str, given: Mapping[str, Numbers]) -> Array:
        """The same of arrays from anywhere."""
        result = np.zeros(self.program.constraints.count)
        for name, value in given.items():
            if name not in self._constraints and str(name).endswith(SLACK):  # of a constraint that was soft
                continue
            if name not in self._constraints:
                known = ", ".join(self._constraints) or "none"
                raise GraphError(f"{what} given for '{name}', which is no constraint (there are: {known})", term=name)
            term, rows = self._constraints[name]
            array = np.asarray(value, dtype=np.float64)
            if array.shape != (term.count, term.size):
                raise GraphError(
                    f"{what} of '{name}' have shape {array.shape}, expected {(term.count, term.size)}", term=name
                )
            result[rows] = array.ravel()
        return result

    def _refuse_not_finite(self, run: SolveState) -> None:
        if run.status is not Status.NOT_FINITE:
            return
        for term in self.program.terms:
            with np.errstate(all="ignore"):
                value = term.residual(run.values)
                bad = ~np.isfinite(value.reshape(len(value), -1)).all(axis=1)
            if bad.any():
                index = int(np.flatnonzero(bad)[0])
                selection = term.gathers[0].selection
                raise NotFiniteError(
                    f"term '{term.name}': the residual of factor {index} is not finite at the guess "
                    f"(its first variable is {selection.family.name}[{selection.indices[index % len(selection)]}]); "
                    + term.remedy(index),
                    term=term.name,
                    family=selection.family.name,
                    index=index,
                )
        raise NotFiniteError("a Jacobian is not finite at the guess: run graph.check(guess) to find the term")


def _same(options: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    """Test whether options are the same numbers and words, or the same objects."""
    plain = bool | int | float | str
    return options.keys() == others.keys() and all(
        value is others[name]
        or (isinstance(value, plain) and isinstance(others[name], plain) and value == others[name])
        for name, value in options.items()
    )
