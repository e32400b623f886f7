"""The worlds of MuJoCo: forces, motors and wheels obey physics; sensors and contacts are those of the engine."""

from __future__ import annotations

import math

import numpy as np
import pytest

from maps import stop_after, walled
from unifg.errors import ScenarioError
from unifg.models import quadrotor, unicycle
from unifg.models.footprint import Body
from unifg.models.planar import base_of
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.simulation.air import QuadrotorWorld
from unifg.scenarios.simulation.bearing_range import SensorModel
from unifg.scenarios.simulation.disturbance import DisturbanceModel
from unifg.scenarios.simulation.drivetrain import Drivetrain
from unifg.scenarios.simulation.layouts import Layout, corridor
from unifg.scenarios.simulation.plane import LidarModel, OdometryModel, World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

pytest.importorskip("mujoco", reason="needs unifg[mujoco]")

from unifg.scenarios.simulation.mujoco_drive import WHEEL, MujocoDrive
from unifg.scenarios.simulation.mujoco_flight import INERTIA, LOOPS, ROTOR, MujocoQuadrotor

CALM, EXACT = DisturbanceModel.calm(), OdometryModel(0.0, 0.0)
QUIET = LidarModel(sigma=0.0, dropout=0.0)
GRAVITY = quadrotor.GRAVITY
DRAGGED = quadrotor.Parameters(1.2, (0.3, 0.2, 0.1), (0.4, -0.2))


def field(*cylinders: tuple[float, float, float], height: float = 5.0) -> Layout:
    """An open field with a wall at x = 8 m and the start above the origin."""
    wall, size = [[[8.0, -5.0], [8.0, 5.0]]], [[-9.0, -9.0], [9.0, 9.0]]
    return Layout(np.array([0.0, 0.0, height]), np.ones(3), np.array(cylinders), np.array(wall), np.array(size))


def flyer(
    parameters: quadrotor.Parameters | None = None, layout: Layout | None = None, *, velocity: float = 0.0
) -> MujocoQuadrotor:
    """A vehicle without disturbances, level, at a speed along x [m/s]."""
    layout = layout or field()
    start = [*layout.start, 1.0, 0.0, 0.0, 0.0, velocity, 0.0, 0.0]
    return MujocoQuadrotor(layout, 0, parameters, start=start, disturbance=CALM, sensor=SensorModel.exact())


def driver(
    *obstacles: Obstacle, start: tuple[float, float, float] = (3.0, 3.0, 0.0), train: Drivetrain | None = None
) -> MujocoDrive:
    """A robot with exact sensors in a room of 6 m by 6 m, its map turned."""
    room = walled(6.0, 6.0, blocks=[(slice(80, 90), slice(20, 55))])
    drivetrain = train or Drivetrain()
    return MujocoDrive(room, start, obstacles, lidar=QUIET, odometry=EXACT, drivetrain=drivetrain)


# ----------------------------------------------------------------------- flight


