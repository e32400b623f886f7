"""The quadrotor's velocity in the Lie algebra for any integrator of :mod:`unifg.models.rkmk`."""

from __future__ import annotations

from unifg.lie import so3
from unifg.machine.calls import local_matrix
from unifg.machine.jit import compiled
from unifg.models.compiled_field import CompiledField
from unifg.models.quadrotor_dynamics import acceleration, force_along_turn
from unifg.typing import Array

__all__ = ["field"]


@compiled
def _velocity(x: Array, u: Array, out: Array) -> None:
    """Inputs u = (omega, T, w_omega, w_a, mass, drag, wind, updraft)."""
    ax, ay, az = acceleration(x, 0, u[3], u[10], u[11], u[12], u[13])
    for i in range(3):
        out[i] = x[7 + i]
        out[3 + i] = u[i] + u[4 + i]
    out[6] = ax + u[14] + u[7]
    out[7] = ay + u[15] + u[8]
    out[8] = az + u[16] + u[9]


@compiled
def _derivative(x: Array, u: Array, by_x: Array, by_u: Array) -> None:
    R = local_matrix(3, 3)
    so3.write_matrix(x[3], x[4], x[5], x[6], R, 0)
    thrust, per, d0, d1, d2 = u[3], 1.0 / u[10], u[11], u[12], u[13]
    s0 = R[0, 0] * x[7] + R[1, 0] * x[8] + R[2, 0] * x[9]
    s1 = R[0, 1] * x[7] + R[1, 1] * x[8] + R[2, 1] * x[9]
    s2 = R[0, 2] * x[7] + R[1, 2] * x[8] + R[2, 2] * x[9]
    t01, t02, t10, t12, t20, t21 = force_along_turn(thrust, d0, d1, d2, s0, s1, s2)
    for i in range(9):
        for k in range(9):
            by_x[i, k] = 0.0
        for k in range(17):
            by_u[i, k] = 0.0
    for i in range(3):
        by_x[i, 6 + i] = by_u[3 + i, i] = by_u[3 + i, 4 + i] = by_u[6 + i, 7 + i] = by_u[6 + i, 14 + i] = 1.0
        a, b, c = per * R[i, 0], per * R[i, 1], per * R[i, 2]
        by_x[6 + i, 3] = b * t10 + c * t20
        by_x[6 + i, 4] = a * t01 + c * t21
        by_x[6 + i, 5] = a * t02 + b * t12
        for k in range(3):
            by_x[6 + i, 6 + k] = -(a * d0 * R[k, 0] + b * d1 * R[k, 1] + c * d2 * R[k, 2])
        by_u[6 + i, 3] = c
        by_u[6 + i, 10] = -per * (c * thrust - a * d0 * s0 - b * d1 * s1 - c * d2 * s2)
        by_u[6 + i, 11], by_u[6 + i, 12], by_u[6 + i, 13] = -a * s0, -b * s1, -c * s2


field = CompiledField(_velocity, 9, (4, 6, 1, 3, 2, 1), _derivative)
"""``field(x, u, w, mass, drag, wind, updraft)``: F, (n, 9), for :func:`unifg.models.rkmk.integrator` on ``STATE``.

The trapezoid made of it has the defect of :data:`unifg.models.quadrotor.disturbed_dynamics`, at several times the cost
and without second derivatives; the other integrators are there to compare with.
"""
