"""Tables in traced functions: values of NumPy and SciPy, exact derivatives, code that does not grow with the table."""

import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import (
    Akima1DInterpolator,
    CubicSpline,
    PchipInterpolator,
    PPoly,
    RegularGridInterpolator,
    make_interp_spline,
)

import unifg as fg
from problems.graphs import graph_of, graph_with
from test_derive import curved, evaluated
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.symbols import TraceError
from unifg.lie import Rn
from unifg.problem.term import CHANGES
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array

Function = Callable[..., Any]
RNG = np.random.default_rng(7)
X = np.sort(RNG.uniform(-2.0, 2.0, 1000))
Y = np.sin(3.0 * X) + 0.1 * X**2
FEW = X[::40]
ROWS, COLUMNS = np.linspace(-2.0, 2.0, 9), np.append(np.sort(RNG.uniform(-2.0, 1.9, 7)), 2.0)
COLUMNS[0] = -2.0
HEIGHTS = np.sin(ROWS)[:, None] * np.cos(COLUMNS) + 0.2 * ROWS[:, None] * COLUMNS
CUBIC = CubicSpline(FEW, np.stack([np.sin(FEW), FEW**2], axis=1))
SIDEWAYS = CubicSpline(FEW, np.stack([np.sin(FEW), FEW**2], axis=0), axis=1)
GRID = RegularGridInterpolator((ROWS, COLUMNS), HEIGHTS, bounds_error=False, fill_value=None)
SMOOTH = RegularGridInterpolator((ROWS, COLUMNS[::-1]), HEIGHTS, method="cubic", bounds_error=False, fill_value=None)
SOLID = RegularGridInterpolator((ROWS, COLUMNS, FEW[::3]), RNG.normal(size=(9, 8, 9, 2)), bounds_error=False)
PCHIP, AKIMA = PchipInterpolator(FEW, np.abs(FEW)), Akima1DInterpolator(FEW, np.abs(FEW))
PIECES = PPoly(np.array([[1.0, -2.0], [0.5, 3.0]]), np.array([-1.0, 0.2, 1.0]))
WAVE = CubicSpline(FEW, np.sin(FEW))
BSPLINE = make_interp_spline(FEW, np.sin(FEW), k=5)

LOOKUPS: dict[str, Function] = {
    "interp": lambda x: np.interp(x, X, Y),
    "interp, ends": lambda x: np.interp(x, X, Y, left=-7.0, right=9.0),
    "interp, end by a variable": lambda x: np.interp(x[:, :1], FEW, np.sin(FEW), left=x[0, 1] ** 2),
    "interp, period": lambda x: np.interp(x, FEW, np.sin(FEW), period=1.7),
    "interp, one point": lambda x: np.interp(x, [0.3], [2.0], left=1.0) * x,
    "interp of a number": lambda x: np.stack([np.interp(x[k, 0] + x[k, 1], X, Y) * x[k] for k in range(len(x))]),
    "cubic spline": lambda x: CUBIC(x[:, 0]) * x[:, 1:],
    "cubic spline, a slope": lambda x: CUBIC(x[:, 0], 1) * x[:, 1:],
    "cubic spline, its derivative": lambda x: CUBIC.derivative(2)(x[:, 0]) * x[:, 1:],
    "cubic spline, periodic": lambda x: CUBIC(x[:, 1], extrapolate="periodic"),
    "cubic spline, not continued": lambda x: CUBIC(x[:, 1], extrapolate=False),
    "cubic spline, other axis": lambda x: SIDEWAYS(x[:, 0]).T * x,
    "shape-preserving": lambda x: PCHIP(x),
    "Akima": lambda x: AKIMA(x),
    "piecewise": lambda x: PIECES(x),
    "B-spline": lambda x: BSPLINE(x),
    "grid": lambda x: GRID(x)[:, None],
    "grid, of a tuple": lambda x: GRID((x[:, 1], 0.3))[:, None],
    "smooth grid": lambda x: SMOOTH(np.stack([x[:, 1], x[:, 0]], axis=-1))[:, None],
    "grid of three": lambda x: SOLID(np.stack([x[:, 0], x[:, 1], 0.2 * x[:, 0] - 0.1], axis=-1)),
}  # fmt: skip


