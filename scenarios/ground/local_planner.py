"""Local planners of users in the controller's place, as ``unifg run navigation --planner MODULE:CLASS`` loads them.

``CLASS(context)`` is constructed once for each map with a `PlannerContext`. At every tick ``control(situation)``
returns a velocity (2,), a sequence of them (K, 2), the first for now, or None where it finds no way. `PlannerAdapter`
brings these within the limits of speed and acceleration of the base, as a velocity smoother behind a planner does, and
slows to rest where there is None. Two members are optional: ``forget()``, called when a new route makes earlier plans
misleading, and ``iterations``, a number for the record.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

import unifg as fg
from unifg.errors import ScenarioError
from unifg.horizon import Plan
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.protocols import constructed, load_class, named
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.polyline import arc_lengths
from unifg.typing import Array, ArrayLike, BoolArray

__all__ = ["LocalPlanner", "PlannerAdapter", "PlannerContext", "Situation", "load_planner"]

SAME_PLACE = 1e-6  # [m]; a reference that has come to its end repeats the goal
TOLERANCE = 1e-4  # [m] by which a robot inside a clearance may come nearer, as when it turns


@dataclass(frozen=True)
class PlannerContext:
    """Map, limits and random numbers of a planner.

    Attributes:
        distance_map: of the map that the robot was given.
        settings: limits of the robot and clearances; `Situation.settings` are those of a tick.
        rng: for planners that sample; decided by the seed of the run.
    """

    distance_map: DistanceMap
    settings: ControllerSettings
    rng: np.random.Generator


@dataclass(frozen=True)
class Situation:
    """Input of a planner at a tick.

    Attributes:
        pose: (3,) estimate [m, m, rad].
        applied: (2,) control of the last tick [m/s, rad/s].
        reference: (N + 1, 3) poses along the route, the first beside the robot; at its end the goal repeated.
        tracks: discs the robot has seen.
        walls: distance to the walls of the map.
        settings: limits of the robot and clearances; ``speed`` is that which health monitoring allows now.
        doubt: addition to the clearances for the uncertainty of the estimate [m].
    """

    pose: Array
    applied: Array
    reference: Array
    tracks: Tracks
    walls: DistanceMap
    settings: ControllerSettings
    doubt: float = 0.0

    def clearance(self, points: Array, times: Array | float) -> Array:
        """Distance from the hull to walls and discs beyond the clearance to be kept; discs go straight on.

        Args:
            points: (..., 2) positions of the robot [m], or (..., 3) poses [m, m, rad], which a body that is no disc
                about its axis needs.
            times: from now, as many as points or the last axes of them [s].

        Returns:
            (...,) [m].
        """
        s, when = self.settings, np.asarray(times)[..., None]
        if not s.hull.round:
            if points.shape[-1] != 3:
                raise ScenarioError("clearances of this body are those of poses (..., 3), positions do not do")
            parts = np.moveaxis(s.hull.places(points), -2, 0)
            gaps = [self._gap(part, when) + less for part, less in zip(parts, s.hull.smaller, strict=True)]
            least: Array = np.min(gaps, axis=0) - s.robot_radius - self.doubt
            return least
        return self._gap(points[..., :2], when) - s.robot_radius - self.doubt

    def _gap(self, points: Array, when: Array) -> Array:
        """Distance (...) of points (..., 2) to walls and discs beyond the clearance to be kept [m]."""
        s = self.settings
        distance = self.walls.distance(points) - s.wall_clearance
        for centre, velocity, radius in zip(self.tracks.centre, self.tracks.velocity, self.tracks.radius, strict=True):
            offset = points - (centre + when * velocity)
            np.minimum(distance, np.hypot(offset[..., 0], offset[..., 1]) - radius - s.disc_clearance, out=distance)
        return distance

    def hits(self, clearance: Array, times: Array | float) -> BoolArray:
        """Flags of a drive of such clearances (...,) at those times: True for a hit that a robot at rest avoids."""
        rest = self.clearance(np.broadcast_to(self.pose[:2], (*np.shape(times), 2)), times)
        return clearance < np.minimum(rest, 0.0) - TOLERANCE

    def reachable(self, wanted: Array) -> Array:
        """Controls (..., K, 2) nearest to those wanted within the limits of speed and acceleration from now on."""
        return reachable(wanted, self.applied, self.settings)

    @property
    def goal(self) -> Array | None:
        """(3,) the goal; None if the reference ends before it."""
        last = self.reference[-2:, :2]
        return self.reference[-1] if np.hypot(*(last[1] - last[0])) < SAME_PLACE else None

    def along(self) -> Array:
        """(N + 1,) arc lengths of the reference [m]."""
        return arc_lengths(self.reference[:, :2])


class LocalPlanner(Protocol):
    """Interface of a user's planner; see the module."""

    def control(self, now: Situation) -> ArrayLike | None:
        """Velocity (2,) or velocities (K, 2) from now on, the last of which holds on [m/s, rad/s]; None for no way."""


