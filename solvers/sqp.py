"""Sequential quadratic programming on the graph (Ta et al. 2014, section IV).

Each iteration linearises the graph, solves the quadratic subproblem (OSQP first; an interior-point QP when OSQP
misses its accuracy; an elastic one when the linearised constraints contradict each other) and accepts a step that
lowers the l1 merit function, with a second-order correction when curvature of the constraints spoils the full
step. The Hessian is that of Gauss-Newton or of the Lagrangian (:mod:`unifg.solvers.quadratic_programs.exact_hessian`),
or the second where the first creeps: a constraint that bends as much as what it is weighed against, as the distance
from a small sphere does, makes Gauss-Newton's steps converge linearly, by a few percent each at worst.
``max_iterations=1`` is the real-time iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg.codegen.inner import inner
from unifg.errors import BackendError
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.capabilities import require
from unifg.solution.solver import Solver, SolveState
from unifg.solution.status import Status
from unifg.solvers.globalize.feasibility_restoration import RestorationTrigger, leave, resume, settle
from unifg.solvers.globalize.line_search import Taken, search
from unifg.solvers.globalize.merit import RowPrices
from unifg.solvers.globalize.norms import largest, norm
from unifg.solvers.globalize.slow_convergence import converges_slowly
from unifg.solvers.quadratic_programs.routes import Subproblems
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, subproblem
from unifg.typing import Array

FAILURES = 4  # damped attempts at one step before giving up
FIRST_DAMPING = 1e-3
DAMPING_GROWTH = 10.0
DAMPING_DECAY = 0.9  # faster forgetting cycles between overshooting and damped steps
SECANT_DECAY = 0.3  # of curvature that was seen along an earlier step
SECANT_MATTERS = 0.5  # of the known curvature; less only slows convergence down
SHORTEST_SECANT = 1e-7  # below it, differences of gradients are rounding
EXACT_DECAY = 0.1  # with the exact Hessian nothing is left to cycle about
NOISE, ROUNDING = 1e-8, 1e-13  # of the merit: for each unit of the penalty, and relative
SMALLEST_DAMPING = 1e-9  # keeps H positive definite without showing in the step


@dataclass(kw_only=True)
class SQP(Solver):
    """Equalities, inequalities and general costs by quadratic subproblems.

    Attributes:
        max_iterations: subproblems before giving up.
        hessian: "gauss-newton", or "exact": of the Lagrangian with the present multipliers, second derivatives of
            residuals and constraints included, which converges quadratically where Gauss-Newton is linear. A step for
            which it has the wrong inertia, or along which the merit does not fall, takes Gauss-Newton's. "auto" begins
            with the first and goes on with the second on slow convergence; under a
            ``time_limit`` it stays with the first, for the second has to be compiled.
        qp: "osqp" (called directly, warm-started), "graph" (an interior point whose systems are eliminated on the
            graph), "elimination" (Ta's primal and dual linear graphs, for equalities only; a reference, written to be
            read) or any name qpsolvers knows. A subproblem without inequalities is one linear system: it goes to
            "graph" unless "elimination" is asked for.
        fallback: "piqp" (called directly), "graph" or any name qpsolvers knows: repeats a QP which missed its accuracy.
            None leaves inaccurate answers as they are, and infeasible subproblems unsolved.
        qp_iterations: limit for OSQP before the fallback takes over; None for what thirty iterations of an interior
            point cost, in operations counted on the graph.
        scaling: bring unknowns and rows whose units are far apart to one scale inside the solve, found at its start
            (:mod:`unifg.solvers.quadratic_programs.scaling`). Answers and the test they have to pass stay in the units
            of the graph.
        second_order_correction: try to repair a full step that the merit function rejects.
        step_tolerance, violation_tolerance: stop rule on the norm of the step and the largest violation, for
            control loops. A positive step_tolerance switches it on; it does not grant CONVERGED.
        full_steps: take every step in full, as the paper does; no merit function.
    """

    rehearses = True

    max_iterations: int = 200
    hessian: Literal["auto", "gauss-newton", "exact"] = "auto"
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
        if self.hessian not in ("auto", "exact", "gauss-newton"):
            raise BackendError(
                f"{self.name}: hessian must be 'auto', 'exact' or 'gauss-newton', found '{self.hessian}'"
            )

    def require(self, program: CompiledProblem) -> None:
        """Refuse inequalities where the linear algebra knows equalities only."""
        if self.qp == "elimination":
            require(program, f"{self.name}(qp='elimination')", "equalities")

    def workspace(self, program: CompiledProblem) -> Subproblems:
        """QP workspaces."""
        return Subproblems(
            program,
            hessian=self.hessian,
            qp=self.qp,
            fallback=self.fallback,
            qp_iterations=self.qp_iterations,
            scaling=self.scaling,
            tolerance=self.tolerance,
        )

    def search_step(self, run: SolveState, workspace: Subproblems, lin: Linearization) -> Array | None:
        """The full step of the subproblem."""
        workspace.start(lin)
        qp = subproblem(run.program, lin, SMALLEST_DAMPING * workspace.scaling.metric, workspace.pattern)
        answer = workspace.solve(qp, run.multipliers, self._accuracy(run, workspace))
        return answer.step if np.isfinite(answer.error) else None

    def iterate(self, run: SolveState, workspace: Subproblems) -> Status | None:
        """Iterate to convergence."""
        # Bounds are linear: once they hold they hold along every step, and leave the line search to the rest.
        within = run.program.within_bounds(run.values)
        if within is not run.values and not self.full_steps:
            run.begin_at(run.program.linearize(within))
        workspace.start(run.lin)
        merit = RowPrices(run.program, workspace.scaling.rows, run.multipliers, run.lin)
        damping, missing = SMALLEST_DAMPING, 0.0
        failures = 0
        watch = RestorationTrigger()
        turning = self.hessian == "auto" and self.time_limit == np.inf and self.qp != "elimination"
        while run.status is None:
            if turning and converges_slowly(run.history):
                turning, workspace = False, workspace.curved()
                workspace.start(run.lin)
                merit = RowPrices(run.program, workspace.scaling.rows, run.multipliers, run.lin)
                damping, missing = SMALLEST_DAMPING, 0.0
            if watch.calls(run) and settle(run, Status.STALLED) is Status.LOCALLY_INFEASIBLE:
                return Status.LOCALLY_INFEASIBLE
            if run.status is not None:
                break
            shift = max(damping, missing)
            shift = _bounded(run, workspace, shift) if failures == 0 else shift
            qp = workspace.subproblem(run.lin, run.multipliers, shift)
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
                damping = max(100.0 * damping, 1e-4)
                if failures == FAILURES:
                    if (ending := resume(run, Status.STALLED)) is not None:
                        return ending
                    failures, damping, missing = 0, SMALLEST_DAMPING, 0.0
                    workspace.start(run.lin)
                    merit = RowPrices(run.program, workspace.scaling.rows, run.multipliers, run.lin)
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
                **({"hessian": _kind(qp, answer)} if workspace.exact else {}),
            )
            if run.status is None and norm(step) < self.step_tolerance:
                if run.optimality.violation < self.violation_tolerance:
                    return Status.STOP_RULE
            damping = _next_damping(workspace.exact, damping, length)
        return None

    def _attempt(
        self, run: SolveState, workspace: Subproblems, merit: RowPrices, qp: QP
    ) -> tuple[QPAnswer, Linearization, Array, Array, float, bool] | None:
        """Solve the subproblem and search along its step; None when there is no answer or no length helps."""
        accuracy = self._accuracy(run, workspace)
        answer = workspace.solve(qp, run.multipliers, accuracy)
        if not np.isfinite(answer.error):
            return None
        merit.raise_above(answer.multipliers)
        found = self._search(run, workspace, merit, qp, answer, accuracy)
        if found is None:
            return None
        multipliers = answer.multipliers if found.dual is None else found.dual
        if found.length < 1.0:
            multipliers = run.multipliers + found.length * (multipliers - run.multipliers)
        return answer, found.reached, multipliers, found.step, found.length, found.dual is not None

    def _accuracy(self, run: SolveState, workspace: Subproblems) -> float:
        """Ask the QP for what the outer iteration can use."""
        size = _size(run, workspace)
        share = min(1e-3, size) if workspace.exact else 1e-3
        # Where a scaled unit is worth many of the graph's, the test of the graph needs more digits.
        return min(max(share * size, 0.1 * self.tolerance * workspace.scaling.smallest), 1e-4)

    def _search(
        self, run: SolveState, workspace: Subproblems, merit: RowPrices, qp: QP, answer: QPAnswer, accuracy: float
    ) -> Taken | None:
        """Step length."""
        program, lin = run.program, run.lin
        if self.full_steps:
            reached = program.linearize(program.retract(lin.values, answer.step))
            return Taken(reached, answer.step, 1.0)
        here, linear = merit.value(lin), qp.linear(answer.step)
        slope = merit.slope(inner(qp.gradient, answer.step), lin, linear)
        # The QP meets its conditions to its own accuracy only; what that costs in merit is noise.
        slack = ROUNDING * max(1.0, abs(here)) + max(NOISE * merit.penalty, min(answer.error, accuracy))
        if program.least_squares:  # what is rounding depends on the cost alone, whose unit is free
            slack = ROUNDING * abs(here)
        if slope > slack:
            return None

        def correct(bend: Array) -> tuple[Array, Array] | None:
            corrected = workspace.correct(qp, answer, bend, accuracy)
            return None if corrected is None else (corrected.step, corrected.multipliers)

        wanted = correct if self.second_order_correction else None
        return search(lin, answer.step, merit, here, slope, slack, linear, wanted)


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
    known = inner(step, qp.curved(step) - qp.damping * step) / squared
    missing = inner(step, change[program.columns.free]) / squared - known
    return missing if missing > SECANT_MATTERS * known else 0.0


def _bounded(run: SolveState, workspace: Subproblems, damping: float) -> float:
    """With the exact Hessian damping must vanish with the error, or convergence would be linear."""
    return max(min(damping, _size(run, workspace)), SMALLEST_DAMPING) if workspace.exact else damping


def _next_damping(exact: bool, damping: float, length: float) -> float:
    """A shortened step means curvature that H does not know: damp, and forget it slowly."""
    if length < 1.0:
        return max(DAMPING_GROWTH * damping, FIRST_DAMPING)
    return max((EXACT_DECAY if exact else DAMPING_DECAY) * damping, SMALLEST_DAMPING)


def _size(run: SolveState, workspace: Subproblems) -> float:
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
    """Kind of Hessian a step was found with."""
    if qp.curved_by is None or answer.route == "elastic":
        return "gauss-newton"
    return "exact" if qp.weights is None else "exact, with squares"
