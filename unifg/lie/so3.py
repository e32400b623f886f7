"""Rotations of space, stored as unit quaternions (w, x, y, z); Sola 2018, appendix B.

The formulas stand in :mod:`unifg.lie.scalar.so3`.
"""

from __future__ import annotations

import numpy as np

from unifg.errors import UnifgError
from unifg.lie.batch import over_one, over_two
from unifg.lie.manifold import LieGroup
from unifg.lie.scalar import so3
from unifg.typing import Array, ArrayLike, BoolArray

UNIT = 1e-9  # how far the norm of a valid quaternion may be from 1
AMBIGUOUS = 1e-14  # gap, over the largest singular value, below which the nearest rotation is anyone's guess

_exp = over_one(so3.exp, 3, 4)
_log = over_one(so3.log, 4, 3)
_compose = over_two(so3.compose, 4, 4, 4)
_inverse = over_one(so3.inverse, 4, 4)
_between = over_two(so3.between, 4, 4, 4)
_retract = over_two(so3.retract, 4, 3, 4)
_local = over_two(so3.local, 4, 4, 3)
_act = over_two(so3.act, 4, 3, 3)
_matrix = over_one(so3.matrix, 4, 3, 3)
_right_jacobian = over_one(so3.right_jacobian, 3, 3, 3)
_right_jacobian_inverse = over_one(so3.right_jacobian_inverse, 3, 3, 3)
_left_jacobian = over_one(so3.left_jacobian, 3, 3, 3)
_left_jacobian_inverse = over_one(so3.left_jacobian_inverse, 3, 3, 3)
_normalise = over_one(so3.normalise, 4, 4)
_from_matrix = over_one(so3.from_matrix, 9, 4)
_from_rpy = over_one(so3.from_rpy, 3, 4)
_to_rpy = over_one(so3.to_rpy, 4, 3)


class SO3Group(LieGroup):
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

    # Constructors, and back.

    def from_quaternion_wxyz(self, quaternion: ArrayLike, /) -> Array:
        """Return the elements of (..., 4) quaternions, scalar first, of any length and sign.

        Raises:
            UnifgError: when one has no direction (all zero, or not finite).
        """
        q = np.asarray(quaternion, dtype=np.float64)
        result = _normalise(q)
        bad = ~np.isfinite(result).all(axis=-1)
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            raise UnifgError(
                f"quaternion {index or ''} {q[index]} names no rotation: give one of non-zero, finite norm"
            )
        return result

    def from_quaternion_xyzw(self, quaternion: ArrayLike, /) -> Array:
        """Return the elements of (..., 4) quaternions, scalar last, of any length and sign.

        Raises:
            UnifgError: when one has no direction (all zero, or not finite).
        """
        return self.from_quaternion_wxyz(np.roll(np.asarray(quaternion, dtype=np.float64), 1, axis=-1))

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
        bad = ~np.isfinite(m).all(axis=(-2, -1))
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            raise UnifgError(f"matrix {index or ''} is not finite, so no rotation is near it: {m[index].tolist()}")
        u, scale, vt = np.linalg.svd(m)
        sign = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0.0, -1.0, 1.0)
        bad = ~(scale[..., 1] + sign * scale[..., 2] > AMBIGUOUS * scale[..., 0])
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            raise UnifgError(
                f"matrix {index or ''} has singular values {scale[index].tolist()} and no single nearest rotation: "
                "it fixes fewer than two directions"
            )
        u[..., :, 2] *= sign[..., None]
        rotation: Array = u @ vt
        return _from_matrix(rotation.reshape(*rotation.shape[:-2], 9))

    def from_rpy(self, roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike, /) -> Array:
        """Return ``Rz(yaw) Ry(pitch) Rx(roll)``, (..., 4), for angles [rad] of any shapes that broadcast."""
        return _from_rpy(np.stack(np.broadcast_arrays(roll, pitch, yaw), axis=-1))

    def to_quaternion_wxyz(self, x: ArrayLike, /) -> Array:
        """Return (..., 4) unit quaternions, scalar first, w >= 0."""
        return _normalise(x)

    def to_quaternion_xyzw(self, x: ArrayLike, /) -> Array:
        """Return (..., 4) unit quaternions, scalar last, w >= 0."""
        return np.roll(_normalise(x), -1, axis=-1)

    def to_matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) rotation matrices; the same as :meth:`matrix`."""
        return _matrix(x)

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

    def exp(self, d: ArrayLike, /) -> Array:
        """Map (..., 3) rotation vectors of any length; Sola eq. 101 and 132."""
        return _exp(d)

    def log(self, x: ArrayLike, /) -> Array:
        """Map to (..., 3) rotation vectors of length at most pi; Sola eq. 133, with the short way round."""
        return _log(x)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Chain: ``world_R_a`` and ``a_R_b`` give ``world_R_b``."""
        return _compose(x, y)

    def inverse(self, x: ArrayLike, /) -> Array:
        """Invert: the conjugate quaternion."""
        return _inverse(x)

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``x^-1 y``: y seen from x."""
        return _between(x, y)

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Return ``x Exp(d)``."""
        return _retract(x, d)

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``Log(x^-1 y)``, the short way round."""
        return _local(x, y)

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Rotate (..., 3) points [m]."""
        return _act(x, points)

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) rotation matrices."""
        return _matrix(x)

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) skew-symmetric matrices: ``hat(a) b`` is the cross product."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 3, 3))
        result[..., (2, 0, 1), (1, 2, 0)] = d
        result[..., (1, 2, 0), (2, 0, 1)] = -d
        return result

    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) adjoints: the rotation matrices; Sola eq. 139."""
        return _matrix(x)

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) small adjoints: the same as :meth:`hat`."""
        return self.hat(d)

    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) right Jacobians; Sola eq. 143."""
        return _right_jacobian(d)

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) inverse right Jacobians; Sola eq. 144; singular at an angle of 2 pi."""
        return _right_jacobian_inverse(d)

    def left_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) left Jacobians; Sola eq. 145."""
        return _left_jacobian(d)

    def left_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) inverse left Jacobians; Sola eq. 146; singular at an angle of 2 pi."""
        return _left_jacobian_inverse(d)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 4) rotations, uniform: the direction of four normal numbers."""
        return _normalise(rng.standard_normal((*shape, 4)))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., 4) vectors whether its norm is 1 to within 1e-9; either sign is valid."""
        return np.asarray(np.abs(np.linalg.norm(x, axis=-1) - 1.0) < UNIT)

    def __reduce__(self) -> str:
        """Pickle by name: there is one SO3."""
        return "SO3"


SO3 = SO3Group()
