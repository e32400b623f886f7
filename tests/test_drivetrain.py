"""Response of a base to its commands, each effect against its closed form, alone and in the simulated world."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.simulation.drivetrain import COMPUTED, Drivetrain, Wheels, latency_of
from unifg.scenarios.simulation.plane import LidarModel, OdometryModel, World

QUIET, EXACT = LidarModel(sigma=0.0, dropout=0.0), OdometryModel(scale_sigma=0.0, noise_sigma=0.0)
SUBSTEP = 0.005
IDEAL: dict[str, Any] = {"acceleration": math.inf, "turning": math.inf}


def open_floor(**drivetrain: Any) -> World:
    """A floor without walls, without noise, the robot at its origin, heading along x."""
    nothing = np.zeros((10, 10), dtype=bool)
    empty = OccupancyMap(nothing, ~nothing, 0.05, (0.0, 0.0, 0.0), "empty")
    base = Drivetrain(**(IDEAL | drivetrain))
    return World(empty, (0.0, 0.0, 0.0), lidar=QUIET, odometry=EXACT, drivetrain=base)


def driven(wheels: Wheels, command: tuple[float, float], time: float) -> tuple[float, float]:
    """Distances that the wheels cover in a time under one command [m, rad]."""
    wheels.tell(command)
    means = np.array([wheels.advance(SUBSTEP) for _ in range(round(time / SUBSTEP))])
    return tuple((SUBSTEP * means.sum(axis=0)).tolist())


def test_an_ideal_base_follows_at_once() -> None:
    wheels = Wheels(Drivetrain.ideal())
    assert driven(wheels, (0.7, -0.4), 0.1) == pytest.approx((0.07, -0.04))
    assert wheels.velocity.tolist() == [0.7, -0.4]


@pytest.mark.parametrize("load", [0.0, 0.6])
def test_ramps_keep_their_accelerations_with_a_load(load: float) -> None:
    """From rest to v and back: v/a of time each, v^2/(2a) of way each; a load divides a, and nothing is lost."""
    a, alpha = 2.5 / (1.0 + load), 3.2 / (1.0 + load)
    wheels = Wheels(Drivetrain(acceleration=2.5, turning=3.2, load=load))
    way, angle = driven(wheels, (1.0, 0.9), 0.2)
    assert way == pytest.approx(0.5 * a * 0.2**2) and wheels.velocity[0] == pytest.approx(a * 0.2)
    more, turned = driven(wheels, (1.0, 0.9), 1.0)
    assert way + more == pytest.approx(1.2 - 1.0**2 / (2.0 * a))
    assert angle + turned == pytest.approx(1.2 * 0.9 - 0.9**2 / (2.0 * alpha))
    braked, _ = driven(wheels, (0.0, 0.0), 1.0)
    assert braked == pytest.approx(1.0 / (2.0 * a))
    assert not wheels.velocity.any()


def test_a_reversal_takes_the_time_of_both_ramps() -> None:
    wheels = Wheels(Drivetrain(acceleration=1.0))
    driven(wheels, (0.5, 0.0), 1.0)
    wheels.tell((-0.5, 0.0))
    speeds = []
    for _ in range(200):
        wheels.advance(SUBSTEP)
        speeds.append(wheels.velocity[0])
    assert np.abs(np.diff(speeds)).max() <= 1.0 * SUBSTEP + 1e-12
    assert speeds[99] == pytest.approx(0.0, abs=1e-9) and speeds[199] == pytest.approx(-0.5)


def test_lag_is_of_first_order() -> None:
    """Velocity 1 - exp(-t/tau), way t - tau (1 - exp(-t/tau)), whatever the substep."""
    tau, time = 0.3, 0.5
    wheels = Wheels(Drivetrain(lag=tau, **IDEAL))
    way, angle = driven(wheels, (1.0, -0.5), time)
    left = math.exp(-time / tau)
    assert wheels.velocity == pytest.approx([1.0 - left, -0.5 * (1.0 - left)])
    assert way == pytest.approx(time - tau * (1.0 - left))
    assert angle == pytest.approx(-0.5 * way)


def test_lag_under_a_limit_is_the_gentler_of_both() -> None:
    wheels = Wheels(Drivetrain(acceleration=1.0, turning=math.inf, lag=0.1))
    driven(wheels, (1.0, 0.0), 0.5)
    assert wheels.velocity[0] == pytest.approx(0.5)  # 10 m/s^2 asked for
    driven(wheels, (1.0, 0.0), 0.4)  # from 0.9 m/s on the lag is the slower one
    assert wheels.velocity[0] == pytest.approx(0.9)
    driven(wheels, (1.0, 0.0), 0.1)
    assert wheels.velocity[0] == pytest.approx(1.0 - 0.1 * math.exp(-1.0), abs=1e-3)


@pytest.mark.parametrize("latency", [0.02, 0.1, 0.25])
def test_a_command_acts_after_its_latency(latency: float) -> None:
    """Every command, in its turn: the second must not overtake the first."""
    wheels = Wheels(Drivetrain(latency=latency, **IDEAL))
    speeds = []
    for command in [1.0, 0.5, 0.0, 0.0, 0.0, 0.0]:
        wheels.tell((command, 0.0))
        speeds += [wheels.advance(SUBSTEP)[0] for _ in range(20)]
    begin = round(latency / SUBSTEP)
    assert not any(speeds[:begin])
    assert speeds[begin : begin + 20] == [1.0] * 20
    assert speeds[begin + 20 : begin + 40] == [0.5] * 20
    assert not any(speeds[begin + 40 :])


def test_a_command_acts_when_it_is_computed() -> None:
    """A tick that takes longer than its period delays the next one, which does not overtake it."""
    wheels = Wheels(Drivetrain(latency=COMPUTED, **IDEAL))
    speeds = []
    for command, computing in ((1.0, 0.03), (0.5, 0.15), (0.2, 0.02), (0.1, 0.02)):
        wheels.tell((command, 0.0), computing)
        speeds += [wheels.advance(SUBSTEP)[0] for _ in range(20)]
    assert speeds == [0.0] * 6 + [1.0] * 44 + [0.5] * 4 + [0.2] * 10 + [0.1] * 16
    assert latency_of("auto") == COMPUTED and latency_of("0.1") == 0.1


# ---------------------------------------------------------------- in the world


def test_the_world_ramps_from_tick_to_tick() -> None:
    """0.25 m/s more each tick at 2.5 m/s^2, and the mean of a ramp is what the wheels report."""
    world = open_floor(acceleration=2.5, turning=3.2)
    seen = []
    for _ in range(6):
        world.step(1.0, 0.0)
        seen.append(world.odometry()[0])
    assert seen == pytest.approx([0.125, 0.375, 0.625, 0.875, 1.0, 1.0], abs=1e-6)
    assert world.pose[0] == pytest.approx(0.6 - 0.2, abs=1e-6)
    for _ in range(6):
        world.step(0.0, 0.0)
    assert world.pose[0] == pytest.approx(0.6, abs=1e-6)


def test_slip_takes_its_share_and_the_wheels_do_not_feel_it() -> None:
    world = open_floor(slip=0.15)
    for _ in range(10):
        world.step(0.8, 0.3)
        assert world.odometry() == pytest.approx((0.8, 0.3), abs=1e-5)
    assert world.pose[2] == pytest.approx(0.85 * 0.3, abs=1e-6)
    radius = 0.8 / 0.3
    assert world.pose[:2] == pytest.approx([radius * math.sin(0.255), radius * (1 - math.cos(0.255))], abs=1e-4)


def test_a_turning_base_drifts_outwards() -> None:
    """With u = skid v omega to the right it goes round a wider circle, of radius hypot(v, u) / omega."""
    v, omega, skid = 0.8, 1.0, 0.1
    world = open_floor(skid=skid)
    places = [world.pose]
    for _ in range(40):
        world.step(v, omega)
        places.append(world.pose)
        assert world.odometry() == pytest.approx((v, omega), abs=1e-4)
    aside = skid * v * omega
    # The centre of a circle lies where the velocity of a point that turns along is zero: left and ahead of the base.
    centre = np.array([aside / omega, v / omega])
    reach = np.hypot(*(np.array(places)[:, :2] - centre).T)
    assert reach == pytest.approx(math.hypot(v, aside) / omega, abs=2e-4)
    straight = open_floor(skid=skid)
    straight.step(v, 0.0)
    assert straight.pose == pytest.approx([0.08, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("acceleration", 0.0), ("turning", -1.0), ("acceleration", math.nan), ("load", -0.1), ("lag", math.inf),
        ("latency", -0.01), ("slip", 1.0), ("skid", math.nan),
    ],
)  # fmt: skip
def test_what_is_no_base_is_refused(field: str, value: float) -> None:
    assert field in {f.name for f in fields(Drivetrain)}
    with pytest.raises(ScenarioError, match=field):
        Drivetrain(**{field: value})
