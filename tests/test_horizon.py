"""Windows against whole histories, plans against deadlines and failures: past and future of any robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.codegen.compile_counter import counting
from unifg.horizon import (
    COUPLINGS,
    Constant,
    Context,
    ControlCost,
    Decision,
    Dynamics,
    InitialGuesses,
    LastPlanThenBrake,
    Measurement,
    Plan,
    RecedingHorizon,
    Robot,
    Term,
    Window,
)
from unifg.models import unicycle
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.solvers.names import backends
from unifg.typing import Array, ArrayLike

# ---------------------------------------------------------------- a linear robot, and what everybody knows about it

T, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
NOISE, GPS, START = np.array([0.02, 0.05]), 0.3, np.array([0.5, 1.0])
BIAS = 0.4


def step(x: Array, u: Array, y: Array, h: float) -> Array:
    return np.asarray(y - x @ T.T - u @ B.T)


def biased(x: Array, u: Array, b: Array, y: Array, h: float) -> Array:
    return np.asarray(y - x @ T.T - (u + b) @ B.T)


def position(x: Array, z: Array) -> Array:
    return x[:, :1] - z


LINE = Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u: T @ x + B @ u)
BIASED = replace(LINE, constants=(Constant("bias", fg.Rn(1), [0.0], 0.5),))
KNOWN = replace(LINE, constants=(Constant("bias", fg.Rn(1), [BIAS], 0.0),))


class Drive:
    """Controls and measurements of a linear robot; some are missing."""

    def __init__(self, ticks: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.controls, self.seen = rng.normal(size=(ticks, 1)), rng.random(ticks + 1) < 0.7
        self.positions = np.where(self.seen, rng.normal(size=ticks + 1), np.nan)[:, None]

    def batch(self, ticks: int, static: bool) -> tuple[Array, Array, Array]:
        """State, covariance and bias after some ticks, from everything at once."""
        graph, x = graph_with(fg.Rn(2), ticks + 1)
        graph.minimize(fg.prior, x[0], START, sigma=0.8)
        about: list[fg.Family | fg.Selection] = [x[-1]]
        guess = {x: np.zeros((ticks + 1, 2))}
        u = self.controls[:ticks]
        if static:
            b = graph.variables("b", fg.Rn(1), 1)
            graph.minimize(fg.prior, b, [0.0], sigma=0.5)
            about.append(b)
            guess[b] = np.zeros((1, 1))
            if ticks:
                each = graph.data("u", u, each=True)
                graph.minimize(biased, x[:-1], each, b, x[1:], 0.1, sigma=NOISE)
        elif ticks:
            graph.minimize(step, x[:-1], graph.data("u", u, each=True), x[1:], 0.1, sigma=NOISE)
        k = np.flatnonzero(self.seen[: ticks + 1])
        if len(k):
            graph.minimize(position, x[k], graph.data("z", self.positions[k], each=True), sigma=GPS)
        solution = GaussNewton(tolerance=1e-12).solve(graph, guess)
        bias = solution[b][0] if static else np.zeros(1)
        return solution[x[-1]][0], solution.covariance(*about), bias


def line_window(length: int, robot: Robot = LINE, **options: Any) -> Window:
    names = tuple(static.name for static in robot.constants)
    motion = Dynamics(biased if names else step, 0.1, sigma=NOISE, constants=names)
    terms: list[Term] = [motion, Measurement("gps", position, (1,), GPS)]
    usual: dict[str, Any] = {"solver": GaussNewton(tolerance=1e-12)}
    return Window(robot, length, terms, start=START, sigma=0.8, **usual | options)


def carry_on(window: Window, drive: Drive, k: int) -> None:
    """Move to tick k of a drive, record what is seen there and estimate."""
    if k:
        window.move(drive.controls[k - 1])
    window.record("gps", drive.positions[k])
    window.estimate(None)


def ticks(window: Window, count: int, control: float = 0.0) -> Iterator[int]:
    """Numbers of ticks, each between the move to its node and the estimate: the time to record."""
    for k in range(count):
        if k:
            window.move([control])
        yield k
        window.estimate()


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


# ---------------------------------------------------------------- loops


class Goal:
    """Come to rest at what is given."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        goal = graph.data("goal", np.zeros(2))
        graph.minimize(fg.prior, x[1:], goal, sigma=[0.2, 0.5], name="goal")
        graph.bound(u, lower=-1.0, upper=1.0, name="limits")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"goal": now.given}


