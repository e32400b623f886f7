"""The interior point alone, watched and with terms in Python, and what data change between solves."""

from __future__ import annotations

import ctypes
import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

import unifg as fg
from own_manifolds import S2, SphereManifold
from problems.control import Quadrotor, Unicycle
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.codegen.clock import clock
from unifg.factors.robust import Loss
from unifg.models import avoidance, quadrotor
from unifg.problem.columns import Values
from unifg.solution.optimality import optimality, read_numbers
from unifg.solution.solve_state import SolveState
from unifg.solvers import SQP, InteriorPoint
from unifg.solvers.interior_point import method
from unifg.solvers.interior_point.method import Workspace
from unifg.typing import Array, ArrayLike


def test_a_watched_solve_takes_the_same_steps() -> None:
    """A callback moves the loop from compiled code to Python; nothing else may change."""
    stated = Unicycle("straight", True, 20).formulation()
    rows: list[fg.Iteration] = []
    solver = InteriorPoint(tolerance=1e-6)
    alone = solver.solve(stated.graph, stated.guess)
    watched = solver.solve(stated.graph, stated.guess, callback=rows.append)
    assert alone.iterations == watched.iterations == rows[-1].number
    assert alone.cost == pytest.approx(watched.cost, rel=1e-9)
    for mine, other in zip(alone.history, watched.history, strict=True):
        assert mine.number == other.number
        assert mine.cost == pytest.approx(other.cost, rel=1e-6)
        assert mine.step_length == pytest.approx(other.step_length, rel=1e-6)
    assert alone.history[-1].terms.keys() == watched.history[-1].terms.keys()


def test_a_stop_rule_ends_when_full_steps_are_short() -> None:
    """It does not grant CONVERGED, and both ways of running obey it."""
    stated = Unicycle("straight", True, 20).formulation()
    whole = InteriorPoint(tolerance=1e-12, max_iterations=30).solve(stated.graph, stated.guess)
    early = InteriorPoint(tolerance=1e-12, max_iterations=30, step_tolerance=1e-2)
    alone = early.solve(stated.graph, stated.guess)
    watched = early.solve(stated.graph, stated.guess, callback=lambda row: None)
    for solution in (alone, watched):
        assert solution.status is fg.Status.STOP_RULE and solution.violation < 1e-4
        assert solution.cost == pytest.approx(whole.cost, rel=1e-3)
    assert alone.iterations == watched.iterations < whole.iterations
    assert alone.history[-1].step_norm < 1e-2 * alone.history[-1].step_length
    never = InteriorPoint(max_iterations=30, step_tolerance=1e3, violation_tolerance=1e-300)
    assert never.solve(stated.graph, stated.guess).converged, "a violation too large to stop at"


