"""Shared parts of the baseline planners: turning at the goal, sampled drives, distances to the reference."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from unifg.lie import wrap_angle
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.local_planner import PlannerContext, Situation
from unifg.typing import Array

__all__ = ["AtGoal", "rollouts", "to_reference", "turn_on_spot"]

AT_GOAL = 0.05  # [m]; from here on a planner that cannot reach a pose in one motion turns on the spot
OFF_GOAL = 0.1  # [m]; a robot that has slid so far away drives again
TURNED = 0.02  # [rad]


class AtGoal(ABC):
    """A planner that turns on the spot where the goal has been reached but for its heading.

    Attributes:
        settings: limits of the robot.
        iterations: of the last tick.
    """

    def __init__(self, context: PlannerContext) -> None:
        """Begin away from the goal."""
        self.settings, self.iterations, self._turning = context.settings, 1, False

    def control(self, now: Situation) -> Array | None:
        """(1, 2) a turn towards the heading of the goal [m/s, rad/s]; what is driven away from the goal."""
        goal = now.goal
        away = np.inf if goal is None else float(np.hypot(*(goal - now.pose)[:2]))
        self._turning = away < (OFF_GOAL if self._turning else AT_GOAL)
        if goal is None or not self._turning:
            return self.drive(now)
        return turn_on_spot(float(wrap_angle(goal[2] - now.pose[2])), now.settings)

    @abstractmethod
    def drive(self, now: Situation) -> Array | None:
        """Controls away from the goal."""

    def forget(self) -> None:
        """Leave the turn at a goal."""
        self._turning = False


def turn_on_spot(angle: float, settings: ControllerSettings) -> Array:
    """(1, 2) turn so fast that the robot can stop at the angle [rad] that is left [m/s, rad/s]."""
    s = settings
    if abs(angle) <= TURNED:
        return np.zeros((1, 2))
    limit = min(s.limits[1], float(np.sqrt(2.0 * s.accelerations[1] * abs(angle))), abs(angle) / s.dt)
    return np.array([[0.0, np.copysign(limit, angle)]])


def rollouts(pose: Array, controls: Array, dt: float) -> Array:
    """Poses (M, K + 1, 3) of M drives from one pose (3,) under controls (M, K, 2); headings are not wrapped."""
    states = np.empty((len(controls), controls.shape[1] + 1, 3))
    states[:, 0] = pose
    turn = dt * controls[..., 1]
    states[:, 1:, 2] = pose[2] + np.cumsum(turn, axis=1)
    middle, along = states[:, 1:, 2] - 0.5 * turn, dt * controls[..., 0]
    states[:, 1:, 0] = pose[0] + np.cumsum(along * np.cos(middle), axis=1)
    states[:, 1:, 1] = pose[1] + np.cumsum(along * np.sin(middle), axis=1)
    return states


def to_reference(now: Situation, points: Array) -> tuple[Array, Array]:
    """Distance of points (M, 2) from the reference, and the length of it left from the nearest point.

    Returns:
        (M,) and (M,) [m].
    """
    x, y = np.ascontiguousarray(points.T)
    closest, left = np.full(len(points), np.inf), np.zeros(len(points))
    arc = now.along()
    # One segment after the other: all at once is an array of a hundred thousand vectors, four times slower.
    for (bx, by), (sx, sy), passed, length in zip(
        now.reference[:-1, :2], np.diff(now.reference[:, :2], axis=0), arc, np.diff(arc), strict=False
    ):
        dx, dy = x - bx, y - by
        share = np.minimum(np.maximum((dx * sx + dy * sy) / max(length**2, 1e-18), 0.0), 1.0)
        gap = np.square(dx - share * sx) + np.square(dy - share * sy)
        closer = gap < closest
        closest = np.where(closer, gap, closest)
        left = np.where(closer, arc[-1] - (passed + share * length), left)
    return np.sqrt(closest), left
