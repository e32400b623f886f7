"""Derivatives by differences far from the origin: as exact there as they are at it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

import unifg as fg
from problems import offsets
from problems.graphs import graph_of
from unifg.codegen.jit import compiled
from unifg.factors.differences import directions_of, jacobian, one_by_one, scalar_slopes
from unifg.lie.rn import minus
from unifg.models import quadrotor, unicycle
from unifg.problem.hessian import lagrangian_hessian
from unifg.typing import Array

FAR = (1e3, 1e5, 5e6)  # [m]; the last is a northing in UTM
GRID = 2.0**-20  # coordinates that every offset represents
CENTRE = np.array([0.25, -0.5])
PULL = np.array([1.0, -2.0, 0.5, 2.0])  # multipliers
STATE = fg.Product(p=fg.Rn(3), R=fg.SO3, v=fg.Rn(3))


@numba.njit  # type: ignore[untyped-decorator]
def drive(x: Array, y: Array, u: Array, centre: Array, r: Array) -> None:
    """A unicycle's step, and the clearance from a disc."""
    r[0] = y[0] - x[0] - 0.2 * u[0] * np.cos(x[2])
    r[1] = y[1] - x[1] - 0.2 * u[0] * np.sin(x[2])
    r[2] = y[2] - x[2] - 0.2 * u[1]
    r[3] = np.sqrt((x[0] - centre[0]) ** 2 + (x[1] - centre[1]) ** 2) - 0.7


@numba.njit  # type: ignore[untyped-decorator]
def drive_rounded(x: Array, y: Array, u: Array, centre: Array, r: Array) -> None:
    """The same with what happens in a step rounded to the spacing of the position."""
    r[0] = y[0] - (x[0] + 0.2 * u[0] * np.cos(x[2]))
    r[1] = y[1] - (x[1] + 0.2 * u[0] * np.sin(x[2]))
    r[2] = y[2] - (x[2] + 0.2 * u[1])
    r[3] = np.sqrt((x[0] - centre[0]) ** 2 + (x[1] - centre[1]) ** 2) - 0.7


@numba.njit  # type: ignore[untyped-decorator]
def fly(x: Array, y: Array, u: Array, centre: Array, r: Array) -> None:
    """Residual of y as seen from x, and of a clearance that turns with y."""
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    px, py, pz = y[0] - x[0], y[1] - x[1], y[2] - x[2]
    cx, cy, cz = 2.0 * (b * pz - c * py), 2.0 * (c * px - a * pz), 2.0 * (a * py - b * px)
    r[0] = px + w * cx + (b * cz - c * cy) - u[0]
    r[1] = py + w * cy + (c * cx - a * cz) - u[1]
    r[2] = pz + w * cz + (a * cy - b * cx)
    r[3] = np.sqrt((x[0] - centre[0]) ** 2 + (x[1] - centre[1]) ** 2) * (y[4] * y[5] - y[3] * y[6])


def batched(function: Any) -> Callable[..., Array]:
    """The same function as NumPy users write it: one call for all factors."""

    def residual(*arguments: Array) -> Array:
        *variables, centre = arguments
        r = np.empty((len(variables[0]), 4))
        for i in range(len(r)):
            function.py_func(*(part[i] for part in variables), centre, r[i])
        return r

    return residual


CASES: dict[str, tuple[fg.Manifold, int, Any]] = {
    "Rn": (fg.Rn(3), 2, drive),
    "Rn, rounded": (fg.Rn(3), 2, drive_rounded),
    "SE2": (fg.SE2, 2, drive),
    "SE3": (fg.SE3, 3, fly),
    "{p, R, v}": (STATE, 3, fly),
}


def derivatives_at(
    manifold: fg.Manifold, axes: int, function: fg.Residual | Callable[..., Array]
) -> Callable[[float], tuple[Array, Array]]:
    """Jacobian, and Hessian of the Lagrangian, of one constraint with its world moved so far."""
    rng = np.random.default_rng(4)
    graph, x, y = graph_of(("x", manifold, 2), ("y", manifold, 2))
    u, centre = graph.variables("u", fg.Rn(2), 2), graph.data("centre", CENTRE)
    points = {family: manifold.random(rng, (2,)) for family in (x, y)}
    for values in points.values():
        values[:, :axes] = np.round(values[:, :axes] / GRID) * GRID
    graph.constrain(function, x, y, u, centre, lower=0.0, upper=0.0)
    program = graph.compile()

    def at(offset: float) -> tuple[Array, Array]:
        away = np.zeros(manifold.storage)
        away[:axes] = offset
        program.bind({centre: CENTRE + offset})
        moved = {family: values + away for family, values in points.items()}
        lin = program.linearize({**moved, u: np.array([[0.7, 0.3], [-0.4, 0.9]])})
        return lin.constraint_jacobian.copy(), lagrangian_hessian(program, lin, np.tile(PULL, 2))

    return at


