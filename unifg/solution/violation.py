"""The quadratic model of 1/2 |violation|^2 at a point: what a step could still take away from it.

The model has the curvature of what the violated rows bend, because the least violation is not small. What it promises
is the same whatever units the unknowns are measured in, which the length of its gradient is not.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.inner import inner
from unifg.elimination.factorization import Factorization
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.evaluation import add_constraints
from unifg.problem.hessian import constraint_curvature
from unifg.problem.linearization import Linearization
from unifg.typing import Array, BoolArray, IntArray

NEGLIGIBLE = 1e-12  # share of the squared violation, as an error of 1e-6 in a residual of one takes
UNSEEN = 1e-3  # of the tolerance: smaller changes of a violation do not count, however small it is
FIRST_DAMPING, LARGEST_DAMPING, GROWTH = 1e-12, 1e6, 100.0


class ViolationModel:
    """Gradient and Hessian of 1/2 |violation|^2 over the unknowns that no bound holds back.

    Attributes:
        value: 1/2 |violation|^2.
        gradient: (n,) zero for unknowns that rest on a bound which descent would leave.
        entries: of the Hessian, in the order of ``CompiledProblem.normal``; nothing couples to unknowns held back.
        size: (n,) curvature of each unknown, never zero: the damping that does not depend on its unit.
    """

    def __init__(self, program: CompiledProblem, lin: Linearization) -> None:
        """Differentiate at ``lin``."""
        outside, normal = program.violation(lin.constraints), program.normal
        self._program = program
        self.value = 0.5 * inner(outside, outside)
        self.gradient, held = descent(program, lin)
        self.entries = constraint_curvature(program, lin, outside)
        counted = (outside != 0.0) | program.equality
        add_constraints(program.arrays, lin.constraint_jacobian, counted.astype(np.float64), self.entries)
        columns = normal.columns
        self.entries[held[normal.indices] | held[columns]] = 0.0
        # An unknown that no violated row touches is moved by none; rows that hold still tell its unit.
        constraints = program.constraints
        slopes = lin.constraint_jacobian[constraints.free]
        unit = np.bincount(constraints.free_columns, weights=slopes**2, minlength=program.size)
        size = np.abs(self.entries[normal.diagonal])
        size = np.where(size > 0.0, size, unit)
        self.size = np.where(size > 0.0, size, 1.0)

    @property
    def lengths(self) -> Array:
        """(n,) how far each unknown would have to go, by itself, to make a difference."""
        return np.sqrt(2.0 * self.value / self.size)

    def damped(self, damping: float, size: Array) -> Array:
        """Entries of the Hessian with ``damping`` times ``size`` on its diagonal."""
        entries = self.entries.copy()
        entries[self._program.normal.diagonal] += damping * size
        return entries

    def stationary(self, tolerance: float) -> bool:
        """Test whether the step to the minimum of the model decreases the value by nothing that counts.

        Args:
            tolerance: of the violation.
        """
        enough = max(NEGLIGIBLE * self.value, (UNSEEN * tolerance) ** 2)
        if not np.isfinite(enough):
            return False
        normal, scale = self._program.normal, 1.0 / np.sqrt(self.size)
        columns = normal.columns
        scaled = np.abs(self.entries * scale[normal.indices] * scale[columns])
        sums = np.bincount(columns, scaled, normal.size) + np.bincount(normal.indices, scaled, normal.size)
        slope = float(np.square(scale * self.gradient).sum())
        if slope == 0.0:
            return True
        if 0.5 * slope > enough * float(sums.max()):  # no eigenvalue exceeds the largest sum of a row
            return False
        damping = FIRST_DAMPING
        with self._program.systems.borrowed() as solver:
            while damping <= LARGEST_DAMPING:
                if _definite(solver, self.damped(damping, self.size)):
                    return 0.5 * inner(self.gradient, solver.solve(self.gradient)) <= enough
                damping *= GROWTH
        return False


def descent(program: CompiledProblem, lin: Linearization) -> tuple[Array, BoolArray]:
    """(n,) gradient of 1/2 |violation|^2, zero for unknowns that a bound holds back, and which those are."""
    outside = program.violation(lin.constraints)
    gradient = program.constraints.transposed_times(lin.constraint_jacobian, outside)[program.columns.free]
    held = np.zeros(program.size, dtype=bool)
    held[blocked(program, lin.constraints, gradient)] = True
    gradient[held] = 0.0
    return gradient, held


def blocked(program: CompiledProblem, constraints: Array, gradient: Array) -> IntArray:
    """Unknowns that rest on a bound which descent along ``gradient`` (n,) would leave."""
    columns, at_lower, at_upper = _walls(program, constraints)
    return columns[((gradient[columns] > 0.0) & at_lower) | ((gradient[columns] < 0.0) & at_upper)]


def bounds_of_step(program: CompiledProblem, lin: Linearization) -> tuple[Array, Array]:
    """(n,) smallest and largest step of each unknown that keeps its bounds."""
    rows, columns = _bounds(program)
    lower, upper = np.full(program.size, -np.inf), np.full(program.size, np.inf)
    np.maximum.at(lower, columns, program.lower[rows] - lin.constraints[rows])
    np.minimum.at(upper, columns, program.upper[rows] - lin.constraints[rows])
    return lower, upper


def _definite(solver: Factorization, entries: Array) -> bool:
    return solver.factor(entries) and solver.definite


def _walls(program: CompiledProblem, constraints: Array) -> tuple[IntArray, BoolArray, BoolArray]:
    """Unknowns with bounds, and whether each rests on its lower or upper one."""
    rows, columns = _bounds(program)
    room = program.upper[rows] - program.lower[rows]
    near = 1e-9 * np.maximum(np.where(np.isfinite(room), room, 1.0), np.abs(constraints[rows]))
    at_lower = np.abs(constraints[rows] - program.lower[rows]) <= near
    at_upper = np.abs(constraints[rows] - program.upper[rows]) <= near
    return columns, at_lower, at_upper


def _bounds(program: CompiledProblem) -> tuple[IntArray, IntArray]:
    """Rows that bound an unknown, and the unknowns."""
    rows, columns = program.constraints.free_rows, program.constraints.free_columns
    bounds = program.bound_rows[rows]
    return rows[bounds], columns[bounds]
