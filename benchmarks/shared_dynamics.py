"""Vehicle dynamics in the past, and estimated parameters in the plan, each by itself.

A quadrotor flies through unknown corridors (:mod:`benchmarks.quadrotor_flights`). Its past knows no dynamics, those
with the parameters believed at the start, or those with mass, drag and wind as unknowns; its plan is made with the
parameters believed at the start, or with estimates; an accelerometer is there or not, for all of them. Where a past
without unknowns meets a plan with estimates, a second past beside it hands on its parameters and nothing else. All
flights of a seed meet the same corridor, parameters, disturbances and noise; intervals are bootstrapped over corridors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.comparison import Key, Row, difference, paired, where
from benchmarks.report import Columns, listing
from benchmarks.runner import Cell, Study
from unifg.horizon import Plan
from unifg.models import quadrotor
from unifg.scenarios.episode import silent
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.quadrotor.estimator import STILL, DeadReckoning, Dynamics, Estimator, EstimatorSettings
from unifg.scenarios.quadrotor.flight_control import Controller
from unifg.scenarios.quadrotor.flight_past import WindowSettings
from unifg.scenarios.quadrotor.flight_pilot import Pilot
from unifg.typing import Array

FORCE_SIGMA = 0.15  # [m/s^2] of an accelerometer with noise of 0.1 and an unknown bias of 0.05
MISTRUST = {False: 1.0, True: 2.0}
"""Process noise of an acceleration whose parameters are wrong, without and with an accelerometer [m/s^2]: that of 0.3,
0.6, 1 and 2 which gave the smallest errors of velocity in corridors 1000 to 1002, which are open to tuning."""
FLIGHT = 25.0  # [s]; who has not arrived by then hangs
AHEAD = 10  # ticks: where a plan is compared with what came of it
PASTS = ("none", "nominal", "unknown")
PLANS = ("nominal", "estimated")


@dataclass(frozen=True)
class NominalDynamics(Dynamics):
    """The vehicle's dynamics with the parameters believed at the start; what these have wrong is noise.

    Attributes:
        mistrust: standard deviation of that noise [m/s^2].
    """

    mistrust: float

    def window(self, settings: EstimatorSettings) -> WindowSettings:
        """Nothing is estimated, and the acceleration is not trusted as far."""
        own = settings.window
        sigma = (*own.noise_sigma[:3], *np.hypot(own.noise_sigma[3:], self.mistrust).tolist())
        return replace(own, estimated=(), noise_sigma=sigma)


class Divided(Pilot):
    """Estimates the state by one past, and plans with parameters that need not be its own.

    Attributes:
        adviser: whose parameters the plan takes; None for those believed at the start.
    """

    def __init__(
        self, estimator: Estimator, controller: Controller, nominal: quadrotor.Parameters, adviser: Estimator | None
    ) -> None:
        """Join them; the adviser may be the estimator itself."""
        super().__init__(estimator, controller)
        self.adviser, self._nominal, self.pushed = adviser, nominal, self._advised

    def recognise(self, reading: Reading, control: Array | None, push: Array = STILL) -> Reading:
        """Move both pasts on to a reading."""
        if self.adviser is not None and self.adviser is not self.estimator:
            self.adviser.predict(reading, control, push)
        return super().recognise(reading, control, push)

    def decide(self, reading: Reading) -> Plan:
        """Estimate by both and plan."""
        if self.adviser is not None and self.adviser is not self.estimator:
            self.adviser.see(reading)
        return super().decide(reading)

    def _advised(self, belief: Belief) -> Belief:
        """The belief with the parameters that the plan takes."""
        if self.adviser is self.estimator:
            return belief
        return replace(belief, parameters=self._nominal if self.adviser is None else self.adviser.estimate().parameters)


def prepared(seed: int, past: str, plan: str, accelerometer: bool) -> Flight:
    """A flight with these dynamics of the past and parameters of the plan, ready to be flown."""
    window = WindowSettings(force_sigma=FORCE_SIGMA if accelerometer else None)
    settings = EstimatorSettings(window=window)
    flight = Flight(FlightSettings("ipm", "sequential", seed, time_limit=FLIGHT, estimator=settings))
    found, known = flight.conditions, flight.pilot.estimator
    estimator = known
    if past != "unknown":
        nominal = NominalDynamics(found.nominal, MISTRUST[accelerometer])
        model = nominal if past == "nominal" else DeadReckoning(found.nominal)
        estimator = Estimator(known.window.present, found.nominal, settings, found.layout.corners, model)
    adviser = known if plan == "estimated" else None
    flight.pilot = Divided(estimator, flight.pilot.controller, found.nominal, adviser)
    return flight


def fly(**cell: Any) -> Row:
    """Fly once."""
    log = prepared(**cell).run(silent)
    metrics = dict(flight_metrics(log))
    return {
        "reached": bool(log.reached),
        "collisions": int(log.collisions),
        "velocity": 1e3 * metrics["velocity_error_m_per_s"]["rms"],
        "position": 1e3 * metrics["position_error_m"]["rms"],
        "tracking": 1e3 * tracking(log),
        "clearance": 100.0 * float(np.min(log.clearance)),
        "time": float(log.time[-1]),
    }


def tracking(log: FlightLog) -> float:
    """Root mean square of how far the vehicle is from where a plan of half a second ago had it go [m].

    Both are counted from where the vehicle was, or believed to be, when the plan was made.
    """
    gone = log.truth[AHEAD:, :3] - log.truth[:-AHEAD, :3]
    planned = log.plans[:-AHEAD, AHEAD] - log.plans[:-AHEAD, 0]
    return float(np.sqrt(np.square(gone - planned).sum(axis=1).mean()))


WORDS = {"none": "none", "nominal": "nominal", "unknown": "with unknowns"}
MEASURES = {
    "velocity error [mm/s]": "velocity",
    "position error [mm]": "position",
    "off the plan after 0.5 s [mm]": "tracking",
    "least clearance [cm]": "clearance",
}
CHANGES = {
    ("dynamics in the past, nominal ones", "nominal plan"): (("none", "nominal"), ("nominal", "nominal")),
    ("unknowns in the dynamics of the past", "nominal plan"): (("nominal", "nominal"), ("unknown", "nominal")),
    ("unknowns in the dynamics of the past", "estimated plan"): (("nominal", "estimated"), ("unknown", "estimated")),
    ("estimates in the plan", "nominal past"): (("nominal", "nominal"), ("nominal", "estimated")),
    ("estimates in the plan", "past with unknowns"): (("unknown", "nominal"), ("unknown", "estimated")),
}
"""What is changed and what is not: dynamics of the past and parameters of the plan, before and after."""


def mean(name: str, some: Sequence[Row]) -> str:
    """Mean of a measure over flights."""
    return f"{np.mean([row[name] for row in some]):.3g}"


def change(name: str, pair: tuple[Sequence[Row], Sequence[Row]]) -> str:
    """Mean of the paired differences of a measure, and its interval."""
    old, new = paired(*pair, lambda row: float(row[name]))
    return difference(new - old)


def render(rows: Sequence[Row]) -> str:
    """Markdown: the combinations, and what each change does."""
    levels: dict[Key, list[Row]] = {}
    changes: dict[Key, tuple[list[Row], list[Row]]] = {}
    for there, sensor in ((False, "no"), (True, "yes")):
        flown = {
            (past, plan): where(rows, accelerometer=there, past=past, plan=plan) for past in PASTS for plan in PLANS
        }
        levels |= {(sensor, WORDS[past], plan): some for (past, plan), some in flown.items() if some}
        for words, (before, after) in CHANGES.items():
            if flown[before] and flown[after]:
                changes[sensor, *words] = flown[before], flown[after]
    told: Columns[list[Row]] = {
        **{head: partial(mean, name) for head, name in MEASURES.items()},
        "time of those who arrive [s]": lambda some: mean("time", [row for row in some if row["reached"]]),
        "arrived, untouched": lambda some: (
            f"{sum(row['reached'] and not row['collisions'] for row in some)} of {len(some)}"
        ),
    }
    differences: Columns[tuple[list[Row], list[Row]]] = {head: partial(change, name) for head, name in MEASURES.items()}
    parts = [
        "### The combinations",
        "Errors are root mean squares over a flight; everything is the mean over flights.",
        listing(["accelerometer", "dynamics of the past", "parameters of the plan"], levels, told),
        "### What each change does",
        "Mean of the paired differences, with its 95 % interval over corridors.",
        listing(["accelerometer", "what is added", "beside"], changes, differences),
    ]
    return "\n\n".join(parts)


def cells(seeds: Sequence[int]) -> list[Cell]:
    """Every combination on every seed."""
    return [
        {"seed": seed, "past": past, "plan": plan, "accelerometer": accelerometer}
        for seed in seeds for accelerometer in (False, True) for past in PASTS for plan in PLANS
        if past != "none" or plan == "nominal"
    ]  # fmt: skip


STUDY = Study(cells, fly, render, range(12))
