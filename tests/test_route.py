"""The route on a map: detours around what stands in the way, and patience where there is none."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from maps import field, walled
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.models.unicycle import followed
from unifg.scenarios.ground.drive_control import Controller
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.route import (
    ALLOWANCE,
    CLOSED,
    GAP,
    PATIENCE,
    STALLED,
    STUCK_TICKS,
    VAIN,
    WAITING,
    WALL_GAP,
    Route,
)
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.grid import SPACING
from unifg.typing import Array

RADIUS = 0.17


@functools.cache
def hall(width: float = 2.0) -> tuple[OccupancyMap, DistanceMap]:
    """A corridor of 12 m along x, its walls at y = 0 and y = width."""
    occupancy = walled(12.0, width + 0.2, 2, (0.0, -0.1, 0.0))
    return occupancy, field(occupancy)


def disc(x: float, y: float, radius: float, velocity: tuple[float, float] = (0.0, 0.0)) -> Tracks:
    """One tracked disc."""
    return Tracks(
        np.array([[x, y]]), np.array([velocity]), np.array([radius]), np.array([0]), np.array([0.0]), np.array([False])
    )


def through_the_hall() -> tuple[Route, Array]:
    """A route down the middle of the hall and the pose it begins at."""
    start = np.array([1.0, 1.0, 0.0])
    return Route(*hall(), start, np.array([11.0, 1.0, 0.5]), RADIUS), start


def test_route_finds_a_detour_around_a_disc() -> None:
    route, start = through_the_hall()
    tracks = disc(3.5, 1.0, 0.25)
    before = route.path
    assert route.repair(start, tracks)
    room = np.hypot(*(route.path[:, :2] - tracks.centre[0]).T) - tracks.radius
    assert room.min() > RADIUS + ALLOWANCE - 0.01
    assert hall()[1].distance(route.path[:, :2]).min() > RADIUS
    assert np.allclose(route.path[0, :2], start[:2])
    assert np.array_equal(route.path[-1], before[-1])
    assert np.hypot(*np.diff(route.path[:, :2], axis=0).T).max() < 0.08
    # Far beyond the disc the old path is kept.
    assert np.array_equal(route.path[-80:], before[-80:])
    reference = route.reference(start, 0.1 * np.arange(31.0))
    assert reference.shape == (31, 3)
    assert not any(route.repair(start, tracks) for _ in range(20)), "the detour is clear: no reason for another"


def test_route_refuses_a_gap_too_narrow_for_the_controller() -> None:
    """Hull and disc fit side by side, but not with the clearances that the controller asks for."""
    route, start = through_the_hall()
    narrow = 2.0 * RADIUS + WALL_GAP + GAP - 0.03
    before = route.path
    assert not route.repair(start, disc(3.5, 1.0, 1.0 - narrow))
    assert route.path is before


def test_stuck_robot_looks_for_another_way_on_the_whole_map() -> None:
    """Two corridors side by side, joined at their ends: a disc that closes one sends the robot through the other."""
    occupancy = walled(20.0, 4.2, 2, name="two corridors", blocks=[np.s_[40:44, 40:-40]])
    start, goal = np.array([1.0, 1.0, 0.0]), np.array([19.0, 1.0, 0.0])
    here = np.array([8.8, 1.0, 0.0])
    for closing, moved in (
        (disc(10.0, 1.0, 0.8), False),
        (replace(disc(10.0, 1.0, 0.8), mover=np.array([True])), True),
    ):
        route = Route(occupancy, field(occupancy), start, goal, RADIUS)
        for x in np.arange(1.0, 9.0):
            route.reference(np.array([x, 1.0, 0.0]), 0.1 * np.arange(2.0))
        answers = [route.repair(here, closing) for _ in range(STUCK_TICKS + PATIENCE)]
        assert any(answers)
        highest = route.path[:, 1].max()
        assert highest < 1.9 if moved else highest > 2.3, "what moves will be elsewhere; what stands stays"
        assert np.allclose(route.path[-1], goal)


def test_robot_that_waits_beside_a_mover_goes_back_the_way_it_came() -> None:
    """A mover that waits for a resting robot, which waits for the mover: the robot makes room, then drives on."""
    route = Route(*hall(0.9), np.array([1.0, 0.45, 0.0]), np.array([11.0, 0.45, 0.0]), RADIUS)
    nothing = disc(20.0, 1.0, 0.2)
    for x in np.arange(1.0, 4.01, 0.1):
        here = np.array([x, 0.45, 0.0])
        route.repair(here, nothing)
        route.reference(here, 0.1 * np.arange(2.0))
    waiting = replace(disc(4.47, 0.45, 0.2), mover=np.array([True]))
    assert any(route.repair(here, waiting) for _ in range(STUCK_TICKS + 2 * PATIENCE))
    furthest = route.path[: round(2.0 / SPACING), 0].min()
    assert 2.3 < furthest < 2.7
    assert np.allclose(route.path[0, :2], here[:2], atol=0.02)
    assert np.allclose(route.path[-1], [11.0, 0.45, 0.0])


@pytest.mark.parametrize(
    ("tracks", "given_up"),
    [
        (disc(2.2, 1.9, 0.2, (0.0, 1.0)), False),
        (disc(2.2, 1.9, 0.2), True),
        (disc(1.0 + WAITING + 0.5, 1.9, 0.2, (0.0, 1.0)), True),
    ],
    ids=["moves by", "stands", "moves far off"],
)
def test_a_goal_is_not_given_up_for_what_moves_nearby(
    tracks: Tracks, given_up: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that does not come nearer may wait for a mover as long as that moves; for all else there is an end."""
    route, start = through_the_hall()
    monkeypatch.setattr(route, "_stuck", lambda end: False)
    for _ in range(STALLED + 3):
        route.repair(start, tracks)
    assert (route.blocked is not None) == given_up


