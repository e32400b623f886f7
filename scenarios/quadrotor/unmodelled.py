"""Does the vehicle move as its model says? An innovation test: the specific force felt, against the one expected.

Over a tick, an accelerometer in the body feels thrust over mass, less drag, and the wind:

    f = (T e3 - D R'v) / m + R'w,

with the believed velocity, mass, drag and wind. The means of what it felt beyond that, over a short window, are weighed
with the noise of the sensor, that of usual gusts, and what is not known of the parameters. Where one of them is larger
than a number of standard deviations, something pushes, or the thrust is not what was asked for: what explains more.
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


class Unmodelled:
    """Watches the forces on one vehicle.

    Attributes:
        push: (2,) horizontal acceleration in the world that no model holds [m/s^2]; zero unless it is significant.
        missing: share of the thrust asked for that is missing, negative for too much; zero unless it is significant.
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
        self.push, self.missing, self.score = np.zeros(2), 0.0, 0.0

    def note(self, force: Array, thrust: float, belief: Belief) -> None:
        """Take in a tick.

        Args:
            force: (3,) specific force felt, in the body [m/s^2]; not finite where it was not measured.
            thrust: asked for [N].
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
        if self.score <= LIMIT:
            return
        if pushed >= weak:
            self.push = sideways
        else:
            self.missing = -along / max(asked, 1e-9)
