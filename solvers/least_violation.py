"""Where a solve ends that cannot meet its constraints: the nearest point that violates them least.

A merit function or an elastic problem stalls at a point that is stationary for its own measure of violation. From
there a damped Newton method on 1/2 |violation|^2 finds a point that is stationary for the measure of
:func:`unifg.kkt.infeasible_stationary`, within the bounds of the unknowns, or a feasible one; then nothing is proved.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from unifg.kkt import blocked, infeasible_stationary
from unifg.linearization import Linearization
from unifg.passes import add_constraints
from unifg.program import Program
from unifg.second_order import constraint_curvature
from unifg.solver import Run
from unifg.solvers.damping import largest
from unifg.status import Status
from unifg.typing import Array, BoolArray

STEPS = 200
FIRST_DAMPING, LARGEST_DAMPING, GROWTH, SHRINK = 1e-3, 1e10, 4.0, 0.2
FLOOR = 1e-6  # of the largest diagonal entry: unknowns that no violated row touches
PROGRESS = 1e-12  # smallest relative decrease that counts; below it, the gradient has to halve
ROUNDING = 1e-14
ASIDE = 1e-3  # standard deviation of the tangent step off a point that may be a saddle
LESS = 1e-4  # relative decrease that tells a saddle from a minimum in a flat valley


def settle(run: Run, status: Status) -> Status:
    """End a solve that stalled: LOCALLY_INFEASIBLE at the point of least violation, else ``status`` where it is."""
    if run.status is not None or run.optimality.violation <= run.tolerance:
        return status
    found = run.lin
    if not run.infeasible_stationary():
        found = least_violation(run.program, run.lin, run.tolerance, lambda: run.out_of_time)
    while infeasible_stationary(run.program, found, run.tolerance):
        run.begin_at(found)
        lower = _downhill(run, found)
        if lower is None:
            run.status = Status.LOCALLY_INFEASIBLE
            return run.status
        found = lower
    return status


def leave(run: Run) -> Status | None:
    """Where the violation is stationary: LOCALLY_INFEASIBLE, or None once the iterate was moved off a saddle."""
    found = _downhill(run, run.lin)
    if found is None:
        return Status.LOCALLY_INFEASIBLE
    run.begin_at(found)
    return run.status


def _downhill(run: Run, lin: Linearization) -> Linearization | None:
    """A point that violates less, looked for from beside a stationary one; None at a minimum."""
    program = run.program
    aside = ASIDE * np.random.default_rng(0).standard_normal(program.size)
    beside = program.linearize(program.retract(lin.values, aside))
    if not beside.finite:
        return None
    found = least_violation(program, beside, run.tolerance, lambda: run.out_of_time)
    here, there = ((program.violation(at.constraints) ** 2).sum() for at in (lin, found))
    return found if found.finite and there < (1.0 - LESS) * here else None


def least_violation(
    program: Program, lin: Linearization, tolerance: float, out_of_time: Callable[[], bool] = lambda: False
) -> Linearization:
    """Descend on the violation until it is stationary, gone, or nothing helps.

    Unknowns at a bound that holds them back are held there for the step.

    Args:
        program: the compiled graph.
        lin: where to begin.
        tolerance: largest violation that counts as none.
        out_of_time: asked before every step whether to end where it is.
    """
    solver, normal = program.normal_solver(), program.normal
    columns = np.repeat(np.arange(program.size), np.diff(normal.indptr))
    lin = program.linearize(program.within_bounds(lin.values))
    damping = FIRST_DAMPING
    for _ in range(STEPS):
        outside = program.violation(lin.constraints)
        if np.abs(outside).max(initial=0.0) <= tolerance or infeasible_stationary(program, lin, tolerance):
            return lin
        if out_of_time():
            return lin
        # What the violated rows bend matters: the least violation is not small.
        entries = constraint_curvature(program, lin, outside)
        counted = (outside != 0.0) | program.equality
        add_constraints(program.arrays, lin.constraint_jacobian, counted.astype(np.float64), entries)
        pull, held = _pull(program, lin)
        entries[held[normal.indices] | held[columns]] = 0.0
        size, value = np.abs(entries[normal.diagonal]), float(outside @ outside)
        size = np.maximum(size, FLOOR * size.max(initial=1.0))
        while damping <= LARGEST_DAMPING:
            damped = entries.copy()
            damped[normal.diagonal] += damping * size
            if solver.factor(damped):
                values = program.within_bounds(program.retract(lin.values, -solver.solve(pull)))
                trial = program.evaluate(values)
                there = float((program.violation(trial.constraints) ** 2).sum()) if trial.finite else np.inf
                if there < (1.0 - PROGRESS) * value:
                    break
                if there <= (1.0 + ROUNDING) * value:
                    after, _ = _pull(program, program.linearize(values))
                    if largest(after) <= 0.5 * largest(pull):
                        break
            damping *= GROWTH
        else:
            return lin
        lin = program.linearize(values)
        damping *= SHRINK
    return lin


def _pull(program: Program, lin: Linearization) -> tuple[Array, BoolArray]:
    """(n,) gradient of 1/2 |violation|^2, zero for unknowns that a bound holds back, and which those are."""
    outside = program.violation(lin.constraints)
    pull = program.constraints.transposed_times(lin.constraint_jacobian, outside)[program.columns.free]
    held = np.zeros(program.size, dtype=bool)
    held[blocked(program, lin.constraints, pull)] = True
    pull[held] = 0.0
    return pull, held
