"""Rotations of the plane, stored as one angle; Sola 2018, appendix A."""

from __future__ import annotations

import numpy as np

from unifg.lie.batch import over_one, over_two
from unifg.lie.manifold import LieGroup, identities
from unifg.lie.scalar import so2
from unifg.lie.scalar.so2 import PI
from unifg.typing import Array, ArrayLike

_wrap = over_one(so2.exp, 1, 1)
_inverse = over_one(so2.inverse, 1, 1)
_add = over_two(so2.compose, 1, 1, 1)
_subtract = over_two(so2.between, 1, 1, 1)
_act = over_two(so2.act, 1, 2, 2)
_matrix = over_one(so2.matrix, 1, 2, 2)


def wrap_angle(theta: ArrayLike, /) -> Array:
    """Bring angles of any shape [rad] into [-pi, pi), exactly: see :func:`unifg.lie.scalar.so2.wrap`."""
    wrapped: Array = _wrap(np.asarray(theta, dtype=np.float64)[..., None])[..., 0][()]
    return wrapped


class SO2Group(LieGroup):
    """Rotations of the plane; use the ready-made object ``SO2``.

    Storage is the angle ``(theta,)`` [rad], returned in [-pi, pi) by every operation and accepted with any
    finite value; tangent is ``(omega,)`` [rad]. The group is commutative: adjoint and Jacobians are 1.
    """

    name = "SO2"
    storage = 1
    dim = 1
    point_dim = 2
    matrix_dim = 2

    def identity(self) -> Array:
        """Return the zero angle, (1,)."""
        return np.zeros(1)

    def exp(self, d: ArrayLike, /) -> Array:
        """Wrap (..., 1) angles; Sola eq. 114 and 116."""
        return _wrap(d)

    def log(self, x: ArrayLike, /) -> Array:
        """Wrap (..., 1) angles; Sola eq. 115."""
        return _wrap(x)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Add angles and wrap."""
        return _add(x, y)

    def inverse(self, x: ArrayLike, /) -> Array:
        """Negate angles and wrap: -pi is its own inverse; Sola eq. 118."""
        return _inverse(x)

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Subtract angles and wrap."""
        return _subtract(x, y)

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Add angles and wrap."""
        return _add(x, d)

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Subtract angles and wrap."""
        return _subtract(x, y)

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Rotate (..., 2) points [m]."""
        return _act(x, points)

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 2, 2) rotation matrices."""
        return _matrix(x)

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., 2, 2) skew-symmetric matrices."""
        omega = np.asarray(d, dtype=np.float64)[..., 0]
        result = np.zeros((*omega.shape, 2, 2))
        result[..., 1, 0] = omega
        result[..., 0, 1] = -omega
        return result

    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return (..., 1, 1) ones; Sola eq. 123."""
        return identities(np.asarray(x), 1)

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., 1, 1) zeros; the group commutes."""
        return np.zeros((*np.shape(d)[:-1], 1, 1))

    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., 1, 1) ones; Sola eq. 126."""
        return identities(np.asarray(d), 1)

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 1, 1) ones; Sola eq. 126."""
        return identities(np.asarray(d), 1)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 1) uniform angles in [-pi, pi)."""
        return rng.uniform(-PI, PI, (*shape, 1))

    def __reduce__(self) -> str:
        """Pickle by name: there is one SO2."""
        return "SO2"


SO2 = SO2Group()
