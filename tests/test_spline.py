"""Splines in functions that are traced: values and derivatives against SciPy's, to twelve digits."""

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, RectBivariateSpline

import unifg as fg
from problems.graphs import graph_with
from test_derive import compared, curved, evaluated
from unifg.errors import ModelError
from unifg.factors.autodiff.rows import traced
from unifg.lie import SE2, Rn
from unifg.models.distance_map import DistanceMap
from unifg.models.spline import BEYOND, SplineCurve, SplineField
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array

RNG = np.random.default_rng(4)
GRID = RNG.normal(size=(9, 12))
RESOLUTION, ORIGIN = 0.25, (3.0, -1.0, 0.7)
FIELD = SplineField(GRID, RESOLUTION, ORIGIN)
ORACLE = RectBivariateSpline(np.arange(9.0), np.arange(12.0), GRID, kx=3, ky=3, s=0)


def derivatives(field: SplineField, points: Array) -> tuple[Array, Array, Array]:
    """Value, gradient and Hessian of a field by a traced kernel."""
    expression = traced(lambda p: field(p)[:, None], (Rn(2),))
    r, J = evaluated(expression, points, np.zeros((1, 0)))
    S = curved(expression, points, np.zeros((1, 0)), np.ones((len(points), 1)))
    return r[:, 0], J[:, 0], S


def world(grid: Array, origin: tuple[float, float, float] = ORIGIN) -> Array:
    """Points (n, 2) of grid coordinates (column, row)."""
    return SE2.act(np.array(origin), RESOLUTION * grid)


def of_scipy(grid: Array) -> tuple[Array, Array, Array]:
    """Value, gradient and Hessian in the world by SciPy."""
    column, row = grid.T
    d = {(i, j): ORACLE.ev(row, column, dx=j, dy=i) for i in range(3) for j in range(3) if i + j <= 2}
    R = SE2.matrix(np.array(ORIGIN))[:2, :2] / RESOLUTION
    first = np.stack([d[1, 0], d[0, 1]], axis=1)
    second = np.stack([np.stack([d[2, 0], d[1, 1]], axis=1), np.stack([d[1, 1], d[0, 2]], axis=1)], axis=1)
    return d[0, 0], first @ R.T, R @ second @ R.T


def test_a_field_is_scipys_spline_with_its_derivatives() -> None:
    grid = np.concatenate([RNG.uniform(0.0, [11.0, 8.0], (300, 2)), [[0.0, 0.0], [11.0, 8.0], [5.0, 3.0], [5.0, 2.5]]])
    for found, expected in zip(derivatives(FIELD, world(grid)), of_scipy(grid), strict=True):
        compared(found, expected)
    np.testing.assert_allclose(FIELD(world(grid)), of_scipy(grid)[0], rtol=0, atol=1e-13)  # as a function of arrays
    places = np.stack(np.meshgrid(np.arange(12.0), np.arange(9.0)), axis=-1)
    np.testing.assert_allclose(FIELD(world(places.reshape(-1, 2))), GRID.ravel(), rtol=0, atol=1e-13)


@pytest.mark.parametrize("edge", [-3.0, -1.0, 0.0, 1.0, 4.0, 11.0, 12.0, 14.0])
def test_second_derivatives_are_continuous_everywhere(edge: float) -> None:
    rows = np.linspace(-4.0, 12.0, 40)
    low, high = (derivatives(FIELD, world(np.stack([np.full(40, edge + e), rows], axis=1))) for e in (-1e-10, 1e-10))
    for before, after in zip(low, high, strict=True):
        np.testing.assert_allclose(before, after, rtol=0, atol=1e-6)


def test_far_beyond_the_grid_nothing_changes_across_the_border() -> None:
    rows = np.linspace(-1.0, 9.0, 20)
    for column, same in ((-BEYOND - 0.5, -BEYOND - 700.0), (11.5 + BEYOND, 1e9)):
        near, far = (np.stack([np.full(20, c), rows], axis=1) for c in (column, same))
        field = SplineField(GRID, RESOLUTION)
        value, gradient, hessian = derivatives(field, RESOLUTION * near)
        np.testing.assert_allclose(field(RESOLUTION * far), value, rtol=0, atol=1e-12)
        assert not gradient[:, 0].any() and not hessian[:, 0].any()
    point = np.array([[np.nan, 0.3], [0.3, np.nan]])
    assert np.isnan(derivatives(FIELD, point)[0]).all() and np.isnan(FIELD(point)).all()


