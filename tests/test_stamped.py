"""Measurements between nodes: interpolation on the group, stamps in any order, and one structure for all ticks."""

from __future__ import annotations

import gzip
import pickle
import sys
from collections.abc import Callable
from copy import deepcopy
from io import BytesIO
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator
from scipy.io import loadmat

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.codegen.compile_counter import counting
from unifg.codegen.jit import compiled
from unifg.errors import ModelError
from unifg.factors.differences import jacobian
from unifg.lie import SE23
from unifg.models import landmarks
from unifg.models.inertial import InertialMeasurements
from unifg.models.interpolation import Interpolation, cubic, geodesic
from unifg.models.preintegration import BIAS, ImuNoise
from unifg.models.quadrotor import STATE
from unifg.models.stamped import Counts, StampedMeasurements
from unifg.solvers import GaussNewton, LevenbergMarquardt
from unifg.typing import Array

TWIST2 = fg.Product(pose=fg.SE2, velocity=fg.Rn(3))
TWIST3 = fg.Product(bias=fg.Rn(1), velocity=fg.Rn(6), pose=fg.SE3)
INERTIAL = fg.Product(R=fg.SO3, p=fg.Rn(3), bias=fg.Rn(2), v=fg.Rn(3))
WAYS: dict[str, tuple[fg.Manifold, Interpolation]] = {
    "geodesic on SE2": (fg.SE2, geodesic(fg.SE2)),
    "geodesic on SE3": (fg.SE3, geodesic(fg.SE3)),
    "geodesic on a product": (INERTIAL, geodesic(INERTIAL)),
    "cubic on SE2": (TWIST2, cubic(TWIST2)),
    "cubic on SE3": (TWIST3, cubic(TWIST3)),
    "cubic in space": (INERTIAL, cubic(INERTIAL)),
    "cubic on SE23": (fg.SE23, cubic(fg.SE23)),
}


def place(x: Array, z: Array) -> Array:
    return x[:, :2] - z


def near(manifold: fg.Manifold, rng: Generator, count: int, size: float = 0.4) -> tuple[Array, Array]:
    x = manifold.random(rng, (count,))
    return x, manifold.retract(x, size * rng.standard_normal((count, manifold.dim)))


# ---------------------------------------------------------------- interpolation


@pytest.mark.parametrize("name", WAYS)
def test_interpolation_passes_through_both_nodes(name: str, rng: Generator) -> None:
    manifold, between = WAYS[name]
    x, y = near(manifold, rng, 20)
    h = np.full(20, 0.3)
    for s, node in ((0.0, x), (1.0, y)):
        found = between(x, y, np.full(20, s), h)
        assert manifold.is_valid(found).all()
        assert np.abs(manifold.local(found, node)).max() < 1e-13
    assert not np.shares_memory(between(x, y, np.zeros(20), h), x)


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.product(3)
def test_interpolation_is_traced_with_exact_derivatives(name: str, rng: Generator) -> None:
    """On symbols it is what it is on numbers, with the derivatives of differences."""
    manifold, between = WAYS[name]
    count = 7
    x, y = near(manifold, rng, count)
    s, h = np.linspace(-0.1, 1.1, count), np.linspace(0.1, 0.5, count)
    here = manifold.random(rng, (count,))

    def error(a: Array, b: Array, s: Array, h: Array, here: Array) -> Array:
        return manifold.local(here, between(a, b, s, h))

    graph, a, b = graph_of(("a", manifold, count), ("b", manifold, count))
    given = [graph.data(str(k), part, each=True) for k, part in enumerate((s, h, here))]
    graph.minimize(fg.residual(error, derivatives="trace"), a, b, *given)
    lin = graph.compile().linearize({a: x, b: y})
    np.testing.assert_allclose(lin.residual.reshape(count, -1), error(x, y, s, h, here), atol=1e-13)
    wanted = jacobian(lambda a, b: error(a, b, s, h, here), [x, y], [manifold, manifold])
    found = lin.jacobian.reshape(count, manifold.dim, 2 * manifold.dim)
    np.testing.assert_allclose(found, np.concatenate(wanted, axis=2), atol=3e-8)


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3, fg.SO3], ids=lambda g: g.name)
def test_constant_twists_are_exact(group: fg.LieGroup, rng: Generator) -> None:
    """A quarter of the way, near a whole half turn, with headings across the cut and 1e6 m away."""
    twist = rng.standard_normal((30, group.dim))
    angles = slice(2, 3) if group is fg.SE2 else slice(-3, None)
    twist[:, angles] *= (np.pi - 1e-6) / np.linalg.norm(twist[:, angles], axis=1, keepdims=True)
    x = group.random(rng, (30,))
    if group is not fg.SO3:
        x[:, 0] += 1e6
    states = fg.Product(pose=group, velocity=fg.Rn(group.dim))
    y, quarter = group.exp(twist), group.retract(x, 0.25 * twist)
    y = group.compose(x, y)
    s, h = np.full(30, 0.25), np.full(30, 0.1)
    tight = 1e-9 if group is not fg.SO3 else 1e-12
    assert np.abs(group.local(quarter, geodesic(group)(x, y, s, h))).max() < tight
    first, last = (states.pack(pose=pose, velocity=10.0 * twist) for pose in (x, y))
    found = states.unpack(cubic(states)(first, last, s, h))
    assert np.abs(group.local(quarter, found["pose"])).max() < 10.0 * tight
    np.testing.assert_allclose(found["velocity"], 10.0 * twist, atol=1e-7)


