"""Does the vehicle move as its model says? An innovation test: the specific force felt, against the one expected.

Over a tick, an accelerometer in the body feels thrust over mass, less drag, and the wind:

    f = (T e3 - D R'v) / m + R'w,

with the believed velocity, mass, drag and wind. The means of what it felt beyond that, over a short window, are weighed
with the noise of the sensor, that of usual gusts, and what is not known of the parameters. Where one of them is larger
than a number of standard deviations, something pushes, or the thrust is not what was asked for: what explains more.

A share of the thrust that is missing, as motors are weak or the vehicle carries something, is a slow state besides the
mass: it jumps where the test finds it, and then follows the mean of the force felt. Thrusts are asked for accordingly.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from unifg.lie import SO3
from unifg.scenarios.perception.belief import Belief
from unifg.typing import Array

__all__ = ["Unmodelled"]

WINDOW = 3  # ticks
LIMIT = 5.0  # standard deviations
SENSOR = 0.12  # [m/s^2] of one reading, with the noise of the air in a tick
LASTING = 0.15  # [m/s^2] of what stays over the window: bias of the sensor, a usual gust
GAIN = 0.1  # of the share that is missing on average of the window, by which a yield that is not one follows it
WHOLE = 0.02  # share by which a yield of one may differ from it
LEAST, MOST = 0.5, 1.5  # yields that are believed
GROUND = 0.3  # [m] above the floor, which may carry the vehicle below


class Unmodelled:
    """Watches the forces on one vehicle.

    Attributes:
        push: (2,) horizontal acceleration in the world that no model holds [m/s^2]; zero unless it is significant.
        missing: share of the thrust expected that is missing, negative for too much; zero unless it is significant.
        thrust_yield: thrust that the mass makes one expect, over the thrust asked for: a load of 40 % leaves 1 / 1.4.
        score: the larger of the two tests, in standard deviations.
    """

    def __init__(self, sigma: Array) -> None:
        """Begin with nothing felt.

        Args:
            sigma: (7,) standard deviations of parameters that are not estimated, in the order of
                ``quadrotor.Parameters.packed``.
        """
        self._sigma = sigma
        self._window: deque[tuple[Array, Array]] = deque(maxlen=WINDOW)
        self.push, self.missing, self.score, self.thrust_yield = np.zeros(2), 0.0, 0.0, 1.0

    def expected(self, control: Array) -> Array:
        """Control (4,) that a vehicle without faults would need for what this one makes of ``control`` (4,)."""
        return control * [1.0, 1.0, 1.0, self.thrust_yield]

    def asked(self, control: Array, most: float) -> Array:
        """Control (4,) that makes of this vehicle what ``control`` (4,) makes of one without faults, up to a thrust."""
        return np.append(control[:3], min(float(control[3]) / self.thrust_yield, most))

    def note(self, force: Array, thrust: float, belief: Belief) -> None:
        """Take in a tick.

        Args:
            force: (3,) specific force felt, in the body [m/s^2]; not finite where it was not measured.
            thrust: that is expected of what was asked for [N].
            belief: after the tick before.
        """
        self.push, self.missing, self.score = np.zeros(2), 0.0, 0.0
        rotation, velocity = belief.state[3:7], belief.state[7:10]
        p = belief.parameters
        if not (np.isfinite(force).all() and np.isfinite(belief.state).all()):
            self._window.clear()
            return
        inverse = SO3.inverse(rotation)
        relative = SO3.act(inverse, velocity)
        wind = SO3.act(inverse, np.array([*p.wind, p.updraft]))
        pulled = thrust / p.mass
        beyond = force - (np.array([0.0, 0.0, pulled]) - np.array(p.drag) * relative / p.mass + wind)
        self._window.append((SO3.act(rotation, beyond)[:2], np.array([beyond[2], pulled])))
        if len(self._window) < WINDOW:
            return
        sideways = np.mean([row[0] for row in self._window], axis=0)
        along, asked = np.mean([row[1] for row in self._window], axis=0).tolist()
        known = belief.parameters_sigma
        sigma = np.where(known > 0.0, known, self._sigma)
        variance = SENSOR**2 / WINDOW + LASTING**2
        drag = sigma[1:4] * np.abs(relative) / p.mass
        across = np.sqrt(variance + sigma[4:6] ** 2 + max(drag[:2]) ** 2)
        upright = np.sqrt(variance + (asked * sigma[0] / p.mass) ** 2 + drag[2] ** 2)
        pushed, weak = float(np.hypot(*(sideways / across))), abs(along) / float(upright)
        self.score = max(pushed, weak)
        missing, gain = -along / max(asked, 1e-9), GAIN if self.thrust_yield != 1.0 else 0.0
        if self.score > LIMIT:
            if pushed >= weak:
                self.push = sideways
            else:
                self.missing, gain = missing, 1.0
        if gain and belief.state[2] > GROUND:
            found = min(max(self.thrust_yield * (1.0 - gain * missing), LEAST), MOST)
            self.thrust_yield = found if abs(found - 1.0) > WHOLE else 1.0
            if self.missing:
                self._window.clear()
