"""QP solvers that are no routes of ours, taken by the name qpsolvers gives them."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import drawn_to, weighed_chain
from problems.known import PROBLEMS, Problem, active_bounds, short_drive
from unifg.solvers import SQP, InteriorPoint
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.piqp_route import ElasticRoute
from unifg.solvers.quadratic_programs.qpsolvers_route import QpsolversRoute
from unifg.solvers.quadratic_programs.subproblem import qp_error, subproblem

NAMES = ["quadprog", "clarabel"]  # a dense active-set method, and a sparse interior point
CONSTRAINED = [problem for problem in PROBLEMS if problem.constrained]


@pytest.mark.product(20)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("problem", CONSTRAINED, ids=lambda problem: problem.name)
def test_solves_by_name(name: str, problem: Problem) -> None:
    """The same optimum and multipliers as every other route finds."""
    graph, guess = problem.build()
    solution = SQP(qp=name).solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 5e-6
    if np.isfinite(problem.cost):
        assert solution.cost == pytest.approx(problem.cost, abs=1e-5)
    for term, expected in problem.duals.items():
        np.testing.assert_allclose(solution.dual(term), expected, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_named_solver_does_the_work(name: str) -> None:
    """Solve with the named solver alone, without ours behind it, beside a disc; on bounds alone, where signs show."""
    graph, guess = short_drive()
    solution = SQP(qp=name, fallback=None).solve(graph, guess, check=True)
    assert {row.details["qp"] for row in solution.history[1:]} == {name}
    graph, guess = active_bounds()
    bounded = SQP(qp=name, fallback=None).solve(graph, guess, check=True)
    np.testing.assert_allclose(bounded.dual("box"), [[2.0, -2.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_one_subproblem_is_what_the_engine_finds(name: str) -> None:
    graph, guess = short_drive()
    program = graph.compile()
    first = SQP().solve(graph, guess)
    qp = subproblem(program, program.linearize(program.values_from(first.values)), 1e-3)
    zero = np.zeros(program.constraints.count)
    mine = GraphRoute(program).solve(qp, zero, 1e-10)
    theirs = QpsolversRoute(program, name).solve(qp, zero, 1e-8)
    assert theirs.error == pytest.approx(qp_error(qp, theirs.step, theirs.multipliers))
    assert theirs.error < 1e-6 and not theirs.infeasible
    np.testing.assert_allclose(theirs.step, mine.step, atol=1e-5)
    np.testing.assert_allclose(theirs.multipliers, mine.multipliers, atol=1e-3)


@pytest.mark.parametrize("name", ["piqp", *NAMES])
@pytest.mark.parametrize("sigma", [1e3, 1e5])
def test_small_costs_are_solved_like_costs_of_one(name: str, sigma: float) -> None:
    """Tolerances of a solver are absolute: multipliers of costs of 1e-6 and 1e-10 have as many digits."""
    graph, x = drawn_to([2.0, 1.0], sigma=sigma)
    graph.constrain(lambda p: 0.01 * p[:, :1], x, lower=-0.01, upper=0.005, name="wall")
    solution = SQP(qp=name, fallback=None, max_iterations=5).solve(graph, {x: np.zeros((1, 2))}, check=True)
    np.testing.assert_allclose(solution[x], [[0.5, 1.0]], atol=1e-5)
    np.testing.assert_allclose(solution.dual("wall") * sigma**2, [[150.0]], rtol=1e-4)


@pytest.mark.parametrize("name", ["osqp", "piqp", *NAMES])
@pytest.mark.parametrize(("sigma", "soft"), [(1e-5, None), (1e-5, 1e3), (1e-6, None)])
def test_large_costs_are_solved_like_costs_of_one(name: str, sigma: float, soft: float | None) -> None:
    """Curvatures of 1e10 made the units of unknowns tiny, in which OSQP and PIQP found convex problems infeasible."""
    for seed in range(6):
        graph, guess = weighed_chain(seed, sigma, soft)
        best = InteriorPoint().solve(graph, guess, check=True).cost
        for limit in (np.inf, 100.0):  # compiled code begins the one, Python the other
            solution = SQP(qp=name, time_limit=limit).solve(graph, guess, check=True)
            assert solution.cost == pytest.approx(best, rel=1e-5)


def test_the_elastic_problem_outweighs_large_costs() -> None:
    """Multipliers of costs of 1e10 are 1e10, and a price of 1e3 left the rows violated that can be met."""
    graph, x = drawn_to([0.0], sigma=1e-5)
    graph.constrain(fg.prior, x, [1.0], lower=0.0, upper=0.0)
    program = graph.compile()
    qp = subproblem(program, program.linearize(program.values_from({x: [[0.0]]})), 0.0, program.normal)
    answer = ElasticRoute(program, program.normal).solve(qp, 0.0)
    np.testing.assert_allclose(answer.step, [1.0], atol=1e-6)
    np.testing.assert_allclose(answer.multipliers, [-1e10], rtol=1e-6)


@pytest.mark.parametrize("name", ["osqp", *NAMES])
def test_contradictions_are_left_to_the_elastic_problem(name: str) -> None:
    """Near the origin the linearised circle asks for an impossible step within the box."""
    graph, x = drawn_to([1.0, 1.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0)
    graph.bound(x, lower=-2.0, upper=2.0)
    solution = SQP(qp=name).solve(graph, {x: np.array([[0.01, 0.02]])}, check=True)
    assert "elastic" in {row.details["qp"] for row in solution.history[1:]}
    np.testing.assert_allclose(solution[x], 0.5**0.5, atol=1e-6)


@pytest.mark.parametrize("options", [{"qp": "nope"}, {"fallback": "nope"}])
def test_names_of_no_solver_are_refused_before_there_is_a_graph(options: dict[str, str]) -> None:
    with pytest.raises(fg.BackendError, match=r"QP solver .nope. is not installed .there are: .*graph"):
        SQP(**options)  # type: ignore[arg-type]
