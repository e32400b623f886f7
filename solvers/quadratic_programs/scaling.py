"""Units for a solve's own use: factors that make the KKT matrix [[H, A'], [A, 0]] alike in all rows and columns.

The largest entry of every row and column is brought near one by taking square roots of it out of both, again and again
(Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices, RAL-TR-2001-034). Factors are rounded
to powers of two: stating a problem in them rounds nothing. Passes see no curvature that is small beside the entries of
its rows everywhere; where it is very small, unknowns grow and rows shrink until the largest curvature is one. Bounds of
unknowns say nothing about their scale, and take over that of the unknown. Curvatures that are large in the mean tell of
the unit of the costs, not of those of unknowns: they are divided by it first. A graph whose units are within a thousand
of balance is solved in them, unless it is one of least squares alone, which has no unit of cost. Answers, and the test
they have to pass, stay in the units of the graph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.symmetric import Symmetric
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer
from unifg.typing import Array, BoolArray, IntArray

PASSES, NEAR = 12, 1.5  # each pass halves what is left in the exponents; factors are rounded anyway
LARGEST = 2.0**60
SMALL = 1e-4  # curvatures of which dampings and shifts of 1e-9 are a share that shows
MODEST = 2.0**10  # factors up to this change little in double precision, and are left alone


@dataclass(frozen=True)
class Scaling:
    """Unknowns are ``columns`` times those of the scaled problem, its rows ``rows`` times those of the graph.

    Attributes:
        program: the compiled graph.
        columns: (n,) per unknown.
        rows: (M,) per constraint row.
    """

    program: CompiledProblem
    columns: Array
    rows: Array

    @classmethod
    def none(cls, program: CompiledProblem) -> Scaling:
        """The units of the graph."""
        return cls(program, np.ones(program.size), np.ones(program.constraints.count))

    @classmethod
    def of(cls, program: CompiledProblem, lin: Linearization, neutral: Scaling | None = None) -> Scaling:
        """For the problem as it is at ``lin``; factors of one where the units of the graph are good enough.

        Args:
            program: the compiled graph.
            lin: where.
            neutral: factors of one, to be returned again; new ones by default.
        """
        columns, rows = np.empty(program.size), np.empty(program.constraints.count)
        patterns = Patterns.of(program, program.normal)
        modest = find_units(patterns, lin.hessian, lin.constraint_jacobian, columns, rows, True)
        if modest and not program.least_squares:
            return neutral or cls.none(program)
        return cls(program, columns, rows)

    @cached_property
    def neutral(self) -> bool:
        """True if all factors are one."""
        return bool((self.columns == 1.0).all() and (self.rows == 1.0).all())

    @cached_property
    def metric(self) -> Array:
        """(n,) what one on the diagonal of the scaled Hessian is in the units of the graph."""
        return self.columns**-2.0

    @cached_property
    def smallest(self) -> float:
        """The smallest factor, at most one."""
        return float(min(self.columns.min(initial=1.0), self.rows.min(initial=1.0)))

    def hessian(self, pattern: Symmetric, entries: Array) -> Array:
        """Entries of a scaled Hessian."""
        return entries * self.columns[pattern.indices] * self.columns[pattern.columns]

    def jacobian(self, entries: Array) -> Array:
        """Entries of the scaled constraint Jacobian, in evaluation order."""
        constraints = self.program.constraints
        return entries * self.rows[constraints.rows] * self.full[constraints.columns]

    def scaled(self, qp: QP) -> QP:
        """The subproblem with scaled unknowns and rows."""
        return QP(
            qp.program,
            qp.lin,
            qp.pattern,
            self.hessian(qp.pattern, qp.hessian),
            self.columns * qp.gradient,
            self.jacobian(qp.jacobian),
            self.rows * qp.lower,
            self.rows * qp.upper,
            qp.damping * np.square(self.columns),
            None if qp.curved_by is None else qp.curved_by / self.rows,
            None if qp.weights is None else qp.weights / np.square(self.rows),
        )

    def unscaled(self, answer: QPAnswer) -> QPAnswer:
        """An answer in the units of the graph; its error stays what it is in the scaled ones."""
        return replace(answer, step=self.columns * answer.step, multipliers=self.rows * answer.multipliers)

    @cached_property
    def full(self) -> Array:
        """(width,) factors of all tangent coordinates, one for fixed ones."""
        full = np.ones(self.program.columns.width)
        full[self.program.columns.free] = self.columns
        return full


class Patterns(NamedTuple):
    """Patterns of a Hessian and of the constraint Jacobian.

    Attributes:
        indptr, indices: of the Hessian by columns, upper triangle.
        free, rows, columns: place in evaluation order, row and unknown of every entry of the Jacobian.
        of_bounds: (M,) which rows bound an unknown.
    """

    indptr: IntArray
    indices: IntArray
    free: IntArray
    rows: IntArray
    columns: IntArray
    of_bounds: BoolArray

    @classmethod
    def of(cls, program: CompiledProblem, pattern: Symmetric) -> Patterns:
        """Those of a program, with the Hessian's own."""
        rows = program.constraints
        return cls(pattern.indptr, pattern.indices, rows.free, rows.free_rows, rows.free_columns, program.bound_rows)


