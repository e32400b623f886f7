"""Primal-dual interior point on the graph: hard inequalities from bad guesses, one elimination per iteration.

The method is in :mod:`unifg.solvers.interior_point.barrier`; this file runs it. A graph whose terms all have kernels is
solved by one compiled loop; with batched NumPy terms, or a callback per iteration, the same functions are called from
Python.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from unifg.answers.history import Iteration
from unifg.answers.solver import Solver, SolveState
from unifg.answers.status import Status
from unifg.errors import BackendError
from unifg.machine.buffers import Block
from unifg.machine.links import memory
from unifg.program.curvature import lagrangian_hessian
from unifg.program.linearization import Linearization
from unifg.program.program import Program
from unifg.program.systems import stacked
from unifg.program.table import COST, COUNT, KIND, ROW, ROWS
from unifg.solvers.globalize.least_violation import nearest
from unifg.solvers.interior_point import state
from unifg.solvers.interior_point.loop import addresses, call
from unifg.solvers.interior_point.state import Fields, Problem, empty_work
from unifg.typing import Array, IntArray

ENDINGS = {
    state.CONVERGED: Status.CONVERGED,
    state.LIMIT_REACHED: Status.ITERATION_LIMIT,
    state.SINGULAR: Status.SINGULAR,
    state.STALLED: Status.STALLED,
    state.NOT_FINITE: Status.NOT_FINITE,
    state.VIOLATED: Status.STALLED,
    state.STOPPED: Status.STOP_RULE,
    state.TRY: Status.TIME_LIMIT,  # there was no time for the step
}
ANSWER = ("residual", "jacobian", "constraints", "constraint_jacobian", "gradient", "hessian")  # of `Work`
NO_ANSWER = -1
STUCK = (state.STALLED, state.SINGULAR, state.VIOLATED)
RESTARTS = 3  # from points that violate less than where the method came to a halt


@dataclass(kw_only=True)
class InteriorPoint(Solver):
    """Equalities, inequalities and general costs by a primal-dual interior point with elastic inequalities.

    Attributes:
        max_iterations: Newton steps before giving up.
        hessian: "exact" (of the Lagrangian; Gauss-Newton where its inertia is wrong) or "gauss-newton".
        barrier: first mu of a cold start; a start with multipliers finds its own.
        price: first rho of the elastic variables; raised when constraints stay violated.
        scaling: measure rows and unknowns in units that make the largest entries of the constraint Jacobian near one,
            where they are far from it, and prices and mu in proportion to a large gradient. Inside only: tolerances and
            multipliers are those of the problem as stated.
        step_tolerance, violation_tolerance: stop rule on the norm of the full step and the largest violation, for
            control loops. A positive step_tolerance switches it on; it does not grant CONVERGED. An infinite one asks
            for a single step, and more of them only as long as constraints are violated. With the rule on, a solve
            that runs out of time or iterations hands back the last iterate that kept the constraints, if one did.
    """

    max_iterations: int = 300
    hessian: Literal["exact", "gauss-newton"] = "exact"
    barrier: float = 0.3
    price: float = 1e3
    scaling: bool = True
    step_tolerance: float = 0.0
    violation_tolerance: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse options that mean nothing."""
        super().__post_init__()
        if self.hessian not in ("exact", "gauss-newton"):
            raise BackendError(f"{self.name}: hessian must be 'exact' or 'gauss-newton', found '{self.hessian}'")
        for name, value in (("barrier", self.barrier), ("price", self.price)):
            if not value > 0.0:
                raise BackendError(f"{self.name}: {name} must be positive, found {value}")

    def runs_alone(self, program: Program) -> bool:
        """Whether a compiled loop can make the whole solve; that of least squares is tested outside, at every step."""
        return program.fully_compiled and not program.least_squares

    def workspace(self, program: Program) -> Workspace:
        """Structure of the KKT matrix."""
        return Workspace(program)

    def iterate(self, run: SolveState, workspace: Workspace) -> Status | None:
        """Iterate to convergence; where that is not to be had, to a point of least violation, or on from another."""
        reason = self._iterate(run, workspace)
        now = workspace.now
        if self.step_tolerance > 0.0 and now["kept"] and run.optimality.violation > now["keeping"]:
            ending = run.status or reason
            if ending in (Status.TIME_LIMIT, Status.ITERATION_LIMIT):  # what kept the constraints may be acted on
                run.begin_at(run.program.linearize(run.program.columns.view(workspace.work.kept.copy())))
                run.status = ending
        return reason

    def _iterate(self, run: SolveState, workspace: Workspace) -> Status | None:
        now = workspace.prepare(run, self)
        restarts = 0
        while True:
            reason = self._alone(run, workspace) if run.alone else self._guided(run, workspace)
            if now["answer"] not in STUCK or run.status not in (None, Status.ITERATION_LIMIT):
                return reason
            if run.optimality.violation <= run.tolerance:
                return reason
            found = run.lin
            if not run.has_been_feasible:
                found, least = nearest(run)
                if least:
                    run.begin_at(found)
                    run.status = Status.LOCALLY_INFEASIBLE
                    return run.status
            if restarts == RESTARTS or now["iteration"] >= self.max_iterations or run.out_of_time:
                return reason
            if now["answer"] == state.VIOLATED:  # the price was too low
                now["going_on"] = 1
            elif run.has_been_feasible or _largest(run.program.violation(found.constraints)) <= run.tolerance:
                workspace.begin_at(run.least_violated.flat if run.has_been_feasible else found.values.flat, self)
                restarts += 1
            else:
                return reason
            run.status = None

    def _alone(self, run: SolveState, workspace: Workspace) -> Status:
        """The compiled loop."""
        work, now = workspace.work, workspace.now

        def out_of_time() -> bool:
            run.iterations = now["iteration"]
            return run.out_of_time

        interrupted = workspace.loop(out_of_time)
        lin, iterations = workspace.found(), now["iteration"]
        log = work.log[: iterations + 1].copy()
        if now["kept"] and now["violation"] > run.tolerance:
            run.begin_at(run.program.linearize(run.program.columns.view(work.kept.copy())))
        run.conclude(lin, work.multipliers.copy(), iterations, _history(log, lin.norms, run.seconds))
        ending = ENDINGS[now["answer"]]
        if interrupted:
            run.status = ending if ending is Status.CONVERGED else Status.INTERRUPTED
        return ending

    def _guided(self, run: SolveState, workspace: Workspace) -> Status | None:
        """The same loop, with every evaluation made by the program and every iterate shown."""
        program, work, now = run.program, workspace.work, workspace.now
        lin = run.lin
        if not np.array_equal(lin.values.flat, work.values):
            run.begin_at(program.linearize(program.columns.view(work.values.copy())))
            lin = run.lin
            if run.status is not None:
                return None
        workspace.take(lin)
        workspace.call("measure" if now["going_on"] else "begin")
        while True:
            workspace.call("test")
            if now["answer"] == state.TRY:
                if self.hessian == "exact":
                    work.curvature[:] = lagrangian_hessian(program, lin, work.multipliers)
                workspace.call("direct")
            while now["answer"] == state.TRY:
                values = program.retract(lin.values, now["alpha"] * work.step[: program.size])
                found = program.evaluate(values, lin.weights)
                now["trial_cost"], work.trial_constraints[:] = found.cost, found.constraints
                workspace.call("judge")
            if now["answer"] == state.AGAIN:
                if run.out_of_time:
                    return Status.TIME_LIMIT
                continue
            if now["answer"] != state.ACCEPTED:
                return ENDINGS[now["answer"]]
            lin = program.linearize(values)
            workspace.take(lin)
            workspace.call("measure")
            details = _details(now["mu"], now["delta"], now["gauss_newton"])
            run.accept(lin, work.multipliers.copy(), now["step"], now["taken"], **details)
            if run.status is not None:
                return None


