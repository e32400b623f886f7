"""OSQP by itself: it does most of SQP's work, within operations that are counted and not timed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import osqp
import pytest

import unifg as fg
from counts import Count, counting
from problems.control import problems
from problems.graphs import drawn_to
from problems.known import active_bounds, short_drive
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import SQP
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.osqp_route import OsqpRoute, counted_iterations
from unifg.solvers.quadratic_programs.subproblem import QP, qp_error, subproblem
from units import drive

CASES = {problem.title: problem for problem in problems()}


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("unicycle straight, discs, N = 50", 0.8),
        ("unicycle curve, discs, N = 50", 0.9),
        ("quadrotor figure8, N = 20", 0.9),
        ("quadrotor goto, spheres, N = 20", 0.8),
    ],
)
def test_osqp_solves_most_subproblems(name: str, share: float) -> None:
    """Beside obstacles too, where it solved one in twenty and was then left out for good."""
    stated = CASES[name].formulation()
    with counting() as count:
        assert SQP(tolerance=1e-4).solve(stated.graph, stated.guess).converged
    assert count.share >= share, count.routes
    assert max(count.asked) <= count.limits[0]


def test_counts_are_kept_apart() -> None:
    count = Count(["osqp", "piqp", "osqp", "elastic"], [10, 80], [80, 80])
    assert (count.by("osqp"), count.by("piqp"), count.share) == (2, 1, 0.5)
    assert Count().share == 0.0


def test_control_c_that_osqp_has_taken_ends_the_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    told = SimpleNamespace(status_val=osqp.SolverStatus.OSQP_SIGINT, iter=1, rho_updates=0)
    monkeypatch.setattr(osqp.OSQP, "solve", lambda *_, **__: SimpleNamespace(info=told))
    graph, guess = active_bounds()
    assert SQP().solve(graph, guess).status is fg.Status.INTERRUPTED


def at(name: str = "short drive") -> tuple[CompiledProblem, QP]:
    """A subproblem near the answer."""
    graph, guess = short_drive() if name == "short drive" else active_bounds()
    program = graph.compile()
    values = SQP().solve(graph, guess).values
    moved = {x: x.manifold.retract(array, np.full(x.manifold.dim, 1e-2)) for x, array in values.items()}
    return program, subproblem(program, program.linearize(program.values_from(moved)), 1e-3)


def test_a_polished_answer_has_all_digits() -> None:
    program, qp = at()
    exact = GraphRoute(program).solve(qp, np.zeros(program.constraints.count), 1e-11)
    answer = OsqpRoute(program, 1000).solve(qp, exact.multipliers, 1e-6)
    assert answer.error == pytest.approx(qp_error(qp, answer.step, answer.multipliers))
    assert answer.error < 1e-8 and answer.iterations <= 200
    np.testing.assert_allclose(answer.step, exact.step, atol=1e-6)
    warm = OsqpRoute(program, 1000).solve(qp, exact.multipliers, 1e-6)
    cold = OsqpRoute(program, 1000).solve(qp, np.zeros(program.constraints.count), 1e-6)
    assert warm.iterations <= cold.iterations


def test_bounds_alone_are_solved_without_a_polish() -> None:
    program, qp = at("bounds")
    answer = OsqpRoute(program, 1000).solve(qp, np.zeros(program.constraints.count), 1e-5)
    assert answer.error < 1e-5


def test_the_limit_is_counted_on_the_graph() -> None:
    """The same for the same structure, whatever the numbers; longer chains cost both methods alike."""
    short, longer = drive(count=10)[0].compile(), drive(count=40)[0].compile()
    assert counted_iterations(short) == counted_iterations(drive(count=10, position=1e3)[0].compile())
    assert abs(counted_iterations(short) - counted_iterations(longer)) <= 20
    assert 30 <= counted_iterations(short) <= 300
    assert OsqpRoute(short, 17).max_iterations == 17
    empty, _ = drawn_to([0.0])
    assert counted_iterations(empty.compile()) > 0


def test_contradictions_and_crossed_limits_are_told() -> None:
    graph, x = drawn_to([0.0])
    graph.constrain(lambda p: p, x, lower=1.0, upper=1.0, name="one")
    graph.constrain(lambda p: p, x, upper=0.0, name="none")
    program = graph.compile()
    qp = subproblem(program, program.linearize(program.values_from({x: [[0.5]]})), 0.0)
    answer = OsqpRoute(program, 2000).solve(qp, np.zeros(2), 1e-6)
    assert answer.infeasible and not np.isfinite(answer.error)
    beyond = replace(qp, lower=np.full(2, 1e21), upper=np.full(2, np.inf))
    assert not np.isfinite(OsqpRoute(program, 100).solve(beyond, np.zeros(2), 1e-6).error)


def test_limits_that_cross_only_where_rows_are_scaled_print_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    """An equality of a row that its weights have left next to nothing of."""
    graph, x = drawn_to([0.0], sigma=1e-9)
    graph.constrain(lambda p: 1e-9 * p - 45.0, x, lower=0.0, upper=0.0, name="far")
    program = graph.compile()
    qp = subproblem(program, program.linearize(program.values_from({x: [[0.5]]})), 0.0)
    faint = replace(qp, jacobian=1e-9 * qp.jacobian)
    for sign in (1.0, -1.0):
        there = replace(faint, lower=sign * faint.lower, upper=sign * faint.upper)
        assert not np.isfinite(OsqpRoute(program, 100).solve(there, np.zeros(1), 1e-6).error)
    assert capfd.readouterr() == ("", "")
