"""Answers at kinks: none is believed where every step lowers the cost, and minima at kinks stay where they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_with
from unifg.solvers import (
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)
from unifg.typing import Array

BACKENDS = [GaussNewton(), LevenbergMarquardt(), DogLeg(), SQP(), InteriorPoint(), AugmentedLagrangian(), Penalty()]


def distance(p: Array, q: Array) -> Array:
    return np.asarray(np.linalg.norm(p - q, axis=1)[:, None])


def opaque(p: Array, q: Array) -> Array:
    """The same by a way that cannot be traced."""
    return np.array([[float(np.sqrt(float(d @ d)))] for d in np.asarray(p) - np.asarray(q)])


def survey(measure: Callable[[Array, Array], Array], seen: float, metre: float = 1.0) -> tuple[fg.Graph, fg.Family]:
    """A landmark with a weak prior where the pose is that measured a distance to it, and a guess of zeros."""
    graph, p = graph_with(fg.Rn(2), 2, "p")
    graph.minimize(fg.prior, p[0], [0.0, 0.0], sigma=0.01 * metre, name="pose")
    graph.minimize(fg.prior, p[1], [0.0, 0.0], sigma=10.0 * metre, name="somewhere")
    graph.minimize(lambda a, b: measure(a, b) - seen * metre, p[0], p[1], sigma=0.1 * metre, name="distance")
    return graph, p


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda solver: solver.name)
@pytest.mark.parametrize("measure", [distance, opaque])
def test_a_landmark_guessed_on_the_pose_is_found(solver: fg.Solver, measure: Callable[[Array, Array], Array]) -> None:
    graph, p = survey(measure, 1.0)
    solution = solver.solve(graph, {p: np.zeros((2, 2))}, check=True)
    assert np.linalg.norm(solution[p][1] - solution[p][0]) == pytest.approx(1.0, abs=1e-3)
    assert solution.cost < 0.01 and solution.verify()


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_a_row_among_others_of_a_factor_among_others_is_found(wrong: int) -> None:
    """One of three landmarks is guessed where its distance is measured from; the others fit without a residual."""
    graph, p = graph_with(fg.Rn(2), 3, "p")
    guess = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    guess[wrong] = 0.0
    graph.minimize(fg.prior, p, guess, sigma=10.0, name="somewhere")
    graph.minimize(lambda v: np.concatenate([1e-6 * v[:, 1:], distance(v, 0.0 * v) - 1.0], axis=1), p, sigma=0.1)
    found = LevenbergMarquardt().solve(graph, {p: guess}, check=True)
    np.testing.assert_allclose(np.linalg.norm(found[p], axis=1), 1.0, atol=1e-3)


@pytest.mark.parametrize("metre", [1e-9, 1e-3, 1e3, 1e9])
def test_the_unit_of_length_does_not_matter(metre: float) -> None:
    graph, p = survey(distance, 1.0, metre)
    assert LevenbergMarquardt().solve(graph, {p: np.zeros((2, 2))}, check=True).cost < 0.01


def test_the_second_solve_of_a_prepared_graph_is_looked_at_too() -> None:
    graph, p = survey(distance, 1.0)
    run = InteriorPoint().prepare(graph)
    assert all(run.solve({p: np.zeros((2, 2))}).cost < 0.01 for _ in range(2))


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda solver: solver.name)
def test_a_minimum_at_a_kink_stays(solver: fg.Solver) -> None:
    graph, p = survey(distance, 0.0)
    solution = solver.solve(graph, {p: np.zeros((2, 2))}, check=True)
    np.testing.assert_array_equal(solution[p], 0.0)


def test_what_is_flat_on_both_sides_stays_and_limits_count() -> None:
    graph, x = drawn_to([2.0], 2, name="prior")
    graph.minimize(lambda v: np.minimum(v, 1.0) - 3.0, x[0], name="saturated")
    graph.minimize(lambda v: np.abs(v - 2.0) + 1.0, x[1], name="held down")
    solution = fg.solve(graph, {x: [[2.0], [2.0]]}, check=True)
    np.testing.assert_allclose(solution[x], 2.0)
    ridge, y = graph_with(fg.Rn(1), 1, "y")
    ridge.minimize(lambda v: 2.0 - np.abs(v), y, name="ridge")
    ridge.bound(y, lower=-1.0, upper=1.0, name="limits")
    assert abs(InteriorPoint().solve(ridge, {y: [[0.0]]}, check=True)[y][0, 0]) == pytest.approx(1.0, abs=1e-5)


def test_scalar_costs_and_saddles() -> None:
    graph, x = drawn_to([0.0, 0.0], name="prior")
    graph.minimize_scalar(lambda v: -3.0 * np.linalg.norm(v, axis=1), x, name="away")
    assert np.linalg.norm(fg.solve(graph, {x: [[0.0, 0.0]]}, check=True)[x]) == pytest.approx(3.0, abs=1e-4)
    saddle, y = graph_with(fg.Rn(1), 1, "y")
    saddle.minimize(lambda v: v**2 - 1.0, y, name="well")  # a maximum at zero, smooth: derivatives say all there is
    assert GaussNewton().solve(saddle, {y: [[0.0]]})[y][0, 0] == 0.0
