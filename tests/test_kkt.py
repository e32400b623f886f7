"""The KKT backend: its step against dense algebra, its globalisation, its active set, the paper's second case study."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.control import Unicycle
from problems.graphs import drawn_to, graph_of, graph_with
from problems.known import STARTS, ecg2o, pose_chain, three_variable_qp
from unifg.models import unicycle
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import KKT, SQP, InteriorPoint, kkt
from unifg.solvers.active_set import ALL_AT_ONCE, ONE_BY_ONE, ActiveSet
from unifg.typing import Array

STEPS_OF_REFERENCE = [5, 7, 8, 8, 6, 10]
"""Full Newton-KKT steps with a Gauss-Newton Hessian until the step is below 1e-3, worked out independently."""
LEVENBERG = KKT(globalization="levenberg-marquardt")


def circle(
    start: tuple[float, float], target: tuple[float, float] = (1.0, 1.0), square: float = 1.0
) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """The point of a circle nearest to a target."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(fg.prior, x, list(target))
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=square, upper=square, name="circle")
    return graph, {x: np.array([start])}


def drive(goal: tuple[float, float, float], count: int = 12) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A unicycle without limits."""
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(unicycle.tracking, x[-1], list(goal), sigma=0.1)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0, name="dynamics")
    return graph, {x: np.zeros((count + 1, 3)), u: np.tile([0.1, 0.0], (count, 1))}


@pytest.mark.parametrize(
    "build", [lambda: ecg2o((1.0, 1.0)), lambda: drive((1.0, 0.6, 0.4), 4)], ids=["ecg2o", "drive"]
)
def test_one_full_step_is_the_dense_kkt_step(build: Callable[[], tuple[fg.Graph, dict[fg.Family, Array]]]) -> None:
    graph, guess = build()
    program = graph.compile()
    values = program.values_from(guess)
    rng = np.random.default_rng(3)
    multipliers = rng.normal(size=program.constraints.count)
    lin = program.linearize(values)
    n, m = program.size, program.constraints.count
    upper = program.normal.matrix(lin.hessian).toarray()
    hessian = upper + upper.T - np.diag(upper.diagonal())
    jacobian = program.constraints.matrix(lin.constraint_jacobian).toarray()
    matrix = np.block([[hessian, jacobian.T], [jacobian, np.zeros((m, m))]])
    gradient = lin.gradient[program.columns.free] + jacobian.T @ multipliers
    expected = np.linalg.solve(matrix, -np.concatenate([gradient, lin.constraints - program.lower]))
    duals = {
        t.name: multipliers[s].reshape(t.count, t.size)
        for t, s in zip(program.constraint_terms, program.slices, strict=True)
    }
    rows: list[fg.Iteration] = []
    taken = KKT(full_steps=True, max_iterations=1, keep_values=True)
    taken.solve(graph, guess, duals=duals, callback=rows.append)
    reached = rows[1].values
    assert reached is not None
    moved = program.retract(values, expected[:n])
    for family, array in reached.items():
        np.testing.assert_allclose(array, moved[family], rtol=1e-9, atol=1e-11)
    assert rows[1].step_norm == pytest.approx(np.linalg.norm(expected[:n]), rel=1e-9)
    assert rows[1].details["multiplier_step"] == pytest.approx(np.linalg.norm(expected[n:]), rel=1e-8)


@pytest.mark.parametrize(("start", "steps"), list(zip(STARTS, STEPS_OF_REFERENCE, strict=True)))
def test_case_study_2_takes_the_steps_of_the_reference(start: tuple[float, float], steps: int) -> None:
    graph, guess = ecg2o(start)
    stopped = KKT(full_steps=True, step_tolerance=1e-3).solve(graph, guess)
    assert stopped.status is fg.Status.STOP_RULE  # convergence is linear here: the rule is no solution
    assert stopped.iterations == steps
    assert np.abs(stopped[graph.families["x"]]).max() < 1e-3
    for solver in (KKT(), KKT(full_steps=True)):
        solution = solver.solve(graph, guess, check=True)
        assert solution.dual("curve")[0, 0] == pytest.approx(-1.0, abs=1e-6)
        assert solution.iterations <= steps + 4


@pytest.mark.parametrize("solver", [KKT(), KKT(full_steps=True)])
def test_linear_equalities_take_one_step(solver: Any) -> None:
    graph, guess = three_variable_qp()
    assert solver.solve(graph, guess, check=True).iterations == 1


def test_the_stop_rule_looks_at_a_step_that_was_taken() -> None:
    """A tolerance beyond rounding, which exact Jacobians alone allow, leaves the end to the rule."""
    graph, x = graph_with(fg.Rn(1), 2)
    graph.minimize(fg.prior, x, [[0.1], [7.3]], sigma=0.3)
    graph.constrain(fg.between, x[0], x[1], [3.1], lower=0.0, upper=0.0, name="apart")
    solution = KKT(step_tolerance=1e-3, tolerance=1e-300).solve(graph, {x: np.zeros((2, 1))})
    assert solution.iterations == 2  # the second finds that nothing is left to do


@pytest.mark.parametrize("goal", [(2.0, 0.1, 0.0), (0.0, 2.0, 0.0), (-2.0, 0.3, 3.0)])
@pytest.mark.parametrize("solver", [KKT(), LEVENBERG], ids=["line search", "levenberg-marquardt"])
def test_a_unicycle_is_brought_from_afar_to_the_optimum(solver: KKT, goal: tuple[float, float, float]) -> None:
    graph, guess = drive(goal)
    solution = solver.solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    assert solution.cost == pytest.approx(SQP().solve(graph, guess, check=True).cost, rel=1e-6)


def test_feasibility_is_restored_although_the_cost_rises() -> None:
    """From the unconstrained minimum the plain cost, as a merit, would reject every step towards the circle."""
    graph, guess = circle((3.0, 3.0), target=(3.0, 3.0))
    solution = KKT().solve(graph, guess, check=True)
    assert solution.history[0].cost == 0.0 < solution.history[1].cost
    np.testing.assert_allclose(solution[graph.families["x"]], 0.5**0.5, atol=1e-6)


def test_strong_curvature_needs_the_merit_function(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a small circle the Hessian of Gauss-Newton is 30 times too weak: full steps cycle, shortened ones damp."""
    monkeypatch.setattr(kkt, "WORTH", np.inf)  # before second derivatives take over
    graph, guess = circle((1.0, 0.5), (0.3, 0.1), 1e-4)
    assert not KKT(full_steps=True).solve(graph, guess).converged
    solution = KKT().solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    assert any("damping" in row.details for row in solution.history)
    assert any(row.step_length < 1.0 for row in solution.history[1:])