TARGET = np.array([1.5, 0.0])


def line_loop(robot: Robot = LINE, steps: int = 20, solver: fg.Solver | None = None, **options: Any) -> RecedingHorizon:
    names = tuple(static.name for static in robot.constants)
    motion = Dynamics(biased if names else step, 0.1, constants=names)
    terms: list[Term] = [motion, Goal(), ControlCost(sigma=[1.0], change=[2.0])]
    usual: dict[str, Any] = {"window": line_window(5, robot), "limits": (-np.ones(1), np.ones(1))}
    return RecedingHorizon(robot, steps, terms, solver=solver or InteriorPoint(), **usual | options)


def drive(loop: RecedingHorizon, ticks: int, seed: int = 0) -> tuple[list[Plan], Array]:
    """Plans, and the true states before them, of a robot whose controls have a bias if it has one."""
    rng, truth, plans, states = np.random.default_rng(seed), START.copy(), [], []
    bias = BIAS if loop.robot.constants else 0.0
    for k in range(ticks):
        states.append(truth)
        plans.append(loop.tick(TARGET, {"gps": truth[:1] + GPS * rng.normal(size=1)} if k % 3 else None))
        truth = T @ truth + B @ (plans[-1].control + bias) + NOISE * 0.3 * rng.normal(size=2)
    return plans, np.array(states)


BACKENDS = backends("ipm", "sqp", "alm")


@pytest.mark.product(2, of="drives and flights")
def test_backends_and_couplings_find_the_same_way() -> None:
    ends = {}
    for name, solver in BACKENDS.items():
        for coupling in ("sequential", "joint"):
            loop = line_loop(BIASED, solver=solver, coupling=coupling)
            plans, states = drive(loop, 60)
            assert loop.sources == {"solved": 60} and sum(loop.statuses.values()) == 60
            assert len(loop.milliseconds) == 60 and all(plan.milliseconds > 0.0 for plan in plans)
            assert states[-1] == pytest.approx(TARGET, abs=0.3)
            assert loop.constants["bias"][0, 0] == pytest.approx(BIAS, abs=0.3)
            assert np.array_equal(plans[-1].states[0], loop.estimate)
            ends[coupling, name] = states[-1]
    for coupling in ("sequential", "joint"):
        for name in ("sqp", "alm"):
            np.testing.assert_allclose(ends[coupling, name], ends[coupling, "ipm"], atol=1e-3)


@pytest.mark.parametrize(
    ("solver", "names"), [(SQP(), {"osqp"}), (SQP(qp="graph"), {"graph"}), (InteriorPoint(), set())]
)
def test_a_loop_counts_who_solved_how_many_quadratic_programs(solver: fg.Solver, names: set[str]) -> None:
    loop = line_loop(solver=solver)
    plans, _ = drive(loop, 3)
    assert set(loop.subproblems) == names
    assert sum(loop.subproblems.values()) == (sum(plan.iterations for plan in plans) if names else 0)


def test_what_the_couplings_hand_on() -> None:
    """Statics: as at the start, as estimated, or estimated in the same solve."""
    found = {}
    for coupling in ("separate", "sequential", "joint"):
        loop = line_loop(BIASED, coupling=coupling)
        plans, _ = drive(loop, 25)
        before, after = plans[-1].states[:2]
        found[coupling] = ((after - T @ before - B @ plans[-1].control) / B[:, 0]).mean()
        assert loop.window is not None
        alone = loop.window.history.constants["bias"][0, 0]
        assert loop.constants["bias"][0, 0] == pytest.approx(found["joint"] if coupling == "joint" else alone, abs=1e-5)
        if coupling == "sequential":
            assert found["sequential"] == pytest.approx(alone, abs=1e-6)
    assert found["separate"] == pytest.approx(0.0, abs=1e-6)
    assert found["sequential"] > 0.1 and found["joint"] != found["sequential"]


@pytest.mark.parametrize(
    ("weight", "pull", "least", "most"),
    [(1e-8, np.inf, 0.0, 1e-4), (1.0, np.inf, 1e-2, np.inf), (1e4, 0.5, 0.49, 0.51), (1e4, [0.01, 0.02], 0.0, 0.11)],
    ids=["no wishes", "free", "in sigmas", "in units"],
)
def test_how_far_the_future_pulls(weight: float, pull: Any, least: float, most: float) -> None:
    loop = line_loop(BIASED, coupling="joint", control_weight=weight, pull=pull)
    drive(loop, 12)
    window = loop.window
    assert window is not None
    pulled = np.append(loop.estimate - window.present, loop.constants["bias"][0] - window.history.constants["bias"][0])
    in_sigmas = np.abs(pulled) / np.sqrt(np.diag(window.covariance))
    if np.ndim(pull):
        assert np.abs(pulled[:2]) == pytest.approx(pull, abs=1e-4)
    else:
        assert least <= in_sigmas.max() <= most


