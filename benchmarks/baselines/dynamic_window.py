"""The dynamic window approach (Fox, Burgard, Thrun, IEEE Robotics and Automation Magazine 4 (1997)).

Velocities within reach in the next tick are tried, each held for a while. Those from which the robot could not stop
before it hits something are not admissible (eq. 14); the cheapest of the others is driven. The paper weights heading to
the goal, clearance and speed; costs here are those its present-day implementation adds so that it follows a path round
corners: critics and weights are the defaults of ``nav2_dwb_controller`` (BaseObstacle, PathDist, PathAlign, GoalDist,
GoalAlign, RotateToGoal), distances in metres, with goal distances measured along the path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.baselines.shared import AtGoal, rollouts, to_reference
from unifg.scenarios.ground.local_planner import PlannerContext, Situation
from unifg.typing import Array, BoolArray

__all__ = ["DynamicWindow", "WindowSettings"]

FULL = 252.0  # cost of a place whose centre is as near as the hull, in the costmaps of Nav2


@dataclass(frozen=True)
class WindowSettings:
    """Numbers of the planner.

    Attributes:
        samples: speeds and turning speeds that are tried, beside rest.
        horizon: time for which each is held [s].
        step: between places that are looked at [s].
        backwards: greatest speed backwards [m/s].
        path_distance, path_align, goal_distance, goal_align: weights, of the end of each drive and of a point ahead of
            it [1/m].
        ahead: of the robot, the point that is aligned [m], as long as ``aligned_beyond`` [m] of path are left: that
            point would reach the goal before the robot does.
        obstacle: weight of the costmap.
        inflation: of the costmap, how far from the hull it reaches [m].
        decay: of the costmap [1/m].
    """

    samples: tuple[int, int] = (20, 20)
    horizon: float = 1.7
    step: float = 0.05
    backwards: float = 0.0
    path_distance: float = 32.0
    path_align: float = 32.0
    goal_distance: float = 24.0
    goal_align: float = 24.0
    ahead: float = 0.1
    aligned_beyond: float = 0.5
    obstacle: float = 0.02
    inflation: float = 0.55
    decay: float = 3.0


class DynamicWindow(AtGoal):
    """Cheapest of many velocities.

    Attributes:
        settings: limits of the robot.
        numbers: of the planner.
        iterations: velocities tried at the last tick.
    """

    def __init__(self, context: PlannerContext, numbers: WindowSettings | None = None) -> None:
        """Construct for a map; without ``numbers`` with the published ones."""
        super().__init__(context)
        self.numbers = numbers or WindowSettings()

    def drive(self, now: Situation) -> Array | None:
        """The cheapest admissible velocity."""
        tried = self.window(now)
        steps = round(self.numbers.horizon / self.numbers.step)
        states = rollouts(now.pose, np.tile(tried[:, None], (1, steps, 1)), self.numbers.step)
        times = self.numbers.step * np.arange(1.0, steps + 1)
        clearance = now.clearance(states[:, 1:, :2], times)
        admissible = self.admissible(tried, now.hits(clearance, times))
        if not admissible.any():
            return None
        cost = np.where(admissible, self.cost(now, states, clearance), np.inf)
        self.iterations = len(tried)
        best: Array = tried[np.argmin(cost)][None]
        return best

    def window(self, now: Situation) -> Array:
        """(M, 2) velocities that the robot can have after this tick (eq. 13)."""
        s, own = now.settings, self.numbers
        change, (least, most) = s.most, s.box
        least = np.array([-own.backwards, least[1]])
        low = np.minimum(np.maximum(now.applied - change, least), now.applied + change)
        high = np.maximum(np.minimum(now.applied + change, most), low)
        speeds, turns = (np.linspace(low[i], high[i], own.samples[i]) for i in range(2))
        inside = (low[1] <= 0.0 <= high[1]) * np.ones(1)  # straight on is always tried, if it can be
        turns = np.append(turns, 0.0) if inside.any() else turns
        return np.stack(np.meshgrid(speeds, turns, indexing="ij"), axis=-1).reshape(-1, 2)

    def admissible(self, tried: Array, hit: BoolArray) -> BoolArray:
        """(M,) True if the robot can stop before the first place (M, K) where it hits something (eq. 14)."""
        first = np.where(hit.any(axis=1), hit.argmax(axis=1), hit.shape[1])
        time = self.numbers.step * first  # of driving freely
        free = ~hit.any(axis=1)
        stop = np.abs(tried) / np.array(self.settings.accelerations)  # braking takes so long, and half the way
        admissible: BoolArray = free | (0.5 * stop.max(axis=1) + self.settings.dt <= time)
        return admissible

    def cost(self, now: Situation, states: Array, clearance: Array) -> Array:
        """(M,) cost of drives (M, K + 1, 3) with clearances (M, K)."""
        own, end = self.numbers, states[:, -1]
        nose = end[:, :2] + own.ahead * np.stack([np.cos(end[:, 2]), np.sin(end[:, 2])], axis=1)
        away, left = to_reference(now, end[:, :2])
        nose_away, nose_left = to_reference(now, nose)
        aligned = float(now.along()[-1] > own.aligned_beyond)
        near = clearance.min(axis=1)
        occupied = np.where(near < own.inflation, FULL * np.exp(-own.decay * np.maximum(near, 0.0)), 0.0)
        return (
            own.path_distance * away + own.goal_distance * left + own.obstacle * occupied
            + aligned * (own.path_align * nose_away + own.goal_align * nose_left)
        )  # fmt: skip
