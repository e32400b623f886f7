"""Sparsity found once, numbers scattered many times.

A :class:`Rows` holds where the entries of a stacked Jacobian sit; a :class:`Symmetric` is the upper triangle of
a symmetric matrix; a :class:`Gram` turns Jacobian entries into the entries of J' D J through index arrays that
are computed once, so that forming normal equations is a gather, a product and a scatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from unifg.typing import Array, IntArray


def scatter(slots: IntArray, numbers: Array, size: int) -> Array:
    """Sum ``numbers`` into ``size`` slots."""
    if not len(slots):  # bincount of nothing counts in integers
        return np.zeros(size)
    return np.asarray(np.bincount(slots, weights=numbers, minlength=size), dtype=np.float64)


class Symmetric:
    """Pattern of the upper triangle of a symmetric matrix, compressed by columns.

    Attributes:
        size: number of rows and columns.
        indptr, indices: the compressed pattern, rows sorted within a column; the diagonal is always stored.
    """

    def __init__(self, size: int, entries: Sequence[tuple[IntArray, IntArray]]) -> None:
        """Unite (row, column) lists with row <= column, and the diagonal."""
        diagonal = np.arange(size)
        keys = [column * size + row for row, column in entries] + [diagonal * (size + 1)]
        self.size = size
        self._keys = np.unique(np.concatenate(keys))
        self.indices = self._keys % max(size, 1)
        self.indptr = np.searchsorted(self._keys, np.arange(size + 1) * size)
        self._column = self._keys // max(size, 1)
        self.diagonal = self.positions(diagonal, diagonal)

    @property
    def nnz(self) -> int:
        """Number of stored entries."""
        return len(self._keys)

    def positions(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Where the given entries are stored."""
        return np.searchsorted(self._keys, columns * self.size + rows)

    def times(self, data: Array, vector: Array) -> Array:
        """The symmetric matrix with upper triangle ``data`` times a vector."""
        above = data * vector[self._column]
        below = data * vector[self.indices]
        below[self.diagonal] = 0.0
        return scatter(self.indices, above, self.size) + scatter(self._column, below, self.size)

    def matrix(self, data: Array) -> sp.csc_matrix:
        """Upper triangle as a SciPy matrix sharing ``data``."""
        return sp.csc_matrix((data, self.indices, self.indptr), shape=(self.size, self.size))


class Rows:
    """Pattern of a stacked Jacobian restricted to free columns.

    Attributes:
        count: number of rows.
        rows, columns: (E,) place of every entry in the full tangent space, in evaluation order.
        free: (F,) entries whose variable is not fixed.
        free_rows, free_columns: their places among the unknowns.
    """

    def __init__(self, count: int, rows: IntArray, columns: IntArray, unknown: IntArray, unknowns: int) -> None:
        """Restrict entries to unknown columns; ``unknown`` maps full columns to unknowns or -1."""
        self.count = count
        self.rows = rows
        self.columns = columns
        self.width = len(unknown)
        self.unknowns = unknowns
        mapped = unknown[columns]
        self.free = np.flatnonzero(mapped >= 0)
        self.free_rows = rows[self.free]
        self.free_columns = mapped[self.free]
        self.all_free = len(self.free) == len(rows)
        keys = self.free_columns * max(count, 1) + self.free_rows
        unique, self._slots = np.unique(keys, return_inverse=True)
        self.indices = unique % max(count, 1)
        self.indptr = np.searchsorted(unique, np.arange(unknowns + 1) * max(count, 1))
        self.nnz = len(unique)

    def compress(self, flat: Array) -> Array:
        """Entries by columns (CSC order), repeated ones summed."""
        return scatter(self._slots, self._restrict(flat), self.nnz)

    def matrix(self, flat: Array) -> sp.csc_matrix:
        """The Jacobian over the unknowns as a SciPy matrix."""
        return sp.csc_matrix((self.compress(flat), self.indices, self.indptr), shape=(self.count, self.unknowns))

    def times(self, flat: Array, vector: Array) -> Array:
        """J v for a vector over the unknowns."""
        return scatter(self.free_rows, self._restrict(flat) * vector[self.free_columns], self.count)

    def transposed_times(self, flat: Array, vector: Array) -> Array:
        """J' v over the full tangent space, fixed variables included."""
        return scatter(self.columns, flat * vector[self.rows], self.width)

    def _restrict(self, flat: Array) -> Array:
        return flat if self.all_free else flat[self.free]


def upper_pairs(columns: IntArray, unknown: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Pairs (a, b) of columns of each factor that fall into the upper triangle over the unknowns.

    Args:
        columns: (n, D) full columns of each factor.
        unknown: full column to unknown, or -1.

    Returns:
        The (n, D) unknowns, and for every pair its factor, a and b.
    """
    mapped = unknown[columns]
    keep = (mapped[:, :, None] <= mapped[:, None, :]) & (mapped[:, :, None] >= 0)
    factor, a, b = np.nonzero(keep)
    return mapped, factor, a, b


class Gram:
    """Products of Jacobian entries that share a row: what the entries of J' D J are sums of.

    Attributes:
        coordinates: (row, column) of every product among the unknowns, row <= column.
    """

    def __init__(self, blocks: Sequence[tuple[IntArray, IntArray]], rows: Rows, unknown: IntArray) -> None:
        """Enumerate the products.

        Args:
            blocks: for each term, entry numbers (n, m, D) and their full columns (n, D).
            rows: the pattern the entries belong to.
            unknown: full column to unknown, or -1.
        """
        none = np.zeros(0, dtype=np.intp)
        first, second, row, column = [none], [none], [none], [none]
        for entries, columns in blocks:
            mapped, factor, a, b = upper_pairs(columns, unknown)
            size = entries.shape[1]
            first.append(entries[factor, :, a].ravel())
            second.append(entries[factor, :, b].ravel())
            row.append(np.repeat(mapped[factor, a], size))
            column.append(np.repeat(mapped[factor, b], size))
        self._first, self._second = np.concatenate(first), np.concatenate(second)
        self._weight = rows.rows[self._first]
        self.coordinates = np.concatenate(row), np.concatenate(column)

    def products(self, flat: Array, weights: Array | None = None) -> Array:
        """J[p] J[q], times the weight of their row."""
        products: Array = flat[self._first] * flat[self._second]
        if weights is not None:
            products *= weights[self._weight]
        return products
