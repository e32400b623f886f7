"""A quadrotor as its autopilot hands it over: it is told body rates and a thrust, and follows them late and softly.

What is told at a tick arrives one tick later, for that is how long deciding takes, and then as late as the link makes
it. The loop of the body rates is of second order, that of the thrust of first,

    lag torque' = gain (told - rate) - torque,    rate' = torque,    lag thrust' = told - thrust

with torque per inertia. Both are linear and stepped exactly; the pose is integrated by RK-MK4 with what they do in the
middle of each millisecond (:func:`unifg.models.quadrotor.fly` does the same with a control that is held).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import ScenarioError
from unifg.models import quadrotor, quadrotor_dynamics
from unifg.models.quadrotor_loops import held
from unifg.scenarios.options import AboveZero, Positive, Settings
from unifg.typing import Array, ArrayLike

__all__ = ["SUBSTEP", "Airframe", "BodyRatePlant", "Loops"]

SUBSTEP = 1e-3
"""Step of the truth [s]."""


@dataclass(frozen=True)
class Loops(Settings):
    """Response of the vehicle to its commands.

    Attributes:
        gain: of the loop of the rates [1/s].
        lag: of the motors [s].
        link: how late a command arrives after the tick in which it was decided [s].
    """

    gain: AboveZero[float] = 25.0
    lag: Positive[float] = 0.02
    link: float = 0.01

    @property
    def delay(self) -> float:
        """Delay of the loops for slow commands: link and slope of the rate loop's phase [s]."""
        return self.link + 1.0 / self.gain


@dataclass(frozen=True)
class Airframe(Settings):
    """A vehicle.

    Attributes:
        parameters: mass, drag, wind.
        loops: how it follows.
        radius: of the hull [m].
        rates: greatest body rates about each axis [rad/s].
        thrust: least and greatest [N].
    """

    parameters: quadrotor.Parameters = field(default_factory=quadrotor.Parameters)
    loops: Loops = field(default_factory=Loops)
    radius: Positive[float] = 0.25
    rates: Positive[tuple[float, float, float]] = (6.0, 6.0, 3.0)
    thrust: tuple[float, float] = (2.0, 20.0)

    @property
    def least(self) -> Array:
        """(4,) least control."""
        return np.array([-self.rates[0], -self.rates[1], -self.rates[2], self.thrust[0]])

    @property
    def most(self) -> Array:
        """(4,) greatest control."""
        return np.array([*self.rates, self.thrust[1]])


@compiled
def _advance(x: Array, loop: Array, told: Array, noise: Array, rho: Array, step: Array, h: float, path: Array) -> None:
    """Move the state x (10,) and the loops (7,) by one substep per row of ``told`` (n, 4)."""
    during = np.zeros(4)
    for n in range(len(told)):
        for i in range(3):
            error, spin = loop[i] - told[n, i], loop[3 + i]
            during[i] = told[n, i] + step[5] * error + step[6] * spin
            loop[i] = told[n, i] + step[0] * error + step[1] * spin
            loop[3 + i] = step[2] * error + step[3] * spin
        before = loop[6]
        loop[6] = told[n, 3] + step[4] * (before - told[n, 3])
        during[3] = 0.5 * (before + loop[6])
        quadrotor_dynamics.integrate(x, during, noise, rho, h, 1)
        for i in range(3):
            path[n, i] = x[i]


class BodyRatePlant:
    """One vehicle in the air, or a model of it.

    Attributes:
        airframe: what flies.
        state: (10,) now.
        loops: (7,) rates [rad/s], torques per inertia times the lag of the motors [rad/s] and thrust [N] now.
        time: [s].
    """

    def __init__(self, airframe: Airframe, state: ArrayLike, dt: float) -> None:
        """Begin in a state, told to hover until now.

        Args:
            airframe: what flies.
            state: (10,) to begin with.
            dt: length of a tick [s], whole milliseconds.

        Raises:
            ScenarioError: for a tick or a link that is no whole number of milliseconds.
        """
        self.airframe, self.dt, self.time = airframe, dt, 0.0
        self.state = np.array(state, dtype=np.float64)
        self._rows, late = round(dt / SUBSTEP), round(airframe.loops.link / SUBSTEP)
        for what, count, length in (("tick", self._rows, dt), ("link", late, airframe.loops.link)):
            if abs(count * SUBSTEP - length) > 1e-9 or (what == "tick" and count < 1):
                raise ScenarioError(f"a {what} of {length:g} s is no whole number of milliseconds")
        hover = quadrotor.hover(airframe.parameters)
        self.loops = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, hover[3]])
        self._step: Array = held(airframe.loops.gain, airframe.loops.lag, SUBSTEP)[0]
        self._pipe: deque[Array] = deque([hover] * (self._rows + late))

    def tick(self, command: ArrayLike, noise: ArrayLike | None = None) -> Array:
        """Fly one tick; what is decided now acts after those decided before.

        Args:
            command: (4,) body rates and thrust; beyond its limits the vehicle does what it can.
            noise: (6,) rates and accelerations that disturb it, held over the tick; None for none.

        Returns:
            (k + 1, 3) where it was every millisecond, the first being the place of the last tick [m].
        """
        told = np.clip(np.asarray(command, dtype=np.float64), self.airframe.least, self.airframe.most)
        if not np.isfinite(told).all():
            raise ScenarioError(f"a command must be finite, got {np.asarray(command).tolist()}")
        self._pipe.extend([told] * self._rows)
        rows = [self._pipe.popleft() for _ in range(self._rows)]
        self.time += self._rows * SUBSTEP
        return self._fly(self.state, self.loops, rows, noise)

    def ahead(self, state: Array, duration: float, noise: ArrayLike | None = None) -> tuple[Array, Array]:
        """Prediction from ``state`` after what is pending has acted for a while.

        Args:
            state: (10,) as it is seen.
            duration: how far to look [s]; the last command is held where none is left.
            noise: (6,) rates and accelerations that disturb it meanwhile; None for none.

        Returns:
            (10,) state and (7,) loops then.
        """
        predicted = state.copy(), self.loops.copy()
        rows = list(self._pipe)[: round(duration / SUBSTEP)]
        rows += [self._pipe[-1]] * (round(duration / SUBSTEP) - len(rows))
        self._fly(*predicted, rows, noise)
        return predicted

    def _fly(self, state: Array, loops: Array, rows: list[Array], noise: ArrayLike | None) -> Array:
        """Move a state (10,) and loops (7,) by a substep per row of commands; the places (k + 1, 3) on the way [m]."""
        told, path = np.array(rows).reshape(-1, 4), np.empty((len(rows) + 1, 3))
        disturbed = np.zeros(6) if noise is None else np.asarray(noise, dtype=np.float64)
        path[0] = state[:3]
        _advance(state, loops, told, disturbed, self.airframe.parameters.packed, self._step, SUBSTEP, path[1:])
        return path
