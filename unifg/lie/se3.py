"""Rigid motions of space, stored as (px, py, pz, qw, qx, qy, qz); Sola 2018, appendix D.

The formulas stand in :mod:`unifg.lie.scalar.se3`.
"""

from __future__ import annotations

import numpy as np

from unifg.errors import UnifgError
from unifg.lie.batch import over_one, over_two
from unifg.lie.manifold import LieGroup
from unifg.lie.scalar import se3
from unifg.lie.so3 import SO3
from unifg.typing import Array, ArrayLike, BoolArray

_exp = over_one(se3.exp, 6, 7)
_log = over_one(se3.log, 7, 6)
_compose = over_two(se3.compose, 7, 7, 7)
_inverse = over_one(se3.inverse, 7, 7)
_between = over_two(se3.between, 7, 7, 7)
_retract = over_two(se3.retract, 7, 6, 7)
_local = over_two(se3.local, 7, 7, 6)
_act = over_two(se3.act, 7, 3, 3)
_matrix = over_one(se3.matrix, 7, 4, 4)
_adjoint = over_one(se3.adjoint, 7, 6, 6)
_right_jacobian = over_one(se3.right_jacobian, 6, 6, 6)
_right_jacobian_inverse = over_one(se3.right_jacobian_inverse, 6, 6, 6)
_left_jacobian = over_one(se3.left_jacobian, 6, 6, 6)
_left_jacobian_inverse = over_one(se3.left_jacobian_inverse, 6, 6, 6)


class SE3Group(LieGroup):
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

    def from_matrix(self, m: ArrayLike, /) -> Array:
        """Return the poses of (..., 4, 4) homogeneous matrices, with the nearest rotation: ``SO3.from_matrix``.

        Raises:
            UnifgError: when the last row is not (0, 0, 0, 1) to within 1e-9, or no single rotation is nearest.
        """
        m = np.asarray(m, dtype=np.float64)
        if m.shape[-2:] != (4, 4):
            raise UnifgError(f"SE3.from_matrix takes (..., 4, 4) matrices; got shape {m.shape}")
        bad = ~(np.abs(m[..., 3, :] - (0.0, 0.0, 0.0, 1.0)) < 1e-9).all(axis=-1)
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            raise UnifgError(f"matrix {index or ''} ends with the row {m[index][3].tolist()}: it must be 0, 0, 0, 1")
        return self.from_parts(m[..., :3, 3], SO3.from_matrix(m[..., :3, :3]))

    def to_matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 4, 4) homogeneous matrices; the same as :meth:`matrix`."""
        return _matrix(x)

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

    def exp(self, d: ArrayLike, /) -> Array:
        """Map (..., 6) tangent vectors to poses; Sola eq. 172 and 174."""
        return _exp(d)

    def log(self, x: ArrayLike, /) -> Array:
        """Map (..., 7) poses to tangent vectors whose rotation is at most pi long; Sola eq. 173."""
        return _log(x)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Chain: ``world_T_a`` and ``a_T_b`` give ``world_T_b``; Sola eq. 171."""
        return _compose(x, y)

    def inverse(self, x: ArrayLike, /) -> Array:
        """Invert: ``a_T_b`` gives ``b_T_a``; Sola eq. 170."""
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
        """Bring (..., 3) points [m] from the body frame to the frame of the pose."""
        return _act(x, points)

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 4, 4) homogeneous matrices; Sola eq. 168."""
        return _matrix(x)

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., 4, 4) Lie algebra matrices ``[[omega]x, v; 0, 0]``; Sola eq. 169."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 4, 4))
        result[..., :3, :3] = SO3.hat(d[..., 3:])
        result[..., :3, 3] = d[..., :3]
        return result

    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return (..., 6, 6) adjoints ``[R, [p]x R; 0, R]``; Sola eq. 175."""
        return _adjoint(x)

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., 6, 6) small adjoints ``[[omega]x, [v]x; 0, [omega]x]``."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 6, 6))
        result[..., :3, :3] = result[..., 3:, 3:] = SO3.hat(d[..., 3:])
        result[..., :3, 3:] = SO3.hat(d[..., :3])
        return result

    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., 6, 6) right Jacobians; Sola eq. 179 at -d, with the block of eq. 180 in fewer terms."""
        return _right_jacobian(d)

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 6, 6) inverse right Jacobians, in closed form; singular at a rotation of 2 pi."""
        return _right_jacobian_inverse(d)

    def left_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., 6, 6) left Jacobians; Sola eq. 179 and 180."""
        return _left_jacobian(d)

    def left_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 6, 6) inverse left Jacobians; Sola eq. 179; singular at a rotation of 2 pi."""
        return _left_jacobian_inverse(d)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 7) poses: standard normal positions, uniform rotations."""
        return self.from_parts(rng.standard_normal((*shape, 3)), SO3.random(rng, shape))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., 7) vectors whether it is finite and its quaternion of unit norm to within 1e-9."""
        x = np.asarray(x, dtype=np.float64)
        return np.asarray(np.isfinite(x[..., :3]).all(axis=-1) & SO3.is_valid(x[..., 3:]))

    def __reduce__(self) -> str:
        """Pickle by name: there is one SE3."""
        return "SE3"


SE3 = SE3Group()
