"""Signed distance to the nearest occupied surface, interpolated between cell centres.

The grid holds, at every cell centre, the Euclidean distance to the nearest occupied cell centre minus half a
cell (or, inside an obstacle, the negative of the same with the roles exchanged): on a straight wall the
bilinear interpolant then crosses zero exactly at the wall's face. Localisation on such a map follows Bazzana
et al. (2022), section VII.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from unifg.typing import Array, ArrayLike, BoolArray


class DistanceMap:
    """A bilinear signed distance field and its exact gradient.

    Attributes:
        values: (H, W) [m], signed distance at the cell centres, row 0 at the lowest y of the map's own frame.
        resolution: side of a cell [m].
        origin: pose (x, y, yaw) [m, m, rad] in the world of the lower-left corner of cell [0, 0].
    """

    def __init__(self, values: ArrayLike, resolution: float, origin: ArrayLike) -> None:
        """Prepare one interpolation polynomial per square of cell centres.

        Args:
            values: (H, W) [m].
            resolution: side of a cell [m].
            origin: (x, y, yaw) [m, m, rad].

        Raises:
            ValueError: values are not a finite (H, W) grid, or the resolution is not positive.
        """
        self.values: Array = np.ascontiguousarray(values, dtype=np.float64)
        self.resolution = float(resolution)
        pose = np.asarray(origin, dtype=np.float64).ravel()
        if self.values.ndim != 2 or self.values.size == 0 or not np.all(np.isfinite(self.values)):
            raise ValueError(f"distance map: values {self.values.shape} must be a finite (H, W) grid")
        if not self.resolution > 0.0 or pose.shape != (3,):
            raise ValueError(
                f"distance map: resolution {resolution!r} must be positive; origin {origin!r}: (x, y, yaw)"
            )
        self.origin: tuple[float, float, float] = (float(pose[0]), float(pose[1]), float(pose[2]))

        # One ring of repeated border values makes the field constant across the border: a point outside finds
        # a polynomial without slope in the outward direction, so clamping needs no masks.
        ring = np.pad(self.values, 1, mode="edge")
        corner, right, above, both = ring[:-1, :-1], ring[:-1, 1:], ring[1:, :-1], ring[1:, 1:]
        # value(s, t) = k0 + k1 s + k2 t + k3 s t on the unit square; one row per square is one gather per
        # point.
        squares = np.stack([corner, right - corner, above - corner, both - above - (right - corner)], axis=-1)
        self._polynomials: Array = np.ascontiguousarray(squares.reshape(-1, 4))
        c, s = math.cos(pose[2]), math.sin(pose[2])
        self._grid_from_world: Array = np.array([[c, -s], [s, c]]) / self.resolution
        self._world_from_grid: Array = np.ascontiguousarray(self._grid_from_world.T)
        self._offset: Array = 0.5 - pose[:2] @ self._grid_from_world
        height, width = self.values.shape
        self._last: Array = np.array([width, height], dtype=np.float64)
        self._strides: Array = np.array([1.0, width + 1.0])

    @classmethod
    def from_occupancy(
        cls, occupied: BoolArray, resolution: float, origin: ArrayLike, cap: float | None = None
    ) -> DistanceMap:
        """Measure the distance of every cell to the nearest surface between occupied and other cells.

        Unknown cells count as not occupied: nothing there returns a lidar beam that could be matched.

        Args:
            occupied: (H, W) bool, row 0 at the lowest y.
            resolution: side of a cell [m].
            origin: (x, y, yaw) [m, m, rad].
            cap: largest magnitude kept [m]; by default the diagonal of the grid, which only a map without
                surfaces reaches.
        """
        mask = np.asarray(occupied, dtype=bool)
        if mask.ndim != 2 or mask.size == 0:
            raise ValueError(f"distance map: occupied of shape {mask.shape} must be a (H, W) grid")
        limit = resolution * math.hypot(*mask.shape) if cap is None else float(cap)
        if not limit > 0.0:
            raise ValueError(f"distance map: cap {cap!r} must be positive [m]")
        if mask.all() or not mask.any():
            return cls(np.full(mask.shape, -limit if mask.all() else limit), resolution, origin)
        outside = np.asarray(ndimage.distance_transform_edt(~mask), dtype=np.float64)
        inside = np.asarray(ndimage.distance_transform_edt(mask), dtype=np.float64)
        values = np.where(mask, 0.5 - inside, outside - 0.5) * resolution
        return cls(np.clip(values, -limit, limit), resolution, origin)

    def distance(self, points: Array) -> Array:
        """Interpolated signed distance.

        Args:
            points: (..., 2) [m] in the world; beyond the grid the value at its border holds. NaN gives NaN.

        Returns:
            (...,) [m].
        """
        s, t, k = self._locate(points)
        return np.asarray(k[..., 0] + s * k[..., 1] + t * (k[..., 2] + s * k[..., 3]))

    def distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Interpolated signed distance and the exact derivative of the interpolant.

        Args:
            points: (..., 2) [m] in the world.

        Returns:
            (...,) [m] and (..., 2) [-] in the world frame. On a line of cell centres, where the interpolant
            has a kink, the derivative is that of the side with larger coordinates.
        """
        s, t, k = self._locate(points)
        slope = k[..., 1:3] + k[..., 3:] * np.stack((t, s), axis=-1)
        value = k[..., 0] + s * k[..., 1] + t * slope[..., 1]
        return value, slope @ self._world_from_grid

    def _locate(self, points: Array) -> tuple[Array, Array, Array]:
        """Coordinates within the square of each point and its polynomial: (...,), (...,), (..., 4)."""
        position = points @ self._grid_from_world
        position += self._offset
        square = np.floor(position)
        # fmax and fmin also give NaN a harmless square; its fraction stays NaN.
        np.fmax(square, 0.0, out=square)
        np.fmin(square, self._last, out=square)
        position -= square
        index = (square @ self._strides).astype(np.intp)
        return position[..., 0], position[..., 1], self._polynomials.take(index, axis=0)
