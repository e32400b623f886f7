"""Routes through the building that ships with the package, drawn by seed: where comparisons of drives begin and end."""

from __future__ import annotations

from functools import cache

import numpy as np

from unifg.errors import ScenarioError
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.planning.grid import plan
from unifg.scenarios.planning.polyline import path_length
from unifg.scenarios.simulation.building import building_map
from unifg.typing import Array

ROOM = 0.45  # [m] between a start or goal and the walls
LENGTHS = (12.0, 30.0)  # [m]
Place = tuple[float, float, float]


@cache
def drawn(number: int, lengths: tuple[float, float] = LENGTHS) -> tuple[Place, Place]:
    """Start and goal [m, m, rad] of a route of such a length, the robot facing along it at both ends."""
    occupancy = building_map()
    distances = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    rng = np.random.default_rng([number, 7])
    free = np.argwhere(occupancy.free)
    while True:
        cells: Array = free[rng.integers(len(free), size=2)][:, ::-1].astype(np.float64) + 0.5
        places = occupancy.grid_to_world(cells)
        if distances.distance(places).min() < ROOM or not lengths[0] < np.hypot(*(places[1] - places[0])) < lengths[1]:
            continue
        ends = np.column_stack([places, np.zeros(2)])
        try:
            path = plan(occupancy, distances, ends[0], ends[1], robot_radius=0.17)
        except ScenarioError:
            continue
        if lengths[0] < path_length(path) < lengths[1]:
            (x, y), (u, v) = places.round(2).tolist()
            return (x, y, round(float(path[0, 2]), 2)), (u, v, round(float(path[-2, 2]), 2))
