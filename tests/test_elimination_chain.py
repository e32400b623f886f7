"""Chains are recognised however their nodes are numbered, and run without indices."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import scipy.sparse as sp

from test_elimination import System, backward_error, full, solving, system
from unifg.codegen.jit import compiled
from unifg.elimination import analysis, fronts, substitution
from unifg.elimination.chain import stages
from unifg.elimination.factorization import Factorization
from unifg.elimination.ordering import block_graph
from unifg.elimination.plan import ADJACENT, DIRECT, Plan
from unifg.elimination.symmetric import Symmetric
from unifg.typing import Array


def horizon(rng: np.random.Generator, length: int, state: int, control: int, multipliers: bool) -> System:
    """States, then controls, then the multipliers of the dynamics: family by family."""
    x, u = range(length), range(length, 2 * length - 1)
    sizes = [state] * length + [control] * (length - 1)
    edges = [(x[k], u[k]) for k in range(length - 1)]
    if not multipliers:
        edges += [(a[k], x[k + 1]) for k in range(length - 1) for a in (x, u)]
        return system(rng, sizes, edges)
    m = range(2 * length - 1, 3 * length - 2)
    edges += [(a, m[k]) for k in range(length - 1) for a in (x[k], u[k], x[k + 1])]
    return system(rng, sizes + [state] * (length - 1), edges, length - 1)


@pytest.mark.parametrize("multipliers", [False, True])
@pytest.mark.parametrize(("length", "state", "control"), [(50, 3, 2), (2, 3, 2), (20, 9, 4), (7, 1, 1)])
def test_horizons(rng: np.random.Generator, length: int, state: int, control: int, multipliers: bool) -> None:
    pattern, data, label, negative = horizon(rng, length, state, control, multipliers)
    factorization = Factorization(pattern, label)
    assert factorization.factor(data)
    if length > 2:
        assert factorization.tree.kind == "chain"
        table = factorization.plan.fronts[:-2]
        assert table[:, DIRECT].all()
        assert table[:, ADJACENT].all()
        assert len(table) >= length // 3 or state == 1
    right = rng.normal(size=pattern.size)
    assert backward_error(full(pattern, data), factorization.solve(right), right) < 1e-11
    assert factorization.inertia == (int((~negative).sum()), int(negative.sum()), 0)
    refined = factorization.refine(data, right)
    assert backward_error(full(pattern, data), refined, right) < 1e-15


def test_other_orders_are_looked_for_where_a_chain_fills_in(rng: np.random.Generator) -> None:
    """Not for a horizon, whose chain fits its neighbourhoods; a tree of 127 nodes is no chain to speak of."""
    pattern, _, label, _ = horizon(rng, 30, 3, 2, True)
    with mock.patch.object(analysis, "predicted_cost", side_effect=AssertionError("another order was looked for")):
        assert analysis.analyse(pattern.indptr, pattern.indices, label, "auto").kind == "chain"
        with pytest.raises(AssertionError, match="another order"):
            pattern, _, label, _ = system(rng, [1] * 127, [((i - 1) // 2, i) for i in range(1, 127)])
            analysis.analyse(pattern.indptr, pattern.indices, label, "auto")
    assert stages(*block_graph(pattern.indptr, pattern.indices, label, 127), np.ones(127, dtype=np.int64))[0]
    assert analysis.analyse(pattern.indptr, pattern.indices, label, "auto").kind == "minimum-degree"


def test_stages_touch_only_the_next(rng: np.random.Generator) -> None:
    pattern, _, label, _ = horizon(rng, 30, 3, 2, True)
    weight = np.bincount(label)
    pointer, neighbours = block_graph(pattern.indptr, pattern.indices, label, len(weight))
    chain, (order, bounds, parent, passed), _ = stages(pointer, neighbours, weight)
    assert chain
    assert sorted(order.tolist()) == list(range(len(weight)))
    stage = np.empty(len(weight), dtype=int)
    stage[order] = np.repeat(np.arange(len(parent)), np.diff(bounds))
    for node in range(len(weight)):
        beside = neighbours[pointer[node] : pointer[node + 1]]
        assert np.abs(stage[beside] - stage[node]).max() <= 1
    for s in range(len(parent) - 1):
        after = order[bounds[s + 1] : bounds[s + 2]]
        touched = [k for k in after if (stage[neighbours[pointer[k] : pointer[k + 1]]] == s).any()]
        assert after[: len(touched)].tolist() == touched
        assert weight[touched].sum() == passed[s]


def test_several_chains_and_loose_nodes(rng: np.random.Generator) -> None:
    edges = [(k, k + 1) for k in range(9)] + [(k, k + 1) for k in range(11, 20)]
    pattern, data, label, _ = system(rng, [2] * 22, edges)
    solving(rng, pattern, data, 1e-14, label)


def test_wide_graphs_are_no_chains(rng: np.random.Generator) -> None:
    star = [(0, k) for k in range(1, 40)]
    loops = [(k, k + 1) for k in range(99)] + [(int(k), int(k) + 40) for k in rng.integers(0, 60, 30)]
    for nodes, edges in ((40, star), (100, loops)):
        pattern, data, label, _ = system(rng, [3] * nodes, edges)
        solving(rng, pattern, data, 1e-14, label)


@compiled
def iterate(plan: Plan, data: Array, added: Array, right: Array, out: Array, times: int) -> int:
    """A solver's loop that never leaves compiled code."""
    done = 0
    for _ in range(times):
        if fronts.factor(plan, data, added):
            substitution.solve(plan, right, out)
            done += 1
    return done