@pytest.mark.parametrize("mover", [False, True])
def test_detours_around_movers_that_rest_are_no_sign_of_a_closed_way(mover: bool) -> None:
    """Each place where a mover rests is driven around; what then stands in the way gets the patience it is due."""
    route, start = through_the_hall()
    route.repair(start, disc(30.0, 1.0, 0.2))
    detours = 0
    while detours <= CLOSED // VAIN:
        ahead = route.path[30, :2]
        resting = disc(float(ahead[0]), float(np.clip(ahead[1], 0.8, 1.2)), 0.25)
        for _ in range(PATIENCE + 1):
            detours += route.repair(start, replace(resting, mover=np.array([mover])))
    standing = disc(3.5, 1.0, 0.9)
    for _ in range(PATIENCE + 2):
        route.repair(start, standing)
    assert (route.blocked is not None) == (not mover)


@pytest.mark.parametrize("heading", [0.0, 1.6, 3.1])
def test_a_guess_without_a_warm_start_can_be_driven(heading: float) -> None:
    """It keeps limits, accelerations and dynamics, turns before it drives, rests at the end, near the reference's."""
    settings = ControllerSettings()
    controller = Controller(hall()[1], "sqp", settings)
    route, start = through_the_hall()
    pose = np.array([start[0], start[1], heading])
    reference = route.reference(pose, controller.stations())
    now = controller.loop.now(pose, controller.given(pose, reference, Tracks.none()))
    states, controls = controller.along(now)
    assert np.abs(controls).max() <= 1.0
    assert np.all(np.abs(np.diff(controls, axis=0, prepend=0.0, append=0.0)) <= settings.most + 1e-9)
    np.testing.assert_allclose(states, followed(pose, now.last, controls, 0.1), atol=1e-9)
    if heading > 1.5:
        assert abs(controls[0, 0]) < 0.1
        assert abs(controls[0, 1]) == settings.most[1]
        assert np.abs(controls[:, 1]).max() == 1.0
    else:
        assert np.hypot(*(states[-1] - reference[-1])[:2]) < 0.4


@pytest.mark.parametrize(
    "tracks",
    [disc(8.0, 1.0, 0.25), disc(3.5, 1.0, 0.25, (0.0, 0.3)), disc(3.5, 1.75, 0.2), disc(3.5, 1.0, 0.8)],
    ids=["too far", "moving", "beside the path", "no way remains"],
)
def test_route_is_left_alone(tracks: Tracks) -> None:
    route, start = through_the_hall()
    before = route.path
    assert not route.repair(start, tracks)
    assert route.path is before


# ----------------------------------------------------------------- localiser
