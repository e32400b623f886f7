"""Measurements with stamps, and gyro and accelerometer, as terms of a window and of a loop."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator

import unifg as fg
from problems.graphs import graph_with
from test_window import Timed
from unifg.horizon import Constant, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Term, Window
from unifg.lie import SE23, SO3
from unifg.models.inertial import InertialMeasurements
from unifg.models.interpolation import cubic
from unifg.models.preintegration import BIAS, ImuNoise, predict, preintegrate
from unifg.models.stamped import Counts, StampedMeasurements
from unifg.solvers import SQP, LevenbergMarquardt
from unifg.typing import Array

H = 0.1


def drift(x: Array, u: Array, y: Array, h: Array) -> Array:
    return (y - x) - np.reshape(h, (-1, 1)) * u


def place(x: Array, z: Array) -> Array:
    return x - z


def step(x: Array, u: Array) -> Array:
    return x + H * u


POINT = Robot(fg.Rn(2), fg.Rn(2), predict=step)
TIMED = Robot(fg.Rn(2), fg.Rn(1), steps={"noise": fg.Rn(1)}, predict=lambda x, u: x)


def walk(rng: Generator, count: int) -> tuple[Array, Array, list[tuple[float, float, Array]]]:
    """Controls, true places, and fixes (arrival, stamp, value) that come up to two steps late."""
    controls = rng.normal(size=(count, 2))
    truth = np.cumsum(np.concatenate([np.zeros((1, 2)), H * controls + 0.01 * rng.normal(size=(count, 2))]), axis=0)
    fixes = []
    for stamp in np.sort(rng.uniform(0.0, H * count, 2 * count)):
        k = min(int(stamp / H), count - 1)
        at = truth[k] + (stamp / H - k) * (truth[k + 1] - truth[k])
        fixes.append((stamp + rng.uniform(0.0, 2.0 * H), stamp, at + 0.05 * rng.normal(size=2)))
    return controls, truth, sorted(fixes, key=lambda fix: fix[0])


def fixes_of(capacity: int = 8) -> StampedMeasurements:
    return StampedMeasurements(place, 2, capacity=capacity, sigma=0.05, name="fixes")


def test_a_window_equals_the_whole_history(rng: Generator) -> None:
    """Linear, so that marginalising loses nothing: from the first tick on, late fixes among them."""
    count, start = 14, np.zeros(2)
    controls, _, fixes = walk(rng, count)
    sensor, solver = fixes_of(), LevenbergMarquardt(tolerance=1e-10)
    window = Window(POINT, 4, [Dynamics(drift, H, sigma=0.01), sensor], start=start, sigma=0.2, solver=solver)
    waiting, fed = list(fixes), 0
    for tick in range(1, count + 1):
        window.move(controls[tick - 1], H * tick)
        while waiting and waiting[0][0] <= H * tick:
            _, stamp, value = waiting.pop(0)
            sensor.add(stamp, value)
            fed += 1
        window.estimate()

        graph, x = graph_with(fg.Rn(2), tick + 1)
        graph.minimize(fg.prior, x[0], start, sigma=0.2)
        graph.minimize(drift, x[:-1], controls[:tick], x[1:], H, sigma=0.01)
        whole = fixes_of(16)
        whole.state(graph, x)
        for arrival, stamp, value in fixes:
            if arrival <= H * tick:
                whole.add(stamp, value)
        data = whole.at(graph, H * np.arange(tick + 1))
        batch = solver.solve(graph, {x: np.zeros((tick + 1, 2))}, data=data, check=True)
        np.testing.assert_allclose(window.present, batch[x][-1], atol=1e-9)
        np.testing.assert_allclose(window.state_covariance, batch.covariance(x[-1]), atol=1e-12)
    assert fed > 20 and sensor.counts.late == sensor.counts.full == 0


@pytest.mark.parametrize("tick", [None, H])
def test_nodes_without_times_stand_as_far_apart_as_their_dynamics_step(tick: float | None, rng: Generator) -> None:
    """Stamps are of seconds: a node at every second would take those of another place."""
    controls, truth, _ = walk(rng, 12)
    ahead = step if tick is None else lambda x, u, seconds: x + seconds * u
    robot, found = Robot(fg.Rn(2), fg.Rn(2), predict=ahead, tick=tick), []
    for times in (H * np.arange(1, 13), [None] * 12):
        sensor = fixes_of()
        window = Window(robot, 4, [Dynamics(drift, H, sigma=0.01), sensor], start=np.zeros(2), sigma=0.2)
        for k, time in enumerate(times):
            window.move(controls[k], time)
            sensor.add(H * (k + 0.5), 0.5 * (truth[k] + truth[k + 1]))
            window.estimate()
        found.append(window.present)
        assert np.linalg.norm(window.present - truth[-1]) < 0.05 and sensor.counts.late == 0
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)


def test_nodes_at_another_spacing_than_the_step_of_dynamics_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    window = Window(POINT, 4, [Dynamics(drift, H, sigma=0.01)], start=np.zeros(2), sigma=0.2)
    window.move(np.zeros(2), 1.2 * H)
    assert not caplog.records
    window.move(np.zeros(2), 3.2 * H)  # a tick is lost
    assert "0.2 s after the last one, but a step of its dynamics is 0.1 s" in caplog.text


def test_the_present_alone_keeps_what_comes() -> None:
    """Before the first step there is no interval: measurements wait, and are placed with the next node."""
    sensor = fixes_of()
    window = Window(POINT, 3, [Dynamics(drift, H, sigma=0.01), sensor], start=np.zeros(2), sigma=0.2)
    sensor.add([0.0, 0.05], [[1.0, 0.0], [1.0, 0.0]])
    window.estimate()
    assert sensor.counts == Counts()
    window.move(np.zeros(2), H)
    window.estimate()
    assert sensor.counts == Counts(placed=2) and window.present[0] > 0.9


def test_one_sensor_stands_in_both_graphs_of_a_joint_loop(rng: Generator) -> None:
    """In the window alone and in past and future: the same fixes, counted once; with the clock's offset unknown."""
    count, offset = 25, 0.04
    late = Constant("clock", fg.Rn(1), [0.0], 0.1)
    robot = Robot(fg.Rn(2), fg.Rn(2), constants=(late,), predict=step)
    found = {}
    for coupling in ("sequential", "joint"):
        draw = np.random.default_rng(3)
        sensor = StampedMeasurements(place, 2, capacity=3, sigma=0.01, offset="clock", name="fixes")
        known = Measurement("own", fg.prior, (2,), 0.01)
        window = Window(robot, 8, [Dynamics(drift, H, sigma=0.01), sensor, known], start=np.zeros(2), sigma=0.2)

        class Goal(Term):
            def state(self, graph: fg.Graph, x: fg.Selection, u: fg.Family) -> None:
                graph.minimize(fg.prior, x[1:], [5.0, 3.0], sigma=1.0, name="goal")
                graph.bound(u, lower=-1.0, upper=1.0)

        terms = [Dynamics(drift, H), Goal(), ControlCost(sigma=[3.0, 3.0])]
        loop = RecedingHorizon(robot, 6, terms, solver=SQP(), window=window, coupling=coupling)
        truth, before = np.zeros(2), np.zeros(2)
        for tick in range(count):
            for s in (0.5, 0.9) if tick else ():  # stamps of a clock that is behind
                stamp = H * (tick - 1 + s)
                sensor.add(stamp - offset, before + s * (truth - before) + 0.01 * draw.normal(size=2))
            plan = loop.tick(measured={"own": truth + 0.01 * draw.normal(size=2)}, time=H * tick)
            assert plan.source == "solved"
            before, truth = truth, step(truth, plan.control)
        assert loop.statuses[fg.Status.CONVERGED] == count
        found[coupling] = loop.constants["clock"][0, 0]
        assert abs(found[coupling] - offset) < 0.02
        assert sensor.counts.late == sensor.counts.full == sensor.counts.invalid == 0
    assert found["joint"] != found["sequential"]


