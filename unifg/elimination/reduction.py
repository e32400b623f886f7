"""Elimination of all but the last scalars of a system, which become the root of the tree."""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import WEAK, Factorization
from unifg.elimination.symmetric import Symmetric
from unifg.typing import Array


class Reduction:
    """Schur complement of a positive semidefinite matrix A on its last scalars, which A need not determine.

    A minimum of d'A d / 2 + g'd over the first scalars leaves s'S s / 2 + h's of the last: S is :attr:`matrix`, h is
    :meth:`reduce` of g, and :meth:`step` is the minimum for given s. A is factorised with a diagonal added to the last.
    """

    def __init__(self, pattern: Symmetric, kept: int) -> None:
        """Order the first scalars before the last ``kept``."""
        self._tree, self._kept = Factorization(pattern, last=kept), slice(pattern.size - kept, pattern.size)
        self._added, self._held = np.zeros(pattern.size), np.zeros((kept, kept))

    def factor(self, data: Array) -> bool:
        """Factorise, from entries in the order of the pattern; False where the first scalars are not determined."""
        tree, diagonal = self._tree, data[self._tree.pattern.diagonal]
        self._added[self._kept] = np.where(diagonal > 0.0, diagonal, 1.0)[self._kept]
        done = tree.factor(data, self._added) and tree.weakest(diagonal + self._added) > WEAK
        if done:
            self._held = tree.last_block()
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
