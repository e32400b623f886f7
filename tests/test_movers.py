"""Movers whose motion is learned: when their sweeps are known, and what the robot makes of that."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from maps import field, walled
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.ground.drive_parts import disc_limits, predicted
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.route import BETWEEN, PERIODS, TICK, Route
from unifg.scenarios.ground.waiting import EARLY, LOOK, occupancy, timed, waiting
from unifg.scenarios.perception.motion_model import GONE, MEMORY, SELDOM, UNLIKELY, MotionModel, Past
from unifg.scenarios.perception.tracks import Tracks, nearest, to_and_fro
from unifg.scenarios.planning.grid import SPACING
from unifg.scenarios.planning.space_time import CELL, Future, quickest
from unifg.typing import Array

DT, RADIUS = 0.1, 0.2
SETTINGS = ControllerSettings()
AFAR = np.array([-50.0, 0.0])  # the robot
ENDS = np.array([[3.0, 2.0], [4.2, 2.9]])  # 1.5 m apart


def seen(place: Array, velocity: Array, name: int = 0, unseen: float = 0.0) -> Tracks:
    """One mover."""
    found = Tracks.of_movers(place[None], velocity[None], np.array([RADIUS]))
    return replace(found, identity=np.array([name]), unseen=np.array([unseen]))


def walk(
    model: MotionModel, times: Array, speed: float, sigma: float = 0.02, name: int = 0, until: float = np.inf
) -> list[Tracks]:
    """Tracks of a mover between the ends, that goes on straight beyond the second one after a while."""
    rng, length = np.random.default_rng(3), float(np.hypot(*(ENDS[1] - ENDS[0])))
    direction, found = (ENDS[1] - ENDS[0]) / length, []
    for time in times:
        now, before = (
            float(to_and_fro(0.0, length, 0.0, speed, np.array(t)) if t < until else speed * t % (2.0 * length))
            for t in (time, time - DT)
        )
        place = ENDS[0] + now * direction + sigma * rng.standard_normal(2)
        found.append(model.update(seen(place, (now - before) / DT * direction, name), DT, AFAR))
    return found


def clock(begin: float, end: float) -> Array:
    """Times of the ticks from one time to another [s]."""
    return DT * np.arange(float(round(begin / DT)), float(round(end / DT)))


# ------------------------------------------------------------------ what is learned


@pytest.mark.parametrize("speed", [0.3, 0.6, 1.0, 1.5])
def test_a_sweep_is_known_after_two_turns_and_foretells_the_next(speed: float) -> None:
    period = 3.0 / speed
    found = walk(MotionModel(), clock(0.3, 0.3 + 1.5 * period), speed)
    known = [tracks.sweeps[0] for tracks in found]
    first = 0.3 + DT * known.index(True)
    assert period < first < 1.5 * period, "the second end is where it turns for the second time"
    assert all(known[known.index(True) :])
    last = 0.3 + DT * (len(found) - 1)
    ahead = np.linspace(0.0, 3.0, 31)
    true = ENDS[0] + to_and_fro(0.0, 1.5, 0.0, speed, last + ahead)[:, None] * (ENDS[1] - ENDS[0]) / 1.5
    assert np.hypot(*(found[-1].swept(ahead)[:, 0] - true).T).max() < 0.08


def test_one_who_does_something_else_is_not_known_any_more() -> None:
    found = walk(MotionModel(), clock(0.0, 13.0), 1.0, until=10.5)
    assert found[round(10.4 / DT)].sweeps[0]
    assert not any(tracks.sweeps[0] for tracks in found[round(10.5 / DT) + 3 :][:5]), "three ticks later at the latest"


def test_one_who_walks_on_or_bends_is_not_known() -> None:
    straight, bent = MotionModel(), MotionModel()
    for time in clock(0.0, 12.0):
        on = straight.update(seen(np.array([0.8 * time, 1.0]), np.array([0.8, 0.0])), DT, AFAR)
        angle = time / 0.8
        circle = np.array([np.cos(angle), np.sin(angle)])
        round_ = bent.update(seen(circle, np.array([-circle[1], circle[0]]) / 0.8), DT, AFAR)
        assert not on.sweeps[0] and not round_.sweeps[0]
    assert np.hypot(*(on.sweep[0, :2] - on.sweep[0, 2:4])) == pytest.approx(0.8 * 1.9), "where it was lately"


def test_what_is_hidden_is_foretold_and_what_comes_back_is_known() -> None:
    model = MotionModel()
    walk(model, clock(0.0, 6.0), 0.8)
    begun = MotionModel().update(seen(np.array([9.0, 9.0]), np.zeros(2), unseen=0.1), DT, AFAR)
    assert np.allclose(begun.sweep[0, :4], 9.0), "a past may begin out of sight"
    hidden = model.update(seen(np.array([9.0, 9.0]), np.zeros(2), unseen=0.1), DT, AFAR)
    assert np.hypot(*(hidden.centre[0] - hidden.swept(np.zeros(1))[0, 0])) < 1e-9
    for _ in range(10):
        model.update(Tracks.none(), DT, AFAR)
    assert walk(model, clock(7.1, 7.5), 0.8, name=5)[-1].sweeps[0], "another number on the line of the lost one"
    other = model.update(seen(np.array([3.0, 4.0]), np.zeros(2), name=9), DT, AFAR)
    assert not other.sweeps[0]
    for _ in range(round(GONE / DT) + 2):
        model.update(Tracks.none(), DT, AFAR)
    assert not model._pasts
    assert len(walk(model, clock(0.0, 20.0), 0.8)) > MEMORY and len(model._pasts[0].times) == MEMORY


# ------------------------------------------------------------------ who yields


def met(end: float, robots: dict[float, float], until: float = 99.0, length: float = 99.0) -> list[Tracks]:
    """Tracks of a mover at 1 m/s to and fro on a way; robots stand there for 4 s each, by the times they come at.

    Until a time the mover brakes at 1 m/s^2 before a robot, later it passes through.
    """
    model, rng, found = MotionModel(), np.random.default_rng(5), []
    made, speed, felt = 0.0, 1.0, 1.0
    for time in clock(0.0, end):
        robot = np.array([next((x for t, x in robots.items() if t <= time < t + 4.0), -50.0), 0.1])
        sense = 1.0 if made % (2.0 * length) < length else -1.0
        ahead = sense * (robot[0] - float(to_and_fro(0.0, length, made, 0.0, np.array(0.0))))
        stops = time < until and 0.0 < ahead < 0.9 + 0.5 * speed**2
        speed = min(max(speed - DT if stops else speed + DT, 0.0), 1.0)
        made, felt = made + DT * speed, 0.5 * (felt + sense * speed)
        at = np.array([float(to_and_fro(0.0, length, made, 0.0, np.array(0.0))), 0.0])
        found.append(model.update(seen(at + 0.02 * rng.standard_normal(2), np.array([felt, 0.0])), DT, robot))
    return found


def yielding(tracks: list[Tracks]) -> Array:
    """Weights (n,) of yielding."""
    return np.array([each.weights[0, 3] for each in tracks])


ROBOTS = {2.0: 4.0, 9.0: 7.5, 16.0: 11.0}


def test_weight_rises_with_every_robot_that_a_mover_yields_to() -> None:
    weights = yielding(met(22.0, ROBOTS))
    first, second, third = (weights[round(begin / DT) :][:40].max() for begin in ROBOTS)
    assert weights[: round(2.0 / DT)].max() <= SELDOM, "it has met no robot"
    assert UNLIKELY < first < second < third and third > 0.5


def test_weight_stays_for_a_mover_that_does_not_yield() -> None:
    assert yielding(met(22.0, ROBOTS, until=0.0)).max() <= SELDOM
    assert yielding(met(22.0, {})).max() <= SELDOM, "it met nobody"
    before_its_end = dict.fromkeys((8.0, 13.0, 18.0, 23.0), 3.5)
    assert yielding(met(28.0, before_its_end, 0.0, 2.5))[80:].max() < 0.1 * SELDOM, "it turns there anyway"


def test_weight_falls_for_a_mover_that_does_not_yield_any_more() -> None:
    weights = yielding(met(22.0, ROBOTS, until=15.0))
    assert weights[round(15.0 / DT)] > 0.5 and weights[-1] < UNLIKELY


def test_a_mover_that_yields_is_not_known_to_go_to_and_fro() -> None:
    """One that turns round before robots is known; one that would, but stops for them, is not."""
    robots = {k: 2.9 for k in (2.0, 9.0, 16.0, 23.0)}
    turns, stops = met(26.0, robots, 0.0, 2.5), met(26.0, robots, 99.0, 2.5)
    known, likely = (np.array([each.sweeps[0] for each in found]) for found in (turns, stops))
    assert known[-100:].all() and not likely.any()
    last = stops[-1].sweep[0]
    assert np.isfinite(last[:4]).all() and np.isnan(last[4:]).all() and np.isfinite(stops[-1].wave).all(), "ends stay"


@pytest.mark.parametrize(("yields", "known"), [(SELDOM, True), (0.5 * UNLIKELY, True), (2.0 * UNLIKELY, False)])
def test_a_sweep_that_fits_is_not_known_of_one_who_yields(yields: float, known: bool) -> None:
    places, wave, axis = np.zeros((9, 2)), np.array([-1.0, 1.0, 0.5, 1.0]), np.eye(2)
    past = Past(np.arange(9.0), places, places, places, wave, axis, np.array([1.0, 0.0, 0.0, yields]))
    assert np.isfinite(past.sweep[4:]).all() == known


# ------------------------------------------------------------------ what is made of it


def sweeping(made: float = 0.0, speed: float = 1.0) -> Tracks:
    """A mover across a corridor along x at x = 5."""
    row = np.array([[5.0, 0.4, 5.0, 1.6, made, speed]])
    place = np.array([[5.0, float(to_and_fro(0.4, 1.6, made, 0.0, np.array(0.0)))]])
    return replace(Tracks.of_movers(place, np.array([[0.0, speed]]), np.array([RADIUS])), sweep=row)


def test_a_known_mover_is_kept_off_where_it_will_be() -> None:
    pose, tracks = np.array([3.0, 1.0, 0.0]), sweeping()
    centres = predicted(SETTINGS, pose, tracks)
    stages = DT * np.arange(1.0, SETTINGS.horizon + 1.0)
    assert np.allclose(centres[:, 0, 1], to_and_fro(0.4, 1.6, 0.0, 1.0, stages))
    resting = np.tile(pose, (SETTINGS.horizon + 1, 1))
    least = disc_limits(SETTINGS, pose, centres, tracks, resting, np.zeros((2, 2)))
    assert np.allclose(least, SETTINGS.robot_radius + SETTINGS.disc_clearance + 0.1), "no barrier, no second to brake"


def test_the_nearest_discs_count_a_sweep_as_a_whole() -> None:
    mover = replace(sweeping(), centre=np.array([[5.0, 1.6]]))
    still = Tracks.of_movers(np.array([[5.0, -0.6]]), np.zeros((1, 2)), np.array([RADIUS]))
    assert nearest(still.followed_by(mover), (5.0, 0.1), 1).sweeps[0]


def test_a_search_waits_for_a_gap_and_uses_it() -> None:
    occupied = np.zeros((11, 11), dtype=bool)
    occupied[:6, 3] = True
    places = timed(occupied, np.zeros(11, dtype=bool))
    assert places.tolist()[5:] == [2, 3, 4, 5, 6, 7] and not occupied[np.arange(11), places].any()
    occupied[:, 3] = True
    assert timed(occupied, np.zeros(11, dtype=bool))[-1] == 2
    unsafe = np.zeros(11, dtype=bool)
    unsafe[1:3] = True
    assert not timed(occupied, unsafe).any(), "it does not wait where no rest is safe"
    assert timed(np.zeros((11, 11), dtype=bool), np.zeros(11, dtype=bool)).tolist() == list(range(11))
    inside = np.zeros((11, 11), dtype=bool)
    inside[:, :3] = True
    assert timed(inside, np.zeros(11, dtype=bool)).tolist() == list(range(11)), "out of where it is occupied"


def test_a_known_mover_occupies_places_when_it_is_there_and_none_is_safe_on_its_way() -> None:
    places = np.column_stack([np.linspace(4.0, 6.0, LOOK + 1), np.full(LOOK + 1, 1.0)])
    tracks = replace(sweeping(made=0.6, speed=0.5), radius=np.array([0.15]))
    occupied, unsafe = occupancy(SETTINGS, np.array([4.0, 1.0, 0.0]), places, tracks)
    middle = LOOK // 2
    reach = 0.15 + SETTINGS.robot_radius + SETTINGS.disc_clearance
    assert unsafe[middle] and not unsafe[0] and not occupied[:, 0].any()
    near = np.abs(to_and_fro(0.4, 1.6, 0.6, 0.5, DT * np.arange(LOOK + 1.0)) - 1.0) < reach
    assert occupied[:, middle][near].all() and not occupied[:, middle].all()
    assert np.flatnonzero(~occupied[:, middle])[0] == np.flatnonzero(~near)[0] + EARLY


def test_a_robot_waits_for_an_unknown_mover_where_that_is_safe_and_only_there() -> None:
    places = np.column_stack([0.1 * np.arange(LOOK + 1.0), np.zeros(LOOK + 1)])
    pose = np.zeros(3)

    def waits(x: float, speed: float) -> bool:
        mover = Tracks.of_movers(np.array([[x, 0.5]]), np.array([[0.0, speed]]), np.array([RADIUS]))
        return bool(waiting(SETTINGS, pose, places, mover)[-1] < LOOK)

    assert waits(3.0, -0.5)
    assert not waits(0.2, -0.5), "it comes to where the robot is"
    near = replace(sweeping(), sweep=np.array([[0.2, -0.6, 0.2, 0.6, 0.0, 1.0]]))
    far = replace(sweeping(), sweep=np.array([[3.0, -0.6, 3.0, 0.6, 0.0, 1.0]]))
    assert waiting(SETTINGS, pose, places, near.followed_by(far))[-1] < 30, "for those that are known nevertheless"


def test_an_unknown_mover_occupies_where_it_was_and_where_it_can_be() -> None:
    places = np.column_stack([np.linspace(3.0, 5.0, LOOK + 1), np.full(LOOK + 1, 1.0)])
    row = np.array([[5.0, 0.4, 5.0, 1.0, np.nan, np.nan]])
    tracks = replace(Tracks.of_movers(np.array([[5.0, 3.0]]), np.array([[0.0, 1.0]]), np.array([RADIUS])), sweep=row)
    occupied, unsafe = occupancy(SETTINGS, np.array([3.0, 1.0, 0.0]), places, tracks)
    reach = RADIUS + SETTINGS.robot_radius + SETTINGS.disc_clearance
    gap = 5.0 - places[:, 0] - reach
    assert (unsafe == (gap < SETTINGS.mover_surprise)).all()
    for step in (0, 2, LOOK):
        assert (occupied[step] == (gap < min(DT * step, SETTINGS.mover_surprise))).all()
    resting = replace(tracks, velocity=np.zeros((1, 2)))
    assert (occupancy(SETTINGS, np.array([3.0, 1.0, 0.0]), places, resting)[1] == (gap < 0.0)).all()


# ------------------------------------------------------------------ ways


HALL, LANE = walled(12.0, 12.0, 2), walled(12.0, 1.1, 2)
ROBOT = 0.17


def nothing(time: float) -> Array:
    """No discs."""
    return np.zeros((0, 3))


def arrival(occupancy: OccupancyMap, start: tuple[float, float], goal: tuple[float, float], discs: Future) -> float:
    """Clairvoyant arrival of a robot's disc within half a minute."""
    way = quickest(occupancy, field(occupancy), np.array(start), np.array(goal), ROBOT, discs, longest=30.0)
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


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_lane_that_stays_closed_has_no_arrival(speed: float) -> None:
    """Neither past what stands nor for one who cannot get out of the way of what comes."""
    assert (
        arrival(LANE, (1.05, 0.55), (11.05, 0.55), lambda time: np.array([[6.0 - speed * time, 0.55, 0.3]])) == math.inf
    )


