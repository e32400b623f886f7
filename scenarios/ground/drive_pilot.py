"""Coupling of estimation and control: two graphs one after the other, or one graph for both."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

import unifg as fg
from unifg.errors import UnifgError
from unifg.files.ros_map import OccupancyMap
from unifg.horizon import Plan
from unifg.lie import SE2
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.calibration import Calibration
from unifg.scenarios.ground.creeping import Creeping
from unifg.scenarios.ground.drive_control import Controller
from unifg.scenarios.ground.drive_past import Smoother
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.drive_signals import RAMPS, DriveSignals
from unifg.scenarios.ground.emergency_stop import EmergencyStop
from unifg.scenarios.ground.local_planner import PlannerAdapter
from unifg.scenarios.ground.localiser import Localiser
from unifg.scenarios.ground.protocols import Estimator
from unifg.scenarios.ground.relocalise import BELIEVED, BESIDE, PORTION, Relocaliser, fit, refine
from unifg.scenarios.ground.route import Route
from unifg.scenarios.ground.waiting import LOOK, waiting
from unifg.scenarios.monitoring.supervisor import Health, HealthReport, Supervisor
from unifg.scenarios.monitoring.validation import Validator
from unifg.scenarios.perception.disc_tracker import DiscTracker
from unifg.scenarios.perception.explaining import PointWatch, explained
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.stopwatch import Stopwatch
from unifg.typing import Array

COUPLINGS = ("sequential", "joint")
AT_REST = 0.02  # [m/s]; slower is rest
HELD = 0.5  # of the way that it could go: a robot that gets no farther is held by movers
SEARCH_AGAIN = 20  # ticks after a search that found nothing
FITS = 0.7  # share of the beams that the map explains, below which the robot doubts where it is
DOUBTFUL = 10  # ticks of doubt after which the rest of the map is searched beside the drive
FOUND_SIGMA = np.array([0.05, 0.05, 0.02])  # of a pose that a search has found [m, m, rad]
DECIMETRE = np.array([0.12, 0.12, 0.05])  # standard deviations of a pose that calibration goes by [m, m, rad]
STOPPED = "stopped"
"""Source of a plan that the supervisor has made: come to rest."""
CREEPING = "creeping"
"""The same of one to tell places apart."""
UNSOLVED = STOPPED, CREEPING
"""Sources of plans that no solver has made, and that are no emergency."""


logger = logging.getLogger("unifg")


PlannerT = TypeVar("PlannerT", bound=Controller | PlannerAdapter)


class Pilot(Generic[PlannerT]):
    """Estimates, looks for things that no map shows, repairs the route, plans along it, and stops when it has to.

    Attributes:
        estimator: of the pose, by the past alone.
        controller: of the drive.
        tracker: of discs.
        points: what is neither on the map nor a disc.
        tracks: after the last tick: discs and points.
        pose: (3,) present estimate [m, m, rad]; that of the joint solve, if there is one.
        iterations: of the estimator at the last tick.
        clock: how long the stages of the last tick took: localise, perceive, route, plan.
        validator: of samples.
        supervisor: how fast the robot may go.
        share: of the beams of the last scan that the map explains.
        relocated: whether the last tick has found the robot at another place.
        slowed: true if the emergency stop has changed the control of the last tick.
        driven: (m,) control of the last tick.
        calibration: slow states of the sensors.
        recalibrated: true if one of them has jumped in the last tick.
        planless: whether no solve is to give a plan: a planner that is out of time.
    """

    def __init__(
        self,
        estimator: Estimator,
        controller: PlannerT,
        tracker: DiscTracker,
        occupancy: OccupancyMap,
        distance_map: DistanceMap,
        beams: int,
        range_max: float = math.inf,
    ) -> None:
        """Join what stands for itself."""
        s = controller.settings
        self.estimator, self.controller, self.tracker = estimator, controller, tracker
        self.points = PointWatch()
        self.tracks = Tracks.none()
        self.clock = Stopwatch()
        self.pose = estimator.pose
        self.validator, self.supervisor = Validator(beams, range_max), Supervisor(RAMPS)
        self.emergency_stop = EmergencyStop(s.hull, (float(s.most[0]) / s.dt, s.accelerations[1]), s.dt, s.kind)
        self.share, self.relocated, self.slowed, self.planless = 1.0, False, False, False
        self.driven = np.zeros(s.kind.size)
        self._map, self._search = distance_map, Relocaliser(occupancy, distance_map, s.robot_radius)
        self._signals = DriveSignals(s.dt, s.most, s.kind)
        self.calibration, self.recalibrated = Calibration(distance_map, s.dt, s.kind), False
        self._pause, self._doubt, self._elsewhere = 0, 0, 0.0
        self._creeping: Creeping | None = None
        self._moved = np.zeros(3)  # since the scan that is searched for was taken
        self._awake, self._failed, self._traced = False, "", set[str]()
        self._first: Scan | None = None

    @property
    def verdict(self) -> HealthReport:
        """Report of the supervisor at the last tick."""
        return self.supervisor.verdict

    @property
    def creeping(self) -> bool:
        """True while the robot, which is lost, moves to tell places apart."""
        return self._creeping is not None and not self._creeping.ended

    @property
    def power_off(self) -> bool:
        """Request that the power of the motors be cut: they do not do what they are told."""
        return self._signals.power_off

    @property
    def planless_for(self) -> float:
        """Time since the last tick with a plan of its own [s]."""
        return self._signals.values()["plan"]

    def wake(self, scan: Scan | None, now: float) -> None:
        """Look where the robot stands before anything is decided, as where to go from there; the first tick goes on."""
        try:
            self._first = self.validator.scan(scan, now)
            self.estimator.update(self._first, None, self.controller.settings.dt)
        except (UnifgError, ArithmeticError, ValueError):
            return  # the first tick tries again, and says what is wrong
        self.pose, self._awake = self.estimator.pose, True

    def tick(self, scan: Scan | None, odometry: Array | None, route: Route, now: float, first: bool = False) -> Plan:
        """Decide; the estimate is that of the plan afterwards. Samples may be anything.

        Args:
            scan: of now; None where none came.
            odometry: (m,) since the last scan; None where none came.
            route: to follow.
            now: [s].
            first: whether nothing has been driven yet, so that there is no odometry.
        """
        self.clock.start()
        self.relocated = False
        try:
            plan, self._failed = self._decide(scan, odometry, route, now, first), ""
        except (UnifgError, ArithmeticError, ValueError) as error:  # a robot that drives has to come to rest
            if str(error) != self._failed:  # what goes on failing is counted by the supervisor
                trace = None if str(error) in self._traced else error.__cause__  # has the lines of a user's part
                logger.warning("the tick at %.2f s failed, the robot brakes: %s", now, error, exc_info=trace)
                self._traced.add(str(error))
            self._failed = str(error)
            self.supervisor.fail(self._failed)
            plan = self._rest(self.pose)
            for stage in ("localise", "perceive", "route", "plan"):
                self.clock.seconds.setdefault(stage, 0.0)
        self._signals.planned(self.verdict.rests or not plan.emergency)
        self.driven = plan.control.copy()
        return plan

    def _decide(self, scan: Scan | None, odometry: Array | None, route: Route, now: float, first: bool) -> Plan:
        s = self.controller.settings
        looked = first and self._awake
        seen = self._first if looked else self.validator.scan(scan, now)
        wheels = None if first else self.validator.odometry(odometry, self.driven, s.dt)
        predicted = (
            self.estimator.pose if wheels is None else s.kind.step(self.estimator.pose[None], wheels[None], s.dt)[0]
        )
        if not looked:
            seen = self._put_right(seen, wheels)
            predicted = self.estimator.pose if self.recalibrated else predicted
            self.estimator.update(seen, None if self.recalibrated else wheels, s.dt)
        if seen is not None and wheels is not None:
            seen = seen.deskewed(s.kind.of(wheels))
        pose = self.pose = self.estimator.pose
        self.clock.split("localise")
        found = None if seen is None else explained(self._map, seen, pose)
        if found is not None and seen is not None:
            self.share = found.share
            discs = self.tracker.update(seen, pose, s.dt)
            self.points.update(found, discs, len(seen.ranges))
            self.tracks = discs.followed_by(self.points.tracks())
        self.clock.split("perceive")
        signals = self._signals
        signals.note(
            corrected=found is not None and not self.estimator.refused, share=self.share, predicted=predicted,
            pose=pose, covariance=self.estimator.covariance, wheels=wheels,
            trusted="wheels" not in self.validator.refused, asked=self.driven,
            blind=0.0 if seen is None else seen.blind,
        )  # fmt: skip
        refused = self.validator.refused
        why = {"fix": refused.get("lidar", "") or self.estimator.refused, "odometry": refused.get("wheels", "")}
        others = {"elsewhere": self._elsewhere, **self._calibrate(seen, predicted, wheels)}
        verdict = self.supervisor.judge({**signals.values(), **others}, why)
        self._find_again(seen, wheels)
        if verdict.rests:
            plan = self._rest(pose)
            if self._creeping is not None and not self._creeping.ended and seen is not None:
                plan = self._creep(self._creeping, plan, seen)
            self.clock.split("route")
        else:
            if route.repair(pose, self.tracks):
                self.controller.forget()
            self.clock.split("route")
            plan = self._plan(pose, route, verdict.share)
            if seen is not None:
                plan = self._stop(plan, seen)
        self.clock.split("plan")
        return plan

    def _put_right(self, scan: Scan | None, wheels: Array | None) -> Scan | None:
        """The scan as a good lidar had taken it; where calibration jumps, the estimate begins anew by the wheels."""
        known = self.calibration
        self.recalibrated = False
        if scan is None or wheels is None:
            known.pose = None
            return scan
        right = known.right(scan)
        self.recalibrated = known.jumps(right, wheels)
        if known.pose is None or not self.recalibrated:
            return right
        self.estimator.reset(known.pose, FOUND_SIGMA)
        self._forget_tracks()
        return known.right(scan)

    def _calibrate(self, scan: Scan | None, predicted: Array, wheels: Array | None) -> dict[str, float]:
        """Signals of the calibration, after a scan that was put right, and a pose (3,) predicted by the wheels."""
        known, spread = self.calibration, np.sqrt(np.diag(self.estimator.covariance))
        placed = self.verdict.health is not Health.LOST and not self.estimator.refused
        sure = placed and bool((spread < DECIMETRE).all())
        trusted = "wheels" not in self.validator.refused and not self.recalibrated
        known.note(scan if sure else None, predicted, self.estimator.pose, wheels if trusted else None)
        mount, bias = np.abs(known.used).tolist()
        return {"mount": mount, "bias": bias, "scale": known.scale_jump}

    def _forget_tracks(self) -> None:
        """Begin anew with what no map shows."""
        self.tracker, self.points = DiscTracker(self._map), PointWatch()
        self.tracks = Tracks.none()

    def _plan(self, pose: Array, route: Route, share: float) -> Plan:
        """Along the route, at a share of the speed."""
        s = self.controller.settings
        if self.planless or share < 1.0:
            self.controller.settings = replace(s, speed=share * s.speed, feasible=-1.0 if self.planless else s.feasible)
        reference = self._reference(pose, route)
        plan = self.controller.plan(pose, reference, self.tracks, self.estimator.covariance)
        self.controller.settings = s
        self.pose = self.controller.estimate
        return plan

    def _reference(self, pose: Array, route: Route) -> Array:
        """(N + 1, 3) poses along the path, which wait for movers."""
        stations, movers, s = self.controller.stations(), self.tracks.at(self.tracks.mover), self.controller.settings
        fastest = min(s.speed, float(s.box[1][0]))
        if not len(movers) or not fastest or isinstance(self.controller, PlannerAdapter):
            return route.reference(pose, stations)
        steps = s.dt * fastest * np.arange(LOOK + 1.0)

        def waits() -> Array:
            return steps[waiting(s, pose, route.reference(pose, steps)[:, :2], movers)[: len(stations)]]

        found = waits()
        pause = max(fastest - self.driven[0], 0.0) / (2.0 * s.accelerations[0])
        if found[-1] < HELD * stations[-1] and route.around(pose, self.tracks, fastest, pause):
            self.controller.forget()
            found = waits()
        return route.reference(pose, np.minimum(stations, found))

    def _stop(self, plan: Plan, scan: Scan) -> Plan:
        """The plan, its first control slowed where beams say that its braking way is not free."""
        control = self.emergency_stop.control(plan.control, self.driven, scan)
        self.slowed = control is not plan.control and not np.array_equal(control, plan.control)
        if not self.slowed:
            return plan
        self.controller.driven(control)
        return replace(plan, controls=np.concatenate([control[None], plan.controls[1:]]))

    def _rest(self, pose: Array) -> Plan:
        """Brake along the path of the last plan; nothing is solved."""
        self.slowed = False
        controls, states = self.controller.rest(pose)
        return Plan(controls, states, fg.Status.INTERRUPTED, 0, STOPPED, 0.0, 0.0)

    def _creep(self, creeping: Creeping, rest: Plan, scan: Scan) -> Plan:
        """The plan to rest, after one more control that leads to where places can be told apart."""
        s = self.controller.settings
        wanted, (speed, turn) = np.zeros(s.kind.size), creeping.control(scan, s.hull.bound)
        wanted[0], wanted[-1] = np.clip(speed, -s.speed, s.speed), s.kind.turning(turn, speed)
        wanted = self.driven + np.clip(wanted - self.driven, -s.most, s.most)
        plan = self._stop(replace(rest, controls=np.concatenate([wanted[None], rest.controls[1:]])), scan)
        if self.slowed and speed:
            creeping.blocked()
        self.controller.driven(plan.controls[0])
        return replace(plan, source=CREEPING)

    def _find_again(self, scan: Scan | None, wheels: Array | None) -> None:
        """Search the map while the robot is lost and rests or creeps, or drives where scans fit badly."""
        s, search, lost = self.controller.settings, self._search, self.verdict.health is Health.LOST
        self._doubt = self._doubt + 1 if self.share < FITS else 0
        if wheels is None or not lost:
            self._creeping = None
        elif self._creeping is not None:
            self._moved = s.kind.step(self._moved[None], wheels[None], s.dt)[0]
            self._creeping.moved(s.kind.of(wheels) * s.dt)
        slow = self._creeping is not None or not (np.abs(s.kind.of(self.driven)) > AT_REST).any()
        if scan is None or not (slow if lost else self._doubt >= DOUBTFUL):
            search.begin(None)
            self._elsewhere = 0.0
            return
        self._pause = max(0, self._pause - 1)
        if not search.searching and not self._pause:
            search.begin(scan)
            self._moved = np.zeros(3)
        result = search.search(PORTION if lost and not self.creeping else BESIDE)
        if result is None:
            return
        self._elsewhere = result.share - self.share if result.share >= BELIEVED and not lost else 0.0
        pose = refine(self._map, scan, SE2.compose(result.pose, self._moved)) if result.pose is not None else None
        if lost and pose is not None and fit(self._map, scan, pose) >= BELIEVED:
            self._creeping = None
            self.estimator.reset(pose, FOUND_SIGMA)
            self.pose, self.relocated, self.calibration.pose = self.estimator.pose, True, None
            self._forget_tracks()
        elif lost and len(result.rivals) > 1:
            self._creeping = self._creeping or Creeping(s.kind.turning_radius)
        self._pause = 0 if self.creeping else SEARCH_AGAIN

    def take_over(self, other: Pilot[PlannerT]) -> None:
        """Go on where another pilot, with another map, was."""
        self.validator, self.supervisor, self._signals = other.validator, other.supervisor, other._signals
        self.driven, self.share = other.driven, other.share
        self.calibration.take_over(other.calibration)


def make_pilot(
    coupling: str,
    occupancy: OccupancyMap,
    distance_map: DistanceMap,
    solver: str,
    settings: ControllerSettings,
    pose: Array,
    sigma: Array,
    beams: int,
    range_max: float = math.inf,
) -> Pilot[Controller]:
    """The pilot for a coupling.

    Args:
        coupling: "sequential", estimation first, then control given the estimate; "joint", one graph for both.
        occupancy: the map that the robot was given.
        distance_map: of it.
        solver: of the controller.
        settings: weights and limits.
        pose: (3,) believed at the start [m, m, rad].
        sigma: (3,) its standard deviations [m, m, rad].
        beams: number of beams in a scan.
        range_max: of the lidar [m].

    Raises:
        BackendError: for an unknown solver.
    """
    estimator: Estimator
    if coupling == "sequential":
        estimator = Localiser(distance_map, pose, sigma, beams, settings.kind)
        controller = Controller(distance_map, solver, settings)
    else:
        estimator = smoother = Smoother(distance_map, pose, sigma, beams, settings.dt, base=settings.kind)
        controller = Controller(distance_map, solver, settings, smoother.window)
    return Pilot(estimator, controller, DiscTracker(distance_map), occupancy, distance_map, beams, range_max)
