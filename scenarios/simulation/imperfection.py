"""Differences between a building and its map: walls drawn a little off, and furniture that has been moved.

The robot's map shows the furniture where it once stood; the world is the map warped, with the furniture where it stands
now. Everything is drawn by seed, and redrawn until the robot can get through in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.options import Settings, not_negative, option
from unifg.scenarios.planning.grid import path_exists
from unifg.typing import Array

__all__ = ["Imperfection", "imperfect"]

WAVES = 4  # of the warp, along each axis
WAVELENGTHS = (4.0, 15.0)  # [m]
SIZES = (0.3, 0.7)  # of a piece of furniture [m]
MOVED = (0.2, 0.8)  # how far it has been moved [m]
FREE_OF = 1.0  # [m] around start and goals without furniture
WAY = 0.3  # [m], clearance of the ways that must remain
DRAWS = 200  # of one piece


@dataclass(frozen=True)
class Imperfection(Settings):
    """Errors of the robot's map.

    Attributes:
        map_error: standard deviation by which walls stand elsewhere than on the map, smoothly from place to place [m].
        furniture: pieces that the map shows and that have been moved since, by 0.2 to 0.8 m.
    """

    map_error: float = option(0.0, text=not_negative, metavar="M")
    furniture: int = option(0, metavar="K")


def imperfect(
    occupancy: OccupancyMap, wrong: Imperfection, start: Array, goals: Array, rng: np.random.Generator
) -> tuple[OccupancyMap, OccupancyMap]:
    """The map that the robot is given, and what is true.

    Args:
        occupancy: a building.
        wrong: how the two differ; without an error both are the building itself.
        start: (3,) true start, around which no furniture stands [m, m, rad].
        goals: (G, 3) the same.
        rng: source of all draws.

    Raises:
        ScenarioError: when no place for a piece of furniture leaves a way.
    """
    given = true = occupancy
    if wrong.map_error > 0.0:
        true = _warped(occupancy, wrong.map_error, rng)
    ends = np.concatenate([start[None, :2], goals[:, :2]])
    for piece in range(wrong.furniture):
        for _ in range(DRAWS):
            once, now = _furnished(given, true, ends, rng)
            if once is not None and now is not None and _passable(once, ends) and _passable(now, ends):
                given, true = once, now
                break
        else:
            raise ScenarioError(
                f"map {occupancy.name!r} has no room for piece {piece + 1} of the furniture that leaves a way of "
                f"{WAY:g} m clearance; ask for at most {piece}"
            )
    return given, true


def _warped(occupancy: OccupancyMap, sigma: float, rng: np.random.Generator) -> OccupancyMap:
    """Every cell looks up what it holds a little off, by a sum of waves of that standard deviation together [m]."""
    rows, columns = np.indices(occupancy.shape)
    places = np.stack([columns, rows], axis=-1) * occupancy.resolution
    off = np.zeros(places.shape)
    for axis in range(2):
        for _ in range(WAVES):
            angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
            wave = 2.0 * np.pi / rng.uniform(*WAVELENGTHS) * np.array([np.cos(angle), np.sin(angle)])
            off[..., axis] += sigma * np.sqrt(2.0 / WAVES) * np.sin(places @ wave + phase)
    moved = np.rint(off / occupancy.resolution).astype(np.intp)
    height, width = occupancy.shape
    at = np.clip(rows + moved[..., 1], 0, height - 1), np.clip(columns + moved[..., 0], 0, width - 1)
    return replace(occupancy, occupied=occupancy.occupied[at], free=occupancy.free[at])


def _furnished(
    given: OccupancyMap, true: OccupancyMap, ends: Array, rng: np.random.Generator
) -> tuple[OccupancyMap | None, OccupancyMap | None]:
    """Both maps with one more piece, drawn at random; None where there is no room for it."""
    rows, columns = np.nonzero(given.free)
    cell = rng.integers(len(rows))
    size, turn, far = rng.uniform(*SIZES, 2), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*MOVED)
    first = np.array([columns[cell], rows[cell]]) * given.resolution
    second = first + far * np.array([np.cos(turn), np.sin(turn)])
    return _standing(given, first, size, ends), _standing(true, second, size, ends)


def _standing(occupancy: OccupancyMap, corner: Array, size: Array, ends: Array) -> OccupancyMap | None:
    """A map with a piece of a size (2,) whose lower left corner is (2,) from the map's [m]."""
    low = np.rint(corner / occupancy.resolution).astype(np.intp)
    high = low + np.maximum(np.rint(size / occupancy.resolution), 1).astype(np.intp)
    height, width = occupancy.shape
    if low.min() < 0 or high[0] > width or high[1] > height:
        return None
    block = slice(low[1], high[1]), slice(low[0], high[0])
    corners = occupancy.grid_to_world(np.array([low, [high[0], low[1]], high, [low[0], high[1]]], dtype=np.float64))
    reach = 0.5 * float(np.hypot(*(corners[2] - corners[0]))) + FREE_OF
    if not occupancy.free[block].all() or np.hypot(*(ends - corners.mean(axis=0)).T).min() < reach:
        return None
    occupied, free = occupancy.occupied.copy(), occupancy.free.copy()
    occupied[block], free[block] = True, False
    return replace(occupancy, occupied=occupied, free=free)


def _passable(occupancy: OccupancyMap, ends: Array) -> bool:
    """Return True if the start is joined to every goal."""
    field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    return all(path_exists(occupancy, field, ends[0], end, WAY) for end in ends[1:])
