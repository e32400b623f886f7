"""The step least-squares and augmented-Lagrangian backends share.

Both descend on f(x) + sum of Powell-Hestenes-Rockafellar terms; without constraints that is f itself. The PHR
term of a row with multiplier lambda and penalty rho is (lambda+^2 - lambda^2) / (2 rho), where lambda+ is the
multiplier the dual step would produce. An inactive inequality contributes nothing (Bazzana's eq. 19 read
literally would keep penalising it).
"""

from __future__ import annotations

import numpy as np

from unifg.columns import Values
from unifg.linearization import Evaluation, Linearization
from unifg.program import Program
from unifg.typing import Array, BoolArray

DIAGONAL_FLOOR = 1e-9  # of the largest diagonal entry: damping must act on unknowns with little curvature too


class Primal:
    """Merit, gradient and damped Gauss-Newton direction of the augmented objective."""

    def __init__(self, program: Program) -> None:
        """Allocate the factorisation; its ordering is found at the first use."""
        self.program = program
        self._solver = program.normal_solver()

    def next_multipliers(self, constraints: Array, multipliers: Array, penalty: Array) -> Array:
        """(M,) lambda+: the first-order dual update, zero for inactive rows."""
        program = self.program
        with np.errstate(invalid="ignore"):
            above = np.maximum(multipliers + penalty * (constraints - program.upper), 0.0)
            below = np.minimum(multipliers + penalty * (constraints - program.lower), 0.0)
        return above + below

    def merit(self, point: Evaluation | Linearization, multipliers: Array, penalty: Array) -> float:
        """Augmented objective."""
        return point.cost + self.barrier(point.constraints, multipliers, penalty)

    def gradient(self, lin: Linearization, multipliers: Array, penalty: Array) -> Array:
        """Gradient of the augmented objective over the unknowns."""
        after = self.next_multipliers(lin.constraints, multipliers, penalty)
        return self.program.lagrangian_gradient(lin, after)[self.program.columns.free]

    def curvature(self, lin: Linearization, multipliers: Array, penalty: Array) -> Array:
        """Gauss-Newton Hessian entries J'J + A' diag(rho, active rows) A."""
        active = self.active(lin.constraints, multipliers, penalty)
        return self.program.normal_entries(lin, np.where(active, penalty, 0.0))

    def active(self, constraints: Array, multipliers: Array, penalty: Array) -> BoolArray:
        """(M,) rows that contribute to the augmented objective."""
        active: BoolArray = self.program.equality | (self.next_multipliers(constraints, multipliers, penalty) != 0.0)
        return active

    def barrier(self, constraints: Array, multipliers: Array, penalty: Array) -> float:
        """Sum of the PHR terms."""
        if not len(multipliers):
            return 0.0
        after = self.next_multipliers(constraints, multipliers, penalty)
        return float(((after * after - multipliers * multipliers) / (2.0 * penalty)).sum())

    def damping_diagonal(self, curvature: Array, damping: float) -> Array:
        """(size,) what Marquardt's damping adds to the diagonal."""
        entries = curvature[self.program.normal.diagonal]
        added: Array = damping * np.maximum(entries, DIAGONAL_FLOOR * entries.max(initial=0.0) + 1e-300)
        return added

    def direction(self, curvature: Array, gradient: Array, added: Array | None = None) -> Array | None:
        """Solve (H + diag(added)) d = -gradient; None when the matrix cannot be factorised."""
        if not self._solver.factor(curvature, added):
            return None
        step = -self._solver.solve(gradient)
        return step if np.isfinite(step).all() else None

    def trial(self, lin: Linearization, step: Array) -> tuple[Values, Evaluation]:
        """Values after ``step`` and what they cost, with the weights of ``lin`` held."""
        values = self.program.retract(lin.values, step)
        return values, self.program.evaluate(values, lin.weights)
