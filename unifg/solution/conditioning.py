"""Conditioning of the normal equations at a solution, and accuracy of their solution.

The unknowns are scaled so that the diagonal is one: units say nothing, and what is left is how hard some directions are
to tell apart. The condition in the 1-norm is estimated from a few solves (N. Higham, "FORTRAN codes for estimating the
one-norm of a real or complex matrix", ACM Trans. Math. Softw. 14 (1988)), hardly ever below a third of what it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.codegen.inner import inner
from unifg.elimination.factorization import Factorization
from unifg.elimination.plan import PIVOTS, ROWS
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.typing import Array

STEPS = 5  # of the estimate
HARDLY = 1e-11  # pivots below this, relative to the diagonal: fewer than five digits of a direction are known
EFFORT = 2e9  # operations of a factorisation that a report may cost


class Conditioning(NamedTuple):
    """Of the normal equations at a solution, with unit diagonal.

    Attributes:
        condition: estimate, a lower bound, of the condition in the 1-norm; infinite where a pivot vanishes.
        residual: max |H d - g| over max (|H| |d| + |g|), for the gradient there: a few 1e-16 where all is well.
    """

    condition: float
    residual: float

    def sentence(self) -> str:
        """For a report."""
        return f"Condition of the linear system {self.condition:.1e}, relative residual {self.residual:.1e}."


def cheap(program: CompiledProblem) -> bool:
    """Test whether a report may factorise."""
    fronts = program.systems.normal().structure.plan.fronts[:-1].astype(np.float64)
    pivots, rows = fronts[:, PIVOTS], fronts[:, ROWS]
    return float((pivots * (pivots**2 / 3.0 + pivots * rows + rows**2)).sum()) <= EFFORT


def conditioning(program: CompiledProblem, lin: Linearization) -> Conditioning:
    """Of pure least squares, which has no other matrix.

    Args:
        program: the compiled graph.
        lin: linearisation at the solution.
    """
    pattern = program.normal
    diagonal = lin.hessian[pattern.diagonal]
    if not program.size:
        return Conditioning(1.0, 0.0)
    if not (diagonal > 0.0).all():
        return Conditioning(np.inf, np.nan)
    scale = 1.0 / np.sqrt(diagonal)
    data = lin.hessian * scale[pattern.indices] * scale[pattern.columns]
    right = lin.gradient[program.columns.free] * scale
    with program.systems.borrowed() as factorization:
        if not factorization.factor(data):
            return Conditioning(np.inf, np.nan)
        size = float(pattern.times(np.abs(data), np.ones(pattern.size)).max())
        condition = size * _inverse_norm(factorization, pattern.size)
        solution = factorization.solve(right)
    whole = float((pattern.times(np.abs(data), np.abs(solution)) + np.abs(right)).max())
    error = float(np.abs(pattern.times(data, solution) - right).max())
    return Conditioning(condition, error / whole if whole > 0.0 else 0.0)


def _inverse_norm(factorization: Factorization, size: int) -> float:
    """Estimate of the 1-norm of the inverse."""
    vector: Array = np.full(size, 1.0 / size)
    estimate = 0.0
    for _ in range(STEPS):
        solved = factorization.solve(vector)
        norm = float(np.abs(solved).sum())
        if norm <= estimate:
            break
        estimate = norm
        slope = factorization.solve(np.where(solved < 0.0, -1.0, 1.0))
        place = int(np.abs(slope).argmax())
        if abs(slope[place]) <= inner(slope, vector):
            break
        vector = np.zeros(size)
        vector[place] = 1.0
    places = np.arange(size)
    alternating = np.where(places % 2, -1.0, 1.0) * (1.0 + places / max(size - 1, 1))
    return max(estimate, 2.0 * float(np.abs(factorization.solve(alternating)).sum()) / (3.0 * size))
