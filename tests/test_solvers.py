"""Every backend on one table of problems, judged by :mod:`judge`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import graph_of, graph_with
from problems.known import PROBLEMS, Problem, ecg2o, inactive_inequality, short_drive
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)

BACKENDS: list[fg.Solver] = [
    GaussNewton(),
    LevenbergMarquardt(),
    DogLeg(),
    AugmentedLagrangian(),
    SQP(),
    SQP(qp="piqp"),
    SQP(qp="graph"),
    InteriorPoint(),
    InteriorPoint(hessian="gauss-newton"),
    KKT(),
    KKT(full_steps=True),
    KKT(globalization="levenberg-marquardt"),
    Penalty(),
]
IDS = ["gn", "lm", "dogleg", "alm", "sqp", "sqp-piqp", "sqp-graph", "ipm", "ipm-gn"]
IDS += ["kkt", "kkt-full", "kkt-lm", "penalty"]


def takes(solver: fg.Solver, problem: Problem) -> bool:
    """Test whether a backend claims the class of a problem."""
    if isinstance(solver, SQP | InteriorPoint | AugmentedLagrangian):
        return True
    if isinstance(solver, Penalty | KKT):
        return not problem.scalar
    return not (problem.constrained or problem.scalar)


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
@pytest.mark.parametrize("solver", BACKENDS, ids=IDS)
@pytest.mark.product(75)
def test_backend_solves_or_refuses(solver: fg.Solver, problem: Problem) -> None:
    graph, guess = problem.build()
    if not takes(solver, problem):
        with pytest.raises(fg.BackendError):
            solver.solve(graph, guess)
        return
    untouched = {family: np.array(array) for family, array in guess.items()}
    solution = solver.solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    # A penalty leaves violations: the cost falls by what they are worth.
    bought = sum(float(np.abs(dual).sum()) for dual in solution.multipliers.values()) * solution.violation
    slack = 2.0 * bought if isinstance(solver, Penalty) else 0.0
    if np.isfinite(problem.cost):
        assert abs(solution.cost - problem.cost) <= max(1e-7 + slack, 1e-6 * abs(problem.cost))
    for name, expected in problem.answer.items():
        family = graph.families[name]
        distance = family.manifold.local(np.asarray(expected, dtype=float), solution[family])
        assert np.abs(distance).max() < 2e-4 if problem.name == "hs48" else np.abs(distance).max() < 1e-5
    for name, expected in problem.duals.items():
        np.testing.assert_allclose(solution.dual(name), expected, atol=1e-4)
    for family, array in untouched.items():
        np.testing.assert_array_equal(guess[family], array)


@pytest.mark.parametrize("solver", BACKENDS, ids=IDS)
def test_single_solves_share_a_workspace_and_nothing_else(solver: fg.Solver) -> None:
    """A later solve of a graph takes over memory and structure; its answer is that of a graph stated anew."""
    problem = next(problem for problem in PROBLEMS if takes(solver, problem))
    graph, guess = problem.build()
    first = solver.solve(graph, guess)
    moved = {family: first[family] for family in guess}
    solver.solve(graph, moved)
    again = replace(solver).solve(graph, guess)
    kept = graph.compile().workspaces
    assert len(kept) == 1 and again.iterations == first.iterations and again.checked == first.checked
    for family in guess:
        np.testing.assert_array_equal(again[family], first[family])
    replace(solver, tolerance=2.0 * solver.tolerance).solve(graph, guess)
    assert len(kept) == 2


def test_bazzana_stop_rule_does_not_claim_convergence() -> None:
    graph, guess = short_drive(disc=False)
    solver = AugmentedLagrangian(
        schedule="bazzana", penalty=100.0, step_tolerance=1e-2, violation_tolerance=1e-2, tolerance=1e-10
    )
    solution = solver.solve(graph, guess)
    assert solution.status is fg.Status.STOP_RULE
    assert solution.violation < 1e-2
    assert not solution.converged


def test_sqp_history_names_the_route() -> None:
    graph, guess = short_drive()
    solution = SQP(qp_iterations=1).solve(graph, guess, check=True)
    routes = {str(row.details["qp"]) for row in solution.history[1:]}
    assert routes <= {"osqp", "piqp", "elastic"}
    assert "piqp" in routes, "one iteration is too few for OSQP here, so the fallback must appear"


def test_moving_within_bounds_spends_no_iteration() -> None:
    graph, guess = short_drive()
    u = graph.families["u"]
    solution = SQP(max_iterations=1).solve(graph, {**guess, u: 3.0 * guess[u]})
    assert solution.iterations == 1
    assert "qp" in solution.history[1].details, "the one iteration is a subproblem"


@pytest.mark.parametrize("solver", [AugmentedLagrangian(), SQP()])
def test_warm_start_needs_fewer_iterations(solver: Any) -> None:
    graph, guess = short_drive()
    x, u = graph.families["x"], graph.families["u"]
    run = solver.prepare(graph)
    cold = run.solve(guess)
    shifted = cold.shifted(x, u, by=0)
    values = {**shifted.values, u: shifted.values[u] + 1e-4}
    warm = run.solve(fg.Guess(values, shifted.multipliers), check=True)
    assert warm.iterations < cold.iterations


def test_full_steps_and_no_fallback_are_options() -> None:
    graph, guess = ecg2o((0.5, -0.5))
    solution = SQP(full_steps=True).solve(graph, guess, check=True)
    # Equalities only: every subproblem is one linear system, which the engine solves.
    assert {row.details["qp"] for row in solution.history[1:]} == {"graph"}
    graph, guess = inactive_inequality()
    solution = SQP(full_steps=True, fallback=None, qp_iterations=4000).solve(graph, guess, check=True)
    assert {row.details["qp"] for row in solution.history[1:]} == {"osqp"}


def test_missing_qp_solver_is_named() -> None:
    graph, guess = short_drive()
    with pytest.raises(fg.BackendError, match="not installed"):
        SQP(qp="no-such-solver").solve(graph, guess)


def test_backends_are_silent(capfd: pytest.CaptureFixture[str]) -> None:
    """Not even the compiled libraries below may write to the terminal."""
    for problem in PROBLEMS:
        graph, guess = problem.build()
        SQP().solve(graph, guess)
    assert capfd.readouterr() == ("", "")


def test_alm_leaves_a_subproblem_whose_steps_are_too_short_to_be_of_use() -> None:
    """At a kink the gradient never vanishes; what violation remains is for the multipliers, not for more steps."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    graph.minimize(lambda a: np.hstack([1.0 + np.abs(a), 30.0 * a]), x, name="kink")
    graph.minimize(fg.prior, y, [0.0], name="rest")
    graph.constrain(lambda b: b, y, lower=1.0, upper=1.0, name="hold")
    solver = AugmentedLagrangian(penalty=10.0, step_tolerance=5e-3, max_iterations=18)
    solution = solver.solve(graph, {x: np.full((1, 1), 0.3), y: np.zeros((1, 1))})
    assert solution.status is fg.Status.STOP_RULE
    assert solution.violation < 1e-4


