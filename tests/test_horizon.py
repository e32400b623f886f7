"""Plans against deadlines and failures: past and future of any robot in one loop."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.codegen.compile_counter import counting
from unifg.horizon import (
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
