"""Operations derived from the exponential, the logarithm, the product and the inverse of a group, for one element.

A group of one's own states these four; whatever else it does not state is made of them here, and nothing is
differenced. With Ad(x) d = Log(x Exp(d) x^-1), which holds for every d within the reach of the logarithm,

    Jr(d) = int_0^1 Ad(Exp(-s d)) ds

(Sola et al., arXiv:1812.01537, eq. 67 and Hall, *Lie Groups, Lie Algebras, and Representations*, theorem 5.4), an
integral of sines, cosines and polynomials of s that Gauss's rule knows to rounding for rotations up to a whole turn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from unifg.codegen.calls import local_matrix, local_vector
from unifg.codegen.jit import compiled
from unifg.lie.elementwise import Scalar
from unifg.typing import Array

REACH = 0.5  # length of the tangent vectors of which adjoints are read
_nodes, _weights = np.polynomial.legendre.leggauss(12)
NODES = tuple(float(node) for node in 0.5 * (1.0 + _nodes))  # in [0, 1]
WEIGHTS = tuple(float(weight) for weight in 0.5 * _weights)


class Rule(NamedTuple):
    """Rule that makes a function.

    Attributes:
        needs: names of the functions it is made of.
        make: of storage, dim and these functions.
    """

    needs: tuple[str, ...]
    make: Callable[..., Scalar]


def _between(storage: int, dim: int, inverse: Scalar, compose: Scalar) -> Scalar:
    @compiled
    def between(x: Array, y: Array, out: Array) -> None:
        """``x^-1 y``."""
        back = local_vector(storage)
        inverse(x, back)
        compose(back, y, out)

    return between


def _retract(storage: int, dim: int, exp: Scalar, compose: Scalar) -> Scalar:
    @compiled
    def retract(x: Array, d: Array, out: Array) -> None:
        """``x Exp(d)``."""
        step = local_vector(storage)
        exp(d, step)
        compose(x, step, out)

    return retract


def _local(storage: int, dim: int, between: Scalar, log: Scalar) -> Scalar:
    @compiled
    def local(x: Array, y: Array, out: Array) -> None:
        """``Log(x^-1 y)``."""
        seen = local_vector(storage)
        between(x, y, seen)
        log(seen, out)

    return local


def _adjoint(storage: int, dim: int, exp: Scalar, log: Scalar, compose: Scalar, inverse: Scalar) -> Scalar:
    @compiled
    def adjoint(x: Array, out: Array) -> None:
        """Columns ``Log(x Exp(d) x^-1)``."""
        back, step, moved, d = local_vector(storage), local_vector(storage), local_vector(storage), local_vector(dim)
        inverse(x, back)
        for j in range(dim):
            for k in range(dim):
                d[k] = REACH if k == j else 0.0
            exp(d, step)
            compose(x, step, moved)
            compose(moved, back, step)
            log(step, d)
            for k in range(dim):
                out[k, j] = d[k] / REACH

    return adjoint


def _right_jacobian(storage: int, dim: int, exp: Scalar, adjoint: Scalar) -> Scalar:
    @compiled
    def right_jacobian(d: Array, out: Array) -> None:
        """The integral of ``Ad(Exp(-s d))``."""
        back, moved, transport = local_vector(dim), local_vector(storage), local_matrix(dim, dim)
        out[:] = 0.0
        for n in range(len(NODES)):
            for k in range(dim):
                back[k] = -NODES[n] * d[k]
            exp(back, moved)
            adjoint(moved, transport)
            for i in range(dim):
                for k in range(dim):
                    out[i, k] += WEIGHTS[n] * transport[i, k]

    return right_jacobian


def _right_jacobian_inverse(storage: int, dim: int, right_jacobian: Scalar) -> Scalar:
    @compiled
    def right_jacobian_inverse(d: Array, out: Array) -> None:
        """Jr inverted."""
        forward = local_matrix(dim, dim)
        right_jacobian(d, forward)
        invert(forward, out)

    return right_jacobian_inverse


def _mirrored(storage: int, dim: int, right: Scalar) -> Scalar:
    @compiled
    def left(d: Array, out: Array) -> None:
        """The right one at -d."""
        back = local_vector(dim)
        for k in range(dim):
            back[k] = -d[k]
        right(back, out)

    return left


@compiled
def invert(a: Array, out: Array) -> None:
    """Write the inverse of ``a``, (n, n), which is overwritten: Gauss and Jordan's elimination with row pivots."""
    n = len(a)
    for i in range(n):
        for k in range(n):
            out[i, k] = 1.0 if i == k else 0.0
    for i in range(n):
        best = i
        for k in range(i + 1, n):
            if abs(a[k, i]) > abs(a[best, i]):
                best = k
        if best != i:
            for k in range(n):
                a[i, k], a[best, k] = a[best, k], a[i, k]
                out[i, k], out[best, k] = out[best, k], out[i, k]
        scale = 1.0 / a[i, i]
        for k in range(n):
            a[i, k] *= scale
            out[i, k] *= scale
        for row in range(n):
            factor = a[row, i]
            if row != i and factor != 0.0:
                for k in range(n):
                    a[row, k] -= factor * a[i, k]
                    out[row, k] -= factor * out[i, k]


RULES: Mapping[str, Rule] = {
    "between": Rule(("inverse", "compose"), _between),
    "retract": Rule(("exp", "compose"), _retract),
    "local": Rule(("between", "log"), _local),
    "adjoint": Rule(("exp", "log", "compose", "inverse"), _adjoint),
    "right_jacobian": Rule(("exp", "adjoint"), _right_jacobian),
    "right_jacobian_inverse": Rule(("right_jacobian",), _right_jacobian_inverse),
    "left_jacobian": Rule(("right_jacobian",), _mirrored),
    "left_jacobian_inverse": Rule(("right_jacobian_inverse",), _mirrored),
}
"""In an order in which all that is needed stands further up."""
