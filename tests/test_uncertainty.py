"""Covariance as a variable of a plan: the recursion is that of a filter, and plans keep what they promise."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from problems import belief_plans
from problems.belief_plans import DENSITY, GAIN, SENSOR, START, Layout, Planner
from unifg.lie import SE2
from unifg.models import uncertainty
from unifg.models.uncertainty import BeaconSensor, Forecast
from unifg.solvers import GaussNewton
from unifg.typing import Array

CERTAIN = BeaconSensor(reach=1e3, softness=0.1)
BEACONS = np.array([[2.0, 1.5], [4.0, -1.0]])


def covariances(rng: np.random.Generator, count: int, size: int) -> Array:
    """Random ones, positive definite."""
    half = rng.normal(size=(count, size, size))
    return half @ np.swapaxes(half, 1, 2)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_packing_keeps_every_entry_once(rng: np.random.Generator, size: int) -> None:
    P = covariances(rng, 4, size)
    triangles = uncertainty.packed(P)
    assert triangles.shape == (4, size * (size + 1) // 2)
    np.testing.assert_array_equal(uncertainty.unpacked(triangles), P)
    np.testing.assert_array_equal(triangles[:, 0], P[:, 0, 0])
    np.testing.assert_array_equal(triangles[:, -1], P[:, -1, -1])


def test_an_update_adds_information(rng: np.random.Generator) -> None:
    P, L = covariances(rng, 5, 3), covariances(rng, 5, 3)
    np.testing.assert_allclose(uncertainty.updated(P, L), np.linalg.inv(np.linalg.inv(P) + L), rtol=1e-9)
    np.testing.assert_allclose(uncertainty.updated(P, 0.0 * L), P, rtol=1e-12)
    np.testing.assert_array_equal(uncertainty.updated(0.0 * P, L), 0.0 * P)  # what is known stays known


def differences(f: object, size: int, step: float = 1e-6) -> Array:
    """(n, m, size) central differences of a function of a tangent step."""
    columns = [(f(step * e) - f(-step * e)) / (2.0 * step) for e in np.eye(size)]  # type: ignore[operator]
    return np.stack(columns, axis=-1)


def test_errors_of_a_pose_arrive_at_the_next(rng: np.random.Generator) -> None:
    x, after = SE2.random(rng, (6,)), SE2.random(rng, (6,))
    moved = SE2.compose(SE2.inverse(x), after)
    expected = differences(lambda e: SE2.local(after, SE2.compose(SE2.retract(x, np.tile(e, (6, 1))), moved)), 3)
    np.testing.assert_allclose(uncertainty.pose_transition(x, after), expected, atol=1e-8)


def test_rows_of_a_sighting_are_derivatives(rng: np.random.Generator) -> None:
    x, beacon = SE2.random(rng, (6,)), np.array([3.0, -2.0])

    def seen(e: Array) -> Array:
        pose = SE2.retract(x, np.tile(e, (6, 1)))
        distance, ahead, aside = uncertainty.to_beacon(pose, beacon)
        return np.stack([distance / SENSOR.sigma_range, np.arctan2(aside, ahead) / SENSOR.sigma_bearing], axis=1)

    rows = np.stack(uncertainty.sighting_rows(x, beacon, SENSOR), axis=1)
    np.testing.assert_allclose(rows, differences(seen, 3), rtol=1e-4, atol=1e-4)


def test_controls_steer_to_second_order(rng: np.random.Generator) -> None:
    x, u = SE2.random(rng, (4,)), rng.normal(size=(4, 2))
    off = []
    for h in (0.2, 0.1):

        def reached(du: Array, h: float = h) -> Array:
            v, turn = (u + du).T
            return SE2.retract(x, h * np.stack([v, 0.0 * v, turn], axis=1))

        expected = differences(lambda du, h=h, reached=reached: SE2.local(reached(np.zeros(2), h), reached(du, h)), 2)
        off.append(np.abs(uncertainty.pose_steering(u, np.full((4, 1), h)) - expected).max())
    assert off[0] < 0.02 and 0.1 < off[1] / off[0] < 0.15  # an eighth


def test_a_chance_falls_with_the_distance() -> None:
    chance = BeaconSensor(reach=2.0, softness=0.1).chance(np.array([0.0, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(chance, [1.0, 1.0, 0.5, 0.0], atol=1e-4)


def bearing_and_range(x: Array, beacon: Array, z: Array) -> Array:
    distance, ahead, aside = uncertainty.to_beacon(x, beacon[0])
    return np.stack([distance - z[:, 0], np.arctan2(aside, ahead) - z[:, 1]], axis=1)


def test_the_recursion_is_the_marginal_of_the_graph(rng: np.random.Generator) -> None:
    """Prior, stochastic motion and expected sightings as factors: the last pose has the covariance of the recursion."""
    x = SE2.exp(np.cumsum(rng.normal([0.4, 0.0, 0.1], 0.05, (6, 3)), axis=0))
    h, graph = 0.3, fg.Graph()
    poses = graph.variables("x", SE2, 6)
    graph.minimize(fg.prior, poses[0], x[0], information=np.linalg.inv(START))
    moved = SE2.compose(SE2.inverse(x[:-1]), x[1:])
    graph.minimize(fg.between, poses[:-1], poses[1:], moved, information=np.linalg.inv(h * DENSITY))
    for beacon in BEACONS:
        distance, ahead, aside = uncertainty.to_beacon(x[1:], beacon)
        z = np.stack([distance, np.arctan2(aside, ahead)], axis=1)
        sigma = [CERTAIN.sigma_range, CERTAIN.sigma_bearing]
        graph.minimize(bearing_and_range, poses[1:], beacon[None], z, sigma=sigma)
    solution = GaussNewton().solve(graph, {poses: x}, check=True)
    P, u = Forecast(START[None], 0.0 * START[None]), np.zeros((1, 2))
    for here, there in zip(x[:-1, None], x[1:, None], strict=True):
        P = uncertainty.pose_forecast(CERTAIN)(P, here, u, there, np.array([[h]]), DENSITY, GAIN, BEACONS)
    np.testing.assert_allclose(P.covariance[0], solution.covariance(poses[-1]), rtol=1e-5, atol=1e-9)


def test_deviations_are_those_of_the_direction_in_the_world(rng: np.random.Generator) -> None:
    """The covariance is that of a tangent step of the pose: its axes turn with the heading."""
    poses, roots = SE2.random(rng, (5,)), rng.normal(size=(5, 3, 3))
    covariance = roots @ np.swapaxes(roots, 1, 2)
    centre = rng.normal(size=(4, 2)) * 5.0
    found = uncertainty.deviations(uncertainty.packed(covariance), poses, centre)
    for k, pose in enumerate(poses):
        turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
        world = turn @ covariance[k, :2, :2] @ turn.T
        for m, point in enumerate(centre):
            to = (pose[:2] - point) / np.linalg.norm(pose[:2] - point)
            assert found[k, m] == pytest.approx(np.sqrt(to @ world @ to), rel=1e-5)


def test_clearance_counts_deviations_towards_the_disc() -> None:
    """A robot that looks along y is unsure along its own axis only: a disc ahead is nearer, one aside is not."""
    P = uncertainty.packed(np.diag([0.09, 0.0, 0.01])[None])
    x, centres = np.array([[1.0, 2.0, np.pi / 2]]), np.array([[1.0, 5.0], [4.0, 2.0]])
    np.testing.assert_allclose(uncertainty.deviations(P, x, centres), [[0.3, 0.0]], atol=2e-3)
    kept = uncertainty.confident_clearance(x, P, centres, np.array([0.5, 0.5]), np.array(2.0))
    np.testing.assert_allclose(kept, [[1.9, 2.5]], atol=4e-3)


WORLD = Layout(
    np.array([[4.0, 0.4], [6.0, -0.9]]),
    np.array([0.5, 0.6]),
    np.array([[1.5, 1.5], [4.0, 2.5], [6.5, 1.5], [9.0, 1.0]]),
)


@pytest.fixture(scope="module")
def plans() -> dict[float, belief_plans.Plan]:
    """Of a small world, by k."""
    planner = Planner(WORLD)
    routes = planner.graph.check(planner.guess(1.5)).routes
    assert {routes[name] for name in ("filter", "clearance", "arrival")} == {"traced, its derivatives exact"}
    found = dict[float, belief_plans.Plan]()
    for k in (0.0, 2.0):
        _, plan = planner.solve(planner.guess(1.5), 0.05, k=k)
        assert plan is not None
        found[k] = plan
    return found


def test_a_plan_keeps_its_deviations(plans: dict[float, belief_plans.Plan]) -> None:
    for k, plan in plans.items():
        foreseen = belief_plans.foreseen(WORLD, plan.poses, plan.controls, plan.step)
        kept = belief_plans.confident(
            plan.poses[1:], foreseen[1:], WORLD.discs, WORLD.radii + belief_plans.ROBOT, np.array(k), np.array(0.05)
        )
        assert abs(kept.min()) < 2e-3
    assert plans[2.0].duration > plans[0.0].duration + 0.01


def test_drives_deviate_as_foreseen(plans: dict[float, belief_plans.Plan]) -> None:
    """Filter and feedback, driven a thousand times: error of the estimate, deviation of the truth from the plan."""
    plan = plans[2.0]
    drives = belief_plans.drive(plan, WORLD, 1000, 3)
    off = drives.paths[:, :, :2] - plan.poses[:, None, :2]
    seen = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))
    foreseen = np.sqrt(plan.beliefs[:, [0, 2, 6, 8]].sum(axis=1))
    np.testing.assert_allclose(seen, foreseen, rtol=0.25)
    assert abs(np.mean(seen / foreseen) - 1.0) < 0.1
    assert np.sqrt(np.mean(drives.arrival**2)) == pytest.approx(plan.deviation[-1], rel=0.25)
    assert drives.collisions < belief_plans.drive(plans[0.0], WORLD, 1000, 3).collisions / 3


def test_lagging_plans_keep_their_own_deviations() -> None:
    planner = Planner(WORLD, foresees=False)
    _, plan = belief_plans.lagging(planner, planner.guess(1.5), 2.0, 0.05)
    assert plan is not None
    radii = WORLD.radii + belief_plans.ROBOT
    kept = belief_plans.confident(plan.poses[1:], plan.beliefs[1:], WORLD.discs, radii, 2.0, 0.05)
    assert -0.01 < kept.min() < 0.05
