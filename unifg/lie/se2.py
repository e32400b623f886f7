"""Rigid motions of the plane, stored as (x, y, theta); Sola 2018, appendix C.

Everything is written with half angles h = theta / 2, because the matrix V of the exponential (eq. 158) is a
scaled rotation, ``V(theta) = (sin h / h) R(h)``, and ``V^-1 = (h cot h) I - h [1]x``. Neither form cancels
near zero, so a floor under |h| replaces the Taylor branch that (1 - cos theta) / theta needs. Two Jacobian
entries do cancel; they have a series.
"""

from __future__ import annotations

import numpy as np

from unifg.lie.manifold import LieGroup
from unifg.lie.so2 import PI, wrap_angle
from unifg.typing import Array, ArrayLike

TINY = 1e-300  # below every half angle that matters: sin(TINY) / TINY == 1 exactly
SERIES_BELOW = 0.5  # [rad]; both series below are exact to rounding there


class SE2Group(LieGroup):
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

    def identity(self) -> Array:
        """Return the (3,) zero pose."""
        return np.zeros(3)

    def exp(self, d: ArrayLike, /) -> Array:
        """Map (..., 3) tangent vectors to poses; Sola eq. 156 and 158."""
        d = np.asarray(d, dtype=np.float64)
        vx, vy, omega = d[..., 0], d[..., 1], d[..., 2]
        half = 0.5 * omega
        scale = _sinc(half)
        c, s = scale * np.cos(half), scale * np.sin(half)
        return _assemble(c * vx - s * vy, s * vx + c * vy, wrap_angle(omega))

    def log(self, x: ArrayLike, /) -> Array:
        """Map (..., 3) poses to tangent vectors with omega in [-pi, pi); Sola eq. 157 and 158."""
        x = np.asarray(x, dtype=np.float64)
        px, py, omega = x[..., 0], x[..., 1], wrap_angle(x[..., 2])
        half = 0.5 * omega
        g = _x_cot_x(half)
        return _assemble(g * px + half * py, g * py - half * px, omega)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Chain: ``world_T_a`` and ``a_T_b`` give ``world_T_b``; Sola eq. 155."""
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        theta, yx, yy = x[..., 2], y[..., 0], y[..., 1]
        c, s = np.cos(theta), np.sin(theta)
        angle = wrap_angle(theta + y[..., 2])
        return _assemble(x[..., 0] + (c * yx - s * yy), x[..., 1] + (s * yx + c * yy), angle)

    def inverse(self, x: ArrayLike, /) -> Array:
        """Invert: ``a_T_b`` gives ``b_T_a``; Sola eq. 154."""
        x = np.asarray(x, dtype=np.float64)
        px, py, theta = x[..., 0], x[..., 1], x[..., 2]
        c, s = np.cos(theta), np.sin(theta)
        return _assemble(-c * px - s * py, s * px - c * py, wrap_angle(-theta))

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``x^-1 y``: y seen from x."""
        x = np.asarray(x, dtype=np.float64)
        delta = np.subtract(y, x)
        dx, dy, theta = delta[..., 0], delta[..., 1], x[..., 2]
        c, s = np.cos(theta), np.sin(theta)
        return _assemble(c * dx + s * dy, c * dy - s * dx, wrap_angle(delta[..., 2]))

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Return ``x Exp(d)``: the chord of the arc has length |v| sin(h)/h and direction theta + h."""
        x, d = np.asarray(x, dtype=np.float64), np.asarray(d, dtype=np.float64)
        theta, vx, vy, omega = x[..., 2], d[..., 0], d[..., 1], d[..., 2]
        half = 0.5 * omega
        middle = theta + half
        scale = _sinc(half)
        c, s = scale * np.cos(middle), scale * np.sin(middle)
        angle = wrap_angle(theta + omega)
        return _assemble(x[..., 0] + (c * vx - s * vy), x[..., 1] + (s * vx + c * vy), angle)

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``Log(x^-1 y)``: the chord turned back by theta + h, stretched by h / sin(h)."""
        x = np.asarray(x, dtype=np.float64)
        delta = np.subtract(y, x)
        dx, dy, omega = delta[..., 0], delta[..., 1], wrap_angle(delta[..., 2])
        half = 0.5 * omega
        middle = x[..., 2] + half
        scale = _sinc(half)
        c, s = np.cos(middle) / scale, np.sin(middle) / scale
        return _assemble(c * dx + s * dy, c * dy - s * dx, omega)

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Bring (..., 2) points [m] from the body frame to the frame of the pose; Sola eq. 165."""
        x, points = np.asarray(x, dtype=np.float64), np.asarray(points, dtype=np.float64)
        theta, px, py = x[..., 2], points[..., 0], points[..., 1]
        c, s = np.cos(theta), np.sin(theta)
        first = x[..., 0] + c * px - s * py
        result = np.empty((*first.shape, 2))
        result[..., 0] = first
        result[..., 1] = x[..., 1] + s * px + c * py
        return result

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) homogeneous matrices; Sola eq. 152."""
        x = np.asarray(x, dtype=np.float64)
        return self._with_column(np.cos(x[..., 2]), np.sin(x[..., 2]), x[..., 0], x[..., 1])

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) Lie algebra matrices; Sola eq. 153."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 3, 3))
        result[..., 1, 0] = d[..., 2]
        result[..., 0, 1] = -d[..., 2]
        result[..., :2, 2] = d[..., :2]
        return result

    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) adjoints ``[R, -[1]x t; 0, 1]``; Sola eq. 159."""
        x = np.asarray(x, dtype=np.float64)
        return self._with_column(np.cos(x[..., 2]), np.sin(x[..., 2]), x[..., 1], -x[..., 0])

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) small adjoints ``[omega [1]x, -[1]x v; 0, 0]``."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 3, 3))
        result[..., 1, 0] = d[..., 2]
        result[..., 0, 1] = -d[..., 2]
        result[..., 0, 2] = d[..., 1]
        result[..., 1, 2] = -d[..., 0]
        return result

    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) right Jacobians; Sola eq. 163."""
        d = np.asarray(d, dtype=np.float64)
        vx, vy, omega = d[..., 0], d[..., 1], d[..., 2]
        e = 0.5 * _sinc(0.5 * omega) ** 2  # (1 - cos omega) / omega^2
        f = _angle_minus_sine(omega)
        return self._with_column(_sinc(omega), -omega * e, f * vx - e * vy, f * vy + e * vx)

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) inverse right Jacobians, the map that RK-MK integrators call dexp^-1.

        ``[g, -h, k vx + vy/2; h, g, k vy - vx/2; 0, 0, 1]`` with h = omega / 2, g = h cot h and
        k = (1 - g) / omega, found by inverting Sola eq. 163. Singular at omega = +-2 pi, where Jr loses rank;
        ``log`` and ``local`` stay within pi.
        """
        d = np.asarray(d, dtype=np.float64)
        vx, vy, omega = d[..., 0], d[..., 1], d[..., 2]
        half = 0.5 * omega
        g = _x_cot_x(half)
        k = _one_minus_x_cot_x(half, g)
        return self._with_column(g, half, k * vx + 0.5 * vy, k * vy - 0.5 * vx)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 3) poses: standard normal positions, uniform headings."""
        result = rng.standard_normal((*shape, 3))
        result[..., 2] = rng.uniform(-PI, PI, shape)
        return result

    def __reduce__(self) -> str:
        """Pickle by name: there is one SE2."""
        return "SE2"

    @staticmethod
    def _with_column(c: Array, s: Array, first: Array, second: Array) -> Array:
        """Return (..., 3, 3) ``[c, -s, first; s, c, second; 0, 0, 1]``."""
        result = np.zeros((*np.shape(c), 3, 3))
        result[..., 0, 0] = c
        result[..., 0, 1] = -s
        result[..., 0, 2] = first
        result[..., 1, 0] = s
        result[..., 1, 1] = c
        result[..., 1, 2] = second
        result[..., 2, 2] = 1.0
        return result


