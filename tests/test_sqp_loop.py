"""SQP's compiled loop: the steps, rows and decisions of a watched solve, and what Python is asked for in between."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from calls import calls_of
from problems.control import Quadrotor, Unicycle
from problems.graphs import drawn_to, graph_of, graph_with
from problems.hock_schittkowski import SMALL
from unifg.solution.solve_state import SolveState
from unifg.solvers import SQP
from unifg.solvers.globalize import slow_convergence
from unifg.solvers.globalize.feasibility_restoration import FALLING, PATIENCE, RestorationTrigger
from unifg.solvers.quadratic_programs import steps as steps_of_sqp
from unifg.solvers.quadratic_programs.attempt import (
    CORRECT,
    LOGGED,
    REFUSED,
    SMALLEST_DAMPING,
    SOLVE,
    STARTED,
    STOPPED,
    TAKEN,
)
from unifg.solvers.quadratic_programs.loop import kkt_size, loop, rests, useful_accuracy
from unifg.solvers.quadratic_programs.routes import Subproblems
from unifg.solvers.quadratic_programs.steps import Steps
from unifg.solvers.sqp import _budget

CASES = {case.name: case for case in SMALL}
Stated = tuple[fg.Graph, Any]


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Answers of all runs of the compiled loop that went on beyond a step."""
    found: list[int] = []
    go = Steps._go

    def noted(self: Steps, stage: int, alone: bool = False) -> None:
        go(self, stage, alone)
        if alone:
            found.append(self.now["answer"])

    monkeypatch.setattr(Steps, "_go", noted)
    return found


def drive(*problem: Any) -> Callable[[], Stated]:
    """A reference problem."""

    def build() -> Stated:
        stated = (Quadrotor if problem[0] in ("figure8", "goto") else Unicycle)(*problem).formulation()
        return stated.graph, stated.guess

    return build


def beyond() -> Stated:
    """A start beyond bounds, of a component too, and a fixed variable within none."""
    graph, x, u = graph_of(("x", fg.SE2, 3), ("u", fg.Rn(2), 2))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, x[1:], np.array([2.0, 1.0, 0.5]))
    graph.minimize(fg.prior, u, np.array([1.0, 1.0]))
    graph.constrain(lambda a, b, v: b[:, :2] - a[:, :2] - v, x[:-1], x[1:], u, lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=[-0.5, -np.inf], upper=[0.5, 0.7])
    return graph, {x: np.zeros((3, 3)), u: np.array([[3.0, -3.0], [-3.0, 3.0]])}


def apart() -> Stated:
    """Two circles that do not meet."""
    graph, x = drawn_to([1.0, 0.3])
    for k, place in enumerate((0.0, 3.0)):
        graph.constrain(lambda p, c: ((p - c) ** 2).sum(axis=1, keepdims=True), x, [place, 0.0], upper=1.0, name=f"{k}")
    return graph, {x: np.array([[0.5, 4.0]])}


def missed() -> Stated:
    """A square that is to be negative by a little: every linearisation can be met."""
    graph, x = drawn_to([0.3])
    graph.constrain(lambda p: p**2, x, upper=-1e-3, name="square")
    return graph, {x: np.ones((1, 1))}


def kink() -> Stated:
    """The cost has its kink next to the start: no length of the step lowers it."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda p: np.abs(p[:, 0]), x)
    graph.bound(x, upper=3.0)
    return graph, {x: np.full((1, 1), 1e-40)}


def endless() -> Stated:
    """A cost without a lower bound."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda p: -(p[:, 0] ** 3), x)
    graph.bound(x, lower=1.0)
    return graph, {x: np.full((1, 1), 2.0)}


def units() -> Stated:
    """A length in units of a micrometre beside one in kilometres."""
    graph, x = drawn_to([1e6, 2e-3], sigma=[1e5, 1e-4])
    graph.constrain(lambda p: p[:, :1] * 1e-6 + p[:, 1:] * 1e3, x, upper=2.0, name="sum")
    return graph, {x: np.zeros((1, 2))}


