"""The closed loop: it arrives, it repeats itself, it stops when its solver fails, it finds a way around."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from calls import calls_of
from maps import building, field, stop_after
from unifg.errors import BackendError, ScenarioError
from unifg.files.ros_map import OccupancyMap, load_map, save_map
from unifg.scenarios.ground.localiser import Localiser
from unifg.scenarios.ground.route import Route
from unifg.scenarios.logs.drive_metrics import episode_metrics, pose_errors
from unifg.scenarios.navigation import Episode, NavigationSettings, run_navigation
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.polyline import path_length, polyline_distance
from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

RADIUS = 0.17
SOLVERS = ("ipm", "sqp", "alm")

# Seven metres of the long corridor, and eight metres out of an office's door and around the corner.
CORRIDOR = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),))
CORNER = NavigationSettings(start=(10.8, 17.0, -1.57), goals=((16.5, 14.0, 0.0),))


# ------------------------------------------------------------------- arriving


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    "settings",
    [replace(CORRIDOR, obstacles=2, seed=1), replace(CORNER, obstacles=1, seed=2)],
    ids=["corridor", "corner"],
)
@pytest.mark.product(2, of="drives and flights")
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
@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.product(1)
def test_a_goal_that_looks_back_along_the_way_is_reached(coupling: str) -> None:
    """The robot turns by half a circle where it arrives, within its accelerations, and does not rest before."""
    log = run_navigation(replace(CORRIDOR, coupling=coupling, goals=((8.0, 14.0, np.pi),)))
    assert log.succeeded and log.ticks < 80
    assert abs(abs(log.true_pose[-1, 2]) - np.pi) < 0.2


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.product(1)
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
@pytest.mark.product(2, of="drives and flights")
def test_same_seed_same_drive(solver: str) -> None:
    settings = replace(CORRIDOR, solver=solver, obstacles=2, seed=5)
    one, two = (Episode(settings).run(stop_after(40)) for _ in range(2))
    assert one.ticks == two.ticks == 40
    clocked = {"solve_ms", "localise_ms", "plan_ms", "perceive_ms", "route_ms"}
    for name, value in vars(one).items():
        other = getattr(two, name)
        if name in clocked or name == "judgement":
            continue
        if isinstance(value, OccupancyMap):
            assert np.array_equal(value.occupied, other.occupied), name
        elif isinstance(value, np.ndarray):
            assert np.array_equal(value, other, equal_nan=value.dtype.kind == "f"), name
        elif isinstance(value, list) and value and isinstance(value[0], np.ndarray):  # rows of different lengths
            assert all(np.array_equal(a, b) for a, b in zip(value, other, strict=True)), name
        else:
            assert value == other, name


@pytest.mark.product(1, of="seeds of drives")
def test_other_seed_other_drive() -> None:
    settings = [replace(CORRIDOR, obstacles=2, seed=seed) for seed in (5, 6)]
    one, two = (Episode(s).run(stop_after(10)) for s in settings)
    assert not np.array_equal(one.true_pose, two.true_pose)
    assert not np.array_equal(one.scan, two.scan, equal_nan=True)
    assert not np.array_equal(one.obstacles, two.obstacles)


def test_interrupted_episode_is_a_shorter_one() -> None:
    log = Episode(CORRIDOR).run(stop_after(7))
    assert log.ticks == 7
    assert log.interrupted and not log.succeeded


# ------------------------------------------------------------------ emergency


class Failing:
    """A prepared solver whose answers are worthless from one solve on."""

    def __init__(self, inner: Any, good: int) -> None:
        self.inner, self.good, self.solver = inner, good, inner.solver

    def solve(self, guess: fg.Guess, **options: Any) -> Any:
        solution = self.inner.solve(guess, **options)
        self.good -= 1
        return solution if self.good >= 0 else Garbage(solution)


class Garbage:
    """An answer that must never reach the wheels."""

    status = fg.Status.LOCALLY_INFEASIBLE
    history: tuple[fg.Iteration, ...] = ()
    violation = np.inf
    worst = ("dynamics", 0)
    iterations = 7
    converged = False

    def __init__(self, solution: fg.Solution) -> None:
        self.solution = solution

    def __getitem__(self, variable: Any) -> Array:
        return np.full_like(self.solution[variable], 99.0)


def replace_solver(monkeypatch: pytest.MonkeyPatch, episode: Episode, double: object) -> None:
    """Put a double in place of all solvers."""
    for name in ("warm", "cold", "second"):
        monkeypatch.setattr(episode.pilot.controller.loop, name, double)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("good", [12, 30], ids=["straight", "in the turn"])
@pytest.mark.product(2, of="drives and flights")
def test_failed_solves_brake_to_rest_along_the_stored_plan(
    monkeypatch: pytest.MonkeyPatch, solver: str, good: int
) -> None:
    episode = Episode(replace(CORNER, solver=solver, seed=3))
    horizon = episode.settings.controller.horizon
    replace_solver(monkeypatch, episode, Failing(episode.pilot.controller.loop.warm, good))
    log = episode.run(stop_after(good + horizon + 10))
    assert np.array_equal(log.emergency, np.arange(log.ticks) >= good)
    assert set(log.status[good:]) == {"locally_infeasible"}

    speed = np.abs(log.control[good - 1 :, 0])
    assert speed[0] > 0.5, "the robot must be under way for this test to mean anything"
    assert np.all(np.diff(speed) <= 1e-9)
    most = episode.controller.most
    assert np.all(np.abs(np.diff(log.control, axis=0, prepend=0.0)) <= most + 1e-6)
    assert np.all(log.control[good + int(1.0 / most[0]) + 1 :] == 0.0)
    assert np.all(np.abs(log.control[good:]) <= 1.0)
    at_rest = log.true_pose[good + horizon + 1 :]
    assert np.abs(at_rest - at_rest[0]).max() < 1e-6

    assert log.collisions == 0
    assert log.clearance.min() > 0.0
    way = log.horizon[good - 1, :, :2]
    assert polyline_distance(log.true_pose[good - 1 :, :2], way).max() < 0.03
    assert not log.succeeded
    assert episode_metrics(log)["solver_failures"] == log.ticks - good


@pytest.mark.product(2, of="drives and flights")
def test_one_failed_solve_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = Episode(replace(CORRIDOR, seed=3))
    run = episode.pilot.controller.loop.warm
    calls = 0

    class Once:
        def solve(self, guess: fg.Guess, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            solution = run.solve(guess, **options)
            return Garbage(solution) if calls == 20 else solution

    replace_solver(monkeypatch, episode, Once())
    monkeypatch.setattr(episode.pilot.controller.loop, "second", None)
    log = episode.run(lambda done, text: None)
    assert log.succeeded
    assert log.emergency.sum() == 1 and not log.rescued.any()


@pytest.mark.product(2, of="drives and flights")
def test_a_rescued_tick_is_no_emergency_and_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Failure of the requested backend for good: the second drives, and nothing is lost but time."""
    episode = Episode(replace(CORRIDOR, solver="alm", seed=3))
    loop = episode.pilot.controller.loop
    failing = Failing(loop.warm, 10)
    monkeypatch.setattr(loop, "warm", failing)
    monkeypatch.setattr(loop, "cold", failing)
    log = episode.run(stop_after(30))
    assert not log.emergency.any() and log.collisions == 0
    assert np.array_equal(log.rescued, np.arange(30) >= 10)
    assert episode_metrics(log)["rescued_ticks"] == loop.rescues == 20
    assert log.true_pose[-1, 0] - log.true_pose[10, 0] > 1.0