def test_a_pull_moves_by_the_covariance_times_the_gradient_of_the_plan() -> None:
    """The joint estimate is that of the past moved by -Sigma grad V, V the optimal cost of the future."""
    weight = 1e-4
    loop = line_loop(coupling="joint", control_weight=weight, pull=np.inf, solver=InteriorPoint(tolerance=1e-10))
    drive(loop, 10)
    window, solution = loop.window, loop.solution
    assert window is not None and solution is not None
    gradient = []
    for k in range(2):
        costs = []
        for side in (1.0, -1.0):
            alone = line_loop(window=None, control_weight=weight, solver=InteriorPoint(tolerance=1e-10))
            alone.applied = loop.window.history.controls[-1].copy()  # type: ignore[union-attr]
            alone.plan(loop.estimate + side * 1e-4 * np.eye(2)[k], TARGET)
            assert alone.solution is not None
            costs.append(alone.solution.cost)
        gradient.append((costs[0] - costs[1]) / 2e-4)
    expected = -window.state_covariance @ np.array(gradient)
    assert np.abs(expected).max() > 1e-6
    np.testing.assert_allclose(loop.estimate - window.present, expected, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
def test_nothing_is_compiled_after_a_loop_is_made(coupling: Any) -> None:
    for solver in BACKENDS.values():
        loop = line_loop(BIASED, solver=solver, coupling=coupling, judge=Sometimes(LastPlanThenBrake(BIASED, keep=2)))
        with counting() as new:
            drive(loop, 16)
            loop.reset()
            drive(loop, 2)
        assert new.everything == 0, new
        assert set(loop.sources) == {"solved", "kept", "braking"}


@dataclass
class Sometimes:
    """A judge that refuses every plan of ticks 5 to 9."""

    inner: LastPlanThenBrake
    ticks: int = 0

    def __call__(self, solution: Any, states: Array, controls: Array, now: Context[Any], kept: Any) -> Decision:
        self.ticks += 1
        if 5 <= self.ticks <= 9:
            return self.inner.instead(now, kept)
        return self.inner(solution, states, controls, now, kept)


def test_a_plan_is_kept_shifted_and_then_braked() -> None:
    brake = LastPlanThenBrake(LINE, keep=2, brake=lambda now: np.clip(-now.present[1:] / 0.1, -1.0, 1.0))
    loop = line_loop(judge=Sometimes(brake), solver=InteriorPoint())
    plans, _ = drive(loop, 12)
    assert [plan.source for plan in plans] == ["solved"] * 4 + ["kept"] * 2 + ["braking"] * 3 + ["solved"] * 3
    good = plans[3].controls
    for age in (1, 2):
        kept = plans[3 + age]
        assert kept.emergency and np.array_equal(kept.controls[:-age], good[age:])
        np.testing.assert_allclose(kept.states[1], T @ kept.states[0] + B @ kept.control, atol=1e-12)
    assert plans[6].control == pytest.approx(np.clip(-plans[6].states[0, 1:] / 0.1, -1.0, 1.0))
    assert loop.sources == {"solved": 7, "kept": 2, "braking": 3}
    assert loop.kept.age == 0


def test_a_solve_that_fails_is_neither_applied_nor_believed() -> None:
    """Limits that cannot be kept: no exception, a status, the estimate of the past alone."""

    class Wall(Goal):
        def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
            super().state(graph, x, u)
            graph.bound(x[1:], lower=[graph_least, -np.inf], name="wall")

    graph_least = 50.0
    motion = Dynamics(step, 0.1)
    for coupling in ("sequential", "joint"):
        loop: RecedingHorizon = RecedingHorizon(
            LINE, 8, [motion, Wall()], solver=InteriorPoint(max_iterations=30), window=line_window(3), coupling=coupling
        )
        plans, _ = drive(loop, 4)
        assert all(plan.source == "braking" and not plan.control.any() for plan in plans)
        assert not loop.statuses[fg.Status.CONVERGED]
        assert loop.window is not None and np.array_equal(loop.estimate, loop.window.present)


def test_a_plan_that_comes_too_late_serves_the_next_tick() -> None:
    now = [0.0]
    loop = line_loop(deadline=0.1, clock=lambda: now[0])
    warm, cold = (Delayed(run, now, 0.02) for run in (loop.warm, loop.cold))
    warm.late[2] = 1.0
    loop.warm, loop.cold = warm, cold  # type: ignore[assignment]
    data = loop.data

    def slowly(context: Context[Any]) -> Any:
        now[0] += 0.03
        return data(context)

    loop.data = slowly  # type: ignore[assignment, method-assign]
    plans, _ = drive(loop, 5)
    assert [plan.source for plan in plans] == ["solved", "solved", "late", "solved", "solved"]
    assert plans[2].milliseconds == pytest.approx(1030.0) and loop.sources["late"] == 1
    assert np.array_equal(plans[2].controls[:-1], plans[1].controls[1:])
    assert cold.limits + warm.limits == pytest.approx([0.07] * 5)
    assert loop.guess is not None


def test_a_plan_is_verified_in_idle_time_where_that_is_long_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    loop = line_loop(clock=lambda: now[0])
    assert loop.idle() == {}
    drive(loop, 3)
    assert loop.solution is not None
    loop.solution.checked = False
    mistraced = loop.warm.program.mistraced

    def slow(*arguments: Any) -> dict[str, str]:
        now[0] += 0.5
        return mistraced(*arguments)

    monkeypatch.setattr(loop.warm.program, "mistraced", slow)
    assert loop.idle(0.1) == {} and loop.solution.checked  # how long it takes is known from now on
    drive(loop, 2)
    loop.solution.checked = False
    assert loop.idle(0.1) == {} and not loop.solution.checked
    assert loop.idle(0.6) == {} and loop.solution.checked


class Delayed:
    """A prepared backend that takes a given time, notes what it may take, and finds a plan or none."""

    def __init__(self, inner: fg.Prepared, clock: list[float], takes: float, status: fg.Status | None = None) -> None:
        self.inner, self.solver, self.clock, self.takes, self.status = inner, inner.solver, clock, takes, status
        self.limits: list[float] = []
        self.late: dict[int, float] = {}  # time that single solves take

    def solve(self, guess: Any, **options: Any) -> fg.Solution:
        self.limits.append(self.solver.time_limit)
        self.clock[0] += self.late.get(len(self.limits), self.takes)
        given, self.solver.time_limit = self.solver.time_limit, np.inf
        solution = self.inner.solve(guess, **options)
        self.solver.time_limit = given
        solution.status = self.status or solution.status
        if self.status is not None:
            solution.violation = 1.0
        return solution


def test_time_limits_of_the_backends_own_are_kept() -> None:
    """The loop takes from them what the deadline leaves, and never adds."""
    now = [0.0]
    own = InteriorPoint(time_limit=0.03)
    loop = line_loop(solver=own, cold=InteriorPoint(time_limit=0.04), deadline=0.1, clock=lambda: now[0])
    loop.warm, loop.cold = (Delayed(run, now, 0.0) for run in (loop.warm, loop.cold))  # type: ignore[assignment]
    drive(loop, 4)
    assert loop.cold.limits == pytest.approx([0.04])  # type: ignore[attr-defined]
    assert loop.warm.limits == pytest.approx([0.03] * 3)  # type: ignore[attr-defined]
    assert own.time_limit == 0.03
    assert loop.sources == {"solved": 4}


@pytest.mark.parametrize(
    ("takes", "own", "limits"),
    [(0.07, np.inf, [0.03]), (0.07, 0.02, [0.02]), (0.0999, np.inf, [0.0001]), (0.1, np.inf, []), (0.4, np.inf, [])],
)
def test_the_second_backend_has_what_is_left_of_the_deadline(takes: float, own: float, limits: list[float]) -> None:
    """It is not asked when nothing is left, and the backend that was handed over stays as it is."""
    now, second = [0.0], InteriorPoint(time_limit=own)
    loop = line_loop(second=second, deadline=0.1, clock=lambda: now[0])
    assert loop.second is not None
    runs = [Delayed(run, now, takes, fg.Status.STALLED) for run in (loop.warm, loop.cold)]
    loop.warm, loop.cold = runs  # type: ignore[assignment]
    other = Delayed(loop.second, now, 0.0)
    loop.second = other  # type: ignore[assignment]
    plans, _ = drive(loop, 1)
    assert other.limits == pytest.approx(limits, abs=1e-9)
    assert second.time_limit == own
    assert loop.rescues == len(limits) and plans[0].rescued is bool(limits)


def test_a_loop_that_ended_early_begins_anew() -> None:
    loop = line_loop(BIASED, coupling="joint")
    first, _ = drive(loop, 9)
    loop.reset()
    again, _ = drive(loop, 9)
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.controls, other.controls)
    loop.reset(start=[0.0, 0.0], sigma=[0.1, 0.1])
    plan = loop.tick(np.zeros(2))
    assert plan.states[0] == pytest.approx([0.0, 0.0], abs=0.05)


