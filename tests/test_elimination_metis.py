"""METIS' order, where it is installed, and what is said where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from unifg.elimination import metis
from unifg.elimination.factorization import Factorization, Ordering
from unifg.elimination.symmetric import Symmetric
from unifg.errors import UnifgError
from unifg.typing import Array, IntArray


def returning(count: int, side: int) -> tuple[Symmetric, Array, IntArray]:
    """A walk on a lattice that closes half of its loops, six scalars to a node; a diagonally dominant matrix."""
    rng, here, step = np.random.default_rng(0), np.full(3, side // 2), np.array([1, 0, 0])
    seen: dict[tuple[int, ...], list[int]] = {}
    pairs = set()
    for k in range(count):
        if rng.random() < 0.3:
            step = np.eye(3, dtype=int)[rng.integers(3)] * rng.choice([-1, 1])
        if (here + step < 0).any() or (here + step >= side).any():
            step = -step
        here = here + step
        pairs |= {(k - 1, k)} if k else set()
        visits = seen.setdefault(tuple(here.tolist()), [])
        pairs |= {(j, k) for j in visits[-3:] if rng.random() < 0.5}
        visits.append(k)
    first, second = np.array(sorted(pairs)).T
    pattern = Symmetric.of_blocks(6 * np.arange(count + 1), first, second)
    data = rng.uniform(-0.1, 0.1, pattern.nnz)
    data[pattern.diagonal] = 20.0
    return pattern, data, np.repeat(np.arange(count), 6)


@pytest.mark.skipif(not metis.installed(), reason="needs unifg[metis]")
def test_metis_finds_the_better_order_where_levels_say_little() -> None:
    pattern, data, label = returning(1500, 6)
    cost = []
    right, solutions = np.ones(pattern.size), []
    orderings: list[Ordering] = ["auto", "nested-dissection", "metis"]
    for ordering in orderings:
        one, two = Factorization(pattern, label, ordering=ordering), Factorization(pattern, label, ordering=ordering)
        np.testing.assert_array_equal(one.structure.order, two.structure.order)
        np.testing.assert_array_equal(np.sort(one.structure.order), np.arange(1500))
        cost.append(one.tree.flops)
        assert one.factor(data)
        solutions.append(one.solve(right))
        assert (one.tree.kind == "METIS") == (ordering != "nested-dissection")
    chosen, ours, theirs = cost
    assert chosen <= theirs < 0.8 * ours
    for solution in solutions[1:]:
        np.testing.assert_allclose(solution, solutions[0], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(pattern.times(data, solutions[0]), right, rtol=0.0, atol=1e-11)


def test_without_metis_its_order_is_refused_and_others_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metis, "find_spec", lambda name: None)
    pattern, data, label = returning(60, 3)
    with pytest.raises(UnifgError, match=r"pip install 'unifg\[metis\]'"):
        Factorization(pattern, label, ordering="metis").factor(data)
    assert Factorization(pattern, label).factor(data)
