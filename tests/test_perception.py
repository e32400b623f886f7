"""Perception of obstacles that are not on the map, by lidar alone: their positions and their motion."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest

from maps import field, walled
from unifg.files.ros_map import OccupancyMap, load_map
from unifg.scenarios.perception.disc_tracker import DiscTracker
from unifg.scenarios.perception.discs import DiscFinder
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks, nearest
from unifg.scenarios.planning.grid import plan
from unifg.scenarios.simulation.plane import LidarModel, World
from unifg.scenarios.simulation.space import Mover, Obstacle, Space
from unifg.typing import Array, ArrayLike

DT = 0.1


def hall(pillar: bool = False) -> OccupancyMap:
    """A hall of 10 m by 8 m, and perhaps a mapped pillar of 0.5 m in its middle."""
    return walled(10.0, 8.0, blocks=[np.s_[75:85, 95:105]] if pillar else [])


def disc(x: float, y: float, radius: float = 0.2) -> Obstacle:
    """A fixed disc."""
    return Obstacle(np.array([x, y]), radius)


def watch(world: World, tracker: DiscTracker, ticks: int, noise: Array, rng: np.random.Generator) -> Tracks:
    """Stand still for some ticks and track; returns the last tracks."""
    tracks = tracker.tracks()
    for _ in range(ticks):
        world.step(0.0, 0.0)
        tracks = tracker.update(world.scan(), world.pose + noise * rng.standard_normal(3), DT)
    return tracks


def follow(world: World, path: Array, tracker: DiscTracker, noise: Array, rng: np.random.Generator) -> list[Tracks]:
    """Drive along a path by pure pursuit of the true pose, tracking from a disturbed one."""
    seen: list[Tracks] = []
    reached = 0
    while reached < len(path) - 3 and len(seen) < 1000:
        pose = world.pose
        reached += int(np.argmin(np.linalg.norm(path[reached : reached + 40, :2] - pose[:2], axis=1)))
        aim = path[min(reached + 10, len(path) - 1), :2] - pose[:2]
        bearing = math.remainder(math.atan2(aim[1], aim[0]) - pose[2], 2.0 * math.pi)
        world.step(0.8 * math.cos(bearing) if abs(bearing) < 1.0 else 0.0, float(np.clip(2.5 * bearing, -1.0, 1.0)))
        seen.append(tracker.update(world.scan(), world.pose + noise * rng.standard_normal(3), DT))
    return seen


@pytest.mark.parametrize("distance", [0.6, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("radius", [0.15, 0.2, 0.25])
@pytest.mark.product(4)
def test_one_scan_places_a_disc(distance: float, radius: float) -> None:
    """From a single scan at the true pose the centre is right to 0.05 m, whatever the radius."""
    occupancy = hall()
    finder = DiscFinder(field(occupancy))
    errors, radii = [], []
    for seed in range(20):
        bearing = 0.3 * seed
        centre = np.array([5.0 + distance * math.cos(bearing), 4.0 + distance * math.sin(bearing)])
        world = World(occupancy, (5.0, 4.0, 0.1 * seed), [Obstacle(centre, radius)], np.random.default_rng(seed))
        discs = finder.find(world.scan(), world.pose)
        assert len(discs.radius) == 1
        errors.append(np.linalg.norm(discs.centre[0] - centre))
        radii.append(discs.radius[0] - radius)
    assert max(errors) < 0.05
    assert np.abs(radii).max() < 0.06


@pytest.mark.parametrize("distance", [1.0, 2.0, 2.9])
@pytest.mark.product(1)
def test_tracks_are_right_with_a_disturbed_estimate(distance: float) -> None:
    """After half a second the centre is right to 0.05 m although each pose is off by 0.02 m and 0.006 rad."""
    occupancy = hall(pillar=True)
    noise = np.array([0.02, 0.02, 0.006])
    for seed in range(15):
        rng = np.random.default_rng(seed)
        world = World(occupancy, (3.0, 2.0, 0.4), [disc(3.0, 2.0 + distance)], rng)
        tracks = watch(world, DiscTracker(field(occupancy)), 6, noise, np.random.default_rng(100 + seed))
        assert len(tracks) == 1
        assert np.linalg.norm(tracks.centre[0] - (3.0, 2.0 + distance)) < 0.05
        assert tracks.velocity.tolist() == [[0.0, 0.0]]
        assert tracks.radius[0] == pytest.approx(0.2, abs=0.03)


def test_two_hits_confirm() -> None:
    """One sighting is not yet an obstacle; the second makes it one, under an identity that stays."""
    occupancy = hall()
    world = World(occupancy, (3.0, 4.0, 0.0), [disc(4.5, 4.0), disc(3.0, 6.0)], np.random.default_rng(0))
    tracker = DiscTracker(field(occupancy))
    assert len(tracker.update(world.scan(), world.pose, DT)) == 0
    second = tracker.update(world.scan(), world.pose, DT)
    third = tracker.update(world.scan(), world.pose, DT)
    assert len(second) == 2
    assert second.identity.tolist() == third.identity.tolist()


def test_mapped_things_are_not_obstacles() -> None:
    """Walls and a pillar on the map give no tracks; the pillar missing from the map does."""
    world = World(hall(pillar=True), (3.0, 4.0, 0.0), rng=np.random.default_rng(0))
    assert len(watch(world, DiscTracker(field(hall(pillar=True))), 30, np.zeros(3), np.random.default_rng(0))) == 0
    found = watch(world, DiscTracker(field(hall())), 5, np.zeros(3), np.random.default_rng(0))
    assert len(found) >= 1
    assert np.linalg.norm(found.centre - (5.0, 4.0), axis=1).min() < 0.25


def test_wide_things_become_several_discs() -> None:
    """An unmapped wall of two metres is covered by discs along its whole face."""
    solid = walled(10.0, 8.0, blocks=[np.s_[60:100, 100:104]])
    world = World(solid, (3.0, 4.0, 0.0), rng=np.random.default_rng(0))
    tracks = watch(world, DiscTracker(field(hall())), 5, np.zeros(3), np.random.default_rng(0))
    face = np.stack([np.full(41, 5.0), np.linspace(3.0, 5.0, 41)], axis=1)
    gap = np.linalg.norm(face[:, None] - tracks.centre[None], axis=2) - tracks.radius
    assert len(tracks) >= 3
    assert gap.min(axis=1).max() < 0.25


@pytest.mark.parametrize("heading", [0.0, 1.2, 2.4, -1.9])
@pytest.mark.product(1)
def test_velocity_of_a_mover(heading: float) -> None:
    """One second after it was first seen, the velocity of a mover at 0.3 m/s is right to 0.1 m/s."""
    occupancy = hall()
    direction = np.array([math.cos(heading), math.sin(heading)])
    errors = []
    for seed in range(12):
        middle = np.array([5.0, 4.0]) + 2.0 * np.array([math.cos(seed), math.sin(seed)])
        mover = Obstacle(middle - 0.6 * direction, 0.2, middle + 0.8 * direction, 0.3)
        world = World(occupancy, (5.0, 4.0, 0.0), [mover], np.random.default_rng(seed))
        world.step(0.0, 0.0)
        noise = np.array([0.01, 0.01, 0.004])
        tracks = watch(world, DiscTracker(field(occupancy)), 11, noise, np.random.default_rng(50 + seed))
        assert len(tracks) == 1
        assert np.linalg.norm(tracks.centre[0] - world.discs()[0, :2]) < 0.08
        errors.append(np.linalg.norm(tracks.velocity[0] - 0.3 * direction))
    assert np.mean(errors) < 0.06
    assert max(errors) < 0.1


class Waiting:
    """Goes along -x at 0.3 m/s, and stands before a robot at rest."""

    def velocity(self, mover: Mover, space: Space, dt: float) -> tuple[float, float]:
        gap = mover.body.position.get_distance(space.vehicle.position) - mover.radius - space.radius
        return (0.0 if gap < 0.1 and space.vehicle.velocity.length < 0.02 else -0.3), 0.0


def waiting() -> tuple[World, DiscTracker, np.random.Generator]:
    """A robot in the middle of the hall, and a mover that comes and waits for it."""
    mover = Mover(np.array([6.5, 4.0]), 0.2, Waiting())
    world = World(hall(), (5.0, 4.0, 0.0), [], np.random.default_rng(4), people=[mover])
    return world, DiscTracker(field(hall())), np.random.default_rng(5)


def met(
    begin: tuple[float, float], end: tuple[float, float], speed: float = 0.3, seed: int = 4
) -> tuple[World, DiscTracker, np.random.Generator]:
    """A robot in the middle of the hall, and a mover that goes to and fro between two points."""
    occupancy, mover = hall(), Obstacle(np.array(begin), 0.2, np.array(end), speed)
    world = World(occupancy, (5.0, 4.0, 0.0), [mover], np.random.default_rng(seed))
    return world, DiscTracker(field(occupancy)), np.random.default_rng(5)


@pytest.mark.product(1, of="tracks")
def test_mover_that_turns_round_is_followed() -> None:
    """Over turns the track stays one, and near the mover."""
    world, tracker, rng = met((4.0, 5.5), (6.0, 5.5))
    identities: set[int] = set()
    away: list[float] = []
    for _ in range(200):
        tracks = watch(world, tracker, 1, np.array([0.01, 0.01, 0.003]), rng)
        identities |= set(tracks.identity.tolist())
        if len(tracks):
            away.append(float(np.linalg.norm(tracks.centre[0] - world.discs()[0, :2])))
    assert len(identities) == 1
    assert max(away[10:]) < 0.15
    assert np.mean(away) < 0.06


@pytest.mark.parametrize("speed", [0.3, 0.6, 1.0, 1.5])
@pytest.mark.product(1, of="tracks")
def test_a_mover_that_turns_round_is_believed_soon(speed: float) -> None:
    """From where it turns it goes a forearm, at any speed, to where its track thought that it would not be."""
    length, wrong = 2.2, []
    for seed in range(3):
        begin = 3.8 + 0.2 * seed
        world, tracker, rng = met((begin, 5.3), (begin + length, 5.3), speed, seed)
        turn = math.ceil(length / speed / DT - 1e-9)
        watch(world, tracker, turn - 10, np.zeros(3), rng)
        found = np.array([watch(world, tracker, 1, np.array([0.005, 0.005, 0.002]), rng).velocity[0, 0]
                          for _ in range(10 + round(1.5 / speed / DT))])  # fmt: skip
        assert np.abs(found[4:9] - speed).max() < 0.1
        wrong.append(DT * np.abs(found[10:] + speed).sum())
    assert np.mean(wrong) < 0.35


@pytest.mark.product(1, of="tracks")
def test_mover_that_waited_is_followed_when_it_goes_on() -> None:
    """A mover that has stood for two seconds, for the robot's sake, is not left behind by its track."""
    world, tracker, rng = waiting()
    still = np.zeros(3)
    waited = 0
    for _ in range(80):
        before = world.discs()[0, :2]
        watch(world, tracker, 1, still, rng)
        waited += bool(np.allclose(world.discs()[0, :2], before))
    assert waited > 20
    away = []
    for _ in range(12):
        tracks = tracker.update(world.scan(), world.pose, 0.1)
        away.append(float(np.linalg.norm(tracks.centre[0] - world.discs()[0, :2])))
        world.step(-1.0, 0.0)  # no longer at rest: the mover goes on
    assert max(away) < 0.05


