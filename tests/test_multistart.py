"""Several starts of one solve: the cheapest feasible answer, when a loop tries more, and paths around discs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.horizon import Context, ControlCost, Dynamics, InitialGuesses, RecedingHorizon, Robot, Term, cheapest
from unifg.horizon.multistart import Jumps
from unifg.models.detours import detours, headed
from unifg.models.obstacles import disc_clearance
from unifg.solvers import InteriorPoint
from unifg.typing import Array

DISC, RADIUS = np.array([[1.5, 0.1]]), np.array([0.6])
STEPS, DT = 20, 0.2
POINT = Robot(fg.Rn(2), fg.Rn(2))


def motion(x: Array, u: Array, y: Array) -> Array:
    """Defect of a point that moves at a velocity."""
    return y - x - DT * u


class Goal:
    """A goal for every node, limits of the velocity, and a disc in the way."""

    def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
        """Add them."""
        goal = graph.data("goal", [3.0, 0.0])
        graph.minimize(fg.prior, x[1:], goal, sigma=0.5, name="goal")
        graph.bound(u, lower=-1.0, upper=1.0, name="limits")
        graph.constrain(clear, x[1:], DISC, RADIUS, lower=0.0, name="disc")

    def data(self, now: Context[Any]) -> dict[str, Array]:
        """Goal of a tick."""
        return {"goal": now.given}


def clear(x: Array, centre: Array, radius: Array) -> Array:
    """(n, M) distance to the discs."""
    distance: Array = np.sqrt(np.sum((x[:, None, :2] - centre) ** 2, axis=-1) + 1e-12)
    return distance - radius


def around(now: Context[Any]) -> Iterator[tuple[Array, Array]]:
    """Starts on both sides of the disc."""
    for path in detours(now.present, now.given, DISC, RADIUS, STEPS, DT):
        yield path, np.zeros((STEPS, 2))


def loop_of(**options: Any) -> tuple[RecedingHorizon, list[int]]:
    """A loop, and a list with an entry for each of its cold solves."""
    terms: list[Term] = [Dynamics(lambda x, u, y, h: motion(x, u, y), DT), Goal(), ControlCost([2.0, 2.0])]
    usual = {"starts": InitialGuesses(others=around)}
    loop = RecedingHorizon(POINT, STEPS, terms, solver=InteriorPoint(), **usual | options)
    solves, solve = [], loop.cold.solve

    def counted(*arguments: Any, **named: Any) -> fg.Solution:
        solves.append(1)
        return solve(*arguments, **named)

    loop.cold.solve = counted  # type: ignore[method-assign]
    return loop, solves


BELOW, ABOVE = np.array([3.0, -0.4]), np.array([3.0, 1.2])


def drive(loop: RecedingHorizon, goals: list[Array]) -> list[tuple[float, bool]]:
    """Cost of every plan, and True where it passes above the disc."""
    state, found = np.zeros(2), []
    for goal in goals:
        plan = loop.plan(state, goal)
        assert plan.source == "solved" and loop.solution is not None
        beside = plan.states[np.argmin(np.abs(plan.states[:, 0] - DISC[0, 0]))]
        found.append((loop.solution.cost, bool(beside[1] > DISC[0, 1])))
        state = state + DT * plan.control
    return found


def test_a_moved_goal_is_reached_by_the_cheaper_side() -> None:
    goals = [BELOW] * 3 + [ABOVE] * 3
    loop, solves = loop_of()
    several = drive(loop, goals)
    assert [above for _, above in several] == [False] * 3 + [True] * 3
    assert loop.more_starts == 2 + 3 and len(solves) == 6, "the first tick and that of the move: cold and both sides"
    alone, solves = loop_of(starts=InitialGuesses(lambda now: next(around(now))))
    assert drive(alone, goals)[3][0] > 1.05 * several[3][0] and len(solves) == 1, "a warm start stays on its side"
    assert not alone.more_starts


def test_with_no_others_the_cold_start_is_tried_where_data_jump() -> None:
    loop, solves = loop_of(starts=InitialGuesses(lambda now: next(around(now)), others=lambda now: ()))
    costs = drive(loop, [BELOW] * 3 + [ABOVE] * 2)
    assert loop.more_starts == 1 and len(solves) == 2 and costs[3][1]


def test_a_goal_that_moves_on_steadily_is_no_jump() -> None:
    loop, solves = loop_of()
    drive(loop, [BELOW + 0.05 * k * np.array([1.0, 0.0]) for k in range(6)])
    assert loop.more_starts == 2 and len(solves) == 3


def test_what_the_deadline_leaves_no_time_for_is_tried_in_the_next_ticks() -> None:
    clock, seconds = [0.0], 0.5
    loop, solves = loop_of(deadline=1.0, clock=lambda: clock[0])
    for run in (loop.warm, loop.cold):

        def slow(*arguments: Any, solve: Callable[..., fg.Solution] = run.solve, **named: Any) -> fg.Solution:
            limits.append(loop.cold.solver.time_limit)
            found = solve(*arguments, **named)
            clock[0] += seconds
            return found

        run.solve = slow  # type: ignore[method-assign]
    tried = []
    limits: list[float] = []
    for goal in [BELOW] * 4 + [ABOVE] * 5:
        before = len(solves)
        assert loop.plan(np.zeros(2), goal).source == "solved"
        tried.append(len(solves) - before)
    # The first tick: cold and one side, which takes it to the deadline; then one start beside the warm one.
    assert tried == [2, 1, 0, 0, 1, 1, 1, 0, 0] and loop.more_starts == 5
    assert 0.4 == pytest.approx(min(limits)), "the last tenth of the deadline stays free"
    seconds = 0.95
    loop.plan(np.zeros(2), BELOW)
    assert len(solves) == sum(tried), "no start without time"
    loop.abandon()
    loop.plan(np.zeros(2), BELOW)
    assert len(solves) == sum(tried) + 1


def graph_of_two_valleys() -> tuple[fg.Graph, fg.Family]:
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(lambda x: (x * x - 1.0) * 2.0, x, sigma=1.0)
    graph.minimize(fg.prior, x, [-1.0], sigma=2.0)
    graph.constrain(lambda x: x, x, lower=-3.0, name="least")
    return graph, x


def test_cheapest_is_the_feasible_answer_of_least_cost() -> None:
    graph, x = graph_of_two_valleys()
    run = InteriorPoint().prepare(graph)
    right, left = {x: np.array([[1.2]])}, {x: np.array([[-1.2]])}
    assert cheapest(run, [right])[x][0, 0] == pytest.approx(0.9, abs=0.1)
    for starts in ([right, left], [left, right]):
        assert cheapest(run, starts)[x][0, 0] == pytest.approx(-1.0, abs=1e-4)
    incumbent = run.solve(left)
    assert cheapest(run, [right], incumbent=incumbent) is incumbent
    with pytest.raises(fg.GraphError, match="no start"):
        cheapest(run, [])
    graph.constrain(lambda x: x, x, lower=0.5, upper=3.0, name="right")
    bounded = InteriorPoint(max_iterations=0).prepare(graph)
    found = cheapest(bounded, [left, right, {x: np.array([[-2.0]])}])
    assert found[x][0, 0] == 1.2, "an answer that keeps its constraints comes before a cheaper one that does not"
    assert cheapest(bounded, [{x: np.array([[-2.0]])}, left])[x][0, 0] == -1.2, "without any, the least violation"


def test_cheapest_stops_when_time_is_up_and_leaves_the_solver_as_it_was() -> None:
    graph, x = graph_of_two_valleys()
    run = InteriorPoint(time_limit=7.0).prepare(graph)
    now, taken = [0.0], []

    def starts() -> Iterator[dict[fg.Family, Array]]:
        for value in (1.2, -1.2, 1.1):
            taken.append(value)
            now[0] += 1.0
            yield {x: np.array([[value]])}

    found = cheapest(run, starts(), seconds=0.5, clock=lambda: now[0])
    assert found[x][0, 0] > 0.0 and len(taken) == 1 and run.solver.time_limit == 7.0


def test_jumps_are_unusual_changes_with_consequences() -> None:
    graph, x = graph_of_two_valleys()
    goal, noise = graph.data("goal", np.zeros(2)), graph.data("noise", np.zeros(3))
    run, rng = InteriorPoint().prepare(graph), np.random.default_rng(0)
    answer = run.solve({x: np.array([[1.2]])})
    assert answer.history[0].cost > 1.06 * answer.cost, "the guess of this answer costs more than itself"

    def said(place: float) -> dict[fg.Data, Array]:
        return {goal: np.array([place, 0.0]), noise: rng.uniform(-1.0, 1.0, 3)}

    def ticks(places: list[float]) -> list[bool]:
        jumps.clear()
        return [jumps(said(place), answer, answer) for place in places]

    jumps = Jumps()
    assert ticks([0.0] * 3 + [1.0] * 4 + [2.0]) == [False] * 3 + [True] + [False] * 3 + [True]
    assert not any(ticks([0.1 * k for k in range(8)])[2:]), "a goal at constant speed does not jump"
    assert ticks([0.1 * k for k in range(6)] + [2.0])[-1]
    assert not any(ticks([5.0] * 6)), "nor does noise"
    quiet = run.solve(answer)
    assert not quiet.iterations
    jumps.clear()
    assert not any(jumps(said(place), quiet, quiet) for place in (0.0, 0.0, 0.0, 1.0)), "no cost, no consequence"
    jumps.clear()
    assert [jumps(said(place), answer, None) for place in (0.0, 0.0, 1.0)] == [False] * 3
    jumps.clear()
    assert not jumps({}, answer, answer) and not jumps({}, answer, answer)
    limits = [np.array([np.inf, place]) for place in (1.0, 1.0, 2.0)]
    assert [jumps({goal: limit}, answer, answer) for limit in limits] == [False, False, True]
    seen = graph.data("seen", np.zeros(2, dtype=bool), each=True)
    flags = [np.array([place, True]) for place in (False, False, True)]
    nothing = graph.data("nothing", np.zeros((0, 2)), each=True)
    found = [jumps({nothing: np.zeros((0, 2)), seen: flag, goal: [0, 0]}, answer, answer) for flag in flags]
    assert found == [False, False, True]


def winding(path: Array, point: Array) -> float:
    """Turns of a path about a point."""
    offset = path - point
    return float(np.diff(np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))[[0, -1]])[0] / (2.0 * np.pi))


def test_detours_pass_what_blocks_the_way_on_either_side() -> None:
    centres = np.array([[2.0, 0.1], [4.0, -0.2], [3.0, 5.0], [-1.0, 0.0], [7.0, 0.0]])
    paths = detours([0.0, 0.0], [6.0, 0.0], centres, 0.5, 200, 0.1, most=8)
    assert len(paths) == 4 and all(path.shape == (201, 2) for path in paths)
    sides = {tuple(round(winding(p, c) - winding(paths[0], c)) for c in centres) for p in paths}
    assert len(sides) == 4 and {side[2:] for side in sides} == {(0, 0, 0)}, "only discs in the way have two sides"
    lengths = [np.hypot(*np.diff(path, axis=0).T).sum() for path in paths]
    assert lengths == sorted(lengths) and lengths[0] < lengths[-1]
    assert [len(detours([0.0, 0.0], [6.0, 0.0], centres, 0.5, 9, 0.1, most=n)) for n in (1, 2)] == [1, 2]
    for path in paths:
        np.testing.assert_array_equal(path[[0, -1]], [[0.0, 0.0], [6.0, 0.0]])
        assert np.hypot(*np.diff(path, axis=0).T).max() <= 0.1 + 1e-12
        near = np.hypot(*(path[:, None] - centres[:2]).T).min(axis=1)
        np.testing.assert_allclose(near, 0.5, atol=0.1)
    (straight,) = detours([0.0, 0.0], [0.0, 2.0], centres, 0.5, 10, 0.5)
    np.testing.assert_allclose(straight[:, 1], np.minimum(0.5 * np.arange(11), 2.0))
    assert np.array_equal(detours([1.0, 1.0], [1.0, 1.0], centres, 0.5, 3, 0.1), [np.ones((4, 2))])
    with pytest.raises(fg.ModelError, match=r"radii .M,., not negative, for centres"):
        detours([0.0, 0.0], [6.0, 0.0], centres, [0.5, 0.5], 9, 0.1)


def test_detours_about_many_discs_choose_the_sides_of_the_widest() -> None:
    centres = np.column_stack([np.arange(1.0, 6.0), np.zeros(5)])
    paths = detours([0.0, 0.0], [6.0, 0.0], centres, [0.1, 0.3, 0.2, 0.4, 0.15], 200, 0.1, most=99)
    turns = np.array([[winding(p, c) for c in centres[[1, 2, 3]]] for p in paths])
    assert len(paths) == 8 and len(np.unique(np.sign(turns), axis=0)) == 8


def test_headings_follow_the_path() -> None:
    path = detours([0.0, 0.0], [0.0, 2.0], np.zeros((0, 2)), 0.0, 4, 1.0)[0]
    forwards, backwards = headed(path, 0.3), headed(path, 0.3, backwards=True)
    np.testing.assert_array_equal(forwards[:, :2], path)
    np.testing.assert_allclose(forwards[:, 2], [np.pi / 2] * 3 + [0.3] * 2, atol=1e-12)
    np.testing.assert_allclose(backwards[:3, 2], 1.5 * np.pi)


def test_clearance_of_the_shipped_model_agrees() -> None:
    pose = np.array([[0.3, 0.2, 0.1]])
    np.testing.assert_allclose(clear(pose, DISC, RADIUS), disc_clearance(pose, DISC, RADIUS), atol=1e-9)
