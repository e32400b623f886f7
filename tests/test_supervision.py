"""Reactions of robots to trouble: invalid samples, signals that get worse, faults in a drive."""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maps
from unifg.models import quadrotor
from unifg.models.footprint import Body
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.ground.drive_signals import RAMPS, DriveSignals
from unifg.scenarios.ground.emergency_stop import EmergencyStop
from unifg.scenarios.ground.motor_lag import MotorLag
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.scenarios.monitoring.supervisor import RISE, STEADY, Health, Ramp, Supervisor
from unifg.scenarios.monitoring.validation import Validator
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.belief import Belief, Landmarks
from unifg.scenarios.perception.line_tracker import LineTracker
from unifg.scenarios.perception.readings import Reading, Scan
from unifg.scenarios.quadrotor.flight_watch import FlightWatch
from unifg.scenarios.quadrotor.unmodelled import Unmodelled
from unifg.scenarios.scenes.flight_plot import control, estimates
from unifg.scenarios.scenes.flight_scene import flight_scene
from unifg.scenarios.simulation.air import QuadrotorWorld
from unifg.scenarios.simulation.drivetrain import Drivetrain, Wheels
from unifg.scenarios.simulation.faults import DRIVE_FAULTS, FLIGHT_FAULTS, Fault, one_of
from unifg.scenarios.simulation.layouts import corridor
from unifg.scenarios.simulation.plane import LidarModel
from unifg.typing import Array

BEAMS = 360
ANGLES = -np.pi + 2.0 * np.pi * np.arange(BEAMS) / BEAMS
DT = 0.1
MOST = np.array([0.25, 0.32])  # changes of the velocities in a tick [m/s, rad/s]
SPREAD = np.array([0.08, 0.1, 0.1, 0.1, 0.5, 0.5, 0.3])  # of parameters that nobody estimates


def scan(ranges: Any = 3.0, time: float = 1.0, seed: int = 0) -> Scan:
    """A scan of a round room, or of the ranges given."""
    noise = 0.01 * np.random.default_rng(seed).standard_normal(BEAMS)
    return Scan(ANGLES, np.broadcast_to(np.asarray(ranges, dtype=np.float64), (BEAMS,)) + noise, time)


# ---------------------------------------------------------------------- the validator


@pytest.mark.parametrize(
    ("sample", "wrong"),
    [
        (None, "no scan came"),
        (scan(np.nan), "no beam came back (not numbers)"),
        (scan(np.inf), "no beam came back (out of range)"),
        (scan(12.0), "no beam came back (out of range)"),
        (scan(-3.0), "beams shorter than can be"),
        (Scan(ANGLES, np.zeros(BEAMS), 1.0), "beams shorter than can be"),
        (Scan(ANGLES[:-1], np.full(BEAMS - 1, 3.0), 1.0), "not the size of a scan"),
        (Scan(ANGLES, np.full((BEAMS, 1), 3.0), 1.0), "not the size of a scan"),
        (Scan(np.full(BEAMS, np.nan), np.full(BEAMS, 3.0), 1.0), "not the size of a scan"),
        (Scan(ANGLES, "three metres", 1.0), "not the size of a scan"),  # type: ignore[arg-type]
        (scan(time=0.7), "too old"),
        (scan(time=1.5), "from the future"),
        (scan(np.where(np.arange(BEAMS) < 19, 3.0, np.nan)), "no beam came back (not numbers)"),
    ],
)
def test_scans_that_are_none_stay_outside(sample: Scan | None, wrong: str) -> None:
    validator = Validator(BEAMS)
    assert validator.scan(sample, 1.0) is None
    assert validator.refused["lidar"] == wrong
    assert dict(validator.dropped) == {f"lidar: {wrong}": 1}
    assert validator.scan(scan(time=1.1), 1.1) is not None
    assert "lidar" not in validator.refused


def test_a_scan_with_some_bad_beams_comes_in_without_them() -> None:
    ranges = np.where(np.arange(BEAMS) % 2 == 0, 3.0, np.where(np.arange(BEAMS) % 3 == 0, -np.inf, -1.0))
    found = Validator(BEAMS).scan(Scan(ANGLES, ranges), 1.0)
    assert found is not None
    assert np.isnan(found.ranges[1::2]).all() and (found.ranges[::2] == 3.0).all()
    assert np.isinf(ranges).any(), "what was given is left alone"
    far = np.where(np.arange(BEAMS) < 300, np.inf, 3.0)
    found = Validator(BEAMS).scan(Scan(ANGLES, far, 1.0), 1.0)
    assert found is not None and np.isinf(found.ranges[:300]).all(), "nothing within range is a measurement"