@pytest.mark.parametrize("watched", [False, True])
def test_a_time_limit_ends_both_ways_of_running_at_the_same_iterate(
    watched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = Unicycle("straight", True, 20).formulation()
    whole = InteriorPoint(tolerance=1e-4, keep_values=True).solve(stated.graph, stated.guess)
    monkeypatch.setattr(SolveState, "seconds", property(lambda run: float(run.iterations)))
    look = (lambda row: None) if watched else None
    for iterations in (0, 1, 4):
        late = InteriorPoint(tolerance=1e-4, time_limit=iterations - 0.5)
        solution = late.solve(stated.graph, stated.guess, callback=look)
        assert solution.status is fg.Status.TIME_LIMIT and solution.iterations == iterations
        row = whole.history[iterations]
        assert solution.cost == pytest.approx(row.cost, rel=1e-9) and row.values is not None
        np.testing.assert_allclose(solution[stated.x], row.values[stated.x], atol=1e-9)
        assert solution.history[-1].cost == pytest.approx(row.cost, rel=1e-9)
    ample = InteriorPoint(tolerance=1e-4, time_limit=1e3).solve(stated.graph, stated.guess, callback=look)
    assert ample.converged and ample.iterations == whole.iterations
    np.testing.assert_allclose(ample[stated.x], whole[stated.x], atol=1e-9)


def test_a_time_limit_leaves_the_solve_to_compiled_code(monkeypatch: pytest.MonkeyPatch) -> None:
    stated = Unicycle("straight", True, 20).formulation()
    monkeypatch.setattr(SolveState, "accept", None)
    assert InteriorPoint(tolerance=1e-4, time_limit=10.0).solve(stated.graph, stated.guess).converged


@pytest.mark.parametrize("watched", [False, True])
@pytest.mark.parametrize("limit", ["iterations", "time"])
def test_a_stopped_loop_hands_back_what_kept_the_constraints(
    limit: str, watched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A point on a sphere is drawn to one far away: a single step along the tangent leaves the sphere by far."""
    graph, x = graph_with(fg.Rn(3))
    graph.minimize(fg.prior, x, [[0.0, 5.0, 0.0]], sigma=1.0)
    graph.constrain(avoidance.sphere_clearance, x, np.zeros((1, 3)), np.ones(1), lower=0.0, upper=0.0, name="sphere")
    guess = {x: np.array([[1.0, 0.0, 0.0]])}
    monkeypatch.setattr(SolveState, "seconds", property(lambda run: float(run.iterations)))
    options = {"max_iterations": 1} if limit == "iterations" else {"time_limit": 0.5}
    look = (lambda row: None) if watched else None
    rule = {"step_tolerance": np.inf, "violation_tolerance": 1e-4}
    plain = InteriorPoint(**options).solve(graph, guess, callback=look)
    safe = InteriorPoint(**options, **rule).solve(graph, guess, callback=look)  # type: ignore[arg-type]
    assert plain.status is safe.status and plain.iterations == safe.iterations == 1
    assert plain.violation > 0.1, "the plain one hands on where it came to"
    assert safe.violation <= 1e-4
    np.testing.assert_array_equal(safe[x], guess[x])
    outside = {x: np.array([[2.0, 0.0, 0.0]])}
    lost = InteriorPoint(**options, **rule).solve(graph, outside, callback=look)  # type: ignore[arg-type]
    assert lost.violation > 1e-4 and not np.array_equal(lost[x], outside[x]), "nothing kept them"
    done = InteriorPoint(**rule).solve(graph, guess, callback=look)  # type: ignore[arg-type]
    assert done.violation <= 1e-4 and done.iterations > 1


def test_the_same_variable_twice_in_an_equality() -> None:
    """Both columns of a factor mean one entry of the KKT matrix."""
    graph, x = drawn_to([3.0], 2)
    graph.constrain(fg.difference, x[[0, 0]], x[[0, 1]], lower=0.0, upper=0.0, name="equal")
    graph.bound(x, upper=2.0)
    solution = InteriorPoint().solve(graph, {x: np.array([[0.0], [5.0]])}, check=True)
    np.testing.assert_allclose(solution[x], 2.0, atol=1e-6)


def test_limits_given_as_data_may_become_equalities() -> None:
    graph, x = drawn_to([5.0], 3)
    low = graph.data("low", np.full((3, 1), -1.0), each=True)
    graph.bound(x, lower=low, upper=1.0)
    run = InteriorPoint(tolerance=1e-8).prepare(graph)
    start = {x: np.zeros((3, 1))}
    np.testing.assert_allclose(run.solve(start)[x], 1.0, atol=1e-6)
    held = run.solve(start, data={low: np.array([[1.0], [-1.0], [-1.0]])}, check=True)
    np.testing.assert_allclose(held[x], 1.0, atol=1e-6)
    np.testing.assert_allclose(run.solve(start)[x], 1.0, atol=1e-6)


@pytest.mark.parametrize("at", [0, 3, None])
def test_control_c_in_the_compiled_loop_ends_it(monkeypatch: pytest.MonkeyPatch, at: int | None) -> None:
    """Python learns of it when the iteration is over: what it found counts."""
    stated = Unicycle("straight", False, 20).formulation()
    run = InteriorPoint(time_limit=1e3).prepare(stated.graph)  # a loop that minds the time comes back at every step
    undisturbed = run.solve(stated.guess)
    call, loops = Workspace.call, list(range(undisturbed.iterations + 1))
    last = loops[-1] if at is None else at

    def pressed(workspace: Workspace, what: str) -> None:
        call(workspace, what)
        if what == "loop" and loops.pop(0) == last:
            raise KeyboardInterrupt

    monkeypatch.setattr(Workspace, "call", pressed)
    solution = run.solve(stated.guess)
    assert solution.status is (fg.Status.CONVERGED if at is None else fg.Status.INTERRUPTED)
    assert solution.iterations == last == len(solution.history) - 1
    same = (solution.cost, solution.violation) == (undisturbed.cost, undisturbed.violation)
    assert same is (at is None)


def test_control_c_while_a_stalled_solve_is_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x = drawn_to([0.0])
    graph.constrain(lambda p: p**2 + 1.0, x, lower=0.0, upper=0.0)
    run, guess = InteriorPoint().prepare(graph), {x: np.array([[3.0]])}
    assert run.solve(guess).status is fg.Status.LOCALLY_INFEASIBLE

    def pressed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("unifg.solvers.interior_point.method.nearest", pressed)
    solution = run.solve(guess)
    assert solution.status is fg.Status.INTERRUPTED
    assert solution.violation < 11.0


def test_control_c_before_the_compiled_loop_is_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no iterate to return; the prepared run is as good as before."""
    stated = Unicycle("straight", False, 20).formulation()
    run = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    before = run.solve(stated.guess, check=True)

    def pressed(workspace: Workspace, what: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Workspace, "call", pressed)
        with pytest.raises(KeyboardInterrupt):
            run.solve(stated.guess)
    again = run.solve(stated.guess, check=True)
    assert again.cost == before.cost
    assert again.iterations == before.iterations


@pytest.mark.parametrize("soft", [None, 5.0])
@pytest.mark.parametrize("by", ["active", "upper"])
def test_a_warm_start_forgets_the_multipliers_of_rows_without_limit(by: str, soft: float | None) -> None:
    """A row that pressed at the last tick and is switched off at this one has no multiplier."""
    graph, x = drawn_to([1.0], 3)
    on = np.array([True, False, True])
    active, upper = graph.data("active", [True] * 3, each=True), graph.data("upper", np.full((3, 1), 0.5))
    graph.constrain(lambda x: x, x, upper=upper, active=active, soft=soft, name="wall")
    run = InteriorPoint().prepare(graph)
    first = run.solve({x: np.zeros((3, 1))}, check=True)
    data = {active: on} if by == "active" else {upper: np.where(on, 0.5, np.inf)[:, None]}
    for start in (first, first.shifted(x, by=0)):
        freed = run.solve(start, data=data)
        assert freed.converged and freed.iterations < 20
        np.testing.assert_allclose(freed[x].ravel(), [0.5, 1.0, 0.5], atol=1e-5)
        assert freed.dual("wall")[1, 0] == 0.0


def test_a_warm_tick_on_its_way_raises_no_price() -> None:
    """One step before the end, hard equalities still miss the tolerance: no elastic variable was too cheap."""
    problem = Quadrotor("figure8", False, 20)
    stated = problem.formulation()
    run = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    solution = run.solve(stated.guess, data=stated.data(problem.start, 0))
    iterations = []
    for tick in range(1, 41):
        state = solution[stated.x][1]
        solution = run.solve(solution.shifted(stated.x, stated.u), data=stated.data(state, tick))
        iterations.append(solution.iterations)
        assert solution.converged
        assert all(float(row.details["mu"]) <= 1e-5 for row in solution.history[1:])
    assert max(iterations) <= 3


def test_an_end_without_cost_keeps_second_derivatives() -> None:
    """Nothing curves heading and speed of the last node, whose pivots vanish where they precede its motion.

    That is no wrong inertia: with Gauss-Newton's Hessian in its place the warm starts took 30 to 40 iterations.
    """
    graph, n = fg.Graph(), 20
    x, u = graph.variables("x", fg.Rn(4), n + 1), graph.variables("u", fg.Rn(2), n)
    lasting = graph.variables("T", fg.Rn(1), 1)
    start = graph.data("start", [0.0, 0.0, 0.3, 1.0])

    def motion(a: Array, u: Array, seconds: Array, b: Array) -> Array:
        field = np.stack([a[:, 3] * np.cos(a[:, 2]), a[:, 3] * np.sin(a[:, 2]), u[:, 0], u[:, 1]], axis=1)
        return b - a - seconds / n * field

    graph.fix(x[0], start)
    graph.constrain(motion, x[:-1], u, lasting, x[1:], lower=0.0, upper=0.0)
    graph.minimize(lambda end: end[:, :2] - np.array([2.0, 1.0]), x[-1], sigma=0.5)
    graph.minimize(fg.prior, u, np.zeros(2))
    graph.bound(lasting, lower=0.5, upper=8.0)
    graph.constrain(lambda p: np.hypot(p[:, 0] - 1.0, p[:, 1] - 0.4)[:, None], x[1:], lower=0.5)
    run = InteriorPoint(tolerance=1e-9).prepare(graph)
    straight = np.linspace([0.0, 0.0, 0.4, 1.0], [2.0, 1.0, 0.4, 1.0], n + 1)
    solution = run.solve({x: straight, u: np.zeros((n, 2)), lasting: [[2.0]]}, check=True)
    for seed in range(10):
        moved = start.value + 1e-4 * np.random.default_rng(seed).standard_normal(4)
        again = run.solve(solution, data={start: moved}, check=True)
        assert again.iterations <= 5 and not any("gauss_newton" in row.details for row in again.history)


def in_python(graph: fg.Graph, names: Sequence[str] | None = None) -> fg.Graph:
    """State some terms as functions of NumPy with the same Jacobians; all of them if no names are given."""
    for k, term in enumerate(graph.terms):
        kernel = term.residual.kernel
        if kernel is not None and (names is None or term.name in names):
            plain = fg.residual(
                lambda *a, f=kernel: f(*a), lambda *a, f=kernel: f.jacobian(*a), name=term.residual.name
            )
            graph.terms[k] = replace(term, residual=plain)
    return graph


def disturbed(loss: Loss | None) -> tuple[fg.Graph, fg.Guess]:
    """A drive past discs whose references have losses, one of them switched off, to an end that is given."""
    stated = Unicycle("straight", True, 10).formulation()
    graph = stated.graph
    x = graph.families["state"]
    sighted = np.array([True, False, True])
    graph.minimize(fg.prior, x[[3, 5, 8]], np.zeros(3), sigma=0.3, robust=loss, active=sighted, name="sights")
    return graph, stated.guess


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("loss", [None, fg.Cauchy(0.5), fg.Reweighted(lambda s: np.where(s < 5.0, 1.0, 0.25))])
@pytest.mark.product(3)
def test_terms_in_python_change_no_step(loss: Loss | None, hessian: Literal["gauss-newton", "exact"]) -> None:
    """None, one or all terms without a kernel; alone or watched: one loop, the same iterates."""
    runs = []
    for names in ((), ("sights",), ("dynamics", "sights"), None):
        graph, guess = disturbed(loss)
        in_python(graph, names)
        solver = InteriorPoint(tolerance=1e-7, hessian=hessian)
        run = solver.prepare(graph)
        plain = [term for term in graph.terms if term.residual.kernel is None and not getattr(term, "is_bound", False)]
        assert len(run.program.batched) == len(plain) >= (len(names) if names is not None else 4)
        runs += [run.solve(guess), run.solve(guess), run.solve(guess, callback=lambda row: None)]
    first = runs[0]
    assert first.converged and first.iterations > 4
    for other in runs[1:]:
        assert other.iterations == first.iterations
        mine, wanted = ([(row.cost, row.step_length) for row in solution.history] for solution in (other, first))
        np.testing.assert_allclose(mine, wanted, rtol=1e-10 if hessian == "gauss-newton" else 1e-5)
        assert other.history[-1].terms.keys() == first.history[-1].terms.keys()


class Plain(SphereManifold):
    """Unit vectors, moved by Python."""

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        return S2.retract(x, d)


@pytest.mark.parametrize("sphere", [S2, Plain()], ids=["compiled", "Python"])
def test_a_manifold_without_a_compiled_retraction_and_a_fixed_member(sphere: SphereManifold) -> None:
    """Its part of a step is taken in Python; what is fixed stays to the last bit."""
    rng = np.random.default_rng(2)
    graph, g, q = graph_of(("g", sphere, 2), ("q", fg.SO3, 2))
    kept = fg.SO3.random(rng) * (1.0 + 3e-13)
    graph.fix(q[0], kept)
    seen = S2.random(rng, (12,))
    graph.minimize(lambda a, z: a - z, g[np.arange(12) % 2], seen, sigma=0.3)
    graph.minimize(fg.between, q[0], q[1], fg.SO3.exp([0.3, -0.2, 0.5]), sigma=0.1)
    graph.constrain(lambda a: a[:, 2:], g, lower=0.4, upper=0.9)
    guess = {g: S2.random(rng, (2,)), q: np.tile(kept, (2, 1))}
    runs = [InteriorPoint(tolerance=1e-7).prepare(graph).solve(guess, callback=c) for c in (None, lambda row: None)]
    for solution in runs:
        assert solution.converged, solution.report()
        assert solution.iterations > 3
        assert solution[q][0].tobytes() == kept.tobytes()
        np.testing.assert_allclose(np.linalg.norm(solution[g], axis=1), 1.0, atol=1e-12)
        assert solution.cost == pytest.approx(runs[0].cost, rel=1e-12)
    # The mean of what was seen, cut at its limits.
    for k in range(2):
        mean = seen[k::2].sum(axis=0)
        height = np.clip(mean[2] / np.linalg.norm(mean), 0.4, 0.9)
        wanted = np.array([*(np.sqrt(1.0 - height**2) * mean[:2] / np.linalg.norm(mean[:2])), height])
        np.testing.assert_allclose(runs[0][g][k], wanted, atol=1e-5)


def test_control_c_while_a_term_runs_in_python() -> None:
    graph, guess = disturbed(None)
    in_python(graph, ["sights"])
    run = InteriorPoint(tolerance=1e-7).prepare(graph)
    whole = run.solve(guess)
    batched, calls = run.program.batched[0], 0
    evaluate = batched.residual

    def pressed(values: Values) -> Array:
        nonlocal calls
        calls += 1
        if calls == 6:
            raise KeyboardInterrupt
        return evaluate(values)

    batched.residual = pressed  # type: ignore[method-assign]
    solution = run.solve(guess)
    assert solution.status is fg.Status.INTERRUPTED
    assert 0 < solution.iterations < whole.iterations
    assert solution.cost == pytest.approx(run.program.evaluate(solution.values).cost, rel=1e-12)
    batched.residual = evaluate  # type: ignore[method-assign]
    assert run.solve(guess).cost == whole.cost


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
@pytest.mark.parametrize("force", [900.0, 940.0, 990.0, 1000.0, 1010.0])
def test_a_multiplier_near_its_price_is_no_end(force: float, tolerance: float) -> None:
    """With a price of 1000 the row gives way by mu / (1000 - force), which is too much for complementarity alone."""
    graph, x = graph_with(fg.Rn(1), 30)
    graph.minimize_scalar(lambda x: force * x[:, 0], x[0], name="push")
    graph.minimize(fg.prior, x, np.ones(1), name="stay")
    graph.bound(x, lower=0.0, name="wall")
    solution = InteriorPoint(tolerance=tolerance).solve(graph, {x: np.ones((30, 1))})
    assert solution.converged and solution.iterations < 40
    assert -tolerance < solution[x][0, 0] < 1e-3


@pytest.mark.parametrize("scalar", [False, True])
@pytest.mark.parametrize("aside", [0.0, 1e-9, 1e-3])
def test_orders_of_elimination_lose_no_digits(scalar: bool, aside: float) -> None:
    """A flight straight at a cylinder, kept off by Ta's potential alone: large curvatures of either sign.

    With the horizon eliminated by minimum degree this took from 17 iterations to the limit.
    """
    count, dt = 40, 0.1
    vehicle = quadrotor.Parameters(mass=1.2, drag=(0.2, 0.2, 0.3), wind=(0.0, 0.5))
    graph, x, u = graph_of(("x", quadrotor.STATE, count + 1), ("u", quadrotor.CONTROL, count))
    start, target = np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 1.5])
    tree, trunk = np.array([[2.5, 0.1]]), np.array([0.75])
    still, hover = np.concatenate([start, quadrotor.hover_attitude(vehicle), np.zeros(3)]), quadrotor.hover(vehicle)
    graph.fix(x[0], still)
    graph.minimize(fg.prior, x[1:].p, target, sigma=2.0)
    graph.minimize(fg.prior, u, hover, sigma=[2.0, 2.0, 2.0, 5.0])
    graph.constrain(quadrotor.dynamics, x[:-1], u, x[1:], vehicle.packed, dt, lower=0, upper=0)
    if scalar:
        graph.minimize_scalar(avoidance.inverse_distance(avoidance.cylinder_clearance), x[1:].p, tree, trunk)
    else:
        graph.minimize(avoidance.inverse_distance_root(avoidance.cylinder_clearance), x[1:].p, tree, trunk)
    straight = np.tile(still, (count + 1, 1))
    straight[:, :3] = np.linspace(start, target, count + 1)
    straight[:, 1] += aside * np.sin(np.linspace(0.0, 3.1, count + 1))
    solution = InteriorPoint().solve(graph, {x: straight, u: np.tile(hover, (count, 1))}, check=True)
    assert solution.iterations <= 16, solution.report()


