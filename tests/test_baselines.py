"""Baseline planners keep the robot's limits, get past what stands, stop where there is no way."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.baselines.dynamic_window import DynamicWindow, WindowSettings
from benchmarks.baselines.elastic_band import BandSettings, ElasticBand
from benchmarks.baselines.path_integral import PathIntegral, PathIntegralSettings
from benchmarks.baselines.pure_pursuit import PurePursuit
from benchmarks.baselines.shared import rollouts, to_reference
from episodes import room
from maps import field, walled
from unifg.files.ros_map import save_map
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.local_planner import PlannerAdapter, PlannerContext, Situation
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.monte_carlo import MonteCarlo
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.simulation.drivetrain import Drivetrain
from unifg.typing import Array

SLOW = (1.0, 2.1)  # [m/s^2, rad/s^2]
SETTINGS = ControllerSettings(accelerations=SLOW)
OTHERS = ("teb", "mppi", "dwa", "pursuit")
PURSUIT = "benchmarks.baselines.pure_pursuit:PurePursuit"
START = np.array([2.0, 2.0, 0.0])


@functools.cache
def hall() -> DistanceMap:
    """An empty hall of 8 m by 4 m."""
    return field(walled(8.2, 4.2, 2, (-0.1, -0.1, 0.0)))


def context(accelerations: tuple[float, float] = SLOW, seed: int = 0) -> PlannerContext:
    """The hall, and a base of such accelerations."""
    settings = replace(SETTINGS, accelerations=accelerations)
    return PlannerContext(hall(), settings, np.random.default_rng(seed))


@functools.cache
def band(accelerations: tuple[float, float]) -> ElasticBand:
    """As many graphs as these short ways need."""
    return ElasticBand(context(accelerations), BandSettings(poses=(3, 16)))


def planner(name: str, accelerations: tuple[float, float] = SLOW, seed: int = 0) -> PlannerAdapter:
    """One of the baselines as the pilot drives it, at rest."""
    given = context(accelerations, seed)
    if name == "teb":
        band(accelerations).forget()
        return PlannerAdapter(band(accelerations), given)
    if name == "mppi":
        return PlannerAdapter(PathIntegral(given, PathIntegralSettings(drives=400)), given)
    return PlannerAdapter({"dwa": DynamicWindow, "pursuit": PurePursuit}[name](given), given)


def straight(pose: Array, end: float = math.inf) -> Array:
    """A reference along x at y = 2 m from beside the robot; it ends, or goes on through walls."""
    way = pose[0] + SETTINGS.speed * SETTINGS.dt * np.arange(SETTINGS.horizon + 1.0)
    return np.column_stack([np.minimum(way, end), np.full(len(way), 2.0), np.zeros(len(way))])


def discs(*rows: tuple[float, float, float], velocity: tuple[float, float] = (0.0, 0.0)) -> Tracks:
    """Discs (x, y, radius)."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return Tracks.of_movers(table[:, :2], np.tile(np.array(velocity), (len(table), 1)), table[:, 2])


def drives(
    own: PlannerAdapter, ticks: int, others: Tracks | None = None, end: float = math.inf, start: Array = START
) -> tuple[Array, Array]:
    """Poses and controls of a drive in a perfect world."""
    poses, controls, seen = [start], [], discs() if others is None else others
    for k in range(ticks):
        now = replace(seen, centre=seen.centre + k * SETTINGS.dt * seen.velocity)
        plan = own.plan(poses[-1], straight(poses[-1], end), now)
        assert plan.controls.shape == (SETTINGS.horizon, 2) and plan.states.shape == (SETTINGS.horizon + 1, 3)
        assert np.array_equal(own.estimate, poses[-1])
        controls.append(plan.control)
        poses.append(unicycle.step(poses[-1][None], plan.control[None], SETTINGS.dt)[0])
    return np.array(poses), np.array(controls)


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.product(2)
def test_limits_of_speed_and_acceleration_are_kept(name: str) -> None:
    poses, controls = drives(planner(name), 25, start=np.array([2.0, 2.2, 0.2]))
    assert (np.abs(controls) <= np.array(SETTINGS.limits) + 1e-12).all()
    changes = np.abs(np.diff(np.concatenate([np.zeros((1, 2)), controls]), axis=0)) / SETTINGS.dt
    assert (changes <= np.array(SLOW) + 1e-9).all()
    assert controls[:, 0].max() > 0.6, "it speeds up where nothing is in the way"
    assert abs(poses[-1, 1] - 2.0) < 0.12, "it comes back to its path"