def _assemble(x: Array, y: Array, theta: Array) -> Array:
    """Put three arrays of one shape side by side; np.stack takes three times as long on small batches."""
    result = np.empty((*np.shape(x), 3))
    result[..., 0] = x
    result[..., 1] = y
    result[..., 2] = theta
    return result


def _sinc(x: Array) -> Array:
    """Return sin(x) / x, with 1 at zero."""
    floored = np.maximum(np.abs(x), TINY)
    result: Array = np.sin(floored) / floored
    return result


def _x_cot_x(x: Array) -> Array:
    """Return x cot(x), with 1 at zero."""
    floored = np.maximum(np.abs(x), TINY)
    result: Array = floored / np.tan(floored)
    return result


def _angle_minus_sine(theta: Array) -> Array:
    """Return (theta - sin theta) / theta^2, by series where the difference cancels."""
    small = np.abs(theta) < SERIES_BELOW
    t = theta * theta
    series = theta * (1 / 6 - t * (1 / 120 - t * (1 / 5040 - t * (1 / 362880 - t * (1 / 39916800 - t / 6227020800)))))
    safe = np.where(small, 1.0, theta)
    result: Array = np.where(small, series, (safe - np.sin(safe)) / (safe * safe))
    return result


def _one_minus_x_cot_x(x: Array, x_cot_x: Array) -> Array:
    """Return (1 - x cot x) / (2 x), by series where the difference cancels."""
    small = np.abs(x) < 0.5 * SERIES_BELOW
    t = x * x
    tail = 1 / 9450 + t * (1 / 93555 + t * (691 / 638512875 + t * (2 / 18243225)))
    series = x * (1 / 6 + t * (1 / 90 + t * (1 / 945 + t * tail)))
    safe = np.where(small, 1.0, x)
    result: Array = np.where(small, series, (1.0 - x_cot_x) / (2.0 * safe))
    return result


SE2 = SE2Group()
