"""Earliest arrival of a disc that is told the future: a wave over the map, 0.1 m and 0.1 s a cell, that may wait.

The wave goes on by the four neighbours of a cell, and by all eight in two steps of five: an octagon, at most 8 % faster
than the circle. Accelerations and headings are not asked for, so that no robot of this speed arrives earlier.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy import ndimage

from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.planning.grid import is_free
from unifg.scenarios.simulation.space import Obstacle, reflected
from unifg.typing import Array

CELL = 0.1  # [m]
DIAGONAL = (1, 3)  # of five steps, those by all eight neighbours
Future = Callable[[float], Array]
"""(K, 3) x, y, radius of all discs at a time from now on [m]."""


def future(obstacles: Sequence[Obstacle]) -> Future:
    """True future of obstacles that rest or go to and fro without waiting, from time zero on."""

    def discs(time: float) -> Array:
        rows = np.zeros((len(obstacles), 3))
        for row, disc in zip(rows, obstacles, strict=True):
            share = 0.0
            if disc.moving:
                assert disc.end is not None
                length = math.dist(disc.centre, disc.end)
                share = reflected(0.0, 1.0, disc.speed * time % (2.0 * length), length)[0] / length
            row[:] = *disc.positions(np.array([share]))[0], disc.radius
        return rows

    return discs


def earliest_arrival(
    occupancy: OccupancyMap,
    walls: DistanceMap,
    start: Array,
    goal: Array,
    radius: float,
    discs: Future,
    speed: float = 1.0,
    longest: float = 60.0,
) -> float:
    """Earliest time at which a disc can be within a cell of ``goal`` (2,), from ``start`` (2,) [s].

    Args:
        occupancy: the map, without a turn; outside of its free cells there is no way.
        walls: distance to them.
        start: (2,) or (3,) [m].
        goal: (2,) or (3,) [m].
        radius: of the disc [m].
        discs: what else is in the way.
        speed: greatest [m/s].
        longest: time after which the search ends [s].

    Returns:
        The time, infinite where the goal is not reached by then.
    """
    low = np.array(occupancy.origin[:2])
    counts = np.ceil(np.array(occupancy.shape[::-1]) * occupancy.resolution / CELL).astype(int).tolist()
    x, y = (a + CELL * (np.arange(n) + 0.5) for a, n in zip(low, counts, strict=True))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    points = places.reshape(-1, 2)
    free = (is_free(occupancy, points) & (walls.distance(points) >= radius)).reshape(len(x), len(y))
    four, eight = (ndimage.generate_binary_structure(2, k) for k in (1, 2))

    def cell(place: Array) -> tuple[int, int]:
        i, j = ((place[:2] - low) / CELL).astype(int).tolist()
        return i, j

    wave, target = np.zeros_like(free), cell(goal)
    wave[cell(start)] = free[cell(start)] = free[target] = True  # centres of their cells may be nearer than they are
    step = CELL / speed
    for count in range(round(longest / step) + 1):
        now = free.copy()
        for x_disc, y_disc, size in discs(count * step).tolist():
            reach = size + radius
            (i, k), (j, m) = (
                np.searchsorted(axis, [c - reach, c + reach]).tolist() for axis, c in ((x, x_disc), (y, y_disc))
            )
            near = places[i:k, j:m] - (x_disc, y_disc)
            now[i:k, j:m] &= np.hypot(near[..., 0], near[..., 1]) >= reach
        wave = now & (ndimage.binary_dilation(wave, eight if count % 5 in DIAGONAL else four) if count else wave)
        if wave[target]:
            return count * step
        if not wave.any():
            break
    return math.inf