class Packed(NamedTuple):
    """A subproblem in units of its own, for a solver that takes both matrices by columns.

    Attributes:
        hessian, gradient: entries of H and g.
        entries: of A by columns.
        lower, upper: (M,) limits.
        columns, rows: factors of unknowns and rows.
    """

    hessian: Array
    gradient: Array
    entries: Array
    lower: Array
    upper: Array
    columns: Array
    rows: Array

    @classmethod
    def of(cls, qp: QP, equalities: float, infinity: float) -> Packed:
        """Bring ``qp`` to one scale, with the rows of equalities ``equalities`` times as long.

        Args:
            qp: the subproblem.
            equalities: factor of their rows.
            infinity: what stands for it.
        """
        program, constraints, pattern = qp.program, qp.program.constraints, qp.pattern
        packed = cls(
            qp.hessian.copy(), qp.gradient.copy(), np.zeros(constraints.nnz), qp.lower.copy(), qp.upper.copy(),
            *equilibrate(program, pattern, qp.hessian, qp.jacobian),
        )  # fmt: skip
        _pack(
            pattern.indptr, pattern.indices, constraints.free, constraints.free_rows, constraints.free_columns,
            constraints.slots, qp.jacobian, equalities, infinity, packed,
        )  # fmt: skip
        return packed


@compiled
def _pack(
    indptr: IntArray,
    indices: IntArray,
    free: IntArray,
    free_rows: IntArray,
    free_columns: IntArray,
    slots: IntArray,
    jacobian: Array,
    equalities: float,
    infinity: float,
    packed: Packed,
) -> None:
    """Scale all numbers."""
    columns, rows, lower, upper = packed.columns, packed.rows, packed.lower, packed.upper
    for row in range(len(rows)):
        if lower[row] == upper[row]:
            rows[row] *= equalities
        lower[row], upper[row] = max(lower[row] * rows[row], -infinity), min(upper[row] * rows[row], infinity)
    for column in range(len(columns)):
        packed.gradient[column] *= columns[column]
        for at in range(indptr[column], indptr[column + 1]):
            packed.hessian[at] *= columns[indices[at]] * columns[column]
    for k in range(len(free)):
        packed.entries[slots[k]] += jacobian[free[k]] * rows[free_rows[k]] * columns[free_columns[k]]


def equilibrate(program: CompiledProblem, pattern: Symmetric, hessian: Array, jacobian: Array) -> tuple[Array, Array]:
    """Factors of the unknowns (n,) and of the constraint rows (M,), powers of two; one where all entries vanish.

    Args:
        program: the compiled graph.
        pattern: of the Hessian.
        hessian: its entries, upper triangle.
        jacobian: entries of A in evaluation order.
    """
    columns, rows = np.empty(program.size), np.empty(program.constraints.count)
    find_units(Patterns.of(program, pattern), hessian, jacobian, columns, rows, False)
    return columns, rows


