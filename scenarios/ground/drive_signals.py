"""Health signals of the ground robot."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from unifg.lie import SE2, wrap_angle
from unifg.models import unicycle
from unifg.models.planar import Base
from unifg.scenarios.ground.motor_lag import MotorLag
from unifg.scenarios.monitoring.supervisor import Ramp
from unifg.typing import Array

__all__ = ["RAMPS", "DriveSignals"]

RAMPS: Mapping[str, Ramp] = {
    "fix": Ramp("no scan says where it is", 0.15, 0.2, lost=1.0),  # [s] since the last that did
    "unexplained": Ramp("the scan does not fit the map", 0.45, 0.6, lost=0.6),  # share of beams
    "elsewhere": Ramp("another place on the map fits the scan better", 0.2, 0.3, lost=0.3),  # share of beams
    "blind": Ramp("the lidar sees nothing in a sector", 0.15, 1.0, least=0.3),  # [rad]
    "spread": Ramp("where it is, is known to decimetres only", 0.12, 0.35, lost=0.5),  # [m]
    "plan": Ramp("no plan", 0.45, 1.0, least=0.3),  # [s] since the last; at rest there is nothing to plan from
    "wheels": Ramp("the robot does not do what it is told", 0.3, 0.5),  # share
    "lag": Ramp("the motors follow late", 0.05, 0.3, least=0.5),  # [s]; half as fast, braking is as short as without
    "slip": Ramp("the wheels slip", 0.25, 0.6, least=0.4),  # share of the way
    "odometry": Ramp("no odometry", 0.15, 1.0, least=0.3),  # [s]
    "mount": Ramp("the lidar has turned in its mount", 0.02, 0.15, least=0.4),  # [rad]
    "bias": Ramp("the lidar measures too far or too near", 0.02, 0.2, least=0.4),  # [m]
    "scale": Ramp("the scale of the wheels has jumped", 0.12, 0.4, least=0.8),  # share of the way
}
"""By signal."""

ARM = 0.15  # [m] from the middle to a wheel
CRAWL = 0.2  # [m/s]; slower wheels are held against this
AGREE = 3  # ticks in a row that count
LATELY = 4  # ticks whose commands may still be on their way to the wheels
WAY = 8  # ticks over which slip is summed up
TRAVELLED = 0.2  # [m] in that time, below which nothing is said
HELD = 1e6  # what a wheel that is not trusted misses
MOVING = 0.1, 0.3  # [m/s, rad/s]; slower is rest, which does no harm
DISOBEYED = 0.3  # [s] for which motors may do something else before their power is to be cut
PAUSE, CHANCE = 4.0, 1.0  # [s] of rest after that, the last of them with power: motors that move then are given up
HOLD = 2.0  # [s] for which wheels are not trusted again, twice as long every time


class DriveSignals:
    """The signals of one drive, tick by tick.

    Attributes:
        motors: how late they follow.
    """

    def __init__(self, dt: float, most: Array, base: Base = unicycle.BASE) -> None:
        """Begin with nothing the matter, in a base whose controls change by at most (m,) in a tick."""
        self._dt, self._base = dt, base
        self.motors = MotorLag(dt, most, base)
        # Speeds of the left and of the right wheel, and of one that slides sideways.
        self._sides = np.array([[1.0, 1.0], [-ARM, ARM]])
        if base.slides:
            self._sides = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-ARM, ARM, 0.0]])
        self._fix = self._plan = self._odometry = 0.0
        self._share, self._spread, self._blind = 1.0, 0.0, 0.0
        self._asked: deque[Array] = deque([base.of(np.zeros(base.size))], maxlen=LATELY)
        self._missed: deque[float] = deque(maxlen=AGREE)
        self._shifts: deque[tuple[float, float]] = deque(maxlen=WAY)
        self._fixed: Array | None = None
        self._held, self._hold = 0.0, HOLD
        self._disobeyed, self._off, self._obeyed = 0, 0.0, base.of(np.zeros(base.size))

    def note(
        self,
        *,
        corrected: bool,
        share: float,
        predicted: Array,
        pose: Array,
        covariance: Array,
        wheels: Array | None,
        trusted: bool,
        asked: Array,
        blind: float = 0.0,
    ) -> None:
        """Take in what a tick has estimated.

        Args:
            corrected: whether a scan has.
            share: of its beams that the map explains.
            predicted: (3,) pose by the wheels [m, m, rad].
            pose: (3,) pose after the scan.
            covariance: (3, 3) of it.
            wheels: (m,) controls they have made; None at the first tick.
            trusted: whether they measured these.
            asked: (m,) controls asked for.
            blind: width of the widest sector of the scan whose beams are all lost [rad].
        """
        self._blind = blind
        self._fix = 0.0 if corrected else self._fix + self._dt
        self._share = share if corrected else self._share
        spread = covariance[:2, :2]
        finite = bool(np.isfinite(covariance).all() and np.isfinite(pose).all())
        self._spread = math.sqrt(max(float(np.linalg.eigvalsh(spread)[-1]), 0.0)) if finite else math.inf
        if wheels is None:
            return
        self._odometry = 0.0 if trusted else self._odometry + self._dt
        self.motors.note(asked, wheels if trusted else None)
        asked, wheels = self._base.of(asked), self._base.of(wheels)
        self._asked.append(asked)
        done = [wheels if trusted else asked]
        if corrected and self._fixed is not None:  # what it has done, whatever the wheels say
            turned, moved = wrap_angle(pose[2] - self._fixed[2]), self._moved(self._fixed, pose)
            done.append(np.array([*moved, turned]) / self._dt)
        self._fixed = pose.copy() if corrected else None
        self._missed.append(min(self._misses(did) for did in done))
        self._watch_power(done)
        self._held = max(0.0, self._held - self._dt)
        if self._distrust() >= RAMPS["wheels"].ends and not self._held:
            self._held, self._hold = self._hold, 2.0 * self._hold
        shift = forward(predicted, pose) if corrected and trusted else 0.0
        self._shifts.append((shift, float(wheels[0]) * self._dt))

    @property
    def power_off(self) -> bool:
        """True while the power of the motors is to be cut: for 0.3 s the robot has moved, and not as it is told.

        For good if it has gone on as before, whatever it was told. If something else has set it in motion, or a wheel
        is dead, the motors have another chance once it rests.
        """
        return self._off > CHANCE

    def _watch_power(self, done: list[Array]) -> None:
        """Compare body velocities (k,), by wheels and by scans, with commands; both have to say that motors disobey."""
        rest = [*[MOVING[0]] * (len(done[0]) - 1), MOVING[1]]
        moves = all((np.abs(did) > rest).any() for did in done)
        obeys = any(self.motors.obey(did) for did in done)
        self._disobeyed = self._disobeyed + 1 if moves and not obeys else 0
        self._obeyed = done[0] if obeys else self._obeyed
        if self._off:
            lurches = moves and self._off <= CHANCE
            self._off = math.inf if lurches else max(0.0, self._off - self._dt)
        elif self._disobeyed * self._dt > DISOBEYED - 0.5 * self._dt:
            same = np.abs(done[0] - self._obeyed) < rest
            self._off = math.inf if same.all() else PAUSE

    def _moved(self, one: Array, other: Array) -> Array:
        """(1,) distance ahead, or (2,) ahead and to the left, from a pose (3,) to another [m]."""
        return SE2.between(one, other)[:2] if self._base.slides else np.array([forward(one, other)])

    def planned(self, sound: bool) -> None:
        """Record if the tick has a plan of its own."""
        self._plan = 0.0 if sound else self._plan + self._dt

    def _misses(self, did: Array) -> float:
        """Share by which body velocities (k,) miss the recent commands of one wheel."""
        told, made = np.array(self._asked) @ self._sides, did @ self._sides
        missed = np.maximum(told.min(axis=0) - made, made - told.max(axis=0))
        return float(missed.max(initial=0.0) / max(np.abs(told).max(), CRAWL))

    def _distrust(self) -> float:
        """Least of these shares over the last ticks."""
        return min(self._missed) if len(self._missed) == AGREE else 0.0

    def values(self) -> dict[str, float]:
        """Values by signal."""
        shifts = np.array(self._shifts).reshape(-1, 2)
        travelled = float(np.abs(shifts[:, 1]).sum())
        slip = abs(float(shifts[:, 0].sum())) / travelled if travelled > TRAVELLED else 0.0
        return {
            "fix": self._fix,
            "unexplained": 1.0 - self._share,
            "blind": self._blind,
            "spread": self._spread,
            "plan": self._plan,
            "wheels": HELD if self._held or self._off else self._distrust(),
            "lag": self.motors.seconds,
            "slip": slip,
            "odometry": self._odometry,
        }


def forward(one: Array, other: Array) -> float:
    """Distance of a pose (3,) ahead of another, along the heading of the first [m]."""
    return float((other - one)[:2] @ [math.cos(one[2]), math.sin(one[2])])
