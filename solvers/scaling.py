"""Units for a solve's own use: factors that make the KKT matrix [[H, A'], [A, 0]] alike in all rows and columns.

The largest entry of every row and column is brought near one by taking square roots of it out of both, again and again
(Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices, RAL-TR-2001-034). Factors are rounded
to powers of two: stating a problem in them rounds nothing. Bounds of unknowns say nothing about their scale, and take
over that of the unknown. A graph whose units are within a thousand of balance is solved in them. Answers, and the test
they have to pass, stay in the units of the graph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from unifg.jit import compiled
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.solvers.qp import QP, QPAnswer
from unifg.sparse import Symmetric
from unifg.typing import Array, IntArray

PASSES, NEAR = 12, 1.5  # each pass halves what is left in the exponents; factors are rounded anyway
LARGEST = 2.0**40
MODEST = 2.0**10  # factors up to this change little in double precision, and are left alone


@dataclass(frozen=True)
class Scaling:
    """Unknowns are ``columns`` times those of the scaled problem, its rows ``rows`` times those of the graph.

    Attributes:
        program: the compiled graph.
        columns: (n,) per unknown.
        rows: (M,) per constraint row.
    """

    program: Program
    columns: Array
    rows: Array

    @classmethod
    def none(cls, program: Program) -> Scaling:
        """The units of the graph."""
        return cls(program, np.ones(program.size), np.ones(program.constraints.count))

    @classmethod
    def of(cls, program: Program, lin: Linearization) -> Scaling:
        """For the problem as it is at ``lin``; factors of one where the units of the graph are good enough."""
        found = cls(program, *equilibrate(program, program.normal, lin.hessian, lin.constraint_jacobian))
        factors = np.concatenate([found.columns, found.rows[~program.bound_rows]])
        modest = factors.max(initial=1.0) <= MODEST and factors.min(initial=1.0) >= 1.0 / MODEST
        return cls.none(program) if modest else found

    @classmethod
    def of_subproblem(cls, qp: QP) -> Scaling:
        """For one quadratic subproblem."""
        return cls(qp.program, *equilibrate(qp.program, qp.pattern, qp.hessian, qp.jacobian))

    @cached_property
    def neutral(self) -> bool:
        """Whether all factors are one."""
        return bool((self.columns == 1.0).all() and (self.rows == 1.0).all())

    @cached_property
    def metric(self) -> Array:
        """(n,) what one on the diagonal of the scaled Hessian is in the units of the graph."""
        metric: Array = self.columns**-2.0
        return metric

    @cached_property
    def smallest(self) -> float:
        """The smallest factor, at most one."""
        return float(min(self.columns.min(initial=1.0), self.rows.min(initial=1.0)))

    def hessian(self, pattern: Symmetric, entries: Array) -> Array:
        """Entries of a scaled Hessian."""
        scaled: Array = entries * self.columns[pattern.indices] * self.columns[pattern.columns]
        return scaled

    def jacobian(self, entries: Array) -> Array:
        """Entries of the scaled constraint Jacobian, in evaluation order."""
        constraints = self.program.constraints
        scaled: Array = entries * self.rows[constraints.rows] * self._full[constraints.columns]
        return scaled

    def scaled(self, qp: QP) -> QP:
        """The subproblem with scaled unknowns and rows."""
        return replace(
            qp,
            hessian=self.hessian(qp.pattern, qp.hessian),
            gradient=self.columns * qp.gradient,
            jacobian=self.jacobian(qp.jacobian),
            lower=self.rows * qp.lower,
            upper=self.rows * qp.upper,
            damping=qp.damping * self.columns**2.0,
            curved_by=None if qp.curved_by is None else qp.curved_by / self.rows,
            weights=None if qp.weights is None else qp.weights / self.rows**2.0,
        )

    def unscaled(self, answer: QPAnswer) -> QPAnswer:
        """An answer in the units of the graph; its error stays what it is in the scaled ones."""
        return replace(answer, step=self.columns * answer.step, multipliers=self.rows * answer.multipliers)

    @cached_property
    def _full(self) -> Array:
        """Factors of all tangent coordinates, one for fixed ones."""
        full = np.ones(self.program.columns.width)
        full[self.program.columns.free] = self.columns
        return full


def equilibrate(program: Program, pattern: Symmetric, hessian: Array, jacobian: Array) -> tuple[Array, Array]:
    """Factors of the unknowns (n,) and of the constraint rows (M,), powers of two; one where all entries vanish.

    Args:
        program: the compiled graph.
        pattern: of the Hessian.
        hessian: its entries, upper triangle.
        jacobian: entries of A in evaluation order.
    """
    constraints = program.constraints
    columns, rows = np.ones(program.size), np.ones(constraints.count)
    of_bounds = program.bound_rows[constraints.free_rows]
    slopes = np.where(of_bounds, 0.0, np.abs(jacobian[constraints.free]))
    _equilibrate(
        pattern.indptr, pattern.indices, np.abs(hessian), constraints.free_rows, constraints.free_columns, slopes,
        columns, rows,
    )  # fmt: skip
    columns, rows = _rounded(columns), _rounded(rows)
    rows[constraints.free_rows[of_bounds]] = 1.0 / columns[constraints.free_columns[of_bounds]]
    return columns, rows


def _rounded(factors: Array) -> Array:
    rounded: Array = np.exp2(np.round(np.log2(np.minimum(np.maximum(factors, 1.0 / LARGEST), LARGEST))))
    return rounded


@compiled
def _equilibrate(
    indptr: IntArray,
    indices: IntArray,
    hessian: Array,
    rows: IntArray,
    columns: IntArray,
    slopes: Array,
    column_factors: Array,
    row_factors: Array,
) -> None:
    """Ruiz' passes; entries must not be negative, and those that are not finite do not count."""
    of_columns, of_rows = np.empty(len(column_factors)), np.empty(len(row_factors))
    for _ in range(PASSES):
        furthest = 1.0
        of_columns[:], of_rows[:] = 0.0, 0.0
        for column in range(len(column_factors)):
            for at in range(indptr[column], indptr[column + 1]):
                row = indices[at]
                size = hessian[at] * column_factors[row] * column_factors[column]
                if size < np.inf:
                    of_columns[row] = max(of_columns[row], size)
                    of_columns[column] = max(of_columns[column], size)
        for at in range(len(slopes)):
            size = slopes[at] * row_factors[rows[at]] * column_factors[columns[at]]
            if size < np.inf:
                of_rows[rows[at]] = max(of_rows[rows[at]], size)
                of_columns[columns[at]] = max(of_columns[columns[at]], size)
        for k in range(len(column_factors)):
            if of_columns[k] > 0.0:
                column_factors[k] /= np.sqrt(of_columns[k])
                furthest = max(furthest, of_columns[k], 1.0 / of_columns[k])
        for k in range(len(row_factors)):
            if of_rows[k] > 0.0:
                row_factors[k] /= np.sqrt(of_rows[k])
                furthest = max(furthest, of_rows[k], 1.0 / of_rows[k])
        if furthest < NEAR:
            break
