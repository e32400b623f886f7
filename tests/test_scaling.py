"""Units of unknowns and rows: SQP solves in its own, and answers in those of the graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import drawn_to, graph_with
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint, LevenbergMarquardt, Penalty
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.scaling import MODEST, Scaling
from unifg.solvers.quadratic_programs.subproblem import qp_error, subproblem
from units import COST, OTHER_COST, drive

UNITS: list[dict[str, float]] = [
    {"position": 1e-8},
    {"position": 1e-6},
    {"position": 1e-4},
    {"position": 1e4},
    {"position": 1e6},
    {"control": 1e-6},
    {"control": 1e6},
    {"position": 1e-6, "angle": 1e-6, "control": 1e-6},
    {"position": 1e6, "angle": 1e6, "control": 1e6},
    {"position": 1e-6, "control": 1e6},
    {"dynamics": 1e-4},
    {"dynamics": 1e6},
    {"clearance": 1e-4},
    {"clearance": 1e6},
    {"position": 1e4, "dynamics": 1e-4},
]


def named(units: dict[str, float]) -> str:
    return ", ".join(f"{name} {size:g}" for name, size in units.items())


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("units", UNITS, ids=named)
@pytest.mark.product(6)
def test_units_do_not_decide_whether_sqp_converges(units: dict[str, Any], hessian: Any) -> None:
    """The same optimum in about as many steps; the judge keeps to the units of the graph, in which slopes are large."""
    graph, guess = drive(**units)
    solution = SQP(hessian=hessian).solve(graph, guess, check=True)
    assert min(abs(solution.cost / cost - 1.0) for cost in (COST, OTHER_COST)) < 1e-4, solution.report()
    assert solution.iterations <= 25, solution.report()
    if max(units.values()) <= 1e4:  # the judge's differences are too coarse for the others
        assert judge(graph, solution).worst() < 2e-6 * max(1.0, units.get("position", 1.0) / 1e2)


SMALL_COSTS: dict[str, fg.Solver] = {
    "ip": InteriorPoint(),
    "sqp": SQP(),
    "sqp graph": SQP(qp="graph"),
    "al": AugmentedLagrangian(),
    "penalty": Penalty(),
}


@pytest.mark.parametrize("cost", [1e-2, 1e-4])
@pytest.mark.parametrize("name", SMALL_COSTS)
def test_costs_are_judged_in_their_own_size(name: str, cost: float) -> None:
    """Slopes below an absolute tolerance say nothing: costs of 1e-8 at the guess have no others."""
    graph, guess = drive(cost=cost)
    solution = SMALL_COSTS[name].solve(graph, guess)
    off = np.abs(solution.cost / cost**2 / np.array([COST, OTHER_COST]) - 1.0).min()
    assert solution.converged == (off < 1e-4) or name == "penalty"
    assert solution.converged == bool(solution.verify())
    assert solution.converged or name == "penalty"  # whose weights are what its user states


def test_small_scalar_costs_are_judged_in_their_own_size() -> None:
    """A guess with slopes of 1e-9 is no answer; at the answer they vanish, and curvature tells the size."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda v: 1e-9 * ((v[:, 0] - 1.0) ** 2 + (v[:, 0] - v[:, 1]) ** 4 + v[:, 1] ** 2), x)
    graph.constrain(lambda v: v[:, :1], x, upper=5.0, name="far")
    for solver in (InteriorPoint(), AugmentedLagrangian(), SQP()):
        solution = solver.solve(graph, {x: np.zeros((1, 2))}, check=True)
        assert solution.cost == pytest.approx(1.875e-10, rel=1e-3)
        assert solution.verify()
        solution.cost *= 2.0
        assert "the cost is" in solution.verify().sentence


def test_without_scaling_units_decide() -> None:
    graph, guess = drive(position=1e-6)
    assert not SQP(scaling=False, hessian="gauss-newton").solve(graph, guess).converged
    assert SQP().solve(graph, guess).converged


def test_multipliers_come_back_in_the_units_of_the_graph() -> None:
    plain = SQP(tolerance=1e-9).solve(*drive())
    other = SQP().solve(*drive(position=1e-4, dynamics=1e4, clearance=1e-2, control=1e5))
    assert abs(plain.cost - other.cost) < 1e-6
    for name, unit in {"dynamics": 1e4, "disc": 1e-2, "limits": 1e-5}.items():
        np.testing.assert_allclose(unit * other.dual(name), plain.dual(name), rtol=1e-3, atol=1e-5)


def test_modest_units_are_left_alone() -> None:
    graph, guess = drive()
    program = graph.compile()
    lin = program.linearize(program.values_from(guess))
    assert Scaling.of(program, lin).neutral
    graph, guess = drive(position=10.0 * MODEST)
    program = graph.compile()
    assert not Scaling.of(program, program.linearize(program.values_from(guess))).neutral


