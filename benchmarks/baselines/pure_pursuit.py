"""Regulated pure pursuit (Macenski, Singh, Martin, Gines, Autonomous Robots 47 (2023), sections 3.1 to 3.3).

An arc leads from the robot to a carrot on the path, farther ahead the faster the robot is. Its speed is lowered where
the arc is sharp, where walls or discs are near, and before the goal; before anything that the arc would hit the robot
stops. Numbers are the defaults of the authors' plugin for Nav2, ``nav2_regulated_pure_pursuit_controller``, but for the
speed, which is the reference speed of the run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.baselines.shared import AtGoal, turn_on_spot
from unifg.models import unicycle
from unifg.scenarios.ground.local_planner import PlannerContext, Situation
from unifg.typing import Array

__all__ = ["PurePursuit", "PursuitSettings"]


@dataclass(frozen=True)
class PursuitSettings:
    """Numbers of the planner.

    Attributes:
        lookahead_time: from robot to carrot at the present speed [s].
        lookahead: least and greatest distance to the carrot [m].
        turning_radius: arcs below it are driven slower, in proportion [m].
        proximity: distance from the robot's centre to things below which it is slower, in proportion [m].
        slowest: of the speeds so lowered [m/s].
        approach: length of path before the goal along which the speed falls [m].
        approach_speed: at its end [m/s].
        turn_beyond: angle to the carrot beyond which it turns on the spot first [rad].
        foresight: time along the arc that must be free, as far as the carrot [s].
    """

    lookahead_time: float = 1.5
    lookahead: tuple[float, float] = (0.3, 0.9)
    turning_radius: float = 0.9
    proximity: float = 0.6
    slowest: float = 0.25
    approach: float = 0.6
    approach_speed: float = 0.05
    turn_beyond: float = 0.785
    foresight: float = 1.0


class PurePursuit(AtGoal):
    """Arcs to a carrot on the path.

    Attributes:
        settings: limits of the robot.
        numbers: of the planner.
        iterations: one.
    """

    def __init__(self, context: PlannerContext, numbers: PursuitSettings | None = None) -> None:
        """Construct for a map; without ``numbers`` with the published ones."""
        super().__init__(context)
        self.numbers = numbers or PursuitSettings()

    def drive(self, now: Situation) -> Array | None:
        """An arc to the carrot, a turn towards it, or a stop."""
        carrot = self.carrot(now)
        offset = carrot[:2] - now.pose[:2]
        distance = float(np.hypot(*offset))
        bearing = np.arctan2(offset[1], offset[0]) - now.pose[2]
        ahead, aside = distance * np.cos(bearing), distance * np.sin(bearing)
        if abs(np.arctan2(aside, ahead)) > self.numbers.turn_beyond:
            return turn_on_spot(float(np.arctan2(aside, ahead)), now.settings)
        curvature = 2.0 * aside / max(distance, 1e-6) ** 2
        speed = self.speed(now, curvature)
        control = np.array([[speed, np.clip(speed * curvature, *(side[1] for side in self.settings.box))]])
        return control if self.free(now, control[0], distance) else None

    def carrot(self, now: Situation) -> Array:
        """(3,) pose of the path at the present look-ahead distance from the robot, its end if that is nearer."""
        reach = float(np.clip(abs(now.applied[0]) * self.numbers.lookahead_time, *self.numbers.lookahead))
        gap = np.hypot(*(now.reference[:, :2] - now.pose[:2]).T)
        beyond = np.flatnonzero(gap >= reach)
        if not len(beyond):
            return np.array(now.reference[-1])
        k = int(beyond[0])
        if k == 0 or gap[k - 1] >= gap[k]:
            return np.array(now.reference[k])
        share = (reach - gap[k - 1]) / (gap[k] - gap[k - 1])
        carrot: Array = now.reference[k - 1] + share * (now.reference[k] - now.reference[k - 1])
        return carrot

    def speed(self, now: Situation, curvature: float) -> float:
        """The speed wanted, regulated by curvature (eq. 4), by what is near (eq. 5), and by the goal [m/s]."""
        own, wanted = self.numbers, now.settings.speed
        bend = 1.0 / (own.turning_radius * max(abs(curvature), 1e-9))
        room = float(now.clearance(now.pose[None, :2], 0.0)[0]) + self.settings.robot_radius
        regulated = max(wanted * min(1.0, bend, max(room, 0.0) / own.proximity), own.slowest)
        if now.goal is None:
            return regulated
        left = max(now.along()[-1], float(np.hypot(*(now.goal - now.pose)[:2])))
        return float(min(regulated, max(wanted * left / own.approach, own.approach_speed)))

    def free(self, now: Situation, control: Array, distance: float) -> bool:
        """Return True if the arc is free for the foresight, or to the carrot if that is nearer."""
        dt = 0.5 * self.settings.dt
        steps = int(np.ceil(min(self.numbers.foresight, distance / max(float(control[0]), 1e-6)) / dt))
        states = unicycle.rollout(now.pose, np.tile(control, (max(steps, 1), 1)), dt)
        times = dt * np.arange(1.0, len(states))
        return not now.hits(now.clearance(states[1:, :2], times), times).any()
