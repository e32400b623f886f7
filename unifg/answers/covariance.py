"""Covariances of unknowns: blocks of the inverse Hessian, or of the inverse KKT matrix, read off the elimination tree.

With constraints the (1, 1) block of [[H, A'], [A, 0]]^-1 is taken, A being the active rows: a direction that an
active constraint forbids has no variance. The tree would give the inverse of the matrix with its shift
(:mod:`unifg.elimination.saddle`), which weak directions feel; so every column is solved for and refined.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.saddle import SaddlePoint
from unifg.elimination.symmetric import Symmetric
from unifg.errors import GraphError
from unifg.program.linearization import Linearization
from unifg.program.program import Program
from unifg.typing import Array, BoolArray, IntArray

SOLVED = 1e-6  # residual of a column, in the equilibrated system, that belongs to a determined unknown
WEAK = 1e-13  # pivots below this, relative to the diagonal, are rounding errors
UNDETERMINED = "the covariance does not exist: some direction is not determined by the costs; run graph.check(guess)"


class Covariances:
    """The factorised information of a solution, to be asked repeatedly."""

    def __init__(self, program: Program, lin: Linearization, active: BoolArray) -> None:
        """Factorise.

        Args:
            program: the compiled graph.
            lin: linearisation at the solution.
            active: (M,) rows held as equalities.

        Raises:
            GraphError: when the information is singular or not finite.
        """
        self._program = program
        self._held: Held | None = None
        if active.any():
            self._held = Held.of(program, active)
            self._data = self._held.entries(lin)
            self._held.factor(self._data)
            return
        self._factorization = program.normal_solver()
        if not self._factorization.factor(lin.hessian):
            raise GraphError(UNDETERMINED)
        scale = lin.hessian[program.normal.diagonal][self._factorization.plan.order[: program.size]]
        if (self._factorization.pivots() <= WEAK * np.abs(scale)).any():
            raise GraphError(UNDETERMINED)

    def joint(self, columns: IntArray) -> Array:
        """(k, k) covariance over full tangent columns, zero for fixed ones, which are known.

        Raises:
            GraphError: when one of them is not determined.
        """
        chosen = self._program.columns.unknown[columns]
        free = np.flatnonzero(chosen >= 0)
        result = np.zeros((len(columns), len(columns)))
        if not len(free):
            return result
        if self._held is None:
            result[np.ix_(free, free)] = self._factorization.inverse_block(chosen[free])
        else:
            self._held.factor(self._data)
            result[np.ix_(free, free)] = self._held.block(chosen[free])
        return result

    def blocks(self, columns: IntArray) -> Array:
        """(n, d, d) marginal covariance of each row of (n, d) full tangent columns, zero for fixed ones.

        Raises:
            GraphError: when one of them is not determined.
        """
        if self._held is not None:
            return np.array([self.joint(row) for row in columns])
        chosen = self._program.columns.unknown[columns]
        _, first, node = np.unique(self._program.blocks, return_index=True, return_inverse=True)
        every = self._factorization.diagonal_blocks()
        result = np.zeros((*columns.shape, columns.shape[1]))
        for k, row in enumerate(chosen):
            free = np.flatnonzero(row >= 0)
            if len(free):
                own = node[row[free[0]]]
                place = row[free] - first[own]
                result[k][np.ix_(free, free)] = every[own][np.ix_(place, place)]
        return result


class Held:
    """The KKT matrix of a graph with some rows held; its structure is kept for the next solution of the same graph."""

    def __init__(self, program: Program, active: BoolArray) -> None:
        """Number the held rows after the unknowns."""
        n, constraints = program.size, program.constraints
        self.active = active.copy()
        number = np.full(len(active), -1, dtype=np.intp)
        number[active] = n + np.arange(int(active.sum()))
        kept = number[constraints.free_rows] >= 0
        self._entries = constraints.free[kept]
        columns, rows = constraints.free_columns[kept], number[constraints.free_rows[kept]]
        normal = program.normal
        across = np.repeat(np.arange(n), np.diff(normal.indptr))
        pattern = Symmetric(n + int(active.sum()), [(normal.indices, across), (columns, rows)])
        self._normal, self._places = pattern.positions(normal.indices, across), pattern.positions(columns, rows)
        self._saddle = SaddlePoint(Factorization(pattern, _labels(program, active)), n)
        self._factored: Array | None = None  # no solution, which would keep its program alive

    @staticmethod
    def of(program: Program, active: BoolArray) -> Held:
        """The structure used last, if it is for the same rows."""
        held = _LAST.get(program)
        if held is None or not np.array_equal(held.active, active):
            held = _LAST[program] = Held(program, active)
        return held

    def entries(self, lin: Linearization) -> Array:
        """(nnz,) entries of the matrix at a linearisation."""
        data = np.zeros(self._saddle.factorization.pattern.nnz)
        data[self._normal] = lin.hessian
        np.add.at(data, self._places, lin.constraint_jacobian[self._entries])
        return data

    def factor(self, data: Array) -> None:
        """Factorise, unless these very entries were the last to be.

        Raises:
            GraphError: when an entry is not finite.
        """
        if self._factored is data:
            return
        self._factored = None
        if not self._saddle.factor(data):
            raise GraphError("the covariance does not exist: the Hessian is not finite")
        self._factored = data

    def block(self, chosen: IntArray) -> Array:
        """(k, k) block of the inverse over unknowns.

        Raises:
            GraphError: when one of them is not determined.
        """
        block, right = np.empty((len(chosen), len(chosen))), np.zeros(self._saddle.factorization.pattern.size)
        for k, row in enumerate(chosen):
            right[row] = 1.0
            solution, _ = self._saddle.solve(right)
            if not np.abs(self._saddle.residual(solution, right)).max() <= SOLVED * self._saddle.scale[row]:
                raise GraphError(UNDETERMINED)
            block[:, k] = solution[chosen]
            right[row] = 0.0
        return 0.5 * (block + block.T)


_LAST: WeakKeyDictionary[Program, Held] = WeakKeyDictionary()


def _labels(program: Program, active: BoolArray) -> IntArray:
    """(n + m,) node of each unknown and held row: the rows of one factor are one node."""
    factor = np.zeros(len(active), dtype=np.int64)
    for k, (term, part) in enumerate(zip(program.constraint_terms, program.slices, strict=True)):
        factor[part] = (k << 40) + np.arange(part.stop - part.start) // term.size
    last = int(program.blocks[-1]) + 1 if program.size else 0
    return np.concatenate([program.blocks, last + np.unique(factor[active], return_inverse=True)[1].ravel()])
