"""Existence of a safe control, for a controller that knows no more than its measurements.

The vehicle and an obstacle are a double integrator of their relative position r. The vehicle gives accelerations up to
A in any direction, less what a wrong mass takes away, and only after a delay; the obstacle is where it is and as fast
as it is, and may give up to B in any direction, too. Nobody knows which. An acceleration A n held from the delay d on
is safe whatever the obstacle does if

    |r + v t + A n (t - d)^2 / 2| - B t^2 / 2 >= keep    for all t                            (yes)

because what the obstacle can do moves r by at most B t^2 / 2. Where that holds for some n a safe control exists. On the
other hand, with the obstacle going straight on, which it may, none exists if at some time

    |r + v t| + A (t - d)^2 / 2 < keep                                                        (no)

since nothing that the vehicle can do carries r farther than that. Both are backward reachable sets, the first from
within and the second from without; between them the oracle does not know. Vehicles that tilt reach A late: the delay
counts that. Among several obstacles one n has to escape them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from unifg.typing import Array

__all__ = ["Answer", "Authority", "Threat", "escape", "exists", "exists_among"]

Answer: TypeAlias = Literal["yes", "no", "unknown"]


@dataclass(frozen=True)
class Authority:
    """Accelerations of vehicle and obstacle.

    Attributes:
        vehicle: greatest acceleration in any direction [m/s^2].
        mass_error: relative, by which the vehicle is heavier than believed.
        delay: until an acceleration is there [s].
        obstacle: greatest acceleration of the obstacle in any direction, what is known of it apart [m/s^2].
        horizon: how far to look [s].
    """

    vehicle: float = 5.0
    mass_error: float = 0.1
    delay: float = 0.2
    obstacle: float = 0.0
    horizon: float = 3.0

    @property
    def usable(self) -> float:
        """Acceleration that is there whatever the mass [m/s^2]."""
        return self.vehicle / (1.0 + self.mass_error)


def escape(
    away: Array, speed: Array, keep: float, authority: Authority, pull: Array | None = None
) -> tuple[float, float]:
    """Clearances that can be had for certain, and at best.

    Args:
        away: (2,) or (3,) position of the vehicle from the obstacle [m].
        speed: its rate, relative to what is known of the obstacle's motion [m/s].
        keep: distance to be kept [m].
        authority: what both can do.
        pull: acceleration of the obstacle that is known, as of one that falls [m/s^2]; None for none.

    Returns:
        The least distance less ``keep`` over time, of the best acceleration that is held, against any motion of the
        obstacle; and a bound that no control exceeds while the obstacle goes straight on [m].
    """
    a = authority
    times = np.linspace(0.0, a.horizon, 301)
    late = 0.5 * np.maximum(times - a.delay, 0.0) ** 2
    straight = away + times[:, None] * speed
    if pull is not None:
        straight = straight - 0.5 * times[:, None] ** 2 * pull
    bound = np.linalg.norm(straight, axis=1) + a.usable * late - keep
    ways = straight + a.usable * _directions(len(away))[:, None, :] * late[:, None]
    certain = np.linalg.norm(ways, axis=2) - 0.5 * a.obstacle * times**2 - keep
    return float(certain.min(axis=1).max()), float(bound.min())


def exists(away: Array, speed: Array, keep: float, authority: Authority, pull: Array | None = None) -> Answer:
    """Existence of a safe control; arguments as those of :func:`escape`."""
    certain, best = escape(away, speed, keep, authority, pull)
    return "yes" if certain >= 0.0 else "no" if best < 0.0 else "unknown"


@dataclass(frozen=True)
class Threat:
    """An obstacle as it is seen.

    Attributes:
        away: (3,) position of the vehicle from it [m].
        speed: (3,) its rate [m/s].
        keep: distance to be kept [m].
        upright: a cylinder, of which only the plane counts.
        bend: greatest acceleration of the obstacle in any direction, what is known of it apart [m/s^2].
        pull: (3,) acceleration of the obstacle that is known [m/s^2]; None for none.
        until: how long it is there [s].
    """

    away: Array
    speed: Array
    keep: float
    upright: bool = False
    bend: float = 0.0
    pull: Array | None = None
    until: float = np.inf


def exists_among(threats: Sequence[Threat], authority: Authority) -> Answer:
    """Existence of one held acceleration that escapes all obstacles, or of one that cannot be escaped.

    Args:
        threats: the obstacles.
        authority: what the vehicle can do; the obstacles' own accelerations take the place of the one in it.
    """
    a = authority
    times = np.linspace(0.0, a.horizon, 301)
    late = 0.5 * np.maximum(times - a.delay, 0.0) ** 2
    level = np.column_stack([_directions(2), np.zeros(72)])
    ways = np.concatenate([level, _directions(3)])
    certain, lost = np.full(len(ways), np.inf), False
    for threat in threats:
        present = times <= threat.until
        flat = np.array([1.0, 1.0, 0.0 if threat.upright else 1.0])
        straight = threat.away + times[present, None] * threat.speed
        if threat.pull is not None:
            straight = straight - 0.5 * times[present, None] ** 2 * threat.pull
        straight, moved = straight * flat, a.usable * ways[:, None, :] * late[None, present, None] * flat
        lost |= bool((np.linalg.norm(straight, axis=1) + a.usable * late[present] < threat.keep).any())
        far = np.linalg.norm(straight + moved, axis=2) - 0.5 * threat.bend * times[present] ** 2 - threat.keep
        certain = np.minimum(certain, far.min(axis=1))
    return "no" if lost else "yes" if certain.max() >= 0.0 else "unknown"


def _directions(axes: int) -> Array:
    """(K, axes) unit vectors, evenly spread."""
    if axes == 2:
        angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        return np.column_stack([np.cos(angle), np.sin(angle)])
    k = np.arange(200) + 0.5
    height, angle = 1.0 - 2.0 * k / 200, np.pi * (1.0 + 5.0**0.5) * k
    level = np.sqrt(1.0 - height**2)
    return np.column_stack([level * np.cos(angle), level * np.sin(angle), height])
