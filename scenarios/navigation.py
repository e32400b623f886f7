"""Scenario ``navigation``: a robot localises itself by lidar and drives through a building under MPC.

Each tick: odometry predicts, the scan corrects (one factor graph), tracked discs are updated, the route is
repaired if a disc stands on it, and the controller (a second factor graph, conditioned on the estimate) decides.
Bazzana et al. 2022, sections IV, V and VII. A supervisor lowers the speed, down to rest, with what the robot has to
rely on; a goal that cannot be reached is given up, by name, and the next one is tried.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from unifg.codegen.compile_counter import counting
from unifg.errors import ScenarioError
from unifg.files.contents import Limits
from unifg.files.ros_map import OccupancyMap, load_map
from unifg.horizon import Plan
from unifg.lie import wrap_angle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.episode import Progress, rehearse, run_ticks, silent
from unifg.scenarios.ground.drive_parts import bounds
from unifg.scenarios.ground.drive_pilot import UNSOLVED, Pilot, make_pilot
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.local_planner import PlannerContext, load_planner
from unifg.scenarios.ground.protocols import Judged, LocaliserContext, constructed, load_class, name_of
from unifg.scenarios.ground.route import Blocked, Route
from unifg.scenarios.logs.columns import Recorder
from unifg.scenarios.logs.drive_log import Assumed, EpisodeLog
from unifg.scenarios.options import Positive, Settings, Signed, count, existing, option, pair, pose, positive
from unifg.scenarios.perception.monte_carlo import MonteCarlo
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.planning.polyline import path_length
from unifg.scenarios.simulation.building import DEMO_GOALS, DEMO_START, building_map
from unifg.scenarios.simulation.drivetrain import PLANTS, Drivetrain, plant
from unifg.scenarios.simulation.faults import DRIVE_FAULTS, DriveFaults, Fault, one_of
from unifg.scenarios.simulation.imperfection import Imperfection, imperfect
from unifg.scenarios.simulation.placement import PlacementRules, place_obstacles
from unifg.scenarios.simulation.plane import LidarModel, OdometryModel
from unifg.scenarios.simulation.traffic import Traffic, draw_traffic
from unifg.typing import Array

INITIAL_SIGMA = (0.1, 0.1, 0.05)  # [m, m, rad]
REACHED_DISTANCE = 0.1  # [m], by the estimate
REACHED_HEADING = 0.1  # [rad]
TRUE_DISTANCE = 0.2  # [m], what the truth must confirm
TRUE_HEADING = 0.2  # [rad]
USUAL_SIGMA = 0.01  # [m] of a position localised on a map
SURE = 3.0  # standard deviations of the estimate that have to fit between what is believed and what must be true
BESIDE_DISC = 0.08  # [m] beyond the radius that obstacles leave of a way
BESIDE = 0.01  # [m] from walls beyond the radius, from where a way is looked for
FREEING = 20  # steps to there
SLOWEST = 0.25  # [m/s]; a goal that takes longer than this, and a minute, is given up
HELPLESS = 20.0  # [s] that a robot that may not move waits before it gives up
REACHED = "reached"
MPC = "mpc"
LOCALISERS = ("graph", "amcl")
WORLDS = {
    "plane": "unifg.scenarios.simulation.plane:World",
    "mujoco": "unifg.scenarios.simulation.mujoco_drive:MujocoDrive",
}
OF_LOCALISER = ("update(scan, odometry, dt)", "reset(pose, sigma)")
OF_WORLD = ("step(*control, dt)", "power(on)", "scan()", "odometry()", "discs()", "clearance()")
LARGEST = Limits(pixels=200_000_000)  # of a map that a user names: 700 m by 700 m at 0.05 m


@dataclass(frozen=True)
class NavigationSettings(Settings):
    """One episode.

    Attributes:
        map: ROS map file; without one, the building that ships with the package.
        start: true start pose [m, m, rad]; without one, on the shipped map, the demonstration's.
        goals: poses to be reached in this order, an option for each; without any, the demonstration's.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
        coupling: of estimation and control: estimation first, then control conditioned on it; or one graph for both.
        believed: pose at the start as the robot believes it; without one it is drawn about the true one.
        initial_sigma: standard deviations of that belief [m, m, rad].
        obstacles: greatest number of obstacles that are not on the map; one in three moves.
        obstacle_radius: least and greatest radius of them [m]; the robot expects what the default says.
        mover_speed: speed of those that move [m/s], which the robot is not told.
        traffic: people.
        seed: of everything random.
        controller: weights and limits.
        plant: base whose numbers the drivetrain has where they are not given: "light", PAL's "pmb2", or "harsh", with
            lag, latency and slip besides.
        drivetrain: of the base; the controller is told the accelerations on its data sheet.
        lidar: as it is; what the robot believes of it is its own.
        odometry: likewise.
        imperfection: of the robot's map.
        planner: of the motion along the route: "mpc", the controller of this library, or a class of your own,
            MODULE:CLASS, as `unifg.scenarios.ground.local_planner` describes it.
        localiser: of the estimate: "graph", that of this library, "amcl", a Monte Carlo localiser to compare with, or
            a class of your own, MODULE:CLASS, constructed with a `LocaliserContext`.
        world: simulation: "plane", "mujoco", or a class of your own, MODULE:CLASS, with the arguments of
            `unifg.scenarios.simulation.plane.World`.
        faults: what goes wrong; may be repeated.
        log: recorded drive that the localiser follows on the map, in the place of a simulated one.
    """

    map: Path | None = option(None, text=existing("the YAML file of a ROS map"), metavar="F.yaml")
    start: Signed[tuple[float, float, float]] | None = option(None, text=pose, metavar="X,Y,TH")
    goals: tuple[tuple[float, float, float], ...] | None = option(
        None, text=pose, metavar="X,Y,TH", flag="goal", many=True
    )
    solver: str = "ipm"
    coupling: str = option("sequential", choices=("sequential", "joint"))
    obstacles: int = option(0, text=partial(count, most=200), metavar="K")
    obstacle_radius: Positive[tuple[float, float]] = option(
        (0.15, 0.25), text=partial(pair, equal=True), metavar="LO,HI"
    )
    mover_speed: float = option(0.3, text=positive, metavar="M/S")
    traffic: Traffic = field(default_factory=Traffic)
    seed: int = option(0, metavar="S")
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    drivetrain: Drivetrain = field(default_factory=Drivetrain)
    lidar: LidarModel = field(default_factory=LidarModel)
    odometry: OdometryModel = field(default_factory=OdometryModel)
    imperfection: Imperfection = field(default_factory=Imperfection)
    planner: str | type = option(MPC, text=str, metavar="MODULE:CLASS")
    localiser: str | type = option(LOCALISERS[0], text=str, metavar="NAME|MODULE:CLASS")
    world: str | type = option("plane", text=str, metavar="NAME|MODULE:CLASS")
    faults: tuple[Fault, ...] = option(
        (), text=one_of(DRIVE_FAULTS), metavar="KIND[=SIZE]@SECONDS[:DURATION]", flag="fault", many=True
    )
    believed: Signed[tuple[float, float, float]] | None = option(None, text=pose, metavar="X,Y,TH")
    initial_sigma: Positive[tuple[float, float, float]] = option(INITIAL_SIGMA, text=pose, metavar="X,Y,TH")
    plant: str = option("light", choices=tuple(PLANTS))
    log: Path | None = option(None, text=existing("a log of a laser", folders=True), metavar="LOG")

    def __post_init__(self) -> None:
        """Refuse a planner or a localiser in one graph with something else."""
        super().__post_init__()
        for word, chosen, default in (("planner", self.planner, MPC), ("localiser", self.localiser, LOCALISERS[0])):
            if self.coupling != "sequential" and chosen != default:
                raise ScenarioError(f"the {word} '{name_of(chosen)}' stands for itself: its coupling is 'sequential'")


def run_navigation(settings: NavigationSettings, progress: Progress | None = None) -> EpisodeLog:
    """Run one episode.

    Args:
        settings: what to run.
        progress: called with the fraction done and a short text, once a tick.

    An exception that a world of the user's raises in a tick has the attribute ``log``: what was recorded before.

    Raises:
        ScenarioError: when start, goals or obstacles do not fit the map, or an option is unknown.
    """
    return Episode(settings).run(progress or silent)


class Episode:
    """World, robot and goals of one run."""

    def __init__(self, settings: NavigationSettings, *, rehearsal: bool = False) -> None:
        """Load the map, plan the legs, place the obstacles, wake the robot, and rehearse unless this is a rehearsal."""
        settings = replace(settings, drivetrain=plant(settings.plant, settings.drivetrain))
        self.settings = settings
        self.controller = control = replace(settings.controller, accelerations=settings.drivetrain.sheet)
        self._localiser = (
            None
            if settings.localiser in LOCALISERS
            else load_class("localiser", settings.localiser, LOCALISERS, OF_LOCALISER, "my:Filter")
        )
        least, most = settings.obstacle_radius
        if not 0.0 < least <= most < np.inf:
            raise ScenarioError(f"obstacles have radii 0 < least <= greatest, got {least:g} and {most:g} m")
        self.occupancy = building_map() if settings.map is None else load_map(settings.map, LARGEST)
        self.start = _pose(settings.start, DEMO_START if settings.map is None else None, "start")
        if settings.goals is None and settings.map is not None:
            raise ScenarioError("a map of your own needs at least one --goal=X,Y,THETA")
        goals = DEMO_GOALS if settings.goals is None else settings.goals
        self.goals = np.array([_pose(goal, None, "goal") for goal in goals])
        if not len(self.goals):
            raise ScenarioError("at least one goal is needed")
        placement, sensors, belief, _, drawn, wrong, about = np.random.default_rng(settings.seed).spawn(7)
        self.occupancy, true = imperfect(self.occupancy, settings.imperfection, self.start, self.goals, wrong)
        self.distance_map = _field(self.occupancy)
        legs = zip([self.start, *self.goals[:-1]], self.goals, strict=True)
        self.legs = [self._route(begin, end) for begin, end in legs]
        self.path = np.concatenate([leg.path for leg in self.legs])
        rules = PlacementRules(
            radius=settings.obstacle_radius,
            speed=settings.mover_speed,
            way_clearance=max(PlacementRules.way_clearance, control.robot_radius + BESIDE_DISC),
        )
        discs = place_obstacles(
            self.occupancy,
            self.distance_map,
            self.path,
            settings.obstacles,
            placement,
            start=self.start,
            goals=self.goals,
            rules=rules,
        )
        self._true = true
        walls = _field(true) if settings.imperfection != Imperfection() else self.distance_map
        of_world = load_class("world", settings.world, WORLDS, OF_WORLD, "fog:Fog")
        self.world = of_world(
            true, self.start, discs, sensors, base=control.kind, body=control.hull, lidar=settings.lidar,
            odometry=settings.odometry, drivetrain=settings.drivetrain,
            people=draw_traffic(settings.traffic, walls, self.path, about),
        )  # fmt: skip
        sigma = np.array(settings.initial_sigma)
        believed = self.start + sigma * belief.standard_normal(3)
        if settings.believed is not None:
            believed = _pose(settings.believed, None, "believed")
        self.faults = DriveFaults(settings.faults, settings.seed, control.kind, range_max=settings.lidar.range_max)
        self._right, self._drawn = (self.occupancy, self.distance_map), drawn
        self.pilot = self._pilot(believed, sigma)
        if not rehearsal:
            kind = (
                "navigation",
                settings.coupling,
                settings.solver,
                name_of(settings.planner),
                name_of(settings.localiser),
                name_of(settings.world),
                control.avoidance,
                control.base,
                len(control.hull.discs),
            )
            rehearse(kind, lambda: Episode(replace(settings, faults=()), rehearsal=True))

    def _pilot(self, pose: Array, sigma: Array) -> Pilot[Any]:
        """Make the pilot with the present map of the robot."""
        settings = self.settings
        pilot: Pilot[Any] = make_pilot(
            settings.coupling, self.occupancy, self.distance_map, settings.solver, self.controller, pose, sigma,
            self.world.lidar.beams, self.world.lidar.range_max,
        )  # fmt: skip
        of_planner, of_localiser = self._drawn.spawn(2)
        if settings.planner != MPC:
            context = PlannerContext(self.distance_map, self.controller, of_planner)
            pilot.controller = load_planner(settings.planner, context)
        if settings.localiser == "amcl":
            pilot.estimator = MonteCarlo(
                self.occupancy, self.distance_map, pose, sigma, of_localiser, base=self.controller.kind
            )
        elif self._localiser is not None:
            own = LocaliserContext(
                self.occupancy, self.distance_map, pose, sigma, self.world.lidar.beams, self.controller.kind,
                of_localiser,
            )  # fmt: skip
            pilot.estimator = Judged(constructed("localiser", self._localiser, own, ("pose", "covariance")))
        pilot.pose = pilot.estimator.pose
        return pilot

    def run(self, progress: Progress) -> EpisodeLog:
        """Tick until the last goal is reached or given up; what was recorded is the `log` of an exception, too."""
        self.begin()
        most = int(2.0 * sum(map(_longest, self.legs)) / self.settings.controller.dt)  # a detour doubles a way
        try:
            return self._finished(run_ticks(most, self._tick, progress))
        except (Exception, SystemExit) as error:
            self._outcomes[self._goal :] = [f"ended by {error!r}"] * (len(self.goals) - self._goal)
            vars(error)["log"] = self._finished(False)
            raise

    def _finished(self, interrupted: bool) -> EpisodeLog:
        """Close the log."""
        return self._recorder.finish(
            collisions=self.world.collisions,
            reached=[outcome == REACHED for outcome in self._outcomes],
            outcomes=self._outcomes,
            dropped=dict(self.pilot.validator.dropped),
            subproblems=dict(self.pilot.controller.loop.subproblems) if self.settings.planner == MPC else {},
            interrupted=interrupted,
        )

    def begin(self) -> None:
        """Open the log."""
        s = self.settings
        self._recorder = Recorder(
            EpisodeLog,
            occupancy=self.occupancy,
            walls=getattr(self.world, "occupancy", self._true),  # a world may have others
            assumed=Assumed(
                s.controller.sigmas,
                s.controller.wall_clearance,
                s.controller.disc_clearance,
                self.controller.accelerations[0],
                self.controller.mover_surprise,
            ),
            path=self.path,
            goals=self.goals,
            start=self.start,
            dt=s.controller.dt,
            robot_radius=s.controller.robot_radius,
            solver=s.solver if s.planner == MPC else name_of(s.planner),
            coupling=s.coupling,
            seed=s.seed,
            control_limits=tuple(s.controller.box[1].tolist()),
            base=s.controller.base,
            body=s.controller.body,
            scan_angles=self.world.lidar.angles,
            obstacle_moves=self.world.discs()[:, 3].astype(bool),
            faults=[str(fault) for fault in s.faults],
            obstacles_wanted=s.obstacles,
        )
        self._outcomes = ["time ran out"] * len(self.goals)
        self._goal, self._driven, self._dead_reckoning = 0, 0.0, self.pilot.pose
        self._begun, self._allowed, self._helpless = 0.0, 0.0, 0.0

    def _tick(self, number: int) -> tuple[float, str] | None:
        """Decide and drive; None at the last goal."""
        control = self.decide(number)
        if control is None:
            return None
        self.world.power(not self.pilot.power_off)
        self.world.computing = sum(self.pilot.clock.seconds.values())
        self.world.step(*control, dt=self.settings.controller.dt)
        return self._driven / path_length(self.path), f"goal {self._goal + 1}/{len(self.goals)}"

    def decide(self, number: int) -> tuple[float, ...] | None:
        """Move on from the last tick, scan, decide and record; the control to be driven, None at the last goal."""
        dt, goal, now = self.settings.controller.dt, self._goal, self.world.time
        faults = self.faults
        if faults.carries(now):
            self.world.carry(faults.elsewhere(self._right[1], self._free_places(), self.world.pose))
        self._swap_maps(now)
        odometry = None
        if number:
            measured = _told("odometry", self.world.odometry(), (self.controller.kind.size,))
            moved = np.where(np.isfinite(measured), measured, 0.0)  # the record goes on without a sample of a world
            self._dead_reckoning = self.controller.kind.step(self._dead_reckoning[None], moved[None], dt)[0]
            self._driven += float(np.hypot(*moved[:2]) if self.controller.kind.slides else abs(moved[0])) * dt
            odometry = faults.odometry(measured, now)
        directions = self.world.lidar.angles
        told, beams = self.world.scan(), (len(directions),)
        if told is None:  # of a user's world, whose lidar has not answered
            told = Scan(directions, np.full(beams, np.nan))
        true_scan = Scan(_told("scan", told.angles, beams), _told("scan", told.ranges, beams), told.time, told.turn)
        self.pilot.planless = faults.hold("solver-timeout", now)
        seen = faults.scan(true_scan, now)
        if not number:
            self.pilot.wake(seen, now)
            self._begin_leg(goal)
        with counting() as new:
            plan = self.pilot.tick(seen, odometry, self.legs[goal], now, first=not number)
        self._record(true_scan, plan, new.everything)
        outcome = self._outcome(goal)
        if outcome is not None:
            self._outcomes[goal] = outcome
            self._goal = goal = goal + 1
            if goal == len(self.goals) or self._hopeless():
                self._outcomes[goal:] = [outcome] * (len(self.goals) - goal)
                return None
            self._begin_leg(goal)
        elif self.pilot.relocated:
            self._begin_leg(goal)
        asked = np.array(plan.control, dtype=np.float64)
        return tuple(faults.control(asked, now, dt).tolist())

    def _outcome(self, goal: int) -> str | None:
        """Outcome of a goal; None while the robot is on its way."""
        pilot, dt = self.pilot, self.settings.controller.dt
        helpless = (pilot.verdict.rests and not pilot.creeping) or pilot.planless_for > dt
        self._helpless = self._helpless + dt if helpless else 0.0
        if self._arrived(goal):
            if _near(self.world.pose, self.goals[goal], TRUE_DISTANCE, TRUE_HEADING):
                return REACHED
            away = float(np.hypot(*(self.world.pose - self.goals[goal])[:2]))
            return f"believed to be reached, {away:.2f} m away"
        if self._hopeless():
            return f"{pilot.verdict.health.value}: {pilot.verdict.cause}"
        leg = self.legs[goal]
        if leg.blocked is not None and not pilot.verdict.cause:
            return str(leg.blocked)
        self._allowed = max(self._allowed, _longest(leg))  # of the longest way so far: what is left gets short
        if self.world.time - self._begun > self._allowed:
            return "timed out" + (f": {pilot.verdict.cause}" if pilot.verdict.cause else "")
        return None

    def _hopeless(self) -> bool:
        """Return True if the robot has not been allowed to move for so long that it gives up all goals."""
        return self._helpless > HELPLESS

    def _begin_leg(self, goal: int) -> None:
        """Plan to a goal from where the robot believes to be; without a way it is given up at the next tick."""
        self._begun, self._allowed = self.world.time, 0.0
        self.pilot.controller.forget()
        try:
            self.legs[goal] = self._route(self._freed(self.pilot.pose), self.goals[goal])
        except ScenarioError:
            gap = self.controller.robot_radius + self._gaps()[0]
            self.legs[goal].blocked = Blocked(self.pilot.pose[:2].copy(), gap)

    def _freed(self, pose: Array) -> Array:
        """A pose, or one beside it that is not too near to a wall to begin a way there."""
        found, least = pose.copy(), self.controller.robot_radius + BESIDE
        for _ in range(FREEING):
            distance, slope = self.distance_map.distance_and_gradient(found[:2])
            if distance >= least or self.controller.oriented:
                break
            found[:2] += (least - distance) * slope / max(float(np.hypot(*slope)), 1e-9)
        return found

    def _gaps(self) -> tuple[float, float]:
        """Between hull and walls, hull and discs, as the controller keeps them of an estimate as sure as usual [m]."""
        s = self.controller
        return s.wall_clearance + s.sigmas * USUAL_SIGMA, s.disc_clearance + s.sigmas * USUAL_SIGMA

    def _swap_maps(self, now: float) -> None:
        """Give the robot the wrong map while that fault holds, and the right one before and after."""
        wrong = self.faults.hold("wrong-map", now)
        if wrong == (self.occupancy is not self._right[0]):
            return
        before = self.pilot
        self.occupancy, self.distance_map = self._right
        if wrong:
            self.occupancy = askew(self.occupancy, before.pose)
            self.distance_map = _field(self.occupancy)
        self.pilot = self._pilot(before.pose, np.array(self.settings.initial_sigma))
        self.pilot.take_over(before)

    def _free_places(self) -> Array:
        """(n, 2) centres of free cells [m]."""
        occupancy = self._right[0]
        return occupancy.grid_to_world(np.argwhere(occupancy.free)[:, ::-1].astype(np.float64) + 0.5)

    def _record(self, scan: Scan, plan: Plan, compiled: int) -> None:
        """Keep what this tick leaves behind; the measured time is what a robot would spend."""
        pilot, world = self.pilot, self.world
        took, verdict = pilot.clock.milliseconds, pilot.verdict
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
            way_out=pilot.controller.way_out,
            scan=scan.ranges,
            obstacles=world.discs()[:, :3],
            detected=np.column_stack([pilot.tracks.centre, pilot.tracks.radius]),
            expected=bounds(self.controller, pilot.tracks),
            solve_ms=took["localise_ms"] + took["plan_ms"],
            **took,
            compiled=compiled,
            localisation_iterations=pilot.estimator.iterations,
            plan_iterations=plan.iterations,
            status=plan.source if plan.source in UNSOLVED else plan.status.name.lower(),
            bound_violation=plan.excess,
            clearance=world.clearance(),
            goal_index=self._goal,
            emergency=plan.emergency and plan.source not in UNSOLVED,
            rescued=plan.rescued,
            health=verdict.health.value,
            cause=verdict.cause,
            allowed=verdict.share,
            explained=pilot.share,
            emergency_stop=pilot.slowed,
            power_off=pilot.power_off,
            fault=self.faults.names(world.time),
        )

    def _route(self, begin: Array, end: Array) -> Route:
        s = self.controller
        return Route(
            self.occupancy, self.distance_map, begin, end, s.robot_radius, *self._gaps(), base=s.kind, body=s.hull
        )

    def _arrived(self, goal: int) -> bool:
        """Return True if the robot believes to be there, by an estimate that leaves room for being wrong.

        ``SURE`` standard deviations, in the worst direction, fit between where it believes to be and what the truth
        must confirm.
        """
        covariance, goal_pose = self.pilot.estimator.covariance, self.goals[goal]
        spread = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        off, turned = (SURE * np.sqrt(max(variance, 0.0)) for variance in (spread, float(covariance[2, 2])))
        if self.pilot.verdict.rests:
            return False
        distance, heading = min(REACHED_DISTANCE, TRUE_DISTANCE - off), min(REACHED_HEADING, TRUE_HEADING - turned)
        return _near(self.pilot.pose, goal_pose, distance, heading)


def askew(occupancy: OccupancyMap, pose: Array) -> OccupancyMap:
    """A map that is wrong: x and y exchanged about where a robot (3,) stands, so that it shows another building."""
    column, row = occupancy.world_to_grid(pose[:2]).tolist()
    x, y = np.array([row, column]) * occupancy.resolution
    yaw = occupancy.origin[2]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    origin = (float(pose[0] - cosine * x + sine * y), float(pose[1] - sine * x - cosine * y), yaw)
    occupied, free = occupancy.occupied.T.copy(), occupancy.free.T.copy()
    return OccupancyMap(occupied, free, occupancy.resolution, origin, f"{occupancy.name}, askew")


def _field(occupancy: OccupancyMap) -> DistanceMap:
    return DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)


def _longest(leg: Route) -> float:
    """Time that the way to a goal may take [s]."""
    return path_length(leg.path) / SLOWEST + 60.0


def _near(pose: Array, goal: Array, distance: float, heading: float) -> bool:
    error = pose - goal
    turn = abs(float(wrap_angle(error[2])))
    return bool(np.hypot(error[0], error[1]) < distance and turn < heading)


def _told(what: str, given: object, shape: tuple[int, ...]) -> Array:
    """An answer of the world, whose class may be a user's own, as an array of its shape."""
    told = np.array(given, dtype=np.float64)
    if told.shape != shape:
        raise ScenarioError(f"the world's {what} has shape {told.shape}, expected {shape}")
    return told


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