@pytest.mark.parametrize("name", OTHERS)
def test_a_base_without_limits_of_acceleration_is_driven_too(name: str) -> None:
    _, controls = drives(planner(name, (math.inf, math.inf)), 8)
    assert np.isfinite(controls).all() and controls[-1, 0] > 0.4


@pytest.mark.product(1)
@pytest.mark.parametrize("name", OTHERS)
def test_the_robot_stops_before_a_wall(name: str) -> None:
    start = np.array([6.0, 2.0, 0.0])
    poses, _ = drives(planner(name), 40, start=start)
    room = hall().distance(poses[:, :2]) - SETTINGS.robot_radius
    assert room.min() > SETTINGS.wall_clearance - 0.01
    assert poses[:, 0].max() > 6.3, "it drives as far as it may"
    assert np.ptp(poses[-8:, 0]) < (0.3 if name == "mppi" else 0.1)  # noise never rests


@pytest.mark.product(1)
@pytest.mark.parametrize(("name", "aside"), [("teb", 0.25), ("mppi", 0.25), ("dwa", 0.48), ("pursuit", 0.48)])
def test_a_disc_beside_the_path_is_passed(name: str, aside: float) -> None:
    """Nearer than the clearance allows, where the planner can leave its path; the others need a route that is free."""
    seen = discs((4.0, 2.0 - aside, 0.2))
    poses, _ = drives(planner(name), 50, seen)
    room = np.hypot(*(poses[:, :2] - seen.centre[0]).T) - 0.2 - SETTINGS.robot_radius
    assert room.min() > SETTINGS.disc_clearance - 0.01
    assert poses[-1, 0] > 4.5


def test_pure_pursuit_waits_before_a_disc_on_its_arc() -> None:
    seen = discs((4.0, 1.75, 0.2))
    own = planner("pursuit")
    poses, controls = drives(own, 40, seen)
    room = np.hypot(*(poses[:, :2] - seen.centre[0]).T) - 0.2 - SETTINGS.robot_radius
    assert room.min() > SETTINGS.disc_clearance - 0.01
    assert poses[-1, 0] < 4.0
    plan = own.plan(poses[-1], straight(poses[-1]), seen)
    assert controls[-5:, 0].min() == 0.0 or plan.emergency


@pytest.mark.parametrize("name", OTHERS)
def test_a_mover_that_will_have_gone_is_no_hindrance_and_one_that_comes_is(name: str) -> None:
    """Clearance from crossing movers is that from their future positions, not from their present ones."""
    now = Situation(START, np.zeros(2), straight(START), discs((3.0, 2.0, 0.2), velocity=(0.0, 1.0)), hall(), SETTINGS)
    ahead = np.array([[3.0, 2.0]])
    assert now.clearance(ahead, 0.0)[0] < 0.0 < now.clearance(ahead, 1.0)[0]
    assert planner(name).plan(START, now.reference, now.tracks).source == "solved"


def test_a_robot_too_near_may_leave_but_not_come_nearer() -> None:
    pose = np.array([0.2, 2.0, 0.0])  # the wall is 0.03 m from the hull, less what is to be kept
    now = Situation(pose, np.zeros(2), straight(pose), discs(), hall(), SETTINGS)
    places = np.array([[[0.19, 2.0], [0.2, 2.0], [0.25, 2.0]]])
    times = np.array([0.1, 0.2, 0.3])
    assert now.hits(now.clearance(places, times), times).tolist() == [[True, False, False]]


