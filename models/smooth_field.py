"""A continuously differentiable distance field for constraints and soft margins.

The bilinear interpolant a lidar factor uses has a kink on every line of cell centres, and a solver that leans on
a wall stops at such a kink. Quadratic B-splines over the same grid reproduce straight walls exactly, round
corners within one cell, and have a continuous gradient.
"""

from __future__ import annotations

import numpy as np

from unifg.models.distance_map import DistanceMap
from unifg.typing import Array


class SmoothField:
    """Signed distance to the nearest wall with a continuous gradient.

    Attributes:
        distance_map: the grid that is smoothed.
    """

    def __init__(self, distance_map: DistanceMap) -> None:
        """Pad the grid so that the field is constant beyond its border."""
        self.distance_map = distance_map
        self._padded = np.pad(distance_map.values, 2, mode="edge")
        self._flat = self._padded.ravel()
        self._width = self._padded.shape[1]
        height, width = distance_map.values.shape
        self._last = np.array([width, height], dtype=np.float64)
        x, y, yaw = distance_map.origin
        cosine, sine = np.cos(yaw), np.sin(yaw)
        self._grid_from_world = np.array([[cosine, -sine], [sine, cosine]]) / distance_map.resolution
        self._offset = -np.array([x, y]) @ self._grid_from_world
        self._neighbours = (np.arange(3)[:, None] * self._width + np.arange(3)).ravel()

    def distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Distance and its exact gradient.

        Args:
            points: (n, 2) [m] in the world.

        Returns:
            (n,) [m] and (n, 2) [-] in the world frame.
        """
        grid = points @ self._grid_from_world + self._offset
        cell = np.clip(np.floor(grid), -1.0, self._last)
        weights, slopes = _spline(np.clip(grid - cell, 0.0, 1.0))
        index = (cell[:, 1] + 1.0) * self._width + cell[:, 0] + 1.0
        block = self._flat[index.astype(np.intp)[:, None] + self._neighbours].reshape(-1, 3, 3)
        along_rows = np.einsum("nij,nj->ni", block, weights[:, 0])
        value = np.einsum("ni,ni->n", along_rows, weights[:, 1])
        gradient = np.empty((len(points), 2))
        gradient[:, 0] = np.einsum("nij,nj,ni->n", block, slopes[:, 0], weights[:, 1])
        gradient[:, 1] = np.einsum("ni,ni->n", along_rows, slopes[:, 1])
        return value, gradient @ self._grid_from_world.T

    def distance(self, points: Array) -> Array:
        """Distance alone, (n,) [m] for points (n, 2) [m]."""
        return self.distance_and_gradient(points)[0]


def _spline(fraction: Array) -> tuple[Array, Array]:
    """(n, 2, 3) weights of the three nearest cells along x and y, and their derivatives."""
    weights = np.stack(
        [0.5 * (1.0 - fraction) ** 2, 0.75 - (fraction - 0.5) ** 2, 0.5 * fraction**2],
        axis=2,
    )
    slopes = np.stack([fraction - 1.0, 1.0 - 2.0 * fraction, fraction], axis=2)
    return weights, slopes