@pytest.mark.parametrize("static", [False, True], ids=["biases that walk", "one bias"])
@pytest.mark.product(1)
def test_inertial_navigation_in_a_window(static: bool, rng: Generator) -> None:
    """Biases are a component of the states, or one static unknown; fixes between nodes at 3.7 Hz."""
    noise, rate = ImuNoise(1e-3, 1e-2, 1e-4, 1e-3), 100.0
    state = SE23 if static else fg.Product(body=SE23, bias=BIAS)
    bias = np.array([0.01, -0.02, 0.01, 0.1, 0.05, -0.1])
    constants = (Constant("bias", BIAS, np.zeros(6), [0.05] * 3 + [0.3] * 3),) if static else ()
    robot = Robot(state, fg.Rn(1), constants=constants)
    body = None if static else "body"
    imu = InertialMeasurements(noise, body=body)
    fixes = StampedMeasurements(
        lambda x, z: x[:, :3] - z, 3, capacity=2, sigma=0.02, between=cubic(SE23), component=body, name="fixes"
    )
    t = np.arange(800) / rate
    w = np.stack([0.5 * np.sin(t), 0.3 * np.cos(2.0 * t), np.full_like(t, 0.4)], axis=1)
    a = np.stack([np.sin(1.5 * t), np.cos(t), 9.81 + 0.3 * np.sin(3.0 * t)], axis=1)
    start = SE23.from_parts(np.zeros(3), [0.5, 0.0, 0.0], SO3.from_rpy(0.05, 0.0, 1.0))
    truth = predict(start, preintegrate(t, w, a, np.append(t, t[-1] + 1.0 / rate), noise, np.zeros(6)))
    spread = np.sqrt(rate) * np.repeat([noise.gyro, noise.accelerometer], 3)
    shown = np.concatenate([w, a], axis=1) + bias + spread * rng.normal(size=(len(t), 6))
    sigma = [0.02] * 3 + [0.1] * 3 + [0.02] * 3 + ([] if static else [0.05] * 3 + [0.3] * 3)
    begin = start if static else np.concatenate([start, np.zeros(6)])
    # What leaves says little of biases alone: the lowest point of what it says is tens of metres per second^2 away.
    window = Window(robot, 10, [imu, fixes], start=begin, sigma=sigma)
    fixed = np.arange(0.13, 7.9, 1.0 / 3.7)
    step, errors = 0.2, []
    for tick in range(1, 36):
        now = step * tick
        window.move(np.zeros(1), now)
        fresh = (t > now - step - 1e-9) & (t < now - 1e-9) if tick > 1 else t < now
        imu.add(t[fresh], shown[fresh, :3], shown[fresh, 3:])
        for stamp in fixed[(fixed > now - step) & (fixed <= now)]:
            k = int(stamp * rate)
            fixes.add(stamp, truth[k, :3] + (stamp * rate - k) * (truth[k + 1, :3] - truth[k, :3]))
        history = window.history  # a first guess of the new node: the last one, moved
        believed = history.constants["bias"][0] if static else history.states[-2, 10:]
        moved = predict(history.states[-2, :10], imu.integrated(history.times[-2:], believed))[1]
        history.states[-1] = moved if static else np.concatenate([moved, believed])
        solution = window.estimate()
        assert solution.converged
        errors.append(SE23.local(window.present[:10], truth[round(now * rate)]))
    final = history.constants["bias"][0] if static else window.present[10:]
    assert np.abs(final[:3] - bias[:3]).max() < 0.01 and np.abs(final[3:] - bias[3:]).max() < 0.1
    assert np.abs(np.array(errors[10:])[:, :3]).max() < 0.1
    assert imu.counts.unknown == 0 and fixes.counts.late == 0
    sigmas = np.sqrt(np.diag(window.state_covariance))[:9]
    assert np.all(np.abs(errors[-1]) < 5.0 * sigmas)


