"""Clearances by hand, and Ta's potential: where it is 1/d, how it goes on inside, and what solvers make of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.errors import GraphError
from unifg.factors.residuals import residual
from unifg.models import avoidance, obstacles
from unifg.solvers import SQP, InteriorPoint
from unifg.typing import Array

CENTRES, RADII = np.array([[2.0, 0.0], [-1.0, -2.0]]), np.array([0.5, 0.25])
NEAREST = 0.2


def at(*rows: tuple[float, float, float]) -> Array:
    return np.array(rows)


def test_cylinders_by_hand() -> None:
    found = avoidance.cylinder_clearance(at((0.0, 0.0, 3.0), (2.0, 0.2, -9.0)), CENTRES, RADII)
    np.testing.assert_allclose(found, [[1.5, np.sqrt(5.0) - 0.25], [-0.3, np.hypot(3.0, 2.2) - 0.25]], atol=1e-15)


def test_moving_cylinders_have_a_centre_for_each_position() -> None:
    centres = np.stack([CENTRES, CENTRES + 1.0])
    found = avoidance.cylinder_clearance(at((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), centres, RADII)
    np.testing.assert_allclose(found[1], np.linalg.norm(CENTRES + 1.0, axis=1) - RADII, atol=1e-15)


def test_a_landmark_is_a_cylinder_of_its_own() -> None:
    p = at((0.0, 0.0, 3.0), (1.0, -2.0, 0.0))
    for centre, radius, column in zip(CENTRES, RADII, avoidance.cylinder_clearance(p, CENTRES, RADII).T, strict=True):
        np.testing.assert_allclose(avoidance.landmark_clearance(p, centre, radius)[:, 0], column, atol=1e-15)


def test_walls_by_hand() -> None:
    walls = np.array([[[0.0, 0.0], [4.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]])  # the second is a post
    p = at((2.0, 1.0, 0.0), (2.0, -1.0, 5.0), (-3.0, 4.0, 0.0), (7.0, 4.0, 0.0), (4.0, 0.5, 0.0))
    found = avoidance.segment_clearance(p, walls, np.array([0.1, 0.2]))
    np.testing.assert_allclose(found[:, 0], [0.9, 0.9, 4.9, 4.9, 0.4], atol=1e-15)
    np.testing.assert_allclose(found[:, 1], np.linalg.norm(p[:, :2] - 1.0, axis=1) - 0.2, atol=1e-15)


def test_the_distance_to_a_wall_has_no_jump() -> None:
    wall = np.array([[[0.0, 0.0], [1.0, 0.5]]])
    t = np.linspace(-2.0, 3.0, 5001)
    path = np.column_stack([t, 0.3 - 0.2 * t, 0.0 * t])
    found = avoidance.segment_clearance(path, wall, np.zeros(1))[:, 0]
    assert np.abs(np.diff(found)).max() <= np.hypot(1.0, 0.2) * (t[1] - t[0]) + 1e-12


def test_spheres_by_hand() -> None:
    found = avoidance.sphere_clearance(at((0.0, 0.0, 0.0)), np.array([[1.0, 2.0, 2.0]]), np.array([0.5]))
    np.testing.assert_allclose(found, [[2.5]], atol=1e-15)


@pytest.mark.parametrize("name", ["cylinder_clearance", "landmark_clearance", "sphere_clearance", "segment_clearance"])
def test_derivatives_stay_finite_where_there_is_no_direction(name: str) -> None:
    which, p = getattr(avoidance, name), at((1.0, 2.0, 3.0))
    others = {
        "cylinder_clearance": (p[:, :2], np.ones(1)),
        "landmark_clearance": (p[:, :2], 1.0),
        "sphere_clearance": (p, np.ones(1)),
        "segment_clearance": (np.array([[[0.0, 2.0], [2.0, 2.0]]]), np.ones(1)),
    }[name]
    np.testing.assert_allclose(which(p, *others), -1.0)
    assert np.isfinite(np.concatenate(which.jacobian(p, *others), axis=2)).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: avoidance.cylinder_clearance(p, np.zeros((2, 3)), np.zeros(2)), r"centre must be \(M, 2\)"),
        (lambda p: avoidance.cylinder_clearance(p, np.zeros((2, 2)), np.zeros(3)), r"centre must be \(M, 2\)"),
        (lambda p: avoidance.sphere_clearance(p, np.zeros((2, 2)), np.zeros(2)), r"centre must be \(M, 3\)"),
        (lambda p: avoidance.segment_clearance(p, np.zeros((2, 2, 3)), np.zeros(2)), r"segments must be \(W, 2, 2\)"),
        (lambda p: avoidance.segment_clearance(p, np.zeros((2, 2, 2)), np.zeros(1)), r"segments must be \(W, 2, 2\)"),
        (lambda p: avoidance.landmark_clearance(p, np.zeros(3), 1.0), "argument 1 has shape"),
        (lambda p: avoidance.cylinder_clearance(p[:, :2], CENTRES, RADII), "argument 0 has shape"),
    ],
)
def test_wrong_shapes_are_refused(call: Callable[[Array], Array], message: str) -> None:
    with pytest.raises(GraphError, match=message):
        call(np.zeros((1, 3)))


# ---------------------------------------------------------------- Ta's potential


def away(*distances: float) -> Array:
    """Positions at distances from the surface of a cylinder of radius 0.5 around the origin."""
    return np.array([[0.5 + d, 0.0, 1.0] for d in distances])


ALONE = np.zeros((1, 2)), np.array([0.5])


def phi(p: Array) -> Array:
    return avoidance.inverse_distance(avoidance.cylinder_clearance, NEAREST)(p, *ALONE)


def test_the_potential_is_one_over_the_distance() -> None:
    np.testing.assert_allclose(phi(away(0.2, 0.5, 1.0, 4.0)), [5.0, 2.0, 1.0, 0.25], rtol=1e-13)


def test_inside_it_is_finite_and_pushes_out_the_harder_the_deeper() -> None:
    found = phi(away(*np.linspace(0.3, -0.45, 400)))
    assert np.isfinite(found).all()
    assert (np.diff(found) > 0.0).all() and (np.diff(found, 2) > -1e-10).all()
    assert phi(away(0.0))[0] == pytest.approx(3.0 / NEAREST)


def test_it_is_twice_continuously_differentiable() -> None:
    step = 1e-4
    sides = []
    for side in (-1.0, 1.0):
        values = phi(away(*(NEAREST + side * step * np.arange(4))))
        slope = side * (-11.0 * values[0] + 18.0 * values[1] - 9.0 * values[2] + 2.0 * values[3]) / (6.0 * step)
        bend = (2.0 * values[0] - 5.0 * values[1] + 4.0 * values[2] - values[3]) / step**2
        sides.append((values[0], slope, bend))
    np.testing.assert_allclose(sides[0], sides[1], rtol=1e-4)
    np.testing.assert_allclose(sides[0], [1.0 / NEAREST, -1.0 / NEAREST**2, 2.0 / NEAREST**3], rtol=1e-4)


def test_the_least_squares_twin_is_the_same_objective() -> None:
    p = np.random.default_rng(0).normal(size=(30, 3))
    r = avoidance.inverse_distance_root(avoidance.cylinder_clearance, NEAREST)(p, CENTRES, RADII)
    assert r.shape == (30, 2)
    both = avoidance.inverse_distance(avoidance.cylinder_clearance, NEAREST, weight=3.0)(p, CENTRES, RADII)
    np.testing.assert_allclose(both, 1.5 * (r**2).sum(axis=1), rtol=1e-13)


def pushed(form: str, start: tuple[float, float, float], solver: fg.Solver) -> fg.Solution:
    """A position drawn to a goal behind a cylinder of radius 0.5, off the line."""
    graph, p = graph_with(fg.Rn(3), 1, "p")
    graph.minimize(fg.prior, p, [0.6, 0.1, 1.0], sigma=0.5)
    if form == "scalar":
        potential = avoidance.inverse_distance(avoidance.cylinder_clearance, NEAREST, weight=0.25)
        graph.minimize_scalar(potential, p, *ALONE)
    else:
        root = avoidance.inverse_distance_root(avoidance.cylinder_clearance, NEAREST)
        graph.minimize(root, p, *ALONE, sigma=2.0)
    return solver.solve(graph, {p: np.array([start])})


@pytest.mark.parametrize("start", [(1.5, 0.4, 1.0), (0.3, 0.2, 1.0)], ids=["outside", "inside"])
@pytest.mark.parametrize("solver", [InteriorPoint(), SQP()], ids=["ipm", "sqp"])
def test_both_forms_have_the_same_optimum(solver: fg.Solver, start: tuple[float, float, float]) -> None:
    scalar, squares = pushed("scalar", start, solver), pushed("squares", start, solver)
    assert scalar.converged and squares.converged, (scalar.report(), squares.report())
    assert scalar.cost == pytest.approx(squares.cost, rel=1e-9)
    # Along the line to the goal, 4 (d - g) = 1/4 d^-2 for the distance g = |(0.6, 0.1)| - 0.5 of the goal.
    g = np.hypot(0.6, 0.1) - 0.5
    expected = np.roots([4.0, -4.0 * g, 0.0, -0.25])
    d = float(expected[np.isreal(expected)].real.max())
    for solution in (scalar, squares):
        (found,) = solution.values.values()
        assert np.hypot(found[0, 0], found[0, 1]) - 0.5 == pytest.approx(d, rel=1e-5)


def test_potentials_are_traced_in_graphs() -> None:
    """As sums of squares and as scalar costs, of clearances that are themselves made of other functions."""
    graph, p = graph_with(fg.Rn(3), 4, "p")
    for k, clearance in enumerate((avoidance.cylinder_clearance, avoidance.sphere_clearance)):
        centre = CENTRES if k == 0 else np.hstack([CENTRES, np.zeros((len(CENTRES), 1))])
        graph.minimize(avoidance.inverse_distance_root(clearance), p, centre, RADII, name=f"root {k}")
        graph.minimize_scalar(avoidance.inverse_distance(clearance), p, centre, RADII, name=f"potential {k}")
    routes = graph.check({p: np.full((4, 3), 0.7)}).routes
    assert len(routes) == 4 and all(route.endswith("derivatives exact") for route in routes.values()), routes


def test_the_potential_takes_any_clearance() -> None:

    own = avoidance.inverse_distance_root(residual(lambda p: p[:, :1]))
    np.testing.assert_allclose(own(np.array([[2.0, 0.0, 0.0]])), [[1.0]])
    planar = avoidance.inverse_distance_root(obstacles.disc_clearance)  # any clearance, also of other robots
    np.testing.assert_allclose(planar(np.array([[2.5, 0.0, 0.3]]), *ALONE), [[1.0]])


def test_what_is_not_a_number_stays_so() -> None:
    assert np.isnan(phi(np.array([[np.nan, 0.0, 0.0]]))).all()
    walls = np.array([[[0.0, 0.0], [4.0, 0.0]]])
    assert np.isnan(avoidance.segment_clearance(np.array([[np.nan, 0.0, 0.0]]), walls, np.zeros(1))).all()
