"""Unforeseen obstacles: near the path, off the walls, apart from each other, and never in the only way."""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import maps
from maps import walled
from unifg.files.ros_map import OccupancyMap, load_map
from unifg.scenarios.planning.grid import plan
from unifg.scenarios.planning.polyline import polyline_distance
from unifg.scenarios.simulation.placement import PlacementRules, place_obstacles
from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

START = np.array([1.0, 1.5, 0.0])
GOALS = np.array([[9.0, 6.0, 0.0], [18.5, 1.5, 0.0]])


def floor(door: float = 1.4) -> OccupancyMap:
    """20 m x 8 m, two inner walls with one door each."""
    half = round(0.5 * door / 0.05)
    beside = [
        (rows, slice(column, column + 3))
        for column, middle in ((120, 100), (260, 60))
        for rows in (slice(0, middle - half), slice(middle + half, 160))
    ]
    return walled(20.0, 8.0, name="floor", blocks=beside)


field = functools.lru_cache(maxsize=4)(maps.field)


def route(occupancy: OccupancyMap, start: Array, goals: Array) -> Array:
    """The planned path over all goals."""
    distance_map = field(occupancy)
    stops = [start, *goals]
    legs = [plan(occupancy, distance_map, a, b, robot_radius=0.17) for a, b in itertools.pairwise(stops)]
    return np.vstack(legs)


def sweep(obstacle: Obstacle, count: int = 60) -> Array:
    """Centres (n, 2) along the obstacle's segment."""
    end = obstacle.centre if obstacle.end is None else obstacle.end
    return obstacle.centre + np.linspace(0.0, 1.0, count)[:, None] * (end - obstacle.centre)


def joined(occupancy: OccupancyMap, start: Array, goals: Array, discs: list[Array], clearance: float) -> bool:
    """Test whether a disc gets from start to every goal: a flood fill of its own. For maps without yaw."""
    # Half a cell's diagonal of slack: the grid is not to forbid what the continuum allows.
    least = clearance - 0.036
    room = field(occupancy).values >= least
    for x, y, radius in discs:
        column, row = occupancy.world_to_grid(np.array([x, y])) - 0.5
        reach = (radius + least) / occupancy.resolution
        low, left = int(row - reach), int(column - reach)
        rows, columns = np.ogrid[low : int(row + reach) + 2, left : int(column + reach) + 2]
        room[low : int(row + reach) + 2, left : int(column + reach) + 2] &= (
            np.hypot(rows - row, columns - column) >= reach
        )
    labels, _ = ndimage.label(room & occupancy.free, structure=np.ones((3, 3)))
    places = np.floor(occupancy.world_to_grid(np.vstack([start[None, :2], goals[:, :2]]))).astype(int)
    found = labels[places[:, 1], places[:, 0]]
    return bool(found[0] > 0 and (found == found[0]).all())


def check(occupancy: OccupancyMap, path: Array, start: Array, goals: Array, obstacles: list[Obstacle]) -> None:
    """Every promise of the placement, judged by other means than those that made it."""
    rules = PlacementRules()
    distance_map = field(occupancy)
    for index, obstacle in enumerate(obstacles):
        along = sweep(obstacle)
        assert rules.radius[0] <= obstacle.radius <= rules.radius[1]
        assert polyline_distance(obstacle.centre[None], path)[0] <= 0.3 + 1e-9
        assert distance_map.distance(along).min() >= obstacle.radius - 1e-9
        assert np.linalg.norm(along - start[:2], axis=1).min() >= 2.0 - 1e-9
        assert np.linalg.norm(along[:, None] - goals[None, :, :2], axis=2).min() >= 1.0 - 1e-9
        assert obstacle.moving == (index % 3 == 2)
        if obstacle.end is not None:
            assert obstacle.speed == 0.3
            assert 0.6 - 1e-9 <= np.linalg.norm(obstacle.end - obstacle.centre) <= 2.0 + 1e-9
        for other in obstacles[:index]:
            assert np.linalg.norm(along[:, None] - sweep(other)[None], axis=2).min() >= 0.97
    for corner in itertools.product((0, -1), repeat=sum(o.moving for o in obstacles)):
        ends = iter(corner)
        discs = [np.append(sweep(o)[next(ends) if o.moving else 0], o.radius) for o in obstacles]
        assert joined(occupancy, start, goals, discs, 0.25)