def test_constant_acceleration_is_exact_for_cubics_and_off_by_an_eighth_for_geodesics() -> None:
    h, a, v = 0.5, np.array([0.3, -0.2, 0.7]), np.array([1.0, 2.0, -1.0])
    zero = INERTIAL.identity()[None]
    states = [zero.copy(), zero.copy(), zero.copy()]
    for t, state in zip((0.0, h, 0.5 * h), states, strict=True):
        state[0, INERTIAL.component("p").storage] = v * t + 0.5 * a * t**2
        state[0, INERTIAL.component("v").storage] = v + a * t
    x, y, middle = states
    half, step = np.array([0.5]), np.array([h])
    assert np.abs(INERTIAL.local(middle, cubic(INERTIAL)(x, y, half, step))).max() < 1e-14
    first, last, between = (fg.SE23.from_parts(*(INERTIAL.unpack(z)[k] for k in "pvR")) for z in (x, y, middle))
    np.testing.assert_allclose(cubic(fg.SE23)(first, last, half, step), between, atol=1e-14)
    straight = INERTIAL.unpack(geodesic(INERTIAL)(x, y, half, step))["p"] - INERTIAL.unpack(middle)["p"]
    np.testing.assert_allclose(straight[0], a * h**2 / 8.0, atol=1e-14)


@pytest.mark.parametrize("states", [TWIST2, TWIST3, INERTIAL], ids=lambda m: m.name)
def test_cubics_are_of_fourth_order_and_their_velocities_of_third(states: fg.Product) -> None:
    """A body under a twist that swings, integrated finely; halving the step divides the errors by 16 and by 8."""
    group = states.components["pose"].manifold if "pose" in states.components else fg.SE3
    assert isinstance(group, fg.LieGroup)

    def twist(t: float) -> Array:
        return np.array([np.sin(1.3 * k + 2.0 * t) for k in range(group.dim)])

    def at(t: float) -> Array:
        pose, count = group.identity(), max(int(t / 1e-3), 1) if t else 0
        for k in range(count):  # fourth order: Magnus with two Gauss points
            d = t / count
            one, two = (twist(d * (k + 0.5 + c * np.sqrt(3.0) / 6.0)) for c in (-1.0, 1.0))
            bracket = group.ad(one) @ two
            pose = group.retract(pose, 0.5 * d * (one + two) + np.sqrt(3.0) / 12.0 * d**2 * bracket)
        if states is INERTIAL:
            q, velocity = pose[3:], fg.SO3.act(pose[3:], twist(t)[:3])
            return states.pack(R=q, p=pose[:3], bias=np.zeros(2), v=velocity)
        parts = {"pose": pose, "velocity": twist(t)}
        return states.pack(**(parts | ({"bias": np.zeros(1)} if "bias" in states.components else {})))

    errors = []
    for h in (0.2, 0.1):
        x, y, middle = (at(t)[None] for t in (0.0, h, 0.4 * h))
        found = cubic(states)(x, y, np.array([0.4]), np.array([h]))
        off = states.local(middle, found)[0]
        moving = "velocity" if states is not INERTIAL else "v"
        position = "pose" if states is not INERTIAL else "p"
        errors.append([np.abs(off[states.component(name).tangent]).max() for name in (position, moving)])
    orders = np.log2(np.array(errors[0]) / errors[1])
    assert orders[0] > 3.7 and orders[1] > 2.7, orders


