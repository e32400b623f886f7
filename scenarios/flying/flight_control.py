"""How to fly there? The model-predictive controller of the quadrotor as a factor graph (Ta et al. 2014, V-B).

Costs: a reference through what is known, level attitude, effort about hover, change of control. Constraints: the
dynamics with the believed mass, drag and wind, limits of control and attitude, clearance from cylinders, moving discs
and walls. With ``avoidance="potential"`` the costs are Ta's own, |p - l_g|^2 and 1/d, and nothing is kept clear of.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Literal, Protocol, TypeAlias

import numpy as np

import unifg as fg
from unifg.models import quadrotor
from unifg.scenarios.flying.braking import brake
from unifg.scenarios.flying.flight_parts import (
    FlightNow,
    GivenFlight,
    clearance,
    following,
    leaning,
    level,
    limits,
    potential,
)
from unifg.scenarios.flying.flight_settings import ControllerSettings, backend
from unifg.scenarios.flying.guide import Guide, Reference
from unifg.scenarios.flying.slots import Obstacles, Slots
from unifg.scenarios.horizon.loop import Loop, Plan
from unifg.scenarios.horizon.part import Part, effort, stated
from unifg.scenarios.horizon.past import Past
from unifg.scenarios.seeing.belief import Belief
from unifg.scenarios.seeing.tracks import Tracks
from unifg.solvers import names
from unifg.typing import Array, BoolArray

LEFT_BEHIND = 1.0  # [m] between the ends of plan and reference
PATIENCE = 10  # ticks of being left behind before the plan starts over from the reference
KEPT = 8  # ticks for which an old plan may be flown

Source: TypeAlias = Literal["solved", "violating", "kept", "braking"]


class FlightPast(Past[FlightNow], Protocol):
    """How a flight is tied to the past: state, parameters and map that are given, or estimated in the same graph."""

    def split(self, obstacles: Obstacles) -> tuple[Obstacles, BoolArray, list[int]]:
        """Obstacles without those that are variables; which (M,) these are, and the variables."""
        ...

    def apart(self, squares: bool | None) -> Sequence[Part[FlightNow]]:
        """Parts that keep clear of what is a variable: hard, or for Ta's potential as sums of squares or not."""
        ...

    def moving_with(self, solution: fg.Solution, now: FlightNow) -> quadrotor.Parameters:
        """Parameters with which a solution moves."""
        ...

    def believed(self, given: Belief) -> Belief:
        """What is believed after a solve for which a belief was given."""
        ...


