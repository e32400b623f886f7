"""Numbers that say how a flight went."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.models import quadrotor
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.metrics import errors as norms
from unifg.scenarios.logs.metrics import statistics, timing
from unifg.typing import Array, BoolArray

__all__ = [
    "PARAMETERS",
    "estimated_parameters",
    "flight_metrics",
    "has_estimate",
    "landmark_errors",
    "state_errors",
]

PARAMETERS = ("mass", "drag_x", "drag_y", "drag_z", "wind_x", "wind_y", "updraft")
"""Names of the parameters in the order of `FlightLog.parameters`."""

_EARLY = 5.0  # [s]
_SIGMAS = 2.0  # half width of the intervals whose coverage is counted
_KNOWN = 0.01  # relative mass error from which on the mass counts as known
_SAME = 1.0  # a landmark farther than this from everything stands for nothing [m]


def flight_metrics(log: FlightLog) -> dict[str, Any]:
    """Summarise a flight.

    Args:
        log: a flight of at least one tick.

    Returns:
        The metrics, of plain Python numbers; the key says the unit. ``duration_s`` goes from the first tick to the
        last, at which arrival shows. Coverage is the share of errors within two standard deviations over ticks and
        components, 0.954 where sigmas are those of the errors. Parameters appear by name, errors as estimate minus
        truth, and only those that are estimated. ``mass_known_s`` is when the relative mass error fell below 1 % for
        good. ``time_to_goal_s`` is None without arrival, an early parameter error None in a flight shorter than 5 s,
        and all of the estimate None where a flight has none.

    Raises:
        ScenarioError: the flight has no tick.
    """
    if log.ticks == 0:
        raise ScenarioError("the flight has no tick: there is nothing to measure")
    duration = round(float(log.time[-1]), 9)
    speed = np.linalg.norm(log.truth[:, 7:], axis=1)
    errors = state_errors(log)
    estimated = has_estimate(log)
    active = estimated_parameters(log)
    early = round(_EARLY / log.dt)  # the tick of that time
    long_enough = early < log.ticks
    wrong = log.parameters - log.parameters_true
    mass = np.abs(log.parameters[:, 0] / log.parameters_true[:, 0] - 1.0)
    return {
        "settings": dict(log.settings),
        "layout": log.layout.name,
        "succeeded": bool(log.succeeded),
        "interrupted": bool(log.interrupted),
        "reached": bool(log.reached),
        "collisions": int(log.collisions),
        "ticks": log.ticks,
        "duration_s": duration,
        "time_to_goal_s": duration if log.reached else None,
        "target_distance_m": float(log.target_distance[-1]),
        "path_length_m": float(np.linalg.norm(np.diff(log.truth[:, :3], axis=0), axis=1).sum()),
        "mean_speed_m_per_s": float(speed.mean()),
        "max_speed_m_per_s": float(speed.max()),
        "min_clearance_m": float(np.min(log.clearance)),
        "position_error_m": norms(errors[:, :3]) if estimated else None,
        "velocity_error_m_per_s": norms(log.believed[:, 7:] - log.truth[:, 7:]) if estimated else None,
        "attitude_error_rad": norms(errors[:, 3:6]) if estimated else None,
        "coverage": _coverage(log, errors, active) if estimated else None,
        "parameter_error": _by_name(wrong[-1], active),
        "parameter_error_5s": _by_name(wrong[early], active) if long_enough else None,
        "parameter_sigma": _by_name(log.parameters_sigma[-1], active),
        "mass_error_relative": float(mass[-1]) if active[0] else None,
        "mass_error_relative_5s": float(mass[early]) if active[0] and long_enough else None,
        "mass_known_s": _settled(log, mass) if active[0] else None,
        "landmarks": len(log.landmarks[-1]),
        "landmark_error_m": norms(landmark_errors(log)) if len(landmark_errors(log)) else None,
        "statuses": dict(sorted(Counter(log.statuses).items())),
        "outcome": log.outcome,
        "health": {state: log.health.count(state) for state in ("ok", "degraded", "lost")},
        "causes": dict(sorted(Counter(cause for cause in log.causes if cause).items())),
        "dropped_samples": dict(sorted(log.dropped.items())),
        "subproblems": dict(sorted(log.subproblems.items())),
        "emergency_ticks": int(np.count_nonzero(log.emergency)),
        "tick_ms": timing(log.estimate_ms + log.plan_ms),
        **statistics(log),
    }


def has_estimate(log: FlightLog) -> bool:
    """Return True if the state was estimated: a flight along a given plan has neither sigmas nor windows."""
    return bool((log.believed_sigma > 0.0).any()) or any(len(past) for past in log.pasts)


def estimated_parameters(log: FlightLog) -> BoolArray:
    """(7,) True for parameters that were estimated: those with a standard deviation."""
    estimated: BoolArray = np.any(log.parameters_sigma > 0.0, axis=0)
    return estimated


def state_errors(log: FlightLog) -> Array:
    """(T, 9) right perturbation (p, R, v) that takes the belief to the truth [m, rad, m/s]."""
    return quadrotor.STATE.local(log.believed, log.truth)


def landmark_errors(log: FlightLog) -> Array:
    """(k, 2) last believed position minus the nearest cylinder's axis or wall's end [m].

    Landmarks farther than 1 m from all of them are left out: they stand for something that moves, or for nothing.
    """
    means = log.landmarks[-1]["mean"]
    things = np.concatenate([log.layout.cylinders[:, :2], log.layout.corners.reshape(-1, 2)])
    if not len(means) or not len(things):
        return np.zeros((0, 2))
    errors = means[:, None, :] - things[None]
    nearest = errors[np.arange(len(means)), np.linalg.norm(errors, axis=2).argmin(axis=1)]
    matched: Array = nearest[np.linalg.norm(nearest, axis=1) <= _SAME]
    return matched


def _coverage(log: FlightLog, errors: Array, active: BoolArray) -> dict[str, float]:
    """Share of errors within two sigmas, by the part of the state and by parameter."""
    covered = np.abs(errors) <= _SIGMAS * log.believed_sigma
    parts = {"position": covered[:, :3], "attitude": covered[:, 3:6], "velocity": covered[:, 6:]}
    within = np.abs(log.parameters - log.parameters_true) <= _SIGMAS * log.parameters_sigma
    parts |= {name: within[:, i] for i, name in enumerate(PARAMETERS) if active[i]}
    return {name: float(part.mean()) for name, part in parts.items()}


def _by_name(values: Array, active: BoolArray) -> dict[str, float] | None:
    named = {name: float(value) for name, value, here in zip(PARAMETERS, values, active, strict=True) if here}
    return named or None


def _settled(log: FlightLog, mass: Array) -> float | None:
    """Time from which on the relative error of the mass stays small; None where it never does."""
    wrong = np.flatnonzero(mass >= _KNOWN)
    if not len(wrong):
        return 0.0
    after = int(wrong[-1]) + 1
    return float(log.time[after]) if after < log.ticks else None