# ---------------------------------------------------------------- a graph with fixes


def sensor(size: int = 2, capacity: int = 1, name: str = "fixes", **options: Any) -> StampedMeasurements:
    return StampedMeasurements(place, size, capacity=capacity, sigma=1.0, name=name, **options)


def window(count: int = 5, capacity: int = 3) -> tuple[fg.Graph, fg.Family, StampedMeasurements]:
    graph, x = graph_with(fg.SE2, count)
    fixes = StampedMeasurements(place, 2, capacity=capacity, sigma=0.05, name="fixes")
    fixes.state(graph, x)
    moved = graph.data("moved", np.tile([0.1, 0.0, 0.05], (count - 1, 1)), each=True)
    graph.minimize(fg.between, x[:-1], x[1:], moved, sigma=[0.02, 0.02, 0.02], name="wheels")
    graph.minimize(fg.prior, x[0], fg.SE2.identity(), sigma=1.0, name="start")
    return graph, x, fixes


TIMES = 0.1 * np.arange(5)
ZERO = np.zeros((5, 3))


def test_a_stamp_on_a_node_is_a_factor_of_that_node(rng: Generator) -> None:
    """On the oldest, one inside, the newest; bit for bit the same structure, answers as of unary factors."""
    values = rng.normal(size=(3, 2))
    graph, x, fixes = window()
    fixes.add(TIMES[[4, 0, 2]], values)
    solver = GaussNewton(tolerance=1e-14, max_iterations=12)  # as many steps of both, whatever each graph would end at
    solution = solver.solve(graph, {x: ZERO}, data=fixes.at(graph, TIMES))
    assert fixes.counts == Counts(placed=3)

    plain, y, _ = window()
    plain.minimize(place, y[[4, 0, 2]], values, sigma=0.05)
    expected = solver.solve(plain, {y: ZERO})
    assert solution.iterations == expected.iterations == 12
    assert np.abs(fg.SE2.local(solution[x], expected[y])).max() < 1e-9
    assert graph.check({x: ZERO}).routes["fixes"] == "traced, its derivatives exact"


def test_order_of_arrival_changes_no_bit(rng: Generator) -> None:
    stamps, values = rng.uniform(0.0, 0.4, 8), rng.normal(size=(8, 2))
    stamps[3] = stamps[5]  # equal stamps
    values[3] = values[5]
    answers = []
    for order in (np.arange(8), np.argsort(stamps), rng.permutation(8)):
        graph, _, fixes = window(capacity=8)
        for k in order:
            fixes.add(stamps[k], values[k])
        answers.append(list(fixes.at(graph, TIMES).values()))
        assert fixes.counts.placed == 8
    for other in answers[1:]:
        for found, wanted in zip(other, answers[0], strict=True):
            assert np.array_equal(found, wanted)


def test_what_is_refused_is_counted() -> None:
    graph, _, fixes = window(capacity=2)
    value = np.zeros(2)
    fixes.add(np.nan, value)
    fixes.add(0.1, [np.inf, 0.0])
    fixes.add([0.22, 0.24, 0.23, 0.25], np.zeros((4, 2)))  # two too many
    fixes.add(-0.01, value)  # before the oldest node
    fixes.add(0.41, value)  # after the newest
    fixes.add(np.full(9, 1e12), np.zeros((9, 2)))  # a clock gone mad
    fixes.at(graph, TIMES)
    assert fixes.counts == Counts(placed=2, waiting=8, late=1, full=2, ahead=2, invalid=2)
    fixes.at(graph, TIMES)  # nothing is counted twice
    assert fixes.counts == Counts(placed=2, waiting=8, late=1, full=2, ahead=2, invalid=2)
    given = fixes.at(graph, TIMES + 0.1)  # what waited near is placed; all that was placed stays
    assert fixes.counts == Counts(placed=3, waiting=7, late=1, full=2, ahead=2, invalid=2)
    filled = next(value for data, value in given.items() if data.name == "fixes: measured")
    assert filled.tolist() == [False, False, True, True, False, False, True, False]
    fixes.at(graph, TIMES + 0.45)  # placed ones leave with their nodes: not late
    assert fixes.counts == Counts(placed=0, waiting=7, late=1, full=2, ahead=2, invalid=2)
    fixes.add(0.3, value)
    fixes.at(graph, TIMES + 0.45)
    assert fixes.counts == Counts(placed=0, waiting=7, late=2, full=2, ahead=2, invalid=2)


