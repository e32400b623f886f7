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
from typing import NamedTuple

import numpy as np

from unifg.codegen.jit import compiled, in_order
from unifg.elimination import substitution
from unifg.elimination.factorization import Factorization
from unifg.elimination.fronts import factor
from unifg.elimination.plan import Plan
from unifg.errors import UnifgError
from unifg.typing import Array, IntArray

SHIFT = 1e-12  # on the diagonal of the equilibrated matrix
SAFE_SHIFT = 2.0**-24  # not lost beside its own inverse; leaves more to refinement
ACCURATE = 1e-8  # residual above which a factorisation with the small shift counts as spoilt by rounding
EXACT = 1e-15  # residual that refinement strives for
SWEEPS, NEAR = 4, 4.0
CORRECTIONS = 12
NOTHING: Array = np.zeros(0)


class SaddleArrays(NamedTuple):
    """Arrays for compiled code.

    Attributes:
        indptr, indices: upper triangle of the matrix by columns.
        starts, rows, entries: the same without zeros, and its numbers.
        scale: (n,) diagonal that equilibrates it.
        added: (n,) what is added to its diagonal.
    """

    indptr: IntArray
    indices: IntArray
    starts: IntArray
    rows: IntArray
    entries: Array
    scale: Array
    added: Array


class SaddlePoint:
    """Systems of one pattern: unknowns first, then multipliers.

    Attributes:
        factorization: of the shifted matrix.
        unknowns: number of rows of H.
        arrays: for compiled code.
        scale: (n,) diagonal that equilibrates the last matrix.
    """

    def __init__(self, factorization: Factorization, unknowns: int) -> None:
        """Remember the structure."""
        size = factorization.pattern.size
        self.factorization = factorization
        self.unknowns = unknowns
        indptr, indices = factorization.symbolic.indptr, factorization.symbolic.indices
        self._data: Array = np.zeros(factorization.pattern.nnz)
        numbers = np.zeros_like(self._data), np.ones(size), np.zeros(size)
        self.arrays = SaddleArrays(indptr, indices, np.zeros_like(indptr), np.zeros_like(indices), *numbers)
        self.scale, self._shift = self.arrays.scale, SHIFT

    def factor(self, data: Array, near: Array = NOTHING) -> bool:
        """Equilibrate, shift and factorise; False when an entry is not finite.

        Where a pivot vanishes all the same, because rounding took the shift, the larger shift is tried.

        Args:
            data: (nnz,) entries in the order of the pattern, kept until the next call.
            near: (n,) diagonal D of a matrix like this one, where the new one starts; empty without one.

        Raises:
            UnifgError: the array has the wrong shape, or the structure asked for makes no sense.
        """
        data = np.ascontiguousarray(data, dtype=np.float64)
        if data.shape != self.arrays.indices.shape:
            raise UnifgError(f"data has shape {data.shape}; expected {self.arrays.indices.shape}")
        success = bool(prepared(self.factorization.plan, self.arrays, data, self.unknowns, near))
        return self.adopt(data, success) or self._factor(SAFE_SHIFT)

    def adopt(self, data: Array, success: bool, shift: float = SHIFT) -> bool:
        """Take over what :func:`prepared` or :func:`shifted` has made of entries in compiled code, and its answer."""
        self._data, self._shift = data, shift
        self.factorization.adopt(success)
        return success

    def _factor(self, shift: float) -> bool:
        plan, added = self.factorization.plan, self.arrays.added
        return self.adopt(self._data, bool(shifted(plan, self._data, self.scale, self.unknowns, shift, added)), shift)

    def solve(self, right: Array, enough: float = EXACT) -> tuple[Array, float]:
        """Solve the system that was factorised, without its shift.

        Args:
            right: (n,).
            enough: residual at which refinement ends.

        Returns:
            (n,) solution and its residual, relative to max (|K| |x| + |right|), both of the equilibrated system; the
            larger one of the unknowns' rows and of the multipliers' rows, each relative to its own size: multipliers
            that blow up do not hide that constraints contradict each other.
        """
        out, error = self._refine(right, enough)
        if error <= ACCURATE or self._shift == SAFE_SHIFT:
            return out, error
        if not self._factor(SAFE_SHIFT):
            self._factor(SHIFT)
            return out, error
        again, less = self._refine(right, enough)
        return (again, less) if less < error else (out, error)

    def _refine(self, right: Array, enough: float) -> tuple[Array, float]:
        out, rest = np.empty(len(right)), np.empty(len(right))
        error = substitution.refine(
            self.factorization.plan,
            *self.arrays[2:5],
            right,
            self.scale,
            self.unknowns,
            out,
            rest,
            enough,
            0.0,
            CORRECTIONS,
        )
        return out, float(error)

    def residual(self, solution: Array, right: Array) -> Array:
        """(n,) right - K x of the equilibrated system."""
        return self.scale * (right - self.factorization.pattern.times(self._data, solution))


