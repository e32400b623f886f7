"""The axioms of Lie groups, once, for every group, batch shape and corner of the tangent space.

A new group joins by one line in ``groups.CASES``. Elements are compared through their matrices, so that
theta = pi and theta = -pi are the same rotation, and a quaternion and its negative; the references are
``scipy.linalg.expm`` of the Lie algebra and of ``ad``.
"""

from __future__ import annotations

from collections.abc import Callable

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
    tangents,
    times,
)
from unifg.lie import SE2, SE3, SO2, SO3, Rn
from unifg.typing import Array

DIFFERENCE = 1e-7  # central differences with STEP
STEP = 1e-5


@pytest.fixture(params=list(CASES.values()), ids=list(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    chosen: Case = request.param
    return chosen


@pytest.fixture(params=BATCHES, ids=str)
def batch(request: pytest.FixtureRequest) -> Batch:
    shape: Batch = request.param
    return shape


@pytest.fixture(params=REGIMES)
def regime(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


# -- the group --


def test_closure(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    d = tangents(case, regime, batch, rng)
    results = [x, group.exp(d), group.compose(x, y), group.inverse(x)]
    results += [group.between(x, y), group.retract(x, d)]
    for result in results:
        assert_on_group(case, result, batch)
    for tangent in (group.log(x), group.local(x, y)):
        assert tangent.dtype == np.float64
        assert tangent.shape == (*batch, group.dim)
        for part in case.rotations:
            assert np.all(np.linalg.norm(tangent[..., part], axis=-1) <= PI + 1e-15)
        for part in case.rotations:
            if part.stop - part.start == 1:
                assert np.all((tangent[..., part] >= -PI) & (tangent[..., part] < PI))


def test_compose_is_matrix_product(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    assert_close(group.matrix(group.compose(x, y)), group.matrix(x) @ group.matrix(y))


def test_associativity(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y, z = (elements(case, regime, batch, rng) for _ in range(3))
    assert_same(group, group.compose(group.compose(x, y), z), group.compose(x, group.compose(y, z)))


def test_identity(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x = elements(case, regime, batch, rng)
    assert group.identity().shape == (group.storage,)
    assert_close(group.matrix(group.identity()), np.eye(group.matrix_dim))
    assert_same(group, group.compose(x, group.identity()), x)
    assert_same(group, group.compose(group.identity(), x), x)
    assert_same(group, group.exp(np.zeros(group.dim)), group.identity())


def test_inverse_and_between(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    unit = np.broadcast_to(group.identity(), x.shape)
    assert_same(group, group.compose(x, group.inverse(x)), unit)
    assert_same(group, group.compose(group.inverse(x), x), unit)
    assert_same(group, group.inverse(group.inverse(x)), x)
    assert_same(group, group.between(x, y), group.compose(group.inverse(x), y))
    assert_same(group, group.compose(x, group.between(x, y)), y)


# -- exp, log and what follows from them --


def test_exp_is_matrix_exponential(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    d = tangents(case, regime, batch, rng)
    assert_close(case.group.matrix(case.group.exp(d)), exponentials(case.group.hat(d)))


@pytest.mark.product(60)
def test_log_inverts_exp(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, d = elements(case, regime, batch, rng), tangents(case, regime, batch, rng)
    assert_same(group, group.exp(group.log(x)), x)
    assert_close(exponentials(group.hat(group.log(x))), group.matrix(x))
    if regime != "exactly -pi" or all(part.stop - part.start == 1 for part in case.rotations):
        # At an angle of pi a rotation vector and its negative are one rotation; only the plane has a rule.
        assert_close(group.log(group.exp(d)), d)
    if regime == "near identity":
        # No digit is lost to wrapping.
        np.testing.assert_allclose(group.log(group.exp(d)), d, rtol=1e-14, atol=0.0)


@pytest.mark.product(60)
def test_retract_is_right_exponential(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, d = elements(case, regime, batch, rng), tangents(case, regime, batch, rng)
    assert_close(group.matrix(group.retract(x, d)), group.matrix(x) @ exponentials(group.hat(d)))
    assert_same(group, group.retract(x, d), group.compose(x, group.exp(d)))
    np.testing.assert_array_equal(group.retract(x, np.zeros(group.dim)), x)


def test_local_inverts_retract(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    d = tangents(case, regime, batch, rng)
    assert_same(group, group.retract(x, group.local(x, y)), y)
    assert_same(group, group.exp(group.local(x, y)), group.between(x, y))
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


def test_adjoint(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    d = tangents(case, regime, batch, rng)
    moved = times(group.adjoint(x), d)
    conjugate = group.matrix(x) @ exponentials(group.hat(d)) @ group.matrix(group.inverse(x))
    assert_close(conjugate, exponentials(group.hat(moved)))
    assert_same(group, group.compose(x, group.exp(d)), group.compose(group.exp(moved), x))
    assert_close(group.adjoint(group.compose(x, y)), group.adjoint(x) @ group.adjoint(y))


def test_small_adjoint(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    a, b = tangents(case, regime, batch, rng), tangents(case, regime, batch, rng)
    bracket = group.hat(a) @ group.hat(b) - group.hat(b) @ group.hat(a)
    assert_close(group.hat(times(group.ad(a), b)), bracket)
    assert_close(group.adjoint(group.exp(a)), exponentials(group.ad(a)))


def phi(generator: Array) -> Array:
    """Return the integral of expm(s G) over s in [0, 1], read off expm([[G, I], [0, 0]])."""
    size = generator.shape[-1]
    block = np.zeros((*generator.shape[:-2], 2 * size, 2 * size))
    block[..., :size, :size] = generator
    block[..., :size, size:] = np.eye(size)
    return exponentials(block)[..., :size, size:]


def test_jacobians_are_integrals_of_the_adjoint(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    d = tangents(case, regime, batch, rng)
    assert_close(group.right_jacobian(d), phi(-group.ad(d)))
    assert_close(group.left_jacobian(d), phi(group.ad(d)))


def test_jacobians_against_differences(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    d = tangents(case, regime, batch, rng)
    x, back = group.exp(d), group.inverse(group.exp(d))
    right, left = [], []
    for axis in STEP * np.eye(group.dim):
        ahead, behind = group.exp(d + axis), group.exp(d - axis)
        right.append((group.local(x, ahead) - group.local(x, behind)) / (2 * STEP))
        after, before = group.log(group.compose(ahead, back)), group.log(group.compose(behind, back))
        left.append((after - before) / (2 * STEP))
    assert_close(group.right_jacobian(d), np.stack(right, axis=-1), DIFFERENCE)
    assert_close(group.left_jacobian(d), np.stack(left, axis=-1), DIFFERENCE)


def test_jacobian_identities(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    d = tangents(case, regime, batch, rng)
    right, left = group.right_jacobian(d), group.left_jacobian(d)
    unit = np.broadcast_to(np.eye(group.dim), right.shape)
    assert_close(group.right_jacobian_inverse(d) @ right, unit)
    assert_close(group.left_jacobian_inverse(d) @ left, unit)
    assert_close(left, group.right_jacobian(-d))
    assert_close(left, group.adjoint(group.exp(d)) @ right)


def test_inverse_jacobian_sign(case: Case, rng: Generator) -> None:
    """An order test cannot see the sign of ad/2; the definition and the series can."""
    group = case.group
    xi, e = 1e-2 * rng.standard_normal((2, 20, group.dim))
    ad = group.ad(xi)
    square = ad @ ad
    series = np.eye(group.dim) + ad / 2 + square / 12 - square @ square / 720  # the next term is ad^6 / 30240
    assert_close(group.right_jacobian_inverse(xi), series, 1e-9)
    assert_close(group.left_jacobian_inverse(xi), series - ad, 1e-9)

    xi = tangents(case, "random", (20,), rng)
    e *= 1e-4
    step = times(group.right_jacobian_inverse(xi), e)
    assert_close(group.local(group.exp(xi), group.exp(xi + step)), e, 1e-10)
    assert_close(group.local(group.exp(xi), group.exp(xi + e)), times(group.right_jacobian(xi), e), 1e-10)
    if case.group in (SE2, SO3, SE3, CASES["product"].group):
        wrong = times(group.left_jacobian_inverse(xi), e)
        assert np.abs(group.local(group.exp(xi), group.exp(xi + wrong)) - e).max() > 1e-7


def test_jacobian_of_log(case: Case, rng: Generator) -> None:
    """Log(X Exp(e)) = Log(X) + Jr^-1(Log X) e: what every relative-pose factor differentiates."""
    group = case.group
    d = 0.9 * tangents(case, "random", (10,), rng)
    x = group.exp(d)
    columns = [
        (group.log(group.retract(x, axis)) - group.log(group.retract(x, -axis))) / (2 * STEP)
        for axis in STEP * np.eye(group.dim)
    ]
    assert_close(group.right_jacobian_inverse(d), np.stack(columns, axis=-1), DIFFERENCE)


# -- actions and randomness --


def test_action(case: Case, batch: Batch, regime: str, rng: Generator) -> None:
    group = case.group
    x, y = elements(case, regime, batch, rng), elements(case, regime, batch, rng)
    points = rng.standard_normal((*batch, group.point_dim))
    assert_close(group.act(group.compose(x, y), points), group.act(x, group.act(y, points)))
    assert_close(group.act(group.identity(), points), points)
    assert_close(group.act(group.inverse(x), group.act(x, points)), points)


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
    right = phi(-SE2.ad(d))
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