class Controller:
    """Decides the next controls from a belief.

    Attributes:
        settings: weights and limits.
        past: what ties the horizon to what is known; without one all that is given.
        guide: what gives the reference.
        slots: what chooses the obstacles.
        data: what gives the data of the whole graph at a tick.
        loop: the prepared graph.
        emergencies: how many ticks were flown by plans of each other source than "solved".
    """

    def __init__(
        self,
        target: Array,
        walls: Array,
        solver: str = "ipm",
        settings: ControllerSettings | None = None,
        bounds: Array | None = None,
        past: FlightPast | None = None,
    ) -> None:
        """State the graph and prepare the backend.

        Args:
            target: (3,) [m].
            walls: (W, 2, 2) segments on the ground plane [m].
            solver: one of `unifg.solvers.names.CONSTRAINED`.
            settings: weights and limits.
            bounds: (2, 2) least and greatest x, y of where a way may lead [m]; None for anywhere.
            past: None for a graph of the future alone.

        Raises:
            ScenarioError: for an unknown avoidance.
            BackendError: for an unknown solver.
        """
        self.settings = s = settings or ControllerSettings()
        if s.avoidance not in ("clearance", "potential"):
            raise fg.ScenarioError(f"unknown avoidance '{s.avoidance}': choose clearance or potential")
        self.past: FlightPast = past or GivenFlight(s)
        self.walls = np.asarray(walls, dtype=np.float64)
        target = np.asarray(target, dtype=np.float64)
        self.guide = Guide(target, self.walls, s.guide, bounds)
        self.emergencies: dict[Source, int] = {"violating": 0, "kept": 0, "braking": 0}
        self.slots = Slots(s, self.walls)
        parts: list[Part[FlightNow]] = [
            self.past.state, limits(s), leaning(s), effort(s.weighted(s.control_sigma), s.weighted(s.rate_sigma))
        ]  # fmt: skip
        if s.avoidance == "potential":
            squares = not s.general_costs or not names.entry(solver).made_by.scalar_costs
            parts += [potential(s, self.walls, target, squares), *self.past.apart(squares)]
        else:
            parts += [following(s), clearance(s, self.walls), *self.past.apart(None)]
        graph = fg.Graph()
        x = graph.variables("state", quadrotor.STATE, s.horizon + 1)
        u = graph.variables("control", quadrotor.CONTROL, s.horizon)
        self.data = stated(parts, graph, x, u)
        self.loop = Loop(graph, x, u, backend(solver, s), backend(solver, s, cold=True), s.box, PATIENCE)
        self._applied: Array | None = None

    def plan(self, belief: Belief, movers: Tracks | None = None) -> Plan:
        """Decide the next controls; never raises for a hard problem.

        Args:
            belief: state, parameters and landmarks.
            movers: discs that move.
        """
        begin = time.perf_counter()
        now = self.now(belief, movers or Tracks.none())
        data = self.data(now)
        run, guess = self.loop.begin(lambda: self.along(now))
        if self.loop.guess is not None:
            guess = fg.Guess(guess.values, self.kept_multipliers(guess, now))
        solution = run.solve(self.past.begin(guess, now), data=data)
        controls, states, source = self.judge(solution, now)
        self._applied = controls[0]
        self.past.take(solution, now, source)
        elapsed = 1e3 * (time.perf_counter() - begin)
        return Plan(controls, states, solution.status, solution.iterations, source, self.loop.excess, elapsed)

    def now(self, belief: Belief, movers: Tracks) -> FlightNow:
        """What the graph's parts ask for."""
        s = self.settings
        reference = self.guide.reference(belief.state, belief.landmarks, s.horizon + 1, s.dt)
        obstacles = self.slots.fill(belief.state, reference.positions, belief.landmarks, movers)
        hover = quadrotor.hover(belief.parameters)
        last = hover if self._applied is None else self._applied
        return FlightNow(belief.state, hover, last, belief, reference, obstacles, *self.past.split(obstacles))

    def forget(self) -> None:
        """Drop the warm start and the stored plan."""
        self.loop.reset()
        self._applied = None

    def along(self, now: FlightNow) -> fg.Guess:
        """Guess a level flight along the reference."""
        belief, reference = now.belief, now.reference
        states = np.tile(belief.state, (self.settings.horizon + 1, 1))
        states[1:, :3], states[1:, 7:] = reference.positions[1:], reference.velocities[1:]
        states[1:, 3:7] = level(belief)
        return fg.Guess({self.loop.x: states, self.loop.u: np.tile(now.wanted, (self.settings.horizon, 1))})

    def kept_multipliers(self, guess: fg.Guess, now: FlightNow) -> dict[str, Array]:
        """Multipliers of a guess without those of slots that hold something else now."""
        multipliers = dict(guess.multipliers)
        if "cylinders" in multipliers:
            multipliers["cylinders"] = np.where(now.obstacles.changed, 0.0, multipliers["cylinders"])
        return multipliers

    def judge(self, solution: fg.Solution, now: FlightNow) -> tuple[Array, Array, Source]:
        """Fly a plan that keeps the constraints; otherwise what keeps off best of all there is."""
        s, loop, belief = self.settings, self.loop, now.belief
        controls, states = solution[loop.u], solution[loop.x]
        sound = moves(controls, states, s.dt, self.past.moving_with(solution, now), s.feasible)
        if sound and self._room(states, now.obstacles) >= -s.give:
            loop.accept(solution, behind=is_behind(states, now.reference))
            return loop.within(loop.stored), states, "solved"
        choices: dict[Source, tuple[Array, Array]] = {}
        age = loop.age + 1
        if age <= KEPT and age < s.horizon:
            rest = np.tile(now.wanted, (age, 1))
            kept = np.concatenate([loop.within(loop.stored[age:]), rest])
            choices["kept"] = kept, quadrotor.rollout(belief.state, kept, s.dt, belief.parameters)
        choices["braking"] = brake(belief.state, belief.parameters, s.horizon, s.dt, loop.least, loop.most)
        if sound:
            choices["violating"] = loop.within(controls), states
        # What is left of an old plan says nothing about the end of the horizon.
        rooms = {name: self._room(choice[1][: s.horizon + 1 - KEPT], now.obstacles) for name, choice in choices.items()}
        source = max(rooms, key=lambda name: min(rooms[name], -s.give))
        controls, states = choices[source]
        self.emergencies[source] += 1
        # Go on from what is flown: from the reference the solver would meet the same difficulty again.
        loop.refuse(fg.Guess({loop.x: _next(states), loop.u: _next(controls)}))
        return controls, states, source

    def _room(self, states: Array, obstacles: Obstacles) -> float:
        """Least distance of states (k, 10) beyond what is to be kept clear [m]; Ta's potential demands nothing."""
        return 0.0 if self.settings.avoidance == "potential" else obstacles.room(states, self.walls)


def moves(controls: Array, states: Array, dt: float, parameters: quadrotor.Parameters, tolerance: float) -> bool:
    """Whether states (N + 1, 10) follow from controls (N, 4), each row of the dynamics to a tolerance."""
    if not (np.isfinite(controls).all() and np.isfinite(states).all()):
        return False
    defects = quadrotor.dynamics(states[:-1], controls, states[1:], parameters.packed, dt)
    return bool(np.abs(defects).max() <= tolerance)


def is_behind(states: Array, reference: Reference) -> bool:
    """Whether a plan (N + 1, 10) ends far from its reference: it may be caught behind something."""
    return bool(np.hypot(*(states[-1, :2] - reference.positions[-1, :2])) > LEFT_BEHIND)


def _next(stages: Array) -> Array:
    """The same one stage later, the last one repeated."""
    return np.concatenate([stages[1:], stages[-1:]])
