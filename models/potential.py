"""Artificial potential fields around obstacles (Bazzana et al. 2022, eq. 9 and 10), and the vortex to search with.

The error of a pose at distance d from an obstacle is

    g(d) = k (1/near - 1/far)   d <= near            eq. 9; near is the paper's mu, far its rho
           k (1/d - 1/far)      near < d < far
           0                    far <= d

and the cost is half its weighted square. The slope of g jumps at both thresholds, that of g^2 at ``near`` only. Below
``near`` it is zero: nothing pushes a pose that starts inside an obstacle, and it may stay there. A clearance
constraint has neither defect (:mod:`unifg.models.obstacles`).

To overcome local minima the paper adds to the repulsive gradient a vector tangent to the equipotential contours. That
field is the gradient of no cost. Here it is a search Jacobian: off by default, used for the first
``search_iterations`` steps only, and no answer is judged by it.

The paper does not say which of the two tangents is meant. One sense for all poses, as in the vortex fields it cites,
pushes a trajectory that runs at an obstacle to one side before it and to the other side behind it, and may leave it
where it was; "aside" pushes all its poses to the side on which they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Literal, TypeAlias

import numpy as np

from unifg.errors import ModelError
from unifg.kernels.kernel import Kernel
from unifg.kernels.residuals import Residual, residual
from unifg.machine.calls import vector
from unifg.machine.jit import compiled
from unifg.typing import Array

SCALE = 0.075  # [m], the paper's k
NEAR = 0.05  # [m], its mu
FAR = 0.8  # [m], its rho
TINY = 1e-300

Sense: TypeAlias = Literal["circulate", "aside"]


@cache
def _kernel(distance: Callable[..., None], search: bool) -> Callable[..., None]:
    """Write g and its derivative, or what to search with; five numbers stand in front of the table of the distance."""

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        distance(v, p, vector(table, 5, len(table) - 5), r, J)
        scale, near, far, vortex, aside = table[0], table[1], table[2], table[3], table[4]
        for a in range(len(r)):
            slope = -scale / (r[a] * r[a]) if near < r[a] < far else 0.0
            if r[a] < near:
                r[a] = near
            if r[a] > far:
                r[a] = far
            r[a] = scale * (1.0 / r[a] - 1.0 / far)
            if len(J):
                for d in range(J.shape[1]):
                    J[a, d] *= slope
                if search:
                    # Components along and across the body: a quarter turn there is a quarter turn in the world.
                    along, across, weight = J[a, 0], J[a, 1], vortex
                    if aside != 0.0:
                        # The tangential part of a push, as strong as the repulsion, across the body and away.
                        side = -1.0 if across > 0.0 else 1.0
                        weight = -vortex * side * along / max(math.sqrt(along * along + across * across), TINY)
                    J[a, 0] -= weight * across
                    J[a, 1] += weight * along

    return kernel


def _kernels(distance: Kernel, numbers: list[float], name: str) -> tuple[Kernel, Kernel]:
    """The true kernel and the one to search with; both read one table."""
    table = np.concatenate([numbers, distance.table])
    true = replace(distance, function=_kernel(distance.function, False), table=table, name=name, second=None)
    return true, replace(true, function=_kernel(distance.function, True))


class _Potential:
    """The same for a distance without a kernel."""

    def __init__(self, distance: Residual, scale: float, near: float, far: float, vortex: float, sense: Sense) -> None:
        self.distance = distance
        self.scale = scale
        self.near = near
        self.far = far
        self.vortex = vortex
        self.sense = sense

    def __call__(self, *arguments: Array) -> Array:
        distance = np.clip(self.distance.function(*arguments), self.near, self.far)
        return self.scale * (1.0 / distance - 1.0 / self.far)

    def jacobian(self, *arguments: Array) -> list[Array]:
        assert self.distance.jacobian is not None
        distance = self.distance.function(*arguments)
        within = (distance > self.near) & (distance < self.far)
        slope = np.where(within, -self.scale / np.clip(distance, self.near, self.far) ** 2, 0.0)
        return [slope[:, :, None] * block for block in self.distance.jacobian(*arguments)]

    def search(self, *arguments: Array) -> list[Array]:
        """The Jacobian plus a multiple of the same turned a quarter to the left in the plane."""
        blocks = self.jacobian(*arguments)
        # Components along and across the body: a quarter turn there is a quarter turn in the world.
        along, across = blocks[0][:, :, 0], blocks[0][:, :, 1]
        weight: Array | float = self.vortex
        if self.sense == "aside":
            # The tangential part of a push, as strong as the repulsion, across the body and away from the obstacle.
            side = np.where(across > 0.0, -1.0, 1.0)
            weight = -self.vortex * side * along / np.maximum(np.hypot(along, across), TINY)
        pose = blocks[0].copy()
        pose[:, :, 0] -= weight * across
        pose[:, :, 1] += weight * along
        return [pose, *blocks[1:]]


def potential(
    distance: Residual,
    scale: float = SCALE,
    near: float = NEAR,
    far: float = FAR,
    vortex: float = 0.0,
    sense: Sense = "circulate",
) -> Residual:
    """Turn a distance into the repulsive error g of eq. 9 and 10, same shape.

    ``potential(disc_clearance)(x, centre, radius)`` keeps away from discs, ``potential(wall_distance(field))(x)`` from
    the walls of a map; with ``minimize``, whose ``sigma`` sets the weight.

    Args:
        distance: a residual of SE(2) poses with an attached Jacobian [m].
        scale: k [m], with which g has no unit.
        near: below this distance g is constant [m].
        far: beyond it g is zero [m].
        vortex: weight of the tangent vector in the search direction, relative to the repulsive gradient. It acts only
            in the first ``search_iterations`` of a solver; cost and derivatives do not know it.
        sense: "circulate" counter-clockwise around every obstacle, with a negative vortex clockwise; or "aside", to
            the side of the body on which the obstacle is not, to the left of one dead ahead.

    Raises:
        ModelError: when the thresholds are not 0 < near < far, the sense is unknown or its weight negative, or the
            distance has no Jacobian.
    """
    if not 0.0 < near < far:
        raise ModelError(f"potential: thresholds must be 0 < near < far, found near = {near}, far = {far}")
    if distance.jacobian is None:
        raise ModelError(f"potential: '{distance.name}' has no attached Jacobian: use fg.residual(function, jacobian)")
    if sense not in ("circulate", "aside") or (sense == "aside" and vortex < 0.0):
        raise ModelError(
            f"potential: sense must be 'circulate', or 'aside' with a positive vortex; found {sense!r}, {vortex}"
        )
    name = f"{distance.name} potential"
    if distance.kernel is not None:
        true, steered = _kernels(distance.kernel, [scale, near, far, vortex, float(sense == "aside")], name)
        return residual(true, search=steered if vortex != 0.0 else None)
    function = _Potential(distance, scale, near, far, vortex, sense)
    return residual(function, function.jacobian, name, function.search if vortex != 0.0 else None)
