"""What one closed-loop run leaves behind: the record that metrics, plots and scenes read.

The loop writes it, tick by tick; everything downstream only reads it, so a picture never needs the solver that made it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["EpisodeLog"]


@dataclass
class EpisodeLog:
    """One episode of T ticks with a horizon of N steps, K true obstacles and G goals.

    Arrays over time share the leading axis T. Row k holds what was true, estimated and decided at ``time[k]``;
    ``control[k]`` is held over ``[time[k], time[k] + dt]``. An episode that was interrupted is a shorter one.

    Attributes:
        occupancy: map the robot was given, without the unforeseen obstacles.
        path: (P, 3) planned path over all goals, world frame [m, m, rad].
        goals: (G, 3) goal poses [m, m, rad].
        start: (3,) true start pose [m, m, rad].
        dt: control period [s].
        robot_radius: radius of the robot's disc [m].
        solver: name of the backend.
        coupling: how estimation and control were joined, such as ``"sequential"``.
        seed: seed of the episode.
        time: (T,) [s].
        true_pose: (T, 3) [m, m, rad].
        estimate: (T, 3) localised pose [m, m, rad].
        dead_reckoning: (T, 3) pose integrated from the wheel odometry alone [m, m, rad].
        control: (T, 2) commanded v [m/s] and omega [rad/s].
        horizon: (T, N + 1, 3) predicted poses [m, m, rad].
        scan: (T, B) lidar ranges [m]; NaN is a dropout, +inf no return.
        scan_angles: (B,) beam angles in the body frame [rad].
        obstacles: (T, K, 3) true unforeseen obstacles x, y, radius [m].
        detected: T arrays (m, 3), tracked obstacles x, y, radius [m].
        solve_ms: (T,) localise and plan together [ms].
        perceive_ms: (T,) update of the tracked obstacles [ms].
        route_ms: (T,) repair of the global route [ms], most often nothing.
        localise_ms: (T,) [ms].
        plan_ms: (T,) [ms].
        localisation_iterations: (T,).
        plan_iterations: (T,).
        status: T status words of the plan, ``"converged"`` when all is well.
        bound_violation: (T,) worst violation of a control bound by the plan that is driven, as the solver returned
            it, before any clipping.
        clearance: (T,) distance from the robot's hull to the nearest thing [m].
        collisions: distinct contact events of the episode.
        goal_index: (T,) goal being approached.
        reached: one flag per goal.
        emergency: (T,) True where the stored plan was driven because the tick's solve failed.
        obstacle_moving: (K,) True for obstacles that move by design; None derives it from their positions.
        control_limits: greatest abs(v) [m/s] and abs(omega) [rad/s].
        scenario: name of the scenario.
        interrupted: the user stopped the episode before its end.
    """

    occupancy: OccupancyMap
    path: Array
    goals: Array
    start: Array
    dt: float
    robot_radius: float
    solver: str
    coupling: str
    seed: int
    time: Array
    true_pose: Array
    estimate: Array
    dead_reckoning: Array
    control: Array
    horizon: Array
    scan: Array
    scan_angles: Array
    obstacles: Array
    detected: list[Array]
    solve_ms: Array
    localise_ms: Array
    plan_ms: Array
    perceive_ms: Array
    route_ms: Array
    localisation_iterations: IntArray
    plan_iterations: IntArray
    status: list[str]
    bound_violation: Array
    clearance: Array
    collisions: int
    goal_index: IntArray
    reached: list[bool]
    emergency: BoolArray
    obstacle_moving: BoolArray | None = None
    control_limits: tuple[float, float] = (1.0, 1.0)
    scenario: str = "navigation"
    interrupted: bool = False

    @property
    def ticks(self) -> int:
        """Number of ticks recorded."""
        return len(self.time)

    @property
    def succeeded(self) -> bool:
        """True only if every goal was reached without a collision, in an episode run to its end."""
        return not self.interrupted and bool(self.reached) and all(self.reached) and self.collisions == 0

    def moving(self) -> BoolArray:
        """(K,) True for the obstacles that move, by design or as seen over the episode."""
        if self.obstacle_moving is not None:
            return self.obstacle_moving
        if self.ticks == 0:
            return np.zeros(self.obstacles.shape[1], dtype=bool)
        places = self.obstacles[:, :, :2]
        travel = np.abs(places - places[:1]).max(axis=(0, 2), initial=0.0)
        moved: BoolArray = np.asarray(travel > 1e-6)
        return moved