@pytest.mark.parametrize("case", [Unicycle("straight", True, 20), Quadrotor("goto", False, 20)], ids=str)
def test_a_tick_is_judged_by_the_numbers_of_the_outside_judge(case: Unicycle | Quadrotor) -> None:
    """Compiled code judges its last iterate; the judge of all backends finds the same from the same linearisation."""
    stated = case.formulation()
    for options in ({}, {"step_tolerance": np.inf}, {"max_iterations": 2}):
        prepared = InteriorPoint(tolerance=1e-4, **options).prepare(stated.graph)
        found = prepared.solve(stated.guess)
        for _ in range(2):
            again = optimality(prepared.program, found._lin, found._multipliers, 1e-4)
            assert (found.stationarity, found.violation, found.complementarity) == again[:3]
            fresh = prepared.program.linearize(found.values)
            assert optimality(prepared.program, fresh, found._multipliers, 1e-4)[:3] == pytest.approx(
                again[:3], abs=1e-9
            )
            assert found.cost == pytest.approx(fresh.cost, rel=1e-12)
            for name in ("residual", "jacobian", "constraints", "constraint_jacobian", "gradient", "norms", "scalars"):
                assert_same(getattr(found._lin, name), getattr(fresh, name))
            found = prepared.solve(found.shifted(stated.x, stated.u))


