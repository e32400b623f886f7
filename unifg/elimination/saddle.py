"""Saddle-point systems [[H, A'], [A, 0]] with H positive semidefinite, in whatever units their rows and columns are.

The matrix is factorised with something added to its diagonal that makes it quasi-definite (M. Saunders, "Cholesky-based
methods for sparse least squares: the benefits of regularization", 1996), and refined until that is gone. One number for
all rows would be lost in the rounding of some and outweigh others, so every row gets its own: a small part of one in
the matrix equilibrated by a diagonal D, D K D, whose rows all have a largest entry near one (D. Ruiz, "A scaling
algorithm to equilibrate both rows and columns norms in matrices", RAL-TR-2001-034). Residuals are measured there too.

Where an unknown without curvature is eliminated first, its shift s is its pivot: its rows of A get 1 / s on their
diagonals and between each other, and cancel down to terms of size one, or to the shift, where several of them share it.
Doubles keep the former for any s above their spacing, the latter only for s above the root of the spacing. So a
factorisation that breaks down, or whose refined solution is not accurate, is repeated with such a shift.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.elimination import substitution
from unifg.elimination.factorization import Factorization
from unifg.jit import compiled
from unifg.typing import Array, IntArray

SHIFT = 1e-12  # on the diagonal of the equilibrated matrix
SAFE_SHIFT = 2.0**-24  # not lost beside its own inverse; leaves more to refinement
ACCURATE = 1e-8  # residual above which a factorisation with the small shift counts as spoilt by rounding
SWEEPS = 4
CORRECTIONS = 12


class SaddlePoint:
    """Systems of one pattern: unknowns first, then multipliers.

    Attributes:
        factorization: of the shifted matrix.
        unknowns: number of rows of H.
        scale: (n,) diagonal that equilibrates the last matrix.
    """

    def __init__(self, factorization: Factorization, unknowns: int) -> None:
        """Remember the structure."""
        size = factorization.pattern.size
        self.factorization = factorization
        self.unknowns = unknowns
        self.scale: Array = np.ones(size)
        self._indptr = factorization.pattern.indptr.astype(np.int64)
        self._indices = factorization.pattern.indices.astype(np.int64)
        self._data: Array = np.zeros(factorization.pattern.nnz)
        self._added: Array = np.zeros(size)
        self._shift = SHIFT

    def factor(self, data: Array) -> bool:
        """Equilibrate, shift and factorise; False when an entry is not finite.

        Where a pivot vanishes all the same, because rounding took the shift, the larger shift is tried.

        Args:
            data: (nnz,) entries in the order of the pattern, kept until the next call.

        Raises:
            UnifgError: the array has the wrong shape, or the structure asked for makes no sense.
        """
        self._data = data
        equilibrate(self._indptr, self._indices, data, self.scale, self._added, SWEEPS)
        return self._factor(SHIFT) or self._factor(SAFE_SHIFT)

    def _factor(self, shift: float) -> bool:
        self._shift = shift
        np.divide(shift, self.scale, out=self._added)
        self._added /= self.scale
        self._added[self.unknowns :] *= -1.0
        return self.factorization.factor(self._data, self._added)

    def solve(self, right: Array) -> tuple[Array, float]:
        """Solve the system that was factorised, without its shift.

        Args:
            right: (n,).

        Returns:
            (n,) solution and its residual, relative to max (|K| |x| + |right|), both of the equilibrated system; the
            larger one of the unknowns' rows and of the multipliers' rows, each relative to its own size: multipliers
            that blow up do not hide that constraints contradict each other.
        """
        out, error = self._refine(right)
        if error <= ACCURATE or self._shift == SAFE_SHIFT:
            return out, error
        if not self._factor(SAFE_SHIFT):
            self._factor(SHIFT)
            return out, error
        again, less = self._refine(right)
        return (again, less) if less < error else (out, error)

    def _refine(self, right: Array) -> tuple[Array, float]:
        out = np.empty(len(right))
        error = substitution.refine(
            self.factorization.plan,
            self._indptr,
            self._indices,
            self._data,
            right,
            self.scale,
            self.unknowns,
            out,
            1e-15,
            CORRECTIONS,
        )
        return out, float(error)

    def residual(self, solution: Array, right: Array) -> Array:
        """(n,) right - K x of the equilibrated system."""
        rest: Array = self.scale * (right - self.factorization.pattern.times(self._data, solution))
        return rest


@compiled
def equilibrate(indptr: IntArray, indices: IntArray, data: Array, scale: Array, size: Array, sweeps: int) -> None:
    """Find D that makes the largest entry of every row of D K D near one; one where a row is empty.

    Args:
        indptr: upper triangle of K by columns.
        indices: its rows.
        data: its entries.
        scale: (n,) receives D.
        size: (n,) to work in.
        sweeps: of Ruiz' iteration; the distance from one halves in the logarithm with each.
    """
    scale[:] = 1.0
    for _ in range(sweeps):
        size[:] = 0.0
        for column in range(len(scale)):
            own, largest = scale[column], size[column]
            for e in range(indptr[column], indptr[column + 1]):
                row = indices[e]
                entry = abs(data[e]) * own * scale[row]
                largest = max(largest, entry)
                size[row] = max(size[row], entry)
            size[column] = max(size[column], largest)
        for row in range(len(scale)):
            if 0.0 < size[row] < np.inf:
                scale[row] /= math.sqrt(size[row])
