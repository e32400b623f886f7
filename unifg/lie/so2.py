"""Rotations of the plane: storage ``(theta,)``, tangent ``(omega,)``; Sola 2018, appendix A."""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.lie.elementwise import over_one
from unifg.lie.manifold import CompiledGroup
from unifg.typing import Array, ArrayLike

PI = math.pi
TWO_PI = 2.0 * math.pi


@compiled
def wrap(theta: float) -> float:
    """Bring an angle [rad] into [-pi, pi), exactly.

    Angles already there come back bit for bit, and the result never leaves the interval: each step is a difference of
    two doubles within a factor two of each other, which is exact (Sterbenz). The usual shortcuts are not:
    ``remainder(theta + pi, 2 pi) - pi`` loses digits near zero, ``rint(theta / 2 pi)`` leaves the interval near pi.
    """
    rest = theta if abs(theta) < TWO_PI else without_turns(theta)
    turns = (1.0 if rest >= PI else 0.0) - (1.0 if rest < -PI else 0.0)  # selected, not branched on
    return rest - TWO_PI * turns


@compiled
def without_turns(theta: float) -> float:
    """Return what whole turns leave of an angle, in (-2 pi, 2 pi) and exact; NaN for what is not finite.

    This is ``fmod(theta, 2 pi)``, which the compiler would compute for every angle, needed or not.
    """
    rest = abs(theta)
    if not rest < math.inf:
        return math.nan
    turns = TWO_PI
    while turns <= 0.5 * rest:
        turns *= 2.0
    while turns >= TWO_PI:
        if rest >= turns:
            rest -= turns
        turns *= 0.5
    return -rest if theta < 0.0 else rest


@compiled
def exp(d: Array, out: Array) -> None:
    """Wrap; Sola eq. 114 to 116."""
    out[0] = wrap(d[0])


@compiled
def compose(x: Array, y: Array, out: Array) -> None:
    """Add and wrap."""
    out[0] = wrap(x[0] + y[0])


@compiled
def inverse(x: Array, out: Array) -> None:
    """Negate and wrap; Sola eq. 118."""
    out[0] = wrap(-x[0])


@compiled
def between(x: Array, y: Array, out: Array) -> None:
    """Subtract and wrap."""
    out[0] = wrap(y[0] - x[0])


@compiled
def act(x: Array, p: Array, out: Array) -> None:
    """Rotate a (2,) point."""
    c, s = math.cos(x[0]), math.sin(x[0])
    px, py = p[0], p[1]
    out[0] = c * px - s * py
    out[1] = s * px + c * py


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write the (2, 2) rotation matrix."""
    c, s = math.cos(x[0]), math.sin(x[0])
    out[0, 0] = c
    out[0, 1] = -s
    out[1, 0] = s
    out[1, 1] = c


@compiled
def unit(x: Array, out: Array) -> None:
    """Write 1; Sola eq. 123 and 126."""
    out[0, 0] = 1.0


log, retract, local = exp, compose, between
adjoint = right_jacobian = right_jacobian_inverse = unit


class SO2Group(CompiledGroup, methods=globals()):
    """Rotations of the plane; use the ready-made object ``SO2``.

    Storage is the angle ``(theta,)`` [rad], returned in [-pi, pi) by every operation and accepted with any
    finite value; tangent is ``(omega,)`` [rad]. The group is commutative: adjoint and Jacobians are 1.
    """

    name = "SO2"
    storage = 1
    dim = 1
    point_dim = 2
    matrix_dim = 2
    generators = np.array([[[0.0, -1.0], [1.0, 0.0]]])

    def identity(self) -> Array:
        """Return the zero angle, (1,)."""
        return np.zeros(1)

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 1) uniform angles in [-pi, pi)."""
        return rng.uniform(-PI, PI, (*shape, 1))


SO2 = SO2Group()


def wrap_angle(theta: ArrayLike, /) -> Array:
    """Bring angles of any shape [rad] into [-pi, pi), exactly: see :func:`wrap`."""
    return over_one(exp, 1, 1)(np.asarray(theta, dtype=np.float64)[..., None])[..., 0][()]