@pytest.mark.parametrize("waits", [5.0, 12.0])
@pytest.mark.product(1, of="tracks")
def test_a_mover_that_has_stood_for_long_stands(waits: float) -> None:
    """Ten seconds in one place; and when it goes on then, that is seen as of any other."""
    world, tracker, rng = waiting()
    watch(world, tracker, 41, np.zeros(3), rng)  # it has come to the robot and waits from then on
    assert tracker.tracks().mover.tolist() == [True]
    tracks = watch(world, tracker, round(10.0 * waits), np.zeros(3), rng)
    assert tracks.mover.tolist() == [waits < 10.0] and not tracks.velocity.any()
    x, y = world.discs()[0, :2]
    assert np.hypot(*(tracks.centre[0] - [x, y])) < 0.04
    world.carry(np.array([2.0, 6.5, 0.0]))
    again = [watch(world, tracker, 1, np.zeros(3), rng) for _ in range(12)]
    assert any(seen.mover.any() for seen in again)


@pytest.mark.parametrize("speed", [0.2, 0.5])
@pytest.mark.product(1, of="tracks")
def test_one_who_goes_to_and_fro_stays_a_mover(speed: float) -> None:
    world, tracker, rng = met((4.0, 5.5), (4.8, 5.5), speed)
    watch(world, tracker, 60, np.zeros(3), rng)
    assert all(watch(world, tracker, 10, np.zeros(3), rng).mover.all() for _ in range(20))


