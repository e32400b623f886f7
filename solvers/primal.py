"""What least-squares and augmented-Lagrangian backends share: merit, gradient and damped Gauss-Newton direction.

Both descend on f(x) + sum of Powell-Hestenes-Rockafellar terms (:mod:`unifg.solvers.phr`); without constraints that
is f itself.
"""

from __future__ import annotations

import numpy as np

from unifg.columns import Values
from unifg.linearization import Evaluation, Linearization
from unifg.program import Program
from unifg.solvers.phr import barrier, update
from unifg.typing import Array

DIAGONAL_FLOOR = 1e-9  # of the largest diagonal entry: damping must act on unknowns with little curvature too


class Primal:
    """Merit, gradient and Gauss-Newton direction of the augmented objective.

    Attributes:
        program: the compiled graph.
        solver: factorisation of the normal equations.
        damping: what was added to the diagonal of the matrix factorised last, relative to it.
    """

    def __init__(self, program: Program) -> None:
        """Analyse the structure of the normal equations."""
        self.program = program
        self.solver = program.normal_solver()
        self.damping = 0.0

    def next_multipliers(self, constraints: Array, multipliers: Array, penalty: Array) -> Array:
        """(M,) lambda+: the first-order dual update, zero for inactive rows."""
        after = np.empty(len(multipliers))
        update(constraints, self.program.lower, self.program.upper, multipliers, penalty, after)
        return after

    def merit(self, point: Evaluation | Linearization, multipliers: Array, penalty: Array) -> float:
        """Augmented objective."""
        program = self.program
        return point.cost + float(barrier(point.constraints, program.lower, program.upper, multipliers, penalty))

    def gradient(self, lin: Linearization, multipliers: Array, penalty: Array) -> Array:
        """Gradient of the augmented objective over the unknowns."""
        after = self.next_multipliers(lin.constraints, multipliers, penalty)
        return self.program.lagrangian_gradient(lin, after)[self.program.columns.free]

    def curvature(self, lin: Linearization, multipliers: Array, penalty: Array) -> Array:
        """Gauss-Newton Hessian entries J'J + A' diag(rho, active rows) A."""
        after = self.next_multipliers(lin.constraints, multipliers, penalty)
        active = self.program.equality | (after != 0.0)
        return self.program.normal_entries(lin, np.where(active, penalty, 0.0))

    def direction(self, curvature: Array, gradient: Array) -> Array | None:
        """Solve H d = -gradient; None when the matrix cannot be factorised."""
        self.damping = 0.0
        if not self.solver.factor(curvature):
            return None
        step = -self.solver.solve(gradient)
        return step if np.isfinite(step).all() else None

    def trial(self, lin: Linearization, step: Array) -> tuple[Values, Evaluation]:
        """Values after ``step`` and what they cost, with the weights of ``lin`` held."""
        values = self.program.retract(lin.values, step)
        return values, self.program.evaluate(values, lin.weights)
