"""Model-predictive controller of the ground robot as a factor graph (Bazzana et al. 2022, section V).

Costs: distance to reference poses along the path (eq. 8), control effort, control rate, soft margins to walls and
discs. Constraints: dynamics of the base, limits of velocities and of accelerations, rest at the end, hard clearance
from walls and from tracked discs.
"""

from __future__ import annotations

import numpy as np

import unifg as fg
from unifg.horizon import Context, ControlCost, Decision, InitialGuesses, LastPlan, Plan, RecedingHorizon, Term, Window
from unifg.lie import wrap_angle
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.scenarios.ground.drive_parts import (
    Clearance,
    Drive,
    EvasiveTrajectory,
    Limits,
    Motion,
    disc_distances,
    following,
    predicted,
    wall_distances,
)
from unifg.scenarios.ground.drive_past import robot
from unifg.scenarios.ground.drive_settings import SECOND, ControllerSettings, backend
from unifg.scenarios.ground.futures import futures, horizon_of
from unifg.scenarios.ground.repulsion import Repulsion
from unifg.scenarios.ground.stopping import evasions, stopped
from unifg.scenarios.perception.tracks import Tracks, nearest
from unifg.typing import Array

COLD_PATIENCE = 3  # a tick without a warm start may iterate longer
LEFT_BEHIND = 0.6  # [m] between the ends of plan and reference
PURSUIT = 0.3  # [m] ahead of the robot, where a guess aims at the reference
PURSUIT_TIME = 0.2  # [s] in which it would turn there
ARRIVED = 0.05  # [m] to the end of the reference, where it only turns
ENDED = (fg.Status.CONVERGED, fg.Status.STOP_RULE)
COMMITTED = 0.1  # [m] more room than the evasion of the last tick has another one to have
OFF_WALLS = 0.015  # [m] from the hull to walls: less is touching, as far as maps and estimates can tell
PATIENCE = 5  # ticks of being left behind before the plan starts over from the reference


