"""Model-predictive controller of the quadrotor as a factor graph (Ta et al. 2014, V-B).

Costs: a reference through what is known, level attitude, effort about hover, change of control. Constraints: the
dynamics with the believed mass, drag and wind, limits of control and attitude, clearance from cylinders, moving discs
and walls. With ``avoidance="potential"`` the costs are Ta's own, |p - l_g|^2 and 1/d, and nothing is kept clear of.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

import unifg as fg
from unifg.horizon import (
    Context,
    ControlCost,
    Decision,
    InitialGuesses,
    LastPlan,
    Plan,
    RecedingHorizon,
)
from unifg.models import landmarks, quadrotor
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.reference_cost import ReferenceCost
from unifg.scenarios.quadrotor.braking import brake
from unifg.scenarios.quadrotor.flight_joint import believable
from unifg.scenarios.quadrotor.flight_parts import (
    Clearance,
    FlightInput,
    GivenFlight,
    Limits,
    Potential,
    following,
    level,
    upright,
)
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings, backend
from unifg.scenarios.quadrotor.guide import Guide, Reference
from unifg.scenarios.quadrotor.slots import SlotObstacles, Slots
from unifg.typing import Array

LEFT_BEHIND = 1.0  # [m] between the ends of plan and reference
PATIENCE = 10  # ticks of being left behind before the plan starts over from the reference
KEPT = 8  # ticks for which an old plan may be flown

Source: TypeAlias = Literal["solved", "violating", "kept", "braking"]


class Controller:
    """Decides the next controls from a belief.

    Attributes:
        settings: weights and limits.
        past: what ties the horizon to what is known; without one all that is given.
        guide: what gives the reference.
        slots: what chooses the obstacles.
        loop: the prepared graph.
        belief: after the last plan.
    """

    def __init__(
        self,
        target: Array,
        walls: Array,
        solver: str = "ipm",
        settings: ControllerSettings | None = None,
        bounds: Array | None = None,
        past: GivenFlight | None = None,
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
            BackendError: for an unknown solver.
        """
        self.settings = s = settings or ControllerSettings()
        self.past: GivenFlight = past or GivenFlight(s)
        self.walls = np.asarray(walls, dtype=np.float64)
        target = np.asarray(target, dtype=np.float64)
        self.guide = Guide(target, self.walls, s.guide, bounds)
        self.slots = Slots(s, self.walls)
        effort = ControlCost(s.weighted(s.control_sigma), s.weighted(s.rate_sigma), wanted=lambda now: now.given.hover)
        lean = ReferenceCost("level", s.weighted(s.level_sigma), upright, "R", residual=landmarks.tilt, size=3)
        terms = [*self.past.motion(), Limits(s), lean, effort]
        if s.avoidance == "potential":
            terms += [Potential(s, self.walls, target), *self.past.apart()]
        else:
            terms += [*following(s), Clearance(s, self.walls), *self.past.apart()]
        window = self.past.window
        self.loop = RecedingHorizon(
            self.past.robot, s.horizon, terms, solver=backend(solver, s), cold=backend(solver, s, cold=True),
            window=window, coupling="sequential" if window is None else "joint", pull=self.past.pull, limits=s.box,
            judge=self.judge, starts=InitialGuesses(self.along, carry=self.carry), believable=believable,
            patience=PATIENCE,
        )  # fmt: skip
        self._flying = False

    def plan(self, belief: Belief, movers: Tracks | None = None) -> Plan:
        """Decide the next controls; never raises for a hard problem.

        Args:
            belief: state, parameters and landmarks.
            movers: discs that move.
        """
        given = self.given(belief, movers or Tracks.none())
        if not self._flying:
            self.loop.applied, self._flying = given.hover, True
        plan = self.loop.plan(belief.state, given)
        self.belief = self.past.believed(belief, self.loop)
        return plan

    def given(self, belief: Belief, movers: Tracks) -> FlightInput:
        """Context of the terms."""
        s = self.settings
        reference = self.guide.reference(belief.state, belief.landmarks, s.horizon + 1, s.dt)
        obstacles = self.slots.fill(belief.state, reference.positions, belief.landmarks, movers)
        hover = quadrotor.hover(belief.parameters)
        return FlightInput(belief, hover, reference, obstacles, *self.past.split(obstacles))

    def forget(self) -> None:
        """Drop the warm start and the stored plan."""
        self.loop.abandon()
        self._flying = False

    def along(self, now: Context[FlightInput]) -> tuple[Array, Array]:
        """Guess a level flight along the reference."""
        belief, reference = now.given.belief, now.given.reference
        states = np.tile(belief.state, (self.settings.horizon + 1, 1))
        states[1:, :3], states[1:, 7:] = reference.positions[1:], reference.velocities[1:]
        states[1:, 3:7] = level(belief)
        return states, np.tile(now.given.hover, (self.settings.horizon, 1))

    def carry(self, guess: fg.Guess, now: Context[FlightInput]) -> fg.Guess:
        """A guess without multipliers of slots that hold something else now."""
        multipliers = dict(guess.multipliers)
        if "cylinders" in multipliers:
            multipliers["cylinders"] = np.where(now.given.obstacles.changed, 0.0, multipliers["cylinders"])
        return fg.Guess(guess.values, self.past.carry(multipliers, now) if multipliers else multipliers)

    def judge(
        self, solution: fg.Solution, states: Array, controls: Array, now: Context[FlightInput], kept: LastPlan
    ) -> Decision:
        """Fly a plan that keeps the constraints; otherwise what keeps off best of all there is."""
        s, given, belief = self.settings, now.given, now.given.belief
        sound = moves(controls, states, s.dt, self.past.moving_with(solution, now), s.feasible)
        if sound and self._room(states, given.obstacles) >= -s.give:
            return Decision(kept.within(controls), states, "solved", behind=is_behind(states, given.reference))
        choices: dict[Source, tuple[Array, Array]] = {}
        if kept.age <= KEPT and kept.age < s.horizon:
            left = kept.within(kept.left())
            old = np.concatenate([left, np.tile(given.hover, (s.horizon - len(left), 1))])
            choices["kept"] = old, quadrotor.rollout(belief.state, old, s.dt, belief.parameters)
        choices["braking"] = brake(belief.state, belief.parameters, s.horizon, s.dt, kept.least, kept.most)
        if sound:
            choices["violating"] = kept.within(controls), states
        # What is left of an old plan says nothing about the end of the horizon.
        rooms = {
            name: self._room(choice[1][: s.horizon + 1 - KEPT], given.obstacles) for name, choice in choices.items()
        }
        source = max(rooms, key=lambda name: min(rooms[name], -s.give))
        controls, states = choices[source]
        # Go on from what is flown: from the reference the solver would meet the same difficulty again.
        return Decision(controls, states, source, after=(_next(states), _next(controls)))

    def _room(self, states: Array, obstacles: SlotObstacles) -> float:
        """Least distance of states (k, 10) beyond what is to be kept clear [m]; Ta's potential demands nothing."""
        return 0.0 if self.settings.avoidance == "potential" else obstacles.room(states, self.walls)


def moves(controls: Array, states: Array, dt: float, parameters: quadrotor.Parameters, tolerance: float) -> bool:
    """Return True if states (N + 1, 10) follow from controls (N, 4), each row of the dynamics to a tolerance."""
    if not (np.isfinite(controls).all() and np.isfinite(states).all()):
        return False
    defects = quadrotor.dynamics(states[:-1], controls, states[1:], parameters.packed, dt)
    return bool(np.abs(defects).max() <= tolerance)


def is_behind(states: Array, reference: Reference) -> bool:
    """Return True for a plan (N + 1, 10) that ends far from its reference: it may be caught behind something."""
    return bool(np.hypot(*(states[-1, :2] - reference.positions[-1, :2])) > LEFT_BEHIND)


def _next(stages: Array) -> Array:
    """The same one stage later, the last one repeated."""
    return np.concatenate([stages[1:], stages[-1:]])
