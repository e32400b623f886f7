"""Corrections that make full steps of SQP good ones: the second-order correction, and the curvature a secant sees."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from problems.control import Unicycle
from problems.graphs import drawn_to, graph_of, graph_with
from problems.hock_schittkowski import SMALL
from unifg.solution.optimality import Tolerances
from unifg.solvers import SQP, AugmentedLagrangian
from unifg.solvers.quadratic_programs.attempt import SECANT_DECAY
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.steps import Steps
from unifg.solvers.quadratic_programs.subproblem import QPAnswer
from unifg.typing import Array

CASES = {case.name: case for case in SMALL}


def maratos(angle: float) -> tuple[fg.Graph, fg.Guess]:
    """Maratos' example, as in Nocedal and Wright (2006), ex. 15.4: 2 (x^2 + y^2 - 1) - x on the unit circle.

    From any point of the circle, with the multiplier of the answer, the full Newton step converges quadratically, and
    raises both the cost and the violation.
    """
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda p: 2.0 * ((p**2).sum(axis=1) - 1.0) - p[:, 0], x, name="cost")
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0, name="circle")
    return graph, fg.Guess({x: np.array([[np.cos(angle), np.sin(angle)]])}, {"circle": np.array([[-1.5]])})


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.5, 0.8])
def test_full_steps_that_merits_reject_are_corrected(angle: float) -> None:
    graph, guess = maratos(angle)
    solution = SQP(hessian="exact").solve(graph, guess, check=True)
    assert [row.step_length for row in solution.history[1:]] == [1.0] * solution.iterations
    assert solution.history[1].details["correction"] == 1
    assert solution.iterations <= 4
    without = SQP(hessian="exact", second_order_correction=False).solve(graph, guess, check=True)
    assert without.history[1].step_length < 0.5
    assert without.iterations >= solution.iterations + 3


@pytest.mark.parametrize(("name", "most"), [("HS18", 25), ("HS29", 25), ("HS31", 25), ("HS40", 15), ("HS12", 15)])
def test_curvature_that_gauss_newton_lacks_is_seen_along_the_step(name: str, most: int) -> None:
    """Without the secant two of these end at the limit of 200, and the others take thrice the steps."""
    graph, guess = CASES[name].build()
    solution = SQP().solve(graph, guess)
    assert solution.converged and solution.iterations <= most, solution.report()


def test_missing_curvature_by_hand() -> None:
    """On the rim of a circle the Lagrangian's curvature is 1 + 2 lambda; Gauss-Newton knows the one."""
    graph, x = drawn_to([1.0, 0.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=1.0, name="circle")
    program = graph.compile()
    before = program.linearize(program.values_from({x: np.array([[0.6, 0.8]])}))
    step = np.array([0.3, -0.2])

    def seen(multiplier: float, step: Array, unit: float, curved: bool = False, before_that: float = 0.0) -> float:
        """Missing curvature, by an attempt that takes the step with this multiplier whatever the merit says."""
        steps, dual = Steps(program), np.array([multiplier])
        steps.prepare(Tolerances(1e-6, 1e-6), True, False)
        steps.start(Scaling(program, np.full(2, unit), np.ones(1)), before, dual)
        steps.now["missing"] = before_that
        steps.pose(before, dual, 0.7, 1e-6, False, curved)
        steps.along(QPAnswer(step, dual, "by hand", 1, 0.0))
        assert steps.taken(lambda bend: None)
        return float(steps.now["missing"])

    for unit in (1.0, 4.0):
        for multiplier, missing in ((2.0, 4.0), (0.5, 1.0), (0.1, 0.0), (-0.4, 0.0)):  # less than half does not count
            assert seen(multiplier, step, unit) / unit**2 == pytest.approx(missing, abs=1e-6)
    assert seen(2.0, 1e-9 * step, 1.0) == 0.0
    assert seen(2.0, step, 1.0, before_that=20.0) == pytest.approx(20.0 * SECANT_DECAY), "which fades"
    assert seen(2.0, step, 1.0, curved=True, before_that=20.0) == 0.0, "the Lagrangian's own Hessian lacks nothing"


def test_subproblems_on_the_graph_begin_from_the_last_multipliers() -> None:
    stated = Unicycle("behind", True, 20).formulation()
    solution = SQP(qp="graph").solve(stated.graph, stated.guess, check=True)
    taken = [int(row.details["qp_iterations"]) for row in solution.history[1:]]
    assert max(taken[-2:]) <= 4 < taken[0], taken


@pytest.mark.parametrize("correction", [True, False])
def test_a_point_that_cannot_be_evaluated_is_not_taken(correction: bool) -> None:
    """The first step leads to where there is no logarithm."""
    graph, x = drawn_to([-5.0])
    graph.constrain(lambda p: np.log(p), x, lower=-3.0, name="log")
    solution = SQP(qp="graph", second_order_correction=correction).solve(graph, {x: np.ones((1, 1))}, check=True)
    assert solution[x][0, 0] == pytest.approx(np.exp(-3.0), rel=1e-4)


def test_positions_in_small_units_beside_headings_are_scaled() -> None:
    """Positions in units of 0.1 mm: the answers of subproblems are polished."""
    unit = np.array([1e-4, 1e-4, 1.0])

    def motion(a: Array, u: Array, b: Array) -> Array:
        a, b = a * unit, b * unit
        heading = a[:, 2] + 0.1 * u[:, 1]
        along = np.stack([u[:, 0] * np.cos(heading), u[:, 0] * np.sin(heading), u[:, 1]], axis=1)
        return np.asarray(b - a - 0.2 * along)

    graph, x, u = graph_of(("x", fg.Rn(3), 9), ("u", fg.Rn(2), 8))
    graph.fix(x[0], np.zeros(3))
    graph.minimize(fg.prior, x[-1], np.array([1.0, 0.5, 0.3]) / unit, sigma=0.1 / unit)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.constrain(motion, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=-0.7, upper=0.7)
    guess = {x: np.linspace(np.zeros(3), [1.0, 0.1, 0.1], 9) / unit, u: np.full((8, 2), 0.3)}
    prepared = SQP(qp="graph").prepare(graph)
    assert prepared.solve(guess).converged and not prepared._workspace.scaling.neutral


@pytest.mark.parametrize("solver", [SQP(qp="graph"), AugmentedLagrangian(tolerance=1e-7)], ids=["sqp", "alm"])
def test_fixed_variables_stay_and_limits_may_change_in_kind(solver: fg.Solver) -> None:
    graph, x = graph_with(fg.SO3, 3)
    start = graph.data("start", [1.0, 0.0, 0.0, 0.0])
    lower, upper = graph.data("lower", np.zeros(3)), graph.data("upper", np.zeros(3))
    graph.fix(x[0], start)
    graph.minimize(fg.prior, x, np.tile([0.8, 0.6, 0.0, 0.0], (3, 1)), sigma=1.0)
    graph.constrain(fg.difference, x[:-1], x[1:], lower=lower, upper=upper, name="turn")
    run = solver.prepare(graph)
    guess = {x: np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))}
    unnormal = np.array([1.0, 4e-10, 0.0, 0.0])  # as it was given, to the last digit
    kinds = [
        (np.zeros(3), np.array([0.2, 0.2, 0.0])),
        (np.zeros(3), np.zeros(3)),
        (np.array([-np.inf, 0.0, 0.0]), np.full(3, 0.2)),
        (np.full(3, -np.inf), np.full(3, np.inf)),
        (np.zeros(3), np.array([0.2, 0.2, 0.0])),
    ]
    for low, high in kinds:
        solution = run.solve(guess, data={start: unnormal, lower: low, upper: high}, check=True)
        turns = fg.SO3.local(solution[x][:-1], solution[x][1:])
        assert (turns > low - 1e-6).all() and (turns < high + 1e-6).all()
        np.testing.assert_array_equal(solution[x][0], unnormal)