def test_an_uncertain_robot_keeps_farther_off() -> None:
    """Margin of as many standard deviations as the controller's, of the axis that is known least."""
    heard: list[float] = []

    class Noting(PurePursuit):
        def control(self, now: Situation) -> Array | None:
            heard.append(float(now.clearance(START[None, :2], 0.0)[0]))
            return super().control(now)

    given = PlannerContext(hall(), SETTINGS, np.random.default_rng(0))
    own = PlannerAdapter(Noting(given), given)
    for covariance in (None, np.diag([0.1**2, 1e-6, 1e-6])):
        own.plan(START, straight(START), discs(), covariance)
    assert heard[0] - heard[1] == pytest.approx(SETTINGS.sigmas * 0.1)


def test_a_planner_may_write_into_what_it_is_given() -> None:
    """One that laid the reference on the robot, in place, moved the estimate of the localiser."""

    class Local(PurePursuit):
        def control(self, now: Situation) -> Array | None:
            for part in (now.pose, now.applied, now.reference):
                part -= 1e3
            return np.array([0.1, 0.0])

    given = PlannerContext(hall(), SETTINGS, np.random.default_rng(0))
    own, pose, reference = PlannerAdapter(Local(given), given), START.copy(), straight(START)
    plan = own.plan(pose, reference, discs())
    np.testing.assert_array_equal(pose, START)
    np.testing.assert_array_equal(reference, straight(START))
    np.testing.assert_allclose(plan.states[0], START)


@pytest.mark.product(1)
@pytest.mark.parametrize("name", OTHERS)
def test_a_goal_is_reached_with_its_heading(name: str) -> None:
    goal = np.array([3.2, 2.0, 0.5])
    own, pose = planner(name), START
    for _ in range(70):
        way = np.minimum(pose[0] + SETTINGS.speed * SETTINGS.dt * np.arange(SETTINGS.horizon + 1.0), goal[0])
        reference = np.column_stack([way, np.full(len(way), 2.0), np.where(way >= goal[0], goal[2], 0.0)])
        pose = unicycle.step(pose[None], own.plan(pose, reference, discs()).control[None], SETTINGS.dt)[0]
        if np.hypot(*(pose - goal)[:2]) < 0.1 and abs(pose[2] - goal[2]) < 0.1:
            return
    pytest.fail(f"ended at {pose}")


