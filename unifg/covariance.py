"""Covariances of unknowns: blocks of the inverse Hessian, or of the inverse KKT matrix, read off the elimination tree.

With constraints the (1, 1) block of [[H, A'], [A, 0]]^-1 is taken, A being the active rows: a direction that an
active constraint forbids has no variance.
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.errors import GraphError
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.sparse import Symmetric
from unifg.typing import Array, BoolArray, IntArray

REGULARISATION = 1e-9  # of the KKT matrix, relative to its largest entry; refined away
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
        self._constrained = bool(active.any())
        if self._constrained:
            self._factorise_kkt(lin, active)
            return
        self._factorization = program.normal_solver()
        if not self._factorization.factor(lin.hessian):
            raise GraphError(UNDETERMINED)
        scale = lin.hessian[program.normal.diagonal][self._factorization.plan.order[: program.size]]
        if (self._factorization.pivots() <= WEAK * np.abs(scale)).any():
            raise GraphError(UNDETERMINED)

    def joint(self, columns: IntArray) -> Array:
        """(k, k) covariance over full tangent columns.

        Raises:
            GraphError: when one of them is fixed, or not determined.
        """
        chosen = self._unknowns(columns)
        if not self._constrained:
            return self._factorization.inverse_block(chosen)
        result = np.empty((len(chosen), len(chosen)))
        for k, column in enumerate(chosen):
            right = np.zeros(self._pattern.size)
            right[column] = 1.0
            solution = self._factorization.refine(self._exact, right, steps=20)
            if np.abs(right - self._pattern.times(self._exact, solution)).max() > 1e-6:
                raise GraphError(UNDETERMINED)
            result[:, k] = solution[chosen]
        return 0.5 * (result + result.T)

    def blocks(self, columns: IntArray) -> Array:
        """(n, d, d) marginal covariance of each row of (n, d) full tangent columns.

        Raises:
            GraphError: when one of them is fixed, or not determined.
        """
        if self._constrained:
            return np.array([self.joint(row) for row in columns])
        chosen = self._unknowns(columns.ravel()).reshape(columns.shape)
        _, first, node = np.unique(self._program.blocks, return_index=True, return_inverse=True)
        every = self._factorization.diagonal_blocks()
        result = np.empty((*columns.shape, columns.shape[1]))
        for k, row in enumerate(chosen):
            place = row - first[node[row[0]]]
            result[k] = every[node[row[0]]][np.ix_(place, place)]
        return result

    def _unknowns(self, columns: IntArray) -> IntArray:
        chosen = self._program.columns.unknown[columns]
        if (chosen < 0).any():
            family, index = self._program.columns.name(int(columns[np.argmax(chosen < 0)]))
            raise GraphError(f"{family}[{index}] is fixed: it has no covariance", family=family, index=index)
        return chosen

    def _factorise_kkt(self, lin: Linearization, active: BoolArray) -> None:
        program, n = self._program, self._program.size
        hessian = program.normal.matrix(lin.hessian).tocoo()
        jacobian = program.constraints.matrix(lin.constraint_jacobian)[active].tocoo()
        total = n + jacobian.shape[0]
        self._pattern = Symmetric(total, [(hessian.row, hessian.col), (jacobian.col, n + jacobian.row)])
        self._exact = np.zeros(self._pattern.nnz)
        np.add.at(self._exact, self._pattern.positions(hessian.row, hessian.col), hessian.data)
        np.add.at(self._exact, self._pattern.positions(jacobian.col, n + jacobian.row), jacobian.data)
        scale = max(float(np.abs(lin.hessian).max(initial=0.0)), 1e-300)
        signs = np.where(np.arange(total) < n, 1.0, -1.0)
        self._factorization = Factorization(self._pattern)
        if not self._factorization.factor(self._exact, REGULARISATION * scale * signs):
            raise GraphError("the covariance does not exist: the Hessian is not finite")