def test_plans_that_end_behind_begin_anew() -> None:
    @dataclass(frozen=True)
    class Behind(LastPlanThenBrake):
        def __call__(self, *arguments: Any) -> Decision:
            return replace(super().__call__(*arguments), behind=True)

    begun: list[float] = []

    def cold(now: Context[Any]) -> tuple[Array, Array]:
        begun.append(now.past.times[-1])
        return np.tile(now.present, (21, 1)), np.zeros((20, 1))

    loop = line_loop(judge=Behind(LINE), patience=3, starts=InitialGuesses(cold=cold))
    drive(loop, 8)
    assert begun == pytest.approx([0.0, 0.3, 0.6])


def test_a_horizon_without_a_window() -> None:
    loop, x = line_loop(window=None), START
    for _ in range(40):
        plan = loop.plan(x, TARGET)
        x = T @ x + B @ plan.control
    assert x == pytest.approx(TARGET, abs=0.05)
    loop.reset()


class Scalar(Term):
    """A cost that is no square."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize_scalar(lambda x: x[:, 0] ** 2, x, name="seen")


class Ahead(Scalar):
    """A term of the past that takes the end of the trajectory for the present."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, graph.families["x"][-1], [0.0, 0.0], name="latest")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coupling": "both"}, "choose separate, sequential, joint"),
        *(({"coupling": "joint", "pull": pull}, "sequential") for pull in (0.0, -1.0, np.nan)),
        *(({"coupling": "joint", "pull": pull}, r"pull.*\(2,\)") for pull in ([1.0] * 3, [1.0], [[1.0, 2.0]], "far")),
        ({"steps": 0}, "at least one step"),
        ({"deadline": 0.0}, "deadline"),
        ({"judge": 5}, "judge must be a function or None, found 5"),
        ({"control_weight": 0.0}, "control_weight"),
        ({"window": None, "coupling": "joint"}, "needs a window"),
        ({"window": line_window(3, replace(LINE, predict=None)), "coupling": "joint"}, "another robot"),
    ],
    ids=lambda value: value if isinstance(value, str) else "-".join(value),
)
def test_what_a_loop_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(fg.GraphError, match=message):
        line_loop(**options)


