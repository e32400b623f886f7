"""Clearance from discs and from the walls of a map, as hard constraints and as soft margins."""

from __future__ import annotations

import numpy as np

from unifg.models.smooth_field import SmoothField
from unifg.residuals import Residual, residual
from unifg.typing import Array

NEAR = 1e-9  # below this distance the direction to the centre is undefined; the gradient is taken as zero


def _offsets(x: Array, centre: Array) -> tuple[Array, Array]:
    """(n, M, 2) vectors from the centres to the positions, and their (n, M) lengths."""
    centres = centre[None, :, :] if centre.ndim == 2 else centre
    offset = x[:, None, :2] - centres
    return offset, np.sqrt(np.einsum("nmk,nmk->nm", offset, offset))


def _disc_clearance(x: Array, centre: Array, radius: Array) -> Array:
    return _offsets(x, centre)[1] - radius


def _disc_clearance_jacobian(x: Array, centre: Array, radius: Array) -> list[Array]:
    offset, distance = _offsets(x, centre)
    direction = offset / np.maximum(distance, NEAR)[:, :, None]
    block = np.zeros((*distance.shape, 3))
    block[:, :, :2] = _in_body(x, direction)
    return [block]


def _in_body(x: Array, direction: Array) -> Array:
    """(n, M, 2) world directions expressed in the body frames of (n, 3) poses."""
    cosine, sine = np.cos(x[:, 2])[:, None], np.sin(x[:, 2])[:, None]
    along, across = direction[:, :, 0], direction[:, :, 1]
    return np.stack([cosine * along + sine * across, cosine * across - sine * along], axis=2)


disc_clearance = residual(_disc_clearance, _disc_clearance_jacobian, "disc clearance")
"""``disc_clearance(x, centre, radius)``: |p - c| - r [m], one column per disc, (n, M).

x: (n, 3) SE(2) poses. centre: (M, 2) shared by all poses or (n, M, 2), one set for each, as for moving discs.
radius: (M,) or (n, M); give the sum of the disc's and the robot's radii for hull clearance.
"""


class _Wall:
    def __init__(self, field: SmoothField) -> None:
        self.field = field

    def __call__(self, x: Array) -> Array:
        return self.field.distance(x[:, :2])[:, None]

    def jacobian(self, x: Array) -> list[Array]:
        _, gradient = self.field.distance_and_gradient(x[:, :2])
        block = np.zeros((len(x), 1, 3))
        block[:, :, :2] = _in_body(x, gradient[:, None, :])
        return [block]


def wall_distance(field: SmoothField) -> Residual:
    """``wall_distance(field)(x)``: signed distance of each SE(2) position to the nearest wall, (n, 1) [m]."""
    function = _Wall(field)
    return residual(function, function.jacobian, "wall distance")


class _Shortfall:
    def __init__(self, distance: Residual, margin: float) -> None:
        self.distance = distance
        self.margin = margin

    def __call__(self, *arguments: Array) -> Array:
        return np.maximum(self.margin - self.distance.function(*arguments), 0.0)

    def jacobian(self, *arguments: Array) -> list[Array]:
        assert self.distance.jacobian is not None
        short = self.distance.function(*arguments) < self.margin
        return [np.where(short[:, :, None], -block, 0.0) for block in self.distance.jacobian(*arguments)]


def shortfall(distance: Residual, margin: float) -> Residual:
    """Turn a clearance into a soft margin: max(0, margin - distance), same shape, in metres.

    Args:
        distance: a residual with an attached Jacobian, such as ``disc_clearance``.
        margin: distance below which the cost begins [m]; its square is continuously differentiable there.
    """
    function = _Shortfall(distance, margin)
    return residual(function, function.jacobian, f"{distance.name} margin")
