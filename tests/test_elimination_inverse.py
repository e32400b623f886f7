"""Entries of the inverse from the tree, and the tree itself."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from test_elimination import full, grid, system
from test_elimination_chain import horizon
from unifg.elimination.factorization import Factorization
from unifg.errors import UnifgError


@pytest.mark.parametrize("ordering", ["auto", "minimum-degree", "nested-dissection", "natural"])
def test_selected_inverse(rng: np.random.Generator, ordering: str) -> None:
    for pattern, data, label, _ in (grid(rng, 9, 3), horizon(rng, 20, 3, 2, False), horizon(rng, 12, 3, 2, True)):
        factorization = Factorization(pattern, label, ordering=ordering)  # type: ignore[arg-type]
        assert factorization.factor(data)
        inverse = np.linalg.inv(full(pattern, data).toarray())
        columns = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
        scale = np.abs(inverse).max()
        assert np.abs(factorization.selected_inverse() - inverse[pattern.indices, columns]).max() < 1e-10 * scale
        for node, block in enumerate(factorization.diagonal_blocks()):
            own = np.flatnonzero(label == node)
            assert np.abs(block - inverse[np.ix_(own, own)]).max() < 1e-10 * scale


def test_blocks_of_mixed_sizes(rng: np.random.Generator) -> None:
    sizes = [1, 4, 2, 3, 1, 6, 2, 2]
    pattern, data, label, _ = system(
        rng, sizes, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 7), (0, 7), (2, 5)]
    )
    factorization = Factorization(pattern, label)
    assert factorization.factor(data)
    blocks = factorization.diagonal_blocks()
    assert [block.shape for block in blocks] == [(size, size) for size in sizes]
    inverse = np.linalg.inv(full(pattern, data).toarray())
    for node, block in enumerate(blocks):
        own = np.flatnonzero(label == node)
        assert np.allclose(block, inverse[np.ix_(own, own)], atol=1e-12)


def test_joint_covariances(rng: np.random.Generator) -> None:
    """On the path of one front only that path is computed; far apart, solves give the same."""
    pattern, data, label, _ = grid(rng, 12, 2)
    factorization = Factorization(pattern, label, ordering="minimum-degree")
    assert factorization.factor(data)
    inverse = np.linalg.inv(full(pattern, data).toarray())
    node = int(factorization.structure.order[0])  # a leaf
    near = np.flatnonzero(label == node)
    assert np.allclose(factorization.inverse_block(near), inverse[np.ix_(near, near)], atol=1e-12)
    assert factorization._inverse is not None
    assert 0 < factorization._inverse[1].sum() < len(factorization.tree)
    far = np.array([0, 5, pattern.size - 1, pattern.size // 2])
    assert np.allclose(factorization.inverse_block(far), inverse[np.ix_(far, far)], atol=1e-12)
    assert np.allclose(factorization.selected_inverse()[pattern.diagonal], np.diag(inverse), atol=1e-12)
    assert factorization.factor(4.0 * data)
    assert np.allclose(factorization.inverse_block(near), inverse[np.ix_(near, near)] / 4.0, atol=1e-12)
    assert not factorization.factor(np.zeros(pattern.nnz))
    with pytest.raises(UnifgError, match="successful factor"):
        factorization.inverse_block(near)


@pytest.mark.parametrize("ordering", ["auto", "minimum-degree", "nested-dissection", "natural"])
def test_blocks_between_nodes_anywhere(rng: np.random.Generator, ordering: str) -> None:
    """Positive definite and quasi-definite, chains, grids and forests, near and far, twice the same node."""
    grids = grid(rng, 9, 3), grid(rng, 10, 2)
    forest = system(rng, [2, 2, 2, 2, 2, 2], [(0, 1), (1, 2), (3, 4), (4, 5)])
    for pattern, data, label, _ in (*grids, horizon(rng, 20, 3, 2, False), horizon(rng, 12, 3, 2, True), forest):
        factorization = Factorization(pattern, label, ordering=ordering)  # type: ignore[arg-type]
        assert factorization.factor(data)
        inverse = np.linalg.inv(full(pattern, data).toarray())
        scale = np.abs(inverse).max()
        nodes = rng.integers(0, label[-1] + 1, (12, 2))
        nodes[1:4, 0] = nodes[0, 0]
        nodes[5] = nodes[6]
        nodes[7, 1] = nodes[7, 0]
        for i, j in nodes.tolist():
            rows = np.flatnonzero((label == i) | (label == j))
            assert np.abs(factorization.inverse_block(rows) - inverse[np.ix_(rows, rows)]).max() < 1e-10 * scale
        own = [np.array([np.flatnonzero(label == k)[:1] for k in nodes[:, e]]) for e in range(2)]
        blocks = factorization.inverse_blocks(*own)
        both = np.concatenate(own, axis=1)
        assert np.abs(blocks - inverse[both[:, :, None], both[:, None, :]]).max() < 1e-10 * scale
    assert not factorization._clean.any()
    assert factorization.inverse_blocks(own[0][:0], own[1][:0]).shape == (0, 2, 2)


def test_products_of_sparse_blocks(rng: np.random.Generator) -> None:
    """Rows of one block that occur twice are added; blocks follow each other."""
    pattern, data, label, _ = grid(rng, 9, 3)
    factorization = Factorization(pattern, label)
    assert factorization.factor(data)
    inverse = np.linalg.inv(full(pattern, data).toarray())
    rows, starts = rng.integers(0, pattern.size, 17), [0, 5, 6, 17]
    rows[3] = rows[1]
    values = rng.standard_normal((17, 3))
    found = factorization.products(np.array(starts), rows, values)
    for k in range(3):
        block = np.zeros((pattern.size, 3))
        np.add.at(block, rows[starts[k] : starts[k + 1]], values[starts[k] : starts[k + 1]])
        np.testing.assert_allclose(found[k], block.T @ inverse @ block, rtol=1e-9, atol=1e-12)


def test_tree_describes_the_elimination(rng: np.random.Generator) -> None:
    pattern, data, label, _ = grid(rng, 8, 3)
    factorization = Factorization(pattern, label)
    tree = factorization.tree
    assert sorted(np.concatenate([tree.nodes(s) for s in range(len(tree))]).tolist()) == list(range(64))
    assert tree.pivots.sum() == pattern.size
    for s in range(len(tree)):
        p = int(tree.parent[s])
        given = set(tree.separators[s].tolist())
        assert 3 * len(given) == tree.rows[s]
        if p >= 0:
            assert p > s
            assert given <= set(tree.nodes(p).tolist()) | set(tree.separators[p].tolist())  # running intersection
        else:
            assert not given
    assert 1 < tree.height <= len(tree)
    assert tree.fill >= pattern.nnz
    assert tree.flops > 0.0
    text = tree.text(lambda node: f"x[{node}]", limit=3)
    assert "x[" in text
    assert text.splitlines()[-1] == f"... {len(tree) - 3} more"
    assert " | " in str(tree)
    assert factorization.factor(data)


def test_pickles_carry_the_structure(rng: np.random.Generator) -> None:
    pattern, data, label, _ = grid(rng, 4, 2)
    factorization = Factorization(pattern, label)
    assert factorization.factor(data)
    copy = pickle.loads(pickle.dumps(factorization))
    assert copy.factor(data)
    right = rng.normal(size=pattern.size)
    assert np.array_equal(copy.solve(right), factorization.solve(right))


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda f, data, label: f.factor(data[:-1]), "data has shape"),
        (lambda f, data, label: f.factor(np.append(data, 0.0)), "data has shape"),
        (lambda f, data, label: f.factor(data, np.zeros(3)), "added has shape"),
        (lambda f, data, label: f.solve(np.zeros(f.pattern.size + 1)), "shape"),
        (lambda f, data, label: f.solve(np.zeros((3, 2))), "shape"),
        (lambda f, data, label: f.solve(np.zeros((f.pattern.size, 2, 2))), "shape"),
        (lambda f, data, label: Factorization(f.pattern, label, ordering="amd").factor(data), "unknown"),  # type: ignore[arg-type]
    ],
)
def test_wrong_shapes_are_refused(ask: Any, words: str, rng: np.random.Generator) -> None:
    pattern, data, label, _ = grid(rng, 3, 2)
    factorization = Factorization(pattern, label)
    assert factorization.factor(data)
    with pytest.raises(UnifgError, match=words):
        ask(factorization, data, label)
