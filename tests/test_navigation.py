"""The closed loop: it arrives, it repeats itself, it stops when its solver fails, it finds a way around."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap, load_map, save_map
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.building import building_map
from unifg.scenarios.controller import Controller, ControllerSettings
from unifg.scenarios.episode import EpisodeLog
from unifg.scenarios.geometry import polyline_distance
from unifg.scenarios.localiser import Localiser
from unifg.scenarios.metrics import episode_metrics, pose_errors
from unifg.scenarios.navigation import Episode, NavigationSettings, run_navigation
from unifg.scenarios.path import path_length
from unifg.scenarios.perception import Tracks
from unifg.scenarios.planner import SPACING
from unifg.scenarios.route import ALLOWANCE, GAP, PATIENCE, STUCK_TICKS, WALL_GAP, Route
from unifg.scenarios.world import Scan, World
from unifg.typing import Array

RADIUS = 0.17
SOLVERS = ("alm", "sqp")

# Seven metres of the long corridor, and eight metres out of an office's door and around the corner.
CORRIDOR = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),))
CORNER = NavigationSettings(start=(10.8, 17.0, -1.57), goals=((16.5, 14.0, 0.0),))


def stop_after(ticks: int, settings: NavigationSettings) -> EpisodeLog:
    """An episode that the user interrupts after so many ticks."""
    return drive(Episode(settings), ticks)


def drive(episode: Episode, ticks: int) -> EpisodeLog:
    """Run an episode for so many ticks at most."""
    count = 0

    def interrupt(done: float, text: str) -> None:
        nonlocal count
        count += done < 1.0
        if count >= ticks:
            count = -(10**6)
            raise KeyboardInterrupt

    return episode.run(interrupt)


# ------------------------------------------------------------------- arriving


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    "settings",
    [replace(CORRIDOR, obstacles=2, seed=1), replace(CORNER, obstacles=1, seed=2)],
    ids=["corridor", "corner"],
)
def test_short_drive_reaches_its_goal(settings: NavigationSettings, solver: str) -> None:
    log = run_navigation(replace(settings, solver=solver))
    metrics = episode_metrics(log)
    assert log.succeeded
    assert metrics["collisions"] == 0
    assert metrics["min_clearance_m"] > 0.0
    assert metrics["obstacles"] == settings.obstacles
    assert metrics["max_bound_violation"] < 1e-3
    assert np.all(np.abs(log.control) <= 1.0)
    assert metrics["duration_s"] <= metrics["planned_length_m"] / 0.6
    assert metrics["localisation_error_m"]["mean"] < 0.05
    assert metrics["localisation_error_rad"]["mean"] < 0.015
    assert metrics["localisation_error_m"]["mean"] < 0.5 * metrics["odometry_error_m"]["mean"]
    # Judged by the truth, not by what the robot believes.
    position, heading = pose_errors(log.true_pose[-1:], log.goals[-1:])
    assert position[0] < 0.2 and heading[0] < 0.2
    assert path_length(log.true_pose) > 0.9 * np.hypot(*(log.goals[0] - log.start)[:2])


@pytest.mark.data
@pytest.mark.parametrize("solver", SOLVERS)
def test_turtlebot_world(shared_data: Path, solver: str) -> None:
    settings = NavigationSettings(
        map=shared_data / "maps" / "turtlebot3_world.yaml",
        start=(-2.0, -0.5, 0.0),
        goals=((2.0, -0.5, 0.0),),
        solver=solver,
    )
    log = run_navigation(settings)
    metrics = episode_metrics(log)
    assert log.succeeded
    assert metrics["duration_s"] <= min(metrics["planned_length_m"], metrics["path_length_m"]) / 0.6
    assert metrics["localisation_error_m"]["mean"] < 0.05
    assert metrics["localisation_error_rad"]["mean"] < 0.015
    assert metrics["max_bound_violation"] < 1e-3


# ------------------------------------------------------------- reproducibility


@pytest.mark.parametrize("solver", SOLVERS)
def test_same_seed_same_drive(solver: str) -> None:
    settings = replace(CORRIDOR, solver=solver, obstacles=2, seed=5)
    one, two = stop_after(40, settings), stop_after(40, settings)
    assert one.ticks == two.ticks == 40
    clocked = {"solve_ms", "localise_ms", "plan_ms", "perceive_ms", "route_ms"}
    for name, value in vars(one).items():
        other = getattr(two, name)
        if name in clocked or name == "occupancy":
            continue
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, other, equal_nan=value.dtype.kind == "f"), name
        elif name == "detected":
            assert all(np.array_equal(a, b) for a, b in zip(value, other, strict=True))
        else:
            assert value == other, name


def test_other_seed_other_drive() -> None:
    one, two = (stop_after(10, replace(CORRIDOR, obstacles=2, seed=seed)) for seed in (5, 6))
    assert not np.array_equal(one.true_pose, two.true_pose)
    assert not np.array_equal(one.scan, two.scan, equal_nan=True)
    assert not np.array_equal(one.obstacles, two.obstacles)


def test_interrupted_episode_is_a_shorter_one() -> None:
    log = stop_after(7, CORRIDOR)
    assert log.ticks == 7
    assert log.interrupted and not log.succeeded


# ------------------------------------------------------------------ emergency


class Failing:
    """A prepared solver whose answers are worthless from one solve on."""

    def __init__(self, inner: Any, good: int) -> None:
        self.inner, self.good = inner, good

    def solve(self, guess: fg.Guess, **options: Any) -> Any:
        solution = self.inner.solve(guess, **options)
        self.good -= 1
        return solution if self.good >= 0 else Garbage(solution)


class Garbage:
    """An answer that must never reach the wheels."""

    status = fg.Status.LOCALLY_INFEASIBLE
    violation = np.inf
    worst = ("dynamics", 0)
    iterations = 7
    converged = False

    def __init__(self, solution: fg.Solution) -> None:
        self.solution = solution

    def __getitem__(self, variable: Any) -> Array:
        return np.full_like(self.solution[variable], 99.0)


def replace_solver(monkeypatch: pytest.MonkeyPatch, episode: Episode, double: object) -> None:
    """Put a double in place of the warm-started solver and of the one for cold starts."""
    for name in ("_run", "_cold"):
        monkeypatch.setattr(episode.pilot.controller, name, double)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("good", [12, 30], ids=["straight", "in the turn"])
def test_failed_solves_brake_to_rest_along_the_stored_plan(
    monkeypatch: pytest.MonkeyPatch, solver: str, good: int
) -> None:
    episode = Episode(replace(CORNER, solver=solver, seed=3))
    horizon = episode.settings.controller.horizon
    replace_solver(monkeypatch, episode, Failing(episode.pilot.controller._run, good))
    log = drive(episode, good + horizon + 10)
    assert np.array_equal(log.emergency, np.arange(log.ticks) >= good)
    assert set(log.status[good:]) == {"locally_infeasible"}

    speed = np.abs(log.control[good - 1 :, 0])
    assert speed[0] > 0.5, "the robot must be under way for this test to mean anything"
    assert np.all(np.diff(speed) <= 1e-9)
    assert np.all(log.control[good + horizon :] == 0.0)
    assert np.all(np.abs(log.control[good:]) <= 1.0)
    at_rest = log.true_pose[good + horizon + 1 :]
    assert np.abs(at_rest - at_rest[0]).max() < 1e-6

    assert log.collisions == 0
    assert log.clearance.min() > 0.0
    way = log.horizon[good - 1, :, :2]
    assert polyline_distance(log.true_pose[good - 1 :, :2], way).max() < 0.03
    assert not log.succeeded
    assert episode_metrics(log)["solver_failures"] == log.ticks - good


def test_one_failed_solve_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = Episode(replace(CORRIDOR, seed=3))
    run = episode.pilot.controller._run
    calls = 0

    class Once:
        def solve(self, guess: fg.Guess, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            solution = run.solve(guess, **options)
            return Garbage(solution) if calls == 20 else solution

    replace_solver(monkeypatch, episode, Once())
    log = episode.run(lambda done, text: None)
    assert log.succeeded
    assert log.emergency.sum() == 1


def test_failure_on_the_first_tick_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = Episode(CORRIDOR)
    replace_solver(monkeypatch, episode, Failing(episode.pilot.controller._run, 0))
    log = drive(episode, 5)
    assert log.emergency.all()
    assert np.all(log.control == 0.0)
    assert np.array_equal(log.true_pose, np.broadcast_to(log.true_pose[0], log.true_pose.shape))


# ------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"goals": ((6.0, 10.0, 0.0),)}, "goal"),  # in a wall
        ({"goals": ((60.0, 10.0, 0.0),)}, "goal"),  # off the map
        ({"start": (6.0, 10.0, 0.0)}, "start"),
        ({"goals": ((np.nan, 10.0, 0.0),)}, "goal"),
        ({"goals": ()}, "goal"),
        ({"solver": "newton"}, "alm or sqp"),
        ({"coupling": "telepathic"}, "sequential"),
    ],
)
def test_impossible_episodes_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        run_navigation(replace(CORRIDOR, **change))


def test_a_map_of_ones_own_needs_start_and_goal(tmp_path: Path) -> None:
    save_map(tmp_path / "hall.yaml", hall()[0])
    own = NavigationSettings(map=tmp_path / "hall.yaml")
    with pytest.raises(ScenarioError, match="--start"):
        run_navigation(own)
    with pytest.raises(ScenarioError, match="--goal"):
        run_navigation(replace(own, start=(1.0, 1.0, 0.0)))


# ---------------------------------------------------------------------- route


@functools.cache
def hall(width: float = 2.0) -> tuple[OccupancyMap, DistanceMap]:
    """A corridor of 12 m along x, its walls at y = 0 and y = width."""
    occupied = np.zeros((round(width / 0.05) + 4, 240), dtype=bool)
    occupied[:2] = occupied[-2:] = True
    occupied[:, :2] = occupied[:, -2:] = True
    occupancy = OccupancyMap(occupied, ~occupied, 0.05, (0.0, -0.1, 0.0), "hall")
    return occupancy, DistanceMap.from_occupancy(occupied, 0.05, occupancy.origin)


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
    assert route.repairs == 1
    room = np.hypot(*(route.path[:, :2] - tracks.centre[0]).T) - tracks.radius
    assert room.min() > RADIUS + ALLOWANCE - 0.01
    assert hall()[1].distance(route.path[:, :2]).min() > RADIUS
    assert np.allclose(route.path[0, :2], start[:2])
    assert np.array_equal(route.path[-1], before[-1])
    assert np.hypot(*np.diff(route.path[:, :2], axis=0).T).max() < 0.08
    # Far beyond the disc the old path is kept.
    assert np.array_equal(route.path[-80:], before[-80:])
    reference = route.reference(start, 0.1, 31)
    assert reference.shape == (31, 3)
    assert not any(route.repair(start, tracks) for _ in range(20)), "the detour is clear: no reason for another"


def test_route_waits_where_no_way_remains() -> None:
    route, start = through_the_hall()
    before = route.path
    assert not route.repair(start, disc(3.5, 1.0, 0.8))
    assert route.path is before


def test_route_refuses_a_gap_too_narrow_for_the_controller() -> None:
    """Hull and disc fit side by side, but not with the clearances that the controller asks for."""
    route, start = through_the_hall()
    narrow = 2.0 * RADIUS + WALL_GAP + GAP - 0.03
    before = route.path
    assert not route.repair(start, disc(3.5, 1.0, 1.0 - narrow))
    assert route.path is before


def test_stuck_robot_looks_for_another_way_on_the_whole_map() -> None:
    """Two corridors side by side, joined at their ends: a disc that closes one sends the robot through the other."""
    occupied = np.zeros((84, 400), dtype=bool)
    occupied[:2] = occupied[-2:] = True
    occupied[:, :2] = occupied[:, -2:] = True
    occupied[40:44, 40:-40] = True
    occupancy = OccupancyMap(occupied, ~occupied, 0.05, (0.0, 0.0, 0.0), "two corridors")
    field = DistanceMap.from_occupancy(occupied, 0.05, occupancy.origin)
    start, goal = np.array([1.0, 1.0, 0.0]), np.array([19.0, 1.0, 0.0])
    here = np.array([8.8, 1.0, 0.0])
    for closing, moved in (
        (disc(10.0, 1.0, 0.8), False),
        (replace(disc(10.0, 1.0, 0.8), mover=np.array([True])), True),
    ):
        route = Route(occupancy, field, start, goal, RADIUS)
        for x in np.arange(1.0, 9.0):
            route.reference(np.array([x, 1.0, 0.0]), 0.1, 2)
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
        route.reference(here, 0.1, 2)
    waiting = replace(disc(4.47, 0.45, 0.2), mover=np.array([True]))
    assert any(route.repair(here, waiting) for _ in range(STUCK_TICKS + 2 * PATIENCE))
    furthest = route.path[: round(2.0 / SPACING), 0].min()
    assert 2.3 < furthest < 2.7
    assert np.allclose(route.path[0, :2], here[:2], atol=0.02)
    assert np.allclose(route.path[-1], [11.0, 0.45, 0.0])


@pytest.mark.parametrize("heading", [0.0, 1.6, 3.1])
def test_a_guess_without_a_warm_start_can_be_driven(heading: float) -> None:
    """It keeps limits and dynamics, turns before it drives, and ends near the end of the reference."""
    controller = Controller(hall()[1], "sqp", ControllerSettings())
    route, start = through_the_hall()
    pose = np.array([start[0], start[1], heading])
    reference = route.reference(pose, 0.1, 31)
    values = controller._along(pose, reference).values
    states, controls = np.asarray(values[controller._x]), np.asarray(values[controller._u])
    assert np.abs(controls).max() <= 1.0
    np.testing.assert_allclose(states, unicycle.rollout(pose, controls, 0.1), atol=1e-9)
    if heading > 1.5:
        assert abs(controls[0, 0]) < 0.1
        assert abs(controls[0, 1]) == 1.0
    else:
        assert np.hypot(*(states[-1] - reference[-1])[:2]) < 0.4


@pytest.mark.parametrize(
    "tracks",
    [disc(8.0, 1.0, 0.25), disc(3.5, 1.0, 0.25, (0.0, 0.3)), disc(3.5, 1.75, 0.2)],
    ids=["too far", "moving", "beside the path"],
)
def test_route_is_left_alone(tracks: Tracks) -> None:
    route, start = through_the_hall()
    before = route.path
    assert not route.repair(start, tracks)
    assert route.path is before


# ----------------------------------------------------------------- localiser


@functools.cache
def building() -> tuple[OccupancyMap, DistanceMap]:
    """The shipped floor and its distance map."""
    occupancy = building_map()
    return occupancy, DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)


SIGMA = np.array([0.1, 0.1, 0.05])


@pytest.mark.parametrize("place", [(3.0, 25.2, 0.0), (21.0, 9.6, -2.0), (10.8, 17.0, 1.0), (36.0, 18.0, 3.0)], ids=str)
@pytest.mark.parametrize("off", [(0.1, 0.0, 0.05), (-0.07, 0.07, -0.05), (0.0, -0.1, 0.05)], ids=str)
def test_localiser_converges(place: tuple[float, float, float], off: tuple[float, float, float]) -> None:
    occupancy, field = building()
    world = World(occupancy, place, rng=np.random.default_rng(1))
    localiser = Localiser(field, world.pose + np.array(off), SIGMA, world.lidar.beams)
    for _ in range(3):
        localiser.correct(world.scan())
    position, heading = pose_errors(localiser.pose[None], world.pose[None])
    assert position[0] < 0.03
    assert heading[0] < 0.01
    assert localiser.iterations > 0
    # It knows better than before, in every direction.
    assert np.linalg.eigvalsh(localiser.covariance).max() < SIGMA.min() ** 2


def test_localiser_keeps_the_prediction_without_a_scan() -> None:
    _, field = building()
    localiser = Localiser(field, np.array([3.0, 25.2, 0.0]), SIGMA, 360)
    localiser.predict(np.array([0.5, 0.0]), 0.1)
    predicted, uncertain = localiser.pose.copy(), localiser.covariance.copy()
    assert np.allclose(predicted, [3.05, 25.2, 0.0])
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    localiser.correct(Scan(angles, np.full(360, np.nan)))
    assert np.array_equal(localiser.pose, predicted)
    assert np.array_equal(localiser.covariance, uncertain)
    assert localiser.iterations == 0


@pytest.mark.data
def test_department_map_is_planned_end_to_end(shared_data: Path) -> None:
    occupancy = load_map(shared_data / "maps" / "dis-B1-2011-09-27.yaml")
    field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    start, goal = np.array([2.3, 30.0, -1.57]), np.array([10.0, 1.7, 0.0])
    route = Route(occupancy, field, start, goal, RADIUS)
    assert field.distance(route.path[:, :2]).min() > RADIUS
    assert 30.0 < path_length(route.path) < 45.0