def assert_same(one: Any, other: Any) -> None:
    if isinstance(one, dict):
        assert one == pytest.approx(other)
    else:
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_a_shifted_guess_is_what_it_shows() -> None:
    """Flat arrays until somebody looks; what is changed then counts."""
    stated = Unicycle("straight", False, 20).formulation()
    prepared = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    first = prepared.solve(stated.guess)
    seen, unseen = first.shifted(stated.x, stated.u), first.shifted(stated.x, stated.u)
    np.testing.assert_array_equal(seen.values[stated.u][:-1], first[stated.u][1:])
    assert set(seen.multipliers) == {"dynamics", "limits"} and seen.penalties == {}
    copied = pickle.loads(pickle.dumps(unseen))
    assert list(map(np.shape, copied.values.values())) == [(21, 3), (20, 2)]
    one, other = prepared.solve(seen), prepared.solve(unseen)
    np.testing.assert_array_equal(one[stated.x], other[stated.x])
    assert one.iterations == other.iterations < first.iterations
    changed = first.shifted(stated.x, stated.u)
    dual = np.full_like(changed.multipliers["limits"], np.nan)
    with pytest.raises(fg.GraphError, match="multipliers of 'limits' are not finite"):
        prepared.solve(replace(changed, multipliers={"limits": dual}))
    flat = first.shifted(stated.x, stated.u)
    flat.__dict__["_stored"][1][1][5] = np.inf
    with pytest.raises(fg.GraphError, match="are not finite"):
        prepared.solve(flat)
    kept = first._multipliers.copy()
    prepared.solve(first)
    np.testing.assert_array_equal(first._multipliers, kept)