def test_path_integral_is_decided_by_its_seed() -> None:
    first, again, other = (drives(planner("mppi", seed=seed), 4)[1] for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_path_integral_forgets_its_plan() -> None:
    own = planner("mppi")
    assert isinstance(own.planner, PathIntegral)
    drives(own, 3)
    assert own.planner.mean[:, 0].max() > 0.0
    own.forget()
    assert not own.planner.mean.any()


def test_the_window_is_what_a_tick_can_reach_and_always_holds_straight_on() -> None:
    own = DynamicWindow(context(), WindowSettings(samples=(3, 4)))
    now = Situation(START, np.array([0.5, 0.1]), straight(START), discs(), hall(), SETTINGS)
    tried = own.window(now)
    assert np.isclose(tried[:, 0].min(), 0.4) and np.isclose(tried[:, 0].max(), 0.6)
    assert np.isclose(tried[:, 1].min(), -0.11) and np.isclose(tried[:, 1].max(), 0.31)
    assert (tried[:, 1] == 0.0).any()
    fast = replace(now, applied=np.array([-0.3, 0.0]))  # backwards, which it does not choose: as far forward as it can
    assert np.isclose(own.window(fast)[:, 0].max(), -0.2)


def test_velocities_from_which_the_robot_cannot_stop_are_not_admissible() -> None:
    own = DynamicWindow(context())
    steps = round(own.numbers.horizon / own.numbers.step)
    hit = np.zeros((3, steps), dtype=bool)
    hit[1:, 8:] = True  # after 0.4 s
    tried = np.array([[1.0, 0.0], [1.0, 0.0], [0.3, 0.0]])  # braking takes 1 s and 0.5 m; 0.3 s and 0.045 m
    assert own.admissible(tried, hit).tolist() == [True, False, True]


def test_pursuit_is_slow_in_bends_near_things_and_before_the_goal() -> None:
    own = PurePursuit(context())
    now = Situation(START, np.array([1.0, 0.0]), straight(START), discs(), hall(), SETTINGS)
    assert own.speed(now, 0.0) == SETTINGS.speed
    assert own.speed(now, 2.0) == pytest.approx(1.0 / (0.9 * 2.0))
    assert own.speed(replace(now, tracks=discs((START[0], START[1] + 0.8, 0.3))), 0.0) == pytest.approx(0.44 / 0.6)
    assert own.speed(replace(now, reference=straight(START, 2.3)), 0.0) == pytest.approx(0.5)
    assert np.allclose(own.carrot(now)[:2], [2.9, 2.0])
    assert np.allclose(own.carrot(replace(now, applied=np.zeros(2)))[:2], [2.3, 2.0])


def test_a_band_is_resized_to_even_intervals_and_keeps_its_ends() -> None:
    own = ElasticBand(context(), BandSettings(poses=(3, 8)))
    poses = np.column_stack([[0.0, 2.0, 2.1, 2.2, 3.0], np.full(5, 2.0), np.zeros(5)])
    times = np.array([1.6, 0.1, 0.1, 0.5])
    found, lengths = own.resized(poses, times)
    assert len(found) == len(lengths) + 1 <= 8
    assert np.isclose(lengths.sum(), times.sum())
    assert np.array_equal(found[[0, -1]], poses[[0, -1]])
    assert (np.diff(found[:, 0]) > 0.0).all()


def test_drives_are_those_of_the_robots_model() -> None:
    controls = np.random.default_rng(3).uniform(-1.0, 1.0, (2, 7, 2))
    states = rollouts(START, controls, 0.1)
    for row, used in zip(states, controls, strict=True):
        assert np.allclose(row, unicycle.rollout(START, used, 0.1))


def test_places_are_held_against_the_path() -> None:
    now = Situation(START, np.zeros(2), straight(START, 4.0), discs(), hall(), SETTINGS)
    away, left = to_reference(now, np.array([[2.55, 2.3], [5.0, 2.0], [1.0, 2.0]]))
    assert np.allclose(away, [0.3, 1.0, 1.0]) and np.allclose(left, [1.45, 0.0, 2.0])


@pytest.mark.parametrize("name", OTHERS)
def test_forgotten_plans_do_not_change_the_next_one(name: str) -> None:
    """A band, a mean of drives and a turn at a goal are dropped."""
    own = planner(name)
    first = own.plan(START, straight(START), discs()).controls
    drives(own, 3, end=2.2)
    own.forget()
    own.driven(np.zeros(2))
    again = own.plan(START, straight(START), discs()).controls
    assert np.allclose(first, again) or name == "mppi"  # its noise goes on


def test_a_baseline_drives_an_episode_beside_the_monte_carlo_localiser(tmp_path: Path) -> None:
    save_map(tmp_path / "room.yaml", room())
    settings = NavigationSettings(
        tmp_path / "room.yaml", (0.0, 0.0, 0.0), ((0.8, 0.0, 0.0),), planner=PURSUIT, localiser="amcl"
    )
    episode = Episode(replace(settings, drivetrain=Drivetrain(*SLOW)), rehearsal=True)
    adapter = episode.pilot.controller
    assert isinstance(adapter, PlannerAdapter) and isinstance(adapter.planner, PurePursuit)
    assert np.array_equal(adapter.settings.accelerations, SLOW)
    log = episode.run(lambda done, text: None)
    assert log.solver == PURSUIT and log.succeeded
    assert isinstance(episode.pilot.estimator, MonteCarlo)
    assert log.localisation_iterations[0] >= 500  # particles