def corridor(width: float = 2.0) -> Route:
    """A route along the middle of a corridor."""
    occupancy_map = walled(12.0, width + 0.2, 2, (0.0, -0.1, 0.0))
    ends = np.array([[1.0, 1.0, 0.0], [11.0, 1.0, 0.0]])
    return Route(occupancy_map, field(occupancy_map), ends[0], ends[1], 0.17)


def test_a_way_between_leads_past_the_end_that_is_free() -> None:
    """The mover leaves the robot the upper half of the corridor while it is at its lower end."""
    route, pose, tracks = corridor(), np.array([3.5, 1.0, 0.0]), sweeping(made=0.6)
    route.reference(np.array([2.0, 1.0, 0.0]), np.zeros(1))
    route.reference(pose, np.zeros(1))
    before = route.path
    assert route.around(pose, tracks, 1.0, 0.2)
    assert np.allclose(route.path[0, :2], pose[:2]) and np.array_equal(route.path[-60:], before[-60:])
    assert np.hypot(*np.diff(route.path[:, :2], axis=0).T).max() < 2.0 * SPACING
    times = 0.2 + SPACING * np.arange(float(len(route.path)))
    apart = np.hypot(*(route.path[:, :2] - tracks.swept(times)[:, 0]).T)
    assert apart.min() > 0.17 + RADIUS, "driven at once it touches nothing"
    assert not route.around(pose, tracks, 1.0, 0.2), "not again at once"