def test_memory_of_things_out_of_view() -> None:
    """A fixed disc behind a pillar is remembered; a mover is forgotten after a second and a half."""
    occupancy = hall(pillar=True)
    fixed = disc(8.0, 4.0)
    tracker = DiscTracker(field(occupancy))
    beside = World(occupancy, (5.0, 2.0, 0.0), [fixed], np.random.default_rng(0))
    watch(beside, tracker, 5, np.zeros(3), np.random.default_rng(0))
    behind = World(occupancy, (3.0, 4.0, 0.0), [fixed], np.random.default_rng(0))
    remembered = watch(behind, tracker, 40, np.zeros(3), np.random.default_rng(0))
    assert len(remembered) == 1
    assert remembered.unseen[0] == pytest.approx(4.0)
    assert np.linalg.norm(remembered.centre[0] - (8.0, 4.0)) < 0.05

    mover = Obstacle(np.array([7.3, 3.0]), 0.2, np.array([7.3, 5.0]), 0.3)
    tracker = DiscTracker(field(occupancy))
    beside = World(occupancy, (5.0, 2.0, 0.0), [mover], np.random.default_rng(0))
    moving = watch(beside, tracker, 20, np.zeros(3), np.random.default_rng(0))
    assert np.linalg.norm(moving.velocity, axis=1).tolist() == pytest.approx([0.3], abs=0.1)
    hidden = World(occupancy, (3.0, 4.0, 0.0), rng=np.random.default_rng(0))
    for _ in range(20):  # a scan that tells nothing: every beam lost
        silent = Scan(hidden.scan().angles, np.full(360, np.nan))
        tracks = tracker.update(silent, hidden.pose, DT)
    assert len(tracks) == 0


