"""Faults of calibration and of the plant: slow states, jumps, motors that disobey, a thrust that is not what it was."""

from __future__ import annotations

import argparse
import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import maps
from unifg.lie import SE2
from unifg.models import unicycle
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.ground.calibration import BIAS, MOUNT, SCALE, TIMES, Calibration
from unifg.scenarios.ground.drive_signals import RAMPS, DriveSignals
from unifg.scenarios.ground.motor_lag import MotorLag
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.quadrotor.unmodelled import Unmodelled
from unifg.scenarios.simulation.drivetrain import Drivetrain
from unifg.scenarios.simulation.faults import DRIVE_FAULTS, FLIGHT_FAULTS, SIZES, DriveFaults, Fault, one_of
from unifg.scenarios.simulation.plane import LidarModel, World
from unifg.typing import Array

DT = 0.1
MOST = np.array([0.25, 0.32])  # changes of the velocities in a tick [m/s, rad/s]
PLACE = np.array([6.5, 14.0, 0.1])
AHEAD = np.array([0.5, 0.0])
CORRIDOR = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),), obstacles=1)
TURNED, BIASED = "the lidar has turned in its mount", "the lidar measures too far or too near"
JUMPED, DISOBEYED = "the scale of the wheels has jumped", "the robot does not do what it is told"


@functools.cache
def seen(x: float = PLACE[0]) -> Scan:
    """Scan of a good lidar on the shipped floor."""
    return World(maps.building()[0], (x, PLACE[1], PLACE[2]), rng=np.random.default_rng(3)).scan()


def spoiled(scan: Scan, kind: str, size: float) -> Scan:
    """The same of a lidar with a fault."""
    found = DriveFaults([Fault(kind, 0.0, size=size)], 0).scan(scan, 0.0)
    assert found is not None
    return found


def standing(scan: Scan) -> Calibration:
    """Calibration of a robot that stands and has taken in a good scan."""
    known = Calibration(maps.building()[1], DT, unicycle.BASE)
    known.note(scan, PLACE, PLACE, np.zeros(2))
    return known


@pytest.mark.parametrize(
    ("kind", "which", "size"),
    [
        ("lidar-turned", MOUNT, 0.17), ("lidar-turned", MOUNT, -0.105), ("lidar-turned", MOUNT, 0.35),
        ("range-bias", BIAS, 0.3), ("range-bias", BIAS, -0.25),
    ],
)  # fmt: skip
def test_a_jump_is_found_at_the_third_scan_and_put_right(kind: str, which: int, size: float) -> None:
    scan, still = seen(), np.zeros(2)
    known, wrong = standing(scan), spoiled(scan, kind, size)
    for _ in range(TIMES - 1):
        assert not known.jumps(known.right(wrong), still)
        known.note(wrong, PLACE, PLACE + np.array([0.0, 0.0, size]), still)
        np.testing.assert_array_equal(known.pose, PLACE, "a scan in doubt does not move it")
    assert known.right(wrong) is wrong and known.jumps(wrong, still)
    true = size if which == BIAS else round(size / scan.spacing) * scan.spacing
    assert known.used[which] == pytest.approx(true, abs=0.02) and known.used[1 - which] == 0.0
    right = known.right(wrong)
    assert not known.jumps(right, still)
    points = [SE2.act(PLACE, r.ranges[:, None] * np.column_stack([np.cos(r.angles), np.sin(r.angles)])) for r in
              (scan, right)]  # fmt: skip
    gaps = [np.abs(maps.building()[1].distance(p[np.isfinite(p).all(axis=1)])).mean() for p in points]
    assert gaps[1] < gaps[0] + 0.01
    for _ in range(TIMES):  # the fault ends
        ended = known.jumps(known.right(scan), still)
    assert ended and not known.used.any() and known.right(scan) is scan


