"""Where a solve ends that cannot meet its constraints: the nearest point that violates them least.

A merit function or an elastic problem stalls at a point that is stationary for its own measure of violation. From
there a damped Newton method on 1/2 |violation|^2 finds a point that is stationary for the measure of
:func:`unifg.kkt.infeasible_stationary`, within the bounds of the unknowns, or a feasible one; then nothing is proved.
"""

from __future__ import annotations

import numpy as np

from unifg.kkt import blocked, infeasible_stationary
from unifg.linearization import Linearization
from unifg.passes import add_constraints
from unifg.program import Program
from unifg.second_order import lagrangian_hessian
from unifg.solver import Run
from unifg.status import Status

STEPS = 200
FIRST_DAMPING, LARGEST_DAMPING, GROWTH, SHRINK = 1e-3, 1e10, 4.0, 0.2
FLOOR = 1e-6  # of the largest diagonal entry: unknowns that no violated row touches
PROGRESS = 1e-12  # smallest relative decrease that counts


def settle(run: Run, status: Status) -> Status:
    """End a solve that stalled: LOCALLY_INFEASIBLE at the point of least violation, else ``status`` where it is."""
    if run.status is not None or run.optimality.violation <= run.tolerance:
        return status
    found = least_violation(run.program, run.lin, run.tolerance)
    if not infeasible_stationary(run.program, found, run.tolerance):
        return status
    run.begin_at(found)
    run.status = Status.LOCALLY_INFEASIBLE
    return run.status


def least_violation(program: Program, lin: Linearization, tolerance: float) -> Linearization:
    """Descend on the violation until it is stationary, gone, or nothing helps.

    Unknowns at a bound that holds them back are held there for the step.

    Args:
        program: the compiled graph.
        lin: where to begin.
        tolerance: largest violation that counts as none.
    """
    solver, free, normal = program.normal_solver(), program.columns.free, program.normal
    columns = np.repeat(np.arange(program.size), np.diff(normal.indptr))
    lin = program.linearize(program.within_bounds(lin.values))
    damping = FIRST_DAMPING
    for _ in range(STEPS):
        outside = program.violation(lin.constraints)
        if np.abs(outside).max(initial=0.0) <= tolerance or infeasible_stationary(program, lin, tolerance):
            return lin
        # What the violated rows bend matters: the least violation is not small.
        entries = lagrangian_hessian(program, lin, outside) - lagrangian_hessian(program, lin, np.zeros(len(outside)))
        add_constraints(program.arrays, lin.constraint_jacobian, (outside != 0.0).astype(np.float64), entries)
        pull = program.constraints.transposed_times(lin.constraint_jacobian, outside)[free]
        held = np.zeros(program.size, dtype=bool)
        held[blocked(program, lin.constraints, pull)] = True
        pull[held] = 0.0
        entries[held[normal.indices] | held[columns]] = 0.0
        size, value = np.abs(entries[normal.diagonal]), float(outside @ outside)
        size = np.maximum(size, FLOOR * size.max(initial=1.0))
        while damping <= LARGEST_DAMPING:
            damped = entries.copy()
            damped[normal.diagonal] += damping * size
            if solver.factor(damped):
                values = program.within_bounds(program.retract(lin.values, -solver.solve(pull)))
                trial = program.evaluate(values)
                if trial.finite and float((program.violation(trial.constraints) ** 2).sum()) < (1.0 - PROGRESS) * value:
                    break
            damping *= GROWTH
        else:
            return lin
        lin = program.linearize(values)
        damping *= SHRINK
    return lin
