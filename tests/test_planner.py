"""Global paths and how they are followed: their clearance, what is refused; the shipped building."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import maps
from tools.draw_building import draw_building
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap, load_map, save_map
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.planning.follow import PathFollower
from unifg.scenarios.planning.grid import SPACING, path_exists, plan
from unifg.scenarios.planning.polyline import path_length
from unifg.scenarios.simulation.building import DEMO_GOALS, DEMO_START, building_map
from unifg.typing import Array

RADIUS = 0.17


def room(gap_cells: int = 8, yaw: float = 0.0) -> OccupancyMap:
    """A room of 6 m x 4 m, a wall across it at x = 3 m with one gap, unknown outside."""
    occupied = np.zeros((100, 140), dtype=bool)
    inside = np.zeros_like(occupied)
    inside[10:90, 10:130] = True
    occupied[9:91, 9:131] = True
    occupied[10:90, 10:130] = False
    occupied[10:90, 68:72] = True
    occupied[60 : 60 + gap_cells, 68:72] = False
    return OccupancyMap(occupied, inside & ~occupied, 0.05, (-0.5, -0.5, yaw), "room")


def turn(path: Array) -> Array:
    """Change of heading per metre along the path, without the goal's own heading."""
    return np.abs((np.diff(path[:-1, 2]) + math.pi) % (2.0 * math.pi) - math.pi) / SPACING


def check_path(path: Array, start: Array, goal: Array, field: DistanceMap, clearance: float) -> None:
    assert np.allclose(path[0, :2], start[:2])
    assert np.allclose(path[-1], goal)
    steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
    assert steps.max() < 1.02 * SPACING
    assert steps.min() > 0.9 * SPACING
    along = np.arctan2(*np.diff(path[:, :2], axis=0).T[::-1])
    off = (path[:-1, 2] - along + math.pi) % (2.0 * math.pi) - math.pi
    assert np.abs(off).max() < 0.25
    dense = np.vstack([path[:-1, :2] + f * np.diff(path[:, :2], axis=0) for f in (0.0, 0.25, 0.5, 0.75)])
    assert field.distance(dense).min() >= clearance


@pytest.mark.parametrize("gap", [8, 9, 12, 30])
def test_a_gap_is_passed_with_the_room_it_offers(gap: int) -> None:
    occupancy = room(gap)
    field = maps.field(occupancy)
    start, goal = np.array([1.0, 1.0, 0.0]), np.array([5.0, 1.0, 2.5])
    path = plan(occupancy, field, start, goal, robot_radius=RADIUS)
    check_path(path, start, goal, field, min(0.32, 0.05 * (gap - 1) / 2.0) - 1e-3)
    assert path_length(path) < 6.5


def test_a_gap_narrower_than_the_robot_is_no_way() -> None:
    occupancy = room(6)
    field = maps.field(occupancy)
    assert not path_exists(occupancy, field, (1, 1), (5, 1), RADIUS)
    with pytest.raises(ScenarioError, match=r"no way from \(1\.00, 1\.00\) to \(5\.00, 1\.00\).*choose another goal"):
        plan(occupancy, field, (1, 1, 0), (5, 1, 0), robot_radius=RADIUS)


def test_the_middle_of_a_corridor_is_preferred() -> None:
    occupied = np.ones((50, 400), dtype=bool)
    occupied[5:45, 5:395] = False
    occupancy = OccupancyMap(occupied, ~occupied, 0.05, (0.0, 0.0, 0.0))
    path = plan(occupancy, maps.field(occupancy), (1.0, 0.6, 0.0), (19.0, 1.8, 0.0), robot_radius=RADIUS)
    middle = path[(path[:, 0] > 4.0) & (path[:, 0] < 16.0)]
    assert np.abs(middle[:, 1] - 1.25).max() < 0.3
    assert path_length(path) < 18.3


def test_an_oblique_line_over_open_floor_is_straight() -> None:
    occupied = np.zeros((200, 200), dtype=bool)
    occupancy = OccupancyMap(occupied, ~occupied, 0.05, (0.0, 0.0, 0.3))
    ends = occupancy.grid_to_world(np.array([[20.3, 31.7], [170.2, 90.1]]))
    start, goal = np.append(ends[0], 1.0), np.append(ends[1], -1.0)
    path = plan(occupancy, maps.field(occupancy), start, goal, robot_radius=RADIUS)
    assert path_length(path) < 1.001 * float(np.hypot(*(ends[1] - ends[0])))
    assert turn(path).max() < 0.3


def test_the_path_of_a_turned_map_is_the_turned_path() -> None:
    plain, turned = room(), room(yaw=0.9)
    ends = plain.world_to_grid(np.array([[1.0, 1.0], [5.0, 1.0]]))
    start, goal = turned.grid_to_world(ends)
    path = plan(plain, maps.field(plain), (1, 1, 0), (5, 1, 0), robot_radius=RADIUS)
    other = plan(turned, maps.field(turned), (*start, 0), (*goal, 0), robot_radius=RADIUS)
    assert abs(path_length(path) - path_length(other)) < 0.05  # rounding decides between equal grid paths
    assert maps.field(turned).distance(other[:, :2]).min() >= 0.17


