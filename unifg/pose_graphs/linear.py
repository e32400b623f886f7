"""Linear least squares over a graph of blocks: what every first guess comes down to."""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric, scatter
from unifg.errors import GraphError
from unifg.typing import Array, IntArray

__all__ = ["block_least_squares"]


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
    count, dim, sides = start.shape
    real = first != second  # an edge from a block to itself says nothing
    first, second, by_first, by_second, target = (part[real] for part in (first, second, by_first, by_second, target))
    unknown = np.full(count, -1, dtype=np.intp)
    free = np.setdiff1d(np.arange(count), fixed)
    unknown[free] = np.arange(len(free))
    if not len(free):
        return start.copy()
    error = by_first @ start[first] + by_second @ start[second] - target
    gradient = np.zeros((count, dim, sides))
    np.add.at(gradient, first, np.swapaxes(by_first, 1, 2) @ error)
    np.add.at(gradient, second, np.swapaxes(by_second, 1, 2) @ error)

    own = np.zeros((count, dim, dim))
    np.add.at(own, first, np.swapaxes(by_first, 1, 2) @ by_first)
    np.add.at(own, second, np.swapaxes(by_second, 1, 2) @ by_second)
    between = (unknown[first] >= 0) & (unknown[second] >= 0)
    left, right = unknown[first[between]], unknown[second[between]]
    shared = np.swapaxes(by_first[between], 1, 2) @ by_second[between]
    shared = np.where((left <= right)[:, None, None], shared, np.swapaxes(shared, 1, 2))
    left, right = np.minimum(left, right), np.maximum(left, right)
    nodes, steps = np.arange(len(free)), np.arange(dim)
    pattern = Symmetric.of_blocks(dim * np.arange(len(free) + 1), left, right)
    entries = np.zeros(pattern.nnz)
    upper = np.triu(np.ones((dim, dim), dtype=bool))
    for rows, columns, blocks, kept in (
        (nodes, nodes, own[free], upper),
        (left, right, shared, np.ones((dim, dim), dtype=bool)),
    ):
        place = np.broadcast_to((rows * dim)[:, None, None] + steps[:, None], blocks.shape)[:, kept].ravel()
        beside = np.broadcast_to((columns * dim)[:, None, None] + steps, blocks.shape)[:, kept].ravel()
        entries += scatter(pattern.positions(place, beside), blocks[:, kept].ravel(), pattern.nnz)
    system = Factorization(pattern, np.repeat(nodes, dim))
    if not system.factor(entries):
        raise GraphError("the first guess is not determined: an information matrix does not see some direction")
    descent = -gradient[free].reshape(len(free) * dim, sides)
    step = np.stack([system.solve(np.ascontiguousarray(descent[:, side])) for side in range(sides)], axis=1)
    result = start.copy()
    result[free] += step.reshape(len(free), dim, sides)
    return result
