"""``solution.verify()``: good answers of all backends pass, spoiled ones are caught and named."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from numba import njit

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.modeling.variables import Data
from unifg.models import unicycle
from unifg.problem.table import SLACKS
from unifg.solution import as_written
from unifg.solution.as_written import WrittenTerm
from unifg.solution.optimality import Tolerances, optimality, unpaid
from unifg.solution.verify import verified
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
)  # fmt: skip
from unifg.typing import Array

CONSTRAINED = (InteriorPoint(), SQP(), SQP(hessian="exact"), AugmentedLagrangian(tolerance=1e-7))


@njit  # type: ignore[untyped-decorator]
def _range(pose: Array, tree: Array, far: float, r: Array) -> None:
    r[0] = np.sqrt((pose[0] - tree[0]) ** 2 + (pose[1] - tree[1]) ** 2) - far


def _missed(pose: Array, goal: Array) -> Array:
    return pose[:, :2] - goal[:2]


def _low(pose: Array) -> Array:
    return 0.01 * pose[:, 1] ** 4


def _side(pose: Array) -> Array:
    return pose[:, 1:2]


def _in_python(pose: Array) -> Array:
    return np.array([[float(f"{p[2]:.17g}")] for p in pose])  # no trace can stand for it


def control() -> tuple[fg.Graph, dict[Any, Any], Data]:
    """A unicycle's plan: kernels, a NumPy function, bounds, a scalar cost, a soft and a fixed part, data."""
    graph, x, u = graph_of(("x", fg.SE2, 21), ("u", fg.Rn(2), 20))
    goal = graph.data("goal", [1.5, 0.6, 0.0])
    graph.fix(x[0], [0.0, 0.0, 0.0], name="start")
    graph.minimize(_missed, x[-1], goal, sigma=0.1, name="goal")
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0, name="effort")
    graph.minimize_scalar(_low, x, name="low")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
    graph.constrain(_side, x, upper=0.3, soft=0.5, name="road")
    graph.bound(u, lower=-0.8, upper=0.8, name="limits")
    return graph, {x: np.zeros((21, 3)), u: np.full((20, 2), 0.5)}, goal


def estimate() -> tuple[fg.Graph, dict[Any, Any]]:
    """A walk past trees: quaternions, a compiled function of one factor, robust losses, weights of all kinds."""
    rng = np.random.default_rng(1)
    graph, x, trees = graph_of(("x", fg.SE3, 6), ("trees", fg.Rn(2), 2))
    active = np.array([True, True, False, True, True])
    information = np.diag([100.0, 100.0, 50.0, 400.0, 300.0, 400.0])
    information[0, 1] = information[1, 0] = 20.0
    step = fg.SE3.exp(np.array([0.5, 0.0, 0.1, 0.0, 0.1, 0.2]) + 0.02 * rng.normal(size=(5, 6)))
    graph.minimize(fg.prior, x[0], fg.SE3.identity(), sigma=0.01, name="origin")
    graph.minimize(fg.between, x[:-1], x[1:], step, information=information, active=active, name="odometry")
    graph.minimize(fg.prior, x[3], step[0], sigma=2.0, name="weak")
    far = 1.0 + 0.3 * rng.normal(size=6)
    for k, loss in enumerate((fg.Huber(1.0), fg.Cauchy(1.0))):
        seen = fg.residual(_range, rows=1)
        graph.minimize(seen, x, trees[k], fg.each(far), sigma=0.1, robust=loss, name=f"seen {k}")
    graph.minimize(fg.prior, trees, [[1.0, 1.0], [0.5, -1.0]], sigma=0.5, name="map")
    graph.minimize(_in_python, x, sigma=3.0, name="height")
    return graph, {x: np.tile(fg.SE3.identity(), (6, 1)), trees: np.array([[1.0, 1.0], [0.5, -1.0]])}