def test_first_come_keeps_its_slot() -> None:
    graph, _, fixes = window(capacity=1)
    fixes.add(0.15, [1.0, 1.0])
    fixes.at(graph, TIMES)
    fixes.add(0.12, [2.0, 2.0])
    given = fixes.at(graph, TIMES)
    assert next(value for data, value in given.items() if data.name == "fixes")[1].tolist() == [1.0, 1.0]
    assert fixes.counts == Counts(placed=1, full=1)


@pytest.mark.parametrize("epoch", [0.0, 1.7e9])
def test_rounding_of_node_times_keeps_measurements_on_the_ends(epoch: float) -> None:
    """Times counted back from now differ from those counted forward by rounding; so do stamps of other clocks."""
    graph, _, fixes = window()
    end = epoch + 0.1 * 3 + 0.1  # 0.4 and a little
    fixes.add([np.nextafter(end, np.inf), np.nextafter(epoch, -np.inf)], np.zeros((2, 2)))
    fixes.at(graph, epoch + TIMES)
    assert fixes.counts == Counts(placed=2)


def test_nodes_whose_measurements_have_left_are_named_in_full() -> None:
    graph, _, fixes = window()
    fixes.add(1.7e9 + 0.15, np.zeros(2))
    fixes.at(graph, 1.7e9 + 0.25 + TIMES)
    with pytest.raises(ModelError, match=r"nodes from 1700000000 s on are .* before 1700000000\.25 s has left"):
        fixes.at(graph, 1.7e9 + TIMES)


@pytest.mark.parametrize(
    ("kind", "act", "words"),
    [
        (ModelError, lambda graph, x, fixes: fixes.add(0.1, np.zeros(3)), r"need values \(2,\), found \(3,\)"),
        (
            ModelError,
            lambda graph, x, fixes: fixes.add(np.zeros(3), np.zeros((2, 2))),
            r"need values \(3, 2\), found \(2, 2\)",
        ),
        (
            fg.GraphError,
            lambda graph, x, fixes: fixes.add(np.zeros(3), np.ma.masked_array(np.zeros((3, 2)), [3 * [True]] * 2)),
            "'fixes': values is a masked array",
        ),
        (
            fg.GraphError,
            lambda graph, x, fixes: fixes.add(np.array(["2026-01-01"], dtype="M8[D]"), np.zeros((1, 2))),
            "'fixes': stamps must be real numbers, found dates",
        ),
        (
            fg.GraphError,
            lambda graph, x, fixes: fixes.add([0.1], [["1", "2"]]),
            "'fixes': values must be real numbers, found text",
        ),
        (ModelError, lambda graph, x, fixes: fixes.at(graph, TIMES[:4]), "5 finite, increasing numbers"),
        (ModelError, lambda graph, x, fixes: fixes.at(graph, TIMES[::-1]), "5 finite, increasing numbers"),
        (ModelError, lambda graph, x, fixes: fixes.at(graph, np.zeros(5)), "5 finite, increasing numbers"),
        (
            ModelError,
            lambda graph, x, fixes: fixes.at(graph, [0.0, 0.1, np.nan, 0.3, 0.4]),
            "5 finite, increasing numbers",
        ),
        (ModelError, lambda graph, x, fixes: fixes.at(graph, TIMES, offset=np.nan), "finite, increasing"),
        (fg.GraphError, lambda graph, x, fixes: sensor(name="stamped").at(graph, TIMES), "stamped"),
        (ModelError, lambda graph, x, fixes: sensor(offset="x").state(graph, x[0]), "two nodes or more"),
        (ModelError, lambda graph, x, fixes: sensor(offset="x").state(graph, x), r"one variable on Rn\(1\)"),
        (ModelError, lambda graph, x, fixes: sensor(0), "must be at least 1"),
        (ModelError, lambda graph, x, fixes: sensor(capacity=0), "must be at least 1"),
    ],
)
def test_shapes_and_times_are_checked(kind: type[Exception], act: Any, words: str) -> None:
    graph, x, fixes = window()
    with pytest.raises(kind, match=words):
        act(graph, x, fixes)
    assert fixes.counts == Counts()