def test_kernels_run_inside_compiled_loops(rng: np.random.Generator) -> None:
    pattern, data, label, negative = horizon(rng, 10, 3, 2, True)
    factorization = Factorization(pattern, label)
    right, out, added = rng.normal(size=pattern.size), np.zeros(pattern.size), np.where(negative, -1e-3, 1e-3)
    assert iterate(factorization.plan, data, added, right, out, 3) == 3
    assert backward_error(full(pattern, data) + sp.diags(added), out, right) < 1e-12
    assert factorization.factor(data, added)
    assert np.array_equal(out, factorization.solve(right))


def test_nothing_is_analysed_twice(rng: np.random.Generator) -> None:
    pattern, data, label, _ = horizon(rng, 5, 3, 2, False)
    factorization = Factorization(pattern, label)
    assert factorization.factor(data)
    with mock.patch("unifg.elimination.factorization.analyse", side_effect=AssertionError):
        assert factorization.factor(2.0 * data)
        assert np.allclose(2.0 * factorization.solve(data[: pattern.size]), dense_solution(pattern, data))


def dense_solution(pattern: Symmetric, data: Array) -> Array:
    """Dense solution for the first entries of the data as right-hand side."""
    return np.asarray(np.linalg.solve(full(pattern, data).toarray(), data[: pattern.size]))


def test_free_end_is_noticed_in_a_chain(rng: np.random.Generator) -> None:
    """Contributions of a front to the next are not taken for the latter's original diagonal."""
    n = 120
    weight = rng.uniform(0.1, 10.0, size=n - 1)
    pattern = Symmetric(n, [(np.arange(n - 1), np.arange(1, n))])
    data = np.zeros(pattern.nnz)
    data[pattern.positions(np.arange(n - 1), np.arange(1, n))] = -weight
    np.add.at(data, pattern.diagonal[:-1], weight)
    np.add.at(data, pattern.diagonal[1:], weight)
    factorization = Factorization(pattern)
    factorization.factor(data + 0.0)
    assert factorization.tree.kind == "chain"
    singular = not factorization.factor(data)
    assert singular or abs(factorization.pivots()[-1]) < 1e-13
    assert fronts.factor(factorization.plan, data, np.full(n, 1e-6))
