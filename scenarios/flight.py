"""Scenario ``quadrotor-mpc``: a quadrotor flies through an unknown corridor (Ta et al. 2014, section V-B).

Each tick: sense, estimate, plan, fly the first control. The past is a window of measurements, the future a horizon of
controls; how they meet is the coupling.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from unifg.errors import ScenarioError, UnifgError
from unifg.models import quadrotor
from unifg.scenarios.flying.braking import braking_control
from unifg.scenarios.flying.coupling import COUPLINGS, make_pilot
from unifg.scenarios.flying.estimator import EstimatorSettings
from unifg.scenarios.flying.plan import ControllerSettings, Plan
from unifg.scenarios.log.columns import Recorder
from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.options import option, share
from unifg.scenarios.seeing.readings import Reading
from unifg.scenarios.worlds.air import QuadrotorWorld
from unifg.scenarios.worlds.conditions import draw_conditions
from unifg.typing import Array

__all__ = ["Flight", "FlightSettings", "run_flight"]

Progress = Callable[[float, str], None]

SCENARIO = "quadrotor-mpc"
REACHED_DISTANCE = 0.3  # [m], by belief and truth
REACHED_SPEED = 0.5  # [m/s], by belief and truth
COLLISIONS = 3  # with so many a flight is given up

logger = logging.getLogger("unifg")


@dataclass(frozen=True)
class FlightSettings:
    """One flight.

    Attributes:
        solver: of the controller, one of `unifg.solvers.names.CONSTRAINED`.
        coupling: of estimation and control: without dynamics in the estimator; both with the same parameters; or one
            graph.
        seed: of everything random.
        movers: number of moving discs.
        mass_error: by which the mass is believed wrong at the start, relative, in [0, 1).
        time_limit: after which a flight is given up [s].
        estimator: of the past; its association is the flight's.
        controller: of the future; its avoidance and horizon are the flight's.
    """

    solver: str = "ipm"
    coupling: str = option("sequential", choices=COUPLINGS)
    seed: int = option(0, metavar="S")
    movers: int = option(0, metavar="K")
    mass_error: float = option(0.05, text=share, metavar="E")
    time_limit: float = 60.0
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    controller: ControllerSettings = field(default_factory=ControllerSettings)

    def __post_init__(self) -> None:
        """Refuse a time that cannot be flown.

        Raises:
            ScenarioError: if the time limit is not positive.
        """
        if not self.time_limit > 0.0:
            raise ScenarioError(f"the time limit must be positive, got {self.time_limit} s")

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
            "time_limit": self.time_limit,
            "window": self.estimator.window.length,
            "horizon": self.controller.horizon,
            "controller": asdict(self.controller),
        }


def run_flight(settings: FlightSettings, progress: Progress | None = None) -> FlightLog:
    """Run one flight; an interrupt from the keyboard ends it early and keeps what was recorded.

    Args:
        settings: what to fly.
        progress: called with the fraction done and a short text, once a tick.

    Raises:
        ScenarioError: when the seed, the movers or an option cannot be served.
    """
    return Flight(settings).run(progress or (lambda done, text: None))


class Flight:
    """World and pilot of one run.

    Attributes:
        settings: what is flown.
        conditions: truth and first belief.
        world: the truth.
        pilot: what flies.
    """

    def __init__(self, settings: FlightSettings) -> None:
        """Draw the world and wake the pilot."""
        self.settings = settings
        self.conditions = found = draw_conditions(settings.seed, settings.mass_error)
        self.world = QuadrotorWorld(found.layout, settings.seed, found.true, settings.movers)
        error = settings.estimator.state_sigma * found.deviation
        believed = quadrotor.STATE.retract(self.world.state[None], error[None])[0]
        self.pilot = make_pilot(
            settings.coupling, settings.solver, found.layout, believed, found.nominal, settings.estimator,
            settings.controller,
        )  # fmt: skip

    def run(self, progress: Progress) -> FlightLog:
        """Fly to the target, or until it is no use."""
        settings, world, dt = self.settings, self.world, self.settings.controller.dt
        recorder = Recorder(
            FlightLog, layout=world.layout, settings=settings.summary(), dt=dt, parameters_true=world.parameters.packed
        )
        reached = interrupted = False
        control: Array | None = None
        far = float(np.linalg.norm(world.layout.target - world.layout.start))
        try:
            for _ in range(round(settings.time_limit / dt)):
                control = self._tick(world.sense(), control, recorder)
                reached = self._arrived(world.state) and self._arrived(self.pilot.belief.state)
                if reached:
                    break
                world.step(control, dt)
                if world.collisions >= COLLISIONS:
                    break
                left = float(np.linalg.norm(world.layout.target - world.state[:3]))
                progress(min(max(0.0, 1.0 - left / far), 0.99), f"{left:.1f} m to go")
        except KeyboardInterrupt:
            interrupted = True
        progress(1.0, "done")
        return recorder.finish(collisions=world.collisions, reached=reached, interrupted=interrupted)

    def _tick(self, reading: Reading, control: Array | None, recorder: Recorder[FlightLog]) -> Array:
        """Estimate, plan and record; the control (4,) to be flown."""
        pilot, world = self.pilot, self.world
        plan: Plan | None = None
        try:
            plan = pilot.tick(reading, control)
        except (UnifgError, ArithmeticError, ValueError) as error:  # a robot in the air has to go on
            logger.warning("the tick at %.2f s failed, the vehicle brakes: %s", world.time, error)
        belief, settings = pilot.belief, self.settings.controller
        least = np.array([*(-rate for rate in settings.rate_limits), settings.thrust_limits[0]])
        most = np.array([*settings.rate_limits, settings.thrust_limits[1]])
        control = braking_control(belief.state, belief.parameters, least, most) if plan is None else plan.controls[0]
        marks = belief.landmarks
        recorder.add(
            truth=world.state,
            believed=belief.state,
            believed_sigma=belief.sigma,
            controls=control,
            plans=np.tile(belief.state[:3], (settings.horizon + 1, 1)) if plan is None else plan.states[:, :3],
            pasts=pilot.estimator.window.states[:, :3],
            landmarks=(marks.ids, marks.positions, marks.covariances, marks.radii),
            parameters=belief.parameters.packed,
            parameters_sigma=belief.parameters_sigma,
            seen=reading.ids,
            movers=world.mover_states(),
            estimate_ms=pilot.estimate_ms,
            plan_ms=pilot.plan_ms,
            statuses="failed" if plan is None else plan.status.name.lower().replace("_", " "),
            clearance=world.clearance(),
            emergency=plan is None or plan.emergency,
        )
        return control

    def _arrived(self, state: Array) -> bool:
        """Whether a state (10,) is at the target and slow."""
        away = np.linalg.norm(state[:3] - self.world.layout.target)
        return bool(away < REACHED_DISTANCE and np.linalg.norm(state[7:]) < REACHED_SPEED)
