"""Covariances under hard constraints: against dense algebra, in any units, and where there is none."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from scipy.linalg import null_space

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from test_kkt import chain
from unifg.solvers import KKT, SQP, InteriorPoint
from unifg.typing import Array


def dense(solution: fg.Solution, unit: Array) -> Array:
    """(n, n) over unknowns measured in ``unit``: the information's inverse where the constraints leave freedom."""
    program, lin = solution._program, solution._lin
    A = program.constraints.matrix(lin.constraint_jacobian).toarray()
    upper = program.normal.matrix(lin.hessian).toarray()
    H = upper + upper.T - np.diag(upper.diagonal())
    A, H = A * unit, H * np.outer(unit, unit)
    Z = null_space(A / np.linalg.norm(A, axis=1)[:, None])
    return np.asarray(Z @ np.linalg.solve(Z.T @ H @ Z, Z.T))


@pytest.mark.parametrize("noise", [1.0, 1e-3])
@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e3, 1.0, 1e-3), (1e-3, 1.0, 1e3), (1e5, 1.0, 1e-4)])
def test_units_do_not_matter(units: tuple[float, ...], noise: float) -> None:
    graph, guess = chain(units, noise, 1.0, 1.0)
    solution = KKT().solve(graph, guess, check=True)
    families = list(guess)
    unit = np.concatenate([np.tile(units, 21), np.ones(21)])
    expected = dense(solution, unit)
    sigma = np.sqrt(expected.diagonal())
    expected = expected / np.outer(sigma, sigma)
    scale = np.outer(unit * sigma, unit * sigma)
    np.testing.assert_allclose(solution.covariance(*families) / scale, expected, atol=1e-8)
    x = families[0]
    each = solution.marginals(x)
    for k in (0, 7, 20):
        own = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(each[k] / scale[own, own], expected[own, own], atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, 1e5, 1e8])
def test_costs_of_any_size_determine_unknowns_beside_constraints(scale: float) -> None:
    graph, x = graph_with(fg.Rn(2), 3)
    graph.minimize(fg.prior, x, [1.0, 2.0], sigma=scale * np.array([1.0, 2.0]))
    graph.constrain(lambda p: p.sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0)
    solution = InteriorPoint().solve(graph, {x: np.zeros((3, 2))}, check=True)
    np.testing.assert_allclose(solution.covariance(x[1]) / scale**2, [[0.8, -0.8], [-0.8, 0.8]], rtol=1e-9)


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_what_nothing_determines_is_refused_in_any_unit(unit: float) -> None:
    """A bias that two constraints carry along and no cost knows; what does not depend on it has its covariance."""
    graph = fg.Graph()
    x, b, y = (graph.variables(name, fg.Rn(1), 1) for name in "xby")
    graph.minimize(fg.prior, y, [0.0], sigma=2.0)
    graph.constrain(lambda p, q: p - unit * q, x, b, lower=0.0, upper=0.0)
    graph.constrain(lambda q: 1e3 * q, y, lower=-np.inf, upper=9.0)
    solution = SQP().solve(graph, {v: np.zeros((1, 1)) for v in (x, b, y)})
    np.testing.assert_allclose(solution.covariance(y), 4.0, rtol=1e-9)
    for variable in (x, b):
        with pytest.raises(fg.GraphError, match="not determined"):
            solution.covariance(variable)
    graph.minimize(fg.prior, b, [0.0], sigma=3.0)
    solution = SQP().solve(graph, {v: np.zeros((1, 1)) for v in (x, b, y)}, check=True)
    np.testing.assert_allclose(solution.covariance(x, b), 9.0 * np.outer([unit, 1.0], [unit, 1.0]), rtol=1e-8)


