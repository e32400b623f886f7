"""What the local planners to compare with share: what they see, what the robot can do, and how it stops.

A tick gives them what it gives the model-predictive controller: the estimate, the reference along the repaired route,
the distance field of the map, and the tracked discs. Whatever they want is brought within the same limits of speed and
acceleration, as a velocity smoother behind a planner does; where they see no way the robot slows to rest within them.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

import unifg as fg
from unifg.horizon import Plan
from unifg.lie import wrap_angle
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array, BoolArray

__all__ = ["LocalPlanner", "Situation", "Wish"]

SAME_PLACE = 1e-6  # [m]; a reference that has come to its end repeats the goal
AT_GOAL = 0.05  # [m]; from here on a planner that cannot reach a pose in one motion turns on the spot
OFF_GOAL = 0.1  # [m]; a robot that has slid so far away drives again
TURNED = 0.02  # [rad]
GIVE = 1e-4  # [m] by which a robot that stands too near to something may come nearer still, as when it turns


@dataclass(frozen=True)
class Situation:
    """What a tick gives a planner.

    Attributes:
        pose: (3,) estimate [m, m, rad].
        applied: (2,) control of the last tick [m/s, rad/s].
        reference: (N + 1, 3) poses along the route, the first beside the robot; at its end the goal repeated.
        tracks: discs the robot has seen.
        walls: distance to them on the map; as it is, for the smooth one the controller has rounds corners off.
        settings: radius of the robot, and the clearances that everybody keeps.
        doubt: what is added to these because the estimate is uncertain [m].
    """

    pose: Array
    applied: Array
    reference: Array
    tracks: Tracks
    walls: DistanceMap
    settings: ControllerSettings
    doubt: float = 0.0

    def clearance(self, points: Array, times: Array | float) -> Array:
        """What is left of the distance from the hull to the nearest thing beyond the clearance that is to be kept.

        Discs are where they will be if they go straight on.

        Args:
            points: (..., 2) places of the robot [m].
            times: when it is there, from now, as many as points or the last axes of them [s].

        Returns:
            (...,) [m].
        """
        s, when = self.settings, np.asarray(times)[..., None]
        found = self.walls.distance(points) - s.wall_clearance
        for centre, velocity, radius in zip(self.tracks.centre, self.tracks.velocity, self.tracks.radius, strict=True):
            offset = points - (centre + when * velocity)
            np.minimum(found, np.hypot(offset[..., 0], offset[..., 1]) - radius - s.disc_clearance, out=found)
        left: Array = found - s.robot_radius - self.doubt
        return left

    def hits(self, clearance: Array, times: Array | float) -> BoolArray:
        """Where a drive of such clearances (...,) at those times hits something that a robot at rest does not."""
        rest = self.clearance(np.broadcast_to(self.pose[:2], (*np.shape(times), 2)), times)
        struck: BoolArray = clearance < np.minimum(rest, 0.0) - GIVE
        return struck

    @property
    def goal(self) -> Array | None:
        """(3,) the goal, if the reference reaches so far."""
        last = self.reference[-2:, :2]
        return self.reference[-1] if np.hypot(*(last[1] - last[0])) < SAME_PLACE else None

    def along(self) -> Array:
        """(N + 1,) arc lengths of the reference [m]."""
        steps = np.hypot(*np.diff(self.reference[:, :2], axis=0).T)
        return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True)
class Wish:
    """What a planner wants.

    Attributes:
        controls: (K, 2) from now on; the last one holds on.
        effort: iterations, samples or candidates, for the record.
    """

    controls: Array
    effort: int = 1


Own = TypeVar("Own")
"""Numbers of a planner."""


class LocalPlanner(ABC, Generic[Own]):
    """Decides the next control from a pose, a reference and tracks, as the model-predictive controller does.

    Attributes:
        usual: makes the numbers that its authors use.
        settings: limits of the robot, and the clearances that everybody keeps.
        distance_map: of the map that the robot was given.
        own: numbers of the planner.
        applied: (2,) control of the last tick [m/s, rad/s].
        estimate: (3,) present pose: what it was given [m, m, rad].
    """

    usual: Callable[[], Own]

    def __init__(self, distance_map: DistanceMap, settings: ControllerSettings, own: Own | None = None) -> None:
        """Stand still; without ``own`` numbers with the usual ones."""
        self.own: Own = self.usual() if own is None else own
        self.settings, self.distance_map = settings, distance_map
        self.applied, self.estimate = np.zeros(2), np.zeros(3)
        self._turning = False

    @abstractmethod
    def wish(self, now: Situation) -> Wish | None:
        """What the planner wants; None where it finds no way."""

    def stations(self) -> Array:
        """(N + 1,) how far ahead along the route the reference is [m]: as far as the horizon reaches at full speed."""
        s = self.settings
        return s.speed * s.dt * np.arange(s.horizon + 1.0)

    def plan(self, pose: Array, reference: Array, tracks: Tracks, covariance: Array | None = None) -> Plan:
        """Decide the next control.

        Args:
            pose: (3,) estimate [m, m, rad].
            reference: (N + 1, 3) poses along the route, the first beside the robot.
            tracks: discs the robot has seen.
            covariance: (3, 3) of the estimate; None for one without error.
        """
        begin, s = time.perf_counter(), self.settings
        self.estimate = np.asarray(pose, dtype=np.float64)
        spread = 0.0 if covariance is None else float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        doubt = s.sigmas * float(np.sqrt(max(spread, 0.0)))
        now = Situation(self.estimate, self.applied, reference, tracks, self.distance_map, s, doubt)
        wish = self.wish(now)
        wanted = np.zeros((1, 2)) if wish is None else wish.controls
        wanted = np.concatenate([wanted, np.tile(wanted[-1], (max(s.horizon - len(wanted), 0), 1))])[: s.horizon]
        controls = self.reachable(wanted)
        least, most = s.box
        excess = float(np.maximum(wanted - most, least - wanted).max(initial=0.0))
        self.applied = controls[0]
        return Plan(
            controls, unicycle.rollout(self.estimate, controls, s.dt),
            fg.Status.LOCALLY_INFEASIBLE if wish is None else fg.Status.STOP_RULE, 0 if wish is None else wish.effort,
            "braking" if wish is None else "solved", excess, 1e3 * (time.perf_counter() - begin),
        )  # fmt: skip

    def rest(self, pose: Array) -> tuple[Array, Array]:
        """Controls (N, 2) and states (N + 1, 3) of coming to rest, the first of which is taken as applied."""
        controls = self.reachable(np.zeros((self.settings.horizon, 2)))
        self.applied, self.estimate = controls[0], np.asarray(pose, dtype=np.float64)
        return controls, unicycle.rollout(self.estimate, controls, self.settings.dt)

    def driven(self, control: Array) -> None:
        """Be told that another control (2,) than the first of the plan is applied."""
        self.applied = control.copy()

    def reachable(self, wanted: Array) -> Array:
        """Controls (..., K, 2) nearest to those wanted that keep the limits of speed and acceleration from now on."""
        s, made = self.settings, np.empty_like(wanted)
        change, (least, most) = s.most, s.box
        last = np.broadcast_to(self.applied, wanted[..., 0, :].shape)
        for k in range(wanted.shape[-2]):
            wish = np.minimum(np.maximum(wanted[..., k, :], least), most)  # np.clip takes twice as long
            last = np.minimum(np.maximum(wish, last - change), last + change)
            made[..., k, :] = last
        return made

    def turned_to_goal(self, now: Situation) -> Wish | None:
        """Turn on the spot where the goal has been reached but for its heading; None elsewhere."""
        goal = now.goal
        if goal is None:
            self._turning = False
            return None
        away = float(np.hypot(*(goal - now.pose)[:2]))
        self._turning = away < (OFF_GOAL if self._turning else AT_GOAL)
        return self.turn(float(wrap_angle(goal[2] - now.pose[2]))) if self._turning else None

    def turn(self, angle: float) -> Wish:
        """Turn on the spot, so fast that the robot can stop at the angle [rad] that is left."""
        s = self.settings
        if abs(angle) <= TURNED:
            return Wish(np.zeros((1, 2)))
        fastest = min(s.limits[1], float(np.sqrt(2.0 * s.accelerations[1] * abs(angle))), abs(angle) / s.dt)
        return Wish(np.array([[0.0, np.copysign(fastest, angle)]]))

    def forget(self) -> None:
        """Drop what was planned, as when a new route makes it misleading."""
        self._turning = False
