"""State filter of the vehicle and of the gust: the past of a flight as one Gaussian.

A step of the past is a factor between two states, a look is a factor on one of them, and the gust, an acceleration that
fades with a known time, goes along. What lies more than one step back is summed up in the mean and the covariance of
the present: the window of one step, which is the extended Kalman filter. The unknowns are the errors

    d = (p, theta, v, gust),   p' = v,   theta' = -rate x theta,   v' = gust - R [T/m e3] theta,   gust' = -gust / tau

with the attitude R Exp(theta); position, attitude and velocity are seen themselves.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.scenarios.simulation.body_rate import BodyRatePlant
from unifg.scenarios.simulation.disturbance import DisturbanceModel
from unifg.typing import Array

__all__ = ["AIR", "StateFilter"]

SEEN = (1e-3, 3e-3, 1e-2)  # [m, rad, m/s] standard deviations of position, attitude and velocity as believed
AIR = DisturbanceModel()  # noise of rates and accelerations, and gusts, as believed
P, R, V, G = (slice(k, k + 3) for k in range(0, 12, 3))


class StateFilter:
    """Follows one vehicle.

    Attributes:
        state: (10,) now.
        gust: (3,) acceleration by the air now [m/s^2].
        covariance: (12, 12) of position, attitude, velocity and gust.
    """

    def __init__(self, dt: float) -> None:
        """Know nothing; ``dt`` is the length of a tick [s]."""
        self._dt, self._keep = dt, math.exp(-dt / AIR.gust_time)
        self._noise = np.square(np.repeat(np.maximum(SEEN, 1e-9), 3))
        blow = np.square(AIR.gust)
        fresh = (1.0 - self._keep**2) * blow
        self._fresh = np.concatenate(
            [np.zeros(3), np.full(3, AIR.rate_density**2 * dt), np.full(3, AIR.acceleration_density**2 * dt), fresh]
        )
        self._fresh[P] = self._fresh[V] * dt * dt / 3.0
        self.state: Array | None = None
        self.gust = np.zeros(3)
        self.covariance = np.diag(np.concatenate([self._noise, blow]))

    @property
    def unsure(self) -> float:
        """Standard deviation of the position, along the axis of which it is greatest [m]."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[P, P])[-1]))

    def see(self, seen: Array) -> Array:
        """Take in a state (10,) as it is seen now; returns the state (10,) that is believed."""
        if self.state is None:
            self.state = seen.copy()
            return self.state
        s = self.covariance
        missed = quadrotor.STATE.local(self.state[None], seen[None])[0]
        gain = np.linalg.solve(s[:9, :9] + np.diag(self._noise), s[:9]).T
        correction = gain @ missed
        self.state = quadrotor.STATE.retract(self.state[None], correction[None, :9])[0]
        self.gust = self.gust + correction[9:]
        s = s - gain @ s[:9]
        self.covariance = 0.5 * (s + s.T)
        return self.state

    def tick(self, model: BodyRatePlant, command: Array) -> None:
        """Let a tick pass in a model of the vehicle, which moves from the state that is believed."""
        assert self.state is not None
        before = model.loops.copy()
        rate, thrust = before[:3], before[6] / model.airframe.parameters.mass
        turn = SO3.to_matrix(self.state[3:7])
        model.state = self.state.copy()
        model.tick(command, np.concatenate([np.zeros(3), self.gust]))
        self.state = model.state.copy()
        self.gust = self._keep * self.gust
        h, step = self._dt, np.eye(12)
        tilt = turn @ np.array([[0.0, -thrust, 0.0], [thrust, 0.0, 0.0], [0.0, 0.0, 0.0]])
        step[P, V], step[P, G], step[P, R] = h * np.eye(3), 0.5 * h * h * np.eye(3), -0.5 * h * h * tilt
        step[R, R] = SO3.to_matrix(SO3.exp(-h * rate))
        step[V, R], step[V, G], step[G, G] = -h * tilt, h * np.eye(3), self._keep * np.eye(3)
        self.covariance = step @ self.covariance @ step.T + np.diag(self._fresh)