def test_the_time_of_a_solve_is_told_by_its_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    stated = Quadrotor("figure8", True, 20).formulation()
    prepared = InteriorPoint().prepare(stated.graph)
    prepared.solve(stated.guess)
    found = prepared.solve(stated.guess)
    assert list(found.times) == ["evaluation", "linear systems", "search", "judge", "Python"]
    assert min(found.times.values()) > 0.0 and sum(found.times.values()) == pytest.approx(found.seconds)
    assert found.times["evaluation"] > found.times["judge"] and found.times["linear systems"] > found.times["judge"]
    assert re.search(r"Of the time: evaluation \d+ %, linear systems \d+ %", found.report())
    assert "Of the time" not in repr(found) and pickle.loads(pickle.dumps(found)).times == found.times
    assert (
        SQP().solve(stated.graph, stated.guess).times == InteriorPoint().solve(stated.graph, stated.guess).times == {}
    )
    with monkeypatch.context() as patched:  # the test of the answer is part of that one call, and told once
        patched.setattr(method, "perf_counter", iter([0.0, 5.0]).__next__)
        parts = prepared.solve(found.shifted(stated.x, stated.u)).times
    assert sum(parts[name] for name in ("evaluation", "linear systems", "search", "judge")) == pytest.approx(5.0)
    prepared._workspace.now["clock"], prepared._workspace._settings = 0, None  # a system without that clock
    found = prepared.solve(stated.guess)
    assert found.times == {} and "Of the time" not in found.report()
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert clock.__wrapped__() == 0


