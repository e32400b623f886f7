"""Errors unknown to the robot: scans that take time, false returns, maps that are wrong; each against its law."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import maps
from episodes import room
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.planning.grid import path_exists
from unifg.scenarios.simulation.building import building_map
from unifg.scenarios.simulation.imperfection import MOVED, Imperfection, imperfect
from unifg.scenarios.simulation.plane import EDGE, LidarModel, OdometryModel, World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

QUIET, EXACT = LidarModel(sigma=0.0, dropout=0.0), OdometryModel(scale_sigma=0.0, noise_sigma=0.0)
START, GOALS = np.array([3.0, 25.2, 0.0]), np.array([[5.5, 25.2, 0.0], [13.5, 14.1, 0.0]])


def looking(lidar: LidarModel, *obstacles: Obstacle, start: tuple[float, float, float] = (1.0, 1.5, 0.0)) -> World:
    """A world in a room."""
    return World(room(), start, obstacles, np.random.default_rng(5), lidar=lidar, odometry=EXACT)


@pytest.mark.parametrize(("v", "omega"), [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_a_scan_that_takes_time_sees_from_where_the_robot_was(v: float, omega: float) -> None:
    """Every beam is what a still lidar sees where the robot was at its moment; the last is of now."""
    duration = 0.1
    world = looking(replace(QUIET, turn=duration))
    before = world.pose
    still = looking(QUIET, start=tuple(before.tolist())).scan().ranges
    np.testing.assert_allclose(world.scan().ranges, still)  # it has not moved yet
    world.step(v, omega)
    world.step(v, omega)
    seen = world.scan()
    count = len(seen.angles)
    for beam in (0, count // 3, count - 1):
        time = 0.2 - duration * (count - 1 - beam) / count
        turn, chord = omega * time, v * time * float(np.sinc(omega * time / (2.0 * math.pi)))
        middle = before[2] + 0.5 * turn
        place = before + np.array([chord * math.cos(middle), chord * math.sin(middle), turn])
        expected = looking(QUIET, start=tuple(place.tolist())).scan().ranges[beam]
        assert seen.ranges[beam] == pytest.approx(expected, abs=2e-3)


def test_clutter_returns_too_soon_from_anywhere() -> None:
    world, true = looking(replace(QUIET, clutter=0.1)), looking(QUIET).scan().ranges
    shares = np.concatenate([world.scan().ranges / true for _ in range(40)])
    early = shares[shares < 1.0 - 1e-9]
    assert len(early) / len(shares) == pytest.approx(0.1, abs=0.01)
    assert shares.max() <= 1.0 + 1e-9
    assert early.mean() == pytest.approx(0.5, abs=0.02) and early.std() == pytest.approx(math.sqrt(1 / 12), abs=0.02)


def test_mixed_pixels_lie_between_the_sides_of_an_edge() -> None:
    pole = Obstacle(np.array([2.5, 1.5]), 0.2)
    true = looking(QUIET, pole).scan().ranges
    world = looking(replace(QUIET, mixed=0.5), pole)
    scans = np.array([world.scan().ranges for _ in range(60)])
    edges = np.abs(true - np.roll(true, 1)) > EDGE
    assert 2 <= edges.sum() < 20
    np.testing.assert_allclose(scans[:, ~edges], np.tile(true[~edges], (60, 1)))
    low, high = np.minimum(true, np.roll(true, 1)), np.maximum(true, np.roll(true, 1))
    assert np.all((scans[:, edges] >= low[edges] - 1e-9) & (scans[:, edges] <= high[edges] + 1e-9))
    assert (np.abs(scans - true)[:, edges] > 1e-9).mean() == pytest.approx(0.5, abs=0.15)


def test_nothing_is_spoiled_unless_asked_for_and_nothing_shifts_the_noise() -> None:
    """With switches off a scan is what it was; with clutter the beams it spares keep their noise."""
    plain, spoiled = looking(LidarModel()).scan().ranges, looking(LidarModel(clutter=0.05)).scan().ranges
    same = np.isclose(plain, spoiled, equal_nan=True)
    assert 0.85 < same.mean() < 1.0


def moved_by(given: OccupancyMap, true: OccupancyMap) -> Array:
    """Distances [m] from the walls of the robot's map to those that are true."""
    field = maps.field(true)
    rows, columns = np.nonzero(given.occupied)
    middles = np.column_stack([columns, rows]).astype(np.float64) + 0.5
    return np.asarray(field.distance(given.grid_to_world(middles)))


def test_walls_stand_a_little_elsewhere() -> None:
    building, exact = building_map(), Imperfection()
    assert imperfect(building, exact, START, GOALS, np.random.default_rng(1)) == (building, building)
    given, true = imperfect(building, Imperfection(map_error=0.06), START, GOALS, np.random.default_rng(1))
    again = imperfect(building, Imperfection(map_error=0.06), START, GOALS, np.random.default_rng(1))[1]
    assert given is building and np.array_equal(again.occupied, true.occupied)
    assert not np.array_equal(true.occupied, building.occupied)
    assert not (true.occupied & true.free).any()
    off = moved_by(given, true)
    assert 0.02 < np.percentile(off, 99) < 0.25  # two or three deviations, and half a cell


def test_furniture_has_been_moved_and_leaves_a_way() -> None:
    building = building_map()
    given, true = imperfect(building, Imperfection(furniture=5), START, GOALS, np.random.default_rng(2))
    for occupancy, other in ((given, true), (true, given)):
        added = occupancy.occupied & ~building.occupied
        assert added.sum() * building.resolution**2 > 5 * 0.3**2 * 0.8
        assert (added & ~other.occupied).any()
        field = maps.field(occupancy)
        assert all(path_exists(occupancy, field, START, goal, 0.3) for goal in GOALS)
        assert field.distance(np.vstack([START[None, :2], GOALS[:, :2]])).min() > 0.3
    assert moved_by(given, true).max() < MOVED[1] + 0.05


def test_too_much_furniture_is_refused() -> None:
    with pytest.raises(ScenarioError, match="furniture"):
        imperfect(
            room(3.0, 2.0), Imperfection(furniture=50), np.array([0.2, 0.2, 0.0]), GOALS[:0], np.random.default_rng(0)
        )