def test_single_numbers_need_no_second_axis() -> None:
    graph, x, _ = window()
    ranges = sensor(1, capacity=2, name="ranges")
    ranges.add([0.1, 0.2], [1.0, 2.0])
    ranges.add(0.3, 3.0)
    ranges.state(graph, x)
    ranges.at(graph, TIMES)
    assert ranges.counts.placed == 3


# ---------------------------------------------------------------- tick after tick


def drive(t: float) -> Array:
    """A circle: one constant twist, headings past the cut at pi, 1e6 m from the origin."""
    return fg.SE2.compose([1e6, 0.0, 2.8], fg.SE2.exp(t * np.array([1.0, 0.0, 0.6])))


def test_a_sliding_window_with_delays_is_the_batch_of_what_has_come(rng: Generator) -> None:
    """Three sensors at their own rates and delays; one loses readings; each tick equals a graph built for it alone."""

    def direction(x: Array, z: Array) -> Array:
        return fg.wrap_angle(x[:, 2:] - z)

    beacon = drive(1.0)[:2] + np.array([3.0, 2.0])

    def gap(x: Array, z: Array) -> Array:
        return np.asarray(np.linalg.norm(x[:, :2] - beacon, axis=1, keepdims=True) - z)

    step, count = 0.1, 6
    readings: list[tuple[float, str, float, Array]] = []  # arrival, sensor, stamp, value
    for rate, name, lag in ((7.3, "fix", 0.17), (23.0, "direction", 0.0), (4.0, "gap", 0.6)):
        for stamp in np.arange(0.01, 2.0, 1.0 / rate):
            pose = drive(stamp)
            reach = np.atleast_1d(np.linalg.norm(pose[:2] - beacon))
            value = {"fix": pose[:2], "direction": pose[2:], "gap": reach}[name]
            if name == "fix" and 0.8 < stamp < 1.1:
                continue  # an outage
            arrival = stamp + lag * rng.uniform(0.5, 1.0)
            readings.append((arrival, name, stamp, value + 0.01 * rng.standard_normal(len(value))))
    readings.sort(key=lambda r: r[0])

    def stated(graph: fg.Graph, x: fg.Family) -> dict[str, StampedMeasurements]:
        sensors = {
            "fix": StampedMeasurements(place, 2, capacity=1, sigma=0.01, name="fix"),
            "direction": StampedMeasurements(direction, 1, capacity=3, sigma=0.01, name="direction"),
            "gap": StampedMeasurements(gap, 1, capacity=1, sigma=0.01, name="gap", robust=fg.Huber(3.0)),
        }
        for sensor in sensors.values():
            sensor.state(graph, x)
        odometry = fg.SE2.exp(step * np.array([1.0, 0.0, 0.6]))
        graph.minimize(fg.between, x[:-1], x[1:], odometry, sigma=[0.01, 0.01, 0.01])
        return sensors

    graph, x = graph_with(fg.SE2, count)
    sensors = stated(graph, x)
    start = graph.data("start", drive(0.0))
    graph.minimize(fg.prior, x[0], start, sigma=0.02)
    run = LevenbergMarquardt().prepare(graph)
    program, waiting, ticks = graph.compile(), list(readings), 0
    for tick in range(count - 1, 20):
        times = step * np.arange(tick - count + 1, tick + 1)
        while waiting and waiting[0][0] <= times[-1]:
            _, name, stamp, value = waiting.pop(0)
            sensors[name].add(stamp, value)
        data = {key: part for sensor in sensors.values() for key, part in sensor.at(graph, times).items()}
        guess = {x: np.array([drive(t) for t in times])}
        data[start] = guess[x][0]
        if tick == count:
            with counting() as tally:
                solution = run.solve(guess, data=data)
            assert tally.everything == 0  # nothing is compiled or read
        solution = run.solve(guess, data=data)
        assert solution.converged and graph.compile() is program
        assert np.abs(fg.SE2.local(solution[x], guess[x])).max() < 0.06
        if tick % 5:
            continue

        own, y = graph_with(fg.SE2, count)
        own.minimize(fg.prior, y[0], data[start], sigma=0.02)
        own.minimize(fg.between, y[:-1], y[1:], fg.SE2.exp(step * np.array([1.0, 0.0, 0.6])), sigma=[0.01, 0.01, 0.01])
        for arrival, name, stamp, value in readings:
            if not (arrival <= times[-1] and times[0] <= stamp <= times[-1]):
                continue
            k = min(int(np.searchsorted(times, stamp, side="right")) - 1, count - 2)
            s = (stamp - times[k]) / step

            def between(a: Array, b: Array, s: float = s) -> Array:
                return fg.SE2.compose(a, fg.SE2.exp(s * fg.SE2.log(fg.SE2.compose(fg.SE2.inverse(a), b))))

            error = {"fix": place, "direction": direction, "gap": gap}[name]
            own.minimize(
                fg.residual(lambda a, b, z, e=error, m=between: e(m(a, b), z), derivatives="differences"),
                y[k], y[k + 1], value, sigma=0.01, robust=fg.Huber(3.0) if name == "gap" else None,
            )  # fmt: skip
        expected = LevenbergMarquardt().solve(own, {y: guess[x]}, check=True)
        assert np.abs(fg.SE2.local(solution[x], expected[y])).max() < 1e-6
        ticks += 1
    assert ticks == 3
    assert sensors["gap"].counts.late > 0 and sensors["fix"].counts.late == 0
    assert sum(getattr(s.counts, name) for s in sensors.values() for name in ("full", "invalid", "ahead")) == 0


