"""The language: what a user writes, what comes back, and what is refused before the first iteration."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import drawn_to, graph_with
from problems.known import line, short_drive
from unifg.solvers import SQP, AugmentedLagrangian, GaussNewton, LevenbergMarquardt


@pytest.mark.parametrize("solver", [SQP(), AugmentedLagrangian()], ids=["sqp", "alm"])
def test_inactive_factors_keep_their_place_and_cost_nothing(solver: fg.Solver) -> None:
    graph, x = line(3)
    active = graph.data("active", np.array([True, True, True]), each=True)
    targets = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    graph.minimize(fg.prior, x, np.zeros(2))
    graph.minimize(fg.prior, x, targets, active=active, name="pull")
    graph.constrain(lambda p: p[:, :1], x, upper=0.25, active=active, name="wall")
    run = solver.prepare(graph)
    guess = {x: np.full((3, 2), 0.1)}
    full = run.solve(guess, check=True)
    np.testing.assert_allclose(full[x][:, 0], 0.25, atol=1e-6)
    mask = np.array([True, False, True])
    part = run.solve(guess, data={active: mask}, check=True)
    np.testing.assert_allclose(part[x][:, 0], [0.25, 0.0, 0.25], atol=1e-6)
    assert part.dual("wall")[1, 0] == 0.0
    assert judge(graph, part, {active: mask}).worst() < 2e-6


def test_inactive_factor_may_be_undefined() -> None:
    graph, x = drawn_to([1.0, 1.0], 2)
    with np.errstate(all="ignore"):
        graph.minimize(lambda p: np.log(p), x, active=np.array([True, False]))
        solution = LevenbergMarquardt().solve(graph, {x: np.array([[2.0, 2.0], [-1.0, -1.0]])})
    assert solution.converged
    np.testing.assert_allclose(solution[x][1], 1.0)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_rounding_of_an_inverse_is_symmetric_enough(unit: float) -> None:
    """An entry next to nothing has no digit left: beside a correlation of one it is symmetric, in any unit."""
    covariance = np.array([[4.0, 3e-12, 0.0], [3e-12, 0.25, 0.0], [0.0, 0.0, 1e-2]])
    scale = np.diag([1.0, unit, 1.0])
    information = np.linalg.inv(scale @ covariance @ scale)
    information[0, 1] += 1e-15 / unit
    assert abs(information[0, 1] / information[1, 0] - 1.0) > 1e-6
    graph, x = drawn_to([1.0, 2.0, 3.0], information=information)
    np.testing.assert_allclose(fg.solve(graph, {x: np.zeros((1, 3))})[x], [[1.0, 2.0, 3.0]], atol=1e-9)
    information[0, 1] += 1e-8 * 2.0 / unit / 0.5
    with pytest.raises(fg.GraphError, match=r"information must be finite and symmetric, found .* at \(0, 1\)"):
        graph.minimize(fg.prior, x, [1.0, 2.0, 3.0], information=information)
        graph.compile()


def test_information_and_sigma_agree() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    omega = root @ root.T
    costs = []
    for information in (omega, np.tile(omega, (2, 1, 1))):
        graph, x = graph_with(fg.SE2, 2)
        graph.minimize(fg.prior, x, np.array([1.0, 2.0, 0.3]), information=information)
        lin = graph.compile().linearize({x: np.zeros((2, 3))})
        costs.append(lin.cost)
    r = fg.SE2.local(np.array([1.0, 2.0, 0.3]), np.zeros(3))
    assert costs == pytest.approx([r @ omega @ r] * 2)


def test_fixed_component_of_a_product() -> None:
    graph, x = graph_with(fg.Product(pose=fg.SE2, v=fg.Rn(1)), 2)
    graph.fix(x.v[0], 0.5)
    graph.minimize(fg.prior, x.pose, [1.0, 0.0, 0.0])
    graph.minimize(fg.prior, x.v, [2.0])
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 4))}, check=True)
    np.testing.assert_allclose(solution[x.v], [[0.5], [2.0]])
    np.testing.assert_allclose(solution[x.pose[1]], [[1.0, 0.0, 0.0]], atol=1e-12)


def test_shift_keeps_rank_within_a_stage() -> None:
    """Two factors per stage, listed disc by disc: each follows its own disc."""
    graph, x = line(3)
    stages = np.array([0, 1, 2, 0, 1, 2])
    graph.minimize(fg.prior, x, [0.0, 0.0])
    level = graph.data("level", np.arange(1.0, 7.0)[:, None], each=True)
    graph.constrain(lambda p, a: p[:, :1] - 0.0 * a, x[stages], level, lower=-5.0, upper=5.0, name="band")
    duals = {"band": np.arange(6.0)[:, None]}
    solution = SQP(max_iterations=0).solve(graph, {x: np.full((3, 2), 0.1)}, duals=duals)
    np.testing.assert_array_equal(solution.dual("band"), duals["band"])
    moved = solution.shifted(x, by=1)
    np.testing.assert_array_equal(moved.multipliers["band"].ravel(), [1.0, 2.0, 2.0, 4.0, 5.0, 5.0])


def test_reweighted_loss_holds_its_weights_during_the_line_search() -> None:
    """A quarter below one: the trial cost is judged with the weight of the linearisation."""
    graph, x = drawn_to([0.0, 0.0], robust=fg.Reweighted(lambda s: np.where(s < 1.0, 0.25, 1.0)), name="beam")
    program = graph.compile()
    lin = program.linearize({x: np.array([[2.0, 0.0]])})
    assert lin.cost == pytest.approx(2.0)
    inside = {x: np.array([[0.5, 0.0]])}
    assert program.evaluate(inside, lin.weights).cost == pytest.approx(0.125)
    assert program.evaluate(inside).cost == pytest.approx(0.25 * 0.125)


def test_history_has_each_term_and_timing() -> None:
    graph, guess = short_drive()
    solution = AugmentedLagrangian().solve(graph, guess, check=True)
    assert [row.number for row in solution.history] == list(range(solution.iterations + 1))
    for row in solution.history:
        assert set(row.terms) == {term.name for term in graph.terms}
    assert all(a.seconds <= b.seconds for a, b in zip(solution.history, solution.history[1:], strict=False))
    assert solution.history[-1].terms["dynamics"] < 1e-6
    assert str(solution.iterations) in solution.report()


def test_a_graph_keeps_what_it_was_stated_with_when_the_caller_reuses_his_arrays() -> None:
    graph, place, sigma, limit, on = fg.Graph(), np.empty(2), np.ones(2), np.empty(2), np.ones(1, dtype=bool)
    x = graph.variables("x", fg.Rn(2), 3)
    for k in range(3):
        place[:] = [k, k * k]
        limit[:] = k + 0.5
        graph.minimize(fg.prior, x[k], place, sigma=sigma, active=on)
        graph.minimize(fg.difference, fg.shared(place), x[k], information=np.diag(sigma))
        graph.bound(x[k], upper=limit, soft=fg.Soft(quadratic=sigma))
    graph.fix(x[0], place)
    for array in (place, sigma, limit, on):
        array[:] = 0
    expected = [[2.0, 4.0], [1.0, 1.0], [2.0, (2 * 4.0 + 2.5) / 3.0]]
    np.testing.assert_allclose(fg.solve(graph, {x: np.zeros((3, 2))})[x], expected, atol=1e-6)