def test_second_order_correction_repairs_a_full_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along a circle a full step leaves the constraint: Maratos."""
    monkeypatch.setattr(kkt, "WORTH", np.inf)
    graph, guess = circle((np.cos(2.0), np.sin(2.0)), target=(3.0, 0.0))
    corrected = KKT().solve(graph, guess, check=True)
    rows = [row for row in corrected.history if "correction" in row.details]
    assert rows and all(row.step_length == 1.0 for row in rows)
    plain = KKT(second_order_correction=False).solve(graph, guess, check=True)
    assert not any("correction" in row.details for row in plain.history)
    assert plain.cost == pytest.approx(corrected.cost, rel=1e-9)


def test_a_start_where_the_constraint_has_no_slope_is_left() -> None:
    """The centre of a circle is a maximum of the violation, not a minimum."""
    graph, guess = circle((0.0, 0.0))
    solution = KKT().solve(graph, guess, check=True)
    np.testing.assert_allclose(solution[graph.families["x"]], 0.5**0.5, atol=1e-6)


@pytest.mark.parametrize(("scale", "tolerance"), [(1e-3, 1e-12), (1.0, 1e-9), (1e6, 1e-6)])
def test_scales_of_costs_do_not_matter(scale: float, tolerance: float) -> None:
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda p: scale * (p - 1.0), x)
    graph.constrain(lambda p: 1e-3 * (p**2).sum(axis=1, keepdims=True), x, lower=1e-3, upper=1e-3)
    solution = KKT(tolerance=tolerance).solve(graph, {x: np.array([[0.3, 2.0]])}, check=True)
    np.testing.assert_allclose(solution[x], 0.5**0.5, rtol=1e-4)


def test_limits_that_are_data_are_looked_at_in_every_solve() -> None:
    graph, x = drawn_to([1.0, 2.0])
    low, high = graph.data("low", np.array([0.5, 0.5])), graph.data("high", np.array([0.5, 0.5]))
    graph.bound(x, lower=low, upper=high, name="box")
    run = KKT().prepare(graph)
    guess = {x: np.zeros((1, 2))}
    np.testing.assert_allclose(run.solve(guess)[x], 0.5)
    wider = run.solve(guess, data={high: np.array([0.5, 0.7])})
    np.testing.assert_allclose(wider[x], [[0.5, 0.7]])
    np.testing.assert_allclose(wider.multipliers["box"], [[0.5, 1.3]])
    free = run.solve(guess, data={low: np.array([0.5, -np.inf]), high: np.array([0.5, np.inf])})
    np.testing.assert_allclose(free[x], [[0.5, 2.0]])


def test_search_without_search_jacobians_changes_nothing() -> None:
    graph, guess = drive((1.0, 0.6, 0.4))
    solution = KKT(search_iterations=3).solve(graph, guess, check=True)  # nothing here has a search Jacobian
    assert [row.number for row in solution.history] == list(range(solution.iterations + 1))


def chain(
    units: tuple[float, ...], noise: float, sight: float, arrival: float
) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """Integrators in a row over 20 steps, each in its own unit; noise and an unknown bias drive the last one alone."""
    n, steps, unit = len(units), 20, np.array(units)
    transition = np.outer(unit, 1.0 / unit) * (np.eye(n) + 0.1 * np.diag(np.ones(n - 1), 1))
    rng = np.random.default_rng(0)
    graph, x, w, b = graph_of(("x", fg.Rn(n), steps + 1), ("w", fg.Rn(1), steps), ("b", fg.Rn(1), 1))
    graph.minimize(fg.prior, x[0], np.zeros(n), sigma=unit * arrival, name="arrival")
    graph.minimize(fg.prior, b, [0.0], sigma=1.0, name="bias")
    graph.minimize(fg.prior, w, [0.0], sigma=noise, name="noise")
    seen = unit[0] * rng.normal(size=(steps + 1, 1))
    graph.minimize(lambda p, z: p[:, :1] - z, x, seen, sigma=sight * unit[0], name="sight")
    push = unit * (np.arange(n) == n - 1)
    graph.constrain(lambda p, w, b, q: q - p @ transition.T - (w + b) * push, x[:-1], w, b, x[1:], lower=0.0, upper=0.0)
    guess: dict[fg.Family, Array] = {f: rng.normal(size=(f.count, f.manifold.storage)) for f in (x, w, b)}
    return graph, guess


@pytest.mark.parametrize("full_steps", [False, True])
@pytest.mark.parametrize("noise", [1.0, 1e-3, 1e-6])
@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e3, 1.0, 1e-3), (1e-3, 1.0, 1e3)])
@pytest.mark.parametrize(("sight", "arrival"), [(1.0, 1.0), (1e-3, 1.0), (1.0, 1e3), (1.0, 1e-4)])
def test_weights_and_units_of_linear_problems_do_not_matter(
    sight: float, arrival: float, units: tuple[float, ...], noise: float, full_steps: bool
) -> None:
    """One system solves them; a second one finds that to the last digit."""
    graph, guess = chain(units, noise, sight, arrival)
    solution = KKT(full_steps=full_steps).solve(graph, guess, check=True)
    assert solution.iterations <= 2


@pytest.mark.parametrize("full_steps", [False, True])
@pytest.mark.parametrize("pinned", [(0,), (0, 39), tuple(range(40))], ids=["first", "both ends", "all"])
@pytest.mark.parametrize("manifold", [fg.SE2, fg.SE3], ids=["SE2", "SE3"])
@pytest.mark.parametrize(
    ("seed", "unit", "information"), [(0, 1.0, 1.0), (1, 1e3, 1.0), (2, 1e-3, 1.0), (3, 1.0, 1e6), (4, 1.0, 1e-6)]
)
def test_hard_priors_that_hold_already_are_no_obstacle(
    seed: int, unit: float, information: float, manifold: fg.Manifold, pinned: tuple[int, ...], full_steps: bool
) -> None:
    """Rows that ask an unknown not to move have nothing but rounding to be compared with."""
    graph, guess = pose_chain(manifold, 40, seed, pinned, unit, information)
    solution = KKT(full_steps=full_steps, tolerance=max(1e-6, 1e-10 * information / unit)).solve(
        graph, guess, check=True
    )
    if full_steps or len(pinned) > 1:  # an open end swings far in the first step, and a merit function slows it
        assert solution.iterations <= 12, (seed, unit, information)


def mover(steps: int, dt: float, dimension: int, seen: int | None) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """Places that only speeds and their changes pay for: every place has rows of exact ones and no curvature."""
    graph, p, v = graph_of(("p", fg.Rn(dimension), steps + 1), ("v", fg.Rn(dimension), steps))
    graph.fix(p[0], np.zeros(dimension))
    graph.minimize(lambda v: v, v, sigma=1.5, name="effort")
    graph.minimize(lambda a, b: b - a, v[:-1], v[1:], sigma=0.5, name="smooth")
    if seen is not None:
        graph.minimize(fg.prior, p[seen], np.ones(dimension), sigma=0.1, name="seen")
    graph.constrain(lambda p, v, q: q - p - dt * v, p[:-1], v, p[1:], lower=0.0, upper=0.0, name="motion")
    rng = np.random.default_rng(steps)
    return graph, {f: rng.normal(size=(f.count, dimension)) for f in (p, v)}


@pytest.mark.product(16)
@pytest.mark.parametrize("globalization", ["line-search", "levenberg-marquardt"])
@pytest.mark.parametrize("seen", [None, 1])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("dt", [0.1, 0.25, 1.0])
@pytest.mark.parametrize("steps", [3, 40])
def test_unknowns_without_curvature_between_exact_ones_are_no_obstacle(
    steps: int,
    dt: float,
    dimension: int,
    seen: int | None,
    globalization: Literal["line-search", "levenberg-marquardt"],
) -> None:
    """All that their pivots have is the shift, and its inverse must not take the shift of others."""
    graph, guess = mover(steps, dt, dimension, seen)
    solution = KKT(globalization=globalization).solve(graph, guess, check=True)
    assert solution.iterations <= (1 if globalization == "line-search" else 2)
    assert float(solution.history[-1].details.get("damping", 0.0)) < 1e-6
    # The last place is dt times the sum of the speeds, whose information is known.
    change, first = np.diff(np.eye(steps), axis=0) / 0.5, np.eye(steps)[0] * dt / 0.1
    information = np.eye(steps) / 1.5**2 + change.T @ change + (np.outer(first, first) if seen == 1 else 0.0)
    variance = dt**2 * np.linalg.inv(information).sum()
    places = next(family for family in guess if family.name == "p")
    np.testing.assert_allclose(
        solution.covariance(places[steps]), variance * np.eye(dimension), rtol=1e-9, atol=1e-9 * variance
    )


@pytest.mark.parametrize("start", STARTS)
def test_levenberg_marquardt_on_the_kkt_system_takes_case_study_2(start: tuple[float, float]) -> None:
    graph, guess = ecg2o(start)
    solution = LEVENBERG.solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    assert solution.iterations <= 13
    assert {"damping", "rejected"} <= solution.history[1].details.keys()


def test_levenberg_marquardt_follows_an_open_chain() -> None:
    """Its first step swings far out and raises the cost: a line search crawls, damping does not."""
    graph, guess = pose_chain(fg.SE3, 40, 0, (0,))
    assert LEVENBERG.solve(graph, guess, check=True).iterations <= 10


def test_a_full_step_that_will_probably_be_taken_is_linearised_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not evaluated before, unless steps have been shortened of late."""
    stated = Unicycle("straight", False, 20).formulation()
    graph, x, u = graph_of(("x", fg.SE2, 21), ("u", fg.Rn(2), 20))
    graph.fix(x[0], [0.0, 0.5, -0.4])
    reference, cruise = stated.problem.reference()
    graph.minimize(unicycle.tracking, x, reference, sigma=1.0)
    graph.minimize(fg.prior, u, cruise, sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0.0, upper=0.0)
    monkeypatch.setattr(CompiledProblem, "evaluate", None)
    solution = KKT().solve(graph, {x: reference, u: cruise}, check=True)
    assert all(row.step_length == 1.0 for row in solution.history[1:]) and solution.iterations > 2


