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

from unifg.codegen.jit import compiled
from unifg.errors import ModelError
from unifg.factors.residuals import Residual, residual
from unifg.models.profile import first_order, of_distance
from unifg.typing import Array

SCALE = 0.075  # [m], the paper's k
NEAR = 0.05  # [m], its mu
FAR = 0.8  # [m], its rho
TINY = 1e-300
NUMBERS = 5  # that stand in front of the table of a distance

Sense: TypeAlias = Literal["circulate", "aside"]


@compiled
def _repulsion(d: float, numbers: Array) -> tuple[float, float, float]:
    """Return g and its slope; the numbers are scale, near, far, vortex and whether it turns aside."""
    scale, near, far = numbers[0], numbers[1], numbers[2]
    slope = -scale / (d * d) if near < d < far else 0.0
    if d < near:
        d = near
    if d > far:
        d = far
    return scale * (1.0 / d - 1.0 / far), slope, 0.0


@compiled
def _steer(J: Array, vortex: float, aside: float) -> None:
    """Add to derivatives along a pose, (m, 3), a multiple of the same turned a quarter to the left in the plane."""
    for a in range(len(J)):
        # Components along and across the body: a quarter turn there is a quarter turn in the world.
        along, across, weight = J[a, 0], J[a, 1], vortex
        if aside != 0.0:
            # The tangential part of a push, as strong as the repulsion, across the body and away.
            side = -1.0 if across > 0.0 else 1.0
            weight = -vortex * side * along / max(math.sqrt(along * along + across * across), TINY)
        J[a, 0] -= weight * across
        J[a, 1] += weight * along


@cache
def _steered(distance: Callable[..., None]) -> Callable[..., None]:
    """Write g and what to search with."""
    repel = first_order(distance, _repulsion, NUMBERS)

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        repel(v, p, table, r, J)
        if len(J):
            _steer(J, table[3], table[4])

    return kernel


class _Search:
    """Search for a distance without a kernel."""

    def __init__(self, true: Residual, vortex: float, aside: float) -> None:
        self.true, self.vortex, self.aside = true, vortex, aside

    def __call__(self, *arguments: Array) -> list[Array]:
        assert self.true.jacobian is not None
        pose, *rest = self.true.jacobian(*arguments)
        pose = pose.copy()
        for block in pose:
            _steer(block, self.vortex, self.aside)
        return [pose, *rest]


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
    aside = float(sense == "aside")
    true = of_distance(distance, _repulsion, [scale, near, far, vortex, aside], f"{distance.name} potential")
    if vortex == 0.0:
        return true
    if distance.kernel is not None and true.kernel is not None:
        return residual(true.kernel, search=replace(true.kernel, function=_steered(distance.kernel.function)))
    return residual(true.function, true.jacobian, true.name, _Search(true, vortex, aside))
