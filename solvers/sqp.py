"""Sequential quadratic programming on the graph (Ta et al. 2014, section IV).

Each iteration linearises the graph, solves the quadratic subproblem (OSQP first; an interior-point QP when OSQP
misses its accuracy; an elastic one when the linearised constraints contradict each other) and accepts a step that
lowers the l1 merit function, with a second-order correction when curvature of the constraints spoils the full
step. The Hessian is that of Gauss-Newton or of the Lagrangian (:mod:`unifg.solvers.qp_exact`).
``max_iterations=1`` is the real-time iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from unifg.answers.requirements import require
from unifg.answers.solver import Run, Solver
from unifg.answers.status import Status
from unifg.errors import BackendError
from unifg.program.linearization import Evaluation, Linearization
from unifg.program.program import Program
from unifg.solvers.damping import largest, norm
from unifg.solvers.least_violation import leave, settle
from unifg.solvers.qp import QP, QPAnswer, Route, solve_convex, subproblem
from unifg.solvers.qp_elimination import EliminationRoute
from unifg.solvers.qp_exact import ExactHessian, holds
from unifg.solvers.qp_graph import GraphRoute
from unifg.solvers.qp_osqp import FINER, OsqpRoute
from unifg.solvers.qp_piqp import ElasticRoute, PiqpRoute
from unifg.solvers.qp_polish import Polish
from unifg.solvers.qp_qpsolvers import QpsolversRoute
from unifg.solvers.scaling import Scaling
from unifg.typing import Array

ARMIJO = 1e-4
SHORTEST = 1e-6
ROUNDING = 1e-13
NOISE = 1e-8
GOOD_ENOUGH = 1e-5  # QP error that is always accepted from the fallback
USABLE = 1e-3  # QP error below which a step may still be tried
FARTHEST = 1e4  # violation that a step may lead to, relative to the start's (Waechter and Biegler 2006, eq. 21)
FAILURES = 4  # damped attempts at one step before giving up
MISSES = 2  # in a row, after which the first route is left out: once, then twice as often with each further miss
LEFT = 0.3  # share of the violation that a step may leave in the linear model
PATIENCE = 20  # iterations whose violation has not fallen
FALLING = 0.9
RESTING = 4  # subproblems that go straight to the fallback after a step of the first route that led nowhere
FIRST_DAMPING = 1e-3
DAMPING_GROWTH = 10.0
DAMPING_DECAY = 0.9  # faster forgetting cycles between overshooting and damped steps
SECANT_DECAY = 0.3  # of curvature that was seen along an earlier step
SECANT_MATTERS = 0.5  # of the known curvature; less only slows convergence down
SHORTEST_SECANT = 1e-7  # below it, differences of gradients are rounding
EXACT_DECAY = 0.1  # with the exact Hessian nothing is left to cycle about
SMALLEST_DAMPING = 1e-9  # keeps H positive definite without showing in the step


@dataclass(kw_only=True)
class SQP(Solver):
    """Equalities, inequalities and general costs by quadratic subproblems.

    Attributes:
        max_iterations: subproblems before giving up.
        hessian: "gauss-newton", or "exact": of the Lagrangian with the present multipliers, second derivatives of
            residuals and constraints included, which converges quadratically where Gauss-Newton is linear. A step for
            which it has the wrong inertia, or along which the merit does not fall, takes Gauss-Newton's.
        qp: "osqp" (called directly, warm-started), "graph" (an interior point whose systems are eliminated on the
            graph), "elimination" (Ta's primal and dual linear graphs, for equalities only; a reference, written to be
            read) or any name qpsolvers knows. A subproblem without inequalities is one linear system: it goes to
            "graph" unless "elimination" is asked for.
        fallback: "piqp" (called directly), "graph" or any name qpsolvers knows: repeats a QP which missed its accuracy.
            None leaves inaccurate answers as they are, and infeasible subproblems unsolved.
        qp_iterations: limit for OSQP before the fallback takes over; None for what thirty iterations of an interior
            point cost, in operations counted on the graph.
        scaling: bring unknowns and rows whose units are far apart to one scale inside the solve, found at its start
            (:mod:`unifg.solvers.scaling`). Answers and the test they have to pass stay in the units of the graph.
        second_order_correction: try to repair a full step that the merit function rejects.
        step_tolerance, violation_tolerance: stop rule on the norm of the step and the largest violation, for
            control loops. A positive step_tolerance switches it on; it does not grant CONVERGED.
        full_steps: take every step in full, as the paper does; no merit function.
    """

    max_iterations: int = 200
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    qp: str = "osqp"
    fallback: str | None = "piqp"
    qp_iterations: int | None = None
    scaling: bool = True
    second_order_correction: bool = True
    step_tolerance: float = 0.0
    violation_tolerance: float = 1e-4
    full_steps: bool = False

    def __post_init__(self) -> None:
        """Refuse options that mean nothing."""
        super().__post_init__()
        if self.hessian not in ("exact", "gauss-newton"):
            raise BackendError(f"{self.name}: hessian must be 'exact' or 'gauss-newton', found '{self.hessian}'")

    def require(self, program: Program) -> None:
        """Refuse inequalities where the linear algebra knows equalities only."""
        if self.qp == "elimination":
            require(program, f"{self.name}(qp='elimination')", "equalities")

    def workspace(self, program: Program) -> Subproblems:
        """QP workspaces."""
        return Subproblems(self, program)

    def search_step(self, run: Run, workspace: Subproblems, lin: Linearization) -> Array | None:
        """The full step of the subproblem."""
        workspace.start(lin)
        qp = subproblem(run.program, lin, SMALLEST_DAMPING * workspace.scaling.metric, workspace.pattern)
        answer = workspace.solve(qp, run.multipliers, self._accuracy(run, workspace))
        return answer.step if np.isfinite(answer.error) else None

    def iterate(self, run: Run, workspace: Subproblems) -> Status | None:
        """Iterate to convergence."""
        # Bounds are linear: once they hold they hold along every step, and leave the line search to the rest.
        within = run.program.within_bounds(run.values)
        if within is not run.values and not self.full_steps:
            run.begin_at(run.program.linearize(within))
        workspace.start(run.lin)
        merit = Merit(workspace.scaling, run.multipliers, run.lin)
        damping, missing = SMALLEST_DAMPING, 0.0
        failures = 0
        watch = Watch()
        while run.status is None:
            if watch.calls(run) and settle(run, Status.STALLED) is Status.LOCALLY_INFEASIBLE:
                return Status.LOCALLY_INFEASIBLE
            if run.status is not None:
                break
            shift = max(damping, missing)
            shift = self._bounded(run, workspace, shift) if failures == 0 else shift
            qp = workspace.subproblem(run, shift)
            taken = self._attempt(run, workspace, merit, qp)
            if taken is None and workspace.distrust():
                taken = self._attempt(run, workspace, merit, qp)
            if taken is None and qp.curved_by is not None:
                qp = qp.gauss_newton()
                taken = self._attempt(run, workspace, merit, qp)
            if workspace.elastic_asked and run.infeasible_stationary():
                if (ending := leave(run)) is not None:
                    return ending
                continue
            if taken is None:
                failures += 1
                if failures == FAILURES:
                    return settle(run, Status.STALLED)
                damping = max(100.0 * damping, 1e-4)
                continue
            failures = 0
            answer, after, multipliers, step, length, corrected = taken
            if qp.curved_by is None:
                seen = missing_curvature(workspace.scaling, qp, run.lin, after, multipliers, step)
                missing = max(seen, SECANT_DECAY * missing)
            else:
                missing = 0.0
            run.accept(
                after,
                multipliers,
                norm(step),
                length,
                qp=answer.route,
                qp_iterations=answer.iterations,
                damping=shift,
                **({"correction": 1} if corrected else {}),
                **({"hessian": _kind(qp, answer)} if self.hessian == "exact" else {}),
            )
            if run.status is None and norm(step) < self.step_tolerance:
                if run.optimality.violation < self.violation_tolerance:
                    return Status.STOP_RULE
            damping = self._next_damping(damping, length)
        return None

    def _attempt(
        self, run: Run, workspace: Subproblems, merit: Merit, qp: QP
    ) -> tuple[QPAnswer, Linearization, Array, Array, float, bool] | None:
        """Solve the subproblem and search along its step; None when there is no answer or no length helps."""
        accuracy = self._accuracy(run, workspace)
        answer = workspace.solve(qp, run.multipliers, accuracy)
        if not np.isfinite(answer.error):
            return None
        merit.raise_prices(answer)
        found = self._search(run, workspace, merit, qp, answer, accuracy)
        return None if found is None else (answer, *found)

    def _bounded(self, run: Run, workspace: Subproblems, damping: float) -> float:
        """With the exact Hessian damping must vanish with the error, or convergence would be linear."""
        return damping if self.hessian != "exact" else max(min(damping, _size(run, workspace)), SMALLEST_DAMPING)

    def _accuracy(self, run: Run, workspace: Subproblems) -> float:
        """Ask the QP for what the outer iteration can use."""
        size = _size(run, workspace)
        share = min(1e-3, size) if self.hessian == "exact" else 1e-3
        # Where a scaled unit is worth many of the graph's, the test of the graph needs more digits.
        return float(np.clip(share * size, 0.1 * self.tolerance * workspace.scaling.smallest, 1e-4))

    def _next_damping(self, damping: float, length: float) -> float:
        """A shortened step means curvature that H does not know: damp, and forget it slowly."""
        if length < 1.0:
            return max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        return max((EXACT_DECAY if self.hessian == "exact" else DAMPING_DECAY) * damping, SMALLEST_DAMPING)

    def _search(
        self, run: Run, workspace: Subproblems, merit: Merit, qp: QP, answer: QPAnswer, accuracy: float
    ) -> tuple[Linearization, Array, Array, float, bool] | None:
        """Where to go: linearisation, multipliers, step and its length, and whether it is a correction."""
        program, lin = run.program, run.lin
        values = program.retract(lin.values, answer.step)
        if self.full_steps:
            return program.linearize(values), answer.multipliers, answer.step, 1.0, False
        here = merit.value(lin)
        slope = merit.slope(qp, answer.step, lin)
        # The QP meets its conditions to its own accuracy only; what that costs in merit is noise.
        slack = ROUNDING * max(1.0, abs(here)) + max(NOISE * merit.price, min(answer.error, accuracy))
        if program.least_squares:  # what is rounding depends on the cost alone, whose unit is free
            slack = ROUNDING * abs(here)
        if slope > slack:
            return None
        trial = program.evaluate(values, lin.weights)
        if merit.accepts(trial, here, slope, 1.0, slack):
            after = program.linearize(values)
            if after.finite:  # a residual may have an edge where its derivatives end
                return after, answer.multipliers, answer.step, 1.0, False
        if self.second_order_correction and trial.finite and program.constraints.count:
            corrected = workspace.correct(qp, answer, trial, lin, accuracy)
            if corrected is not None:
                bent = program.retract(lin.values, corrected.step)
                if merit.accepts(program.evaluate(bent, lin.weights), here, slope, 1.0, slack):
                    after = program.linearize(bent)
                    if after.finite:
                        return after, corrected.multipliers, corrected.step, 1.0, True
        length = 0.5
        while length >= SHORTEST:
            values = program.retract(lin.values, length * answer.step)
            if merit.accepts(program.evaluate(values, lin.weights), here, slope, length, slack):
                after = program.linearize(values)
                if after.finite:
                    multipliers = run.multipliers + length * (answer.multipliers - run.multipliers)
                    return after, multipliers, length * answer.step, length, False
            length *= 0.5
        return None


def missing_curvature(
    scaling: Scaling, qp: QP, before: Linearization, after: Linearization, multipliers: Array, step: Array
) -> float:
    """Curvature of the Lagrangian along a step, by the secant, that the Hessian lacked; zero when it did not matter.

    A Gauss-Newton Hessian leaves out what constraints and residuals bend. Where that is as much as H itself, full steps
    swing to and fro across the answer: the error is multiplied by 1 - (true curvature) / (that of the subproblem).

    Args:
        scaling: units in which the length of the step is measured.
        qp: the subproblem that gave the step.
        before: linearisation at the start of the step.
        after: linearisation at its end.
        multipliers: (M,) at its end.
        step: (n,) tangent step.
    """
    program = scaling.program
    squared = float(np.square(step / scaling.columns).sum())
    if squared < SHORTEST_SECANT**2:
        return 0.0
    change = program.lagrangian_gradient(after, multipliers) - program.lagrangian_gradient(before, multipliers)
    known = float(step @ (qp.curved(step) - qp.damping * step)) / squared
    missing = float(step @ change[program.columns.free]) / squared - known
    return missing if missing > SECANT_MATTERS * known else 0.0


class Merit:
    """l1 merit: objective plus a price per unit of violation for every row (Powell 1978)."""

    def __init__(self, scaling: Scaling, multipliers: Array, start: Linearization) -> None:
        """Start with the prices the multipliers suggest."""
        self.program = scaling.program
        self._rows = scaling.rows
        self.prices = np.abs(multipliers)
        self._worst = FARTHEST * max(1.0, self._violation(start.constraints))

    @property
    def price(self) -> float:
        """The highest price in scaled units, at least one."""
        return float((self.prices / self._rows).max(initial=1.0))

    def raise_prices(self, answer: QPAnswer) -> None:
        """Keep every price above its multiplier."""
        size = np.abs(answer.multipliers)
        self.prices = np.maximum(1.1 * size, 0.5 * (self.prices + size))

    def value(self, point: Linearization | Evaluation) -> float:
        """Merit at a point."""
        return point.cost + float(self.prices @ np.abs(self.program.violation(point.constraints)))

    def slope(self, qp: QP, step: Array, lin: Linearization) -> float:
        """Upper bound of the merit's derivative along ``step``."""
        linear = lin.constraints + qp.linear(step)
        change = np.abs(self.program.violation(linear)) - np.abs(self.program.violation(lin.constraints))
        return float(qp.gradient @ step + self.prices @ change)

    def accepts(self, trial: Evaluation, here: float, slope: float, length: float, slack: float) -> bool:
        """Armijo's condition, not too far from the constraints: the merit may be unbounded out there."""
        if not trial.finite or self._violation(trial.constraints) > self._worst:
            return False
        return self.value(trial) <= here + ARMIJO * length * slope + slack

    def _violation(self, constraints: Array) -> float:
        return float((self._rows * np.abs(self.program.violation(constraints))).sum())


