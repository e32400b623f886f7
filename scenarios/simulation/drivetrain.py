"""Response of a base to its commands: latency, lag, accelerations, slip and drift.

A command acts after the latency. The motors follow it with a lag of first order, dv/dt = (command - v) / lag, but they
change the wheels' velocities no faster than their accelerations allow, divided by what the base carries besides itself.
The floor takes a share of what the wheels do (longitudinal slip), and lets a base that turns
drift outwards in proportion to its lateral acceleration. Wheels feel neither.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from unifg.models import unicycle
from unifg.models.planar import Base
from unifg.scenarios.options import Settings, above_zero, not_negative, option, share
from unifg.typing import Array

__all__ = ["COMPUTED", "PLANTS", "Drivetrain", "Wheels", "followed", "plant"]

COMPUTED = -1.0  # latency that is the measured time of each tick


class Usual(float):
    """A number that nobody has asked for, in whose place a named base has its own."""


def latency_of(text: str) -> float:
    """Seconds, or "auto" for `COMPUTED`."""
    return COMPUTED if text in ("auto", str(COMPUTED)) else not_negative(text)


@dataclass(frozen=True)
class Drivetrain(Settings):
    """Of a base, as it is; the robot knows of it what its data sheet says, the accelerations unloaded.

    2.5 m/s^2 and 3.2 rad/s^2 are the accelerations that the example of Nav2's DWB controller gives a light base; the
    driver of PAL's PMB-2, which goes 1 m/s like the robot here and carries an arm, allows 1.0 m/s^2 and 2.1 rad/s^2.

    Attributes:
        acceleration: greatest change of the forward velocity, speeding up or braking [m/s^2].
        turning: greatest change of the turning rate [rad/s^2].
        load: mass carried, as a share of the base's own: forces stay what they are, so accelerations shrink.
        lag: time constant of the motors [s].
        latency: from a command, or from what it was computed of, to its effect [s]; "auto", -1, for the measured time
            of each tick, so that a drive depends on the clock. What is not yet computed delays what comes after it.
        slip: share of the wheels' motion that the floor takes.
        skid: outward drift of a base that turns, per lateral acceleration [(m/s)/(m/s^2)].
    """

    acceleration: float = option(Usual(2.5), text=above_zero, metavar="M/S2")
    turning: float = option(Usual(3.2), text=above_zero, metavar="RAD/S2")
    load: float = option(Usual(0.0), text=not_negative, metavar="SHARE")
    lag: float = option(Usual(0.0), text=not_negative, metavar="S")
    latency: float = option(Usual(0.0), text=latency_of, metavar="S")
    slip: float = option(Usual(0.0), text=share, metavar="SHARE")
    skid: float = option(Usual(0.0), text=not_negative, metavar="S")

    @staticmethod
    def ideal() -> Drivetrain:
        """A base that does what it is told, at once."""
        return Drivetrain(acceleration=math.inf, turning=math.inf)

    @property
    def sheet(self) -> tuple[float, float]:
        """Accelerations [m/s^2, rad/s^2] as the data sheet has them: without a load."""
        return self.acceleration, self.turning


PLANTS: dict[str, dict[str, float]] = {
    "light": {},
    "pmb2": {"acceleration": 1.0, "turning": 2.1},
    "harsh": {"acceleration": 1.0, "turning": 2.1, "lag": 0.1, "latency": 0.05, "slip": 0.05, "skid": 0.05},
}
"""Bases by name: that of the DWB example, PAL's PMB-2, and one whose motors and floor are worse than it is told."""


def plant(name: str, drivetrain: Drivetrain) -> Drivetrain:
    """A drivetrain with the numbers of a named base where nobody has asked for others."""
    own = {key: value for key, value in PLANTS[name].items() if isinstance(getattr(drivetrain, key), Usual)}
    return replace(drivetrain, **own)


class Wheels:
    """The controls of a base over time, as its motors make them.

    Attributes:
        velocity: (m,) of the motors now: of a unicycle forward and turning [m/s, rad/s].
        powered: false while brakes hold the wheels, whatever they are told.
    """

    def __init__(self, drivetrain: Drivetrain, base: Base = unicycle.BASE) -> None:
        """Stand still, told to stand still."""
        self._drivetrain = drivetrain
        self._most = base.spread(drivetrain.sheet) / (1.0 + drivetrain.load)
        if base.steering is not None and np.isfinite(self._most[-1]):
            self._most[-1] = base.steering[1]
        self._coming: deque[tuple[float, Array]] = deque()
        self._told = np.zeros(base.size)
        self._now = self._computed = 0.0
        self.velocity, self.powered = np.zeros(base.size), True

    def tell(self, command: Sequence[float], computing: float = 0.0) -> None:
        """Send a command (m,) now, which took so long to compute [s]; it acts after the latency, until another does."""
        latency = self._drivetrain.latency
        if latency == COMPUTED:
            self._computed = max(self._computed, self._now) + computing
        self._coming.append((self._computed if latency == COMPUTED else self._now + latency, np.array(command)))

    def advance(self, dt: float) -> Array:
        """Let time pass; (m,) mean controls over ``dt`` [s].

        A command takes effect at the beginning of the interval in which its time comes, half an interval early or late.
        """
        while self._coming and self._coming[0][0] <= self._now + 0.5 * dt:
            self._told = self._coming.popleft()[1]
        self._now += dt
        told, lag = (self._told, self._drivetrain.lag) if self.powered else (np.zeros_like(self._told), 0.0)
        self.velocity, mean = followed(told, self.velocity, lag, self._most * dt, dt)
        return mean


def followed(told: Array, before: Array, lag: float, most: Array, dt: float) -> tuple[Array, Array]:
    """Velocities that follow a command with a lag of first order and limited accelerations.

    Args:
        told: (2,) command [m/s, rad/s].
        before: (2,) velocities now.
        lag: time constant [s].
        most: (2,) greatest changes within the interval.
        dt: its duration [s].

    Returns:
        (2,) velocities at the end, and (2,) means.
    """
    wanted = (1.0 if lag == 0.0 else -math.expm1(-dt / lag)) * (told - before)
    change = np.clip(wanted, -most, most)
    after = before + change
    if lag == 0.0:  # a ramp that ends within the interval, or a step
        spent = np.divide(np.abs(change), most, out=np.zeros_like(change), where=most > 0.0)
        return after, after - 0.5 * spent * change
    # The exponential where it is not cut.
    return after, np.where(np.abs(wanted) <= most, told - wanted * lag / dt, 0.5 * (before + after))