@pytest.mark.parametrize("globalization", ["line-search", "levenberg-marquardt"])
@pytest.mark.parametrize("seed", range(20))
def test_chains_with_a_hard_end_are_solved(
    seed: int, globalization: Literal["line-search", "levenberg-marquardt"]
) -> None:
    """Far goals bend the chain so much that Gauss-Newton's steps alone creep: three of twenty were not solved."""
    rng = np.random.default_rng(seed)
    graph, x = graph_with(fg.SE2, 10)
    goal = [*rng.uniform(-8.0, 8.0, 2), rng.uniform(-np.pi, np.pi)]
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.0], sigma=0.1)
    graph.constrain(fg.prior, x[-1], goal, lower=0.0, upper=0.0)
    guess = {x: np.arange(10.0)[:, None] * [1.0, 0.0, 0.0]}
    solution = KKT(globalization=globalization).solve(graph, guess, check=True)
    assert solution.iterations <= 60
    assert solution.cost == pytest.approx(InteriorPoint().solve(graph, guess, check=True).cost, rel=1e-6)


def corner(upper: float) -> tuple[fg.Graph, fg.Family]:
    """A point that is drawn to (1, 2), below a line and a parabola that meet at (1, 1)."""
    graph, x = drawn_to([1.0, 2.0])
    graph.constrain(lambda x: x[:, :1] + x[:, 1:], x, upper=upper, name="line")
    graph.constrain(lambda x: x[:, 1:] - x[:, :1] ** 2, x, upper=0.0, name="parabola")
    graph.bound(x, lower=-5.0, upper=5.0, name="box")
    return graph, x


