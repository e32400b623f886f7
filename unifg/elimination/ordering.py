"""Graph of the nodes of a sparse symmetric matrix."""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.typing import IntArray


@compiled
def filled(size: int, value: int) -> IntArray:
    """Array of one integer; loops compile far sooner than array expressions."""
    result = np.empty(size, np.int64)
    for k in range(size):
        result[k] = value
    return result


@compiled
def block_graph(indptr: IntArray, indices: IntArray, label: IntArray, nodes: int) -> tuple[IntArray, IntArray]:
    """Graph of the nodes from the scalar pattern.

    Args:
        indptr: upper triangle by columns.
        indices: its rows.
        label: (n,) node of each scalar, non-decreasing from 0 to nodes - 1.
        nodes: number of nodes.

    Returns:
        Pointers (nodes + 1,) and neighbours of each node, both directions, without the node itself.
    """
    scalars = len(label)
    seen, pointer = filled(nodes, -1), filled(nodes + 1, 0)
    first, second = filled(0, 0), filled(0, 0)
    pairs = 0
    for sweep in range(2):
        if sweep == 1:
            first, second = np.empty(pairs, np.int64), np.empty(pairs, np.int64)
            pairs = 0
            for k in range(nodes):
                seen[k] = -1
        for column in range(scalars):
            b = label[column]
            previous = b
            for e in range(indptr[column], indptr[column + 1]):
                a = label[indices[e]]
                if a == previous:  # rows of one node follow each other
                    continue
                previous = a
                if a != b and seen[a] != b:
                    seen[a] = b
                    if sweep == 1:
                        first[pairs], second[pairs] = a, b
                        pointer[a + 1] += 1
                        pointer[b + 1] += 1
                    pairs += 1
    fill = np.empty(nodes, np.int64)
    for k in range(nodes):
        fill[k] = pointer[k]
        pointer[k + 1] += pointer[k]
    neighbours = np.empty(2 * pairs, np.int64)
    for k in range(pairs):
        a, b = first[k], second[k]
        neighbours[fill[a]] = b
        neighbours[fill[b]] = a
        fill[a] += 1
        fill[b] += 1
    return pointer, neighbours


@compiled
def indistinguishable(indptr: IntArray, indices: IntArray) -> IntArray:
    """Label scalars so that consecutive ones with the same neighbours, themselves included, share a label.

    Neighbourhoods are compared by a 64-bit sum of mixed indices.
    """
    scalars = len(indptr) - 1
    digest = filled(scalars, 0)
    mixed = np.empty(scalars, np.int64)
    for i in range(scalars):
        z = (i + 1) * -7046029254386353131
        z = (z ^ (z >> 30)) * -4658895280553007687
        z = (z ^ (z >> 27)) * -7723592293110705685
        mixed[i] = z ^ (z >> 31)
    for column in range(scalars):
        for e in range(indptr[column], indptr[column + 1]):
            row = indices[e]
            digest[column] += mixed[row]
            if row != column:
                digest[row] += mixed[column]
    label = filled(scalars, 0)
    for i in range(1, scalars):
        label[i] = label[i - 1] + (1 if digest[i] != digest[i - 1] else 0)
    return label