def test_large_forces_are_judged_relative_to_their_size() -> None:
    """Regression test: a solution that passed by the relative numbers of the KKT test failed by absolute ones."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 500))
    graph.minimize(fg.prior, x, [1.0], sigma=0.01)
    graph.minimize(fg.prior, y, [0.0])
    graph.bound(x, upper=0.0, name="wall")
    graph.bound(y, lower=-1.0, upper=1.0, name="room")
    off = {"wall": np.array([[1e4 + 5e-5]])}
    solution = KKT().solve(graph, {x: np.zeros((1, 1)), y: np.zeros((500, 1))}, duals=off, check=True)
    assert 1e-7 < solution.stationarity <= 1e-6 and solution.iterations == 0
    found = solution.verify()
    assert found and found.claimed is not None
    assert found.claimed.stationarity == pytest.approx(solution.stationarity, rel=1e-3)
    off["wall"] += 1e-3
    assert not KKT(max_iterations=0).solve(graph, solution, duals=off).verify()


@pytest.mark.parametrize("solver", CONSTRAINED, ids=lambda s: f"{s.name}{getattr(s, 'hessian', '')}")
def test_plans_of_all_backends_pass(solver: fg.Solver) -> None:
    graph, guess, goal = control()
    solution = solver.solve(graph, guess, data={goal: [1.2, 0.7, 0.0]}, check=True)
    found = solution.verify()
    assert found, str(found)
    assert found.claimed is not None and found.least is not None and found.multipliers is not None
    assert found.claimed.bound < 1e-8
    assert found.claimed.stationarity == pytest.approx(solution.stationarity, abs=1e-8)
    assert found.violation == pytest.approx(solution.violation, abs=1e-12)
    assert found.cost == pytest.approx(solution.cost, rel=1e-10)
    assert not found.least.fails(1e-6)
    for name, made in found.multipliers.items():
        np.testing.assert_allclose(made, solution.dual(name), atol=1e-3)


@pytest.mark.parametrize(
    "solver", [GaussNewton(), LevenbergMarquardt(), DogLeg(), InteriorPoint()], ids=lambda s: s.name
)
def test_estimates_of_all_backends_pass(solver: fg.Solver) -> None:
    graph, guess = estimate()
    solution = solver.solve(graph, guess, check=True)
    found = solution.verify()
    assert found, str(found)
    assert found.claimed is not None and found.claimed.stationarity == pytest.approx(solution.stationarity, abs=1e-7)
    assert found.cost == pytest.approx(solution.cost, rel=1e-9)


def test_a_perfect_fit_passes() -> None:
    graph, x = graph_with(fg.SE2, 3)
    graph.minimize(fg.prior, x[0], [1.0, 2.0, 0.5], sigma=0.1)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.2, 0.3], sigma=0.01)
    assert GaussNewton().solve(graph, {x: np.zeros((3, 3))}, check=True).verify()


def test_a_perfect_fit_at_zero_passes() -> None:
    """Variables that are zero have no size that rounding could be measured by."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    graph.minimize(lambda a, b: 3.0 * a - b, x, y, sigma=0.5)
    graph.minimize(fg.prior, x, [0.0])
    graph.minimize(fg.prior, y, [0.0])
    solution = GaussNewton().solve(graph, {x: [[1.0]], y: [[1.0]]}, check=True)
    solution._lin.values.flat[:] = 1e-17, -2e-17
    solution.cost = 0.0
    assert solution.verify()


@njit  # type: ignore[untyped-decorator]
def _turned(x: Array, matrix: Array, r: Array) -> None:
    for i in range(2):
        r[i] = matrix[i, 0] * x[0] + matrix[i, 1] * x[1]


@pytest.mark.parametrize("count", [3, 2])
def test_a_function_of_one_factor_takes_matrices_that_all_share(count: int) -> None:
    graph, x = drawn_to([1.0, 2.0], count)
    matrix = np.array([[0.0, -1.0], [1.0, 0.0]])
    graph.constrain(fg.residual(_turned, rows=2), x, fg.shared(matrix), lower=-1.0, upper=0.5, name="turned")
    found = InteriorPoint().solve(graph, {x: np.zeros((count, 2))}, check=True).verify()
    assert found, str(found)


def spoiled(solution: fg.Solution, family: str, member: int, column: int, by: float) -> str:
    """Sentence about an answer with one number moved."""
    solution._lin.values[solution.families[family]][member, column] += by
    found = solution.verify()
    assert found.verdict == "fails"
    return found.sentence


@pytest.fixture
def plan() -> fg.Solution:
    graph, guess, _ = control()
    return InteriorPoint().solve(graph, guess, check=True)


def test_a_moved_pose_is_named(plan: fg.Solution) -> None:
    sentence = spoiled(plan, "x", 7, 0, 1e-3)  # which ends one motion and begins another
    assert sentence in [f"term 'motion', factor {k}, row 0 is 0.001 outside its limits" for k in (6, 7)]


