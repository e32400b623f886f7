"""Rotations of the plane, one at a time: storage ``(theta,)``, tangent ``(omega,)``; Sola 2018, appendix A."""

from __future__ import annotations

import math

from unifg.machine.jit import compiled
from unifg.typing import Array

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
    """Wrap; Sola eq. 114 and 116."""
    out[0] = wrap(d[0])


@compiled
def log(x: Array, out: Array) -> None:
    """Wrap; Sola eq. 115."""
    out[0] = wrap(x[0])


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
def retract(x: Array, d: Array, out: Array) -> None:
    """Add and wrap."""
    out[0] = wrap(x[0] + d[0])


@compiled
def local(x: Array, y: Array, out: Array) -> None:
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
def adjoint(x: Array, out: Array) -> None:
    """Write 1; Sola eq. 123."""
    out[0, 0] = 1.0


@compiled
def right_jacobian(d: Array, out: Array) -> None:
    """Write 1; Sola eq. 126."""
    out[0, 0] = 1.0


@compiled
def right_jacobian_inverse(d: Array, out: Array) -> None:
    """Write 1; Sola eq. 126."""
    out[0, 0] = 1.0


@compiled
def left_jacobian(d: Array, out: Array) -> None:
    """Write 1; Sola eq. 126."""
    out[0, 0] = 1.0


@compiled
def left_jacobian_inverse(d: Array, out: Array) -> None:
    """Write 1; Sola eq. 126."""
    out[0, 0] = 1.0
