"""The vector space R^n as a Lie group under addition: storage and tangent are the vector; Sola 2018, appendix E."""

from __future__ import annotations

import operator
from typing import Any, SupportsIndex

import numpy as np

from unifg.codegen.jit import compiled, in_order
from unifg.errors import UnifgError
from unifg.lie.elementwise import elementwise
from unifg.lie.manifold import LieGroup, identities
from unifg.typing import Array, ArrayLike


@in_order
def minus(a: float, b: float) -> float:
    """Return ``a - b`` as it stands: of (y - x) - b a compiler would make y - (x + b), which is rounded far out.

    It takes *both* to keep it from that, ``minus(minus(y, x), b)``: the liberties of either are enough.
    """
    return a - b


@compiled
def copy(x: Array, out: Array) -> None:
    """Copy: the exponential and the logarithm."""
    for i in range(len(x)):
        out[i] = x[i]


@compiled
def add(x: Array, y: Array, out: Array) -> None:
    """``x + y``."""
    for i in range(len(x)):
        out[i] = x[i] + y[i]


@compiled
def negate(x: Array, out: Array) -> None:
    """``-x``."""
    for i in range(len(x)):
        out[i] = -x[i]


@compiled
def subtract(x: Array, y: Array, out: Array) -> None:
    """``y - x``."""
    for i in range(len(x)):
        out[i] = minus(y[i], x[i])


@compiled
def unit(x: Array, out: Array) -> None:
    """Write an identity matrix of the size of ``out``: adjoints and Jacobians."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 1.0 if i == j else 0.0


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write the (n + 1, n + 1) homogeneous translation."""
    unit(x, out)
    out[:-1, -1] = x


def _copies(group: Any, x: ArrayLike) -> Array:
    return np.array(x, dtype=np.float64)


def _sums(group: Any, x: ArrayLike, y: ArrayLike) -> Array:
    return np.add(x, y, dtype=np.float64)


def _opposites(group: Any, x: ArrayLike) -> Array:
    return np.negative(x, dtype=np.float64)


def _differences(group: Any, x: ArrayLike, y: ArrayLike) -> Array:
    return np.subtract(y, x, dtype=np.float64)


def _units(group: Any, x: ArrayLike) -> Array:
    return identities(np.asarray(x), group.dim)


def _translations(group: Any, x: ArrayLike) -> Array:
    x = np.asarray(x, dtype=np.float64)
    result = identities(x, group.matrix_dim)
    result[..., :-1, -1] = x
    return result


class Rn(LieGroup):
    """Vectors of length n; equal n makes equal objects.

    Storage and tangent are the vector itself. ``act`` translates points of R^n. Batches are NumPy's, so that no loop is
    compiled for a new n.

    Raises:
        UnifgError: when n is below 1.
    """

    exp = log = elementwise(copy, _copies)
    compose = retract = act = elementwise(add, _sums)
    inverse = elementwise(negate, _opposites)
    between = local = elementwise(subtract, _differences)
    matrix = elementwise(matrix, _translations)
    adjoint = right_jacobian = right_jacobian_inverse = elementwise(unit, _units)
    left_jacobian = left_jacobian_inverse = elementwise(unit, _units)

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

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., n+1, n+1) matrices with ``d`` in the last column."""
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], self.matrix_dim, self.matrix_dim))
        result[..., :-1, -1] = d
        return result

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., n, n) zeros: translations commute."""
        return np.zeros((*np.shape(d)[:-1], self.dim, self.dim))

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, n) standard normal vectors."""
        return rng.standard_normal((*shape, self.dim))