# ---------------------------------------------------------------- windows that begin anew, are shared, or full at once


def resting(filled: bool = False) -> tuple[Window, InertialMeasurements]:
    """A body that stands still, with biases in its states."""
    imu, state = InertialMeasurements(ImuNoise(1e-3, 1e-2, 1e-4, 1e-3), body="body"), fg.Product(body=SE23, bias=BIAS)
    sigma = [0.02] * 9 + [0.01] * 6
    return Window(Robot(state, fg.Rn(1)), 4, [imu], start=state.identity(), sigma=sigma, filled=filled), imu


def test_nothing_of_the_last_episode_comes_back() -> None:
    sensor = fixes_of()
    window, _ = resting()
    imu = InertialMeasurements(ImuNoise(), body="body")
    sensor.add([0.1, 0.2, np.nan], np.full((3, 2), 100.0))
    imu.add([0.0, 0.01, 0.01], np.full((3, 3), 5.0), np.full((3, 3), 50.0))
    for term in (sensor, imu):
        assert term.counts != type(term.counts)()
        term.reset()
        assert term.counts == type(term.counts)()
    place_of = Window(POINT, 3, [Dynamics(drift, H, sigma=0.01), sensor], start=np.zeros(2), sigma=0.2)
    place_of.move(np.zeros(2), H)
    place_of.estimate()
    assert not place_of.present.any() and sensor.counts == Counts()
    assert len(imu.integrated([0.0, 0.1], np.zeros(6)).held) == 1
    assert imu.integrated([0.0, 0.1], np.zeros(6)).held[0] == np.inf
    window.estimate()


