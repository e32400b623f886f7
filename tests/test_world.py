"""The simulated truth: walls hold, sensors are as noisy as promised, contacts are counted, seeds repeat."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest

from maps import walled
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap, load_map
from unifg.models.lidar import beam_endpoints
from unifg.scenarios.planning.polyline import polyline_distance
from unifg.scenarios.simulation.plane import LidarModel, OdometryModel, World
from unifg.scenarios.simulation.rectangles import surface_cells, wall_rectangles
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array, BoolArray

QUIET = LidarModel(sigma=0.0, dropout=0.0)
EXACT = OdometryModel(scale_sigma=0.0, noise_sigma=0.0)


def room(width: float = 6.0, height: float = 4.0, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> OccupancyMap:
    """A room with walls one cell thick; its inside begins one cell (0.05 m) from the origin."""
    return walled(width, height, origin=origin, name="room")


def quiet_world(start: tuple[float, float, float], *obstacles: Obstacle, seed: int = 0) -> World:
    """A noiseless world in the room."""
    return World(room(), start, obstacles, np.random.default_rng(seed), lidar=QUIET, odometry=EXACT)


@pytest.mark.parametrize("density", [0.05, 0.4, 0.8])
def test_rectangles_cover_surface_and_nothing_free(density: float) -> None:
    """The union of the rectangles lies in the occupied cells and holds all that can be seen."""
    occupied: BoolArray = np.random.default_rng(1).random((40, 55)) < density
    covered = np.zeros_like(occupied)
    for low, high, left, right in wall_rectangles(occupied):
        assert high > low and right > left
        covered[low:high, left:right] = True
    assert not (covered & ~occupied).any()
    assert covered[surface_cells(occupied)].all()


def test_rectangles_of_plain_shapes_are_few() -> None:
    """A room needs four rectangles, a solid block one, an empty grid none."""
    assert len(wall_rectangles(room().occupied)) == 4
    assert wall_rectangles(np.ones((20, 30), dtype=bool)).tolist() == [[0, 20, 0, 30]]
    assert wall_rectangles(np.zeros((20, 30), dtype=bool)).shape == (0, 4)


def test_polyline_distance() -> None:
    """Beside a segment, beyond an end, and to a path of one point."""
    path = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 1.57]])
    points = np.array([[1.0, 0.5], [-3.0, 4.0], [2.5, 1.0]])
    np.testing.assert_allclose(polyline_distance(points, path), [0.5, 5.0, 0.5])
    np.testing.assert_allclose(polyline_distance(points[:1], path[:1]), [math.hypot(1.0, 0.5)])


@pytest.mark.parametrize("v, omega", [(1.0, 1.0), (0.7, 0.0), (-0.4, 0.9), (0.0, -1.0)])
def test_free_motion_follows_the_arc(v: float, omega: float) -> None:
    """Every tick, the first too, moves along the exact arc of its own command."""
    world = quiet_world((3.0, 2.0, 0.3))
    world.step(v, omega)
    world.step(-v, 0.5 * omega)
    pose = np.array([3.0, 2.0, 0.3])
    for speed, rate in ((v, omega), (-v, 0.5 * omega)):
        turn = rate * 0.1
        chord = speed * 0.1 * np.sinc(turn / (2.0 * np.pi))
        middle = pose[2] + 0.5 * turn
        pose += [chord * np.cos(middle), chord * np.sin(middle), turn]
    np.testing.assert_allclose(world.pose, pose, atol=2e-6)
    assert world.time == pytest.approx(0.2)
    assert world.odometry() == pytest.approx((-v, 0.5 * omega), abs=1e-5)


@pytest.mark.parametrize("heading", [0.0, 0.35, -0.8])
def test_wall_stops_the_robot_and_the_wheels(heading: float) -> None:
    """Driving at the wall ends at the wall, as one contact, with wheels that report the true motion."""
    world = quiet_world((4.5, 2.0, heading))
    for _ in range(30):
        world.step(1.0, 0.0)
        assert world.clearance() > -0.0055  # one substep at full speed
    assert world.clearance() == pytest.approx(0.0, abs=0.001)
    assert world.pose[0] == pytest.approx(5.78, abs=0.001)
    if heading == 0.0:
        assert world.odometry() == pytest.approx((0.0, 0.0), abs=0.02)
        assert world.collisions == 1


def test_contacts_are_counted_as_events() -> None:
    """Contacts less than half a second apart are one event; the robot can always leave the wall."""
    world = quiet_world((5.6, 2.0, 0.0))
    for command in ([0.5] * 8, [-0.5] * 2, [0.5] * 3):
        for v in command:
            world.step(v, 0.0)
    assert world.collisions == 1
    for v in [-0.5] * 10 + [0.5] * 12:
        world.step(v, 0.0)
    assert world.collisions == 2
    for _ in range(10):
        world.step(-0.5, 0.0)
    assert world.clearance() > 0.3


def test_fixed_obstacle_is_a_collision_and_does_not_yield() -> None:
    """A fixed disc stops the robot and stays."""
    world = quiet_world((2.0, 2.0, 0.0), Obstacle(np.array([3.0, 2.0]), 0.2))
    assert world.clearance() == pytest.approx(1.0 - 0.2 - 0.17)
    for _ in range(20):
        world.step(0.8, 0.0)
    assert world.collisions == 1
    assert world.pose[0] == pytest.approx(3.0 - 0.37, abs=0.01)
    np.testing.assert_allclose(world.discs(), [[3.0, 2.0, 0.2, 0.0]])


def test_clearance_to_walls_and_in_the_open() -> None:
    """Distance of the hull to a wall's face; infinite where there is nothing."""
    assert quiet_world((0.55, 2.0, 1.0)).clearance() == pytest.approx(0.5 - 0.17, abs=1e-6)
    nothing = np.zeros((10, 10), dtype=bool)
    empty = OccupancyMap(occupied=nothing, free=~nothing, resolution=0.05, origin=(0.0, 0.0, 0.0), name="empty")
    assert World(empty, (0.0, 0.0, 0.0)).clearance() == math.inf


