"""Margins for the uncertainty of an estimate, beside deviations that the library's Jacobians have no part in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.errors import GraphError
from unifg.horizon import (
    Constant,
    Context,
    ControlCost,
    Dynamics,
    Measurement,
    RecedingHorizon,
    Robot,
    Term,
    Tree,
    Window,
)
from unifg.models import unicycle
from unifg.solvers import SQP, InteriorPoint
from unifg.typing import Array, ArrayLike

STEP, STEPS = 0.1, 12
START = (0.0, 0.4, 0.0)
SPREAD = np.diag([0.05, 0.01, 0.02]) ** 2


@dataclass
class Wall:
    """A goal, and a straight wall that is kept off: y >= limit for all nodes, by a function or a bound."""

    soft: float | None = None
    lower: Any = 0.0
    upper: Any = np.inf
    data_lower: Mapping[str, Array] = field(default_factory=dict)
    goal: tuple[float, float, float] = (1.0, -0.5, 0.0)

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, x[1:], list(self.goal), sigma=[1.0, 1.0, 3.0], name="goal")
        graph.bound(u, lower=[0.0, -1.5], upper=[1.0, 1.5], name="limits")
        lower = graph.data("edge", [float(self.lower)]) if self.data_lower else self.lower
        graph.constrain(height, x[1:], lower=lower, upper=self.upper, soft=self.soft, name="wall")

    def data(self, now: Context[Any]) -> Mapping[str, Array]:
        return self.data_lower


def height(x: Array) -> Array:
    return x[:, 1:2]


def loop_of(wall: Wall, **options: Any) -> RecedingHorizon:
    robot = Robot(fg.SE2, fg.Rn(2))
    terms: list[Term] = [Dynamics(unicycle.dynamics, STEP), wall, ControlCost(sigma=[3.0, 3.0])]
    return RecedingHorizon(robot, STEPS, terms, solver=InteriorPoint(), **options)


def planned(wall: Wall, start: ArrayLike = START, covariance: Array | None = SPREAD, **options: Any) -> Array:
    loop = loop_of(wall, **options)
    for _ in range(6):  # a margin is that at the guess: the plan settles
        loop.plan(start, covariance=covariance)
    return nodes(loop)


def nodes(loop: RecedingHorizon) -> Array:
    """(N + 1, 3) of the last plan."""
    assert loop.solution is not None
    return loop.solution[loop.x]


def deviations(states: Array, covariance: Array = SPREAD) -> Array:
    """Standard deviations of y when the error of the present moves the plan as a rigid body, by differences."""
    start, found, eps = states[0], np.zeros(len(states)), 1e-6
    for k, state in enumerate(states):
        slope = np.zeros(3)
        for j in range(3):
            ends = []
            for sign in (1.0, -1.0):
                moved = fg.SE2.retract(start[None], sign * eps * np.eye(3)[j][None])
                ends.append(fg.SE2.compose(moved, fg.SE2.compose(fg.SE2.inverse(start[None]), state[None]))[0, 1])
            slope[j] = (ends[0] - ends[1]) / (2 * eps)
        found[k] = np.sqrt(slope @ covariance @ slope)
    return found


def test_every_node_keeps_its_number_of_standard_deviations() -> None:
    states = planned(Wall(), sigmas=3.0)
    wanted = 3.0 * deviations(states)
    assert (states[1:, 1] > wanted[1:] - 1e-5).all()
    near = states[1:, 1] - wanted[1:]
    assert near.min() < 1e-3  # the goal lies behind the wall: the margin is used up
    assert wanted[-1] > 1.2 * wanted[0]  # the lever arm of the heading counts


@pytest.mark.parametrize("start", [(0.0, 0.4, 0.0), (0.2, 0.4, 1.2)])
def test_without_sigmas_or_covariance_plans_keep_their_bits(start: tuple[float, float, float]) -> None:
    usual = planned(Wall(), start, None)
    assert np.array_equal(planned(Wall(), start, sigmas=0.0), usual)
    assert np.array_equal(planned(Wall(), start, sigmas={}), usual)
    certain = planned(Wall(), start, np.zeros((3, 3)), sigmas=3.0)
    assert np.allclose(certain, usual, atol=1e-6)


def test_limits_that_are_data_and_upper_limits_get_margins() -> None:
    states = planned(Wall(data_lower={"edge": np.array([0.1])}), sigmas={"wall": 2.0})
    assert ((states[:, 1] - 0.1 - 2.0 * deviations(states))[1:] > -1e-5).all()
    assert (states[:, 1] - 0.1 - 2.0 * deviations(states))[1:].min() < 1e-3
    high = planned(Wall(lower=-np.inf, upper=0.6, goal=(1.0, 2.0, 0.0)), sigmas=2.0)
    spare = (0.6 - high[:, 1] - 2.0 * deviations(high))[1:]
    assert -1e-5 < spare.min() < 1e-3


def test_two_limits_leave_something_between_them() -> None:
    loop = loop_of(Wall(lower=0.35, upper=0.45), sigmas=30.0)
    assert loop.plan((0.0, 0.4, 0.0), covariance=SPREAD).status is fg.Status.CONVERGED
    states = nodes(loop)
    assert (np.abs(states[1:, 1] - 0.4) < 0.05 * 0.1 + 1e-5).all()


def test_a_robot_nearer_than_its_margin_has_plans_and_leaves() -> None:
    loop = loop_of(Wall(goal=(1.0, 0.02, 0.0)), sigmas=3.0)
    state, spare = np.array([0.0, 0.02, 0.0]), []
    for _ in range(60):
        plan = loop.plan(state, covariance=np.diag([0.05, 0.05, 1e-3]) ** 2)
        assert plan.status is fg.Status.CONVERGED
        state = unicycle.step(state[None], plan.control[None], STEP)[0]
        spare.append(state[1])
    assert spare[0] < 0.06
    assert spare[-1] > 0.12  # of the 0.15 m of three standard deviations
    assert min(spare) > 0.0


def test_a_soft_constraint_is_tightened_itself_and_a_hard_one_once_more() -> None:
    ends = dict[float | None, fg.Solution]()
    for soft in (None, 1e3):
        loop = loop_of(Wall(soft=soft, goal=(1.0, 0.02, 0.0)), sigmas=3.0)
        for _ in range(6):
            loop.plan((0.0, 0.02, 0.0), covariance=SPREAD)
        assert loop.solution is not None
        ends[soft] = loop.solution
    with pytest.raises(GraphError, match="with a margin"):
        ends[1e3].slack("wall, with a margin")
    for solution, name in ((ends[None], "wall, with a margin"), (ends[1e3], "wall")):
        assert np.abs(solution.slack(name)[0, 0]) > 3e-3  # no step leads so far sideways
        assert np.abs(solution.slack(name)[-1, 0]) < 1e-5


@dataclass
class Pillar(Term):
    """A pillar whose place is estimated with the robot's."""

    reach: float = 0.3

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, x[1:], [2.0, 0.05, 0.0], sigma=[1.0, 1.0, 3.0], name="goal")
        graph.bound(u, lower=[0.0, -1.5], upper=[1.0, 1.5], name="limits")
        pillar = graph.families["pillar"]
        graph.constrain(apart, x[1:], pillar, lower=self.reach, name="pillar kept off")


