"""Rigid motions of space, one at a time; Sola 2018, appendix D.

Storage ``(px, py, pz, qw, qx, qy, qz)``, tangent ``(vx, vy, vz, wx, wy, wz)``.

The algebra of SE(3) is that of SO(3) over the dual numbers ``omega + epsilon v``, with ``epsilon^2 = 0``: its small
adjoint is ``[W, V; 0, W]``, V = [v]x. A power series of it therefore has the block ``f(W)`` twice on the diagonal, and
above it the derivative of f at W in the direction V. So the blocks Q of Barfoot, *State Estimation for Robotics*,
eq. 7.86, and Sola eq. 180 are, with t = |omega|^2 and s = omega . v,

    Jr:     -b V + c (W V + V W) - b' s W + c' s W^2
    Jr^-1:   V/2 + k (W V + V W) + k' s W^2

where ' is d/dtheta over theta, in :mod:`unifg.lie.scalar.series`; W V + V W = omega v' + v omega' - 2 s I.
"""

from __future__ import annotations

import math

from unifg.lie.scalar.series import b_slope, c_slope, c_value, k_slope, k_value, x_cot_x
from unifg.lie.scalar.so3 import (
    coefficients,
    half_log,
    half_turn,
    rotate,
    write,
    write_matrix,
    write_polynomial,
    write_product,
)
from unifg.machine.jit import compiled
from unifg.typing import Array