def test_mover_keeps_its_pace_on_its_segment() -> None:
    """Far from the robot it goes to and fro at its speed and turns at the ends."""
    world = quiet_world((1.0, 1.0, 0.0), Obstacle(np.array([3.0, 3.0]), 0.2, np.array([4.5, 3.0]), 0.3))
    xs = []
    for _ in range(110):
        world.step(0.0, 0.0)
        xs.append(world.discs()[0, 0])
    expected = 3.0 + np.abs((0.3 * 0.1 * np.arange(1, 111) + 1.5) % 3.0 - 1.5)
    np.testing.assert_allclose(xs, expected, atol=1e-6)
    assert world.discs()[0, 3] == 1.0


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_lidar_measures_the_room(yaw: float) -> None:
    """Noiseless ranges equal the distance to the room's faces, also on a rotated map."""
    origin = (2.0, -1.0, yaw)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    inside = np.array([2.3, 1.4])
    start = (
        2.0 + cosine * inside[0] - sine * inside[1],
        -1.0 + sine * inside[0] + cosine * inside[1],
        0.4 + yaw,
    )
    scan = World(room(origin=origin), start, lidar=QUIET).scan()
    points = beam_endpoints(scan.ranges[scan.valid], scan.angles[scan.valid])
    turn = np.array([[math.cos(0.4), -math.sin(0.4)], [math.sin(0.4), math.cos(0.4)]])
    points = points @ turn.T + inside
    faces = np.stack([points[:, 0] - 0.05, 5.95 - points[:, 0], points[:, 1] - 0.05, 3.95 - points[:, 1]])
    assert len(points) == 360
    np.testing.assert_allclose(faces.min(axis=0), 0.0, atol=1e-6)


def test_lidar_noise_dropouts_and_range() -> None:
    """Spread 0.02 m, one beam in a hundred lost, +inf beyond 12 m, obstacles seen, the robot itself not."""
    world = World(room(30.0, 4.0), (2.0, 2.0, 0.0), [Obstacle(np.array([4.0, 2.0]), 0.2)], np.random.default_rng(3))
    true = World(room(30.0, 4.0), (2.0, 2.0, 0.0), [Obstacle(np.array([4.0, 2.0]), 0.2)], lidar=QUIET).scan()
    scans = np.array([world.scan().ranges for _ in range(60)])
    seen = np.isfinite(scans)
    error = scans[seen] - np.broadcast_to(true.ranges, scans.shape)[seen]
    assert abs(error.mean()) < 0.001
    assert error.std() == pytest.approx(0.02, rel=0.03)
    assert np.isnan(scans).mean() == pytest.approx(0.01, abs=0.002)
    assert true.ranges[180] == pytest.approx(1.8, abs=1e-9)
    assert np.isinf(true.ranges[np.abs(true.angles - 0.13) < 0.01]).all()
    assert np.nanmax(np.where(np.isinf(scans), np.nan, scans)) <= 12.0
    assert true.ranges.min() > 1.7