class Controller:
    """Decides the next control from a pose, a reference and tracks.

    Attributes:
        settings: weights and limits.
        loop: the prepared graph.
        way_out: (N + 1, 3) poses of what the last tick would have driven without a plan [m, m, rad].
    """

    def __init__(
        self, distance_map: DistanceMap, solver: str, settings: ControllerSettings, window: Window | None = None
    ) -> None:
        """State the graph and prepare the backend; with a window, past and future are one graph."""
        self.settings = s = settings
        self.field = SmoothField(distance_map)
        self._coming = np.zeros((0, s.kind.size))  # what would be driven next if nothing were decided any more
        self.way_out = np.zeros((s.horizon + 1, 3))
        self._evasion: int | None = None  # number of the evasion that was the last tick's way out
        terms: list[Term] = [
            *following(s),
            ControlCost(s.every(s.control_sigma), s.every(s.rate_sigma), wanted=wanted_controls),
            Motion(s),
            Limits(s),
            Repulsion(s, self.field) if s.avoidance in ("potential", "vortex") else Clearance(s, self.field),
        ]
        self.loop = RecedingHorizon(
            robot(s.dt, s.kind) if window is None else window.robot, horizon_of(s), terms, solver=backend(solver, s),
            probabilities=(lambda now: now.given.futures.probabilities) if s.branches else None,
            cold=backend(solver, s, COLD_PATIENCE), second=backend(SECOND, s, COLD_PATIENCE), window=window,
            coupling="sequential" if window is None else "joint", pull=s.pull, limits=s.box, judge=self.judge,
            starts=InitialGuesses(self.along, self.leaving), believable=is_believable, patience=PATIENCE,
        )  # fmt: skip

    def stations(self) -> Array:
        """(N + 1,) how far ahead along the path the reference is [m]."""
        return self.settings.stations

    def plan(self, pose: Array, reference: Array, tracks: Tracks, covariance: Array | None = None) -> Plan:
        """Decide the next control.

        Args:
            pose: (3,) estimate by the past alone [m, m, rad].
            reference: (N + 1, 3) poses along the path, the first beside the robot.
            tracks: discs the robot has seen.
            covariance: (3, 3) of the estimate, in its tangent space; None for an estimate without error.
        """
        plan = self.loop.plan(pose, self.given(pose, reference, tracks, covariance))
        self._coming = plan.controls[1:]
        return plan

    @property
    def estimate(self) -> Array:
        """(3,) present pose as it is believed after the last plan [m, m, rad]."""
        return self.loop.estimate

    def given(self, pose: Array, reference: Array, tracks: Tracks, covariance: Array | None = None) -> Drive:
        """Context of the terms; arguments as of :meth:`plan`."""
        spread = np.zeros((3, 3)) if covariance is None else covariance
        s, evasion = self.settings, self._evasion_from(pose, tracks)
        self.way_out = evasion.states
        expected = None if s.futures == "worst" else futures(s, nearest(tracks, pose, s.discs))
        return Drive(self._cruise(reference), reference, tracks, spread, evasion, expected)

    def _cruise(self, reference: Array) -> Array:
        """(N, m) controls of the speeds along a reference (N + 1, 3)."""
        s, way = self.settings, np.diff(reference[:, :2], axis=0)
        cruise = np.zeros((s.horizon, s.kind.size))
        cruise[:, 0] = np.hypot(*way.T) / s.dt
        if s.oriented or s.kind.slides:  # it may lead backwards, or sideways
            cosine, sine = np.cos(reference[:-1, 2]), np.sin(reference[:-1, 2])
            ahead, left = (way * np.stack([cosine, sine], axis=-1)).sum(axis=1), way[:, 1] * cosine - way[:, 0] * sine
            cruise[:, 0] = np.copysign(cruise[:, 0], ahead)
            if s.kind.slides:
                cruise[:, :2] = np.column_stack([ahead, left]) / s.dt
        return cruise

    def _evasion_from(self, pose: Array, tracks: Tracks) -> EvasiveTrajectory:
        """Rest along the path of the last plan; if a mover would come too near there, the best simple way of evading.

        Which is the best is judged by the least distance on the way, of discs and of walls alike, beyond what is to be
        kept from them. One that leads into a wall is taken only where each does: walls do not step aside, and what the
        way out comes near to the plan may come near to as well. The one of the last tick is kept while no other is much
        better: who turns back and forth between two ways out takes neither.
        """
        s, last = self.settings, self.loop.applied
        controls = stopped(last, self._coming, s.most, s.horizon, s.kind)
        rest = EvasiveTrajectory(s.kind.followed(pose, last, controls, s.dt), controls)
        movers = tracks.at(tracks.mover)
        if not len(movers) or self._room(rest.states, predicted(s, pose, movers), movers.radius) >= 0.0:
            self._evasion = None
            return rest
        centres, best, before, self._evasion = predicted(s, pose, tracks), rest, self._evasion, None
        most = self._worth(rest.states, centres, tracks.radius)
        for number, way in enumerate(evasions(last, s.most, s.box[1], s.horizon, s.dt, s.kind)):
            states = s.kind.followed(pose, last, way, s.dt)
            off_walls, clear, room = self._worth(states, centres, tracks.radius)
            worth = off_walls, clear, room + (COMMITTED if number == before else 0.0)
            if worth > most:
                most, best, self._evasion = worth, EvasiveTrajectory(states, way, evades=True), number
        return best

    def _worth(self, states: Array, centres: Array, radii: Array) -> tuple[bool, bool, float]:
        """Rank of an evasion, the greater the better: clear of walls, clear of discs, least distance."""
        walls, room = self._off_walls(states), self._room(states, centres, radii)
        clear = room + self.settings.disc_clearance >= 0.0
        return walls + self.settings.wall_clearance >= OFF_WALLS, clear, min(room, walls)

    def _room(self, states: Array, centres: Array, radii: Array) -> float:
        """Least gap between the hull at states (N + 1, 3) and discs at centres (N, k, 2), beyond what is to be kept."""
        apart = disc_distances(self.settings.hull, states[1:], centres) - radii
        return float(apart.min(initial=np.inf)) - self.settings.robot_radius - self.settings.disc_clearance

    def _off_walls(self, states: Array) -> float:
        """The same of walls."""
        s = self.settings
        return float(wall_distances(s.hull, self.field, states[1:]).min()) - s.robot_radius - s.wall_clearance

    def rest(self, pose: Array) -> tuple[Array, Array]:
        """Come to rest along the path of the last plan, without asking a solver.

        Args:
            pose: (3,) present [m, m, rad].

        Returns:
            Controls (N, m) and states (N + 1, 3), the first of which is taken as applied.
        """
        s, last = self.settings, self.loop.applied
        controls = stopped(last, self._coming, s.most, s.horizon, s.kind)
        self.loop.abandon()
        self.loop.applied, self._coming = controls[0].copy(), controls[1:]
        self.way_out = s.kind.followed(pose, last, controls, s.dt)
        return controls, self.way_out

    def driven(self, control: Array) -> None:
        """Be told that another control (m,) than the first of the plan is applied."""
        self.loop.applied = control.copy()

    def forget(self) -> None:
        """Drop the warm start, as when a new route makes it misleading."""
        self._evasion = None
        self.loop.forget()

    def judge(
        self, solution: fg.Solution, states: Array, controls: Array, now: Context[Drive], kept: LastPlan
    ) -> Decision:
        """Drive a plan that keeps the constraints; drive the evasive trajectory otherwise.

        Of a solve that ended early this is where it stopped. The cheapest iterate it has passed that keeps the
        constraints was tried: such plans brush past obstacles and creep up to those that stand in the way.
        """
        if solution.violation <= self.settings.feasible:
            driven, most = kept.within(controls), self.settings.most
            driven[0] = np.clip(driven[0], now.last - most, now.last + most)  # no farther than the base can follow
            return Decision(driven, states, "solved", behind=is_behind(states, now.given.reference))
        way = now.given.evasive
        return Decision(way.controls, way.states, "evading" if way.evades else "braking")

    def leaving(self, now: Context[Drive]) -> tuple[Array, Array]:
        """Guess the way out, which is feasible: a solver that failed finds the near side of what stopped it."""
        return now.given.evasive.states, now.given.evasive.controls

    def along(self, now: Context[Drive]) -> tuple[Array, Array]:
        """Guess how a simple pursuit would follow the reference, which leads around whatever the route leads around.

        It keeps limits, accelerations and dynamics, and ends at rest: it turns first where the reference begins behind
        the robot's back.
        """
        s, reference = self.settings, now.given.reference
        if s.oriented or s.kind.slides:  # the reference itself can be driven, but for the corners of its controls
            return reference.copy(), np.clip(now.given.wanted, *s.box)
        speeds, controls = now.given.wanted[:, 0], np.zeros((s.horizon, 2))
        states, last = np.tile(now.present, (s.horizon + 1, 1)), now.last
        aim = 0
        for k in range(s.horizon):
            pose = states[k]
            while aim < s.horizon and np.hypot(*(reference[aim] - pose)[:2]) < PURSUIT:
                aim += 1
            ahead = reference[aim] - pose
            distance = float(np.hypot(*ahead[:2]))
            bearing = np.arctan2(ahead[1], ahead[0]) if distance > ARRIVED else reference[aim, 2]
            turn = float(wrap_angle(bearing - pose[2]))
            speed = min(speeds[k], distance / s.dt) * max(np.cos(turn), 0.0) ** 2 if distance > ARRIVED else 0.0
            fastest = np.minimum(s.box[1], s.most * (s.horizon - k))
            wanted = np.clip([speed, turn / PURSUIT_TIME], -fastest, fastest)
            controls[k] = np.clip(wanted, last - s.most, last + s.most)
            states[k + 1] = s.kind.step(pose[None], 0.5 * (last + controls[k])[None], s.dt)[0]
            last = controls[k]
        return states, controls


def wanted_controls(now: Context[Drive]) -> Array:
    """(N, m) controls that would follow the reference, those of a stage for all nodes of the stage."""
    return now.given.wanted if now.tree is None else now.given.wanted[now.tree.depths[1:] - 1]


def is_behind(states: Array, reference: Array) -> bool:
    """Return True for a plan (N + 1, 3) that ends far from its reference: it may be caught in a dead end."""
    return bool(np.hypot(*(states[-1] - reference[-1])[:2]) > LEFT_BEHIND)


def is_believable(solution: fg.Solution, choice: Decision) -> bool:
    """Return True if a joint solve says where the robot is: it ended, and its plan is driven."""
    return choice.source == "solved" and solution.status in ENDED