@pytest.mark.parametrize("rule", ["line-search", "levenberg-marquardt"])
@pytest.mark.parametrize(("upper", "expected"), [(2.0, [1.0, 1.0]), (9.0, None)])
def test_inequalities_are_active_or_have_no_multiplier(upper: float, expected: Any, rule: Any) -> None:
    graph, x = corner(upper)
    solution = KKT(globalization=rule).solve(graph, {x: np.zeros((1, 2))}, check=True)
    assert judge(graph, solution).worst() < 2e-6
    if expected is not None:
        np.testing.assert_allclose(solution[x][0], expected, atol=1e-6)
    assert (solution.multipliers["line"][0, 0] > 0.1) == (upper == 2.0)
    assert solution.multipliers["parabola"][0, 0] > 0.1 and not solution.multipliers["box"].any()


def test_multipliers_of_the_guess_begin_the_active_set() -> None:
    graph, x = corner(2.0)
    first = KKT().solve(graph, {x: np.array([[3.0, -4.0]])}, check=True)
    again = KKT().solve(graph, first, check=True)
    assert again.iterations == 0
    wrong = {"line": np.array([[-1.0]]), "box": np.array([[2.0, -2.0]])}  # at a limit that is none, and far from one
    other = KKT().solve(graph, {x: np.array([[3.0, -4.0]])}, duals=wrong, check=True)
    np.testing.assert_allclose(other[x], first[x], atol=1e-6)