def test_a_bound_that_is_violated_is_named(plan: fg.Solution) -> None:
    bounded = spoiled(plan, "u", 4, 1, 3.0 - plan["u"][4, 1])
    assert "term 'limits', factor 4, row 1 is 2.2 outside its limits" in bounded


def test_a_fixed_variable_that_moved_is_named(plan: fg.Solution) -> None:
    plan._lin.values[plan.families["x"]][0, 1] += 1e-3
    assert plan.verify().sentence == "what 'start' fixes is 0.001 away from its value"


def test_values_that_are_not_finite_are_named(plan: fg.Solution) -> None:
    assert spoiled(plan, "u", 4, 1, np.nan) == "u[4] is no point of its manifold"


@pytest.mark.parametrize(("name", "by"), [("motion", 1e-3), ("limits", 0.2)])
def test_a_wrong_multiplier_is_named(plan: fg.Solution, name: str, by: float) -> None:
    rows = next(rows for term, rows, _ in plan._program.places if term == name)
    plan._multipliers[rows.start + 7] += by
    found = plan.verify()
    size = 3 if name == "motion" else 2
    assert found.verdict == "fails" and "the values pass, the multipliers do not" in found.sentence
    assert f"'{name}', factor {7 // size}, row {7 % size}" in found.sentence
    assert found.least is not None and not found.least.fails(1e-6)


def test_a_quaternion_off_norm_is_named() -> None:
    graph, guess = estimate()
    solution = GaussNewton().solve(graph, guess, check=True)
    assert spoiled(solution, "x", 4, 6, 1e-3) == "x[4] is no point of its manifold"


def test_a_moved_landmark_is_named() -> None:
    graph, guess = estimate()
    solution = GaussNewton().solve(graph, guess, check=True)
    solution._lin.values[solution.families["trees"]][1, 0] += 1e-3
    assert "the cost is" in solution.verify().sentence  # which the solution has told before
    solution.cost = solution.verify().cost
    assert "the cost can still fall" in solution.verify().sentence
    assert "most at trees[1]" in solution.verify().sentence


def test_a_function_that_raises_is_named_and_nothing_is_raised() -> None:
    graph, x = graph_with(fg.Rn(1), 2)
    broken: list[int] = []

    def own(x: Array) -> Array:
        if broken:
            raise ValueError("no such point")
        return x - 1.0

    graph.minimize(own, x, name="own")
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 1))})
    assert solution.verify()
    broken.append(1)
    assert solution.verify().sentence == "term 'own' raises ValueError: no such point"


def test_an_answer_that_claims_nothing_fails_without_an_error() -> None:
    graph, guess, _ = control()
    solution = InteriorPoint(max_iterations=1).solve(graph, guess)
    assert not solution.converged and not solution.verify()


def test_tolerance_counts(plan: fg.Solution) -> None:
    assert plan.verify(1e-6)
    assert plan.verify(1e-15).verdict != "passes"


def test_constraints_of_fixed_variables_alone_pass() -> None:
    graph, x = drawn_to([0.0], 2, name="cost")
    graph.fix(x, [[1.0], [2.0]])
    graph.constrain(lambda a, b: b - a, x[:1], x[1:], lower=0.5, name="apart")
    found = InteriorPoint().solve(graph, {x: [[1.0], [2.0]]}, check=True).verify()
    assert found and found.multipliers is not None and not found.multipliers["apart"].any()


def test_data_are_those_of_the_solve() -> None:
    graph, guess, goal = control()
    loop = InteriorPoint().prepare(graph)
    first = loop.solve(guess, data={goal: [1.2, 0.7, 0.0]})
    second = loop.solve(first, data={goal: [0.4, 0.1, 0.0]})
    sent = pickle.loads(pickle.dumps(first))
    graph.check(guess)  # binds the defaults
    for solution, cost in ((first, first.cost), (second, second.cost), (sent, first.cost)):
        found = solution.verify()
        assert found, str(found)
        assert found.cost == pytest.approx(cost, rel=1e-10)


def test_flags_are_those_of_the_solve() -> None:
    graph, x = graph_with(fg.Rn(1), 3)
    known = graph.data("known", np.array([True, False, True]))
    graph.minimize(fg.prior, x, [[1.0], [2.0], [4.0]], active=known, name="seen")
    graph.minimize(fg.difference, x[:-1], x[1:], name="smooth")
    loop = GaussNewton().prepare(graph)
    first = loop.solve({x: np.zeros((3, 1))})
    loop.solve(first, data={known: [True, True, True]})
    assert first.verify().cost == pytest.approx(first.cost)


