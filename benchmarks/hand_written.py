"""Residuals with derivatives worked out and written by hand, as they shipped before they were derived: a yardstick."""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.calls import local_matrix, vector
from unifg.codegen.jit import compiled
from unifg.factors.kernel import Kernel
from unifg.lie import SE2, Rn, so3
from unifg.lie.rn import minus
from unifg.lie.so2 import wrap
from unifg.models.quadrotor import STATE
from unifg.models.vehicle import Vehicle
from unifg.typing import Array


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


@compiled
def _vehicle(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """v_next - v - dt / m_eq (f - resistance)."""
    dt, slope = p[0], p[1]
    gain = dt / table[0]
    road = table[1] * table[6] * (math.sin(slope) + table[2] * math.cos(slope))
    resistance = road + table[4] + (table[5] + table[3] * v[0]) * v[0]
    r[0] = v[2] - v[0] - gain * (v[1] - resistance)
    if len(J):
        J[0, 0] = gain * (table[5] + 2.0 * table[3] * v[0]) - 1.0
        J[0, 1] = -gain
        J[0, 2] = 1.0


@compiled
def _vehicle_second(v: Array, p: Array, table: Array, w: Array, S: Array) -> None:
    """The drag alone bends."""
    for i in range(len(S)):
        for k in range(len(S)):
            S[i, k] = 0.0
    S[0, 0] = w[0] * p[0] / table[0] * 2.0 * table[3]


@compiled
def _bearing_range(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Write bearing and range of v = (state, landmark), less those measured."""
    R = local_matrix(3, 3)
    so3.write_matrix(v[3], v[4], v[5], v[6], R, 0)
    dx, dy = v[10] - v[0], v[11] - v[1]
    length = math.hypot(dx, dy)
    r[0] = wrap(math.atan2(dy, dx) - math.atan2(R[1, 0], R[0, 0]) - p[0])
    r[1] = length - p[1]
    if len(J):
        for i in range(2):
            for k in range(11):
                J[i, k] = 0.0
        x, y = dx / length, dy / length
        J[0, 0], J[0, 1], J[0, 9], J[0, 10] = y / length, -x / length, -y / length, x / length
        J[1, 0], J[1, 1], J[1, 9], J[1, 10] = -x, -y, x, y
        per = 1.0 / (R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0])
        J[0, 4] = per * (R[0, 0] * R[1, 2] - R[1, 0] * R[0, 2])
        J[0, 5] = -per * (R[0, 0] * R[1, 1] - R[1, 0] * R[0, 1])


def vehicle(car: Vehicle) -> Kernel:
    """Of :func:`unifg.models.vehicle.dynamics`."""
    table = [car.equivalent_mass, car.mass, car.rolling, car.drag, car.drag_constant, car.drag_linear, car.gravity]
    arguments = Rn(1), Rn(1), Rn(1), 0, 0
    return Kernel(_vehicle, arguments, 1, np.array(table), "vehicle", second=_vehicle_second)


dynamics = Kernel(_dynamics, (SE2, Rn(2), SE2, 0), 3, name="dynamics", second=_dynamics_second)
tracking = Kernel(_tracking, (SE2, (3,)), 3, name="tracking", second=_tracking_second)
bearing_range = Kernel(_bearing_range, (STATE, Rn(2), (2,)), 2, name="bearing and range")
