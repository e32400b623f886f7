"""Flights of FactorMPC, section IV, past obstacles with a margin: one flight, its oracle and its record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias, cast

import numpy as np

from unifg.models.quadrotor import GRAVITY
from unifg.scenarios.logs.safe_log import SafeLog, safe_metrics
from unifg.scenarios.quadrotor.oracle import Answer, Authority, Threat, exists
from unifg.scenarios.quadrotor.situations import Kind
from unifg.scenarios.safe_flight import Controller, Knowledge, SafeFlight, SafeSettings, flights
from unifg.scenarios.simulation.bodies import Ellipse, Thrown

Row: TypeAlias = dict[str, Any]

VEHICLE = 5.0  # horizontal acceleration at a tilt of 27 degrees [m/s^2]
TILT = 0.15  # time to get there [s]
EVERY = 5  # ticks between two questions
BASE = 0.05  # distances of Pareto curves are those beyond it [m]
EIGHTS = tuple(range(101, 111))  # seeds of figure eights


@dataclass(frozen=True)
class Job:
    """One flight."""

    study: str
    case: str
    controller: str = "barrier"
    alpha: float = 1.2
    gamma: float = 0.0
    speed: float = 2.0
    seed: int = -1
    knowledge: str = "estimated"
    margin: float = BASE
    step: float = 0.05
    slots: int = 5
    duration: float = 0.0

    def flight(self) -> SafeFlight:
        """The flight; no seed is minus one, and the duration of the case is zero."""
        settings = SafeSettings(
            case=cast(Kind, self.case), alpha=(self.alpha,), gamma=(self.gamma,), speed=(self.speed,),
            controller=(cast(Controller, self.controller),), knowledge=cast(Knowledge, self.knowledge),
            seed=None if self.seed < 0 else self.seed,
        )  # fmt: skip
        if self.controller == "spline":
            settings = replace(settings, spline=replace(settings.spline, margin=self.margin))
        else:
            keeper = replace(settings.keeper, step=self.step, slots=self.slots)
            settings = replace(settings, margin=self.margin, keeper=keeper)
        (flight,) = flights(settings)
        if self.duration:
            flight.situation = replace(flight.situation, duration=self.duration)
        return flight


def threats(flight: SafeFlight, log: SafeLog, tick: int) -> list[Threat]:
    """The obstacles as they are seen at a tick; a ball in the hand is none."""
    found, now = [], float(log.time[tick])
    for body in flight.situation.bodies.bodies:
        motion, ball = body.motion, isinstance(body.motion, Thrown)
        place, velocity = (part[0] for part in motion.at(np.array([now + 1e-6])))
        until = np.inf
        if isinstance(motion, Thrown):
            if not motion.release <= now < motion.release + motion.flight:
                continue
            until = motion.release + motion.flight - now
        found.append(
            Threat(
                log.states[tick, :3] - place, log.states[tick, 7:] - velocity, body.radius + log.hull + log.margin,
                body.upright,
                motion.speed**2 * max(motion.axes) / min(motion.axes) ** 2 if isinstance(motion, Ellipse) else 0.0,
                np.array([0.0, 0.0, -GRAVITY * ball]), until,
            )
        )  # fmt: skip
    return found


def judged(flight: SafeFlight, log: SafeLog) -> Row:
    """Answer of the oracle at first sight, and for a lost margin whether it ever was "yes"."""
    loops = flight.settings.books.loops
    authority = Authority(VEHICLE, 0.1, loops.delay + flight.settings.dt + TILT)
    balls = [body.motion.release for body in flight.situation.bodies.bodies if isinstance(body.motion, Thrown)]
    first = min(int(np.ceil(max(balls, default=0.0) / log.dt)), log.ticks - 1)
    answer: Answer = exists(threats(flight, log, first), authority)
    if not log.violated:
        return {"oracle": answer}
    lost = int(np.argmax(log.boundary < -1e-3))
    asked = [exists(threats(flight, log, k), authority) for k in range(first, lost, EVERY)]
    return {
        "oracle": answer,
        "charged": "yes" in asked or answer == "yes",
        "told": "too near" in log.statuses[max(first, 0) : lost + 1],
    }


def fly(**cell: Any) -> Row:
    """Fly once and keep what tables need."""
    job = Job(**cell)
    if job.study == "times":
        replace(job, duration=0.5).flight().run()  # compiles and loads what this process has not yet
    flight = job.flight()
    log = flight.run()
    metrics = safe_metrics(log)
    kept = {key: metrics[key] for key in ("arrived", "touched", "margin_kept", "statuses", "late_s")}
    row: Row = {**kept, "top": metrics["max_speed_m_per_s"], "slack": metrics["greatest_slack_m"]}
    if len(log.radii):
        row["boundary"], row["clearance"] = metrics["min_boundary_distance_m"], metrics["min_clearance_m"]
        row |= judged(flight, log)
    late = log.error[log.time >= 3.0] if job.case == "figure8" else log.error[log.time >= 2.0]
    row["error"] = float(np.sqrt((late**2).sum(axis=1).mean()))
    row["decide_ms"] = np.round(log.decide_ms, 3).tolist()
    return row
