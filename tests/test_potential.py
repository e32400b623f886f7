"""The potential field of eq. 9 and 10, and the search directions that only steer the first steps."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.models.obstacles import disc_clearance, wall_distance
from unifg.models.potential import FAR, NEAR, SCALE, Sense, potential
from unifg.solvers import SQP, AugmentedLagrangian, GaussNewton, InteriorPoint, LevenbergMarquardt
from unifg.typing import Array

CENTRE, RADIUS = np.array([[0.0, 0.0]]), np.array([0.3])


def at(distances: list[float]) -> Array:
    """Poses at given distances from the disc, on the x axis and turned."""
    return np.stack([0.3 + np.array(distances), np.zeros(len(distances)), np.full(len(distances), 0.8)], axis=1)


def test_values_of_equation_9() -> None:
    assert (SCALE, NEAR, FAR) == (0.075, 0.05, 0.8)
    value = potential(disc_clearance)(at([-0.1, 0.02, 0.05, 0.1, 0.4, 0.8, 3.0]), CENTRE, RADIUS)[:, 0]
    largest = 0.075 * (20.0 - 1.25)
    np.testing.assert_allclose(
        value, [largest, largest, largest, 0.075 * 8.75, 0.075 * 1.25, 0.0, 0.0], rtol=1e-12, atol=1e-15
    )


def test_slope_jumps_at_both_thresholds_and_is_flat_inside() -> None:
    """Slopes have the defects that the papers page warns of: corners, and no push below the lower threshold."""
    push = potential(disc_clearance)
    assert push.jacobian is not None
    steps = [-0.1, NEAR - 1e-6, NEAR + 1e-6, FAR - 1e-6, FAR + 1e-6]
    slopes = np.linalg.norm(push.jacobian(at(steps), CENTRE, RADIUS)[0][:, 0], axis=1)
    expected = [0.0, 0.0, SCALE / NEAR**2, SCALE / FAR**2, 0.0]
    np.testing.assert_allclose(slopes, expected, rtol=1e-4)


def test_walls_push_towards_the_room() -> None:
    grid = DistanceMap.from_occupancy(np.pad(np.zeros((38, 38), dtype=bool), 1, constant_values=True), 0.1, (0, 0, 0))
    push = potential(wall_distance(SmoothField(grid)))
    assert push.jacobian is not None
    pose = np.array([[0.4, 2.0, 0.5]])  # 0.3 m from the wall on the left
    assert push(pose)[0, 0] == pytest.approx(SCALE * (1.0 / 0.3 - 1.0 / FAR), rel=1e-6)
    world = fg.SE2.matrix(pose)[0, :2, :2] @ push.jacobian(pose)[0][0, 0, :2]
    np.testing.assert_allclose(world, [-SCALE / 0.3**2, 0.0], atol=1e-6)


@pytest.mark.parametrize("vortex", [1.0, 0.4, -0.7])
def test_vortex_is_tangent_to_the_contours(vortex: float) -> None:
    """Vectors of a vortex: perpendicular to the gradient, ``vortex`` times as long, counter-clockwise if positive."""
    angle = np.linspace(-3.0, 3.0, 13)
    x = np.stack([0.6 * np.cos(angle), 0.6 * np.sin(angle), 2.0 * angle], axis=1)
    push = potential(disc_clearance, vortex=vortex)
    assert push.jacobian is not None and push.search is not None
    true, steered = (block[0][:, 0] for block in (push.jacobian(x, CENTRE, RADIUS), push.search(x, CENTRE, RADIUS)))
    rotation = fg.SE2.matrix(x)[:, :2, :2]
    added = -np.einsum("nij,nj->ni", rotation, (steered - true)[:, :2])  # of the direction of descent
    length = abs(vortex) * SCALE / 0.3**2
    tangent = np.sign(vortex) * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    np.testing.assert_allclose(added, length * tangent, atol=1e-12)
    np.testing.assert_array_equal(steered[:, 2], true[:, 2])


def test_vortex_is_off_by_default_and_pickled_along() -> None:
    assert potential(disc_clearance).search is None

    copy = pickle.loads(pickle.dumps(potential(disc_clearance, vortex=1.0)))
    assert copy(at([0.1]), CENTRE, RADIUS)[0, 0] == pytest.approx(SCALE * 8.75)


# ---------------------------------------------------------------- the option itself, on a cost anybody can follow


def well(lie: float, constrained: bool) -> tuple[fg.Graph, fg.Family, Array]:
    """A point drawn to (1, 0); its search Jacobian claims that moving along y helps too."""
    graph, p = graph_with(fg.Rn(2), 1, "p")

    def true(x: Array) -> list[Array]:
        return [np.broadcast_to(np.eye(2), (len(x), 2, 2))]

    def search(x: Array) -> list[Array]:
        return [np.broadcast_to(np.array([[1.0, lie], [0.0, 1.0]]), (len(x), 2, 2))]

    graph.minimize(fg.residual(lambda x: x - [1.0, 0.0], true, "pull", search=search), p)
    if constrained:
        graph.bound(p, lower=-50.0, upper=50.0)
    return graph, p, np.array([[-3.0, 2.0]])


SOLVERS: list[tuple[type[fg.Solver], bool]] = [
    (GaussNewton, False),
    (LevenbergMarquardt, False),
    (AugmentedLagrangian, True),
    (SQP, True),
    (InteriorPoint, True),
]


@pytest.mark.parametrize(("solver", "constrained"), SOLVERS, ids=lambda v: getattr(v, "__name__", ""))
def test_search_steers_only_the_first_steps(solver: type[fg.Solver], constrained: bool) -> None:
    graph, p, start = well(5.0, constrained)
    steps = 3
    solution = solver(search_iterations=steps, keep_values=True).solve(graph, {p: start}, check=True)
    np.testing.assert_allclose(solution[p], [[1.0, 0.0]], atol=1e-6)  # judged by the true gradient
    searched = [row.number for row in solution.history if "search" in row.details]
    assert searched == [1, 2, 3][: len(searched)] and searched
    for row in solution.history:  # every row tells the truth, the rows of the search included
        assert row.values is not None
        error = row.values[p][0] - [1.0, 0.0]
        assert row.cost == pytest.approx(0.5 * error @ error, abs=1e-12)
        if not constrained:  # the relative offset is one wherever the true Jacobian is the identity; rows bound it
            cosine = np.abs(error).max() / np.linalg.norm(error) if np.linalg.norm(error) > 1e-12 else 0.0
            assert cosine - 1e-12 <= row.stationarity <= 1.0
    plain = solver(keep_values=True).solve(graph, {p: start})
    first, other = solution.history[1].values, plain.history[1].values
    assert first is not None and other is not None
    assert "search" not in plain.history[1].details
    steered = np.array([[1.0, 5.0], [0.0, 1.0]])
    residual = start[0] - [1.0, 0.0]
    expected = start[0] - np.linalg.solve(steered.T @ steered, steered.T @ residual)
    np.testing.assert_allclose(first[p][0], expected, atol=0.2)  # damping or a barrier shortens it a little
    assert np.abs(other[p][0] - expected).max() > 1.0


@pytest.mark.parametrize(("solver", "constrained"), SOLVERS, ids=lambda v: getattr(v, "__name__", ""))
def test_without_search_jacobians_the_option_changes_nothing(solver: type[fg.Solver], constrained: bool) -> None:
    graph, p = graph_with(fg.Rn(2), 1, "p")
    graph.minimize(lambda x: np.stack([10.0 * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], axis=1), p)
    if constrained:
        graph.bound(p, lower=-50.0, upper=50.0)
    one, other = (solver(search_iterations=n).solve(graph, {p: [[-1.2, 1.0]]}) for n in (0, 5))
    assert [row.cost for row in one.history] == [row.cost for row in other.history]


def test_search_that_leaves_the_domain_is_abandoned() -> None:
    """A step to where the residual does not exist is not taken, and the solve goes on by the true derivatives."""
    graph, p = graph_with(fg.Rn(1), 1, "p")
    graph.minimize(
        fg.residual(np.log, lambda x: [1.0 / x[:, :, None]], "log", search=lambda x: [np.full((len(x), 1, 1), 1e-3)]),
        p,
    )
    solution = LevenbergMarquardt(search_iterations=5).solve(graph, {p: [[2.5]]}, check=True)
    assert solution[p][0, 0] == pytest.approx(1.0, abs=1e-6)
    assert not any("search" in row.details for row in solution.history)


def test_a_start_that_is_an_answer_is_not_searched_from() -> None:
    graph, p, _ = well(5.0, False)
    solution = GaussNewton(search_iterations=5).solve(graph, {p: [[1.0, 0.0]]})
    assert solution.converged and solution.iterations == 0


def test_solvers_without_steps_of_a_search_are_named() -> None:
    class Foreign(GaussNewton):
        search_step = fg.Solver.search_step

    graph, p, start = well(5.0, False)
    with pytest.raises(fg.BackendError, match="Foreign has no search_step"):
        Foreign(search_iterations=1).solve(graph, {p: start})


def test_aside_pushes_away_from_the_obstacle() -> None:
    """Tangent again, but to the left of the body when the obstacle is on its right, and the other way round."""
    angle = np.linspace(-3.0, 3.0, 13)
    x = np.stack([0.6 * np.cos(angle), 0.6 * np.sin(angle), np.zeros(13)], axis=1)  # all facing along the x axis
    push = potential(disc_clearance, vortex=0.5, sense="aside")
    assert push.jacobian is not None and push.search is not None
    true, steered = (block[0][:, 0] for block in (push.jacobian(x, CENTRE, RADIUS), push.search(x, CENTRE, RADIUS)))
    added = -(steered - true)[:, :2]
    np.testing.assert_allclose(np.einsum("nk,nk->n", added, x[:, :2]), 0.0, atol=1e-14)
    expected = 0.5 * SCALE / 0.3**2 * np.abs(np.cos(angle))  # nothing is tangential where the obstacle is abeam
    np.testing.assert_allclose(np.linalg.norm(added, axis=1), expected, atol=1e-12)
    above = x[:, 1] >= 0.0
    assert (added[above, 1] >= 0.0).all() and (added[~above, 1] <= 0.0).all()


# By second derivatives the interior point gets there without a vortex.
@pytest.mark.parametrize(("solver", "constrained"), SOLVERS[:-1], ids=lambda v: getattr(v, "__name__", ""))
@pytest.mark.parametrize(("vortex", "sense"), [(1.0, "circulate"), (-1.0, "circulate"), (1.0, "aside")])
def test_vortex_leads_around_an_obstacle(
    solver: type[fg.Solver], constrained: bool, vortex: float, sense: Sense
) -> None:
    """The textbook trap: a goal straight behind a disc. The vortex gets there, on the side its sign says."""
    answers = []
    for weight in (0.0, vortex):
        graph, x = graph_with(fg.SE2)
        graph.minimize(fg.prior, x, [1.6, 0.0, 0.0], sigma=[1.0, 1.0, 0.3])
        push = potential(disc_clearance, vortex=weight, sense=sense)
        graph.minimize(push, x, CENTRE, np.array([1.0]), sigma=0.05)
        searching = solver(search_iterations=30, keep_values=True)
        answers.append((searching.solve(graph, {x: [[-1.3, 0.0, 0.0]]}, check=True), x))
    (stuck, trapped), (free, family) = answers
    assert stuck[trapped][0, 0] < -1.0
    np.testing.assert_allclose(free[family][0, 1:], 0.0, atol=1e-5)
    assert free[family][0, 0] > 1.6
    assert free.cost < 0.1 * stuck.cost
    heights = [row.values[family][0, 1] for row in free.history if row.values is not None]
    left = sense == "aside" or vortex < 0.0  # clockwise past a disc ahead is to the left
    assert (max(heights) > 1.0) if left else (min(heights) < -1.0)