def test_what_is_as_far_as_the_lidar_sees_is_no_measurement() -> None:
    for reach, ranges, lets_in in ((8.0, 8.1, False), (8.0, 7.8, True), (12.0, 8.1, True)):
        assert (Validator(BEAMS, reach).scan(scan(ranges), 1.0) is not None) is lets_in
    pilot = Episode(replace(SHORT, lidar=LidarModel(range_max=4.0)), rehearsal=True).pilot
    assert pilot.validator.scan(scan(4.1), 1.0) is None
    assert pilot.validator.refused["lidar"] == "no beam came back (out of range)"


def test_a_scan_once_more_is_none_only_for_a_robot_that_has_moved() -> None:
    validator, still = Validator(BEAMS), scan(3.0)
    assert validator.scan(still, 1.0) is not None
    validator.odometry(np.zeros(2), np.zeros(2), DT)
    assert validator.scan(replace(still, time=1.1), 1.1) is not None
    validator.odometry(np.array([0.2, 0.0]), np.zeros(2), DT)
    assert validator.scan(replace(still, time=1.2), 1.2) is None
    assert validator.refused["lidar"] == "the last one once more"
    assert validator.scan(scan(3.0, 1.3, seed=1), 1.3) is not None
    assert validator.scan(scan(3.0, 1.3, seed=2), 1.4) is None, "its stamp says that it is not newer"


@pytest.mark.parametrize(
    ("measured", "wrong"),
    [
        (None, "none came"),
        (np.array([np.nan, 0.0]), "not finite"),
        (np.array([0.0, np.inf]), "not finite"),
        (np.array([1e9, 0.0]), "faster than any wheel"),
        (np.zeros(3), "not 2 numbers"),
        ("fast", "not 2 numbers"),
    ],
)
def test_without_odometry_what_was_asked_for_stands_for_it(measured: Any, wrong: str) -> None:
    validator, asked = Validator(), np.array([0.5, -0.1])
    assert np.array_equal(validator.odometry(measured, asked, DT), asked)
    assert validator.refused["wheels"] == wrong
    assert np.array_equal(validator.odometry(np.array([0.4, 0.0]), asked, DT), [0.4, 0.0])
    assert validator.dropped.total() == 1


def reading(**changed: Any) -> Reading:
    """Two cylinders and a corner."""
    whole = Reading(
        time=1.0, ids=np.array([0, 1, 7]), bearings=np.array([0.1, -0.2, 1.0]), ranges=np.array([2.0, 3.0, 4.0]),
        radii=np.array([0.3, 0.3, 0.0]), kinds=np.array([0, 0, 1]), moving=np.zeros(3, dtype=bool), height=1.5,
        tilt=np.array([0.0, 0.0, 1.0]), rates=np.zeros(3), force=np.array([0.0, 0.0, 9.81]),
    )  # fmt: skip
    return replace(whole, **changed)


def test_a_reading_loses_what_cannot_be_and_keeps_the_rest() -> None:
    asked = np.array([0.1, 0.2, 0.3, 9.0])
    validator = Validator()
    whole = validator.reading(reading(), 1.0, asked)
    assert np.array_equal(whole.ids, [0, 1, 7]) and not validator.refused
    bad = validator.reading(reading(ranges=np.array([2.0, np.nan, 4.0])), 1.0, asked)
    assert np.array_equal(bad.ids, [0, 7]) and validator.refused == {"detector": "sightings that cannot be"}
    short = validator.reading(reading(bearings=np.zeros(2)), 1.0, asked)
    assert len(short.ids) == 0 and validator.refused == {"detector": "columns of several lengths"}
    blind = validator.reading(reading(rates=np.array([0.0, np.nan, 0.0])), 1.0, asked)
    assert np.array_equal(blind.rates, asked[:3]) and np.isnan(blind.force).all()
    assert list(validator.refused) == ["inertial unit"]
    nothing = validator.reading(None, 2.0, asked)
    assert nothing.time == 2.0 and len(nothing.ids) == 0 and np.array_equal(nothing.rates, asked[:3])
    stuck = validator.reading(reading(time=math.nan, height="high"), 3.0, asked)
    assert stuck.time == 3.0 and math.isnan(stuck.height)


