"""Paths in space with their derivatives, as those who fly by differential flatness need them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from unifg.typing import Array

__all__ = ["FigureEight", "FlatPath", "Flown", "Hover", "Line"]


class Flown(NamedTuple):
    """A path at n times.

    Attributes:
        position, velocity, acceleration, jerk: (n, 3) in the world [m, m/s, m/s^2, m/s^3].
    """

    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array


class FlatPath(Protocol):
    """Positions over time."""

    def at(self, times: Array) -> Flown:
        """The path at times (n,) [s], before and after which it goes on as it is stated."""


@dataclass(frozen=True)
class Hover:
    """Staying in place.

    Attributes:
        place: (x, y, z) [m].
    """

    place: tuple[float, float, float]

    def at(self, times: Array) -> Flown:
        """The place."""
        still = np.zeros((len(times), 3))
        return Flown(np.tile(np.array(self.place), (len(times), 1)), still, still, still)


@dataclass(frozen=True)
class Line:
    """A straight line with a trapezoidal speed profile; at rest before it begins and after its end.

    Attributes:
        start, end: (x, y, z) [m], not the same.
        speed: on the plateau, if the line is long enough to reach it [m/s].
        acceleration: along the ramps [m/s^2]; the jerk at their corners is left out.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    speed: float
    acceleration: float

    @property
    def length(self) -> float:
        """From start to end [m]."""
        return math.dist(self.start, self.end)

    @property
    def ramp(self) -> float:
        """Duration of each ramp [s]."""
        return min(self.speed / self.acceleration, math.sqrt(self.length / self.acceleration))

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        return self.ramp + self.length / (self.acceleration * self.ramp)

    def at(self, times: Array) -> Flown:
        """The path at times (n,) [s]."""
        t = np.clip(times, 0.0, self.duration)
        up, down = np.minimum(t, self.ramp), np.maximum(t - (self.duration - self.ramp), 0.0)
        top, a = self.acceleration * self.ramp, self.acceleration
        way = a * up * up / 2.0 + top * np.maximum(t - self.ramp, 0.0) - a * down * down / 2.0
        inside = (times >= 0.0) & (times < self.duration)
        bend = np.where(inside, np.where(t < self.ramp, a, 0.0) - np.where(down > 0.0, a, 0.0), 0.0)
        along = (np.array(self.end) - np.array(self.start)) / self.length
        rate = a * (up - down)
        return Flown(
            np.array(self.start) + way[:, None] * along, rate[:, None] * along, bend[:, None] * along,
            np.zeros((len(times), 3)),
        )  # fmt: skip


@dataclass(frozen=True)
class FigureEight:
    """The level curve (a sin ct, b sin 2ct), fastest in its crossing.

    Attributes:
        speed: in the crossing, the greatest of all [m/s].
        height: [m].
        length, width: half axes a and b [m].
    """

    speed: float
    height: float = 1.5
    length: float = 2.0
    width: float = 1.0

    @property
    def frequency(self) -> float:
        """C, angle per time [1/s]."""
        return self.speed / math.hypot(self.length, 2.0 * self.width)

    @property
    def period(self) -> float:
        """Of one round [s]."""
        return 2.0 * math.pi / self.frequency

    def at(self, times: Array) -> Flown:
        """The path at times (n,) [s]."""
        c, level = self.frequency, np.zeros(len(times))
        one, two = c * times, 2.0 * c * times
        a, b = self.length, self.width
        parts = [
            (a * np.sin(one), b * np.sin(two)),
            (a * c * np.cos(one), 2.0 * b * c * np.cos(two)),
            (-a * c**2 * np.sin(one), -4.0 * b * c**2 * np.sin(two)),
            (-a * c**3 * np.cos(one), -8.0 * b * c**3 * np.cos(two)),
        ]
        made = [np.column_stack([*part, level]) for part in parts]
        made[0][:, 2] = self.height
        return Flown(*made)
