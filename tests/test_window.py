"""Windows against whole histories: the past of any robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of
from test_horizon import (
    BIAS,
    BIASED,
    GPS,
    KNOWN,
    LINE,
    NOISE,
    START,
    TARGET,
    B,
    Drive,
    T,
    carry_on,
    drive,
    line_loop,
    line_window,
    position,
    step,
    ticks,
)
from unifg.horizon import (
    COUPLINGS,
    Constant,
    Context,
    Dynamics,
    Measurement,
    Robot,
    Term,
    Window,
)
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array, ArrayLike


@pytest.mark.product(2)
@pytest.mark.parametrize("length", [1, 3, 7])
@pytest.mark.parametrize("static", [False, True])
def test_a_window_says_what_the_whole_history_says(length: int, static: bool) -> None:
    """From the first tick, while the window is not full yet, to long after the start has left it."""
    drive, window = Drive(20), line_window(length, BIASED if static else LINE)
    for k in range(21):
        carry_on(window, drive, k)
        state, covariance, bias = drive.batch(k, static)
        np.testing.assert_allclose(window.present, state, atol=1e-9)
        np.testing.assert_allclose(window.covariance, covariance, atol=1e-9)
        if static:
            np.testing.assert_allclose(window.history.constants["bias"][0], bias, atol=1e-9)
    assert window.history.full and window.left.arrival is not None


class Pushed(Term):
    """Exact dynamics pushed by one noise per step, fewer than there are states: constraints of the past."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        noise = graph.families["noise"]
        graph.minimize(fg.prior, noise, [0.0], sigma=0.4, name="noise")
        graph.constrain(
            lambda x, u, w, y: y - x @ T.T - (u + w) @ B.T, x[:-1], u, noise, x[1:], lower=0, upper=0, name="pushed"
        )
        graph.constrain(lambda w: w, noise, lower=-50.0, upper=50.0, name="weak")  # an inequality that never holds


@pytest.mark.parametrize(
    "solver", [SQP(tolerance=1e-11, qp="graph"), InteriorPoint(tolerance=1e-11)], ids=["sqp", "ipm"]
)
def test_what_leaves_through_constraints_is_not_lost(solver: fg.Solver) -> None:
    """The marginal of a node and its noise through a hard dynamics, against the batch with the same constraints."""
    drive, robot = Drive(14, seed=2), replace(LINE, steps={"noise": fg.Rn(1)})
    terms: list[Term] = [Pushed(), Measurement("gps", position, (1,), GPS)]
    window: Window = Window(robot, 4, terms, start=START, sigma=0.8, solver=solver)
    for k in range(15):
        carry_on(window, drive, k)
    graph, x, w = graph_of(("x", fg.Rn(2), 15), ("w", fg.Rn(1), 14))
    graph.minimize(fg.prior, x[0], START, sigma=0.8)
    graph.minimize(fg.prior, w, [0.0], sigma=0.4)
    each = graph.data("u", drive.controls, each=True)
    graph.constrain(lambda x, u, w, y: y - x @ T.T - (u + w) @ B.T, x[:-1], each, w, x[1:], lower=0, upper=0)
    at = np.flatnonzero(drive.seen)
    graph.minimize(position, x[at], graph.data("z", drive.positions[at], each=True), sigma=GPS)
    whole = SQP(tolerance=1e-12).solve(graph, {x: np.zeros((15, 2)), w: np.zeros((14, 1))})
    np.testing.assert_allclose(window.history.states, whole[x][-5:], atol=1e-9)
    # Where constraints hold, a covariance softens them by 1e-5 in their own units.
    np.testing.assert_allclose(window.state_covariance, whole.covariance(x[-1]), atol=1e-7)


