"""The vector space R^n as a Lie group under addition; Sola 2018, appendix E."""

from __future__ import annotations

import operator
from typing import SupportsIndex

import numpy as np

from unifg.errors import UnifgError
from unifg.lie.manifold import LieGroup, identities
from unifg.typing import Array, ArrayLike


class Rn(LieGroup):
    """Vectors of length n; equal n makes equal objects.

    Storage and tangent are the vector itself. ``act`` translates points of R^n.

    Raises:
        UnifgError: when n is below 1.
    """

    def __init__(self, n: SupportsIndex) -> None:
        """Describe R^n."""
        size = operator.index(n)
        if size < 1:
            raise UnifgError(f"Rn({size}) has no directions to move in: give n >= 1")
        self.name = f"Rn({size})"
        self.storage = self.dim = self.point_dim = size
        self.matrix_dim = size + 1

    def identity(self) -> Array:
        """Return the (n,) zero vector."""
        return np.zeros(self.dim)

    def exp(self, d: ArrayLike, /) -> Array:
        """Copy (..., n) tangent vectors; the map is the identity."""
        return np.array(d, dtype=np.float64)

    def log(self, x: ArrayLike, /) -> Array:
        """Copy (..., n) vectors; the map is the identity."""
        return np.array(x, dtype=np.float64)

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Add."""
        return np.add(x, y, dtype=np.float64)

    def inverse(self, x: ArrayLike, /) -> Array:
        """Negate."""
        return np.negative(x, dtype=np.float64)

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``y - x``."""
        return np.subtract(y, x, dtype=np.float64)

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Return ``x + d``."""
        return np.add(x, d, dtype=np.float64)

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``y - x``."""
        return np.subtract(y, x, dtype=np.float64)

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Translate (..., n) points."""
        return np.add(x, points, dtype=np.float64)

    def matrix(self, x: ArrayLike, /) -> Array:
        """Return (..., n+1, n+1) homogeneous translations."""
        x = np.asarray(x, dtype=np.float64)
        result = identities(x, self.matrix_dim)
        result[..., :-1, -1] = x
        return result

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., n+1, n+1) matrices with ``d`` in the last column."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], self.matrix_dim, self.matrix_dim))
        result[..., :-1, -1] = d
        return result

    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return (..., n, n) identities."""
        return identities(np.asarray(x), self.dim)

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., n, n) zeros: translations commute."""
        return np.zeros((*np.shape(d)[:-1], self.dim, self.dim))

    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., n, n) identities."""
        return identities(np.asarray(d), self.dim)

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., n, n) identities."""
        return identities(np.asarray(d), self.dim)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, n) standard normal vectors."""
        return rng.standard_normal((*shape, self.dim))

    def _key(self) -> tuple[object, ...]:
        return (self.dim,)
