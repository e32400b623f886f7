"""Requirements of backends: refusals by name, before the first iteration."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from unifg.errors import BackendError
from unifg.problem.compiled_problem import CompiledProblem

Constraints: TypeAlias = Literal["none", "equalities", "all"]


def require(
    program: CompiledProblem,
    solver: str,
    constraints: Constraints = "all",
    scalar_costs: bool = True,
    soft: bool = True,
) -> None:
    """Raise unless a graph has no other constraints, switched on, and no other costs than these.

    Args:
        program: the compiled graph.
        solver: to be named in the error.
        constraints: which may be there.
        scalar_costs: whether costs that are no squares may be there.
        soft: whether the linear prices of soft constraints may be there in any case.

    Raises:
        BackendError: naming the first constraint or cost that may not.
    """
    if constraints == "none" and program.constraint_terms:
        name = program.constraint_terms[0].name
        raise BackendError(
            f"{solver} cannot take the constraint '{name}': use InteriorPoint, AugmentedLagrangian or SQP, or "
            "`fg.solve`, which picks; or state it as a cost"
        )
    for name in [] if scalar_costs else [term.name for term in program.scalar_terms]:
        stated = next((own for own, slack in program.soft.items() if name.startswith(slack.family.name)), None)
        if stated is not None and soft:
            continue
        if stated is not None:
            raise BackendError(
                f"{solver} cannot take the soft constraint '{stated}', whose price is no square: use InteriorPoint, "
                "SQP, AugmentedLagrangian or Penalty"
            )
        raise BackendError(
            f"{solver} cannot take the scalar cost '{name}': it is not a square; use InteriorPoint, "
            "AugmentedLagrangian or SQP, or state it as a residual"
        )
    if constraints != "equalities":
        return
    rows = np.flatnonzero(program.inequalities)
    if len(rows):
        name, index = program.row_name(int(rows[0]))
        raise BackendError(
            f"{solver} cannot take the inequality '{name}' (factor {index}): it knows equalities only; use "
            "InteriorPoint, AugmentedLagrangian or SQP"
        )
