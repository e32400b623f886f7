"""The last word before a control is driven: is the way that braking takes free, by the beams alone?

Neither the map nor the estimate, the tracker nor the plan is asked. A control is reached in a tick and then braked
along its arc; where the hull would come nearer to the end of a beam than it may, the control is slowed, as far as
braking goes. Three neighbouring beams have to agree, so noise and single echoes do not stop the robot. Where most beams
ahead are lost, the way is not known to be free; a sector that no beam has looked into is occupied from the hull on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unifg.lie import SE2
from unifg.models import unicycle
from unifg.models.footprint import Body
from unifg.models.planar import Base
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array

__all__ = ["EmergencyStop"]

SLOW = 0.02  # [m/s]; slower is rest
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
        body: of the robot.
        decelerations: of the robot, moving and turning [m/s^2, rad/s^2].
        dt: for which a control is held [s].
        base: that moves.
    """

    body: Body
    decelerations: tuple[float, float]
    dt: float
    base: Base = unicycle.BASE

    def __post_init__(self) -> None:
        """Load what a tick needs."""
        SE2.exp(np.zeros((SAMPLES, 3)))

    def control(self, asked: Array, last: Array, scan: Scan) -> Array:
        """The fastest control (m,) along the arc of the one asked for whose braking way is free, or that brakes.

        Args:
            asked: (m,) control.
            last: (m,) that was driven until now.
            scan: of now.
        """
        velocity, before = self.base.of(asked), self.base.of(last)
        speed = self._pace(velocity)
        if speed < SLOW or self.is_free(asked, scan, last):
            return asked
        onward = float(before @ velocity) > 0.0
        least = max(self._pace(before) - self.decelerations[0] * self.dt, 0.0) if onward else 0.0
        control: Array = asked
        for slower in np.linspace(speed, min(least, speed), SHARES + 1)[1:].tolist():
            control = np.where(self.base.resting, asked * (slower / speed), asked)
            if slower < SLOW:
                control = np.zeros_like(asked)
                if self.body.round or self.base.steering is not None:
                    control[-1] = asked[-1]
                return control
            if self.is_free(control, scan, last):
                break
        return control

    def _pace(self, velocity: Array) -> float:
        """Greatest speed of a point of the hull [m/s]; turning a disc about its axis moves none."""
        speed = math.hypot(*velocity[:-1].tolist())
        return speed if self.body.round else max(speed, abs(float(velocity[-1])) * self.body.bound)

    def is_free(self, control: Array, scan: Scan, last: Array | None = None) -> bool:
        """Return True if a control (m,), reached from the one before (m,) and then braked, touches nothing seen.

        Without ``last`` the control has been reached.
        """
        velocity = self.base.of(control)
        across, turn = velocity[:-1], float(velocity[-1])
        speed, spent = math.hypot(*across.tolist()), 0.0
        if speed >= SLOW:
            bearing = math.atan2(float(across[1]) if len(across) > 1 else 0.0, float(across[0]))
            away = np.abs(np.remainder(scan.angles - bearing + np.pi, 2.0 * np.pi) - np.pi)
            ahead = away < AHEAD
            if not ahead.any() or np.isnan(scan.ranges[ahead]).mean() > 1.0 - SEEN:
                return False
            before = speed if last is None else max(float(self.base.of(last)[:-1] @ across) / speed, 0.0)
            length = 0.5 * (speed + before) * self.dt + 0.5 * speed * speed / self.decelerations[0]
            spent = length / speed
        if not self.body.round:
            spent = max(spent, self.dt + 0.5 * abs(turn) / self.decelerations[1])
        ranges = agreed(scan)
        near = ranges < speed * spent + self.body.bound
        hidden = [begin + np.arange(STEP, width, STEP) for begin, width in scan.unseen.tolist()]
        angles = np.concatenate([scan.angles[near], *hidden])
        if not len(angles):
            return True
        rim = self.body.rim(angles[int(near.sum()) :])
        points = np.concatenate([ranges[near], rim])[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        motion = np.zeros(3)
        motion[: len(across)], motion[2] = across, turn
        way = SE2.exp(np.linspace(0.0, spent, SAMPLES)[:, None] * motion)
        seen = points[:, None] - way[:, :2]
        if not self.body.round:
            cosine, sine = np.cos(way[:, 2]), np.sin(way[:, 2])
            seen = np.stack(
                [cosine * seen[..., 0] + sine * seen[..., 1], cosine * seen[..., 1] - sine * seen[..., 0]], -1
            )
        gap = self.body.gap(seen)
        return bool((gap.min(axis=1) >= np.minimum(-BIAS, gap[:, 0] - COMING)).all())


def agreed(scan: Scan) -> Array:
    """(B,) the middle one of each beam and its neighbours [m]; what is lost is infinitely far."""
    whole = np.where(np.isnan(scan.ranges), np.inf, scan.ranges)
    around = np.concatenate([whole[-1:], whole, whole[:1]] if scan.closed else [whole[:1], whole, whole[-1:]])
    three = np.sort(np.stack([around[:-2], whole, around[2:]]), axis=0)
    middle: Array = three[1]
    return middle
