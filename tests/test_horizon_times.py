"""Horizons with node times of any spacing: warm starts, kept plans and rollouts go by seconds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from test_horizon import Goal
from unifg.codegen.compile_counter import counting
from unifg.elimination import factorization
from unifg.errors import GraphError
from unifg.horizon import (
    Context,
    ControlCost,
    Decision,
    Dynamics,
    LastPlanThenBrake,
    RecedingHorizon,
    Robot,
    Term,
    Window,
)
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import GaussNewton, InteriorPoint
from unifg.typing import Array, ArrayLike

TICK = 0.1
TIMES = np.array([0.0, 0.1, 0.2, 0.4, 0.7, 1.1, 1.6])
TARGET = np.array([1.0, 0.0])


def flows(x: Array, u: Array, seconds: float) -> Array:
    """State after a control that is held."""
    return np.array([x[0] + seconds * x[1] + 0.5 * seconds**2 * u[0], x[1] + seconds * u[0]])


def motion(x: Array, u: Array, y: Array, h: Array) -> Array:
    """Defect of the same, (n, 2)."""
    t = np.reshape(h, (-1, 1)) * np.ones((len(x), 1))
    ahead = np.concatenate([x[:, :1] + t * x[:, 1:] + 0.5 * t * t * u, x[:, 1:] + t * u], axis=1)
    return np.asarray(y - ahead)


CART = Robot(fg.Rn(2), fg.Rn(1), predict=flows, tick=TICK)
STEADY = Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u: flows(x, u, TICK))


@dataclass
class Refusing:
    """A judge that refuses the plans of some ticks."""

    inner: LastPlanThenBrake
    refused: range
    ticks: int = 0

    def __call__(self, solution: Any, states: Array, controls: Array, now: Context[Any], kept: Any) -> Decision:
        self.ticks += 1
        judge = self.inner.instead if self.ticks in self.refused else None
        return judge(now, kept) if judge else self.inner(solution, states, controls, now, kept)


def loop_of(times: Array | None, robot: Robot = CART, steps: int = 6, **options: Any) -> RecedingHorizon:
    uneven = times is not None and np.ptp(np.diff(times)) > 1e-9
    lengths = np.diff(times) if times is not None and uneven else TICK
    terms: list[Term] = [Dynamics(motion, lengths), Goal(), ControlCost(sigma=[1.0], change=[2.0])]
    return RecedingHorizon(robot, steps, terms, times=times, solver=InteriorPoint(), **options)


def test_equal_steps_give_the_same_bits_with_times_and_without() -> None:
    """Warm starts, kept plans, braking: nothing differs in the last bit."""
    runs = []
    for times, robot in ((None, STEADY), (TICK * np.arange(7.0), CART)):
        keep = 2 if times is None else 2 * TICK
        judge = Refusing(LastPlanThenBrake(robot, keep=keep), range(4, 8))
        loop = loop_of(times, robot, judge=judge, limits=(-1.0, 1.0))
        state, plans = np.array([0.0, 0.4]), []
        for _ in range(10):
            plans.append(loop.plan(state, TARGET))
            state = flows(state, plans[-1].control, TICK)
        runs.append(plans)
    assert [plan.source for plan in runs[0]] == ["solved"] * 3 + ["kept"] * 2 + ["braking"] * 2 + ["solved"] * 3
    for one, other in zip(*runs, strict=True):
        assert one.source == other.source and one.iterations == other.iterations
        assert np.array_equal(one.controls, other.controls) and np.array_equal(one.states[:2], other.states[:2])
        np.testing.assert_allclose(one.states, other.states, rtol=0.0, atol=1e-15)  # lengths of steps are differences


def test_a_warm_start_is_the_last_plan_a_tick_later() -> None:
    loop = loop_of(TIMES)
    plan = loop.plan(np.array([0.0, 0.4]), TARGET)
    guess = loop.guess
    assert guess is not None and plan.source == "solved"
    later = np.minimum(TIMES + TICK, TIMES[-1])
    expected = np.column_stack([np.interp(later, TIMES, column) for column in plan.states.T])
    np.testing.assert_allclose(guess.values[loop.x.family], expected, atol=1e-12)
    acting = [0.1, 0.2, 0.3, 0.5, 0.8, 1.2]  # what acts when each step of the next plan begins
    np.testing.assert_array_equal(guess.values[loop.u], plan.controls[[1, 2, 2, 3, 4, 5]])
    assert np.allclose(acting, TIMES[:-1] + TICK)


def test_warm_starts_take_fewer_iterations_than_cold_ones() -> None:
    loop, cold = loop_of(TIMES), loop_of(TIMES)
    state = np.array([0.0, 0.4])
    for _ in range(8):
        plan = loop.plan(state, TARGET)
        cold.forget()
        again = cold.plan(state, TARGET)
        np.testing.assert_allclose(plan.controls, again.controls, atol=1e-3)
        state = flows(state, plan.control, TICK)
    assert plan.iterations <= again.iterations


def test_a_kept_plan_ages_in_seconds() -> None:
    """Its controls act when they were planned to, on the grid of now; states are rolled out in steps of the grid."""
    judge = Refusing(LastPlanThenBrake(CART, keep=0.55), range(2, 9))
    loop = loop_of(TIMES, judge=judge)
    state = np.array([0.0, 0.4])
    plans = []
    for _ in range(8):
        plans.append(loop.plan(state, TARGET))
        state = flows(state, plans[-1].control, TICK)
    assert [plan.source for plan in plans] == ["solved"] + ["kept"] * 5 + ["braking"] * 2
    good = plans[0].controls
    for age, acting in enumerate([[1, 2, 2, 3, 4, 5], [2, 2, 3, 3, 4, 5], [2, 3, 3, 4, 4, 5]], start=1):
        kept = plans[age]
        np.testing.assert_array_equal(kept.controls[: len(acting)], good[acting])
        for k, length in enumerate(np.diff(TIMES)):
            np.testing.assert_allclose(kept.states[k + 1], flows(kept.states[k], kept.controls[k], length), atol=1e-12)
    np.testing.assert_array_equal(plans[5].controls[:5], good[[3, 3, 4, 4, 5]])
    assert not plans[5].controls[5:].any(), "where nothing is left it brakes"
    assert loop.kept.age == pytest.approx(0.7)


def test_a_delay_predicts_by_ticks() -> None:
    loop = loop_of(TIMES, delay=2)
    state = np.array([0.0, 0.4])
    first = loop.plan(state, TARGET)
    np.testing.assert_allclose(first.states[0], flows(flows(state, np.zeros(1), TICK), np.zeros(1), TICK))


def test_a_joint_graph_moves_its_past_by_nodes_and_its_future_by_seconds() -> None:
    past: list[Term] = [Dynamics(motion, TICK, sigma=[0.01, 0.02])]
    window = Window(CART, 3, past, start=[0.0, 0.4], sigma=0.1, solver=GaussNewton())
    loop = loop_of(TIMES, window=window, coupling="joint")
    for _ in range(5):
        plan = loop.tick(TARGET)
        assert plan.source == "solved"
    solution, guess = loop.solution, loop.guess
    assert solution is not None and guess is not None
    nodes, moved = solution[loop.x.family], guess.values[loop.x.family]
    np.testing.assert_array_equal(moved[:3], nodes[1:4])
    later = np.minimum(TIMES + TICK, TIMES[-1])
    expected = np.column_stack([np.interp(later, TIMES, column) for column in nodes[3:].T])
    np.testing.assert_allclose(moved[3:], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("times", "robot", "why"),
    [
        ([0.0, 0.1, 0.2], CART, "the times must be 7 growing numbers from 0 on"),
        ([0.0, 0.1, 0.2, 0.2, 0.7, 1.1, 1.6], CART, "growing"),
        ([0.1, 0.2, 0.3, 0.4, 0.7, 1.1, 1.6], CART, "from 0 on"),
        ([0.0, 0.1, 0.2, 0.4, 0.7, 1.1, np.inf], CART, "growing"),
        (TIMES, STEADY, r"predict\(x, u, seconds\)"),
        (TIMES, replace(CART, tick=0.2), r"as long as a tick of the robot \(0.2 s\), got 0.1 s"),
        (TICK * np.arange(7.0), CART, "'dynamics': its step is .* s, but the nodes .* leave step= out"),
        (None, CART, "'dynamics': its step is .* s, but the nodes"),
    ],
)
def test_times_that_do_not_fit_are_refused(times: ArrayLike, robot: Robot, why: str) -> None:
    terms: list[Term] = [Dynamics(motion, np.diff(TIMES)), Goal()]
    with pytest.raises(fg.GraphError, match=why):
        RecedingHorizon(robot, 6, terms, times=times, solver=InteriorPoint())


def test_dynamics_of_one_step_are_refused_beside_other_times() -> None:
    with pytest.raises(fg.GraphError, match=r"'dynamics': its step is 0.1 s, but the nodes of the horizon are \[0.1"):
        RecedingHorizon(CART, 6, [Dynamics(motion, TICK), Goal()], times=TIMES, solver=InteriorPoint())
    loop = loop_of(TICK * np.arange(7.0))
    with pytest.raises(fg.GraphError, match="leave step= out"):
        loop.set_times(TIMES)
    assert loop.times[-1] == pytest.approx(6 * TICK)


@pytest.mark.parametrize("robot", [CART, Robot(fg.Rn(2), fg.Rn(1))])
def test_a_past_of_another_step_than_a_tick_is_refused(robot: Robot) -> None:
    """Its estimate would move half as far as the robot."""
    past = Dynamics(motion, 0.5 * TICK, sigma=[0.1, 0.1])
    window = Window(robot, 3, [past], start=np.zeros(2), sigma=0.1)
    with pytest.raises(fg.GraphError, match=r"its step is 0.05 s, but .* in a window give the length of a tick"):
        loop_of(TIMES, robot, window=window)


def moving(**options: Any) -> RecedingHorizon:
    """A loop whose node times may change, with costs of the states in proportion to the steps before them."""

    class Weighed:
        def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
            share = graph.data("share", np.ones((len(u), 1)), each=True)
            graph.minimize(lambda x, share: np.sqrt(share) * (x - TARGET), x[1:], share, sigma=0.3, name="goal")

        def data(self, now: Context[Any]) -> dict[str, Array]:
            return {"share": np.diff(now.times)[:, None]}

    terms: list[Term] = [Dynamics(motion), Weighed(), ControlCost(sigma=[1.0], change=[2.0])]
    return RecedingHorizon(CART, 6, terms, solver=InteriorPoint(tolerance=1e-9), **{"times": TIMES} | options)


LATER = np.array([0.0, 0.1, 0.3, 0.6, 0.9, 1.4, 2.2])


def test_new_times_are_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is compiled, traced or ordered again, and the plan is that of a loop that began with these times."""
    loop, fresh = moving(), moving(times=LATER)
    state = np.array([0.0, 0.4])
    first, expected = loop.plan(state, TARGET), fresh.plan(state, TARGET)
    program, made = loop.warm.program, []
    for owner, name in ((factorization, "analyse"), (CompiledProblem, "__init__")):
        monkeypatch.setattr(owner, name, lambda *_, **__: made.append(1))
    loop.set_times(LATER)
    loop.applied = np.zeros(1)
    with counting() as counts:
        found = loop.plan(state, TARGET)
    assert not counts.everything and not made and loop.warm.program is program
    np.testing.assert_allclose(found.controls, expected.controls, atol=1e-6)
    assert np.abs(found.controls - first.controls).max() > 1e-2
    for k, length in enumerate(np.diff(LATER)):
        np.testing.assert_allclose(found.states[k + 1], flows(found.states[k], found.controls[k], length), atol=1e-8)
    with pytest.raises(GraphError, match="first step must be as long as a tick"):
        loop.set_times(2.0 * LATER)
    assert np.array_equal(loop.times, LATER)


