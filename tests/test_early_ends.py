"""Result of a solve that ends early: after a few steps the last iterate, else the one of least merit."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_with
from unifg.models import obstacles, unicycle
from unifg.problem.linearization import Linearization
from unifg.scenarios.manoeuvres import CASES, ManoeuvreSettings, state_problem
from unifg.solution.solve_state import SolveState
from unifg.solvers import KKT, SQP, AugmentedLagrangian, InteriorPoint, Penalty
from unifg.typing import Array

N, DT, TICKS, MOVED_AT = 15, 0.1, 60, 3
NEAR, FAR = np.array([1.0, 0.2]), np.array([1.4, 0.9])
CENTRE, RADIUS = np.array([0.9, 0.45]), 0.2
REACHED = 0.02  # [m] of the converged loop's end; what is left of a slow approach


def missing(pose: Array, goal: Array) -> Array:
    """Way to a goal: without a heading, which a unicycle would only creep towards."""
    return goal - pose[:, :2]


class RecedingHorizon:
    """A unicycle sent to one goal, and at tick 3 to another; plain MPC, nothing but graph, guess and solve."""

    def __init__(self, limits: bool = True, disc: bool = False, soft: bool = False) -> None:
        self.graph = fg.Graph()
        self.x, self.u = self.graph.variables("x", fg.SE2, N + 1), self.graph.variables("u", fg.Rn(2), N)
        self.start = self.graph.data("start", np.zeros(3))
        self.goal = self.graph.data("goal", NEAR)
        self.graph.fix(self.x[0], self.start)
        self.graph.minimize(missing, self.x[1:-1], self.goal, sigma=1.0, name="way")
        self.graph.minimize(missing, self.x[-1], self.goal, sigma=0.1, name="goal")
        self.graph.minimize(fg.prior, self.u, [0.0, 0.0], sigma=2.0, name="effort")
        x, u = self.x, self.u
        if soft:
            self.graph.minimize(unicycle.dynamics, x[:-1], u, x[1:], DT, sigma=0.02, name="motion")
        else:
            self.graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], DT, lower=0.0, upper=0.0, name="motion")
        if limits:
            self.graph.bound(u, lower=[-1.0, -2.0], upper=[1.0, 2.0], name="limits")
        if disc:
            centre, radius = CENTRE[None], np.array([RADIUS])
            self.graph.constrain(obstacles.disc_clearance, x[1:], centre, radius, lower=0.0, name="disc")

    def first(self) -> fg.Solution:
        """Converged plan for the first goal."""
        line = np.linspace(0.0, 1.0, N + 1)[:, None] * [*NEAR, 0.0]
        rest = {self.x: line, self.u: np.zeros((N, 2))}
        solution = InteriorPoint().solve(self.graph, rest, check=True)
        return solution

    def drive(self, solver: fg.Solver, feasible: bool) -> Array:
        """Poses of a drive whose plans start at shifted ones, rolled out from the robot when ``feasible``."""
        run, plan, pose = solver.prepare(self.graph), self.first(), np.zeros(3)
        poses = [pose]
        for tick in range(TICKS):
            guess = plan.shifted(self.x, self.u) if tick else fg.Guess(plan.values, plan.multipliers, plan.penalties)
            values = dict(guess.values)
            if feasible:
                values[self.u] = np.clip(values[self.u], [-1.0, -2.0], [1.0, 2.0])
                values[self.x] = unicycle.rollout(pose, values[self.u], DT)
            plan = run.solve(
                fg.Guess(values, guess.multipliers, guess.penalties),
                data={self.start: pose, self.goal: NEAR if tick < MOVED_AT else FAR},
            )
            pose = unicycle.rollout(pose, np.clip(plan[self.u][:1], [-1.0, -2.0], [1.0, 2.0]), DT)[-1]
            poses.append(pose)
        return np.array(poses)


BACKENDS: dict[str, Callable[[int], fg.Solver]] = {
    "sqp": lambda k: SQP(max_iterations=k),
    "sqp, full steps": lambda k: SQP(max_iterations=k, full_steps=True),
    "sqp, exact": lambda k: SQP(max_iterations=k, hessian="exact"),
    "sqp on the graph": lambda k: SQP(max_iterations=k, qp="graph"),
    "interior point": lambda k: InteriorPoint(max_iterations=k),
    "augmented Lagrangian": lambda k: AugmentedLagrangian(max_iterations=k),
    "penalty": lambda k: Penalty(max_iterations=k, penalty=1e4),
    "kkt": lambda k: KKT(max_iterations=k),
    "kkt, full steps": lambda k: KKT(max_iterations=k, full_steps=True),
}


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("iterations", [1, 2, 3, 5])
@pytest.mark.parametrize("feasible", [True, False], ids=["rolled out", "shifted"])
@pytest.mark.product(2)
def test_few_iterations_follow_a_moved_goal(name: str, iterations: int, feasible: bool) -> None:
    arrives_as_converged(name, lambda loop: loop.drive(BACKENDS[name](iterations), feasible), feasible)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("feasible", [True, False], ids=["rolled out", "shifted"])
@pytest.mark.product(6)
def test_little_time_follows_a_moved_goal(name: str, feasible: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # An iteration takes a second.
    monkeypatch.setattr(SolveState, "seconds", property(lambda run: run.iterations + 1.0))

    def drive(loop: RecedingHorizon) -> Array:
        solver = BACKENDS[name](200)
        solver.time_limit = 2.5
        return loop.drive(solver, feasible)

    arrives_as_converged(name, drive, feasible)


def arrives_as_converged(name: str, drive: Callable[[RecedingHorizon], Array], feasible: bool) -> None:
    ends = converged_end(name, feasible)
    assert np.linalg.norm(ends - FAR) < 0.02  # the loop is one that arrives
    assert drive(RecedingHorizon(limits="kkt" not in name))[-1, :2] == pytest.approx(ends, abs=REACHED)


@cache
def converged_end(name: str, feasible: bool) -> Array:
    """End of the loop that solves every tick."""
    return RecedingHorizon(limits="kkt" not in name).drive(BACKENDS[name](200), feasible)[-1, :2]


@pytest.mark.parametrize("name", [name for name in BACKENDS if "kkt" not in name])
@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.product(3)
def test_few_iterations_pass_a_disc(name: str, iterations: int) -> None:
    loop = RecedingHorizon(disc=True)
    poses = loop.drive(BACKENDS[name](iterations), feasible=True)
    assert np.linalg.norm(poses[-1, :2] - FAR) < 0.05
    gaps = np.linalg.norm(poses[:, :2] - CENTRE, axis=1) - RADIUS
    assert gaps.min() > -0.01  # an iteration that has not converged may touch it


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_the_last_iterate_is_returned(name: str, iterations: int) -> None:
    loop = RecedingHorizon(limits="kkt" not in name)
    ahead = np.tile([0.2, 0.1], (N, 1))
    guess = {loop.x: unicycle.rollout(np.zeros(3), ahead, DT), loop.u: ahead}  # keeps every constraint
    solution = BACKENDS[name](iterations).solve(loop.graph, guess, data={loop.goal: FAR})
    last = solution.history[-1]
    assert solution.iterations == last.number > 0
    assert (solution.cost, solution.violation) == (last.cost, last.violation)
    assert not np.array_equal(solution[loop.u], ahead)


def test_a_stop_rule_returns_the_iterate_at_which_it_fired() -> None:
    """Bazzana's loop on soft dynamics, from a guess that keeps every constraint and costs ten times as much."""
    loop = RecedingHorizon(soft=True)
    rest = {loop.x: np.zeros((N + 1, 3)), loop.u: np.zeros((N, 2))}
    for short in (1e-2, 1e-3):
        solver = AugmentedLagrangian(
            schedule="bazzana", penalty=0.1, step_tolerance=short, violation_tolerance=1e-2, tolerance=1e-12
        )
        solution = solver.solve(loop.graph, rest)
        assert solution.status is fg.Status.STOP_RULE, solution.report()
        last = solution.history[-1]
        assert last.step_norm < short
        assert (solution.cost, solution.stationarity) == (last.cost, last.stationarity)
        assert solution.cost < 0.5 * solution.history[0].cost


