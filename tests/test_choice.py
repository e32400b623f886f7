"""Choice of a backend if none is named: one that fits, a second one where that fails, a report of both."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to
from problems.known import PROBLEMS, Problem, line, short_drive
from unifg.solvers import AugmentedLagrangian, GaussNewton, InteriorPoint, LevenbergMarquardt, choice
from unifg.solvers.choice import choose
from unifg.typing import Array


def circled(upper: float = 2.0) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """The point of the unit circle nearest to (1, 1), in a box that may exclude it."""
    graph, x = drawn_to([1.0, 1.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0, name="circle")
    graph.bound(x, lower=0.0, upper=upper, name="box")
    return graph, {x: np.array([[0.1, 0.2]])}


def test_what_is_stated_decides() -> None:
    graph, x = drawn_to([1.0, 0.0], 4)
    assert isinstance(choose(graph).first, LevenbergMarquardt)
    assert choose(graph).reason == "least squares without constraints"
    where = graph.data("where", 0.5)
    graph.constrain(lambda p: p[:, :1], x, lower=0.5, upper=where, name="column")
    picked = choose(graph)
    assert (type(picked.first), type(picked.second)) == (InteriorPoint, AugmentedLagrangian)
    assert picked.reason == "the equality 'column'"
    assert choose(graph, {where: 1.0}).reason == "the inequality 'column'"  # as this solve will see it
    assert choose(graph).reason == "the equality 'column'"
    graph.bound(x, lower=-1.0, name="box")
    assert choose(graph).reason == "the inequality 'box'"
    graph.minimize_scalar(lambda p: p[:, 1] ** 4, x, name="quartic")
    picked = choose(graph)
    assert (type(picked.first), type(picked.second)) == (InteriorPoint, AugmentedLagrangian)
    assert picked.reason == "the scalar cost 'quartic'"


def test_limits_that_are_none_now_are_no_equality() -> None:
    graph, x = drawn_to([1.0, 0.0])
    graph.bound(x, upper=graph.data("most", np.inf), name="box")
    assert choose(graph).reason == "the constraint 'box', without limits now"


def test_a_time_limit_that_is_no_number_is_refused() -> None:
    with pytest.raises(fg.errors.BackendError, match="time_limit must be a number of seconds, found nan"):
        choose(circled()[0], time_limit=float("nan"))


def test_options_reach_both() -> None:
    picked = choose(circled()[0], tolerance=1e-3, time_limit=5.0, verbose=True)
    for solver in (picked.first, picked.second):
        assert (solver.tolerance, solver.time_limit, solver.verbose) == (1e-3, 5.0, True)


ONE_OF_EACH = ("square of poses", "hs48", "active bounds", "inverse distance")


@pytest.mark.parametrize("problem", [p for p in PROBLEMS if p.name in ONE_OF_EACH], ids=lambda p: p.name)
def test_known_answers(problem: Problem) -> None:
    solution = fg.solve(*problem.build(), check=True)
    assert abs(solution.cost - problem.cost) < 1e-4 * max(1.0, abs(problem.cost))


def test_the_report_and_the_log_say_who_and_why(caplog: pytest.LogCaptureFixture) -> None:
    graph, guess = circled()
    with caplog.at_level(logging.INFO, "unifg"):
        solution = fg.solve(graph, guess)
    assert solution.report().startswith("InteriorPoint (picked for the inequality 'box'): The KKT conditions")
    assert caplog.records[-1].message == "picked InteriorPoint for the inequality 'box'"
    assert InteriorPoint().solve(graph, guess).report().startswith("InteriorPoint: ")


def test_another_one_tries_where_the_first_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, guess = circled()
    limited = choose(graph)
    short = replace(limited, first=InteriorPoint(max_iterations=1))
    monkeypatch.setattr(choice, "choose", lambda *_, **__: short)
    solution = fg.solve(graph, guess, check=True)
    assert solution.solver == "AugmentedLagrangian"
    assert "picked for the inequality 'box', after InteriorPoint ended as iteration limit" in solution.report()
    assert fg.solve(graph, guess, time_limit=1e-9).solver == "InteriorPoint", "there is no time for another one"


def test_what_both_miss_is_told_of_both() -> None:
    graph, guess = circled(0.5)
    solution = fg.solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE
    assert solution.solver == "InteriorPoint"
    assert solution.picked == "picked for the inequality 'box'; AugmentedLagrangian ended as locally infeasible"
    with pytest.raises(fg.NotConverged, match="picked for the inequality 'box'"):
        fg.solve(graph, guess, check=True)


def test_what_is_undetermined_is_not_tried_again() -> None:
    graph, x = line()
    graph.minimize(fg.difference, x[:-1], x[1:])
    solution = fg.solve(graph, {x: np.arange(8.0).reshape(4, 2)})
    assert (solution.status, solution.solver) == (fg.Status.UNDETERMINED, "LevenbergMarquardt")


def test_callbacks_and_data_go_through() -> None:
    graph, x = line(1)
    target = graph.data("target", [0.0, 0.0])
    graph.minimize(fg.prior, x, target)
    rows: list[fg.Iteration] = []
    solution = fg.solve(graph, {x: np.ones((1, 2))}, data={target: [3.0, 4.0]}, callback=rows.append)
    np.testing.assert_allclose(solution[x], [[3.0, 4.0]])
    assert len(rows) > 1


def test_refusals_name_the_measured_order() -> None:
    graph, guess = short_drive()
    with pytest.raises(fg.BackendError, match="use InteriorPoint, AugmentedLagrangian or SQP, or `fg"):
        GaussNewton().solve(graph, guess)
    graph, x = line(1)
    graph.minimize_scalar(lambda p: p[:, 0] ** 4, x, name="quartic")
    with pytest.raises(fg.BackendError, match="not a square; use InteriorPoint, AugmentedLagrangian or SQP"):
        GaussNewton().solve(graph, {x: np.ones((1, 2))})


@dataclass(kw_only=True)
class Timed(InteriorPoint):
    """Takes a given time, and ends as told."""

    takes: float = 0.0
    ends: fg.Status = fg.Status.STALLED

    def solve(self, *arguments: Any, **options: Any) -> fg.Solution:
        solution = InteriorPoint().solve(*arguments, **options)
        solution.seconds, solution.status = self.takes, self.ends
        return solution


@pytest.mark.parametrize(
    ("takes", "limit", "left"),
    [(0.7, 1.0, 0.3), (0.0, 1.0, 1.0), (5.0, np.inf, np.inf), (1.0, 1.0, None), (2.0, 1.0, None)],
)
def test_the_second_backend_has_what_is_left_of_the_time(
    takes: float, limit: float, left: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[float] = []

    class Second(InteriorPoint):
        def solve(self, *arguments: Any, **options: Any) -> fg.Solution:
            given.append(self.time_limit)
            return super().solve(*arguments, **options)

    picked = choice.Choice(Timed(takes=takes, time_limit=limit), Second(time_limit=limit), "a test")
    monkeypatch.setattr(choice, "choose", lambda *_, **__: picked)
    solution = fg.solve(*circled(), time_limit=limit)
    assert given == ([] if left is None else [pytest.approx(left)])
    assert solution.converged is (left is not None)


@dataclass(kw_only=True)
class First(InteriorPoint):
    """Ends as STALLED with a given violation and cost."""

    reached: tuple[float, float]

    def solve(self, *arguments: Any, **options: Any) -> fg.Solution:
        solution = InteriorPoint().solve(*arguments, **options)
        solution.status, solution.solver = fg.Status.STALLED, self.name
        solution.violation, solution.cost = self.reached
        return solution


class Second(First):
    """Another one."""


@pytest.mark.parametrize(
    ("first", "second", "kept"),
    [
        ((1e-2, 5.0), (1e-3, 9.0), "second"),
        ((1e-2, 9.0), (1e-2, 5.0), "second"),
        ((1e-3, 9.0), (1e-2, 5.0), "first"),
        ((0.0, 9.0), (1e-7, 5.0), "second"),
        ((1e-7, 5.0), (0.0, 9.0), "first"),
        ((0.0, 5.0), (0.0, 5.0), "first"),
        ((0.0, 5.0), (0.0, np.nan), "first"),
    ],
)
def test_of_two_that_miss_the_one_that_violates_less_is_kept(
    first: tuple[float, float], second: tuple[float, float], kept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    picked = choice.Choice(First(reached=first), Second(reached=second), "a test")
    monkeypatch.setattr(choice, "choose", lambda *_, **__: picked)
    solution = fg.solve(*circled())
    assert (solution.violation, solution.cost) == (first if kept == "first" else second)
    told = {"first": "a test; Second ended as stalled", "second": "a test, after First ended as stalled"}
    assert solution.picked == f"picked for {told[kept]}"