# ---------------------------------------------------------------- the supervisor


def test_speed_falls_with_a_signal_and_comes_back_slowly() -> None:
    supervisor = Supervisor({"age": Ramp("no scan", 0.1, 0.3, lost=1.0), "slip": Ramp("slips", 0.2, 0.4, least=0.5)})
    assert supervisor.judge({"age": 0.1, "slip": 0.1}).health is Health.OK
    slow = supervisor.judge({"age": 0.2, "slip": 0.25})
    assert slow.health is Health.DEGRADED and slow.share == pytest.approx(0.5) and slow.cause == "no scan"
    rest = supervisor.judge({"age": 0.3, "slip": 0.0}, {"age": "not finite"})
    assert rest.rests and rest.cause == "no scan: not finite"
    assert supervisor.judge({"age": 0.0, "slip": 9.0}).share == pytest.approx(RISE), "it comes back step by step"
    shares = [supervisor.judge({"age": 0.0, "slip": 9.0}).share for _ in range(10)]
    assert shares[-1] == 0.5 and supervisor.verdict.cause == "slips"
    supervisor.judge({"age": math.nan, "slip": 0.0})
    assert supervisor.verdict.rests, "what is no number is the worst"


def test_a_lost_robot_rests_until_all_has_been_well_for_a_while() -> None:
    supervisor = Supervisor({"age": Ramp("no scan", 0.1, 0.3, lost=1.0)})
    assert supervisor.judge({"age": 1.0}).health is Health.DEGRADED, "once may be chance"
    assert supervisor.judge({"age": 1.1}).health is Health.LOST
    for _ in range(STEADY - 1):
        verdict = supervisor.judge({"age": 0.0})
        assert verdict.health is Health.LOST and verdict.rests and verdict.cause == "no scan"
    assert supervisor.judge({"age": 0.0}).health is Health.DEGRADED
    for _ in range(10):
        supervisor.judge({"age": 0.0})
    assert supervisor.verdict.health is Health.OK and supervisor.verdict.cause == ""


def test_a_robot_that_was_lost_goes_on_though_something_else_slows_it_down() -> None:
    supervisor = Supervisor({"age": Ramp("no scan", 0.1, 0.3, lost=1.0), "slip": Ramp("slips", 0.2, 0.4, least=0.5)})
    lost = [supervisor.judge({"age": 1.0, "slip": 9.0}) for _ in range(2)][-1]
    found = [supervisor.judge({"age": 0.0, "slip": 9.0}) for _ in range(STEADY)][-1]
    assert lost.health is Health.LOST and found.health is Health.DEGRADED
    assert found.share == RISE and found.cause == "slips"


def note(signals: DriveSignals, asked: Array, did: Array, wheels: Array, pose: Array, corrected: bool = True) -> Array:
    """A tick in which the robot ``did`` something; the pose it leads to."""
    heading = np.array([math.cos(pose[2]), math.sin(pose[2])])
    after, predicted = (pose + DT * np.array([*v * heading, omega]) for v, omega in (did, wheels))
    signals.note(
        corrected=corrected, share=1.0, predicted=predicted, pose=after, covariance=1e-4 * np.eye(3), wheels=wheels,
        trusted=True, asked=asked,
    )  # fmt: skip
    return after


def test_wheels_that_slip_are_told_from_wheels_that_do_not_obey() -> None:
    asked = np.array([1.0, 0.0])
    slipping, dead, late = (DriveSignals(DT, MOST) for _ in range(3))
    here = there = elsewhere = np.array([2.0, 1.0, 0.5])
    commands = [np.array([min(1.0, 0.25 * k), 0.0]) for k in range(12)]
    for k in range(8):
        driven = commands[max(0, k - 1)]
        here = note(slipping, commands[k], driven, 1.6 * driven, here)
        there = note(dead, asked, np.array([0.5, -3.3]), np.array([0.5, -3.3]), there)
        behind = commands[max(0, k - 2)]
        elsewhere = note(late, commands[k], behind, behind, elsewhere)
    assert slipping.values()["slip"] == pytest.approx(0.375) and slipping.values()["wheels"] < 1e-9
    assert dead.values()["wheels"] > RAMPS["wheels"].ends and dead.values()["slip"] < 1e-9
    assert late.values()["wheels"] < RAMPS["wheels"].begins, "a base that follows late obeys"


