"""Elimination of all but the last scalars of a system, which become the root of the tree."""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.ordering import indistinguishable
from unifg.elimination.symmetric import Symmetric
from unifg.typing import Array

ROUNDING = 1e-13  # pivots that are smaller, of the entry on the diagonal, are made of rounding


class Reduction:
    """Schur complement of a positive semidefinite matrix A on its last scalars, which A need not determine.

    A minimum of d'A d / 2 + g'd over the first scalars leaves s'S s / 2 + h's of the last: S is :attr:`matrix`, h is
    :meth:`reduce` of g, and :meth:`step` is the minimum for given s. A is factorised with a diagonal added to the last.
    """

    def __init__(self, pattern: Symmetric, kept: int) -> None:
        """Order the first scalars before the last ``kept``."""
        gone = pattern.size - kept
        label = indistinguishable(pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64))
        label[gone:] += 1  # a node is of the first or of the last
        last = int(label[-1] - label[gone]) + 1 if kept else 0
        self._tree = Factorization(pattern, label, last=last)
        self._kept, self._added, self._held = slice(gone, pattern.size), np.zeros(pattern.size), np.zeros((0, 0))

    def factor(self, data: Array) -> bool:
        """Factorise, from entries in the order of the pattern; False where the first scalars are not determined."""
        tree, diagonal = self._tree, data[self._tree.pattern.diagonal]
        self._added[self._kept] = np.where(diagonal > 0.0, diagonal, 1.0)[self._kept]
        done = tree.factor(data, self._added) and tree.definite
        done = done and bool((tree.pivots() > ROUNDING * (diagonal + self._added)[tree.plan.order]).all())
        if done:
            self._held = tree.last_block(self._kept.stop - self._kept.start)
        return done

    @property
    def matrix(self) -> Array:
        """(k, k) Schur complement."""
        return self._held - np.diag(self._added[self._kept])

    def reduce(self, gradient: Array) -> tuple[Array, float]:
        """(k,) gradient that is left of (n,), and how much eliminating lowers twice the cost."""
        solved = self._tree.solve(gradient)
        left: Array = self._held @ solved[self._kept]
        return left, float(gradient @ solved - left @ solved[self._kept])

    def step(self, gradient: Array, kept: Array) -> Array:
        """(n,) lowest point for (k,) given last scalars."""
        right = -gradient
        right[self._kept] += self._held @ kept + self.reduce(gradient)[0]
        return self._tree.solve(right)
