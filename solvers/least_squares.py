"""What the least-squares backends share."""

from __future__ import annotations

from dataclasses import dataclass

from unifg.answers.solver import Solver
from unifg.program.program import Program
from unifg.solvers.primal import Primal


@dataclass(kw_only=True)
class LeastSquares(Solver):
    """Unconstrained sums of squares with robust losses.

    Attributes:
        step_tolerance: optional stop rule on the norm of the step; it does not grant CONVERGED.
    """

    constraints = "none"
    scalar_costs = False

    step_tolerance: float = 0.0

    def workspace(self, program: Program) -> Primal:
        """The factorisation of the normal equations."""
        return Primal(program)