@pytest.mark.parametrize("mass", [0.8, 1.3])
def test_thrust_like_the_weight_hovers(mass: float) -> None:
    world = flyer(quadrotor.Parameters(mass))
    for _ in range(20):
        world.step([0.0, 0.0, 0.0, mass * GRAVITY])
    np.testing.assert_allclose(world.state, [0, 0, 5, 1, 0, 0, 0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(world.sense().force, [0.0, 0.0, GRAVITY], atol=1e-6)


def test_without_thrust_it_falls() -> None:
    """The rotors turn on for the lag, so the fall begins late by it."""
    world = flyer()
    for _ in range(8):
        world.step(np.zeros(4))
    assert world.state[9] == pytest.approx(-GRAVITY * (0.4 - LOOPS.lag), abs=1e-2)
    np.testing.assert_allclose(world.sense().force, 0.0, atol=1e-3)


def test_rotors_follow_with_their_lag() -> None:
    world = flyer()
    felt = []
    for _ in range(12):
        world.step([0.0, 0.0, 0.0, 1.5 * GRAVITY], dt=0.005)
        felt.append(world.sense().force[2] / GRAVITY)
    times = 0.005 * np.arange(12) + 0.002  # middle of the samples in a step
    np.testing.assert_allclose(felt, 1.0 + 0.5 * (1.0 - np.exp(-times / LOOPS.lag)), atol=2e-3)


def test_the_autopilot_reaches_the_rates_it_is_told() -> None:
    """Roll and pitch settle as a loop of second order; yaw, by the drag of the rotors alone, is slower."""
    world, told = flyer(), np.array([0.3, -0.5, 0.2, GRAVITY])
    for _ in range(6):
        world.step(told, dt=0.005)
    early = world.sense().rates
    assert early[1] == pytest.approx(-0.5 * _second_order(0.0275), abs=0.02)
    for _ in range(10):
        world.step(told)
    np.testing.assert_allclose(world.sense().rates, told[:3], atol=5e-3)


def _second_order(time: float) -> float:
    """Step response of lag rate'' + rate' = gain (1 - rate)."""
    damped, decay = math.sqrt(LOOPS.gain / LOOPS.lag - 0.25 / LOOPS.lag**2), 0.5 / LOOPS.lag
    return 1.0 - math.exp(-decay * time) * (math.cos(damped * time) + decay / damped * math.sin(damped * time))


def test_drag_and_wind_are_those_of_the_own_plant() -> None:
    flown = flyer(DRAGGED, velocity=2.0)
    own = QuadrotorWorld(field(), 0, DRAGGED, start=flown.state, disturbance=CALM)
    for _ in range(20):
        for world in (flown, own):
            world.step([0.0, 0.0, 0.0, DRAGGED.mass * GRAVITY])
    np.testing.assert_allclose(flown.state, own.state, atol=2e-3)


def test_a_load_and_weak_rotors_are_felt() -> None:
    world = flyer()
    world.parameters = quadrotor.Parameters(1.5)
    for _ in range(4):
        world.step([0.0, 0.0, 0.0, 1.5 * GRAVITY])
    np.testing.assert_allclose(world.physics.model.body_inertia[world.physics.vehicle], 1.5 * INERTIA)
    assert world.sense().force[2] == pytest.approx(GRAVITY, abs=0.01)
    for _ in range(4):
        world.step([0.0, 0.0, 0.0, 100.0])
    assert world.sense().force[2] == pytest.approx(4.0 * ROTOR / 1.5, rel=1e-3)


def test_a_cylinder_a_wall_and_a_mover_stop_it_once() -> None:
    mover = Obstacle(np.array([-3.0, -3.0]), 0.3, np.array([-3.0, 3.0]), 0.5)
    layout = field((3.0, 0.0, 0.5))
    for start, vx in (((0.0, 0.0), 2.0), ((6.0, 3.0), 2.0)):
        state = [*start, 5.0, 1.0, 0.0, 0.0, 0.0, vx, 0.0, 0.0]
        world = MujocoQuadrotor(layout, 0, None, [mover], start=state, disturbance=CALM)
        for _ in range(25):
            world.step([0.0, 0.0, 0.0, GRAVITY])
        assert world.collisions == 1 and world.state[7] < 0.5
        assert world.clearance() > -0.02
    standing = MujocoQuadrotor(layout, 0, None, [mover], start=[-3, 0, 5, 1, 0, 0, 0, 0, 0, 0], disturbance=CALM)
    for _ in range(120):
        standing.step([0.0, 0.0, 0.0, GRAVITY])
    assert standing.collisions >= 1 and standing.state[1] > 0.1  # pushed along


@pytest.mark.parametrize(("thrust", "hits"), [(0.97, 0), (0.5, 1)])
def test_a_soft_landing_is_no_collision(thrust: float, hits: int) -> None:
    world = flyer(layout=field(height=0.5))
    for _ in range(60):
        world.step([0.0, 0.0, 0.0, thrust * GRAVITY])
    assert world.grounded and world.collisions == hits and abs(world.state[2]) < 0.01


def test_the_engine_sees_what_the_own_plant_sees() -> None:
    layout = corridor(3)
    for x, y in ((4.0, 0.5), (9.0, -1.0), (15.0, 0.0), (22.0, 1.0)):
        if np.hypot(*(layout.cylinders[:, :2] - [x, y]).T).min() < 1.0:
            continue
        start = [x, y, 1.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        kinds = (kind(layout, 0, start=start, movers=2) for kind in (QuadrotorWorld, MujocoQuadrotor))
        own, seen = (world.sense() for world in kinds)
        np.testing.assert_array_equal(seen.ids, own.ids)
        np.testing.assert_allclose(seen.ranges, own.ranges)
        assert len(own.ids) > 2


# ------------------------------------------------------------------------ drive


def test_wheels_roll_as_kinematics_say() -> None:
    """Straight on a radius up to the middle of what tyres are pressed in, in a turn to a slip below 2 %."""
    straight = driver(start=(1.0, 1.0, 0.0))
    for _ in range(10):
        straight.step(0.5, 0.0)
    begin = straight.pose[0]
    for _ in range(20):
        straight.step(0.5, 0.0)
    radius = WHEEL + 0.5 * float(straight.physics.data.qpos[2])
    assert 0.99 * WHEEL < radius < WHEEL
    assert straight.pose[0] - begin == pytest.approx(0.5 * 2.0 * radius / WHEEL, rel=1e-3)
    np.testing.assert_allclose(straight.pose[1:], [1.0, 0.0], atol=1e-3)
    turning = driver()
    for _ in range(10):
        turning.step(0.4, 0.8)
    before, counted = turning.pose, np.zeros(2)
    for _ in range(20):
        turning.step(0.4, 0.8)
        counted += turning.odometry()
    np.testing.assert_allclose(counted / 20.0, [0.4, 0.8], rtol=1e-3)
    made = unicycle.BASE.rollout(before, np.tile([0.4, 0.8], (20, 1)), 0.1)[-1]
    slipped = 0.8 * 2.0 - (turning.pose[2] - before[2])
    assert 1e-3 < slipped < 0.02 * 1.6
    np.testing.assert_allclose(turning.pose[:2], made[:2], atol=0.02)


def test_wheels_spin_at_a_wall_and_encoders_count_it() -> None:
    world = driver(start=(5.5, 1.0, 0.0))
    counted = 0.0
    for _ in range(20):
        world.step(0.6, 0.0)
        counted += 0.1 * world.odometry()[0]
    assert world.collisions == 1 and -0.01 < world.clearance() < 0.01
    assert counted > world.pose[0] - 5.5 + 0.3


def test_a_polygon_touches_with_its_front() -> None:
    body, room = Body.polygon([(0.25, -0.15), (0.25, 0.15), (-0.2, 0.15), (-0.2, -0.15)]), walled(6.0, 6.0)
    world = MujocoDrive(room, (5.2, 3.0, 0.0), body=body, drivetrain=Drivetrain())
    for _ in range(20):
        world.step(0.8, 0.0)
    assert world.collisions == 1 and world.pose[0] == pytest.approx(5.95 - 0.25, abs=0.005)


def test_a_disc_that_moves_pushes_and_is_counted() -> None:
    mover = Obstacle(np.array([4.5, 3.0]), 0.2, np.array([1.0, 3.0]), 0.5)
    world = MujocoDrive(walled(6.0, 6.0), (3.0, 3.0, 0.0), [mover], drivetrain=Drivetrain())
    for _ in range(40):
        world.step(0.0, 0.0)
    assert world.collisions >= 1 and world.pose[0] < 2.9


def test_beams_meet_what_the_own_lidar_meets() -> None:
    things = (Obstacle(np.array([4.5, 3.3]), 0.2), Obstacle(np.array([2.0, 2.0]), 0.3))
    world = driver(*things)
    own = World(world.occupancy, (3.0, 3.0, 0.0), things, lidar=QUIET, odometry=EXACT)
    np.testing.assert_allclose(world.scan().ranges, own.scan().ranges, atol=1e-9)


def test_beams_of_a_turning_lidar_leave_from_where_the_robot_was() -> None:
    lidar = LidarModel(sigma=0.0, dropout=0.0, turn=0.1)
    room = walled(6.0, 6.0)
    worlds = [kind(room, (3.0, 3.0, 0.0), lidar=lidar, drivetrain=Drivetrain()) for kind in (World, MujocoDrive)]
    for world in worlds:
        for _ in range(8):
            world.step(0.6, 0.0)
    (own, seen), x = (world.scan().ranges for world in worlds), worlds[1].pose[0]
    assert seen[180] == pytest.approx(5.95 - (x - 0.03), abs=2e-3)  # ahead, half a turn ago
    np.testing.assert_allclose(seen, own, atol=0.02)


def test_a_robot_put_down_elsewhere_rests_there() -> None:
    world = driver()
    for _ in range(5):
        world.step(0.8, 0.0)
    world.carry([1.5, 1.5, 2.0])
    world.power(False)
    world.step(0.8, 0.0)
    np.testing.assert_allclose(world.pose, [1.5, 1.5, 2.0], atol=0.06)
    for _ in range(10):
        world.step(0.8, 0.0)
    assert world.odometry() == pytest.approx((0.0, 0.0), abs=1e-3)


def test_other_bases_and_stated_slip_are_refused() -> None:
    with pytest.raises(ScenarioError, match="two wheels"):
        driver(train=Drivetrain(slip=0.1))
    with pytest.raises(ScenarioError, match="two wheels"):
        MujocoDrive(walled(6.0, 6.0), (3.0, 3.0, 0.0), base=base_of("omnidirectional"))


# ------------------------------------------------------------------ closed loops


@pytest.mark.product(2, of="drives and flights")
def test_a_flight_repeats_and_is_not_that_of_the_own_plant() -> None:
    def flown(world: str, seconds: float = 2.0) -> Array:
        settings = FlightSettings(seed=1003, world=world, time_limit=seconds)
        log = Flight(settings, rehearsal=True).run(lambda done, text: None)
        assert log.settings["world"] == world and not log.collisions and log.health == ["ok"] * log.ticks
        assert np.linalg.norm(log.believed[:, :3] - log.truth[:, :3], axis=1).max() < 0.15
        return log.truth

    first, again, own = flown("mujoco"), flown("mujoco", 0.5), flown("air")
    np.testing.assert_array_equal(first[: len(again)], again)
    assert first[-1, 0] > 2.5 and 1e-3 < np.linalg.norm(first[-1, :3] - own[-1, :3]) < 0.3


@pytest.mark.product(2, of="drives and flights")
def test_a_drive_reaches_its_goal_and_repeats() -> None:
    def driven(ticks: int) -> tuple[Array, bool]:
        settings = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((8.5, 14.1, 0.0),), world="mujoco")
        log = Episode(settings, rehearsal=True).run(stop_after(ticks))
        assert not log.collisions
        return log.true_pose, log.succeeded

    poses, reached = driven(1000)
    again, _ = driven(12)
    assert reached
    np.testing.assert_array_equal(poses[:12], again[:12])
