"""A user's function of one factor, compiled with Numba."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import pytest

import unifg as fg
from unifg.solvers import AugmentedLagrangian, GaussNewton
from unifg.typing import Array

RNG = np.random.default_rng(5)


@numba.njit  # type: ignore[untyped-decorator]
def relative(x: Array, y: Array, measured: Array, scale: float, r: Array) -> None:
    c, s = np.cos(x[2]), np.sin(x[2])
    dx, dy = y[0] - x[0], y[1] - x[1]
    r[0] = scale * (c * dx + s * dy - measured[0])
    r[1] = scale * (c * dy - s * dx - measured[1])


@numba.njit  # type: ignore[untyped-decorator]
def relative_jacobian(x: Array, y: Array, measured: Array, scale: float, by_x: Array, by_y: Array) -> None:
    c, s = np.cos(x[2]), np.sin(x[2])
    dx, dy = y[0] - x[0], y[1] - x[1]
    turn = y[2] - x[2]
    ct, st = np.cos(turn), np.sin(turn)
    by_x[:] = 0.0
    by_x[0, 0] = by_x[1, 1] = -scale
    by_x[0, 2] = scale * (c * dy - s * dx)
    by_x[1, 2] = -scale * (c * dx + s * dy)
    by_y[:] = 0.0
    by_y[0, 0] = by_y[1, 1] = scale * ct
    by_y[0, 1] = -scale * st
    by_y[1, 0] = scale * st


@numba.njit  # type: ignore[untyped-decorator]
def wrong_jacobian(x: Array, y: Array, measured: Array, scale: float, by_x: Array, by_y: Array) -> None:
    by_x[:] = 1.0
    by_y[:] = 0.0


@numba.njit  # type: ignore[untyped-decorator]
def speed(state: Array, direction: Array, r: Array) -> None:
    r[0] = state[0] * direction[0, 0] + state[2] * direction[1, 1]


def batched(x: Array, y: Array, measured: Array, scale: float) -> Array:
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    d = y - x
    return scale * np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=1) - scale * measured


def chain(residual: fg.Residual | Callable[..., Array]) -> tuple[fg.Graph, fg.Family, Array]:
    poses = RNG.normal(size=(6, 3))
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 6)
    graph.minimize(residual, x[:-1], x[1:], np.full((5, 2), 0.3), 2.0, sigma=0.1)
    graph.minimize(fg.prior, x, poses, sigma=1.0)
    return graph, x, poses


@pytest.mark.parametrize(
    "residual", [fg.residual(relative, rows=2), fg.residual(relative, relative_jacobian, rows=2)], ids=["f", "f, j"]
)
def test_agrees_with_the_batched_function(residual: fg.Residual) -> None:
    global RNG
    RNG = np.random.default_rng(5)
    graph, x, poses = chain(residual)
    RNG = np.random.default_rng(5)
    reference, z, _ = chain(batched)
    assert graph.check({x: poses})
    mine, theirs = GaussNewton().solve(graph, {x: poses}), GaussNewton().solve(reference, {z: poses})
    assert mine.converged
    np.testing.assert_allclose(mine[x], theirs[z], atol=1e-6)
    lin, other = graph.compile().linearize({x: poses}), reference.compile().linearize({z: poses})
    np.testing.assert_allclose(lin.jacobian, other.jacobian, atol=1e-6)
    np.testing.assert_allclose(lin.residual, other.residual, rtol=1e-12)


def test_a_wrong_compiled_jacobian_is_found() -> None:
    graph, x, poses = chain(fg.residual(relative, wrong_jacobian, rows=2))
    assert [finding.kind for finding in graph.check({x: poses}).findings] == ["wrong Jacobian"]


def test_constrains_a_component_of_a_product_with_a_shared_matrix() -> None:
    graph = fg.Graph()
    state = graph.variables("state", fg.Product(p=fg.Rn(3), R=fg.SO2), 4)
    direction = graph.data("direction", np.array([[1.0, 0.0], [0.0, 2.0]]))
    graph.minimize(fg.prior, state.p, np.array([1.0, 2.0, 3.0]))
    graph.minimize(fg.prior, state.R, np.zeros(1))
    graph.constrain(fg.residual(speed, rows=1), state.p, direction, lower=0.0, upper=0.0, name="still")
    solution = AugmentedLagrangian().solve(graph, {state: np.ones((4, 4))})
    assert solution.converged
    p = solution[state][:, :3]
    np.testing.assert_allclose(p[:, 0] + 2.0 * p[:, 2], 0.0, atol=1e-6)


def test_differences_reach_every_component_of_a_product() -> None:
    @numba.njit  # type: ignore[untyped-decorator]
    def heading(state: Array, r: Array) -> None:
        r[0] = state[0] * np.cos(state[3]) + state[2]

    graph = fg.Graph()
    state = graph.variables("state", fg.Product(p=fg.Rn(3), R=fg.SO2), 2)
    graph.minimize(fg.residual(heading, rows=1), state)
    point = RNG.normal(size=(2, 4))
    jacobian = graph.compile().linearize({state: point}).jacobian.reshape(2, 4)
    expected = np.stack([np.cos(point[:, 3]), np.zeros(2), np.ones(2), -point[:, 0] * np.sin(point[:, 3])], axis=1)
    np.testing.assert_allclose(jacobian, expected, atol=1e-9)


def test_the_number_of_rows_must_be_told() -> None:
    with pytest.raises(fg.GraphError, match="rows="):
        fg.residual(relative)
