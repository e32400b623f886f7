"""How to fly there? The model-predictive controller of the quadrotor as a factor graph (Ta et al. 2014, V-B).

Costs: a reference through what is known, level attitude, effort about hover, change of control. Constraints: the
dynamics with the believed mass, drag and wind, limits of control and attitude, clearance from cylinders, moving discs
and walls. With ``avoidance="potential"`` the costs are Ta's own, |p - l_g|^2 and 1/d, and nothing is kept clear of.
"""

from __future__ import annotations

import time

import numpy as np

import unifg as fg
from unifg.kernels.residuals import Residual
from unifg.lie import SO3
from unifg.models import avoidance, landmarks, quadrotor
from unifg.scenarios.flying.braking import brake, stopping_height
from unifg.scenarios.flying.flyable import moves, room
from unifg.scenarios.flying.guide import Guide, Reference
from unifg.scenarios.flying.plan import ControllerSettings, Plan, Source, backend
from unifg.scenarios.flying.slots import FAR_AWAY, SPARE, Obstacles, Slots
from unifg.scenarios.seeing.belief import Belief
from unifg.scenarios.seeing.tracks import Tracks
from unifg.solvers import names
from unifg.typing import Array, ArrayLike

UP = np.array([0.0, 0.0, 1.0])
LEFT_BEHIND = 1.0  # [m] between the ends of plan and reference
PATIENCE = 10  # ticks of being left behind before the plan starts over from the reference
SLOWING = 0.3  # [s] in which a speed above the limit is to fade
KEPT = 8  # ticks for which an old plan may be flown

Given = dict[fg.Data, ArrayLike]


