"""What the least-squares backends share, and what they refuse."""

from __future__ import annotations

from dataclasses import dataclass

from unifg.answers.solver import Solver
from unifg.errors import BackendError
from unifg.program.program import Program
from unifg.solvers.primal import Primal


@dataclass(kw_only=True)
class LeastSquares(Solver):
    """Unconstrained sums of squares with robust losses.

    Attributes:
        step_tolerance: optional stop rule on the norm of the step; it does not grant CONVERGED.
    """

    step_tolerance: float = 0.0

    def require(self, program: Program) -> None:
        """Refuse constraints and scalar costs."""
        require_unconstrained(program, self.name)
        require_squares(program, self.name)

    def workspace(self, program: Program) -> Primal:
        """The factorisation of the normal equations."""
        return Primal(program)


def require_unconstrained(program: Program, solver: str) -> None:
    """Raise unless the problem has no constraints.

    Raises:
        BackendError: naming the first constraint.
    """
    if program.constraint_terms:
        name = program.constraint_terms[0].name
        raise BackendError(
            f"{solver} cannot take the constraint '{name}': use AugmentedLagrangian or SQP, or state it as a cost"
        )


def require_squares(program: Program, solver: str) -> None:
    """Raise unless every cost is a sum of squares.

    Raises:
        BackendError: naming the first scalar cost.
    """
    if program.scalar_terms:
        name = program.scalar_terms[0].name
        raise BackendError(
            f"{solver} cannot take the scalar cost '{name}': it is not a square; use SQP, or state it as a residual"
        )
