"""What the least-squares backends refuse."""

from __future__ import annotations

from unifg.errors import BackendError
from unifg.program import Program


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
