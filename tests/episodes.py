"""A made-up episode: a robot that drives an arc through a small room, with everything a real loop would record."""

from __future__ import annotations

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.lie import wrap_angle
from unifg.scenarios.logs.drive_log import Assumed, EpisodeLog
from unifg.typing import Array

RESOLUTION = 0.1
BEAMS, HORIZON, DT = 72, 10, 0.1


def room(width: float = 8.0, height: float = 6.0, yaw: float = 0.0) -> OccupancyMap:
    """A walled room with a pillar, of cells of 0.1 m, its lower-left corner at (-1, -1)."""
    shape = (round(height / RESOLUTION), round(width / RESOLUTION))
    occupied = np.zeros(shape, dtype=bool)
    occupied[:2] = occupied[-2:] = True
    occupied[:, :2] = occupied[:, -2:] = True
    occupied[20:26, 50:56] = True
    return OccupancyMap(occupied, ~occupied, RESOLUTION, (-1.0, -1.0, yaw), "room")


def episode(ticks: int = 40, obstacles: int = 2, *, map_yaw: float = 0.0, seed: int = 3) -> EpisodeLog:
    """An arc from (0, 0) at 0.5 m/s with a known drift of dead reckoning and a constant error of the estimate."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(ticks, dtype=np.float64)
    sweep = 1.2 * max(ticks * DT, 1.0)
    phase = 0.5 * time / sweep * 2.4
    truth = np.column_stack([2.4 * np.sin(phase), 2.4 * (1.0 - np.cos(phase)), phase])
    estimate = truth + np.array([0.03, 0.04, -0.01])
    drift = truth + np.column_stack([0.02 * time, 0.01 * time, 0.005 * time])
    ahead = DT * np.arange(HORIZON + 1)
    heading = truth[:, 2:] + np.zeros(HORIZON + 1)
    horizon = np.stack(
        [
            truth[:, :1] + 0.5 * ahead * np.cos(truth[:, 2:]),
            truth[:, 1:2] + 0.5 * ahead * np.sin(truth[:, 2:]),
            wrap_angle(heading),
        ],
        axis=-1,
    )
    scan = 2.0 + 0.02 * rng.standard_normal((ticks, BEAMS))
    scan[:, 0], scan[:, 1] = np.nan, np.inf
    places = np.empty((ticks, obstacles, 3))
    for k in range(obstacles):
        places[:, k] = (4.0, 1.0 + k, 0.2)
        if k % 3 == 0:
            places[:, k, 1] += 0.3 * np.minimum(time, 3.0)
    solve = 5.0 + np.arange(ticks, dtype=np.float64) % 7
    emergency = np.zeros(ticks, dtype=bool)
    emergency[-1] = True
    return EpisodeLog(
        occupancy=room(yaw=map_yaw),
        walls=room(yaw=map_yaw),
        assumed=Assumed(2.0, 0.03, 0.06, 2.5, 0.5),
        path=truth.copy(),
        goals=truth[-1:].copy(),
        start=truth[0].copy(),
        dt=DT,
        robot_radius=0.17,
        solver="alm",
        coupling="sequential",
        seed=seed,
        time=time,
        true_pose=truth,
        estimate=estimate,
        dead_reckoning=drift,
        covariance=np.tile(np.diag([4e-4, 1e-4, 1e-5]), (ticks, 1, 1)),
        route=[truth.copy() if k < ticks // 2 else truth + np.array([0.0, 0.1, 0.0]) for k in range(ticks)],
        contacts=np.zeros(ticks, dtype=np.intp),
        control=np.column_stack([np.full(ticks, 0.5), np.full(ticks, 0.2)]),
        horizon=horizon,
        way_out=np.repeat(truth[:, None], HORIZON + 1, axis=1),
        scan=scan,
        obstacle_moves=np.arange(obstacles) % 3 == 0,
        scan_angles=np.linspace(-np.pi, np.pi, BEAMS, endpoint=False),
        obstacles=places,
        detected=[_seen(places[k], k) for k in range(ticks)],
        expected=[
            np.column_stack([row[:, :2], np.tile([0.3, 0.21], (len(row), 1))])
            for row in map(_seen, places, range(ticks))
        ],
        solve_ms=solve,
        localise_ms=solve * 0.25,
        compiled=np.zeros(ticks, dtype=np.intp),
        plan_ms=solve * 0.75,
        perceive_ms=solve * 0.1,
        route_ms=solve * 0.05,
        localisation_iterations=np.full(ticks, 2, dtype=np.intp),
        plan_iterations=1 + np.arange(ticks, dtype=np.intp) % 3,
        status=["converged"] * (ticks - 1) + ["stalled"],
        bound_violation=np.full(ticks, -1e-9),
        clearance=0.6 - 0.2 * np.sin(phase),
        collisions=0,
        goal_index=np.zeros(ticks, dtype=np.intp),
        reached=[True],
        emergency=emergency,
        rescued=np.zeros(ticks, dtype=bool),
        outcomes=["reached"],
        health=["ok"] * (ticks - 1) + ["degraded"],
        cause=[""] * (ticks - 1) + ["no plan"],
        allowed=np.where(emergency, 0.5, 1.0),
        explained=np.full(ticks, 0.9),
        emergency_stop=np.zeros(ticks, dtype=bool),
        power_off=np.zeros(ticks, dtype=bool),
        fault=[""] * ticks,
    )


def _seen(obstacles: Array, tick: int) -> Array:
    """Output of a simulated tracker: nothing at first, then the first obstacle."""
    return obstacles[: min(1, tick // 5)].copy()