def test_data_are_copied_when_they_are_replaced() -> None:
    """A control tick has no time for more."""
    graph, guess, goal = control()
    loop = InteriorPoint().prepare(graph)
    first = loop.solve(guess, data={goal: [1.2, 0.7, 0.0]})
    assert first._data is None
    second = loop.solve(first)
    assert first._data == np.array([1.2, 0.7, 0.0]).tobytes() and second._data is None


def test_a_solution_whose_data_are_gone_is_refused() -> None:
    graph, guess, _ = control()
    loop = InteriorPoint().prepare(graph)
    solution = loop.solve(guess)
    loop.program.binding.holder = None  # as where a solve is repeated without a trace that was wrong
    with pytest.raises(fg.GraphError, match="the data of this solution were replaced"):
        solution.verify()


def test_slopes_that_differences_cannot_tell_are_undecided() -> None:
    graph, x = drawn_to([1.0])
    graph.constrain(lambda x: np.sin(6e4 * (x - 1.0)), x, upper=0.0, name="steep")
    solution = SQP().solve(graph, {x: [[1.0]]}, check=True)
    solution._multipliers[:] = 1e-11  # times slopes of 6e4, of which steps of 6e-5 see less
    found = solution.verify(1e-7)
    assert found.verdict == "undecided" and not found
    assert "differences cannot tell stationarity to 1e-07" in found.sentence
    assert found.claimed is not None and abs(6e-7 - found.claimed.stationarity) < found.claimed.bound


@pytest.mark.parametrize("beside", [0.0, 1e-5, 2e-5, 3e-5, 5e-5])
def test_a_kink_is_undecided(beside: float) -> None:
    """At a kink there is no slope, and beside it steps reach across: the bound tells, wherever it lies."""
    graph, x = drawn_to([2.0])
    graph.constrain(lambda x: np.maximum(x, 3.0 * x - 2.0), x, upper=1.0 - beside, name="bent")
    solution = InteriorPoint(tolerance=1e-9).solve(graph, {x: [[0.5]]})
    solution._lin.values.flat[:] = 1.0 - beside
    solution._multipliers[:] = 1.0 + beside  # with the slope of the left side
    solution.cost = 0.5 * (1.0 + beside) ** 2
    found = solution.verify()
    assert found.verdict == "undecided" and found.claimed is not None
    assert found.claimed.stationarity <= found.claimed.bound


@pytest.mark.parametrize("solver", [SQP(hessian="exact"), AugmentedLagrangian()], ids=lambda s: s.name)
def test_a_direction_without_curvature_is_undecided(solver: fg.Solver) -> None:
    """Jennrich and Sampson: both unknowns are alike at the optimum, so that no row tells them apart."""
    graph, x = graph_with(fg.Rn(2))
    k = np.arange(1.0, 11.0)
    graph.minimize(lambda x: 2.0 + 2.0 * k - np.exp(k * x[:, :1]) - np.exp(k * x[:, 1:]), x, name="sums")
    solution = solver.solve(graph, {x: [[0.3, 0.4]]}, check=True)
    assert solution.verify().verdict == "undecided"


HEIGHTS = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
KNOWS: dict[str, tuple[Any, int]] = {  # a function, and the calls that its slopes take
    "factor by factor": (lambda x, y, each, shared: x * y * each + shared, 2),
    "numbers of its own": (lambda x, y, each, shared: x * y * each + shared * HEIGHTS[:, None], 18),
    "its index": (lambda x, y, each, shared: x * y * each + shared * (np.arange(len(x)) % 2)[:, None], 18),
    "the others": (lambda x, y, each, shared: (x - x.mean(axis=0)) * y * each + shared, 18),
}


