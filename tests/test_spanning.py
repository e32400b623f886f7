"""Spanning trees of measurements, beside SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree

from unifg.pose_graphs.spanning import spanning_tree
from unifg.typing import Array, BoolArray, IntArray

Edges = tuple[IntArray, IntArray, Array]


def tangle(count: int, edges: int, seed: int) -> Edges:
    """Random edges, some of them loops at one node, some beside each other, many of equal cost."""
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, count, (2, edges))
    return (
        first,
        second,
        rng.choice([0.5, 1.0, 2.0, 1e-3, 1e6], edges) * rng.choice([1.0, rng.uniform(1.0, 2.0)], edges),
    )


def lightest(edges: Edges, count: int) -> coo_matrix:
    """Of edges beside each other the cheapest, none from a node to itself; both ways."""
    best: dict[tuple[int, int], float] = {}
    for i, j, cost in zip(*(array.tolist() for array in edges), strict=True):
        if i != j:
            pair = min(i, j), max(i, j)
            best[pair] = min(cost, best.get(pair, np.inf))
    pairs = np.array(list(best)).reshape(-1, 2)
    return coo_matrix((list(best.values()), (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def check(edges: Edges, parent: IntArray, edge: IntArray, forward: BoolArray, roots: IntArray) -> IntArray:
    """Every edge of the tree leads to the parent, and every way to a root; how deep each node is, -1 for none."""
    first, second, _ = edges
    count = len(edge)
    assert parent[count] == count and (parent[roots] == count).all() and (edge[roots] == -1).all()
    inner = np.flatnonzero(edge >= 0)
    begin, end = np.where(
        forward[inner], (first[edge[inner]], second[edge[inner]]), (second[edge[inner]], first[edge[inner]])
    )
    assert np.array_equal(begin, parent[inner]) and np.array_equal(end, inner)
    depth = np.full(count, -1)
    for node in range(count):
        at, steps = node, 0
        while parent[at] not in (-1, count):
            at, steps = int(parent[at]), steps + 1
            assert steps <= count, "a ring"
        if parent[at] == count:
            depth[node] = steps
    return depth


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("count", "edges"), [(1, 0), (2, 1), (7, 4), (30, 40), (200, 900)])
def test_trees_are_as_light_and_paths_as_short_as_scipys(count: int, edges: int, seed: int) -> None:
    graph = tangle(count, edges, seed)
    roots = np.unique(np.random.default_rng(seed).integers(0, count, 1 + seed % 3))
    matrix = lightest(graph, count)
    lengths = dijkstra(matrix.tocsr(), directed=False, indices=roots).min(axis=0)
    for shortest in (True, False):
        parent, edge, forward = spanning_tree(*graph, roots, count, shortest)
        depth = check(graph, parent, edge, forward, roots)
        assert np.array_equal(depth >= 0, np.isfinite(lengths))
        if shortest:
            walked = np.zeros(count)
            for node in np.argsort(depth):
                if edge[node] >= 0:
                    walked[node] = walked[parent[node]] + graph[2][edge[node]]
            np.testing.assert_allclose(walked[depth >= 0], lengths[depth >= 0], rtol=1e-12)
        else:
            held = np.full(count + 1, 1e-9)  # of an edge from each root to one node above them
            above = coo_matrix((held[: len(roots)], (roots, np.full(len(roots), count))), shape=(count + 1, count + 1))
            grown = coo_matrix((matrix.data, (matrix.row, matrix.col)), shape=(count + 1, count + 1)) + above
            reached = np.append(depth >= 0, True)
            grown = grown.tocsr()[reached][:, reached]
            weight = minimum_spanning_tree(grown).sum() - 1e-9 * len(roots)
            assert graph[2][edge[edge >= 0]].sum() == pytest.approx(weight, rel=1e-12, abs=1e-6)


def test_of_equal_ways_the_lower_numbers_are_taken() -> None:
    first, second = np.array([0, 0, 1, 2, 1]), np.array([1, 2, 3, 3, 3])
    parent, edge, forward = spanning_tree(first, second, np.ones(5), np.array([0]), 4, True)
    assert parent.tolist() == [4, 0, 0, 1, 4] and edge.tolist() == [-1, 0, 1, 2] and forward.tolist()[1:] == [True] * 3
