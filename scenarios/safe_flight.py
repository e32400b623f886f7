"""Flight that must keep its distance (FactorMPC, section IV): a truth, what is seen of it, and who decides.

A vehicle that follows body rates and thrust late and softly, whose mass and drag are not those in the books, is seen a
hundred times a second. Who decides knows the vehicle from the books and, if asked to estimate, from how it has moved;
it knows how late its commands act and predicts where the vehicle will be when the next one does. Obstacles are seen
with their velocities; where they will be is guessed from that alone.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np

import unifg as fg
from unifg.models import quadrotor
from unifg.scenarios.episode import Progress, run_ticks, silent
from unifg.scenarios.logs.columns import Recorder
from unifg.scenarios.logs.safe_log import SafeLog
from unifg.scenarios.options import Positive, Settings, count, not_negative, number, option, positive
from unifg.scenarios.planning.flat_path import Line
from unifg.scenarios.quadrotor.cascade import CascadeSettings, Track
from unifg.scenarios.quadrotor.cbf_mpc import (
    TRACKING,
    WHOLE,
    CbfMpc,
    Decision,
    KeeperSettings,
    Obstacles,
    Reading,
    Terminal,
)
from unifg.scenarios.quadrotor.flatness import TUNED, FlatnessController, Gains, flat_flight
from unifg.scenarios.quadrotor.one_step import FilterSettings, filtered
from unifg.scenarios.quadrotor.pace import Pace
from unifg.scenarios.quadrotor.sightings import Sightings, SightingSettings
from unifg.scenarios.quadrotor.situations import Kind, Situation, situation
from unifg.scenarios.quadrotor.spline_planner import SplinePath, SplineSettings, around
from unifg.scenarios.quadrotor.state_filter import AIR, StateFilter
from unifg.scenarios.quadrotor.weighing import Weighing, WeighingSettings
from unifg.scenarios.simulation.body_rate import SUBSTEP, Airframe, BodyRatePlant, Loops
from unifg.scenarios.simulation.disturbance import DisturbanceModel, Disturbances
from unifg.typing import Array

__all__ = ["CONTROLLERS", "Controller", "Knowledge", "SafeFlight", "SafeSettings", "flights", "run_safe_flights"]

Controller = Literal["barrier", "flatness", "filter", "cascade", "spline"]
Knowledge = Literal["estimated", "books"]
Sight = Literal["exact", "noisy", "relative"]
CONTROLLERS: tuple[Controller, ...] = get_args(Controller)

_TAG = 72  # keeps the noise apart from other numbers of the same seed


class _Swept(NamedTuple):
    alpha: tuple[float, ...] = (1.2,)
    gamma: tuple[float, ...] = (0.0,)
    speed: tuple[float, ...] = (2.0,)
    controller: tuple[Controller, ...] = ("barrier",)


_SWEPT: dict[Kind, _Swept] = {
    "static": _Swept(alpha=(1.2, 0.3, 0.1, 3.0)),
    "ellipse": _Swept(gamma=(0.0, 0.1, 1.3)),
    "cluttered": _Swept(),
    "figure8": _Swept(speed=(1.0, 2.0, 3.0), controller=("barrier", "flatness")),
    "ball": _Swept(alpha=(3.0,), speed=(3.2,)),
}
"""What a case is flown with when nothing else is asked for."""


@dataclass(frozen=True)
class SafeSettings(Settings):
    """Flights to run; of several alphas, speeds and controllers all combinations.

    Attributes:
        case: static cylinder, obstacle on an ellipse, cluttered course, figure eight, or a ball thrown at a vehicle
            that hovers.
        alpha: rate at which a clearance may shrink [1/s]; may be repeated.
        gamma: of the velocity in a second barrier [s], as published [s/m^2]; may be repeated.
        reading: barriers that decay from node to node, or as they are published.
        speed: of the path at its fastest [m/s]; may be repeated.
        controller: who decides: a plan with barriers, flatness, flatness with a filter of one step, such a filter
            below a plan that is made now and then, or flatness along a spline that was planned before; may be repeated.
        terminal: whether plans have to end at rest.
        sight: whether obstacles are seen where they are and as fast as they are, or with noise and without velocity,
            in the world or, "relative", from the vehicle.
        knowledge: "estimated" mass and drag with prediction of what is pending, or what is in the "books" without.
        seed: of sizes, places, phases and noise; without one, the case as it is described.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
        margin: to be kept between hull and obstacles [m].
        faster: speed limit over the speed of the path.
        patience: by how much the vehicle, at the speed of the path, may be late before time on the path stands still
            [s].
        dt: length of a tick [s].
        books: vehicle as believed at first.
        truth: mass and drag of the vehicle.
        true_loops: its loops.
        gains: of the controller by flatness where it predicts; where it does not it has those of a new `Gains`, for
            these need the prediction.
        filter: numbers of the filter of one step.
        cascade: how it shares the work with a plan above it.
        sighting: numbers of noisy looks at obstacles, and of who believes them.
        spline: numbers of the planner by splines.
        keeper: numbers of the controller by barriers.
        tracking: the same where nothing is in the way and it predicts.
        weighing: numbers of the estimate.
        believed: statistics of sensors and air that an estimate of the state goes by.
        seen: standard deviations of position, attitude and velocity as they are seen [m, rad, m/s].
        disturbance: of rates and accelerations.
    """

    case: Kind = option("static")
    alpha: tuple[float, ...] | None = option(None, text=positive, metavar="A", many=True)
    gamma: tuple[float, ...] | None = option(None, text=not_negative, metavar="G", many=True)
    reading: Reading = option("decay")
    speed: tuple[float, ...] | None = option(None, text=positive, metavar="V", many=True)
    controller: tuple[Controller, ...] | None = option(None, choices=CONTROLLERS, many=True)
    terminal: Terminal = option("none")
    sight: Sight = option("exact")
    knowledge: Knowledge = option("estimated")
    seed: int | None = option(None, text=count, metavar="S")
    solver: str = "ipm"
    margin: float = 0.05
    faster: Positive[float] = 1.25
    patience: float = 2.0
    dt: Annotated[float, number("a tick in (0, 1] s", lambda value: 0.0 < value <= 1.0)] = 0.01
    books: Airframe = field(default_factory=Airframe)
    truth: quadrotor.Parameters = field(default_factory=lambda: quadrotor.Parameters(1.1, (0.3, 0.3, 0.15)))
    true_loops: Loops = field(default_factory=lambda: Loops(22.0, 0.025, 0.012))
    gains: Gains = TUNED
    filter: FilterSettings = field(default_factory=FilterSettings)
    cascade: CascadeSettings = field(default_factory=CascadeSettings)
    sighting: SightingSettings = field(default_factory=SightingSettings)
    spline: SplineSettings = field(default_factory=SplineSettings)
    keeper: KeeperSettings = field(default_factory=KeeperSettings)
    tracking: KeeperSettings = TRACKING
    weighing: WeighingSettings = field(default_factory=WeighingSettings)
    seen: tuple[float, float, float] = (1e-3, 3e-3, 1e-2)
    disturbance: DisturbanceModel = field(default_factory=DisturbanceModel)


class SafeFlight:
    """One flight.

    Attributes:
        settings: of all.
        situation: what it is about.
        label: what tells it from those beside it.
    """

    def __init__(
        self,
        settings: SafeSettings,
        about: Situation,
        controller: Controller,
        barriers: tuple[float, float],
        label: str,
        speed: float,
    ) -> None:
        """Prepare.

        Args:
            settings: of all flights.
            about: path and bodies.
            controller: who decides.
            barriers: alpha [1/s] and gamma of them.
            label: what tells it from those beside it.
            speed: of the path at its fastest [m/s].
        """
        s = self.settings = settings
        self.situation, self.label = about, label
        self._known = {
            "case": about.kind, "controller": controller, "alpha_per_s": barriers[0], "gamma": barriers[1],
            "reading": s.reading, "terminal": s.terminal, "sight": s.sight, "speed_m_per_s": speed,
            "knowledge": s.knowledge, "seed": s.seed, "solver": s.solver,
        }  # fmt: skip
        noise, shake, self._blur = np.random.default_rng([_TAG, s.seed or 0]).spawn(3)
        self._noise, self._shake = noise, Disturbances(s.disturbance, shake)
        truth = replace(s.books, parameters=s.truth, loops=s.true_loops)
        start = flat_flight(about.path.at(np.zeros(1)), s.truth)[0][0]
        self.plant, self.model = BodyRatePlant(truth, start, s.dt), BodyRatePlant(s.books, start, s.dt)
        estimating = s.knowledge == "estimated"
        self.weighing = Weighing(s.weighing, s.books.parameters, s.dt) if estimating else None
        self.filter = StateFilter(s.dt) if estimating else None
        path = self._spline() if controller == "spline" else about.path
        self.pace = Pace(path, s.patience * speed)
        noisy, beside = s.sight != "exact" and len(about.bodies) > 0, s.sight == "relative"
        self.sightings = Sightings(s.sighting, self._bodies(0.0), beside) if noisy else None
        self._decide = self._deciders(controller, barriers, s.faster * speed)

    def _deciders(
        self, controller: Controller, barriers: tuple[float, float], limit: float
    ) -> Callable[[Array, Obstacles], Decision]:
        s, link = self.settings, self.settings.books.loops.link
        estimating = self.weighing is not None
        if controller in ("barrier", "cascade"):
            blind = controller == "cascade" and not s.cascade.barriers
            slots, (alpha, gamma) = 0 if blind else min(s.keeper.slots, len(self.situation.bodies)), barriers
            weights = s.tracking if estimating and not len(self.situation.bodies) else s.keeper
            numbers = replace(
                weights, alpha=alpha, gamma=gamma, reading=s.reading, speed=limit, slots=slots, terminal=s.terminal
            )
            if controller == "cascade":  # a plan now and then has no next ticks to go on in
                numbers = replace(numbers, portion=None, iterations=min(numbers.iterations, WHOLE))
            frame = s.books if estimating else replace(s.books, loops=replace(s.books.loops, gain=np.inf))
            keeper, lead = CbfMpc(numbers, frame, s.dt, self.weighing, s.solver), link + s.dt if estimating else 0.0

            def plan(state: Array, seen: Obstacles) -> Decision:
                start = np.concatenate(self.model.ahead(state, lead, self._air))
                fade = np.exp(-(lead + keeper.nodes[:-1]) / AIR.gust_time)
                gust = fade[:, None] * self._air[3:]
                return keeper.decide(start, self.pace.at(lead + keeper.nodes), seen, lead, gust)

            if controller == "barrier":
                return plan
        flat = FlatnessController(s.gains if estimating else Gains(), s.books.least, s.books.most)
        ahead = s.books.loops.delay + s.dt if estimating else 0.0
        numbers_of_filter, track = replace(s.filter, alpha=barriers[0]), Track(s.cascade.every)

        def follow(now: Array, seen: Obstacles) -> Decision:
            """Follow the path, or the last plan of a cascade, by flatness; its acceleration may be filtered."""
            begin, status, steps, slack = time.thread_time(), "none", 0, 0.0
            flown = self.pace.at(np.array([ahead]))
            if controller == "cascade":
                status = "last plan"
                if track.due():
                    above = plan(now, seen)
                    status, steps = above.status, above.iterations
                    if keeper.states is not None:
                        track.lay(lead + keeper.nodes, keeper.states[:, [0, 1, 2, 7, 8, 9]])
                flown = track.at(track.ticks * s.dt + ahead, self.pace.at)
            state, p = self.model.ahead(now, ahead, self._air)[0], self._windy
            acceleration = flat.wanted(state, flown)
            if controller in ("filter", "cascade"):
                acceleration, slack = filtered(acceleration, state, seen, ahead, numbers_of_filter)
            control = flat.steer(state, acceleration, flown.jerk[0], p)
            elapsed = 1e3 * (time.thread_time() - begin)
            places = (now if controller == "cascade" else state)[None, :3]
            return Decision(control, places, status, steps, slack, p.mass, np.array(p.drag), elapsed)

        return follow

    @property
    def _air(self) -> Array:
        """(6,) rates and accelerations by which the air is believed to disturb the vehicle."""
        return np.zeros(6) if self.filter is None else np.concatenate([np.zeros(3), self.filter.gust])

    @property
    def _windy(self) -> quadrotor.Parameters:
        """Believed parameters, with the gust of the moment for a wind."""
        p, (x, y, z) = self.believed, self._air[3:].tolist()
        return replace(p, wind=(p.wind[0] + x, p.wind[1] + y), updraft=p.updraft + z)

    def _spline(self) -> SplinePath:
        """A path around what stands in the way, planned before the flight."""
        line = self.situation.path
        if not isinstance(line, Line) or self.situation.kind != "static":
            raise fg.ScenarioError(f"splines are planned past things at rest, not in the case {self.situation.kind!r}")
        return around(line, self._bodies(0.0), self.settings.spline)

    @property
    def believed(self) -> quadrotor.Parameters:
        """Mass and drag as the past says, or as in the books."""
        return self.settings.books.parameters if self.weighing is None else self.weighing.believed

    def see(self) -> Array:
        """State (10,) as it is seen now."""
        sigma = np.repeat(self.settings.seen, 3) * self._noise.standard_normal(9)
        state: Array = quadrotor.STATE.retract(self.plant.state[None], sigma[None])[0]
        return state

    def look_around(self, state: Array) -> Obstacles:
        """Obstacles as they are seen now by a vehicle that believes to be in a state (10,)."""
        truth = self._bodies(self.plant.time)
        if self.sightings is None:
            return truth
        blur = self.settings.sighting.noise * self._blur.standard_normal(truth.position.shape)
        beside = self.plant.state[:3] if self.sightings.relative else np.zeros(3)
        own = self.settings.seen[0] if self.filter is None else self.filter.unsure
        return self.sightings.see(self.plant.time, truth.position - beside + blur, state[:3], own)

    def _bodies(self, now: float) -> Obstacles:
        """Obstacles as they are."""
        bodies = self.situation.bodies
        place, velocity = (part[0] for part in bodies.at(np.array([now])))
        keep = bodies.radii + self.settings.books.radius + self.settings.margin
        return Obstacles(place, velocity, keep, bodies.upright, bodies.falls)

    def run(self, progress: Progress = silent) -> SafeLog:
        """Fly to the end, or until the user stops it."""
        s, about = self.settings, self.situation
        total = round(about.duration / s.dt)
        record = Recorder(
            SafeLog, label=self.label, settings=self._known, dt=s.dt, hull=s.books.radius, margin=s.margin,
            radii=about.bodies.radii, upright=about.bodies.upright,
            end=None if about.end is None else np.array(about.end),
        )  # fmt: skip

        def tick(number: int) -> tuple[float, str]:
            now = self.plant.time
            state = self.see()
            if self.weighing is not None:
                self.weighing.see(state, float(self.model.loops[6]))
                self.model.airframe = replace(s.books, parameters=self.believed)
            begin = time.thread_time()
            state = state if self.filter is None else self.filter.see(state)
            filtered_ms = 1e3 * (time.thread_time() - begin)
            obstacles = self.look_around(state)
            self.pace.see(state[:3])
            before = self.plant.state.copy()
            decision = self._decide(state, obstacles)
            if self.filter is None:
                self.model.state = state.copy()
                self.model.tick(decision.control)
            else:
                self.filter.tick(self.model, decision.control)
            self.pace.pass_by(s.dt)
            path = self.plant.tick(decision.control, self._shake.draw(s.dt))
            times = now + SUBSTEP * np.arange(len(path), dtype=np.float64)
            wanted = about.path.at(times[:1])
            record.add(
                time=now, states=before, wanted=np.concatenate([wanted.position[0], wanted.velocity[0]]),
                controls=decision.control, plans=decision.plan, bodies=about.bodies.at(times[:1])[0][0],
                near=about.bodies.nearest(path, times).min(axis=0, initial=np.inf), slack=decision.slack,
                mass=decision.mass, drag=decision.drag, decide_ms=decision.milliseconds + filtered_ms,
                steps=decision.iterations, statuses=decision.status, late=times[0] + s.dt - self.pace.now,
            )  # fmt: skip
            return (number + 1) / total, f"{self.label}: {now:.1f} s"

        stopped = run_ticks(total, tick, progress)
        return record.finish(interrupted=stopped)


def flights(settings: SafeSettings) -> list[SafeFlight]:
    """Every flight that is asked for, in order."""
    s, swept = settings, _SWEPT[settings.case]
    all_alphas, all_gammas, speeds = s.alpha or swept.alpha, s.gamma or swept.gamma, s.speed or swept.speed
    controllers = s.controller or swept.controller
    made = []
    for speed in speeds:
        about = situation(s.case, speed, s.seed)
        for controller in controllers:
            barriers = controller in ("barrier", "filter", "cascade") and len(about.bodies) > 0
            alphas = all_alphas if barriers else all_alphas[:1]
            gammas = all_gammas if barriers and controller in ("barrier", "cascade") else all_gammas[:1]
            for alpha, gamma in itertools.product(alphas, gammas):
                told = [f"{speed:g} m/s"] * (len(speeds) > 1) + [controller] * (len(controllers) > 1)
                told += [f"alpha {alpha:g}"] * (len(alphas) > 1) + [f"gamma {gamma:g}"] * (len(gammas) > 1)
                label = ", ".join(told) or (f"alpha {alpha:g}" if barriers else controller)
                made.append(SafeFlight(s, about, controller, (alpha, gamma), label, speed))
    return made


def run_safe_flights(settings: SafeSettings | None = None, progress: Progress = silent) -> list[SafeLog]:
    """Fly all that is asked for, one after the other; a flight that the user stops is the last one.

    Raises:
        ScenarioError: for a case or a controller that is unknown.
        BackendError: for an unknown solver.
    """
    every = flights(settings or SafeSettings())
    logs: list[SafeLog] = []
    for k, flight in enumerate(every):

        def tell(done: float, text: str, k: int = k) -> None:
            progress((k + done) / len(every), text)

        logs.append(flight.run(tell))
        if logs[-1].interrupted:
            break
    return logs