def test_a_tick_of_one_step_leaves_second_derivatives_out() -> None:
    """They pay where steps converge; a solve to the answer, and a cold one, have them."""
    stated = Unicycle("straight", True, 20).formulation()
    plain = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    first = plain.solve(stated.guess)
    tick = InteriorPoint(tolerance=1e-4, step_tolerance=np.inf).prepare(stated.graph)
    shifted = first.shifted(stated.x, stated.u)
    rows: list[fg.Iteration] = []
    tick.solve(shifted, callback=rows.append)
    assert rows[1].details["gauss_newton"] == 1
    plain.solve(shifted, callback=rows.append)
    assert "gauss_newton" not in rows[-1].details
    cold: list[fg.Iteration] = []
    tick.solve(stated.guess, callback=cold.append)
    assert "gauss_newton" in cold[1].details and "gauss_newton" not in cold[2].details


def cusp() -> tuple[fg.Graph, Any]:
    """HS13: no multipliers at the answer."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda p: p - [2.0, 0.0], x, name="near")
    graph.constrain(lambda p: (1.0 - p[:, :1]) ** 3 - p[:, 1:], x, lower=0.0, name="cusp")
    graph.bound(x, lower=0.0, name="box")
    return graph, {x: [[-2.0, -2.0]]}


def falling() -> tuple[fg.Graph, Any]:
    """A cost that falls without end."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda p: -(p[:, 0] ** 3), x, name="height")
    graph.bound(x, lower=0.0, name="box")
    return graph, {x: [[1.0]]}


