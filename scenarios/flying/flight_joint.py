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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import unifg as fg
from unifg.models import avoidance, quadrotor
from unifg.scenarios.flying.estimator import FIRST_LANDMARK, Estimator, flyable
from unifg.scenarios.flying.flight_parts import FlightNow, repel
from unifg.scenarios.flying.flight_settings import ControllerSettings
from unifg.scenarios.flying.flight_terms import Shared, StateTerms
from unifg.scenarios.flying.flight_window import PLACES
from unifg.scenarios.flying.slots import FAR_AWAY, Obstacles
from unifg.scenarios.flying.standardised import standardised
from unifg.scenarios.horizon.part import Given, Gives, Part
from unifg.scenarios.horizon.past import joined
from unifg.scenarios.seeing.belief import Belief
from unifg.typing import Array, BoolArray

STILL = np.zeros(6)  # process noise of the future
BELIEVABLE = 1e-4  # largest violation of an estimate; a plan may have more, but noise of the past is as small as that
LEAST_SIGMA = 1e-6  # of what the past knows for certain, so that it can be divided by


@dataclass(frozen=True)
class JointSettings:
    """How far the future may lean on the past.

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


class SharedFlight:
    """The past's terms in the graph of the horizon: first state, parameters and map are estimated in the same solve.

    Attributes:
        estimator: of the past alone; its window is the joint graph's past.
        joint: how far the future may lean on the past.
        latest: what the last joint solve says; what the past alone says where that solve was of no use.
    """

    def __init__(self, estimator: Estimator, settings: ControllerSettings, joint: JointSettings) -> None:
        """Take the past from its estimator.

        Args:
            estimator: of the past.
            settings: weights and limits of the future.
            joint: how far it may lean on the past.
        """
        self.estimator, self.joint, self._settings = estimator, joint, settings
        self.latest = estimator.belief()
        self.names = estimator.atlas.names.copy()

    # ---------------------------------------------------------------- what the graph says

    def state(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:
        """Add the past's terms on the first state, the bounds of the pull, and the dynamics of the future."""
        window = self.estimator.window
        self._x = x
        self.shared = shared = Shared(graph, window.settings, window.parameters)
        self._terms = terms = StateTerms(graph, x[0], shared, window.settings)
        least_drag = graph.data("least drag", np.zeros(3))
        if "drag" in window.settings.estimated:
            graph.bound(shared.drag, lower=least_drag, upper=np.inf, name="drag")
        pulled = [] if np.isinf(self.joint.pull) else self._bound_pull(graph, x)
        motion = (x[:-1], u, STILL, *shared.parameters, x[1:], self._settings.dt)
        graph.constrain(quadrotor.disturbed_dynamics, *motion, lower=0, upper=0, name="flight")

        def data(now: FlightNow) -> Given:
            drag = np.minimum(window.parameters[PLACES["drag"]], 0.0)
            found: Given = {**terms.data(window), least_drag: drag}
            for variable, place, spread in pulled:
                value, sigma = self._past_says(variable, now.belief)
                found[place], found[spread] = value, np.maximum(sigma, LEAST_SIGMA)
            return found

        return data

    def _bound_pull(self, graph: fg.Graph, x: fg.Family) -> list[tuple[fg.Family | fg.Selection, fg.Data, fg.Data]]:
        """Bound what is shared; the variables, and the data that say where the past puts them and how surely."""
        estimated, pull = self.estimator.window.settings.estimated, self.joint.pull
        bounded: list[tuple[str, fg.Family | fg.Selection]] = [("state", x[0]), ("landmarks", self.shared.landmarks)]
        bounded += [(f.name, f) for f in self.shared.parameters if f.name in estimated]
        pulled: list[tuple[fg.Family | fg.Selection, fg.Data, fg.Data]] = []
        for name, variable in bounded:
            manifold, count = variable.manifold, len(variable)
            place = graph.data(f"{name}, by the past", np.tile(manifold.identity(), (count, 1)), each=True)
            sigma = graph.data(f"sigma of {name}, by the past", np.ones((count, manifold.dim)), each=True)
            graph.constrain(
                standardised(manifold), variable, place, sigma, lower=-pull, upper=pull, name=f"pull of {name}"
            )
            pulled.append((variable, place, sigma))
        return pulled

    def _past_says(self, variable: fg.Family | fg.Selection, belief: Belief) -> tuple[Array, Array]:
        """Value and standard deviation of a variable by the past alone; those of an idle slot mean nothing."""
        estimator = self.estimator
        if variable is self.shared.landmarks:
            sigma = np.sqrt(np.diag(estimator.covariance)[FIRST_LANDMARK:]).reshape(-1, 2)
            return estimator.window.landmarks, sigma
        if isinstance(variable, fg.Family):
            place = PLACES[variable.name]
            return estimator.window.parameters[None, place], belief.parameters_sigma[None, place]
        return belief.state[None], belief.sigma[None]

    def apart(self, squares: bool | None) -> Sequence[Part[FlightNow]]:
        """Keep clear of the landmarks' variables; the slots keep what has left the window's map, and movers."""
        return (partial(self._keep_clear, squares),)

    def _keep_clear(self, squares: bool | None, graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:
        """Pair every node with every landmark: clearance, hard or as Ta's 1/d, and data that say which pairs count."""
        s, count = self._settings, len(self.shared.landmarks)
        node, mark = np.repeat(np.arange(s.horizon), count), np.tile(np.arange(count), s.horizon)
        radii = graph.data("radii of landmarks", np.zeros(len(node)), each=True)
        near = graph.data("landmarks to keep clear of", np.zeros(len(node), dtype=bool), each=True)
        least = graph.data("clearances of landmarks", np.zeros((len(node), 1)), each=True) if squares is None else None
        pairs, kept = (x.p[1:][node], self.shared.landmarks[mark], radii), avoidance.landmark_clearance
        if least is not None:
            graph.constrain(kept, *pairs, lower=least, active=near, name="landmarks")
        else:
            repel(graph, s, bool(squares), kept, *pairs, name="landmarks", active=near)

        def data(now: FlightNow) -> Given:
            hulls, limits = np.zeros((2, s.horizon, count))
            counting = np.zeros((s.horizon, count), dtype=bool)
            counting[:, now.marks] = True
            hulls[:, now.marks] = now.obstacles.radii[now.held] + (0.0 if least is not None else s.vehicle_radius)
            limits[:, now.marks] = now.obstacles.limits[:, now.held]
            found: Given = {radii: hulls.ravel(), near: counting.ravel()}
            return found if least is None else {**found, least: limits.reshape(-1, 1)}

        return data

    def split(self, obstacles: Obstacles) -> tuple[Obstacles, BoolArray, list[int]]:
        """Obstacles without those that are landmarks of the window; which (M,) these are, and the slots they hold."""
        atlas = self.estimator.atlas
        slots = [atlas.slot_of(name) if name >= 0 else -1 for name in obstacles.names.tolist()]
        held = np.array(slots) >= 0
        centres = np.where(held[:, None], FAR_AWAY, obstacles.centres)
        return replace(obstacles, centres=centres), held, [slot for slot in slots if slot >= 0]

    # ---------------------------------------------------------------- a tick

    def begin(self, guess: fg.Guess, now: FlightNow) -> fg.Guess:
        """The horizon's guess, begun at the estimate, and what the past alone says."""
        multipliers = self.kept_multipliers(guess, now) if guess.multipliers else guess.multipliers
        self.names = self.estimator.atlas.names.copy()
        past = self._terms.guess(self.estimator.window)
        return joined(fg.Guess(guess.values, multipliers), self._x, now.present, past)

    def kept_multipliers(self, guess: fg.Guess, now: FlightNow) -> dict[str, Array]:
        """Multipliers without those of what has changed its slot or its kind; those of the past are moved on."""
        multipliers = dict(guess.multipliers)
        same = self.estimator.atlas.names == self.names
        near = np.zeros(len(same), dtype=bool)
        near[now.marks] = True
        keep = {"cylinders": ~now.held, "landmarks": np.tile(near & same, self._settings.horizon)[:, None]}
        for name, kept in (*keep.items(), ("pull of landmarks", same[:, None])):
            if name in multipliers:
                multipliers[name] = np.where(kept, multipliers[name], 0.0)
        # The step that led to the present is the last one between past states now.
        past, last = multipliers["dynamics"], multipliers["dynamics now"]
        multipliers["dynamics"] = np.concatenate([past[1:], last])
        return multipliers

    def moving_with(self, solution: fg.Solution, now: FlightNow) -> quadrotor.Parameters:
        """The parameters that were estimated."""
        return flyable(self._parameters_of(solution))

    def take(self, solution: fg.Solution, now: FlightNow, source: str) -> None:
        """What the joint solve says, with the covariances of the past; nothing new unless it keeps its constraints."""
        self.latest = belief = now.belief
        if not solution.violation <= BELIEVABLE:  # nor if that is not a number
            return
        atlas = self.estimator.atlas
        marks = solution[self.shared.landmarks]
        positions = belief.landmarks.positions.copy()
        for row, name in enumerate(belief.landmarks.ids.tolist()):
            slot = atlas.slot_of(name)
            if slot >= 0:
                positions[row] = marks[slot]
        self.latest = replace(
            belief,
            state=solution[self._x][0].copy(),
            parameters=flyable(self._parameters_of(solution)),
            landmarks=replace(belief.landmarks, positions=positions),
        )

    def believed(self, given: Belief) -> Belief:
        """What the joint solve says."""
        return self.latest

    def _parameters_of(self, solution: fg.Solution) -> Array:
        return np.concatenate([solution[family][0] for family in self.shared.parameters])
