"""Maps of scans whose poses are known: a field to register other scans on, and an occupancy grid."""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2
from unifg.models import lidar
from unifg.models.distance_map import DistanceMap
from unifg.typing import Array

__all__ = ["field_of", "mapped"]

CELL = 0.05  # [m]
AROUND = 0.6  # [m] of a point, within which distances are known
OCCUPIED = 0.3  # share of the beams through a cell that have to end there


def field_of(points: Array) -> DistanceMap:
    """Distances to the nearest of points (n, 2) [m], up to 0.6 m."""
    low = points.min(axis=0) - 2.0 * AROUND
    columns, rows = (np.ceil((points.max(axis=0) + 2.0 * AROUND - low) / CELL)).astype(int).tolist()
    squared = np.full((rows, columns), (AROUND / CELL) ** 2)
    _paint((points - low) / CELL - 0.5, AROUND / CELL, squared)
    return DistanceMap(CELL * (np.sqrt(squared) - 0.5), CELL, (*low.tolist(), 0.0))


@compiled
def _paint(points: Array, reach: float, squared: Array) -> None:
    """Lower the squared distances around points, all in cells from the middle of the first one."""
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        if squared[int(y + 0.5), int(x + 0.5)] > 0.25:  # else there is one in this cell
            for row in range(int(y - reach) + 1, int(y + reach) + 1):
                for column in range(int(x - reach) + 1, int(x + reach) + 1):
                    away = (column - x) ** 2 + (row - y) ** 2
                    if away < squared[row, column]:
                        squared[row, column] = away


def mapped(
    angles: Array, ranges: Array, poses: Array, resolution: float = CELL, reach: float = lidar.DROP_BEYOND
) -> OccupancyMap:
    """A grid of how often a cell was hit and how often seen through.

    Args:
        angles: (b,) directions of the beams [rad].
        ranges: (n, b) [m].
        poses: (n, 3) of the lidar [m, m, rad].
        resolution: side of a cell [m].
        reach: of the beams that take part [m].
    """
    low, high = poses[:, :2].min(axis=0) - reach - 2.0, poses[:, :2].max(axis=0) + reach + 2.0
    columns, rows = np.ceil((high - low) / resolution).astype(int).tolist()
    hits, passes = np.zeros((rows, columns)), np.zeros((rows, columns))
    touched = np.full((rows, columns), -1)
    for k, (row, pose) in enumerate(zip(ranges, poses, strict=True)):
        good = lidar.usable(row, reach)
        ends = SE2.act(pose, lidar.beam_endpoints(row[good], angles[good], reach))
        _trace((pose[:2] - low) / resolution, (ends - low) / resolution, k, touched, hits, passes)
    occupied = (hits > OCCUPIED * (hits + passes)) & (hits > 0.0)
    return OccupancyMap(occupied, (passes > 0.0) & ~occupied, resolution, (float(low[0]), float(low[1]), 0.0))


@compiled
def _trace(begin: Array, ends: Array, scan: int, touched: Array, hits: Array, passes: Array) -> None:
    """Count the ends of a scan's beams, and once a scan every cell on the way to a cell before them."""
    for i in range(len(ends)):
        way = math.hypot(ends[i, 0] - begin[0], ends[i, 1] - begin[1])
        hits[int(ends[i, 1]), int(ends[i, 0])] += 1.0
        for step in range(int(max(0.0, 2.0 * (way - 1.0))) + 1):
            share = 0.5 * step / max(way, 1e-9)
            if 0.5 * step < way - 1.0:
                row = int(begin[1] + share * (ends[i, 1] - begin[1]))
                column = int(begin[0] + share * (ends[i, 0] - begin[0]))
                if touched[row, column] != scan:
                    touched[row, column] = scan
                    passes[row, column] += 1.0