def pointwise(name: str, points: Array) -> Array:
    """The function itself, one point at a time."""
    return np.concatenate([np.asarray(LOOKUPS[name](point[None])).reshape(1, -1) for point in points])


def of(function: Function) -> Expression:
    return traced(function, [Rn(2)])


@pytest.mark.parametrize("name", LOOKUPS)
def test_values_slopes_and_curvature_are_those_of_the_function(name: str) -> None:
    """At generic points, inside the table and outside."""
    expression, nothing = of(LOOKUPS[name]), np.zeros((1, 0))
    points = RNG.uniform(-2.6, 2.6, (60, 2))
    found, slopes = evaluated(expression, points, nothing)
    expected = pointwise(name, points)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12, equal_nan=True)
    weights = RNG.normal(size=found.shape)
    h, steps = 1e-6, np.eye(2)
    bends = curved(expression, points, nothing, weights)
    for k in range(2):
        ahead, behind = (pointwise(name, points + sign * h * steps[k]) for sign in (1, -1))
        numeric = (ahead - behind) / (2.0 * h)
        known = np.isfinite(numeric).all(axis=1)
        assert known.sum() > 20
        np.testing.assert_allclose(slopes[known][:, :, k], numeric[known], rtol=3e-5, atol=3e-6)
        ahead, behind = (evaluated(expression, points + sign * h * steps[k], nothing)[1] for sign in (1, -1))
        bent = np.einsum("nm,nmd->nd", weights, (ahead - behind) / (2.0 * h))
        known &= np.isfinite(bent).all(axis=1)
        np.testing.assert_allclose(bends[known][:, k], bent[known], rtol=3e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("function", "knots", "both"),
    [
        (lambda x: np.interp(x, FEW, np.sin(FEW)), FEW, False),
        (lambda x: PCHIP(x), FEW, True),
        (lambda x: WAVE(x), FEW, True),
        (lambda x: BSPLINE(x), FEW, True),
        (lambda x: GRID((x, 0.0 * x))[..., 0], ROWS, False),
        (lambda x: SMOOTH((x, 0.0 * x))[..., 0], ROWS, True),
    ],
    ids=["interp", "shape-preserving", "cubic", "B-spline", "grid", "smooth grid"],
)
def test_at_a_knot_the_slope_is_that_of_one_side(function: Function, knots: Array, both: bool) -> None:
    """Of the interval that begins there, at the last knot of the last interval; where slopes agree, of both."""
    expression = traced(lambda x: function(x).reshape(-1, 1), [Rn(1)])
    found, slopes = evaluated(expression, knots[:, None], np.zeros((1, 0)))
    direct = np.array([float(np.squeeze(function(np.array([[s]])))) for s in knots])
    np.testing.assert_allclose(found[:, 0], direct, rtol=1e-13, atol=1e-13)
    h = 1e-7

    def quotient(step: float) -> Array:
        moved = [float(np.squeeze(function(np.array([[s + step]])))) for s in knots]
        return np.asarray((np.array(moved) - direct) / step)

    ahead, behind = quotient(h), quotient(-h)
    side = np.append(ahead[:-1], behind[-1])
    np.testing.assert_allclose(slopes[:, 0, 0], side, rtol=1e-5, atol=1e-5)
    if both:
        np.testing.assert_allclose(slopes[1:-1, 0, 0], behind[1:-1], rtol=1e-5, atol=1e-5)
    else:
        assert np.abs(ahead - behind)[1:-1].max() > 1e-3  # it has kinks


def test_what_is_not_a_number_stays_so() -> None:
    expression = of(lambda x: np.concatenate([np.interp(x, X, Y), CUBIC(x[:, 0]), GRID(x)[:, None]], axis=1))
    found, _ = evaluated(expression, np.full((1, 2), np.nan), np.zeros((1, 0)))
    assert np.isnan(found).all()


