"""Primal-dual interior point on the graph: hard inequalities from bad guesses, one elimination per iteration.

The method is in :mod:`unifg.solvers.barrier`; this file runs it. A graph whose terms all have kernels is solved by one
compiled loop; with batched NumPy terms, or a callback per iteration, the same functions are called from Python.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg import passes
from unifg.curvature import add_curvature
from unifg.elimination.threads import one_thread
from unifg.errors import BackendError
from unifg.jit import compiled
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.retraction import retract_parts
from unifg.second_order import lagrangian_hessian
from unifg.solver import Run, Solver
from unifg.solvers import barrier
from unifg.solvers import barrier_state as state
from unifg.solvers.barrier_state import Iterate, Work, empty_work
from unifg.solvers.kkt_system import KktArrays, KktSystem
from unifg.status import Status
from unifg.table import Terms
from unifg.typing import Array, IntArray

ENDINGS = {
    state.CONVERGED: Status.CONVERGED,
    state.LIMIT_REACHED: Status.ITERATION_LIMIT,
    state.SINGULAR: Status.SINGULAR,
    state.STALLED: Status.STALLED,
    state.NOT_FINITE: Status.NOT_FINITE,
}


@dataclass(kw_only=True)
class InteriorPoint(Solver):
    """Equalities, inequalities and general costs by a primal-dual interior point with elastic inequalities.

    Attributes:
        max_iterations: Newton steps before giving up.
        hessian: "exact" (of the Lagrangian; Gauss-Newton where its inertia is wrong) or "gauss-newton".
        barrier: first mu of a cold start; a start with multipliers finds its own.
        price: first rho of the elastic variables; raised when inequalities stay violated.
    """

    max_iterations: int = 300
    hessian: Literal["exact", "gauss-newton"] = "exact"
    barrier: float = 0.1
    price: float = 1e3

    def __post_init__(self) -> None:
        """Refuse options that mean nothing."""
        super().__post_init__()
        if self.hessian not in ("exact", "gauss-newton"):
            raise BackendError(f"{self.name}: hessian must be 'exact' or 'gauss-newton', found '{self.hessian}'")
        for name, value in (("barrier", self.barrier), ("price", self.price)):
            if not value > 0.0:
                raise BackendError(f"{self.name}: {name} must be positive, found {value}")

    def workspace(self, program: Program) -> Workspace:
        """Structure of the KKT matrix."""
        return Workspace(program)

    def iterate(self, run: Run, workspace: Workspace) -> Status | None:
        """Iterate to convergence."""
        work = workspace.prepare(run, self)
        kkt = workspace.system.arrays
        program = run.program
        at = workspace.iterate_of(run.lin, work, self)
        barrier.begin(program.arrays, kkt, work, at, bool(np.any(run.multipliers)))
        with one_thread():
            if workspace.compiled and not run.watched:
                flat = run.values.flat.copy()
                code = _loop(
                    program.arrays, program.retraction.parts, program.columns.free, kkt, work, at, flat, program.scratch
                )
                values = program.columns.view(flat)
                lin = program.linearize(values)
                run.conclude(lin, work.multipliers.copy(), _rows(work))
                return ENDINGS[code]
            return self._guided(run, workspace, work, at)

    def _guided(self, run: Run, workspace: Workspace, work: Work, at: Iterate) -> Status | None:
        """The same loop, with every evaluation made by the program and every iterate shown."""
        program, kkt = run.program, workspace.system.arrays
        step = np.empty(program.size)
        lin = run.lin
        while True:
            code = barrier.newton(program.arrays, kkt, work, at)
            if code != state.TRY:
                return ENDINGS[code]
            while code == state.TRY:
                barrier.trial_step(work, step)
                values = program.retract(lin.values, step)
                found = program.evaluate(values, lin.weights)
                code = barrier.judge(program.arrays, kkt, work, at, found.cost, found.constraints)
            if code == state.STALLED:
                return Status.STALLED
            if code == state.AGAIN:
                continue
            lin = program.linearize(values)
            at = workspace.iterate_of(lin, work, self)
            barrier.safeguard(work, at.constraints)
            barrier.measure(program.arrays, kkt, work, at)
            numbers = work.numbers
            run.accept(
                lin,
                work.multipliers.copy(),
                float(numbers[state.STEP]),
                float(numbers[state.TAKEN]),
                **_details(numbers[state.MU], numbers[state.DELTA], work.counts[state.GAUSS_NEWTON]),
            )
            if run.status is not None:
                return None


class Workspace:
    """What is kept between solves of one structure."""

    def __init__(self, program: Program) -> None:
        """Analyse the KKT matrix."""
        self.program = program
        self.system = KktSystem(program, program.equality)
        self.compiled = program.fully_compiled
        self._numbers = self._arrays(1)

    def _arrays(self, iterations: int) -> dict[str, Array]:
        program, system = self.program, self.system
        return empty_work(
            program.size + int(system.arrays.size[1]),
            program.constraints.count,
            program.columns.width,
            system.pattern.nnz,
            program.normal.nnz,
            iterations,
        )

    def prepare(self, run: Run, options: InteriorPoint) -> Work:
        """Arrays for one solve, with the sides that the present limits have."""
        program = self.program
        if not np.array_equal(program.equality, self.system.equality):
            self.system = KktSystem(program, program.equality)
            self._numbers = self._arrays(1)
        if len(self._numbers["log"]) < options.max_iterations + 2:
            self._numbers["log"] = np.zeros((options.max_iterations + 2, 9))
        lower, upper = program.lower, program.upper
        below = np.flatnonzero(np.isfinite(lower) & ~program.equality)
        above = np.flatnonzero(np.isfinite(upper) & ~program.equality)
        rows = np.concatenate([below, above])
        sides = len(rows)
        numbers = np.zeros(state.FLOATS)
        numbers[state.MU], numbers[state.RHO] = options.barrier, options.price
        numbers[state.TOLERANCE] = run.tolerance
        largest = float(np.abs(run.multipliers).max(initial=0.0))
        if largest > 0.5 * options.price:
            numbers[state.RHO] = 10.0 * largest
        counts = np.zeros(state.INTEGERS, dtype=np.int64)
        counts[state.LIMIT], counts[state.EXACT] = options.max_iterations, options.hessian == "exact"
        return Work(
            numbers=numbers,
            counts=counts,
            side_row=rows,
            side_sign=np.repeat([1.0, -1.0], [len(below), len(above)]),
            side_limit=np.concatenate([lower[below], upper[above]]),
            y=np.zeros(sides),
            dy=np.zeros(sides),
            s=np.zeros(sides),
            e=np.zeros(sides),
            multipliers=run.multipliers.copy(),
            free=program.columns.free,
            **self._numbers,
        )

    def iterate_of(self, lin: Linearization, work: Work, options: InteriorPoint) -> Iterate:
        """A linearisation as the compiled functions take it."""
        curvature = lin.hessian
        if options.hessian == "exact":
            curvature = lagrangian_hessian(self.program, lin, work.multipliers)
        return Iterate(
            np.array([lin.cost]),
            lin.residual,
            lin.jacobian,
            lin.constraints,
            lin.constraint_jacobian,
            lin.gradient.copy(),
            lin.hessian,
            curvature,
        )


def _rows(work: Work) -> list[tuple[Array, dict[str, float | int | str]]]:
    """History rows of the compiled loop: the numbers of an iteration and what the backend adds."""
    count = int(work.counts[state.ITERATION]) + 1
    return [(row[:6], _details(row[6], row[7], row[8])) for row in work.log[1:count].copy()]


def _details(mu: float, delta: float, gauss_newton: float) -> dict[str, float | int | str]:
    """What a row of the history shows beside the KKT numbers."""
    details: dict[str, float | int | str] = {"mu": float(mu)}
    if delta:
        details["shift"] = float(delta)
    if gauss_newton:
        details["gauss_newton"] = 1
    return details


@compiled
def _loop(
    terms: Terms,
    parts: IntArray,
    free: IntArray,
    kkt: KktArrays,
    work: Work,
    at: Iterate,
    values: Array,
    scratch: Array,
) -> int:
    """The whole solve; ``values`` and ``at`` are moved."""
    step, full, trial = np.empty(len(free)), np.empty(len(terms.unknown)), values.copy()
    residual, constraints = np.empty_like(at.residual), np.empty_like(at.constraints)
    norms, squares = np.empty(len(terms.fields)), np.empty(1)
    exact = work.counts[state.EXACT] == 1
    while True:
        code = barrier.newton(terms, kkt, work, at)
        if code != state.TRY:
            return code
        while code == state.TRY:
            barrier.trial_step(work, step)
            trial[:] = values
            full[:] = 0.0
            retract_parts(parts, free, step, full, values, trial)
            cost = passes.evaluate(terms, trial, residual, constraints, squares, scratch)
            code = barrier.judge(terms, kkt, work, at, cost, constraints)
        if code == state.STALLED:
            return code
        if code == state.AGAIN:
            continue
        values[:] = trial
        at.gradient[:] = 0.0
        at.hessian[:] = 0.0
        at.cost[0] = passes.linearize(
            terms,
            values,
            False,
            at.residual,
            at.jacobian,
            at.constraints,
            at.constraint_jacobian,
            squares,
            norms,
            at.gradient,
            at.hessian,
            scratch,
        )
        barrier.safeguard(work, at.constraints)
        if exact:
            barrier.measure(terms, kkt, work, at)
            at.curvature[:] = at.hessian
            add_curvature(terms, values, at.residual, work.multipliers, at.curvature)