def test_a_sensor_serves_one_window_or_says_so() -> None:
    """Measurements that left with the nodes of one window are gone for another; windows in step may share."""
    sensor = fixes_of()
    ahead, behind, same = (
        Window(POINT, 3, [Dynamics(drift, H, sigma=0.01), sensor], start=np.zeros(2), sigma=0.2) for _ in range(3)
    )
    for k in range(1, 9):
        ahead.move(np.zeros(2), H * k)
        same.move(np.zeros(2), H * k)
        sensor.add(H * k, [1.0, 0.0])
        ahead.estimate()
        same.estimate()
        assert np.array_equal(ahead.present, same.present)
    behind.move(np.zeros(2), H)
    with pytest.raises(fg.ModelError, match=r"'fixes': nodes from 0 s on .* before 0\.5 s has left.*reset\(\)"):
        behind.estimate()
    sensor.reset()
    sensor.add(H, [1.0, 0.0])
    behind.estimate()
    assert sensor.counts == Counts(placed=1)


def test_an_inertial_sensor_serves_one_window_or_says_so() -> None:
    imu, state = InertialMeasurements(ImuNoise(), body="body"), fg.Product(body=SE23, bias=BIAS)
    ahead, behind = (Window(Robot(state, fg.Rn(1)), 2, [imu], start=state.identity(), sigma=0.1) for _ in range(2))
    t = 0.01 * np.arange(60)
    imu.add(t, np.zeros((60, 3)), np.tile([0.0, 0.0, 9.81], (60, 1)))
    for k in range(1, 6):
        ahead.move(np.zeros(1), 0.1 * k)
        ahead.estimate()
    behind.move(np.zeros(1), 0.1)
    with pytest.raises(fg.ModelError, match=r"'imu': nodes from 0 s on .* samples before 0\.3 s have been forgotten"):
        behind.estimate()
    imu.reset()
    behind.estimate()
    assert imu.counts.unknown == 1


def test_sensors_stand_in_a_window_that_is_full_at_once() -> None:
    """Steps of no duration: nothing is measured in them, and nothing moves."""
    answers = []
    for filled in (False, True):
        sensor = fixes_of()
        window = Window(TIMED, 4, [Timed(), sensor], start=np.zeros(2), sigma=0.2, filled=filled)
        sensor.add([0.0, np.nextafter(0.0, -1.0)], [[0.1, 0.0], [0.2, 0.0]])
        window.estimate()
        assert sensor.counts == Counts()
        for k in range(1, 8):
            window.move(np.zeros(1), H * k)
            sensor.add(H * (k - 0.5), [0.1, 0.0])
            assert window.estimate().converged
        assert sensor.counts.late == 0
        inertial, imu = resting(filled=filled)
        t = 0.01 * np.arange(101)
        imu.add(t, np.full((101, 3), 0.01), np.tile([0.1, 0.0, 9.81], (101, 1)))
        inertial.estimate()
        for k in range(1, 8):
            inertial.move(np.zeros(1), H * k)
            assert inertial.estimate().converged
            assert imu.counts.unknown == 0
        answers.append((inertial.present, np.sqrt(np.diag(inertial.state_covariance))))
    np.testing.assert_allclose(answers[0][0], answers[1][0], atol=1e-6)
    np.testing.assert_allclose(answers[0][1], answers[1][1], rtol=1e-3)
