"""Rotations of space; Sola 2018, appendix B.

Storage is the unit quaternion ``(w, x, y, z)``, tangent the rotation vector ``(wx, wy, wz)``.

A quaternion and its negative are one rotation: results have w >= 0, arguments may have either sign. Results have unit
norm to within ``DRIFT / 2`` and rounding. With W = [omega]x and the angle theta = |omega|,

    Jr = I - b W + c W^2,        Jr^-1 = I + W / 2 + k W^2,

where b, c and k are the functions of the angle in :mod:`unifg.lie.series`. ``Jl`` has the other sign at W. The
logarithm reads the half angle from ``atan2(|v|, w)``, which is accurate at every angle, pi among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import UnifgError
from unifg.lie.elementwise import over_one
from unifg.lie.manifold import CompiledGroup
from unifg.lie.series import TINY, c_value, k_value, x_cot_x
from unifg.lie.so2 import wrap
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

Order: TypeAlias = Literal["wxyz", "xyzw"]
UNIT = 1e-9  # how far the norm of a valid quaternion may be from 1
AMBIGUOUS = 1e-14  # gap, over the largest singular value, below which the nearest rotation is anyone's guess
DRIFT = 4e-15  # of |q|^2; below it a product keeps its digits, so that a zero step changes none


@compiled
def write(w: float, x: float, y: float, z: float, out: Array, at: int) -> None:
    """Store a quaternion at ``out[at:at + 4]``, unit norm and w >= 0."""
    square = w * w + x * x + y * y + z * z
    scale = 1.0
    if abs(square - 1.0) > DRIFT:
        scale = 1.0 / math.sqrt(square)
    if w < 0.0:
        scale = -scale
    out[at] = scale * w
    out[at + 1] = scale * x
    out[at + 2] = scale * y
    out[at + 3] = scale * z


@compiled
def write_product(
    w: float, x: float, y: float, z: float, v: float, a: float, b: float, c: float, out: Array, at: int
) -> None:
    """Store the product of the quaternions ``(w, x, y, z)`` and ``(v, a, b, c)``."""
    write(
        w * v - x * a - y * b - z * c,
        w * a + x * v + y * c - z * b,
        w * b - x * c + y * v + z * a,
        w * c + x * b - y * a + z * v,
        out,
        at,
    )


@compiled
def rotate(w: float, x: float, y: float, z: float, px: float, py: float, pz: float) -> tuple[float, float, float]:
    """Turn a vector: ``p + 2 w (u x p) + 2 u x (u x p)`` with u = (x, y, z)."""
    cx, cy, cz = 2.0 * (y * pz - z * py), 2.0 * (z * px - x * pz), 2.0 * (x * py - y * px)
    return (
        px + (w * cx + (y * cz - z * cy)),
        py + (w * cy + (z * cx - x * cz)),
        pz + (w * cz + (x * cy - y * cx)),
    )


@compiled
def half_turn(wx: float, wy: float, wz: float) -> tuple[float, float, float]:
    """Return the angle, ``cos(theta / 2)`` and ``sin(theta / 2) / theta`` of a rotation vector."""
    theta = max(math.sqrt(wx * wx + wy * wy + wz * wz), TINY)
    half = 0.5 * theta
    return theta, math.cos(half), math.sin(half) / theta


@compiled
def half_log(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return what makes (x, y, z) the rotation vector, half the angle h <= pi / 2, and h cot(h).

    The factor has the sign of w: the short way round. The quaternion need not be of unit norm.
    """
    length = max(math.sqrt(x * x + y * y + z * z), TINY)
    cosine = abs(w)
    half = math.atan2(length, cosine)
    factor = 2.0 * half / length
    return (-factor if w < 0.0 else factor), half, half * cosine / length


@compiled
def coefficients(wx: float, wy: float, wz: float) -> tuple[float, float, float]:
    """Return a = sin(theta) / theta, b and c of a rotation vector."""
    theta, cosine, s = half_turn(wx, wy, wz)
    a = 2.0 * s * cosine
    return a, 2.0 * s * s, c_value(theta, a * theta)


