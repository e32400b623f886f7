"""Nothing is CONVERGED that is not: lying backends, lost derivatives, rounding as large as the tolerance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.solution.multipliers import Slopes, estimated
from unifg.solution.optimality import optimality
from unifg.solution.solve_state import SolveState
from unifg.solution.solver import Solver
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
    choice,
)
from unifg.typing import Array

EVERY: list[Solver] = [
    GaussNewton(),
    LevenbergMarquardt(),
    DogLeg(),
    Penalty(),
    AugmentedLagrangian(),
    KKT(),
    InteriorPoint(),
    SQP(),
]


class Liar(Solver):
    """Says CONVERGED wherever it is told to stand, with the multipliers it is told to have."""

    def __init__(self, point: float, multiplier: float) -> None:
        super().__init__()
        self.point, self.multiplier = point, multiplier

    def workspace(self, program: Any) -> None:
        return None

    def iterate(self, run: SolveState, workspace: Any) -> fg.Status:
        moved = run.program.retract(run.values, np.array([self.point]) - run.values.flat)
        multipliers = np.zeros(len(run.multipliers))
        multipliers[:1] = self.multiplier
        run.accept(run.program.linearize(moved), multipliers, 1.0, 1.0)
        run.status = fg.Status.CONVERGED
        return fg.Status.CONVERGED


def limited() -> tuple[fg.Graph, fg.Family]:
    """Minimise 1/2 (x - 3)^2 with x <= 1: x = 1, multiplier 2."""
    graph, x = drawn_to([3.0])
    graph.constrain(lambda p: p, x, upper=1.0, name="limit")
    return graph, x


@pytest.mark.parametrize(
    ("point", "multiplier", "believed"),
    [(1.0, 2.0, True), (0.5, 0.0, False), (2.0, 1.0, False), (1.0, -2.0, False), (1.0, 0.0, False), (5.0, -2.0, False)],
    ids=["true", "not stationary", "outside", "wrong sign", "no multiplier", "wrong sign, stationary"],
)
def test_a_backend_is_not_believed(point: float, multiplier: float, believed: bool) -> None:
    graph, x = limited()
    solution = Liar(point, multiplier).solve(graph, {x: np.zeros((1, 1))})
    assert solution.converged is believed
    assert (solution.status is fg.Status.CONVERGED) is believed


@pytest.mark.parametrize("solver", [InteriorPoint(max_iterations=300), SQP(max_iterations=300)], ids=lambda s: s.name)
def test_no_minimum_is_found_where_there_is_none(solver: Solver) -> None:
    """Far out an absolute step is lost, and every difference looks like zero."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    graph.minimize_scalar(lambda a, b: -(a + b)[:, 0], x, y)
    graph.constrain(lambda a, b: a - b, x, y, lower=0.0, upper=0.0)
    assert not solver.solve(graph, {x: [[1.0]], y: [[2.0]]}).converged

    saddle, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    saddle.minimize_scalar(lambda a, b: (b**2 - a**2)[:, 0], x, y)
    saddle.bound(y, lower=-1.0, upper=1.0)
    assert not solver.solve(saddle, {x: [[1.0]], y: [[0.5]]}).converged


