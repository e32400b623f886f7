"""Covariances under hard constraints: against dense algebra, in any units, and where there is none."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from scipy.linalg import null_space

import unifg as fg
from test_kkt import chain
from unifg.solvers import KKT, SQP
from unifg.typing import Array


def dense(solution: fg.Solution, unit: Array) -> Array:
    """(n, n) over unknowns measured in ``unit``: the information's inverse where the constraints leave freedom."""
    program, lin = solution._program, solution._lin
    A = program.constraints.matrix(lin.constraint_jacobian).toarray()
    upper = program.normal.matrix(lin.hessian).toarray()
    H = upper + upper.T - np.diag(upper.diagonal())
    A, H = A * unit, H * np.outer(unit, unit)
    Z = null_space(A / np.linalg.norm(A, axis=1)[:, None])
    covariance: Array = Z @ np.linalg.solve(Z.T @ H @ Z, Z.T)
    return covariance


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
    graph = fg.Graph()
    x, y = graph.variables("x", fg.Rn(1), 1), graph.variables("y", fg.Rn(1), 1)
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