@pytest.mark.parametrize("unit", [1e3, 1.0, 1e-3, 1e-6])
def test_a_covariance_through_exact_dynamics_is_the_same_in_any_unit(unit: float) -> None:
    """Of a robot that a constant drift moves: softening its motion by 1e-5 km would be a centimetre."""
    drift = Constant("drift", fg.Rn(1), [0.0], 0.1 * unit)
    robot = Robot(fg.Rn(1), fg.Rn(1), constants=(drift,), predict=lambda x, u: x + 0.1 * u)
    motion = Dynamics(lambda x, u, c, y, h: y - x - h * (u + c), 0.1, constants=("drift",))
    terms: list[Term] = [motion, Measurement("gps", position, (1,), 0.3 * unit)]
    window = Window(robot, 3, terms, start=[0.0], sigma=0.05 * unit)
    for k in ticks(window, 6, unit):
        window.record("gps", [0.1 * k * unit])
    rows = np.stack([np.ones(6), 0.1 * np.arange(6)], axis=1)  # of the start and the drift
    whole = np.linalg.inv(np.diag([0.05**-2, 0.1**-2]) + rows.T @ rows / 0.3**2)
    present = np.array([[1.0, 0.5], [0.0, 1.0]])
    expected, scale = present @ whole @ present.T, np.array([[0.05], [0.1]])
    np.testing.assert_allclose(window.covariance / unit**2 / (scale * scale.T), expected / (scale * scale.T), atol=1e-3)


class Smooth:
    """A cost over three nodes in a row, and a mark seen from them: what leaves ties two nodes and the mark."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(lambda a, b, c: a - 2.0 * b + c, x[:-2], x[1:-1], x[2:], sigma=0.3, name="smooth")
        seen = graph.data("marked", np.zeros(len(x), dtype=bool), each=True)
        mark = graph.families["mark"]
        graph.minimize(lambda x, m: m - x[:, :1], x, mark[0], sigma=0.2, active=seen, name="mark")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"marked": np.round(now.past.times) % 3 == 0}


def test_factors_over_several_nodes_leave_whole() -> None:
    robot = replace(LINE, constants=(Constant("mark", fg.Rn(1), [[0.0], [7.0]], [[2.0], [0.1]]),))
    terms: list[Term] = [
        Smooth(),
        Measurement("gps", position, (1,), GPS),
        Measurement("speed", lambda x, z: x[:, 1:] - z, (1,), 1.0),
    ]
    exact = GaussNewton(tolerance=1e-12)
    window: Window = Window(robot, 3, terms, start=START, sigma=0.8, solver=exact)
    drive, count = Drive(12, seed=3), 13
    graph, x, m = graph_of(("x", fg.Rn(2), count), ("m", fg.Rn(1), 2))
    graph.minimize(fg.prior, x[0], START, sigma=0.8)
    graph.minimize(fg.prior, m, [[0.0], [7.0]], sigma=[[2.0], [0.1]])
    graph.minimize(lambda a, b, c: a - 2.0 * b + c, x[:-2], x[1:-1], x[2:], sigma=0.3)
    graph.minimize(lambda x, m: m - x[:, :1], x[::3], m[0], sigma=0.2)
    at = np.flatnonzero(drive.seen)
    graph.minimize(position, x[at], graph.data("z", drive.positions[at], each=True), sigma=GPS)
    graph.minimize(lambda x: x[:, 1:] - 0.3, x, sigma=1.0)
    whole = exact.solve(graph, {x: np.zeros((count, 2)), m: np.zeros((2, 1))})
    for k in ticks(window, count):
        window.record("gps", drive.positions[k])
        window.record("speed", [0.3])
    np.testing.assert_allclose(window.history.states, whole[x][-4:], atol=1e-9)
    np.testing.assert_allclose(window.history.constants["mark"], whole[m], atol=1e-9)


def test_a_late_measurement_counts_as_one_in_time() -> None:
    drive, early, late = Drive(10, seed=4), line_window(4), line_window(4)
    drive.positions[8] = 0.7
    for k in range(11):
        for window in (early, late):
            if k:
                window.move(drive.controls[k - 1])
            if window is early or k != 8:
                window.record("gps", drive.positions[k])
            if window is late and k == 10:
                window.record("gps", drive.positions[8], node=-3)
            window.estimate(None)
    np.testing.assert_allclose(late.history.states, early.history.states, atol=1e-9)


@pytest.mark.parametrize(
    ("method", "given", "options", "message"),
    [
        ("record", ("pgs", [0.0]), {}, r"nothing measures 'pgs'.*gps"),
        ("record", ("gps", [0.0, 0.0]), {}, r"shape \(2,\), expected \(1,\)"),
        ("record", ("gps", [0.0]), {"node": -3}, "the window holds nodes 2..3"),  # nothing has entered there yet
        ("move", ([np.nan],), {}, "must be"),
        ("move", ([0.0],), {"time": 2.0}, "not later"),
    ],
)
def test_what_cannot_be_recorded_is_refused(method: str, given: Any, options: dict[str, Any], message: str) -> None:
    window = line_window(3)
    window.estimate(None)
    window.move([0.0], time=2.0)
    with pytest.raises(fg.GraphError, match=message):
        getattr(window, method)(*given, **options)


def test_an_estimate_that_is_none_leaves_the_prediction() -> None:
    """A mark of which nothing is known and nothing is seen: the states are estimated, and leave, all the same."""
    robot = replace(LINE, constants=(Constant("mark", fg.Rn(1), [3.0], np.inf),))
    terms: list[Term] = [
        Dynamics(step, 0.1, sigma=NOISE),
        Measurement("gap", lambda x, m, z: m - x[:, :1] - z, (1,), 0.1, ("mark",)),
    ]
    window: Window = Window(robot, 2, terms, start=START, sigma=0.1)
    for k in range(8):
        if k:
            window.move([0.0])
        window.record("gap", [1.0] if k == 6 else None)
        window.estimate(None)
        assert np.isfinite(window.present).all()
        assert (window.history.constants["mark"][0, 0] == 3.0) == (k < 6)
    assert window.history.constants["mark"][0, 0] == pytest.approx(0.5 + 0.6 + 1.0, abs=0.2)


class Marks:
    """Gaps to marks, each seen or not: what a landmark's slots are."""

    records: ClassVar = {"gaps": (2, 2)}

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        gaps = graph.data("gaps", np.zeros((2 * len(x), 1)), each=True)
        seen = graph.data("seen", np.zeros(2 * len(x), dtype=bool), each=True)
        marks = graph.families["mark"][np.tile([0, 1], len(x))]
        graph.minimize(
            lambda x, m, z: m - x[:, :1] - z, x[np.repeat(np.arange(len(x)), 2)], marks, gaps, sigma=0.1, active=seen,
            name="gaps",
        )  # fmt: skip

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        rows = now.past.recorded("gaps")[0].reshape(-1, 2)
        return {"gaps": rows[:, :1], "seen": rows[:, 1] > 0.0}