def test_the_manoeuvre_behind_in_the_paper_s_form() -> None:
    settings = ManoeuvreSettings()
    graph, x, _, guess = state_problem(next(case for case in CASES.values() if case.name == "behind"), settings)
    solver = AugmentedLagrangian(schedule="bazzana", penalty=0.5, step_tolerance=1e-2, violation_tolerance=1e-1)
    solution = solver.solve(graph, guess)
    assert not np.array_equal(solution[x], guess.values[x])
    assert solution.cost == solution.history[-1].cost


@pytest.mark.parametrize("solver", [SQP(max_iterations=500), InteriorPoint(max_iterations=2000)])
def test_an_unbounded_solve_returns_its_last_finite_iterate(solver: fg.Solver) -> None:
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda p: -(p[:, 0] ** 3), x)
    graph.bound(x, lower=0.0)
    solution = solver.solve(graph, {x: [[1.0]]})
    assert solution.status is fg.Status.UNBOUNDED, solution.report()
    assert solution.cost < -1e20
    assert np.isfinite(solution[x]).all() and solution[x] > 1e6


class Flies(fg.Solver):
    """Steps to 2, 3 and then to where nothing is finite, or says that it is done where it is not."""

    def workspace(self, program: object) -> None:
        return None

    def iterate(self, run: SolveState, workspace: None) -> fg.Status | None:
        for target in (2.0, 3.0, np.inf):
            step = target - run.values.flat
            run.accept(run.program.linearize(run.program.retract(run.values, step)), run.multipliers, 1.0, 1.0)
        return None


