"""State of a solve, and the parts that an iterative method fills in: one loop state during, one judge after."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from unifg.codegen.inner import inner
from unifg.errors import BackendError, require_kinds
from unifg.factors.steps import EPSILON
from unifg.modeling.model import Model
from unifg.modeling.variables import Data
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.units import SMALL_FORCES
from unifg.solution.batch import Outcomes
from unifg.solution.capabilities import Constraints, require
from unifg.solution.conditioning import HARDLY
from unifg.solution.export import Exported
from unifg.solution.history import HEADER, Deferred, Iteration, factor_norms, line, show
from unifg.solution.incumbent import Incumbent, Incumbents
from unifg.solution.multipliers import Slopes, estimated
from unifg.solution.optimality import Optimality, Tolerances, infeasible_stationary, optimality, within_bounds
from unifg.solution.relative_offset import Factored
from unifg.solution.solution import AnyGuess, Solution
from unifg.solution.status import Status
from unifg.typing import Array, Numbers

Callback: TypeAlias = Callable[[Iteration], bool | None]

UNBOUNDED_COST = -1e20
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


@dataclass(kw_only=True)
class IterativeMethod(Backend):
    """Options common to all backends, and the parts of a solve that each has of its own.

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
        for name in ("max_iterations", "search_iterations", "damping"):
            if not vars(self).get(name, 0) >= 0:
                raise BackendError(f"{self.name}: {name} must not be negative, found {vars(self)[name]}")

    @property
    def tolerances(self) -> Tolerances:
        """Both tolerances of the KKT test."""
        stated = self.feasibility_tolerance
        return Tolerances(self.tolerance, stated or self.tolerance, (stated or 0.0) / self.tolerance)

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

    def at_once(self, workspace: Any, values: Array, multipliers: Array) -> Conclusion | bool:
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
        resumed: squared violation where the last one ended that the solve was to go on from.
        parts: seconds of a compiled loop in evaluation, linear systems and the test of the answer, and of all of the
            loop; None where nobody took them.
        begun: whether the workspace holds a first attempt that :meth:`IterativeMethod.at_once` has made.
        alone: whether nobody looks before the end; there is no linearisation then until :meth:`conclude`.
        tolerances: of the KKT test.
        lent: the backend's factorisation of a matrix near the Hessian of the objective, which the KKT test of least
            squares may use and overwrite; None where the backend has no such thing.
        slopes: the largest so far, where there are constraints.
        incumbents: iterates one of which is returned without success.
    """

    def __init__(
        self,
        solver: IterativeMethod,
        program: CompiledProblem,
        values: Values,
        multipliers: Array,
        callback: Callback | None,
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
        self.incumbents = Incumbents(program, self.tolerances.violation)
        self._recall: Callable[[], list[Iteration]] | None = None
        self._least, self._start = np.inf, values
        self._least_at: Array | None = None
        self._values: Values | None
        self.lent: Factored | None = None
        self.slopes: Slopes | None = None
        self.iterations = self.restoration_steps = 0
        self.begun, self.resumed = False, np.inf
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
        values = lin.stored
        self._note(measured.violation, values)
        if candidate and measured.finite:
            self.consider(lin.cost, lin.constraints.copy(), values, multipliers)

    def pass_by(
        self, number: int, violation: float, cost: float, constraints: Array, values: Array, multipliers: Array
    ) -> None:
        """Take note of an iterate that a solve has left behind; all as of :meth:`consider`, finite."""
        self.iterations = number
        self._note(violation, values)
        self.consider(cost, constraints, values, multipliers)

    def look_at(self, lin: Linearization) -> None:
        """Take note of a point that may violate less than all iterates."""
        self._note(self._farthest(lin.constraints), lin.stored)

    def _note(self, violation: float, values: Array | None) -> None:
        """Keep the values of least violation, None for the start."""
        if violation < self._least:
            self._least, self._least_at = violation, values

    def _farthest(self, constraints: Array) -> float:
        """Largest violation of (M,) values of the constraints."""
        return float(np.abs(self.program.violation(constraints)).max(initial=0.0))

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
            self._note(self._farthest(self.program.evaluate(self._start).constraints), None)
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
        return self._farthest(constraints) > self.tolerances.violation

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
