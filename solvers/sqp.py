"""Sequential quadratic programming on the graph (Ta et al. 2014, section IV).

Each iteration linearises the graph, solves the quadratic subproblem (OSQP first; an interior-point QP when OSQP
misses its accuracy; an elastic one when the linearised constraints contradict each other) and accepts a step that
lowers the l1 merit function, with a second-order correction when curvature of the constraints spoils the full
step. ``max_iterations=1`` is the real-time iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.linearization import Evaluation, Linearization
from unifg.program import Program
from unifg.solver import Run, Solver
from unifg.solvers.damping import norm
from unifg.solvers.qp import QP, QPAnswer, Route, subproblem
from unifg.solvers.qp_graph import GraphRoute
from unifg.solvers.qp_osqp import OsqpRoute
from unifg.solvers.qp_piqp import ElasticRoute, PiqpRoute
from unifg.solvers.qp_qpsolvers import QpsolversRoute
from unifg.status import Status
from unifg.typing import Array

ARMIJO = 1e-4
SHORTEST = 1e-6
ROUNDING = 1e-13
NOISE = 1e-8
GOOD_ENOUGH = 1e-5  # QP error that is always accepted from the fallback
USABLE = 1e-3  # QP error below which a step may still be tried
FAILURES = 4  # damped attempts at one step before giving up
MISSES = 2  # in a row within one solve, after which the first route is no longer asked
FIRST_DAMPING = 1e-3
DAMPING_GROWTH = 10.0
DAMPING_DECAY = 0.9  # faster forgetting cycles between overshooting and damped steps
SMALLEST_DAMPING = 1e-9  # keeps H positive definite without showing in the step


@dataclass(kw_only=True)
class SQP(Solver):
    """Equalities, inequalities and general costs by quadratic subproblems with a Gauss-Newton Hessian.

    Attributes:
        max_iterations: subproblems before giving up.
        qp: "osqp" (called directly, warm-started), "graph" (an interior point whose systems are eliminated on the
            graph) or any name qpsolvers knows. A subproblem without inequalities is one linear system: it goes to
            "graph" whatever is said here.
        fallback: "piqp" (called directly), "graph" or any name qpsolvers knows: repeats a QP which missed its accuracy.
            None leaves inaccurate answers as they are, and infeasible subproblems unsolved.
        qp_iterations: limit for OSQP before the fallback takes over.
        second_order_correction: try to repair a full step that the merit function rejects.
        step_tolerance, violation_tolerance: stop rule on the norm of the step and the largest violation, for
            control loops. A positive step_tolerance switches it on; it does not grant CONVERGED.
        full_steps: take every step in full, as the paper does; no merit function.
    """

    max_iterations: int = 200
    qp: str = "osqp"
    fallback: str | None = "piqp"
    qp_iterations: int = 200
    second_order_correction: bool = True
    step_tolerance: float = 0.0
    violation_tolerance: float = 1e-4
    full_steps: bool = False

    def workspace(self, program: Program) -> Subproblems:
        """QP workspaces."""
        return Subproblems(self, program)

    def search_step(self, run: Run, workspace: Subproblems, lin: Linearization) -> Array | None:
        """The full step of the subproblem."""
        workspace.start()
        answer = workspace.solve(subproblem(run.program, lin, SMALLEST_DAMPING), run.multipliers, self._accuracy(run))
        return answer.step if np.isfinite(answer.error) else None

    def iterate(self, run: Run, workspace: Subproblems) -> Status | None:
        """Iterate to convergence."""
        # Bounds are linear: once they hold they hold along every step, and leave the line search to the rest.
        within = run.program.within_bounds(run.values)
        if within is not run.values and not self.full_steps:
            run.begin_at(run.program.linearize(within))
        workspace.start()
        merit = Merit(run.program, run.multipliers)
        damping = SMALLEST_DAMPING
        failures = 0
        while run.status is None:
            accuracy = self._accuracy(run)
            qp = subproblem(run.program, run.lin, damping)
            answer = workspace.solve(qp, run.multipliers, accuracy)
            if answer.route.startswith("elastic") and run.infeasible_stationary():
                return Status.LOCALLY_INFEASIBLE
            taken = None
            if np.isfinite(answer.error):
                merit.raise_prices(answer)
                taken = self._search(run, workspace, merit, qp, answer, accuracy)
            if taken is None:
                failures += 1
                if failures == FAILURES:
                    return Status.STALLED
                damping = max(100.0 * damping, 1e-4)
                continue
            failures = 0
            after, multipliers, length, corrected = taken
            run.accept(
                after,
                multipliers,
                length * norm(answer.step),
                length,
                qp=answer.route,
                qp_iterations=answer.iterations,
                damping=damping,
                **({"correction": 1} if corrected else {}),
            )
            if run.status is None and length * norm(answer.step) < self.step_tolerance:
                if run.optimality.violation < self.violation_tolerance:
                    return Status.STOP_RULE
            damping = self._next_damping(damping, length)
        return None

    def _accuracy(self, run: Run) -> float:
        """Ask the QP for what the outer iteration can use."""
        size = max(run.optimality.stationarity, run.optimality.violation, run.optimality.complementarity)
        return float(np.clip(1e-3 * size, 0.1 * self.tolerance, 1e-4))

    def _next_damping(self, damping: float, length: float) -> float:
        """A shortened step means curvature that H does not know: damp, and forget it slowly."""
        if length < 1.0:
            return max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        return max(DAMPING_DECAY * damping, SMALLEST_DAMPING)

    def _search(
        self, run: Run, workspace: Subproblems, merit: Merit, qp: QP, answer: QPAnswer, accuracy: float
    ) -> tuple[Linearization, Array, float, bool] | None:
        program, lin = run.program, run.lin
        values = program.retract(lin.values, answer.step)
        if self.full_steps:
            return program.linearize(values), answer.multipliers, 1.0, False
        here = merit.value(lin)
        slope = merit.slope(qp, answer.step, lin)
        # The QP meets its rows to its own accuracy only; what that costs in merit is noise.
        slack = ROUNDING * max(1.0, abs(here)) + NOISE * merit.price
        if slope > slack:
            return None
        trial = program.evaluate(values, lin.weights)
        if merit.accepts(trial, here, slope, 1.0, slack):
            return program.linearize(values), answer.multipliers, 1.0, False
        if self.second_order_correction and trial.finite and program.constraints.count:
            corrected = workspace.correct(qp, answer, trial, lin, accuracy)
            if corrected is not None:
                bent = program.retract(lin.values, corrected.step)
                if merit.accepts(program.evaluate(bent, lin.weights), here, slope, 1.0, slack):
                    return program.linearize(bent), corrected.multipliers, 1.0, True
        length = 0.5
        while length >= SHORTEST:
            values = program.retract(lin.values, length * answer.step)
            if merit.accepts(program.evaluate(values, lin.weights), here, slope, length, slack):
                multipliers = run.multipliers + length * (answer.multipliers - run.multipliers)
                return program.linearize(values), multipliers, length, False
            length *= 0.5
        return None


class Merit:
    """l1 merit: objective plus a price per unit of violation for every row (Powell 1978)."""

    def __init__(self, program: Program, multipliers: Array) -> None:
        """Start with the prices the multipliers suggest."""
        self.program = program
        self.prices = np.abs(multipliers)

    @property
    def price(self) -> float:
        """The highest price, at least one."""
        return float(self.prices.max(initial=1.0))

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
        """Armijo's condition."""
        return trial.finite and self.value(trial) <= here + ARMIJO * length * slope + slack


