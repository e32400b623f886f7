"""Flights through the corridor: every coupling flies, variants of a seed are paired, a failing tick ends nothing."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from maps import stop_after
from unifg.errors import BackendError, ScenarioError
from unifg.horizon import Plan
from unifg.lie import SO3
from unifg.scenarios import command
from unifg.scenarios import flight as episode
from unifg.scenarios.commands import flights as results
from unifg.scenarios.commands.catalogue import SCENARIOS
from unifg.scenarios.episode import Progress, silent
from unifg.scenarios.flight import Flight, FlightSettings, run_flight
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics, state_errors
from unifg.scenarios.options import add_options, settings_of
from unifg.scenarios.perception.line_tracker import LineTracker
from unifg.scenarios.perception.readings import NOTHING, Reading
from unifg.scenarios.quadrotor import flight_watch
from unifg.scenarios.quadrotor.estimator import EstimatorSettings
from unifg.scenarios.quadrotor.flight_pilot import COUPLINGS
from unifg.scenarios.simulation.conditions import DRAG, MASS, WIND, draw_conditions
from unifg.scenarios.simulation.faults import Fault
from unifg.typing import Array

SEED = 1006  # of those open to tuning


def short(seconds: float = 1.0, **changes: object) -> FlightSettings:
    """A flight that ends early."""
    return replace(FlightSettings(seed=SEED, time_limit=seconds), **changes)  # type: ignore[arg-type]


# ------------------------------------------------------------------- flying


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.product(1)
def test_every_coupling_flies_and_knows_where_it_is(coupling: str) -> None:
    log = run_flight(short(1.5, coupling=coupling))
    assert (log.ticks, log.collisions, log.reached) == (30, 0, False)
    assert "failed" not in log.statuses
    assert not log.emergency.any()
    assert log.truth[-1, 0] > log.truth[0, 0] + 0.8
    assert np.abs(state_errors(log)[:, :3]).max() < 0.1
    assert log.settings["coupling"] == coupling
    assert (log.estimate_ms > 0.0).all()
    assert (log.plan_ms > 0.0).all()


@pytest.mark.parametrize("solver", ["sqp", "alm"])
@pytest.mark.product(1)
def test_every_backend_flies(solver: str) -> None:
    log = run_flight(short(1.0, solver=solver))
    assert log.collisions == 0
    assert log.truth[-1, 0] > log.truth[0, 0] + 0.3


@pytest.mark.product(2, of="drives and flights")
def test_a_flight_reaches_the_target_and_learns_the_mass() -> None:
    log = run_flight(FlightSettings(seed=SEED))
    assert log.succeeded
    assert log.target_distance[-1] < episode.REACHED_DISTANCE
    assert np.linalg.norm(log.believed[-1, :3] - log.layout.target) < episode.REACHED_DISTANCE
    assert np.linalg.norm(log.truth[-1, 7:]) < episode.REACHED_SPEED
    assert abs(log.parameters[0, 0] / log.parameters_true[0, 0] - 1.0) > 0.03
    error = flight_metrics(log)["mass_error_relative_5s"]
    assert error is not None
    assert error < 0.01
    # The cylinders were not known: each appears when it is seen.
    known = [len(row["id"]) for row in log.landmarks]
    assert known[0] < known[-1]
    for ids, row in zip(log.seen, log.landmarks, strict=True):
        assert set(ids.tolist()) <= set(row["id"].tolist())


@pytest.mark.parametrize("association", ["known", "unknown"])
@pytest.mark.product(1)
def test_walls_on_the_map_correct_the_heading_and_cylinders_do_not(association: str) -> None:
    headings = []
    for surveyed in (True, False):
        flight = Flight(short(1.0))
        estimator = type(flight.pilot.estimator)
        state = flight.pilot.estimator.window.present.copy()
        turn = SO3.exp(np.array([0.0, 0.0, 0.02]))
        state[3:7] = SO3.compose(turn, flight.world.state[3:7])
        settings = replace(flight.settings.estimator, association=association)
        corners = flight.world.layout.corners if surveyed else None
        flight.pilot.estimator = estimator(state, flight.conditions.nominal, settings, corners)
        log = flight.run(silent)
        headings.append(abs(state_errors(log)[-1, 5]))
        survey = flight.pilot.estimator.survey
        assert survey.known.any() == surveyed
        for place in survey.places[survey.known]:
            assert np.linalg.norm(flight.world.layout.corners - place, axis=1).min() == 0.0
    assert headings[0] < 0.005
    assert headings[1] > 0.01


@pytest.mark.product(2, of="drives and flights")
def test_the_separate_coupling_learns_no_parameters_and_the_others_do() -> None:
    logs = {coupling: run_flight(short(1.0, coupling=coupling)) for coupling in COUPLINGS}
    nominal = draw_conditions(SEED).nominal.packed
    np.testing.assert_array_equal(logs["separate"].parameters, np.tile(nominal, (20, 1)))
    for coupling in ("sequential", "joint"):
        assert abs(logs[coupling].parameters[-1, 0] - nominal[0]) > 0.02


# ------------------------------------------------------------------- pairing


def overheard(flight: Flight) -> tuple[list[Reading], list[Array]]:
    """Readings of a flight and the true states at which they were made."""
    readings: list[Reading] = []
    states: list[Array] = []
    sense = flight.world.sense

    def listen() -> Reading:
        states.append(flight.world.state)
        readings.append(sense())
        return readings[-1]

    flight.world.sense = listen  # type: ignore[method-assign]
    flight.run(silent)
    return readings, states


@pytest.mark.product(2, of="drives and flights")
def test_variants_of_a_seed_meet_the_same_world_and_noise() -> None:
    noise: list[Array] = []
    paths = []
    for coupling in ("separate", "sequential"):
        flight = Flight(short(1.0, coupling=coupling))
        readings, states = overheard(flight)
        height = np.array([r.height - x[2] for r, x in zip(readings, states, strict=True)])
        tilt = np.array([r.tilt - SO3.matrix(x[None, 3:7])[0, 2] for r, x in zip(readings, states, strict=True)])
        things = flight.world.things()
        thing = int(readings[0].ids[0])
        ranges = np.array(
            [
                r.ranges[r.ids == thing][0] - np.linalg.norm(things[thing, :2] - x[:2])
                for r, x in zip(readings, states, strict=True)
            ]
        )
        noise.append(np.column_stack([height, tilt, ranges]))
        paths.append(np.array(states))
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
    assert np.abs(paths[0][-1] - paths[1][-1]).max() > 1e-6  # they do fly differently


def test_a_flight_repeats_itself() -> None:
    first, second = run_flight(short(0.5)), run_flight(short(0.5))
    np.testing.assert_array_equal(first.truth, second.truth)
    np.testing.assert_array_equal(first.believed, second.believed)


@pytest.mark.product(2, of="drives and flights")
def test_conditions_depend_on_the_seed_alone() -> None:
    found = [draw_conditions(seed) for seed in range(1000, 1040)]
    again = draw_conditions(1000)
    np.testing.assert_array_equal(found[0].true.packed, again.true.packed)
    np.testing.assert_array_equal(found[0].deviation, again.deviation)
    masses = np.array([c.nominal.mass for c in found])
    np.testing.assert_allclose(np.abs(masses - MASS), 0.05)
    assert {masses.min() < MASS, masses.max() > MASS} == {True}
    truths = np.array([c.true.packed for c in found])
    assert (truths[:, 1:4] >= DRAG[0]).all()
    assert (truths[:, 1:4] <= DRAG[1]).all()
    wind = np.hypot(truths[:, 4], truths[:, 5])
    assert wind.max() <= WIND
    assert np.ptp(wind) > 0.5 * WIND
    # Another mass error changes nothing else.
    other = draw_conditions(1000, 0.2)
    np.testing.assert_array_equal(other.true.packed, found[0].true.packed)
    assert abs(other.nominal.mass - MASS) == pytest.approx(0.2)


# ------------------------------------------------------------------- endings


def test_an_interrupt_keeps_what_was_flown() -> None:
    log = run_flight(short(), stop_after(4))
    assert (log.ticks, log.interrupted, log.succeeded) == (4, True, False)


@pytest.mark.parametrize("stage", ["recognise", "decide"])
def test_a_failing_tick_does_not_end_the_flight(stage: str) -> None:
    flight = Flight(short(0.5))
    works, count = getattr(flight.pilot, stage), 0

    def fail(*given: object) -> object:
        nonlocal count
        count += 1
        if count == 5:
            raise ValueError("not today")
        return works(*given)

    setattr(flight.pilot, stage, fail)
    log = flight.run(silent)
    assert log.ticks == 10
    assert [status == "failed" for status in log.statuses] == [k == 4 for k in range(10)]
    assert log.emergency[4]
    assert not log.emergency[5]


def test_collisions_are_counted_and_many_end_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    def drop(reading: Reading) -> Plan:
        raise ArithmeticError("engines off")

    def fall(*given: object) -> Array:
        return np.zeros(4)

    monkeypatch.setattr(flight_watch, "braking_control", fall)
    logs = []
    for most in (1, 3):
        monkeypatch.setattr(episode, "COLLISIONS", most)
        flight = Flight(short(1.5))
        monkeypatch.setattr(flight.pilot, "decide", drop)
        logs.append(flight.run(silent))
    assert [log.collisions for log in logs] == [1, 1]
    assert logs[0].ticks < logs[1].ticks == 30
    assert not logs[1].succeeded


def test_arrival_needs_belief_and_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight(short(0.2))
    there = np.concatenate([flight.world.layout.target, [1.0, 0.0, 0.0, 0.0], np.zeros(3)])
    decide = flight.pilot.decide

    def dream(reading: Reading) -> Plan:
        plan = decide(reading)
        flight.pilot.belief = replace(flight.pilot.belief, state=there)
        return plan

    monkeypatch.setattr(flight.pilot, "decide", dream)
    assert not flight.run(silent).reached
    monkeypatch.setattr(episode, "REACHED_DISTANCE", 100.0)
    log = run_flight(short(0.2))
    assert (log.reached, log.ticks) == (True, 1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: FlightSettings(seed=-1),
        lambda: FlightSettings(mass_error=1.0),
        lambda: FlightSettings(mass_error=-0.1),
        lambda: Flight(short(0.2, coupling="loose")),
        lambda: Flight(short(0.2, solver="newton")),
        lambda: Flight(short(0.2, movers=-1)),
        lambda: FlightSettings(time_limit=0.0),
    ],
)
def test_what_does_not_exist_is_refused(make: Callable[[], object]) -> None:
    with pytest.raises((ScenarioError, BackendError)):
        make()


# ------------------------------------------------------------------- moving discs


def sighting(time: float, places: Array, ids: list[int], state: Array) -> Reading:
    """A reading without noise of moving discs at some places."""
    forward = SO3.matrix(state[None, 3:7])[0, :, 0]
    offset = places - state[:2]
    bearings = np.arctan2(offset[:, 1], offset[:, 0]) - np.arctan2(forward[1], forward[0])
    count = len(ids)
    return Reading(
        time, np.array(ids), bearings, np.hypot(*offset.T), np.full(count, 0.4), np.zeros(count, dtype=np.intp),
        np.ones(count, dtype=bool), 1.5, np.array([0.0, 0.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 9.81]),
    )  # fmt: skip


@pytest.mark.parametrize("association", ["known", "unknown"])
def test_tracks_find_velocities(association: str) -> None:
    tracker = LineTracker(association=association)
    velocities = np.array([[0.5, -0.3], [-0.4, 0.0]])
    for k in range(12):
        time = 0.05 * k
        state = np.concatenate([[0.1 * k, 0.0, 1.5], SO3.exp(np.array([0.0, 0.0, 0.3 + 0.02 * k])), np.zeros(3)])
        places = np.array([[5.0, 1.0], [5.0, -1.5]]) + time * velocities
        order = [0, 1] if k % 2 else [1, 0]  # an unknown association must not depend on the order
        reading = tracker.told(sighting(time, places[order], [[20, 21][i] for i in order], state), state)
        movers = tracker.update(reading, state)
    rows = np.argsort(-movers.centre[:, 1])
    np.testing.assert_allclose(movers.centre[rows], places, atol=1e-9)
    np.testing.assert_allclose(movers.velocity[rows], velocities, atol=1e-9)
    np.testing.assert_allclose(movers.radius, 0.4)
    # Out of sight a disc goes on for a while and is then given up.
    unseen = sighting(1.0, np.zeros((0, 2)), [], state)
    later = tracker.update(tracker.told(unseen, state), state)
    np.testing.assert_allclose(later.centre[rows], places + (1.0 - time) * velocities, atol=1e-9)
    assert len(tracker.update(replace(unseen, time=3.0), state)) == 0


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.product(1)
def test_a_gust_is_no_motion_of_the_vehicle(coupling: str) -> None:
    """Gusts that push and are felt do not bend the believed velocity."""
    log = run_flight(short(2.0, coupling=coupling, faults=(Fault("gust", 0.5, 1.5),)))
    assert "a gust pushes" in log.causes
    assert np.abs(log.believed[:, 7:9] - log.truth[:, 7:9]).max() < 0.3


@pytest.mark.parametrize("flag", [False, True])
def test_who_moves_is_found_out_where_nobody_names_things(flag: bool) -> None:
    """Of noisy sightings of discs that stand none ever moves, whatever the sensor flags; one that walks soon does."""
    rng, state = np.random.default_rng(0), np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    standing, told = LineTracker(association="unknown"), []
    places = np.array([[4.0, 1.5 * k - 3.0] for k in range(5)])
    for k in range(400):
        reading = replace(
            sighting(0.05 * k, places + 0.05 * rng.standard_normal((5, 2)), [9] * 5, state), moving=np.full(5, flag)
        )
        told.append(standing.told(reading, state))
    assert not np.any([reading.moving for reading in told])
    assert all(sorted(reading.ids) == sorted(told[0].ids) for reading in told), "five discs keep five names"
    assert len(standing.update(told[-1], state)) == 0
    walking, first = LineTracker(association="unknown"), []
    for k in range(60):
        place = np.array([[4.0, 0.4 * 0.05 * k]]) + 0.05 * rng.standard_normal((1, 2))
        reading = walking.told(replace(sighting(0.05 * k, place, [9], state), moving=np.array([flag])), state)
        first += [k] if reading.moving[0] else []
    assert 0.05 * first[0] < 1.5 and len(first) == 60 - first[0], "once it has moved, it is a mover"
    assert walking.update(reading, state).velocity[0] == pytest.approx([0.0, 0.4], abs=0.15)


def test_in_clutter_a_cylinder_counts_once_enough_readings_show_it() -> None:
    """Four of six: a real one from its fourth sighting on, misses or not; false ones, spread out, never."""
    rng, state = np.random.default_rng(3), np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracker, told, shown = LineTracker("unknown", (4, 6)), [], 0
    for k in range(300):
        there = rng.uniform() > 0.2
        false = np.array([[-6.0 + 12.0 * ((7 * k) % 97) / 97.0, -5.0 + 10.0 * ((13 * k) % 89) / 89.0]])
        places = np.concatenate([np.array([[3.0, 0.5]])[: int(there)], false])
        told.append(tracker.told(sighting(0.05 * k, places, [NOTHING] * len(places), state), state))
        shown += there
        if shown == 3:
            assert not any(len(reading.ids) for reading in told)
    near = [np.hypot(*(np.cos(r.bearings) * r.ranges - 3.0, np.sin(r.bearings) * r.ranges - 0.5)) for r in told]
    assert sum(len(own) for own in near) > 0.9 * shown
    assert max(float(own.max(initial=0.0)) for own in near) < 0.31
    beside = tracker.told(sighting(15.0, np.array([[3.45, 0.5]]), [NOTHING], state), state)
    assert len(beside.ids) == 0  # a false one takes the track of a cylinder that was missed, and not its place
    known = LineTracker().told(sighting(0.0, np.array([[1.0, 0.0], [2.0, 0.0]]), [5, NOTHING], state), state)
    assert known.ids.tolist() == [5]


def test_clutter_asks_for_confirmation_unless_it_is_stated() -> None:
    assert replace(short(4.0), clutter=1.0).known.confirmation == (4, 6)
    stated = EstimatorSettings(confirmation=(2, 3))
    assert replace(short(4.0), clutter=1.0, estimator=stated).known.confirmation == (2, 3)
    assert replace(short(4.0), estimator=stated).known.confirmation == (2, 3)


@pytest.mark.product(1, of="drives and flights")
@pytest.mark.parametrize("association", ["known", "unknown"])
def test_clutter_misses_and_wrong_radii_cost_a_flight_little(association: str) -> None:
    settings = replace(short(4.0), clutter=1.0, misses=0.2, radius_error=0.03)
    settings = replace(settings, estimator=EstimatorSettings(association=association))
    flight = Flight(settings)
    log, plain = flight.run(silent), run_flight(replace(settings, clutter=0.0, misses=0.0, radius_error=0.0))
    assert log.collisions == 0
    assert np.linalg.norm(log.truth[-1, :3] - plain.truth[-1, :3]) < 1.0  # after the same time
    mapped = log.landmarks[-1]["mean"][log.landmarks[-1]["radius"] > 0.0]
    gaps = np.linalg.norm(mapped[:, None] - flight.world.layout.cylinders[None, :, :2], axis=2).min(axis=1)
    assert len(mapped) and gaps.max() < 0.1  # nothing false is on the map, and nothing stands beside its place


@pytest.mark.product(2, of="drives and flights")
def test_what_turns_out_to_move_leaves_the_map() -> None:
    flight = Flight(replace(short(3.0, movers=2), seed=7, estimator=EstimatorSettings(association="unknown")))
    log = flight.run(silent)
    assert log.collisions == 0
    cylinders = flight.world.layout.cylinders[:, :2]
    final, ever = log.landmarks[-1], 0.0
    for row in log.landmarks:
        own = row["mean"][row["radius"] > 0.0]
        away = np.hypot(*np.moveaxis(own[:, None] - cylinders, 2, 0)).min(axis=1, initial=np.inf)
        ever = max(ever, float(away.max(initial=0.0)))
    assert ever > 1.0, "at first sight nobody knows"
    own = final["mean"][final["radius"] > 0.0]
    assert np.hypot(*np.moveaxis(own[:, None] - cylinders, 2, 0)).min(axis=1).max() < 0.3


# ------------------------------------------------------------------- the command


def chosen(*words: str) -> FlightSettings:
    """Settings that the command line makes of the scenario's own words."""
    parser = argparse.ArgumentParser()
    add_options(parser, FlightSettings)
    return settings_of(FlightSettings, parser.parse_args(["--seed", "7", *words]), solver="sqp")


