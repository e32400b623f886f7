"""The unicycle: kinematics, tracking and rate residuals (Bazzana et al. 2022, section V).

State x = (px, py, theta) on SE(2), control u = (v, omega) in R2 [m/s, rad/s]. Each residual serves as a soft
factor through ``minimize`` and as a hard constraint through ``constrain``.
"""

from __future__ import annotations

import numpy as np

from unifg.lie import SE2, wrap_angle
from unifg.residuals import residual
from unifg.typing import Array


def step(x: Array, u: Array, dt: float) -> Array:
    """Advance by one sample with the heading at mid-step (eq. 12-14).

    Args:
        x: (n, 3) poses [m, m, rad].
        u: (n, 2) controls [m/s, rad/s].
        dt: sampling time [s].

    Returns:
        (n, 3) next poses.
    """
    heading = x[:, 2] + 0.5 * dt * u[:, 1]
    return np.stack(
        [
            x[:, 0] + dt * u[:, 0] * np.cos(heading),
            x[:, 1] + dt * u[:, 0] * np.sin(heading),
            wrap_angle(x[:, 2] + dt * u[:, 1]),
        ],
        axis=1,
    )


def rollout(start: Array, u: Array, dt: float) -> Array:
    """States reached from ``start`` (3,) under controls (n, 2): (n + 1, 3)."""
    states = [np.asarray(start, dtype=np.float64).reshape(1, 3)]
    for control in np.asarray(u, dtype=np.float64):
        states.append(step(states[-1], control[None, :], dt))
    return np.concatenate(states)


def _dynamics(x: Array, u: Array, x_next: Array, dt: float) -> Array:
    """(n, 3) defect x_next - f(x, u) in world axes (eq. 11), heading wrapped."""
    heading = x[:, 2] + 0.5 * dt * u[:, 1]
    advance = dt * u[:, 0]
    defect = x_next - x
    defect[:, 0] -= advance * np.cos(heading)
    defect[:, 1] -= advance * np.sin(heading)
    defect[:, 2] = wrap_angle(defect[:, 2] - dt * u[:, 1])
    return defect


def _dynamics_jacobian(x: Array, u: Array, x_next: Array, dt: float) -> list[Array]:
    count = len(x)
    heading = x[:, 2] + 0.5 * dt * u[:, 1]
    cosine, sine, advance = np.cos(heading), np.sin(heading), dt * u[:, 0]
    before = -_world_from_body(x)
    before[:, 0, 2] = advance * sine
    before[:, 1, 2] = -advance * cosine
    control = np.zeros((count, 3, 2))
    control[:, 0, 0] = -dt * cosine
    control[:, 1, 0] = -dt * sine
    control[:, 0, 1] = 0.5 * dt * advance * sine
    control[:, 1, 1] = -0.5 * dt * advance * cosine
    control[:, 2, 1] = -dt
    return [before, control, _world_from_body(x_next)]


def _tracking(x: Array, reference: Array) -> Array:
    """(n, 3) deviation (p - p_ref, theta - theta_ref) in world axes (eq. 8), heading wrapped."""
    error = x - reference
    error[:, 2] = wrap_angle(error[:, 2])
    return error


def _tracking_jacobian(x: Array, reference: Array) -> list[Array]:
    return [_world_from_body(x)]


def _rate(u: Array, u_next: Array) -> Array:
    """(n, 2) change of control between neighbouring samples [m/s, rad/s]."""
    return u_next - u


def _rate_jacobian(u: Array, u_next: Array) -> list[Array]:
    identity = np.broadcast_to(np.eye(2), (len(u), 2, 2))
    return [-identity, identity]


def _world_from_body(x: Array) -> Array:
    """(n, 3, 3) derivative of (px, py, theta) along the right perturbation of SE(2)."""
    cosine, sine = np.cos(x[:, 2]), np.sin(x[:, 2])
    block = np.zeros((len(x), 3, 3))
    block[:, 0, 0] = block[:, 1, 1] = cosine
    block[:, 0, 1] = -sine
    block[:, 1, 0] = sine
    block[:, 2, 2] = 1.0
    return block


dynamics = residual(_dynamics, _dynamics_jacobian, "dynamics")
"""``dynamics(x, u, x_next, dt)``: x_next - f(x, u), (n, 3) [m, m, rad] (Bazzana eq. 11-14)."""

tracking = residual(_tracking, _tracking_jacobian, "tracking")
"""``tracking(x, reference)``: deviation from a reference pose in world axes, (n, 3) [m, m, rad] (Bazzana eq. 8)."""

rate = residual(_rate, _rate_jacobian, "rate")
"""``rate(u, u_next)``: change of control, (n, 2) [m/s, rad/s]."""

state = SE2
"""Manifold of the state."""
