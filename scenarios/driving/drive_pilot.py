"""How estimation and control are coupled: two graphs one after the other, or one graph for both."""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

from unifg.errors import ScenarioError
from unifg.horizon import Plan
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.driving.drive_control import Controller
from unifg.scenarios.driving.drive_past import Smoother
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.driving.localiser import Localiser
from unifg.scenarios.driving.route import Route
from unifg.scenarios.seeing.disc_tracker import DiscTracker
from unifg.scenarios.seeing.readings import Scan
from unifg.scenarios.seeing.tracks import Tracks
from unifg.scenarios.stopwatch import Stopwatch
from unifg.typing import Array

COUPLINGS = ("sequential", "joint")


class Estimator(Protocol):
    """What says where the robot is."""

    @property
    def iterations(self) -> int:
        """Of the last update."""
        ...

    @property
    def pose(self) -> Array:
        """(3,) present estimate [m, m, rad]."""
        ...

    @property
    def covariance(self) -> Array:
        """(3, 3) of it, in the tangent space."""
        ...

    def update(self, scan: Scan, odometry: Array | None, dt: float) -> None:
        """Take in a scan and the odometry (2,) since the last one, None on the first."""
        ...


class Planner(Protocol):
    """What says where to go."""

    settings: ControllerSettings

    @property
    def estimate(self) -> Array:
        """(3,) present pose as it is believed after the last plan [m, m, rad]."""
        ...

    def stations(self) -> Array:
        """(N + 1,) how far ahead along the path the reference is [m]."""
        ...

    def plan(self, pose: Array, reference: Array, tracks: Tracks, covariance: Array | None = None) -> Plan:
        """Decide the next control from a pose (3,), poses (N + 1, 3) along the route, discs, and the pose's (3, 3)."""
        ...

    def forget(self) -> None:
        """Drop the warm start, as when a new route makes it misleading."""
        ...


PlannerT = TypeVar("PlannerT", bound=Planner)


class Pilot(Generic[PlannerT]):
    """Estimates, looks for discs that no map shows, repairs the route, and plans along it.

    Attributes:
        estimator: of the pose, by the past alone.
        controller: of the drive.
        tracker: of discs.
        tracks: after the last tick.
        pose: (3,) present estimate [m, m, rad]; that of the joint solve, if there is one.
        iterations: of the estimator at the last tick.
        clock: how long the stages of the last tick took: localise, perceive, route, plan.
    """

    def __init__(self, estimator: Estimator, controller: PlannerT, tracker: DiscTracker) -> None:
        """Join what stands for itself."""
        self.estimator, self.controller, self.tracker = estimator, controller, tracker
        self.tracks = Tracks.none()
        self.clock = Stopwatch()
        self.pose = estimator.pose

    @property
    def iterations(self) -> int:
        """Iterations of the last estimate."""
        return self.estimator.iterations

    def tick(self, scan: Scan, odometry: Array | None, route: Route) -> Plan:
        """Decide; the estimate is that of the plan afterwards.

        Args:
            scan: of now.
            odometry: (2,) since the last scan; None at the first one.
            route: to follow.
        """
        s = self.controller.settings
        self.clock.start()
        self.estimator.update(scan, odometry, s.dt)
        self.clock.split("localise")
        pose = self.estimator.pose
        self.tracks = self.tracker.update(scan, pose, s.dt)
        self.clock.split("perceive")
        if route.repair(pose, self.tracks):
            self.controller.forget()
        self.clock.split("route")
        reference = route.reference(pose, self.controller.stations())
        plan = self.controller.plan(pose, reference, self.tracks, self.estimator.covariance)
        self.clock.split("plan")
        self.pose = self.controller.estimate
        return plan

    def forget(self) -> None:
        """Drop the warm start of the horizon."""
        self.controller.forget()


def make_pilot(
    coupling: str,
    distance_map: DistanceMap,
    solver: str,
    settings: ControllerSettings,
    pose: Array,
    sigma: Array,
    beams: int,
) -> Pilot[Controller]:
    """The pilot for a coupling.

    Args:
        coupling: "sequential", estimation first, then control given the estimate; "joint", one graph for both.
        distance_map: of the map that the robot was given.
        solver: of the controller.
        settings: weights and limits.
        pose: (3,) believed at the start [m, m, rad].
        sigma: (3,) its standard deviations [m, m, rad].
        beams: number of beams in a scan.

    Raises:
        ScenarioError: for an unknown coupling.
    """
    estimator: Estimator
    if coupling == "sequential":
        estimator = Localiser(distance_map, pose, sigma, beams)
        controller = Controller(distance_map, solver, settings)
    elif coupling == "joint":
        estimator = smoother = Smoother(distance_map, pose, sigma, beams, settings.dt)
        controller = Controller(distance_map, solver, settings, smoother.window)
    else:
        raise ScenarioError(f"unknown coupling '{coupling}': choose {' or '.join(COUPLINGS)}")
    return Pilot(estimator, controller, DiscTracker(distance_map))
