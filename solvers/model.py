"""The subproblem of a primal step, solved to its end.

With residuals and constraints linearised, the augmented objective is convex and piecewise quadratic: a row of an
inequality joins or leaves as the step grows. Newton steps that update the active rows, with a line search, find
its minimum in a few factorisations and without any new evaluation of the problem. A single Gauss-Newton step
would freeze the active rows at the linearisation point and overshoot every limit it runs into.
"""

from __future__ import annotations

import numpy as np

from unifg.linearization import Linearization
from unifg.solvers.primal import Primal
from unifg.typing import Array

NEWTON_STEPS = 12
SHORTEST = 1e-3
ARMIJO = 0.1
ROUNDING = 1e-14


def model_step(
    primal: Primal, lin: Linearization, multipliers: Array, penalty: Array, damping: float
) -> tuple[Array, float] | None:
    """Minimise the damped model.

    Args:
        primal: the augmented objective and its factorisation.
        lin: where the model is built.
        multipliers: (M,) of the augmented objective.
        penalty: (M,) rho of every row.
        damping: relative to the diagonal of the Gauss-Newton Hessian at ``lin``.

    Returns:
        The tangent step and the decrease the model predicts; None when a system cannot be factorised.
    """
    program = primal.program
    residual, constraints = lin.residual, lin.constraints
    step = np.zeros(program.size)
    added: Array | None = None
    active = primal.active(constraints, multipliers, penalty)
    start = value = 0.5 * float(residual @ residual) + primal.barrier(constraints, multipliers, penalty)
    for _ in range(NEWTON_STEPS):
        after = primal.next_multipliers(constraints, multipliers, penalty)
        gradient = program.costs.transposed_times(lin.jacobian, residual)
        if program.constraints.count:
            gradient += program.constraints.transposed_times(lin.constraint_jacobian, after)
        gradient = gradient[program.columns.free]
        curvature = program.normal_entries(lin, np.where(active, penalty, 0.0))
        if added is None:
            added = primal.damping_diagonal(curvature, damping)
        gradient += added * step
        move = primal.direction(curvature, gradient, added)
        if move is None:
            return None
        residual_move = program.costs.times(lin.jacobian, move)
        constraint_move = program.constraints.times(lin.constraint_jacobian, move)
        slope, length = float(gradient @ move), 1.0
        while True:
            here = step + length * move
            residual_here = residual + length * residual_move
            constraints_here = constraints + length * constraint_move
            value_here = (
                0.5 * float(residual_here @ residual_here)
                + 0.5 * float(here @ (added * here))
                + primal.barrier(constraints_here, multipliers, penalty)
            )
            if value_here <= value + ARMIJO * length * slope + ROUNDING * abs(value) or length < SHORTEST:
                break
            length *= 0.5
        step, residual, constraints, value = here, residual_here, constraints_here, value_here
        before, active = active, primal.active(constraints, multipliers, penalty)
        if length == 1.0 and np.array_equal(before, active):
            break
    return step, start - value
