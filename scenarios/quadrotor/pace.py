"""The time on a path waits for a vehicle that is held up.

A path in time goes on when an obstacle keeps the vehicle back. Who then follows a point that is far ahead flies
straight at it, or rushes after it. So the time on the path runs more slowly the farther the vehicle lags behind,
measured along the path, and stands still at a bound; beside the path, which is how obstacles are passed, it may be as
far as it likes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios.planning.flat_path import FlatPath, Flown
from unifg.typing import Array

__all__ = ["Pace"]

REST = 1e-3  # a path slower than that leads nowhere [m/s]


@dataclass
class Pace:
    """One flight along a path.

    Attributes:
        path: to be followed.
        reach: how far the path may be ahead of the vehicle [m]; up to half of it time runs as ever.
        now: time on the path [s].
        rate: how fast it runs.
    """

    path: FlatPath
    reach: float
    now: float = 0.0
    rate: float = 1.0

    def see(self, place: Array) -> None:
        """Look how far behind a vehicle at a place (3,) is."""
        flown = self.path.at(np.array([self.now]))
        along = flown.velocity[0]
        speed = float(np.linalg.norm(along))
        lag = float((flown.position[0] - place) @ along) / speed if speed > REST else 0.0
        self.rate = float(np.clip(2.0 - 2.0 * lag / self.reach, 0.0, 1.0))

    def pass_by(self, dt: float) -> None:
        """Let a tick [s] pass."""
        self.now += self.rate * dt

    def at(self, ahead: Array) -> Flown:
        """The path some seconds (n,) ahead, as it will be if time goes on to run like that."""
        r = self.rate
        p, v, a, j = self.path.at(self.now + r * ahead)
        return Flown(p, r * v, r * r * a, r**3 * j)
