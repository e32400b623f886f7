"""Rigid motions of space; Sola 2018, appendix D.

Storage ``(px, py, pz, qw, qx, qy, qz)``, tangent ``(vx, vy, vz, wx, wy, wz)``.

The algebra of SE(3) is that of SO(3) over the dual numbers ``omega + epsilon v``, with ``epsilon^2 = 0``: its small
adjoint is ``[W, V; 0, W]``, V = [v]x. A power series of it therefore has the block ``f(W)`` twice on the diagonal, and
above it the derivative of f at W in the direction V. So the blocks Q of Barfoot, *State Estimation for Robotics*,
eq. 7.86, and Sola eq. 180 are, with t = |omega|^2 and s = omega . v,

    Jr:     -b V + c (W V + V W) - b' s W + c' s W^2
    Jr^-1:   V/2 + k (W V + V W) + k' s W^2

where ' is d/dtheta over theta, in :mod:`unifg.lie.series`; W V + V W = omega v' + v omega' - 2 s I.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import UnifgError
from unifg.lie.manifold import CompiledGroup
from unifg.lie.series import b_slope, c_slope, c_value, k_slope, k_value, x_cot_x
from unifg.lie.so3 import (
    SO3,
    Order,
    coefficients,
    half_log,
    half_turn,
    require_all,
    rotate,
    write,
    write_matrix,
    write_polynomial,
    write_product,
)
from unifg.typing import Array, ArrayLike, BoolArray


@compiled
def turned(
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
    out[0], out[1], out[2] = turned(2.0 * s * s, c, wx, wy, wz, d[0], d[1], d[2])
    write(cosine, s * wx, s * wy, s * wz, out, 3)


@compiled
def write_log(w: float, x: float, y: float, z: float, px: float, py: float, pz: float, out: Array) -> None:
    """Write the logarithm of the pose with this quaternion and position, ``(Jl(omega)^-1 p, omega)``."""
    factor, half, g = half_log(w, x, y, z)
    wx, wy, wz = factor * x, factor * y, factor * z
    out[0], out[1], out[2] = turned(-0.5, k_value(4.0 * half * half, g), wx, wy, wz, px, py, pz)
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
    out[0], out[1], out[2] = rotate(w, a, b, c, y[0] - x[0], y[1] - x[1], y[2] - x[2])
    write_product(w, a, b, c, v, e, f, g, out, 3)


@compiled
def retract(x: Array, d: Array, out: Array) -> None:
    """``x Exp(d)``."""
    tx, ty, tz, w, a, b, c = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    wx, wy, wz = d[3], d[4], d[5]
    theta, cosine, s = half_turn(wx, wy, wz)
    third = c_value(theta, 2.0 * s * cosine * theta)
    vx, vy, vz = turned(2.0 * s * s, third, wx, wy, wz, d[0], d[1], d[2])
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
def right_jacobian(d: Array, out: Array) -> None:
    """Write Jr, (6, 6); Sola eq. 179 at -d, with the block of eq. 180 in fewer terms."""
    a, b, c = coefficients(d[3], d[4], d[5])
    t = d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
    write_dual(-b, c, -b_slope(t, a, b), c_slope(t, b, c), d, out)


@compiled
def right_jacobian_inverse(d: Array, out: Array) -> None:
    """Write Jr^-1, (6, 6); singular at a rotation of 2 pi."""
    t = d[3] * d[3] + d[4] * d[4] + d[5] * d[5]
    g = x_cot_x(0.5 * math.sqrt(t))
    write_dual(0.5, k_value(t, g), 0.0, k_slope(t, g), d, out)


def _rows(pose: ArrayLike) -> Array:
    """Poses as an array with a last axis of 7."""
    x = np.asarray(pose, dtype=np.float64)
    if x.shape[-1:] != (7,):
        raise UnifgError(f"poses are (..., 7) arrays, found shape {x.shape}")
    return x


class SE3Group(CompiledGroup, methods=globals()):
    """Rigid motions of space; use the ready-made object ``SE3``.

    Storage is ``(px, py, pz, qw, qx, qy, qz)``: the position [m], then a rotation as ``SO3`` stores it, unit norm and
    scalar first; every operation returns qw >= 0 and accepts either sign. Tangent is ``(vx, vy, vz, wx, wy, wz)``
    [m, rad], translation first. ``retract`` is the full exponential: a step with both translation and rotation moves
    along a screw.
    """

    name = "SE3"
    storage = 7
    dim = 6
    point_dim = 3
    matrix_dim = 4
    generators = np.zeros((6, 4, 4))  # [[omega]x, v; 0, 0]; Sola eq. 169
    generators[:3, :3, 3], generators[3:, :3, :3] = np.eye(3), SO3.generators

    # Constructors, and back.

    def from_parts(self, position: ArrayLike, rotation: ArrayLike, /) -> Array:
        """Join (..., 3) positions [m] and (..., 4) elements of ``SO3`` (of its constructors) to (..., 7) poses.

        Raises:
            UnifgError: when a last axis has another length.
        """
        p, q = np.asarray(position, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
        if p.shape[-1:] != (3,) or q.shape[-1:] != (4,):
            raise UnifgError(f"SE3.from_parts joins (..., 3) and (..., 4) arrays; got shapes {p.shape} and {q.shape}")
        result = np.empty((*np.broadcast_shapes(p.shape[:-1], q.shape[:-1]), 7))
        result[..., :3] = p
        result[..., 3:] = q
        return result

    def from_quaternion(self, pose: ArrayLike, /, *, order: Order) -> Array:
        """Return the elements of (..., 7) rows, position [m] then quaternion, as TUM and g2o files have them.

        Args:
            pose: (..., 7).
            order: of the quaternion, "xyzw" or "wxyz"; see ``SO3.from_quaternion``.

        Raises:
            UnifgError: as ``SO3.from_quaternion``, or when the last axis has another length than 7.
        """
        x = _rows(pose)
        return self.from_parts(x[..., :3], SO3.from_quaternion(x[..., 3:], order=order))

    def to_quaternion(self, x: ArrayLike, /, *, order: Order) -> Array:
        """Return (..., 7) rows, position [m] then unit quaternion with w >= 0 in the order "xyzw" or "wxyz"."""
        x = _rows(x)
        return self.from_parts(x[..., :3], SO3.to_quaternion(x[..., 3:], order=order))

    def from_matrix(self, m: ArrayLike, /) -> Array:
        """Return the poses of (..., 4, 4) homogeneous matrices, with the nearest rotation: ``SO3.from_matrix``.

        Raises:
            UnifgError: when the last row is not (0, 0, 0, 1) to within 1e-9, or no single rotation is nearest.
        """
        m = np.asarray(m, dtype=np.float64)
        if m.shape[-2:] != (4, 4):
            raise UnifgError(f"SE3.from_matrix takes (..., 4, 4) matrices; got shape {m.shape}")
        require_all(
            (np.abs(m[..., 3, :] - (0.0, 0.0, 0.0, 1.0)) < 1e-9).all(axis=-1),
            lambda index, at: f"matrix {at} ends with the row {m[index][3].tolist()}: it must be 0, 0, 0, 1",
        )
        return self.from_parts(m[..., :3, 3], SO3.from_matrix(m[..., :3, :3]))

    def to_matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 4, 4) homogeneous matrices; the same as :meth:`matrix`."""
        return self.matrix(x)

    def position(self, x: ArrayLike, /) -> Array:
        """Return the (..., 3) positions [m], as a view of an array."""
        return np.asarray(x, dtype=np.float64)[..., :3]

    def rotation(self, x: ArrayLike, /) -> Array:
        """Return the (..., 4) rotations, elements of ``SO3``, as a view of an array."""
        return np.asarray(x, dtype=np.float64)[..., 3:]

    # The group.

    def identity(self) -> Array:
        """Return (0, 0, 0, 1, 0, 0, 0)."""
        return np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 7) poses: standard normal positions, uniform rotations."""
        return self.from_parts(rng.standard_normal((*shape, 3)), SO3.random(rng, shape))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., 7) vectors whether it is finite and its quaternion of unit norm to within 1e-9."""
        x = np.asarray(x, dtype=np.float64)
        return np.asarray(np.isfinite(x[..., :3]).all(axis=-1) & SO3.is_valid(x[..., 3:]))


SE3 = SE3Group()
