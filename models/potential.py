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

from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import ModelError, require_kinds
from unifg.factors.residuals import Residual
from unifg.models.profile import of_distance
from unifg.typing import Array

__all__ = ["potential"]

SCALE = 0.075  # [m], the paper's k
NEAR = 0.05  # [m], its mu
FAR = 0.8  # [m], its rho
TINY = 1e-300

Sense: TypeAlias = Literal["circulate", "aside"]


@compiled
def _repulsion(d: float, numbers: Array) -> tuple[float, float]:
    """Return g and its slope; the numbers are scale, near and far."""
    scale, near, far = numbers[0], numbers[1], numbers[2]
    slope = -scale / (d * d) if near < d < far else 0.0
    if d < near:
        d = near
    if d > far:
        d = far
    return scale * (1.0 / d - 1.0 / far), slope


def _push(scale: float, near: float, far: float, d: Array) -> Array:
    return scale * (1.0 / np.clip(d, near, far) - 1.0 / far)


def _slope(scale: float, near: float, far: float, d: Array) -> Array:
    return np.where((near < d) & (d < far), -scale / (d * d), 0.0)


class _Search:
    """Derivatives along a pose, (n, m, 3), plus a multiple of the same turned a quarter to the left in the plane."""

    def __init__(self, true: Residual, vortex: float, aside: bool) -> None:
        self.true, self.vortex, self.aside = true, vortex, aside

    def __call__(self, *arguments: Array) -> list[Array]:
        assert self.true.jacobian is not None
        pose, *rest = self.true.jacobian(*arguments)
        # Components along and across the body: a quarter turn there is a quarter turn in the world.
        along, across, weight = pose[:, :, 0], pose[:, :, 1], np.full(pose.shape[:2], self.vortex)
        if self.aside:
            # The tangential part of a push, as strong as the repulsion, across the body and away.
            side = np.where(across > 0.0, -1.0, 1.0)
            weight = -self.vortex * side * along / np.maximum(np.hypot(along, across), TINY)
        return [np.stack([along - weight * across, across + weight * along, pose[:, :, 2]], axis=2), *rest]


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
        ModelError: when the thresholds are not 0 < near < far or the scale not positive, the sense is unknown or its
            weight negative, or the distance has no Jacobian.
    """
    require_kinds("potential", ModelError, potential.__annotations__, locals(), Residual)
    if not (0.0 < near < far and scale > 0.0 and np.isfinite(vortex)):
        found = f"near = {near}, far = {far}, scale = {scale} and vortex = {vortex}"
        raise ModelError(f"potential: the scale must be positive, the vortex finite and 0 < near < far, found {found}")
    if distance.jacobian is None:
        raise ModelError(f"potential: '{distance.name}' has no attached Jacobian: use fg.residual(function, jacobian)")
    if sense not in ("circulate", "aside") or (sense == "aside" and vortex < 0.0):
        raise ModelError(
            f"potential: sense must be 'circulate', or 'aside' with a positive vortex; found {sense!r}, {vortex}"
        )
    push, slope = (partial(plain, scale, near, far) for plain in (_push, _slope))
    true = of_distance(distance, _repulsion, [scale, near, far], f"{distance.name} potential", push, slope)
    return true if vortex == 0.0 else replace(true, search=_Search(true, vortex, sense == "aside"))