def test_wheels_that_did_not_obey_are_given_time_twice_as_long_every_time() -> None:
    signals, pose = DriveSignals(DT, MOST), np.zeros(3)
    stopped = np.zeros(2)
    waits = []
    for _ in range(2):
        while signals.values()["wheels"] < RAMPS["wheels"].ends:
            pose = note(signals, np.array([1.0, 0.0]), stopped, stopped, pose)
        count = 0
        while signals.values()["wheels"] >= RAMPS["wheels"].ends:
            pose = note(signals, stopped, stopped, stopped, pose)
            count += 1
        waits.append(count)
    assert waits[1] == pytest.approx(2 * waits[0], abs=2) and waits[0] * DT == pytest.approx(2.0, abs=0.3)


def following(lag: float, asked: Array, scale: float = 1.0) -> MotorLag:
    """Motors that were asked for velocities (n, 2), and wheels that follow with a lag [s] and are noisy."""
    motors, wheels = MotorLag(DT, MOST), Wheels(Drivetrain(lag=lag))
    noise = 0.02 * np.random.default_rng(1).standard_normal(asked.shape)
    for told, wrong in zip(asked, noise, strict=True):
        wheels.tell((float(told[0]), float(told[1])))
        motors.note(told, np.array(wheels.advance(DT)) * (scale + wrong))
    return motors


def test_motors_that_follow_late_are_named_and_wheels_of_the_wrong_size_are_not() -> None:
    start = np.column_stack([np.minimum(1.0, 0.25 * np.arange(1, 13)), np.zeros(12)])
    turns = np.column_stack([np.full(60, 0.8), 0.8 * np.sin(0.4 * np.arange(60))])
    for asked in (start, turns):
        assert following(0.0, asked).seconds == 0.0
        for scale in (0.9, 1.1):
            assert following(0.0, asked, scale).seconds == 0.0 and following(0.0, asked, scale)._evidence.max() < 4.0
    assert following(0.3, start).seconds == pytest.approx(0.3, abs=0.1)
    assert following(0.3, turns).seconds == pytest.approx(0.3, abs=0.1)
    steady = following(0.3, np.tile([1.0, 0.0], (20, 1)))
    assert steady.seconds > 0.0, "the start told it"
    for _ in range(120):
        steady.note(np.array([1.0, 0.0]), np.array([1.0, 0.0]))
    assert steady.seconds == 0.0, "what nothing confirms is forgotten"
    for _ in range(3):
        steady.note(np.array([0.0, 0.0]), None)
    assert steady.seconds == 0.0, "wheels that say nothing accuse nobody"


def test_ticks_without_numbers_say_nothing_of_the_motors() -> None:
    start = np.column_stack([np.minimum(1.0, 0.25 * np.arange(1, 13)), np.zeros(12)])
    motors = following(0.3, start)
    named = motors.seconds
    motors.note(np.array([np.nan, 0.0]), np.zeros(2))
    assert motors.seconds == named > 0.0


# ----------------------------------------------------------------- the last stop

STOP = EmergencyStop(Body.disc(0.17), (2.5, 3.2), DT)


def ahead(distance: float, half: float = 0.15, base: float = 5.0) -> Scan:
    """A scan with something ``distance`` ahead, ``half`` [rad] wide to both sides, in a wide room."""
    return scan(np.where(np.abs(ANGLES) < half, distance, base))


def test_a_control_is_driven_only_as_fast_as_beams_leave_room_to_brake() -> None:
    fast = np.array([1.0, 0.0])
    assert STOP.control(fast, fast, ahead(0.6)) is fast
    assert STOP.control(fast, np.zeros(2), ahead(0.25))[0] <= 0.5
    braking = STOP.control(fast, fast, ahead(0.3))
    assert braking[0] == pytest.approx(0.75), "no harder than braking goes"
    assert STOP.control(-fast, -fast, ahead(0.3)) is not None
    assert np.array_equal(STOP.control(-fast, -fast, ahead(0.3)), -fast), "it is in front, not behind"
    turn = STOP.control(np.array([0.1, 1.0]), np.zeros(2), ahead(0.16, half=0.5))
    assert turn[0] == 0.0 and turn[1] == 1.0, "turning on the spot touches nothing"