class Wrong(Goal):
    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"gaol": now.given}


def ahead_of(*terms: Term, **options: Any) -> RecedingHorizon:
    return RecedingHorizon(LINE, 5, [Dynamics(step, 0.1), *terms], solver=SQP(), **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: line_window(0), "at least one step"),
        (lambda: line_window(3, replace(LINE, constants=(Constant("b", fg.Rn(1), [0.0], -1.0),))), "positive"),
        (lambda: Window(LINE, 3, [], start=[0.0], sigma=1.0), r"the start has shape \(1,\), expected \(2,\)"),
        (lambda: Window(LINE, 5, [Scalar()], start=START, sigma=1.0), r"'seen'.*cannot be marginalised"),
        (lambda: line_window(3, BIASED).admit("bias", 1, [0.0], 1.0), "no static 'bias' with a member 1"),
        (lambda: line_window(3, BIASED).admit("bias", 0, [0.0, 0.0], 1.0), "is not on"),
        (lambda: line_window(3, KNOWN).admit("bias", 0, [0.0], 1.0), "is known"),
        (lambda: ahead_of(Scalar(), control_weight=2.0), "'seen' cannot be weighed"),
        (
            lambda: ahead_of(Goal(), window=Window(LINE, 5, [Ahead()], start=START, sigma=1.0), coupling="joint"),
            "'latest' of the past reaches into the future",
        ),
        (lambda: ahead_of(Wrong(), window=line_window(3)).tick(TARGET), r"Wrong gives data 'gaol'.*goal"),
        (lambda: line_loop().tick(np.zeros(3)), r"data 'goal' has shape \(3,\)"),
        (lambda: line_loop(window=None).tick(TARGET), "without one, give the present"),
        (lambda: line_loop(window=None).reset(START), "a beginning needs a window; without one, give the present"),
        (lambda: line_loop(window=None).reset(sigma=1.0), "a beginning needs a window; without one, give the present"),
        (
            lambda: line_loop(window=None).plan(START, TARGET, 5),  # type: ignore[arg-type]
            "constants must be of the class Mapping or None, found 5",
        ),
    ],
)
def test_what_windows_and_loops_cannot_do_is_refused(make: Any, message: str) -> None:
    with pytest.raises(fg.GraphError, match=message):
        make()


