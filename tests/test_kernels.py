"""Compiled residuals in graphs: the same numbers as their batched calls, whatever the term looks like."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.errors import GraphError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual
from unifg.factors.robust import Huber
from unifg.models import lidar, unicycle
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.models.obstacles import disc_clearance, shortfall, wall_distance
from unifg.models.potential import potential
from unifg.typing import Array

RNG = np.random.default_rng(23)
GRID = DistanceMap(np.add.outer(np.sin(np.arange(30.0)), np.cos(0.7 * np.arange(40.0))), 0.25, (-5.0, -4.0, 0.3))
WALLS = wall_distance(SmoothField(GRID))
ENDPOINT = lidar.endpoint(GRID)
CENTRES, RADII = RNG.normal(size=(3, 2)), np.array([0.2, 0.3, 0.4])
BETWEEN = fg.between.on(fg.SE2)
COUNT = 6

Rewrite = Callable[[Residual], Residual]
Build = Callable[[Rewrite], tuple[fg.Graph, dict[fg.Family, Array]]]


def kernel_of(case: Residual) -> Kernel:
    assert case.kernel is not None, case.name
    return case.kernel


def batched(case: Residual) -> Residual:
    """The same as a plain batched function, which graphs evaluate by NumPy."""
    kernel = kernel_of(case)
    plain = fg.residual(lambda *a: kernel(*a), kernel.jacobian, case.name, case.search)
    assert plain.kernel is None
    return plain


def compare(build: Build, search: bool = False) -> None:
    """All that solvers read must agree between kernels and batched functions, and J'J with J."""
    results = []
    for rewrite in (lambda case: case, batched):
        graph, guess = build(rewrite)
        program = graph.compile()
        values = program.values_from(guess)
        lin, evaluation = program.linearize(values, search), program.evaluate(values)
        assert lin.cost == pytest.approx(evaluation.cost, rel=1e-13)
        np.testing.assert_allclose(evaluation.constraints, lin.constraints, rtol=1e-13)
        jacobian = program.costs.matrix(lin.jacobian).toarray()
        hessian = program.normal.matrix(lin.hessian).toarray()
        np.testing.assert_allclose(hessian, np.triu(jacobian.T @ jacobian), rtol=1e-11, atol=1e-9)
        free = program.columns.free
        np.testing.assert_allclose(lin.gradient[free], jacobian.T @ lin.residual, rtol=1e-11, atol=1e-9)
        results.append(
            [lin.residual, lin.jacobian, lin.constraints, lin.constraint_jacobian, lin.gradient, lin.hessian]
        )
    for mine, reference in zip(*results, strict=True):
        np.testing.assert_allclose(mine, reference, rtol=1e-11, atol=1e-11)
    assert max(np.abs(part).max(initial=0.0) for part in results[0][1::2]) > 1e-3  # something was compared


def poses(count: int = COUNT) -> Array:
    return fg.SE2.random(np.random.default_rng(3), (count,))


def controls(count: int = COUNT) -> Array:
    return np.random.default_rng(4).normal(size=(count, 2))


# ---------------------------------------------------------------- the same numbers


def test_everything_at_once() -> None:
    """Components of a product, some members fixed, some factors inactive, robust, shared and own parameters."""

    def build(rewrite: Rewrite) -> tuple[fg.Graph, dict[fg.Family, Array]]:
        graph, s = graph_with(fg.Product(v=fg.Rn(2), p=fg.SE2), COUNT, "s")
        seen = graph.data("seen", np.arange(COUNT) % 3 > 0, each=True)
        centres = graph.data("centres", CENTRES + np.linspace(0.0, 1.0, COUNT)[:, None, None], each=True)
        graph.fix(s.p[0], poses()[0])
        graph.fix(s.v[2], [0.1, 0.2])
        graph.minimize(rewrite(unicycle.tracking), s.p, poses()[::-1], sigma=[0.3, 0.4, 0.5], robust=Huber(0.5))
        graph.minimize(rewrite(unicycle.rate), s.v[:-1], s.v[1:], information=np.array([[2.0, 0.3], [0.3, 1.0]]))
        graph.minimize(
            rewrite(shortfall(disc_clearance, 2.0)), s.p, centres, RADII, active=seen, sigma=0.2, robust=Huber(1.0)
        )
        graph.minimize(rewrite(shortfall(WALLS, 5.0)), s.p[::-1], active=seen)
        graph.minimize(rewrite(potential(disc_clearance, vortex=0.4)), s.p, centres, RADII)
        graph.constrain(
            rewrite(unicycle.dynamics), s.p[:-1], s.v[:-1], s.p[1:], np.linspace(0.1, 0.3, COUNT - 1), upper=0.0
        )
        graph.constrain(rewrite(disc_clearance), s.p, centres, RADII, lower=0.1, active=seen)
        return graph, {s: np.concatenate([controls(), poses()], axis=1)}

    compare(build)
    compare(build, search=True)