def apart(x: Array, place: Array) -> Array:
    return np.asarray(np.linalg.norm(x[:, :2] - place, axis=1, keepdims=True))


@pytest.mark.parametrize("shared", [0.0, 1.0], ids=["independent", "moves with the robot"])
def test_constants_count_with_their_correlation(shared: float) -> None:
    pillar = Constant("pillar", fg.Rn(2), [[1.0, 0.0]], 0.1)
    robot = Robot(fg.SE2, fg.Rn(2), constants=(pillar,))
    terms: list[Term] = [Dynamics(unicycle.dynamics, STEP), Pillar(), ControlCost(sigma=[3.0, 3.0])]
    loop = RecedingHorizon(robot, 20, terms, solver=InteriorPoint(), sigmas=2.0)
    spread = np.zeros((5, 5))
    spread[:2, :2] = spread[3:, 3:] = 0.04**2 * np.eye(2)
    spread[:2, 3:] = spread[3:, :2] = shared * 0.04**2 * np.eye(2)
    for _ in range(8):
        loop.plan((0.0, 0.1, 0.0), covariance=spread)
    states = nodes(loop)
    gap = np.hypot(*(states[1:, :2] - [1.0, 0.0]).T).min() - 0.3
    wanted = 0.0 if shared else 2.0 * np.sqrt(2.0) * 0.04
    assert gap == pytest.approx(wanted, abs=2e-3)