@pytest.mark.parametrize("how", ["njit", "NumPy"])
@pytest.mark.parametrize("case", CASES)
def test_differences_do_not_depend_on_the_origin(case: str, how: str) -> None:
    manifold, axes, function = CASES[case]
    at = derivatives_at(manifold, axes, fg.residual(function, rows=4) if how == "njit" else batched(function))
    first, second = at(0.0)
    assert np.abs(second).max() > 1.0, "no curvature to be wrong about"
    for offset in FAR:
        moved, moved_second = at(offset)
        # What is rounded to the spacing of 5e6, 1e-9 m, cannot be had more exactly.
        rounded = "rounded" in case
        np.testing.assert_allclose(moved, first, atol=1e-6 if rounded else 1e-8, err_msg=f"{offset}")
        np.testing.assert_allclose(moved_second, second, atol=2e-3 if rounded else 2e-4, err_msg=f"{offset}")


@pytest.mark.parametrize("how", ["njit", "NumPy"])
def test_a_wide_step_is_not_believed_where_the_function_bends(how: str) -> None:
    """A variable whose scale is a millimetre beside one of a million: the wide step would miss what happens."""

    @numba.njit  # type: ignore[untyped-decorator]
    def fine(x: Array, u: Array, centre: Array, r: Array) -> None:
        r[0] = np.sin(1e3 * u[0])
        r[1] = x[0] - centre[0]
        r[2] = r[3] = 0.0

    graph, x, u = graph_of(("x", fg.Rn(2), 1), ("u", fg.Rn(1), 1))
    graph.minimize(fg.residual(fine, rows=4) if how == "njit" else batched(fine), x, u, CENTRE)
    lin = graph.compile().linearize({x: np.full((1, 2), 5e6), u: np.array([[1e-3]])})
    np.testing.assert_allclose(lin.jacobian.reshape(4, 3)[0], [0.0, 0.0, 1e3 * np.cos(1.0)], rtol=1e-4)


@pytest.mark.parametrize("offset", (0.0, *FAR))
@pytest.mark.parametrize("manifold", [fg.SE2, fg.SE3], ids=lambda m: m.name)
def test_gradient_and_hessian_of_a_scalar(manifold: fg.Manifold, offset: float) -> None:
    """Against the closed form of 1/2 |p - c|^2 cos(angle between the first axis of the body and the line to c)."""
    axes = 2 if manifold is fg.SE2 else 3
    rng = np.random.default_rng(1)
    x = manifold.random(rng, (6,))
    x[:, :axes] = np.round(x[:, :axes] / GRID) * GRID
    away = np.zeros(manifold.storage)
    away[:axes] = offset

    def ahead(points: Array) -> Array:
        line = points[:, :axes] - offset
        R = fg.SO2.matrix(points[:, 2:3]) if manifold is fg.SE2 else fg.SO3.matrix(points[:, 3:7])
        return np.asarray(np.einsum("nk,nk->n", line, R[:, :, 0]))  # p' R e1

    gradient, hessian, _ = scalar_slopes(one_by_one(ahead), directions_of((manifold,)), [x + away])
    R = fg.SO2.matrix(x[:, 2:3]) if manifold is fg.SE2 else fg.SO3.matrix(x[:, 3:7])
    body = np.einsum("nk,nki->ni", x[:, :axes], R)  # p in the frame of the body
    expected = np.zeros_like(gradient)
    bent = np.zeros_like(hessian)
    turn = axes  # column of the first rotation; d(p' R Exp(w) e1) = p_b . (w x e1)
    expected[:, 0] = 1.0
    if axes == 2:
        expected[:, 2], bent[:, 2, 2] = body[:, 1], -body[:, 0]
        bent[:, 1, 2] = bent[:, 2, 1] = 1.0 - 0.5  # t . (w x e1), less half of the slope along w x t
    else:
        expected[:, turn + 1], expected[:, turn + 2] = -body[:, 2], body[:, 1]
        first, whole = np.eye(3)[0], np.eye(3)
        for i in range(3):
            for j in range(3):
                mixed = whole[i] @ np.cross(whole[j], first) + 0.5 * first @ np.cross(whole[j], whole[i])
                bent[:, i, turn + j] = bent[:, turn + j, i] = mixed
                twice = np.cross(whole[i], np.cross(whole[j], first)) + np.cross(whole[j], np.cross(whole[i], first))
                bent[:, turn + i, turn + j] = 0.5 * body @ twice
    np.testing.assert_allclose(gradient, expected, atol=1e-8)
    np.testing.assert_allclose(hessian, bent, atol=1e-4 if offset else 1e-6)
    (numerical,) = jacobian(lambda points: ahead(points)[:, None], [x + away], [manifold])
    np.testing.assert_allclose(numerical[:, 0], expected, atol=1e-8)


