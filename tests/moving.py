"""Fields that depend on the state, with known motions: what the tests of the integrators integrate."""

from __future__ import annotations

from functools import cache

import numpy as np

import unifg as fg
from unifg.lie.functions import functions_of
from unifg.machine.calls import local_matrix, local_vector
from unifg.machine.jit import compiled
from unifg.models.compiled_field import CompiledField
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

    def derivative(self, x: Array, u: Array, w: Array) -> list[Array]:
        back = self.group.adjoint(self.group.inverse(x))
        count = max(len(x), len(u), len(w))
        by_x = self.group.ad((back @ w[:, :, None])[:, :, 0])
        unit = np.eye(self.group.dim)
        return [np.broadcast_to(part, (count, *unit.shape)) for part in (by_x, unit, back)]

    def after(self, x: Array, u: Array, w: Array, time: float) -> Array:
        moved: Array = self.group.compose(self.group.exp(time * w), self.group.retract(x, time * u))
        return moved


@cache
def compiled_carried(group: fg.LieGroup, derive: bool) -> CompiledField:
    """The same field for one state, its two inputs side by side."""
    functions = functions_of(group)
    assert functions is not None
    inverse, adjoint, dim, storage = functions.inverse, functions.adjoint, group.dim, group.storage

    @compiled
    def field(x: Array, u: Array, out: Array) -> None:
        pose, back = local_vector(storage), local_matrix(dim, dim)
        inverse(x, pose)
        adjoint(pose, back)
        for i in range(dim):
            out[i] = u[i]
            for j in range(dim):
                out[i] += back[i, j] * u[dim + j]

    structure = group.ad(np.eye(dim))  # ad(a) = sum of a_k structure[k], most of it zero
    places = tuple(tuple(int(place) for place in axis) for axis in np.nonzero(structure))
    numbers, (which, above, beside) = tuple(float(a) for a in structure[np.nonzero(structure)]), places

    @compiled
    def derivative(x: Array, u: Array, by_x: Array, by_u: Array) -> None:
        pose, back, moved = local_vector(storage), local_matrix(dim, dim), local_vector(dim)
        inverse(x, pose)
        adjoint(pose, back)
        by_x[:] = 0.0
        for k in range(dim):
            moved[k] = 0.0
            for j in range(dim):
                moved[k] += back[k, j] * u[dim + j]
            for j in range(dim):
                by_u[k, j] = 1.0 if j == k else 0.0
                by_u[k, dim + j] = back[k, j]
        for n in range(len(numbers)):
            by_x[above[n], beside[n]] += numbers[n] * moved[which[n]]

    return CompiledField(field, dim, (dim, dim), derivative if derive else None)


def drag_and_thrust(x: Array, u: Array) -> Array:
    """A body with thrust along its third axis, linear drag in its own axes, and a rate that follows the wind."""
    part, rotation = FLYER.unpack(x), fg.SO3.matrix(FLYER.unpack(x)["R"])
    axis = rotation[:, 2]  # of the world's third axis, in the body
    slip = np.einsum("nji,nj->ni", rotation, part["v"])
    force = np.einsum("nij,nj->ni", rotation, -np.array([0.3, 0.4, 0.5]) * slip) + u[:, 3:] * rotation[:, :, 2]
    rate = u[:, :3] + 0.8 * axis[:, [1, 2, 0]]
    return np.concatenate([part["v"], rate, force - [0.0, 0.0, 9.81]], axis=1)


def with_held_rate(x: Array, u: Array) -> Array:
    result = drag_and_thrust(x, u)
    result[:, 3:6] = u[:, :3]
    return result
