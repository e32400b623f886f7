"""SO(3) and SE(3): accuracy at every angle, the two signs of a quaternion, constructors and their orders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import Generator
from numpy.typing import NDArray

from groups import PI, assert_close, assert_same, integrated
from unifg.errors import UnifgError
from unifg.lie import SE3, SO3
from unifg.lie.se3 import SE3Group
from unifg.lie.so3 import DRIFT, SO3Group
from unifg.typing import Array

Spatial = SO3Group | SE3Group
Long = NDArray[np.longdouble]

SHORT = [0.0, 1e-300, 1e-160, 1e-12, 1e-7, 1e-4, 0.3, 0.4999, 0.5, 0.5001, 1.0, 2.0, PI - 1e-4, PI - 1e-8]
BEYOND = [PI, 4.0, 5.0, 6.0, 2 * PI, 7.0, 20.0]
EXACT = 4e-15  # a few roundings of entries up to about four
GROUPS = pytest.mark.parametrize("group", [SO3, SE3], ids=str)

numbers = st.floats(-10.0, 10.0)


def vectors(length: int) -> st.SearchStrategy[Array]:
    return st.lists(numbers, min_size=length, max_size=length).map(np.array)


def with_angle(group: Spatial, angle: float, rng: Generator, count: int = 40) -> Array:
    """Draw (count, dim) tangent vectors whose rotation has the angle."""
    d = rng.standard_normal((count, group.dim))
    d[:, -3:] *= angle / np.linalg.norm(d[:, -3:], axis=-1, keepdims=True)
    return d


def long_exponential(generator: Array) -> Long:
    """Return expm by its series and squarings, in extended precision: 19 terms of a matrix below 0.01."""
    unit = np.eye(generator.shape[-1], dtype=np.longdouble)
    scaled: Long = generator.astype(np.longdouble) / np.longdouble(2) ** 12
    result: Long = np.broadcast_to(unit, scaled.shape).copy()
    term = result
    for k in range(1, 20):
        term = term @ scaled / np.longdouble(k)
        result = result + term
    for _ in range(12):
        result = result @ result
    return result


# -- accuracy --


@GROUPS
@pytest.mark.parametrize("angle", SHORT + BEYOND)
def test_exponential_and_jacobians(group: Spatial, angle: float, rng: Generator) -> None:
    d = with_angle(group, angle, rng)
    error = np.abs(group.matrix(group.exp(d)) - long_exponential(group.hat(d))).max()
    assert error < EXACT * max(1.0, angle)
    for jacobian, sign in ((group.right_jacobian, -1.0), (group.left_jacobian, 1.0)):
        assert np.abs(jacobian(d) - integrated(sign * group.ad(d), long_exponential)).max() < EXACT


@GROUPS
@pytest.mark.parametrize("angle", [*SHORT, *BEYOND[:4]])
def test_inverse_jacobians(group: Spatial, angle: float, rng: Generator) -> None:
    d = with_angle(group, angle, rng)
    unit = np.eye(group.dim)
    for inverse, sign in ((group.right_jacobian_inverse, -1.0), (group.left_jacobian_inverse, 1.0)):
        jacobian = integrated(sign * group.ad(d), long_exponential)
        size = np.abs(inverse(d)).max()
        assert np.abs(inverse(d) @ jacobian - unit).max() < EXACT * size
        assert np.abs(jacobian @ inverse(d) - unit).max() < EXACT * size


@GROUPS
@pytest.mark.parametrize("angle", SHORT)
def test_logarithm(group: Spatial, angle: float, rng: Generator) -> None:
    d = with_angle(group, angle, rng)
    back = group.log(group.exp(d))
    np.testing.assert_allclose(back, d, rtol=0, atol=EXACT)
    np.testing.assert_allclose(back[:, -3:], d[:, -3:], rtol=0, atol=EXACT * angle)
    x = group.random(rng, (40,))
    assert np.abs(group.local(x, group.retract(x, d)) - d).max() < 5 * EXACT


@GROUPS
@pytest.mark.parametrize("angle", BEYOND)
def test_the_short_way_round(group: Spatial, angle: float, rng: Generator) -> None:
    d = with_angle(group, angle, rng)
    back = group.log(group.exp(d))
    short = abs(angle - 2 * PI * np.rint(angle / (2 * PI)))
    np.testing.assert_allclose(np.linalg.norm(back[:, -3:], axis=-1), short, rtol=0, atol=EXACT * angle)
    assert np.linalg.norm(back[:, -3:], axis=-1).max() <= PI * (1 + 1e-15)
    assert_close(group.matrix(group.exp(back)), group.matrix(group.exp(d)), 1e-13)


@pytest.mark.product(1, of="studies")
@given(vectors(6), vectors(6))
def test_retract_and_local_anywhere(start: Array, d: Array) -> None:
    x = SE3.exp(start)
    y = SE3.retract(x, d)
    assert SE3.is_valid(y)
    assert_same(SE3, SE3.retract(x, SE3.local(x, y)), y)
    if np.linalg.norm(d[3:]) < PI - 1e-6:
        assert_close(SE3.local(x, y), d, 1e-12)


# -- two quaternions, one rotation --


def test_both_signs_are_one_rotation(rng: Generator) -> None:
    x, y = SE3.random(rng, (20,)), SE3.random(rng, (20,))
    d, points = rng.standard_normal((20, 6)), rng.standard_normal((20, 3))
    flipped = x * ([1.0] * 3 + [-1.0] * 4)
    assert SE3.is_valid(flipped).all()
    for operation, other in ((SE3.compose, y), (SE3.between, y), (SE3.retract, d), (SE3.local, y), (SE3.act, points)):
        np.testing.assert_array_equal(operation(flipped, other), operation(x, other))
    np.testing.assert_array_equal(SE3.local(y, flipped), SE3.local(y, x))
    for unary in (SE3.log, SE3.inverse, SE3.matrix, SE3.adjoint):
        np.testing.assert_array_equal(unary(flipped), unary(x))
    np.testing.assert_array_equal(SO3.log(-x[:, 3:]), SO3.log(x[:, 3:]))
    np.testing.assert_allclose(SO3.local(x[:, 3:], -x[:, 3:]), 0.0, atol=1e-15)


@GROUPS
def test_results_have_unit_norm_and_positive_scalar(group: Spatial, rng: Generator) -> None:
    x, y = group.random(rng, (500,)), group.random(rng, (500,))
    d = 4.0 * rng.standard_normal((500, group.dim))
    for result in (x, group.exp(d), group.compose(x, y), group.between(x, y), group.inverse(x), group.retract(x, d)):
        q = result[:, -4:]
        assert np.abs(np.linalg.norm(q, axis=-1) - 1).max() < DRIFT
        assert (q[:, 0] >= 0).all()


def test_long_products_stay_on_the_group(rng: Generator) -> None:
    x, step = SE3.random(rng), 0.1 * rng.standard_normal(6)
    for _ in range(3000):
        x = SE3.retract(x, step)
    assert abs(np.linalg.norm(x[3:]) - 1) < DRIFT


def test_is_valid_wants_unit_norm() -> None:
    x = np.array([[1, 0, 0, 0], [-1, 0, 0, 0], [1 + 1e-8, 0, 0, 0], [0, 0, 0, 0], [1 + 1e-10, 0, 0, 0]])
    np.testing.assert_array_equal(SO3.is_valid(x), [True, True, False, False, True])
    poses = SE3.from_parts([0.0, np.inf, 0.0], x)
    assert not SE3.is_valid(poses).any()


def test_random_rotations_are_uniform(rng: Generator) -> None:
    """A rotated axis is uniform on the sphere, and the angle has density (1 - cos) / pi, of mean pi/2 + 2/pi."""
    x = SO3.random(rng, (20000,))
    rotated = SO3.act(x, [0.0, 0.0, 1.0])
    assert np.abs(rotated.mean(axis=0)).max() < 0.02
    assert np.abs((rotated**2).mean(axis=0) - 1 / 3).max() < 0.01
    assert abs(np.linalg.norm(SO3.log(x), axis=-1).mean() - (PI / 2 + 2 / PI)) < 0.02


# -- constructors --


def test_quaternion_orders() -> None:
    h = np.sqrt(0.5)
    quarter = SO3.exp([0.0, 0.0, PI / 2])  # about z: x goes to y
    np.testing.assert_allclose(quarter, [h, 0, 0, h], atol=1e-15)
    np.testing.assert_allclose(SO3.act(quarter, [1.0, 0.0, 0.0]), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(SO3.from_quaternion([2, 0, 0, 2], order="wxyz"), [h, 0, 0, h], atol=1e-15)
    np.testing.assert_allclose(SO3.from_quaternion([0, 0, -2, -2], order="xyzw"), [h, 0, 0, h], atol=1e-15)
    np.testing.assert_allclose(SO3.to_quaternion(-quarter, order="xyzw"), [0, 0, h, h], atol=1e-15)
    np.testing.assert_allclose(SO3.to_quaternion(-quarter, order="wxyz"), [h, 0, 0, h], atol=1e-15)


def test_roll_pitch_yaw_by_hand() -> None:
    np.testing.assert_allclose(SO3.matrix(SO3.from_rpy(PI / 2, 0, 0)), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(SO3.matrix(SO3.from_rpy(0, PI / 2, 0)), [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(SO3.matrix(SO3.from_rpy(0, 0, PI / 2)), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    # The rightmost turn, roll, comes first: y goes to z, which pitch takes to x.
    np.testing.assert_allclose(SO3.act(SO3.from_rpy(PI / 2, PI / 2, 0), [0.0, 1.0, 0.0]), [1, 0, 0], atol=1e-15)
    assert SO3.from_rpy(np.zeros((4, 1)), 0.1, np.zeros(3)).shape == (4, 3, 4)


@given(st.floats(-4, 4), st.sampled_from([0.0, 1e-9, 1e-5, 0.3, 1.5]), st.floats(-4, 4), st.sampled_from([-1.0, 1.0]))
def test_roll_pitch_yaw_up_to_the_pole(roll: float, below: float, yaw: float, side: float) -> None:
    pitch = side * (PI / 2 - below)
    x = SO3.from_rpy(roll, pitch, yaw)
    back = SO3.to_rpy(x)
    assert abs(back[1] - pitch) < 1e-15
    assert_same(SO3, SO3.from_rpy(*back), x)
    if below >= 1e-5:
        turn = np.array([back[0] - roll, back[2] - yaw]) / (2 * PI)
        np.testing.assert_allclose(turn, np.rint(turn), rtol=0, atol=1e-15 / below)


def test_rotation_matrices_come_back(rng: Generator) -> None:
    """All four branches of the quaternion of a matrix, and the borders between them."""
    half_turns = np.array(
        [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, 0.8, 0], [0.5, 0.5, 0.5, 0.5], [1, 0, 0, 0]]
    )
    x = np.concatenate([SO3.random(rng, (200,)), SO3.from_quaternion(half_turns, order="wxyz")])
    back = SO3.from_matrix(SO3.matrix(x))
    assert_close(SO3.matrix(back), SO3.matrix(x), 2e-15)
    pose = SE3.random(rng, (2, 5))
    assert_close(SE3.from_matrix(SE3.to_matrix(pose)), pose)


def test_nearest_rotation(rng: Generator) -> None:
    m = rng.standard_normal((30, 3, 3))  # half of them reflect
    rotation = SO3.matrix(SO3.from_matrix(m))
    assert_close(np.linalg.det(rotation), np.ones(30))
    distance = np.linalg.norm(m - rotation, axis=(-2, -1))
    for _ in range(200):
        near = SO3.matrix(SO3.retract(SO3.from_matrix(m), rng.choice([1e-3, 1.0]) * rng.standard_normal((30, 3))))
        assert np.all(np.linalg.norm(m - near, axis=(-2, -1)) >= distance - 1e-12)
    scaled = SO3.from_matrix(1e-200 * rotation)
    assert_close(SO3.matrix(scaled), rotation, 1e-14)


REFUSED: dict[str, Callable[[], object]] = {
    r"quaternion \(1,\) \[0. 0. 0. 0.\] names no rotation": lambda: SO3.from_quaternion(
        [[1, 0, 0, 0], [0, 0, 0, 0]], order="wxyz"
    ),
    "names no rotation": lambda: SO3.from_quaternion([np.nan, 0, 0, 1], order="xyzw"),
    r"matrix \(0, 2\) has singular values .* no single nearest": lambda: SO3.from_matrix(
        np.array([[np.eye(3), np.eye(3), np.zeros((3, 3))]])
    ),
    # every half turn about a level axis is as near
    "no single nearest": lambda: SO3.from_matrix(np.diag([1.0, 1.0, -1.0])),
    "not finite": lambda: SO3.from_matrix(np.full((3, 3), np.nan)),
    r"takes \(..., 3, 3\) matrices; got shape \(4, 4\)": lambda: SO3.from_matrix(np.eye(4)),
    r"\[0.0, 0.0, 0.0, 2.0\]: it must be 0, 0, 0, 1": lambda: SE3.from_matrix(2.0 * np.eye(4)),
    r"takes \(..., 4, 4\) matrices": lambda: SE3.from_matrix(np.eye(3)),
    r"joins \(..., 3\) and \(..., 4\) arrays; got shapes \(2,\) and \(4,\)": lambda: SE3.from_parts(
        [0.0, 0.0], SO3.identity()
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refusals(message: str) -> None:
    with pytest.raises(UnifgError, match=message):
        REFUSED[message]()


def test_poses_by_hand() -> None:
    quarter = SO3.from_rpy(0.0, 0.0, PI / 2)
    pose = SE3.from_parts([1.0, 2.0, 3.0], quarter)
    np.testing.assert_allclose(SE3.act(pose, [[1, 0, 0], [0, 0, 1]]), [[1, 3, 3], [1, 2, 4]], atol=1e-15)
    np.testing.assert_array_equal(SE3.position(pose), [1, 2, 3])
    np.testing.assert_array_equal(SE3.rotation(pose), quarter)
    # A quarter turn about z along an arc of radius 1, rising by 5: a screw.
    screw = SE3.exp([PI / 2, 0, 5, 0, 0, PI / 2])
    np.testing.assert_allclose(screw, [1, 1, 5, *quarter], atol=1e-15)
    np.testing.assert_allclose(SE3.log(screw), [PI / 2, 0, 5, 0, 0, PI / 2], atol=1e-15)
    assert SE3.from_parts(np.zeros((4, 1, 3)), SO3.random(np.random.default_rng(0), (2,))).shape == (4, 2, 7)