def test_shared_variable() -> None:
    """All beams of a scan see one pose."""

    def build(rewrite: Rewrite) -> tuple[fg.Graph, dict[fg.Family, Array]]:
        graph, x = graph_with(fg.SE2, 2)
        beams = graph.data("beams", np.random.default_rng(5).uniform(-2.0, 2.0, (40, 2)), each=True)
        loss = lidar.endpoint_loss(0.1, 0.25)
        graph.minimize(rewrite(ENDPOINT), x[1], beams, sigma=0.1, robust=loss)
        graph.minimize(rewrite(BETWEEN), x[0], x[1], np.zeros(3))
        return graph, {x: 0.3 * poses(2)}

    compare(build)


@pytest.mark.parametrize("measured", [np.array([0.3, -0.2, 0.5]), np.array([[0.3, -0.2, 0.5], [0.1, 0.0, -1.0]])])
def test_one_variable_in_both_places_of_a_factor(measured: Array) -> None:
    """Its two blocks add up: J'J is that of their sum, cross products counted twice."""

    def build(rewrite: Rewrite) -> tuple[fg.Graph, dict[fg.Family, Array]]:
        graph, x = graph_with(fg.SE2, 2)
        graph.minimize(rewrite(BETWEEN), x, x, measured, sigma=0.7)
        graph.minimize(fg.prior, x, np.zeros(3))
        graph.constrain(rewrite(unicycle.dynamics), x, controls(2), x, 0.1, upper=0.0)
        return graph, {x: poses(2)}

    compare(build)
    graph, guess = build(lambda case: case)
    lin = graph.compile().linearize(guess)
    first, second = kernel_of(BETWEEN).jacobian(poses(2), poses(2), measured)
    both = (first + second) / 0.7
    expected = np.zeros((6, 6))
    for k in range(2):
        expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = both[k].T @ both[k]
    after = fg.SE2.right_jacobian_inverse(fg.SE2.log(poses(2)))
    for k in range(2):
        expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += after[k].T @ after[k]
    np.testing.assert_allclose(graph.compile().normal.matrix(lin.hessian).toarray(), np.triu(expected), atol=1e-10)