class Controller:
    """A compiled control graph that is warm-started with its shifted solution.

    A joint graph of past and future replaces :meth:`_anchor`, :meth:`_move` and :meth:`_keep_clear`, which state what
    belongs to the estimate, :meth:`_anchored`, :meth:`_moved` and :meth:`_kept_clear`, which give their data,
    :meth:`_solve`, which adds the guess of the past, and :meth:`_moving_with`.

    Attributes:
        settings: weights and limits.
        guide: what gives the reference.
        emergencies: how many ticks were flown by plans of each other source than "solved".
    """

    def __init__(
        self,
        target: Array,
        walls: Array,
        solver: str = "ipm",
        settings: ControllerSettings | None = None,
        bounds: Array | None = None,
    ) -> None:
        """State the graph and prepare the backend.

        Args:
            target: (3,) [m].
            walls: (W, 2, 2) segments on the ground plane [m].
            solver: one of `unifg.solvers.names.CONSTRAINED`.
            settings: weights and limits.
            bounds: (2, 2) least and greatest x, y of where a way may lead [m]; None for anywhere.

        Raises:
            ScenarioError: for an unknown avoidance.
            BackendError: for an unknown solver.
        """
        self.settings = s = settings or ControllerSettings()
        if s.avoidance not in ("clearance", "potential"):
            raise fg.ScenarioError(f"unknown avoidance '{s.avoidance}': choose clearance or potential")
        self.target, self.walls = np.asarray(target, dtype=np.float64), np.asarray(walls, dtype=np.float64)
        self.guide = Guide(self.target, self.walls, s.guide, bounds)
        self.emergencies: dict[Source, int] = {"violating": 0, "kept": 0, "braking": 0}
        self._slots = Slots(s, self.walls)
        self._squares = not s.general_costs or not names.entry(solver).made_by.scalar_costs
        self._least = np.array([*(-limit for limit in s.rate_limits), s.thrust_limits[0]])
        self._most = np.array([*s.rate_limits, s.thrust_limits[1]])
        graph = fg.Graph()
        self._x = x = graph.variables("state", quadrotor.STATE, s.horizon + 1)
        self._u = u = graph.variables("control", quadrotor.CONTROL, s.horizon)
        self._anchor(graph, x)
        self._move(graph, x, u)
        self._limit(graph, x, u)
        self._spend(graph, x, u)
        if s.avoidance == "potential":
            self._attract_and_repel(graph, x)
        else:
            self._follow(graph, x)
            self._keep_clear(graph, x)
        self._run = backend(solver, s).prepare(graph)
        self._cold = backend(solver, s, cold=True).prepare(graph)
        self._guess: fg.Guess | None = None
        self._stored: Array | None = None
        self._age = 0
        self._lagging = 0
        self._applied: Array | None = None

    # ---------------------------------------------------------------- a tick

    def plan(self, belief: Belief, movers: Tracks | None = None) -> Plan:
        """Decide the next controls; never raises for a hard problem.

        Args:
            belief: state, parameters and landmarks.
            movers: discs that move.
        """
        begin = time.perf_counter()
        s = self.settings
        reference = self.guide.reference(belief.state, belief.landmarks, s.horizon + 1, s.dt)
        obstacles = self._slots.fill(belief.state, reference.positions, belief.landmarks, movers or Tracks.none())
        data = {**self._anchored(belief), **self._moved(belief), **self._limited(belief), **self._spent(belief)}
        if s.avoidance == "potential":
            data |= self._attracted_and_repelled(belief, obstacles)
        else:
            data |= {**self._followed(reference), **self._kept_clear(obstacles)}
        solution = self._solve(belief, reference, obstacles, data)
        controls, states, source = self._judge(solution, belief, reference, obstacles)
        self._applied = controls[0]
        elapsed = 1e3 * (time.perf_counter() - begin)
        return Plan(controls, states, solution.status, elapsed, solution.iterations, source)

    def forget(self) -> None:
        """Drop the warm start and the stored plan."""
        self._guess = self._stored = self._applied = None
        self._lagging = 0

    def _solve(self, belief: Belief, reference: Reference, obstacles: Obstacles, data: Given) -> fg.Solution:
        """From the shifted solution; without one, along the reference."""
        if self._guess is None:
            return self._cold.solve(self._along(belief, reference), data=data)
        return self._run.solve(self._refreshed(self._guess, obstacles), data=data)

    def _along(self, belief: Belief, reference: Reference) -> fg.Guess:
        """Guess a level flight along the reference."""
        states = np.tile(belief.state, (self.settings.horizon + 1, 1))
        states[1:, :3], states[1:, 7:] = reference.positions[1:], reference.velocities[1:]
        states[1:, 3:7] = self._level(belief)
        controls = np.tile(quadrotor.hover(belief.parameters), (self.settings.horizon, 1))
        return fg.Guess({self._x: states, self._u: controls})

    def _refreshed(self, guess: fg.Guess, obstacles: Obstacles) -> fg.Guess:
        """Forget the multipliers of slots that hold something else now."""
        multipliers = dict(guess.multipliers)
        if "cylinders" in multipliers:
            multipliers["cylinders"] = np.where(obstacles.changed, 0.0, multipliers["cylinders"])
        return fg.Guess(guess.values, multipliers)

    # ---------------------------------------------------------------- the graph

    def _anchor(self, graph: fg.Graph, x: fg.Family) -> None:
        """Tie the horizon to the estimate: here it is given, and its first state fixed."""
        self._start = graph.data("start", quadrotor.STATE.identity())
        graph.fix(x[0], self._start)

    def _anchored(self, belief: Belief) -> Given:
        """Data of what :meth:`_anchor` stated."""
        return {self._start: belief.state}

    def _move(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> None:
        """The dynamics, with parameters that are given."""
        self._parameters = graph.data("parameters", quadrotor.Parameters().packed)
        graph.constrain(
            quadrotor.dynamics, x[:-1], u, x[1:], self._parameters, self.settings.dt, lower=0, upper=0, name="dynamics"
        )

    def _moved(self, belief: Belief) -> Given:
        """Data of what :meth:`_move` stated."""
        return {self._parameters: belief.parameters.packed}

    def _moving_with(self, solution: fg.Solution, belief: Belief) -> quadrotor.Parameters:
        """Parameters with which a solution moves."""
        return belief.parameters

    def _limit(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> None:
        """What the vehicle can do and where it may be."""
        s = self.settings
        graph.bound(u, lower=self._least, upper=self._most, name="control limits")
        free, lean = np.inf, s.lean_limit
        box = np.full((s.horizon, 3), free)
        box[:, 2] = 1.0
        self._low, self._high = (graph.data(name, sign * box, each=True) for name, sign in (("low", -1), ("high", 1)))
        graph.bound(x.p[1:], lower=self._low, upper=self._high, name="height limits")
        graph.constrain(
            landmarks.tilt, x.R[1:], np.zeros(3), lower=[-lean, -lean, -free], upper=[lean, lean, free], name="lean"
        )

    def _limited(self, belief: Belief) -> Given:
        """Data of what :meth:`_limit` stated: heights as far as a vehicle keeps them that stops climbing or sinking."""
        s = self.settings
        low, high = (np.full((s.horizon, 3), side * np.inf) for side in (-1.0, 1.0))
        stop = stopping_height(belief.state[2], belief.state[9], s.dt * np.arange(1.0, s.horizon + 1))
        low[:, 2] = np.minimum(s.height_limits[0], stop - SPARE)
        high[:, 2] = np.maximum(s.height_limits[1], stop + SPARE)
        return {self._low: low, self._high: high}

    def _spend(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> None:
        """Costs of attitude and control."""
        s = self.settings
        self._hover = graph.data("hover", np.zeros(4))
        self._last = graph.data("last control", np.zeros(4))
        self._upright = graph.data("upright", UP)
        graph.minimize(landmarks.tilt, x.R[1:], self._upright, sigma=self._weighted(s.level_sigma), name="level")
        graph.minimize(fg.prior, u, self._hover, sigma=self._weighted(s.control_sigma), name="effort")
        graph.minimize(fg.prior, u[0], self._last, sigma=self._weighted(s.rate_sigma), name="first change")
        graph.minimize(fg.difference, u[:-1], u[1:], sigma=self._weighted(s.rate_sigma), name="change")

    def _spent(self, belief: Belief) -> Given:
        """Data of what :meth:`_spend` stated."""
        hover = quadrotor.hover(belief.parameters)
        level = self._level(belief)
        return {
            self._hover: hover,
            self._last: hover if self._applied is None else self._applied,
            self._upright: SO3.act(SO3.inverse(level), UP),
        }

    def _level(self, belief: Belief) -> Array:
        """Attitude (4,) that hovers with the present heading."""
        nose = SO3.act(belief.state[3:7], np.array([1.0, 0.0, 0.0]))
        heading = SO3.exp(np.array([0.0, 0.0, np.arctan2(nose[1], nose[0])]))
        return SO3.compose(quadrotor.hover_attitude(belief.parameters), heading)

    def _follow(self, graph: fg.Graph, x: fg.Family) -> None:
        """Costs of leaving the reference."""
        s = self.settings
        n, last = s.horizon, np.sqrt(s.terminal_weight)
        self._positions = graph.data("reference positions", np.zeros((n - 1, 3)), each=True)
        self._velocities = graph.data("reference velocities", np.zeros((n - 1, 3)), each=True)
        self._end = graph.data("end of reference", np.zeros(3))
        self._leaving = graph.data("velocity at the end", np.zeros(3))
        position, velocity = self._weighted(s.position_sigma), self._weighted(s.velocity_sigma)
        graph.minimize(fg.prior, x.p[1:-1], self._positions, sigma=position, name="way")
        graph.minimize(fg.prior, x.v[1:-1], self._velocities, sigma=velocity, name="pace")
        graph.minimize(fg.prior, x.p[-1], self._end, sigma=position / last, name="end of way")
        graph.minimize(fg.prior, x.v[-1], self._leaving, sigma=velocity / last, name="final pace")

    def _followed(self, reference: Reference) -> Given:
        """Data of what :meth:`_follow` stated."""
        return {
            self._positions: reference.positions[1:-1],
            self._velocities: reference.velocities[1:-1],
            self._end: reference.positions[-1],
            self._leaving: reference.velocities[-1],
        }

    def _obstacles(self, graph: fg.Graph) -> None:
        """Data of the slots."""
        n, m = self.settings.horizon, self.settings.cylinders + self.settings.movers
        self._centres = graph.data("centres", np.full((n, m, 2), FAR_AWAY), each=True)
        self._radii = graph.data("radii", np.zeros(m))

    def _keep_clear(self, graph: fg.Graph, x: fg.Family) -> None:
        """Hard clearance from cylinders, moving discs and walls."""
        n, m = self.settings.horizon, self.settings.cylinders + self.settings.movers
        self._obstacles(graph)
        self._clearances = graph.data("clearances", np.zeros((n, m)), each=True)
        graph.constrain(
            avoidance.cylinder_clearance,
            x.p[1:],
            self._centres,
            self._radii,
            lower=self._clearances,
            name="cylinders",
        )
        if len(self.walls):
            self._wall_clearances = graph.data("wall clearances", np.zeros((n, len(self.walls))), each=True)
            graph.constrain(
                avoidance.segment_clearance,
                x.p[1:],
                self.walls,
                np.zeros(len(self.walls)),
                lower=self._wall_clearances,
                name="walls",
            )

    def _kept_clear(self, obstacles: Obstacles) -> Given:
        """Data of what :meth:`_keep_clear` stated."""
        walls: Given = {self._wall_clearances: obstacles.wall_limits} if len(self.walls) else {}
        return {
            self._centres: obstacles.centres,
            self._radii: obstacles.radii,
            self._clearances: obstacles.limits,
            **walls,
        }

    def _attract_and_repel(self, graph: fg.Graph, x: fg.Family) -> None:
        """Ta's costs |p - l_g|^2 and 1/d, with d between the hull and what stands or moves (section V-A).

        Far from its target a vehicle would race: its speed is limited.
        """
        s = self.settings
        n, speed, walls = s.horizon, s.guide.speed, self.walls
        self._obstacles(graph)
        graph.minimize(fg.prior, x.p[1:], self.target, sigma=self._weighted(s.goal_sigma), name="goal")
        self._speed = graph.data("speed", np.full((n, 3), speed), each=True)
        self._speed_back = graph.data("speed back", np.full((n, 3), -speed), each=True)
        graph.bound(x.v[1:], lower=self._speed_back, upper=self._speed, name="speed")
        weight = s.potential_weight * s.control_weight
        terms: list[tuple[str, Residual, tuple[fg.Data | Array, ...]]] = [
            ("cylinders", avoidance.cylinder_clearance, (self._centres, self._radii))
        ]
        if len(walls):
            hull = np.full(len(walls), s.vehicle_radius)
            terms.append(("walls", avoidance.segment_clearance, (walls, hull)))
        for name, clearance, arguments in terms:
            if self._squares:
                root = avoidance.inverse_distance_root(clearance)
                graph.minimize(root, x.p[1:], *arguments, sigma=1.0 / np.sqrt(weight), name=f"1/d, {name}")
            else:
                inverse = avoidance.inverse_distance(clearance, weight=weight)
                graph.minimize_scalar(inverse, x.p[1:], *arguments, name=f"1/d, {name}")

    def _attracted_and_repelled(self, belief: Belief, obstacles: Obstacles) -> Given:
        """Data of what :meth:`_attract_and_repel` stated."""
        s = self.settings
        times = s.dt * np.arange(1.0, s.horizon + 1)
        excess = np.maximum(np.abs(belief.state[7:10]) - s.guide.speed, 0.0) + SPARE
        allowed = s.guide.speed + excess * np.exp(-times / SLOWING)[:, None]
        return {
            self._centres: obstacles.centres,
            self._radii: obstacles.radii + s.vehicle_radius,
            self._speed: allowed,
            self._speed_back: -allowed,
        }

    def _weighted(self, sigma: ArrayLike) -> Array:
        scaled: Array = np.asarray(sigma) / np.sqrt(self.settings.control_weight)
        return scaled

    # ---------------------------------------------------------------- judgement

    def _judge(
        self, solution: fg.Solution, belief: Belief, reference: Reference, obstacles: Obstacles
    ) -> tuple[Array, Array, Source]:
        """Fly a plan that keeps the constraints; otherwise what keeps off best of all there is."""
        s = self.settings
        controls, states = solution[self._u], solution[self._x]
        sound = moves(controls, states, s.dt, self._moving_with(solution, belief), s.feasible)
        if sound and self._room(states, obstacles) >= -s.give:
            self._guess = None if self._left_behind(states, reference) else solution.shifted(self._x, self._u)
            self._stored, self._age = self._clipped(controls), 0
            return self._stored, states, "solved"
        choices: dict[Source, tuple[Array, Array]] = {}
        self._age += 1
        if self._stored is not None and self._age <= KEPT:
            rest = np.tile(quadrotor.hover(belief.parameters), (self._age, 1))
            kept = np.concatenate([self._stored[self._age :], rest])
            choices["kept"] = kept, quadrotor.rollout(belief.state, kept, s.dt, belief.parameters)
        choices["braking"] = brake(belief.state, belief.parameters, s.horizon, s.dt, self._least, self._most)
        if sound:
            choices["violating"] = self._clipped(controls), states
        # What is left of an old plan says nothing about the end of the horizon.
        rooms = {name: self._room(choice[1][: s.horizon + 1 - KEPT], obstacles) for name, choice in choices.items()}
        source = max(rooms, key=lambda name: min(rooms[name], -s.give))
        controls, states = choices[source]
        self.emergencies[source] += 1
        # Go on from what is flown: from the reference the solver would meet the same difficulty again.
        self._guess = fg.Guess({self._x: _next(states), self._u: _next(controls)})
        return controls, states, source

    def _room(self, states: Array, obstacles: Obstacles) -> float:
        """Least distance of states (k, 10) beyond what is to be kept clear [m]; Ta's potential demands nothing."""
        return 0.0 if self.settings.avoidance == "potential" else room(states, obstacles, self.walls)

    def _clipped(self, controls: Array) -> Array:
        return np.clip(controls, self._least, self._most)

    def _left_behind(self, states: Array, reference: Reference) -> bool:
        """Whether plans have ended far from the reference for so long that they must be caught behind something."""
        far = float(np.hypot(*(states[-1, :2] - reference.positions[-1, :2]))) > LEFT_BEHIND
        self._lagging = self._lagging + 1 if far else 0
        if self._lagging < PATIENCE:
            return False
        self._lagging = 0
        return True


def _next(stages: Array) -> Array:
    """The same one stage later, the last one repeated."""
    return np.concatenate([stages[1:], stages[-1:]])