def test_a_doubt_that_does_not_last_is_forgotten_and_one_that_lasts_without_a_jump_as_well() -> None:
    scan, still = seen(), np.zeros(2)
    known, wrong = standing(scan), spoiled(scan, "lidar-turned", 0.17)
    for other in (wrong, wrong, scan, wrong, wrong, spoiled(scan, "lidar-turned", -0.17), wrong, wrong):
        assert not known.jumps(other, still)
        known.note(other, PLACE, PLACE, still)
    lost = Calibration(maps.building()[1], DT, unicycle.BASE)
    assert not any(lost.jumps(wrong, still) for _ in range(5)), "nothing is compared before a pose is known"
    known = standing(scan)
    known.note(None, PLACE, PLACE, still)
    assert known.pose is None, "a pose that is not sure is none to compare with"
    known = standing(scan)
    assert not known.jumps(wrong, still) and not known.jumps(spoiled(scan, "lidar-turned", -0.17), still)
    known.note(scan, PLACE, PLACE + np.array([0.1, 0.0, 0.0]), still)
    assert known.pose is not None and known.pose[0] == PLACE[0] + 0.1, "these contradict each other"


def test_a_bias_that_is_put_right_leaves_no_range_below_zero() -> None:
    known = standing(seen())
    known.used = np.array([0.0, 0.8])
    ranges = known.right(seen()).ranges
    assert np.nanmin(ranges) == 0.0 and np.isnan(ranges[np.isnan(seen().ranges)]).all()


def driven(known: Calibration, off: Array, ticks: int, scan: Scan | None = None, wheels: Array = AHEAD) -> None:
    """Ticks after which scans find a robot ``off`` (3,) where wheels have predicted it."""
    for _ in range(ticks):
        known.note(scan or seen(), PLACE, SE2.compose(PLACE, off), wheels)


def test_a_mount_is_learnt_from_motion_aside() -> None:
    known = standing(seen())
    driven(known, np.array([0.0, -0.5 * DT * 0.02, 0.0]), 100)
    assert known.state[MOUNT] == pytest.approx(0.02, abs=0.005) and not known.used.any(), "a tolerance"
    driven(known, np.array([0.0, -0.5 * DT * 0.1, 0.0]), 100)
    assert known.used[MOUNT] == pytest.approx(0.1, rel=0.4)
    before = known.state[MOUNT]
    driven(known, np.array([0.0, -0.1, 0.0]), 50, wheels=np.array([0.0, 0.3]))
    assert known.state[MOUNT] == before, "a robot that turns where it stands says nothing"
    skids = standing(seen())
    driven(skids, np.array([0.0, -0.5 * DT * 0.1, 0.0]), 5, wheels=np.array([0.5, 1.0]))
    sure = standing(seen())
    driven(sure, np.array([0.0, -0.5 * DT * 0.1, 0.0]), 5)
    assert abs(skids.state[MOUNT]) < abs(sure.state[MOUNT]), "a base that turns drifts"


def test_a_bias_is_learnt_from_walls_on_both_sides() -> None:
    known, wrong = standing(seen()), spoiled(seen(), "range-bias", 0.12)
    assert known.state[BIAS] == pytest.approx(0.0, abs=0.01)
    for _ in range(100):
        known.note(known.right(wrong), PLACE, PLACE, np.zeros(2))
    assert known.used[BIAS] == pytest.approx(0.12, abs=0.03) and known.used[MOUNT] == 0.0


def test_a_scale_of_wheels_that_jumps_is_told_from_one_that_is_known() -> None:
    known = standing(seen())
    driven(known, np.array([0.1 * 0.5 * DT, 0.0, 0.0]), 60)
    assert known.state[SCALE] == pytest.approx(0.1, abs=0.02) and known.scale_jump < 0.03
    driven(known, np.array([-0.2 * 0.5 * DT, 0.0, 0.0]), 4)
    assert known.scale_jump < 0.2, "three ticks in a row"
    driven(known, np.array([-0.2 * 0.5 * DT, 0.0, 0.0]), 2)
    assert known.scale_jump == pytest.approx(0.28, abs=0.05) and RAMPS["scale"].share(known.scale_jump) < 1.0
    assert abs(known.state[SCALE] - 0.1) < 0.1, "slow"
    new = standing(seen())
    driven(new, np.array([-0.2 * 0.5 * DT, 0.0, 0.0]), 6)
    assert new.scale_jump == 0.0, "a scale has to be known before it can jump"


# ------------------------------------------------------------------------ motors


def obeying(commands: list[tuple[float, float]], did: tuple[float, float]) -> list[bool]:
    """For every command, if a robot that goes on in its own way obeys."""
    motors, found = MotorLag(DT, MOST), []
    for _ in range(12):
        motors.note(np.array([1.0, 0.0]), np.array([1.0, 0.0]))
    for command in commands:
        motors.note(np.array(command), np.array(did))
        found.append(motors.obey(np.array(did)))
    return found