@pytest.mark.parametrize("between", [None, cubic(TWIST2)], ids=["geodesic", "cubic"])
def test_the_offset_of_a_clock_is_estimated(between: Interpolation | None, rng: Generator) -> None:
    """The sensor's clock is 37 ms behind: the truth at a stamp is that at the stamp plus 37 ms."""
    offset, count, step = 0.037, 21, 0.1
    manifold = TWIST2 if between else fg.SE2
    truth = np.array([drive(t) for t in step * np.arange(count)])
    if between:
        truth = np.concatenate([truth, np.tile([1.0, 0.0, 0.6], (count, 1))], axis=1)
    graph, x, late = graph_of(("x", manifold, count), ("late", fg.Rn(1), 1))
    fixes = StampedMeasurements(place, 2, capacity=2, sigma=0.01, between=between, offset="late", name="fixes")
    fixes.state(graph, x)
    graph.minimize(fg.prior, x, truth, sigma=0.01, name="own clock")
    graph.minimize(fg.prior, late, [0.0], sigma=1.0, name="offset")
    stamps = np.arange(0.02, 1.95, 0.07)
    fixes.add(stamps, np.array([drive(t + offset)[:2] for t in stamps]))
    believed = 0.0
    for _ in range(2):  # placed anew by what is believed
        data = fixes.at(graph, step * np.arange(count), offset=believed)
        solution = LevenbergMarquardt().solve(graph, {x: truth, late: [[0.0]]}, data=data, check=True)
        believed = float(solution[late][0, 0])
    assert abs(believed - offset) < 1e-4
    assert fixes.counts.placed == len(stamps)


def test_an_offset_that_is_known_moves_the_stamps() -> None:
    graph, _, fixes = window()
    fixes.add([0.02, 0.39], np.zeros((2, 2)))
    given = {data.name: value for data, value in fixes.at(graph, TIMES, offset=0.09).items()}
    assert fixes.counts == Counts(placed=1, waiting=1)
    np.testing.assert_allclose(given["fixes: time into step"][3], 0.01, atol=1e-15)