def test_a_table_on_the_tape_is_that_of_machine_code() -> None:
    expression = of(lambda x: np.stack([np.interp(x[:, 0], FEW, np.cos(FEW)), CUBIC(x[:, 1])[:, 0]], axis=1))
    points = np.vstack([RNG.uniform(-2.5, 2.5, (20, 2)), FEW[:4].reshape(2, 2)])
    found, _ = evaluated(expression, points, np.zeros((1, 0)))
    rest, nodes = expression.tape.at_rest(list(expression.rows))
    slow = [rest.evaluate(nodes, point, ()) for point in points]
    np.testing.assert_allclose(found, slow, rtol=1e-14, atol=1e-15)


def test_code_grows_with_the_digits_of_the_length_alone() -> None:
    def spline(count: int) -> Expression:
        s = np.linspace(-2.0, 2.0, count)
        made = CubicSpline(s, np.sin(s))
        return of(lambda x: np.concatenate([made(x), np.interp(x, s, s**2)], axis=1))

    short, long = spline(10), spline(20_000)
    assert len(short.tape.live(short.rows)) == len(long.tape.live(long.rows))
    assert sum(long.tape.op[i] == Op.SEARCH for i in long.tape.live(long.rows)) == 2  # shared tables
    assert len(long._residual()) < 3 * len(short._residual())
    times = []
    for expression in (short, long):
        begin = time.thread_time()
        expression._residual()
        times.append(time.thread_time() - begin)
    assert times[1] < 5.0 * times[0] + 0.02


PLACES, KNOTS = 10, np.linspace(-2.0, 2.0, 7)


def of_each(x: Array, tables: Array) -> Array:
    return np.stack([np.stack([np.interp(x[k, j], KNOTS, tables[k, j]) for j in range(PLACES)]) for k in range(len(x))])


@pytest.mark.parametrize("summed", [False, True])
def test_many_look_ups_are_one_loop(summed: bool) -> None:
    """In one table, and each in a table among the parameters."""

    def finished(found: Any) -> Any:
        return found.sum(axis=1, keepdims=True) if summed else found

    points, tables = RNG.uniform(-2.3, 2.3, (40, PLACES)), RNG.normal(size=(40, PLACES, 7))
    one = traced(lambda x: finished(np.interp(x, X, Y) + WAVE(x)), [Rn(PLACES)])
    several = traced(lambda x, t: finished(of_each(x, t)), [Rn(PLACES), (PLACES, 7)])
    for expression, parameters, expected in (
        (one, np.zeros((1, 0)), np.interp(points, X, Y) + WAVE(points)),
        (several, tables.reshape(40, -1), of_each(points, tables)),
    ):
        found, slopes = evaluated(expression, points, parameters)
        np.testing.assert_allclose(found, finished(expected), rtol=1e-12, atol=1e-13)
        ahead, _ = evaluated(expression, points + 1e-7, parameters)
        np.testing.assert_allclose(slopes.sum(axis=2), (ahead - found) / 1e-7, atol=2e-5)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda x: np.interp(x, x[0], [0.0, 1.0]), "looks up in a table that it computes; compute it outside"),
        (lambda x: np.interp(x, [0.0, 0.0, 1.0], [0.0, 1.0, 2.0]), "points that do not increase"),
        (lambda x: np.interp(x, [0.0, 1.0], [0.0, 1.0], period=x[0, 0]), "period= and points that may change"),
        (lambda x: np.interp(x, [0.0, 1.0], [0.0, 1.0j]), r"a table of complex128"),
        (lambda x: np.interp(x, [0.0, 1.0], [0.0, 1.0, 2.0]), r"points of shape \(2,\) and values of shape \(3,\)"),
        (lambda x: GRID(x, method="nearest")[:, None], "RegularGridInterpolator with nearest; leave it to differences"),
        (lambda x: SMOOTH(x, nu=(1, 0))[:, None], "RegularGridInterpolator with nu="),
        (lambda x: GRID(x[:, :1])[:, None], "of 2 dimensions with points of 1"),
        (lambda x: CUBIC(x, slope=1), "calls a PPoly in a way that is not traced"),
    ],
)
def test_what_is_not_traced_is_named(function: Function, words: str) -> None:
    with pytest.raises(TraceError, match=words):
        of(function)


