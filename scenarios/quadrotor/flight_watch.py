"""Health signals of the quadrotor, and the control in place of a plan.

A vehicle that may not go on hovers, by what it still measures; one that cannot go on for long lands where it is.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from unifg.scenarios.monitoring.supervisor import Health, HealthReport, Ramp, Supervisor
from unifg.scenarios.monitoring.validation import Validator
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.quadrotor.braking import braking_control
from unifg.scenarios.quadrotor.unmodelled import Unmodelled
from unifg.typing import Array

__all__ = ["RAMPS", "FlightWatch"]

RAMPS: Mapping[str, Ramp] = {
    "sight": Ramp("nothing is seen", 0.1, 0.2, lost=1.0),  # [s] since the last sighting that came in
    "spread": Ramp("where it is, is known to decimetres only", 0.25, 0.6, lost=0.9),  # [m]
    "plan": Ramp("no plan", 0.25, 1.0, least=0.3),  # [s] since the last
    "strangers": Ramp("the detector sees what was not there before", 6.0, 12.0),  # landmarks that are new, lately
    "inertial": Ramp("no inertial unit", 0.1, 0.5, least=0.3),  # [s]
    "push": Ramp("a gust pushes", 0.5, 4.0, least=0.4),  # [m/s^2] beyond the wind that is believed
    "thrust": Ramp("the thrust is not what is asked for", 0.03, 0.3, least=0.5),  # share
}
"""By signal."""

LATELY = 0.5  # [s] in which strangers are counted
HOVER = 4.0  # [s] for which a vehicle that may not go on, or has no plan, hovers before it lands
BLIND_HOVER = 1.5  # [s] for which one that does not know where it is does: it drifts
SINK = (0.4, 1.5)  # [m/s] of a landing, at the floor and at most; a drifting vehicle should not take long
SLOWING = 0.8  # [s] in which a landing would reach the floor at the speed it has
BLIND_SINK = 0.6  # [m/s] of one that does not measure its height
COMMITTED = 0.6  # [m] below which a landing is not broken off


class FlightWatch:
    """Looks at readings, judges, and flies where nothing is planned.

    Attributes:
        validator: of readings.
        supervisor: how fast the vehicle may fly.
        felt: what no model holds.
        lands: whether it is to land.
    """

    def __init__(self, dt: float, sigma: Array) -> None:
        """Begin with nothing the matter.

        Args:
            dt: duration of a tick [s].
            sigma: (7,) standard deviations of parameters that are not estimated; see :class:`Unmodelled`.
        """
        self.validator, self.supervisor, self.felt = Validator(), Supervisor(RAMPS), Unmodelled(sigma)
        self.lands = False
        self._dt = dt
        self._sight = self._plan = self._inertial = self._resting = 0.0
        self._known: set[int] = set()
        self._strangers: deque[int] = deque(maxlen=round(LATELY / dt))
        self._first = True

    @property
    def verdict(self) -> HealthReport:
        """The last one."""
        return self.supervisor.verdict

    def admit(self, reading: Reading | None, now: float, applied: Array | None, belief: Belief) -> Reading:
        """Let a reading in, as far as it can be, and feel what no model holds.

        Args:
            reading: as it arrived.
            now: [s].
            applied: (4,) control since the last tick; None at the first one.
            belief: after the last tick.
        """
        seen = self.validator.reading(reading, now, np.zeros(4) if applied is None else applied)
        if applied is not None:
            self.felt.note(seen.force, float(self.felt.expected(applied)[3]), belief)
        return seen

    def judge(self, told: Reading | None, belief: Belief) -> None:
        """Say how fast the vehicle may fly, by what it has recognised and the belief of the tick before.

        Args:
            told: what was admitted, with the names and flags the vehicle itself knows, -1 for what it has no name for;
                None where that failed.
            belief: after the last tick.
        """
        resting = np.zeros(0, dtype=np.intp) if told is None else told.ids[~told.moving]
        self._sight = 0.0 if len(resting) else self._sight + self._dt
        names = set(resting[resting >= 0].tolist())
        self._strangers.append(0 if self._first else len(names - self._known))
        self._known |= names
        self._first = False
        self._inertial = self._inertial + self._dt if "inertial unit" in self.validator.refused else 0.0
        spread = float(np.linalg.eigvalsh(belief.covariance[:3, :3])[-1]) if _finite(belief) else math.inf
        signals = {
            "sight": self._sight, "spread": math.sqrt(max(spread, 0.0)), "plan": self._plan,
            "strangers": float(sum(self._strangers)), "inertial": self._inertial,
            "push": float(np.hypot(*self.felt.push)),
            "thrust": max(abs(self.felt.missing), abs(1.0 - self.felt.thrust_yield)),
        }  # fmt: skip
        verdict = self.supervisor.judge(signals, {"sight": self.validator.refused.get("detector", "")})
        waits = verdict.rests or self._plan > RAMPS["plan"].ends
        self._resting = self._resting + self._dt if waits else 0.0
        self.lands = self._resting > (BLIND_HOVER if verdict.health is Health.LOST else HOVER) or (
            self.lands and (waits or float(belief.state[2]) < COMMITTED)
        )

    def planned(self, sound: bool) -> None:
        """Record if the tick has a plan of its own."""
        self._plan = 0.0 if sound else self._plan + self._dt

    def hover(self, belief: Belief, least: Array, most: Array) -> Array:
        """The control (4,) of a vehicle that brakes and hovers, or lands."""
        sink = 0.0
        if self.lands:
            measured = "altimeter" not in self.validator.refused
            sink = float(np.clip(belief.state[2] / SLOWING, *SINK)) if measured else BLIND_SINK
        return braking_control(belief.state, self.pushed(belief).parameters, least, most, sink)

    def pushed(self, belief: Belief) -> Belief:
        """A belief whose wind holds what pushes besides: the estimate takes seconds to make it its own."""
        p = belief.parameters
        push = self.felt.push
        if not push.any():
            return belief
        return replace(belief, parameters=replace(p, wind=(p.wind[0] + push[0], p.wind[1] + push[1])))


def _finite(belief: Belief) -> bool:
    return bool(np.isfinite(belief.covariance).all() and np.isfinite(belief.state).all())
