"""The quadratic subproblem of an SQP step, and how its answers are judged.

    minimise 1/2 d'Hd + g'd   subject to   lower <= A d <= upper

Whatever route solves it, the answer is measured here, in the problem's own units, before it is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from unifg.linearization import Linearization
from unifg.program import Program
from unifg.typing import Array


@dataclass
class QP:
    """Numbers of one subproblem in the program's fixed patterns.

    Attributes:
        program: gives the patterns ``hessian`` (upper triangle of H) and ``constraints`` (A).
        hessian: entries of H, upper triangle.
        gradient: (n,) g.
        jacobian: entries of A in evaluation order.
        lower, upper: (M,) limits on A d.
    """

    program: Program
    hessian: Array
    gradient: Array
    jacobian: Array
    lower: Array
    upper: Array

    def curved(self, step: Array) -> Array:
        """H d."""
        return self.program.hessian.times(self.hessian, step)

    def linear(self, step: Array) -> Array:
        """A d."""
        return self.program.constraints.times(self.jacobian, step)

    def shifted(self, offset: Array) -> QP:
        """The same problem with both limits moved by ``offset``."""
        return QP(self.program, self.hessian, self.gradient, self.jacobian, self.lower + offset, self.upper + offset)


@dataclass
class QPAnswer:
    """A candidate solution.

    Attributes:
        step: (n,) d.
        multipliers: (M,) positive at an active upper limit, negative at an active lower one.
        route: name of what produced it.
        iterations: its iterations.
        error: largest KKT residual, see :func:`qp_error`; infinite when it does not exist.
        infeasible: whether the route claims that no feasible step exists.
    """

    step: Array
    multipliers: Array
    route: str
    iterations: int
    error: float
    infeasible: bool = False


class Route(Protocol):
    """A way of solving subproblems that share one pattern."""

    name: str

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve, starting from the step zero and ``multipliers`` if the route can."""
        ...


def qp_error(qp: QP, step: Array, multipliers: Array) -> float:
    """Largest of stationarity, infeasibility and complementarity, scaled as in :mod:`unifg.kkt`."""
    if not (np.isfinite(step).all() and np.isfinite(multipliers).all()):
        return np.inf
    scale = max(1.0, float(np.abs(multipliers).mean()) / 100.0) if len(multipliers) else 1.0
    program = qp.program
    dual = qp.curved(step) + qp.gradient
    dual = dual + program.constraints.transposed_times(qp.jacobian, multipliers)[program.columns.free]
    value = qp.linear(step)
    outside = np.maximum(np.maximum(value - qp.upper, qp.lower - value), 0.0)
    limit = np.where(multipliers > 0.0, qp.upper, qp.lower)
    slack = np.where(np.isfinite(limit), np.abs(value - limit), 1.0)
    slip = np.where(program.equality, 0.0, np.abs(multipliers) * slack)
    return max(
        float(np.abs(dual).max(initial=0.0)) / scale,
        float(outside.max(initial=0.0)),
        float(slip.max(initial=0.0)) / scale,
    )


def subproblem(program: Program, lin: Linearization, damping: float) -> QP:
    """The quadratic model at ``lin`` with ``damping`` added to the diagonal of H."""
    hessian = program.hessian_entries(lin)
    hessian[program.hessian.diagonal] += damping
    return QP(
        program,
        hessian,
        lin.gradient[program.columns.free],
        lin.constraint_jacobian,
        program.lower - lin.constraints,
        program.upper - lin.constraints,
    )
