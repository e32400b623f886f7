"""Plans that act a tick after their present: predicted, they are those of a loop without delay, one tick later."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.horizon import ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Term, Window
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint
from unifg.typing import Array

H, STEPS, START, DISC = 0.2, 15, np.array([0.0, 0.0, 0.8]), np.array([1.0, 0.5])
LIMITS = np.array([-1.0, -1.5]), np.array([1.0, 1.5])


def advance(x: Array, u: Array) -> Array:
    return np.asarray(unicycle.step(x[None], u[None], H)[0])


CAR = Robot(fg.SE2, fg.Rn(2), predict=advance)


class Course(Term):
    """To a goal behind a disc."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(unicycle.tracking, x[1:], [3.0, 0.5, 0.0], sigma=[0.5, 0.5, 1.0], name="goal")
        graph.constrain(obstacles.disc_clearance, x[1:], [DISC], [0.4], lower=0.0, name="disc")
        graph.bound(u, lower=LIMITS[0], upper=LIMITS[1], name="limits")


def loop_of(**options: Any) -> RecedingHorizon:
    terms: list[Term] = [Dynamics(unicycle.dynamics, H), Course(), ControlCost(sigma=[2.0, 2.0], change=[0.5, 0.5])]
    return RecedingHorizon(CAR, STEPS, terms, solver=InteriorPoint(tolerance=1e-9), limits=LIMITS, **options)


def driven(loop: RecedingHorizon, ticks: int, late: int) -> Array:
    """True states of a plant without noise on which controls act ``late`` ticks after the loop has said them."""
    truth, states, waiting = START, [START], [np.zeros(2)] * late
    for _ in range(ticks):
        plan = loop.plan(truth)
        assert plan.source == "solved"
        waiting.append(plan.control)
        acting = waiting.pop(0)
        if loop.delay == late:
            np.testing.assert_array_equal(acting, loop.applied)
        truth = advance(truth, acting)
        states.append(truth)
    return np.array(states)


@pytest.mark.parametrize("delay", [1, 3])
def test_a_predicted_plan_is_that_of_a_loop_without_delay(delay: int) -> None:
    """The robot rests until the first plan acts; from then on all is the same, tick by tick."""
    ideal = driven(loop_of(), 20, 0)
    predicted = driven(loop_of(delay=delay), 20 + delay, delay)
    np.testing.assert_array_equal(predicted[: delay + 1], np.tile(START, (delay + 1, 1)))
    assert np.abs(fg.SE2.local(ideal, predicted[delay:])).max() < 1e-6
    assert np.linalg.norm(ideal[-1, :2] - [3.0, 0.5]) < 0.2


def test_without_prediction_it_is_worse() -> None:
    """Plans from where the robot was: it turns too late on its way around the disc."""

    def cost(states: Array) -> float:
        return float(np.square(unicycle.tracking(states, np.array([3.0, 0.5, 0.0])) / [0.5, 0.5, 1.0]).sum())

    assert cost(driven(loop_of(), 25, 1)) > 1.03 * cost(driven(loop_of(delay=1), 25, 1))


def test_the_past_is_of_what_has_acted() -> None:
    """The window moves by the control that acted, and the estimate is of the present, not of the prediction."""
    past: list[Term] = [
        Dynamics(unicycle.dynamics, H, sigma=[1e-3] * 3),
        Measurement("pose", fg.prior, (3,), [0.01, 0.01, 0.01]),
    ]
    window = Window(CAR, 4, past, start=START, sigma=0.1)
    loop, truth, acted = loop_of(delay=1, window=window), START, []
    for _ in range(8):
        plan = loop.tick(measured={"pose": truth})
        assert np.abs(fg.SE2.local(truth, loop.estimate)).max() < 1e-3
        ahead = advance(loop.estimate, loop.applied)
        assert np.abs(fg.SE2.local(ahead, plan.states[0])).max() < 1e-9
        np.testing.assert_array_equal(loop.sent, plan.control[None])
        acted.append(loop.applied)
        truth = advance(truth, loop.applied)
    np.testing.assert_array_equal(window.history.controls, acted[3:7])
    loop.reset()
    assert not loop.sent.any() and not loop.applied.any()


def test_what_cannot_be_predicted_is_refused() -> None:
    past: list[Term] = [Dynamics(unicycle.dynamics, H, sigma=[1e-3] * 3)]
    window = Window(CAR, 4, past, start=START, sigma=0.1)
    for options in ({"delay": -1}, {"delay": 1, "coupling": "joint", "window": window}):
        with pytest.raises(fg.GraphError, match="a plan acts now or later"):
            loop_of(**options)
    with pytest.raises(fg.GraphError, match="takes a robot that predicts"):
        RecedingHorizon(Robot(fg.SE2, fg.Rn(2)), 5, [Dynamics(unicycle.dynamics, H)], solver=InteriorPoint(), delay=1)