@compiled
def write_polynomial(b: float, c: float, wx: float, wy: float, wz: float, out: Array, at: int) -> None:
    """Write ``I + b W + c W^2`` as the 3 by 3 block of ``out`` whose first entry is ``out[at, at]``."""
    xx, yy, zz = c * wx * wx, c * wy * wy, c * wz * wz
    xy, xz, yz = c * wx * wy, c * wx * wz, c * wy * wz
    bx, by, bz = b * wx, b * wy, b * wz
    out[at, at] = 1.0 - (yy + zz)
    out[at, at + 1] = xy - bz
    out[at, at + 2] = xz + by
    out[at + 1, at] = xy + bz
    out[at + 1, at + 1] = 1.0 - (xx + zz)
    out[at + 1, at + 2] = yz - bx
    out[at + 2, at] = xz - by
    out[at + 2, at + 1] = yz + bx
    out[at + 2, at + 2] = 1.0 - (xx + yy)


@compiled
def write_matrix(w: float, x: float, y: float, z: float, out: Array, at: int) -> None:
    """Write the rotation matrix ``I + 2 w U + 2 U^2``, U = [(x, y, z)]x, as a block of ``out``."""
    write_polynomial(2.0 * w, 2.0, x, y, z, out, at)


@compiled
def exp(d: Array, out: Array) -> None:
    """Exponential at any angle; Sola eq. 101 and 132."""
    wx, wy, wz = d[0], d[1], d[2]
    _, cosine, s = half_turn(wx, wy, wz)
    write(cosine, s * wx, s * wy, s * wz, out, 0)


@compiled
def log(x: Array, out: Array) -> None:
    """Logarithm of length at most pi; Sola eq. 133."""
    w, a, b, c = x[0], x[1], x[2], x[3]
    factor, _, _ = half_log(w, a, b, c)
    out[0] = factor * a
    out[1] = factor * b
    out[2] = factor * c


@compiled
def compose(x: Array, y: Array, out: Array) -> None:
    """``x y``: the product of the quaternions."""
    write_product(x[0], x[1], x[2], x[3], y[0], y[1], y[2], y[3], out, 0)


@compiled
def inverse(x: Array, out: Array) -> None:
    """``x^-1``: the conjugate."""
    write(x[0], -x[1], -x[2], -x[3], out, 0)


@compiled
def between(x: Array, y: Array, out: Array) -> None:
    """``x^-1 y``."""
    write_product(x[0], -x[1], -x[2], -x[3], y[0], y[1], y[2], y[3], out, 0)


@compiled
def retract(x: Array, d: Array, out: Array) -> None:
    """``x Exp(d)``."""
    wx, wy, wz = d[0], d[1], d[2]
    _, cosine, s = half_turn(wx, wy, wz)
    write_product(x[0], x[1], x[2], x[3], cosine, s * wx, s * wy, s * wz, out, 0)


@compiled
def local(x: Array, y: Array, out: Array) -> None:
    """``Log(x^-1 y)``, the short way round."""
    w, a, b, c = x[0], -x[1], -x[2], -x[3]
    v, e, f, g = y[0], y[1], y[2], y[3]
    qx = w * e + a * v + (b * g - c * f)
    qy = w * f + b * v + (c * e - a * g)
    qz = w * g + c * v + (a * f - b * e)
    factor, _, _ = half_log(w * v - a * e - b * f - c * g, qx, qy, qz)
    out[0] = factor * qx
    out[1] = factor * qy
    out[2] = factor * qz