def test_a_scaled_subproblem_is_the_same_subproblem() -> None:
    """Its matrix is balanced, and its answer, carried back, solves the one it was made of."""
    graph, guess = drive(position=1e-5, control=1e4, dynamics=1e3)
    program = graph.compile()
    lin = program.linearize(program.values_from(guess))
    scaling = Scaling.of(program, lin)
    qp = subproblem(program, lin, 1e-9 * scaling.metric)
    scaled = scaling.scaled(qp)
    matrix = np.abs(program.constraints.matrix(scaled.jacobian).toarray())
    rows = ~program.bound_rows & (matrix.max(axis=1) > 0.0)
    assert matrix[rows].max(axis=1).min() > 0.3 and matrix[rows].max() < 3.0
    answer = GraphRoute(program).solve(scaled, np.zeros(program.constraints.count), 1e-9)
    assert answer.error < 1e-8
    carried = scaling.unscaled(answer)
    size = max(1.0, float(np.abs(qp.gradient).max()))
    assert qp_error(qp, carried.step, carried.multipliers) < 1e-6 * size
    np.testing.assert_array_equal(np.log2(scaling.columns) % 1.0, 0.0)
    none = Scaling.none(program)
    np.testing.assert_array_equal(none.scaled(qp).hessian, qp.hessian)


def beside_disc(gap: float) -> tuple[fg.Graph, dict[fg.Family, Any]]:
    """A point in a disc of radius one and beyond a wall ``gap`` outside of it."""
    graph, x = drawn_to([2.0, 0.5])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=1.0, name="disc")
    graph.constrain(lambda p: p[:, :1], x, lower=1.0 + gap, name="wall")
    return graph, {x: np.array([[0.3, 0.2]])}


def between_lines(gap: float) -> tuple[fg.Graph, dict[fg.Family, Any]]:
    """Two half planes that miss each other by ``gap``."""
    graph, x = drawn_to([2.0, 0.5])
    graph.constrain(lambda p: p.sum(axis=1, keepdims=True), x, upper=1.0, name="below")
    graph.constrain(lambda p: p.sum(axis=1, keepdims=True), x, lower=1.0 + gap, name="above")
    return graph, {x: np.array([[0.3, 0.2]])}


@pytest.mark.product(8)
@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-5, 4e-6])
@pytest.mark.parametrize("build", [beside_disc, between_lines])
@pytest.mark.parametrize("options", [{}, {"qp": "graph"}, {"hessian": "exact"}], ids=["osqp", "graph", "exact"])
def test_constraints_that_miss_each_other_by_little_are_infeasible(build: Any, gap: float, options: Any) -> None:
    solution = SQP(**options).solve(*build(gap))
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution.iterations < 60
    assert 0.45 * gap < solution.violation < 0.85 * gap


@pytest.mark.parametrize("build", [beside_disc, between_lines])
@pytest.mark.parametrize("gap", [-1e-5, -1e-3])
def test_constraints_that_just_meet_are_not(gap: float, build: Any) -> None:
    replace(SQP()).solve(*build(gap), check=True)


@pytest.mark.parametrize("information", [1e-24, 1e-12, 1e-6, 1e6, 1e12, 1e24])
@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
def test_least_squares_has_no_unit_of_cost(hessian: Literal["gauss-newton", "exact"], information: float) -> None:
    """Neither damping nor what counts as rounding may have one: a curved valley, and eight poses around a loop."""
    graph, p = graph_with(fg.Rn(2), 1, "p")
    graph.minimize(
        lambda v: np.stack([10.0 * (v[:, 1] - v[:, 0] ** 2), 1.0 - v[:, 0] + 0.1 * v[:, 1] ** 3], axis=1),
        p, information=information * np.eye(2),
    )  # fmt: skip
    solution = SQP(hessian=hessian).solve(graph, {p: [[-1.2, 1.0]]}, check=True)
    assert solution.iterations <= 50
    rng = np.random.default_rng(3)
    graph, x = graph_with(fg.SE2, 8)
    graph.minimize(fg.prior, x[0], [0.0, 0.0, 0.0], information=information * np.eye(3))
    steps = np.array([1.0, 0.1, 0.5]) + 0.1 * rng.standard_normal((7, 3))
    graph.minimize(fg.between, x[:-1], x[1:], steps, information=information * np.diag([1.0, 2.0, 10.0]))
    graph.minimize(fg.between, x[7], x[0], [1.0, 0.0, 0.7], information=information * np.eye(3))
    assert SQP(hessian=hessian).solve(graph, {x: 0.5 * rng.standard_normal((8, 3))}).converged


def test_damping_compares_no_units() -> None:
    """A linear graph with standard deviations of 1e-6 and 1e6: curvatures differ by 1e24."""
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(1), 3)
    graph.minimize(fg.prior, x, [[1.0], [2.0], [3e6]], sigma=[[1e-6], [1.0], [1e6]])
    graph.minimize(lambda a, b: b - a, x[:-1], x[1:], sigma=[[1.0], [1e6]])
    solution = LevenbergMarquardt().solve(graph, {x: np.zeros((3, 1))})
    assert solution.converged and solution.iterations <= 2
