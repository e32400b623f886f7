"""Covariances of unknowns: blocks of the inverse Hessian, or of the inverse KKT matrix, read off the elimination tree.

With constraints the (1, 1) block of [[H, A'], [A, 0]]^-1 is taken, A being the active rows: a direction that an
active constraint forbids has no variance. The tree would give the inverse of the matrix with its shift
(:mod:`unifg.elimination.saddle`), which weak directions feel; so every column is solved for and refined.
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import WEAK
from unifg.errors import GraphError
from unifg.locks import ReentrantLock
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.systems import KktStructure, KktSystem, fill
from unifg.solution.multipliers import size_of_costs
from unifg.typing import Array, BoolArray, IntArray

SOLVED = 1e-6  # residual of a column, in the equilibrated system, that belongs to a determined unknown
UNDETERMINED = "the covariance does not exist: some direction is not determined by the costs; run graph.check(guess)"


class Covariances:
    """The factorised information of a solution, to be asked repeatedly."""

    def __init__(self, program: CompiledProblem, lin: Linearization, active: BoolArray) -> None:
        """Factorise, or remember what to.

        Args:
            program: the compiled graph.
            lin: linearisation at the solution.
            active: (M,) rows held as equalities.

        Raises:
            GraphError: when the information is singular.
        """
        self._program = program
        self._lock = ReentrantLock()
        self._structure: KktStructure | None = None
        if active.any():
            self._structure = program.systems.structure(active)
            self._lin, self._data = lin, np.zeros(0)
            self._unit = size_of_costs(program, lin)  # beside which rows of constraints are not large
            return
        self._factorization = program.systems.normal()
        diagonal = lin.hessian[program.normal.diagonal]
        if not (self._factorization.factor(lin.hessian) and self._factorization.weakest(diagonal) > WEAK):
            raise GraphError(UNDETERMINED)

    def joint(self, columns: IntArray) -> Array:
        """(k, k) covariance over full tangent columns, zero for fixed ones, which are known.

        Raises:
            GraphError: when one of them is not determined, or the information is not finite.
        """
        chosen = self._program.columns.unknown[columns]
        free = np.flatnonzero(chosen >= 0)
        result = np.zeros((len(columns), len(columns)))
        if not len(free):
            return result
        if self._structure is None:
            with self._lock:
                result[np.ix_(free, free)] = self._factorization.inverse_block(chosen[free])
            return result
        with self._lock, self._structure.borrowed() as system:
            if not len(self._data):
                self._data = np.zeros(system.pattern.nnz)
                fill(system.arrays, self._lin.hessian / self._unit, self._lin.constraint_jacobian, self._data)
            if not system.load(self._data):
                raise GraphError("the covariance does not exist: the Hessian is not finite")
            result[np.ix_(free, free)] = _inverse_block(system, chosen[free]) / self._unit
        return result

    def blocks(self, columns: IntArray) -> Array:
        """(n, d, d) marginal covariance of each row of (n, d) full tangent columns, zero for fixed ones.

        Raises:
            GraphError: when one of them is not determined.
        """
        if self._structure is not None:
            return np.array([self.joint(row) for row in columns])
        chosen = self._program.columns.unknown[columns]
        _, first, node = np.unique(self._program.blocks, return_index=True, return_inverse=True)
        with self._lock:
            every = self._factorization.diagonal_blocks()
        result = np.zeros((*columns.shape, columns.shape[1]))
        for k, row in enumerate(chosen):
            free = np.flatnonzero(row >= 0)
            if len(free):
                own = node[row[free[0]]]
                place = row[free] - first[own]
                result[k][np.ix_(free, free)] = every[own][np.ix_(place, place)]
        return result

    def pairs(self, first: IntArray, second: IntArray) -> Array:
        """(n, k + m, k + m) joint covariance of each row of (n, k) with that of (n, m) full tangent columns.

        Raises:
            GraphError: when one of them is not determined.
        """
        unknown = self._program.columns.unknown
        if self._structure is None and not ((unknown[first] < 0).any() or (unknown[second] < 0).any()):
            with self._lock:
                return self._factorization.inverse_blocks(unknown[first], unknown[second])
        both = np.concatenate([first, second], axis=1)
        return np.array([self.joint(row) for row in both]).reshape(len(both), both.shape[1], both.shape[1])


def _inverse_block(system: KktSystem, chosen: IntArray) -> Array:
    """(k, k) block of the inverse of a factorised KKT matrix over unknowns.

    Raises:
        GraphError: when one of them is not determined.
    """
    block, right = np.empty((len(chosen), len(chosen))), np.zeros(system.pattern.size)
    for k, row in enumerate(chosen):
        right[row] = 1.0
        solution, _ = system.saddle.solve(right)
        if not np.abs(system.saddle.residual(solution, right)).max() <= SOLVED * system.saddle.scale[row]:
            raise GraphError(UNDETERMINED)
        block[:, k] = solution[chosen]
        right[row] = 0.0
    return 0.5 * (block + block.T)