def test_an_arc_past_something_is_free_and_one_into_it_is_not() -> None:
    aside = scan(np.where(np.abs(ANGLES - 0.9) < 0.2, 0.3, 5.0))
    left, right = np.array([0.8, 2.5]), np.array([0.8, -2.5])
    assert STOP.is_free(right, aside) and not STOP.is_free(left, aside)


def test_single_beams_stop_nobody_and_lost_ones_do() -> None:
    fast = np.array([1.0, 0.0])
    ranges = np.full(BEAMS, 5.0)
    ranges[180] = 0.2
    assert STOP.is_free(fast, scan(ranges))
    ranges[179:182] = 0.2
    assert not STOP.is_free(fast, scan(ranges))
    blind = np.where(np.abs(ANGLES) < 0.6, np.nan, 5.0)
    assert not STOP.is_free(fast, scan(blind)) and STOP.is_free(-fast, scan(blind))
    assert STOP.is_free(fast, scan(np.where(np.abs(ANGLES) < 0.6, np.inf, 5.0))), "nothing within range is free"


# ------------------------------------------------------------------------ faults


def test_faults_are_read_and_refused_by_name() -> None:
    read = one_of(DRIVE_FAULTS)
    assert read("lidar-nan@5") == Fault("lidar-nan", 5.0) and str(read("kidnapped@1.5:2")) == "kidnapped@1.5:2"
    assert not read("lidar-nan@5:1").holds(6.0) and read("lidar-nan@5:1").holds(5.9)
    for text in ("lidar-nan", "lidar-nan@", "lidar-nan@x", "lidar-nan@-1", "lidar-nan@1:0", "lidar-nan@nan", "gust@1"):
        with pytest.raises(argparse.ArgumentTypeError):
            read(text)


def test_a_lidar_that_sees_nothing_says_its_own_range() -> None:
    settings = NavigationSettings(lidar=LidarModel(range_max=5.0), faults=(Fault("lidar-max", 0.0),))
    episode = Episode(settings)
    found = episode.faults.scan(episode.world.scan(), 0.0)
    assert found is not None and (found.ranges == 5.0).all()


SHORT = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),), obstacles=1)


@functools.cache
def faulty(fault: str, coupling: str = "sequential", ticks: int = 50) -> EpisodeLog:
    """Some seconds with a fault from second 1."""
    settings = replace(SHORT, coupling=coupling, faults=(one_of(DRIVE_FAULTS)(fault),))
    return Episode(settings).run(maps.stop_after(ticks))


@pytest.mark.parametrize("kind", ["lidar-max", "lidar-frozen", "lidar-delayed", "beams-missing"])
@pytest.mark.product(1)
def test_a_blind_robot_brakes_at_once_and_says_why(kind: str) -> None:
    log = faulty(f"{kind}@1", ticks=26)
    last_good = 9  # the tick at 0.9 s
    speed = log.control[:, 0]
    assert speed[last_good] > 0.6
    assert (np.diff(speed[last_good + 2 : last_good + 5]) < 0.0).all() and speed[last_good + 2] < speed[last_good + 1]
    assert not speed[last_good + 2 + 4 :].any(), "at rest within v / a"
    assert log.collisions == 0
    assert log.health[last_good + 2] == "degraded" and log.health[-1] == "lost"
    assert log.cause[-1].startswith("no scan says where it is: ")
    m = episode_metrics(log)
    assert m["health"]["lost"] == 5 and sum(m["dropped_samples"].values()) == 16


