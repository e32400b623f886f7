"""Spheres and upright cylinders in space that move as they like, and how near a flight came to them.

How near is measured along the whole flight: between two of its points the relative motion is taken for straight, and
the distance to that chord is exact. With points every millisecond at a relative speed of 5 m/s and a radius of half a
metre the chord deviates from the arc by 6 micrometres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from unifg.models.quadrotor import GRAVITY
from unifg.typing import Array, BoolArray

__all__ = ["Bodies", "Body", "Ellipse", "Motion", "Shuttle", "Still", "Thrown"]


class Motion(Protocol):
    """Motion over time."""

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions (n, 3) [m] and velocities (n, 3) [m/s] at times (n,) [s]."""


@dataclass(frozen=True)
class Still:
    """A thing at rest at ``place`` [m]."""

    place: tuple[float, float, float]

    def at(self, times: Array) -> tuple[Array, Array]:
        """The place."""
        return np.tile(np.array(self.place), (len(times), 1)), np.zeros((len(times), 3))


@dataclass(frozen=True)
class Ellipse:
    """Round a level ellipse at constant speed.

    Attributes:
        centre: (x, y, z) [m].
        axes: half axes along x and y [m].
        speed: along the curve [m/s].
        phase: share of the circumference at time zero, counted from the far end of the axis along x.
        clockwise: seen from above.
    """

    centre: tuple[float, float, float]
    axes: tuple[float, float]
    speed: float
    phase: float = 0.0
    clockwise: bool = False
    _arc: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Measure the circumference."""
        angle = np.linspace(0.0, 2.0 * np.pi, 4097)
        a, b = self.axes
        pace = np.hypot(a * np.sin(angle), b * np.cos(angle))
        arc = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) * np.diff(angle))])
        object.__setattr__(self, "_arc", (arc, angle))

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities."""
        arc, angle = self._arc
        sense = -1.0 if self.clockwise else 1.0
        turn = np.interp((self.phase * arc[-1] + sense * self.speed * times) % arc[-1], arc, angle)
        a, b = self.axes
        across = np.column_stack([-a * np.sin(turn), b * np.cos(turn)])
        across *= sense * self.speed / np.linalg.norm(across, axis=1, keepdims=True)
        level = np.zeros(len(times))
        place = np.column_stack([a * np.cos(turn), b * np.sin(turn), level]) + np.array(self.centre)
        return place, np.column_stack([across, level])


@dataclass(frozen=True)
class Shuttle:
    """To and fro between two places at constant speed, with turns of no duration.

    Attributes:
        start, end: (x, y, z) [m].
        speed: [m/s].
        phase: share of the way there and back at time zero.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    speed: float
    phase: float = 0.0

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities."""
        span = np.array(self.end) - np.array(self.start)
        length = float(np.linalg.norm(span))
        share = (self.phase + self.speed * times / (2.0 * length)) % 1.0
        share_along = 1.0 - np.abs(2.0 * share - 1.0)
        sense = np.where(share < 0.5, 1.0, -1.0)
        return np.array(self.start) + share_along[:, None] * span, sense[:, None] * span * (self.speed / length)


@dataclass(frozen=True)
class Thrown:
    """A ball that is held until it is thrown, flies as gravity has it, and stays where it lands.

    Attributes:
        place: of the hand (x, y, z) [m].
        velocity: as it leaves the hand [m/s].
        release: when [s].
        floor: height at which its centre comes to rest [m].
    """

    place: tuple[float, float, float]
    velocity: tuple[float, float, float]
    release: float
    floor: float = 0.1

    @property
    def flight(self) -> float:
        """Duration of the flight [s]."""
        up, height = self.velocity[2], self.place[2] - self.floor
        return (up + math.sqrt(max(up * up + 2.0 * GRAVITY * height, 0.0))) / GRAVITY

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities."""
        t = np.clip(times - self.release, 0.0, self.flight)[:, None]
        velocity, down = np.array(self.velocity), np.array([0.0, 0.0, -GRAVITY])
        flying = (times >= self.release) & (times < self.release + self.flight)
        speed = np.where(flying[:, None], velocity + down * t, 0.0)
        return np.array(self.place) + velocity * t + 0.5 * down * t * t, speed

    @classmethod
    def at_target(
        cls, place: tuple[float, float, float], target: tuple[float, float, float], duration: float, release: float
    ) -> Thrown:
        """Thrown from a place so that it passes a target ``duration`` seconds after its release."""
        way = (np.array(target) - np.array(place)) / duration
        x, y, z = way.tolist()
        return cls(place, (x, y, z + 0.5 * GRAVITY * duration), release)


@dataclass(frozen=True)
class Body:
    """One obstacle.

    Attributes:
        radius: [m].
        motion: of its centre.
        upright: a cylinder without bottom and top instead of a sphere.
    """

    radius: float
    motion: Motion
    upright: bool = False


class Bodies:
    """All obstacles of a flight.

    Attributes:
        bodies: M of them.
        radii: (M,) [m].
        upright: (M,).
        falls: (M,) whether gravity bends their ways.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        """Keep them in their order."""
        self.bodies = tuple(bodies)
        self.radii = np.array([body.radius for body in self.bodies], dtype=np.float64)
        self.upright: BoolArray = np.array([body.upright for body in self.bodies], dtype=bool)
        self.falls: BoolArray = np.array([isinstance(body.motion, Thrown) for body in self.bodies], dtype=bool)

    def __len__(self) -> int:
        """Number of bodies."""
        return len(self.bodies)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions (n, M, 3) [m] and velocities (n, M, 3) [m/s] at times (n,) [s]."""
        if not self.bodies:
            return np.zeros((len(times), 0, 3)), np.zeros((len(times), 0, 3))
        parts = [body.motion.at(times) for body in self.bodies]
        return np.stack([p for p, _ in parts], axis=1), np.stack([v for _, v in parts], axis=1)

    def nearest(self, path: Array, times: Array) -> Array:
        """Least distance of a point on its way to each surface between consecutive points of the way.

        Args:
            path: (n, 3) where the point is [m].
            times: (n,) when [s].

        Returns:
            (n - 1, M) [m], negative inside.
        """
        relative = path[:, None, :] - self.at(times)[0]
        relative[:, self.upright, 2] = 0.0
        start, span = relative[:-1], np.diff(relative, axis=0)
        square = np.einsum("nmk,nmk->nm", span, span)
        share = -np.einsum("nmk,nmk->nm", start, span) / np.where(square > 0.0, square, 1.0)
        chord = start + np.clip(share, 0.0, 1.0)[..., None] * span
        distance: Array = np.linalg.norm(chord, axis=2) - self.radii
        return distance