class Workspace:
    """What is kept between solves of one structure."""

    def __init__(self, program: Program) -> None:
        """Analyse the KKT matrix and compile."""
        self.program = program
        self._build(1)

    def _build(self, iterations: int) -> None:
        program = self.program
        self.system = program.systems.kkt(program.equality)
        arrays, table = self.system.arrays, program.table
        plan, doubles = stacked(arrays)
        equalities, constraints = len(arrays.rows), table.constraints
        self.work = empty_work(
            stored=program.columns.stored,
            width=program.columns.width,
            unknowns=program.size,
            equalities=max(equalities, 1),
            total=program.size + equalities,
            residuals=table.residuals,
            entries=table.entries,
            rows=constraints,
            row_entries=table.constraint_entries,
            sides=max(2 * constraints, 1),
            normal=program.normal.nnz,
            terms=len(program.arrays.fields),
            robust=table.weights,
            log=iterations + 2,
            data=len(plan.slots),
        )
        self._answer = Block([len(getattr(self.work, name)) for name in ANSWER])
        answer: dict[str, Any] = dict(zip(ANSWER, self._answer.arrays, strict=True))
        self.work = self.work._replace(**answer)
        self.problem = Problem(
            np.zeros(1, state.LINKS),
            program.arrays,
            plan,
            program.retraction.parts,
            program.columns.free,
            program.scratch,
            arrays.rows,
            arrays.entries,
            doubles,
            np.array([self._unequal(row) for row in program.arrays.fields], dtype=np.int64),
        )
        self._describe()
        self.problem.links[:] = addresses()
        self._held = program.equality
        self._links, self.now = Fields(self.problem.links), Fields(self.work.scalars)

    def _unequal(self, term: IntArray) -> bool:
        """Whether a row of the table is a term with inequality rows."""
        rows = slice(term[ROW], term[ROW] + term[COUNT] * term[ROWS])
        return term[KIND] != COST and not self.program.equality[rows].all()

    def _describe(self) -> None:
        """Tell compiled code where the arrays are."""
        self._words = memory.describe((self.problem, self.work))
        self._address = self._words.ctypes.data

    def call(self, function: str) -> None:
        """Run one of the linked functions."""
        call(self._links[function], self._address)

    def loop(self, out_of_time: Callable[[], bool]) -> bool:
        """Run the whole solve; returns whether control-C was pressed, which Python learns when it is over.

        Args:
            out_of_time: asked before every step, if there is a limit.

        Raises:
            KeyboardInterrupt: when it was pressed before the solve had begun.
        """
        self.now["answer"] = NO_ANSWER
        try:
            self.call("loop")
            while self.now["answer"] == state.TRY and not out_of_time():
                self.call("loop")
        except KeyboardInterrupt:
            if self.now["answer"] == NO_ANSWER:
                raise
            return True
        return False

    def prepare(self, run: SolveState, options: InteriorPoint) -> Fields:
        """Set up one solve with the present data; returns the scalars."""
        if self.program.equality is not self._held:  # which is a new array when limits have changed
            if not np.array_equal(self.program.equality, self.system.held):
                self._build(options.max_iterations)
            self._held = self.program.equality
        if len(self.work.log) < options.max_iterations + 2:
            self.work = self.work._replace(log=np.zeros((options.max_iterations + 2, 9)))
            self._describe()
        work, now = self.work, self.now
        # The test of least squares has no absolute tolerance.
        now["tolerance"] = 0.0 if run.program.least_squares else run.tolerance
        now["asked"], now["scaling"] = 0.0, bool(options.scaling)
        now["step_tolerance"] = options.step_tolerance
        now["violation_tolerance"], now["clocked"] = options.violation_tolerance, options.time_limit < np.inf
        now["keeping"] = max(run.tolerance, options.violation_tolerance if options.step_tolerance > 0.0 else 0.0)
        now["iteration"], now["kept"], now["raises"] = 0, 0, 0
        work.row_units[:] = work.units[:] = 1.0
        now["limit"], now["exact"] = options.max_iterations, options.hessian == "exact"
        self.begin_at(run.values.flat, options)
        work.multipliers[:] = run.multipliers
        return now

    def begin_at(self, values: Array, options: InteriorPoint) -> None:
        """Go on from other values, about whose multipliers nothing is known."""
        work, now = self.work, self.now
        work.values[:], work.multipliers[:] = values, 0.0
        now["mu"], now["going_on"] = options.barrier, 0
        now["rho"] = options.price * 10.0 ** now["raises"]

    def found(self) -> Linearization:
        """The linearisation at which the compiled loop ended."""
        program, work = self.program, self.work
        values = program.columns.view(work.values.copy())
        program.retraction.fix(values)
        residual, jacobian, constraints, rows, gradient, hessian = self._answer.copied()
        return Linearization(
            values,
            self.now["cost"],
            residual,
            jacobian,
            constraints,
            rows,
            gradient,
            hessian,
            program.norms(work.norms),
            work.weights.copy(),
            squares=work.squares.copy(),
        )

    def take(self, lin: Linearization) -> None:
        """Copy a linearisation to where the compiled functions look for it."""
        work = self.work
        self.now["cost"], work.values[:] = lin.cost, lin.values.flat
        work.residual[:], work.jacobian[:] = lin.residual, lin.jacobian
        work.constraints[:], work.constraint_jacobian[:] = lin.constraints, lin.constraint_jacobian
        work.gradient[:], work.hessian[:] = lin.gradient, lin.hessian


def _history(log: Array, norms: dict[str, float], seconds: float) -> Callable[[], list[Iteration]]:
    """Rows of the compiled loop, made when somebody asks for them; nobody took the time of single iterations."""

    def rows() -> list[Iteration]:
        last, made = len(log) - 1, []
        for number, row in enumerate(log.tolist()):
            cost, stationarity, violation, complementarity, step, length, *details = row
            kkt = stationarity, violation, complementarity
            taken, terms = (seconds, _details(*details)) if number else (0.0, {})
            own = norms if number == last else {}
            made.append(Iteration(number, cost, *kkt, step, length, taken, own, terms))
        return made

    return rows


def _largest(violation: Array) -> float:
    return float(np.abs(violation).max(initial=0.0))


def _details(mu: float, delta: float, gauss_newton: float) -> dict[str, float | int | str]:
    """What a row of the history shows beside the KKT numbers."""
    details: dict[str, float | int | str] = {"mu": float(mu)}
    if delta:
        details["shift"] = float(delta)
    if gauss_newton:
        details["gauss_newton"] = 1
    return details