def test_disc_taken_away_is_dropped() -> None:
    """Beams that pass clearly through a remembered disc end it within half a second."""
    occupancy = hall()
    tracker = DiscTracker(field(occupancy))
    there = World(occupancy, (3.0, 4.0, 0.0), [disc(5.0, 4.0)], np.random.default_rng(0))
    assert len(watch(there, tracker, 10, np.zeros(3), np.random.default_rng(0))) == 1
    gone = World(occupancy, (3.0, 4.0, 0.0), rng=np.random.default_rng(0))
    assert len(watch(gone, tracker, 1, np.zeros(3), np.random.default_rng(0))) == 1
    assert len(watch(gone, tracker, 4, np.zeros(3), np.random.default_rng(0))) == 0


def test_nearest_looks_ahead() -> None:
    """Hulls count, not centres, and a mover that approaches counts where it will be."""
    tracks = Tracks(
        centre=np.array([[3.0, 0.0], [0.0, 1.0], [-2.0, 0.0], [0.0, -1.05]]),
        velocity=np.array([[-1.9, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]),
        radius=np.array([0.2, 0.15, 0.2, 0.25]),
        identity=np.arange(4),
        unseen=np.zeros(4),
        mover=np.zeros(4, dtype=bool),
    )
    assert nearest(tracks, (0.0, 0.0, 1.0), 3).identity.tolist() == [0, 3, 1]
    assert nearest(tracks, (0.0, 0.0), 9, horizon=0.0).identity.tolist() == [3, 1, 2, 0]
    empty = tracks.at(np.zeros(4, dtype=bool))
    assert len(nearest(empty, (0.0, 0.0), 3)) == 0


def test_poor_scans_are_survived() -> None:
    """All beams lost, none returned, everything unexplained: no error, no track from nothing."""
    occupancy = hall()
    angles = World(occupancy, (5.0, 4.0, 0.0), lidar=LidarModel()).scan().angles
    tracker = DiscTracker(field(occupancy))
    for ranges in (np.full(360, np.nan), np.full(360, np.inf), np.where(np.arange(360) == 5, 1.0, np.inf)):
        for _ in range(3):
            assert len(tracker.update(Scan(angles, ranges), (5.0, 4.0, 0.0), DT)) == 0
    for _ in range(3):
        tracks = tracker.update(Scan(angles, np.full(360, 1.0)), (5.0, 4.0, 0.0), DT)
    assert len(tracks) > 5


@pytest.mark.data
@pytest.mark.product(1, of="tracks")
def test_empty_building_gives_no_tracks(shared_data: Path) -> None:
    """Fifty metres through the real building, the estimate off by 0.03 m and 0.008 rad: no false tracks."""
    occupancy = load_map(shared_data / "maps" / "dis-B1-2011-09-27.yaml")
    distance_map = field(occupancy)
    path = plan(occupancy, distance_map, (2.3, 30.0, -1.57), (26.0, 1.7, 0.0), robot_radius=0.17)
    world = World(occupancy, (2.3, 30.0, -1.57), rng=np.random.default_rng(0))
    seen = follow(world, path, DiscTracker(distance_map), np.array([0.03, 0.03, 0.008]), np.random.default_rng(1))
    assert len(seen) > 400
    assert np.linalg.norm(world.pose[:2] - (26.0, 1.7)) < 0.5
    assert sum(len(tracks) > 0 for tracks in seen) == 0


@pytest.mark.data
@pytest.mark.product(1, of="tracks")
def test_discs_in_the_building(shared_data: Path) -> None:
    """Discs beside a drive through the real building are found, placed to 0.05 m within 3 m, and quickly."""
    occupancy = load_map(shared_data / "maps" / "dis-B1-2011-09-27.yaml")
    distance_map = field(occupancy)
    path = plan(occupancy, distance_map, (2.3, 30.0, -1.57), (10.0, 1.7, 0.0), robot_radius=0.17)
    obstacles = []
    for index in (120, 240, 360, 480):
        x, y, theta = path[index]
        side = np.array([-math.sin(theta), math.cos(theta)])
        options = [np.array([x, y]) + sign * 0.45 * side for sign in (1.0, -1.0)]
        centre = max(options, key=lambda c: float(distance_map.distance(c[None])[0]))
        obstacles.append(Obstacle(centre, 0.18))
    world = World(occupancy, (2.3, 30.0, -1.57), obstacles, np.random.default_rng(0))
    centres = np.array([o.centre for o in obstacles])
    spent: list[float] = []
    errors: list[float] = []

    class Judged(DiscTracker):
        """A tracker whose answers are timed and held against the truth."""

        def update(self, scan: Scan, pose: ArrayLike, dt: float) -> Tracks:
            begin = time.thread_time()
            tracks = super().update(scan, pose, dt)
            spent.append(time.thread_time() - begin)
            near = np.linalg.norm(tracks.centre - world.pose[:2], axis=1) < 3.0
            fresh = tracks.at(near & (tracks.unseen == 0.0))
            errors.extend(np.linalg.norm(fresh.centre[:, None] - centres[None], axis=2).min(axis=1).tolist())
            return tracks

    noise = np.array([0.015, 0.015, 0.005])
    seen = follow(world, path, Judged(distance_map), noise, np.random.default_rng(1))
    assert world.collisions == 0
    assert len(seen[-1]) == 4
    assert len(errors) > 150
    assert np.quantile(errors, 0.99) < 0.05
    assert max(errors) < 0.08
    assert np.median(spent) < 0.005  # typically 0.6 ms