def test_search_by_numpy_beside_a_kernel() -> None:
    """Only the linearisations that search leave the kernel."""

    def looked_in(x: Array, centre: Array, radius: Array) -> list[Array]:
        return [2.0 * disc_clearance.jacobian(x, centre, radius)[0]]  # type: ignore[misc]

    graph, x = graph_with(fg.SE2, COUNT)
    graph.minimize(replace(disc_clearance, search=looked_in), x, CENTRES, RADII)
    graph.minimize(disc_clearance, x[::-1], CENTRES, RADII)
    program = graph.compile()
    assert program.fully_compiled
    steered, true = (program.linearize({x: poses()}, search=flag).jacobian for flag in (True, False))
    np.testing.assert_allclose(steered, true * np.repeat([2.0, 1.0], len(true) // 2), rtol=1e-12)


def test_data_reaches_the_kernels() -> None:
    graph, x = graph_with(fg.SE2, COUNT)
    centres, radii = graph.data("centres", CENTRES), graph.data("radii", np.tile(RADII, (COUNT, 1)), each=True)
    seen = graph.data("seen", np.ones(COUNT, dtype=bool), each=True)
    graph.constrain(disc_clearance, x, centres, radii, lower=0.0, active=seen)
    program = graph.compile()
    moved: dict[fg.Data, Any] = {
        centres: CENTRES + 1.0,
        radii: 2.0 * np.tile(RADII, (COUNT, 1)),
        seen: np.arange(COUNT) > 2,
    }
    for data in ({}, moved, {}):
        program.bind(data)
        given: dict[fg.Data, Any] = {centres: CENTRES, radii: radii.value, seen: seen.value, **data}
        expected = disc_clearance(poses(), given[centres], given[radii]) * given[seen][:, None]
        np.testing.assert_allclose(program.evaluate({x: poses()}).constraints, expected.ravel(), atol=1e-14)


def test_numpy_forms_of_the_combinators_agree() -> None:
    """Margins and potentials of a batched distance are those of its kernel."""
    arguments = (0.5 * poses(60), CENTRES, RADII)
    plain = batched(disc_clearance)
    cases = [(shortfall(disc_clearance, 0.5), shortfall(plain, 0.5))]
    for sense in ("circulate", "aside"):
        options: dict[str, Any] = {"vortex": 0.6, "sense": sense}
        cases.append((potential(disc_clearance, **options), potential(plain, **options)))
    for mine, reference in cases:
        assert mine.kernel is not None and reference.kernel is None
        np.testing.assert_allclose(mine(*arguments), reference(*arguments), atol=1e-13)
        assert 0.1 < np.mean(mine(*arguments) > 0.0) < 1.0
        pairs = [(mine.jacobian, reference.jacobian), (mine.search, reference.search)]
        for own, other in pairs:
            assert (own is None) == (other is None)
            if own is not None and other is not None:
                np.testing.assert_allclose(own(*arguments)[0], other(*arguments)[0], rtol=1e-12, atol=1e-12)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (lambda g: g.minimize(unicycle.tracking, g.variables("h", fg.SO2, 3), np.zeros(3)), "is SE2; found .*h.* SO2"),
        (lambda g: g.minimize(unicycle.rate, *(g.variables(n, fg.Rn(3), 2) for n in "ab")), r"is Rn\(2\); found"),
        (
            lambda g: g.minimize(unicycle.tracking, g.variables("x", fg.SE2, 2), g.variables("y", fg.SE2, 2)),
            "argument 1 of tracking is a parameter, not a variable",
        ),
        (
            lambda g: g.minimize(WALLS, g.variables("s", fg.Product(p=fg.SE2, v=fg.Rn(1)), 2)),
            "argument 0 of wall distance is SE2",
        ),
        (lambda g: g.minimize(unicycle.tracking, g.variables("x", fg.SE2, 2)), "takes 2 arguments, found 1"),
        (
            lambda g: g.minimize(disc_clearance, g.variables("x", fg.SE2, 2), CENTRES, RADII[:2]),
            r"radius \(M,\).*found \(3, 2\) and \(2,\)",
        ),
        (
            lambda g: g.minimize(disc_clearance, g.variables("x", fg.SE2, 2), np.zeros((2, 3, 3)), RADII),
            r"found \(3, 3\) and \(3,\)",
        ),
        (
            lambda g: g.minimize(ENDPOINT, g.variables("x", fg.SE2, 4), np.zeros((4, 3))),
            r"argument 1 has shape \(4, 3\), expected \(2,\)",
        ),
        (
            lambda g: g.minimize(unicycle.tracking, g.variables("x", fg.SE2, 4), np.zeros((3, 3))),
            r"speak of \[3, 4\] factors",
        ),
        (
            lambda g: g.minimize(unicycle.tracking, g.variables("x", fg.SE2, 4), np.zeros((4, 1, 3))),
            r"argument 1 has shape \(4, 1, 3\), expected \(3,\)",
        ),
        (
            lambda g: g.minimize(
                unicycle.dynamics, g.variables("x", fg.SE2, 4), np.zeros((4, 3)), np.zeros((4, 3)), 0.1
            ),
            r"expected \(n, 2\) for Rn\(2\)",
        ),
    ],
)
def test_wrong_manifolds_and_shapes_are_refused(state: Callable[[fg.Graph], Any], message: str) -> None:
    graph = fg.Graph()
    with pytest.raises(GraphError, match=message):
        state(graph)
        graph.compile()


@pytest.mark.parametrize("case", [unicycle.tracking, fg.prior.on(fg.SE2), fg.prior.on(fg.Rn(3))])
def test_a_short_reference_is_refused(case: Any) -> None:
    """Compiled code would read beyond its end."""
    with pytest.raises(GraphError, match=r"argument 1 has shape \(2,\), expected \(3,\)"):
        case(poses(), np.zeros(2))


# ---------------------------------------------------------------- kernels as objects


def test_tables_are_shared_and_what_compiled_code_expects() -> None:
    assert kernel_of(ENDPOINT).table is GRID.table is kernel_of(WALLS).table
    assert kernel_of(shortfall(WALLS, 0.1)).function is kernel_of(shortfall(WALLS, 0.2)).function
    whole: Any = np.arange(12)[::2].reshape(2, 3)
    strange = Kernel(kernel_of(WALLS).function, (fg.SE2,), 1, whole)
    np.testing.assert_array_equal(strange.table, np.arange(0.0, 12.0, 2.0))
    assert strange.table.flags.c_contiguous and strange.table.dtype == np.float64