@compiled
def bend(
    b: float, c: float, wx: float, wy: float, wz: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return ``(I + b W + c W^2) (x, y, z)``."""
    ax, ay, az = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    return (
        x + b * ax + c * (wy * az - wz * ay),
        y + b * ay + c * (wz * ax - wx * az),
        z + b * az + c * (wx * ay - wy * ax),
    )


@compiled
def exp(d: Array, out: Array) -> None:
    """Exponential ``(Jl(omega) v, Exp(omega))``; Sola eq. 172 and 174."""
    wx, wy, wz = d[3], d[4], d[5]
    theta, cosine, s = half_turn(wx, wy, wz)
    c = c_value(theta, 2.0 * s * cosine * theta)
    px, py, pz = bend(2.0 * s * s, c, wx, wy, wz, d[0], d[1], d[2])
    out[0] = px
    out[1] = py
    out[2] = pz
    write(cosine, s * wx, s * wy, s * wz, out, 3)


@compiled
def write_log(w: float, x: float, y: float, z: float, px: float, py: float, pz: float, out: Array) -> None:
    """Write the logarithm of the pose with this quaternion and position, ``(Jl(omega)^-1 p, omega)``."""
    factor, half, g = half_log(w, x, y, z)
    wx, wy, wz = factor * x, factor * y, factor * z
    vx, vy, vz = bend(-0.5, k_value(4.0 * half * half, g), wx, wy, wz, px, py, pz)
    out[0] = vx
    out[1] = vy
    out[2] = vz
    out[3] = wx
    out[4] = wy
    out[5] = wz


@compiled
def log(x: Array, out: Array) -> None:
    """Logarithm with a rotation of at most pi; Sola eq. 173."""
    write_log(x[3], x[4], x[5], x[6], x[0], x[1], x[2], out)


@compiled
def compose(x: Array, y: Array, out: Array) -> None:
    """``x y``; Sola eq. 171."""
    tx, ty, tz, w, a, b, c = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    v, e, f, g = y[3], y[4], y[5], y[6]
    px, py, pz = rotate(w, a, b, c, y[0], y[1], y[2])
    out[0] = tx + px
    out[1] = ty + py
    out[2] = tz + pz
    write_product(w, a, b, c, v, e, f, g, out, 3)


@compiled
def inverse(x: Array, out: Array) -> None:
    """``x^-1``; Sola eq. 170."""
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    px, py, pz = rotate(w, a, b, c, x[0], x[1], x[2])
    out[0] = -px
    out[1] = -py
    out[2] = -pz
    write(w, a, b, c, out, 3)


@compiled
def between(x: Array, y: Array, out: Array) -> None:
    """``x^-1 y``."""
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    v, e, f, g = y[3], y[4], y[5], y[6]
    px, py, pz = rotate(w, a, b, c, y[0] - x[0], y[1] - x[1], y[2] - x[2])
    out[0] = px
    out[1] = py
    out[2] = pz
    write_product(w, a, b, c, v, e, f, g, out, 3)


@compiled
def retract(x: Array, d: Array, out: Array) -> None:
    """``x Exp(d)``."""
    tx, ty, tz, w, a, b, c = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    wx, wy, wz = d[3], d[4], d[5]
    theta, cosine, s = half_turn(wx, wy, wz)
    third = c_value(theta, 2.0 * s * cosine * theta)
    vx, vy, vz = bend(2.0 * s * s, third, wx, wy, wz, d[0], d[1], d[2])
    px, py, pz = rotate(w, a, b, c, vx, vy, vz)
    out[0] = tx + px
    out[1] = ty + py
    out[2] = tz + pz
    write_product(w, a, b, c, cosine, s * wx, s * wy, s * wz, out, 3)


@compiled
def local(x: Array, y: Array, out: Array) -> None:
    """``Log(x^-1 y)``, the short way round."""
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    v, e, f, g = y[3], y[4], y[5], y[6]
    px, py, pz = rotate(w, a, b, c, y[0] - x[0], y[1] - x[1], y[2] - x[2])
    qw = w * v - a * e - b * f - c * g
    qx = w * e + a * v + (b * g - c * f)
    qy = w * f + b * v + (c * e - a * g)
    qz = w * g + c * v + (a * f - b * e)
    write_log(qw, qx, qy, qz, px, py, pz, out)


@compiled
def act(x: Array, p: Array, out: Array) -> None:
    """Bring a (3,) point from the body frame to the frame of the pose."""
    tx, ty, tz = x[0], x[1], x[2]
    px, py, pz = rotate(x[3], x[4], x[5], x[6], p[0], p[1], p[2])
    out[0] = tx + px
    out[1] = ty + py
    out[2] = tz + pz


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write the (4, 4) homogeneous matrix; Sola eq. 168."""
    write_matrix(x[3], x[4], x[5], x[6], out, 0)
    for i in range(3):
        out[i, 3] = x[i]
        out[3, i] = 0.0
    out[3, 3] = 1.0


@compiled
def adjoint(x: Array, out: Array) -> None:
    """Write ``[R, [p]x R; 0, R]``, (6, 6); Sola eq. 175."""
    px, py, pz = x[0], x[1], x[2]
    write_matrix(x[3], x[4], x[5], x[6], out, 0)
    for j in range(3):
        rx, ry, rz = out[0, j], out[1, j], out[2, j]
        out[3, j + 3] = rx
        out[4, j + 3] = ry
        out[5, j + 3] = rz
        out[0, j + 3] = py * rz - pz * ry
        out[1, j + 3] = pz * rx - px * rz
        out[2, j + 3] = px * ry - py * rx
        out[3, j] = 0.0
        out[4, j] = 0.0
        out[5, j] = 0.0


@compiled
def write_dual(b: float, c: float, b_rate: float, c_rate: float, d: Array, out: Array) -> None:
    """Write ``f(ad(d))`` for ``f(W) = I + b W + c W^2``, whose coefficients have the slopes given (over theta)."""
    vx, vy, vz, wx, wy, wz = d[0], d[1], d[2], d[3], d[4], d[5]
    write_polynomial(b, c, wx, wy, wz, out, 0)
    for i in range(3):
        for j in range(3):
            out[i + 3, j + 3] = out[i, j]
            out[i + 3, j] = 0.0
    s = wx * vx + wy * vy + wz * vz
    second, first = c_rate * s, b_rate * s
    xx, yy, zz = second * wx * wx, second * wy * wy, second * wz * wz
    xy = second * wx * wy + c * (wx * vy + wy * vx)
    xz = second * wx * wz + c * (wx * vz + wz * vx)
    yz = second * wy * wz + c * (wy * vz + wz * vy)
    ox, oy, oz = b * vx + first * wx, b * vy + first * wy, b * vz + first * wz
    twice = 2.0 * c
    out[0, 3] = -twice * (wy * vy + wz * vz) - (yy + zz)
    out[0, 4] = xy - oz
    out[0, 5] = xz + oy
    out[1, 3] = xy + oz
    out[1, 4] = -twice * (wx * vx + wz * vz) - (xx + zz)
    out[1, 5] = yz - ox
    out[2, 3] = xz - oy
    out[2, 4] = yz + ox
    out[2, 5] = -twice * (wx * vx + wy * vy) - (xx + yy)


@compiled
def _jacobian(sign: float, d: Array, out: Array) -> None:
    """Write Jl for sign 1, Jr for sign -1."""
    a, b, c = coefficients(d[3], d[4], d[5])
    t = d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
    write_dual(sign * b, c, sign * b_slope(t, a, b), c_slope(t, b, c), d, out)


@compiled
def _jacobian_inverse(sign: float, d: Array, out: Array) -> None:
    """Write Jl^-1 for sign 1, Jr^-1 for sign -1."""
    t = d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
    g = x_cot_x(0.5 * math.sqrt(t))
    write_dual(-0.5 * sign, k_value(t, g), 0.0, k_slope(t, g), d, out)


@compiled
def right_jacobian(d: Array, out: Array) -> None:
    """Write Jr, (6, 6); Sola eq. 179 at -d."""
    _jacobian(-1.0, d, out)


@compiled
def right_jacobian_inverse(d: Array, out: Array) -> None:
    """Write Jr^-1, (6, 6); singular at a rotation of 2 pi."""
    _jacobian_inverse(-1.0, d, out)


@compiled
def left_jacobian(d: Array, out: Array) -> None:
    """Write Jl, (6, 6); Sola eq. 179 and 180."""
    _jacobian(1.0, d, out)


@compiled
def left_jacobian_inverse(d: Array, out: Array) -> None:
    """Write Jl^-1, (6, 6); Sola eq. 179; singular at a rotation of 2 pi."""
    _jacobian_inverse(1.0, d, out)
