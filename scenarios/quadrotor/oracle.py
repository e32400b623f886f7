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
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from unifg.typing import Array

__all__ = ["Answer", "Authority", "Threat", "escape", "exists"]

Answer: TypeAlias = Literal["yes", "no", "unknown"]


@dataclass(frozen=True)
class Authority:
    """Accelerations of the vehicle.

    Attributes:
        vehicle: greatest acceleration in any direction [m/s^2].
        mass_error: relative, by which the vehicle is heavier than believed.
        delay: until an acceleration is there [s].
        horizon: how far to look [s].
    """

    vehicle: float = 5.0
    mass_error: float = 0.1
    delay: float = 0.2
    horizon: float = 3.0

    @property
    def usable(self) -> float:
        """Acceleration that is there whatever the mass [m/s^2]."""
        return self.vehicle / (1.0 + self.mass_error)


@dataclass(frozen=True)
class Threat:
    """An obstacle as it is seen.

    Attributes:
        away: (3,) position of the vehicle from it [m].
        speed: (3,) its rate, relative to what is known of the obstacle's motion [m/s].
        keep: distance to be kept [m].
        upright: a cylinder, of which only the plane counts.
        bend: greatest acceleration of the obstacle in any direction, what is known of it apart [m/s^2].
        pull: (3,) acceleration of the obstacle that is known, as of one that falls [m/s^2].
        until: how long it is there [s].
    """

    away: Array
    speed: Array
    keep: float
    upright: bool = False
    bend: float = 0.0
    pull: Array = field(default_factory=lambda: np.zeros(3))
    until: float = np.inf


def escape(threats: Sequence[Threat], authority: Authority) -> tuple[float, float]:
    """Clearances from all obstacles that can be had for certain, and at best.

    Args:
        threats: the obstacles.
        authority: what the vehicle can do.

    Returns:
        The least distance beyond that to be kept over time, of the best acceleration that is held, against any motion
        of the obstacles; and a bound that no control exceeds while the obstacles go straight on [m].
    """
    times = np.linspace(0.0, authority.horizon, 301)
    late = 0.5 * np.maximum(times - authority.delay, 0.0) ** 2
    ways = authority.usable * _directions()[:, None, :]
    certain, best = np.full(len(ways), np.inf), np.inf
    for threat in threats:
        present = times <= threat.until
        t, gained, flat = (
            times[present, None],
            late[present, None],
            np.array([1.0, 1.0, 0.0 if threat.upright else 1.0]),
        )
        straight = (threat.away + t * threat.speed - 0.5 * t**2 * threat.pull) * flat
        reach = np.linalg.norm(straight, axis=1) + authority.usable * late[present]
        best = min(best, float(reach.min()) - threat.keep)
        far = np.linalg.norm(straight + ways * gained * flat, axis=2) - 0.5 * threat.bend * times[present] ** 2
        certain = np.minimum(certain, far.min(axis=1) - threat.keep)
    return float(certain.max()), best


def exists(threats: Sequence[Threat], authority: Authority) -> Answer:
    """Existence of one held acceleration that escapes all obstacles; "no" where one of them cannot be escaped."""
    certain, best = escape(threats, authority)
    return "no" if best < 0.0 else "yes" if certain >= 0.0 else "unknown"


def _directions() -> Array:
    """(K, 3) unit vectors, evenly spread: 72 in the plane, 200 in space."""
    k = np.arange(200) + 0.5
    height = np.concatenate([np.zeros(72), 1.0 - 2.0 * k / 200])
    angle = np.concatenate([np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False), np.pi * (1.0 + 5.0**0.5) * k])
    level = np.sqrt(1.0 - height**2)
    return np.column_stack([level * np.cos(angle), level * np.sin(angle), height])
