"""Lidars that see a part of the turn, turn while the robot moves, or are half blind; covariances of poses by scans."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from maps import building, field, stop_after
from unifg.errors import ScenarioError
from unifg.lie import SE2
from unifg.models import lidar
from unifg.models.footprint import Body
from unifg.scenarios.ground.emergency_stop import EmergencyStop, agreed
from unifg.scenarios.ground.localiser import Localiser, least, scan_covariance
from unifg.scenarios.logs.drive_metrics import consistency, episode_metrics, nees
from unifg.scenarios.monitoring.validation import Validator
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.disc_tracker import DiscTracker
from unifg.scenarios.perception.discs import DiscFinder, Discs
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.simulation.faults import DRIVE_FAULTS, one_of
from unifg.scenarios.simulation.imperfection import Imperfection, imperfect
from unifg.scenarios.simulation.plane import LidarModel, World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

STOP = EmergencyStop(Body.disc(0.17), (2.5, 3.2), 0.1)
FAST = np.array([1.0, 0.0])
SHORT = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),), obstacles=1)
HALF = LidarModel(beams=181, field=math.pi)


# ---------------------------------------------------------------- the field of view


def test_beams_fill_the_field_of_view() -> None:
    np.testing.assert_array_equal(LidarModel().angles, -np.pi + 2.0 * np.pi * np.arange(360) / 360)
    angles = HALF.angles
    assert len(angles) == 181 and angles[0] == -0.5 * math.pi and angles[-1] == 0.5 * math.pi
    scan = Scan(angles, np.ones(181))
    assert scan.spacing == pytest.approx(math.pi / 180) and not scan.closed
    assert Scan(LidarModel().angles, np.ones(360)).closed
    for view in (0.0, 7.0, math.nan):
        with pytest.raises(ScenarioError, match=r"^field: |field of view"):
            LidarModel(field=view)


def test_what_no_beam_looks_into_is_unseen() -> None:
    ((begin, width),) = Scan(HALF.angles, np.full(181, np.inf)).unseen.tolist()
    assert begin == pytest.approx(0.5 * math.pi) and width == pytest.approx(math.pi)
    angles = LidarModel().angles
    assert not len(Scan(angles, np.where(np.arange(360) % 3, 2.0, np.nan)).unseen)
    blind = Scan(angles, np.where(np.abs(angles) < 0.1, np.nan, 2.0))
    assert blind.unseen[0] == pytest.approx([angles[174], 12 * math.pi / 180], abs=1e-9)
    assert Scan(angles, np.full(360, np.nan)).unseen[0, 1] == pytest.approx(2.0 * math.pi)
    assert not len(Scan(np.linspace(-3.0, 3.0, 10), np.ones(10)).unseen), "a coarse lidar sees what it can"


def test_the_blind_sector_is_that_of_lost_beams_within_the_field() -> None:
    angles = LidarModel().angles
    assert Scan(HALF.angles, np.ones(181)).blind == 0.0
    assert Scan(angles, np.where(np.abs(angles) < 0.3, np.nan, 2.0)).blind == pytest.approx(0.6, abs=0.02)
    behind = np.where(np.abs(angles) > np.pi - 0.3, np.nan, 2.0)
    assert Scan(angles, behind).blind == pytest.approx(0.6, abs=0.03), "across the seam"
    assert Scan(angles, np.full(360, np.nan)).blind == pytest.approx(2.0 * math.pi)


def test_what_is_not_seen_is_occupied() -> None:
    clear = Scan(HALF.angles, np.full(181, 5.0))
    assert STOP.is_free(FAST, clear, FAST) and STOP.is_free(np.array([0.5, 1.0]), clear, 0.5 * FAST)
    assert not STOP.is_free(-FAST, clear), "nothing is known of what is behind"
    assert STOP.control(-0.5 * FAST, np.zeros(2), clear)[0] == 0.0
    assert STOP.control(np.array([0.0, 1.0]), np.zeros(2), clear)[1] == 1.0, "turning touches nothing"
    full = LidarModel().angles
    assert STOP.is_free(-FAST, Scan(full, np.full(360, 5.0)))
    hole = Scan(full, np.where(np.abs(full) < 0.1, np.nan, 5.0))  # most beams ahead are there
    assert not STOP.is_free(FAST, hole) and STOP.is_free(-FAST, hole)
    aside = Scan(full, np.where(np.abs(full - 2.0) < 0.1, np.nan, 5.0))
    assert STOP.is_free(FAST, aside)


def test_the_ends_of_a_half_turn_are_no_neighbours() -> None:
    near = np.where(np.isin(np.arange(181), [1, 180]), 0.1, 5.0)  # beam 0 would lie between them
    assert agreed(Scan(HALF.angles, near))[0] == 5.0
    full = np.where(np.isin(np.arange(360), [1, 359]), 0.1, 5.0)
    assert agreed(Scan(LidarModel().angles, full))[0] == 0.1


@pytest.mark.parametrize("lidar", [LidarModel(), HALF, LidarModel(beams=541, field=1.5 * math.pi)])
def test_a_disc_is_placed_by_a_lidar_of_any_field(lidar: LidarModel) -> None:
    place = (21.0, 9.6, -2.0)
    centre = SE2.act(np.array(place), np.array([1.2, 0.1]))
    disc = Obstacle(centre, 0.2)
    world = World(building()[0], place, [disc], np.random.default_rng(3), lidar=replace(lidar, dropout=0.0))
    found = DiscFinder(building()[1]).find(world.scan(), world.pose)
    near = np.hypot(*(found.centre - centre).T)
    assert near.min() < 0.04 and found.radius[near.argmin()] == pytest.approx(0.2, abs=0.04)


def test_a_track_is_seen_through_by_beams_as_wide_as_they_stand() -> None:
    """Beside the middle beam, which passes, others are stopped before; 31 beams of a full turn would be coarser."""
    scan = Scan(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 31), np.where(np.arange(31) == 15, 5.0, 1.0))
    tracker = DiscTracker(building()[1])
    seen = Discs(np.array([[3.0, 0.0]]), np.array([0.2]), np.array([0.02]), np.array([3.0]))
    tracker._rows = type(tracker._rows).of(seen, np.zeros(1, dtype=np.intp))
    assert tracker._seen_through(np.ones(1, dtype=bool), scan, np.zeros(3)).all()


@pytest.mark.product(2, of="drives and flights")
def test_a_lidar_that_sees_half_a_turn_drives_into_nothing() -> None:
    log = Episode(replace(SHORT, lidar=HALF, obstacles=3, seed=4)).run(stop_after(150))
    assert log.collisions == 0 and np.hypot(*(log.true_pose[-1] - log.true_pose[0])[:2]) > 3.0
    assert log.control[:, 0].min() >= 0.0, "it does not reverse into what it does not see"


# ---------------------------------------------------------------- blind and without time


@pytest.mark.product(2, of="drives and flights")
def test_a_blind_sector_ahead_stops_the_robot_and_is_named() -> None:
    log = Episode(replace(SHORT, faults=(one_of(DRIVE_FAULTS)("lidar-blind@1"),))).run(stop_after(40))
    assert log.control[5, 0] > 0.3 and not log.control[25:, 0].any() and log.collisions == 0
    assert set(log.health[15:]) == {"degraded"}
    assert log.cause[-1] == "the lidar sees nothing in a sector"


def test_a_stamp_that_is_no_number_is_refused() -> None:
    angles = LidarModel().angles
    ranges = 3.0 + 0.01 * np.random.default_rng(0).standard_normal(360)
    for stamp in (math.nan, "soon"):
        validator = Validator(360)
        assert validator.scan(Scan(angles, ranges, stamp), 1.0) is None  # type: ignore[arg-type]
        assert validator.refused["lidar"] == "its time is not a number"
    validator = Validator(360)
    found = validator.scan(Scan(angles, ranges), 1.0)
    assert found is not None and found.time == 1.0, "without a stamp it is of now"
    assert validator.scan(Scan(angles, ranges + 0.01), 1.0) is not None


# ---------------------------------------------------------------- turning while the robot moves


@pytest.mark.parametrize("motion", [(0.8, 0.0), (0.0, 1.0), (0.7, -0.9)])
def test_a_scan_is_deskewed_by_the_wheels(motion: tuple[float, float]) -> None:
    def taken(turn: float) -> tuple[Scan, Array]:
        lidar = LidarModel(sigma=0.0, dropout=0.0, turn=turn)
        world = World(building()[0], (21.0, 9.6, -2.0), rng=np.random.default_rng(1), lidar=lidar)
        for _ in range(2):
            world.step(*motion)
        return world.scan(), world.pose

    (scan, pose), (still, same) = taken(0.1), taken(0.0)
    np.testing.assert_array_equal(pose, same)
    assert scan.turn == 0.1 and still.deskewed(np.array(motion)) is still

    def off(one: Scan) -> float:
        ends = lidar.beam_endpoints(one.ranges[one.valid], one.angles[one.valid])
        return float(np.abs(building()[1].distance(SE2.act(pose, ends))).mean())

    right = scan.deskewed(np.array(motion))
    assert off(right) < off(still) + 0.003 < off(scan)
    assert right.turn == 0.0 and right.deskewed(np.array(motion)) is right
    gone = replace(scan, ranges=np.where(np.arange(360) < 9, np.nan, np.where(np.arange(360) < 20, np.inf, 1.0)))
    moved = gone.deskewed(np.array(motion))
    assert np.isnan(moved.ranges[:9]).all() and np.isinf(moved.ranges[9:20]).all()
    np.testing.assert_allclose(moved.angles[0] - gone.angles[0], -motion[1] * 0.1 * 359 / 360, atol=1e-12)


def test_a_turning_lidar_leaves_no_bias() -> None:
    errors = []
    for turn in (0.0, 0.1):
        world = World(
            building()[0], (21.0, 9.6, -2.0), rng=np.random.default_rng(1), lidar=LidarModel(turn=turn, sigma=0.005)
        )
        localiser = Localiser(building()[1], world.pose, np.array([0.05, 0.05, 0.02]), 360)
        localiser.update(world.scan(), None, 0.1)
        for _ in range(20):
            world.step(0.3, 0.9)
            localiser.update(world.scan(), np.array(world.odometry()), 0.1)
        errors.append(SE2.local(localiser.pose, world.pose))
    np.testing.assert_allclose(errors[1], errors[0], atol=0.008)


# ---------------------------------------------------------------- how sure


def test_the_covariance_follows_what_the_map_leaves_unexplained() -> None:
    occupancy = building()[0]
    ends = np.array([[21.0, 9.6, -2.0]])
    sizes = []
    for error in (0.0, 0.03):
        given, true = imperfect(occupancy, Imperfection(map_error=error), ends[0], ends, np.random.default_rng(5))
        world = World(true, ends[0], rng=np.random.default_rng(1))
        localiser = Localiser(field(given), world.pose, np.array([0.05, 0.05, 0.02]), 360)
        for _ in range(3):
            localiser.update(world.scan(), np.zeros(2), 0.1)
        sizes.append(np.sqrt(np.diag(localiser.covariance)))
    assert sizes[0][:2].max() < 0.006 and sizes[0][2] < 0.002
    assert (sizes[1][:2] > 0.015).all() and sizes[1][2] > 1.5 * sizes[0][2]


def test_correlated_residuals_count_for_less_than_independent_ones(rng: np.random.Generator) -> None:
    angles = LidarModel().angles
    pose = np.array([21.0, 9.6, -2.0])
    world = World(building()[0], pose, rng=np.random.default_rng(1), lidar=LidarModel(sigma=0.0, dropout=0.0))
    clean = world.scan().ranges
    white = rng.standard_normal(360)
    waves = np.convolve(np.tile(white, 3), np.hanning(41), mode="same")[360:720]
    alike = [clean + 0.03 * noise / noise.std() for noise in (white, waves)]
    independent, correlated = (scan_covariance(building()[1], Scan(angles, ranges), pose) for ranges in alike)
    assert np.linalg.eigvalsh(correlated)[0] > 4.0 * np.linalg.eigvalsh(independent)[0]


def test_the_lesser_of_two_covariances_is_taken_in_every_direction(rng: np.random.Generator) -> None:
    root = rng.standard_normal((3, 3))
    one = root @ root.T + 0.1 * np.eye(3)
    np.testing.assert_allclose(least(one, 4.0 * one), one, atol=1e-12)
    np.testing.assert_allclose(least(one, 0.25 * one), 0.25 * one, atol=1e-12)
    np.testing.assert_allclose(least(np.diag([1.0, 4.0]), np.diag([9.0, 1.0])), np.eye(2), atol=1e-12)


def test_a_scan_again_and_again_makes_no_surer() -> None:
    world = World(building()[0], (21.0, 9.6, -2.0), rng=np.random.default_rng(1))
    localiser = Localiser(building()[1], world.pose, np.array([0.05, 0.05, 0.02]), 360)
    localiser.correct(world.scan())
    first = np.linalg.eigvalsh(localiser.covariance)
    for _ in range(30):
        localiser.correct(world.scan())
    assert (np.linalg.eigvalsh(localiser.covariance) > 0.3 * first).all()


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.product(2, of="drives and flights")
def test_errors_are_as_large_as_their_covariances(coupling: str) -> None:
    lidar = LidarModel(turn=0.1)
    log = Episode(
        replace(SHORT, coupling=coupling, lidar=lidar, imperfection=Imperfection(map_error=0.03), seed=3)
    ).run(stop_after(60))
    values = nees(log.estimate, log.true_pose, log.covariance)
    assert 0.2 < values[5:].mean() < 8.0


def test_the_metrics_hold_means_and_one_draw_of_nees() -> None:
    log = Episode(SHORT).run(stop_after(12))
    values = nees(log.estimate, log.true_pose, log.covariance)
    error = SE2.local(log.estimate[4], log.true_pose[4])
    assert values[4] == pytest.approx(error @ np.linalg.solve(log.covariance[4], error))
    found = episode_metrics(log)["nees"]
    assert found == consistency(log) and found["mean"] == pytest.approx(values.mean())
    assert found["drawn"] in values.tolist()
    assert len({consistency(replace(log, seed=seed))["drawn"] for seed in range(20)}) > 4