@pytest.mark.parametrize("kind", KNOWS)
def test_slopes_take_few_calls_where_the_function_allows_that(kind: str) -> None:
    """Many moves stand in one long call, unless the function knows how many factors there are."""
    function, most = KNOWS[kind]
    calls = []

    def counted(x: Array, y: Array, each: Array, shared: Array) -> Array:
        calls.append(len(x))
        return np.asarray(function(x, y, each, shared))

    graph, x, y = graph_of(("x", fg.Rn(2), 5), ("y", fg.Rn(2), 5))
    active = np.array([True, True, False, True, True])
    given = fg.each(np.arange(1.0, 6.0)[:, None]), fg.shared([0.5, 0.7])
    graph.minimize(counted, x, y, *given, active=active, name="term")
    values = {x: np.arange(10.0).reshape(5, 2) / 7.0, y: np.arange(3.0, 13.0).reshape(5, 2) / 9.0}
    program = graph.compile()
    term = WrittenTerm(program.terms[0].term, program.columns, values, {})
    calls.clear()
    slopes, doubt, _ = term.slopes()
    assert len(calls) == most and max(calls) == 5 * 18
    expected = np.zeros((5, 2, 4))
    own = values[x] - (values[x].mean(axis=0) if kind == "the others" else 0.0)
    for k in range(2):
        expected[:, k, k] = values[y][:, k] * (0.0 if kind == "the others" else np.arange(1.0, 6.0))
        expected[:, k, 2 + k] = own[:, k] * np.arange(1.0, 6.0)
    np.testing.assert_allclose(slopes[active], expected[active], atol=1e-9)
    assert not slopes[~active].any() and doubt.max() < 1e-8


def test_a_large_term_is_moved_call_by_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long call of it would not fit into a cache."""
    monkeypatch.setattr(as_written, "LONGEST", 59)
    lengths = []

    def counted(x: Array) -> Array:
        lengths.append(len(x))
        return np.asarray(np.sin(x))

    graph, x = graph_with(fg.Rn(1), 10)
    graph.minimize(counted, x)
    program = graph.compile()
    term = WrittenTerm(program.terms[0].term, program.columns, {x: np.zeros((10, 1))}, {})
    lengths.clear()
    np.testing.assert_allclose(term.slopes()[0], 1.0, atol=1e-9)
    assert lengths == [10] * 4
    monkeypatch.setattr(as_written, "LONGEST", 60)
    term.slopes()
    assert lengths == [10] * 5 + [60]


@pytest.mark.parametrize(("limit", "price", "beside"), [(1.0, 10.0, 1e-7), (500.0, 1e9, 0.0)], ids=["sum", "ulp"])
def test_what_slacks_do_not_pay_for_is_judged_as_by_the_solver(limit: float, price: float, beside: float) -> None:
    """Neither twice, with the length of the slack, nor where it is the last digit of the row."""
    graph, x = drawn_to([limit + 2.0])
    graph.constrain(lambda x: x, x, upper=limit, soft=price, name="wall")
    program, multipliers = graph.compile(), np.array([2.0, 2.0 - price])

    def claimed(at: float) -> tuple[Any, ...]:
        here = program.values_from({x: [[at]]})
        here[program.soft["wall"].family][:] = beside
        lin = program.linearize(here)
        if at < limit + 1e-6:
            assert optimality(program, lin, multipliers, 1e-6).passes(Tolerances(1e-6, 1e-6))
        return program, {family: here[family] for family in here}, multipliers, lin.cost, {}, 1e-6

    assert verified(*claimed(np.nextafter(limit, np.inf) + 2.0 * beside)).verdict != "fails"
    assert verified(*claimed(limit + 1e-6)).verdict == "fails"


@pytest.mark.parametrize("lower", [-np.inf, -1.0])
def test_every_slack_is_judged_by_its_own_row(lower: float) -> None:
    graph, x = graph_with(fg.Rn(2), 3)
    graph.constrain(lambda x: x, x, lower=lower, upper=1.0, soft=5.0, name="wall")
    program = graph.compile()
    here = program.values_from({x: [[1.5, 0.0], [-2.0, 3.0], [1.0, -1.25]]})
    here[program.soft["wall"].family][:] = 0.0
    outside = np.array([[0.5, 0.0], [1.0, 2.0], [0.0, 0.25]])
    if lower == -np.inf:
        outside[here[x] < 0.0] = 0.0
    constraints, term = program.evaluate(here).constraints, int(np.flatnonzero(program.arrays.fields[:, SLACKS])[0])
    expected = outside if lower == -np.inf else np.tile(outside, (1, 2))  # slacks above, then those below
    found = [unpaid(program.arrays, term, k, constraints) for k in range(expected.size)]
    np.testing.assert_array_equal(found, expected.ravel())
