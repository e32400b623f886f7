"""The last word before a control is driven: is the way that braking takes free, by the beams alone?

Neither the map nor the estimate, the tracker nor the plan is asked. A control is reached in a tick and then braked
along its arc; where the hull would come nearer to the end of a beam than it may, the control is slowed, as far as
braking goes. Three neighbouring beams have to agree, so noise and single echoes do not stop the robot. Where most beams
ahead are lost, the way is not known to be free; a sector that no beam has looked into is occupied from the hull on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array

__all__ = ["EmergencyStop"]

SLOW = 0.02  # [m/s]; slower is rest, and turning on the spot touches nothing
SAMPLES = 12  # places along the way
SHARES = 4  # speeds tried between the one asked for and the one that braking leaves
BIAS = 0.015  # [m] by which the nearest of many noisy beams looks nearer than what it has met
COMING = 1e-4  # [m] by which something near already may come nearer
AHEAD = 0.6  # [rad] to both sides of the motion where beams have to be there
SEEN = 0.5  # share of them
STEP = 0.04  # [rad] between places of the rim of the hull beside which nothing is seen


@dataclass(frozen=True)
class EmergencyStop:
    """Slows what would touch.

    Attributes:
        radius: of the hull [m].
        deceleration: of the robot [m/s^2].
        dt: for which a control is held [s].
    """

    radius: float
    deceleration: float
    dt: float

    def control(self, asked: Array, last: Array, scan: Scan) -> Array:
        """The fastest control (2,) along the arc of the one asked for whose braking way is free, or that brakes.

        Args:
            asked: (2,) [m/s, rad/s].
            last: (2,) that was driven until now.
            scan: of now.
        """
        speed = float(asked[0])
        if abs(speed) < SLOW or self.is_free(asked, scan, float(last[0])):
            return asked
        least = max(abs(float(last[0])) - self.deceleration * self.dt, 0.0) if last[0] * speed > 0.0 else 0.0
        control: Array = asked
        for slower in np.linspace(abs(speed), min(least, abs(speed)), SHARES + 1)[1:].tolist():
            control = asked * (slower / abs(speed))
            if slower < SLOW:
                return np.array([0.0, asked[1]])
            if self.is_free(control, scan, float(last[0])):
                break
        return control

    def is_free(self, control: Array, scan: Scan, last: float | None = None) -> bool:
        """Return True if a control (2,), reached from a speed ``last`` [m/s] and then braked, touches nothing seen.

        Without ``last`` the control has been reached.
        """
        v, omega = control.tolist()
        away = np.abs(np.remainder(scan.angles - (0.0 if v > 0.0 else np.pi) + np.pi, 2.0 * np.pi) - np.pi)
        ahead = away < AHEAD
        if not ahead.any() or np.isnan(scan.ranges[ahead]).mean() > 1.0 - SEEN:
            return False
        mean = abs(v) if last is None else 0.5 * (abs(v) + max(last * np.sign(v), 0.0))
        length = mean * self.dt + 0.5 * v * v / self.deceleration
        ranges = agreed(scan)
        near = ranges < length + self.radius
        hidden = [begin + np.arange(STEP, width, STEP) for begin, width in scan.unseen.tolist()]
        angles = np.concatenate([scan.angles[near], *hidden])
        if not len(angles):
            return True
        rim = np.full(len(angles) - int(near.sum()), self.radius)
        points = np.concatenate([ranges[near], rim])[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        along = np.linspace(0.0, length, SAMPLES)
        turn = along * omega / abs(v)
        reach = np.sign(v) * along * np.sinc(0.5 * turn / np.pi)  # the chord of the arc
        way = reach[:, None] * np.column_stack([np.cos(0.5 * turn), np.sin(0.5 * turn)])
        gap = np.hypot(*np.moveaxis(points[:, None] - way[None], 2, 0))
        return bool((gap.min(axis=1) >= np.minimum(self.radius - BIAS, gap[:, 0] - COMING)).all())


def agreed(scan: Scan) -> Array:
    """(B,) the middle one of each beam and its neighbours [m]; what is lost is infinitely far."""
    whole = np.where(np.isnan(scan.ranges), np.inf, scan.ranges)
    around = np.concatenate([whole[-1:], whole, whole[:1]] if scan.closed else [whole[:1], whole, whole[-1:]])
    three = np.sort(np.stack([around[:-2], whole, around[2:]]), axis=0)
    middle: Array = three[1]
    return middle