def active_set(limits: Array, multipliers: Array) -> ActiveSet:
    """Rows x below their limits, the first of which is an equality."""
    graph, x = graph_with(fg.Rn(len(limits)))
    graph.minimize(fg.prior, x, np.zeros(len(limits)))
    lower = np.where(np.arange(len(limits)) == 0, limits, -np.inf)
    graph.constrain(lambda x: x, x, lower=lower, upper=limits, name="rows")
    return ActiveSet(graph.compile(), True, multipliers, 1e-9)


def test_rows_enter_and_leave_at_once_then_one_by_one() -> None:
    chosen = active_set(np.ones(4), np.array([-3.0, 1.0, 0.0, -1.0]))
    assert chosen.side.tolist() == [1, 1, 0, 0]
    np.testing.assert_array_equal(chosen.missing(np.array([0.5, 2.0, 2.0, 2.0])), [0.5, -1.0, 0.0, 0.0])
    beyond, pulling = np.array([1.0, 1.5, 1.5, 1.5]), np.array([-3.0, -2.0, 0.0, 0.0])
    sides = []
    for _ in chosen.attempts():  # it never settles, so the set of the beginning is left
        sides.append(chosen.side.tolist())
        assert not chosen.settled(beyond, pulling)
    assert sides[:3] == [[1, 1, 0, 0], [1, 0, 1, 1], [1, 1, 1, 1]]
    assert sides[ALL_AT_ONCE : ALL_AT_ONCE + 3] == [[1, 1, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0]]
    assert len(sides) == ALL_AT_ONCE + ONE_BY_ONE and chosen.side.tolist() == [1, 1, 0, 0]


def test_a_singular_system_ends_a_series_of_attempts() -> None:
    chosen = active_set(np.ones(2), np.array([0.0, 1.0]))
    count = 0
    for _ in chosen.attempts():
        count += 1
        chosen.fail()
    assert count == 2 and chosen.side.tolist() == [1, 1]


def test_rounding_moves_no_row() -> None:
    chosen = active_set(np.ones(3), np.array([0.0, 1.0, 0.0]))
    assert chosen.settled(np.array([1.0, 1.0, 1.0 + 1e-10]), np.array([1e4, -1e-9, 0.0]))
    assert not chosen.settled(np.array([1.0, 1.0, 1.0 + 1e-8]), np.array([1e4, -1e-9, 0.0]))
    assert not chosen.settled(np.array([1.0, 1.0, 1.0 + 1e-8]), np.array([1e4, -1e-7, 1.0]))
