"""How the inverse right Jacobian changes: derivatives of ``Jr^-1(d) v`` along d, one at a time, in closed form.

Runge-Kutta-Munthe-Kaas methods have dexp^-1 = Jr^-1 in their equations, and so this matrix in their Jacobians. Column j
of ``group(d, v, out)`` is the derivative along ``d_j`` at a fixed v. With W = [omega]x, t = |omega|^2 and k of
:mod:`unifg.lie.scalar.series`, on SO(3)

    Jr^-1(omega) y = y + omega x y / 2 + k (omega (omega . y) - t y),
    D(omega, y) = -[y]x / 2 + k ((omega . y) I + omega y' - 2 y omega') + k' (omega (omega . y) - t y) omega',

where ' on k is d/dtheta over theta. On SE(3) ``Jr^-1 (y, z) = (Jr^-1(omega) y + D(omega, z) v, Jr^-1(omega) z)`` for
d = (v, omega), because its algebra is that of SO(3) over the dual numbers; so D(omega, z) v is differentiated again.
"""

from __future__ import annotations

import math

from unifg.lie.scalar.series import SERIES_BELOW, k_slope, k_value, x_cot_x
from unifg.machine.calls import vector
from unifg.machine.jit import compiled
from unifg.typing import Array


@compiled
def k_curve(t: float, g: float, slope: float) -> float:
    """Return (k' / theta)' / theta given g = h cot h and k' / theta; the series lacks a term below 1e-17."""
    if t < SERIES_BELOW:
        tail = 1 / 622702080 + t * (3617 / 63515612160000 + t * (43867 / 22808456326656000))
        return 1 / 3780 + t * (1 / 50400 + t * (1 / 997920 + t * (691 / 16345929600 + t * tail)))
    g_rate = (g - g * g - 0.25 * t) / (2.0 * t)  # by t
    return 2.0 * (((2.0 * g + 1.0) * g_rate + 0.25) / (t * t) - 2.0 * slope / t)


@compiled
def none(d: Array, v: Array, out: Array) -> None:
    """Write zeros, (n, n): commutative groups have Jr^-1 = I."""
    out[:] = 0.0


@compiled
def se2(d: Array, v: Array, out: Array) -> None:
    """Write the (3, 3) derivative for d = (vx, vy, omega)."""
    vx, vy, omega = d[0], d[1], d[2]
    a, b, turn = v[0], v[1], v[2]
    t = omega * omega
    g = x_cot_x(0.5 * omega)
    value, slope = k_value(t, g), k_slope(t, g)
    k, k_rate = omega * value, value + t * slope  # of omega k
    g_rate = -omega * (2.0 * value + t * slope)  # g = 1 - t k
    out[0, 0] = k * turn
    out[0, 1] = 0.5 * turn
    out[0, 2] = g_rate * a - 0.5 * b + k_rate * vx * turn
    out[1, 0] = -0.5 * turn
    out[1, 1] = k * turn
    out[1, 2] = 0.5 * a + g_rate * b + k_rate * vy * turn
    out[2, 0] = out[2, 1] = out[2, 2] = 0.0


@compiled
def write_turn(k: float, slope: float, w: Array, y: Array, out: Array, row: int, column: int) -> None:
    """Write D(w, y), (3, 3), as a block of ``out``."""
    along = w[0] * y[0] + w[1] * y[1] + w[2] * y[2]
    t = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    for i in range(3):
        second = slope * (w[i] * along - t * y[i])
        for j in range(3):
            out[row + i, column + j] = k * (w[i] * y[j] - 2.0 * y[i] * w[j]) + second * w[j]
        out[row + i, column + i] += k * along
    x0, x1, x2 = 0.5 * y[0], 0.5 * y[1], 0.5 * y[2]
    out[row, column + 1] += x2
    out[row, column + 2] -= x1
    out[row + 1, column] -= x2
    out[row + 1, column + 2] += x0
    out[row + 2, column] += x1
    out[row + 2, column + 1] -= x0


@compiled
def so3(d: Array, v: Array, out: Array) -> None:
    """Write D(d, v), (3, 3)."""
    t = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    g = x_cot_x(0.5 * math.sqrt(t))
    write_turn(k_value(t, g), k_slope(t, g), d, v, out, 0, 0)


@compiled
def se3(d: Array, v: Array, out: Array) -> None:
    """Write the (6, 6) derivative for d = (v, omega) and a vector (y, z)."""
    p, w, y, z = vector(d, 0, 3), vector(d, 3, 3), vector(v, 0, 3), vector(v, 3, 3)
    t = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    g = x_cot_x(0.5 * math.sqrt(t))
    k, slope = k_value(t, g), k_slope(t, g)
    curve = k_curve(t, g, slope)
    write_turn(k, slope, w, z, out, 0, 0)
    write_turn(k, slope, w, y, out, 0, 3)
    write_turn(k, slope, w, z, out, 3, 3)
    wz = w[0] * z[0] + w[1] * z[1] + w[2] * z[2]
    wp = w[0] * p[0] + w[1] * p[1] + w[2] * p[2]
    pz = p[0] * z[0] + p[1] * z[1] + p[2] * z[2]
    for i in range(3):
        square = w[i] * wz - t * z[i]  # W^2 z
        first = slope * (p[i] * wz + w[i] * pz - 2.0 * z[i] * wp) + curve * wp * square
        for j in range(3):
            out[3 + i, j] = 0.0
            out[i, 3 + j] += k * (p[i] * z[j] - 2.0 * z[i] * p[j]) + first * w[j] + slope * square * p[j]
            out[i, 3 + j] += slope * wp * (w[i] * z[j] - 2.0 * z[i] * w[j])
        out[i, 3 + i] += k * pz + slope * wp * wz
