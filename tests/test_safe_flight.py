"""Flight that must keep its distance: flatness, the weighing of the past, barriers in a plan, and whole flights."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unifg.errors import ScenarioError
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.scenarios import command
from unifg.scenarios.logs.safe_log import SafeLog, safe_metrics
from unifg.scenarios.planning.flat_path import FigureEight, Hover, Line
from unifg.scenarios.quadrotor.cbf_mpc import (
    KEEP,
    PULL,
    SLOWING,
    TRACKING,
    CbfMpc,
    Decision,
    KeeperSettings,
    Obstacles,
    Reading,
)
from unifg.scenarios.quadrotor.flatness import TUNED, FlatnessController, Gains, flat_flight
from unifg.scenarios.quadrotor.pace import Pace
from unifg.scenarios.quadrotor.situations import SITUATIONS, situation
from unifg.scenarios.quadrotor.state_filter import StateFilter
from unifg.scenarios.quadrotor.weighing import Weighing, WeighingSettings
from unifg.scenarios.safe_flight import SafeFlight, SafeSettings, flights, run_safe_flights
from unifg.scenarios.scenes.safe_scene import safe_scene
from unifg.scenarios.simulation.body_rate import Airframe, BodyRatePlant
from unifg.scenarios.simulation.disturbance import DisturbanceModel, Disturbances
from unifg.typing import Array

HEAVY = quadrotor.Parameters(1.1, (0.3, 0.3, 0.15))
WINDY = quadrotor.Parameters(0.9, (0.2, 0.2, 0.2), (0.5, -0.3), 0.2)
NOTHING = Obstacles(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0, dtype=bool))


def short(settings: SafeSettings, seconds: float) -> SafeFlight:
    """The first flight that is asked for, cut short."""
    flight = flights(settings)[0]
    flight.situation = replace(flight.situation, duration=seconds)
    return flight


# ---------------------------------------------------------------- flatness


@pytest.mark.parametrize("vehicle", [HEAVY, WINDY, quadrotor.Parameters(2.0, (0.0, 0.0, 0.4))])
def test_flat_controls_fly_the_path(vehicle: quadrotor.Parameters) -> None:
    path, h = FigureEight(3.0), 2e-3
    states, controls = flat_flight(path.at(h * np.arange(601, dtype=np.float64)), vehicle)
    state = states[0]
    for k in range(600):
        state = quadrotor.fly(state, 0.5 * (controls[k] + controls[k + 1]), h, vehicle, substeps=1)
    np.testing.assert_allclose(state, states[-1], atol=2e-5)


def test_the_nose_points_along_x() -> None:
    states, _ = flat_flight(FigureEight(3.0).at(np.linspace(0.0, 5.0, 50)), HEAVY)
    turn = SO3.to_matrix(states[:, 3:7])
    np.testing.assert_allclose(turn[:, 0, 1], 0.0, atol=1e-12)  # what is left of the vehicle is left of x
    assert (turn[:, 0, 0] > 0.5).all()


def test_feedback_is_none_on_the_path_and_limited_far_away() -> None:
    air = Airframe(HEAVY)
    controller = FlatnessController(TUNED, air.least, air.most)
    flown = FigureEight(2.0).at(np.array([0.7]))
    states, controls = flat_flight(flown, HEAVY)
    np.testing.assert_allclose(controller.control(states[0], flown, HEAVY), controls[0], atol=1e-9)
    np.testing.assert_allclose(
        controller.control(-states[0] * [-1, -1, -1, 1, 1, 1, 1, -1, -1, -1], flown, HEAVY), controls[0], atol=1e-9
    )
    over = states[0].copy()
    over[3:7] = SO3.exp(np.array([np.pi, 0.0, 0.0]))  # on its back
    for wild in (over, states[0] + np.array([50.0, -50.0, 9.0, 0, 0, 0, 0, 9.0, 9.0, -9.0])):
        control = controller.control(wild, flown, HEAVY)
        assert (control >= air.least).all() and (control <= air.most).all()


@pytest.mark.parametrize(
    ("axis", "row"),
    [((1.0, 0.0, 0.0), 0), ((0.0, 1.0, 0.0), 1), ((0.0, 0.0, 1.0), 2)],
)
def test_errors_of_the_attitude_are_turned_back(axis: tuple[float, float, float], row: int) -> None:
    air, hover = Airframe(), Hover((0.0, 0.0, 1.0)).at(np.zeros(1))
    controller = FlatnessController(Gains(), air.least, air.most)
    state = np.concatenate([[0.0, 0.0, 1.0], SO3.exp(0.1 * np.array(axis)), np.zeros(3)])
    rates = controller.control(state, hover, air.parameters)[:3]
    gain = Gains().heading if row == 2 else Gains().tilt
    np.testing.assert_allclose(rates, -0.1 * gain * np.array(axis), rtol=3e-3, atol=1e-9)


# ---------------------------------------------------------------- weighing


def weighed(seconds: float, noise: float, truth: quadrotor.Parameters) -> Weighing:
    """Weighing that observed an eight flown without use of its results."""
    books = Airframe()
    plant, model = (
        BodyRatePlant(
            replace(books, parameters=truth), flat_flight(FigureEight(3.0).at(np.zeros(1)), truth)[0][0], 0.01
        ),
        None,
    )
    model = BodyRatePlant(books, plant.state, 0.01)
    weighing = Weighing(WeighingSettings(), books.parameters, 0.01)
    controller, rng = FlatnessController(TUNED, books.least, books.most), np.random.default_rng(1)
    for _ in range(round(100 * seconds)):
        seen = quadrotor.STATE.retract(
            plant.state[None], noise * np.repeat([1e-3, 3e-3, 1e-2], 3)[None] * rng.standard_normal(9)
        )[0]
        weighing.see(seen, float(model.loops[6]))
        control = controller.control(plant.state, FigureEight(3.0).at(np.array([plant.time])), truth)
        model.state = seen
        model.tick(control)
        plant.tick(control)
    return weighing


@pytest.mark.parametrize(("noise", "of_mass", "of_drag"), [(0.0, 0.003, 0.02), (1.0, 0.01, 0.06)])
def test_mass_and_drag_are_found(noise: float, of_mass: float, of_drag: float) -> None:
    found = weighed(3.5, noise, HEAVY).believed
    assert found.mass == pytest.approx(1.1, abs=of_mass)
    np.testing.assert_allclose(found.drag[:2], 0.3, atol=of_drag)


def test_before_anything_was_seen_the_books_are_believed() -> None:
    weighing = weighed(0.04, 1.0, HEAVY)
    assert weighing.believed == quadrotor.Parameters()


# ---------------------------------------------------------------- a plan


def pillar(x: float, y: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Obstacles:
    """One cylinder whose axis is to be kept 0.75 m away."""
    return Obstacles(
        np.array([[x, y, 0.0]]), np.array([velocity]), np.array([0.75]), np.ones(1, dtype=bool), np.zeros(1, dtype=bool)
    )


LINE = Line((-4.0, 0.0, 1.5), (4.0, 0.0, 1.5), 2.0, 1.5)


def keeper(**numbers: Any) -> CbfMpc:
    return CbfMpc(KeeperSettings(**{"slots": 1, **numbers}), Airframe(), 0.01)


def decide(plans: CbfMpc, start: Array, now: float, obstacles: Obstacles, later: float = 0.0) -> Decision:
    """Along the line in still air, the vehicle's loops hovering."""
    steady = np.concatenate([start, np.zeros(6), [quadrotor.GRAVITY]])
    return plans.decide(steady, LINE.at(now + plans.nodes), obstacles, later, np.zeros((plans.settings.horizon, 3)))


