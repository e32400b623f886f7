"""Several starts of one solve: the cheapest answer, and what the others found."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.models import obstacles, unicycle
from unifg.solution import starts as further
from unifg.solution.solver import Solver
from unifg.typing import Array


def waves() -> tuple[fg.Graph, fg.Family]:
    """Many minima, the lowest of which lies at 3.8 in a plane of its own units."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda x: (np.sin(5.0 * x) + 0.1 * (x - 4.0) ** 2).sum(axis=1), x, name="waves")
    graph.bound(x, lower=-6.0, upper=6.0, name="box")
    return graph, x


def test_more_starts_find_the_lowest_of_many_minima() -> None:
    graph, x = waves()
    single, several = (fg.solve(graph, {x: [[-5.0]]}, starts=count) for count in (1, 40))
    assert single.converged
    assert several.converged
    assert several.cost < single.cost - 1.0
    assert not single.others
    assert len(several.others) == 39
    assert several.cost <= min(found.cost for found in several.others if found.status.converged)
    assert all(-6.0 <= found.values["x"].item() <= 6.0 for found in several.others)
    again = fg.solve(graph, {x: [[-5.0]]}, starts=40)
    np.testing.assert_array_equal(again[x], several[x])


def test_starts_pass_an_obstacle_on_both_sides() -> None:
    """The guess goes straight through a disc that lies to one side: from there it is passed on the longer side."""
    count = 20
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    centre = graph.data("centre", [[1.0, 0.12]])
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.fix(x[-1], [2.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=1.0, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0.0, upper=0.0, name="motion")
    graph.constrain(obstacles.disc_clearance, x[1:-1], centre, np.array([0.4]), lower=0.0, name="disc")
    line = np.linspace([0.0, 0.0, 0.0], [2.0, 0.0, 0.0], count + 1)
    line[1:-1, 1] = 0.6  # on the wrong side
    guess = {x: line, u: np.tile([1.0, 0.0], (count, 1))}
    single, several = (fg.solve(graph, guess, starts=starts) for starts in (1, 12))
    assert single.converged
    assert several.converged
    assert single[x][count // 2, 1] > 0.0 > several[x][count // 2, 1]
    assert several.cost < 0.98 * single.cost
    moved = fg.solve(graph, guess, data={centre: [[1.0, -0.12]]}, starts=12)
    assert moved[x][count // 2, 1] > 0.0
    assert moved.cost == pytest.approx(several.cost, rel=1e-5)


def test_the_guess_is_kept_where_no_start_has_an_answer() -> None:
    graph, x = waves()
    graph.constrain(lambda x: x, x, lower=7.0, name="beyond")
    solution = fg.solve(graph, {x: [[-5.0]]}, starts=3)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE
    assert not any(found.status.converged for found in solution.others)


@pytest.mark.parametrize(
    ("starts", "limit", "left"), [(7, np.inf, [np.inf] * 7), (20, 2.0, [2.0, 1.5, 1.0, 0.5])], ids=["all", "in time"]
)
def test_every_start_is_solved_once_in_what_is_left_of_the_time(
    starts: int, limit: float, left: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    graph, x = waves()
    given: list[float] = []
    solve = Solver.solve

    def timed(self: Solver, *arguments: Any, **options: Any) -> fg.Solution:
        given.append(self.time_limit)
        solution = solve(self, *arguments, **options)
        solution.seconds = 0.5
        return solution

    monkeypatch.setattr(Solver, "solve", timed)
    solution = fg.solve(graph, {x: [[-5.0]]}, starts=starts, time_limit=limit)
    assert given == left and len(solution.others) == len(left) - 1 and solution.checked


def test_no_more_starts_are_made_than_there_is_time_for(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x = waves()
    made: list[fg.Manifold] = []
    honest = further._steps

    def counted(manifold: fg.Manifold, points: Array, rng: np.random.Generator) -> Array:
        made.append(manifold)
        return honest(manifold, points, rng)

    monkeypatch.setattr(further, "_steps", counted)
    fg.solve(graph, {x: [[-5.0]]}, starts=1000, callback=lambda row: len(made) > 1)
    assert len(made) == 2


def test_a_callback_ends_all_starts() -> None:
    graph, x = waves()
    solution = fg.solve(graph, {x: [[-5.0]]}, starts=9, callback=lambda row: row.number > 0)
    assert not solution.others and solution.status is fg.Status.INTERRUPTED


def test_starts_where_a_term_is_not_finite_are_left_out() -> None:
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(lambda x: np.log(x), x, name="log")
    with np.errstate(invalid="ignore"):
        solution = fg.solve(graph, {x: [[0.5]]}, starts=9)
    assert solution.converged and 0 < len(solution.others) < 8