def test_a_slot_that_gets_another_landmark_forgets_the_first() -> None:
    """Mark 0 is seen until it has left the window, then its slot holds another one: the batch has three marks."""
    robot = replace(LINE, constants=(Constant("mark", fg.Rn(1), [[0.0], [0.0]], 1e3),))
    terms: list[Term] = [Dynamics(step, 0.1, sigma=NOISE), Marks()]
    exact = GaussNewton(tolerance=1e-12)
    window = Window(robot, 2, terms, start=START, sigma=0.8, solver=exact)
    rng, count, change = np.random.default_rng(7), 13, 8
    gaps = rng.normal(size=(count, 2))
    seen = np.array([[k < 4 or k >= change, True] for k in range(count)])
    for k in ticks(window, count):
        if k == change:
            window.forget("mark", 0)
            window.admit("mark", 0, [1.0], 1e3)
            assert window.history.constants["mark"][0, 0] == 1.0
        window.record("gaps", np.column_stack([gaps[k], seen[k]]))
    graph, x, m = graph_of(("x", fg.Rn(2), count), ("m", fg.Rn(1), 3))
    graph.minimize(fg.prior, x[0], START, sigma=0.8)
    graph.minimize(fg.prior, m, [[0.0], [0.0], [1.0]], sigma=1e3)
    still = graph.data("u", np.zeros((count - 1, 1)), each=True)
    graph.minimize(step, x[:-1], still, x[1:], 0.1, sigma=NOISE)
    at, j = np.nonzero(seen)
    which = np.where((j == 0) & (at >= change), 2, j)
    values = graph.data("z", gaps[at, j][:, None], each=True)
    graph.minimize(lambda x, m, z: m - x[:, :1] - z, x[at], m[which], values, sigma=0.1)
    whole = exact.solve(graph, {x: np.zeros((count, 2)), m: np.zeros((3, 1))})
    # What was believed of the first mark before it was seen, to a kilometre, goes with it.
    np.testing.assert_allclose(window.present, whole[x][-1], atol=1e-6)
    np.testing.assert_allclose(window.history.constants["mark"], whole[m][[2, 1]], atol=1e-6)
    scale = np.sqrt(np.outer(*[np.diag(window.covariance)] * 2))
    expected = whole.covariance(x[-1], m[2], m[1])
    np.testing.assert_allclose(window.covariance / scale, expected / scale, atol=1e-6)
    assert window.covariance[window.place("mark", 1), window.place("mark", 1)] == pytest.approx(
        expected[3:, 3:], rel=1e-6
    )


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_what_is_known_is_no_unknown(coupling: Any) -> None:
    """A bias that is known is the same in every graph, and no measurement or wish moves it."""
    loop = line_loop(KNOWN, coupling=coupling)
    plans, _ = drive(loop, 12)
    assert loop.constants["bias"][0, 0] == BIAS
    before, after = plans[-1].states[:2]
    np.testing.assert_allclose(after, T @ before + B @ (plans[-1].control + BIAS), atol=1e-6)
    assert loop.window is not None
    assert not loop.window.covariance[loop.window.place("bias")].any()