class Ended:
    """A solve as the controller sees it, with another violation."""

    def __init__(self, solution: fg.Solution, violation: float) -> None:
        self._solution, self.violation, self.status = solution, violation, fg.Status.ITERATION_LIMIT

    def __getitem__(self, variable: fg.Family | fg.Selection) -> Array:
        return self._solution[variable] + (0.2 if isinstance(variable, fg.Family) else 0.0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._solution, name)


NOBODY = Tracks.none()


@pytest.mark.parametrize(("share", "driven"), [(0.9, True), (1.1, False)])
def test_a_plan_is_driven_where_it_stopped_if_it_keeps_the_constraints(share: float, driven: bool) -> None:
    episode = Episode(CORNER)
    controller = episode.pilot.controller
    pose = np.array(episode.settings.start)
    reference = np.tile(pose, (controller.settings.horizon + 1, 1))
    loop = controller.loop
    now = loop.now(pose, controller.given(pose, reference, NOBODY))
    solution = loop.warm.solve(loop.guess_of(*controller.leaving(now), now), data=loop.data(now))
    ended: Any = Ended(solution, share * controller.settings.feasible)
    choice = controller.judge(ended, ended[loop.x], ended[loop.u], now, loop.kept)
    assert (choice.source == "solved") == driven
    np.testing.assert_allclose(choice.controls[0], 0.2 + solution[loop.u][0] if driven else 0.0)


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
def test_a_drive_has_nothing_to_warn_of(coupling: str, caplog: pytest.LogCaptureFixture) -> None:
    Episode(replace(CORNER, coupling=coupling)).run(stop_after(5))
    assert [record.message for record in caplog.records if "unifg compiles" not in record.message] == []


