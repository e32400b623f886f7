"""What Gauss-Newton and Levenberg-Marquardt refuse."""

from __future__ import annotations

from unifg.errors import BackendError
from unifg.program import Program


def require_least_squares(program: Program, solver: str) -> None:
    """Raise unless the problem is an unconstrained sum of squares.

    Raises:
        BackendError: naming the first term that is not.
    """
    if program.constraint_terms:
        name = program.constraint_terms[0].name
        raise BackendError(
            f"{solver} cannot take the constraint '{name}': use AugmentedLagrangian or SQP, or state it as a cost"
        )
    if program.scalar_terms:
        name = program.scalar_terms[0].name
        raise BackendError(
            f"{solver} cannot take the scalar cost '{name}': it is not a square; use SQP, or state it as a residual"
        )