@compiled
def find_units(
    patterns: Patterns, hessian: Array, jacobian: Array, column_factors: Array, row_factors: Array, apart: bool
) -> bool:
    """Write factors by Ruiz' passes, and rounding; true where no factor, but for those of bounds, is large or small.

    Entries that are not finite do not count.

    Args:
        patterns: of H and A.
        hessian: entries of H.
        jacobian: entries of A in evaluation order.
        column_factors: (n,) that are written.
        row_factors: (M,) that are written.
        apart: whether the size of large costs is taken out of H first.
    """
    indptr, indices, free, rows, columns, of_bounds = patterns
    column_factors[:] = 1.0
    row_factors[:] = 1.0
    entries = np.empty(len(indices) + len(free))  # but zeros, which a fixed pattern has many of: those of H, then of A
    firsts, seconds = np.empty(len(entries), dtype=np.int64), np.empty(len(entries), dtype=np.int64)
    count = 0
    for column in range(len(column_factors)):
        for at in range(indptr[column], indptr[column + 1]):
            if hessian[at] != 0.0:
                entries[count], firsts[count], seconds[count] = abs(hessian[at]), indices[at], column
                count += 1
    squares = count
    for k in range(len(free)):
        if jacobian[free[k]] != 0.0 and not of_bounds[rows[k]]:
            entries[count], firsts[count], seconds[count] = abs(jacobian[free[k]]), rows[k], columns[k]
            count += 1
    curved = entries[:squares], firsts[:squares], seconds[:squares]
    if apart and _curvature(*curved, column_factors) > MODEST:
        # The constraints alone tell the size of the costs from units of unknowns.
        _balance(entries[squares:count], firsts[squares:count], seconds[squares:count], 0, column_factors, row_factors)
        size = max(_curvature(*curved, column_factors), 1.0)
        for k in range(squares):  # a slice that is written to raises errors that cannot be shipped
            entries[k] /= size
        column_factors[:] = 1.0
        row_factors[:] = 1.0
    _balance(entries[:count], firsts[:count], seconds[:count], squares, column_factors, row_factors)
    steepest = 0.0
    for k in range(squares):
        steepest = max(steepest, entries[k] * column_factors[firsts[k]] * column_factors[seconds[k]])
    small = 0.0 < steepest < SMALL
    if small:
        column_factors /= np.sqrt(steepest)
        row_factors *= np.sqrt(steepest)
    _round(column_factors)
    _round(row_factors)
    for k in range(len(free)):
        if of_bounds[rows[k]]:
            row_factors[rows[k]] = 1.0 / column_factors[columns[k]]
    for factor in column_factors:
        if not 1.0 / MODEST <= factor <= MODEST:
            return False
    for row in range(len(row_factors)):
        if not of_bounds[row] and not 1.0 / MODEST <= row_factors[row] <= MODEST:
            return False
    return not small


@compiled
def _curvature(entries: Array, firsts: IntArray, seconds: IntArray, factors: Array) -> float:
    """Mean curvature of scaled unknowns, by its logarithm; one where there is none."""
    total, count = 0.0, 0
    for k in range(len(entries)):
        if firsts[k] == seconds[k] and entries[k] < np.inf:
            total, count = total + np.log2(entries[k] * factors[firsts[k]] ** 2), count + 1
    return float(np.exp2(total / max(count, 1)))


@compiled
def _balance(
    entries: Array, firsts: IntArray, seconds: IntArray, squares: int, column_factors: Array, row_factors: Array
) -> None:
    """Improve factors until the largest entries of all columns and rows are near one.

    Args:
        entries: of H, then of A.
        firsts: rows of them.
        seconds: columns of them.
        squares: count of those of H.
        column_factors: (n,) factors of unknowns.
        row_factors: (M,) factors of the rows of A.
    """
    of_columns, of_rows = np.empty(len(column_factors)), np.empty(len(row_factors))
    for _ in range(PASSES):
        furthest = 1.0
        of_columns[:], of_rows[:] = 0.0, 0.0
        for k in range(squares):
            row, column = firsts[k], seconds[k]
            size = entries[k] * column_factors[row] * column_factors[column]
            if size < np.inf:
                of_columns[row] = max(of_columns[row], size)
                of_columns[column] = max(of_columns[column], size)
        for k in range(squares, len(entries)):
            row, column = firsts[k], seconds[k]
            size = entries[k] * row_factors[row] * column_factors[column]
            if size < np.inf:
                of_rows[row] = max(of_rows[row], size)
                of_columns[column] = max(of_columns[column], size)
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


@compiled
def _round(factors: Array) -> None:
    """Bring every factor to the nearest power of two within the largest ones."""
    for k in range(len(factors)):
        factors[k] = np.exp2(np.rint(np.log2(min(max(factors[k], 1.0 / LARGEST), LARGEST))))
