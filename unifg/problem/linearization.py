"""Linearisation of a program at a point, with and without derivatives, and products with its stacked Jacobians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.symmetric import scatter
from unifg.modeling.variables import Family
from unifg.problem.columns import Values
from unifg.problem.evaluation import times, transposed_times
from unifg.problem.table import COLUMN, COUNT, ROWS, WIDTH, TermTable
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray

if TYPE_CHECKING:
    import scipy.sparse as sp


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
        """Test whether every number is finite."""
        return bool(math.isfinite(self.cost) and all_finite(self.constraints))


@dataclass
class Linearization:
    """Objective and constraints with their derivatives at ``values``.

    Attributes:
        values: where.
        cost: objective.
        residual: (C,) weighted, whitened cost residuals.
        jacobian: entries of the cost Jacobian, in the order of ``CompiledProblem.costs``.
        constraints: (M,) stacked g.
        constraint_jacobian: entries of A, in the order of ``CompiledProblem.constraints``.
        gradient: gradient of the objective over the full tangent space.
        hessian: Gauss-Newton Hessian of the objective, in the order of ``CompiledProblem.normal``; scalar costs
            without their negative curvature.
        norms: each term's residual norm; for constraints the norm of the violation.
        weights: of robust factors; line searches hold those of losses that ask for it.
        concavity: negative curvature of scalar costs, in the order of ``CompiledProblem.normal``; empty without.
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
    weights: Array = field(default_factory=lambda: np.zeros(0))
    concavity: Array = field(default_factory=lambda: np.zeros(0))
    squares: Array = field(default_factory=lambda: np.zeros(0))
    scalars: dict[str, Array] = field(default_factory=dict)
    rounding: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def stored(self) -> Array:
        """Stored values of all families."""
        return self.values.flat

    def of(self, family: Family) -> Array:
        """(count, storage) values of one family."""
        return self.values[family]

    @property
    def finite(self) -> bool:
        """True if every number is finite."""
        return bool(
            math.isfinite(self.cost)
            and all_finite(self.gradient)
            and all_finite(self.constraints)
            and all_finite(self.constraint_jacobian)
        )


class Rows:
    """Pattern of a stacked Jacobian: term after term, factor after factor, row after row.

    Attributes:
        count: number of rows.
        length: number of entries, those of fixed variables included.
    """

    def __init__(self, table: TermTable, terms: Sequence[CompiledTerm], costs: bool, unknowns: int) -> None:
        """Describe the costs or the constraints of a table."""
        self._table = table
        self._terms = terms
        self._costs = costs
        self._unknowns = unknowns
        self.count = table.residuals if costs else table.constraints
        self.length = table.entries if costs else table.constraint_entries

    def times(self, entries: Array, vector: Array) -> Array:
        """J v for a vector over the unknowns."""
        out = np.empty(self.count)
        times(self._table.arrays, self._costs, entries, vector, out)
        return out

    def transposed_times(self, entries: Array, vector: Array) -> Array:
        """J' v over the full tangent space, fixed variables included."""
        out = np.zeros(len(self._table.arrays.unknown))
        transposed_times(self._table.arrays, self._costs, entries, vector, out)
        return out

    @cached_property
    def rows(self) -> IntArray:
        """(length,) row of every entry."""
        widths = [np.full(t.place[COUNT] * t.place[ROWS], t.place[WIDTH]) for t in self._terms]
        return np.repeat(np.arange(self.count), np.concatenate([np.zeros(0, dtype=np.int64), *widths]))

    @cached_property
    def factors(self) -> IntArray:
        """(count,) factor of every row, numbered over all terms."""
        sizes = [np.full(term.count, term.size) for term in self._terms]
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *sizes])
        return np.repeat(np.arange(len(rows)), rows)

    @cached_property
    def columns(self) -> IntArray:
        """(length,) full tangent column of every entry."""
        parts = [np.zeros(0, dtype=np.int64)]
        for term in self._terms:
            count, rows, width, start = (int(term.place[field]) for field in (COUNT, ROWS, WIDTH, COLUMN))
            own = self._table.arrays.columns[start : start + count * width].reshape(count, 1, width)
            parts.append(np.broadcast_to(own, (count, rows, width)).ravel())
        return np.concatenate(parts)

    @cached_property
    def free(self) -> IntArray:
        """(F,) entries whose variable is not fixed."""
        return np.flatnonzero(self._table.arrays.unknown[self.columns] >= 0)

    @cached_property
    def free_rows(self) -> IntArray:
        """(F,) their rows."""
        return self.rows[self.free]

    @cached_property
    def free_columns(self) -> IntArray:
        """(F,) their unknowns."""
        return self._table.arrays.unknown[self.columns[self.free]]

    @cached_property
    def _compressed(self) -> tuple[IntArray, IntArray, IntArray]:
        """Slots of the free entries in the matrix compressed by columns, its row indices and column starts."""
        height = max(self.count, 1)
        unique, slots = np.unique(self.free_columns * height + self.free_rows, return_inverse=True)
        return slots, unique % height, np.searchsorted(unique, np.arange(self._unknowns + 1) * height)

    @property
    def nnz(self) -> int:
        """Entries of the compressed matrix."""
        return len(self._compressed[1])

    @property
    def indices(self) -> IntArray:
        """Row of every entry of the compressed matrix."""
        return self._compressed[1]

    @property
    def indptr(self) -> IntArray:
        """Start of each column of the compressed matrix."""
        return self._compressed[2]

    @property
    def slots(self) -> IntArray:
        """(F,) place of every free entry in the compressed matrix."""
        return self._compressed[0]

    def compress(self, entries: Array) -> Array:
        """Entries by columns (CSC order), repeated ones summed."""
        return scatter(self.slots, entries[self.free], self.nnz)

    def matrix(self, entries: Array) -> sp.csc_matrix:
        """The Jacobian over the unknowns as a SciPy matrix."""
        import scipy.sparse as sp  # slow to load

        _, indices, starts = self._compressed
        return sp.csc_matrix((self.compress(entries), indices, starts), shape=(self.count, self._unknowns))


@compiled
def all_finite(numbers: Array) -> bool:
    """Test whether every number is finite."""
    for number in numbers:
        if not math.isfinite(number):
            return False
    return True
