"""Quadratics over a graph of blocks: what first guesses, relaxations and certificates come down to."""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric, scatter
from unifg.errors import GraphError
from unifg.lie import SE3, SO3, LieGroup
from unifg.typing import Array, IntArray

__all__ = ["BlockQuadratic", "block_gradient", "block_least_squares", "polar", "with_rotations"]

ROUNDS, NEARLY = 6, 1e-8  # of Newton's iteration for frames, whose last one leaves this squared


def polar(matrices: Array) -> Array:
    """(n, d, r) orthonormal rows nearest to the rows of matrices, d <= r.

    Newton's iteration squares what is left of rows that nearly are (N. Higham, SIAM J. Sci. Stat. Comput. 7, 1986).
    """
    result = matrices
    for _ in range(ROUNDS):
        excess = result @ np.swapaxes(result, 1, 2) - np.eye(matrices.shape[1])
        most = float(np.abs(excess).max(initial=0.0))
        if not most < 0.5:
            break
        result = result - 0.5 * excess @ result
        if most <= NEARLY:
            return result
    left, _, right = np.linalg.svd(matrices, full_matrices=False)
    found: Array = left @ right
    return found


def with_rotations(group: LieGroup, poses: Array, matrices: Array) -> Array:
    """Poses (n, storage) with the rotations nearest to (n, d, d) matrices in the place of their own."""
    result = poses.copy()
    if group is SE3:
        result[:, 3:] = SO3.from_matrix(matrices)
    else:  # the nearest rotation maximises tr(R' M)
        sine, cosine = matrices[:, 1, 0] - matrices[:, 0, 1], matrices[:, 0, 0] + matrices[:, 1, 1]
        result[:, 2] = np.arctan2(sine, cosine)
    return result


class BlockQuadratic:
    """The matrix of sum |A x_i + B x_j|^2 over blocks x of one size: pattern once, entries as often as needed.

    Attributes:
        free: positions of the blocks that are not known.
        factorization: of the matrix over the free blocks, (free * d) scalars.
    """

    def __init__(self, first: IntArray, second: IntArray, count: int, dim: int, fixed: IntArray) -> None:
        """Find the pattern.

        Args:
            first: (m,) blocks i.
            second: (m,) blocks j.
            count: number of blocks.
            dim: numbers in a block.
            fixed: positions of blocks that are known.
        """
        self.count, self.dim = count, dim
        self.free: IntArray = np.setdiff1d(np.arange(count), fixed)
        self._real = first != second  # an edge from a block to itself says nothing
        self._first, self._second = first[self._real], second[self._real]
        unknown = np.full(count, -1, dtype=np.intp)
        unknown[self.free] = np.arange(len(self.free))
        self._between = (unknown[self._first] >= 0) & (unknown[self._second] >= 0)
        left, right = unknown[self._first[self._between]], unknown[self._second[self._between]]
        self._swapped = left > right
        left, right = np.minimum(left, right), np.maximum(left, right)
        pattern = Symmetric.of_blocks(dim * np.arange(len(self.free) + 1), left, right)
        self._size = pattern.nnz
        nodes = np.arange(len(self.free))
        self._upper = np.triu(np.ones((dim, dim), dtype=bool))
        self._own_places = pattern.positions(*self._scalars(nodes, nodes, self._upper))
        self._shared_places = pattern.positions(*self._scalars(left, right, np.ones((dim, dim), dtype=bool)))
        self.factorization = Factorization(pattern, np.repeat(nodes, dim))

    def _scalars(self, rows: IntArray, columns: IntArray, kept: Array) -> tuple[IntArray, IntArray]:
        steps, shape = np.arange(self.dim), (len(rows), self.dim, self.dim)
        place = np.broadcast_to((rows * self.dim)[:, None, None] + steps[:, None], shape)[:, kept].ravel()
        beside = np.broadcast_to((columns * self.dim)[:, None, None] + steps, shape)[:, kept].ravel()
        return place, beside

    def entries(self, by_first: Array, by_second: Array, added: Array | None = None) -> Array:
        """(nnz,) entries of the matrix over the free blocks.

        Args:
            by_first: (m, r, d) A, whitened.
            by_second: (m, r, d) B, whitened.
            added: (n, d, d) symmetric, added to the diagonal blocks.
        """
        by_first, by_second = by_first[self._real], by_second[self._real]
        own = np.zeros((self.count, self.dim, self.dim)) if added is None else added.copy()
        np.add.at(own, self._first, np.swapaxes(by_first, 1, 2) @ by_first)
        np.add.at(own, self._second, np.swapaxes(by_second, 1, 2) @ by_second)
        shared = np.swapaxes(by_first[self._between], 1, 2) @ by_second[self._between]
        shared = np.where(self._swapped[:, None, None], np.swapaxes(shared, 1, 2), shared)
        result: Array = scatter(self._own_places, own[self.free][:, self._upper].ravel(), self._size)
        result += scatter(self._shared_places, shared.ravel(), self._size)
        return result

    def solve(self, right: Array) -> Array:
        """(free, d, k) solution for right-hand sides (free, d, k), once the factorisation has been made."""
        return self.factorization.solve(right.reshape(len(self.free) * self.dim, -1)).reshape(right.shape)


def block_gradient(
    first: IntArray, second: IntArray, by_first: Array, by_second: Array, error: Array, count: int
) -> Array:
    """(count, d, k) sum of A' e and B' e over the edges of every block, for errors (m, r, k)."""
    real = first != second
    total = np.zeros((count, by_first.shape[2], error.shape[2]))
    np.add.at(total, first[real], np.swapaxes(by_first[real], 1, 2) @ error[real])
    np.add.at(total, second[real], np.swapaxes(by_second[real], 1, 2) @ error[real])
    return total


def block_least_squares(
    first: IntArray, second: IntArray, by_first: Array, by_second: Array, target: Array, start: Array, fixed: IntArray
) -> Array:
    """Minimise the sum of |A x_i + B x_j - c|^2 over blocks x, several right-hand sides at once.

    Args:
        first: (m,) blocks i.
        second: (m,) blocks j.
        by_first: (m, r, d) A, whitened.
        by_second: (m, r, d) B, whitened.
        target: (m, r, k) c, whitened.
        start: (n, d, k) values; those of fixed blocks are kept, the others do not matter for the answer.
        fixed: positions of blocks that are known.

    Returns:
        (n, d, k) blocks.

    Raises:
        GraphError: the measurements do not determine the blocks.
    """
    count, dim, _ = start.shape
    system = BlockQuadratic(first, second, count, dim, fixed)
    result = start.copy()
    if not len(system.free):
        return result
    error = by_first @ start[first] + by_second @ start[second] - target
    gradient = block_gradient(first, second, by_first, by_second, error, count)
    if not system.factorization.factor(system.entries(by_first, by_second)):
        raise GraphError("the first guess is not determined: an information matrix does not see some direction")
    result[system.free] -= system.solve(gradient[system.free])
    return result
