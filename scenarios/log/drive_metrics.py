"""Numbers that say how an episode went, and their JSON file.

Everything measured by a clock lives under keys that end in ``_ms``; the rest depends on settings and seed alone, so two
runs of the same seed compare equal after `without_timings`.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TypedDict

import numpy as np

from unifg.errors import ScenarioError
from unifg.lie import wrap_angle
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.ways.polyline import path_length
from unifg.typing import Array, IntArray

__all__ = [
    "EpisodeMetrics",
    "Iterations",
    "Spread",
    "Timing",
    "episode_metrics",
    "pose_errors",
    "without_timings",
    "write_metrics",
]


class Spread(TypedDict):
    """Statistics over the ticks of an episode."""

    mean: float
    std: float
    max: float


class Timing(TypedDict):
    """Percentiles over the ticks of an episode [ms]."""

    p50: float
    p99: float
    max: float


class Iterations(TypedDict):
    """Iterations of the solver over the ticks of an episode."""

    mean: float
    max: int


class EpisodeMetrics(TypedDict):
    """What `episode_metrics` returns; the key says the unit.

    ``path_length_m`` is the way the robot really drove, ``planned_length_m`` that of the planned path;
    ``solver_failures`` counts ticks whose solve was rejected, so that the stored plan was driven
    (``emergency_ticks``, the same ticks), and ``plan_status`` counts the status words of all ticks.
    ``odometry_error_m`` is the error of dead reckoning.
    """

    scenario: str
    map: str
    solver: str
    coupling: str
    seed: int
    succeeded: bool
    interrupted: bool
    reached: bool
    goals: int
    goals_reached: int
    obstacles: int
    collisions: int
    steps: int
    duration_s: float
    path_length_m: float
    planned_length_m: float
    mean_speed_m_per_s: float
    min_clearance_m: float
    localisation_error_m: Spread
    localisation_error_rad: Spread
    odometry_error_m: Spread
    odometry_error_rad: Spread
    solver_failures: int
    emergency_ticks: int
    plan_status: dict[str, int]
    max_bound_violation: float
    localisation_iterations: Iterations
    plan_iterations: Iterations
    solve_ms: Timing
    localise_ms: Timing
    plan_ms: Timing
    perceive_ms: Timing
    route_ms: Timing


def episode_metrics(log: EpisodeLog) -> EpisodeMetrics:
    """Summarise an episode.

    Args:
        log: an episode of at least one tick.

    Returns:
        The metrics, of plain Python numbers.

    Raises:
        ScenarioError: the episode has no tick.
    """
    if log.ticks == 0:
        raise ScenarioError("the episode has no tick: there is nothing to measure")
    duration = round(log.ticks * log.dt, 9)
    length = path_length(log.true_pose)
    position, heading = pose_errors(log.estimate, log.true_pose)
    odometry_position, odometry_heading = pose_errors(log.dead_reckoning, log.true_pose)
    emergencies = int(np.count_nonzero(log.emergency))
    return EpisodeMetrics(
        scenario=log.scenario,
        map=log.occupancy.name,
        solver=log.solver,
        coupling=log.coupling,
        seed=int(log.seed),
        succeeded=log.succeeded,
        interrupted=bool(log.interrupted),
        reached=bool(log.reached) and all(log.reached),
        goals=len(log.goals),
        goals_reached=sum(bool(flag) for flag in log.reached),
        obstacles=int(log.obstacles.shape[1]),
        collisions=int(log.collisions),
        steps=log.ticks,
        duration_s=float(duration),
        path_length_m=length,
        planned_length_m=path_length(log.path),
        mean_speed_m_per_s=length / duration,
        min_clearance_m=float(np.min(log.clearance)),
        localisation_error_m=_spread(position),
        localisation_error_rad=_spread(heading),
        odometry_error_m=_spread(odometry_position),
        odometry_error_rad=_spread(odometry_heading),
        solver_failures=emergencies,
        emergency_ticks=emergencies,
        plan_status=dict(sorted(Counter(log.status).items())),
        max_bound_violation=float(max(0.0, np.max(log.bound_violation))),
        localisation_iterations=_iterations(log.localisation_iterations),
        plan_iterations=_iterations(log.plan_iterations),
        solve_ms=_timing(log.solve_ms),
        localise_ms=_timing(log.localise_ms),
        plan_ms=_timing(log.plan_ms),
        perceive_ms=_timing(log.perceive_ms),
        route_ms=_timing(log.route_ms),
    )


def without_timings(metrics: Mapping[str, object]) -> dict[str, object]:
    """The metrics that settings and seed determine: all but the keys that end in ``_ms``."""
    return {key: value for key, value in metrics.items() if not key.endswith("_ms")}


def write_metrics(path: str | Path, metrics: Mapping[str, object]) -> Path:
    """Write metrics as JSON with sorted keys; a number that is not finite becomes null.

    Args:
        path: file to write; an existing one is replaced.
        metrics: what `episode_metrics` returned.

    Returns:
        The path written.
    """
    path = Path(path)
    text = json.dumps(_strict(dict(metrics)), indent=2, sort_keys=True, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8", newline="\n")
    return path


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


def _spread(values: Array) -> Spread:
    return Spread(mean=float(np.mean(values)), std=float(np.std(values)), max=float(np.max(values)))


def _timing(values: Array) -> Timing:
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return Timing(p50=float(p50), p99=float(p99), max=float(np.max(values)))


def _iterations(values: IntArray) -> Iterations:
    return Iterations(mean=float(np.mean(values)), max=int(np.max(values)))


def _strict(value: object) -> object:
    """The same value for a strict JSON reader, which knows neither NaN nor infinity."""
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