def placed(occupancy: OccupancyMap, count: int, seed: int) -> list[Obstacle]:
    """Draw obstacles on a floor."""
    rng, path = np.random.default_rng(seed), way(occupancy)
    return place_obstacles(occupancy, field(occupancy), path, count, rng, start=START, goals=GOALS)


@functools.lru_cache(maxsize=4)
def way(occupancy: OccupancyMap) -> Array:
    """The planned path over a floor."""
    return route(occupancy, START, GOALS)


@pytest.mark.product(2, of="drives and flights")
def test_promises_hold_over_many_seeds() -> None:
    """Thirty draws of four obstacles on a floor with narrow doors."""
    occupancy, near_door = floor(), 0
    for seed in range(30):
        obstacles = placed(occupancy, 4, seed)
        assert len(obstacles) == 4
        check(occupancy, way(occupancy), START, GOALS, obstacles)
        doors = np.array([[6.1, 5.0], [13.1, 3.0]])
        near_door += any(np.linalg.norm(doors - o.centre, axis=1).min() < 1.0 for o in obstacles)
    assert near_door >= 5  # the doors are not simply avoided


def test_narrow_doors_are_left_open() -> None:
    """Doors that let nothing pass beside an obstacle get no obstacle."""
    occupancy = floor(door=0.8)
    for seed in range(10):
        check(occupancy, way(occupancy), START, GOALS, placed(occupancy, 3, seed))


def test_same_seed_same_obstacles() -> None:
    """The draws come from the generator alone; by default the path's ends are start and goal."""
    occupancy = floor()
    first, again, other = (
        place_obstacles(occupancy, field(occupancy), way(occupancy), 3, np.random.default_rng(s)) for s in (5, 5, 6)
    )
    np.testing.assert_array_equal([o.centre for o in first], [o.centre for o in again])
    assert np.abs(first[0].centre - other[0].centre).max() > 0.01
    assert placed(occupancy, 0, 5) == []


def test_as_many_are_placed_as_leave_a_way() -> None:
    """Too many obstacles, and a map that is too narrow from the start."""
    occupancy = floor()
    few = place_obstacles(occupancy, field(occupancy), way(occupancy)[:70], 6, np.random.default_rng(0))
    assert 0 < len(few) < 6
    assert placed(floor(door=0.4), 1, 0) == []


def test_movers_keep_off_walls_in_the_world() -> None:
    """Driven by the world for twenty seconds, no mover touches a wall, and all of them move."""
    occupancy = floor()
    world = World(occupancy, START, placed(occupancy, 6, 2), np.random.default_rng(0))
    states = []
    for _ in range(200):
        world.step(0.0, 0.0)
        states.append(world.discs())
    track = np.array(states)
    moving = track[0, :, 3] == 1.0
    assert moving.tolist() == [False, False, True, False, False, True]
    assert (field(occupancy).distance(track[:, :, :2]) >= track[:, :, 2] - 1e-6).all()
    assert (np.ptp(track[:, moving, :2], axis=0).max(axis=1) > 0.4).all()
    assert np.ptp(track[:, ~moving, :2], axis=0).max() == 0.0


@pytest.mark.data
def test_department_map(shared_data: Path) -> None:
    """The promises hold in a real building."""
    occupancy = load_map(shared_data / "maps" / "dis-B1-2011-09-27.yaml")
    start, goals = np.array([2.3, 30.0, -1.57]), np.array([[10.0, 1.7, 0.0], [26.0, 1.7, 0.0]])
    path = route(occupancy, start, goals)
    distance_map = field(occupancy)
    for seed in range(4):
        obstacles = place_obstacles(
            occupancy, distance_map, path, 3, np.random.default_rng(seed), start=start, goals=goals
        )
        check(occupancy, path, start, goals, obstacles)