def test_where_the_last_iterate_is_not_finite_another_stands_in() -> None:
    graph, x = drawn_to([1.0], name="wish")
    graph.minimize(fg.prior, x, [3.2], name="other wish")
    solution = Flies().solve(graph, {x: [[0.0]]})
    assert solution.status is fg.Status.NOT_FINITE
    assert solution[x].item() == 2.0  # costs less than 0 and 3
    assert np.isfinite(solution.cost)
    assert solution.returned == 1 and solution.history[1].details == {"returned": 1}


def test_nothing_unbounded_is_called_converged() -> None:
    """Beyond 1e10 a difference of a scalar cost may vanish, and a vanishing gradient passes for a stationary one."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda p: np.minimum(-p[:, 0], -2e20), x)
    solution = SQP().solve(graph, {x: [[1.0]]})
    assert solution.status is fg.Status.UNBOUNDED


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("feasible", [True, False])
@pytest.mark.parametrize("iterations", [4, 5, 7, 9])
@pytest.mark.product(12)
def test_a_limit_returns_the_iterate_of_least_merit(
    name: str, iterations: int, feasible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cost plus the largest multiplier so far times the sum of violations beyond the tolerance, of all iterates."""
    loop = RecedingHorizon(limits="kkt" not in name, disc="kkt" not in name)
    ahead = np.tile([0.2, 0.1], (N, 1))
    poses = unicycle.rollout(np.zeros(3), ahead, DT)
    guess = {
        loop.x: poses if feasible else poses + np.linspace(0.0, 1.0, N + 1)[:, None] * [1.0, 0.2, 0.0],
        loop.u: ahead,
    }
    seen: list[tuple[float, float, float, Array]] = []
    accept = SolveState.accept

    def noted(run: SolveState, lin: Linearization, multipliers: Array, *more: float, **details: Any) -> None:
        g, program = lin.constraints, run.program
        outside = float((np.maximum(g - program.upper, 0.0) + np.maximum(program.lower - g, 0.0)).sum())
        seen.append((lin.cost, outside, float(np.abs(multipliers).max(initial=0.0)), multipliers))
        accept(run, lin, multipliers, *more, **details)

    monkeypatch.setattr(SolveState, "accept", noted)
    watched = BACKENDS[name](iterations)
    watched.keep_values = True
    solution = watched.solve(loop.graph, guess, data={loop.goal: FAR})
    monkeypatch.undo()
    price = max(row[2] for row in seen)
    merits = [cost + price * outside for cost, outside, _, _ in seen]
    best = len(seen) - 1 if solution.converged else int(np.argmin(merits))
    row = solution.history[best]
    assert solution.returned == best and solution.iterations == len(seen) - 1
    assert row.values is not None
    np.testing.assert_array_equal(solution[loop.u], row.values[loop.u])
    assert (solution.cost, solution.violation) == (row.cost, row.violation)
    if not solution.converged:
        assert solution.stationarity == row.stationarity
        np.testing.assert_array_equal(np.concatenate([m.ravel() for m in solution.multipliers.values()]), seen[best][3])
    assert ("returned" in row.details) == (best < len(seen) - 1)
    alone = BACKENDS[name](iterations).solve(loop.graph, guess, data={loop.goal: FAR})  # with nobody who looks
    assert (alone.returned, alone.status) == (best, solution.status)
    np.testing.assert_allclose(alone[loop.u], solution[loop.u], rtol=0.0, atol=1e-9)
    assert ("returned" in alone.history[best].details) == (best < len(seen) - 1)


class Walks(fg.Solver):
    """Goes through given points with given multipliers, and stops for a given reason."""

    def __init__(self, points: list[float], multiplier: float, reason: fg.Status, **options: float) -> None:
        self.step_tolerance = options.pop("step_tolerance", 0.0)
        super().__init__(**options)  # type: ignore[arg-type]
        self.points, self.multiplier, self.reason = points, multiplier, reason

    def workspace(self, program: object) -> None:
        return None

    def iterate(self, run: SolveState, workspace: None) -> fg.Status | None:
        for target in self.points:
            if run.status is None:
                step = target - run.values.flat
                moved = run.program.linearize(run.program.retract(run.values, step))
                run.accept(moved, np.full(len(run.multipliers), self.multiplier), 1.0, 1.0)
        return self.reason


ENDINGS = [
    fg.Status.STALLED,
    fg.Status.SINGULAR,
    fg.Status.INTERRUPTED,
    fg.Status.TIME_LIMIT,
    fg.Status.ITERATION_LIMIT,
]


