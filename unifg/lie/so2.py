"""Rotations of the plane, stored as one angle; Sola 2018, appendix A."""

from __future__ import annotations

import numpy as np

from unifg.lie.manifold import LieGroup, identities
from unifg.typing import Array, ArrayLike

PI = float(np.pi)
TWO_PI = 2.0 * PI


def wrap_angle(theta: ArrayLike, /) -> Array:
    """Bring angles of any shape [rad] into [-pi, pi).

    Angles already there come back bit for bit, and the result never leaves the interval: ``fmod`` is exact,
    and so is the difference of two doubles within a factor two of each other. The usual shortcuts are not:
    ``remainder(theta + pi, 2 pi) - pi`` loses digits near zero, ``rint(theta / 2 pi)`` leaves the interval
    near pi.
    """
    rest = np.fmod(theta, TWO_PI)
    turns = np.subtract(rest >= PI, rest < -PI, dtype=np.float64)
    wrapped: Array = rest - TWO_PI * turns
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
        return wrap_angle(d)

    def log(self, x: ArrayLike, /) -> Array:
        """Wrap (..., 1) angles; Sola eq. 115."""
        return wrap_angle(x)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Add angles and wrap."""
        return wrap_angle(np.add(x, y))

    def inverse(self, x: ArrayLike, /) -> Array:
        """Negate angles and wrap: -pi is its own inverse; Sola eq. 118."""
        return wrap_angle(np.negative(x))

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Subtract angles and wrap."""
        return wrap_angle(np.subtract(y, x))

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Add angles and wrap."""
        return wrap_angle(np.add(x, d))

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Subtract angles and wrap."""
        return wrap_angle(np.subtract(y, x))

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Rotate (..., 2) points [m]."""
        theta = np.asarray(x, dtype=np.float64)[..., 0]
        points = np.asarray(points, dtype=np.float64)
        px, py = points[..., 0], points[..., 1]
        c, s = np.cos(theta), np.sin(theta)
        first = c * px - s * py
        result = np.empty((*first.shape, 2))
        result[..., 0] = first
        result[..., 1] = s * px + c * py
        return result

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 2, 2) rotation matrices."""
        theta = np.asarray(x, dtype=np.float64)[..., 0]
        result = np.empty((*theta.shape, 2, 2))
        result[..., 0, 0] = result[..., 1, 1] = np.cos(theta)
        sine = np.sin(theta)
        result[..., 1, 0] = sine
        result[..., 0, 1] = -sine
        return result

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
