"""Maps that several tests drive on, and the interrupt that ends a drive early."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.episode import Progress
from unifg.scenarios.simulation.building import building_map

CELL = 0.05


def walled(
    width: float,
    height: float,
    wall: int = 1,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    name: str = "hall",
    blocks: Sequence[tuple[slice, slice]] = (),
) -> OccupancyMap:
    """A room of a size over all [m], with walls of some cells of 0.05 m and blocks of cells (rows, columns)."""
    occupied = np.ones((round(height / CELL), round(width / CELL)), dtype=bool)
    occupied[wall:-wall, wall:-wall] = False
    for block in blocks:
        occupied[block] = True
    return OccupancyMap(occupied, ~occupied, CELL, origin, name)


def field(occupancy: OccupancyMap) -> DistanceMap:
    """Distance map of an occupancy map."""
    return DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)


@functools.cache
def building() -> tuple[OccupancyMap, DistanceMap]:
    """The shipped floor and its distance map."""
    occupancy = building_map()
    return occupancy, field(occupancy)


def stop_after(ticks: int) -> Progress:
    """Progress of a drive that the user interrupts after so many ticks."""
    numbers = itertools.count(1)

    def interrupt(done: float, text: str) -> None:
        if done < 1.0 and next(numbers) == ticks:
            raise KeyboardInterrupt

    return interrupt
