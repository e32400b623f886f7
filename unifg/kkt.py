"""The optimality test every backend is judged by.

For min f(x) s.t. l <= g(x) <= u with L = f + lambda' g, at a point and multipliers:

- stationarity: max |grad f + A' lambda| over the unknowns (tangent coordinates, right perturbation);
- violation: max distance of g outside [l, u];
- complementarity: max |lambda_i| times the distance of g_i to the limit its sign points at; a multiplier
  pointing at a limit that does not exist has the wrong sign and counts as |lambda_i|.

Stationarity and complementarity are divided by max(1, mean|lambda| / 100); the violation is not scaled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.linearization import Linearization
from unifg.program import Program
from unifg.typing import Array, BoolArray, IntArray


@dataclass(frozen=True)
class Optimality:
    """KKT numbers at a point.

    Attributes:
        stationarity, violation, complementarity: as defined in the module's docstring.
        worst_row: constraint row with the largest violation, or -1 without constraints.
        finite: whether everything could be evaluated.
    """

    stationarity: float
    violation: float
    complementarity: float
    worst_row: int
    finite: bool

    def passes(self, tolerance: float) -> bool:
        """Whether all three numbers are within ``tolerance``."""
        return self.finite and max(self.stationarity, self.violation, self.complementarity) <= tolerance


def optimality(program: Program, lin: Linearization, multipliers: Array) -> Optimality:
    """Measure the KKT conditions at a linearised point.

    Args:
        program: the compiled graph with its data bound.
        lin: linearisation at the point, whose gradient is the true one, robust losses included.
        multipliers: (M,) one per constraint row.
    """
    finite = lin.finite and bool(np.isfinite(multipliers).all())
    if not finite:
        return Optimality(np.inf, np.inf, np.inf, -1, False)
    gradient = program.lagrangian_gradient(lin, multipliers)[program.columns.free]
    stationarity = float(np.abs(gradient).max(initial=0.0))
    if not program.constraints.count:
        return Optimality(stationarity, 0.0, 0.0, -1, True)
    scale = max(1.0, float(np.abs(multipliers).mean()) / 100.0)
    outside = np.abs(program.violation(lin.constraints))
    worst = int(np.argmax(outside))
    return Optimality(
        stationarity / scale,
        float(outside[worst]),
        float(complementarity(program, lin.constraints, multipliers).max()) / scale,
        worst,
        True,
    )


def complementarity(program: Program, constraints: Array, multipliers: Array) -> Array:
    """(M,) complementarity error of every row; equalities have none."""
    limit = np.where(multipliers > 0.0, program.upper, program.lower)
    slack = np.where(np.isfinite(limit), np.abs(constraints - limit), 1.0)
    return np.where(program.equality, 0.0, np.abs(multipliers) * slack)


def infeasible_stationary(program: Program, lin: Linearization, tolerance: float) -> bool:
    """Whether the point is stationary for 1/2 |violation|^2 without being feasible.

    Descent directions that satisfied bounds of the unknowns block do not count. The gradient A' v is compared with
    the size of v and of the rows of A it is made of.
    """
    outside = program.violation(lin.constraints)
    if np.abs(outside).max(initial=0.0) <= tolerance:
        return False
    pull = program.constraints.transposed_times(lin.constraint_jacobian, outside)[program.columns.free]
    columns, at_lower, at_upper = _walls(program, lin.constraints)
    blocked = ((pull[columns] > 0.0) & at_lower) | ((pull[columns] < 0.0) & at_upper)
    pull[columns[blocked]] = 0.0
    size = np.abs(lin.constraint_jacobian).max(initial=0.0) * np.abs(outside).max()
    return bool(np.abs(pull).max(initial=0.0) <= 1e-6 * size)


def _walls(program: Program, constraints: Array) -> tuple[IntArray, BoolArray, BoolArray]:
    """Unknowns with bounds, and whether each rests on its lower or upper one."""
    rows, columns = program.constraints.free_rows, program.constraints.free_columns
    bounds = program.bound_rows[rows]
    rows, columns = rows[bounds], columns[bounds]
    near = 1e-9 * np.maximum(1.0, np.abs(constraints[rows]))
    at_lower = np.abs(constraints[rows] - program.lower[rows]) <= near
    at_upper = np.abs(constraints[rows] - program.upper[rows]) <= near
    return columns, at_lower, at_upper
