"""Every integrator on every group: order, exactness, derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, cast

import numpy as np
import pytest

import unifg as fg
from moving import FLYER, Carried, drag_and_thrust
from unifg.factors.differences import jacobian
from unifg.models import rkmk
from unifg.models.rkmk import Method
from unifg.models.tableau import METHODS, Tableau
from unifg.typing import Array

RNG = np.random.default_rng(3)
GROUPS: list[fg.LieGroup] = [fg.SE2, fg.SO3, fg.SE3, fg.Product(X=fg.SE3, p=fg.Rn(2), R=fg.SO3)]
NAMES = cast(list[Method], list(METHODS))
HEUN = Tableau("heun", 2, (0.5, 0.5), ((), (1.0,)))
EVERY_GROUP = pytest.mark.parametrize("group", GROUPS, ids=lambda g: g.name)
EVERY_METHOD = pytest.mark.parametrize("method", NAMES)


# ---------------------------------------------------------------- the methods


@EVERY_METHOD
@EVERY_GROUP
@pytest.mark.product(1)
def test_order_of_convergence(group: fg.LieGroup, method: Method) -> None:
    """Against the exact motion, at steps that halve."""
    field, order = Carried(group), METHODS[cast(str, method)].order
    rng = np.random.default_rng(5)
    x, u, w = group.random(rng), rng.uniform(-0.9, 0.9, group.dim), rng.uniform(-0.9, 0.9, group.dim)
    exact = Carried(group).after(x[None], u[None], w[None], 0.5)[0]
    errors = []
    for steps in (8, 16, 32):
        states = rkmk.rollout(group, field, x, u, w, h=0.5 / steps, method=method, count=steps)
        errors.append(float(np.linalg.norm(group.local(exact, states[-1]))))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert abs(orders[-1] - order) < 0.06, (orders, errors)
    assert abs(orders[-1] - order) <= abs(orders[0] - order) + 0.01


FLIGHT = (
    FLYER.pack(p=[0, 0, 0], R=fg.SO3.exp([0.3, -0.2, 0.5]), v=[1.0, 0.5, -0.3]),
    np.array([0.6, -0.4, 0.8, 9.0]),
)


@cache
def flown() -> Array:
    return np.asarray(rkmk.rollout(FLYER, drag_and_thrust, *FLIGHT, h=0.4, count=1, substeps=512)[-1])


@EVERY_METHOD
@pytest.mark.product(1)
def test_order_on_position_attitude_velocity(method: Method) -> None:
    """The state of a flying robot, against rk4 at a sixteenth of the finest step."""
    order, errors = METHODS[cast(str, method)].order, []
    for steps in (8, 16, 32):
        states = rkmk.rollout(FLYER, drag_and_thrust, *FLIGHT, h=0.4, method=method, count=1, substeps=steps)
        errors.append(float(np.linalg.norm(FLYER.local(flown(), states[-1]))))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert abs(orders[-1] - order) < 0.06, (orders, errors)


@pytest.mark.parametrize("group", [*GROUPS, fg.SO2, fg.Rn(3)], ids=lambda g: g.name)
@pytest.mark.parametrize("method", [*NAMES, HEUN], ids=str)
def test_exact_where_the_field_does_not_depend_on_the_state(group: fg.LieGroup, method: Method) -> None:
    x, u, h = group.random(RNG, (50,)), RNG.normal(size=(50, group.dim)), 0.4
    defect = rkmk.integrator(group, lambda x, u: u, method)
    assert np.abs(defect(x, u, group.retract(x, h * u), h)).max() < 1e-14
    np.testing.assert_allclose(
        rkmk.advance(group, lambda x, u: u, x, u, h=h, method=method), group.retract(x, h * u), atol=1e-13
    )


@pytest.mark.parametrize("method", ["explicit euler", "rk4"])
@pytest.mark.parametrize("group", [fg.SO3, fg.SE3, GROUPS[3]], ids=lambda g: g.name)
def test_a_long_way_stays_on_the_group(group: fg.LieGroup, method: Method) -> None:
    field, turns = Carried(group), 10_000
    u, w = np.full(group.dim, 0.3), np.linspace(-0.5, 0.5, group.dim)
    states = rkmk.rollout(group, field, group.random(RNG), u, w, h=0.05, method=method, count=turns)
    assert states.shape == (turns + 1, group.storage)
    for part, at in {"SO3": [("q", 0)], "SE3": [("q", 3)]}.get(group.name, [("X", 3), ("R", 9)]):
        norms = np.linalg.norm(states[:, at : at + 4], axis=1)
        assert np.abs(norms - 1.0).max() < 5e-15, part
    rotations = fg.SO3.matrix(states[:, -4:] if group.name != "SE3" else states[:, 3:])
    assert np.abs(np.einsum("nji,njk->nik", rotations, rotations) - np.eye(3)).max() < 2e-14


# ---------------------------------------------------------------- derivatives


def step_of(group: fg.LieGroup, count: int = 6) -> tuple[list[Array], list[fg.Manifold]]:
    x = group.random(RNG, (count,))
    u, w = RNG.normal(size=(2, count, group.dim))
    after = group.retract(x, 0.6 * RNG.normal(size=(count, group.dim)))
    return [x, u, w, after], [group, fg.Rn(group.dim), fg.Rn(group.dim), group]


def linearized(
    defect: fg.Residual, points: Sequence[Array], manifolds: Sequence[fg.Manifold], h: Any
) -> tuple[Array, Array]:
    """Residual (n, dim) and Jacobian (n, dim, d) of steps that a graph has traced; one point of a kind is shared."""
    graph, count = fg.Graph(), len(points[0])
    families = [graph.variables(f"x{k}", m, len(p)) for k, (m, p) in enumerate(zip(manifolds, points, strict=True))]
    graph.minimize(defect, *families, h)
    program = graph.compile()
    assert program.terms[0].route.endswith("derivatives exact")
    lin = program.linearize(dict(zip(families, points, strict=True)))
    return lin.residual.reshape(count, -1), lin.jacobian.reshape(count, lin.residual.size // count, -1)


@pytest.mark.parametrize("method", [*NAMES, HEUN], ids=str)
@EVERY_GROUP
@pytest.mark.product(5)
def test_jacobians(group: fg.LieGroup, method: Method) -> None:
    """Traced in a graph: against differences of the defect."""
    points, manifolds = step_of(group)
    defect = rkmk.integrator(group, Carried(group), method)
    numerical = np.concatenate(jacobian(lambda *p: defect(*p, 0.3), points, manifolds), axis=2)
    found, blocks = linearized(defect, points, manifolds, 0.3)
    np.testing.assert_allclose(found, defect(*points, 0.3), atol=1e-14 * 30)
    np.testing.assert_allclose(blocks, numerical, atol=1e-8)


def test_steps_may_differ_and_inputs_be_shared() -> None:
    group, field = fg.SE3, Carried(fg.SE3)
    (x, u, w, after), manifolds = step_of(group)
    h = RNG.uniform(0.1, 0.4, len(x))
    defect = rkmk.integrator(group, field, "rk4")
    together, (_, blocks) = defect(x, u, w[:1], after, h), linearized(defect, (x, u, w[:1], after), manifolds, h)
    for i in range(len(x)):
        one = [part[i : i + 1] for part in (x, u)]
        alone = defect(*one, w[:1], after[i : i + 1], float(h[i]))
        np.testing.assert_allclose(together[i], alone[0], atol=1e-15)
        single = linearized(defect, (*one, w[:1], after[i : i + 1]), manifolds, float(h[i]))[1]
        np.testing.assert_allclose(blocks[i], single[0], atol=1e-14)