def test_batches_of_nothing_and_of_one_row() -> None:
    assert disc_clearance(np.zeros((0, 3)), CENTRES, RADII).shape == (0, 3)
    assert kernel_of(disc_clearance).jacobian(np.zeros((0, 3)), CENTRES, RADII)[0].shape == (0, 3, 3)
    one = unicycle.dynamics(poses()[0], controls(), poses(), 0.1)
    np.testing.assert_array_equal(one, unicycle.dynamics(np.tile(poses()[0], (COUNT, 1)), controls(), poses(), 0.1))


@pytest.mark.parametrize("case", [WALLS, shortfall(WALLS, 0.3), potential(WALLS)], ids=lambda case: case.name)
def test_positions_that_are_no_numbers_or_far_away(case: Residual) -> None:
    """NaN stays NaN for the solver to see; beyond the map the border holds."""
    strange = np.array(
        [[np.nan, 0.0, 0.0], [0.0, np.nan, 1.0], [1e9, -1e9, 0.3], [-1e300, 1e300, 0.0], [0.1, 0.2, 0.3]]
    )
    value = case(strange)[:, 0]
    assert np.isnan(value[:2]).all() and np.isfinite(value[2:]).all()
    slopes = kernel_of(case).jacobian(strange)[0]
    assert np.abs(slopes[2:4]).max() < 1e-12 and np.isfinite(slopes[4]).all()
    corner = SmoothField(GRID).distance(np.array([[100.0, -100.0]]))
    np.testing.assert_allclose(WALLS(strange[2:3])[0], corner, atol=1e-12)


# ---------------------------------------------------------------- stated in NumPy


def _bowl(x: Array, depth: Array) -> Array:
    return (depth * np.sin(x[:, 0]) * x[:, 1])[:, None]


def test_stated_kernels_are_derived_when_they_are_needed() -> None:
    kernel = StatedKernel(_bowl, (fg.Rn(2), ()), 1, name="bowl")
    assert kernel.derived and "_expression" not in vars(kernel)
    x = np.array([[0.3, -0.7], [1.2, 0.4]])
    np.testing.assert_allclose(kernel(x, 2.0), _bowl(x, np.array(2.0)), rtol=1e-15)
    (by_x,) = kernel.jacobian(x, 2.0)
    np.testing.assert_allclose(by_x[:, 0], 2.0 * np.stack([np.cos(x[:, 0]) * x[:, 1], np.sin(x[:, 0])], axis=1))
    assert "second_address" not in vars(kernel)
    second = kernel.second_derivatives(np.ones((2, 1)), x, 2.0)
    np.testing.assert_allclose(second[:, 0, 1], 2.0 * np.cos(x[:, 0]))
    np.testing.assert_allclose(second[:, 0, 0], -2.0 * np.sin(x[:, 0]) * x[:, 1])
    copy = pickle.loads(pickle.dumps(kernel))
    assert not {"_expression", "address", "second_address"} & set(vars(copy))
    np.testing.assert_array_equal(copy(x, 2.0), kernel(x, 2.0))
    with pytest.raises(GraphError, match=r"bowl: argument 0 has shape \(2, 3\), expected \(n, 2\) for Rn\(2\)"):
        kernel(np.zeros((2, 3)), 2.0)


@pytest.mark.parametrize(
    "manifold", [fg.SO2, fg.SE2, fg.SO3, fg.SE3, fg.SE23, fg.Product(x=fg.SE2, v=fg.Rn(2))], ids=str
)
def test_a_prior_bends_as_its_slopes_say(manifold: fg.LieGroup) -> None:
    """Its rows are written by hand, its Hessian is derived from a function of NumPy; at zero and far away."""
    rng = np.random.default_rng(5)
    x = manifold.random(rng, (4,))
    d = np.array([0.0, 1e-3, 0.5, 1.2])[:, None] * rng.standard_normal((4, manifold.dim)) / 1.5
    reference, weights, eye = manifold.retract(x, d), rng.standard_normal((4, manifold.dim)), np.eye(manifold.dim)
    kernel = fg.prior.on(manifold).kernel
    assert kernel is not None
    found = kernel.second_derivatives(weights, x, reference)
    sides = (kernel.jacobian(manifold.retract(x, sign * 1e-5 * e), reference)[0] for e in eye for sign in (1.0, -1.0))
    pulled = [np.einsum("nij,ni->nj", side, weights) for side in sides]
    slopes = np.stack([(a - b) / 2e-5 for a, b in zip(pulled[::2], pulled[1::2], strict=True)], axis=1)
    np.testing.assert_allclose(found, 0.5 * (slopes + np.swapaxes(slopes, 1, 2)), atol=1e-8)