# ---------------------------------------------------------------- terms


def stated(function: Function, *arguments: Any, count: int = 3) -> tuple[fg.Graph, fg.Family]:
    graph, x = graph_with(fg.Rn(1), count)
    graph.minimize(function, x, *arguments, sigma=1.0, name="own")
    return graph, x


@pytest.mark.parametrize("count", [3, 200], ids=["few factors", "as many factors as points"])
def test_tables_that_are_data_change_between_solves(count: int) -> None:
    """Their numbers are parameters, and are bisected where they stand."""
    graph, x = graph_with(fg.Rn(1), count)
    points, heights = graph.data("points", np.linspace(-3.0, 3.0, 200)), graph.data("heights", np.linspace(-1, 1, 200))
    graph.minimize(lambda x, p, h: np.asarray(np.interp(x, p, h) - 0.2), x, points, heights, name="own")
    run, guess = GaussNewton().prepare(graph), {x: np.full((count, 1), 0.9)}
    for scale, stretch in ((1.0, 1.0), (2.0, 1.0), (-1.0, 0.7)):
        given = {points: stretch * np.linspace(-3.0, 3.0, 200), heights: scale * np.linspace(-1.0, 1.0, 200)}
        np.testing.assert_allclose(run.solve(guess, data=given)[x], 0.6 * stretch / scale, atol=1e-9)
    assert run.program.terms[0].route == "traced, its derivatives exact"


def test_a_table_for_each_factor() -> None:
    graph, x = graph_with(fg.Rn(1), 3)
    heights = np.linspace(-1.0, 1.0, 9) * np.array([[1.0], [2.0], [4.0]])
    table = graph.data("table", heights, each=True)
    at = np.linspace(-2.0, 2.0, 9)
    graph.minimize(
        lambda x, h: np.stack([np.interp(x[k], at, h[k]) - 0.5 for k in range(len(x))]), x, table, name="own"
    )
    found = GaussNewton().solve(graph, {x: np.zeros((3, 1))})
    assert "traced" in graph.check({x: np.zeros((3, 1))}).routes["own"]
    np.testing.assert_allclose(found[x].ravel(), [1.0, 0.5, 0.25], atol=1e-9)


class Car:
    def __init__(self, spline: Any) -> None:
        self.spline, self.several = spline, [spline]

    def residual(self, x: Array) -> Any:
        return self.spline(x) + self.several[0](x[:, 0])[:, None] - 0.5


def test_interpolators_are_found_in_attributes_lists_and_arguments() -> None:
    spline = CubicSpline(FEW, np.sin(FEW))
    for function, arguments, value in (
        (Car(spline).residual, (), 0.25),
        (lambda x, s: s(x) - 0.5, (spline,), 0.5),
        (lambda x, s=spline: s(x) - 0.5, (), 0.5),
    ):
        graph, x = stated(function, *arguments)
        guess = {x: np.zeros((3, 1))}
        assert graph.check(guess).routes["own"] == "traced, its derivatives exact"
        np.testing.assert_allclose(spline(GaussNewton().solve(graph, guess)[x]), value, atol=1e-9)


