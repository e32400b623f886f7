"""The axioms of Lie groups, once, for every group, batch shape and corner of the tangent space.

A new group joins by one line in ``groups.CASES``. Elements are compared through their matrices, so that
theta = pi and theta = -pi are the same rotation, and a quaternion and its negative; the references are
``scipy.linalg.expm`` of the Lie algebra and of ``ad``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.random import Generator

from groups import (
    BATCHES,
    BROADCASTS,
    CASES,
    PI,
    REGIMES,
    Batch,
    Case,
    assert_close,
    assert_on_group,
    assert_same,
    elements,
    exponentials,
    integrated,
    tangents,
    times,
)
from unifg.lie import SE2, SE3, SO2, SO3, LieGroup, Rn
from unifg.typing import Array


class Drawn(NamedTuple):
    """A group, and elements, tangent vectors and points of one batch shape from one corner of its tangent space."""

    case: Case
    group: LieGroup
    batch: Batch
    regime: str
    x: Array
    y: Array
    d: Array
    points: Array


@pytest.fixture(params=list(CASES.values()), ids=list(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    chosen: Case = request.param
    return chosen


@pytest.fixture(params=[(batch, regime) for batch in BATCHES for regime in REGIMES], ids=str)
def drawn(case: Case, request: pytest.FixtureRequest, rng: Generator) -> Drawn:
    batch, regime = request.param
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    points = rng.standard_normal((*batch, case.group.point_dim))
    return Drawn(case, case.group, batch, regime, x, y, tangents(case, regime, batch, rng), points)


# -- the group --


@pytest.mark.product(80)
def test_closure(drawn: Drawn) -> None:
    case, group, batch, _, x, y, d, _ = drawn
    results = [x, group.exp(d), group.compose(x, y), group.inverse(x)]
    results += [group.between(x, y), group.retract(x, d)]
    for result in results:
        assert_on_group(case, result, batch)
    for tangent in (group.log(x), group.local(x, y)):
        assert tangent.dtype == np.float64
        assert tangent.shape == (*batch, group.dim)
        for part in case.rotations:
            assert np.all(np.linalg.norm(tangent[..., part], axis=-1) <= PI + 1e-15)
            if part.stop - part.start == 1:
                assert np.all((tangent[..., part] >= -PI) & (tangent[..., part] < PI))


@pytest.mark.product(80)
def test_products_are_those_of_matrices(drawn: Drawn) -> None:
    _, group, _, _, x, y, _, points = drawn
    unit = np.broadcast_to(group.identity(), x.shape)
    assert_close(group.matrix(group.compose(x, y)), group.matrix(x) @ group.matrix(y))
    assert group.identity().shape == (group.storage,)
    assert_close(group.matrix(group.identity()), np.eye(group.matrix_dim))
    assert_same(group, group.compose(x, group.inverse(x)), unit)
    assert_same(group, group.between(x, y), group.compose(group.inverse(x), y))
    assert_close(group.act(group.compose(x, y), points), group.act(x, group.act(y, points)))
    assert_close(group.act(group.inverse(x), group.act(x, points)), points)


# -- exp, log and what follows from them --


@pytest.mark.product(80)
def test_exp_and_log(drawn: Drawn) -> None:
    case, group, _, regime, x, _, d, _ = drawn
    assert_close(group.matrix(group.exp(d)), exponentials(group.hat(d)))
    assert_close(exponentials(group.hat(group.log(x))), group.matrix(x))
    if regime != "exactly -pi" or all(part.stop - part.start == 1 for part in case.rotations):
        # At an angle of pi a rotation vector and its negative are one rotation; only the plane has a rule.
        assert_close(group.log(group.exp(d)), d)
    if regime == "near identity":
        # No digit is lost to wrapping.
        np.testing.assert_allclose(group.log(group.exp(d)), d, rtol=1e-14, atol=0.0)


@pytest.mark.product(80)
def test_retract_and_local(drawn: Drawn) -> None:
    _, group, _, regime, x, y, d, _ = drawn
    assert_close(group.matrix(group.retract(x, d)), group.matrix(x) @ exponentials(group.hat(d)))
    np.testing.assert_array_equal(group.retract(x, np.zeros(group.dim)), x)
    assert_same(group, group.retract(x, group.local(x, y)), y)
    if regime != "exactly -pi":  # rounding of theta decides the sign there
        assert_close(group.local(x, group.retract(x, d)), d)
    assert_close(group.local(x, x), np.zeros_like(d))


@pytest.mark.parametrize(("first", "second"), BROADCASTS, ids=str)
def test_broadcasting(case: Case, first: Batch, second: Batch, rng: Generator) -> None:
    group = case.group
    shape = np.broadcast_shapes(first, second)
    x, y = group.random(rng, first), group.random(rng, second)
    d = tangents(case, "random", second, rng)
    points = rng.standard_normal((*second, group.point_dim))
    operations: list[tuple[Callable[[Array, Array], Array], Array]] = [
        (group.compose, y),
        (group.between, y),
        (group.local, y),
        (group.retract, d),
        (group.act, points),
    ]
    for operation, other in operations:
        full_x = np.broadcast_to(x, (*shape, x.shape[-1]))
        full_other = np.broadcast_to(other, (*shape, other.shape[-1]))
        np.testing.assert_array_equal(operation(x, other), operation(full_x, full_other), strict=True)


def test_arguments_are_not_changed(case: Case, rng: Generator) -> None:
    group = case.group
    x, y = group.random(rng, (4,)), group.random(rng, (4,))
    d, zero = tangents(case, "random", (4,), rng), np.zeros((4, group.dim))
    for array in (x, y, d, zero):
        array.flags.writeable = False
    outcomes = [group.exp(zero), group.log(x), group.inverse(x), group.compose(x, y), group.retract(x, zero)]
    outcomes += [group.local(x, y), group.between(x, y), group.adjoint(x), group.ad(d)]
    outcomes += [group.right_jacobian(d), group.right_jacobian_inverse(d)]
    for outcome in outcomes:
        assert outcome.flags.writeable
        assert not any(np.shares_memory(outcome, array) for array in (x, y, d, zero))


# -- adjoints and Jacobians --


@pytest.mark.product(80)
def test_adjoints(drawn: Drawn) -> None:
    _, group, _, _, x, y, d, _ = drawn
    other = group.log(y)
    moved = times(group.adjoint(x), d)
    conjugate = group.matrix(x) @ exponentials(group.hat(d)) @ group.matrix(group.inverse(x))
    assert_close(conjugate, exponentials(group.hat(moved)))
    bracket = group.hat(d) @ group.hat(other) - group.hat(other) @ group.hat(d)
    assert_close(group.hat(times(group.ad(d), other)), bracket)
    assert_close(group.adjoint(group.exp(d)), exponentials(group.ad(d)))


@pytest.mark.product(80)
def test_jacobians(drawn: Drawn) -> None:
    """They are integrals of the adjoint, which fixes their signs, and their inverses are inverses."""
    _, group, _, _, _, _, d, _ = drawn
    right, left = group.right_jacobian(d), group.left_jacobian(d)
    assert_close(right, integrated(-group.ad(d)))
    assert_close(left, integrated(group.ad(d)))
    unit = np.broadcast_to(np.eye(group.dim), right.shape)
    assert_close(group.right_jacobian_inverse(d) @ right, unit)
    assert_close(group.left_jacobian_inverse(d) @ left, unit)


# -- actions and randomness --


def test_action_through_matrices(rng: Generator) -> None:
    points = rng.standard_normal((7, 2))
    pose, angle, shift = SE2.random(rng, (7,)), SO2.random(rng, (7,)), Rn(2).random(rng, (7,))
    homogeneous = np.concatenate([points, np.ones((7, 1))], axis=-1)
    assert_close(SE2.act(pose, points), times(SE2.matrix(pose), homogeneous)[:, :2])
    assert_close(Rn(2).act(shift, points), times(Rn(2).matrix(shift), homogeneous)[:, :2])
    assert_close(SO2.act(angle, points), times(SO2.matrix(angle), points))

    points = rng.standard_normal((7, 3))
    turn, motion = SO3.random(rng, (7,)), SE3.random(rng, (7,))
    homogeneous = np.concatenate([points, np.ones((7, 1))], axis=-1)
    assert_close(SO3.act(turn, points), times(SO3.matrix(turn), points))
    assert_close(SE3.act(motion, points), times(SE3.matrix(motion), homogeneous)[:, :3])


def test_random_depends_on_the_generator_alone(case: Case) -> None:
    draws = [case.group.random(np.random.default_rng(seed), (6,)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])


# -- values known by hand --


def test_se2_by_hand() -> None:
    quarter = PI / 2
    np.testing.assert_allclose(SE2.compose([1, 2, quarter], [3, 0, 0]), [1, 5, quarter], atol=1e-15)
    np.testing.assert_allclose(SE2.inverse([1, 2, quarter]), [-2, 1, -quarter], atol=1e-15)
    np.testing.assert_allclose(SE2.act([1, 2, quarter], [[3, 0], [0, 1]]), [[1, 5], [0, 2]], atol=1e-15)
    # A quarter turn along an arc of length pi/2: radius 1, ends at (1, 1).
    np.testing.assert_allclose(SE2.exp([quarter, 0, quarter]), [1, 1, quarter], atol=1e-15)
    np.testing.assert_allclose(SE2.log([1, 1, quarter]), [quarter, 0, quarter], atol=1e-15)
    np.testing.assert_allclose(SE2.exp([PI, 0, PI]), [0, 2, -PI], atol=1e-15)
    np.testing.assert_allclose(SE2.local([1, 2, quarter], [1, 5, quarter]), [3, 0, 0], atol=1e-15)


@pytest.mark.parametrize("omega", [0.0, 5e-324, -5e-324, 1e-310, 1e-160, -1e-20, 1e-12])
def test_se2_with_hardly_any_rotation(omega: float) -> None:
    d = np.array([1.0, -2.0, omega])
    np.testing.assert_allclose(SE2.exp(d), d, rtol=0, atol=2e-12)
    np.testing.assert_allclose(SE2.log(d), d, rtol=0, atol=2e-12)
    np.testing.assert_allclose(SE2.right_jacobian(d), np.eye(3) - SE2.ad(d) / 2, rtol=0, atol=2e-12)
    np.testing.assert_allclose(SE2.right_jacobian_inverse(d), np.eye(3) + SE2.ad(d) / 2, rtol=0, atol=2e-12)


def test_se2_jacobians_over_all_angles() -> None:
    """Both branches of both series, and the seam between them, up to the singularity at 2 pi."""
    small = np.geomspace(1e-14, 0.45, 60)
    seam = 0.5 * (1 + np.linspace(-1e-3, 1e-3, 21))
    omega = np.concatenate([small, seam, np.linspace(0.55, 6.0, 60)])
    omega = np.concatenate([-omega, [0.0], omega])
    d = np.stack([np.full_like(omega, 0.7), np.full_like(omega, -1.3), omega], axis=-1)
    right = integrated(-SE2.ad(d))
    np.testing.assert_allclose(SE2.right_jacobian(d), right, rtol=0, atol=2e-14)
    inverse = np.linalg.inv(right)
    error = np.abs(SE2.right_jacobian_inverse(d) - inverse).max(axis=(1, 2))
    assert np.max(error / np.abs(inverse).max(axis=(1, 2))) < 2e-13


def test_unwrapped_storage_names_the_same_pose(rng: Generator) -> None:
    x, y, d = SE2.random(rng, (8,)), SE2.random(rng, (8,)), rng.standard_normal((8, 3))
    turned = x + np.array([0.0, 0.0, 4 * PI])
    for operation, other in ((SE2.compose, y), (SE2.retract, d), (SE2.local, y), (SE2.between, y)):
        np.testing.assert_allclose(operation(turned, other), operation(x, other), atol=1e-13)
    assert SE2.is_valid(turned).all()


def test_is_valid_finds_what_is_not_finite(case: Case, rng: Generator) -> None:
    x = case.group.random(rng, (3,))
    x[1, -1], x[2, 0] = np.nan, np.inf
    np.testing.assert_array_equal(case.group.is_valid(x), [True, False, False])
