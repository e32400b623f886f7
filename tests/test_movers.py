"""Drives among movers as fast as the robot: the bound that they are compared with, and how their ends are counted."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import movers
from benchmarks.movers import future
from maps import field, walled
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.planning.space_time import CELL, Future, quickest
from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

HALL, LANE = walled(12.0, 12.0, 2), walled(12.0, 1.1, 2)
RADIUS = 0.17


def nothing(time: float) -> Array:
    """No discs."""
    return np.zeros((0, 3))


def arrival(occupancy: OccupancyMap, start: tuple[float, float], goal: tuple[float, float], discs: Future) -> float:
    """Clairvoyant arrival of a robot's disc within half a minute."""
    way = quickest(occupancy, field(occupancy), np.array(start), np.array(goal), RADIUS, discs, longest=30.0)
    if way is None:
        return math.inf
    assert np.abs(np.diff(way, axis=0)).max() < 1.01 * CELL and np.abs(way[-1] - goal).max() <= CELL
    return (len(way) - 1) * CELL


@pytest.mark.parametrize("goal", [(11.05, 1.05), (8.05, 8.05), (11.05, 5.05)])
def test_without_discs_the_bound_is_the_way_at_full_speed(goal: tuple[float, float]) -> None:
    way = math.dist((1.05, 1.05), goal)
    assert 0.92 * way - 0.1 <= arrival(HALL, (1.05, 1.05), goal, nothing) <= 1.02 * way + 0.1


def test_the_bound_waits_for_what_goes_away_and_no_longer() -> None:
    def leaves(time: float) -> Array:
        return np.array([[6.0, 0.55 if time < 15.0 else -5.0, 0.3]])

    assert arrival(LANE, (1.05, 0.55), (11.05, 0.55), leaves) == pytest.approx(15.0 + 11.05 - 5.53, abs=0.2)


def test_a_lane_that_stays_closed_has_no_arrival() -> None:
    assert arrival(LANE, (1.05, 0.55), (11.05, 0.55), future([Obstacle(np.array([6.0, 0.55]), 0.3)])) == math.inf


def test_one_who_cannot_get_out_of_the_way_does_not_arrive() -> None:
    lane = Obstacle(np.array([9.0, 0.55]), 0.3, np.array([0.6, 0.55]), 1.0)
    assert arrival(LANE, (1.05, 0.55), (11.05, 0.55), future([lane])) == math.inf


def test_the_future_is_that_of_the_world() -> None:
    discs = [Obstacle(np.array([6.0, 6.0]), 0.2), Obstacle(np.array([3.0, 9.0]), 0.25, np.array([4.3, 8.2]), 0.7)]
    world = World(HALL, (2.0, 2.0, 0.0), discs, yields=False)
    for _ in range(70):
        world.step(0.0, 0.0)
        assert np.allclose(world.discs()[:, :3], future(discs)(world.time), atol=0.01)


@pytest.mark.parametrize(
    ("speeds", "contact", "clearance", "kind"),
    [
        ([1.0] * 12, None, 0.1, ""),
        ([1.0] * 12, 9, 0.1, "moving"),
        ([1.0] * 12, None, -0.01, "moving"),
        ([0.0] * 12, 9, 0.1, "at rest"),
        ([0.0] * 7 + [1.0] * 5, 9, 0.1, "moving"),
    ],
)
def test_contacts_are_told_apart_by_the_motion_before(
    speeds: list[float], contact: int | None, clearance: float, kind: str
) -> None:
    ticks = len(speeds)
    contacts, gaps = np.zeros(ticks, dtype=int), np.full(ticks, 0.1)
    gaps[9] = clearance
    if contact is not None:
        contacts[contact:] = 1
    pose = np.zeros((ticks, 3))
    pose[:, 0] = np.cumsum(np.array(speeds) * 0.1)
    log: Any = SimpleNamespace(contacts=contacts, clearance=gaps, collisions=contacts[-1], true_pose=pose, dt=0.1)
    assert movers.touched(log) == kind


def test_thirty_seeds_are_ten_routes_and_the_next_are_others() -> None:
    routes = [movers.settings(movers.Meeting(0.3, 2.5, seed)).start for seed in (0, 10, 29, 30, 39)]
    assert routes[0] == routes[1] and len({*routes}) == 4


def test_rows_become_a_table() -> None:
    row = {
        "speed": 0.6, "base": 1.0, "seed": 0, "reached": True, "touched": "", "arrival": 20.0, "time": 30.0,
        "reverse": 0.1, "tick": 9.0,
    }  # fmt: skip
    rows = [row, {**row, "touched": "at rest"}, {**row, "reached": False}, {**row, "arrival": math.inf}]
    line = movers.render(rows).splitlines()[2]
    assert line == "| 0.6 | 1 | 3 | 1 | 6 .. 79 % | 0 | 1 | 1 | 1.50 | 10 % | 9.0 |"