def test_a_window_gives_its_own_covariance() -> None:
    robot = Robot(fg.SE2, fg.Rn(2))
    fixes = Measurement("fix", lambda pose, z: pose[:, :2] - z, (2,), 0.1)
    wheels = Dynamics(unicycle.dynamics, STEP, sigma=[0.02, 0.02, 0.02])
    nearest = dict[float, float]()
    for sigmas in (0.0, 3.0):
        window = Window(robot, 8, [fixes, wheels], start=[0.0, 0.3, 0.0], sigma=0.1)
        terms: list[Term] = [
            Dynamics(unicycle.dynamics, STEP),
            Wall(goal=(2.0, 0.0, 0.0)),
            ControlCost(sigma=[3.0, 3.0]),
        ]
        loop = RecedingHorizon(robot, STEPS, terms, solver=InteriorPoint(), window=window, sigmas=sigmas)
        pose, rng = np.array([[0.0, 0.3, 0.0]]), np.random.default_rng(1)
        seen = []
        for _ in range(30):
            plan = loop.tick(measured={"fix": pose[0, :2] + rng.normal(0.0, 0.1, 2)})
            pose = unicycle.step(pose, plan.control[None], STEP)
            seen.append(pose[0, 1])
        nearest[sigmas] = min(seen)
    assert nearest[3.0] > nearest[0.0] + 0.05
    with pytest.raises(GraphError, match=r"covariance of state and constants has shape \(2, 2\), expected \(3, 3\)"):
        loop.plan((0.0, 0.3, 0.0), covariance=np.eye(2))


@pytest.mark.parametrize(
    ("sigmas", "message"),
    [
        ({"walls": 2.0}, r"'walls' is no inequality constraint on states \(there are: 'wall'\)"),
        ({"limits": 2.0}, "'limits' is no inequality"),
        (-1.0, r"-1\.0 standard deviations for 'wall'"),
        (np.array([1.0, 2.0]), r"sigmas of 'wall' has shape \(2,\), expected \(\)"),
        (np.inf, "sigmas of 'wall' must be finite"),
    ],
)
def test_errors_name_the_sigmas_that_were_given(sigmas: Any, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        loop_of(Wall(), sigmas=sigmas)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (-np.eye(3), "negative variances"),
        (None, r"need the covariance of state and constants, \(3, 3\), or a window"),
    ],
)
def test_errors_name_the_covariance_that_was_given(covariance: Any, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        loop_of(Wall(), sigmas=1.0).plan((0.0, 0.4, 0.0), covariance=covariance)


def test_a_joint_graph_and_a_horizon_that_branches_have_margins() -> None:
    robot = Robot(fg.SE2, fg.Rn(2))
    fixes = Measurement("fix", lambda pose, z: pose[:, :2] - z, (2,), 0.1)
    window = Window(robot, 4, [fixes, Dynamics(unicycle.dynamics, STEP, sigma=0.02)], start=[0.0, 0.4, 0.0], sigma=0.05)
    variants: list[tuple[int | Tree, Any]] = [(STEPS, "joint"), (Tree((0, 1, 2, 2, 3, 4)), "sequential")]
    for steps, coupling in variants:
        terms: list[Term] = [
            Dynamics(unicycle.dynamics, STEP),
            Wall(goal=(1.0, -2.0, 0.0)),
            ControlCost(sigma=[3.0, 3.0]),
        ]
        loop = RecedingHorizon(
            robot, steps, terms, solver=InteriorPoint(), sigmas=2.0, window=window, coupling=coupling
        )
        for _ in range(8):
            loop.tick(applied=[0.0, 0.0], measured={"fix": [0.0, 0.4]})
        states = nodes(loop)
        spare = (states[:, 1] - 2.0 * deviations(states, window.covariance))[1:]
        assert spare.min() > -2e-3


class Pace(Term):
    """Goal, and a limit on how far neighbouring nodes are apart, which no error of the present changes."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, x[1:], [2.0, 1.0, 0.5], sigma=1.0, name="goal")
        graph.constrain(lambda a, b: fg.SE2.local(a, b)[:, :1], x[:-1], x[1:], upper=0.08, name="pace")


@pytest.mark.parametrize("solver", [InteriorPoint(), SQP()], ids=lambda own: own.name)
def test_a_limit_that_the_estimate_does_not_move_has_no_margin(solver: fg.Solver) -> None:
    terms: list[Term] = [Dynamics(unicycle.dynamics, STEP), Pace(), ControlCost(sigma=[3.0, 3.0])]
    spread = np.array([[0.01, 0.002, 0.0], [0.002, 0.02, 0.001], [0.0, 0.001, 0.005]])
    found = []
    for sigmas in (None, 3.0):
        loop = RecedingHorizon(Robot(fg.SE2, fg.Rn(2)), STEPS, terms, solver=solver, sigmas=sigmas)
        state = np.array([0.1, 0.2, 0.3])
        for _ in range(4):
            state = loop.plan(state, covariance=spread).states[1]
        found.append(nodes(loop))
    np.testing.assert_allclose(found[1], found[0], atol=1e-4)