def test_failure_on_the_first_tick_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = Episode(CORRIDOR)
    replace_solver(monkeypatch, episode, Failing(episode.pilot.controller.loop.warm, 0))
    log = episode.run(stop_after(5))
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
        ({"solver": "newton"}, "unknown backend"),
        ({"coupling": "telepathic"}, "sequential"),
    ],
)
def test_impossible_episodes_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises((ScenarioError, BackendError), match=message):
        run_navigation(replace(CORRIDOR, **change))


def test_a_map_of_ones_own_needs_start_and_goal(tmp_path: Path) -> None:
    occupied = np.zeros((44, 240), dtype=bool)
    save_map(tmp_path / "hall.yaml", OccupancyMap(occupied, ~occupied, 0.05, (0.0, -0.1, 0.0), "hall"))
    own = NavigationSettings(map=tmp_path / "hall.yaml")
    with pytest.raises(ScenarioError, match="--start"):
        run_navigation(own)
    with pytest.raises(ScenarioError, match="--goal"):
        run_navigation(replace(own, start=(1.0, 1.0, 0.0)))


# ----------------------------------------------------------------- localiser


SIGMA = np.array([0.1, 0.1, 0.05])


@pytest.mark.parametrize("place", [(3.0, 25.2, 0.0), (21.0, 9.6, -2.0), (10.8, 17.0, 1.0), (36.0, 18.0, 3.0)], ids=str)
@pytest.mark.parametrize("off", [(0.1, 0.0, 0.05), (-0.07, 0.07, -0.05), (0.0, -0.1, 0.05)], ids=str)
def test_localiser_converges(place: tuple[float, float, float], off: tuple[float, float, float]) -> None:
    occupancy, distances = building()
    world = World(occupancy, place, rng=np.random.default_rng(1))
    localiser = Localiser(distances, world.pose + np.array(off), SIGMA, world.lidar.beams)
    for _ in range(3):
        localiser.correct(world.scan())
    position, heading = pose_errors(localiser.pose[None], world.pose[None])
    assert position[0] < 0.03
    assert heading[0] < 0.01
    assert localiser.iterations > 0
    # It knows better than before, in every direction.
    assert np.linalg.eigvalsh(localiser.covariance).max() < SIGMA.min() ** 2


def test_a_disc_beside_a_wall_does_not_pull_the_estimate_along_a_corridor() -> None:
    """Little says how far along a corridor the robot is: beams that end on a disc, near a wall, must not decide it."""
    occupancy, distances = building()
    place = np.array([15.0, 14.2, -0.3])
    shelf = [Obstacle(np.array([15.0 + x, 13.45]), 0.2) for x in (0.6, 1.1, 1.6)]
    world = World(occupancy, place, shelf, np.random.default_rng(1))
    localiser = Localiser(distances, place.copy(), SIGMA, world.lidar.beams)
    iterations = []
    for _ in range(10):
        localiser.correct(world.scan())
        iterations.append(localiser.iterations)
    assert pose_errors(localiser.pose[None], world.pose[None])[0][0] < 0.02
    assert max(iterations) < 12  # it converges


