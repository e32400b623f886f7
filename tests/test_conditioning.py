"""Condition and residual of the normal equations of a solution, and the word for directions of few digits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.solvers import GaussNewton, LevenbergMarquardt
from unifg.typing import Array


def chain(anchor: float, unit: float = 1.0, weight: float = 1.0) -> tuple[fg.Graph, fg.Family, Array]:
    """Thirty poses with odometry of a millimetre, tied to the world by a prior of this sigma."""
    graph, x = graph_with(fg.Rn(2), 30)
    rng = np.random.default_rng(0)
    steps = unit * (np.array([1.0, 0.5]) + 1e-3 * rng.standard_normal((29, 2)))
    graph.minimize(fg.prior, x[0], np.zeros(2), sigma=anchor * unit / np.sqrt(weight))
    graph.minimize(fg.between, x[:-1], x[1:], steps, sigma=1e-3 * unit / np.sqrt(weight))
    graph.minimize(fg.between, x[0], x[29], steps.sum(axis=0) + 1e-3 * unit, sigma=1e-3 * unit / np.sqrt(weight))
    return graph, x, np.zeros((30, 2))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("weight", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize(("anchor", "status"), [(1.0, fg.Status.CONVERGED), (300.0, fg.Status.HARDLY_DETERMINED)])
@pytest.mark.parametrize("backend", [GaussNewton(), LevenbergMarquardt(damping=1e-20)])
def test_the_status_between_converged_and_singular(
    backend: Any, anchor: float, status: Any, unit: float, weight: float
) -> None:
    """It is a matter of scaling between directions: neither tiny units nor small weights bring it about."""
    graph, x, guess = chain(anchor, unit, weight)
    solution = backend.solve(graph, {x: guess}, check=True)
    assert solution.status is status
    assert ("few digits" in solution.report()) == (status is not fg.Status.CONVERGED)


@pytest.mark.parametrize("apart", [5e-7, 7e-7, 9e-7])
def test_a_hardly_determined_direction_is_found_in_spite_of_damping(apart: float) -> None:
    """Two unknowns of which rows of nearly the same slopes are measured: of their difference few digits are known."""
    rows = np.array([[1.0, 1.0], [1.0, 1.0 + apart], [1.0, 1.0 - apart]])
    graph, x = graph_with(fg.Rn(2))
    measured = rows @ [1.0, 2.0] + 1e-9 * np.array([1.0, -1.0, 2.0])
    graph.minimize(lambda x, a, y: ((x * a).sum(axis=1) - y)[:, None], x[np.zeros(3, int)], rows, measured)
    solution = LevenbergMarquardt().solve(graph, {x: np.array([[0.3, -0.7]])})
    assert solution.status is fg.Status.HARDLY_DETERMINED and solution.iterations < 60
    np.testing.assert_allclose(solution[x][0], np.linalg.lstsq(rows, measured)[0], rtol=1e-5)


def test_the_estimate_is_that_of_a_dense_matrix_and_has_no_units() -> None:
    conditions = []
    for unit in (1e-6, 1.0, 1e4):
        graph, x, guess = chain(0.1, unit)
        solution = GaussNewton().solve(graph, {x: guess})
        assert solution.conditioning is not None
        pattern = graph.compile().normal
        upper = pattern.matrix(solution._lin.hessian).toarray()
        whole = upper + np.triu(upper, 1).T
        scale = 1.0 / np.sqrt(np.diag(whole))
        exact = np.linalg.cond(whole * np.outer(scale, scale), 1)
        assert exact / 3.0 <= solution.conditioning.condition <= exact * (1.0 + 1e-6)
        assert 0.0 <= solution.conditioning.residual < 1e-13
        conditions.append(solution.conditioning.condition)
        assert "Condition of the linear system" in solution.report()
        assert "Condition" not in repr(solution)
    np.testing.assert_allclose(conditions, conditions[0], rtol=1e-5)


def test_of_constrained_problems_nothing_is_said_and_of_singular_ones_that_it_is_infinite() -> None:
    graph, x = graph_with(fg.Rn(1), 2)
    graph.minimize(fg.between, x[0], x[1], np.ones(1), sigma=1.0)
    loose = LevenbergMarquardt().solve(graph, {x: np.zeros((2, 1))})
    assert loose.conditioning is not None and loose.conditioning.condition > 1e15
    graph.constrain(lambda a: a, x[0], lower=0.0, upper=0.0)
    tied = fg.solve(graph, {x: np.zeros((2, 1))})
    assert tied.converged and tied.conditioning is None and "Condition" not in tied.report()