def test_discs_are_avoided_and_can_close_the_way() -> None:
    occupancy = room(30)
    field = maps.field(occupancy)
    disc = np.array([[2.0, 3.0, 0.25]])
    start, goal = np.array([1.0, 3.0, 0.0]), np.array([5.0, 3.2, 0.0])
    path = plan(occupancy, field, start, goal, robot_radius=RADIUS, extra_discs=disc)
    apart = np.hypot(*(path[:, :2] - disc[0, :2]).T) - 0.25
    assert 0.31 <= apart.min() < 0.7
    assert np.allclose(field.values, maps.field(occupancy).values)  # the map itself is left alone
    assert path_exists(occupancy, field, start, goal, 0.25, disc)
    assert not path_exists(occupancy, field, start, goal, 0.25, [[3.0, 3.25, 0.4]])
    assert path_exists(occupancy, field, start, goal, 0.25, [[3.0, 2.7, 0.2]])
    with pytest.raises(ScenarioError, match="no way"):
        plan(occupancy, field, start, goal, robot_radius=RADIUS, extra_discs=[[3.0, 3.25, 0.6]])


@pytest.mark.parametrize("radius", [0.5, 2.2, 3.0])
def test_discs_are_avoided_by_robots_of_any_size(radius: float) -> None:
    walls = np.zeros((200, 200), dtype=bool)
    floor = OccupancyMap(walls, ~walls, 0.1, (0.0, 0.0, 0.0))
    field = DistanceMap.from_occupancy(walls, 0.1, floor.origin)
    disc = np.array([[10.0, 10.3, 0.4]])
    path = plan(floor, field, [4.0, 10.0], [16.0, 10.0, 0.0], robot_radius=radius, extra_discs=disc)
    assert np.hypot(*(path[:, :2] - disc[0, :2]).T).min() - 0.4 >= radius
    between = np.array([[10.0, y, 0.4] for y in np.arange(0.0, 21.0, 2.0 * radius)])
    assert not path_exists(floor, field, [4.0, 10.0], [16.0, 10.0], 2.0 * radius, between)


def test_unknown_cells_are_not_driven_through() -> None:
    occupancy = room(30)
    free = occupancy.free.copy()
    free[60:90, 68:72] = False
    closed = OccupancyMap(occupancy.occupied, free, 0.05, occupancy.origin, "closed")
    assert path_exists(occupancy, maps.field(occupancy), (1, 1), (5, 1), 0.25)
    assert not path_exists(closed, maps.field(closed), (1, 1), (5, 1), 0.25)


@pytest.mark.parametrize(
    ("start", "goal", "words"),
    [
        ((1, 1, 0), (50, 1, 0), r"goal \(50\.00, 1\.00\) lies outside map 'room'"),
        ((3.0, 1, 0), (1, 1, 0), r"start \(3\.00, 1\.00\) lies in an occupied cell"),
        ((1, 1, 0), (-0.3, 1, 0), r"goal \(-0\.30, 1\.00\) lies in an unknown cell"),
        ((0.1, 1, 0), (1, 1, 0), r"start \(0\.10, 1\.00\) is 0\.100 m from the nearest wall"),
        ((1, math.nan, 0), (1, 1, 0), "start .* is not finite"),
    ],
)
def test_places_where_no_robot_can_stand_are_refused(
    start: tuple[float, ...], goal: tuple[float, ...], words: str
) -> None:
    occupancy = room()
    with pytest.raises(ScenarioError, match=words):
        plan(occupancy, maps.field(occupancy), start, goal, robot_radius=RADIUS)


@pytest.mark.parametrize("apart", [0.0, 0.01, 0.3])
def test_a_goal_at_hand_still_gives_two_poses(apart: float) -> None:
    occupancy = room()
    path = plan(occupancy, maps.field(occupancy), (1.012, 1.033, 0), (1.012 + apart, 1.033, 2.0), robot_radius=RADIUS)
    assert len(path) >= 2
    assert np.allclose(path[-1], (1.012 + apart, 1.033, 2.0))
    assert path_length(path) < apart + 0.05
    PathFollower(path).reference((1.0, 1.0), 0.06 * np.arange(5.0))


def eight() -> Array:
    """A path that crosses itself in its middle."""
    t = np.linspace(0.0, 2.0 * math.pi, 600)
    points = np.column_stack([4.0 * np.sin(t), 2.0 * np.sin(2.0 * t)])
    along = np.gradient(points, axis=0)
    return np.column_stack([points, np.arctan2(along[:, 1], along[:, 0])])


def test_the_reference_follows_a_path_that_crosses_itself() -> None:
    path = eight()
    follower = PathFollower(path)
    arc, seen = 0.0, []
    for pose in path[::5]:
        poses, arc = follower.reference(pose[:2] + 0.05, 0.06 * np.arange(31.0), arc)
        seen.append(arc)
        assert poses.shape == (31, 3)
        assert np.hypot(*(poses[0, :2] - pose[:2])) < 0.12
    assert np.all(np.diff(seen) >= 0.0)
    true_arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])[::5]
    assert np.abs(np.array(seen) - true_arc).max() < 0.12
    assert arc > follower.length - 0.3


