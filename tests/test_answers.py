"""Answers of a solution: priors of what leaves, covariances, reactions, shifted guesses, the worst row, checks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import null_space

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.solution.marginal import cost_rows
from unifg.solvers import (
    SQP,
    GaussNewton,
    InteriorPoint,
)
from unifg.solvers.names import CONSTRAINED, LEAST_SQUARES, backends
from unifg.typing import Array

# ---------------------------------------------------------------- priors of what leaves


def pair() -> tuple[fg.Graph, fg.Family, fg.Family]:
    """Two past states, hard and soft ties to the present, all linear."""
    graph, x, y = graph_of(("x", fg.Rn(2), 2), ("y", fg.Rn(2), 1))
    graph.minimize(fg.prior, x, np.array([0.3, -0.4]), sigma=[0.5, 2.0], name="prior")
    graph.minimize(lambda a, b: b - a - 1.0, x[0], x[1], sigma=0.7, name="step")
    graph.minimize(lambda a, b: 2.0 * b - a, x[1], y, sigma=0.3, name="now")
    graph.constrain(lambda a, b: a[:, :1] + 2.0 * b[:, 1:] - 3.0, x[1], y, lower=0.0, upper=0.0, name="tie")
    graph.minimize(fg.prior, y, np.array([5.0, 6.0]), name="rest")
    return graph, x, y


def eliminated(graph: fg.Graph, x: fg.Family, y: fg.Family) -> tuple[Array, Array]:
    """Information about y and where it points, by dense algebra over everything but 'rest'."""
    program = graph.compile()
    lin = program.linearize({x: np.zeros((2, 2)), y: np.zeros((1, 2))})
    rows = cost_rows(program, ["prior", "step", "now"])
    J = program.costs.matrix(lin.jacobian).toarray()[rows]
    A = program.constraints.matrix(lin.constraint_jacobian).toarray()
    r, c = lin.residual[rows], lin.constraints
    Z = null_space(A[:, :4])
    offset, slope = -np.linalg.pinv(A[:, :4]) @ c, -np.linalg.pinv(A[:, :4]) @ A[:, 4:]
    gone, rest, left = J[:, :4] @ Z, J[:, 4:] + J[:, :4] @ slope, r + J[:, :4] @ offset
    projector = np.eye(len(left)) - gone @ np.linalg.pinv(gone)
    information = rest.T @ projector @ rest
    return information, -np.linalg.solve(information, rest.T @ projector @ left)


@pytest.mark.parametrize("iterations", [0, 20])
def test_a_prior_does_not_depend_on_where_a_linear_graph_was_left(iterations: int) -> None:
    """Constraints that do not hold yet where the solve ended count with what they lack."""
    graph, x, y = pair()
    guess = {x: np.array([[4.0, -3.0], [0.5, 7.0]]), y: np.array([[-2.0, 1.0]])}
    solution = SQP(max_iterations=iterations).solve(graph, guess)
    assert (solution.violation > 0.4) == (iterations == 0)
    mean, information = solution.marginal_prior(["prior", "step", "now", "tie"], x, y)
    expected, place = eliminated(graph, x, y)
    np.testing.assert_allclose(information, expected, atol=1e-9)
    np.testing.assert_allclose(mean[0], place, atol=1e-8)
    # Left out, the tie says nothing: another prior.
    loose = solution.marginal_prior(["prior", "step", "now"], x, y)[1]
    assert np.abs(loose - expected).max() > 0.1


def test_a_factor_may_hold_a_variable_twice() -> None:
    """Its derivatives along both arguments add up."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    graph.minimize(lambda a, b, c: 2.0 * a + b - c, x[0], x[0], y[0], sigma=0.5, name="twice")
    graph.minimize(fg.prior, x, np.zeros(1), sigma=1.0, name="prior")
    graph.minimize(fg.prior, y, np.zeros(1), sigma=1.0, name="rest")
    solution = GaussNewton().solve(graph, {x: [[1.0]], y: [[1.0]]}, check=True)
    _, information = solution.marginal_prior(["twice", "prior"], x, y)
    # y = 3 x + noise of sigma 0.5, x of sigma 1.
    np.testing.assert_allclose(information, 1.0 / (9.0 + 0.25))
    np.testing.assert_allclose(solution.covariance(x), 1.0 / (1.0 + 9.0 / 1.25))


