"""Creeping of a lost robot, from a place that looks like others to one that does not.

The way is free as far as the beams of the last scan say so, and they, not a map, stop the robot. It is active
localisation (Fox, Burgard, Thrun, *Robotics and Autonomous Systems* 25 (1998)) in its plainest form: straight on, and
where that ends, to where there is most room, until a search of the map finds one place alone. A base that does not turn
on the spot goes ahead or back, and as far aside as it steers.
"""

from __future__ import annotations

import numpy as np

from unifg.lie import wrap_angle
from unifg.scenarios.ground.emergency_stop import agreed
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array

__all__ = ["Creeping"]

FARTHEST = 30.0  # [m] after which the robot rests
SPEED, TURN = 0.3, 0.5  # [m/s, rad/s]
FAN = 2.0 * np.pi * np.arange(36) / 36 - np.pi  # directions [rad]
HALF = 0.3  # [rad] to both sides of a direction that has to be free
ROOM = 3.0  # [m] of free way that is enough
NEAR = 0.6  # [m] from the hull where the way ends
ASIDE = 0.5  # [m] of free way that a radian less to turn is worth
AHEAD = 0.35  # [rad] beside the heading; farther aside the robot turns on the spot
STEERED = 0.6  # [rad] from its axis that a base may head for which does not


class Creeping:
    """Direction and length of the way so far.

    Attributes:
        travelled: [m].
        radius: least one of a turn [m]; 0 for a base that turns on the spot.
    """

    def __init__(self, radius: float = 0.0) -> None:
        """Begin straight on."""
        self.travelled, self.radius, self._heading = 0.0, radius, 0.0

    @property
    def ended(self) -> bool:
        """True after the farthest way."""
        return self.travelled >= FARTHEST

    def moved(self, step: Array) -> None:
        """Take in a motion (k,) of the body, the last number of which turns it [m, rad]."""
        self.travelled += float(np.linalg.norm(step[:-1]))
        self._heading = float(wrap_angle(self._heading - step[-1]))

    def control(self, scan: Scan, bound: float) -> tuple[float, float]:
        """Speed [m/s], negative back, and turning rate [rad/s] to where it is free, for a hull within a radius [m]."""
        ranges, aside = agreed(scan), np.abs(wrap_angle(scan.angles - FAN[:, None]))
        free = np.where(aside < HALF, np.minimum(ranges, ROOM), ROOM).min(axis=1)
        free[~(aside < HALF).any(axis=1)] = 0.0
        away = np.abs(wrap_angle(FAN - self._heading))
        now = int(np.argmin(away))
        ended = free[now] < bound + NEAR
        worth = free - ASIDE * (np.abs(FAN) if ended else away)  # there is more room along an aisle than across
        reached = (np.abs(np.sin(FAN)) < np.sin(STEERED)) | (self.radius == 0.0)
        best = int(np.argmax(np.where((ended | (away < AHEAD)) & reached, worth, -np.inf)))
        if ended or best != now:
            self._heading = float(FAN[best])
        if not self.radius:
            turn = float(np.clip(2.0 * self._heading, -TURN, TURN))
            return (SPEED if abs(self._heading) < AHEAD else 0.0), turn
        back = abs(self._heading) > 0.5 * np.pi
        off, most = float(wrap_angle(self._heading - np.pi * back)), min(TURN, SPEED / self.radius)
        return (-SPEED if back else SPEED), float(np.clip(2.0 * off, -most, most))

    def blocked(self) -> None:
        """Turn back: something stops the robot that beams ahead do not see, and in an aisle there is no other way."""
        self._heading = float(wrap_angle(self._heading + np.pi))
