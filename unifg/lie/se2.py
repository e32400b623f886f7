"""Rigid motions of the plane: storage ``(x, y, theta)``, tangent ``(vx, vy, omega)``; Sola 2018, appendix C.

Everything is written with half angles h = theta / 2, because the matrix V of the exponential (eq. 158) is a scaled
rotation, ``V(theta) = (sin h / h) R(h)``, and ``V^-1 = (h cot h) I - h [1]x``. Neither form cancels near zero, so a
floor under |h| takes the place of the Taylor branch that (1 - cos theta) / theta needs.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.lie.manifold import CompiledGroup
from unifg.lie.series import c_value, k_value, sinc, sinc_and_cos, x_cot_x
from unifg.lie.so2 import PI, wrap
from unifg.typing import Array


@compiled
def exp(d: Array, out: Array) -> None:
    """Exponential; Sola eq. 156 and 158."""
    vx, vy, omega = d[0], d[1], d[2]
    half = 0.5 * omega
    scale, cosine = sinc_and_cos(half)
    c, s = scale * cosine, scale * scale * half
    out[0] = c * vx - s * vy
    out[1] = s * vx + c * vy
    out[2] = wrap(omega)


@compiled
def log(x: Array, out: Array) -> None:
    """Logarithm with omega in [-pi, pi); Sola eq. 157 and 158."""
    px, py, omega = x[0], x[1], wrap(x[2])
    half = 0.5 * omega
    g = x_cot_x(half)
    out[0] = g * px + half * py
    out[1] = g * py - half * px
    out[2] = omega


@compiled
def compose(x: Array, y: Array, out: Array) -> None:
    """``x y``; Sola eq. 155."""
    px, py, theta = x[0], x[1], x[2]
    qx, qy, turn = y[0], y[1], y[2]
    c, s = math.cos(theta), math.sin(theta)
    out[0] = px + (c * qx - s * qy)
    out[1] = py + (s * qx + c * qy)
    out[2] = wrap(theta + turn)


@compiled
def inverse(x: Array, out: Array) -> None:
    """``x^-1``; Sola eq. 154."""
    px, py, theta = x[0], x[1], x[2]
    c, s = math.cos(theta), math.sin(theta)
    out[0] = -c * px - s * py
    out[1] = s * px - c * py
    out[2] = wrap(-theta)


@compiled
def between(x: Array, y: Array, out: Array) -> None:
    """``x^-1 y``."""
    theta = x[2]
    dx, dy, turn = y[0] - x[0], y[1] - x[1], y[2] - theta
    c, s = math.cos(theta), math.sin(theta)
    out[0] = c * dx + s * dy
    out[1] = c * dy - s * dx
    out[2] = wrap(turn)


@compiled
def retract(x: Array, d: Array, out: Array) -> None:
    """``x Exp(d)``: the chord of the arc has length |v| sin(h)/h and direction theta + h."""
    px, py, theta = x[0], x[1], x[2]
    vx, vy, omega = d[0], d[1], d[2]
    half = 0.5 * omega
    scale = sinc(half)
    middle = theta + half
    c, s = scale * math.cos(middle), scale * math.sin(middle)
    out[0] = px + (c * vx - s * vy)
    out[1] = py + (s * vx + c * vy)
    out[2] = wrap(theta + omega)


@compiled
def local(x: Array, y: Array, out: Array) -> None:
    """``Log(x^-1 y)``: the chord turned back by theta + h, stretched by h / sin(h)."""
    theta = x[2]
    dx, dy, omega = y[0] - x[0], y[1] - x[1], wrap(y[2] - theta)
    half = 0.5 * omega
    stretch = 1.0 / sinc(half)
    middle = theta + half
    c, s = stretch * math.cos(middle), stretch * math.sin(middle)
    out[0] = c * dx + s * dy
    out[1] = c * dy - s * dx
    out[2] = omega


@compiled
def act(x: Array, p: Array, out: Array) -> None:
    """Bring a (2,) point from the body frame to the frame of the pose; Sola eq. 165."""
    tx, ty, theta = x[0], x[1], x[2]
    px, py = p[0], p[1]
    c, s = math.cos(theta), math.sin(theta)
    out[0] = tx + (c * px - s * py)
    out[1] = ty + (s * px + c * py)


@compiled
def with_column(c: float, s: float, first: float, second: float, out: Array) -> None:
    """Write ``[c, -s, first; s, c, second; 0, 0, 1]``."""
    out[0, 0] = c
    out[0, 1] = -s
    out[0, 2] = first
    out[1, 0] = s
    out[1, 1] = c
    out[1, 2] = second
    out[2, 0] = 0.0
    out[2, 1] = 0.0
    out[2, 2] = 1.0


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write the (3, 3) homogeneous matrix; Sola eq. 152."""
    with_column(math.cos(x[2]), math.sin(x[2]), x[0], x[1], out)


@compiled
def adjoint(x: Array, out: Array) -> None:
    """Write ``[R, -[1]x t; 0, 1]``, (3, 3); Sola eq. 159."""
    with_column(math.cos(x[2]), math.sin(x[2]), x[1], -x[0], out)


@compiled
def right_jacobian(d: Array, out: Array) -> None:
    """Write Jr, (3, 3); Sola eq. 163."""
    vx, vy, omega = d[0], d[1], d[2]
    half = 0.5 * omega
    s, cosine = sinc_and_cos(half)
    a = s * cosine  # sin omega / omega
    e = 0.5 * s * s  # (1 - cos omega) / omega^2
    f = omega * c_value(omega, a * omega)
    with_column(a, -omega * e, f * vx - e * vy, f * vy + e * vx, out)


@compiled
def right_jacobian_inverse(d: Array, out: Array) -> None:
    """Write Jr^-1, (3, 3), the map that RK-MK integrators call dexp^-1.

    ``[g, -h, k vx + vy/2; h, g, k vy - vx/2; 0, 0, 1]`` with h = omega / 2, g = h cot h and k = (1 - g) / omega,
    found by inverting Sola eq. 163. Singular at omega = +-2 pi, where Jr loses rank; ``log`` and ``local`` stay
    within pi.
    """
    vx, vy, omega = d[0], d[1], d[2]
    half = 0.5 * omega
    g = x_cot_x(half)
    k = omega * k_value(omega * omega, g)
    with_column(g, half, k * vx + 0.5 * vy, k * vy - 0.5 * vx, out)


class SE2Group(CompiledGroup, methods=globals()):
    """Rigid motions of the plane; use the ready-made object ``SE2``.

    Storage is ``(x, y, theta)`` [m, m, rad], theta returned in [-pi, pi) by every operation and accepted with
    any finite value. Tangent is ``(vx, vy, omega)`` [m, m, rad], translation first. ``retract`` is the full
    exponential: a step with both translation and rotation moves along an arc.
    """

    name = "SE2"
    storage = 3
    dim = 3
    point_dim = 2
    matrix_dim = 3
    generators = np.array(
        [
            [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
            [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]],
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    )

    def identity(self) -> Array:
        """Return the (3,) zero pose."""
        return np.zeros(3)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 3) poses: standard normal positions, uniform headings."""
        result = rng.standard_normal((*shape, 3))
        result[..., 2] = rng.uniform(-PI, PI, shape)
        return result


SE2 = SE2Group()
