"""Adaptive mesh: nodes where dynamics and clearances need them, and what then holds between nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import unifg as fg
from unifg.horizon import Context, Dynamics, Robot, Term, plan_on_mesh
from unifg.horizon.mesh import MeshPlan
from unifg.models import unicycle
from unifg.models.obstacles import disc_clearance
from unifg.solvers import InteriorPoint
from unifg.typing import Array

DISC, RADIUS = np.array([[0.75, 0.02]]), np.array([0.15])
CAR = Robot(fg.SE2, fg.Rn(2), predict=lambda x, u, seconds: unicycle.step(x[None], u[None], seconds)[0], tick=0.5)


class Course:
    """A goal behind a disc that is smaller than a step, with costs in proportion to the steps."""

    def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
        share = graph.data("share", np.ones((len(u), 1)), each=True)
        graph.minimize(lambda x, share: np.sqrt(share) * (x - np.array([2.0, 0.0, 0.0])), x[1:], share, sigma=0.5)
        graph.minimize(lambda u, share: np.sqrt(share) * u, u, share, sigma=2.0)
        graph.bound(u, lower=-1.0, upper=1.0)
        graph.constrain(disc_clearance, x[1:], DISC, RADIUS, lower=0.0, name="disc")

    def data(self, now: Context[Any]) -> dict[str, Array]:
        return {"share": np.diff(now.times)[:, None]}


def clear(x: Array) -> Array:
    """(n, M) distances to the hull."""
    return np.asarray(disc_clearance(x, DISC, RADIUS))


def dense(robot: Robot, found: MeshPlan, pieces: int = 50) -> list[Array]:
    """States of the model on the way from each node of a plan."""
    ways = []
    for k, length in enumerate(np.diff(found.times)):
        controls = np.tile(found.plan.controls[k], (pieces, 1))
        ways.append(robot.rollout(found.plan.states[k], controls, np.full(pieces, length / pieces)))
    return ways


def drive(**options: Any) -> MeshPlan:
    terms: list[Term] = [Dynamics(unicycle.dynamics), Course()]
    usual: dict[str, Any] = {"solver": InteriorPoint(), "between": clear, "defect": 1e-3, "violation": 1e-3}
    start, times = options.pop("present", np.zeros(3)), options.pop("times", np.linspace(0.0, 4.0, 9))
    return plan_on_mesh(CAR, terms, times, start, **usual | options)


def test_a_plan_does_not_step_over_what_it_shall_avoid() -> None:
    coarse = drive(rounds=1)
    assert coarse.steps == (8,) and not coarse.met and coarse.violations.max() > 0.05
    assert clear(coarse.plan.states[1:]).min() > -1e-6, "every node keeps off"
    assert min(clear(way).min() for way in dense(CAR, coarse)) < -0.05
    found = drive()
    assert found.met and found.steps[0] == 8 and found.steps[-1] == len(found.defects) == len(found.times) - 1
    assert min(clear(way).min() for way in dense(CAR, found)) > -1.5e-3
    assert found.violations.max() <= 1e-3 and found.defects.max() <= 1e-3
    lengths = np.diff(found.times)
    near = np.abs(found.plan.states[:-1, 0] - 0.75) < 0.2
    assert lengths[near].max() < 0.5 and lengths.max() == 0.5, "no node where none is needed"
    finest = drive(violation=1e-5, defect=1e-5)
    assert finest.met and finest.steps[-1] > found.steps[-1]
    assert min(clear(way).min() for way in dense(CAR, finest)) > -3e-5


def rate(x: Array, u: Array) -> Array:
    """(n, 2) of a pendulum with a torque."""
    return np.concatenate([x[:, 1:], u - 9.81 * np.sin(x[:, :1])], axis=1)


def midpoint(x: Array, u: Array, seconds: Any) -> Array:
    """(n, 2) state after a step of the midpoint rule."""
    h = np.reshape(seconds, (-1, 1)) * np.ones((len(x), 1))
    return x + h * rate(x + 0.5 * h * rate(x, u), u)


class Swing:
    """A pendulum to be brought to rest from a swing."""

    def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
        share = graph.data("share", np.ones((len(u), 1)), each=True)
        graph.minimize(lambda u, share: np.sqrt(share) * u, u, share, sigma=2.0)
        graph.minimize(fg.prior, x[-1], [0.0, 0.0], sigma=0.05)
        graph.bound(u, lower=-3.0, upper=3.0)

    def data(self, now: Context[Any]) -> dict[str, Array]:
        return {"share": np.diff(now.times)[:, None]}


def test_the_dynamics_hold_between_nodes_to_the_tolerance() -> None:
    robot = Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u, t: midpoint(x[None], u[None], t)[0], tick=0.1)
    terms: list[Term] = [Dynamics(lambda x, u, y, h: y - midpoint(x, u, h)), Swing()]
    found = plan_on_mesh(
        robot, terms, np.linspace(0.0, 1.6, 17), [1.5, 0.0], solver=InteriorPoint(), defect=1e-3,
        cold=lambda now: (np.tile(now.present, (17, 1)), np.zeros((16, 1))),
    )  # fmt: skip
    assert found.met and found.defects.max() <= 1e-3 and not found.violations.any()
    assert len(found.steps) > 1 and np.ptp(np.diff(found.times)) > 0.01, "steps are divided where they are off"
    missed = []
    for k, (begin, end) in enumerate(zip(found.times[:-1], found.times[1:], strict=True)):
        control, state = found.plan.controls[k], found.plan.states[k]
        exact = solve_ivp(
            lambda t, x, u=control: rate(x[None], u[None])[0], (begin, end), state, rtol=1e-10, atol=1e-12
        )
        missed.append(np.abs(exact.y[:, -1] - found.plan.states[k + 1]).max())
    assert max(missed) <= 1.1e-3, "the defect is that of the true flow"
    np.testing.assert_allclose(missed, found.defects, atol=0.05e-3)


def test_terms_are_given_what_the_caller_gives() -> None:
    seen = []

    class Told(Course):
        def data(self, now: Context[Any]) -> dict[str, Array]:
            seen.append(now.given)
            return super().data(now)

    goal = np.array([2.0, 0.0, 0.0])
    terms: list[Term] = [Dynamics(unicycle.dynamics), Told()]
    plan_on_mesh(CAR, terms, np.linspace(0.0, 4.0, 9), np.zeros(3), goal, solver=InteriorPoint(), rounds=1)
    assert seen and all(one is goal for one in seen)


def test_clearances_of_nothing_are_not_violated() -> None:
    for free in (lambda x: np.zeros((len(x), 0)), lambda x: np.full(len(x), np.inf)):
        assert not drive(between=free).violations.any()


def test_a_plan_that_is_refused_ends_the_search() -> None:
    found = drive(present=np.array([0.75, 0.0, 0.0]), solver=InteriorPoint(max_iterations=0))
    assert not found.met and found.steps == (8,) and found.plan.source != "solved"
    with pytest.raises(fg.GraphError, match="a robot that predicts"):
        plan_on_mesh(Robot(fg.SE2, fg.Rn(2)), [], [0.0, 1.0], np.zeros(3), solver=InteriorPoint())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rounds": 0}, "plan_on_mesh: takes positive numbers"),
        ({"defect": 0.0}, "plan_on_mesh: takes positive numbers"),
        ({"violation": np.nan}, "plan_on_mesh: takes positive numbers"),
        ({"substeps": 1}, "at least two substeps"),
        ({"substeps": 2.5}, "substeps must be a whole number, found 2.5"),
        ({"defect": "small"}, "defect must be a number, found 'small'"),
        ({"between": 3}, "between must be a function or None, found 3"),
        ({"between": lambda x: np.full(len(x), np.nan)}, "between must give numbers, found"),
        ({"between": lambda x: None}, "what between gives must be real numbers, found None"),
        ({"times": [0.0]}, "at least two of them"),
        ({"times": 4.0}, "at least two of them"),
        ({"times": "soon"}, "the times of the nodes must be real numbers, found 'soon'"),
        ({"times": [0.0, np.nan]}, "growing numbers from 0 on"),
    ],
    ids=lambda part: part if isinstance(part, str) else "-".join(part),
)
def test_what_no_mesh_can_meet_is_refused(options: dict[str, Any], said: str) -> None:
    """No round would have ended the search, or none of its numbers could be found."""
    with pytest.raises(fg.GraphError, match=said):
        drive(**options)


def test_the_next_mesh_begins_on_the_plan_of_the_last() -> None:
    times, at = np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.5, 1.0, 2.0, 3.0, 4.0])
    states, controls = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.4], [2.0, 1.0, 0.8]]), np.array([[1.0, 2.0], [3.0, 4.0]])
    nodes, acting = CAR.between(times, states, controls, at)
    half = fg.SE2.retract(states[:1], 0.5 * fg.SE2.local(states[:1], states[1:2]))
    np.testing.assert_allclose(
        nodes[[0, 1, 2, 4, 5]], [states[0], half[0], states[1], states[2], states[2]], atol=1e-12
    )
    np.testing.assert_array_equal(acting, controls[[0, 0, 1, 1, 1]])