def test_new_times_interpolate_the_warm_start_and_leave_the_kept_plan() -> None:
    judge = Refusing(LastPlanThenBrake(CART, keep=0.55), range(2, 9))
    loop = moving(judge=judge)
    plan = loop.plan(np.array([0.0, 0.4]), TARGET)
    before = loop.guess
    assert before is not None
    loop.set_times(LATER)
    guess = loop.guess
    assert guess is not None and guess.multipliers is before.multipliers
    nodes = before.values[loop.x.family]
    expected = np.column_stack([np.interp(LATER, TIMES, column) for column in nodes.T])
    np.testing.assert_allclose(guess.values[loop.x.family], expected, atol=1e-12)
    np.testing.assert_array_equal(guess.values[loop.u], before.values[loop.u][[0, 1, 2, 3, 4, 5]])
    kept = loop.plan(plan.states[1], TARGET)
    assert kept.source == "kept"
    acting = [1, 2, 3, 4, 4, 5]  # what acts at 0.1, 0.2, 0.4, 0.7, 1.0 and 1.5 s of the plan
    np.testing.assert_array_equal(kept.controls, plan.controls[acting])
    for k, length in enumerate(np.diff(LATER)):
        np.testing.assert_allclose(kept.states[k + 1], flows(kept.states[k], kept.controls[k], length), atol=1e-12)
    loop.abandon()
    assert not len(loop.kept.left())


def test_a_past_needs_a_step_of_its_own() -> None:
    with pytest.raises(GraphError, match="the past needs the step of 'dynamics'"):
        Window(CART, 3, [Dynamics(motion)], start=np.zeros(2), sigma=1.0)


def test_steps_of_one_length_do_not_fill_a_window() -> None:
    """They would move its start and add their noise before anything has moved."""
    with pytest.raises(GraphError, match=r"'dynamics' has a step of 0.1 s, but a filled window begins with steps"):
        Window(CART, 3, [Dynamics(motion, TICK, sigma=[0.01, 0.02])], start=[0.0, 1.0], sigma=1.0, filled=True)