def test_localiser_keeps_the_prediction_without_a_scan() -> None:
    _, distances = building()
    localiser = Localiser(distances, np.array([3.0, 25.2, 0.0]), SIGMA, 360)
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
    distances = field(occupancy)
    start, goal = np.array([2.3, 30.0, -1.57]), np.array([10.0, 1.7, 0.0])
    route = Route(occupancy, distances, start, goal, RADIUS)
    assert distances.distance(route.path[:, :2]).min() > RADIUS
    assert 30.0 < path_length(route.path) < 45.0


def test_a_drive_plans_with_the_backend_that_the_page_names() -> None:
    page = (Path(__file__).parents[1] / "docs" / "results" / "navigation.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith("| `--solver"))
    assert f"`{NavigationSettings().solver}`" in row.split("|")[2]
    assert NavigationSettings().solver == SOLVERS[0]


# -------------------------------------------------------- what the robot knows


class Doubting:
    """An estimator that is less sure than it was."""

    def __init__(self, inner: Any, covariance: Array) -> None:
        self.inner, self.covariance = inner, covariance

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


@pytest.mark.parametrize(
    ("sigma", "arrives"),
    [((0.01, 0.01, 0.01), True), ((0.07, 0.01, 0.01), False), ((0.01, 0.07, 0.01), False), ((0.01, 0.01, 0.07), False)],
)
def test_who_does_not_know_where_he_is_has_not_arrived(sigma: tuple[float, float, float], arrives: bool) -> None:
    """Believed to be at the goal, by an estimate whose three standard deviations leave what the truth must confirm."""
    episode = Episode(replace(CORRIDOR, seed=1))
    episode.pilot.pose = episode.goals[0].copy()
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])  # the worst direction is no axis
    episode.pilot.estimator = Doubting(episode.pilot.estimator, turn @ np.diag(np.square(sigma)) @ turn.T)
    assert episode._arrived(0) == arrives
    episode.pilot.pose = episode.goals[0] + np.array([0.11, 0.0, 0.0])
    assert not episode._arrived(0)
    episode.pilot.pose = episode.goals[0] + np.array([0.06, 0.0, 0.0])
    assert episode._arrived(0) == arrives
    episode.pilot.estimator.covariance = 0.05**2 * np.eye(3)  # three of them and 0.06 m are more than 0.2 m
    assert not episode._arrived(0)


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
def test_the_first_leg_begins_where_the_robot_believes_to_be(coupling: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody tells it the true start: it looks around first, and plans from what that says; no scan counts twice."""
    episode = Episode(replace(CORRIDOR, seed=4, coupling=coupling))
    believed = episode.pilot.pose
    assert np.hypot(*(believed - episode.start)[:2]) > 0.03
    updates = calls_of(monkeypatch, episode.pilot.estimator, "update")
    log = episode.run(stop_after(2))
    assert [odometry is None for _, odometry, _ in updates] == [True, False]
    first = log.route[0][0, :2]
    assert not np.array_equal(first, episode.start[:2])
    assert np.hypot(*(first - log.estimate[0, :2])) < 0.02
    assert np.hypot(*(first - episode.start[:2])) < 0.03


def test_a_leg_can_begin_beside_a_wall_where_the_estimate_touches_it() -> None:
    episode = Episode(CORRIDOR)
    wall = np.array([6.5, 14.0, 0.0])
    while episode.distance_map.distance(wall[:2]) > RADIUS - 0.03:
        wall[1] -= 0.01
    with pytest.raises(ScenarioError, match="start"):
        episode._route(wall, episode.goals[0])
    episode.pilot.pose = wall
    episode._begin_leg(0)
    assert episode.legs[0].blocked is None
    path = episode.legs[0].path
    assert np.hypot(*(path[0] - wall)[:2]) < 0.06
    assert np.array_equal(wall, episode.pilot.pose)