@pytest.mark.product(2, of="drives and flights")
def test_a_robot_that_sees_again_goes_on() -> None:
    log = faulty("lidar-nan@1:1.5")
    assert log.health[25] == "lost" and log.health[-1] == "ok" and log.control[-1, 0] > 0.9
    assert log.collisions == 0


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.product(1)
def test_a_robot_without_odometry_goes_on_slowly(coupling: str) -> None:
    log = faulty("odometry-nan@1", coupling)
    assert log.health[-1] == "degraded" and log.cause[-1] == "no odometry: not finite"
    assert 0.1 < log.control[-1, 0] < 0.6 and np.isfinite(log.estimate).all()
    assert np.abs(log.estimate - log.true_pose).max() < 0.15


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.product(2, of="drives and flights")
def test_a_kidnapped_robot_stops_and_finds_itself(coupling: str) -> None:
    log = faulty("kidnapped@1", coupling, 60)
    assert np.hypot(*(log.true_pose[10] - log.true_pose[9])[:2]) > 3.0
    assert "lost" in log.health and log.control[10:14, 0].max() < 1.0 and log.collisions == 0
    assert np.hypot(*(log.estimate[-1] - log.true_pose[-1])[:2]) < 0.05
    assert any(cause == "the scan does not fit the map" for cause in log.cause)


@pytest.mark.product(2, of="drives and flights")
def test_a_robot_with_the_wrong_map_rests_and_says_so() -> None:
    log = faulty("wrong-map@1")
    assert log.health[-1] == "lost" and log.cause[-1] == "the scan does not fit the map"
    assert not log.control[20:].any() and log.collisions == 0


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("odometry-slip@1", "the wheels slip"),
        ("wheel-dead@1", "the robot does not do what it is told"),
        ("solver-timeout@1", "no plan"),
    ],
)
@pytest.mark.product(2, of="drives and flights")
def test_other_faults_are_named_too(fault: str, cause: str) -> None:
    log = faulty(fault)
    assert cause in log.cause and log.collisions == 0
    assert log.control[-1, 0] < 0.8


