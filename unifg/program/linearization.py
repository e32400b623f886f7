"""What a program says about a point: with and without derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from unifg.machine.jit import compiled
from unifg.program.columns import Values
from unifg.typing import Array

HeldWeights: TypeAlias = dict[str, Array]


@dataclass
class Evaluation:
    """Objective and constraints at a point, without derivatives.

    Attributes:
        cost: objective.
        constraints: (M,) stacked g.
    """

    cost: float
    constraints: Array

    @property
    def finite(self) -> bool:
        """Whether every number is finite."""
        return bool(math.isfinite(self.cost) and all_finite(self.constraints))


@dataclass
class Linearization:
    """Objective and constraints with their derivatives at ``values``.

    Attributes:
        values: where.
        cost: objective.
        residual: (C,) weighted, whitened cost residuals.
        jacobian: entries of the cost Jacobian, in the order of ``Program.costs``.
        constraints: (M,) stacked g.
        constraint_jacobian: entries of A, in the order of ``Program.constraints``.
        gradient: gradient of the objective over the full tangent space.
        hessian: Gauss-Newton Hessian of the objective, in the order of ``Program.normal``; scalar costs without their
            negative curvature.
        norms: each term's residual norm; for constraints the norm of the violation.
        weights: weights of reweighted losses, to be held during the line search.
        concavity: the negative curvature of scalar costs, in the order of ``Program.normal``; empty without such costs.
        squares: squared norms of the whitened residuals of robust factors, before their loss.
        scalars: (n,) values of each scalar cost.
        rounding: of the part of the gradient that scalar costs make by differences, over the full tangent space; empty
            without such costs.
    """

    values: Values
    cost: float
    residual: Array
    jacobian: Array
    constraints: Array
    constraint_jacobian: Array
    gradient: Array
    hessian: Array
    norms: dict[str, float]
    weights: HeldWeights = field(default_factory=dict)
    concavity: Array = field(default_factory=lambda: np.zeros(0))
    squares: Array = field(default_factory=lambda: np.zeros(0))
    scalars: dict[str, Array] = field(default_factory=dict)
    rounding: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def finite(self) -> bool:
        """Whether every number is finite."""
        return bool(
            math.isfinite(self.cost)
            and all_finite(self.gradient)
            and all_finite(self.constraints)
            and all_finite(self.constraint_jacobian)
        )


@compiled
def all_finite(numbers: Array) -> bool:
    """Whether every number is finite."""
    for number in numbers:
        if not math.isfinite(number):
            return False
    return True