def wall(most: float) -> tuple[fg.Graph, fg.Family]:
    """Minimise 1/2 (x - 5)^2 where x is at most ``most``."""
    graph, x = drawn_to([5.0])
    graph.constrain(lambda p: p, x, upper=most)
    return graph, x


@pytest.mark.parametrize("reason", ENDINGS, ids=lambda s: s.name)
def test_a_feasible_guess_that_is_cheaper_is_returned(reason: fg.Status) -> None:
    graph, x = wall(1.0)
    solution = Walks([0.9, 0.5, 0.2, 0.1], -0.1, reason).solve(graph, {x: [[0.95]]})
    assert (solution[x].item(), solution.returned, solution.iterations) == (0.95, 0, 4)
    assert solution.status is reason and solution.history[0].details == {"returned": 1}
    assert "returned=1" in solution.table()
    assert solution.multipliers[next(iter(solution.multipliers))].item() == 0.0  # those of the guess
    assert solution.cost == pytest.approx(0.5 * 4.05**2)


@pytest.mark.parametrize("reason", ENDINGS, ids=lambda s: s.name)
def test_an_infeasible_guess_that_costs_least_is_not_returned(reason: fg.Status) -> None:
    graph, x = wall(1.0)
    solution = Walks([3.0, 0.8, 0.2], 4.0, reason).solve(graph, {x: [[5.0]]})
    assert solution[x].item() == pytest.approx(0.8) and solution.returned == 2
    # At a price of nothing, and without any multiplier, least cost is all there is.
    assert Walks([3.0, 0.8, 0.2], 0.0, reason).solve(graph, {x: [[4.9]]})[x].item() == 4.9


def test_the_price_is_the_largest_on_the_way() -> None:
    """A row that is met at the end has no multiplier there, and still counts."""
    graph, x = wall(1.0)

    class Forgets(Walks):
        def iterate(self, run: SolveState, workspace: None) -> fg.Status | None:
            super().iterate(run, workspace)
            run.accept(run.program.linearize(run.values), np.zeros(1), 0.0, 0.0)
            return self.reason

    solution = Forgets([3.0, 0.8, 0.2], 4.0, fg.Status.STALLED).solve(graph, {x: [[5.0]]})
    assert solution.returned == 2


def test_what_is_feasible_as_stated_is_judged_by_its_cost() -> None:
    """A huge multiplier on the way priced a violation within the tolerance, and the dearer guess was returned."""
    graph, x = wall(1.0)

    class Overshoots(Walks):
        def iterate(self, run: SolveState, workspace: None) -> fg.Status | None:
            self.multiplier, self.points = 1e6, [0.9]
            super().iterate(run, workspace)
            self.multiplier, self.points = 4.0, [1.0 + 5e-7, 0.97, 1.0 + 9e-6]
            return super().iterate(run, workspace)

    solution = Overshoots([], 0.0, fg.Status.STALLED).solve(graph, {x: [[0.95]]})
    assert solution.returned == 2 and solution.violation == pytest.approx(5e-7)


def test_single_steps_are_returned_whatever_they_cost() -> None:
    graph, x = wall(1.0)
    for options in ({"max_iterations": 3}, {"step_tolerance": np.inf, "max_iterations": 10}):
        solution = Walks([0.9, 0.5, 0.2], -0.1, fg.Status.ITERATION_LIMIT, **options)
        assert solution.solve(graph, {x: [[0.95]]})[x].item() == pytest.approx(0.2)
    for reason in (fg.Status.STOP_RULE, fg.Status.UNBOUNDED):
        assert Walks([0.9, 0.5, 0.2], -0.1, reason).solve(graph, {x: [[0.95]]})[x].item() == pytest.approx(0.2)
    assert (
        Walks([0.9, 0.5, 0.2, 0.1], -0.1, fg.Status.ITERATION_LIMIT, max_iterations=4)
        .solve(graph, {x: [[0.95]]})[x]
        .item()
        == 0.95
    )


def test_a_schedule_that_diverges_returns_the_guess() -> None:
    """A constant penalty far too light, from a guess that is nearly right."""
    loop = RecedingHorizon(limits=False)
    near = InteriorPoint().solve(loop.graph, loop.first(), data={loop.goal: FAR}).values
    near[loop.u] = near[loop.u] + 1e-3
    heavy = AugmentedLagrangian(schedule="bazzana-damped", penalty=1e-3, max_iterations=40)
    solution = heavy.solve(loop.graph, near, data={loop.goal: FAR})
    assert not solution.converged
    worst = max(row.cost + 1e3 * row.violation for row in solution.history)
    returned = solution.history[solution.returned]
    assert (solution.cost, solution.violation) == (returned.cost, returned.violation)
    assert solution.cost + 1e3 * solution.violation < worst