def driving() -> tuple[fg.Graph, Any]:
    """A drive past discs."""
    stated = Unicycle("straight", True, 20).formulation()
    return stated.graph, stated.guess


@pytest.mark.parametrize(
    ("problem", "options", "status"),
    [
        (driving, {}, fg.Status.CONVERGED),
        (driving, {"tolerance": 1e-12, "step_tolerance": 1e-3}, fg.Status.STOP_RULE),
        (driving, {"step_tolerance": np.inf, "max_iterations": 2}, fg.Status.ITERATION_LIMIT),
        (driving, {"max_iterations": 3}, fg.Status.ITERATION_LIMIT),
        (driving, {"time_limit": 1e3}, fg.Status.CONVERGED),
        (driving, {"keep_values": True}, fg.Status.CONVERGED),
        (cusp, {}, fg.Status.DEGENERATE),
        (falling, {}, fg.Status.UNBOUNDED),
    ],
)
def test_a_solve_in_one_call_says_what_a_solve_in_parts_says(
    problem: Any, options: dict[str, Any], status: fg.Status
) -> None:
    graph, guess = problem()
    solver = InteriorPoint(**options)
    used, fresh = solver.prepare(graph), solver.prepare(graph)
    used.solve(guess)
    one, other = used.solve(guess), fresh.solve(guess)  # the first one of a prepared solver goes on in parts
    assert one.status is other.status is status
    assert one.returned == other.returned and one.iterations == other.iterations
    np.testing.assert_array_equal(one._lin.stored, other._lin.stored)
    np.testing.assert_array_equal(one._multipliers, other._multipliers)
    for number in ("cost", "stationarity", "violation", "complementarity", "tolerance", "worst", "finite"):
        assert getattr(one, number) == getattr(other, number), number
    assert len(one.history) == len(other.history)
    assert [row.cost for row in one.history] == [row.cost for row in other.history]
    if "keep_values" in options:
        assert one.history[0].values is not None


