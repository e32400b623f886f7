"""Pose of a body between two nodes, at which a measurement was taken.

Nodes x at time 0 and y at time h; s = t / h in [0, 1]. The geodesic moves with a constant velocity of the body,

    x(s) = x Exp(s Log(x^-1 y)),

and is off by up to a h^2 / 8 under an acceleration a. Where states know their velocities, cubics meet these at both
nodes and are off by h^4 / 384 of the fourth derivative. With a velocity w in the body's axes it is the cubic of
xi(t) = Log(x^-1 x(t)), whose slope is Jr^-1(xi) w: the mean of a Gaussian process with white noise on the acceleration
(Barfoot, Tong, Sarkka 2014, *Batch continuous-time trajectory estimation as exactly sparse Gaussian process
regression*; on groups Anderson and Barfoot 2015, *Full STEAM ahead*). With a velocity v in the world's axes the
position is a cubic and the orientation a geodesic.

All go the short way round: nodes have to be less than half a turn apart. Outside [0, 1] they extrapolate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from unifg.errors import ModelError
from unifg.lie import SE23, SO3, LieGroup, Manifold, Product, Rn
from unifg.typing import Array

__all__ = ["cubic", "geodesic"]

Interpolation: TypeAlias = Callable[[Array, Array, Array, Array], Array]
"""``between(x, y, s, h)``: (n, storage) states at the fractions s (n,) of steps of h (n,) [s] from x to y."""


def geodesic(manifold: Manifold) -> Interpolation:
    """``x [+] s (y [-] x)`` on any manifold; of products, component by component."""

    def constant_velocity(x: Array, y: Array, s: Array, h: Array) -> Array:
        return manifold.retract(x, np.reshape(s, (-1, 1)) * manifold.local(x, y))

    return constant_velocity


def cubic(manifold: Manifold) -> Interpolation:
    """Cubics that know the velocities; other components of a product move on geodesics.

    Args:
        manifold: a product with components ``pose``, a group, and ``velocity``, its velocity in the body's axes; or
            with ``p``, ``R`` and ``v``, the last a velocity in the world's axes; or SE23.

    Raises:
        ModelError: for another manifold.
    """
    if manifold == SE23:
        return _along_velocities(manifold, slice(0, 3), slice(3, 6))
    parts = {name: part.manifold for name, part in manifold.components.items()} if isinstance(manifold, Product) else {}
    pose, velocity = parts.get("pose"), parts.get("velocity")
    if isinstance(manifold, Product) and isinstance(pose, LieGroup) and velocity == Rn(pose.dim):
        return _along_twists(manifold, pose)
    if isinstance(manifold, Product) and (parts.get("p"), parts.get("R"), parts.get("v")) == (Rn(3), SO3, Rn(3)):
        return _along_velocities(manifold, manifold.component("p").storage, manifold.component("v").storage)
    raise ModelError(
        f"cubic needs velocities, which {manifold.name} has not: make it a product with components pose (a group) and "
        "velocity (Rn of the same dimension), or p, R, v (Rn(3), SO3, Rn(3)), or SE23; or use geodesic"
    )


def _along_twists(manifold: Product, pose: LieGroup) -> Interpolation:
    """Of poses and their velocities in the body's axes."""
    at, rates = manifold.component("pose").storage, manifold.component("velocity").storage

    def cubic_of_twists(x: Array, y: Array, s: Array, h: Array) -> Array:
        s, h = np.reshape(s, (-1, 1)), np.reshape(h, (-1, 1))
        between = manifold.retract(x, s * manifold.local(x, y))
        xi = pose.local(x[:, at], y[:, at])
        end = np.einsum("nij,nj->ni", pose.right_jacobian_inverse(xi), y[:, rates])
        moved, slope = _hermite(xi, x[:, rates], end, s, h)
        between[:, at] = pose.retract(x[:, at], moved)
        between[:, rates] = np.einsum("nij,nj->ni", pose.right_jacobian(moved), slope)
        return between

    return cubic_of_twists


def _along_velocities(manifold: Manifold, p: slice, v: slice) -> Interpolation:
    """Of positions and their velocities in the world's axes."""

    def cubic_of_positions(x: Array, y: Array, s: Array, h: Array) -> Array:
        s, h = np.reshape(s, (-1, 1)), np.reshape(h, (-1, 1))
        between = manifold.retract(x, s * manifold.local(x, y))
        moved, slope = _hermite(y[:, p] - x[:, p], x[:, v], y[:, v], s, h)
        between[:, p] = x[:, p] + moved
        between[:, v] = slope
        return between

    return cubic_of_positions


def _hermite(end: Array, slope: Array, end_slope: Array, s: Array, h: Array) -> tuple[Array, Array]:
    """The cubic from 0 to ``end`` with slopes [1/s] at both ends, and its own slope."""
    rise, t = end - h * slope, 1.0 - s
    last = h * (end_slope - slope)
    value = h * s * slope + s * s * (3.0 - 2.0 * s) * rise - s * s * t * last
    speed = slope + (6.0 * s * t * rise - s * (2.0 - 3.0 * s) * last) / h
    return value, speed
