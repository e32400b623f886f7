"""Solves in portions over ticks, and decisions that have no time: what is applied meanwhile, and what follows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg import horizon
from unifg.horizon import Context, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Term, Window
from unifg.models import quadrotor
from unifg.scenarios.planning.flat_path import Line
from unifg.scenarios.quadrotor.cbf_mpc import CbfMpc, Decision, KeeperSettings, Obstacles
from unifg.scenarios.quadrotor.flatness import flat_flight
from unifg.scenarios.simulation.body_rate import Airframe
from unifg.solvers import InteriorPoint
from unifg.typing import Array

DT = 0.01
LINE = Line((-4.0, 0.0, 1.0), (4.0, 0.0, 1.0), 2.0, 1.5)


def chain() -> tuple[fg.Graph, fg.Family, fg.Data]:
    """Points on a line that keep off a disc: an answer that takes some iterations."""
    graph, x = graph_with(fg.Rn(2), 8)
    goal = graph.data("goal", np.array([3.0, 0.1]))
    graph.minimize(fg.prior, x[-1], goal, sigma=0.1)
    graph.minimize(lambda a, b: b - a, x[:-1], x[1:], sigma=1.0, name="steps")
    graph.fix(x[0], [-3.0, 0.0])
    graph.constrain(lambda p: np.hypot(p[:, :1], p[:, 1:]), x[1:], lower=1.0, name="off")
    return graph, x, goal


def guess(x: fg.Family, bent: float) -> dict[Any, Array]:
    return {x: np.column_stack([np.linspace(-3.0, 3.0, 8), np.full(8, bent)])}


@pytest.mark.parametrize("portion", [1, 3])
def test_portions_make_the_steps_of_one_solve(portion: int) -> None:
    whole, parts = InteriorPoint(), InteriorPoint()
    (graph, x, goal), (other, y, aim) = chain(), chain()
    one, many = whole.prepare(graph), parts.prepare(other)
    one.solve(guess(x, 0.3)), many.solve(guess(y, 0.3))  # the first is always whole
    moved = np.array([2.5, -0.4])
    expected = one.solve(guess(x, -0.2), data={goal: moved})
    many.portioned(portion)
    found, calls = many.solve(guess(y, -0.2), data={aim: moved}), 1
    assert many.unfinished and found.status is fg.Status.ITERATION_LIMIT and found.iterations == portion
    while many.unfinished:
        found, calls = many.proceed(), calls + 1
        assert found.iterations <= calls * portion
    assert found.converged and found.iterations == expected.iterations > 3 and calls == -(-found.iterations // portion)
    np.testing.assert_array_equal(found[y], expected[x])
    np.testing.assert_array_equal(found.dual("off"), expected.dual("off"))
    many.solve(guess(y, -0.2), data={aim: moved})
    assert many.unfinished
    again = many.solve(guess(y, 0.3))  # with its own numbers: what was begun is dropped
    assert again.iterations == portion and not np.array_equal(again[y], found[y])


def hard() -> tuple[fg.Graph, fg.Family, fg.Data]:
    """Points in steps of limited length around a disc that may be too large for them."""
    graph, x = graph_with(fg.Rn(2), 6)
    goal, radius = graph.data("goal", [3.0, 0.1]), graph.data("radius", 1.0)
    graph.minimize(fg.prior, x[-1], goal, sigma=0.1, robust=fg.Huber(1.0))
    graph.minimize(lambda a, b: b - a, x[:-1], x[1:], sigma=1.0, name="steps")
    graph.fix(x[0], [-3.0, 0.0])
    graph.constrain(lambda p, r: np.hypot(p[:, :1], p[:, 1:]) - r, x[1:], radius, lower=0.0, name="off")
    graph.constrain(lambda a, b: ((b - a) ** 2).sum(axis=1, keepdims=True), x[:-1], x[1:], upper=2.5, name="length")
    return graph, x, goal


@pytest.mark.parametrize("options", [{}, {"step_tolerance": 1e-2}, {"max_iterations": 12}], ids=str)
def test_a_portion_that_leaves_the_constraints_is_gone_on_with_from_where_it_ended(options: dict[str, Any]) -> None:
    """Iterates that kept them are looked for at the end alone: that takes the memory which the solve goes on with."""
    (graph, x, goal), (other, y, aim) = hard(), hard()
    one, many = InteriorPoint(**options).prepare(graph), InteriorPoint(**options).prepare(other)
    one.solve(around(x, 0.3)), many.solve(around(y, 0.3))
    rng = np.random.default_rng(0)
    for _ in range(20):
        to, bent = 3.0 * rng.normal(size=2), rng.normal()
        many.portioned(int(rng.integers(1, 4)))
        expected, found = one.solve(around(x, bent), data={goal: to}), many.solve(around(y, bent), data={aim: to})
        while many.unfinished:
            found = many.proceed()
        assert (found.status, found.iterations) == (expected.status, expected.iterations)
        np.testing.assert_array_equal(found[y], expected[x])


def around(x: fg.Family, bent: float) -> dict[Any, Array]:
    return {x: np.column_stack([np.linspace(-3.0, 3.0, 6), np.full(6, bent)])}


def test_a_solve_is_gone_on_with_by_its_own_data() -> None:
    """Data are shared by all solves of a graph, and another one has come between."""
    graph, x, goal = chain()
    run, moved = InteriorPoint().prepare(graph), np.array([2.5, -0.4])
    run.solve(guess(x, 0.3))
    expected = run.solve(guess(x, -0.2), data={goal: moved})
    run.portioned(2)
    run.solve(guess(x, -0.2), data={goal: moved})
    fg.solve(graph, guess(x, 0.3))
    while run.unfinished:
        found = run.proceed()
    np.testing.assert_array_equal(found[x], expected[x])
    assert found.cost == expected.cost and run.verify(found) == {}


def test_many_instances_are_solved_whole() -> None:
    graph, x, goal = chain()
    run, each = InteriorPoint().prepare(graph), np.array([[2.5, -0.4], [3.0, 0.1]])
    run.solve(guess(x, 0.3))
    run.portioned(1)
    assert run.solve_many(guess(x, -0.2), data={goal: each}).converged and not run.unfinished
    assert run.solve(guess(x, -0.2), data={goal: each[0]}).iterations == 1


def test_without_an_unfinished_solve_there_is_nothing_to_go_on_with() -> None:
    graph, x, _ = chain()
    run = InteriorPoint().prepare(graph)
    for solved in (False, True):
        if solved:
            run.solve(guess(x, 0.3))
        with pytest.raises(fg.BackendError, match="InteriorPoint has no unfinished solve to proceed with"):
            run.proceed()
    for count in (0, -1):
        with pytest.raises(fg.BackendError, match=f"at least 1, or None for whole solves, found {count}"):
            run.portioned(count)
    with pytest.raises(fg.BackendError, match=r"count must be a whole number or None, found 1\.5"):
        run.portioned(1.5)  # type: ignore[arg-type]


def test_a_solve_whose_portion_shows_a_wrong_trace_is_made_anew_and_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x, _ = chain()
    run = InteriorPoint().prepare(graph)
    run.solve(guess(x, 0.3))
    run.portioned(1)
    told = iter([{"steps": "it differs"}, {}])
    monkeypatch.setattr(run.program, "mistraced", lambda *_: next(told))
    assert run.solve(guess(x, -0.2)).converged and not run.unfinished


def keeper(**settings: Any) -> CbfMpc:
    plans = CbfMpc(KeeperSettings(**{"alpha": 1.0, "slots": 1, **settings}), Airframe(), DT)
    for k in range(3):  # the first is cold, the second begins with a warm start
        decide(plans, k, pillar(9.0))
    return plans


def pillar(y: float) -> Obstacles:
    flags = np.ones(1, dtype=bool)
    return Obstacles(np.array([[0.0, y, 1.0]]), np.zeros((1, 3)), np.array([0.8]), flags, ~flags)


def decide(plans: CbfMpc, tick: int, seen: Obstacles) -> Decision:
    """Decision of a vehicle that is on its way along the line."""
    flown = LINE.at(1.0 + DT * tick + plans.nodes)
    state = flat_flight(flown, plans.believed)[0][0]
    hover = quadrotor.hover(plans.believed)
    start = np.concatenate([state, np.zeros(6), hover[3:]])
    return plans.decide(start, flown, seen, 0.0, np.zeros((plans.settings.horizon, 3)))


def test_the_last_plan_is_flown_until_all_portions_are_made() -> None:
    plans, whole = keeper(portion=2, iterations=60), keeper(portion=None, iterations=12)
    last = plans.loop.kept.controls.copy()
    expected = decide(whole, 3, pillar(0.1))
    decision, ticks = decide(plans, 3, pillar(0.1)), 0
    while plans.loop.goes_on:
        ticks += 1
        assert decision.status == "last plan" and decision.iterations == 2 * ticks
        np.testing.assert_array_equal(decision.control, plans.loop.kept.within(last)[(4 + ticks) // 5])
        decision = decide(plans, 3 + ticks, pillar(9.0))  # a pillar that the solve does not see: it keeps its numbers
    # Its first portion that keeps the constraints is a plan.
    assert ticks == plans.loop.waited == 5
    assert decision.status == expected.status and decision.iterations == expected.iterations
    np.testing.assert_array_equal(plans.loop.kept.controls, whole.loop.kept.controls)
    assert plans.loop.kept.age == pytest.approx(ticks * DT)
    np.testing.assert_array_equal(decision.control, whole.loop.kept.controls[(4 + ticks) // 5])
    before, after = whole.loop.solution, plans.loop.guess
    assert before is not None and after is not None
    speed = before[plans.loop.x.family.name][0, 7]
    moved = after.values[plans.loop.x.family][0, 0] - before[plans.loop.x.family.name][0, 0]
    assert moved == pytest.approx(speed * DT * (ticks + 1), rel=0.05)


def test_a_decision_without_time_flies_the_last_plan_by_name_and_then_brakes() -> None:
    plans = keeper(decide_ms=1e4, portion=2, iterations=60)
    now, slow = 0.0, 0.0

    def clock() -> float:
        nonlocal now
        now += slow
        return now

    plans.loop._clock = clock
    decide(plans, 3, pillar(9.0))
    last = plans.loop.kept.controls.copy()
    slow, plans.loop._step_time = 4.0, 8.0  # [s], so that none of its iterations fits into ten
    told = [decide(plans, 4 + k, pillar(9.0)) for k in range(10)]
    assert [each.status for each in told] == ["late"] * 10 and {each.iterations for each in told} == {0}
    np.testing.assert_array_equal(told[0].control, last[1])
    for each in told[8:]:  # the plan is too old
        assert each.control[1] < -0.1 and each.control[3] > 1.0  # the nose goes up, and the vehicle does not fall
    slow = 0.0
    while plans.loop._step_time > 4.0:
        decide(plans, 14, pillar(9.0))
    assert decide(plans, 14, pillar(9.0)).status in ("converged", "stop_rule")


def test_a_tick_without_time_for_a_solve_still_estimates() -> None:
    robot = Robot(fg.Rn(1), fg.Rn(1), predict=lambda x, u: x + u)
    step = Dynamics(lambda x, u, y, h: y - x - h * u, 1.0, sigma=0.1)
    window = Window(robot, 3, [step, Measurement("place", fg.difference, (1,), 0.01)], start=[0.0], sigma=1.0)
    loop = RecedingHorizon(
        robot, 3, [step, ControlCost(sigma=1.0)], solver=InteriorPoint(), window=window, portion=1, deadline=1e3
    )
    loop.tick(measured={"place": [0.0]})
    loop._step_time = np.inf
    assert loop.tick(measured={"place": [5.0]}).source == "late"
    np.testing.assert_allclose(loop.estimate, [5.0], atol=0.1)


def test_portions_that_cannot_be_are_refused() -> None:
    with pytest.raises(fg.ScenarioError, match="portion: '0' is not a whole number of at least 1"):
        keeper(portion=0)


def boat(steps: int) -> tuple[RecedingHorizon, Robot]:
    """A boat with drag whose plans take several iterations, of which each tick makes one."""

    def motion(x: Array, u: Array, y: Array, h: Array) -> Array:
        return y - x - h[:, None] * np.stack([x[:, 1], u[:, 0] - 0.3 * x[:, 1] * np.abs(x[:, 1])], axis=1)

    class Berth:
        def state(self, graph: fg.Graph, x: fg.Selection, u: fg.Family) -> None:
            graph.minimize(fg.prior, x[1:], graph.data("berth", np.zeros(2)), sigma=[0.3, 1.0], name="berth")
            graph.bound(u, lower=-1.0, upper=1.0, name="limits")

        def data(self, now: Context[float]) -> dict[str, list[float]]:
            return {"berth": [now.given, 0.0]}

    def predict(x: Array, u: Array, seconds: float) -> Array:
        return np.asarray(-motion(x[None], u[None], np.zeros((1, 2)), np.full(1, seconds))[0])

    robot = Robot(fg.Rn(2), fg.Rn(1), predict=predict, tick=0.5)
    terms: list[Term] = [Dynamics(motion), Berth(), ControlCost(sigma=2.0)]
    return RecedingHorizon(robot, steps, terms, solver=InteriorPoint(), portion=1), robot


def test_a_plan_that_took_ticks_is_followed_from_where_it_should_be() -> None:
    loop, robot = boat(6)
    x = np.zeros(2)
    for tick in range(8):
        plan = loop.plan(x, 5.0 if tick < 4 else -3.0)
        if loop.waited and plan.source == "solved":
            break
        x = robot.predicted(x, loop.applied)
    left = 6 - loop.waited
    assert plan.source == "solved" and 0 < left < 6
    np.testing.assert_allclose(robot.rollout(plan.states[0], plan.controls[:left]), plan.states[: left + 1], atol=2e-3)


def test_a_plan_that_is_over_before_it_is_found_is_not_applied() -> None:
    loop, _ = boat(2)
    found = []
    for tick in range(12):
        plan = loop.plan(np.array([0.1 * tick, 0.2]), 5.0)
        assert plan.controls.shape == (2, 1)
        found += [plan] if loop.waited >= 2 and not loop.goes_on else []
    assert found and {plan.source for plan in found} == {"braking"}


def test_new_node_times_drop_what_was_begun_on_the_old_ones() -> None:
    loop, _ = boat(6)
    for to in (5.0, 5.0, 5.0, 5.0, -3.0):
        loop.plan(np.zeros(2), to)
        if loop.goes_on:
            break
    assert loop.goes_on
    loop.set_times([0.0, 0.5, 1.5, 2.5, 3.5, 4.5, 5.5])
    assert loop.plan(np.zeros(2), 5.0).iterations == 1


def test_a_portion_that_was_dropped_is_not_gone_on_with_after_a_cold_solve() -> None:
    loop, _ = boat(6)
    accepted = True

    def judge(solution: fg.Solution, states: Array, controls: Array, now: Any, kept: Any) -> horizon.Decision:
        return horizon.Decision(controls, states, "solved" if accepted else "braking")

    loop.judge = judge
    for to in (5.0, 5.0, -3.0):
        loop.plan(np.zeros(2), to)
    assert loop.warm.unfinished, "accepted as it was"
    loop.forget()
    accepted = False
    assert loop.plan(np.zeros(2), 50.0).source == "braking" and not loop.goes_on
