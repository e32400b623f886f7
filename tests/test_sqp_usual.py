"""Usual iterations of SQP in one compiled call: the same as from Python, to the last bit, whatever happens between."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import unifg as fg
from problems.control import Quadrotor, Unicycle
from problems.known import short_drive
from test_losses import LOSSES, poses
from unifg.solution.solver import Prepared
from unifg.solvers import SQP, AugmentedLagrangian
from unifg.solvers.augmented_usual import UsualPrimal
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.sqp_usual import UsualSubproblems
from unifg.typing import Array


@contextmanager
def watched() -> Iterator[list[str]]:
    """Record of iterations: "taken", "answered" (by the subproblem, and no more) or "untouched"."""
    went: list[str] = []
    take = UsualSubproblems.take

    def watching(subproblems: UsualSubproblems, *given: Any) -> Any:
        found = take(subproblems, *given)
        left = "untouched" if subproblems._answered is None else "answered"
        went.append(left if found is None else "taken")
        return found

    with patch.object(UsualSubproblems, "take", watching):
        yield went


def compare(run: Prepared, guess: Any, **given: Any) -> tuple[fg.Solution, list[str]]:
    """Solve with and without compiled iterations; the solution, and how its iterations went."""
    with watched() as went:
        mine = run.solve(guess, **given)
    with patch.object(UsualSubproblems, "take", lambda *_: None):
        other = run.solve(guess, **given)
    assert mine.status is other.status and mine.iterations == other.iterations
    for row, theirs in zip(mine.history, other.history, strict=True):
        assert (row.cost, row.step_norm, row.step_length) == (theirs.cost, theirs.step_norm, theirs.step_length)
        assert row.details == theirs.details and row.terms == theirs.terms
    for family, values in mine.values.items():
        np.testing.assert_array_equal(values, other.values[family])
    for name, dual in mine.multipliers.items():
        np.testing.assert_array_equal(dual, other.multipliers[name])
    for part in ("weights", "squares", "hessian", "constraint_jacobian"):
        np.testing.assert_array_equal(getattr(mine._lin, part), getattr(other._lin, part))
    return mine, went


@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
@pytest.mark.parametrize(
    "problem", [Unicycle("straight", False, 20), Unicycle("ahead", False, 30), Quadrotor("figure8", True, 10)]
)
def test_compiled_iterations_are_those_of_python(problem: Unicycle | Quadrotor, hessian: str) -> None:
    stated = problem.formulation()
    solver = SQP(qp="graph", hessian=hessian, tolerance=1e-5)  # type: ignore[arg-type]
    solution, went = compare(solver.prepare(stated.graph), stated.guess)
    assert solution.converged and "taken" in went


def test_steps_are_corrected_and_shortened_alike() -> None:
    stated = Quadrotor("goto", True, 20).formulation()
    solution, went = compare(
        SQP(qp="graph", hessian="gauss-newton", max_iterations=60).prepare(stated.graph), stated.guess
    )
    assert set(went) == {"taken"}
    assert sum("correction" in row.details for row in solution.history) > 0
    assert {row.step_length for row in solution.history[1:]} == {1.0, 0.5}
    without = SQP(qp="graph", max_iterations=20, second_order_correction=False).prepare(stated.graph)
    solution, went = compare(without, stated.guess)
    assert set(went) == {"taken"} and not any("correction" in row.details for row in solution.history)


def log_of_a_number() -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """The first step leads to where there is no logarithm."""
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(1), 1)
    graph.minimize(fg.prior, x, [-5.0])
    graph.constrain(lambda p: np.log(p), x, lower=-3.0, name="log")
    return graph, {x: np.ones((1, 1))}


@pytest.mark.parametrize("correction", [True, False])
def test_a_point_that_cannot_be_evaluated_is_not_taken(correction: bool) -> None:
    graph, guess = log_of_a_number()
    solution, went = compare(SQP(qp="graph", second_order_correction=correction).prepare(graph), guess)
    assert went[0] == "answered" and solution.converged
    assert solution[graph.families["x"]][0, 0] == pytest.approx(np.exp(-3.0), rel=1e-4)


def test_an_answer_at_hand_is_not_found_twice() -> None:
    """Iterations left to Python after the subproblem go on from its answer."""
    solve, solved = GraphRoute.solve, []

    def counting(route: GraphRoute, *given: Any) -> Any:
        solved.append(route)
        return solve(route, *given)

    graph, guess = log_of_a_number()
    run = SQP(qp="graph", max_iterations=1).prepare(graph)
    with watched() as went, patch.object(GraphRoute, "solve", counting):
        run.solve(guess)
    assert went == ["answered"] and not solved


def test_units_far_apart() -> None:
    """Positions in units of 0.1 mm, which the solve does not keep: its answers are polished, from Python."""
    unit = np.array([1e-4, 1e-4, 1.0])

    def motion(a: Array, u: Array, b: Array) -> Array:
        a, b = a * unit, b * unit
        heading = a[:, 2] + 0.1 * u[:, 1]
        along = np.stack([u[:, 0] * np.cos(heading), u[:, 0] * np.sin(heading), u[:, 1]], axis=1)
        gap: Array = b - a - 0.2 * along
        return gap

    graph = fg.Graph()
    x, u = graph.variables("x", fg.Rn(3), 9), graph.variables("u", fg.Rn(2), 8)
    graph.fix(x[0], np.zeros(3))
    graph.minimize(fg.prior, x[-1], np.array([1.0, 0.5, 0.3]) / unit, sigma=0.1 / unit)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.constrain(motion, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=-0.7, upper=0.7)
    guess = {x: np.linspace(np.zeros(3), [1.0, 0.1, 0.1], 9) / unit, u: np.full((8, 2), 0.3)}
    prepared = SQP(qp="graph").prepare(graph)
    solution, went = compare(prepared, guess)
    assert solution.converged and not prepared._workspace.scaling.neutral
    assert "answered" in went and "untouched" not in went


@pytest.mark.parametrize("fallback", [None, "piqp"])
def test_rows_that_contradict_each_other_are_left_to_python(fallback: str | None) -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(2), 1)
    graph.minimize(fg.prior, x, [1.0, 1.0])
    graph.constrain(lambda p: p[:, :1], x, lower=1.0, name="right")
    graph.constrain(lambda p: p[:, :1], x, upper=-1.0, name="left")
    solution, went = compare(SQP(qp="graph", fallback=fallback, max_iterations=10).prepare(graph), {x: [[0.0, 0.0]]})
    assert not solution.converged and "taken" not in went


def test_fixed_variables_stay_and_limits_may_change_in_kind() -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.SO3, 3)
    start = graph.data("start", [1.0, 0.0, 0.0, 0.0])
    lower, upper = graph.data("lower", np.zeros(3)), graph.data("upper", np.zeros(3))
    graph.fix(x[0], start)
    graph.minimize(fg.prior, x, np.tile([0.8, 0.6, 0.0, 0.0], (3, 1)), sigma=1.0)
    graph.constrain(fg.difference, x[:-1], x[1:], lower=lower, upper=upper, name="turn")
    run = SQP(qp="graph").prepare(graph)
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
        solution, went = compare(run, guess, data={start: unnormal, lower: low, upper: high})
        assert solution.converged
        assert ("taken" in went) == bool(np.isfinite([low, high]).any() and (low != high).any())
        np.testing.assert_array_equal(solution[x][0], unnormal)


def test_losses() -> None:
    for loss in LOSSES:
        graph, guess, _ = poses(loss, True)
        graph.bound(graph.families["shared"], lower=-0.3, upper=0.3)
        _, went = compare(SQP(qp="graph").prepare(graph), guess)
        assert "taken" in went, loss


@pytest.mark.parametrize("what", ["loss of one's own", "numpy", "scalar", "osqp", "no inequality", "full steps"])
def test_what_compiled_code_does_not_know_is_not_asked_of_it(what: str) -> None:
    graph, guess = short_drive()
    x = graph.families["x"]
    options: dict[str, Any] = {"qp": "graph"}
    if what == "loss of one's own":
        graph.minimize(fg.prior, x[0], [0.0, 0.0, 0.0], sigma=1.0, robust=fg.Reweighted(np.ones_like), name="anchor")
    elif what == "numpy":
        own = fg.residual(lambda v: np.tanh(v[:, :1]), derivatives="differences")
        graph.minimize(own, x[0], sigma=1.0, name="anchor")
    elif what == "scalar":
        graph.minimize_scalar(lambda v: np.cosh(v[:, 0]), x[-1], name="energy")
    elif what == "osqp":
        options = {"qp": "osqp"}
    elif what == "full steps":
        options["full_steps"] = True
    else:
        graph, guess = fg.Graph(), {}
        y = graph.variables("y", fg.Rn(2), 1)
        graph.minimize(fg.prior, y, [1.0, 1.0])
        graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), y, lower=1.0, upper=1.0)
        guess[y] = np.array([[1.0, 0.2]])
    with watched() as went:
        solution = SQP(**options).solve(graph, guess)
    assert solution.converged, solution.report()
    assert "taken" not in went and "answered" not in went


@pytest.mark.parametrize(
    ("solver", "where"), [(SQP(qp="graph"), UsualSubproblems), (AugmentedLagrangian(), UsualPrimal)], ids=["sqp", "alm"]
)
def test_a_trace_that_is_given_up_between_two_solves_is_left_to_python(solver: fg.Solver, where: Any) -> None:
    factor, take, found = np.array([1.0]), where.take, []

    def watching(*given: Any) -> Any:
        found.append(take(*given))
        return found[-1]

    def own(v: Array) -> Array:
        if factor[0] > 2.0:
            return np.array([[factor[0] * float(row[0]) - 1.0] for row in v])
        found: Array = factor[0] * v[:, :1] - 1.0
        return found

    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(2), 1)
    graph.minimize(own, x, name="own")
    graph.minimize(fg.prior, x, [0.0, 0.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=4.0, name="disc")
    run = solver.prepare(graph)
    with patch.object(where, "take", watching):
        assert run.solve({x: [[1.0, 1.0]]}, check=True)[x][0, 0] == pytest.approx(0.5, abs=1e-6)
        assert any(found)
        found.clear()
        factor[0] = 3.0
        assert run.solve({x: [[1.0, 1.0]]}, check=True)[x][0, 0] == pytest.approx(0.3, abs=1e-6)
    assert found and not any(found)
