"""A continuously differentiable distance field for constraints and soft margins.

The bilinear interpolant a lidar factor uses has a kink on every line of cell centres, and a solver that leans on
a wall stops at such a kink. Quadratic B-splines over the same grid reproduce straight walls exactly, round
corners within one cell, and have a continuous gradient.
"""

from __future__ import annotations

from unifg.machine.jit import compiled
from unifg.models.distance_map import HEADER, RING, DistanceMap, cell_of, sampler
from unifg.typing import Array


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
        return _sample(self.table, points)

    def distance(self, points: Array) -> Array:
        """Distance alone, (...,) [m] for points (..., 2) [m]."""
        return _sample(self.table, points)[0]


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


_sample = sampler(smooth)
