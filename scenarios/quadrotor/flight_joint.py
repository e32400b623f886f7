"""One graph that estimates and flies: the window of the past and the horizon share the present, parameters and map.

Ta et al. 2014, Fig. 1, in one solve. The rules, which make this more than gluing two graphs together:

- only terms of the past are marginalised when a state leaves the window;
- a control that has been applied becomes data: its cost and its limits leave with it;
- limits of states begin one step after the present;
- ``control_weight`` scales the costs of the future, which pull on the estimate;
- ``pull`` bounds how far, in standard deviations, from what the past alone says; whatever that is, no wish makes drag
  negative;
- what the window carries on is what the past alone says, so that a bias is not repeated;
- covariances count the past's terms alone;
- what a solve says that has not met its constraints closely is not believed: a dynamics that gives by a millimetre
  says as little about the past as one that is not there;
- a plan is judged by the map of the past alone: cylinders that the plan has pushed aside are where they were.

Which obstacles count, where they are guessed and how wide their margins are is decided before the solve, by the past
alone. What has left the window's map and what moves are data, as in the controller by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Context, RecedingHorizon, Term
from unifg.models import avoidance, quadrotor
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.quadrotor.estimator import Estimator, flyable
from unifg.scenarios.quadrotor.flight_parts import FlightInput, GivenFlight, repel
from unifg.scenarios.quadrotor.flight_past import packed, parameters_in
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.quadrotor.slots import FAR_AWAY, SlotObstacles
from unifg.typing import Array, ArrayLike, BoolArray

STILL = np.zeros(6)  # process noise of the future
BELIEVABLE = 1e-4  # largest violation of an estimate; a plan may have more, but noise of the past is as small as that


@dataclass(frozen=True)
class JointSettings:
    """Bounds on the pull of the future on the past.

    Attributes:
        pull: how far the plan may move state, parameters and landmarks, in standard deviations of what the past
            alone says, each coordinate by itself; infinity for no bound.

    Raises:
        ScenarioError: if the pull is not positive; without any the coupling is the sequential one.
    """

    pull: float = 0.5

    def __post_init__(self) -> None:
        """Refuse a bound that leaves nothing to estimate."""
        if not self.pull > 0.0:
            raise fg.ScenarioError(
                f"the pull must be positive, got {self.pull} standard deviations: "
                "without any, the coupling is 'sequential'"
            )


@dataclass(frozen=True)
class SharedMotion:
    """The dynamics with parameters that are estimated in the same graph; no wish makes drag negative."""

    settings: ControllerSettings
    drag: bool

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the dynamics, and bound the drag if it is estimated."""
        if self.drag:
            least = graph.data("least drag", np.zeros(3))
            graph.bound(graph.families["drag"], lower=least, upper=np.inf, name="drag")
        motion = (x[:-1], u, STILL, *parameters_in(graph), x[1:], self.settings.dt)
        graph.constrain(quadrotor.disturbed_dynamics, *motion, lower=0, upper=0, name="flight")

    def data(self, now: Context[FlightInput]) -> Mapping[str, ArrayLike]:
        """Drag that the past puts below zero may stay there."""
        return {"least drag": np.minimum(now.constants["drag"][0], 0.0)} if self.drag else {}


