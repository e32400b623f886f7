"""People, carts and doors: their motion in closed form, what the lidar sees of them, and drives among them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pymunk
import pytest

from unifg.errors import ScenarioError
from unifg.files.contents import Limits
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios import navigation
from unifg.scenarios.episode import run_ticks, silent
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.worlds import traffic
from unifg.scenarios.worlds.plane import LidarModel, World
from unifg.scenarios.worlds.traffic import (
    Cart,
    Door,
    Person,
    Schedule,
    Traffic,
    doorways,
    draw_traffic,
    gap_to_box,
)
from unifg.typing import Array

DT, PAUSE = 0.1, 0.005
TIMES: Array = DT * np.arange(1.0, 101.0)
QUIET = LidarModel(sigma=0.0, dropout=0.0)
FAR = pymunk.Body()
FAR.position = (-50.0, 0.0)


def hall(narrow: bool = False) -> OccupancyMap:
    """A hall of 12 m by 4 m, perhaps with a wall at x = 6 m that has a doorway of 1 m."""
    occupied = np.zeros((80, 240), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    if narrow:
        occupied[:, 119:121] = True
        occupied[30:50, 119:121] = False
    return OccupancyMap(occupied, ~occupied, 0.05, (0.0, 0.0, 0.0), "hall")


def field(occupancy: OccupancyMap) -> DistanceMap:
    return DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)


def world(*things: Person | Cart | Door, start: tuple[float, float, float] = (1.0, 2.0, 0.0)) -> World:
    return World(hall(), start, (), np.random.default_rng(0), lidar=QUIET, traffic=things)


def to_and_fro(speed: float, length: float, time: Array) -> Array:
    """Distance of something from its beginning."""
    along: Array = length - np.abs((speed * time) % (2.0 * length) - length)
    return along


def test_a_strict_walker_goes_to_and_fro_at_its_pace() -> None:
    way = np.array([[4.0, 1.0], [6.0, 1.0], [6.0, 2.5]])
    here = world(Person(way, 0.2, 0.8))
    found = []
    for _ in range(100):
        here.step(0.0, 0.0)
        found.append(here.obstacle_states()[0])
    along = to_and_fro(0.8, 3.5, TIMES)
    expected = np.where((along < 2.0)[:, None], np.column_stack([4.0 + along, 0.0 * along + 1.0]),
                        np.column_stack([0.0 * along + 6.0, along - 1.0]))  # fmt: skip
    np.testing.assert_allclose(np.array(found)[:, :2], expected, atol=0.005)
    assert np.array(found)[0, 2:].tolist() == [0.2, 1.0]


def test_a_person_alone_takes_up_its_pace_as_the_forces_say() -> None:
    """dv / dt = (v0 - v) / tau: v = v0 (1 - exp(-t / tau))."""
    way = np.array([[2.0, 2.0], [10.0, 2.0]])
    person = Person(way, 0.2, 1.2, field(hall()))
    for k in range(400):
        person.advance(FAR, 0.17, False, PAUSE)
        place, speed = person.body.position, person.body.velocity
        assert speed.x == pytest.approx(1.2 * (1.0 - math.exp(-(k + 1) * PAUSE / 0.5)), abs=0.01)
        person.body.position = place + PAUSE * speed
    assert person.body.position.x == pytest.approx(2.0 + 1.2 * (2.0 - 0.5 * (1.0 - math.exp(-4.0))), abs=0.01)
    assert person.body.position.y == pytest.approx(2.0, abs=0.01)


def test_people_are_pushed_off_walls_and_off_each_other() -> None:
    walls = field(hall())
    person, other = (Person(np.array([[x, 2.0], [11.0, 2.0]]), 0.2, 1.0, walls) for x in (2.0, 2.5))
    person.others = [(other.body, other.radius)]
    going = np.array([1.0, 0.0])
    push = person.force(np.array([2.0, 2.0]), going)
    assert push == pytest.approx([-25.0 * math.exp((0.4 - 0.5) / 0.08), 0.0], abs=1e-6)
    person.others = []
    beside = np.array([5.0, 3.95 - 0.3])  # 0.3 m from the wall above
    wall = person.force(beside, going)
    aim = np.array([5.0, 2.0])
    assert wall[1] < -25.0 * math.exp((0.2 - 0.3) / 0.08), "and back to its way"
    assert person.force(aim, going, (FAR, 0.17)) == pytest.approx(person.force(aim, going))
    robot = pymunk.Body()
    robot.position = (5.5, 2.0)
    assert person.force(aim, going, (robot, 0.17))[0] == pytest.approx(
        person.force(aim, going)[0] - 25.0 * math.exp((0.37 - 0.5) / 0.08)
    )


@pytest.mark.parametrize("courteous", [False, True])
def test_people_run_into_a_robot_unless_they_mind_it(courteous: bool) -> None:
    way = np.array([[5.0, 2.02], [0.8, 2.02]])
    here = world(Person(way, 0.2, 1.0, field(hall()), courteous), start=(2.5, 2.0, 0.0))
    for _ in range(60):
        here.step(0.0, 0.0)
    assert (here.collisions == 0) == courteous


def test_a_cart_is_a_box_that_goes_to_and_fro() -> None:
    heading = math.atan2(0.6, 0.8)
    begin, end = np.array([4.0, 1.0]), np.array([6.0, 2.5])
    here, found = world(Cart(begin, end, 0.7)), []
    for _ in range(100):
        here.step(0.0, 0.0)
        found.append(here.boxes()[0])
    along = to_and_fro(0.7, 2.5, TIMES)
    expected = begin + along[:, None] * np.array([math.cos(heading), math.sin(heading)])
    np.testing.assert_allclose(np.array(found)[:, :2], expected, atol=0.004)
    np.testing.assert_allclose(np.array(found)[:, 2:], np.tile([heading, 1.2, 0.6], (100, 1)), atol=1e-9)


def test_the_lidar_sees_a_cart_as_long_as_it_is() -> None:
    along, across = (
        world(Cart(np.array([5.0, 2.0]), np.array(end), 0.5)).scan().ranges[180] for end in ([8.0, 2.0], [5.0, 3.0])
    )
    assert (along, across) == (pytest.approx(4.0 - 0.6), pytest.approx(4.0 - 0.3))


def test_a_courteous_cart_stops_before_the_robot() -> None:
    for courteous in (True, False):
        here = world(Cart(np.array([6.0, 2.0]), np.array([1.0, 2.0]), 0.5, courteous=courteous), start=(3.0, 2.0, 0.0))
        for _ in range(60):
            here.step(0.0, 0.0)
        assert (here.collisions == 0) == courteous
        if courteous:
            assert here.clearance() == pytest.approx(0.1, abs=0.005)


def test_the_schedule_of_a_door() -> None:
    times = Schedule(8.0, 4.0, 1.0)
    expected = {0.0: 0.0, 7.9: 0.0, 8.25: 0.25, 9.0: 1.0, 12.9: 1.0, 13.75: 0.25, 14.0: 0.0, 22.5: 0.5, 27.75: 0.25}
    assert times.period == 14.0
    assert [times.closed(time) for time in expected] == pytest.approx(list(expected.values()))
    assert Schedule(8.0, 4.0, 1.0, begun=8.5).closed(0.0) == pytest.approx(0.5)


def test_a_door_slides_and_is_seen() -> None:
    door = Door(np.array([5.0, 2.0]), math.pi / 2.0, 1.0, Schedule(1.0, 1.0, 0.5))
    here = world(door)
    for tick in range(1, 61):
        here.step(0.0, 0.0)
        closed = Schedule(1.0, 1.0, 0.5).closed(tick * DT)
        assert here.boxes()[0] == pytest.approx([5.0, 1.0 + closed, math.pi / 2.0, 1.0, 0.06], abs=1e-6)
        if closed in (0.0, 1.0):
            assert here.scan().ranges[180] == pytest.approx(3.97 if closed else 10.95, abs=0.01)


def test_a_door_does_not_close_on_a_robot() -> None:
    door = Door(np.array([3.0, 2.0]), math.pi / 2.0, 1.0, Schedule(1.0, 1.0, 0.5))
    here = world(door, start=(3.0, 2.0, 0.0))
    for _ in range(40):
        here.step(0.0, 0.0)
    assert here.collisions == 0 and door.time == pytest.approx(1.0, abs=0.01)
    for _ in range(25):
        here.step(0.6, 0.0)
    assert here.collisions == 0 and door.time > 1.5


def test_the_gap_to_a_box() -> None:
    assert gap_to_box(np.array([2.0, 0.0]), 0.0, (1.2, 0.6)) == pytest.approx(1.4)
    assert gap_to_box(np.array([2.0, 0.0]), math.pi / 2.0, (1.2, 0.6)) == pytest.approx(1.7)
    assert gap_to_box(np.array([0.9, 0.7]), 0.0, (1.2, 0.6)) == pytest.approx(0.5)
    assert gap_to_box(np.array([0.1, 0.1]), 0.3, (1.2, 0.6)) == 0.0


PATH = np.column_stack([np.linspace(1.0, 11.0, 201), np.full(201, 2.0), np.zeros(201)])
GOALS = PATH[-1:]


def test_traffic_is_drawn_where_there_is_room() -> None:
    occupancy = hall(narrow=True)
    walls, chosen = field(occupancy), Traffic(people=4, doors=1)
    drawn = [draw_traffic(chosen, occupancy, walls, PATH, GOALS, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    places = [[tuple(thing.body.position) for thing in things] for things in drawn]
    assert places[0] == places[1] != places[2]
    for thing in drawn[0]:
        if isinstance(thing, Person):
            assert math.hypot(thing.body.position.x - 1.0, thing.body.position.y - 2.0) >= 3.0
            assert walls.distance(thing.way).min() >= thing.radius and 0.3 <= thing.pace <= 1.5
            assert len(thing.others) == 3
    (middle, heading, width), *more = doorways(walls, PATH[:, :2], GOALS)
    assert not more and middle == pytest.approx([6.0, 2.0], abs=0.06) and width == pytest.approx(1.0, abs=0.06)
    assert abs(math.sin(heading)) == pytest.approx(1.0)
    carts = draw_traffic(Traffic(carts=2), hall(), field(hall()), PATH, GOALS, np.random.default_rng(0))
    for cart in carts:
        assert isinstance(cart, Cart) and cart.speed == 0.5
    assert draw_traffic(Traffic(), occupancy, walls, PATH, GOALS, np.random.default_rng(0)) == []


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"people": -1}, "people must be from 0 to 200"),
        ({"people": 10**9}, "people must be from 0 to 200"),
        ({"carts": 201}, "carts must be from 0 to 200"),
        ({"walking": "run"}, "choose social or scripted"),
        ({"slowest": 2.0}, "slowest <= fastest"),
        ({"cart_speed": math.nan}, "cart_speed must be above zero"),
        ({"open_for": 0.0}, "open_for must be above zero"),
    ],
)
def test_what_is_no_traffic_is_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        Traffic(**wrong)  # type: ignore[arg-type]


def test_no_room_is_a_sentence() -> None:
    occupancy = hall()
    walls = field(occupancy)
    with pytest.raises(ScenarioError, match="0 narrow places for a door, not 1"):
        draw_traffic(Traffic(doors=1), occupancy, walls, PATH, GOALS, np.random.default_rng(0))
    short = PATH[:20]
    for chosen, message in ((Traffic(people=1), "so many people"), (Traffic(carts=1), "so many carts")):
        with pytest.raises(ScenarioError, match=message):
            draw_traffic(chosen, occupancy, walls, short, short[-1:], np.random.default_rng(0))


def test_a_drive_meets_its_traffic_and_keeps_a_log_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = Traffic(people=2, carts=1, doors=1)
    drive = Episode(NavigationSettings(seed=3, traffic=chosen), rehearsal=True)
    alone = Episode(NavigationSettings(seed=3), rehearsal=True)
    assert drive.pilot.pose == pytest.approx(alone.pilot.pose), "who goes about does not shift other draws"
    monkeypatch.setattr(navigation, "run_ticks", lambda limit, tick, progress: run_ticks(12, tick, progress))
    log = drive.run(silent)
    assert log.boxes.shape[1:] == (2, 5) and log.obstacles.shape[1] == 2
    assert np.abs(log.boxes[-1] - log.boxes[0]).max() > 0.0
    assert traffic.CART[0] > traffic.CART[1]


def test_a_map_of_half_a_kilometre_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def load(path: Path, limits: Limits) -> OccupancyMap:
        assert limits.pixels * 0.05**2 >= 500.0**2
        raise ScenarioError("read")

    monkeypatch.setattr(navigation, "load_map", load)
    with pytest.raises(ScenarioError, match="read"):
        Episode(NavigationSettings(map=tmp_path / "town.yaml", start=(1.0, 1.0, 0.0), goals=((2.0, 1.0, 0.0),)))


def test_obstacles_may_be_other_than_the_robot_expects() -> None:
    def radii(between: tuple[float, float]) -> Array:
        settings = NavigationSettings(obstacles=6, seed=2, obstacle_radius=between)
        return Episode(settings, rehearsal=True).world.obstacle_states()[:, 2]

    assert 0.15 <= radii((0.15, 0.25)).min() and radii((0.15, 0.25)).max() <= 0.25
    assert 0.08 <= radii((0.08, 0.1)).min() and radii((0.08, 0.1)).max() <= 0.1
    with pytest.raises(ScenarioError, match="radii 0 < least"):
        radii((0.0, 0.1))


def test_a_person_in_the_middle_of_a_short_way_walks_on() -> None:
    """No point of it is far enough to be gone for."""
    person = Person(np.column_stack([np.linspace(1.0, 1.7, 8), np.full(8, 2.0)]), 0.2, 1.0, field(hall()))
    for place in ((1.35, 2.0), (1.0, 2.0), (1.7, 2.0)):
        assert np.isfinite(person.force(np.array(place), np.zeros(2))).all()