def test_motors_that_go_on_disobey_a_command_to_brake_or_to_turn() -> None:
    braked = obeying([(max(0.0, 0.75 - 0.25 * k), 0.0) for k in range(8)], (1.0, 0.0))
    assert braked[0] and not any(braked[5:]) and braked == sorted(braked, reverse=True)
    turned = obeying([(1.0, 0.5)] * 8, (1.0, 0.0))
    assert turned[0] and not any(turned[5:])
    assert all(obeying([(1.0, 0.0)] * 8, (1.12, 0.04))), "wheels have a scale and noise"
    assert not any(obeying([(1.0, 0.0)] * 8, (1.3, 0.0)))


def asked_to_stop(did: Array, ticks: int, pose_says: Array | None = None) -> DriveSignals:
    """Signals of a robot that drove on at 1 m/s, was told to stop, and does something else for some ticks."""
    signals, pose = DriveSignals(DT, MOST), np.zeros(3)
    for k in range(14 + ticks):
        told = np.array([min(1.0, 0.25 * (k + 1)), 0.0]) if k < 6 else np.array([max(0.0, 1.0 - 0.25 * (k - 5)), 0.0])
        stopping = k < 14
        wheels = signals.motors._expected[-1][0] if stopping else did
        moved = wheels if pose_says is None or stopping else pose_says
        after = pose + DT * np.array([moved[0], 0.0, moved[1]])
        signals.note(
            corrected=True, share=1.0, predicted=after, pose=after, covariance=1e-4 * np.eye(3), wheels=wheels,
            trusted=True, asked=told,
        )  # fmt: skip
        pose = np.array([after[0], 0.0, 0.0])
    return signals


def at_rest(signals: DriveSignals, ticks: int, moved: float = 0.0) -> DriveSignals:
    """The same after some ticks of rest, or of a motion that is not told [m/s]."""
    for _ in range(ticks):
        did = np.array([moved, 0.0])
        signals.note(
            corrected=True, share=1.0, predicted=np.zeros(3), pose=np.zeros(3), covariance=1e-4 * np.eye(3),
            wheels=did, trusted=True, asked=np.zeros(2),
        )  # fmt: skip
        if moved:
            signals._watch_power([did, did])
    return signals


def test_power_is_to_be_cut_after_three_ticks_of_another_motion() -> None:
    on = np.array([0.5, 0.0])
    assert not asked_to_stop(on, 2).power_off and asked_to_stop(on, 3).power_off
    assert not asked_to_stop(np.array([0.09, 0.2]), 9).power_off, "it rests"
    assert not asked_to_stop(on, 9, pose_says=np.zeros(2)).power_off, "its wheels alone say that it moves"
    signals = asked_to_stop(on, 3)
    assert signals.values()["wheels"] > RAMPS["wheels"].ends
    assert at_rest(signals, 28).power_off and not at_rest(signals, 3).power_off, "something has pushed it"
    assert RAMPS["wheels"].share(signals.values()["wheels"]) == 0.0, "it does not move yet"
    assert RAMPS["wheels"].share(at_rest(signals, 10).values()["wheels"]) == 1.0
    again = at_rest(asked_to_stop(on, 3), 32)
    assert not again.power_off and at_rest(at_rest(again, 1, moved=0.2), 100).power_off, "given up"


def test_motors_that_go_on_as_before_are_given_up() -> None:
    signals, pose = DriveSignals(DT, MOST), np.zeros(3)
    for k in range(60):
        told = np.array([min(1.0, 0.25 * (k + 1)), 0.0]) if k < 10 else np.zeros(2)
        wheels = signals.motors._expected[-1][0] if k < 10 else np.array([1.0, 0.0])
        wheels = np.zeros(2) if signals.power_off else wheels
        after = pose + DT * np.array([wheels[0], 0.0, wheels[1]])
        signals.note(
            corrected=True, share=1.0, predicted=after, pose=after, covariance=1e-4 * np.eye(3), wheels=wheels,
            trusted=True, asked=told,
        )  # fmt: skip
        pose = after
    assert signals.power_off and at_rest(signals, 100).power_off