@pytest.mark.parametrize("size", [7e10, 1e15, 1e27])
def test_derivatives_do_not_vanish_far_out(size: float) -> None:
    """The point itself is judged, whatever a backend would do there."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    graph.minimize_scalar(lambda a, b: -(a + b)[:, 0], x, y)
    graph.minimize(lambda a, b: 1e-3 * (a - b), x, y)
    lin = graph.compile().linearize({x: np.array([[size]]), y: np.array([[size]])})
    np.testing.assert_allclose(lin.gradient, -1.0, rtol=1e-4)
    np.testing.assert_allclose(lin.jacobian, [1e-3, -1e-3], rtol=1e-4)


@pytest.mark.parametrize("solver", [InteriorPoint(), SQP()], ids=lambda s: s.name)
@pytest.mark.parametrize("scale", [1.0, 1e8])
@pytest.mark.parametrize("derivatives", ["differences", "trace"])
def test_rounding_above_the_tolerance_is_said(derivatives: Any, solver: Solver, scale: float) -> None:
    """Of 1e8 cosh(x - 1) differences know the slope to 1e-4: 1e-6 cannot be claimed. What was derived is exact."""
    graph, x = graph_with(fg.Rn(1))
    cost = fg.residual(lambda p: scale * np.cosh(p[:, 0] - 1.0), derivatives=derivatives)
    graph.minimize_scalar(cost, x)
    solution = solver.solve(graph, {x: np.full((1, 1), 1.3)})
    assert solution[x][0, 0] == pytest.approx(1.0, abs=1e-5)
    rounded = derivatives == "differences" and scale != 1.0
    assert solution.converged is not rounded
    assert (solution.rounding > solver.tolerance) is rounded


@numba.njit  # type: ignore[untyped-decorator]
def far_above(p: Array, r: Array) -> None:
    r[0] = 1e3 * np.cosh(p[0] - 1.0)


@numba.njit  # type: ignore[untyped-decorator]
def far_above_slope(p: Array, J: Array) -> None:
    J[0, 0] = 1e3 * np.sinh(p[0] - 1.0)


@pytest.mark.product(2)
@pytest.mark.parametrize("stated", ["njit", "NumPy", "attached", "traced", "NumPy, traced"])
def test_rounding_of_residuals(stated: str) -> None:
    """A residual of 1e3 at the solution, beside a constraint; with a Jacobian that is exact it is as good as any."""
    residuals: dict[str, Any] = {
        "njit": fg.residual(far_above, rows=1, derivatives="differences"),
        "NumPy": fg.residual(lambda p: 1e3 * np.cosh(p - 1.0), derivatives="differences"),
        "attached": fg.residual(far_above, far_above_slope, rows=1),
        "traced": fg.residual(far_above, rows=1),
        "NumPy, traced": lambda p: 1e3 * np.cosh(p - 1.0),
    }
    exact = stated in ("attached", "traced", "NumPy, traced")
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(residuals[stated], x)
    graph.constrain(fg.prior, x, [0.0], upper=1.0)
    solution = InteriorPoint().solve(graph, {x: np.full((1, 1), 1.0)})
    assert solution.converged is exact
    assert solution.status is (fg.Status.CONVERGED if exact else fg.Status.IMPRECISE)


@pytest.mark.parametrize("solver", EVERY, ids=lambda s: s.name)
def test_a_residual_may_use_the_same_memory_at_each_call(solver: Solver) -> None:
    graph, buffer = fg.Graph(), np.empty((1, 1))
    x = graph.variables("x", fg.Rn(1), 1)

    def same(p: Array) -> Array:
        np.subtract(p, 2.0, out=buffer)
        return buffer

    graph.minimize(same, x)
    solution = solver.solve(graph, {x: np.zeros((1, 1))}, check=True)
    assert solution[x][0, 0] == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.int64, np.complex128])
@pytest.mark.parametrize("scalar", [False, True])
def test_results_are_float64(kind: type, scalar: bool) -> None:
    graph, x = graph_with(fg.Rn(1))
    state: Callable[..., Any] = graph.minimize_scalar if scalar else graph.minimize
    with pytest.raises(fg.GraphError, match=rf"'coarse'.*{np.dtype(kind)}.*float64"):
        state(lambda p: (p[:, 0] if scalar else p).astype(kind), x, name="coarse")


def test_jacobians_are_float64() -> None:
    graph, x = graph_with(fg.Rn(1))
    with pytest.raises(fg.GraphError, match=r"'coarse'.*Jacobian.*float32"):
        graph.minimize(fg.residual(lambda p: p, lambda p: [np.ones((1, 1, 1), dtype=np.float32)]), x, name="coarse")


@numba.njit  # type: ignore[untyped-decorator]
def wraps(p: Array, r: Array) -> None:
    p[0] = p[0] % 2.0
    r[0] = p[0]


def batched_wraps(p: Array) -> Array:
    p %= 2.0
    return p - 1.0


def batched_scales(p: Array, factor: Array) -> Array:
    factor *= 2.0
    return p * factor


def test_a_residual_that_changes_its_arguments_is_named() -> None:
    cases: list[tuple[Any, tuple[Array, ...]]] = [
        (fg.residual(wraps, rows=1), ()),
        (batched_wraps, ()),
        (batched_scales, (np.array([[3.0]]),)),
    ]
    for residual, constants in cases:
        graph, x = graph_with(fg.Rn(1))
        graph.minimize(residual, x, *constants, name="wrapped")
        with pytest.raises(fg.GraphError, match=r"'wrapped'.*changes its argument"):
            GaussNewton().solve(graph, {x: np.full((1, 1), 5.0)})


@numba.njit  # type: ignore[untyped-decorator]
def forgets(p: Array, r: Array) -> None:
    r[0] = p[0]


def test_a_compiled_residual_that_leaves_rows_out_is_named() -> None:
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(fg.residual(forgets, rows=2), x, name="short")
    with pytest.raises(fg.GraphError, match=r"'short'.*row 1"):
        GaussNewton().solve(graph, {x: np.ones((1, 1))})


def test_information_of_zero_is_not_silent(caplog: pytest.LogCaptureFixture) -> None:
    graph, x = drawn_to([1.0, 1.0], information=np.zeros((2, 2)), name="nothing")
    run = LevenbergMarquardt().prepare(graph)
    for _ in range(3):
        assert run.solve({x: np.ones((1, 2))}).status is fg.Status.UNDETERMINED
    assert caplog.text.count("'nothing'") == 1


def test_data_switch_a_term_off_in_silence(caplog: pytest.LogCaptureFixture) -> None:
    """Windows do so at every tick; whether anything is missing then, the status says."""
    graph, x = graph_with(fg.Rn(2))
    weight = graph.data("weight", np.eye(2))
    graph.minimize(fg.prior, x, [1.0, 1.0], information=weight, name="switched")
    run, off = LevenbergMarquardt().prepare(graph), {weight: np.zeros((2, 2))}
    assert run.solve({x: np.ones((1, 2))}, data=off).status is fg.Status.UNDETERMINED
    assert run.solve({x: np.ones((1, 2))}).converged
    graph.minimize(fg.prior, x, [0.0, 0.0])
    assert LevenbergMarquardt().solve(graph, {x: np.ones((1, 2))}, data=off).converged
    assert caplog.text == ""


def flat(row: Callable[[Array], Array], cost: float, rows: float, unknown: float) -> tuple[fg.Graph, fg.Family]:
    """Minimise 1/2 (x - 1)^2 where a row is zero, in other units of cost, row and unknown."""
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(lambda p: p / unknown - 1.0, x, sigma=cost**-0.5)
    graph.constrain(lambda p: rows * row(p / unknown), x, lower=0.0, upper=0.0, name="row")
    return graph, x


@pytest.mark.parametrize("unknown", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("rows", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("cost", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("row", "start", "point", "slope", "degenerate"),
    [
        (np.exp, 0.0, -19.0, np.exp(-19.0), True),
        (lambda p: p**3, 2.0, 1e-4, 3e-8, True),
        (lambda p: p**3, 2.0, 0.5, 0.75, False),
        (lambda p: np.sin(1e-5 * p), 2.0, 1e-8, 1e-5, False),
    ],
    ids=["exp", "cube", "slope", "small slope"],
)
@pytest.mark.product(25)
def test_degenerate_multipliers_have_no_units(
    row: Callable[[Array], Array],
    start: float,
    point: float,
    slope: float,
    degenerate: bool,
    cost: float,
    rows: float,
    unknown: float,
) -> None:
    """A row whose slope is gone needs a multiplier that is huge in any unit."""
    graph, x = flat(row, cost, rows, unknown)
    program = graph.compile()
    first, lin = (program.linearize({x: np.full((1, 1), unknown * value)}) for value in (start, point))
    slopes = Slopes(program, first.constraint_jacobian, first.gradient)
    slopes.see(lin.constraint_jacobian, lin.gradient)
    multipliers = np.array([-cost * (point - 1.0) / (rows * slope)])
    assert np.abs(program.lagrangian_gradient(lin, multipliers)).max() < 1e-6 * cost / unknown
    assert (slopes.excess(lin, multipliers, 1e-6) > 0.0) is degenerate


LOSING = [SQP(), SQP(hessian="exact"), KKT(), InteriorPoint(), AugmentedLagrangian()]


@pytest.mark.parametrize(
    ("solver", "row", "start"),
    [(solver, lambda p: p**3, start) for solver in LOSING for start in (1.0, 2.0)]
    + [(solver, np.exp, start) for solver in LOSING[:3] for start in (0.0, 2.0)],
)
def test_rows_that_lose_their_slope_are_no_success(solver: Solver, row: Callable[[Array], Array], start: float) -> None:
    """They used to be CONVERGED, with multipliers of 1e8 that the test divides by."""
    graph, x = flat(row, 1.0, 1.0, 1.0)
    guess = {x: np.full((1, 1), start)}
    solution = solver.solve(graph, guess)
    assert solution.status is fg.Status.DEGENERATE, solution.report()
    assert "have lost their slope" in solution.report()
    with pytest.raises(fg.NotConverged):
        solver.solve(graph, guess, check=True)
    # Another time, another tolerance: both scaled, nothing changes.
    for unit in (1e-3, 1e3):
        scaled, x = flat(row, unit, unit, 1.0)
        again = replace(solver, tolerance=1e-6 * unit).solve(scaled, {x: guess[next(iter(guess))]})
        assert again.status in (fg.Status.DEGENERATE, fg.Status.ITERATION_LIMIT), (unit, again.report())


def test_the_second_backend_is_asked_where_the_first_ends_degenerate(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x = flat(lambda p: p**3, 1.0, 1.0, 1.0)
    asked: list[str] = []

    class Other(InteriorPoint):
        def solve(self, *arguments: Any, **options: Any) -> fg.Solution:
            asked.append("second")
            return super().solve(*arguments, **options)

    monkeypatch.setattr(choice, "choose", lambda *_, **__: choice.Choice(SQP(), Other(), "a test"))
    fg.solve(graph, {x: np.ones((1, 1))})
    assert asked == ["second"]


@pytest.mark.parametrize("solver", [InteriorPoint(), SQP(), AugmentedLagrangian()], ids=lambda s: s.name)
def test_long_chains_of_constraints_are_not_degenerate(solver: Solver) -> None:
    """Their multipliers add up over the length."""
    count = 4000
    graph, x, u = graph_of(("x", fg.Rn(2), count), ("u", fg.Rn(1), count - 1))

    def pendulum(a: Array, b: Array, u: Array) -> Array:
        return np.concatenate(
            [b[:, :1] - a[:, :1] - 0.1 * a[:, 1:], b[:, 1:] - a[:, 1:] - 0.1 * (u - np.sin(a[:, :1]))], 1
        )

    graph.fix(x[0], [0.0, 0.0])
    graph.constrain(pendulum, x[:-1], x[1:], u, lower=0.0, upper=0.0)
    graph.constrain(fg.prior, x[-1], [0.5, 0.0], lower=0.0, upper=0.0)
    graph.bound(u, lower=-2.0, upper=2.0)
    graph.minimize(fg.prior, u, [0.0])
    graph.minimize(fg.prior, x, [0.4, 0.0], sigma=0.3)
    solution = solver.solve(graph, {x: np.zeros((count, 2)), u: np.zeros((count - 1, 1))})
    assert solution.status is fg.Status.CONVERGED, solution.report()


def test_an_exact_optimum_is_found_out_where_the_linear_system_was_singular() -> None:
    """From the centre of a circle its row has no slope: the first step reaches the optimum with a multiplier of 1e9."""
    graph, x = drawn_to([1.0, 0.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0, name="circle")
    solution = InteriorPoint().solve(graph, {x: np.zeros((1, 2))}, check=True)
    assert solution.dual("circle").item() == pytest.approx(0.0, abs=1e-9)
    assert solution.stationarity <= 1e-9


@pytest.mark.parametrize(
    ("point", "multiplier", "found"), [(1.0, 50.0, 2.0), (1.0, 0.0, 2.0), (0.5, 1.0, None), (1.5, 1.0, None)]
)
def test_multipliers_of_a_stalled_solve_are_estimated_from_the_gradients(
    point: float, multiplier: float, found: float | None
) -> None:
    """Only of rows at their limits, where they are met."""

    class Stalls(Liar):
        def iterate(self, run: SolveState, workspace: Any) -> fg.Status:
            super().iterate(run, workspace)
            run.status = fg.Status.STALLED
            return fg.Status.STALLED

    graph, x = limited()
    graph.bound(x, lower=-9.0, name="far")
    backend = Stalls(point, multiplier)
    backend.max_iterations = 3
    solution = backend.solve(graph, {x: np.zeros((1, 1))})
    assert solution.converged is (found is not None)
    assert solution.dual("limit").item() == pytest.approx(multiplier if found is None else found)


@pytest.mark.parametrize(
    ("goal", "lower", "expected"), [(3.0, -np.inf, 2.0), (0.0, -np.inf, 0.0), (3.0, 1.0, 2.0), (0.0, 1.0, -1.0)]
)
def test_estimated_multipliers_have_the_sign_of_their_limits(goal: float, lower: Any, expected: float) -> None:
    """Pulled away from its limit, a row has none; between limits that meet it may have either."""
    graph, x = drawn_to([goal])
    graph.constrain(lambda p: p, x, lower=lower, upper=1.0)
    program = graph.compile()
    multipliers = estimated(program, program.linearize({x: np.ones((1, 1))}), 1e-6)
    assert multipliers is not None and multipliers.item() == pytest.approx(expected)


@pytest.mark.parametrize("watched", [False, True])
@pytest.mark.parametrize("solver", [s for s in EVERY if s.constraints == "all"], ids=lambda s: s.name)
@pytest.mark.product(4)
def test_rows_between_fixed_variables_are_judged_first_and_named(solver: Solver, watched: bool) -> None:
    """No step changes them: nothing is gained by an iteration."""
    graph, x = drawn_to([3.0, 1.0], 3)
    where = graph.data("where", [[0.0, 0.0], [1.0, 0.5]])
    graph.fix(x[:2], where)
    graph.constrain(lambda a, b: b - a, x[:-1], x[1:], lower=-1.0, upper=1.0, name="step")
    graph.bound(x, upper=2.0, name="fence")
    run = replace(solver, keep_values=watched).prepare(graph)
    guess = {x: np.zeros((3, 2))}
    assert run.solve(guess).converged
    solution = run.solve(guess, data={where: np.array([[0.0, 0.0], [1.0, 1.5]])})
    assert solution.status is fg.Status.INFEASIBLE and solution.iterations == 0 and not solution.converged
    assert solution.worst == ("step", 0) and solution.violation == pytest.approx(0.5)
    assert "all fixed" in solution.report() and "'step', factor 0" in solution.report()
    # The largest violation that can be mended is not the one that is named.
    solution = run.solve({x: np.full((3, 2), 90.0)}, data={where: np.array([[1.5, 0.0], [2.5, 0.0]])})
    assert solution.status is fg.Status.INFEASIBLE and solution.worst == ("fence", 1)
    within = run.solve(guess, data={where: np.array([[0.0, 0.0], [1.0, 1.0 + 1e-7]])})
    assert within.status is not fg.Status.INFEASIBLE and within.iterations > 0


def test_check_names_violated_rows_between_fixed_variables() -> None:
    graph, x = drawn_to([3.0, 1.0], 3)
    graph.fix(x[:2], [[0.0, 0.0], [1.0, 1.5]])
    graph.constrain(lambda a, b: b - a, x[:-1], x[1:], lower=-1.0, upper=1.0, name="step")
    report = graph.check({x: np.zeros((3, 2))})
    (finding,) = report.findings
    assert (finding.kind, finding.term, finding.index) == ("violated and fixed", "step", 0)
    assert "violated by 0.5, and all its variables are fixed" in finding.message


def on_a_circle(size: float) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """The nearest point of a circle, whose row is in other units."""
    graph, x = drawn_to([3.0, 4.0])
    graph.constrain(lambda p: size * ((p**2).sum(axis=1, keepdims=True) - 1.0), x, lower=0.0, upper=0.0, name="circle")
    return graph, {x: np.array([[2.0, -1.0]])}


@pytest.mark.parametrize("solver", [InteriorPoint(), SQP(), AugmentedLagrangian()], ids=lambda s: s.name)
def test_the_violation_has_a_tolerance_of_its_own(solver: Solver) -> None:
    graph, guess = on_a_circle(1e3)
    strict, loose = (replace(solver, feasibility_tolerance=f).solve(graph, guess) for f in (1e-9, 10.0))
    assert strict.converged and strict.violation <= 1e-9
    assert loose.converged and loose.violation > 1e-9 and loose.iterations < strict.iterations


@pytest.mark.parametrize("bad", [0.0, np.inf, np.nan])
@pytest.mark.parametrize("name", ["tolerance", "feasibility_tolerance"])
def test_a_tolerance_of_nothing_or_of_everything_is_refused(name: str, bad: float) -> None:
    with pytest.raises(fg.BackendError, match=f"SQP: {name} must be positive and finite, found {bad}"):
        SQP(**{name: bad})  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_large_numbers_are_judged_by_what_they_are_sums_of(size: float) -> None:
    """A gradient of 1e6 times a millionth is a sum that cancels; of one, it is none."""
    graph, x = drawn_to([1.0], sigma=1.0 / np.sqrt(size))
    graph.constrain(lambda p: p, x, lower=0.0, upper=0.0, name="zero")
    program = graph.compile()
    lin = program.linearize(program.values_from({x: np.zeros((1, 1))}))
    numbers = [optimality(program, lin, np.array([size * (1.0 + off)])) for off in (1e-9, 1e-4)]
    assert numbers[0].stationarity <= 1e-6
    assert numbers[1].stationarity == pytest.approx(1e-4 if size < 1.0 else 1e-2, rel=1e-2)


@pytest.mark.parametrize("tiny", [0.0, 1e-12])
def test_a_slope_of_rounding_hides_no_force(tiny: float) -> None:
    """Beside a slope that is rounding, multipliers that balance nothing are seen."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda p: 11.0 * p[:, 0] + 0.0 * p[:, 1], x, name="cost")
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True) - 1.0, x, lower=0.0, name="outside")
    graph.bound(x, lower=0.0, name="bounds")
    program = graph.compile()
    lin = program.linearize(program.values_from({x: np.array([[tiny, 1.5]])}))
    measured = optimality(program, lin, np.array([-1.0 / 6.0, -11.0, 0.0]))
    assert measured.stationarity > 0.1 and measured.complementarity > 0.1