def shifted(values: Array, axes: int, offset: float) -> Array:
    result = np.array(values)
    result[..., :axes] += offset
    return result


SEEN = np.array([0.3, -0.2, 0.7])
SHIPPED: dict[str, tuple[fg.Residual, fg.Manifold, int, list[Any]]] = {  # manifold, axes of its position, parameters
    "unicycle.dynamics": (unicycle.dynamics, fg.SE2, 2, [0.2]),
    "between, Rn": (fg.between.on(fg.Rn(3)), fg.Rn(3), 3, [SEEN]),
    "between, SE2": (fg.between.on(fg.SE2), fg.SE2, 2, [SEEN]),
    "difference, SE3": (fg.difference.on(fg.SE3), fg.SE3, 3, []),
    "quadrotor.dynamics": (quadrotor.dynamics, quadrotor.STATE, 3, [quadrotor.Parameters(1.0).packed, 0.2]),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_kernels_do_not_round_far_out(name: str) -> None:
    """A compiler that may reorder makes y - (x + a) of (y - x) - a, which is rounded to 1e-9 m at 5e6 m."""
    residual, manifold, axes, rest = SHIPPED[name]
    rng = np.random.default_rng(2)
    x, y = manifold.random(rng, (20,)), manifold.random(rng, (20,))
    for values in (x, y):
        values[:, :axes] = np.round(values[:, :axes] / GRID) * GRID
    between = {"unicycle.dynamics": [rng.normal(size=(20, 2))], "quadrotor.dynamics": [rng.normal(size=(20, 4))]}
    at = [
        residual(shifted(x, axes, offset), *between.get(name, []), shifted(y, axes, offset), *rest)
        for offset in (0.0, 5e6)
    ]
    np.testing.assert_allclose(at[1], at[0], rtol=0.0, atol=1e-14)


@compiled
def _defect(y: float, x: float, moved: float) -> float:
    return minus(minus(y, x), moved)


def test_what_may_be_reordered_is_kept_from_it() -> None:
    """``minus(y, x) - moved`` is not: the outer operation's liberty is enough to make y - (x + moved) of it."""
    moved = 0.1234567890123456
    assert _defect(5e6 + 0.25, 5e6, moved) == 0.25 - moved


@pytest.mark.parametrize("asked", ["soft", "hard goal", "obstacle"])
@pytest.mark.parametrize(("name", "kind"), [("SE(2)", "shipped"), ("{p, R, v}", "shipped")])
def test_a_moved_world_is_the_same_problem(name: str, kind: str, asked: str) -> None:
    """A slice of ``make offsets``; a penalty's last iterations are decided by rounding."""
    case = offsets.drive_case(name, offsets.SPACES[name], kind, asked)
    case.backends = {name: make for name, make in case.backends.items() if name not in ("Penalty", "KKT")}
    for row in offsets.run(case):
        assert row.same, row
        assert set(row.status) == {"CONVERGED"}, row


def test_the_gradient_of_a_logarithm_near_zero() -> None:
    """Accuracy where four points at a step of 1e-4 are wrong by 2e-4, and two at a sixteenth of it by 2e-5."""
    x = np.array([[7e-4], [3e-3], [0.2], [5.0]])
    entropy = one_by_one(lambda p: np.asarray(p[:, 0] * np.log(p[:, 0])))
    gradient, hessian, _ = scalar_slopes(entropy, directions_of((fg.Rn(1),)), [x])
    exact = 1.0 + np.log(x)
    np.testing.assert_allclose(gradient[0], exact[0], atol=3e-5)
    np.testing.assert_allclose(gradient[1:], exact[1:], atol=3e-6)
    np.testing.assert_allclose(gradient[2:], exact[2:], atol=1e-9)
    np.testing.assert_allclose(hessian[1:, 0], 1.0 / x[1:], rtol=1e-3)
