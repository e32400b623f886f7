"""Scenario ``quadrotor-mpc``: a quadrotor flies through an unknown corridor (Ta et al. 2014, section V-B).

Each tick: sense, estimate, plan, fly the first control. The past is a window of measurements, the future a horizon of
controls; how they meet is the coupling.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from unifg.codegen.compile_counter import counting
from unifg.errors import ScenarioError, UnifgError
from unifg.horizon import Plan
from unifg.models import quadrotor
from unifg.scenarios.episode import Progress, rehearse, run_ticks, silent
from unifg.scenarios.ground.protocols import load_class, name_of
from unifg.scenarios.logs.columns import Recorder
from unifg.scenarios.logs.flight_log import FlightLog, landmark_rows
from unifg.scenarios.options import Settings, count, not_negative, option, positive, share
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.quadrotor.estimator import EstimatorSettings
from unifg.scenarios.quadrotor.flight_pilot import COUPLINGS, make_pilot
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.quadrotor.flight_watch import FlightWatch
from unifg.scenarios.simulation.air import QuadrotorWorld
from unifg.scenarios.simulation.bearing_range import SensorModel
from unifg.scenarios.simulation.conditions import draw_conditions
from unifg.scenarios.simulation.disturbance import DisturbanceModel
from unifg.scenarios.simulation.faults import FLIGHT_FAULTS, Fault, FlightFaults, one_of
from unifg.typing import Array

__all__ = ["Flight", "FlightSettings", "run_flight"]

SCENARIO = "quadrotor-mpc"
REACHED_DISTANCE = 0.3  # [m], by belief and truth
REACHED_SPEED = 0.5  # [m/s], by belief and truth
SLOWEST_SHARE = 0.05  # of the speed of the reference; at rest nothing is planned
WORLDS = {
    "air": "unifg.scenarios.simulation.air:QuadrotorWorld",
    "mujoco": "unifg.scenarios.simulation.mujoco_flight:MujocoQuadrotor",
}
OF_WORLD = ("step(control, dt)", "sense()", "discs()", "clearance()")
CONFIRMATION = (4, 6)  # readings that show a cylinder before it is a landmark, and of how many, in clutter
COLLISIONS = 3  # with so many a flight is given up
ASTRAY = 10.0  # times as far from the target as the start is, a flight is given up

logger = logging.getLogger("unifg")


@dataclass(frozen=True)
class FlightSettings(Settings):
    """One flight.

    Attributes:
        solver: of the controller, one of `unifg.solvers.names.CONSTRAINED`.
        coupling: of estimation and control: without dynamics in the estimator; both with the same parameters; or one
            graph.
        seed: of everything random.
        movers: number of moving discs.
        mass_error: by which the mass is believed wrong at the start, relative, in [0, 1).
        speed: cruise [m/s]; None for that of the controller's guide.
        gusts: factor on the standard deviation of the gusts, which the robot is not told.
        misses: share of its sightings that the sensor of landmarks loses.
        clutter: cylinders that it sees in a reading and that are not there, on average.
        radius_error: standard deviation of the radii that it measures [m].
        world: simulation: "air", "mujoco", or a class of your own, MODULE:CLASS, with the arguments of
            `unifg.scenarios.simulation.air.QuadrotorWorld`.
        time_limit: after which a flight is given up [s].
        estimator: of the past; its association is the flight's.
        controller: of the future; its avoidance and horizon are the flight's.
        faults: what goes wrong; may be repeated.
    """

    solver: str = "ipm"
    coupling: str = option("sequential", choices=COUPLINGS)
    seed: int = option(0, metavar="S")
    movers: int = option(0, text=partial(count, most=200), metavar="K")
    mass_error: float = option(0.05, text=share, metavar="E")
    speed: float | None = option(None, text=positive, metavar="M/S")
    gusts: float = option(1.0, text=not_negative, metavar="FACTOR")
    misses: float = option(0.0, text=share, metavar="SHARE")
    clutter: float = option(0.0, text=not_negative, metavar="COUNT")
    radius_error: float = option(0.0, text=not_negative, metavar="M")
    world: str | type = option("air", text=str, metavar="NAME|MODULE:CLASS")
    time_limit: float = 60.0
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    faults: tuple[Fault, ...] = option(
        (), text=one_of(FLIGHT_FAULTS), metavar="KIND[=SIZE]@SECONDS[:DURATION]", flag="fault", many=True
    )

    def __post_init__(self) -> None:
        """Refuse a time that cannot be flown.

        Raises:
            ScenarioError: if the time limit is shorter than a tick, or infinite.
        """
        super().__post_init__()
        if not self.controller.dt <= self.time_limit < math.inf:
            raise ScenarioError(
                f"the time limit must be finite and no shorter than a tick of {self.controller.dt:g} s, "
                f"got {self.time_limit:g} s"
            )

    def summary(self) -> dict[str, Any]:
        """JSON values that say how the flight is made."""
        return {
            "scenario": SCENARIO,
            "solver": self.solver,
            "coupling": self.coupling,
            "seed": self.seed,
            "association": self.estimator.association,
            "avoidance": self.controller.avoidance,
            "movers": self.movers,
            "mass_error": self.mass_error,
            "gusts": self.gusts,
            "misses": self.misses,
            "clutter": self.clutter,
            "radius_error": self.radius_error,
            "world": name_of(self.world),
            "time_limit": self.time_limit,
            "window": self.estimator.window.length,
            "horizon": self.controller.horizon,
            "controller": asdict(self.flown),
            "faults": [str(fault) for fault in self.faults],
        }

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the vehicle."""
        return SensorModel(sigma_radius=self.radius_error, misses=self.misses, clutter=self.clutter)

    @property
    def known(self) -> EstimatorSettings:
        """Settings of the past: in clutter a cylinder needs confirmation, this one unless another is stated."""
        stated = self.estimator.confirmation != EstimatorSettings.confirmation
        return replace(self.estimator, confirmation=CONFIRMATION) if self.clutter and not stated else self.estimator

    @property
    def flown(self) -> ControllerSettings:
        """Of the controller, at the speed that was asked for."""
        if self.speed is None:
            return self.controller
        return replace(self.controller, guide=replace(self.controller.guide, speed=self.speed))