class Subproblems:
    """The QP routes of one prepared graph and the order they are tried in."""

    def __init__(self, options: SQP, program: Program) -> None:
        """Open the chosen route and its fallback.

        Raises:
            BackendError: when a named solver is not installed.
        """
        self.program = program
        linear = bool(program.equality.all())
        self.fallback = None if options.fallback is None else _route(program, options.fallback, 0)
        self.first = _route(program, "graph" if linear else options.qp, options.qp_iterations)
        self.elastic = None if options.fallback is None else ElasticRoute(program)
        self._misses = 0

    def start(self) -> None:
        """Begin a new solve: the first route is trusted again."""
        self._misses = 0

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Try the first route, then the fallback, then the elastic problem."""
        enough = max(10.0 * accuracy, GOOD_ENOUGH)
        if self.fallback is None or self.elastic is None:
            return self.first.solve(qp, multipliers, accuracy)
        answers = []
        if self._misses < MISSES:
            answers.append(self.first.solve(qp, multipliers, accuracy))
            if answers[-1].error <= 10.0 * accuracy:
                self._misses = 0
                return answers[-1]
            self._misses += 1
        if not any(answer.infeasible for answer in answers):
            answers.append(self.fallback.solve(qp, multipliers, accuracy))
            if answers[-1].error <= enough:
                return answers[-1]
        best = min(answers, key=lambda answer: answer.error)
        if best.error <= USABLE:
            return best
        return self.elastic.solve(qp, max(10.0 * float(np.abs(multipliers).max(initial=0.0)), 1e3))

    def correct(
        self, qp: QP, answer: QPAnswer, trial: Evaluation, lin: Linearization, accuracy: float
    ) -> QPAnswer | None:
        """Second-order correction: aim at the constraints as found after the full step."""
        bend = trial.constraints - lin.constraints - qp.linear(answer.step)
        for route in (self.first, self.fallback):
            if route is not None and route.name == answer.route:
                corrected = route.solve(qp.shifted(-bend), answer.multipliers, accuracy)
                return corrected if corrected.error <= USABLE else None
        return None


def _route(program: Program, name: str, osqp_iterations: int) -> Route:
    """The engine, OSQP and PIQP are called directly, everything else through qpsolvers."""
    if name == "graph":
        return GraphRoute(program)
    if name == "osqp":
        return OsqpRoute(program, osqp_iterations)
    return PiqpRoute(program) if name == "piqp" else QpsolversRoute(program, name)
