"""Rigid motions of the plane, stored as (x, y, theta); Sola 2018, appendix C.

The formulas stand in :mod:`unifg.lie.scalar.se2`.
"""

from __future__ import annotations

import numpy as np

from unifg.lie.batch import over_one, over_two
from unifg.lie.manifold import LieGroup
from unifg.lie.scalar import se2
from unifg.lie.scalar.so2 import PI
from unifg.typing import Array, ArrayLike

_exp = over_one(se2.exp, 3, 3)
_log = over_one(se2.log, 3, 3)
_compose = over_two(se2.compose, 3, 3, 3)
_inverse = over_one(se2.inverse, 3, 3)
_between = over_two(se2.between, 3, 3, 3)
_retract = over_two(se2.retract, 3, 3, 3)
_local = over_two(se2.local, 3, 3, 3)
_act = over_two(se2.act, 3, 2, 2)
_matrix = over_one(se2.matrix, 3, 3, 3)
_adjoint = over_one(se2.adjoint, 3, 3, 3)
_right_jacobian = over_one(se2.right_jacobian, 3, 3, 3)
_right_jacobian_inverse = over_one(se2.right_jacobian_inverse, 3, 3, 3)


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
        return _exp(d)

    def log(self, x: ArrayLike, /) -> Array:
        """Map (..., 3) poses to tangent vectors with omega in [-pi, pi); Sola eq. 157 and 158."""
        return _log(x)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Chain: ``world_T_a`` and ``a_T_b`` give ``world_T_b``; Sola eq. 155."""
        return _compose(x, y)

    def inverse(self, x: ArrayLike, /) -> Array:
        """Invert: ``a_T_b`` gives ``b_T_a``; Sola eq. 154."""
        return _inverse(x)

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``x^-1 y``: y seen from x."""
        return _between(x, y)

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Return ``x Exp(d)``: the chord of the arc has length |v| sin(h)/h and direction theta + h, h = omega/2."""
        return _retract(x, d)

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``Log(x^-1 y)``: the chord turned back by theta + h, stretched by h / sin(h)."""
        return _local(x, y)

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Bring (..., 2) points [m] from the body frame to the frame of the pose; Sola eq. 165."""
        return _act(x, points)

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., 3, 3) homogeneous matrices; Sola eq. 152."""
        return _matrix(x)

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
        return _adjoint(x)

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
        return _right_jacobian(d)

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., 3, 3) inverse right Jacobians, the map that RK-MK integrators call dexp^-1.

        ``[g, -h, k vx + vy/2; h, g, k vy - vx/2; 0, 0, 1]`` with h = omega / 2, g = h cot h and
        k = (1 - g) / omega, found by inverting Sola eq. 163. Singular at omega = +-2 pi, where Jr loses rank;
        ``log`` and ``local`` stay within pi.
        """
        return _right_jacobian_inverse(d)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 3) poses: standard normal positions, uniform headings."""
        result = rng.standard_normal((*shape, 3))
        result[..., 2] = rng.uniform(-PI, PI, shape)
        return result

    def __reduce__(self) -> str:
        """Pickle by name: there is one SE2."""
        return "SE2"


SE2 = SE2Group()
