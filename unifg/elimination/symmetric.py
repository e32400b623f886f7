"""The pattern of a symmetric matrix, found once and filled many times."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import Array, IntArray

if TYPE_CHECKING:
    import scipy.sparse as sp


def scatter(slots: IntArray, numbers: Array, size: int) -> Array:
    """Sum ``numbers`` into ``size`` slots."""
    if not len(slots):  # bincount of nothing counts in integers
        return np.zeros(size)
    return np.asarray(np.bincount(slots, weights=numbers, minlength=size), dtype=np.float64)


def distinct(numbers: IntArray) -> IntArray:
    """Distinct numbers, sorted: of a million, np.unique's hash table (from NumPy 2.3 on) takes fifty times as long."""
    ordered = np.sort(numbers)
    return ordered[np.flatnonzero(np.diff(ordered, prepend=ordered[:1] - 1))]


class Symmetric:
    """Pattern of the upper triangle of a symmetric matrix, compressed by columns.

    Attributes:
        size: number of rows and columns.
        nnz: number of stored entries.
        indptr, indices: the compressed pattern, rows sorted within a column; the diagonal is always stored.
    """

    def __init__(self, size: int, entries: Sequence[tuple[IntArray, IntArray]]) -> None:
        """Unite (row, column) lists with row <= column, and the diagonal."""
        diagonal = np.arange(size)
        keys = [column * size + row for row, column in entries] + [diagonal * (size + 1)]
        unique = distinct(np.concatenate(keys))
        self.size = size
        self.nnz = len(unique)
        self.indices: IntArray = unique % max(size, 1)
        self.indptr: IntArray = np.searchsorted(unique, np.arange(size + 1) * size)

    @classmethod
    def of_blocks(cls, starts: IntArray, first: IntArray, second: IntArray) -> Symmetric:
        """Unite dense blocks.

        Args:
            starts: (V + 1,) where the rows of each node start.
            first: nodes of the rows of every block.
            second: nodes of its columns, first <= second, in any order and with repetitions; the diagonal blocks are
                always part of the pattern.
        """
        count = len(starts) - 1
        own = np.arange(count)
        keys = distinct(np.concatenate([second * count + first, own * (count + 1)]))
        self = cls.__new__(cls)
        self.size = int(starts[-1])
        lengths = np.diff(starts)
        rows_above = np.zeros(count + 1, dtype=np.intp)  # entries in the first column of each node, without its own
        first, second = keys % max(count, 1), keys // max(count, 1)
        np.add.at(rows_above, second, np.where(first < second, lengths[first], 0))
        column_of = np.repeat(own, lengths)
        depth = np.arange(self.size) - starts[column_of] + 1
        self.indptr = np.concatenate([[0], np.cumsum(rows_above[column_of] + depth)]).astype(np.intp)
        self.nnz = int(self.indptr[-1])
        self.indices = np.empty(self.nnz, dtype=np.intp)
        _expand(starts, first, second, self.indptr, self.indices)
        return self

    @cached_property
    def diagonal(self) -> IntArray:
        """(size,) where the diagonal is stored: last in every column."""
        return self.indptr[1:] - 1

    def positions(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Positions of the given entries."""
        return np.searchsorted(self.columns * self.size + self.indices, columns * self.size + rows)

    def times(self, data: Array, vector: Array) -> Array:
        """The symmetric matrix with upper triangle ``data`` times a vector."""
        out = np.zeros(self.size)
        add_times(self.indptr, self.indices, data, np.ascontiguousarray(vector, dtype=np.float64), out)
        return out

    def matrix(self, data: Array) -> sp.csc_matrix:
        """Upper triangle as a SciPy matrix sharing ``data``."""
        import scipy.sparse as sp  # slow to load

        return sp.csc_matrix((data, self.indices, self.indptr), shape=(self.size, self.size))

    @cached_property
    def columns(self) -> IntArray:
        """(nnz,) column of every entry."""
        return np.repeat(np.arange(self.size), np.diff(self.indptr))


@compiled
def _expand(starts: IntArray, first: IntArray, second: IntArray, indptr: IntArray, indices: IntArray) -> None:
    """Write the rows of every column, for blocks sorted by second, then first."""
    filled = np.zeros(len(indptr), dtype=np.intp)
    for block in range(len(first)):
        own = first[block] == second[block]
        for column in range(starts[second[block]], starts[second[block] + 1]):
            at = indptr[column] + filled[column]
            last = column + 1 if own else starts[first[block] + 1]
            for row in range(starts[first[block]], last):
                indices[at] = row
                at += 1
            filled[column] = at - indptr[column]


@compiled
def add_times(indptr: IntArray, indices: IntArray, data: Array, vector: Array, out: Array) -> None:
    """Add the product of the symmetric matrix with upper triangle ``data`` and a vector to ``out``."""
    for column in range(len(out)):
        total = 0.0
        for at in range(indptr[column], indptr[column + 1]):
            row = indices[at]
            total += data[at] * vector[row]
            if row != column:
                out[row] += data[at] * vector[column]
        out[column] += total