def test_a_tick_that_fails_stops_the_robot_and_not_the_record(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = Episode(SHORT)
    monkeypatch.setattr(episode.pilot.tracker, "update", lambda *_: np.linalg.inv(np.zeros((2, 2))))
    log = episode.run(maps.stop_after(10))
    assert log.ticks == 10 and not log.control.any()
    assert log.cause[-1] == "the tick failed: Singular matrix" and log.health[-1] == "degraded"


# ------------------------------------------------------------------- the quadrotor


HOVERED = np.array([0.0, 0.0, 0.0, 9.81])  # control


def believed(spread: float = 1e-4) -> Belief:
    """A vehicle that flies at 1 m/s, 1.5 m above the floor."""
    state = np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    return Belief(state, spread * np.eye(9), quadrotor.Parameters(), np.zeros(7), Landmarks.none())


def looked(watch: FlightWatch, readings: Iterable[Reading | None], belief: Belief, begin: int = 0) -> None:
    """Ticks of a vehicle that hovers and takes the sensor's names for its own."""
    for tick, seen in enumerate(readings, start=begin):
        watch.judge(watch.admit(seen, 0.05 * tick, HOVERED, belief), belief)


def test_a_vehicle_that_sees_nothing_stops_in_time_and_lands_after_a_while() -> None:
    watch, dt = FlightWatch(0.05, SPREAD), 0.05
    looked(watch, [reading()] * 10, believed())
    assert watch.verdict.cause == ""
    blind = reading(ids=np.zeros(0, int), bearings=np.zeros(0), ranges=np.zeros(0), radii=np.zeros(0),
                    kinds=np.zeros(0, int), moving=np.zeros(0, bool))  # fmt: skip
    rested = landed = 0.0
    for tick in range(1, 200):
        looked(watch, [blind], believed(), 10 + tick)
        rested = rested or (tick * dt if watch.verdict.rests else 0.0)
        landed = landed or (tick * dt if watch.lands else 0.0)
    assert rested == pytest.approx(0.2) and watch.verdict.health is Health.LOST
    assert watch.verdict.cause == "nothing is seen"
    assert 1.5 < landed < 2.5
    least, most = np.array([-4.0, -4.0, -2.0, 2.0]), np.array([4.0, 4.0, 2.0, 20.0])
    still = replace(believed(), state=np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert watch.hover(still, least, most)[3] < 9.81, "it sinks"
    assert FlightWatch(dt, SPREAD).hover(still, least, most)[3] == pytest.approx(9.81)


@pytest.mark.parametrize(
    ("changed", "cause"),
    [
        ({"ids": np.array([0, 1, 7]) + 100}, ""),
        ({"rates": np.full(3, np.nan)}, "no inertial unit"),
        ({"ranges": np.full(3, np.inf)}, "nothing is seen: sightings that cannot be"),
    ],
)
def test_readings_say_what_is_the_matter(changed: dict[str, Any], cause: str) -> None:
    watch = FlightWatch(0.05, SPREAD)
    looked(watch, [reading(), *[reading(**changed)] * 19], believed())
    assert watch.verdict.cause == cause


def test_a_detector_that_sees_ghosts_is_not_followed() -> None:
    watch = FlightWatch(0.05, SPREAD)
    looked(watch, [reading(ids=np.array([0, 1, 50 + 10 * tick]) + tick) for tick in range(8)], believed())
    assert watch.verdict.rests and watch.verdict.cause == "the detector sees what was not there before"
    lost = FlightWatch(0.05, SPREAD)
    looked(lost, [reading()] * 3, believed(4.0))
    assert lost.verdict.health is Health.LOST and "decimetres" in lost.verdict.cause
    looked(lost, [None], believed(math.nan), 4)
    assert lost.verdict.rests and lost.validator.dropped["detector: nothing came"] == 1


def test_the_watch_counts_what_the_vehicle_recognises_and_not_what_the_world_calls_it() -> None:
    """Names under unknown association are those of own tracks; a landmark without a track does not count as new."""
    watch, pilot = FlightWatch(0.05, SPREAD), LineTracker(association="unknown")
    for tick in range(12):  # the world's names change at every tick, the places do not
        seen = watch.admit(reading(ids=np.arange(3) + 100 * tick), 0.05 * tick, HOVERED, believed())
        watch.judge(pilot.told(seen, believed().state), believed())
    assert watch.verdict.cause == "" and watch.verdict.share == 1.0
    for tick in range(12, 20):  # the same names, places that jump
        seen = reading(
            ids=np.arange(3), kinds=np.full(3, Landmarks.CYLINDER), ranges=np.full(3, 1.0 + 0.9 * (tick % 5))
        )
        watch.judge(pilot.told(watch.admit(seen, 0.05 * tick, HOVERED, believed()), believed().state), believed())
    assert watch.verdict.cause == "the detector sees what was not there before"
    flagged = FlightWatch(0.05, SPREAD)
    for tick in range(20):  # all is called moving by the world, and rests by what the vehicle finds
        seen = flagged.admit(reading(moving=np.ones(3, dtype=bool)), 0.05 * tick, HOVERED, believed())
        flagged.judge(pilot.told(seen, believed().state), believed())
    assert flagged.verdict.cause == ""
    for _ in range(4):
        flagged.judge(None, believed())
    assert flagged.verdict.cause == "nothing is seen"


def felt(force: Array, thrust: float = 9.81, count: int = 3, **changed: Any) -> Unmodelled:
    """Forces (3,) beyond those of a vehicle at rest, felt for some ticks."""
    found = Unmodelled(SPREAD)
    belief = replace(believed(), parameters_sigma=np.full(7, 0.01), **changed)
    at_rest = replace(belief, state=np.concatenate([belief.state[:7], np.zeros(3)]))
    for _ in range(count):
        found.note(np.array([0.0, 0.0, thrust]) + force, thrust, at_rest)
    return found


def test_what_pushes_is_told_from_what_is_missing() -> None:
    usual = felt(np.array([0.2, -0.1, 0.2]))
    assert not usual.push.any() and usual.missing == 0.0 and 0.5 < usual.score < 3.0
    gust = felt(np.array([0.0, 4.0, 0.3]))
    assert gust.push == pytest.approx([0.0, 4.0], abs=1e-9) and gust.missing == 0.0
    assert not felt(np.array([0.0, 4.0, 0.0]), count=2).push.any(), "two ticks may be chance"
    weak = felt(np.array([0.1, 0.0, -0.981]))
    assert weak.missing == pytest.approx(0.1) and not weak.push.any()
    unsure = felt(np.array([0.0, 0.0, -0.981]), parameters=quadrotor.Parameters())
    assert unsure.missing > 0.0
    blank = Unmodelled(SPREAD)
    for _ in range(3):
        blank.note(np.array([0.0, 0.0, 8.9]), 9.81, believed())
    assert blank.missing == 0.0, "a mass that is known to eight per cent explains it"
    blank.note(np.full(3, np.nan), 9.81, believed())
    assert blank.score == 0.0
    turned = np.array([0.0, 0.0, 1.5, math.cos(0.5), 0.0, 0.0, math.sin(0.5), 0.0, 0.0, 0.0])
    eastern = felt(np.array([4.0 * math.cos(1.0), -4.0 * math.sin(1.0), 0.0]), state=turned)
    assert eastern.push == pytest.approx([4.0, 0.0], abs=1e-9), "in the world, not in the body"


def test_what_pushes_is_flown_against_at_once() -> None:
    watch, least, most = FlightWatch(0.05, SPREAD), np.array([-4.0, -4.0, -2.0, 2.0]), np.array([4.0, 4.0, 2.0, 20.0])
    belief = replace(believed(), parameters_sigma=np.full(7, 0.01))
    still = replace(belief, state=np.concatenate([belief.state[:7], np.zeros(3)]))
    assert watch.pushed(still) is still
    looked(watch, [reading(), *[reading(force=np.array([0.0, 4.0, 9.81]))] * 3], still)
    assert watch.verdict.cause == "a gust pushes" and watch.verdict.share < 1.0
    assert watch.pushed(still).parameters.wind == pytest.approx((0.0, 4.0), abs=0.01)
    assert watch.hover(still, least, most)[0] > 1.0, "it leans against it"


@pytest.mark.parametrize(("height", "lands"), [(1.5, False), (0.4, True)])
def test_a_landing_is_broken_off_when_all_is_well_again_but_not_near_the_floor(height: float, lands: bool) -> None:
    watch, here = FlightWatch(0.05, SPREAD), believed()
    here.state[2] = height
    looked(watch, [None] * 60, here)
    assert watch.lands
    looked(watch, [reading()] * 20, here, 60)
    assert watch.verdict.health is not Health.LOST and watch.lands is lands


@pytest.mark.product(2, of="drives and flights")
def test_a_flight_that_a_gust_carries_away_is_given_up() -> None:
    fault = one_of(FLIGHT_FAULTS)("gust=1e6@0.1")
    log = Flight(FlightSettings(faults=(fault,), time_limit=1.0)).run(lambda done, text: None)
    assert log.outcome == "given up far away from the target" and log.ticks <= 4
    assert np.isfinite(log.truth).all() and not log.reached
    estimates(log)


@pytest.mark.product(2, of="drives and flights")
def test_a_flight_without_its_detector_hovers_and_its_pictures_say_why(tmp_path: Path) -> None:
    fault = one_of(FLIGHT_FAULTS)("detector-lost@0.5")
    log = Flight(FlightSettings(faults=(fault,), time_limit=1.6)).run(lambda done, text: None)
    speed = np.linalg.norm(log.truth[:, 7:], axis=1)
    assert log.health[11] == "ok" and log.health[14] == "degraded" and log.collisions == 0
    assert speed[-1] < 0.5 * speed[:16].max() and log.outcome == "timed out: nothing is seen"
    assert flight_metrics(log)["causes"] == {"nothing is seen": log.causes.count("nothing is seen")}
    assert log.fault[9] == "" and log.fault[10:] == ["detector-lost"] * (log.ticks - 10)
    scene = flight_scene(log)
    assert scene.facts["health"].endswith("(nothing is seen)") and scene.outcome.endswith("timed out: nothing is seen")
    figure = control(log)
    assert any("nothing is seen" in ax.get_title("left") for part in figure.subfigs for ax in part.axes)
    log.save(path := tmp_path / "flight.npz")
    assert FlightLog.load(path).causes == log.causes


@pytest.mark.parametrize(("speed", "touched"), [(0.5, 0), (1.5, 1)])
def test_touching_the_floor_softly_is_a_landing(speed: float, touched: int) -> None:
    layout = corridor(0)
    start = np.concatenate([layout.start[:2], [0.05, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -speed]])
    world = QuadrotorWorld(layout, 0, start=start)
    world.step([0.0, 0.0, 0.0, quadrotor.GRAVITY], 0.2)
    assert world.state[2] < 0.01 and world.collisions == touched