@pytest.mark.product(2, of="drives and flights")
def test_odometry_statistics() -> None:
    """Scale errors: once per episode, 5 %. Noise: every step, 2 %. Both in proportion to the motion."""
    scales = []
    for seed in range(150):
        world = World(room(), (1.0, 2.0, 0.0), rng=np.random.default_rng(seed))
        ratios = []
        for sign in (1, -1) * 6:
            world.step(sign * 0.5, sign * 0.4)
            ratios.append(np.array(world.odometry()) / (sign * 0.5, sign * 0.4) - 1.0)
        scales.append(np.concatenate([np.mean(ratios, axis=0), np.std(ratios, axis=0, ddof=1)]))
    mean, spread = np.mean(scales, axis=0), np.std(scales, axis=0)
    np.testing.assert_allclose(mean[:2], 0.0, atol=0.013)
    np.testing.assert_allclose(spread[:2], 0.05, rtol=0.2)
    np.testing.assert_allclose(mean[2:], 0.02, rtol=0.1)
    assert abs(np.corrcoef(np.array(scales)[:, :2].T)[0, 1]) < 0.25
    world.step(0.0, 0.0)
    assert world.odometry() == pytest.approx((0.0, 0.0), abs=1e-9)


def episode(seed: int, speed: float, scans_per_tick: int = 1) -> tuple[Array, Array, Array]:
    """Truth, odometry ratios and last noise of a short drive."""
    world = World(room(), (1.0, 2.0, 0.0), [Obstacle(np.array([4.0, 3.0]), 0.2)], np.random.default_rng(seed))
    true, ratio, ranges = [], [], []
    for _ in range(10):
        world.step(speed, speed)
        for _ in range(scans_per_tick):
            ranges.append(world.scan().ranges)
        true.append(world.pose)
        ratio.append(np.array(world.odometry()) / speed)
    return np.array(true), np.array(ratio), np.array(ranges)


def test_same_seed_same_bits_and_streams_stay_apart() -> None:
    """A repeat is identical; another control or scan rate leaves the noise streams where they were."""
    first, again = episode(7, 0.5), episode(7, 0.5)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    slower, often, other_seed = episode(7, 0.2), episode(7, 0.5, scans_per_tick=3), episode(8, 0.5)
    np.testing.assert_allclose(first[1], slower[1], atol=1e-4)
    np.testing.assert_array_equal(first[1], often[1])
    np.testing.assert_array_equal(np.isnan(first[2]), np.isnan(slower[2]))
    assert np.abs(first[1] - other_seed[1]).max() > 0.005


@pytest.mark.parametrize(
    ("start", "command", "dt", "words"),
    [
        ((0.1, 2.0, 0.0), 0.0, 0.1, "would overlap a wall or an obstacle"),
        ((1.0, math.nan, 0.0), 0.0, 0.1, "three finite numbers"),
        ((3.0, 2.0, 0.0), math.nan, 0.1, "finite numbers"),
        ((3.0, 2.0, 0.0), 0.1, 0.0, "must be positive"),
    ],
)
def test_bad_input_is_refused(start: tuple[float, float, float], command: float, dt: float, words: str) -> None:
    """Standing in a wall, a start that is no pose, commands and durations that are no numbers."""
    with pytest.raises(ScenarioError, match=words):
        quiet_world(start).step(command, 0.0, dt=dt)


@pytest.mark.product(1, of="studies")
@pytest.mark.data
def test_department_map_is_quick(shared_data: Path) -> None:
    """A real building of 54 m x 51 m builds and scans in good time."""
    occupancy = load_map(shared_data / "maps" / "dis-B1-2011-09-27.yaml")
    World(occupancy, (2.3, 30.0, -1.57), rng=np.random.default_rng(0)).scan()  # compiles what the cache has not
    begin = time.thread_time()
    world = World(occupancy, (2.3, 30.0, -1.57), rng=np.random.default_rng(0))
    built = time.thread_time()
    for _ in range(20):
        scan = world.scan()
    scanned = time.thread_time()
    assert built - begin < 2.0
    assert (scanned - built) / 20 < 0.02  # typically 1.5 ms
    assert scan.valid.sum() > 250
    assert world.clearance() > 0.3
