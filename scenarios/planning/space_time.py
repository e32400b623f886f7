"""Quickest way of a disc among things whose future is given: a wave over place and time, that may wait.

The wave goes on by the four neighbours of a cell, and by all eight in two steps of five: an octagon, at most 8 % faster
than the circle. Accelerations and headings are not asked for, so that no robot of this speed arrives earlier.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.planning.grid import is_free
from unifg.typing import Array, BoolArray

__all__ = ["CELL", "Future", "quickest"]

CELL = 0.1  # [m]
DIAGONAL = (1, 3)  # of five steps, those by all eight neighbours
Future = Callable[[float], Array]
"""(K, 3) x, y, radius of all discs at a time from now on [m]."""


def quickest(
    occupancy: OccupancyMap,
    walls: DistanceMap,
    start: Array,
    goal: Array,
    radius: float,
    discs: Future,
    speed: float = 1.0,
    longest: float = 60.0,
) -> Array | None:
    """Places (K + 1, 2) of the quickest way to within a cell of ``goal``, ``CELL / speed`` [s] apart; None for no way.

    Args:
        occupancy: the map; outside of its free cells there is no way.
        walls: distance to them.
        start: (2,) or (3,) [m].
        goal: (2,) or (3,) [m].
        radius: of the disc [m].
        discs: what else is in the way.
        speed: greatest [m/s].
        longest: time after which the search ends [s].
    """
    scale = CELL / occupancy.resolution
    shape = np.ceil(np.array(occupancy.shape[::-1]) / scale).astype(int)
    places = occupancy.grid_to_world(scale * (np.argwhere(np.ones(shape)).astype(np.float64) + 0.5))
    free = (is_free(occupancy, places) & (walls.distance(places) >= radius)).reshape(shape)
    places = places.reshape(*shape, 2)

    def cell(place: Array) -> tuple[int, int]:
        i, j = (occupancy.world_to_grid(place[:2]) / scale).astype(int).tolist()
        return i, j

    begin, target = cell(start), cell(goal)
    wave, waves = np.zeros_like(free), list[BoolArray]()
    wave[begin] = free[begin] = free[target] = True  # centres of their cells may be nearer to walls than they are
    for count in range(round(longest * speed / CELL) + 1):
        now = free.copy()
        for disc in discs(count * CELL / speed):
            (i, j), reach = cell(disc), disc[2] + radius
            span = int(reach / CELL) + 2
            near = np.s_[max(i - span, 0) : max(i + span, 0), max(j - span, 0) : max(j + span, 0)]
            now[near] &= np.hypot(*np.moveaxis(places[near] - disc[:2], -1, 0)) >= reach
        wave = now & (ndimage.binary_dilation(wave, _neighbours(count)) if count else wave)
        waves.append(wave)
        if wave[target]:
            way: Array = places[tuple(np.transpose(_back(waves, begin, target)))]
            return way
        if not wave.any():
            break
    return None


def _neighbours(count: int) -> BoolArray:
    """(3, 3) cells that the wave reaches in a step."""
    cells: BoolArray = ndimage.generate_binary_structure(2, 2 if count % 5 in DIAGONAL else 1)
    return cells


def _back(waves: list[BoolArray], begin: tuple[int, int], cell: tuple[int, int]) -> list[tuple[int, int]]:
    """Cells of all times on a way to a cell of the last wave, that waits as early as it can."""
    cells = [cell]
    for count in range(len(waves) - 1, 0, -1):
        reached = [
            (cell[0] + i - 1, cell[1] + j - 1)
            for i, j in np.argwhere(_neighbours(count)).tolist()
            if 0 <= cell[0] + i - 1 < waves[0].shape[0] and 0 <= cell[1] + j - 1 < waves[0].shape[1]
        ]
        cell = min(
            (each for each in reached if waves[count - 1][each]),
            key=lambda each: (each[0] - begin[0]) ** 2 + (each[1] - begin[1]) ** 2,
        )
        cells.append(cell)
    return cells[::-1]
