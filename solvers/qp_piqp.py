"""PIQP, called directly: a proximal interior point with a workspace per structure.

Takes 7-20 iterations where OSQP takes hundreds once obstacles are active, and says so when a problem is
infeasible. Equalities, inequalities and the pattern of both are fixed at setup; when data turn an inequality into
an equality the workspace is rebuilt.
"""

from __future__ import annotations

import numpy as np
import piqp
import scipy.sparse as sp

from unifg.program import Program
from unifg.solvers.qp import QP, QPAnswer, qp_error
from unifg.typing import Array, BoolArray, IntArray

INFINITY = 1e30  # PIQP treats larger limits as absent
TIGHTEST = 1e-9


class PiqpRoute:
    """A persistent PIQP workspace.

    Attributes:
        name: "piqp".
    """

    name = "piqp"

    def __init__(self, program: Program) -> None:
        """Remember the pattern; PIQP is set up with the first numbers."""
        self.program = program
        self._solver: piqp.SparseSolver | None = None
        self._hessian = program.hessian.matrix(np.zeros(program.hessian.nnz))

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve to ``accuracy`` and measure; interior points start cold, so ``multipliers`` are not used."""
        equal = qp.lower == qp.upper
        fresh = self._solver is None or not np.array_equal(equal, self._equal)
        if fresh:
            self._split(equal)
        assert self._solver is not None
        self._solver.settings.eps_abs = float(np.clip(0.1 * accuracy, TIGHTEST, 1e-6))
        entries = self.program.constraints.compress(qp.jacobian)
        self._hessian.data[:] = qp.hessian
        self._equalities.data[:] = entries[self._equality_entries]
        self._inequalities.data[:] = entries[self._inequality_entries]
        numbers = {
            "P": self._hessian,
            "c": qp.gradient,
            "A": self._equalities,
            "b": qp.lower[equal],
            "G": self._inequalities,
            "h_l": np.maximum(qp.lower[~equal], -INFINITY),
            "h_u": np.minimum(qp.upper[~equal], INFINITY),
        }
        if fresh:
            self._solver.setup(**numbers)
        else:
            self._solver.update(**numbers)
        status = self._solver.solve()
        result = self._solver.result
        iterations = int(result.info.iter)
        if status in (piqp.PIQP_PRIMAL_INFEASIBLE, piqp.PIQP_DUAL_INFEASIBLE):
            zero = np.zeros(self.program.size)
            infeasible = status == piqp.PIQP_PRIMAL_INFEASIBLE
            return QPAnswer(zero, multipliers, self.name, iterations, np.inf, infeasible)
        step, dual = np.array(result.x), np.zeros(len(equal))
        dual[equal] = result.y
        dual[~equal] = np.asarray(result.z_u) - np.asarray(result.z_l)
        return QPAnswer(step, dual, self.name, iterations, qp_error(qp, step, dual))

    def _split(self, equal: BoolArray) -> None:
        """Find which entries of A belong to equalities, and start a new workspace."""
        self._equal = equal.copy()
        self._equality_entries, self._equalities = self._part(equal)
        self._inequality_entries, self._inequalities = self._part(~equal)
        self._solver = piqp.SparseSolver()
        self._solver.settings.eps_rel = 0.0
        self._solver.settings.eps_duality_gap_rel = 0.0
        self._solver.settings.max_iter = 100

    def _part(self, rows: BoolArray) -> tuple[IntArray, sp.csc_matrix]:
        """Positions of the entries of chosen rows, and the matrix they make."""
        constraints = self.program.constraints
        chosen = np.flatnonzero(rows[constraints.indices])
        place = np.cumsum(rows) - 1
        column = np.repeat(np.arange(self.program.size), np.diff(constraints.indptr))[chosen]
        indptr = np.searchsorted(column, np.arange(self.program.size + 1))
        matrix = sp.csc_matrix(
            (np.zeros(len(chosen)), place[constraints.indices[chosen]], indptr),
            shape=(int(rows.sum()), self.program.size),
        )
        return chosen, matrix
