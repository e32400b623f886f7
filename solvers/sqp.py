"""Sequential quadratic programming on the graph (Ta et al. 2014, section IV).

Each iteration linearises the graph, solves the quadratic subproblem (OSQP first; an interior-point QP when OSQP
misses its accuracy; an elastic one when the linearised constraints contradict each other) and accepts a step that
lowers the l1 merit function, with a second-order correction when curvature of the constraints spoils the full
step. The Hessian is that of Gauss-Newton or of the Lagrangian (:mod:`unifg.solvers.quadratic_programs.exact_hessian`),
or the second where the first creeps: a constraint that bends as much as what it is weighed against, as the distance
from a small sphere does, makes Gauss-Newton's steps converge linearly, by a few percent each at worst.
``max_iterations=1`` is the real-time iteration.

A solve whose terms are all compiled begins in compiled code, and with ``qp="graph"`` goes on there from step to step
(:mod:`unifg.solvers.quadratic_programs.loop`). :meth:`SQP.iterate` does what is unusual, and all of a solve that
somebody watches or that has a time limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg.errors import BackendError
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import require_second
from unifg.problem.linearization import Linearization
from unifg.solution.capabilities import require
from unifg.solution.solve_state import SolveState
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.globalize.feasibility_restoration import RestorationTrigger, leave, resume, settle
from unifg.solvers.globalize.norms import largest
from unifg.solvers.globalize.slow_convergence import PATIENCE, second_derivatives_pay
from unifg.solvers.quadratic_programs.attempt import LOGGED, SMALLEST_DAMPING, STARTED, STOPPED
from unifg.solvers.quadratic_programs.loop import kkt_size, rests, useful_accuracy
from unifg.solvers.quadratic_programs.routes import Subproblems
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, subproblem
from unifg.typing import Array

FAILURES = 4  # damped attempts at one step before giving up
WORTH = 8.0  # iterations of Gauss-Newton that the last few with second derivatives cost


@dataclass(kw_only=True)
class SQP(Solver):
    """Equalities, inequalities and general costs by quadratic subproblems.

    Attributes:
        max_iterations: subproblems before giving up.
        hessian: "gauss-newton", or "exact": of the Lagrangian with the present multipliers, second derivatives of
            residuals and constraints included, which converges quadratically where Gauss-Newton is linear. A step for
            which it has the wrong inertia, or along which the merit does not fall, takes Gauss-Newton's. "auto" begins
            with the first and goes on with the second where steps converge more slowly than the second would, which
            the last two iterations tell.
        qp: "osqp" (called directly, warm-started; what it finds active is completed on the graph), "graph" (active
            sides, or an interior point, whose systems are eliminated on the graph), "elimination" (Ta's primal and dual
            linear graphs, for equalities only; a reference, written to be read) or any name qpsolvers knows. A
            subproblem without inequalities is one linear system: it goes to "graph" unless "elimination" is asked for.
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

    rehearses = states_subproblems = True

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
        for name in (self.qp, self.fallback or "piqp"):
            if name not in ("osqp", "graph", "elimination", "piqp"):
                from unifg.solvers.quadratic_programs.qpsolvers_route import require_known

                require_known(name)

    def require(self, program: CompiledProblem) -> None:
        """Refuse inequalities where the linear algebra knows equalities only."""
        if self.qp == "elimination":
            require(program, f"{self.name}(qp='elimination')", "equalities")

    def runs_alone(self, program: CompiledProblem) -> bool:
        """Test whether the compiled loop may begin the solve, and go on where it is the graph that answers."""
        return self._known(program) and not len(program.fixed_rows())

    def _known(self, program: CompiledProblem) -> bool:
        """Test whether compiled code knows all that an iterate is judged by."""
        python = program.large or program.differenced or program.least_squares
        return program.fully_compiled and self.time_limit == np.inf and not python

    def workspace(self, program: CompiledProblem) -> Subproblems:
        """QP workspaces."""
        if program.fully_compiled and self.hessian != "gauss-newton":
            require_second(program)
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
        program, steps, watch, failures = run.program, workspace.steps, RestorationTrigger(), 0
        now, turning = steps.now, self.hessian == "auto" and self.qp != "elimination"
        worth = np.inf if workspace.first.name == "graph" else WORTH  # where steps of Gauss-Newton are cheaper by far
        alone = program.sided and (run.alone or (not run.watched and self._known(program)))
        rule = self.step_tolerance, self.violation_tolerance
        steps.prepare(self.tolerances, self.full_steps, self.second_order_correction, self.max_iterations, rule)
        if run.alone:
            workspace.begin()
            budget = _budget(watch, 1 if turning else 0) if alone and workspace.compiled else 0
            _noted(run, workspace, watch, 1, steps.begin_alone(run, budget, workspace.scaled))
        else:
            # Bounds are linear: once they hold they hold along every step, and leave the line search to the rest.
            if not self.full_steps and program.violation(run.lin.constraints)[program.bound_rows].any():
                run.begin_at(program.linearize(program.within_bounds(run.values)))
            now["answer"] = STARTED
        if now["answer"] == STARTED and run.status is None:
            self._begin(run, workspace)
        while run.status is None:
            if now["answer"] == STOPPED:
                return Status.STOP_RULE
            if not steps.pending:
                if turning and second_derivatives_pay(run, worth):
                    turning, workspace = False, workspace.curved()
                    self._begin(run, workspace)
                calls = watch.calls(run.optimality.violation, run.tolerances.violation)
                if calls and settle(run, Status.STALLED) is Status.LOCALLY_INFEASIBLE:
                    return Status.LOCALLY_INFEASIBLE
                if run.status is not None:
                    break
                if alone and workspace.compiled:
                    rows = len(run.history)
                    begun = steps.go_on_alone(run, _budget(watch, rows if turning else 0))
                    failures = 0 if _noted(run, workspace, watch, rows, begun) else failures
                    if not steps.pending:
                        continue
            shift = max(now["next_damping"], now["missing"])
            qp = workspace.subproblem(run.lin, run.multipliers, shift) if workspace.exact else None
            answer = self._attempt(run, workspace, shift, qp)
            if answer is None and workspace.distrust():
                answer = self._attempt(run, workspace, shift, qp)
            if answer is None and qp is not None and qp.curved_by is not None:
                qp = qp.gauss_newton()
                answer = self._attempt(run, workspace, shift, qp)
            if workspace.elastic_asked and run.infeasible_stationary():
                if (ending := leave(run)) is not None:
                    return ending
                continue
            if answer is None:
                failures += 1
                now["next_damping"] = max(100.0 * now["next_damping"], 1e-4)
                if failures == FAILURES:
                    if (ending := resume(run, Status.STALLED)) is not None:
                        return ending
                    failures = 0
                    self._begin(run, workspace)
                continue
            failures = 0
            run.accept(
                steps.reached(),
                steps.work.multipliers.copy(),
                now["size"],
                now["length"],
                qp=answer.route,
                qp_iterations=answer.iterations,
                damping=shift,
                **({"correction": 1} if now["corrected"] == 1 else {}),
                **({"hessian": _kind(qp, answer)} if qp is not None else {}),
            )
            if run.status is None and rests(now["size"], run.optimality.violation, *rule):
                return Status.STOP_RULE
        return None

    def _begin(self, run: SolveState, workspace: Subproblems) -> None:
        """Begin at the present iterate, with nothing learned."""
        workspace.start(run.lin)
        workspace.steps.start(workspace.scaling, run.lin, run.multipliers)

    def _attempt(self, run: SolveState, workspace: Subproblems, shift: float, qp: QP | None) -> QPAnswer | None:
        """Solve the subproblem and search along its step; None when there is no answer or no length helps.

        Without ``qp`` the subproblem is Gauss-Newton's, and is put together where it is looked at.
        """
        steps, accuracy = workspace.steps, self._accuracy(run, workspace)
        curved = qp is not None and qp.curved_by is not None
        steps.pose(run.lin, run.multipliers, shift, accuracy, workspace.exact, curved)
        answer, good = steps.on_graph() if qp is None and workspace.compiled and run.program.sided else (None, False)
        if good:
            workspace.answered()
        else:
            qp = workspace.subproblem(run.lin, run.multipliers, shift) if qp is None else qp
            answer = workspace.solve(qp, run.multipliers, accuracy, answer)
            if not np.isfinite(answer.error):
                return None
            steps.along(answer)
        assert answer is not None

        def correct(bend: Array) -> QPAnswer | None:
            given = workspace.subproblem(run.lin, run.multipliers, shift) if qp is None else qp
            return workspace.correct(given, answer, bend, accuracy)

        return answer if steps.taken(correct) else None

    def _accuracy(self, run: SolveState, workspace: Subproblems) -> float:
        """Accuracy to ask of the QP."""
        smallest = workspace.scaling.smallest * min(1.0, run.optimality.slope)
        return useful_accuracy(workspace.exact, _size(run, workspace), self.tolerance, smallest)


