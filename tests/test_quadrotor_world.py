"""The quadrotor's world: things hold, hidden landmarks stay hidden, noise is as promised, seeds repeat."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test_quadrotor_scene import flight
from unifg.errors import FileFormatError, ScenarioError
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.perception.readings import NOTHING
from unifg.scenarios.simulation.air import VEHICLE_RADIUS, QuadrotorWorld
from unifg.scenarios.simulation.bearing_range import SensorModel
from unifg.scenarios.simulation.disturbance import DisturbanceModel, Disturbances
from unifg.scenarios.simulation.layouts import Layout, corridor
from unifg.scenarios.simulation.space import Obstacle

CALM = DisturbanceModel.calm()
PARAMETERS = quadrotor.Parameters(mass=1.2, drag=(0.2, 0.3, 0.4), wind=(0.3, -0.2), updraft=0.1)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def field(
    cylinders: list[tuple[float, float, float]] | None = None,
    walls: list[tuple[tuple[float, float], tuple[float, float]]] | None = None,
) -> Layout:
    """An open field with the start at the origin, 2 m up."""
    return Layout(
        start=np.array([0.0, 0.0, 2.0]),
        target=np.array([20.0, 0.0, 2.0]),
        cylinders=np.array(cylinders or []),
        walls=np.array(walls or []),
        size=np.array([[-20.0, -20.0], [20.0, 20.0]]),
        name="field",
    )


def gliding(layout: Layout, vx: float, vy: float, *movers: Obstacle) -> QuadrotorWorld:
    """A quiet world whose vehicle moves level at a constant velocity under the hover thrust."""
    start = np.array([*layout.start, *LEVEL, vx, vy, 0.0])
    return QuadrotorWorld(layout, 0, None, movers, start=start, disturbance=CALM, sensor=SensorModel.exact())


HOVER = quadrotor.hover(quadrotor.Parameters())


# ----------------------------------------------------------------------- motion


def test_free_flight_is_the_reference_integrator() -> None:
    world = QuadrotorWorld(field([(0.0, 8.0, 0.5)]), 0, PARAMETERS, disturbance=CALM)
    state, rng = world.state, np.random.default_rng(2)
    for _ in range(40):
        u = np.append(rng.uniform(-1.0, 1.0, 3), rng.uniform(10.0, 14.0))
        world.step(u, 0.05)
        state = quadrotor.fly(state, u, 0.05, PARAMETERS, substeps=10)
        np.testing.assert_allclose(world.state, state, rtol=0.0, atol=1e-9)
    assert world.collisions == 0
    assert world.time == pytest.approx(2.0)
    assert np.linalg.norm(state[:2]) > 0.1  # it went somewhere


@pytest.mark.parametrize("vy", [0.0, 1.0])
def test_a_wall_stops_the_vehicle_once(vy: float) -> None:
    world = gliding(field(walls=[((3.0, -9.0), (3.0, 9.0))]), 2.0, vy)
    closest = math.inf
    for _ in range(60):
        world.step(HOVER, 0.05)
        closest = min(closest, world.clearance())
    assert world.collisions == 1
    assert -0.011 < closest < 0.0  # one substep at 2 m/s
    assert world.clearance() == pytest.approx(0.0, abs=2e-3)
    assert world.state[0] == pytest.approx(3.0 - VEHICLE_RADIUS, abs=2e-3)
    np.testing.assert_allclose(world.state[7:9], [0.0, vy], atol=1e-6)
    assert world.state[1] == pytest.approx(3.0 * vy, abs=1e-3)  # the wall has no friction


def test_pushing_against_a_cylinder_is_one_event_and_a_return_another() -> None:
    world = gliding(replace(field([(3.0, 0.0, 0.5)]), start=np.array([0.0, 0.0, 20.0])), 2.0, 0.0)
    tilt = math.radians(10.0)
    lean = np.array([0.0, 0.0, 0.0, quadrotor.GRAVITY / math.cos(tilt)])
    world.step([0.0, tilt / 0.05, 0.0, quadrotor.GRAVITY], 0.05)
    for _ in range(40):
        world.step(lean, 0.05)
    assert world.collisions == 1
    world.step([0.0, -3.0 * tilt / 0.05, 0.0, quadrotor.GRAVITY], 0.05)
    for _ in range(25):
        world.step(lean, 0.05)
    assert world.clearance() > 0.5  # it left at once: nothing holds it
    world.step([0.0, 4.0 * tilt / 0.05, 0.0, quadrotor.GRAVITY], 0.05)
    for _ in range(80):
        world.step(lean, 0.05)
    assert world.collisions == 2


def test_the_floor_counts_unless_the_flight_starts_on_it() -> None:
    ground = replace(field(), start=np.zeros(3))
    world = QuadrotorWorld(ground, 0, disturbance=CALM)
    world.step([0.0, 0.0, 0.0, 0.5 * HOVER[3]], 0.5)
    assert world.collisions == 0 and world.state[2] == 0.0 and world.clearance() == 0.0
    world.step([0.0, 0.0, 0.0, 1.5 * HOVER[3]], 1.0)
    height = world.state[2]
    assert height == pytest.approx(0.25 * quadrotor.GRAVITY, rel=1e-9)
    assert world.collisions == 0
    for _ in range(60):
        world.step([0.0, 0.0, 0.0, 0.5 * HOVER[3]], 0.05)
    assert world.collisions == 1
    assert world.state[2] == 0.0 and world.state[9] == 0.0


def test_clearance_is_the_nearest_of_everything() -> None:
    mover = Obstacle(np.array([0.0, -1.5]), 0.3, np.array([0.0, -3.0]), 0.5)
    layout = field([(2.0, 0.0, 0.5)], [((-1.2, -5.0), (-1.2, 5.0))])
    high = QuadrotorWorld(layout, 0, disturbance=CALM)
    assert high.clearance() == pytest.approx(1.2 - VEHICLE_RADIUS)
    assert QuadrotorWorld(layout, 0, movers=[mover]).clearance() == pytest.approx(1.2 - VEHICLE_RADIUS)
    near = replace(mover, centre=np.array([0.0, -1.0]))
    assert QuadrotorWorld(layout, 0, movers=[near]).clearance() == pytest.approx(0.7 - VEHICLE_RADIUS)
    low = replace(layout, start=np.array([0.0, 0.0, 0.4]))
    assert QuadrotorWorld(low, 0).clearance() == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("start", "control", "dt", "words"),
    [
        (np.zeros(3), HOVER, 0.05, "start"),
        (np.full(10, np.nan), HOVER, 0.05, "start"),
        ([0, 0, 1, 2, 0, 0, 0, 0, 0, 0], HOVER, 0.05, "start"),
        ([0, 0, -0.1, *LEVEL, 0, 0, 0], HOVER, 0.05, "start"),
        ([4.5, 0, 1, *LEVEL, 0, 0, 0], HOVER, 0.05, "cannot start at"),
        (None, [0.0, 0.0, math.nan, 9.81], 0.05, "four finite"),
        (None, HOVER, 0.0, "duration"),
    ],
)
def test_bad_starts_and_steps_are_refused(start: Any, control: Any, dt: float, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        QuadrotorWorld(field([(5.0, 0.0, 0.3)]), 0, start=start).step(control, dt)


# ----------------------------------------------------------------------- movers


def test_movers_keep_to_their_segments_whatever_the_vehicle_does() -> None:
    layout = corridor(11)
    first, second = (QuadrotorWorld(layout, 5, movers=4, disturbance=CALM) for _ in range(2))
    assert first.discs()[:, :3].shape == (4, 3)
    travelled = np.zeros(4)
    for tick in range(200):
        before = first.discs()[:, :3]
        first.step(HOVER)
        second.step([0.0, 0.1, 0.0, 11.0] if tick < 5 else HOVER)
        np.testing.assert_allclose(first.discs()[:, :3], second.discs()[:, :3], atol=1e-9)
        travelled += np.linalg.norm((first.discs()[:, :3] - before)[:, :2], axis=1)
        assert (layout.distance(first.discs()[:, :2]) >= first.discs()[:, 2] + 0.1 - 1e-9).all()
    for mover, distance in zip(first.movers, travelled, strict=True):
        assert distance == pytest.approx(mover.speed * 10.0, rel=0.02)
    assert not np.array_equal(QuadrotorWorld(layout, 6, movers=4).discs()[:, :3], before)


def test_a_mover_hits_and_pushes_a_hovering_vehicle() -> None:
    mover = Obstacle(np.array([-3.0, 0.0]), 0.4, np.array([1.0, 0.0]), 1.0)
    world = gliding(field(), 0.0, 0.0, mover)
    for _ in range(64):
        world.step(HOVER, 0.05)
        assert world.clearance() > -0.02
    assert world.collisions == 1
    assert world.state[0] == pytest.approx(0.2 + 0.4 + VEHICLE_RADIUS, abs=0.02)
    np.testing.assert_allclose(world.state[7:9], [1.0, 0.0], atol=1e-6)


def test_too_many_movers_are_refused() -> None:
    narrow = replace(field(), size=np.array([[0.0, -0.25], [20.0, 0.25]]))
    with pytest.raises(ScenarioError, match="no room for mover 0"):
        QuadrotorWorld(narrow, 0, movers=1)


# ---------------------------------------------------------------------- sensors


def test_an_exact_sensor_reports_the_truth() -> None:
    layout = field([(3.0, 1.0, 0.5), (-2.0, 4.0, 0.3)], [((2.0, -2.0), (4.0, -3.0))])
    turned = SO3.exp(np.array([[0.2, -0.3, 2.5]]))[0]
    start = np.array([0.5, 0.2, 1.7, *turned, 0.0, 0.0, 0.0])
    world = QuadrotorWorld(layout, 0, start=start, sensor=SensorModel.exact(), disturbance=CALM)
    reading, matrix = world.sense(), SO3.matrix(turned[None])[0]
    np.testing.assert_array_equal(reading.ids, [0, 1, 2, 3])
    np.testing.assert_array_equal(reading.kinds, [Landmarks.CYLINDER] * 2 + [Landmarks.CORNER] * 2)
    np.testing.assert_array_equal(reading.radii, [0.5, 0.3, 0.0, 0.0])
    assert not reading.moving.any()
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    there = start[:2] + reading.ranges[:, None] * np.stack(
        [np.cos(heading + reading.bearings), np.sin(heading + reading.bearings)], axis=1
    )
    np.testing.assert_allclose(there, world.things()[:, :2], atol=1e-12)
    assert (np.abs(reading.bearings) <= np.pi).all()
    assert reading.height == 1.7
    np.testing.assert_allclose(reading.tilt, matrix.T @ [0.0, 0.0, 1.0], atol=1e-15)
    np.testing.assert_array_equal(reading.rates, np.zeros(3))
    np.testing.assert_allclose(reading.force, matrix.T @ [0.0, 0.0, 9.81], atol=1e-14)
    world.step([0.3, -0.2, 0.5, 9.0])
    np.testing.assert_allclose(world.sense().rates, [0.3, -0.2, 0.5], atol=1e-15)
    np.testing.assert_allclose(world.sense().force, [0.0, 0.0, 9.0], atol=1e-5)  # thrust by mass, whatever the way


def test_what_is_felt_is_the_acceleration_without_gravity() -> None:
    """Drag and wind are felt, and the floor that carries a vehicle."""
    turned = SO3.exp(np.array([0.2, -0.3, 2.5]))
    start = np.array([0.0, 0.0, 1.7, *turned, 1.5, -0.5, 0.2])
    drag, wind, u = np.array([0.3, 0.2, 0.1]), np.array([0.4, -0.2, 0.0]), np.array([0.0, 0.0, 0.0, 11.0])
    parameters = quadrotor.Parameters(1.2, (0.3, 0.2, 0.1), (0.4, -0.2))
    world = QuadrotorWorld(field([]), 0, parameters, start=start, sensor=SensorModel.exact(), disturbance=CALM)
    world.step(u, 0.005)
    back = SO3.matrix(turned[None])[0].T
    force = (np.array([0.0, 0.0, 11.0]) - drag * (back @ start[7:])) / 1.2 + back @ wind
    np.testing.assert_allclose(world.sense().force, force, atol=0.01)
    on = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    parked = QuadrotorWorld(field([]), 0, start=on, sensor=SensorModel.exact(), disturbance=CALM)
    parked.step([0.0, 0.0, 0.0, 3.0])
    np.testing.assert_allclose(parked.sense().force, [0.0, 0.0, 9.81], atol=1e-12)


def seen(
    *cylinders: tuple[float, float, float], walls: list[tuple[tuple[float, float], tuple[float, float]]]
) -> set[int]:
    world = QuadrotorWorld(field(list(cylinders), walls), 0)
    return set(world.sense().ids.tolist())


def test_hidden_things_are_not_seen() -> None:
    front = (3.0, 0.0, 0.5)
    assert seen(front, (6.0, 0.0, 0.5), walls=[]) == {0}  # in its shadow
    assert seen(front, (6.0, 0.9, 0.5), walls=[]) == {0, 1}  # the axis is hidden, a flank is not
    assert seen(front, (6.0, 2.5, 0.5), walls=[]) == {0, 1}
    assert seen((5.0, 0.0, 0.5), walls=[((3.0, -1.0), (3.0, 1.0))]) == {1, 2}  # behind a wall, whose corners show
    assert seen((2.0, 0.0, 0.5), walls=[((3.0, -0.5), (3.0, 5.0))]) == {0, 2}  # a corner behind a cylinder
    assert seen(walls=[((2.0, -1.0), (2.0, 1.0)), ((4.0, -1.0), (4.0, 1.0))]) == {0, 1}  # a wall behind a wall


def test_things_beyond_the_range_are_not_seen() -> None:
    world = gliding(field([(9.0, 0.0, 0.6)], [((0.0, 7.99), (0.0, 9.0))]), 1.0, 0.0)
    assert world.sense().ids.tolist() == [1]
    while not np.isin(0, world.sense().ids):
        world.step(HOVER)
        assert world.time < 3.0
    assert world.state[0] == pytest.approx(1.0, abs=0.06)  # within one tick of 8 m to the axis


@pytest.mark.product(1, of="studies")
def test_misses_and_clutter_are_as_frequent_as_promised_and_shift_no_other_noise() -> None:
    layout, model = field([(3.0, 0.0, 0.3), (0.0, 5.0, 0.4)]), SensorModel(misses=0.3, clutter=1.5)
    worlds = QuadrotorWorld(layout, 1, PARAMETERS, sensor=model), QuadrotorWorld(layout, 1, PARAMETERS)
    readings = [(worlds[0].sense(), worlds[1].sense()) for _ in range(2000)]
    false = [reading.only(reading.ids == NOTHING) for reading, _ in readings]
    assert sum(len(reading.ids) for reading in false) == pytest.approx(3000, abs=200)
    assert sum(len(reading.ids) for reading, _ in readings) - 3000 == pytest.approx(0.7 * 4000, abs=200)
    spread = np.concatenate([reading.ranges for reading in false])
    assert spread.max() <= model.range_max
    assert (spread < 0.5 * model.range_max).mean() == pytest.approx(0.25, abs=0.04)  # evenly over the area
    for reading, full in readings:
        own = reading.only(reading.ids != NOTHING)
        kept = full.only(np.isin(full.ids, own.ids))
        np.testing.assert_array_equal(own.ranges, kept.ranges)
        np.testing.assert_array_equal(reading.force, full.force)


@pytest.mark.product(1, of="studies")
def test_noise_is_as_large_as_promised() -> None:
    layout = field([(3.0, 0.0, 0.3), (0.0, 5.0, 0.4)])
    world, model = QuadrotorWorld(layout, 1, PARAMETERS), SensorModel()
    readings = [world.sense() for _ in range(3000)]
    ranges = np.array([r.ranges for r in readings]) - [3.0, 5.0]
    bearings = np.array([r.bearings for r in readings]) - [0.0, 0.5 * np.pi]
    height = np.array([r.height for r in readings]) - 2.0
    tilt = np.array([r.tilt for r in readings]) - [0.0, 0.0, 1.0]
    rates = np.array([r.rates for r in readings])
    force = np.array([r.force for r in readings]) - [0.0, 0.0, 9.81]
    bias = force.mean(axis=0)  # the same throughout
    assert (np.abs(bias) < 4.0 * model.sigma_force_bias).all() and np.abs(bias).max() > 0.1 * model.sigma_force_bias
    force -= bias
    for sample, sigma in [
        (ranges, model.sigma_range), (bearings, model.sigma_bearing), (height, model.sigma_height),
        (tilt, model.sigma_tilt), (rates, model.sigma_gyro), (force, model.sigma_force),
    ]:  # fmt: skip
        assert sample.std() == pytest.approx(sigma, rel=0.05)
        assert abs(sample.mean()) < 5.0 * sigma / math.sqrt(sample.size)
    columns = np.column_stack([ranges, bearings, height, tilt, rates, force])
    correlation = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlation).max() < 0.1


def test_default_sensor_is_the_specified_one() -> None:
    model = SensorModel()
    assert (model.range_max, model.sigma_range, model.sigma_bearing) == (8.0, 0.05, 0.01)
    assert (model.sigma_height, model.sigma_tilt, model.sigma_gyro) == (0.03, 0.01, 0.01)


def test_one_seed_is_one_noise_whatever_is_flown_and_seen() -> None:
    layout = field([(3.0, 0.0, 0.3), (0.0, 5.0, 0.4)])
    worlds = [QuadrotorWorld(layout, 3), QuadrotorWorld(layout, 3), QuadrotorWorld(layout, 3, movers=3)]
    quiet = [QuadrotorWorld(world.layout, 3, movers=world.movers, sensor=SensorModel.exact()) for world in worlds]
    controls = [HOVER, np.array([0.2, -0.1, 0.8, 10.5]), HOVER]
    for _ in range(20):
        noises = []
        for world, exact, control in zip(worlds, quiet, controls, strict=True):
            world.step(control)
            exact.step(control)
            np.testing.assert_array_equal(world.state, exact.state)
            noisy, clean = world.sense(), exact.sense()
            standing = ~noisy.moving
            noises.append(
                np.concatenate(
                    [
                        (noisy.ranges - clean.ranges)[standing],
                        (noisy.bearings - clean.bearings)[standing],
                        [noisy.height - clean.height],
                        noisy.tilt - clean.tilt,
                        noisy.rates - clean.rates,
                        noisy.force - clean.force,
                        clean.rates - control[:3],
                    ]
                )
            )
        np.testing.assert_allclose(noises[0], noises[1], atol=1e-12)
        np.testing.assert_allclose(noises[0], noises[2], atol=1e-12)
    other = QuadrotorWorld(layout, 4)
    other.step(HOVER)
    assert not np.array_equal(other.sense().ranges, worlds[0].sense().ranges)


@pytest.mark.product(1, of="studies")
def test_disturbances_have_the_promised_statistics() -> None:
    """Means over 50 ms: white parts as documented, gusts correlated over their time."""
    model = DisturbanceModel(gust=(0.3, 0.2, 0.1), gust_time=0.5)
    draws = Disturbances(model, np.random.default_rng(0))
    noise = np.array([draws.draw(0.005) for _ in range(120_000)])
    ticks = noise.reshape(-1, 10, 6).mean(axis=1)
    np.testing.assert_allclose(ticks[:, :3].std(axis=0), 0.02, rtol=0.03)
    slow = noise.reshape(-1, 100, 6).mean(axis=1)[:, 3:]  # over 0.5 s nearly all is gust
    np.testing.assert_allclose(
        noise[:, 3:].var(axis=0), np.square(model.gust) + model.acceleration_density**2 / 0.005, rtol=0.15
    )
    lagged = [float(np.corrcoef(slow[:-lag, 0], slow[lag:, 0])[0, 1]) for lag in (1, 2)]
    assert lagged[1] / lagged[0] == pytest.approx(math.exp(-1.0), abs=0.08)
    long = noise[:, 3:].reshape(-1, 4000, 3).mean(axis=1)  # 20 s are many correlation times
    np.testing.assert_allclose(long.std(axis=0), model.white_sigma(20.0)[3:], rtol=0.35)
    with pytest.raises(ScenarioError, match=r"gust_time: '0.0' is not a positive number"):
        DisturbanceModel(gust_time=0.0)


# ------------------------------------------------------------------- flight log


@pytest.mark.parametrize("ticks", [0, 1, 6])
def test_a_flight_log_survives_its_file(ticks: int, tmp_path: Path) -> None:
    log = flight(ticks)
    assert log.ticks == ticks and len(log.seen) == ticks
    np.testing.assert_allclose(log.time, 0.05 * np.arange(ticks))
    if ticks:
        assert log.plans.shape == (ticks, 21, 3) and log.movers.shape == (ticks, 1, 3)
        assert log.target_distance[0] == pytest.approx(11.0)
        assert len(log.pasts[-1]) == ticks
    path = tmp_path / "flight.npz"
    log.save(path)
    read = FlightLog.load(path)
    for name, value in vars(log).items():
        other = getattr(read, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(other, value, err_msg=name)
            assert other.dtype == value.dtype and other.shape == value.shape, name
        elif name == "layout":
            for part in ("start", "target", "cylinders", "walls", "size", "name"):
                np.testing.assert_array_equal(getattr(other, part), getattr(value, part))
        elif name in ("pasts", "seen", "landmarks"):
            assert len(other) == len(value)
            for a, b in zip(other, value, strict=True):
                np.testing.assert_array_equal(a, b)
                assert a.shape == b.shape and a.dtype == b.dtype
        else:
            assert other == value, name


def test_a_file_that_is_no_flight_log_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(FileFormatError, match="is no unifg flight log 5"):
        FlightLog.load(tmp_path / "other.npz")
