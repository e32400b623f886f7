"""Signed distance to the nearest occupied surface, interpolated between cell centres in two ways.

The grid holds, at every cell centre, the Euclidean distance to the nearest occupied cell centre minus half a
cell (or, inside an obstacle, the negative of the same with the roles exchanged): on a straight wall the
bilinear interpolant then crosses zero exactly at the wall's face. Localisation on such a map follows Bazzana
et al. (2022), section VII.

The bilinear interpolant a lidar factor uses has a kink on every line of cell centres, and a solver that leans on
a wall stops at such a kink. For constraints and soft margins quadratic B-splines over the same grid reproduce straight
walls exactly, round corners within one cell, and have a continuous gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import ndimage

from unifg.codegen.jit import compiled
from unifg.errors import ModelError, require_kinds, require_positive
from unifg.modeling.duplicates import doubles
from unifg.typing import Array, ArrayLike, BoolArray

__all__ = ["DistanceMap", "SmoothField"]

HEADER = 8  # numbers in front of the cells of a table
RING = 2  # cells repeated around the grid
PIECE, BESIDE = 2048, 512  # cells to a side that are measured at once, and beyond them


class DistanceMap:
    """A bilinear signed distance field and its exact gradient.

    Attributes:
        values: (H, W) [m], signed distance at the cell centres, row 0 at the lowest y of the map's own frame.
        resolution: side of a cell [m].
        origin: pose (x, y, yaw) [m, m, rad] in the world of the lower-left corner of cell [0, 0].
        table: what compiled look-ups read: two rows of (., ., offset) that lead from the world to the grid, with
            (0, 0) at the origin and 1 for a cell; W and H; and (H + 4, W + 4) values, two border cells repeated.
    """

    def __init__(self, values: ArrayLike, resolution: float, origin: ArrayLike) -> None:
        """Lay out the table.

        Args:
            values: (H, W) [m].
            resolution: side of a cell [m].
            origin: (x, y, yaw) [m, m, rad].

        Raises:
            ModelError: values are not a finite (H, W) grid, the resolution is not positive, or the origin no pose.
        """
        self.values: Array
        self.values, self.resolution, self.origin = grid_of("distance map", values, resolution, origin)
        (height, width), (x, y, yaw) = self.values.shape, self.origin
        cosine, sine = math.cos(yaw) / self.resolution, math.sin(yaw) / self.resolution
        offset = [-cosine * x - sine * y, sine * x - cosine * y]
        header = [cosine, sine, offset[0], -sine, cosine, offset[1], width, height]
        # Repeated border values make the field constant across the border: clamping needs no masks.
        self.table: Array = np.empty(HEADER + (height + 2 * RING) * (width + 2 * RING))
        self.table[:HEADER] = header
        around = self.table[HEADER:].reshape(height + 2 * RING, width + 2 * RING)
        inner = slice(RING, -RING)
        around[inner, inner] = self.values
        around[:RING, inner], around[-RING:, inner] = self.values[0], self.values[-1]
        around[:, :RING], around[:, -RING:] = around[:, RING, None], around[:, -RING - 1, None]
        self.values = around[inner, inner]  # kept once: a large map is most of what a robot remembers

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

        Raises:
            ModelError: occupied is no grid of booleans, or a number is not as it should be.
        """
        require_kinds("distance map", ModelError, DistanceMap.from_occupancy.__annotations__, locals())
        mask = np.asarray(occupied)
        if mask.ndim != 2 or mask.size == 0 or mask.dtype != bool:
            raise ModelError(f"distance map: occupied, {mask.dtype} of shape {mask.shape}, must be a (H, W) bool grid")
        limit = resolution * math.hypot(*mask.shape) if cap is None else float(cap)
        require_positive("distance map", ModelError, finite=False, **{"cap [m]": 1.0 if cap is None else cap})
        if mask.all() or not mask.any():
            return cls(np.full(mask.shape, -limit if mask.all() else limit), resolution, origin)
        values = _signed_cells(mask)
        values *= resolution
        return cls(np.clip(values, -limit, limit, out=values), resolution, origin)

    def distance(self, points: Array) -> Array:
        """Interpolated signed distance.

        Args:
            points: (..., 2) [m] in the world; beyond the grid the value at its border holds. NaN gives NaN.

        Returns:
            (...,) [m].
        """
        return _bilinear(self.table, points)[0]

    def distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Interpolated signed distance and the exact derivative of the interpolant.

        Args:
            points: (..., 2) [m] in the world.

        Returns:
            (...,) [m] and (..., 2) [-] in the world frame. On a line of cell centres, where the interpolant
            has a kink, the derivative is that of the side with larger coordinates.
        """
        return _bilinear(self.table, points)


def grid_of(
    who: str, values: ArrayLike, resolution: float, origin: ArrayLike
) -> tuple[Array, float, tuple[float, float, float]]:
    """Grid (H, W), side of a cell [m] and origin (x, y, yaw); the arguments as those of :class:`DistanceMap`.

    Raises:
        ModelError: values are not a finite (H, W) grid, the resolution is not positive, or the origin no pose.
    """
    require_kinds(who, ModelError, grid_of.__annotations__, {"resolution": resolution})
    pose, grid = (doubles(f"{who}: {w}", v, error=ModelError) for w, v in (("origin", origin), ("values", values)))
    if not 0.0 < resolution < math.inf or pose.size != 3 or not np.isfinite(pose).all():
        raise ModelError(f"{who}: resolution {resolution!r} must be positive; origin {origin!r}: (x, y, yaw)")
    if grid.ndim != 2 or grid.size == 0 or not np.isfinite(grid).all():
        raise ModelError(f"{who}: values {grid.shape} must be a finite (H, W) grid")
    x, y, yaw = pose.ravel().tolist()
    return grid, float(resolution), (x, y, yaw)


def _signed_cells(mask: BoolArray) -> Array:
    """(H, W) signed distance to the nearest surface, in cells; piece by piece where the grid is large.

    The transform needs some forty bytes for a cell. A piece is measured with its surroundings; a distance found in them
    that is no longer than they are wide is that of the whole grid, and where one is longer they are widened.
    """
    height, width = mask.shape
    if mask.size <= PIECE * PIECE:
        return _signed_piece(mask)
    values = np.empty(mask.shape)
    for row in range(0, height, PIECE):
        for column in range(0, width, PIECE):
            reach = BESIDE
            while True:
                top, left = max(0, row - reach), max(0, column - reach)
                bottom, right = min(height, row + PIECE + reach), min(width, column + PIECE + reach)
                part = mask[top:bottom, left:right]
                whole = (bottom - top, right - left) == mask.shape
                if whole or (part.any() and not part.all()):
                    found = _signed_piece(part)[row - top : row - top + PIECE, column - left : column - left + PIECE]
                    if whole or float(np.abs(found).max()) <= reach - 0.5:
                        break
                reach *= 2
            values[row : row + PIECE, column : column + PIECE] = found
    return values


def _signed_piece(mask: BoolArray) -> Array:
    outside = np.asarray(ndimage.distance_transform_edt(~mask), dtype=np.float64)
    inside = np.asarray(ndimage.distance_transform_edt(mask), dtype=np.float64)
    return np.where(mask, 0.5 - inside, outside - 0.5)


@compiled
def cell_of(position: float, first: float, last: float) -> tuple[int, float]:
    """Cell of a grid coordinate, from ``first`` to ``last``, and the fraction of it in [0, 1]; NaN stays NaN."""
    cell = np.floor(position)
    if not cell > first:
        cell = first
    if cell > last:
        cell = last
    fraction = position - cell
    if fraction < 0.0:
        fraction = 0.0
    if fraction > 1.0:
        fraction = 1.0
    return int(cell), fraction


@compiled
def bilinear(table: Array, x: float, y: float) -> tuple[float, float, float]:
    """Distance at a point in the world and its gradient there; ``table`` is that of a :class:`DistanceMap`."""
    column, s = cell_of(table[0] * x + table[1] * y + table[2] + 0.5, 0.0, table[6])
    row, t = cell_of(table[3] * x + table[4] * y + table[5] + 0.5, 0.0, table[7])
    stride = int(table[6]) + 2 * RING
    at = HEADER + (row + RING - 1) * stride + column + RING - 1
    corner, above = table[at], table[at + stride]
    along, along_above = table[at + 1] - corner, table[at + stride + 1] - above
    low, high = corner + s * along, above + s * along_above
    slope_s, slope_t = along + t * (along_above - along), high - low
    return low + t * slope_t, table[0] * slope_s + table[3] * slope_t, table[1] * slope_s + table[4] * slope_t


def sampler(look_up: Callable[..., tuple[float, float, float]]) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Make a look-up of one point in a table one of (..., 2) points: (...,) values and (..., 2) gradients."""

    @compiled
    def loop(table: Array, points: Array, value: Array, gradient: Array) -> None:
        for i in range(len(points)):
            value[i], gradient[i, 0], gradient[i, 1] = look_up(table, points[i, 0], points[i, 1])

    def sample(table: Array, points: Array) -> tuple[Array, Array]:
        points = np.ascontiguousarray(points, dtype=np.float64)
        if points.shape[-1] != 2:
            raise ModelError(f"distance map: points are (..., 2) arrays, found shape {points.shape}")
        shape = points.shape[:-1]
        value, gradient = np.empty(math.prod(shape)), np.empty((math.prod(shape), 2))
        loop(table, points.reshape(-1, 2), value, gradient)
        return value.reshape(shape), gradient.reshape(*shape, 2)

    return sample


