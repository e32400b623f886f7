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

import numpy as np

import unifg as fg
from unifg.models import avoidance, quadrotor
from unifg.scenarios.flying.controller import Controller, Given
from unifg.scenarios.flying.estimator import FIRST_LANDMARK, Estimator, flyable
from unifg.scenarios.flying.guide import Reference
from unifg.scenarios.flying.plan import ControllerSettings
from unifg.scenarios.flying.slots import FAR_AWAY, Obstacles
from unifg.scenarios.flying.standardised import standardised
from unifg.scenarios.flying.window import PLACES
from unifg.scenarios.flying.window_terms import Shared, WindowTerms
from unifg.scenarios.seeing.belief import Belief
from unifg.scenarios.worlds.layouts import Layout
from unifg.typing import Array, ArrayLike, BoolArray

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


class JointController(Controller):
    """A controller whose first state, parameters and map are estimated in the same solve.

    Attributes:
        estimator: of the past alone; its window is the joint graph's past.
        joint: how far the future may lean on the past.
        alone: what the past alone says of the last tick.
        believed: what the last joint solve says; as ``alone`` where that solve was of no use.
    """

    def __init__(
        self, estimator: Estimator, layout: Layout, solver: str, settings: ControllerSettings, joint: JointSettings
    ) -> None:
        """State the joint graph.

        Args:
            estimator: of the past.
            layout: of which target and walls are known.
            solver: one of `unifg.solvers.names.CONSTRAINED`.
            settings: weights and limits of the future.
            joint: how far it may lean on the past.
        """
        self.estimator, self.joint = estimator, joint
        self.alone = self.believed = estimator.belief()
        self._names = estimator.atlas.names.copy()
        if solver == "alm":  # what its stop rule leaves is more than the past leaves open
            settings = replace(settings, tolerance=min(settings.tolerance, BELIEVABLE), step_tolerance=0.0)
        super().__init__(layout.target, layout.walls, solver, settings, layout.size)

    # ---------------------------------------------------------------- the past

    def _anchor(self, graph: fg.Graph, x: fg.Family) -> None:
        window = self.estimator.window
        self._shared = Shared(graph, window.settings, window.parameters)
        self._terms = WindowTerms(graph, x[0], self._shared, window.settings)
        self._least_drag = graph.data("least drag", np.zeros(3))
        if "drag" in window.settings.estimated:
            graph.bound(self._shared.drag, lower=self._least_drag, upper=np.inf, name="drag")
        self._pulled: list[tuple[fg.Family | fg.Selection, fg.Data, fg.Data]] = []
        if np.isinf(self.joint.pull):
            return
        shared: list[tuple[str, fg.Family | fg.Selection]] = [("state", x[0]), ("landmarks", self._shared.landmarks)]
        shared += [(f.name, f) for f in self._shared.parameters if f.name in window.settings.estimated]
        for name, variable in shared:
            manifold, count = variable.manifold, len(variable)
            place = graph.data(f"{name}, by the past", np.tile(manifold.identity(), (count, 1)), each=True)
            sigma = graph.data(f"sigma of {name}, by the past", np.ones((count, manifold.dim)), each=True)
            pull = self.joint.pull
            graph.constrain(
                standardised(manifold), variable, place, sigma, lower=-pull, upper=pull, name=f"pull of {name}"
            )
            self._pulled.append((variable, place, sigma))

    def _anchored(self, belief: Belief) -> Given:
        data: Given = dict(self._terms.data(self.estimator.window))
        data[self._least_drag] = np.minimum(self.estimator.window.parameters[PLACES["drag"]], 0.0)
        for variable, place, spread in self._pulled:
            value, sigma = self._past_says(variable, belief)
            data[place], data[spread] = value, np.maximum(sigma, LEAST_SIGMA)
        return data

    def _past_says(self, variable: fg.Family | fg.Selection, belief: Belief) -> tuple[Array, Array]:
        """Value and standard deviation of a variable by the past alone; those of an idle slot mean nothing."""
        estimator = self.estimator
        if variable is self._shared.landmarks:
            sigma = np.sqrt(np.diag(estimator.covariance)[FIRST_LANDMARK:]).reshape(-1, 2)
            return estimator.window.landmarks, sigma
        if isinstance(variable, fg.Family):
            place = PLACES[variable.name]
            return estimator.window.parameters[None, place], belief.parameters_sigma[None, place]
        return belief.state[None], belief.sigma[None]

    # ---------------------------------------------------------------- the future

    def _move(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> None:
        graph.constrain(
            quadrotor.disturbed_dynamics,
            x[:-1],
            u,
            STILL,
            *self._shared.parameters,
            x[1:],
            self.settings.dt,
            lower=0,
            upper=0,
            name="flight",
        )

    def _moved(self, belief: Belief) -> Given:
        return {}

    def _moving_with(self, solution: fg.Solution, belief: Belief) -> quadrotor.Parameters:
        return flyable(self._parameters_of(solution))

    def _pairs(self, graph: fg.Graph, x: fg.Family) -> tuple[fg.Selection, fg.Selection]:
        """Nodes and landmarks, every node with every slot, and the data that say which of them count."""
        n, count = self.settings.horizon, len(self._shared.landmarks)
        node, mark = np.repeat(np.arange(n), count), np.tile(np.arange(count), n)
        self._mark_radii = graph.data("radii of landmarks", np.zeros(n * count), each=True)
        self._near = graph.data("landmarks to keep clear of", np.zeros(n * count, dtype=bool), each=True)
        return x.p[1:][node], self._shared.landmarks[mark]

    def _keep_clear(self, graph: fg.Graph, x: fg.Family) -> None:
        """Clearance from the landmarks' variables; the slots keep what has left the window's map, and movers."""
        super()._keep_clear(graph, x)
        positions, marks = self._pairs(graph, x)
        self._mark_limits = graph.data("clearances of landmarks", np.zeros((len(positions), 1)), each=True)
        graph.constrain(
            avoidance.landmark_clearance,
            positions,
            marks,
            self._mark_radii,
            lower=self._mark_limits,
            active=self._near,
            name="landmarks",
        )

    def _kept_clear(self, obstacles: Obstacles) -> Given:
        others, held, slots = self._split(obstacles)
        limits = np.zeros((self.settings.horizon, len(self._shared.landmarks)))
        limits[:, slots] = obstacles.limits[:, held]
        return {
            **super()._kept_clear(others),
            **self._paired(obstacles.radii[held], slots),
            self._mark_limits: limits.reshape(-1, 1),
        }

    def _attract_and_repel(self, graph: fg.Graph, x: fg.Family) -> None:
        """Ta's costs, with 1/d from the landmarks' variables."""
        super()._attract_and_repel(graph, x)
        weight = self.settings.potential_weight * self.settings.control_weight
        clearance, name = avoidance.landmark_clearance, "1/d, landmarks"
        pairs = (*self._pairs(graph, x), self._mark_radii)
        if self._squares:
            root = avoidance.inverse_distance_root(clearance)
            graph.minimize(root, *pairs, sigma=1.0 / np.sqrt(weight), active=self._near, name=name)
        else:
            inverse = avoidance.inverse_distance(clearance, weight=weight)
            graph.minimize_scalar(inverse, *pairs, active=self._near, name=name)

    def _attracted_and_repelled(self, belief: Belief, obstacles: Obstacles) -> Given:
        others, held, slots = self._split(obstacles)
        radii = obstacles.radii[held] + self.settings.vehicle_radius
        return {**super()._attracted_and_repelled(belief, others), **self._paired(radii, slots)}

    def _split(self, obstacles: Obstacles) -> tuple[Obstacles, BoolArray, list[int]]:
        """Obstacles without those that are landmarks of the window; which (M,) these are, and the slots they hold."""
        atlas = self.estimator.atlas
        slots = [atlas.slot_of(name) if name >= 0 else -1 for name in obstacles.names.tolist()]
        held = np.array(slots) >= 0
        centres = np.where(held[:, None], FAR_AWAY, obstacles.centres)
        return replace(obstacles, centres=centres), held, [slot for slot in slots if slot >= 0]

    def _paired(self, radii: Array, slots: list[int]) -> Given:
        """Data of the pairs, for landmarks of some radii in some slots."""
        n, count = self.settings.horizon, len(self._shared.landmarks)
        all_radii, near = np.zeros((n, count)), np.zeros((n, count), dtype=bool)
        all_radii[:, slots], near[:, slots] = radii, True
        return {self._mark_radii: all_radii.ravel(), self._near: near.ravel()}

    # ---------------------------------------------------------------- a tick

    def _solve(
        self, belief: Belief, reference: Reference, obstacles: Obstacles, data: Mapping[fg.Data, ArrayLike]
    ) -> fg.Solution:
        """Past and future, from what the past alone says and the shifted plan."""
        run = self._cold if self._guess is None else self._run
        ahead = self._along(belief, reference) if self._guess is None else self._refreshed(self._guess, obstacles)
        self._names = self.estimator.atlas.names.copy()
        values = {**ahead.values, **self._terms.guess(self.estimator.window)}
        values[self._x] = np.concatenate([belief.state[None], np.asarray(ahead.values[self._x])[1:]])
        solution = run.solve(fg.Guess(values, ahead.multipliers), data=data)
        self._believe(solution, belief)
        return solution

    def _refreshed(self, guess: fg.Guess, obstacles: Obstacles) -> fg.Guess:
        """Forget the multipliers of what has changed its slot or its kind, and move on those of the past."""
        multipliers = dict(super()._refreshed(guess, obstacles).multipliers)
        if not multipliers:
            return guess
        _, held, slots = self._split(obstacles)
        same = self.estimator.atlas.names == self._names
        near = np.zeros(len(same), dtype=bool)
        near[slots] = True
        keep = {"cylinders": ~held, "landmarks": np.tile(near & same, self.settings.horizon)[:, None]}
        for name, kept in (*keep.items(), ("pull of landmarks", same[:, None])):
            if name in multipliers:
                multipliers[name] = np.where(kept, multipliers[name], 0.0)
        # The step that led to the present is the last one between past states now.
        past, last = multipliers["dynamics"], multipliers["dynamics now"]
        multipliers["dynamics"] = np.concatenate([past[1:], last])
        return fg.Guess(guess.values, multipliers)

    def _believe(self, solution: fg.Solution, belief: Belief) -> None:
        """What the joint solve says, with the covariances of the past; nothing new unless it keeps its constraints."""
        self.alone = self.believed = belief
        if not solution.violation <= BELIEVABLE:  # nor if that is not a number
            return
        atlas = self.estimator.atlas
        marks = solution[self._shared.landmarks]
        positions = belief.landmarks.positions.copy()
        for row, name in enumerate(belief.landmarks.ids.tolist()):
            slot = atlas.slot_of(name)
            if slot >= 0:
                positions[row] = marks[slot]
        self.believed = replace(
            belief,
            state=solution[self._x][0].copy(),
            parameters=flyable(self._parameters_of(solution)),
            landmarks=replace(belief.landmarks, positions=positions),
        )

    def _parameters_of(self, solution: fg.Solution) -> Array:
        return np.concatenate([solution[family][0] for family in self._shared.parameters])