def test_a_base_without_power_brakes_and_takes_no_command() -> None:
    world = World(maps.building()[0], PLACE, drivetrain=Drivetrain(lag=0.3, latency=0.15))
    for _ in range(30):
        world.step(0.5, 0.0)
    assert world.vehicle.velocity.length == pytest.approx(0.5, abs=0.02)
    world.power(False)
    speeds = []
    for _ in range(4):
        world.step(0.5, 0.0)
        speeds.append(world.vehicle.velocity.length)
    assert speeds[0] == pytest.approx(0.25, abs=0.03) and max(speeds[1:]) < 0.01, "at 2.5 m/s^2, without lag"
    world.power(True)
    world.step(0.5, 0.0)
    assert world.vehicle.velocity.length > 0.1


# ------------------------------------------------------------------------ faults


def test_faults_have_a_size_where_there_is_one() -> None:
    read = one_of(DRIVE_FAULTS)
    assert read("range-bias=-0.2@3:1") == Fault("range-bias", 3.0, 1.0, -0.2)
    assert str(read("range-bias=-0.2@3:1")) == "range-bias=-0.2@3:1"
    for text, words in (
        ("kidnapped=1@3", "no size"),
        ("range-bias=x@3", "KIND"),
        ("range-bias=inf@3", "KIND"),
        ("actuator-lag=-1@3", "zero"),
    ):
        with pytest.raises(argparse.ArgumentTypeError, match=words):
            read(text)
    faults = DriveFaults([Fault("odometry-slip", 1.0, 1.0), Fault("odometry-slip", 5.0, size=2.0)], 0)
    assert [faults.size("odometry-slip", time) for time in (0.0, 1.5, 3.0, 6.0)] == [None, 1.6, None, 2.0]
    assert set(SIZES) <= {*DRIVE_FAULTS, *FLIGHT_FAULTS}


def test_faults_of_wheels_and_motors_do_as_they_say() -> None:
    faults = DriveFaults([Fault("wheel-scale", 1.0), Fault("actuator-stuck", 1.0)], 0)
    asked = np.array([1.0, 0.5])
    np.testing.assert_array_equal(faults.odometry(asked, 0.9), asked)
    np.testing.assert_allclose(faults.odometry(asked, 1.0), 1.3 * asked)
    dead = (
        DriveFaults([Fault("wheel-scale", 1.0, size=0.0)], 0),
        DriveFaults([Fault("odometry-slip", 1.0, size=0.0)], 0),
    )
    assert [each.odometry(asked, 1.0).tolist() for each in dead] == [[0.0, 0.0], [0.0, 0.5]], "zero is a size, too"
    np.testing.assert_array_equal(faults.control(asked, 0.9, DT), asked)
    np.testing.assert_array_equal(faults.control(np.zeros(2), 1.0, DT), asked)


def test_a_lidar_that_is_turned_reports_directions_of_its_own() -> None:
    scan = World(maps.building()[0], PLACE, rng=np.random.default_rng(0), lidar=LidarModel(dropout=0.0)).scan()
    turned = spoiled(scan, "lidar-turned", 2.0 * scan.spacing)
    assert turned.ranges[10] == scan.ranges[12]
    narrow = replace(scan, angles=scan.angles[90:270], ranges=scan.ranges[90:270])
    for by in (3, -3):
        found = spoiled(narrow, "lidar-turned", by * scan.spacing).ranges
        there = np.arange(180) + by
        outside = (there < 0) | (there >= 180)
        assert np.isnan(found[outside]).all() and outside.sum() == 3
        np.testing.assert_array_equal(found[~outside], narrow.ranges[there[~outside]])


@functools.cache
def faulty(fault: str, seed: int = 0, coupling: str = "sequential", plant: str = "light") -> EpisodeLog:
    """Five seconds of a drive; no fault for ""."""
    faults = (one_of(DRIVE_FAULTS)(fault),) if fault else ()
    settings = replace(CORRIDOR, seed=seed, coupling=coupling, plant=plant, faults=faults)
    return Episode(settings).run(maps.stop_after(50))


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("lidar-turned@2", TURNED), ("lidar-turned=-0.12@2", TURNED), ("range-bias@2", BIASED),
        ("range-bias=-0.3@2", BIASED), ("range-bias=0.1@2", BIASED), ("wheel-scale@2", JUMPED),
        ("wheel-scale=0.75@2", JUMPED),
    ],
)  # fmt: skip
@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.product(1)
def test_a_jump_of_calibration_is_named_within_half_a_second(fault: str, cause: str, coupling: str) -> None:
    log = faulty(fault, coupling=coupling)
    named = [time for time, word in zip(log.time, log.cause, strict=True) if word == cause]
    assert 2.0 <= named[0] <= 2.5 + 1e-9 and log.collisions == 0
    error = SE2.local(log.estimate[log.time > 2.5], log.true_pose[log.time > 2.5])
    assert np.abs(error).max() < 0.1, "it knows where it is all the same"
    assert log.control[log.time > 3.5, 0].max() < 1.0


