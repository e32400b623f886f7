"""People: their motion in closed form, and drives among them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from maps import field, walled
from unifg.errors import ScenarioError
from unifg.files.contents import Limits
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.models.footprint import Body
from unifg.scenarios import navigation
from unifg.scenarios.episode import run_ticks, silent
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.simulation.plane import LidarModel, World
from unifg.scenarios.simulation.space import Mover, Space
from unifg.scenarios.simulation.traffic import Social, Traffic, draw_traffic
from unifg.typing import Array

PAUSE = 0.005
QUIET = LidarModel(sigma=0.0, dropout=0.0)
FAR = Space(np.array([-50.0, 0.0]), Body.disc(0.17))


def hall() -> OccupancyMap:
    """A hall of 12 m by 4 m."""
    return walled(12.0, 4.0)


def person(way: Array, radius: float, pace: float, walls: DistanceMap) -> Mover:
    return Mover(way[0], radius, Social(way, radius, pace, walls))


def world(*people: Mover, start: tuple[float, float, float] = (1.0, 2.0, 0.0)) -> World:
    return World(hall(), start, (), np.random.default_rng(0), lidar=QUIET, people=people)


def test_a_person_alone_takes_up_its_pace_as_the_forces_say() -> None:
    """dv / dt = (v0 - v) / tau: v = v0 (1 - exp(-t / tau))."""
    way = np.array([[2.0, 2.0], [10.0, 2.0]])
    walker = person(way, 0.2, 1.2, field(hall()))
    assert walker.policy is not None
    for k in range(400):
        walker.body.velocity = walker.policy.velocity(walker, FAR, PAUSE)
        place, speed = walker.body.position, walker.body.velocity
        assert speed.x == pytest.approx(1.2 * (1.0 - math.exp(-(k + 1) * PAUSE / 0.5)), abs=0.01)
        walker.body.position = place + PAUSE * speed
    assert walker.body.position.x == pytest.approx(2.0 + 1.2 * (2.0 - 0.5 * (1.0 - math.exp(-4.0))), abs=0.01)
    assert walker.body.position.y == pytest.approx(2.0, abs=0.01)


def test_people_are_pushed_off_walls_and_off_each_other() -> None:
    walls = field(hall())
    way = np.array([[2.0, 2.0], [11.0, 2.0]])
    policy = Social(way, 0.2, 1.0, walls)
    policy.others = [person(np.array([[2.5, 2.0], [11.0, 2.0]]), 0.2, 1.0, walls)]
    going = np.array([1.0, 0.0])
    push = policy.force(np.array([2.0, 2.0]), going)
    assert push == pytest.approx([-25.0 * math.exp((0.4 - 0.5) / 0.08), 0.0], abs=1e-6)
    policy.others = []
    beside = np.array([5.0, 3.95 - 0.3])  # 0.3 m from the wall above
    wall = policy.force(beside, going)

    assert wall[1] < -25.0 * math.exp((0.2 - 0.3) / 0.08), "and back to its way"


def test_people_walk_into_a_robot_that_stands_in_their_way() -> None:
    way = np.array([[5.0, 2.02], [0.8, 2.02]])
    here = world(person(way, 0.2, 1.0, field(hall())), start=(2.5, 2.0, 0.0))
    for _ in range(60):
        here.step(0.0, 0.0)
    assert here.collisions > 0


PATH = np.column_stack([np.linspace(1.0, 11.0, 201), np.full(201, 2.0), np.zeros(201)])


def test_people_are_drawn_where_there_is_room() -> None:
    walls, chosen = field(hall()), Traffic(people=4)
    drawn = [draw_traffic(chosen, walls, PATH, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    places = [[tuple(mover.body.position) for mover in people] for people in drawn]
    assert places[0] == places[1] != places[2]
    for mover in drawn[0]:
        assert math.hypot(mover.body.position.x - 1.0, mover.body.position.y - 2.0) >= 3.0
        policy = mover.policy
        assert isinstance(policy, Social) and len(policy.others) == 3
        assert walls.distance(policy.way).min() >= mover.radius and 0.3 <= policy.pace <= 1.5
    assert draw_traffic(Traffic(), walls, PATH, np.random.default_rng(0)) == []


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"people": -1}, "people: '-1' is not a whole number"),
        ({"people": 10**9}, "people: '1000000000' is more than 200"),
        ({"slowest": 2.0}, "slowest <= fastest"),
    ],
)
def test_what_is_no_traffic_is_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        Traffic(**wrong)  # type: ignore[arg-type]


def test_no_room_is_a_sentence() -> None:
    with pytest.raises(ScenarioError, match="so many people"):
        draw_traffic(Traffic(people=1), field(hall()), PATH[:20], np.random.default_rng(0))


@pytest.mark.product(2, of="drives and flights")
def test_a_drive_meets_its_people_and_keeps_a_log_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Episode(NavigationSettings(seed=3, traffic=Traffic(people=2)), rehearsal=True)
    alone = Episode(NavigationSettings(seed=3), rehearsal=True)
    assert drive.pilot.pose == pytest.approx(alone.pilot.pose), "people do not shift other draws"
    monkeypatch.setattr(navigation, "run_ticks", lambda limit, tick, progress: run_ticks(12, tick, progress))
    log = drive.run(silent)
    assert log.obstacles.shape[1] == 2
    assert np.abs(log.obstacles[-1] - log.obstacles[0]).max() > 0.0


def test_a_map_of_half_a_kilometre_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def load(path: Path, limits: Limits) -> OccupancyMap:
        assert limits.pixels * 0.05**2 >= 500.0**2
        raise ScenarioError("read")

    monkeypatch.setattr(navigation, "load_map", load)
    with pytest.raises(ScenarioError, match="read"):
        Episode(NavigationSettings(map=tmp_path / "town.yaml", start=(1.0, 1.0, 0.0), goals=((2.0, 1.0, 0.0),)))


@pytest.mark.product(2, of="drives and flights")
def test_obstacles_may_be_other_than_the_robot_expects() -> None:
    def radii(between: tuple[float, float]) -> Array:
        settings = NavigationSettings(obstacles=6, seed=2, obstacle_radius=between)
        return np.asarray(Episode(settings, rehearsal=True).world.discs()[:, 2])

    assert 0.15 <= radii((0.15, 0.25)).min() and radii((0.15, 0.25)).max() <= 0.25
    np.testing.assert_array_equal(radii((0.2, 0.2)), 0.2)
    assert 0.08 <= radii((0.08, 0.1)).min() and radii((0.08, 0.1)).max() <= 0.1
    with pytest.raises(ScenarioError, match=r"obstacle_radius.*not a positive number"):
        radii((0.0, 0.1))


def test_a_person_in_the_middle_of_a_short_way_walks_on() -> None:
    """No point of it is far enough to be gone for."""
    policy = Social(np.column_stack([np.linspace(1.0, 1.7, 8), np.full(8, 2.0)]), 0.2, 1.0, field(hall()))
    for place in ((1.35, 2.0), (1.0, 2.0), (1.7, 2.0)):
        assert np.isfinite(policy.force(np.array(place), np.zeros(2))).all()
