"""A quadrotor that follows its commands late: the loops of the body rates and of the thrust are part of the state.

The state of :mod:`unifg.models.quadrotor` is followed by what the loops hold, {p, R, v, rate, spin, thrust}, and a
control is what they are told (:data:`unifg.models.quadrotor.CONTROL`). The loops are linear: of second order for the
rates, of first order for the thrust,

    rate' = torque,    lag torque' = gain (told - rate) - torque,    lag thrust' = told - thrust

with torque per inertia. The state has spin = lag torque [rad/s] in its place, which is of the size of rates. Over a
step with a command that is held the loops are exact. The attitude turns by the mean rate of the step; velocity and
position follow by the trapezoid, with the mean thrust along the mean of the two axes of the body.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg

from unifg.errors import ModelError
from unifg.lie import SO3, Product, Rn
from unifg.models import quadrotor
from unifg.typing import Array, ArrayLike

STATE = Product(p=Rn(3), R=SO3, v=Rn(3), rate=Rn(3), spin=Rn(3), thrust=Rn(1))
"""Storage 17 numbers, of which the first ten are those of :data:`unifg.models.quadrotor.STATE`; tangent 16."""

P, R, V, RATE, SPIN, THRUST = (STATE.component(name).storage for name in ("p", "R", "v", "rate", "spin", "thrust"))


def held(gain: float, lag: float, durations: ArrayLike) -> Array:
    """(n, 8) how the loops change in steps with a command that is held.

    With e = rate - told: e and spin at the end are [[a, b], [c, d]] of e and spin at the begin, the mean of e is (m, k)
    of them, and of what the thrust misses f is left, its mean is g of it. The columns are a, b, c, d, f, m, k, g.

    Args:
        gain: of the loop of the rates [1/s]; infinite for loops that follow at once.
        lag: of the motors [s].
        durations: (n,) [s].

    Raises:
        ModelError: for a gain or a lag that is not positive, or a negative duration.
    """
    times = np.atleast_1d(np.asarray(durations, dtype=np.float64))
    if not (gain > 0.0 and lag > 0.0 and (times >= 0.0).all() and np.isfinite(times).all()):
        raise ModelError(f"loops need a gain and a lag above zero and finite durations, found {gain}, {lag}, {times}")
    if np.isinf(gain):
        return np.zeros((len(times), 8))
    a = np.array([[0.0, 1.0], [-gain * lag, -1.0]]) / lag
    found = np.empty((len(times), 8))
    for k, h in enumerate(times.tolist()):
        step = scipy.linalg.expm(a * h)
        mean = np.linalg.solve(a * h, step - np.eye(2)) if h > 0.0 else np.eye(2)
        kept = np.exp(-h / lag)
        found[k] = *step.ravel(), kept, *mean[0], (1.0 - kept) * lag / h if h > 0.0 else 1.0
    return found


def defect(x: Array, u: Array, mass: Array, drag: Array, gust: Array, x_next: Array, dt: Any, loops: Array) -> Array:
    """(n, 16) by what a step from x with the command u misses x_next.

    Args:
        x: (n, 17).
        u: (n, 4) rates [rad/s] and thrust [N] that are told.
        mass: (n, 1) [kg].
        drag: (n, 3) along the axes of the body [kg/s].
        gust: (n, 3) what the air adds to the acceleration [m/s^2].
        x_next: (n, 17).
        dt: (n,) [s].
        loops: (n, 8) as :func:`held` gives them.
    """
    h = np.reshape(dt, (-1, 1))
    told, pushed = u[:, :3], u[:, 3:]
    miss, spin, short = x[:, RATE] - told, x[:, SPIN], x[:, THRUST] - pushed
    rate = told + loops[:, 0:1] * miss + loops[:, 1:2] * spin
    turned = told + loops[:, 5:6] * miss + loops[:, 6:7] * spin
    twisted = loops[:, 2:3] * miss + loops[:, 3:4] * spin
    mean = pushed + loops[:, 7:8] * short
    push = 0.5 * (quadrotor.pushed(x, mean, mass, drag) + quadrotor.pushed(x_next, mean, mass, drag))
    return np.concatenate(
        [
            x_next[:, P] - x[:, P] - 0.5 * h * (x[:, V] + x_next[:, V]),
            SO3.log(SO3.compose(SO3.inverse(x[:, R]), x_next[:, R])) - h * turned,
            x_next[:, V] - x[:, V] - h * (push - quadrotor.GRAVITY * quadrotor.UP + gust),
            x_next[:, RATE] - rate,
            x_next[:, SPIN] - twisted,
            x_next[:, THRUST] - pushed - loops[:, 4:5] * short,
        ],
        axis=1,
    )


def field(x: Array, u: Array, mass: Array, drag: Array, gust: Array, gain: float, lag: float) -> Array:
    """F, (n, 16): x' in the tangent space of :data:`STATE`, for finite gains."""
    push = quadrotor.pushed(x, x[:, THRUST], mass, drag) - quadrotor.GRAVITY * quadrotor.UP + gust
    twist = gain * (u[:, :3] - x[:, RATE]) - x[:, SPIN] / lag
    return np.concatenate([x[:, V], x[:, RATE], push, x[:, SPIN] / lag, twist, (u[:, 3:] - x[:, THRUST]) / lag], axis=1)