def test_errors_may_be_shipped_residuals_with_landmarks(rng: Generator) -> None:
    """The bearing and range of a landmark, itself unknown, seen between two nodes of a quadrotor."""
    graph, x, mark = graph_of(("x", STATE, 4), ("mark", fg.Rn(2), 1))
    seen = StampedMeasurements(
        landmarks.bearing_range,
        2,
        capacity=2,
        sigma=[0.01, 0.02],
        between=cubic(STATE),
        constants=("mark",),
        name="seen",
    )
    seen.state(graph, x)
    truth = np.tile(STATE.identity(), (4, 1))
    truth[:, 0], truth[:, 7] = [0.0, 1.0, 2.0, 3.0], 10.0
    graph.minimize(fg.prior, x, truth, sigma=0.001)
    place = np.array([1.5, 2.0])
    for t in (0.05, 0.17, 0.22):
        state = STATE.identity()
        state[0] = 10.0 * t
        seen.add(t, landmarks.observe(state, place[None])[0])
    data = seen.at(graph, [0.0, 0.1, 0.2, 0.3])
    solution = LevenbergMarquardt().solve(graph, {x: truth, mark: [[1.0, 1.0]]}, data=data, check=True)
    np.testing.assert_allclose(solution[mark][0], place, atol=1e-9)
    assert graph.check({x: truth, mark: [[1.0, 1.0]]}).routes["seen"] == "traced, its derivatives exact"