@compiled
def prepared(plan: Plan, saddle: SaddleArrays, data: Array, unknowns: int, near: Array) -> bool:
    """:func:`compress`, :func:`equilibrate` and :func:`shifted`, from the diagonal ``near`` unless that is empty."""
    begun = len(near) > 0
    for k in range(len(saddle.scale)):
        saddle.scale[k] = near[k] if begun else 1.0
    compress(saddle.indptr, saddle.indices, data, saddle.starts, saddle.rows, saddle.entries)
    equilibrate(saddle.starts, saddle.rows, saddle.entries, saddle.scale, saddle.added, NEAR if begun else 1.0)
    return shifted(plan, data, saddle.scale, unknowns, SHIFT, saddle.added)


@compiled
def shifted(plan: Plan, data: Array, scale: Array, unknowns: int, shift: float, added: Array) -> bool:
    """Factorise with ``shift`` on the diagonal of the equilibrated matrix, negative for multipliers."""
    shifts(scale, unknowns, shift, added)
    return factor(plan, data, added)


@in_order
def shifts(scale: Array, unknowns: int, shift: float, added: Array) -> None:
    """The shift of every row in its own units."""
    for k in range(len(scale)):
        added[k] = (shift if k < unknowns else -shift) / scale[k] / scale[k]


@compiled
def compress(
    indptr: IntArray, indices: IntArray, data: Array, starts: IntArray, rows: IntArray, entries: Array
) -> None:
    """Leave out zeros, which a fixed pattern has many of: ``starts``, ``rows``, ``entries`` receive the same matrix."""
    count = 0
    for column in range(len(indptr) - 1):
        starts[column] = count
        for e in range(indptr[column], indptr[column + 1]):
            rows[count], entries[count] = indices[e], data[e]
            count += data[e] != 0.0
    starts[len(indptr) - 1] = count


@compiled
def equilibrate(indptr: IntArray, indices: IntArray, data: Array, scale: Array, size: Array, enough: float) -> None:
    """Improve D until the largest entry of every row of D K D is near one; a row that is empty keeps its own.

    Args:
        indptr: upper triangle of K by columns.
        indices: its rows.
        data: its entries.
        scale: (n,) D: ones, or that of a matrix like this one.
        size: (n,) to work in.
        enough: factor from one that calls for another sweep of Ruiz' iteration, which halves it in the logarithm.
    """
    for _ in range(SWEEPS):
        size[:], furthest = 0.0, 1.0
        for column in range(len(scale)):
            own, largest = scale[column], size[column]
            for e in range(indptr[column], indptr[column + 1]):
                row = indices[e]
                entry = abs(data[e]) * own * scale[row]
                largest = max(largest, entry)
                size[row] = max(size[row], entry)
            size[column] = max(size[column], largest)
        for row in range(len(scale)):
            own = size[row] if 0.0 < size[row] < np.inf else 1.0
            scale[row] /= math.sqrt(own)
            furthest = max(furthest, own, 1.0 / own)
        if furthest <= enough:
            break
