"""Fields that depend on the state, with known motions: what the tests of the integrators integrate."""

from __future__ import annotations

import numpy as np

import unifg as fg
from unifg.typing import Array

FLYER = fg.Product(p=fg.Rn(3), R=fg.SO3, v=fg.Rn(3))


class Carried:
    """F(x, u, w) = u + Ad(x^-1) w: a body velocity and a current that is constant in the world's frame.

    x' = x hat(F) = x hat(u) + hat(w) x has the solution Exp(t w) x_0 Exp(t u), on every group.
    """

    def __init__(self, group: fg.LieGroup) -> None:
        self.group = group

    def __call__(self, x: Array, u: Array, w: Array) -> Array:
        moved: Array = (self.group.adjoint(self.group.inverse(x)) @ w[:, :, None])[:, :, 0]
        return u + moved

    def after(self, x: Array, u: Array, w: Array, time: float) -> Array:
        return np.asarray(self.group.compose(self.group.exp(time * w), self.group.retract(x, time * u)))


def drag_and_thrust(x: Array, u: Array) -> Array:
    """A body with thrust along its third axis, linear drag in its own axes, and a rate that follows the wind."""
    part, rotation = FLYER.unpack(x), fg.SO3.matrix(FLYER.unpack(x)["R"])
    axis = rotation[:, 2]  # of the world's third axis, in the body
    slip = np.einsum("nji,nj->ni", rotation, part["v"])
    force = np.einsum("nij,nj->ni", rotation, -np.array([0.3, 0.4, 0.5]) * slip) + u[:, 3:] * rotation[:, :, 2]
    rate = u[:, :3] + 0.8 * axis[:, [1, 2, 0]]
    return np.concatenate([part["v"], rate, force - [0.0, 0.0, 9.81]], axis=1)
