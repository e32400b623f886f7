"""Scenario ``navigation``: a unicycle localises itself by lidar and drives through a building under MPC.

Each tick: odometry predicts, the scan corrects (one factor graph), tracked discs are updated, the route is
repaired if a disc stands on it, and the controller (a second factor graph, conditioned on the estimate) decides.
Bazzana et al. 2022, sections IV, V and VII.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.files.ros_map import load_map
from unifg.horizon import Plan
from unifg.lie import wrap_angle
from unifg.machine.tally import counting
from unifg.models.distance_map import DistanceMap
from unifg.models.unicycle import step
from unifg.scenarios.driving.drive_pilot import Pilot, make_pilot
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.driving.route import Route
from unifg.scenarios.episode import Progress, rehearse, run_ticks, silent
from unifg.scenarios.log.columns import Recorder
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.options import existing, option, pose, positive
from unifg.scenarios.rivals.choices import (
    LOCALISERS,
    OWN_LOCALISER,
    OWN_PLANNER,
    PLANNERS,
    make_localiser,
    make_planner,
)
from unifg.scenarios.seeing.readings import Scan
from unifg.scenarios.ways.polyline import path_length
from unifg.scenarios.worlds.building import DEMO_GOALS, DEMO_START, building_map
from unifg.scenarios.worlds.drivetrain import Drivetrain, draw_patches
from unifg.scenarios.worlds.placement import PlacementRules, place_obstacles
from unifg.scenarios.worlds.plane import World
from unifg.typing import Array

INITIAL_SIGMA = (0.1, 0.1, 0.05)  # [m, m, rad]
REACHED_DISTANCE = 0.1  # [m], by the estimate
REACHED_HEADING = 0.1  # [rad]
TRUE_DISTANCE = 0.2  # [m], what the truth must confirm
TRUE_HEADING = 0.2  # [rad]
SLOWEST = 0.25  # [m/s]; an episode that needs longer than this, and a minute, has failed


@dataclass(frozen=True)
class NavigationSettings:
    """One episode.

    Attributes:
        map: ROS map file; without one, the building that ships with the package.
        start: true start pose [m, m, rad]; without one, on the shipped map, the demonstration's.
        goals: poses to be reached in this order, an option for each; without any, the demonstration's.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
        coupling: of estimation and control: estimation first, then control conditioned on it; or one graph for both.
        obstacles: number of obstacles that are not on the map; one in three moves.
        mover_speed: speed of those that move [m/s], which the robot is not told.
        courteous: whether they wait for a robot at rest; else they go on through it.
        seed: of everything random.
        controller: weights and limits.
        drivetrain: of the base; the controller is told the accelerations on its data sheet.
        planner: of the motion along the route: that of this library, or one of others to compare with.
        localiser: of the estimate: that of this library, or another one to compare with.
    """

    map: Path | None = option(None, text=existing("the YAML file of a ROS map"), metavar="F.yaml")
    start: tuple[float, float, float] | None = option(None, text=pose, metavar="X,Y,TH")
    goals: tuple[tuple[float, float, float], ...] | None = option(
        None, text=pose, metavar="X,Y,TH", flag="goal", many=True
    )
    solver: str = "ipm"
    coupling: str = option("sequential", choices=("sequential", "joint"))
    obstacles: int = option(0, metavar="K")
    mover_speed: float = option(0.3, text=positive, metavar="M/S")
    courteous: bool = option(False)
    seed: int = option(0, metavar="S")
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    drivetrain: Drivetrain = field(default_factory=Drivetrain)
    planner: str = option(OWN_PLANNER, choices=PLANNERS)
    localiser: str = option(OWN_LOCALISER, choices=LOCALISERS)


def run_navigation(settings: NavigationSettings, progress: Progress | None = None) -> EpisodeLog:
    """Run one episode.

    Args:
        settings: what to run.
        progress: called with the fraction done and a short text, once a tick.

    Raises:
        ScenarioError: when start, goals or obstacles do not fit the map, or an option is unknown.
    """
    return Episode(settings).run(progress or silent)


class Episode:
    """World, robot and goals of one run."""

    def __init__(self, settings: NavigationSettings, *, rehearsal: bool = False) -> None:
        """Load the map, plan the legs, place the obstacles, wake the robot, and rehearse unless this is a rehearsal."""
        self.settings = settings
        self.controller = control = replace(settings.controller, accelerations=settings.drivetrain.sheet)
        if settings.coupling != "sequential":
            for word, chosen, own in (
                ("planner", settings.planner, OWN_PLANNER),
                ("localiser", settings.localiser, OWN_LOCALISER),
            ):
                if chosen != own:
                    raise ScenarioError(f"the {word} '{chosen}' stands for itself: its coupling is 'sequential'")
        self.occupancy = building_map() if settings.map is None else load_map(settings.map)
        self.start = _pose(settings.start, DEMO_START if settings.map is None else None, "start")
        if settings.goals is None and settings.map is not None:
            raise ScenarioError("a map of your own needs at least one --goal=X,Y,THETA")
        goals = DEMO_GOALS if settings.goals is None else settings.goals
        self.goals = np.array([_pose(goal, None, "goal") for goal in goals])
        if not len(self.goals):
            raise ScenarioError("at least one goal is needed")
        self.distance_map = DistanceMap.from_occupancy(
            self.occupancy.occupied, self.occupancy.resolution, self.occupancy.origin
        )
        legs = zip([self.start, *self.goals[:-1]], self.goals, strict=True)
        self.legs = [self._route(begin, end) for begin, end in legs]
        self.path = np.concatenate([leg.path for leg in self.legs])
        placement, sensors, belief, floor, drawn = np.random.default_rng(settings.seed).spawn(5)
        discs = place_obstacles(
            self.occupancy,
            self.distance_map,
            self.path,
            settings.obstacles,
            placement,
            start=self.start,
            goals=self.goals,
            rules=PlacementRules(speed=settings.mover_speed),
        )
        self.world = World(
            self.occupancy, self.start, discs, sensors, robot_radius=control.robot_radius,
            drivetrain=settings.drivetrain, patches=draw_patches(settings.drivetrain, self.path, floor),
            courteous=settings.courteous,
        )  # fmt: skip
        sigma = np.array(INITIAL_SIGMA)
        believed = self.start + sigma * belief.standard_normal(3)
        pilot: Pilot[Any] = make_pilot(
            settings.coupling, self.distance_map, settings.solver, control, believed, sigma, self.world.lidar.beams
        )
        of_planner, of_localiser = drawn.spawn(2)
        planner = make_planner(settings.planner, self.distance_map, control, of_planner)
        localiser = make_localiser(settings.localiser, self.occupancy, self.distance_map, believed, sigma, of_localiser)
        if planner is not None:
            pilot.controller = planner
        if localiser is not None:
            pilot.estimator, pilot.pose = localiser, localiser.pose
        self.pilot = pilot
        if not rehearsal:
            kind = "navigation", settings.coupling, settings.solver, settings.planner, settings.localiser
            rehearse(kind, lambda: Episode(settings, rehearsal=True))

    def run(self, progress: Progress) -> EpisodeLog:
        """Tick until the last goal is reached or time is up."""
        length, s = path_length(self.path), self.settings
        self._recorder = Recorder(
            EpisodeLog,
            occupancy=self.occupancy,
            path=self.path,
            goals=self.goals,
            start=self.start,
            dt=s.controller.dt,
            robot_radius=s.controller.robot_radius,
            solver=s.solver if s.planner == OWN_PLANNER else s.planner,
            coupling=s.coupling,
            seed=s.seed,
            control_limits=s.controller.limits,
            scan_angles=self.world.lidar.angles,
            obstacle_moving=self.world.obstacle_states()[:, 3].astype(bool),
        )
        self._reached = [False] * len(self.goals)
        self._goal, self._driven, self._dead_reckoning = 0, 0.0, self.pilot.pose
        limit = int((length / SLOWEST + 60.0) / s.controller.dt)
        interrupted = run_ticks(limit, lambda number: self._tick(number, length), progress)
        return self._recorder.finish(
            collisions=self.world.collisions,
            reached=self._reached,
            interrupted=interrupted,
        )

    def _tick(self, number: int, length: float) -> tuple[float, str] | None:
        """Move on from the last tick, scan, decide, record and drive; None at the last goal."""
        dt, goal = self.settings.controller.dt, self._goal
        odometry = None
        if number:
            odometry = np.array(self.world.odometry())
            self._dead_reckoning = step(self._dead_reckoning[None], odometry[None], dt)[0]
            self._driven += abs(odometry[0]) * dt
        scan = self.world.scan()
        with counting() as new:
            plan = self.pilot.tick(scan, odometry, self.legs[goal])
        self._record(scan, plan, new.everything)
        if self._arrived(goal):
            self._reached[goal] = self._confirmed(goal)
            self._goal = goal = goal + 1
            if goal == len(self.goals):
                return None
            self.legs[goal] = self._route(self.pilot.pose, self.goals[goal])
            self.pilot.forget()
        self.world.step(float(plan.control[0]), float(plan.control[1]), dt)
        return self._driven / length, f"goal {goal + 1}/{len(self.goals)}"

    def _record(self, scan: Scan, plan: Plan, compiled: int) -> None:
        """Keep what this tick leaves behind; the measured time is what a robot would spend."""
        pilot, world = self.pilot, self.world
        took = pilot.clock.milliseconds
        self._recorder.add(
            time=world.time,
            true_pose=world.pose,
            estimate=pilot.pose,
            dead_reckoning=self._dead_reckoning,
            covariance=pilot.estimator.covariance,
            control=plan.control,
            route=self.legs[self._goal].path,
            contacts=world.collisions,
            horizon=plan.states,
            scan=scan.ranges,
            obstacles=world.obstacle_states()[:, :3],
            detected=np.column_stack([pilot.tracks.centre, pilot.tracks.radius]),
            solve_ms=took["localise_ms"] + took["plan_ms"],
            **took,
            compiled=compiled,
            localisation_iterations=pilot.iterations,
            plan_iterations=plan.iterations,
            status=plan.status.name.lower(),
            bound_violation=plan.excess,
            clearance=world.clearance(),
            goal_index=self._goal,
            emergency=plan.emergency,
            rescued=plan.rescued,
        )

    def _route(self, begin: Array, end: Array) -> Route:
        return Route(self.occupancy, self.distance_map, begin, end, self.settings.controller.robot_radius)

    def _arrived(self, goal: int) -> bool:
        return _near(self.pilot.pose, self.goals[goal], REACHED_DISTANCE, REACHED_HEADING)

    def _confirmed(self, goal: int) -> bool:
        """Whether the robot truly is where it believes to have arrived."""
        return _near(self.world.pose, self.goals[goal], TRUE_DISTANCE, TRUE_HEADING)


def _near(pose: Array, goal: Array, distance: float, heading: float) -> bool:
    error = pose - goal
    turn = abs(float(wrap_angle(error[2])))
    return bool(np.hypot(error[0], error[1]) < distance and turn < heading)


def _pose(given: object, default: tuple[float, float, float] | None, what: str) -> Array:
    if given is None:
        if default is None:
            raise ScenarioError(f"a map of your own needs --{what}=X,Y,THETA")
        given = default
    pose = np.asarray(given, dtype=np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ScenarioError(f"{what} must be three finite numbers x, y, theta; found {given!r}")
    return pose


__all__ = ["Episode", "NavigationSettings", "run_navigation"]