def small(name: str) -> Callable[[], Stated]:
    """A problem of Hock and Schittkowski."""
    return lambda: CASES[name].build()


RUNS: dict[str, tuple[Callable[[], Stated], dict[str, Any], set[int]]] = {
    "drive": (drive("behind", True, 20), {}, {TAKEN}),
    "drive, to a limit": (drive("curve", True, 20), {"max_iterations": 7}, {TAKEN}),
    "drive, one step": (drive("straight", False, 20), {"max_iterations": 1}, {TAKEN}),
    "drive, no step": (drive("straight", False, 20), {"max_iterations": 0}, {STARTED}),
    "drive, in full": (drive("ahead", True, 20), {"full_steps": True, "max_iterations": 12}, {TAKEN}),
    "drive, rest": (drive("straight", False, 20), {"step_tolerance": 1e-2}, {STOPPED}),
    "drive, OSQP": (drive("straight", False, 20), {"qp": "osqp"}, {TAKEN}),
    "flight": (drive("figure8", True, 20), {}, {TAKEN}),
    "beyond": (beyond, {}, {TAKEN}),
    "beyond, in full": (beyond, {"full_steps": True, "max_iterations": 3}, {TAKEN}),
    "apart": (apart, {}, set()),
    "missed": (missed, {}, {CORRECT}),
    "missed by Gauss-Newton": (missed, {"hessian": "gauss-newton"}, {CORRECT}),
    "endless": (endless, {}, {TAKEN}),
    "kink": (kink, {"second_order_correction": False}, {REFUSED}),
    "units": (units, {}, {STARTED}),
    "units left": (units, {"scaling": False}, {TAKEN}),
    "equalities": (small("HS6"), {}, {TAKEN}),
    "no answer": (small("HS35"), {}, {SOLVE}),
    "no answer, then": (small("HS23"), {}, {SOLVE, TAKEN}),
    "correction": (small("HS10"), {}, {CORRECT, TAKEN}),
    "curvature": (small("HS38"), {}, {TAKEN}),
    "slow": (small("HS38"), {"hessian": "gauss-newton"}, {TAKEN}),
    "degenerate": (small("HS13"), {}, {SOLVE, TAKEN}),
}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.product(4)
def test_a_solve_takes_the_steps_of_a_watched_one(
    name: str, answers: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    build, options, asked = RUNS[name]
    graph, guess = build()
    prepared = SQP(**{"qp": "graph", **options}).prepare(graph)
    answers.clear()
    violations = calls_of(monkeypatch, RestorationTrigger, "calls")
    runs = calls_of(monkeypatch, SolveState, "finish")

    def learned() -> tuple[Any, ...]:
        """Violations that the trigger has seen since, and what is known of the routes."""
        routes, found = prepared._workspace, tuple(violation for _, violation, _ in violations)
        violations.clear()
        return found, routes._first_answered, routes._misses, routes._resting, routes.elastic_asked

    for _ in range(2):  # nothing is left of the first
        solution = prepared.solve(guess)
        assert asked <= set(answers)
        answers.clear()
        known = learned()
        watched = prepared.solve(guess, callback=lambda row: None)
        assert not answers and learned() == known
        assert solution.status is watched.status and solution.iterations == watched.iterations
        assert solution.restoration_steps == watched.restoration_steps
        np.testing.assert_array_equal(solution._lin.stored, watched._lin.stored)
        for term, found in watched.multipliers.items():
            np.testing.assert_array_equal(solution.multipliers[term], found)
        assert len(solution.history) == len(watched.history)
        mine, theirs = (run for run, _ in runs[-2:])
        assert mine.slopes is not None and theirs.slopes is not None
        np.testing.assert_array_equal(mine.slopes.jacobian, theirs.slopes.jacobian)
        np.testing.assert_array_equal(mine.slopes.gradient, theirs.slopes.gradient)
        if not solution.converged:
            assert mine.has_been_feasible == theirs.has_been_feasible
            np.testing.assert_array_equal(mine.least_violated.flat, theirs.least_violated.flat)
        for row, other in zip(solution.history, watched.history, strict=True):
            names = vars(other).keys() - {"seconds", "deferred"}
            assert {name: getattr(row, name) for name in names} == {name: getattr(other, name) for name in names}
        seconds = [row.seconds for row in solution.history]
        assert sorted(seconds) == seconds and 0.0 < seconds[0] and seconds[-1] < solution.seconds


def test_the_cases_end_as_they_are_meant_to() -> None:
    """The compiled loop hands over to the exact Hessian, to restoration and to failures."""

    def solved(name: str) -> fg.Solution:
        build, options, _ = RUNS[name]
        graph, guess = build()
        return SQP(**{"qp": "graph", **options}).solve(graph, guess)

    kinds = [row.details.get("hessian") for row in solved("curvature").history[1:]]
    assert kinds[: slow_convergence.PATIENCE] == [None] * slow_convergence.PATIENCE and "exact" in kinds
    for name in ("apart", "missed", "missed by Gauss-Newton"):
        assert solved(name).status is fg.Status.LOCALLY_INFEASIBLE
    assert any("correction" in row.details for row in solved("correction").history)
    assert solved("drive, rest").status is fg.Status.STOP_RULE
    assert solved("endless").status is fg.Status.UNBOUNDED
    assert solved("kink").iterations == 0


def test_failures_count_in_a_row_and_damp_the_next_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two steps are refused, one is taken between them; the start is feasible, so there is nothing to restore."""
    graph, guess = CASES["HS12"].build()
    prepared = SQP(qp="graph").prepare(graph)
    usual, go, runs = prepared.solve(guess), Steps._go, iter(range(100))

    def refused(self: Steps, stage: int, alone: bool = False) -> None:
        if alone and next(runs) in (1, 3):
            self.now["answer"] = REFUSED
        else:
            go(self, stage, alone)

    monkeypatch.setattr(Steps, "_go", refused)
    monkeypatch.setattr(Subproblems, "distrust", lambda self: False)
    monkeypatch.setattr("unifg.solvers.sqp.FAILURES", 2)
    monkeypatch.setattr("unifg.solvers.sqp.LOGGED", 3)  # Python has a look after every step
    solution = prepared.solve(guess)
    assert solution.converged and solution.cost == pytest.approx(usual.cost, rel=1e-6)
    first, second, third = (float(row.details["damping"]) for row in solution.history[1:4])
    assert second >= max(100.0 * SMALLEST_DAMPING, 1e-4) > first and third >= 50.0 * second


def test_one_call_makes_a_solve(answers: list[int]) -> None:
    graph, guess = drive("straight", False, 20)()
    prepared = SQP(qp="graph").prepare(graph)
    answers.clear()
    solution = prepared.solve(guess)
    assert solution.converged and solution.iterations > 5 and answers == [TAKEN]
    again = pickle.loads(pickle.dumps(solution))
    assert [row.cost for row in again.history] == [row.cost for row in solution.history]


@pytest.mark.parametrize(
    "options", [{"time_limit": 60.0}, {"verbose": True}, {"keep_values": True}, {"keep_residuals": True}]
)
def test_who_looks_at_iterates_or_the_clock_gets_to_see_each(options: dict[str, Any], answers: list[int]) -> None:
    graph, guess = drive("straight", False, 20)()
    assert SQP(qp="graph", **options).solve(graph, guess).converged and not answers


def test_the_exact_hessian_is_only_begun_in_compiled_code(answers: list[int]) -> None:
    graph, guess = drive("straight", False, 20)()
    assert SQP(qp="graph", hessian="exact").solve(graph, guess).converged and answers == [TAKEN]


def test_a_violated_row_of_fixed_variables_is_found_before_the_first_step() -> None:
    graph, x = graph_with(fg.Rn(1), 2)
    graph.fix(x[0], [2.0])
    graph.minimize(fg.prior, x[1], [0.0])
    graph.bound(x, upper=[1.0])
    solution = SQP(qp="graph").solve(graph, {x: np.full((2, 1), 3.0)})
    assert solution.status is fg.Status.INFEASIBLE and solution.iterations == 0


def test_an_interrupt_during_compiled_code_returns_what_was_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, guess = drive("behind", False, 50)()
    prepared = SQP(qp="graph", max_iterations=30).prepare(graph)
    whole, run = prepared.solve(guess), loop

    def interrupted(address: int) -> None:
        run(address)
        raise KeyboardInterrupt

    monkeypatch.setattr(steps_of_sqp, "loop", interrupted)
    monkeypatch.setattr("unifg.solvers.sqp.LOGGED", 7)  # steps until Python has a look: five
    solution = prepared.solve(guess)
    assert solution.status is fg.Status.INTERRUPTED and solution.iterations == 5 < whole.iterations
    assert [row.cost for row in solution.history] == [row.cost for row in whole.history[:6]]


def test_the_budget_ends_before_a_rule_may_call() -> None:
    watch = RestorationTrigger()
    assert _budget(watch, 0) == min(PATIENCE, LOGGED - 2)
    assert _budget(watch, 1) == slow_convergence.PATIENCE == 20
    assert [_budget(watch, rows) for rows in (19, 20, 21, 40)] == [2, 1, 1, 1]
    watch.calls(1.0, 1e-6)
    for waited in range(1, PATIENCE):
        assert not watch.calls(1.0, 1e-6)
        assert watch.left == PATIENCE - waited and _budget(watch, 0) <= watch.left
    assert watch.calls(1.0, 1e-6) and watch.left == 2 * PATIENCE
    assert _budget(watch, 0) == LOGGED - 2, "the start takes two places of the log"
    watch.calls(0.5 * FALLING, 1e-6)
    assert watch.left == 2 * PATIENCE


def test_small_rules_by_hand() -> None:
    assert kkt_size(1e-3, 1e-4, 1e-5, 4.0) == pytest.approx(4e-3)
    assert kkt_size(1e-3, 2.0, 1e-5, 1.0) == 2.0
    assert kkt_size(0.0, 0.0, 1e-3, 1e-4) == pytest.approx(1e-7), "complementarity has the unit of small costs"
    assert useful_accuracy(False, 1e-2, 1e-6, 1.0) == pytest.approx(1e-5)
    assert useful_accuracy(True, 1e-4, 1e-6, 0.01) == pytest.approx(1e-8)
    assert useful_accuracy(False, 1e-9, 1e-6, 1.0) == pytest.approx(1e-7)
    assert useful_accuracy(False, 1e9, 1e-6, 1.0) == 1e-4
    assert rests(1e-4, 1e-5, 1e-3, 1e-4)
    assert not rests(1e-4, 1e-3, 1e-3, 1e-4) and not rests(1e-2, 1e-5, 1e-3, 1e-4) and not rests(0.0, 0.0, 0.0, 1e-4)


def test_bounds_are_kept_where_they_are_of_components() -> None:
    graph, x = drawn_to([0.0, 0.0, 0.0], 4)
    pose = graph.variables("pose", fg.Product(place=fg.Rn(2), turn=fg.SO2), 2)
    graph.minimize(fg.prior, pose, pose.manifold.identity())
    graph.bound(x[2:], lower=[-1.0, -np.inf, 0.5], upper=[1.0, 0.0, np.inf])
    graph.bound(pose.place, lower=-0.1, upper=[0.2, 0.3])
    graph.fix(x[3], [0.0, 5.0, 2.0])
    program = graph.compile()
    guess = {x: np.full((4, 3), 2.0), pose: np.tile(pose.manifold.identity(), (2, 1))}
    guess[pose][:, :2] = [[-1.0, 1.0], [0.15, -7.0]]
    values = program.within_bounds(program.values_from(guess))
    np.testing.assert_array_equal(values[x], [[2.0] * 3, [2.0] * 3, [1.0, 0.0, 2.0], [0.0, 5.0, 2.0]])
    np.testing.assert_array_equal(values[pose][:, :2], [[-0.1, 0.3], [0.15, -0.1]])
    assert len(program.bounded) == program.bound_rows.sum()