@pytest.mark.parametrize("plant", ["light", "harsh"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.product(1)
def test_drives_without_a_fault_name_none(seed: int, plant: str) -> None:
    log = faulty("", seed, plant=plant)
    assert {cause for cause in log.cause if cause} <= {"the motors follow late"}
    assert not log.power_off.any() and episode_metrics(log)["power_off_s"] is None


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.product(2, of="drives and flights")
def test_a_robot_whose_motors_are_stuck_has_its_power_cut(seed: int) -> None:
    settings = replace(CORRIDOR, seed=seed, faults=(Fault("actuator-stuck", 2.0),))
    log = Episode(settings).run(maps.stop_after(50))
    asked = log.control[:-1][log.power_off[1:]]
    told = np.abs(log.control[20:] - log.control[19]).max(axis=1) > 0.1  # it would do something else
    cut = episode_metrics(log)["power_off_s"]
    assert log.collisions == 0 and cut - log.time[20:][told][0] <= 1.2 and DISOBEYED in log.cause
    assert np.hypot(*np.diff(log.true_pose[-3:, :2], axis=0)[-1]) < 1e-6 and len(asked), "at rest"


# ---------------------------------------------------------------------- quadrotor


def carried(missing: list[float], height: float = 1.5) -> Unmodelled:
    """A vehicle that hovers while shares of the thrust that is expected are missing, one a tick."""
    found = Unmodelled(np.full(7, 0.01))
    state = np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    belief = SimpleNamespace(
        state=state, parameters_sigma=np.full(7, 0.01),
        parameters=SimpleNamespace(wind=(0.0, 0.0), updraft=0.0, mass=1.0, drag=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    for share in missing:
        expected = float(found.expected(np.array([0.0, 0.0, 0.0, 10.0]))[3])
        found.note(np.array([0.0, 0.0, 10.0 * (1.0 - share)]), expected, belief)  # type: ignore[arg-type]
    return found


def test_a_thrust_that_is_missing_is_asked_for() -> None:
    found = carried([0.3] * 3)
    assert found.thrust_yield == pytest.approx(0.7) and found.missing == pytest.approx(0.3)
    assert carried([0.3] * 2).thrust_yield == 1.0 and carried([0.02] * 9).thrust_yield == 1.0
    control = np.array([0.1, 0.2, 0.3, 9.0])
    np.testing.assert_allclose(found.expected(found.asked(control, 20.0)), control)
    assert found.asked(control, 10.0)[3] == 10.0 and found.asked(control, 10.0)[0] == 0.1
    assert carried([0.3] * 6).missing == 0.0 and carried([0.3] * 3 + [0.0] * 3).thrust_yield == 1.0
    slowly = carried([0.3] * 3 + [0.33] * 30).thrust_yield
    assert 0.67 <= slowly < 0.69, "it follows what is too little to jump"
    assert carried([0.3] * 3, height=0.2).thrust_yield == 1.0, "the floor may carry it"
    assert carried([0.9] * 30).thrust_yield >= 0.5


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.product(2, of="drives and flights")
def test_a_vehicle_that_is_loaded_in_flight_flies_on(seed: int) -> None:
    log = run_flight(FlightSettings(seed=seed, time_limit=5.0, faults=(Fault("payload", 3.0),)))
    named = [time for time, cause in zip(log.time, log.causes, strict=True) if cause]
    assert 3.0 <= named[0] <= 3.5 and set(filter(None, log.causes)) == {"the thrust is not what is asked for"}
    assert log.collisions == 0 and log.truth[:, 2].min() > 1.2 and log.truth[-1, 2] == pytest.approx(1.5, abs=0.1)
    assert log.controls[-1, 3] == pytest.approx(1.4 * 9.81, rel=0.1)
