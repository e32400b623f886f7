"""The one sparse linear-algebra route: LDL' of a symmetric (quasi-)definite matrix.

This is the seam behind which a factor-graph elimination engine can take over. Today it holds QDLDL: symbolic
analysis and ordering once per pattern, numeric factorisation as often as needed.
"""

from __future__ import annotations

import numpy as np
import qdldl

from unifg.sparse import Symmetric
from unifg.typing import Array


class Factorization:
    """Factorises matrices of one sparsity pattern."""

    def __init__(self, pattern: Symmetric) -> None:
        """Remember the pattern; the ordering is found at the first factorisation."""
        self.pattern = pattern
        self._matrix = pattern.matrix(np.zeros(pattern.nnz))
        self._solver: qdldl.Solver | None = None
        self._ready = False

    def factor(self, data: Array) -> bool:
        """Factorise; False when the matrix is not finite or has a zero pivot."""
        self._ready = False
        if not np.isfinite(data).all():
            return False
        self._matrix.data[:] = data
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(self._matrix, upper=True)
            else:
                self._solver.update(self._matrix, upper=True)
        except RuntimeError:
            self._solver = None
            return False
        self._ready = True
        return True

    def solve(self, right: Array) -> Array:
        """Solve for one right-hand side with the last factorisation."""
        if not self._ready or self._solver is None:
            raise RuntimeError("solve called before a successful factor")
        solution: Array = self._solver.solve(right)
        return solution

    def pivots(self) -> Array:
        """Diagonal D of the factorisation, in elimination order."""
        if not self._ready or self._solver is None:
            raise RuntimeError("pivots called before a successful factor")
        diagonal: Array = self._solver.factors()[1]
        return diagonal
