"""Feedback gains: Riccati's recursion, and differences of problems that are solved again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import unifg as fg
from problems.control import Problem, Quadrotor, Stated, Unicycle
from problems.graphs import graph_of
from unifg.horizon import ControlCost, Dynamics, RecedingHorizon, Robot, Term
from unifg.solution.solver import Prepared
from unifg.solvers import KKT, SQP, InteriorPoint
from unifg.typing import Array

RNG = np.random.default_rng(0)
A = np.eye(3) + 0.2 * RNG.standard_normal((3, 3))
B = RNG.standard_normal((3, 2))
Q, R = np.diag([1.0, 2.0, 0.5]), np.diag([0.3, 0.7])


def motion(x: Array, u: Array, y: Array) -> Array:
    """Defect of the linear system."""
    return y - x @ A.T - u @ B.T


def regulator(steps: int, end: Array, start: Any = (1.0, 1.0, 1.0)) -> tuple[fg.Graph, fg.Family, fg.Family]:
    """Linear system with quadratic costs."""
    graph, x, u = graph_of(("x", fg.Rn(3), steps + 1), ("u", fg.Rn(2), steps))
    graph.fix(x[0], start, name="start")
    graph.minimize(fg.prior, x[:-1], np.zeros(3), information=Q, name="stages")
    graph.minimize(fg.prior, x[-1], np.zeros(3), information=end, name="end")
    graph.minimize(fg.prior, u, np.zeros(2), information=R, name="effort")
    graph.constrain(motion, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="dynamics")
    return graph, x, u


def solved(graph: fg.Graph, tolerance: float = 1e-10, **data: Any) -> fg.Solution:
    """Solution from zero."""
    guess = {f: np.tile(f.manifold.identity(), (f.count, 1)) for f in graph.families.values()}
    return InteriorPoint(tolerance=tolerance).solve(graph, guess, check=True, **data)


def test_gains_of_a_regulator_are_those_of_riccati() -> None:
    end = np.diag([5.0, 1.0, 3.0])
    graph, x, u = regulator(12, end)
    found = solved(graph).gains(x, u)
    assert found.shape == (12, 2, 3)
    value = end
    for gain in found[::-1]:
        expected = -np.linalg.solve(R + B.T @ value @ B, B.T @ value @ A)
        np.testing.assert_allclose(gain, expected, rtol=0.0, atol=1e-10)
        value = Q + A.T @ value @ (A + B @ expected)
    stationary = solve_discrete_are(A, B, Q, R)
    graph, x, u = regulator(9, stationary)
    expected = -np.linalg.solve(R + B.T @ stationary @ B, B.T @ stationary @ A)
    np.testing.assert_allclose(solved(graph).gains("x", "u"), np.tile(expected, (9, 1, 1)), rtol=0.0, atol=1e-8)


def again(stated: Stated, run: Any, solution: fg.Solution, start: Array, step: float) -> Array:
    """(m, d) differences of the first control, of problems that are solved again."""
    manifold, columns = stated.problem.manifold, []
    for unit in np.eye(manifold.dim):
        ends = []
        for side in (1.0, -1.0, 2.0, -2.0):
            moved = manifold.retract(start[None], side * step * unit[None])[0]
            found = run.solve(solution, data=stated.data(moved, 0), check=True)
            ends.append(found[stated.u][0])
        columns.append((8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * step))
    return np.array(columns).T


CASES = [
    (Unicycle("straight", True, 50), np.array([0.0, 0.01, 0.02])),
    (Unicycle("straight", False, 20), np.array([0.0, 0.02, 0.02])),
    (Quadrotor("figure8", True, 20), Quadrotor("figure8", True, 20).reference()[0][0]),
]


@pytest.mark.parametrize(("problem", "start"), CASES, ids=lambda case: getattr(case, "title", ""))
def test_the_first_gain_is_the_difference_of_problems_solved_again(problem: Problem, start: Array) -> None:
    stated = problem.formulation()
    run = InteriorPoint(tolerance=1e-10).prepare(stated.graph)
    data = stated.data(start, 0)
    solution = run.solve(stated.guess, data=data, check=True)
    gain = solution.gains(stated.x[:1], stated.u[:1])[0]
    limits = np.abs(solution.dual("limits")) > 1e-3
    if problem.blocked:
        assert limits.any() and (np.abs(solution.dual(problem.obstacles)) > 1e-3).any(), "limits and obstacles act"
    expected = again(stated, run, solution, start, 1e-4)
    assert np.abs(gain - expected).max() <= 1e-7 * np.abs(expected).max()
    np.testing.assert_allclose(gain[limits[0]], 0.0, atol=1e-12, err_msg="a control at its limit stays there")
    np.testing.assert_array_equal(solution.gains(stated.x[:1], stated.u[:1])[0], gain)  # other starts change nothing
    run.solve(solution, data=stated.data(start, 3))
    with pytest.raises(fg.GraphError, match="have been replaced"):
        solution.gains(stated.x[:1], stated.u[:1])


def test_a_later_gain_is_that_of_the_problem_that_begins_there() -> None:
    problem = Unicycle("straight", False, 20)
    stated = problem.formulation()
    run = InteriorPoint(tolerance=1e-10).prepare(stated.graph)
    solution = run.solve(stated.guess, data=stated.data(CASES[1][1], 0), check=True)
    gains = solution.gains(stated.x, stated.u)
    tail = Unicycle("straight", False, 14).formulation()
    shorter = InteriorPoint(tolerance=1e-10).prepare(tail.graph)
    begin = solution[stated.x][6]
    guess = {tail.x: solution[stated.x][6:], tail.u: solution[stated.u][6:]}
    rest = shorter.solve(guess, data=tail.data(begin, 6), check=True)
    np.testing.assert_allclose(rest.gains(tail.x, tail.u), gains[6:], rtol=0.0, atol=1e-7)


def test_changes_of_controls_count_from_the_control_before() -> None:
    graph, x, u = regulator(4, Q)
    graph.minimize(lambda before, after: after - before, u[:-1], u[1:], sigma=0.5, name="change")
    found = solved(graph).gains(x, u)
    graph, x, u = regulator(1, Q)
    graph.minimize(fg.prior, u, np.zeros(2), sigma=0.5, name="change")
    np.testing.assert_allclose(found[-1], solved(graph).gains(x, u)[0], atol=1e-10)


def test_families_side_by_side_and_an_unknown_first_state() -> None:
    graph = fg.Graph()
    p, v = graph.variables("p", fg.Rn(1), 6), graph.variables("v", fg.Rn(1), 6)
    a, b = graph.variables("a", fg.Rn(1), 5), graph.variables("b", fg.Rn(1), 5)
    for family in (p, v, a, b):
        graph.minimize(fg.prior, family, [1.0], sigma=1.0, name=f"cost {family.name}")
    graph.constrain(lambda p, v, a, q: q - p - 0.5 * v - a, p[:-1], v[:-1], a, p[1:], lower=0.0, upper=0.0, name="p")
    graph.constrain(lambda v, b, w: w - v - b, v[:-1], b, v[1:], lower=0.0, upper=0.0, name="v")
    found = solved(graph).gains([p, v], [a, b])
    step, act, value = np.array([[1.0, 0.5], [0.0, 1.0]]), np.eye(2), np.eye(2)
    for gain in found[::-1]:
        np.testing.assert_allclose(gain, -np.linalg.solve(np.eye(2) + value, value @ step), atol=1e-10)
        value = np.eye(2) + step.T @ value @ (step + act @ gain)


def test_a_loop_has_gains_and_a_fixed_control_has_none() -> None:
    class Target(Term):
        def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
            graph.minimize(fg.prior, x[1:], np.zeros(3), information=Q, name="target")
            graph.fix(u[2], [0.1, 0.2])

    robot = Robot(fg.Rn(3), fg.Rn(2))
    dynamics = Dynamics(lambda x, u, y, h: motion(x, u, y), 1.0)
    loop = RecedingHorizon(robot, 4, [dynamics, Target(), ControlCost([1.0, 1.0])], solver=InteriorPoint())
    loop.plan(np.ones(3))
    assert loop.solution is not None
    gains = loop.solution.gains(loop.x, loop.u)
    assert not gains[2].any() and all(gain.any() for gain in gains[[0, 1, 3]])
    expected = -np.linalg.solve(np.eye(2) + B.T @ Q @ B, B.T @ Q @ A)
    np.testing.assert_allclose(gains[3], expected, atol=1e-7)


def test_gains_are_refused_by_name() -> None:
    graph, x, u = regulator(3, Q)
    guess = {x: np.ones((4, 3)), u: np.ones((3, 2))}
    stopped = InteriorPoint(max_iterations=0).solve(graph, guess)
    with pytest.raises(fg.GraphError, match="ITERATION_LIMIT"):
        stopped.gains(x, u)
    good = solved(graph)
    with pytest.raises(fg.GraphError, match=r"\[2\] states for \[3\] controls"):
        good.gains(x[:2], u)
    for states, controls in (([], u), (x, []), ([], [])):
        with pytest.raises(fg.GraphError, match=r"gains: .* give as many, and at least one"):
            good.gains(states, controls)
    for wrong in (5, None):
        with pytest.raises(fg.GraphError, match="expected a family of variables"):
            good.gains(x, wrong)  # type: ignore[arg-type]
    np.testing.assert_array_equal(good.gains(x[1:3], u[1:3]), good.gains(x, u)[1:])
    idle, x, u = graph_of(("x", fg.Rn(1), 3), ("u", fg.Rn(2), 2))
    idle.fix(x[0], [1.0])
    idle.minimize(fg.prior, x[1:], [0.0], sigma=1.0)
    idle.constrain(lambda x, u, y: y - x - u[:, :1] - u[:, 1:], x[:-1], u, x[1:], lower=0.0, upper=0.0, name="step")
    with pytest.raises(fg.GraphError, match=r"u\[0\] has none.*leave it free"):
        solved(idle).gains(x, u)


def test_gains_at_rest_are_not_those_of_other_weights() -> None:
    """At the goal neither the cost nor a constraint tells that a weight has been replaced."""
    graph, x, u = regulator(3, Q, np.zeros(3))
    price = graph.data("price", R)
    graph.minimize(fg.prior, u, np.zeros(2), information=price, name="price")
    run = InteriorPoint().prepare(graph)
    rest = {x: np.zeros((4, 3)), u: np.zeros((3, 2))}
    first = run.solve(rest, check=True)
    gains = first.gains(x, u)
    run.solve(rest, data={price: 9.0 * R})
    with pytest.raises(fg.GraphError, match="have been replaced"):
        first.gains(x, u)
    run.solve(rest)
    np.testing.assert_array_equal(first.gains(x, u), gains)


@pytest.mark.parametrize("unit", [1e-4, 1e-7, 1e4])
def test_the_unit_of_the_costs_does_not_matter(unit: float) -> None:
    """Multipliers of small costs are small, and limits act all the same."""

    def limited(unit: float) -> fg.Solution:
        graph, x, u = graph_of(("x", fg.Rn(3), 9), ("u", fg.Rn(2), 8))
        graph.fix(x[0], [1.0, 1.0, 1.0])
        graph.minimize(fg.prior, x, np.zeros(3), information=unit * Q, name="stages")
        graph.minimize(fg.prior, u, np.zeros(2), information=unit * R, name="effort")
        graph.constrain(motion, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=-0.5, upper=0.5, name="limits")
        return solved(graph, tolerance=1e-6)

    expected, found = limited(1.0), limited(unit)
    at_limits = np.isclose(np.abs(expected["u"]), 0.5, atol=1e-5)
    gains = found.gains("x", "u")
    assert at_limits.sum() == 1 and np.abs(gains[at_limits]).max() < 1e-9
    np.testing.assert_allclose(gains, expected.gains("x", "u"), atol=1e-4)
    np.testing.assert_allclose(unit * found.covariance("u"), expected.covariance("u"), atol=1e-4)


def test_a_constraint_that_cannot_be_kept_from_another_state_has_no_gain_there() -> None:
    """A wall for a position that the control reaches two steps later; from farther away it can be kept."""
    graph, x, u = graph_of(("x", fg.Rn(2), 6), ("u", fg.Rn(1), 5))
    graph.fix(x[0], [0.0, 0.5])
    graph.minimize(fg.prior, x[1:], [2.0, 0.0], sigma=0.1, name="goal")
    graph.minimize(fg.prior, u, [0.0], sigma=1.0, name="effort")
    step = np.array([[1.0, 1.0], [0.0, 1.0]])
    graph.constrain(
        lambda x, u, y: y - x @ step.T - np.concatenate([0.0 * u, u], axis=1), x[:-1], u, x[1:], lower=0.0, upper=0.0,
        name="dynamics",
    )  # fmt: skip
    graph.constrain(lambda x: x[:, :1], x[1:], upper=1.0, name="wall")
    solution = solved(graph)
    active = np.flatnonzero(solution.dual("wall")[:, 0] > 1e-3)
    assert active[0] == 1, "the wall acts from node 2 on"
    with pytest.raises(fg.GraphError, match=r"u\[1\] has none"):
        solution.gains(x, u)
    gain = solution.gains(x[:1], u[:1])[0]
    np.testing.assert_allclose(gain, [[-1.0, -2.0]], atol=1e-9)  # so that p + v + (v + u) stays where it is


def test_a_backend_with_another_way_to_the_solution_has_the_same_gains() -> None:
    problem, start = CASES[1]
    stated = problem.formulation()
    data = stated.data(start, 0)
    found = []
    for solver in (InteriorPoint(tolerance=1e-9), SQP(tolerance=1e-9)):
        run = solver.prepare(stated.graph)
        found.append(run.solve(stated.guess, data=data, check=True).gains(stated.x, stated.u))
    np.testing.assert_allclose(found[0], found[1], rtol=0.0, atol=1e-5 * np.abs(found[0]).max())


def cart(x: Array, u: Array, y: Array) -> Array:
    """Defect of a mass that is pushed."""
    return y - x - 0.5 * np.stack([x[:, 1], u[:, 0]], axis=1)


def test_a_soft_limit_that_is_kept_has_the_gains_of_a_hard_one() -> None:
    """At a limit that the state itself is at: nothing later depends on how far that would give way."""
    found = []
    for soft in (None, 50.0):
        graph, x, u = graph_of(("x", fg.Rn(2), 9), ("u", fg.Rn(1), 8))
        graph.fix(x[0], [0.0, 0.0])
        graph.minimize(fg.prior, x[1:], [4.0, 0.0], sigma=[1.0, 2.0])
        graph.minimize(fg.prior, u, [0.0], sigma=1.0)
        graph.constrain(cart, x[:-1], u, x[1:], lower=0.0, upper=0.0)
        graph.constrain(lambda x: x[:, 1:], x[1:], lower=-1.2, upper=1.2, soft=soft, name="speed")
        solution = solved(graph)
        assert (np.abs(solution.dual("speed")) > 0.1).sum() > 2
        found.append(solution.gains(x, u))
    np.testing.assert_allclose(found[0], found[1], rtol=0.0, atol=1e-7)


def test_gains_follow_numbers_that_a_function_captures() -> None:
    def stated(weight: Array) -> tuple[Prepared, fg.Family, fg.Family]:
        graph, x, u = graph_of(("x", fg.Rn(1), 4), ("u", fg.Rn(1), 3))
        graph.fix(x[0], [1.0])
        graph.minimize(lambda x: x * weight, x[1:], name="state")
        graph.minimize(lambda u: u, u, name="effort")
        graph.constrain(lambda x, u, y: y - x - u, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
        return KKT().prepare(graph), x, u

    def gains(run: Prepared, x: fg.Family, u: fg.Family) -> Array:
        return run.solve({x: np.zeros((4, 1)), u: np.zeros((3, 1))}).gains(x[:-1], u)

    weight = np.array([1.0])
    stage = stated(weight)
    before = gains(*stage)
    weight[0] = 3.0
    np.testing.assert_allclose(gains(*stage), gains(*stated(np.array([3.0]))), atol=1e-12)
    assert np.abs(gains(*stage) - before).max() > 0.1
