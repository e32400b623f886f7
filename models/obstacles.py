"""Hard clearance from discs and from the walls of a map."""

from __future__ import annotations

import numpy as np

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
