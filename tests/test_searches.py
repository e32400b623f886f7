"""Searches in parts over ticks: the same path, a counted share of work in a tick, and the old path meanwhile."""

from __future__ import annotations

import numpy as np
import pytest

from maps import building, field, walled
from unifg.errors import ScenarioError
from unifg.scenarios.ground import route as routes
from unifg.scenarios.ground.route import PATIENCE, Route
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.grid import plan, planning
from unifg.scenarios.simulation.building import DEMO_GOALS, DEMO_START
from unifg.typing import Array


def standing(*places: tuple[float, float]) -> Tracks:
    """Discs of 0.2 m that never moved."""
    count = len(places)
    return Tracks(
        np.array(places), np.zeros((count, 2)), np.full(count, 0.2), np.arange(count), np.zeros(count),
        np.zeros(count, dtype=bool),
    )  # fmt: skip


def hall() -> Route:
    occupancy = walled(8.0, 4.0)
    return Route(occupancy, field(occupancy), np.array([1.0, 2.0, 0.0]), np.array([7.0, 2.0, 0.0]), 0.17)


def repaired(budget: int, monkeypatch: pytest.MonkeyPatch) -> tuple[list[bool], list[Array], Route]:
    """Results and paths of ticks beside a disc that stands on the way."""
    monkeypatch.setattr(routes, "EXPANSIONS", budget)
    found, paths, route = list[bool](), list[Array](), hall()
    for _ in range(400):
        found.append(route.repair(np.array([1.0, 2.0, 0.0]), standing((4.0, 2.0))))
        paths.append(route.path)
        if found[-1]:
            break
    return found, paths, route


def test_a_search_in_parts_ends_with_the_path_of_one_at_once() -> None:
    ends = np.array(DEMO_START), np.array(DEMO_GOALS[0])
    expected, parts = plan(*building(), *ends, robot_radius=0.17), list[int]()
    work = planning(*building(), *ends, robot_radius=0.17)
    try:
        while True:
            parts.append(next(work))
    except StopIteration as end:
        np.testing.assert_array_equal(end.value, expected)
    assert len(parts) > 12 and min(parts) > 0
    assert max(parts) < 60_000  # no part is as long as a tick's share


@pytest.mark.parametrize("budget", [1, 30_000])
def test_the_robot_keeps_its_path_until_a_detour_is_found(budget: int, monkeypatch: pytest.MonkeyPatch) -> None:
    (at_once,), (expected,), whole = repaired(10**9, monkeypatch)
    found, paths, route = repaired(budget, monkeypatch)
    assert at_once and whole.searched == 0
    assert len(found) > (10 if budget == 1 else 1) and found == [False] * (len(found) - 1) + [True]
    straight = hall().path
    assert all(np.array_equal(path, straight) for path in paths[:-1])
    np.testing.assert_array_equal(paths[-1], expected)
    assert route.searched == 0
    again = [route.repair(np.array([1.0, 2.0, 0.0]), standing((4.0, 2.0))) for _ in range(PATIENCE)]
    assert not any(again) and route.path is paths[-1]


def test_parts_of_a_tick_are_counted_and_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (repaired(20_000, monkeypatch)[0] for _ in range(2))
    assert first == second
    assert len(repaired(5_000, monkeypatch)[0]) > len(first)


def test_a_search_in_parts_may_fail_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "EXPANSIONS", 20_000)
    route, wall = hall(), [(4.0, 0.2 + 0.4 * k) for k in range(10)]
    straight = route.path
    for _ in range(2000):
        route.repair(np.array([1.0, 2.0, 0.0]), standing(*wall))
        if route.blocked is not None:
            break
    assert route.path is straight
    assert route.blocked is not None and "blocked near (3" in str(route.blocked)
    with pytest.raises(ScenarioError, match="no way"):
        plan(walled(8.0, 4.0), field(walled(8.0, 4.0)), [1.0, 2.0], [7.0, 2.0, 0.0], robot_radius=0.17,
             extra_discs=[(x, y, 0.2) for x, y in wall])  # fmt: skip
