"""Factorisation of block-sparse symmetric systems: accuracy, inertia, refusals."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numba import types

from unifg.elimination import symbolic
from unifg.elimination.analysis import SLACK
from unifg.elimination.dense import MANY, subtract_signed
from unifg.elimination.factorization import Factorization, Ordering
from unifg.elimination.symmetric import Symmetric
from unifg.errors import UnifgError
from unifg.typing import Array, BoolArray, IntArray

System = tuple[Symmetric, Array, IntArray, BoolArray]


def system(rng: np.random.Generator, sizes: list[int], edges: list[tuple[int, int]], multipliers: int = 0) -> System:
    """Random matrix on a graph of blocks; the last ``multipliers`` nodes get a negative definite diagonal, -1e-3 I."""
    starts = np.concatenate([[0], np.cumsum(sizes)])
    n, primal = int(starts[-1]), len(sizes) - multipliers
    dense, present = np.zeros((n, n)), np.zeros((n, n), dtype=bool)
    for a, b in edges:
        rows, columns = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
        if max(a, b) < primal:
            jacobian = rng.normal(size=(sizes[a] + sizes[b], sizes[a] + sizes[b]))
            gram = jacobian.T @ jacobian
            dense[rows, rows] += gram[: sizes[a], : sizes[a]]
            dense[columns, columns] += gram[sizes[a] :, sizes[a] :]
            dense[rows, columns] += gram[: sizes[a], sizes[a] :]
            dense[columns, rows] += gram[sizes[a] :, : sizes[a]]
        else:
            coupling = rng.normal(size=(sizes[a], sizes[b]))
            dense[rows, columns] += coupling
            dense[columns, rows] += coupling.T
        present[rows, columns] = present[columns, rows] = True
    for k, size in enumerate(sizes):
        inside = slice(starts[k], starts[k + 1])
        dense[inside, inside] += np.eye(size) * (1.0 if k < primal else -1e-3)
        present[inside, inside] = True
    rows_, columns_ = np.nonzero(np.triu(present))
    pattern = Symmetric(n, [(rows_, columns_)])
    data = dense[pattern.indices, np.repeat(np.arange(n), np.diff(pattern.indptr))]
    label = np.repeat(np.arange(len(sizes)), sizes)
    return pattern, data, label, label >= primal


def grid(rng: np.random.Generator, side: int, size: int) -> System:
    """Four-connected grid of side x side nodes."""
    number = np.arange(side * side).reshape(side, side)
    pairs = [*zip(number[:, :-1].ravel(), number[:, 1:].ravel(), strict=True)]
    pairs += [*zip(number[:-1].ravel(), number[1:].ravel(), strict=True)]
    return system(rng, [size] * side * side, [(int(a), int(b)) for a, b in pairs])


def full(pattern: Symmetric, data: Array) -> sp.csc_matrix:
    """Both triangles."""
    upper = pattern.matrix(data)
    return upper + sp.triu(upper, 1).T


def backward_error(matrix: sp.csc_matrix, x: Array, right: Array) -> float:
    """Normwise, in the maximum norm."""
    size = np.abs(matrix).sum(axis=1).max() * np.abs(x).max() + np.abs(right).max()
    return float(np.abs(right - matrix @ x).max() / size)


def solving(
    rng: np.random.Generator, pattern: Symmetric, data: Array, error: float, *label: IntArray, **options: Any
) -> Factorization:
    """Factorization that solves a random system to less than a backward error."""
    factorization = Factorization(pattern, *label, **options)
    assert factorization.factor(data)
    right = rng.normal(size=pattern.size)
    assert backward_error(full(pattern, data), factorization.solve(right), right) < error
    return factorization


ORDERINGS: list[Ordering] = ["auto", "minimum-degree", "nested-dissection", "natural"]


@pytest.mark.parametrize("ordering", [*ORDERINGS, None])
@pytest.mark.parametrize("side", [1, 2, 6, 12])
def test_positive_definite_grids(rng: np.random.Generator, side: int, ordering: Ordering | None) -> None:
    pattern, data, label, _ = grid(rng, side, 3)
    chosen: Ordering = rng.permutation(side * side) if ordering is None else ordering
    factorization = solving(rng, pattern, data, 1e-14, label, ordering=chosen)
    assert factorization.inertia == (pattern.size, 0, 0)
    assert factorization.definite
    assert factorization.failure == -1


@pytest.mark.parametrize("size", [40, 150])
@pytest.mark.parametrize("multipliers", [0, 1])
def test_large_fronts(multipliers: int, rng: np.random.Generator, size: int) -> None:
    """Fronts wide enough for BLAS, positive and signed."""
    pattern, data, label, _ = system(rng, [size] * 4, [(0, 1), (1, 2), (0, 2), (1, 3), (2, 3)], multipliers)
    factorization = solving(rng, pattern, data, 1e-11, label)
    assert factorization.inertia == (size * (4 - multipliers), size * multipliers, 0)
    assert factorization.definite == (multipliers == 0)


graphs = st.integers(2, 14).flatmap(
    lambda nodes: st.tuples(
        st.lists(st.integers(1, 4), min_size=nodes, max_size=nodes),
        st.lists(st.tuples(st.integers(0, nodes - 1), st.integers(0, nodes - 1)).filter(lambda e: e[0] != e[1])),
        st.integers(0, nodes // 3),
    )
)


@pytest.mark.parametrize(("size", "depth", "start"), [(333, 96, 0), (701, 200, 0), (520, 100, 136)])
def test_rows_side_by_side_give_the_same_bits(rng: np.random.Generator, size: int, depth: int, start: int) -> None:
    step, stride = size + 3, size + 5
    numbers = rng.normal(size=step * depth + stride * size + SLACK)
    signs = np.repeat([1.0, -1.0, 1.0], [depth // 2, 9, depth - depth // 2 - 9])
    factor = numbers[: step * depth].reshape(depth, step)[:, :size]
    place = step * depth

    def square(numbers: Array) -> Array:
        return numbers[place : place + stride * size].reshape(size, stride)[:, :size]

    def subtract(rows: int) -> Array:
        """So many rows in a call."""
        mine = numbers.copy()
        for first in range(start, size, rows):
            subtract_signed(
                mine.ctypes.data, place, stride, size, 0, step, depth, signs.ctypes.data, 0, first,
                min(first + rows, size),
            )  # fmt: skip
        assert np.array_equal(mine[:place], numbers[:place])
        assert np.array_equal(mine[place + stride * size :], numbers[place + stride * size :])
        assert np.array_equal(np.tril(square(mine), -4), np.tril(square(numbers), -4))
        return np.triu(square(mine))[start:]

    together = subtract(size)
    np.testing.assert_allclose(
        together, np.triu(square(numbers) - factor.T @ (signs[:, None] * factor))[start:], rtol=1e-9, atol=1e-9
    )
    assert np.array_equal(together, subtract(MANY - 8))


@given(graphs, st.integers(0, 2**32 - 1))
def test_any_graph(graph: tuple[list[int], list[tuple[int, int]], int], seed: int) -> None:
    """Against a dense solve, with and without multipliers, in every ordering, with and without labels."""
    sizes, edges, multipliers = graph
    rng = np.random.default_rng(seed)
    primal = len(sizes) - multipliers
    edges = [(min(e), max(e)) for e in edges if min(e) < primal]
    pattern, data, label, negative = system(rng, sizes, edges, multipliers)
    added = np.where(negative, -1.0, 1.0)
    dense = full(pattern, data).toarray() + np.diag(added)
    right = rng.normal(size=(pattern.size, 3))
    for ordering in ORDERINGS:
        for blocks in (label, None):
            factorization = Factorization(pattern, blocks, ordering=ordering)
            assert factorization.factor(data, added)
            x = factorization.solve(right)
            assert np.abs(right - dense @ x).max() < 1e-9 * (1.0 + np.abs(x).max())
            assert np.allclose(factorization.solve(right[:, 0]), x[:, 0], rtol=1e-9, atol=1e-12)
            assert factorization.inertia == (int((~negative).sum()), int(negative.sum()), 0)


def test_added_diagonal_is_not_remembered(rng: np.random.Generator) -> None:
    pattern, data, label, _ = grid(rng, 5, 2)
    factorization = Factorization(pattern, label)
    right, added = rng.normal(size=pattern.size), rng.uniform(1.0, 2.0, size=pattern.size)
    assert factorization.factor(data, added)
    damped = factorization.solve(right)
    assert backward_error(full(pattern, data) + sp.diags(added), damped, right) < 1e-14
    assert factorization.factor(data)
    assert backward_error(full(pattern, data), factorization.solve(right), right) < 1e-14


def test_refinement_removes_regularisation(rng: np.random.Generator) -> None:
    """[[H, A'], [A, 0]] from the factors of [[H + dI, A'], [A, -dI]]."""
    edges = [(k, k + 1) for k in range(9)] + [(k, 10 + k) for k in range(9)] + [(k + 1, 10 + k) for k in range(9)]
    pattern, data, label, negative = system(rng, [3] * 10 + [2] * 9, edges, 9)
    data[pattern.diagonal[negative]] = 0.0
    added = np.where(negative, -1e-7, 1e-7)
    factorization = Factorization(pattern, label)
    assert factorization.factor(data, added)
    assert factorization.inertia == (30, 18, 0)
    right = rng.normal(size=pattern.size)
    matrix = full(pattern, data)
    assert backward_error(matrix, factorization.solve(right), right) > 1e-10
    assert backward_error(matrix, factorization.refine(data, right), right) < 1e-15


def test_failures_name_the_scalar(rng: np.random.Generator) -> None:
    pattern, data, label, _ = grid(rng, 4, 3)
    factorization = Factorization(pattern, label, ordering="natural")
    with pytest.raises(UnifgError, match="successful factor"):
        factorization.solve(np.zeros(pattern.size))
    loose = data.copy()
    columns = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    loose[(columns == 10) | (pattern.indices == 10)] = 0.0
    assert not factorization.factor(loose)
    assert factorization.failure == 10
    assert factorization.inertia[2] == 1
    assert not factorization.definite
    for bad in (np.nan, np.inf, -np.inf):
        for entry in (0, 7, pattern.nnz - 2):
            spoiled = data.copy()
            spoiled[entry] = bad
            assert not factorization.factor(spoiled)
            assert factorization.failure >= 0
    assert factorization.factor(data)
    assert factorization.failure == -1


def test_free_gauge_is_noticed(rng: np.random.Generator) -> None:
    """A chain of differences without a prior is singular."""
    n = 200
    pattern = Symmetric(n, [(np.arange(n - 1), np.arange(1, n))])
    data = np.full(pattern.nnz, -1.0)
    data[pattern.diagonal] = 2.0
    data[pattern.diagonal[[0, -1]]] = 1.0
    factorization = Factorization(pattern)
    assert not factorization.factor(data)
    assert factorization.factor(data, np.full(n, 1e-9))


def test_negative_pivots_are_counted(rng: np.random.Generator) -> None:
    pattern, data, label, _ = grid(rng, 3, 2)
    factorization = Factorization(pattern, label)
    data[pattern.diagonal[7]] = -50.0
    assert factorization.factor(data)
    assert factorization.inertia == (pattern.size - 1, 1, 0)
    assert not factorization.definite


def test_bad_structure_is_refused(rng: np.random.Generator) -> None:
    pattern, _, label, _ = grid(rng, 3, 2)
    with pytest.raises(UnifgError, match="shape"):
        Factorization(pattern, label[:-1]).factor(np.zeros(pattern.nnz))
    with pytest.raises(UnifgError, match="decreases at scalar 2"):
        Factorization(pattern, label[::-1].copy()).factor(np.zeros(pattern.nnz))
    with pytest.raises(UnifgError, match="permutation of the 9 nodes"):
        Factorization(pattern, label, ordering=np.zeros(9, dtype=np.intp)).factor(np.zeros(pattern.nnz))


@pytest.mark.product(2, of="processes of their own")
def test_literals_make_no_functions_of_their_own() -> None:
    """A count that begins as a literal was passed to callees as one first: each was compiled twice, and half unused."""
    caller: Any = symbolic._eliminate
    callees: list[Any] = [symbolic._merge_twins, symbolic._append, symbolic._within]
    indices = types.Array(types.int64, 1, "C")
    numba.njit(caller.py_func).compile((*[indices] * 3, types.boolean, *[indices] * 2))
    assert [len(callee.overloads) for callee in callees] == [1, 1, 1]