def test_threads_add_while_others_ask() -> None:
    """Nothing is lost, and stamps and values stay together; copies and pickles have locks of their own."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        graph, x = graph_with(SE23, 5)
        graph.variables("bias", BIAS, 1)
        y = graph.variables("y", fg.Rn(1), 5)
        count, fixes = 600, StampedMeasurements(lambda x, z: x - z, 1, capacity=2000, sigma=1.0, name="fixes")
        imu = InertialMeasurements(ImuNoise())
        fixes.state(graph, y)
        imu.state(graph, x)

        def feed(share: int) -> None:
            for k in range(share, count, 2):
                stamp = 0.4 * k / count
                fixes.add(stamp, [stamp])
                imu.add(stamp, np.zeros(3), np.zeros(3))

        threads = [Thread(target=feed, args=(share,)) for share in (0, 1)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            fixes.at(graph, TIMES)
            imu.at(graph, TIMES, np.zeros(6))
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    given = {data.name: value for data, value in fixes.at(graph, TIMES).items()}
    assert fixes.counts == Counts(placed=count)
    on = given["fixes: measured"]
    stamps = (np.repeat(TIMES[:-1], 2000) + given["fixes: time into step"])[on]
    np.testing.assert_allclose(stamps, given["fixes"][on, 0], atol=1e-12)
    imu.at(graph, TIMES, np.zeros(6))
    assert imu.counts.kept == count
    for other in (deepcopy(imu), pickle.loads(pickle.dumps(imu))):
        other.add(9.0, np.zeros(3), np.zeros(3))
        assert other.counts.kept == count


def test_a_refused_sensor_leaves_the_graph_as_it_was() -> None:
    graph, x, bias = graph_of(("x", SE23, 3), ("bias", BIAS, 3))
    before = str(graph)
    with pytest.raises(fg.GraphError, match="sigma"):
        StampedMeasurements(lambda x, z: x[:, :2] - z, 2, capacity=1, sigma=-1.0, name="fixes").state(graph, x)
    for wrong in ({"offset": "clock"}, {"constants": ("x", "mark")}):
        role, name = next((key, value if isinstance(value, str) else value[1]) for key, value in wrong.items())
        fixes = StampedMeasurements(place, 2, capacity=1, sigma=1.0, name="fixes", **wrong)
        with pytest.raises(ModelError, match=f"'fixes': {role}= names '{name}', .*there are: 'x', 'bias'"):
            fixes.state(graph, x)
    assert str(graph) == before
    graph.minimize(fg.prior, bias, np.zeros(6), name="imu: biases")  # a name that is taken
    before = str(graph)
    with pytest.raises(fg.GraphError, match="imu: biases"):
        InertialMeasurements(ImuNoise()).state(graph, x)
    assert str(graph) == before
    graph.remove("imu: biases")
    InertialMeasurements(ImuNoise()).state(graph, x)
    StampedMeasurements(lambda x, z: x[:, :2] - z, 2, capacity=1, sigma=1.0, name="fixes").state(graph, x)


def test_functions_of_one_factor_are_refused() -> None:
    @compiled
    def one(x: Array, z: Array, r: Array) -> None:
        r[:] = x[:2] - z

    with pytest.raises(ModelError, match="give a batched function"):
        StampedMeasurements(fg.residual(one, rows=2), 2, capacity=1, sigma=1.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("solver", [GaussNewton, LevenbergMarquardt])
def test_untraceable_errors_still_work(solver: Callable[[], fg.Solver]) -> None:
    """Functions that branch on numbers are left to Python, empty slots among them."""

    def odd(x: Array, z: Array) -> Array:
        return x[:, :2] - z if float(z[0, 0]) < 1e9 else x[:, :2]

    graph, x = graph_with(fg.SE2, 3)
    fixes = StampedMeasurements(odd, 2, capacity=2, sigma=0.1, name="fixes")
    fixes.state(graph, x)
    graph.minimize(fg.prior, x, np.zeros(3), sigma=1.0)
    fixes.add(0.05, [0.1, 0.2])
    solution = solver().solve(graph, {x: np.zeros((3, 3))}, data=fixes.at(graph, [0.0, 0.1, 0.2]), check=True)
    assert solution[x][0, 0] > 0.04


# ---------------------------------------------------------------- a log


@pytest.mark.data
def test_ranges_of_a_lawn_mower_between_sparse_nodes(shared_data: Path) -> None:
    """Plaza 1: four beacons at 1.8 Hz, nodes every 4 s; ranges are too long by a factor that is estimated along.

    Ranges taken at the nearest node instead are what one does without interpolation.
    """
    with gzip.open(shared_data / "landmarks" / "Plaza1_.mat.gz") as file:
        log = loadmat(BytesIO(file.read()))
    beacons = {int(row[0]): row[1:] for row in log["TL"]}
    first, every, count = 600, 20, 60
    places = slice(first, first + every * count + 1, every)
    times, truth = log["GT"][places, 0], log["GT"][places, 1:]
    moved = np.tile(fg.SE2.identity(), (count, 1))
    steps = log["DR"][first : first + every * count, 1:].reshape(count, every, 2)
    for k in range(every):
        moved = fg.SE2.compose(moved, fg.SE2.exp(np.insert(steps[:, k], 1, 0.0, axis=1)))
    ranges = log["TD"][(log["TD"][:, 0] > times[0]) & (log["TD"][:, 0] < times[-1])]
    values = np.array([[*beacons[int(row[2])], row[3]] for row in ranges])

    def error(x: Array, long: Array, z: Array) -> Array:
        distance = np.linalg.norm(x[:, :2] - z[:, :2], axis=1, keepdims=True)
        return np.asarray(distance * (1.0 + long[:, 1:]) + long[:, :1] - z[:, 2:])

    graph, x, long = graph_of(("x", fg.SE2, count + 1), ("long", fg.Rn(2), 1))
    graph.minimize(fg.between, x[:-1], x[1:], moved, sigma=np.sqrt(every) * np.array([0.03, 0.03, 0.01]))
    graph.minimize(fg.prior, x[0], truth[0], sigma=[1.0, 1.0, 0.3])
    graph.minimize(fg.prior, long, [0.0, 0.0], sigma=[5.0, 0.2])
    guess = {x: truth[:1] + np.zeros((count + 1, 1)), long: np.zeros((1, 2))}
    for k in range(count):
        guess[x][k + 1] = fg.SE2.compose(guess[x][k], moved[k])
    nearest = times[np.argmin(np.abs(times[:, None] - ranges[:, 0]), axis=0)]
    off = {}
    for name, stamps in (("interpolated", ranges[:, 0]), ("nearest", nearest)):
        sensor = StampedMeasurements(
            error, 3, capacity=20, sigma=0.7, constants=("long",), robust=fg.Huber(1.345), name=name
        )
        sensor.state(graph, x)
        sensor.add(stamps, values)
        solution = LevenbergMarquardt().solve(graph, guess, data=sensor.at(graph, times), check=True)
        graph.remove(name)
        assert sensor.counts == Counts(placed=len(ranges))
        off[name] = float(np.sqrt(np.mean(np.sum((solution[x][:, :2] - truth[:, :2]) ** 2, axis=1))))
    assert len(ranges) == 441 and off["interpolated"] < 0.2 < 0.35 < off["nearest"], off
