"""Tables of numbers as smooth functions: cubic splines in one and two variables, for functions that are traced.

A spline here passes through its numbers, which stand on a regular grid; between them it is a cubic in each variable,
with continuous second derivatives. It is the one whose third derivative is continuous at the second and at the last but
one of them as well ("not-a-knot", de Boor, *A Practical Guide to Splines*, chapter IV); in two variables it is the
tensor product. Written in B-splines of the grid its coefficients are continued by their border values: beyond the grid
the function, its slope and its curvature stay continuous, and more than three steps beyond it is constant across
the border. What is not a number gives what is not a number.

A residual calls a spline as any function of arrays::

    field = SplineField.of_map(distance_map)
    graph.constrain(lambda x: field(x[:, :2])[:, None] - 0.3, poses, lower=0.0)

and has the spline's exact first and second derivatives.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.linalg import solve_banded

from unifg.errors import ModelError, require_kinds, require_positive
from unifg.factors.autodiff.lookup import Lookup
from unifg.modeling.duplicates import doubles
from unifg.models.distance_map import DistanceMap, grid_of
from unifg.typing import Array, ArrayLike

__all__ = ["SplineCurve", "SplineField"]

BEYOND = 3  # steps outside the grid after which nothing changes
RING = 16  # cells of a map repeated around it: what a kink at its border stirs up has died away there
PAD = BEYOND  # coefficients repeated on each side


class SplineCurve(Lookup):
    """A cubic spline through numbers at equal distances: ``curve(s)``, same shape as s.

    Attributes:
        values: (n,) numbers, n >= 4.
        start: where the first stands.
        spacing: between two neighbours.
    """

    def __init__(self, values: ArrayLike, start: float = 0.0, spacing: float = 1.0) -> None:
        """Find the coefficients.

        Raises:
            ModelError: fewer than four values, values that are not finite, or a spacing that is not positive.
        """
        require_kinds("spline", ModelError, SplineCurve.__init__.__annotations__, {"start": start})
        require_positive("spline", ModelError, spacing=spacing)
        self.values: Array = np.array(doubles("spline: values", values, error=ModelError))
        self.start, self.spacing = float(start), float(spacing)
        if self.values.ndim != 1 or len(self.values) < 4 or not np.isfinite([*self.values, start]).all():
            raise ModelError(f"spline: start {start!r} and values {self.values.shape}: four or more finite numbers")
        super().__init__(np.pad(coefficients(self.values), PAD, mode="edge"))

    def __call__(self, s: Any) -> Any:
        """The spline at s."""
        cell, weights = _cell((s - self.start) / self.spacing, len(self.values))
        return sum(weight * self.take(cell + (PAD + k)) for k, weight in enumerate(weights))


class SplineField(Lookup):
    """A bicubic spline through the values of a grid: ``field(points)``, (...,) for points (..., 2) in the world.

    Attributes:
        values: (H, W), four or more along each axis; row 0 at the lowest y of the grid's own frame.
        resolution: between two neighbours [m].
        origin: pose (x, y, yaw) [m, m, rad] in the world of the grid, at the number values[0, 0].
    """

    def __init__(self, values: ArrayLike, resolution: float, origin: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Find the coefficients.

        Raises:
            ModelError: values are not a finite grid of four by four or more, the resolution is not positive, or the
                origin no pose.
        """
        grid, self.resolution, self.origin = grid_of("spline", values, resolution, origin)
        self.values: Array = grid.copy()
        if min(grid.shape) < 4:
            raise ModelError(f"spline: values of shape {grid.shape} must be a grid of 4 by 4 or more")
        super().__init__(np.pad(coefficients(coefficients(self.values).T).T, PAD, mode="edge"))

    @classmethod
    def of_map(cls, distance_map: DistanceMap) -> SplineField:
        """The signed distance of a map [m], smooth: its values stand at the centres of the cells.

        Border cells are repeated before the spline is found: beyond the map the value at its border holds.
        """
        x, y, yaw = distance_map.origin
        back = (0.5 - RING) * distance_map.resolution
        corner = x + back * (math.cos(yaw) - math.sin(yaw)), y + back * (math.sin(yaw) + math.cos(yaw)), yaw
        return cls(np.pad(distance_map.values, RING, mode="edge"), distance_map.resolution, corner)

    def __call__(self, points: Any) -> Any:
        """The spline at points."""
        points = points if isinstance(points, np.ndarray) else np.asarray(points, dtype=np.float64)
        x0, y0, yaw = self.origin
        cosine, sine = math.cos(yaw), math.sin(yaw)
        x, y = points[..., 0] - x0, points[..., 1] - y0
        height, width = self.values.shape
        column, across = _cell((cosine * x + sine * y) / self.resolution, width)
        row, along = _cell((cosine * y - sine * x) / self.resolution, height)
        first = (row + PAD) * (width + 2 + 2 * PAD) + (column + PAD)
        total: Any = 0.0
        for i, weight in enumerate(along):
            offset = i * (width + 2 + 2 * PAD)
            total = total + weight * sum(b * self.take(first + (offset + k)) for k, b in enumerate(across))
        return total


def coefficients(values: Array) -> Array:
    """Of the B-splines whose sum passes through values, (n, ...), along the first axis: (n + 2, ...).

    With B(0) = 2/3 and B(1) = B(-1) = 1/6 at the numbers, and no jump of the third derivative at the second and at the
    last but one: the fourth differences of five coefficients vanish.
    """
    count = len(values) + 2
    bands = np.zeros((9, count))  # entry (i, j) of the matrix at [4 + i - j, j]
    for shift, entry in ((0, 1.0 / 6.0), (1, 4.0 / 6.0), (2, 1.0 / 6.0)):
        rows = np.arange(1, count - 1)
        bands[4 + 1 - shift, rows - 1 + shift] = entry
    for j, entry in enumerate((1.0, -4.0, 6.0, -4.0, 1.0)):
        bands[4 - j, j] = entry
        bands[4 + 4 - j, count - 5 + j] = entry
    right = np.zeros((count, *values.shape[1:]))
    right[1:-1] = values
    found: Array = solve_banded((4, 4), bands, right)
    return found


def _cell(place: Any, count: int) -> tuple[Any, list[Any]]:
    """The cell of a grid coordinate, and what the four B-splines are there that do not vanish."""
    place = np.clip(place, -float(BEYOND), count - 1.0 + BEYOND)
    cell = np.clip(np.floor(place), -float(BEYOND), count - 2.0 + BEYOND)
    t = place - cell
    rest, square = 1.0 - t, t * t
    ahead = rest * rest
    return cell, [
        ahead * rest * (1.0 / 6.0),
        (2.0 / 3.0) - square * (1.0 - 0.5 * t),
        (2.0 / 3.0) - ahead * (1.0 - 0.5 * rest),
        square * t * (1.0 / 6.0),
    ]