def test_arguments_arrive() -> None:
    assert chosen() == FlightSettings("sqp", "sequential", 7)
    words = ("--coupling", "joint", "--association", "unknown", "--avoidance", "potential", "--movers", "2")
    settings = chosen(*words, "--mass-error", "0.1")
    assert (settings.coupling, settings.movers, settings.mass_error) == ("joint", 2, 0.1)
    assert settings.estimator.association == "unknown"
    assert settings.controller.avoidance == "potential"
    parser = argparse.ArgumentParser()
    SCENARIOS["quadrotor-mpc"].add_options(parser)
    assert settings_of(FlightSettings, parser.parse_args([])).solver == FlightSettings().solver


@pytest.mark.parametrize("words", [("--movers", "-1"), ("--mass-error", "1"), ("--coupling", "loose")])
def test_wrong_arguments_are_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    assert command.main(["run", "quadrotor-mpc", *words, "--out", str(tmp_path)]) == 2


@pytest.mark.parametrize(
    "setting",
    [
        "controller.dt=0", "controller.dt=-0.05", "controller.margin=-1", "controller.vehicle_radius=-1",
        "controller.cylinders=-1", "controller.movers=-1", "controller.height_limits=[3.0, 0.3]",
        "controller.lean_limit=0", "controller.control_weight=0", "time_limit=inf", "time_limit=0.01",
    ],
)  # fmt: skip
def test_numbers_that_no_flight_can_have_are_refused_by_name(
    setting: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main(["run", "quadrotor-mpc", "--out", str(tmp_path), "--set", setting]) == 2
    name = setting.partition("=")[0].rpartition(".")[2].replace("time_limit", "time")
    assert name in capsys.readouterr().err


def only_a_moment(monkeypatch: pytest.MonkeyPatch, change: Callable[[FlightLog], FlightLog]) -> None:
    """Let the command fly for half a second."""

    def fly(settings: FlightSettings, progress: Progress) -> FlightLog:
        return change(run_flight(replace(settings, time_limit=0.5), progress))

    monkeypatch.setattr(episode, "run_flight", fly)


@pytest.mark.product(1, of="scenes and pictures")
def test_the_command_writes_its_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only_a_moment(monkeypatch, lambda log: log)
    no_scene = SimpleNamespace(save=lambda path: path)  # takes seconds, as pictures do, and has tests of its own
    monkeypatch.setattr(results, "flight_scene", lambda log: no_scene)
    monkeypatch.setattr(results, "write_figure", lambda path, figure, dpi: path)
    assert command.main(["run", "quadrotor-mpc", "--seed", str(SEED), "--out", str(tmp_path)]) == 1  # not there yet
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["settings"]["seed"] == SEED
    assert metrics["ticks"] == 10
    assert {"metrics.json", "flight.npz"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize(("collisions", "status"), [(0, 0), (1, 1)])
def test_the_exit_status_says_whether_it_arrived(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, collisions: int, status: int
) -> None:
    only_a_moment(monkeypatch, lambda log: replace(log, reached=True, collisions=collisions))
    monkeypatch.setattr(results, "results", lambda log, metrics: {})
    assert command.main(["run", "quadrotor-mpc", "--seed", str(SEED), "--out", str(tmp_path)]) == status


def test_speed_and_gusts_are_settings_of_a_flight() -> None:
    """A speed reaches guide and summary, gusts the world alone; without them a flight is what it was."""
    usual, quick = Flight(FlightSettings(seed=SEED)), Flight(FlightSettings(seed=SEED, speed=1.2, gusts=3.0))
    assert quick.pilot.controller.settings.guide.speed == 1.2
    assert quick.settings.summary()["controller"]["guide"]["speed"] == 1.2
    assert usual.pilot.controller.settings == FlightSettings().controller
    calm = usual.world.disturbance_model.gust
    assert quick.world.disturbance_model.gust == pytest.approx([3.0 * sigma for sigma in calm])
    assert replace(quick.world.disturbance_model, gust=calm) == usual.world.disturbance_model
