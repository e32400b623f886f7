"""Where to go? A model-predictive controller as a factor graph (Bazzana et al. 2022, section V).

Costs: distance to reference poses along the path (eq. 8), control effort, control rate, soft margins to walls and
discs. Constraints: unicycle dynamics, velocity limits, hard clearance from walls and from tracked discs.
"""

from __future__ import annotations

import numpy as np

import unifg as fg
from unifg.horizon import Choice, ControlCost, Dynamics, Kept, Loop, Now, Plan, Starts, Term, Window
from unifg.lie import wrap_angle
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.scenarios.driving.drive_parts import Clearance, Drive, Following, Limits
from unifg.scenarios.driving.drive_past import robot
from unifg.scenarios.driving.drive_settings import ControllerSettings, backend
from unifg.scenarios.seeing.tracks import Tracks
from unifg.typing import Array

COLD_PATIENCE = 3  # a tick without a warm start may iterate longer
YIELD_SPEED = 0.05  # [m/s] towards the robot
LEFT_BEHIND = 0.6  # [m] between the ends of plan and reference
BRAKING = 6  # ticks to come to rest when no new plan is found
PURSUIT = 0.3  # [m] ahead of the robot, where a guess aims at the reference
PURSUIT_TIME = 0.2  # [s] in which it would turn there
ARRIVED = 0.05  # [m] to the end of the reference, where it only turns
SETTLED = (fg.Status.CONVERGED, fg.Status.STOP_RULE)
PATIENCE = 5  # ticks of being left behind before the plan starts over from the reference


class Controller:
    """Decides the next control from a pose, a reference and tracks.

    Attributes:
        settings: weights and limits.
        loop: the prepared graph.
    """

    def __init__(
        self, distance_map: DistanceMap, solver: str, settings: ControllerSettings, window: Window | None = None
    ) -> None:
        """State the graph and prepare the backend; with a window, past and future are one graph."""
        self.settings = s = settings
        terms: list[Term] = [
            Following(s),
            ControlCost(s.weighted(s.control_sigma), s.weighted(s.rate_sigma), wanted=lambda now: now.given.wanted),
            Dynamics(unicycle.dynamics, s.dt),
            Limits(s),
            Clearance(s, SmoothField(distance_map)),
        ]
        self.loop = Loop(
            robot(s.dt) if window is None else window.robot, s.horizon, terms, solver=backend(solver, s),
            cold=backend(solver, s, COLD_PATIENCE), window=window, coupling="sequential" if window is None else "joint",
            pull=s.pull, limits=s.box, judge=self.judge, starts=Starts(self.along, self.staying), believable=settled,
            patience=PATIENCE,
        )  # fmt: skip

    def plan(self, pose: Array, reference: Array, tracks: Tracks) -> Plan:
        """Decide the next control.

        Args:
            pose: (3,) estimate by the past alone [m, m, rad].
            reference: (N + 1, 3) poses along the path, the first beside the robot.
            tracks: discs the robot has seen.
        """
        return self.loop.plan(pose, self.given(reference, tracks))

    def given(self, reference: Array, tracks: Tracks) -> Drive:
        """What the terms are given."""
        cruise = np.zeros((self.settings.horizon, 2))
        cruise[:, 0] = np.hypot(*np.diff(reference[:, :2], axis=0).T) / self.settings.dt
        return Drive(cruise, reference, tracks)

    def forget(self) -> None:
        """Drop the warm start, as when a new route makes it misleading."""
        self.loop.forget()

    def judge(self, solution: fg.Solution, states: Array, controls: Array, now: Now[Drive], kept: Kept) -> Choice:
        """Drive a plan that keeps the constraints; brake along the last one otherwise; rest where a mover nears.

        Of a solve that ended early this is where it stopped. The cheapest iterate it has passed that keeps the
        constraints was tried: such plans brush past obstacles and creep up to those that stand in the way.
        """
        s, source, behind = self.settings, "solved", False
        if solution.violation <= s.feasible:
            behind, driven = is_behind(states, now.given.reference), kept.within(controls)
        else:
            source, driven = "braking", self._braking(kept, now.last)
            states = unicycle.rollout(now.present, driven, s.dt)
        if self._yields(now.present, now.given.tracks):
            driven = np.zeros_like(driven)
        return Choice(driven, states, source, behind=behind)

    def _braking(self, kept: Kept, last: Array) -> Array:
        """(N, 2) stored plan slowed to rest; the path keeps its shape, and the robot rests well before its end."""
        left, controls = kept.left(), np.zeros((self.settings.horizon, 2))
        fade = np.maximum(1.0 - (kept.age + np.arange(len(left))) / BRAKING, 0.0)
        stored = left * fade[:, None]
        fastest = np.abs(stored[:, 0]).max(initial=0.0)
        slower = min(1.0, abs(float(last[0])) / fastest) if fastest > 0.0 else 1.0
        controls[: len(left)] = slower * stored
        return controls

    def staying(self, now: Now[Drive]) -> tuple[Array, Array]:
        """Guess rest, which is feasible: from there a solver that failed finds the near side of what stopped it."""
        n = self.settings.horizon
        return np.tile(now.present, (n + 1, 1)), np.zeros((n, 2))

    def along(self, now: Now[Drive]) -> tuple[Array, Array]:
        """Guess how a simple pursuit would follow the reference, which leads around whatever the route leads around.

        It keeps limits and dynamics: it turns first where the reference begins behind the robot's back.
        """
        s, reference = self.settings, now.given.reference
        speeds, controls = now.given.wanted[:, 0], np.zeros((s.horizon, 2))
        states = np.tile(now.present, (s.horizon + 1, 1))
        aim = 0
        for k in range(s.horizon):
            here = states[k]
            while aim < s.horizon and np.hypot(*(reference[aim] - here)[:2]) < PURSUIT:
                aim += 1
            ahead = reference[aim] - here
            distance = float(np.hypot(*ahead[:2]))
            bearing = np.arctan2(ahead[1], ahead[0]) if distance > ARRIVED else reference[aim, 2]
            turn = float(wrap_angle(bearing - here[2]))
            speed = min(speeds[k], distance / s.dt) * max(np.cos(turn), 0.0) ** 2 if distance > ARRIVED else 0.0
            controls[k] = np.clip([speed, turn / PURSUIT_TIME], *s.box)
            states[k + 1] = unicycle.step(here[None], controls[k : k + 1], s.dt)[0]
        return states, controls

    def _yields(self, pose: Array, tracks: Tracks) -> bool:
        """Whether a mover is so near and closing in that resting, which it respects, is the only safe answer."""
        s = self.settings
        offset = pose[:2] - tracks.centre
        distance = np.hypot(*offset.T)
        closing = np.einsum("ij,ij->i", offset, tracks.velocity) / np.maximum(distance, 1e-9)
        near = distance - tracks.radius - s.robot_radius < s.yield_distance
        return bool((tracks.mover & near & (closing > YIELD_SPEED)).any())


def is_behind(states: Array, reference: Array) -> bool:
    """Whether a plan (N + 1, 3) ends far from its reference: it may be caught in a dead end."""
    return bool(np.hypot(*(states[-1] - reference[-1])[:2]) > LEFT_BEHIND)


def settled(solution: fg.Solution, choice: Choice) -> bool:
    """Whether a joint solve says where the robot is: it ended, and its plan is driven."""
    return choice.source == "solved" and solution.status in SETTLED