@dataclass(frozen=True)
class KeepClear:
    """Every node and every landmark of the window: clearance, hard or as Ta's 1/d, and data that say which pairs count.

    Attributes:
        settings: weights and limits.
    """

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Pair them."""
        s, marks = self.settings, graph.families["landmarks"]
        node, mark = np.repeat(np.arange(s.horizon), len(marks)), np.tile(np.arange(len(marks)), s.horizon)
        radii = graph.data("radii of landmarks", np.zeros(len(node)), each=True)
        near = graph.data("landmarks to keep clear of", np.zeros(len(node), dtype=bool), each=True)
        pairs, kept = (x.p[1:][node], marks[mark], radii), avoidance.landmark_clearance
        if s.avoidance == "clearance":
            least = graph.data("clearances of landmarks", np.zeros((len(node), 1)), each=True)
            graph.constrain(kept, *pairs, lower=least, active=near, name="landmarks")
        else:
            repel(graph, s, kept, *pairs, name="landmarks", active=near)

    def data(self, now: Context[FlightInput]) -> Mapping[str, ArrayLike]:
        """Flags of the landmarks that are obstacles now, their radii, and the clearances to keep."""
        s, given, count = self.settings, now.given, len(now.constants["landmarks"])
        hard = s.avoidance == "clearance"
        hulls, limits = np.zeros((2, s.horizon, count))
        counting = np.zeros((s.horizon, count), dtype=bool)
        counting[:, given.marks] = True
        hulls[:, given.marks] = given.obstacles.radii[given.held] + (0.0 if hard else s.vehicle_radius)
        limits[:, given.marks] = given.obstacles.limits[:, given.held]
        values = {"radii of landmarks": hulls.ravel(), "landmarks to keep clear of": counting.ravel()}
        return values | ({"clearances of landmarks": limits.reshape(-1, 1)} if hard else {})


class SharedFlight(GivenFlight):
    """A flight whose first state, parameters and map are estimated in the same solve.

    Attributes:
        estimator: of the past alone; its window is the joint graph's past.
        robot: who flies.
        window: of the past.
        pull: how far the future may lean on the past.
        names: of what the window's slots held at the last solve.
    """

    def __init__(self, estimator: Estimator, settings: ControllerSettings, joint: JointSettings) -> None:
        """Take the past from its estimator.

        Args:
            estimator: of the past.
            settings: weights and limits of the future.
            joint: how far it may lean on the past.
        """
        super().__init__(settings, estimator.window.robot, estimator.window, joint.pull)
        self.estimator = estimator
        self.names = estimator.atlas.names.copy()

    def motion(self) -> list[Term]:
        """Terms of the motion."""
        return [SharedMotion(self.settings, "drag" in self.estimator.own.estimated)]

    def apart(self) -> list[Term]:
        """Keep clear of the landmarks' variables; the slots keep what has left the window's map, and movers."""
        return [KeepClear(self.settings)]

    def split(self, obstacles: SlotObstacles) -> tuple[SlotObstacles, BoolArray, list[int]]:
        """Obstacles without those that are landmarks of the window; which (M,) these are, and the slots they hold."""
        atlas = self.estimator.atlas
        slots = [atlas.slot_of(name) if name >= 0 else -1 for name in obstacles.names.tolist()]
        held = np.array(slots) >= 0
        centres = np.where(held[:, None], FAR_AWAY, obstacles.centres)
        return replace(obstacles, centres=centres), held, [slot for slot in slots if slot >= 0]

    def carry(self, multipliers: dict[str, Array], now: Context[FlightInput]) -> dict[str, Array]:
        """Multipliers without those of what has changed its slot or its kind."""
        multipliers = dict(multipliers)
        same = self.estimator.atlas.names == self.names
        near = np.zeros(len(same), dtype=bool)
        near[now.given.marks] = True
        keep = {"cylinders": ~now.given.held, "landmarks": np.tile(near & same, self.settings.horizon)[:, None]}
        for name, kept in (*keep.items(), ("pull of landmarks", same[:, None])):
            if name in multipliers:
                multipliers[name] = np.where(kept, multipliers[name], 0.0)
        return multipliers

    def moving_with(self, solution: fg.Solution, now: Context[FlightInput]) -> quadrotor.Parameters:
        """The parameters that were estimated."""
        families = {family.name: family for family in solution.values}
        return flyable(packed({static.name: solution[families[static.name]] for static in self.robot.constants}))

    def believed(self, given: Belief, loop: RecedingHorizon) -> Belief:
        """Belief by the joint solve, with the covariances of the past; the given one where it says nothing."""
        atlas = self.estimator.atlas
        self.names = atlas.names.copy()
        if not loop.believed:
            return given
        positions = given.landmarks.positions.copy()
        for row, name in enumerate(given.landmarks.ids.tolist()):
            slot = atlas.slot_of(name)
            if slot >= 0:
                positions[row] = loop.constants["landmarks"][slot]
        return replace(
            given,
            state=loop.estimate.copy(),
            parameters=flyable(packed(loop.constants)),
            landmarks=replace(given.landmarks, positions=positions),
        )


def believable(solution: fg.Solution, choice: object) -> bool:
    """Return True for a solve that says something about the past, whatever came of its plan."""
    return solution.violation <= BELIEVABLE
