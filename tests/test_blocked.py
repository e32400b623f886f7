"""Obstacles that are not discs, ways that are too narrow, and goals that are given up by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from episodes import episode
from maps import field, walled
from unifg.errors import FileFormatError, ScenarioError
from unifg.files.ros_map import OccupancyMap, save_map
from unifg.models.distance_map import SmoothField
from unifg.scenarios import navigation
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.scenarios.perception.explaining import PointWatch, explained, thinned
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.grid import smoothed
from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array


def corridor(door: int = 0, length: float = 12.0) -> OccupancyMap:
    """A corridor of 2 m along x, its walls at y = 0 and y = 2, with a wall at x = 6 and a door of so many cells."""
    first, across = 22 - door // 2, slice(118, 122)
    blocks = [(slice(0, first), across), (slice(first + door, 44), across)] if door else []
    return walled(length, 2.2, 2, (0.0, -0.1, 0.0), "corridor", blocks)


FOUR = [Obstacle(np.array([6.0, y]), 0.25) for y in (0.25, 0.75, 1.25, 1.75)]


def settings(folder: Path, occupancy: OccupancyMap, start: float, *goals: float) -> NavigationSettings:
    """A drive along the middle of a corridor."""
    path = folder / "corridor.yaml"
    save_map(path, occupancy)
    poses = tuple((x, 1.0, 0.0 if x > start else np.pi) for x in goals)
    return NavigationSettings(map=path, start=(start, 1.0, 0.0), goals=poses, seed=3)


@pytest.mark.parametrize("solver", ["ipm", "alm"])
@pytest.mark.product(2, of="drives and flights")
def test_a_closed_corridor_is_not_hit_and_said_to_be_blocked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, solver: str
) -> None:
    monkeypatch.setattr(navigation, "place_obstacles", lambda *_, **__: FOUR)
    chosen = settings(tmp_path, corridor(), 3.5, 10.0, 3.0)
    log = run_navigation(NavigationSettings(**{**vars(chosen), "solver": solver}))
    assert log.collisions == 0 and log.clearance.min() > 0.0
    assert log.outcomes[0].startswith("blocked near (5.") and "no way of clearance 0.22 m" in log.outcomes[0]
    assert log.outcomes[1] == "reached" and log.reached == [False, True]
    assert log.ticks * log.dt < 30.0  # 12 to 28 s over eight seeds, by what rounding makes of plans that cannot be
    assert episode_metrics(log)["outcomes"] == log.outcomes and not log.succeeded


def test_the_time_for_a_goal_is_that_of_the_longest_way_so_far(tmp_path: Path) -> None:
    """A detour that is nearly driven is short again, and no reason to give the goal up."""
    drive = navigation.Episode(settings(tmp_path, corridor(), 1.0, 10.0))
    drive.begin()
    leg = drive.legs[0]
    direct, short = leg.path, leg.path[-3:]
    detour = np.concatenate([direct, direct[::-1], direct])
    asked = [(direct, 10.0), (detour, 90.0), (short, 120.0), (short, 160.0), (short, 180.0)]
    found = []
    for path, now in asked:
        leg.path, drive.world.time = path, now
        found.append(drive._outcome(0))
    assert found == [None, None, None, None, "timed out"]  # 27 m in 108 s, and a minute
    drive._begin_leg(0)
    assert drive._outcome(0) is None


@pytest.mark.parametrize(("cells", "passes"), [(8, False), (9, False), (11, True)])
def test_a_door_is_passed_or_refused(tmp_path: Path, cells: int, passes: bool) -> None:
    chosen = settings(tmp_path, corridor(cells), 4.8, 7.2)
    if not passes:
        with pytest.raises(ScenarioError, match=r"radius 0\.17 m that keeps 0\.05 m from walls"):
            run_navigation(chosen)
        return
    log = run_navigation(chosen)
    assert log.outcomes == ["reached"] and log.collisions == 0 and not log.emergency.any()


def test_planner_and_controller_have_one_field() -> None:
    occupancy = corridor(9)
    values, rows = field(occupancy), np.arange(18, 27)
    centres = occupancy.grid_to_world(np.column_stack([np.full(len(rows), 120), rows]) + 0.5)
    smooth = SmoothField(values).distance(centres)
    assert np.allclose(smoothed(values.values)[rows, 120], smooth)
    assert smooth.max() < values.values[rows, 120].max(), "the controller finds the door narrower than the grid does"


# ------------------------------------------------------------------------ points


def look(world: World, pose: Array, watch: PointWatch, tracks: Tracks, times: int = 1) -> Array:
    """Points after so many scans from where the robot stands."""
    distance_map = field(world.occupancy)
    for _ in range(times):
        scan = world.scan()
        watch.update(explained(distance_map, scan, pose), tracks, len(scan.ranges))
    return watch.points


def test_what_is_seen_twice_and_no_disc_becomes_points() -> None:
    pose = np.array([3.5, 1.0, 0.0])
    world = World(corridor(), pose, FOUR, np.random.default_rng(0))
    watch = PointWatch()
    assert len(look(world, pose, watch, Tracks.none())) == 0, "once may be clutter"
    points = look(world, pose, watch, Tracks.none())
    assert len(points) > 8 and np.ptp(points[:, 1]) > 1.5
    away = np.abs(np.hypot(*(points[:, None] - np.array([d.centre for d in FOUR])).transpose(2, 0, 1)) - 0.25)
    assert away.min(axis=1).max() < 0.08, "they lie on the rims"
    chosen = Tracks.of_movers(np.array([d.centre for d in FOUR]), np.zeros((4, 2)), np.full(4, 0.25))
    assert len(look(world, pose, watch, chosen, 2)) == 0, "tracked discs stand for them"
    standing = watch.tracks()
    assert not standing.mover.any() and not standing.velocity.any()


def test_an_empty_corridor_has_no_points_and_explains_its_beams() -> None:
    pose = np.array([3.5, 1.0, 0.4])
    world = World(corridor(), pose, (), np.random.default_rng(0))
    watch = PointWatch()
    assert len(look(world, pose, watch, Tracks.none(), 5)) == 0
    seen = explained(field(world.occupancy), world.scan(), pose)
    assert seen.share > 0.99
    assert explained(field(world.occupancy), world.scan(), np.array([3.5, 1.0, 1.6])).share < 0.5
    blind = Scan(world.lidar.angles, np.full(360, np.inf))
    assert explained(field(world.occupancy), blind, pose).share == 0.0


def test_single_beams_are_no_points() -> None:
    pose = np.array([3.5, 1.0, 0.0])
    world = World(corridor(), pose, (), np.random.default_rng(0))
    distance_map, watch = field(world.occupancy), PointWatch()
    for _ in range(3):
        scan = world.scan()
        ranges = scan.ranges.copy()
        ranges[180] = 1.5
        watch.update(explained(distance_map, Scan(scan.angles, ranges), pose), Tracks.none(), 360)
        assert len(watch.points) == 0


def test_thinning_keeps_one_point_of_a_square() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 1.0, (500, 2))
    kept = thinned(points, 0.25)
    assert len(kept) == 16 and all((points == row).all(axis=1).any() for row in kept)
    assert len(thinned(np.zeros((0, 2)), 0.25)) == 0


# ------------------------------------------------------------------------ the log


def test_a_drive_is_stored_so_that_others_can_read_it(tmp_path: Path) -> None:
    log = episode(12)
    path = tmp_path / "drive.npz"
    log.save(path)
    with np.load(path, allow_pickle=False) as file:  # as any program does
        about = json.loads(str(file["about"]))
        assert about["units"]["control"] == "m/s, rad/s" and about["kind"] == "unifg drive log 3"
        assert file["control"].shape == (12, 2) and file["health"][-1] == "degraded"
        assert file["route_lengths"].sum() == len(file["route"])
    again = EpisodeLog.load(path)
    for name, value in vars(log).items():
        other = getattr(again, name)
        if name in ("occupancy", "walls"):
            assert np.array_equal(value.occupied, other.occupied) and value.origin == other.origin
        elif isinstance(value, np.ndarray):
            assert value.dtype == other.dtype and np.array_equal(value, other, equal_nan=value.dtype.kind == "f"), name
        elif isinstance(value, list) and value and isinstance(value[0], np.ndarray):
            assert all(np.array_equal(a, b) for a, b in zip(value, other, strict=True)), name
        else:
            assert value == other, name


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: path.write_bytes(b""), "is no unifg drive log 3"),
        (lambda path: path.write_bytes(b"not a file"), "is no unifg drive log 3"),
        (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "is no unifg drive log 3"),
        (
            lambda path: np.savez(path, about=np.array('{"kind": "something else", "units": {}}')),
            "is no unifg drive log 3",
        ),
        (lambda path: path.unlink(), "drive.npz"),
    ],
)
def test_files_that_are_no_drive_are_refused(spoil: Any, words: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.npz"
    episode(3).save(path)
    spoil(path)
    with pytest.raises(FileFormatError, match=words):
        EpisodeLog.load(path)