def test_numbers_of_an_interpolator_are_watched() -> None:
    points = np.linspace(-2.0, 2.0, 5)
    spline = CubicSpline(points, points)
    graph, x = stated(lambda x: spline(x) - 0.5)
    run, guess = GaussNewton().prepare(graph), {x: np.zeros((3, 1))}
    np.testing.assert_allclose(run.solve(guess)[x], 0.5, atol=1e-9)
    spline.c[...] *= 2.0
    np.testing.assert_allclose(run.solve(guess)[x], 0.25, atol=1e-9)
    assert run.program.terms[0].route.startswith("traced")
    for _ in range(CHANGES):
        spline.c[...] *= 0.9
        run.solve(guess)
    assert "keeps changing" in run.program.terms[0].route
    huge = RegularGridInterpolator((np.arange(400.0), np.arange(400.0)), np.zeros((400, 400)), bounds_error=False)
    graph, x = stated(lambda x: huge(np.concatenate([x, x], axis=1))[:, None])
    assert "160800 numbers, which would be compared" in graph.check({x: np.zeros((3, 1))}).routes["own"]


# ---------------------------------------------------------------- a small MPC over measured tables

STEPS = 20
ALONG = np.linspace(-1.0, 12.0, 1000)
TERRAIN = CubicSpline(ALONG, 0.3 * np.sin(ALONG) + 0.05 * ALONG)
SLIP, LOAD = np.linspace(-0.6, 0.6, 41), np.linspace(0.5, 2.5, 9)
FORCE = np.sin(1.6 * np.arctan(8.0 * SLIP))[:, None] * LOAD
TYRE = RegularGridInterpolator((SLIP, LOAD), FORCE, method="cubic", bounds_error=False, fill_value=None)
SPEEDS, DRAG = np.linspace(-0.5, 20.0, 7), np.array([1.0, 2.0, 1.5, 3.0, 2.0, 1.0, 1.0])


def drive(x: Array, u: Array, after: Array) -> Any:
    """Position and speed along a road; slip is the control."""
    slope = TERRAIN(x[:, 0], 1)
    grip = TYRE(np.stack([u[:, 0], 1.0 - 0.1 * slope], axis=-1))
    speed = x[:, 1] + 0.1 * (4.0 * grip - 2.0 * slope - 0.1 * np.interp(x[:, 1], SPEEDS, DRAG) * x[:, 1])
    return after - np.stack([x[:, 0] + 0.1 * x[:, 1], speed], axis=-1)


@pytest.mark.parametrize("solver", [InteriorPoint(), SQP(hessian="gauss-newton")], ids=lambda s: s.name)
def test_a_drive_over_tables_is_traced_and_answers_as_python_does(
    solver: fg.Solver, caplog: pytest.LogCaptureFixture
) -> None:
    found, iterations = [], []
    for derivatives in (None, "differences"):
        graph, x, u = graph_of(("x", fg.Rn(2), STEPS + 1), ("u", fg.Rn(1), STEPS))
        own = drive if derivatives is None else fg.residual(drive, derivatives="differences")
        graph.constrain(own, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="drive")
        graph.fix(x[0], [0.0, 1.0])
        graph.bound(u, lower=-0.15, upper=0.15)
        graph.minimize(fg.prior, x, [5.0, 1.5], sigma=1.0, name="track")
        graph.minimize(fg.prior, u, [0.0], sigma=0.3, name="effort")
        guess = {x: np.tile([0.0, 1.0], (STEPS + 1, 1)), u: np.zeros((STEPS, 1))}
        with caplog.at_level(logging.WARNING, "unifg"):
            solution = solver.solve(graph, guess)
        assert solution.converged and solution.checked and not solution.mistraced
        route = graph.check(guess).routes["drive"]
        assert route.startswith("traced" if derivatives is None else "evaluated by Python")
        assert np.abs(drive(solution[x][:-1], solution[u], solution[x][1:])).max() < 1e-6
        assert np.isclose(np.abs(solution[u]).max(), 0.15, atol=1e-4)  # a limit is active
        found.append(np.concatenate([solution[x].ravel(), solution[u].ravel()]))
        iterations.append(solution.iterations)
    np.testing.assert_allclose(found[0], found[1], atol=2e-5)
    assert abs(iterations[0] - iterations[1]) <= 2