def test_the_reference_is_spaced_turns_with_the_path_and_ends_at_the_goal() -> None:
    path = eight()
    path[-1, 2] = -1.0
    follower = PathFollower(path)
    poses, reached = follower.reference(path[100], 0.06 * np.arange(40.0), 3.0)
    assert abs(np.hypot(*(poses[0, :2] - path[100, :2]))) < 1e-6
    assert np.allclose(np.hypot(*np.diff(poses[:, :2], axis=0).T), 0.06, rtol=5e-3)
    direction = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    assert np.abs((poses[:-1, 2] - direction + math.pi) % (2 * math.pi) - math.pi).max() < 0.05
    assert np.all((poses[:, 2] >= -math.pi) & (poses[:, 2] < math.pi))
    assert reached > 3.0
    poses, reached = follower.reference(path[-3], 0.06 * np.arange(40.0), follower.length - 0.5)
    assert np.array_equal(poses[-1], path[-1])
    assert np.array_equal(poses[5:], np.repeat(path[-1:], 35, axis=0))
    assert np.abs(poses[0, 2] - path[-3, 2]) < 0.05  # the goal's heading is not blended in before the goal
    past, reached = follower.reference((9.0, 9.0), 0.06 * np.arange(3.0), follower.length + 1.0)
    assert reached == follower.length
    assert np.array_equal(past, np.repeat(path[-1:], 3, axis=0))


def test_the_reference_never_goes_back_and_a_follower_remembers_nothing() -> None:
    path = eight()
    used = PathFollower(path)
    used.reference(path[90], 0.06 * np.arange(10.0), 0.0)
    once, arc = used.reference(path[50], 0.06 * np.arange(10.0), 0.0)
    again, arc_again = PathFollower(path).reference(path[50], 0.06 * np.arange(10.0), 0.0)
    assert np.array_equal(once, again)
    assert arc == arc_again
    assert used.reference(path[0], 0.06 * np.arange(10.0), 3.0)[1] == 3.0


@pytest.fixture(scope="module")
def building() -> OccupancyMap:
    return building_map()


def test_the_shipped_building_is_what_the_generator_draws(building: OccupancyMap, tmp_path: Path) -> None:
    drawn = draw_building()
    assert np.array_equal(building.occupied, drawn.occupied)
    assert np.array_equal(building.free, drawn.free)
    assert (building.resolution, building.origin, building.name) == (
        drawn.resolution,
        drawn.origin,
        drawn.name,
    )
    save_map(tmp_path / "building.yaml", drawn)
    shipped = Path(__file__).parents[1] / "scenarios" / "simulation"
    for name in ("building.yaml", "building.pgm"):
        assert (tmp_path / name).read_bytes() == (shipped / name).read_bytes()


def test_every_room_of_the_building_can_be_reached(building: OccupancyMap) -> None:
    open_cells = building.free & (maps.field(building).values >= 0.25)
    labels, _ = ndimage.label(open_cells)
    sizes = np.bincount(labels.ravel())[1:]
    # What is left over are nooks behind furniture of less than half a square metre.
    assert np.sort(sizes)[:-1].max() * building.resolution**2 < 0.5
    assert sizes.max() * building.resolution**2 > 600.0
    assert 0.05 < 1.0 - (building.occupied | building.free).mean() < 0.2


def test_the_building_looks_different_when_mirrored_or_turned(building: OccupancyMap) -> None:
    inside = building.occupied[20:-20, 20:-20]
    for other in (inside[::-1], inside[:, ::-1], inside[::-1, ::-1]):
        assert (inside & other).sum() < 0.5 * inside.sum()


def test_the_demonstration_route(building: OccupancyMap) -> None:
    field = maps.field(building)
    start, total = np.array(DEMO_START), 0.0
    for goal in np.array(DEMO_GOALS):
        path = plan(building, field, start, goal, robot_radius=RADIUS)
        check_path(path, start, goal, field, 0.32 - 1e-3)
        assert turn(path).max() < 2.0
        total += path_length(path)
        start = goal
    assert 45.0 < total < 60.0


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "stops", "longest", "clearance"),
    [
        ("dis-B1-2011-09-27", [(2.3, 30, -1.57), (10, 1.7, 0), (26, 1.7, 0)], 52.0, 0.5),
        ("turtlebot3_world", [(-2, -0.5, 0), (2, -0.5, 0)], 4.1, 0.32),
        ("turtlebot3_world", [(-2, -0.5, 0), (0.5, 0.5, 1.57)], 3.2, 0.32),
    ],
)
def test_real_maps(
    shared_data: Path, name: str, stops: list[tuple[float, float, float]], longest: float, clearance: float
) -> None:
    occupancy = load_map(shared_data / "maps" / f"{name}.yaml")
    field = maps.field(occupancy)
    total = 0.0
    for start, goal in pairwise(stops):
        path = plan(occupancy, field, start, goal, robot_radius=RADIUS)
        check_path(path, np.array(start), np.array(goal), field, clearance)
        total += path_length(path)
    assert total < longest