_bilinear = sampler(bilinear)


class SmoothField:
    """Signed distance to the nearest wall with a continuous gradient.

    Attributes:
        distance_map: the grid that is smoothed.
        table: of the map, which both share.
    """

    def __init__(self, distance_map: DistanceMap) -> None:
        """Smooth a map; the field is constant beyond its border."""
        self.distance_map = distance_map
        self.table: Array = distance_map.table

    def distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Distance and its exact gradient.

        Args:
            points: (..., 2) [m] in the world; NaN gives NaN.

        Returns:
            (...,) [m] and (..., 2) [-] in the world frame.
        """
        return _smooth(self.table, points)

    def distance(self, points: Array) -> Array:
        """Distance alone, (...,) [m] for points (..., 2) [m]."""
        return _smooth(self.table, points)[0]


@compiled
def _spline(before: float, here: float, after: float, fraction: float) -> tuple[float, float]:
    """Quadratic B-spline between three neighbours, and its derivative."""
    rest, aside = 1.0 - fraction, fraction - 0.5
    value = 0.5 * (rest * rest * before + fraction * fraction * after) + (0.75 - aside * aside) * here
    return value, fraction * after - rest * before - 2.0 * aside * here


@compiled
def smooth(table: Array, x: float, y: float) -> tuple[float, float, float]:
    """Distance at a point in the world and its gradient there; ``table`` is that of a map."""
    column, s = cell_of(table[0] * x + table[1] * y + table[2], -1.0, table[6])
    row, t = cell_of(table[3] * x + table[4] * y + table[5], -1.0, table[7])
    stride = int(table[6]) + 2 * RING
    low = HEADER + (row + RING - 1) * stride + column + RING - 1
    middle, high = low + stride, low + 2 * stride
    a, slope_a = _spline(table[low], table[low + 1], table[low + 2], s)
    b, slope_b = _spline(table[middle], table[middle + 1], table[middle + 2], s)
    c, slope_c = _spline(table[high], table[high + 1], table[high + 2], s)
    value, slope_t = _spline(a, b, c, t)
    slope_s = _spline(slope_a, slope_b, slope_c, t)[0]
    return value, table[0] * slope_s + table[3] * slope_t, table[1] * slope_s + table[4] * slope_t


_smooth = sampler(smooth)