class Timed:
    """Exact motion with noise on the speed, over the time between nodes."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        noise, times = graph.families["noise"], graph.data("durations", np.zeros(len(x) - 1), each=True)
        graph.minimize(fg.prior, noise, [0.0], sigma=0.4, name="noise")

        def moved(x: Array, u: Array, w: Array, y: Array, h: Array) -> Array:
            speed = x[:, 1:] + h[:, None] * (u + w)
            return np.concatenate([y[:, :1] - x[:, :1] - h[:, None] * x[:, 1:], y[:, 1:] - speed], axis=1)

        graph.constrain(moved, x[:-1], u, noise, x[1:], times, lower=0, upper=0, name="moved")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"durations": np.diff(now.past.times)}


def test_a_window_filled_by_steps_of_no_duration_is_one_that_fills_up() -> None:
    robot = replace(LINE, steps={"noise": fg.Rn(1)})
    terms: list[Term] = [Timed(), Measurement("gps", position, (1,), GPS)]
    solver = SQP(tolerance=1e-11, qp="graph")
    windows = [Window(robot, 5, terms, start=START, sigma=0.8, solver=solver, filled=f) for f in (False, True)]
    drive = Drive(9, seed=8)
    for k in range(10):
        for window in windows:
            if k:
                window.move(drive.controls[k - 1], 0.1 * k)
            window.record("gps", drive.positions[k])
            window.estimate(None)
        np.testing.assert_allclose(windows[0].present, windows[1].present, atol=1e-9)
        # Covariances soften each constraint, those of steps of no duration too.
        np.testing.assert_allclose(windows[0].state_covariance, windows[1].state_covariance, rtol=1e-5, atol=1e-9)
    assert windows[1].history.empty == 0


class Floor:
    """A line on the floor that was seen, the first or the second: which one, depends on where the robot is believed."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        line = graph.data("line", np.zeros(1))
        graph.minimize(lambda x, z: x[:, :1] - z, x[-1], line, sigma=0.01, name="line")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"line": [1.0 if now.present[0] < 0.95 else 2.0]}


@pytest.mark.parametrize(("rounds", "solves", "place"), [(1, 1, 1.0), (2, 2, 2.0), (9, 3, 2.0)])
def test_data_that_depend_on_beliefs_are_asked_for_again(rounds: int, solves: int, place: float) -> None:
    """One round believes what it has found; more of them go on until the present stays where it is."""
    window = Window(LINE, 2, [Floor()], start=[0.9, 0.0], sigma=0.8, rounds=rounds, steady=1e-6)
    window.estimate(None)
    assert sum(window.statuses.values()) == solves
    assert window.present[0] == pytest.approx(place, abs=0.05)


def test_a_loop_made_on_a_window_leaves_what_it_knows() -> None:
    window = line_window(4)
    for k in ticks(window, 6, 0.1):
        window.record("gps", [0.1 * k])
    states = window.history.states.copy()
    loop = line_loop(window=window, coupling="joint")
    assert np.array_equal(window.history.states, states)
    loop.plan(window.present, TARGET)
    assert np.array_equal(window.history.states, states)  # the window carries on what the past alone says
    assert np.abs(loop.estimate - window.present).max() > 1e-6
    loop.tick(TARGET)
    assert window.history.times[-1] == pytest.approx(0.6)