@pytest.mark.product(4)
@pytest.mark.parametrize("solver", BACKENDS, ids=IDS)
def test_a_far_start_overflows_in_silence(solver: fg.Solver) -> None:
    """Squares of 1e160 overflow; that is for the status to say, not for a warning or an error of a QP solver."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda p: np.stack([p[:, 0] + np.exp(-p[:, 1]), p[:, 0] ** 2 + 2.0 * p[:, 1]], axis=1), x)
    constrained = not isinstance(solver, GaussNewton | LevenbergMarquardt | DogLeg)
    if constrained:
        graph.constrain(lambda p: p[:, :1] ** 3 + p[:, 1:] ** 2, x, lower=0.0, upper=0.0)
    if constrained and not isinstance(solver, KKT):
        graph.bound(x, upper=1e6)
    for start in ([0.0, -300.0], [1e30, 1.0], [1e5, -200.0]):
        solution = solver.solve(graph, {x: np.array([start])})
        assert isinstance(solution.status, fg.Status)
        assert all(np.isfinite(array).all() for array in solution.values.values())


@pytest.mark.parametrize("guess", [(1.0, 1.0), (1.0, 2.0), (1.0, 0.2)])
def test_a_damped_step_does_not_leave_the_guess_for_where_nothing_is_seen(guess: tuple[float, float]) -> None:
    """BoxBOD of NIST's nonlinear regressions: at a large rate the curve is a constant, and its rate has no slope."""
    t, y = np.array([1.0, 2.0, 3.0, 5.0, 7.0, 10.0]), np.array([109.0, 149.0, 149.0, 191.0, 213.0, 224.0])
    graph = fg.Graph()
    b = graph.variables("b", fg.Rn(2), 1)
    graph.minimize(lambda b, t, y: (b[:, 0] * (1.0 - np.exp(-b[:, 1] * t)) - y)[:, None], b[np.zeros(6, int)], t, y)
    solution = LevenbergMarquardt().solve(graph, {b: np.array([guess])})
    assert solution.converged and solution.iterations < 30
    assert 2.0 * solution.cost == pytest.approx(1168.0088766, rel=1e-9)


def test_points_at_a_wrong_depth_come_back() -> None:
    """Squares of pixels are finite at infinity: undamped steps take points there, and they stay."""
    found = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points = np.column_stack([rng.uniform(-3.0, 3.0, (15, 2)), rng.uniform(4.0, 12.0, 15)])
        places = np.column_stack([0.6 * np.arange(4), 0.1 * rng.standard_normal((4, 2))])
        camera, point = np.repeat(np.arange(4), 15), np.tile(np.arange(15), 4)
        seen = points[point] - places[camera]
        pixels = 500.0 * seen[:, :2] / seen[:, 2:] + 0.5 * rng.standard_normal((60, 2))
        graph = fg.Graph()
        x, p = graph.variables("x", fg.Rn(3), 4), graph.variables("p", fg.Rn(3), 15)
        graph.minimize(fg.prior, x, places, sigma=np.array([[1e-3] * 3] + [[0.1] * 3] * 3), name="places")
        graph.minimize(
            lambda x, p, z: 500.0 * (p - x)[:, :2] / (p - x)[:, 2:] - z, x[camera], p[point], pixels, sigma=0.5
        )
        depths = points * np.exp(rng.uniform(np.log(0.2), np.log(6.0), (15, 1)))
        guess = {x: places + 0.3 * rng.standard_normal((4, 3)), p: depths}
        solution = LevenbergMarquardt().solve(graph, guess)
        found += solution.converged and solution.cost < 100.0
    assert found >= 7