def _budget(watch: RestorationTrigger, rows: int) -> int:
    """Steps until Python's rules may ask for something, which need ``rows`` of the history; 0 where none does."""
    return max(1, min(watch.left, LOGGED - 2, PATIENCE + 1 - rows if rows else LOGGED))


def _noted(run: SolveState, workspace: Subproblems, watch: RestorationTrigger, rows: int, begun: list[float]) -> bool:
    """Take note of what a compiled loop has done since there were ``rows``; whether it has taken a step.

    Args:
        run: the solve.
        workspace: its subproblems, which the graph has answered.
        watch: sees the iterates, for which it would not have called.
        rows: of the history before; at least that of the start.
        begun: violations of those from which another step was looked for.
    """
    for violation in begun:
        watch.calls(violation, run.tolerances.violation)
    if stepped := run.iterations >= rows:
        workspace.answered()
    return stepped


def _size(run: SolveState, workspace: Subproblems) -> float:
    """The largest KKT number of the present iterate, in scaled units."""
    program, scaling, measured = run.program, workspace.scaling, run.optimality
    if scaling.neutral:
        return kkt_size(*measured[:3], measured.slope)
    gradient = program.lagrangian_gradient(run.lin, run.multipliers)[program.columns.free]
    return max(
        largest(scaling.columns * gradient),
        largest(scaling.rows * program.violation(run.lin.constraints)),
        min(1.0, measured.slope) * measured.complementarity,
    )


def _kind(qp: QP, answer: QPAnswer) -> str:
    """Kind of Hessian a step was found with."""
    if qp.curved_by is None or answer.route == "elastic":
        return "gauss-newton"
    return "exact" if qp.weights is None else "exact, with squares"
