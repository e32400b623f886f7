"""Things that are not on the map: discs that rest, or go to and fro and wait for a robot at rest."""

from __future__ import annotations

from dataclasses import dataclass

import pymunk

from unifg.typing import Array

__all__ = ["COURTESY_GAP", "Mover", "Obstacle"]

COURTESY_GAP = 0.1
"""Gap a mover keeps between its hull and that of a resting robot [m]."""


@dataclass(frozen=True)
class Obstacle:
    """A disc that is not on the map; it rests, or moves to and fro between two points.

    Attributes:
        centre: (2,) where it is at time zero, world frame [m].
        radius: [m].
        end: (2,) far end of the segment it moves along, starting from ``centre`` [m]; None for a fixed
            obstacle.
        speed: speed along the segment [m/s]; 0 for a fixed obstacle.
    """

    centre: Array
    radius: float
    end: Array | None = None
    speed: float = 0.0

    @property
    def moving(self) -> bool:
        """True if the obstacle moves by design, even while it waits."""
        return self.end is not None and self.speed > 0.0


class Mover:
    """A kinematic disc going to and fro along its segment."""

    def __init__(self, obstacle: Obstacle, end: Array) -> None:
        """Stand at the obstacle's centre, about to leave for ``end`` (2,) [m]."""
        self.origin = pymunk.Vec2d(*map(float, obstacle.centre))
        span = pymunk.Vec2d(*map(float, end)) - self.origin
        self.length = span.length
        self.direction = span.normalized()
        self.radius = obstacle.radius
        self.speed = obstacle.speed
        self.along = 0.0
        self.sense = 1.0
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.body.position = self.origin

    def advance(self, robot: pymunk.Body, robot_radius: float, resting: bool, dt: float) -> None:
        """Choose the velocity of the next substep; wait when it would crowd a robot at rest.

        Args:
            robot: the robot's body.
            robot_radius: [m].
            resting: True while the robot stands still; turning on the spot is standing still.
            dt: duration of the substep [s].
        """
        along, sense = self.along + self.sense * self.speed * dt, self.sense
        if along > self.length:
            along, sense = max(2.0 * self.length - along, 0.0), -1.0
        elif along < 0.0:
            along, sense = min(-along, self.length), 1.0
        target = self.origin + along * self.direction
        if resting:
            hulls = robot_radius + self.radius
            gap = target.get_distance(robot.position) - hulls
            if gap < COURTESY_GAP and gap < self.body.position.get_distance(robot.position) - hulls:
                self.body.velocity = (0.0, 0.0)
                return
        self.along, self.sense = along, sense
        self.body.velocity = (target - self.body.position) / dt  # lands on the segment: no drift