def test_solutions_of_one_graph_keep_their_own_covariances() -> None:
    """They share the structure of the elimination, not its numbers."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    sigma, slope = graph.data("sigma", 1.0), graph.data("slope", np.ones(1))
    graph.minimize(fg.prior, x, [0.0], sigma=sigma)
    graph.minimize(fg.prior, y, [0.0], sigma=1e3)
    graph.constrain(lambda p, q, s: q - s * p, x, y, slope, lower=0.0, upper=0.0)
    graph.bound(y, lower=-np.inf, upper=50.0, name="top")
    run = SQP().prepare(graph)
    guess = {x: np.zeros((1, 1)), y: np.zeros((1, 1))}
    first = run.solve(guess, data={sigma: 1.0, slope: [2.0]}, check=True)
    before = first.covariance(x, y)
    second = run.solve(guess, data={sigma: 3.0, slope: [5.0]}, check=True)
    np.testing.assert_allclose(second.covariance(x, y), 9.0 * np.outer([1.0, 5.0], [1.0, 5.0]), rtol=1e-3)
    np.testing.assert_allclose(first.covariance(y, x), before[::-1, ::-1], rtol=1e-9)
    np.testing.assert_allclose(before, np.outer([1.0, 2.0], [1.0, 2.0]), rtol=1e-3)


def test_the_kept_structure_goes_with_its_graph() -> None:
    graph, guess = chain((1.0, 1.0, 1.0), 1.0, 1.0, 1.0)
    solution = KKT().solve(graph, guess, check=True)
    assert solution.covariance(next(iter(guess))).shape == (63, 63)
    program = weakref.ref(graph.compile())
    del graph, guess, solution
    gc.collect()
    assert program() is None


INFORMATION = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.5], [0.5, -0.5, 2.0]])


def pressed(limit: float) -> tuple[fg.Graph, fg.Family, fg.Data]:
    """A point that wants to be at (2, 1, 3), below a plane whose height is data, under a bound and above another."""
    graph, x = drawn_to([2.0, 1.0, 3.0], information=INFORMATION)
    height = graph.data("height", limit)
    graph.constrain(lambda p: p[:, :1] + 2.0 * p[:, 1:2], x, upper=height, name="plane")
    graph.bound(x, lower=[-9.0, -9.0, -9.0], upper=[9.0, 9.0, 2.5])
    return graph, x, height


@pytest.mark.parametrize("solver", [SQP(), InteriorPoint()], ids=lambda s: s.name)
def test_an_active_inequality_forbids_a_direction_and_an_inactive_one_none(solver: fg.Solver) -> None:
    """Left out of the covariance, an active limit would leave the uncertainty it removes."""
    graph, x, height = pressed(1.0)
    run = solver.prepare(graph)
    active = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])  # the plane and the upper bound of the third coordinate
    for limit, rows in ((1.0, active), (50.0, active[1:])):
        solution = run.solve({x: np.zeros((1, 3))}, data={height: limit}, check=True)
        Z = null_space(rows)
        expected = Z @ np.linalg.solve(Z.T @ INFORMATION @ Z, Z.T)
        np.testing.assert_allclose(solution.covariance(x), expected, atol=1e-8)
        np.testing.assert_allclose(solution.marginals(x)[0], expected, atol=1e-8)
        np.testing.assert_allclose(rows @ solution.covariance(x), 0.0, atol=1e-8)


@pytest.mark.parametrize("constrained", [False, True])
def test_what_is_fixed_is_known(constrained: bool) -> None:
    """Zeros for fixed members and components; it used to be an error that named the first of them."""
    graph = fg.Graph()
    state = fg.Product(p=fg.Rn(2), v=fg.Rn(1))
    x = graph.variables("x", state, 4)
    graph.fix(x[0], [[1.0, 2.0, 0.5]])
    graph.fix(x[2].v, [[0.25]])
    rng = np.random.default_rng(4)
    roots = rng.normal(size=(3, 3, 3)) + 3.0 * np.eye(3)
    graph.minimize(lambda a, b: b - a - 0.1, x[:-1], x[1:], information=np.einsum("nij,nkj->nik", roots, roots))
    if constrained:
        graph.constrain(lambda a: a[:, :1], x[3], lower=2.0, upper=2.0, name="wall")
    solution = SQP().solve(graph, {x: np.full((4, 3), 0.5)}, check=True)
    program, lin = solution._program, solution._lin
    free = program.columns.free
    upper = program.normal.matrix(lin.hessian).toarray()
    H = upper + upper.T - np.diag(upper.diagonal())
    A = program.constraints.matrix(lin.constraint_jacobian).toarray()
    Z = null_space(A) if constrained else np.eye(len(free))
    expected = np.zeros((12, 12))
    expected[np.ix_(free, free)] = Z @ np.linalg.solve(Z.T @ H @ Z, Z.T)
    np.testing.assert_allclose(solution.covariance(x), expected, atol=1e-9)
    for k, block in enumerate(solution.marginals(x)):
        np.testing.assert_allclose(block, expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], atol=1e-9)
    np.testing.assert_array_equal(solution.covariance(x[0]), np.zeros((3, 3)))
    np.testing.assert_array_equal(solution.covariance(x[2].v), np.zeros((1, 1)))
    np.testing.assert_array_equal(solution.marginals(x[0].p), np.zeros((1, 2, 2)))


@pytest.mark.parametrize("case", ["free", "fixed", "constrained"])
def test_covariances_of_pairs_are_those_of_each_pair(case: str) -> None:
    """Free members by two paths of the tree; fixed ones are known; held rows take the KKT matrix."""
    rng, graph = np.random.default_rng(0), fg.Graph()
    x, y = graph.variables("x", fg.SE2, 12), graph.variables("y", fg.Rn(2), 3)
    graph.minimize(fg.between, x[:-1], x[1:], np.array([1.0, 0.0, 0.2]), sigma=0.1)
    graph.minimize(lambda a, b: a[:, :2] - b, x[[1, 5, 9]], y, sigma=0.3)
    graph.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    if case == "fixed":
        graph.fix(x[4], np.array([3.5, 1.5, 0.8]))
    if case == "constrained":
        graph.constrain(lambda a: a[:, :1], x[6], lower=4.0, upper=4.0)
    guess = {x: fg.SE2.exp(0.1 * rng.standard_normal((12, 3))), y: np.zeros((3, 2))}
    solution = fg.solve(graph, guess, check=True)
    for first, second in ((x[11], x[[0, 4, 4, 11]]), (y[1], x), (x[[2, 3]], y[[0, 2]]), (x[3], x[7])):
        pairs = solution.pair_covariances(first, second)
        count = max(len(first), len(second))
        assert len(pairs) == count
        for k, pair in enumerate(pairs):
            ends = [end if len(end) == 1 else end[k] for end in (first, second)]
            np.testing.assert_allclose(pair, solution.covariance(*ends), rtol=0.0, atol=1e-9 * np.abs(pair).max())
    with pytest.raises(fg.GraphError, match="pairs of 2 and 3"):
        solution.pair_covariances(x[:2], y)