def test_far_from_the_origin_a_field_keeps_its_digits() -> None:
    grid = RNG.integers(0, 2**10, (50, 2)) / 2.0**10 * [11.0, 8.0]
    far = SplineField(GRID, RESOLUTION, (2.0**20, -(2.0**20), 0.0))
    near = SplineField(GRID, RESOLUTION, (0.0, 0.0, 0.0))
    points = np.round(RESOLUTION * grid * 2.0**20) / 2.0**20
    moved = points + np.array([2.0**20, -(2.0**20)])
    for found, expected in zip(derivatives(far, moved), derivatives(near, points), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_curve_is_scipys_spline_with_its_derivatives() -> None:
    values = RNG.normal(size=15)
    curve = SplineCurve(values, -2.0, 0.4)
    oracle = CubicSpline(-2.0 + 0.4 * np.arange(15), values)
    s = RNG.uniform(-2.0, 3.6, (100, 1))
    expression = traced(lambda s: curve(s), (Rn(1),))
    r, J = evaluated(expression, s, np.zeros((1, 0)))
    compared(r, oracle(s))
    compared(J[:, 0], oracle(s, 1))
    compared(curved(expression, s, np.zeros((1, 0)), np.ones((100, 1)))[:, 0], oracle(s, 2))
    np.testing.assert_allclose(curve(s), oracle(s), rtol=0, atol=1e-13)
    assert curve(1.0) == pytest.approx(float(oracle(1.0)), abs=1e-13)


def test_a_kernel_carries_every_table_it_reads() -> None:
    """Two fields and a curve in one residual on poses; the fourth-order differences of it."""
    curve, other = SplineCurve(RNG.normal(size=6)), SplineField(GRID[::-1] ** 2, 0.4, (2.0, -2.0, -0.3))

    def f(x: Array) -> Any:
        return np.stack([FIELD(x[:, :2]) * curve(x[:, 2] + 2.0), other(x[:, :2]) - FIELD(x[:, :2])], axis=1)

    expression = traced(f, (SE2,))
    assert len(expression.table) == sum(len(part.table) for part in (curve, other, FIELD))
    x = np.concatenate([world(RNG.uniform(1.0, [10.0, 7.0], (20, 2))), RNG.uniform(0.0, 2.0, (20, 1))], axis=1)
    r, J = evaluated(expression, x, np.zeros((1, 0)))
    np.testing.assert_allclose(r, f(x), rtol=0, atol=1e-13)
    h = 1e-4
    for k in range(3):
        d = h * np.eye(3)[k]
        wide = f(SE2.retract(x, 2 * d)) - f(SE2.retract(x, -2 * d))
        near = f(SE2.retract(x, d)) - f(SE2.retract(x, -d))
        np.testing.assert_allclose(J[:, :, k], (8 * near - wide) / (12 * h), rtol=0, atol=1e-7)


def test_a_map_becomes_a_field() -> None:
    occupied = np.zeros((20, 30), dtype=bool)
    occupied[:, :4] = True
    flat = DistanceMap.from_occupancy(occupied, 0.1, (1.0, 2.0, 0.5))
    field = SplineField.of_map(flat)
    place = SE2.act(np.array([1.0, 2.0, 0.5]), np.array([[1.234, 1.0], [0.75, 0.6]]))
    np.testing.assert_allclose(field(place), [0.834, 0.35], rtol=0, atol=2e-3)  # straight wall, away from its kink
    centres = SE2.act(np.array([1.0, 2.0, 0.5]), 0.1 * (np.array([[7.0, 3.0], [0.0, 0.0]]) + 0.5))
    np.testing.assert_allclose(field(centres), flat.values[[3, 0], [7, 0]], rtol=0, atol=1e-13)
    beyond = SE2.act(np.array([1.0, 2.0, 0.5]), np.array([[-5.0, 1.0], [9.0, 1.0]]))
    np.testing.assert_allclose(field(beyond), flat.values[10, [0, -1]], rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SplineField(np.zeros((3, 9)), 0.1),
        lambda: SplineField(np.full((5, 5), np.nan), 0.1),
        lambda: SplineField(np.zeros((5, 5)), 0.0),
        lambda: SplineField(np.zeros((5, 5)), 0.1, (0.0, 0.0)),
        lambda: SplineCurve(np.zeros(3)),
        lambda: SplineCurve(np.zeros((5, 2))),
        lambda: SplineCurve(np.zeros(5), 0.0, -1.0),
        lambda: SplineCurve(np.zeros(5), np.inf),
    ],
)
def test_what_is_no_spline_is_refused(make: Any) -> None:
    with pytest.raises(ModelError, match="spline: "):
        make()


def test_a_field_does_not_change() -> None:
    grid = GRID.copy()
    field = SplineField(grid, 1.0)
    before = field(np.array([[2.3, 1.2]]))
    grid[:] = 0.0
    assert field(np.array([[2.3, 1.2]])) == before
    for part in (field.table, field.values):
        with pytest.raises(ValueError, match="read-only"):
            part[0] = 1.0
    with pytest.raises(fg.ModelError, match="never changes"):
        field.origin = (1.0, 0.0, 0.0)


def test_fields_that_compute_the_same_are_known_as_equal() -> None:
    digests = {
        SplineField(GRID, 1.0).digest, SplineField(GRID, 2.0).digest, SplineField(GRID, 1.0, (0.0, 0.0, 1.0)).digest,
        SplineField(GRID + 1e-9, 1.0).digest, SplineField(GRID.T, 1.0).digest,
    }  # fmt: skip
    assert len(digests) == 5 and SplineField(GRID.copy(), 1.0).digest in digests


def test_a_graph_is_traced_through_a_field() -> None:
    """A function that reaches a field is compiled with its table, and solved with exact derivatives."""
    bowl = SplineField(np.add.outer((np.arange(8.0) - 3.3) ** 2, (np.arange(9.0) - 4.6) ** 2), 1.0)
    graph, x = graph_with(Rn(2), 3)
    graph.minimize(lambda p: bowl(p)[:, None], x, name="bowl")
    assert bowl(np.array([[4.6, 3.3]]))[0] == pytest.approx(0.0, abs=1e-12)
    solution = LevenbergMarquardt(max_iterations=60).solve(graph, {x: np.array([[4.0, 3.0], [5.0, 4.0], [4.5, 2.8]])})
    assert float(np.abs(bowl(solution[x])).max()) < 1e-3
    assert "term 'bowl': traced, its derivatives exact" in str(graph.check({x: np.zeros((3, 2))}))