def test_a_solution_remembers_which_constraints_were_equalities() -> None:
    """Limits are data: the next solve may switch a constraint off, what the last one says stays."""
    graph, limits = fg.Graph(), []
    x, y = graph.variables("x", fg.Rn(1), 1), graph.variables("y", fg.Rn(1), 1)
    for name, value in (("low", 0.0), ("high", 0.0)):
        limits.append(graph.data(name, value))
    graph.minimize(fg.prior, x, np.zeros(1), sigma=2.0, name="prior")
    graph.minimize(fg.prior, y, np.zeros(1), sigma=9.0, name="rest")
    graph.constrain(lambda a, b: b - a, x, y, lower=limits[0], upper=limits[1], name="same")
    run = SQP().prepare(graph)
    guess = {x: np.ones((1, 1)), y: np.ones((1, 1))}
    tied = run.solve(guess, check=True)
    before = tied.marginal_prior(["prior", "same"], x, y)[1]
    np.testing.assert_allclose(before, 0.25)
    free = run.solve(guess, data={limits[0]: -np.inf, limits[1]: np.inf}, check=True)
    np.testing.assert_allclose(tied.marginal_prior(["prior", "same"], x, y)[1], before)
    assert not free.marginal_prior(["prior", "same"], x, y)[1].any()
    for low, high in ((-np.inf, 5.0), (-5.0, np.inf), (-5.0, 5.0)):
        ranged = run.solve(guess, data={limits[0]: low, limits[1]: high}, check=True)
        with pytest.raises(fg.GraphError, match=r"'same' \(factor 0\) is an inequality") as caught:
            ranged.marginal_prior(["prior", "same"], x, y)
        assert (caught.value.term, caught.value.index) == ("same", 0)


def test_one_inequality_among_equalities_is_refused_and_named() -> None:
    graph, x, y = graph_of(("x", fg.Rn(1), 2), ("y", fg.Rn(1), 2))
    graph.minimize(fg.prior, x, np.zeros(1), name="prior")
    graph.minimize(fg.prior, y, np.zeros(1), name="rest")
    limit = np.array([[0.0], [1.0]])
    graph.constrain(lambda a, b: b - a, x, y, lower=-limit, upper=limit, name="tie")
    solution = SQP().solve(graph, {x: np.ones((2, 1)), y: np.ones((2, 1))}, check=True)
    with pytest.raises(fg.GraphError, match=r"'tie' \(factor 1\) is an inequality") as caught:
        solution.marginal_prior(["prior", "tie"], x, y)
    assert (caught.value.term, caught.value.index) == ("tie", 1)


def test_the_first_unknown_of_a_graph_is_one_like_all_others() -> None:
    graph, x = graph_with(fg.Rn(1), 3)
    graph.minimize(lambda a, b: b - a, x[:-1], x[1:], sigma=0.5, name="step")
    graph.minimize(fg.prior, x[2], np.zeros(1), name="end")
    solution = GaussNewton().solve(graph, {x: np.ones((3, 1))}, check=True)
    with pytest.raises(fg.GraphError, match=r"also depend on x\[0\]") as caught:
        solution.marginal_prior(["step"], x[1], x[2])
    assert (caught.value.family, caught.value.index) == ("x", 0)
    _, information = solution.marginal_prior(["step", "end"], (x[1], x[2]), x[0])
    np.testing.assert_allclose(information, 1.0 / (1.0 + 0.25 + 0.25))


# ---------------------------------------------------------------- covariances


