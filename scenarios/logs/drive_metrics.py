"""Numbers that say how a drive went."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.lie import SE2, wrap_angle
from unifg.scenarios.logs.assumptions import judged
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.metrics import spread, statistics, timing
from unifg.scenarios.planning.polyline import path_length
from unifg.typing import Array

__all__ = ["consistency", "episode_metrics", "nees", "pose_errors"]


def episode_metrics(log: EpisodeLog) -> dict[str, Any]:
    """Summarise an episode.

    Args:
        log: an episode of at least one tick.

    Returns:
        The metrics, of plain Python numbers; the key says the unit. ``path_length_m`` is the way the robot really
        drove, ``duration_s`` the time from the first tick to the last, at which arrival shows, ``planned_length_m`` the
        length of the planned path; ``solver_failures`` counts ticks without a
        plan, in which the robot braked (``emergency_ticks``, the same ticks), ``rescued_ticks`` those for which the
        second backend had one and the first had not, and ``plan_status`` counts the status words of all ticks.
        ``odometry_error_m`` is the error of dead reckoning. ``outcomes`` says what became of every goal, ``health``
        and ``causes`` count ticks by what the supervisor made of them, ``dropped_samples`` what was not let in,
        ``power_off_s`` is the time at which the robot first asked for its motors' power to be cut, None for never, and
        ``last_stops`` counts ticks in which beams alone slowed the robot. ``tick_ms`` is all of a tick: estimate,
        perception, repair of the route and plan; ``late_ticks`` took longer than their period. ``contacts`` has the
        cause of each, ``broken_assumptions`` counts ticks by the assumption that did not hold, and ``beyond_sigma`` is
        the share of ticks whose true position lies outside of the ellipse that clearances are widened by.

    Raises:
        ScenarioError: the episode has no tick.
    """
    if log.ticks == 0:
        raise ScenarioError("the episode has no tick: there is nothing to measure")
    duration = round(float(log.time[-1]), 9)
    length = path_length(log.true_pose)
    position, heading = pose_errors(log.estimate, log.true_pose)
    odometry_position, odometry_heading = pose_errors(log.dead_reckoning, log.true_pose)
    emergencies, judgement = int(np.count_nonzero(log.emergency)), judged(log)
    return {
        "scenario": log.scenario,
        "map": log.occupancy.name,
        "solver": log.solver,
        "coupling": log.coupling,
        "base": log.base,
        "body": log.body or f"disc:{log.robot_radius:g}",
        "seed": int(log.seed),
        "succeeded": log.succeeded,
        "interrupted": bool(log.interrupted),
        "reached": bool(log.reached) and all(log.reached),
        "goals": len(log.goals),
        "goals_reached": sum(bool(flag) for flag in log.reached),
        "obstacles": int(log.obstacles.shape[1]),
        "obstacles_wanted": int(log.obstacles_wanted),
        "collisions": int(log.collisions),
        "contacts": [asdict(contact) for contact in judgement.contacts],
        "broken_assumptions": judgement.ticks,
        "beyond_sigma": judgement.beyond_sigma,
        "steps": log.ticks,
        "duration_s": duration,
        "path_length_m": length,
        "planned_length_m": path_length(log.path),
        "mean_speed_m_per_s": length / duration if duration else 0.0,
        "min_clearance_m": float(np.min(log.clearance)),
        "localisation_error_m": spread(position),
        "nees": consistency(log),
        "localisation_error_rad": spread(heading),
        "odometry_error_m": spread(odometry_position),
        "odometry_error_rad": spread(odometry_heading),
        "solver_failures": emergencies,
        "emergency_ticks": emergencies,
        "rescued_ticks": int(np.count_nonzero(log.rescued)),
        "plan_status": dict(sorted(Counter(log.status).items())),
        "max_bound_violation": float(max(0.0, np.max(log.bound_violation))),
        "outcomes": list(log.outcomes),
        "faults": list(log.faults),
        "health": {state: log.health.count(state) for state in ("ok", "degraded", "lost")},
        "causes": dict(sorted(Counter(cause for cause in log.cause if cause).items())),
        "dropped_samples": dict(sorted(log.dropped.items())),
        "subproblems": dict(sorted(log.subproblems.items())),
        "power_off_s": float(log.time[np.argmax(log.power_off)]) if log.power_off.any() else None,
        "last_stops": int(np.count_nonzero(log.emergency_stop)),
        "explained_share": {"mean": float(np.mean(log.explained)), "min": float(np.min(log.explained))},
        "tick_ms": timing(log.tick_ms),
        "late_ticks": int(np.count_nonzero(log.tick_ms > 1e3 * log.dt)),
        **statistics(log),
    }


def consistency(log: EpisodeLog) -> dict[str, float]:
    """Consistency of the covariances: the mean NEES, and that of one tick drawn by the seed.

    Errors of neighbouring ticks are correlated, so only one tick of a drive is an independent draw of chi-squared with
    three degrees of freedom.
    """
    values = nees(log.estimate, log.true_pose, log.covariance)
    chosen = np.random.default_rng([56, log.seed, len(values)]).integers(len(values))
    return {"mean": float(values.mean()), "drawn": float(values[chosen])}


def nees(estimate: Array, truth: Array, covariance: Array) -> Array:
    """Normalised estimation error squared e' P^-1 e (Bar-Shalom et al. 2001, section 5.4), three on average.

    Args:
        estimate: (n, 3) [m, m, rad].
        truth: (n, 3) [m, m, rad].
        covariance: (n, 3, 3) in the tangent space at the estimate.

    Returns:
        (n,).
    """
    error = SE2.local(estimate, truth)
    found: Array = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    return found


def pose_errors(estimate: Array, truth: Array) -> tuple[Array, Array]:
    """Distance and absolute heading difference between poses.

    Args:
        estimate: (n, 3) [m, m, rad].
        truth: (n, 3) [m, m, rad].

    Returns:
        (n,) distances [m] and (n,) angles in [0, pi] [rad].
    """
    distance: Array = np.linalg.norm(estimate[:, :2] - truth[:, :2], axis=1)
    angle: Array = np.abs(wrap_angle(estimate[:, 2] - truth[:, 2]))
    return distance, angle
