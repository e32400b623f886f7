"""Several robots in one building: where they are for each other, and how they get past."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pytest

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap, save_map
from unifg.machine.tally import counting
from unifg.scenarios import fleet
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.fleet import run_fleet
from unifg.scenarios.navigation import NavigationSettings
from unifg.scenarios.worlds.faults import DRIVE_FAULTS, one_of
from unifg.scenarios.worlds.plane import LidarModel, World


@functools.cache
def hall() -> OccupancyMap:
    """A hall of 9 m by 4 m with a pillar, so that a robot knows where it is."""
    occupied = np.zeros((80, 180), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[64:, 86:94] = True
    return OccupancyMap(occupied, ~occupied, 0.05, (0.0, 0.0, 0.0), "hall")


def side_by_side(*starts: tuple[float, float, float]) -> list[World]:
    quiet = LidarModel(sigma=0.0, dropout=0.0)
    worlds = [World(hall(), start, (), np.random.default_rng(0), lidar=quiet) for start in starts]
    for one in worlds:
        for other in worlds:
            if one is not other:
                one.meet(other)
    return worlds


def test_each_robot_is_in_the_worlds_of_the_others() -> None:
    left, right = worlds = side_by_side((1.0, 2.0, 0.0), (7.0, 2.0, np.pi))
    for _ in range(20):
        for _ in zip_longest(*(world.stepping(1.0, 0.3, 0.1) for world in worlds)):
            for one, other in ((left, right), (right, left)):
                x, y, radius, moves = one.obstacle_states()[-1]
                assert np.hypot(*(other.pose[:2] - [x, y])) < 0.0051 and (radius, moves) == (0.17, 1.0)
    left, right = side_by_side((1.0, 2.0, 0.0), (7.0, 2.0, np.pi))
    assert left.scan().ranges[180] == right.scan().ranges[180] == pytest.approx(6.0 - 0.17)


def test_robots_that_meet_touch() -> None:
    worlds = side_by_side((2.0, 2.0, 0.0), (3.0, 2.0, np.pi))
    for _ in range(10):
        for _ in zip_longest(*(world.stepping(0.5, 0.0, 0.1) for world in worlds)):
            pass
    assert [world.collisions for world in worlds] == [1, 1]
    assert worlds[1].pose[0] - worlds[0].pose[0] == pytest.approx(0.34, abs=0.01)


def test_a_step_is_all_of_its_substeps() -> None:
    one, other = side_by_side((2.0, 2.0, 0.0))[0], side_by_side((2.0, 2.0, 0.0))[0]
    one.step(0.7, 0.2)
    assert len(list(other.stepping(0.7, 0.2))) == 20
    assert one.pose == pytest.approx(other.pose, abs=0.0) and one.odometry() == other.odometry()


@pytest.fixture
def places(tmp_path: Path) -> list[NavigationSettings]:
    save_map(tmp_path / "hall.yaml", hall())
    ends = ((1.0, 1.8, 0.0), (7.5, 2.0, 0.0)), ((8.0, 1.9, np.pi), (1.5, 1.8, np.pi))
    return [NavigationSettings(map=tmp_path / "hall.yaml", start=start, goals=(goal,), seed=k)
            for k, (start, goal) in enumerate(ends)]  # fmt: skip


def test_any_number_of_processes_drives_the_same(places: list[NavigationSettings]) -> None:
    """One of them is carried elsewhere on the way, which the other processes have to know."""
    kidnapped = one_of(DRIVE_FAULTS)("kidnapped@1.5")
    third = replace(places[0], start=(4.4, 1.0, 0.0), goals=((6.0, 1.2, 0.0),), seed=7, faults=(kidnapped,))
    robots = [*places, third]
    with counting() as made:
        alone = run_fleet(robots)
    shared = run_fleet(robots, workers=2)
    # Code rounds otherwise in the process that compiles it, docs/limitations.md; after `unifg warmup` none does.
    near = 1e-5 if made.compiled else 0.0
    for one, other in zip(alone, shared, strict=True):
        assert one.outcomes == other.outcomes and one.ticks == other.ticks and one.collisions == other.collisions
        for what in ("true_pose", "control", "scan"):
            np.testing.assert_allclose(getattr(one, what), getattr(other, what), rtol=0.0, atol=near, err_msg=what)
    step = np.abs(np.diff(alone[2].true_pose[:, :2], axis=0)).max()
    assert step > 2.0, "it was carried"


def test_what_goes_wrong_in_a_process_is_said_here(places: list[NavigationSettings]) -> None:
    with pytest.raises(ScenarioError, match="at least one worker, got 0"):
        run_fleet(places, workers=0)
    with pytest.raises(ScenarioError, match=r"robot 1 cannot start at .*another one stands there"):
        run_fleet([places[0], replace(places[0], seed=3)], workers=2)

    def stop(done: float, words: str) -> None:
        raise KeyboardInterrupt

    logs = run_fleet(places, stop, workers=2)
    assert [log.interrupted for log in logs] == [True, True] and min(log.ticks for log in logs) >= 1

    def fail(done: float, words: str) -> None:
        raise OSError("nobody listens")

    for workers in (1, 2):
        with pytest.raises(OSError, match="nobody listens"):
            run_fleet(places, fail, workers=workers)
    assert not fleet._parts, "worlds of a drive that failed are let go"


def test_two_robots_get_past_each_other(places: list[NavigationSettings]) -> None:
    told = list[str]()
    logs = run_fleet(places, lambda done, words: told.append(words))
    assert all(log.succeeded for log in logs) and told[0] == "2 robots under way"
    first, second = logs
    both = min(log.ticks for log in logs)
    apart = np.hypot(*(first.true_pose[:both] - second.true_pose[:both])[:, :2].T)
    assert apart.min() > 0.34, "and each was where the other saw it"
    assert np.abs(first.obstacles[:both, -1, :2] - second.true_pose[:both, :2]).max() < 0.006


def test_what_is_no_fleet_is_refused(places: list[NavigationSettings]) -> None:
    with pytest.raises(ScenarioError, match="at least one robot"):
        run_fleet([])
    faster = replace(places[1], controller=replace(ControllerSettings(), dt=0.05))
    with pytest.raises(ScenarioError, match="one sampling time, got"):
        run_fleet([places[0], faster])
    with pytest.raises(ScenarioError, match="robot 1 cannot start at"):
        run_fleet([places[0], replace(places[1], start=places[0].start)])
