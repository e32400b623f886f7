"""Flights of Ta et al. 2014, section V-B, through unknown cylinders: one flight, and what tables tell of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.scenarios.quadrotor.flight_settings import Avoidance

MARKS = (1.0, 2.0, 5.0, 10.0)  # [s] at which the mass is looked at
TOUCH = 0.01  # [m]; a hull nearer than this has touched, or will


@dataclass(frozen=True)
class Job:
    """One flight and the conditions it is made under."""

    study: str
    solver: str
    coupling: str
    seed: int
    avoidance: Avoidance = "clearance"
    association: str = "known"
    movers: int = 0
    run: int = 0

    def settings(self) -> FlightSettings:
        """The flight."""
        plain = FlightSettings(self.solver, self.coupling, self.seed, self.movers)
        return replace(
            plain,
            estimator=replace(plain.estimator, association=self.association),
            controller=replace(plain.controller, avoidance=self.avoidance),
        )


def fly(**cell: Any) -> dict[str, Any]:
    """Fly once and keep what tables need."""
    job = Job(**cell)
    if job.study == "timing":
        run_flight(replace(job.settings(), time_limit=0.5))  # compiles what this process has not compiled yet
    log = run_flight(job.settings())
    metrics: dict[str, Any] = dict(flight_metrics(log))
    del metrics["settings"]
    ticks = {name: np.round(getattr(log, name), 3).tolist() for name in ("estimate_ms", "plan_ms")}
    return {"metrics": metrics, "mass": _mass(log), "contact": _contact(log), **ticks}


def _mass(log: FlightLog) -> dict[str, list[float]]:
    """Relative error of the mass and its sigma at some times [s]."""
    true = log.parameters_true[:, 0]
    error, sigma = log.parameters[:, 0] / true - 1.0, log.parameters_sigma[:, 0] / true
    marks = [round(mark / log.dt) for mark in MARKS]
    return {f"{log.dt * k:g}": [float(error[k]), float(sigma[k])] for k in marks if k < log.ticks}


def _contact(log: FlightLog) -> dict[str, Any] | None:
    """Time and place of the first contact, and the belief there."""
    near = np.flatnonzero(log.clearance < TOUCH)
    if not log.collisions or not len(near):
        return None
    k = int(near[0])
    return {
        "time_s": round(float(log.time[k]), 2),
        "place": np.round(log.truth[k, :3], 2).tolist(),
        "position_error_m": float(np.linalg.norm(log.believed[k, :3] - log.truth[k, :3])),
        "emergency_before": int(np.count_nonzero(log.emergency[max(0, k - 20) : k + 1])),
        "status": log.statuses[k],
    }