def test_a_tick_is_one_call_until_something_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, guess = driving()
    prepared = InteriorPoint().prepare(graph)
    prepared.solve(guess)
    begun: list[bool] = []
    real = InteriorPoint.at_once

    def at_once(*given: Any) -> Any:
        found = real(*given)
        begun.append(not isinstance(found, bool))
        return found

    monkeypatch.setattr(InteriorPoint, "at_once", at_once)
    first = prepared.solve(guess)
    prepared.solver.tolerance = 1e-3  # an option of the same solver
    loose = prepared.solve(guess)
    prepared.solve(guess)
    assert begun == [True, False, True]
    assert loose.tolerance == 1e-3 and loose.iterations < first.iterations
    prepared.solve(guess, callback=lambda row: None)
    assert len(begun) == 3


def test_a_call_is_judged_before_its_answer_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solve goes on in parts if its answer, converged by the loop, does not pass the judge of all backends."""
    graph, guess = driving()
    prepared = InteriorPoint().prepare(graph)
    expected = prepared.solve(guess)
    asked: list[Any] = []

    def doubted(found: Array, cost: float) -> Any:
        asked.append(read_numbers(found, cost))
        return asked[0]._replace(stationarity=1.0) if len(asked) == 1 else asked[-1]

    monkeypatch.setattr(method, "read_numbers", doubted)
    found = prepared.solve(guess)
    assert asked and found.converged and found.stationarity == expected.stationarity


def test_one_call_says_what_parts_say_where_a_stop_rule_and_a_limit_meet() -> None:
    graph, guess = driving()
    options: dict[str, Any] = {"tolerance": 1e-12, "step_tolerance": 1e-2}
    last = InteriorPoint(**options).solve(graph, guess).iterations
    said = []
    for limit in (last - 1, last, last + 1):
        solver = InteriorPoint(max_iterations=limit, **options)
        used, fresh = solver.prepare(graph), solver.prepare(graph)
        used.solve(guess)
        one, other = used.solve(guess), fresh.solve(guess)
        assert one.status is other.status and one.iterations == other.iterations
        np.testing.assert_array_equal(one._lin.stored, other._lin.stored)
        said.append(one.status)
    assert said == [fg.Status.ITERATION_LIMIT, fg.Status.ITERATION_LIMIT, fg.Status.STOP_RULE]