def test_a_mover_off_the_way_is_no_reason_to_leave_it() -> None:
    route, pose = corridor(), np.array([1.0, 1.0, 0.0])
    before = route.path
    far = replace(sweeping(), sweep=np.array([[6.0, 0.4, 6.0, 1.6, 0.0, 1.0]]))
    assert not route.around(pose, far, 1.0, 0.2) and route.path is before, "it is farther off than is looked"
    aside = replace(sweeping(), sweep=np.array([[2.0, 5.0, 2.0, 6.0, 0.0, 1.0]]))
    assert not any(route.around(pose, aside, 1.0, 0.2) for _ in range(500)) and route.blocked is None


def test_after_three_periods_the_goal_is_given_up_by_name() -> None:
    route, pose = corridor(), np.array([3.5, 1.0, 0.0])
    route.reference(np.array([2.0, 1.0, 0.0]), np.zeros(1))
    route.reference(pose, np.zeros(1))
    wide = replace(sweeping(), radius=np.array([0.55]))  # no robot gets past it
    ticks = round(PERIODS * 2.4 / TICK)
    for _ in range(ticks):
        assert not route.around(pose, wide, 1.0, 0.2) and route.blocked is None
    for _ in range(BETWEEN + 1):
        route.around(pose, wide, 1.0, 0.2)
    assert str(route.blocked) == "kept away by a mover at (5.0, 0.4)"


def test_after_three_periods_another_way_is_taken() -> None:
    two = walled(20.0, 4.2, 2, name="two corridors", blocks=[np.s_[40:44, 40:-40]])
    start, goal = np.array([1.0, 1.0, 0.0]), np.array([19.0, 1.0, 0.0])
    route, pose = Route(two, field(two), start, goal, 0.17), np.array([3.5, 1.0, 0.0])
    route.reference(np.array([2.0, 1.0, 0.0]), np.zeros(1))
    route.reference(pose, np.zeros(1))
    wide = replace(sweeping(), radius=np.array([0.55]))
    ticks = round(PERIODS * 2.4 / TICK) + BETWEEN + 1
    found = [route.around(pose, wide, 1.0, 0.2) for _ in range(ticks)]
    assert any(found) or any(route.repair(pose, wide) for _ in range(5))  # the search goes on in the next ticks
    assert route.path[:, 1].max() > 2.3 and route.blocked is None