def run_flight(settings: FlightSettings, progress: Progress | None = None) -> FlightLog:
    """Run one flight; an interrupt from the keyboard ends it early and keeps what was recorded.

    Args:
        settings: what to fly.
        progress: called with the fraction done and a short text, once a tick.

    Raises:
        ScenarioError: when the seed, the movers or an option cannot be served.
    """
    return Flight(settings).run(progress or silent)


class Flight:
    """World and pilot of one run.

    Attributes:
        settings: what is flown.
        conditions: truth and first belief.
        world: the truth.
        pilot: what flies.
    """

    def __init__(self, settings: FlightSettings, *, rehearsal: bool = False) -> None:
        """Draw the world and wake the pilot, and rehearse unless this is a rehearsal."""
        self.settings = settings
        self.conditions = drawn = draw_conditions(settings.seed, settings.mass_error)
        calm, k = DisturbanceModel(), settings.gusts
        x, y, z = calm.gust
        gusty = replace(calm, gust=(k * x, k * y, k * z))
        of_world = load_class("world", settings.world, WORLDS, OF_WORLD, "storm:Storm")
        self.world: QuadrotorWorld = of_world(
            drawn.layout, settings.seed, drawn.true, settings.movers, disturbance=gusty, sensor=settings.sensor
        )
        error = settings.estimator.state_sigma * drawn.deviation
        believed = quadrotor.STATE.retract(self.world.state[None], error[None])[0]
        self.pilot = make_pilot(
            settings.coupling, settings.solver, drawn.layout, believed, drawn.nominal, settings.known,
            settings.flown,
        )  # fmt: skip
        self.faults = FlightFaults(settings.faults, settings.seed)
        self.watch = FlightWatch(settings.controller.dt, settings.estimator.parameters_sigma(drawn.nominal))
        self.pilot.pushed = self.watch.pushed
        self._speed = self.pilot.controller.guide.settings
        if not rehearsal:
            avoidance, association = settings.controller.avoidance, settings.estimator.association
            world, movers = name_of(settings.world), settings.movers > 0
            kind = SCENARIO, settings.coupling, settings.solver, avoidance, association, movers, world
            rehearse(kind, lambda: Flight(replace(settings, faults=()), rehearsal=True))

    def run(self, progress: Progress) -> FlightLog:
        """Fly to the target, or until it is no use; what was recorded is the `log` of an exception, too."""
        settings, world, dt = self.settings, self.world, self.settings.controller.dt
        recorder = Recorder(FlightLog, layout=world.layout, settings=settings.summary(), dt=dt)
        self._control: Array | None = None
        self._reached = self._landed = self._astray = False

        def finished(interrupted: bool, outcome: str) -> FlightLog:
            return recorder.finish(
                collisions=world.collisions, reached=self._reached, interrupted=interrupted, outcome=outcome,
                dropped=dict(self.watch.validator.dropped), subproblems=dict(self.pilot.controller.loop.subproblems),
            )  # fmt: skip

        try:
            interrupted = run_ticks(round(settings.time_limit / dt), lambda number: self._tick(recorder), progress)
            return finished(interrupted, self._outcome(interrupted))
        except (Exception, SystemExit) as error:
            vars(error)["log"] = finished(False, f"ended by {error!r}")
            raise

    def _outcome(self, interrupted: bool) -> str:
        """Outcome of the flight in words."""
        cause = self.watch.verdict.cause
        if self._reached or interrupted:
            return "reached" if self._reached else "interrupted"
        if self._landed:
            return f"landed: {cause}"
        if self.world.collisions >= COLLISIONS:
            return "given up after collisions"
        if self._astray:
            return "given up far away from the target"
        return "timed out" + (f": {cause}" if cause else "")

    def _tick(self, recorder: Recorder[FlightLog]) -> tuple[float, str] | None:
        """Decide and fly; None when the target is reached or the flight is given up."""
        world = self.world
        self._control = self._decide(recorder)
        self._reached = self._arrived(world.state) and self._arrived(self.pilot.belief.state)
        if self._reached:
            return None
        now, (gust_x, gust_y) = world.time, self.faults.wind(world.time)
        empty, load = self.conditions.true, 1.0 + self.faults.load(now)
        wind = empty.wind[0] + gust_x, empty.wind[1] + gust_y
        world.parameters = replace(empty, mass=load * empty.mass, wind=wind)
        world.step(self.faults.control(self._control, now), self.settings.controller.dt)
        self._landed = self.watch.lands and world.grounded
        target, start = world.layout.target, world.layout.start
        left, whole = (float(np.linalg.norm(target - place)) for place in (world.state[:3], start))
        self._astray = not left <= ASTRAY * whole  # also where it is nowhere
        if self._landed or self._astray or world.collisions >= COLLISIONS:
            return None
        return 1.0 - left / whole, f"{left:.1f} m to go"

    @contextlib.contextmanager
    def _going_on(self) -> Iterator[None]:
        """A robot in the air has to go on, whatever fails."""
        try:
            yield
        except (UnifgError, ArithmeticError, ValueError) as error:
            logger.warning("the tick at %.2f s failed, the vehicle brakes: %s", self.world.time, error)

    def _decide(self, recorder: Recorder[FlightLog]) -> Array:
        """Sense, estimate, plan and record; the control (4,) to be flown."""
        pilot, world, watch = self.pilot, self.world, self.watch
        reading = watch.admit(self.faults.reading(world.sense(), world.time), world.time, self._control, pilot.belief)
        plan: Plan | None = None
        told: Reading | None = None
        with counting() as new:
            applied = None if self._control is None else watch.felt.expected(self._control)
            with self._going_on():
                told = pilot.recognise(reading, applied, watch.felt.push)
            watch.judge(told, pilot.belief)
            verdict, guide = watch.verdict, pilot.controller.guide
            guide.settings = replace(self._speed, speed=max(verdict.share, SLOWEST_SHARE) * self._speed.speed)
            if told is not None:
                with self._going_on():
                    plan = pilot.decide(told)
        if self.faults.hold("solver-timeout", world.time):
            plan = None
        watch.planned(plan is not None and not plan.emergency)
        belief, settings = pilot.belief, self.settings.controller
        if plan is None or verdict.rests or watch.lands:
            plan, control = None, watch.hover(belief, *settings.box)
            pilot.controller.loop.abandon()
            pilot.controller.loop.applied = control.copy()
        else:
            control = plan.control
        control = watch.felt.asked(control, float(settings.box[1][3]))
        marks = belief.landmarks
        recorder.add(
            truth=world.state,
            believed=belief.state,
            believed_sigma=belief.sigma,
            controls=control,
            plans=np.tile(belief.state[:3], (settings.horizon + 1, 1)) if plan is None else plan.states[:, :3],
            pasts=pilot.estimator.window.history.states[:, :3],
            landmarks=landmark_rows(marks.ids, marks.positions, marks.covariances, marks.radii),
            parameters=belief.parameters.packed,
            parameters_sigma=belief.parameters_sigma,
            parameters_true=world.parameters.packed,
            seen=reading.ids,
            movers=world.discs()[:, :3],
            **pilot.clock.milliseconds,
            compiled=new.everything,
            statuses="failed" if plan is None else plan.status.name.lower().replace("_", " "),
            clearance=world.clearance(),
            emergency=plan is None or plan.emergency,
            health=verdict.health.value,
            causes=verdict.cause,
            fault=self.faults.names(world.time),
        )
        return control

    def _arrived(self, state: Array) -> bool:
        """Return True for a state (10,) at the target and slow."""
        away = np.linalg.norm(state[:3] - self.world.layout.target)
        return bool(away < REACHED_DISTANCE and np.linalg.norm(state[7:]) < REACHED_SPEED)