def test_plans_lose_their_share_of_the_clearance_and_no_more() -> None:
    plans, start = keeper(alpha=1.0), np.array([-1.9, 0.05, 1.5, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    moving = pillar(0.0, 0.0, (-0.3, 0.1, 0.0))
    decision = decide(plans, start, 2.0, moving, 0.05)
    assert decision.status == "stop_rule" and decision.slack < 1e-3
    place = np.array([0.0, 0.0]) + np.array([-0.3, 0.1]) * (0.05 + plans.nodes)[:, None]
    clearance = np.linalg.norm(decision.plan[:, :2] - place, axis=1) - 0.75
    left = clearance[1:] - np.exp(-np.diff(plans.nodes)) * clearance[:-1]
    assert left.min() > -5e-3  # what slack costs
    assert (left < 1e-2).sum() > 3  # and it does bind
    assert np.diff(plans.nodes)[0] == pytest.approx(0.01)


def test_where_no_plan_keeps_its_distance_the_slack_says_so() -> None:
    start = np.array([-0.85, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0])
    decision = decide(keeper(alpha=1.0, speed=6.0), start, 2.0, pillar(0.0, 0.02))
    assert decision.slack > 0.05 and np.isfinite(decision.control).all()
    assert decision.status == "too near"


@pytest.mark.parametrize("velocity", [(2.6, 0.0, 0.0), (2.0, 1.7, 0.0), (3.4, 0.0, 0.0)])
def test_who_is_too_fast_has_a_plan_that_slows_down(velocity: tuple[float, float, float]) -> None:
    """No control makes a vehicle slow enough within a tick: a hard limit would leave it without a plan."""
    start = np.array([0.5, 1.5, 1.5, 1.0, 0.0, 0.0, 0.0, *velocity])
    plans = keeper(alpha=1.0, speed=2.5)
    decision = decide(plans, start, 3.0, pillar(0.0, 0.0))
    assert decision.status not in ("last plan", "braking")
    pace = np.linalg.norm(np.diff(decision.plan, axis=0), axis=1) / np.diff(plans.nodes)
    late = (float(np.linalg.norm(velocity)) - 2.5) / SLOWING
    assert pace[0] > 2.55 and pace[plans.nodes[1:] > late + 0.15].max() < 2.53


def test_without_a_plan_the_last_is_flown_on_and_then_the_vehicle_brakes() -> None:
    start = np.array([-3.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    plans, nothing = keeper(portion=None), pillar(50.0, 50.0)
    first = decide(plans, start, 1.0, nothing)
    controls = plans.loop.kept.controls
    warm = plans.loop.warm

    class Violated:
        """An answer that is no plan."""

        violation = 1.0

        def __init__(self, found: Any) -> None:
            self.found = found

        def __getattr__(self, name: str) -> Any:
            return getattr(self.found, name)

        def __getitem__(self, family: Any) -> Any:
            return self.found[family]

    class Lost:
        """A solver that finds none."""

        def solve(self, guess: Any, data: Any) -> Any:
            return Violated(warm.solve(guess, data=data))

    plans.loop.warm = Lost()  # type: ignore[assignment]
    told = [decide(plans, start, 1.0, nothing) for _ in range(round(KEEP / 0.01) + 3)]
    statuses = [decision.status for decision in told]
    assert statuses == ["last plan"] * round(KEEP / 0.01) + ["braking"] * 3
    np.testing.assert_array_equal(told[0].control, controls[1])  # what was meant for this tick
    np.testing.assert_array_equal(told[4].control, controls[1])
    np.testing.assert_array_equal(told[5].control, controls[2])
    assert all(len(decision.plan) == len(first.plan) for decision in told)
    assert told[-1].control[1] < -0.5  # the nose goes up, against the way
    plans.loop.warm = warm
    assert decide(plans, start, 1.0, nothing).status in ("stop_rule", "converged")


def test_a_plan_does_not_wish_for_another_vehicle() -> None:
    """In one graph with the past a plan that is short of force would rather be light."""
    weighing = Weighing(WeighingSettings(mass_sigma=10.0, drag_sigma=10.0), quadrotor.Parameters(), 0.01)
    plans = CbfMpc(KeeperSettings(slots=1, alpha=1.0, speed=6.0), Airframe(), 0.01, weighing)
    start = np.array([-0.85, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0])
    decision = decide(plans, start, 2.0, pillar(0.0, 0.02))
    assert abs(decision.mass - 1.0) < PULL[0] + 1e-3 and np.abs(decision.drag).max() < PULL[1] + 1e-3


def test_plans_of_millimetres_are_solved_to_the_end() -> None:
    """Stopped after a step a plan asks for something else, by as much as noise leaves; TRACKING has it solved."""
    exact = replace(TRACKING, slots=0, tolerance=1e-9, iterations=100)
    numbers = {"solved": replace(TRACKING, slots=0), "stopped": replace(exact, settled=False), "exact": exact}
    start, told = np.array([-4.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), {}
    for name, settings in numbers.items():
        plans = CbfMpc(settings, Airframe(), 0.01)
        decide(plans, start, 0.0, NOTHING)
        told[name] = decide(plans, start + np.eye(10)[1] * 2e-3, 0.01, NOTHING)
    apart = {name: float(np.abs(told[name].control - told["exact"].control).max()) for name in told}
    assert told["solved"].status == "converged" and told["stopped"].status == "stop_rule"
    assert apart["solved"] < 0.2 * apart["stopped"], apart


def test_the_path_waits_for_who_is_held_up_and_not_for_who_is_beside_it() -> None:
    pace = Pace(LINE, 2.0, now=2.0)
    place = LINE.at(np.array([2.0])).position[0]
    lags = (0.0, 3.0, 1.0), (0.9, -1.0, 1.0), (1.5, 0.0, 0.5), (5.0, 0.0, 0.0), (-1.0, 0.0, 1.0)
    for behind, beside, rate in lags:
        pace.see(place - [behind, beside, 0.0])
        assert pace.rate == pytest.approx(rate)
    pace.see(place - [1.5, 0.0, 0.0])
    ahead, step = pace.at(np.array([0.1, 0.2, 0.3])), 1e-3
    moved = pace.at(np.array([0.1, 0.2, 0.3]) + step)
    np.testing.assert_allclose((moved.position - ahead.position) / step, ahead.velocity, atol=1e-9)
    pace.pass_by(0.1)
    np.testing.assert_allclose(pace.at(np.zeros(1)).position, ahead.position[:1])
    over = Pace(LINE, 2.0, now=60.0)  # at rest at the end there is nothing to wait for
    over.see(np.array([-4.0, 0.0, 1.5]))
    assert over.rate == 1.0


def test_the_filter_knows_better_than_the_sensors_and_how_well() -> None:
    """Normalised errors of position, attitude, velocity and gust have the size that the covariance says."""
    air, seen, rng = DisturbanceModel(), np.array([1e-3, 3e-3, 1e-2]), np.random.default_rng(5)
    start = flat_flight(LINE.at(np.zeros(1)), quadrotor.Parameters())[0][0]
    plant, model = (BodyRatePlant(Airframe(), start, 0.01) for _ in range(2))
    shake, estimate = Disturbances(air, rng), StateFilter(0.01)
    told = np.array([0.0, 0.0, 0.0, quadrotor.GRAVITY])
    misses, raw, sizes = [], [], []
    for k in range(600):
        look = quadrotor.STATE.retract(plant.state[None], (np.repeat(seen, 3) * rng.standard_normal(9))[None])[0]
        found = estimate.see(look)
        if k > 100:
            miss = quadrotor.STATE.local(found[None], plant.state[None])[0]
            misses.append(np.concatenate([miss, shake._gust - estimate.gust]))
            raw.append(quadrotor.STATE.local(look[None], plant.state[None])[0])
            sizes.append(misses[-1] @ np.linalg.solve(estimate.covariance, misses[-1]))
        command = told + np.array([0.5 * np.sin(0.2 * k), 0.5 * np.cos(0.15 * k), 0.0, 0.0])
        estimate.tick(model, command)
        plant.tick(command, shake.draw(0.01))
    better = np.square(misses).mean(0)[:9].reshape(3, 3).mean(1) / np.square(raw).mean(0).reshape(3, 3).mean(1)
    assert (np.sqrt(better) < [0.7, 0.5, 0.5]).all()
    assert 9.0 < np.mean(sizes) < 16.0  # 12 if all is as stated; one flight is 600 dependent ticks
    assert np.sqrt(np.square(misses).mean(0)[9:11]).max() < 0.07  # the gust itself has 0.1


def test_what_the_plan_comes_near_to_is_looked_at_and_keeps_its_place() -> None:
    """Two pillars beside the vehicle, one farther away on its way, in a plan that can look at two."""
    places = np.array([[-3.0, 1.6, 0.0], [-3.0, -1.7, 0.0], [-1.4, 0.1, 0.0], [3.0, 3.0, 0.0]])
    still, upright = np.zeros((4, 3)), np.ones(4, dtype=bool)
    all_four = Obstacles(places, still, np.full(4, 0.5), upright, ~upright)
    plans, start = keeper(slots=2), np.array([-3.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    looped = np.concatenate([start, np.zeros(7)])
    assert set(plans._nearest(looped, all_four, 0.0).tolist()) == {2, 0}
    before = plans._looked_at.copy()
    moved = looped + np.array([1.5, -1.5, *np.zeros(15)])
    assert plans._nearest(moved, all_four, 0.0).tolist() == [2 if k == 2 else 1 for k in before]
    plans = keeper(slots=2)
    decide(plans, start, 1.0, all_four)
    assert all_four.clearance(plans.loop.kept.states[:, :3], plans.nodes)[:, 2].min() > 0.0


def test_the_nearest_are_looked_at_and_falling_ones_fall() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-5.0, 5.0, (20, 3))
    upright = np.arange(20) % 2 == 0
    many = Obstacles(places, np.ones((20, 3)), np.linspace(0.2, 2.0, 20), upright, np.arange(20) % 3 == 0)
    away = places.copy()
    away[upright, 2] = 0.0
    near = many.nearest(np.zeros(3), 4)
    np.testing.assert_array_equal(near.keep, many.keep[np.argsort(np.linalg.norm(away, axis=1) - many.keep)[:4]])
    two = replace(many.nearest(np.zeros(3), 2), falls=np.array([True, False]), velocity=np.zeros((2, 3)))
    gone = two.at(np.array([0.0, 0.5]))
    np.testing.assert_allclose(gone[1] - gone[0], [[0.0, 0.0, -0.125 * quadrotor.GRAVITY], [0.0, 0.0, 0.0]], atol=1e-12)
    far = NOTHING.nearest(np.zeros(3), 3)
    assert far.position.shape == (3, 3) and np.linalg.norm(far.position, axis=1).min() > 100.0


# ---------------------------------------------------------------- whole flights


def test_situations_are_what_they_are_called_and_a_seed_moves_them() -> None:
    for kind in SITUATIONS:
        one, same, other = situation(kind, seed=1), situation(kind, seed=1), situation(kind, seed=2)
        for k in range(3):
            times = np.array([0.4 * k])
            np.testing.assert_array_equal(one.bodies.at(times)[0], same.bodies.at(times)[0])
        if len(one.bodies):
            assert not np.array_equal(one.bodies.at(np.array([2.5]))[0], other.bodies.at(np.array([2.5]))[0])
            start = one.path.at(np.zeros(1)).position
            assert one.bodies.nearest(np.tile(start, (2, 1)), np.array([0.0, 1e-3])).min() > 0.3
    assert len(situation("cluttered").bodies) >= 20
    with pytest.raises(ScenarioError, match="unknown case 'flat': choose static"):
        SafeSettings(case="flat")  # type: ignore[arg-type]


@pytest.mark.parametrize(("speed", "said"), [(3.4, False), (6.0, True)])
def test_a_path_too_short_for_its_speed_says_which_it_reaches(
    speed: float, said: bool, caplog: pytest.LogCaptureFixture
) -> None:
    about = situation("static", speed)
    fastest = np.linalg.norm(about.path.at(np.linspace(0.0, about.duration, 5001)).velocity, axis=1).max()
    assert ("too short for 6 m/s: it reaches" in caplog.text) == said
    assert abs(fastest - speed) < 0.01 or f"{fastest:.2f} m/s" in caplog.text


@pytest.mark.product(2, of="drives and flights")
def test_the_same_seed_flies_the_same_flight() -> None:
    settings = SafeSettings(alpha=(3.0,), seed=4)
    one, two = (short(settings, 0.4).run() for _ in range(2))
    other = short(replace(settings, seed=5), 0.4).run()
    for name in ("states", "controls", "near", "mass"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert not np.array_equal(one.states, other.states)


def test_what_is_pending_is_predicted_and_in_the_books_it_is_not() -> None:
    calm = {"seen": (0.0, 0.0, 0.0), "disturbance": DisturbanceModel.calm(), "truth": quadrotor.Parameters()}
    errors = {}
    for knowledge in ("estimated", "books"):
        settings = SafeSettings(case="figure8", controller=("flatness",), speed=(3.0,), knowledge=knowledge, **calm)  # type: ignore[arg-type]
        log = short(settings, 3.0).run()
        errors[knowledge] = np.linalg.norm(log.error[150:], axis=1).max()
    assert errors["estimated"] < 0.5 * errors["books"]
    assert errors["books"] < 0.2  # gains that need the prediction would lose the vehicle


def test_who_is_asked_for_flies() -> None:
    labels = [flight.label for flight in flights(SafeSettings(case="figure8", speed=(1.0, 2.0)))]
    assert labels == ["1 m/s, barrier", "1 m/s, flatness", "2 m/s, barrier", "2 m/s, flatness"]
    assert [flight.label for flight in flights(SafeSettings(alpha=(0.5,), controller=("flatness",)))] == ["flatness"]
    with pytest.raises(ScenarioError, match="unknown controller 'pilot': choose barrier, flatness, filter"):
        flights(SafeSettings(controller=("pilot",)))  # type: ignore[arg-type]


@pytest.mark.parametrize("reading", ["decay", "published"])
@pytest.mark.product(1)
def test_a_velocity_in_the_barrier_bends_the_plan(reading: Reading) -> None:
    start, ahead = np.array([-2.2, 0.02, 1.5, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0]), pillar(0.0, 0.0, (-1.0, 0.0, 0.0))
    plans = [decide(keeper(reading=reading, gamma=gamma, alpha=1.2), start, 2.0, ahead) for gamma in (0.0, 0.4)]
    assert all(np.isfinite(plan.control).all() for plan in plans)
    assert np.abs(plans[0].plan - plans[1].plan).max() > 0.01


def test_an_interrupt_keeps_what_was_flown() -> None:
    def stop(done: float, text: str) -> None:
        if 0.01 < done < 0.5:
            raise KeyboardInterrupt

    logs = run_safe_flights(SafeSettings(case="ball", controller=("flatness",)), stop)
    assert len(logs) == 1 and logs[0].interrupted and 0 < logs[0].ticks < 100


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a flight past the cylinder, from the command line."""
    out = tmp_path_factory.mktemp("flight")
    assert command.main(["run", "quadrotor-cbf", "--alpha", "3", "--out", str(out)]) == 0
    return out


@pytest.mark.product(2, of="drives and flights")
def test_the_cylinder_is_passed_beyond_the_margin(folder: Path) -> None:
    told = json.loads((folder / "metrics.json").read_text())
    (flight,) = told["flights"]
    assert told["case"] == "static" and flight["label"] == "alpha 3" and flight["succeeded"]
    assert 0.0 < flight["min_boundary_distance_m"] < 0.25
    assert flight["min_clearance_m"] == pytest.approx(flight["min_boundary_distance_m"] + 0.05)
    assert flight["mass_kg"] == pytest.approx(1.1, abs=0.01)
    assert flight["statuses"].get("not_finite", 0) == 0


@pytest.mark.product(1, of="scenes and pictures")
def test_a_flight_leaves_a_picture_and_a_scene(folder: Path) -> None:
    assert (folder / "flights.png").stat().st_size > 20_000
    page = (folder / "scene.html").read_text(encoding="utf-8")
    assert "quadrotor-cbf, static" in page and "kept its distance, arrived" in page


@pytest.mark.product(2, of="drives and flights")
def test_a_smaller_alpha_keeps_farther_away() -> None:
    """Fig. 5, on the way to the cylinder."""
    near = {}
    for alpha in (0.1, 3.0):
        near[alpha] = short(SafeSettings(alpha=(alpha,)), 1.6).run().boundary.min()
    assert near[0.1] > near[3.0] + 0.5


@pytest.mark.parametrize(
    "setting",
    [
        "dt=0", "dt=1e9", "faster=0", "faster=-2", "margin=-1", "patience=-5", "seen=[1.0, -1.0, 1.0]",
        "seen=[inf, 1, 1]", "keeper.horizon=0", "keeper.slots=-1", "keeper.iterations=0",
        "keeper.step=0", "keeper.speed=-1",
    ],
)  # fmt: skip
def test_numbers_that_no_flight_can_have_are_refused_by_name(
    setting: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "quadrotor-cbf", "--case", "ball", "--controller", "flatness", "--out", str(tmp_path)]
    assert command.main([*words, "--set", setting]) == 2
    name = setting.partition("=")[0].rpartition(".")[2]
    assert f"error: {name}: " in capsys.readouterr().err


def judged(near: float, end: float) -> SafeLog:
    """A record of two ticks."""
    zero = np.zeros(2)
    states = np.zeros((2, 10))
    states[:, 0] = end
    return SafeLog(
        label="", settings={"case": "static", "controller": "barrier"}, dt=0.01, hull=0.25, margin=0.05,
        radii=np.ones(1), upright=np.zeros(1, dtype=bool), end=np.zeros(3), time=np.array([0.0, 0.01]), states=states,
        wanted=np.zeros((2, 6)), controls=np.zeros((2, 4)), plans=np.zeros((2, 1, 3)), bodies=np.zeros((2, 1, 3)),
        near=np.array([[1.0], [near]]), late=zero, slack=zero, mass=zero, drag=np.zeros((2, 3)), decide_ms=zero,
        steps=np.zeros(2, dtype=np.intp), statuses=["none", "none"],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("near", "end", "touched", "violated", "succeeded"),
    [
        (0.35, 0.0, False, False, True),
        (0.2995, 0.0, False, False, True),  # what the last iterate leaves
        (0.298, 0.0, False, True, False),
        (0.24, 0.0, True, True, False),
        (0.35, 0.4, False, False, False),
    ],
)
def test_flights_are_judged(near: float, end: float, touched: bool, violated: bool, succeeded: bool) -> None:
    log = judged(near, end)
    assert (log.touched, log.violated, log.succeeded) == (touched, violated, succeeded)
    assert safe_metrics(log)["min_clearance_m"] == pytest.approx(near - 0.25)


def test_the_panel_of_a_scene_says_the_error_of_the_metrics() -> None:
    log = judged(0.35, 0.2)
    late = replace(log, time=np.array([0.0, 2.5]), wanted=np.array([[0.2, 0.0, 0.0, 0.0, 0.0, 0.0], np.zeros(6)]))
    assert safe_metrics(late)["tracking_error_m"]["rms"] == pytest.approx(0.2)
    assert safe_scene(late).facts["from the path"] == "20.0 cm rms"