class Watch:
    """Calls for a look at the violation alone when it has not fallen for long.

    Where constraints miss each other by little, every linearisation may have a solution, while steps only get shorter
    and multipliers longer. Whether there is a feasible point, a descent on the violation tells.
    """

    def __init__(self) -> None:
        """Begin to count."""
        self._patience, self._waited = PATIENCE, 0
        self._least = np.inf

    def calls(self, run: Run) -> bool:
        """Whether it is time; asked once an iteration, and after every call half as often."""
        violation = run.optimality.violation
        if violation <= run.tolerance or violation < FALLING * self._least:
            self._least, self._waited = min(violation, self._least), 0
            return False
        self._waited += 1
        if self._waited < self._patience:
            return False
        self._patience, self._waited = 2 * self._patience, 0
        return True


class Subproblems:
    """The QP routes of one prepared graph and the order they are tried in.

    Attributes:
        program: the compiled graph.
        pattern: of the Hessians.
        scaling: units in which subproblems are solved, found at the start of each solve.
        elastic_asked: whether the last subproblem went to the elastic route.
    """

    def __init__(self, options: SQP, program: Program) -> None:
        """Open the chosen route and its fallback.

        Raises:
            BackendError: when a named solver is not installed.
        """
        self.program = program
        self.elastic_asked = False
        self._tolerance = options.tolerance
        self._exact = ExactHessian(program) if options.hessian == "exact" else None
        self.pattern = program.hessian if self._exact is None else program.normal
        linear = bool(program.equality.all()) and options.qp != "elimination"
        self.fallback = None if options.fallback is None else _route(program, options.fallback, options.qp_iterations)
        self.first = _route(program, "graph" if linear else options.qp, options.qp_iterations)
        self.elastic = None if options.fallback is None else ElasticRoute(program, self.pattern)
        self._polish = Polish(program)
        self._scaled = options.scaling and not isinstance(self.first, EliminationRoute)
        self.scaling = self._neutral = Scaling.none(program)
        self._misses = self._resting = 0
        self._first_answered = False

    def start(self, lin: Linearization) -> None:
        """Begin a new solve at ``lin``: the first route is trusted again, and nothing of the last one is left.

        Raises:
            BackendError: when new data made inequalities that the first route cannot take.
        """
        self._misses = self._resting = 0
        for route in (self.first, self.fallback, self.elastic):
            if isinstance(route, (OsqpRoute, PiqpRoute, ElasticRoute)):
                route.begin()
        if self._scaled:
            self.scaling = Scaling.of(self.program, lin, self._neutral)
        if isinstance(self.first, EliminationRoute):
            require(self.program, "SQP(qp='elimination')", "equalities")

    def subproblem(self, run: Run, damping: float) -> QP:
        """The quadratic model at the present iterate."""
        if self._exact is None:
            return subproblem(self.program, run.lin, damping * self.scaling.metric, self.pattern)
        return self._exact.subproblem(run.lin, run.multipliers, damping * self.scaling.metric, self.scaling)

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Try the first route, then the fallback, then the elastic problem."""
        scaling = self.scaling
        if scaling.neutral:
            return self._solve(qp, qp.gauss_newton, multipliers, accuracy)
        scaled, multipliers = scaling.scaled(qp), multipliers / scaling.rows
        answer = self._solve(scaled, lambda: scaling.scaled(qp.gauss_newton()), multipliers, accuracy)
        if FINER * accuracy < answer.error <= USABLE and not self.elastic_asked:
            answer = self._polish(scaled, answer)
        return scaling.unscaled(answer)

    def _solve(self, qp: QP, elastic: Callable[[], QP], multipliers: Array, accuracy: float) -> QPAnswer:
        self.elastic_asked = self._first_answered = False
        enough = max(10.0 * accuracy, GOOD_ENOUGH)
        if self.fallback is None or self.elastic is None:
            answer = solve_convex(self.first, qp, multipliers, accuracy)
            return answer if holds(qp, answer, enough) else replace(answer, error=np.inf)
        answers = []
        if self._resting:
            self._resting -= 1
        else:
            answers.append(solve_convex(self.first, qp, multipliers, accuracy))
            if not holds(qp, answers[-1], enough):
                return replace(answers[-1], error=np.inf)
            if answers[-1].error <= 10.0 * accuracy and not self._contradicts(qp, answers[-1]):
                self._misses, self._first_answered = 0, True
                return answers[-1]
            self._misses += 1
            if self._misses >= MISSES:
                self._resting = 2 ** (self._misses - MISSES)
        if not any(answer.infeasible for answer in answers):
            answers.append(solve_convex(self.fallback, qp, multipliers, accuracy))
            if not holds(qp, answers[-1], enough):
                return replace(answers[-1], error=np.inf)
        best = min(answers, key=lambda answer: answer.error)
        if best.error <= USABLE and not self._contradicts(qp, best):
            return best
        # Where no step satisfies the rows, nothing says along which steps the curvature of constraints should count.
        self.elastic_asked = True
        return self.elastic.solve(elastic(), max(10.0 * float(np.abs(multipliers).max(initial=0.0)), 1e3))

    def _contradicts(self, qp: QP, answer: QPAnswer) -> bool:
        """Whether an answer leaves most of the violation, as the least error of contradicting rows does."""
        if answer.error <= 0.1 * self._tolerance:  # which is no less than what is left
            return False
        linear = qp.linear(answer.step)
        left = largest(np.maximum(linear - qp.upper, 0.0) + np.maximum(qp.lower - linear, 0.0))
        return left > max(LEFT * largest(np.maximum(-qp.upper, 0.0) + np.maximum(qp.lower, 0.0)), 0.1 * self._tolerance)

    def distrust(self) -> bool:
        """Leave the first route out for a while, after a step of it that led nowhere; whether it gave the last step."""
        if not self._first_answered:
            return False
        self._resting = RESTING
        return True

    def correct(
        self, qp: QP, answer: QPAnswer, trial: Evaluation, lin: Linearization, accuracy: float
    ) -> QPAnswer | None:
        """Second-order correction: aim at the constraints as found after the full step."""
        bend = trial.constraints - lin.constraints - qp.linear(answer.step)
        for route in (self.first, self.fallback):
            if route is not None and route.name == answer.route:
                corrected = solve_convex(
                    route, self.scaling.scaled(qp.shifted(-bend)), answer.multipliers / self.scaling.rows, accuracy
                )
                return self.scaling.unscaled(corrected) if corrected.error <= USABLE else None
        return None


def _size(run: Run, workspace: Subproblems) -> float:
    """The largest KKT number of the present iterate, in scaled units."""
    program, scaling, measured = run.program, workspace.scaling, run.optimality
    if scaling.neutral:
        scale = max(1.0, float(np.abs(run.multipliers).mean()) / 100.0) if len(run.multipliers) else 1.0
        return max(scale * measured.stationarity, measured.violation, measured.complementarity)
    gradient = program.lagrangian_gradient(run.lin, run.multipliers)[program.columns.free]
    return max(
        largest(scaling.columns * gradient),
        largest(scaling.rows * program.violation(run.lin.constraints)),
        measured.complementarity,
    )


def _kind(qp: QP, answer: QPAnswer) -> str:
    """Which Hessian a step was found with."""
    if qp.curved_by is None or answer.route == "elastic":
        return "gauss-newton"
    return "exact" if qp.weights is None else "exact, with squares"


def _route(program: Program, name: str, osqp_iterations: int | None) -> Route:
    """The engine, OSQP and PIQP are called directly, everything else through qpsolvers."""
    if name == "graph":
        return GraphRoute(program)
    if name == "elimination":
        return EliminationRoute(program)
    if name == "osqp":
        return OsqpRoute(program, osqp_iterations)
    return PiqpRoute(program) if name == "piqp" else QpsolversRoute(program, name)
