"""Supervisor: health signals become a share of the robot's speed.

Every signal grows with trouble. Up to one value all is well; from there the share of the speed falls, and at another
one it is at its least, most often rest. From a third one on the robot does not know where it is. The worst signal
counts, and names the cause. One class serves both robots: they differ in their signals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

__all__ = ["Health", "HealthReport", "Ramp", "Supervisor"]

RISE = 0.1  # of the speed that comes back in a tick
STEADY = 5  # ticks in a row in which nothing says that it is lost, after which a robot that was is not
PERSISTENT = 2  # bad ticks in a row that make one lost


class Health(Enum):
    """State of a robot's sensors and estimates."""

    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"


@dataclass(frozen=True)
class Ramp:
    """Speed by the value of one signal.

    Attributes:
        words: the cause, for people.
        begins: up to this value all is well.
        ends: from this value on the share is at its least.
        least: share of the speed then.
        lost: from this value on the robot does not know where it is.
    """

    words: str
    begins: float
    ends: float
    least: float = 0.0
    lost: float = math.inf

    def share(self, value: float) -> float:
        """Of the speed; a signal that is no number is the worst."""
        if not value > self.begins and not math.isnan(value):
            return 1.0
        fall = (value - self.begins) / (self.ends - self.begins)
        return 1.0 - (1.0 - self.least) * (fall if fall < 1.0 else 1.0)


@dataclass(frozen=True)
class HealthReport:
    """Report that holds until the next tick.

    Attributes:
        health: in a word.
        share: of its speed that the robot may use; at 0 it comes to rest.
        cause: what is the matter, "" if nothing is.
    """

    health: Health
    share: float
    cause: str

    @property
    def rests(self) -> bool:
        """True if the robot has to come to rest."""
        return self.share <= 0.0


class Supervisor:
    """Watches the signals of one robot.

    Attributes:
        ramps: by name of the signal.
        verdict: the last one.
    """

    def __init__(self, ramps: Mapping[str, Ramp]) -> None:
        """Begin with confidence."""
        self.ramps = dict(ramps)
        self.verdict = HealthReport(Health.OK, 1.0, "")
        self._bad = 0
        self._good = STEADY

    def judge(self, signals: Mapping[str, float], notes: Mapping[str, str] | None = None) -> HealthReport:
        """Weigh the signals of a tick.

        Args:
            signals: by name; one that is missing is well.
            notes: what more is known of the cause of a signal.
        """
        shares = {name: self.ramps[name].share(value) for name, value in signals.items()}
        worst = min(shares, key=lambda name: shares[name], default="")
        allowed = shares.get(worst, 1.0)
        lost = [name for name, value in signals.items() if not value < self.ramps[name].lost]
        self._bad = self._bad + 1 if lost else 0
        # What can make it lost has to be well; what only slows it down may last.
        placed = all(shares[name] >= 1.0 for name in signals if math.isfinite(self.ramps[name].lost))
        self._good = self._good + 1 if placed else 0
        before = self.verdict
        is_lost = self._bad >= PERSISTENT or (before.health is Health.LOST and self._good < STEADY)
        if is_lost:
            named = self._cause(worst if allowed < 1.0 else "", notes) or before.cause
            self.verdict = HealthReport(Health.LOST, 0.0, named)
        elif allowed < 1.0:
            self.verdict = HealthReport(Health.DEGRADED, min(allowed, before.share + RISE), self._cause(worst, notes))
        else:
            share = min(1.0, before.share + RISE)
            returning = share < 1.0
            self.verdict = HealthReport(
                Health.DEGRADED if returning else Health.OK, share, before.cause if returning else ""
            )
        return self.verdict

    def fail(self, why: str) -> None:
        """Note a tick that came to no end."""
        self._good = 0
        health = Health.LOST if self.verdict.health is Health.LOST else Health.DEGRADED
        self.verdict = HealthReport(health, 0.0, f"the tick failed: {why}")

    def _cause(self, name: str, notes: Mapping[str, str] | None) -> str:
        if not name:
            return ""
        more = (notes or {}).get(name, "")
        return self.ramps[name].words + (f": {more}" if more else "")
