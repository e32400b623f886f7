"""The unicycle: kinematics, tracking and rate residuals (Bazzana et al. 2022, section V).

State x = (px, py, theta) on SE(2), control u = (v, omega) in R2 [m/s, rad/s]. Each residual serves as a soft
factor through ``minimize`` and as a hard constraint through ``constrain``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from unifg.kernels.kernel import Kernel
from unifg.kernels.residuals import residual
from unifg.language.factors import difference
from unifg.lie import SE2, Rn
from unifg.lie.rn import minus
from unifg.lie.so2 import wrap
from unifg.machine.calls import vector
from unifg.machine.jit import compiled
from unifg.typing import Array, ArrayLike

state = SE2
"""Manifold of the state."""

CONTROL = Rn(2)


@compiled
def advance(x: Array, u: Array, dt: float, out: Array) -> tuple[float, float]:
    """Write the next pose of one robot (eq. 12-14); return cosine and sine of the heading at mid-step."""
    heading, turn = x[2], dt * u[1]
    middle = heading + 0.5 * turn
    cosine, sine = math.cos(middle), math.sin(middle)
    out[0] = x[0] + dt * u[0] * cosine
    out[1] = x[1] + dt * u[0] * sine
    out[2] = wrap(heading + turn)
    return cosine, sine


@compiled
def _advance_all(x: Array, u: Array, dt: Array, out: Array) -> None:
    """Advance row by row, in order: ``out`` may be ``x`` one row further on."""
    for i in range(len(out)):
        advance(x[i], u[i], dt[i], out[i])


def step(x: Array, u: Array, dt: ArrayLike) -> Array:
    """Advance by one sample with the heading at mid-step (eq. 12-14).

    Args:
        x: (n, 3) poses [m, m, rad].
        u: (n, 2) controls [m/s, rad/s].
        dt: sampling time [s], one or (n,).

    Returns:
        (n, 3) next poses.
    """
    moved = np.empty((max(len(x), len(u)), 3))
    _advance_all(_rows(x, moved, 3), _rows(u, moved, 2), _samples(dt, moved), moved)
    return moved


def rollout(start: Array, u: Array, dt: ArrayLike) -> Array:
    """States reached from ``start`` (3,) under controls (n, 2): (n + 1, 3)."""
    states = np.empty((len(u) + 1, 3))
    states[0] = start
    _advance_all(states[:-1], _rows(u, states[1:], 2), _samples(dt, states[1:]), states[1:])
    return states


def _rows(part: ArrayLike, moved: Array, size: int) -> Array:
    """One contiguous row per result."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(part, dtype=np.float64), (len(moved), size)))


def _samples(dt: ArrayLike, moved: Array) -> Array:
    """One sampling time per result."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(dt, dtype=np.float64), len(moved)))


@compiled
def world_from_body(heading: float, J: Array, column: int) -> None:
    """Write the (3, 3) derivative of (px, py, theta) along the right perturbation of SE(2), from a column on."""
    cosine, sine = math.cos(heading), math.sin(heading)
    J[0, column] = cosine
    J[0, column + 1] = -sine
    J[1, column] = sine
    J[1, column + 1] = cosine
    J[0, column + 2] = J[1, column + 2] = J[2, column] = J[2, column + 1] = 0.0
    J[2, column + 2] = 1.0


@compiled
def _dynamics(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """x_next - f(x, u) in world axes (eq. 11), heading wrapped."""
    u, dt = vector(v, 3, 2), p[0]
    cosine, sine = advance(v, u, dt, r)
    r[0] = minus(minus(v[5], v[0]), dt * u[0] * cosine)
    r[1] = minus(minus(v[6], v[1]), dt * u[0] * sine)
    r[2] = wrap(v[7] - r[2])
    if len(J):
        world_from_body(v[2], J, 0)
        for i in range(3):
            for k in range(3):
                J[i, k] = -J[i, k]
        along = dt * u[0]
        J[0, 2] = along * sine
        J[1, 2] = -along * cosine
        J[0, 3] = -dt * cosine
        J[1, 3] = -dt * sine
        J[2, 3] = 0.0
        J[0, 4] = 0.5 * dt * along * sine
        J[1, 4] = -0.5 * dt * along * cosine
        J[2, 4] = -dt
        world_from_body(v[7], J, 5)


@compiled
def _tracking(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """(p - p_ref, theta - theta_ref) in world axes (eq. 8), heading wrapped."""
    r[0] = v[0] - p[0]
    r[1] = v[1] - p[1]
    r[2] = wrap(v[2] - p[2])
    if len(J):
        world_from_body(v[2], J, 0)


@compiled
def bend(heading: float, x: float, y: float, at: int, S: Array) -> None:
    """Add the Hessian of (x, y)' p along the right perturbation of a pose, whose columns begin at ``at``.

    The position moves by R (v + omega [1]x v / 2) to second order.
    """
    cosine, sine = math.cos(heading), math.sin(heading)
    first, second = 0.5 * (cosine * y - sine * x), -0.5 * (cosine * x + sine * y)
    S[at, at + 2] += first
    S[at + 2, at] += first
    S[at + 1, at + 2] += second
    S[at + 2, at + 1] += second


@compiled
def _dynamics_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Hessian of w' (x_next - f(x, u))."""
    dt, x, y = p[0], w[0], w[1]
    middle = v[2] + 0.5 * dt * v[4]
    cosine, sine = math.cos(middle), math.sin(middle)
    for i in range(len(S)):
        for k in range(len(S)):
            S[i, k] = 0.0
    bend(v[2], -x, -y, 0, S)
    bend(v[7], x, y, 5, S)
    along, across = dt * v[3] * (cosine * x + sine * y), dt * (cosine * y - sine * x)
    S[2, 2] += along
    S[2, 3] -= across
    S[2, 4] += 0.5 * dt * along
    S[3, 4] -= 0.5 * dt * across
    S[4, 4] += 0.25 * dt * dt * along
    S[3, 2], S[4, 2], S[4, 3] = S[2, 3], S[2, 4], S[3, 4]


@compiled
def _tracking_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """Hessian of w' (p - p_ref, theta - theta_ref)."""
    for i in range(len(S)):
        for k in range(len(S)):
            S[i, k] = 0.0
    bend(v[2], w[0], w[1], 0, S)


dynamics = residual(Kernel(_dynamics, (SE2, CONTROL, SE2, 0), 3, name="dynamics", second=_dynamics_second))
"""``dynamics(x, u, x_next, dt)``: x_next - f(x, u), (n, 3) [m, m, rad] (Bazzana eq. 11-14)."""

tracking = residual(Kernel(_tracking, (SE2, (3,)), 3, name="tracking", second=_tracking_second))
"""``tracking(x, reference)``: deviation from a reference pose in world axes, (n, 3) [m, m, rad] (Bazzana eq. 8)."""

_change = difference.on(CONTROL).kernel
assert _change is not None
rate = residual(replace(_change, name="rate"))
"""``rate(u, u_next)``: change of control, (n, 2) [m/s, rad/s]."""
