"""The language: what a user writes, what comes back, and what is refused before the first iteration."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems import short_drive
from unifg.models import obstacles, unicycle
from unifg.solvers import SQP, AugmentedLagrangian, GaussNewton, LevenbergMarquardt
from unifg.typing import Array


def line(count: int = 4) -> tuple[fg.Graph, fg.Family]:
    graph = fg.Graph()
    return graph, graph.variables("x", fg.Rn(2), count)


def test_data_changes_the_answer_without_a_new_program() -> None:
    graph, x = line(1)
    target = graph.data("target", [1.0, 2.0])
    graph.minimize(fg.prior, x, target)
    run = GaussNewton().prepare(graph)
    program = graph.compile()
    np.testing.assert_allclose(run.solve({x: np.zeros((1, 2))})[x], [[1.0, 2.0]])
    np.testing.assert_allclose(run.solve({x: np.zeros((1, 2))}, data={target: [5.0, 6.0]})[x], [[5.0, 6.0]])
    np.testing.assert_allclose(run.solve({x: np.zeros((1, 2))})[x], [[1.0, 2.0]])
    assert graph.compile() is program


def test_shared_variable_is_broadcast_over_factors() -> None:
    """One scale shared by five measurements, stated in one term."""
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(1), 5)
    scale = graph.variables("scale", fg.Rn(1), 1)
    truth = np.arange(1.0, 6.0)[:, None]
    graph.minimize(fg.prior, x, truth)
    graph.minimize(lambda p, s, z: p * s - z, x, scale, 1.7 * truth)
    solution = GaussNewton().solve(graph, {x: np.ones((5, 1)), scale: np.ones((1, 1))}, check=True)
    assert solution[scale][0, 0] == pytest.approx(1.7)


def test_states_times_obstacles_both_ways() -> None:
    """N poses x M discs as one (n, M) residual and as index arrays give the same multipliers."""
    centre, radius = np.array([[1.0, -0.1], [1.5, 0.4]]), np.array([0.3, 0.2])
    answers = []
    for indexed in (False, True):
        graph, guess = short_drive(disc=False)
        x = graph.families["x"]
        if indexed:
            i, j = (a.ravel() for a in np.meshgrid(np.arange(1, len(x)), [0, 1], indexing="ij"))
            which = graph.data("which", np.concatenate([centre, radius[:, None]], axis=1)[j], each=True)
            graph.constrain(
                lambda p, d: np.linalg.norm(p[:, :2] - d[:, :2], axis=1, keepdims=True) - d[:, 2:],
                x[i], which, lower=0.0, name="discs",
            )  # fmt: skip
        else:
            graph.constrain(obstacles.disc_clearance, x[1:], centre, radius, lower=0.0, name="discs")
        solution = SQP().solve(graph, guess, check=True)
        answers.append((solution.cost, solution.dual("discs").ravel()))
    assert answers[0][0] == pytest.approx(answers[1][0], rel=1e-7)
    np.testing.assert_allclose(answers[0][1], answers[1][1], atol=1e-4)


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
    graph, x = line(2)
    graph.minimize(fg.prior, x, [1.0, 1.0])
    with np.errstate(all="ignore"):
        graph.minimize(lambda p: np.log(p), x, active=np.array([True, False]))
        solution = LevenbergMarquardt().solve(graph, {x: np.array([[2.0, 2.0], [-1.0, -1.0]])})
    assert solution.converged
    np.testing.assert_allclose(solution[x][1], 1.0)


def test_information_and_sigma_agree() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    omega = root @ root.T
    costs = []
    for information in (omega, np.tile(omega, (2, 1, 1))):
        graph = fg.Graph()
        x = graph.variables("x", fg.SE2, 2)
        graph.minimize(fg.prior, x, np.array([1.0, 2.0, 0.3]), information=information)
        lin = graph.compile().linearize({x: np.zeros((2, 3))})
        costs.append(lin.cost)
    r = fg.SE2.local(np.array([1.0, 2.0, 0.3]), np.zeros(3))
    assert costs == pytest.approx([r @ omega @ r] * 2)


def test_fixed_variable_reports_its_reaction() -> None:
    """A spring of unit stiffness stretched by 2: the fixed end feels -2, the sign of -gradient."""
    graph, x = line(2)
    graph.fix(x[0], [0.0, 0.0], name="anchor")
    graph.minimize(fg.difference, x[0], x[1])
    graph.minimize(fg.prior, x[1], [4.0, 0.0])
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 2))}, check=True)
    np.testing.assert_allclose(solution[x], [[0.0, 0.0], [2.0, 0.0]])
    np.testing.assert_allclose(solution.dual("anchor"), [[2.0, 0.0]])


def test_fixed_component_of_a_product() -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.Product(pose=fg.SE2, v=fg.Rn(1)), 2)
    graph.fix(x.v[0], 0.5)
    graph.minimize(fg.prior, x.pose, [1.0, 0.0, 0.0])
    graph.minimize(fg.prior, x.v, [2.0])
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 4))}, check=True)
    np.testing.assert_allclose(solution[x.v], [[0.5], [2.0]])
    np.testing.assert_allclose(solution[x.pose[1]], [[1.0, 0.0, 0.0]], atol=1e-12)


def test_shift_moves_values_and_multipliers_by_stage() -> None:
    graph, guess = short_drive()
    x, u = graph.families["x"], graph.families["u"]
    solution = SQP().solve(graph, guess, check=True)
    moved = solution.shifted(x, u, by=1)
    np.testing.assert_array_equal(moved.values[x][:-1], solution[x][1:])
    np.testing.assert_array_equal(moved.values[x][-1], solution[x][-1])
    for name in ("dynamics", "limits", "disc clearance"):
        np.testing.assert_array_equal(moved.multipliers[name][:-1], solution.dual(name)[1:])
        np.testing.assert_array_equal(moved.multipliers[name][-1], solution.dual(name)[-1])


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
    graph, x = line(1)
    graph.minimize(fg.prior, x, [0.0, 0.0], robust=fg.Reweighted(lambda s: np.where(s < 1.0, 0.25, 1.0)), name="beam")
    program = graph.compile()
    lin = program.linearize({x: np.array([[2.0, 0.0]])})
    assert lin.cost == pytest.approx(2.0)
    inside = {x: np.array([[0.5, 0.0]])}
    assert program.evaluate(inside, lin.weights).cost == pytest.approx(0.125)
    assert program.evaluate(inside).cost == pytest.approx(0.25 * 0.125)


def test_covariance_of_a_chain_and_of_a_constrained_pose() -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(1), 3)
    graph.minimize(fg.prior, x[0], [0.0], sigma=0.1)
    graph.minimize(fg.difference, x[:-1], x[1:], sigma=0.2)
    solution = GaussNewton().solve(graph, {x: np.ones((3, 1))})
    np.testing.assert_allclose(np.diag(solution.covariance(x)), [0.01, 0.05, 0.09], rtol=1e-9)
    graph = fg.Graph()
    p = graph.variables("p", fg.Rn(2), 1)
    graph.minimize(fg.prior, p, [0.0, 0.0], sigma=[1.0, 2.0])
    graph.constrain(lambda q: q[:, :1] - q[:, 1:], p, lower=0.0, upper=0.0)
    solution = SQP().solve(graph, {p: np.ones((1, 2))}, check=True)
    np.testing.assert_allclose(solution.covariance(p), np.full((2, 2), 0.8), rtol=1e-6)  # 1 / (1 + 1/4)


def test_graphs_solutions_and_prepared_solvers_pickle() -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 2)
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.between, x[0], x[1], [1.0, 0.0, 0.3], sigma=0.1)
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 3))}, check=True)
    again = pickle.loads(pickle.dumps(solution))
    assert again.cost == solution.cost
    copy = pickle.loads(pickle.dumps(graph))
    y = copy.families["x"]
    np.testing.assert_allclose(GaussNewton().solve(copy, {y: np.zeros((2, 3))})[y], solution[x])
    run = pickle.loads(pickle.dumps(SQP().prepare(graph)))
    assert run.solve({run.program.graph.families["x"]: np.zeros((2, 3))}).converged


def test_history_has_each_term_and_timing() -> None:
    graph, guess = short_drive()
    solution = AugmentedLagrangian().solve(graph, guess, check=True)
    assert [row.number for row in solution.history] == list(range(solution.iterations + 1))
    for row in solution.history:
        assert set(row.terms) == {term.name for term in graph.terms}
    assert all(a.seconds <= b.seconds for a, b in zip(solution.history, solution.history[1:], strict=False))
    assert solution.history[-1].terms["dynamics"] < 1e-6
    assert str(solution.iterations) in solution.report()


# ------------------------------------------------------------------ what is refused

Breaks = Callable[[fg.Graph, fg.Family], object]

REFUSALS: list[tuple[str, Breaks, str]] = [
    ("family name twice", lambda g, x: g.variables("x", fg.Rn(1), 1), "exists already"),
    ("no members", lambda g, x: g.variables("y", fg.Rn(1), 0), "at least one"),
    ("no variable", lambda g, x: g.minimize(fg.prior, np.zeros(2), [0.0, 0.0]), "no variable"),
    ("lengths", lambda g, x: g.minimize(fg.difference, x[:2], x[:3]), "unclear.*has 2.*has 3"),
    (
        "sigma and information",
        lambda g, x: g.minimize(fg.prior, x, [0, 0], sigma=1.0, information=np.eye(2)),
        "not both",
    ),
    ("lower above upper", lambda g, x: g.bound(x, lower=[0.0, 2.0], upper=1.0), "lower exceeds upper"),
    ("nan limit", lambda g, x: g.bound(x, upper=np.nan), "NaN"),
    ("fixed twice", lambda g, x: (g.fix(x[0], [0.0, 0.0]), g.fix(x[:2], [0.0, 0.0])), r"x\[0\] is fixed"),
    ("fix shape", lambda g, x: g.fix(x[0], [0.0, 0.0, 0.0]), "shape"),
    ("fix nan", lambda g, x: g.fix(x[1], [0.0, np.nan]), r"x\[1\]"),
    ("out of range", lambda g, x: x[7], "family 'x' has 4"),
    (
        "name taken",
        lambda g, x: (g.bound(x, upper=1, name="a"), g.bound(x, lower=0, name="a")),
        "'a' is taken",
    ),
    ("other graph", lambda g, x: g.minimize(fg.prior, line()[1], [0.0, 0.0]), "another graph"),
    ("data nan", lambda g, x: g.data("z", [np.nan]), "NaN"),
    (
        "residual shape",
        lambda g, x: (g.minimize(lambda p: p[:, 0], x), g.compile()),
        r"returned shape \(4,\)",
    ),
    (
        "sigma shape",
        lambda g, x: (g.minimize(fg.prior, x, [0, 0], sigma=np.ones(3)), g.compile()),
        "sigma has shape",
    ),
    (
        "negative sigma",
        lambda g, x: (g.minimize(fg.prior, x, [0, 0], sigma=-1.0), g.compile()),
        "must be positive",
    ),
    (
        "indefinite information",
        lambda g, x: (g.minimize(fg.prior, x, [0, 0], information=np.diag([1.0, -1.0])), g.compile()),
        "negative eigenvalue",
    ),
    (
        "untouched",
        lambda g, x: (g.minimize(fg.prior, x[:2], [0.0, 0.0]), g.compile()),
        r"x\[2\] is in no cost",
    ),
    ("bound on a group", lambda g, x: g.bound(g.variables("p", fg.SE2, 1), upper=1.0), "not Rn"),
]


@pytest.mark.parametrize(("breaks", "message"), [r[1:] for r in REFUSALS], ids=[r[0] for r in REFUSALS])
def test_bad_statement_is_refused(breaks: Breaks, message: str) -> None:
    graph, x = line()
    with pytest.raises(fg.GraphError, match=message):
        breaks(graph, x)


GUESSES: list[tuple[str, Callable[[fg.Family], dict[fg.Family, Array]], str]] = [
    ("missing", lambda x: {}, "no values for family 'x'"),
    ("shape", lambda x: {x: np.zeros((3, 2))}, r"shape \(3, 2\), expected \(4, 2\)"),
    ("nan", lambda x: {x: np.array([[0, 0], [0, 0], [np.nan, 0], [0, 0.0]])}, r"x\[2\]"),
    ("stranger", lambda x: {x: np.zeros((4, 2)), line()[1]: np.zeros((4, 2))}, "no family of this graph"),
]


@pytest.mark.parametrize(("guess", "message"), [g[1:] for g in GUESSES], ids=[g[0] for g in GUESSES])
@pytest.mark.parametrize("solver", [GaussNewton(), SQP(), AugmentedLagrangian()], ids=["gn", "sqp", "alm"])
def test_bad_guess_is_refused(
    solver: fg.Solver, guess: Callable[[fg.Family], dict[fg.Family, Array]], message: str
) -> None:
    graph, x = line()
    graph.minimize(fg.prior, x, [0.0, 0.0])
    with pytest.raises(fg.GraphError, match=message) as caught:
        solver.solve(graph, guess(x))
    assert caught.value.family in ("x", None)


def test_bad_data_and_duals_are_refused() -> None:
    graph, x = line()
    target = graph.data("target", [0.0, 0.0])
    low = graph.data("low", -1.0)
    graph.minimize(fg.prior, x, target)
    graph.bound(x, lower=low, upper=1.0, name="box")
    run = SQP().prepare(graph)
    guess = {x: np.zeros((4, 2))}
    with pytest.raises(fg.GraphError, match=r"data 'target' has shape \(3,\)"):
        run.solve(guess, data={target: [0.0, 0.0, 0.0]})
    with pytest.raises(fg.GraphError, match="data 'target' contains NaN"):
        run.solve(guess, data={target: [0.0, np.nan]})
    with pytest.raises(fg.GraphError, match="'box': lower exceeds upper in factor 0"):
        run.solve(guess, data={low: 2.0})
    with pytest.raises(fg.GraphError, match="does not belong"):
        run.solve(guess, data={fg.Graph().data("t", [0.0]): [1.0]})
    with pytest.raises(fg.GraphError, match="which is no constraint"):
        run.solve(guess, duals={"bax": np.zeros((4, 2))})
    with pytest.raises(fg.GraphError, match="multipliers of 'box' have shape"):
        run.solve(guess, duals={"box": np.zeros(4)})
    assert run.solve(guess).converged, "a refused solve leaves the prepared solver usable"


def test_not_finite_at_the_guess_names_the_factor() -> None:
    graph, x = line()
    graph.minimize(fg.prior, x, [1.0, 1.0])
    graph.minimize(lambda p: np.log(p), x, name="logarithm")
    guess = np.ones((4, 2))
    guess[2, 1] = -1.0
    with pytest.raises(fg.GraphError, match=r"'logarithm'.*factor 2.*x\[2\]") as caught:
        GaussNewton().solve(graph, {x: guess})
    assert (caught.value.term, caught.value.family, caught.value.index) == ("logarithm", "x", 2)


def test_unknown_dual_and_solution_of_another_family() -> None:
    graph, guess = short_drive()
    solution = SQP().solve(graph, guess)
    with pytest.raises(fg.GraphError, match="no constraint, bound or fix is called 'limit'"):
        solution.dual("limit")
    with pytest.raises(fg.GraphError, match="not part of this solution"):
        solution[line()[1]]


def test_check_true_raises_with_the_solution() -> None:
    graph, guess = short_drive()
    with pytest.raises(fg.NotConverged) as caught:
        SQP(max_iterations=1).solve(graph, guess, check=True)
    assert caught.value.solution.status is fg.Status.ITERATION_LIMIT


# ------------------------------------------------------------------ graph.check


def test_check_finds_nothing_in_a_sound_graph() -> None:
    graph, guess = short_drive()
    report = graph.check(guess)
    assert report, str(report)


def test_check_finds_a_wrong_jacobian() -> None:
    graph = fg.Graph()
    x, u = graph.variables("x", fg.SE2, 3), graph.variables("u", fg.Rn(2), 2)

    def jacobian(*arguments: Array) -> list[Array]:
        assert unicycle.dynamics.jacobian is not None
        blocks = list(unicycle.dynamics.jacobian(*arguments))
        blocks[1] = -blocks[1]
        return blocks

    wrong = fg.residual(unicycle.dynamics.function, jacobian, "dynamics")
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [0.5, 0.1])
    graph.constrain(wrong, x[:-1], u, x[1:], 0.1, lower=0.0, upper=0.0)
    report = graph.check({x: np.zeros((3, 3)), u: np.full((2, 2), 0.3)})
    assert [(f.kind, f.term, f.family) for f in report.findings] == [("wrong Jacobian", "dynamics", "u")]


def test_check_finds_what_nothing_determines() -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 4)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.0])
    report = graph.check({x: np.zeros((4, 3))})
    assert {f.kind for f in report.findings} == {"undetermined"}
    assert {(f.family, f.index) for f in report.findings} == {("x", k) for k in range(4)}
    graph, y = line(3)
    graph.minimize(fg.prior, y[:2], [0.0, 0.0])
    graph.minimize(lambda p: p[:, :1], y[2])
    found = graph.check({y: np.zeros((3, 2))}).findings
    assert [(f.kind, f.family, f.index) for f in found] == [("undetermined", "x", 2)]


def test_check_finds_dependent_constraints_and_bad_residuals() -> None:
    graph, x = line(2)
    graph.minimize(fg.prior, x, [0.0, 0.0])
    graph.constrain(lambda p: p[:, :1], x[0], lower=1.0, upper=1.0, name="once")
    graph.constrain(lambda p: 2.0 * p[:, :1], x[0], lower=2.0, upper=2.0, name="twice")
    found = graph.check({x: np.zeros((2, 2))}).findings
    assert {(f.kind, f.term) for f in found} == {
        ("dependent constraints", "once"),
        ("dependent constraints", "twice"),
    }
    graph.minimize(lambda p: 1.0 / p[:, :1], x, name="inverse")
    with np.errstate(all="ignore"):
        found = graph.check({x: np.array([[1.0, 1.0], [0.0, 1.0]])}).findings
    assert [(f.kind, f.term, f.index) for f in found] == [("not finite", "inverse", 1)]