# ---------------------------------------------------------------- on groups, with functions nobody can trace


class Lamp:
    """Ranges to a lamp whose place nobody knows, as NumPy alone computes them."""

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        return {"range": (1,)}

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        ranges = graph.data("ranges", np.ones((len(x), 1)), each=True)
        seen = graph.data("in sight", np.zeros(len(x), dtype=bool), each=True)

        def distance(pose: Array, lamp: Array, measured: Array) -> Array:
            rows: Sequence[float] = [
                float(np.hypot(*(p[:2] - q))) for p, q in zip(pose, np.broadcast_to(lamp, (len(pose), 2)), strict=True)
            ]
            return np.array(rows)[:, None] - measured

        graph.minimize(distance, x, graph.families["lamp"], ranges, sigma=0.05, active=seen, name="ranges")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        ranges, seen = now.past.recorded("range")
        return {"ranges": ranges, "in sight": seen}


class Towards(Term):
    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(unicycle.tracking, x[1:], [4.0, 1.0, 0.0], sigma=[1.0, 1.0, 2.0], name="towards")
        graph.minimize(
            lambda p, lamp: 0.3 / (0.1 + np.sum((p[:, :2] - lamp) ** 2, axis=1, keepdims=True)),
            x[1:],
            graph.families["lamp"],
            name="shy",
        )
        graph.bound(u, lower=[0.0, -1.0], upper=[1.0, 1.0], name="limits")


@pytest.mark.product(2, of="drives and flights")
@pytest.mark.parametrize("coupling", ["sequential", "joint"])
def test_a_robot_on_se2_finds_a_lamp_while_it_drives(coupling: Any) -> None:
    h, lamp = 0.2, np.array([2.0, -0.8])
    noise = np.array([0.01, 0.005, 0.01])
    robot = Robot(
        fg.SE2, fg.Rn(2), (Constant("lamp", fg.Rn(2), [1.5, -1.2], 0.5),),
        predict=lambda x, u: unicycle.step(x[None], u[None], h)[0],
    )  # fmt: skip
    past: list[Term] = [Dynamics(unicycle.dynamics, h, sigma=noise), Lamp()]
    window: Window = Window(robot, 8, past, start=np.zeros(3), sigma=[0.02, 0.02, 0.02])
    effort = ControlCost([1.0, 1.0], [1.0, 1.0], wanted=[0.6, 0.0])
    ahead: list[Term] = [Dynamics(unicycle.dynamics, h), Towards(), effort]
    loop: RecedingHorizon = RecedingHorizon(
        robot, 12, ahead, solver=InteriorPoint(hessian="gauss-newton"), window=window, coupling=coupling
    )
    rng, truth = np.random.default_rng(5), np.zeros(3)
    compiled = 0
    for _ in range(30):
        before = truth
        with counting() as new:
            plan = loop.tick(measured={"range": [np.hypot(*(truth[:2] - lamp)) + 0.05 * rng.normal()]})
        compiled += new.everything
        truth = fg.SE2.retract(unicycle.step(truth[None], plan.control[None], h)[0], noise * rng.normal(size=3))
    assert loop.constants["lamp"][0] == pytest.approx(lamp, abs=0.15)
    assert np.hypot(*(truth[:2] - [4.0, 1.0])) < 0.4
    error = fg.SE2.local(window.present, before)
    assert error @ np.linalg.solve(window.state_covariance, error) < 16.3  # as large as its covariance says
    assert loop.sources["solved"] == 30 and compiled == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_was_not_measured(value: float) -> None:
    found = []
    for seen in ({"gps": [value]}, {"gps": None}, {}):
        loop = line_loop()
        loop.tick(TARGET, {"gps": [0.3]})
        found.append(loop.tick(TARGET, seen).controls)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