@compiled
def act(x: Array, p: Array, out: Array) -> None:
    """Rotate a (3,) point."""
    out[0], out[1], out[2] = rotate(x[0], x[1], x[2], x[3], p[0], p[1], p[2])


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write the (3, 3) rotation matrix, which is the adjoint too; Sola eq. 139."""
    write_matrix(x[0], x[1], x[2], x[3], out, 0)


adjoint = matrix


@compiled
def right_jacobian(d: Array, out: Array) -> None:
    """Write Jr, (3, 3); Sola eq. 143."""
    _, b, c = coefficients(d[0], d[1], d[2])
    write_polynomial(-b, c, d[0], d[1], d[2], out, 0)


@compiled
def inverse_coefficient(wx: float, wy: float, wz: float) -> float:
    """Return k of a rotation vector."""
    t = wx * wx + wy * wy + wz * wz
    return k_value(t, x_cot_x(0.5 * math.sqrt(t)))


@compiled
def right_jacobian_inverse(d: Array, out: Array) -> None:
    """Write Jr^-1, (3, 3); Sola eq. 144; singular at an angle of 2 pi."""
    write_polynomial(0.5, inverse_coefficient(d[0], d[1], d[2]), d[0], d[1], d[2], out, 0)


@compiled
def normalise(x: Array, out: Array) -> None:
    """Bring a quaternion of any length to unit norm and w >= 0; one without direction gives NaN."""
    write(x[0], x[1], x[2], x[3], out, 0)


@compiled
def all_unit(numbers: Array, starts: IntArray) -> bool:
    """Test whether all quaternions that start at some places have norm 1 to within 1e-9."""
    for k in starts:
        size = math.sqrt(numbers[k] ** 2 + numbers[k + 1] ** 2 + numbers[k + 2] ** 2 + numbers[k + 3] ** 2)
        if not abs(size - 1.0) < UNIT:
            return False
    return True


@compiled
def from_matrix(m: Array, out: Array) -> None:
    """Store the quaternion of a rotation matrix, given as (9,) numbers row by row.

    The four products 4 q_i q_j of the largest component with all others are sums of entries; dividing by the largest
    loses no digits (Shepperd 1978, *Quaternion from rotation matrix*).
    """
    r00, r11, r22 = m[0], m[4], m[8]
    wx, wy, wz = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    xy, xz, yz = m[3] + m[1], m[2] + m[6], m[7] + m[5]
    trace = r00 + r11 + r22
    if trace >= r00 and trace >= r11 and trace >= r22:
        a, b, c, d = 1.0 + trace, wx, wy, wz
    elif r00 >= r11 and r00 >= r22:
        a, b, c, d = wx, 1.0 + r00 - r11 - r22, xy, xz
    elif r11 >= r22:
        a, b, c, d = wy, xy, 1.0 + r11 - r00 - r22, yz
    else:
        a, b, c, d = wz, xz, yz, 1.0 + r22 - r00 - r11
    scale = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
    write(scale * a, scale * b, scale * c, scale * d, out, 0)


@compiled
def from_rpy(angles: Array, out: Array) -> None:
    """Store ``Rz(yaw) Ry(pitch) Rx(roll)`` for angles (roll, pitch, yaw) [rad]."""
    roll, pitch, yaw = 0.5 * angles[0], 0.5 * angles[1], 0.5 * angles[2]
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    write(
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        out,
        0,
    )


@compiled
def to_rpy(x: Array, out: Array) -> None:
    """Write (roll, pitch, yaw) [rad], pitch in [-pi/2, pi/2], the others in [-pi, pi).

    With half angles, ``(w - y, x + z) = (cos p - sin p) (cos, sin)(roll/2 + yaw/2)`` and ``(w + y, x - z) =
    (cos p + sin p) (cos, sin)(roll/2 - yaw/2)``, p = pitch / 2; the product of the lengths is cos(pitch). This keeps
    all digits up to the pole, where one of the two pairs is noise that does not change the rotation.
    """
    w, a, b, c = x[0], x[1], x[2], x[3]
    plus, minus = math.atan2(a + c, w - b), math.atan2(a - c, w + b)
    cosine = math.hypot(w - b, a + c) * math.hypot(w + b, a - c)
    out[0] = wrap(plus + minus)
    out[1] = math.atan2(2.0 * (w * b - a * c), cosine)
    out[2] = wrap(plus - minus)


_normalise, _from_matrix = over_one(normalise, 4, 4), over_one(from_matrix, 9, 4)
_from_rpy, _to_rpy = over_one(from_rpy, 3, 4), over_one(to_rpy, 4, 3)


def require_all(good: BoolArray | np.bool_, message: Callable[[Any, str], str]) -> None:
    """Raise where something does not hold, with what ``message`` makes of the first index and of its text."""
    if not good.all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        raise UnifgError(message(index, f"{index or ''}"))


def _reordered(quaternion: ArrayLike, order: Order, by: int) -> Array:
    """(..., 4) with the scalar rolled from last to first (by 1) or back (by -1), if it is last in ``order``."""
    q = np.asarray(quaternion, dtype=np.float64)
    if order not in ("wxyz", "xyzw"):
        raise UnifgError(f"order= of a quaternion is 'wxyz' or 'xyzw', found {order!r}")
    if q.shape[-1:] != (4,):
        raise UnifgError(f"quaternions are (..., 4) arrays, found shape {q.shape}")
    return np.roll(q, by, axis=-1) if order == "xyzw" else q


class SO3Group(CompiledGroup, methods=globals()):
    """Rotations of space; use the ready-made object ``SO3``.

    Storage is the unit quaternion ``(w, x, y, z)``, scalar first, Hamilton's product. A quaternion and its negative are
    one rotation: every operation returns unit norm and w >= 0, and accepts either sign. Tangent is the rotation vector
    ``(wx, wy, wz)`` [rad]; ``log`` and ``local`` return the short one, of length at most pi. At pi itself, where the
    vector and its negative are one rotation, rounding decides. Make elements with the constructors ``from_...``, which
    spell their order.
    """

    name = "SO3"
    storage = 4
    dim = 3
    point_dim = 3
    matrix_dim = 3
    generators = np.array(
        [
            [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    )

    # Constructors, and back.

    def from_quaternion(self, quaternion: ArrayLike, /, *, order: Order) -> Array:
        """Return the elements of (..., 4) quaternions of any length and sign.

        Args:
            quaternion: (..., 4).
            order: "xyzw" for the scalar last, as in ROS, SciPy, TUM and g2o files; "wxyz" for the scalar first.

        Raises:
            UnifgError: when one has no direction (all zero, or not finite), or there is no such order.
        """
        q = _reordered(quaternion, order, 1)
        result = _normalise(q)
        require_all(
            np.isfinite(result).all(axis=-1),
            lambda index, at: f"quaternion {at} {q[index]} names no rotation: give one of non-zero, finite norm",
        )
        return result

    def from_matrix(self, m: ArrayLike, /) -> Array:
        """Return the rotations nearest to (..., 3, 3) matrices in the Frobenius norm.

        With the singular value decomposition ``m = U S V'`` it is ``U diag(1, 1, det(U V')) V'`` (Umeyama 1991,
        *Least-squares estimation of transformation parameters between two point patterns*, eq. 39 to 43): the
        projection that ends a chordal initialisation. A rotation matrix comes back as itself.

        Raises:
            UnifgError: when an entry is not finite, or two rotations are equally near.
        """
        m = np.asarray(m, dtype=np.float64)
        if m.shape[-2:] != (3, 3):
            raise UnifgError(f"SO3.from_matrix takes (..., 3, 3) matrices; got shape {m.shape}")
        require_all(
            np.isfinite(m).all(axis=(-2, -1)),
            lambda index, at: f"matrix {at} is not finite, so no rotation is near it: {m[index].tolist()}",
        )
        u, scale, vt = np.linalg.svd(m)
        sign = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0.0, -1.0, 1.0)
        require_all(
            scale[..., 1] + sign * scale[..., 2] > AMBIGUOUS * scale[..., 0],
            lambda index, at: (
                f"matrix {at} has singular values {scale[index].tolist()} and no single nearest rotation: it fixes "
                "fewer than two directions"
            ),
        )
        u[..., :, 2] *= sign[..., None]
        rotation: Array = u @ vt
        return _from_matrix(rotation.reshape(*rotation.shape[:-2], 9))

    def from_rpy(self, roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike, /) -> Array:
        """Return ``Rz(yaw) Ry(pitch) Rx(roll)``, (..., 4), for angles [rad] of any shapes that broadcast."""
        return _from_rpy(np.stack(np.broadcast_arrays(roll, pitch, yaw), axis=-1))

    def to_quaternion(self, x: ArrayLike, /, *, order: Order) -> Array:
        """Return (..., 4) unit quaternions, w >= 0, in the order "xyzw" or "wxyz"; see :meth:`from_quaternion`."""
        return _reordered(_normalise(x), order, -1)

    def to_matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) rotation matrices; the same as :meth:`matrix`."""
        return self.matrix(x)

    def to_rpy(self, x: ArrayLike, /) -> tuple[Array, Array, Array]:
        """Return roll, pitch and yaw [rad], (...) each: the arguments that :meth:`from_rpy` turns into ``x``.

        Pitch is in [-pi/2, pi/2], the others in [-pi, pi). At a pitch of +-pi/2 only the difference or the sum of roll
        and yaw is defined: that one is right, and so is the rotation.
        """
        angles = _to_rpy(x)
        return angles[..., 0], angles[..., 1], angles[..., 2]

    # The group.

    def identity(self) -> Array:
        """Return (1, 0, 0, 0)."""
        return np.array([1.0, 0.0, 0.0, 0.0])

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 4) rotations, uniform: the direction of four normal numbers."""
        return _normalise(rng.standard_normal((*shape, 4)))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., 4) vectors whether its norm is 1 to within 1e-9; either sign is valid."""
        x = np.asarray(x)
        return np.asarray(np.abs(np.sqrt(np.einsum("...i,...i->...", x, x)) - 1.0) < UNIT)


SO3 = SO3Group()