def test_a_fixed_member_has_no_variance_and_the_others_have_theirs() -> None:
    graph, x = graph_with(fg.Rn(1), 4)
    graph.fix(x[2], np.zeros(1))
    graph.minimize(lambda a, b: b - a, x[:-1], x[1:], sigma=0.5, name="step")
    solution = GaussNewton().solve(graph, {x: np.ones((4, 1))}, check=True)
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[3, 3] = [[0.5, 0.25], [0.25, 0.25]], 0.25
    np.testing.assert_allclose(solution.covariance(x), expected, atol=1e-12)
    np.testing.assert_allclose(solution.covariance(x[3], x[2], x[0]), np.diag([0.25, 0.0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(solution.covariance(x[1], x[0]), [[0.25, 0.25], [0.25, 0.5]])
    np.testing.assert_allclose(solution.marginals(x)[:, 0, 0], np.diag(expected), atol=1e-12)


def test_one_direction_that_nothing_determines_is_enough_to_refuse() -> None:
    """Three of four numbers are known well; their sum with the fourth is not."""
    graph, x, y = graph_of(("x", fg.Rn(3), 1), ("y", fg.Rn(1), 1))
    graph.minimize(fg.prior, x, np.zeros(3), name="prior")
    graph.minimize(lambda a: a[:, :1] * 0.0, y, name="nothing")
    solution = GaussNewton(max_iterations=0).solve(graph, {x: np.ones((1, 3)), y: np.ones((1, 1))})
    with pytest.raises(fg.GraphError, match="not determined"):
        solution.covariance(x)
    graph, x = graph_with(fg.Rn(2), 2)
    graph.minimize(lambda a, b: a - b, x[0], x[1], sigma=1e-3, name="relative")
    graph.minimize(lambda a: a[:, :1], x[0], sigma=1e3, name="first coordinate")
    solution = GaussNewton(max_iterations=0).solve(graph, {x: np.ones((2, 2))})
    with pytest.raises(fg.GraphError, match="not determined"):
        solution.covariance(x[1])


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_rounding_does_not_pass_for_information(unit: float) -> None:
    """A chain that hangs on nothing in one direction: what its last pivot has left is rounding, sometimes positive."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        graph, x = graph_with(fg.Rn(2), 6)
        sigmas = unit * rng.uniform(0.1, 1.0, (5, 2))
        graph.minimize(lambda a, b: a - b, x[:-1], x[1:], sigma=sigmas, name="relative")
        graph.minimize(lambda a: a[:, :1], x[0], sigma=unit, name="first coordinate")
        solution = GaussNewton(max_iterations=0).solve(graph, {x: np.ones((6, 2))})
        with pytest.raises(fg.GraphError, match="not determined"):
            solution.covariance(x[5])


def test_solutions_with_other_active_limits_share_no_structure() -> None:
    """Asked in turn, each answers for the limits that are active in it."""
    graph, x = graph_with(fg.Rn(1), 2)
    target = graph.data("target", np.zeros(2))
    graph.minimize(lambda a, b, t: np.concatenate([a, b], axis=1) - t, x[0], x[1], target, sigma=2.0, name="wish")
    graph.minimize(lambda a, b: b - a, x[0], x[1], sigma=1.0, name="alike")
    graph.bound(x, lower=-1.0, upper=1.0, name="limits")
    run = InteriorPoint(tolerance=1e-7).prepare(graph)
    guess = {x: np.zeros((2, 1))}
    information = np.array([[1.25, -1.0], [-1.0, 1.25]])
    solved = []
    for wish, free in (([0.0, 0.0], [0, 1]), ([9.0, -1.0], [1]), ([-1.0, 9.0], [0]), ([18.0, -18.0], [])):
        solution = run.solve(guess, data={target: wish}, check=True)
        active = np.abs(solution.dual("limits")[:, 0]) > 1e-3
        assert np.flatnonzero(~active).tolist() == free
        expected = np.zeros((2, 2))
        if free:
            expected[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
        solved.append((solution, expected))
    for solution, expected in (*solved, *reversed(solved)):
        np.testing.assert_allclose(solution.covariance(x), expected, atol=1e-6)


# ---------------------------------------------------------------- reactions, shifted guesses, the worst row


def test_reactions_balance_the_gradient() -> None:
    graph, x = graph_with(fg.Rn(2), 2)
    graph.fix(x[0], np.array([1.0, 2.0]), name="anchor")
    graph.minimize(lambda a, b: b - a, x[0], x[1], sigma=0.5, name="step")
    graph.minimize(fg.prior, x[1], np.array([4.0, -4.0]), name="end")
    graph.bound(x[1], upper=[1.2, np.inf], name="box")
    solution = SQP().solve(graph, {x: np.array([[1.0, 2.0], [0.0, 0.0]])}, check=True)
    moved = solution[x][1] - [1.0, 2.0]
    np.testing.assert_allclose(moved[0], 0.2, atol=1e-9)
    # What pulls the second point to the right: the wish, less the step; the bound and the anchor hold against it.
    np.testing.assert_allclose(solution.dual("box"), [[(4.0 - 1.2) - 4.0 * 0.2, 0.0]], atol=1e-6)
    np.testing.assert_allclose(solution.dual("anchor"), [4.0 * moved], atol=1e-6)
    with pytest.raises(fg.GraphError, match=r"'boxes' \(there are: box, anchor\)"):
        solution.dual("boxes")


def test_a_shift_moves_values_and_multipliers_and_repeats_the_end() -> None:
    graph, x, p = graph_of(("x", fg.Rn(1), 5), ("p", fg.Rn(1), 1))
    graph.minimize(fg.prior, x, np.array([3.0]), name="wish")
    graph.minimize(fg.prior, p, np.array([7.0]), name="parameter")
    limits = np.arange(5.0)[:, None] / 4.0
    graph.bound(x, upper=limits, name="each")
    graph.constrain(lambda a, q: a - q, x[1:3], p, upper=0.0, name="shared")
    solution = InteriorPoint(tolerance=1e-9).solve(graph, {x: np.zeros((5, 1)), p: np.zeros((1, 1))}, check=True)
    np.testing.assert_allclose(solution[x], limits, atol=1e-6)
    forces = solution.dual("each")
    np.testing.assert_allclose(forces, 3.0 - limits, atol=1e-5)
    for by, rows in ((0, [0, 1, 2, 3, 4]), (1, [1, 2, 3, 4, 4]), (3, [3, 4, 4, 4, 4]), (9, [4] * 5)):
        guess = solution.shifted(x, by=by)
        assert np.array_equal(guess.values[x], solution[x][rows])
        assert np.array_equal(guess.values[p], solution[p])  # not asked to move
        assert np.array_equal(guess.multipliers["each"], forces[rows])
    still = solution.shifted(p)
    assert np.array_equal(still.multipliers["each"], forces)
    with pytest.raises(fg.GraphError, match="must not be negative"):
        solution.shifted(x, by=-1)


def test_the_worst_row_is_named_where_something_is_violated() -> None:
    graph, x = drawn_to([0.0], 3, name="wish")
    graph.bound(x, upper=5.0, name="loose")
    graph.constrain(lambda a: a, x, lower=np.array([[0.0], [2.0], [1.0]]), name="tight")
    solution = SQP(max_iterations=0).solve(graph, {x: np.zeros((3, 1))})
    assert solution.worst == ("tight", 1) and solution.violation == 2.0
    assert "'tight', factor 1" in solution.report()
    solved = SQP().solve(graph, {x: np.zeros((3, 1))}, check=True)
    assert "Largest violation" not in solved.report()


# ---------------------------------------------------------------- checks


def test_check_names_the_place_of_every_mistake() -> None:
    """Wrong Jacobians by factor, argument and number; unknowns that hang together; equalities that say the same."""
    graph, x, y = graph_of(("x", fg.Rn(2), 3), ("y", fg.Rn(2), 3))

    def jacobian(a: Array, b: Array) -> list[Array]:
        blocks = [np.tile(-np.eye(2), (3, 1, 1)), np.tile(np.eye(2), (3, 1, 1))]
        blocks[1][2, 1, 0] += 1e-3
        return blocks

    graph.minimize(fg.residual(lambda a, b: b - a, jacobian, "tie"), x, y)
    graph.minimize(fg.prior, x[:2], np.zeros(2), name="prior")
    guess = {x: np.ones((3, 2)), y: np.zeros((3, 2))}
    report = graph.check(guess)
    wrong, loose = report.findings[0], report.findings[1:]
    assert (wrong.kind, wrong.term, wrong.family, wrong.index) == ("wrong Jacobian", "tie", "y", 2)
    assert "argument 1 (y) has 0.001 where differentiation gives" in wrong.message
    assert "(factor 2, row 1, tangent column 0)" in wrong.message
    assert {(f.kind, f.family, f.index) for f in loose} == {("undetermined", "x", 2), ("undetermined", "y", 2)}
    graph.constrain(lambda a: a[:, :1], x[2], lower=0.0, upper=0.0, name="once")
    graph.constrain(lambda a: a[:, 1:], x[2], lower=0.0, upper=1.0, name="no equality")
    graph.minimize(fg.prior, x[2], np.zeros(2), name="prior of the last")
    assert [f.kind for f in graph.check(guess).findings] == ["wrong Jacobian"]


def test_check_accepts_jacobians_that_are_as_good_as_differences() -> None:
    graph, x = graph_with(fg.Rn(1), 2)
    graph.minimize(
        fg.residual(lambda a: 1e4 * a**2, lambda a: [(2e4 * a + 0.04)[:, :, None]], "steep"), x, name="steep"
    )
    assert graph.check({x: np.ones((2, 1))})  # a relative error of 2e-6
    graph, x = graph_with(fg.Rn(1), 2)
    graph.minimize(fg.residual(lambda a: 1e4 * a**2, lambda a: [(2e4 * a + 1.0)[:, :, None]], "steep"), x, name="steep")
    assert not graph.check({x: np.ones((2, 1))})


@pytest.mark.parametrize("sigma", [1e-9, 1.0, 1e9])
def test_check_finds_what_is_undetermined_whatever_the_unit(sigma: float) -> None:
    graph, x = graph_with(fg.Rn(1), 3)
    graph.minimize(lambda a, b: b - a, x[:-1], x[1:], sigma=sigma, name="steps")
    assert [finding.family for finding in graph.check({x: np.zeros((3, 1))}).findings] == ["x"], (
        "nothing says where they begin"
    )
    graph.minimize(fg.prior, x[0], [0.0], sigma=sigma, name="begin")
    assert not graph.check({x: np.zeros((3, 1))}).findings


@pytest.mark.parametrize("sigma", [1e-6, 1.0, 1e6])
def test_a_prior_of_what_leaves_is_the_same_in_every_unit(sigma: float) -> None:
    graph, x = graph_with(fg.Rn(2), 2)
    graph.minimize(fg.prior, x[0], [1.0, -2.0], sigma=sigma, name="prior")
    graph.minimize(lambda a, b: b - a - [3.0, 0.5], x[0], x[1], sigma=2.0 * sigma, name="step")
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 2))})
    reference, information = solution.marginal_prior(["prior", "step"], x[0], x[1])
    np.testing.assert_allclose(reference, [[4.0, -1.5]], rtol=1e-9)
    np.testing.assert_allclose(information, np.eye(2) / (5.0 * sigma**2), rtol=1e-9, atol=1e-12 / sigma**2)


# ---------------------------------------------------------------- what a solve says of itself


def test_a_report_gives_the_number_that_decided() -> None:
    graph, x = drawn_to([2.0])
    text = GaussNewton().solve(graph, {x: np.zeros((1, 1))}).report()
    assert "relative offset" in text and "violation" not in text
    graph.constrain(lambda a: a, x, upper=1.0, name="limit")
    text = SQP().solve(graph, {x: np.zeros((1, 1))}).report()
    assert "stationarity" in text and "violation" in text and "relative offset" not in text


def test_no_iteration_is_a_limit_like_any_other() -> None:
    graph, x = drawn_to([2.0])
    solution = GaussNewton(max_iterations=0).solve(graph, {x: np.ones((1, 1))})
    assert solution.status is fg.Status.ITERATION_LIMIT and solution[x] == 1.0


STEPPING = backends(*LEAST_SQUARES, *CONSTRAINED, keep_values=True)


@pytest.mark.parametrize("name", STEPPING)
def test_a_history_gives_the_length_of_the_step_that_was_taken(name: str) -> None:
    """Far out the arctangent is so flat that full steps overshoot: what was shortened is counted as it was taken."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(lambda p: np.arctan(p - 1.0), x, name="bend")
    if name not in LEAST_SQUARES:
        y = graph.variables("y", fg.Rn(1), 1)
        graph.minimize(fg.prior, y, [0.0], sigma=100.0)
        graph.constrain(lambda p, q: p - q, x, y, lower=0.0, upper=0.0, name="same")
    guess = {family: np.array([[4.0]]) for family in graph.families.values()}
    history = STEPPING[name].solve(graph, guess).history
    assert len(history) > 2
    for before, after in pairwise(history):
        assert before.values is not None and after.values is not None
        moved = [after.values[family] - before.values[family] for family in after.values]
        assert after.step_norm == pytest.approx(np.linalg.norm(moved), rel=1e-6, abs=1e-9)
