"""Do the motors follow as the data sheet says? An innovation test: what the wheels did, against models of it.

A bank of models is told what the base is told. One follows at once, within its accelerations; the others with a lag of
first order besides. Each tick leaves, for each of them, half the difference between the squared normalised residuals of
the first model and its own: the logarithm of their likelihood ratio. Sums that fade over some seconds and never fall
below zero (Page's test, Biometrika 41 (1954)) name a lag where they exceed a threshold. A base that goes on steadily
says nothing, as all models agree then.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from unifg.models import unicycle
from unifg.models.planar import Base
from unifg.scenarios.simulation.drivetrain import followed
from unifg.typing import Array

__all__ = ["MotorLag"]

LAGS = np.array([0.0, 0.1, 0.2, 0.3, 0.5])  # [s]
THRESHOLD = 8.0  # of the logarithm of a likelihood ratio
MOST = 30.0  # that is kept of it
MEMORY = 5.0  # [s] over which it fades
SCALE = 0.06  # relative standard deviation of what wheels say of their velocities
FLOOR = (0.02, 0.05)  # the same at rest [m/s, rad/s]
OUTLIER = 9.0  # a squared normalised residual counts as no more than this
OBEYING = 4  # models, up to a lag of 0.3 s, between which motors are that obey
LEEWAY = 0.2, (0.05, 0.1)  # of velocities, and of rest [m/s, rad/s], by which they may differ, as wheels are not exact


class MotorLag:
    """Watches the wheels of one base."""

    def __init__(self, dt: float, most: Array, base: Base = unicycle.BASE) -> None:
        """Stand still.

        Args:
            dt: duration of a tick [s].
            most: (m,) greatest changes of the controls in a tick by the data sheet.
            base: that moves.
        """
        self._dt, self._most, self._base = dt, most, base
        self._velocities = np.zeros((len(LAGS), base.size))
        self._evidence = np.zeros(len(LAGS))
        self._expected: deque[Array] = deque([np.zeros((len(LAGS), len(base.of(np.zeros(base.size)))))], maxlen=2)

    @property
    def seconds(self) -> float:
        """Time constant of the lag that is named [s]; 0 for none."""
        best = int(np.argmax(self._evidence))
        return float(LAGS[best]) if self._evidence[best] > THRESHOLD else 0.0

    def note(self, asked: Array, done: Array | None) -> None:
        """Take in a tick.

        Args:
            asked: (m,) controls asked for; a tick in which they are not finite says nothing.
            done: (m,) mean controls that the wheels have measured; None where they have not.
        """
        if not np.isfinite(asked).all():
            return
        models = [followed(asked, v, lag, self._most, self._dt) for v, lag in zip(self._velocities, LAGS, strict=True)]
        self._velocities, expected = (np.array(part) for part in zip(*models, strict=True))
        self._evidence *= math.exp(-self._dt / MEMORY)
        expected = self._base.velocities(expected)
        self._expected.append(expected)
        if done is None:
            return
        made = self._base.of(done)
        floor = np.array([FLOOR[0]] * (len(made) - 1) + [FLOOR[1]])
        sigma = floor + SCALE * np.abs(expected[0])
        squares = np.minimum(np.square((made - expected) / sigma), OUTLIER).sum(axis=1)
        self._evidence = np.clip(self._evidence + 0.5 * (squares[0] - squares), 0.0, MOST)

    def obey(self, done: Array) -> bool:
        """Return True if body velocities (k,) lie within what models make of the last commands.

        Those of the tick before count, too: a command may be on its way.
        """
        expected = np.concatenate([part[:OBEYING] for part in self._expected])
        low, high = expected.min(axis=0), expected.max(axis=0)
        share, rest = LEEWAY
        leeway = share * np.maximum(np.abs(low), np.abs(high)) + [*[rest[0]] * (len(done) - 1), rest[1]]
        return bool(((done >= low - leeway) & (done <= high + leeway)).all())
