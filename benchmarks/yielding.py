"""World in which discs that move stop before a robot in their way, and go on once it has left.

``unifg run navigation --world benchmarks.yielding:Yielding``.
"""

from __future__ import annotations

import pymunk

from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Mover, Obstacle, Space, ToAndFro, reflected

BRAKING = 1.0  # [m/s^2]
GAP, ASIDE = 0.5, 0.25  # [m] between hulls, ahead of a mover that stands and beside its way


class Yields(ToAndFro):
    """To and fro along the segment of an obstacle, but not into a vehicle ahead."""

    def __init__(self, obstacle: Obstacle) -> None:
        """Begin at the obstacle's centre, at full speed."""
        super().__init__(obstacle)
        self.now = self.speed

    def velocity(self, mover: Mover, space: Space, dt: float) -> tuple[float, float]:
        """Velocity to the next place on the segment."""
        hulls, offset = mover.radius + space.radius, space.vehicle.position - mover.body.position
        ahead, aside = self.sense * offset.dot(self.direction), abs(offset.cross(self.direction))
        met = 0.0 < ahead < hulls + GAP + self.now**2 / (2.0 * BRAKING) and aside < hulls + ASIDE
        self.now = max(self.now - BRAKING * dt, 0.0) if met else min(self.now + BRAKING * dt, self.speed)
        self.along, self.sense = reflected(self.along, self.sense, self.now * dt, self.length)
        return (self.origin + self.along * self.direction - mover.body.position) / dt


class Yielding(World):
    """Plane world whose obstacles yield."""

    def add_disc(self, obstacle: Obstacle, owner: int) -> pymunk.Shape:
        """Add a disc that rests, or goes to and fro and yields."""
        policy = Yields(obstacle) if obstacle.moving else None
        return self.add_mover(Mover(obstacle.centre, obstacle.radius, policy), owner)