class PlannerAdapter:
    """A user's planner as the pilot drives it.

    Attributes:
        settings: limits and clearances of now.
        applied: (2,) control of the last tick [m/s, rad/s].
        estimate: (3,) pose of the last tick [m, m, rad].
        way_out: (N + 1, 3) poses of braking in the place of the last plan [m, m, rad].
    """

    def __init__(self, planner: LocalPlanner, context: PlannerContext) -> None:
        """Begin at rest."""
        self.planner, self.settings, self._walls = planner, context.settings, context.distance_map
        self.applied, self.estimate = np.zeros(context.settings.kind.size), np.zeros(3)
        self.way_out = np.zeros((context.settings.horizon + 1, 3))

    def stations(self) -> Array:
        """(N + 1,) arc lengths of the reference [m]: as far as the horizon reaches at full speed."""
        s = self.settings
        return s.speed * s.dt * np.arange(s.horizon + 1.0)

    def plan(self, pose: Array, reference: Array, tracks: Tracks, covariance: Array | None = None) -> Plan:
        """Decide the next control.

        Args:
            pose: (3,) estimate [m, m, rad].
            reference: (N + 1, 3) poses along the route, the first beside the robot.
            tracks: discs the robot has seen.
            covariance: (3, 3) of the estimate; None for one without error.

        Raises:
            ScenarioError: the planner raised something, or returned something else than finite controls (2,) or (K, 2),
                or None.
        """
        begin, s = time.perf_counter(), self.settings
        self.estimate = np.array(pose, dtype=np.float64)
        variance = 0.0 if covariance is None else float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        doubt = s.sigmas * float(np.sqrt(max(variance, 0.0)))
        lent, held, way = self.estimate.copy(), self.applied.copy(), reference.copy()  # which it may write into
        now = Situation(lent, held, way, tracks, self._walls, s, doubt)
        size = s.kind.size
        with named("planner", self.planner):
            answer = self.planner.control(now)
            iterations = 0 if answer is None else int(getattr(self.planner, "iterations", 1))
        try:
            given = np.atleast_2d(np.asarray(np.zeros(size) if answer is None else answer))
            wanted = given.astype(np.float64) if given.dtype.kind in "biuf" else np.zeros(0)
        except ValueError:  # rows of several lengths
            wanted = np.zeros(0)
        if wanted.ndim != 2 or wanted.shape[1] != size or not len(wanted) or not np.isfinite(wanted).all():
            raise ScenarioError(
                f"the planner returned {answer!r}: give finite controls ({size},) or (K, {size}), or None"
            )
        wanted = np.concatenate([wanted, np.tile(wanted[-1], (max(s.horizon - len(wanted), 0), 1))])[: s.horizon]
        controls, braking = now.reachable(wanted), now.reachable(np.zeros_like(wanted))
        self.way_out = s.kind.rollout(self.estimate, braking, s.dt)
        least, most = s.box
        excess = float(np.maximum(wanted - most, least - wanted).max(initial=0.0))
        self.applied = controls[0]
        status, source = fg.Status.STOP_RULE, "solved"
        if answer is None:
            status, source = fg.Status.LOCALLY_INFEASIBLE, "braking"
        states = s.kind.rollout(self.estimate, controls, s.dt)
        return Plan(controls, states, status, iterations, source, excess, 1e3 * (time.perf_counter() - begin))

    def rest(self, pose: Array) -> tuple[Array, Array]:
        """Controls (N, 2) and states (N + 1, 3) of coming to rest, the first of which is taken as applied."""
        s = self.settings
        controls = reachable(np.zeros((s.horizon, s.kind.size)), self.applied, s)
        self.applied, self.estimate = controls[0], np.asarray(pose, dtype=np.float64)
        self.way_out = s.kind.rollout(self.estimate, controls, s.dt)
        return controls, self.way_out

    def driven(self, control: Array) -> None:
        """Record that another control (2,) than the first of the plan is applied."""
        self.applied = control.copy()

    def forget(self) -> None:
        """Drop earlier plans, as when a new route makes them misleading."""
        forget = getattr(self.planner, "forget", None)
        if forget is not None:
            with named("planner", self.planner):
                forget()


def reachable(wanted: Array, applied: Array, settings: ControllerSettings) -> Array:
    """Controls (..., K, 2) nearest to those wanted within the limits of speed and acceleration, after ``applied``."""
    made = np.empty_like(wanted)
    change, (least, most) = settings.most, settings.box
    last = np.broadcast_to(applied, wanted[..., 0, :].shape)
    for k in range(wanted.shape[-2]):
        bounded = np.minimum(np.maximum(wanted[..., k, :], least), most)  # np.clip takes twice as long
        last = np.minimum(np.maximum(bounded, last - change), last + change)
        made[..., k, :] = last
    return made


def load_planner(name: str | type, context: PlannerContext) -> PlannerAdapter:
    """Construct a user's planner.

    Args:
        name: ``MODULE:CLASS``, or the class; modules of the working directory are found, too.
        context: map, limits and random numbers, the argument of the class.

    Raises:
        ScenarioError: there is no such module or class, or it cannot be constructed or has no method ``control``.
    """
    example = "benchmarks.baselines.elastic_band:ElasticBand"
    kind = load_class("planner", name, ("mpc",), ("control(situation)",), example)
    return PlannerAdapter(constructed("planner", kind, context), context)
