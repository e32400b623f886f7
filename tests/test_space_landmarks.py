"""Bearing and range in space: against GTSAM, at the places where charts break, mounted sensors, estimation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator

import unifg as fg
from problems.graphs import graph_with
from unifg.lie import SE3, SE23, SO3
from unifg.models.quadrotor import STATE
from unifg.models.space_landmarks import bearing_3d, bearing_range_3d, observe_3d
from unifg.solvers import InteriorPoint, LevenbergMarquardt
from unifg.typing import Array

MOUNT = SE3.from_parts([0.3, -0.2, 0.1], SO3.from_rpy(0.4, -1.2, 2.0))


def unit(rng: Generator, count: int) -> Array:
    x = rng.standard_normal((count, 3))
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))


def test_gtsam_agrees(rng: Generator) -> None:
    gtsam = pytest.importorskip("gtsam")
    x, marks, z = SE3.random(rng, (20,)), 5.0 * rng.standard_normal((20, 3)), unit(rng, 20)
    ranges = rng.uniform(1.0, 9.0, 20)
    r = bearing_range_3d()(x, marks, np.column_stack([z, ranges]))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.3]))
    for k in range(20):
        factor = gtsam.BearingRangeFactor3D(1, 2, gtsam.Unit3(z[k]), ranges[k], noise)
        values = gtsam.Values()
        values.insert(1, gtsam.Pose3(gtsam.Rot3(SO3.matrix(x[k, 3:])), x[k, :3]))
        values.insert(2, marks[k])
        np.testing.assert_allclose(0.5 * np.sum((r[k] / [0.1, 0.1, 0.3]) ** 2), factor.error(values), rtol=1e-9)


def test_the_length_of_the_residual_is_the_angle(rng: Generator) -> None:
    """For every angle from nothing to half a turn, at every direction, the poles of Duff's axes among them."""
    towards = np.concatenate([unit(rng, 40), np.eye(3), -np.eye(3), [[1e-9, 0.0, -1.0], [1e-9, 0.0, 1.0]]])
    x = np.tile(SE3.identity(), (len(towards), 1))
    for angle in (0.0, 1e-12, 1e-7, 1e-3, 0.5, np.pi / 2, 3.0, np.pi - 1e-6, np.pi - 1e-9, np.pi):
        axis = np.cross(towards, unit(rng, len(towards)))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        seen = 7.0 * SO3.act(SO3.exp(angle * axis), towards)
        r = bearing_3d()(x, seen, towards)
        np.testing.assert_allclose(np.linalg.norm(r, axis=1), angle, atol=3e-12)
        scaled = bearing_3d()(x, 2.0 * seen, 3.0 * towards)  # lengths do not matter
        np.testing.assert_allclose(np.linalg.norm(scaled, axis=1), angle, atol=3e-12)


def test_derivatives_are_finite_everywhere_but_at_zero_range(rng: Generator) -> None:
    towards = unit(rng, 12)
    x, far = np.tile(SE3.identity(), (12, 1)), 4.0 * towards
    for seen in (far, -far, far + 1e-9, -far + 1e-9):
        case = bearing_3d()
        assert case.jacobian is not None
        blocks = case.jacobian(x, seen, towards)
        assert all(np.isfinite(block).all() for block in blocks)
        if seen is far:  # at the measured direction: the plane itself, per metre of distance
            np.testing.assert_allclose(np.linalg.norm(blocks[1] @ towards[:, :, None], axis=1), 0.0, atol=1e-15)
            for block in blocks[1]:
                np.testing.assert_allclose(block @ block.T, np.eye(2) / 16.0, atol=1e-14)
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(
            bearing_range_3d()(x, np.zeros((12, 3)), np.column_stack([towards, towards[:, 0]]))
        ).all()


def test_a_mounted_sensor_sees_from_where_it_stands(rng: Generator) -> None:
    """The same as a sensor at world_T_body body_T_sensor; of every state that has a pose."""
    x, marks = SE3.random(rng, (10,)), 4.0 * rng.standard_normal((10, 3))
    z = np.column_stack([unit(rng, 10), rng.uniform(1.0, 5.0, 10)])
    mounted = bearing_range_3d(SE3, MOUNT)(x, marks, z)
    np.testing.assert_allclose(mounted, bearing_range_3d()(SE3.compose(x, MOUNT), marks, z), atol=1e-13)
    velocity = rng.standard_normal((10, 3))
    twist = fg.Product(velocity=fg.Rn(6), pose=SE3)
    for manifold, same in (
        (SE23, SE23.from_parts(x[:, :3], velocity, x[:, 3:])),
        (STATE, STATE.pack(p=x[:, :3], R=x[:, 3:], v=velocity)),
        (twist, twist.pack(velocity=np.zeros(6), pose=x)),
    ):
        np.testing.assert_allclose(bearing_range_3d(manifold, MOUNT)(same, marks, z), mounted, atol=1e-14)
        np.testing.assert_allclose(
            observe_3d(same[0], marks, manifold, MOUNT), observe_3d(x[0], marks, SE3, MOUNT), atol=1e-14
        )


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_what_is_observed_leaves_nothing(far: float, rng: Generator) -> None:
    x, marks = SE3.random(rng, (6,)), 4.0 * rng.standard_normal((6, 3)) + [far, -far, far]
    x[:, :3] += [far, -far, far]
    for k in range(6):
        z = observe_3d(x[k], marks, SE3, MOUNT)
        np.testing.assert_allclose(np.linalg.norm(z[:, :3], axis=1), 1.0, atol=1e-15)
        np.testing.assert_allclose(bearing_range_3d(SE3, MOUNT)(x[k : k + 1], marks, z), 0.0, atol=1e-14)
    assert observe_3d(x[0], np.empty((0, 3))).shape == (0, 4)


def test_a_residual_is_derived_once() -> None:
    assert bearing_3d().kernel is bearing_3d().kernel


@pytest.mark.parametrize("data", [False, True], ids=["constant", "data"])
@pytest.mark.parametrize("solver", [LevenbergMarquardt, InteriorPoint])
def test_a_direction_without_length_is_refused(
    solver: type[LevenbergMarquardt] | type[InteriorPoint], data: bool, rng: Generator
) -> None:
    """It led to a pose that nothing had measured; where it is inactive, as an empty slot, it does not matter."""
    marks = 4.0 * rng.standard_normal((4, 3))
    z = observe_3d(SE3.identity(), marks)
    z[3, :3] = 0.0
    for active in (None, np.arange(4) < 3):
        graph, x = graph_with(SE3)
        given = graph.data("z", z, each=True) if data else z
        graph.minimize(bearing_range_3d(), x[[0] * 4], marks, given, sigma=0.1, active=active, name="seen")
        start = {x: SE3.exp(np.full(6, 0.1))[None]}
        if active is None:
            with pytest.raises(fg.GraphError, match="'seen': the residual of factor 3 is not finite"):
                solver().solve(graph, start)
        else:
            found = solver().solve(graph, start, check=True)
            assert np.abs(SE3.local(SE3.identity(), found[x][0])).max() < 1e-6
