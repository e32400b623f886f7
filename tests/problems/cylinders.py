"""Flights at 6 m/s among ten upright cylinders at random.

The quadrotor of :mod:`problems.control` follows a straight line for 2.5 s; the cylinders stand on it and beside it. Its
guess is that line, through the cylinders.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from problems.control import Quadrotor
from unifg.models import quadrotor
from unifg.typing import Array

SPEED = 6.0  # [m/s]
CYLINDERS = 10
FREE = 1.5  # of cylinders, around the start [m]


@dataclass(frozen=True)
class Flight(Quadrotor):
    """One layout.

    Attributes:
        seed: of the cylinders.
    """

    obstacles = "cylinders"
    axes = 2

    seed: int = 0

    @property
    def name(self) -> str:
        """For the tables."""
        return f"layout {self.seed}"

    @property
    def discs(self) -> Array:
        """(M, 4) x, y, nothing, radius of the cylinders [m]."""
        rng = np.random.default_rng([61, self.seed])
        length = SPEED * self.dt * self.horizon
        found: list[tuple[float, float, float, float]] = []
        while len(found) < CYLINDERS:
            x, y, radius = rng.uniform(0.0, length), rng.uniform(-1.5, 1.5), rng.uniform(0.25, 0.5)
            if np.hypot(x, y) >= FREE + radius:
                found.append((x, y, 0.0, radius))
        return np.array(found)

    @property
    def start(self) -> Array:
        """(10,) level flight at the speed of the reference."""
        return np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, SPEED, 0.0, 0.0])

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, 10) from step ``first`` on, and controls (N, 4)."""
        t = self.dt * np.arange(first, first + self.horizon + 1)
        states = np.tile(self.start, (len(t), 1))
        states[:, 0] = SPEED * t
        return states, np.tile([0.0, 0.0, 0.0, quadrotor.GRAVITY], (self.horizon, 1))


def flight(seed: int, horizon: int = 50) -> Flight:
    """One layout of the study."""
    return Flight("flight", True, horizon, seed)
