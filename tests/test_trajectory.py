"""Trajectories in continuous time against numerical differentiation, and what graphs find of them on a long run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.errors import ModelError
from unifg.models.trajectory import CubicTrajectory
from unifg.solvers import GaussNewton
from unifg.typing import Array

GROUPS = [fg.SE2, fg.SE3, fg.SO3, fg.SE23, fg.Rn(2)]


def controls(group: Any, rng: np.random.Generator, count: int = 9) -> Array:
    """A walk of control poses, less than half a turn apart."""
    poses = [group.random(rng)]
    for _ in range(count - 1):
        poses.append(group.retract(poses[-1], 0.6 * rng.uniform(-1.0, 1.0, group.dim)))
    return np.array(poses)


@pytest.mark.parametrize("group", GROUPS, ids=lambda g: g.name)
def test_rates_are_derivatives(group: Any, rng: np.random.Generator) -> None:
    """Within intervals and across knots; pose, velocity and acceleration are continuous there."""
    curve, poses, h = CubicTrajectory(group, start=-2.0, spacing=0.4), controls(group, rng), 1e-4
    times = np.concatenate([rng.uniform(-1.99, 0.39, 20), curve.knots(9)[2:-2]])
    by_pose = group.local(curve.at(poses, times - h), curve.at(poses, times + h)) / (2.0 * h)
    np.testing.assert_allclose(curve.velocity_at(poses, times), by_pose, rtol=0.0, atol=2e-5)
    slope = (curve.velocity_at(poses, times + h) - curve.velocity_at(poses, times - h)) / (2.0 * h)
    np.testing.assert_allclose(curve.acceleration_at(poses, times[:20]), slope[:20], rtol=0.0, atol=2e-4)
    knots, near = curve.knots(9)[2:-2], 1e-10
    before, after = curve.acceleration_at(poses, knots - near), curve.acceleration_at(poses, knots + near)
    np.testing.assert_allclose(before, after, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("group", GROUPS, ids=lambda g: g.name)
def test_the_world_may_be_moved_and_constant_velocities_stay(group: Any, rng: np.random.Generator) -> None:
    curve, poses, moved = CubicTrajectory(group, spacing=0.2), controls(group, rng), group.random(rng)
    times = np.linspace(0.0, 1.2, 31)
    there = group.compose(moved, curve.at(poses, times))
    assert np.abs(group.local(there, curve.at(group.compose(moved, poses), times))).max() < 1e-11
    velocity = rng.uniform(-1.0, 1.0, group.dim)
    steady = group.compose(moved, group.exp(curve.knots(9)[:, None] * velocity))
    expected = group.compose(moved, group.exp(times[:, None] * velocity))
    assert np.abs(group.local(expected, curve.at(steady, times))).max() < 1e-12
    np.testing.assert_allclose(curve.velocity_at(steady, times), np.tile(velocity, (31, 1)), atol=1e-11)
    assert np.abs(curve.acceleration_at(steady, times)).max() < 1e-9


def test_its_functions_are_traced_and_their_derivatives_exact(rng: np.random.Generator) -> None:
    curve, poses = CubicTrajectory(fg.SE2, spacing=0.5), controls(fg.SE2, rng, 6)
    for function in (curve.pose, curve.velocity, curve.acceleration):
        graph, x = graph_with(fg.SE2, 6)
        graph.minimize(function, *curve.places([0.1, 0.7, 1.4], 6).of(x), sigma=1.0)
        program = graph.compile()
        assert not program.left_to_python
        lin, h = program.linearize(program.values_from({x: poses})), 1e-6
        for k in range(program.size):
            step = h * np.eye(program.size)[k]
            ahead, behind = (program.linearize(program.retract(lin.values, s * step)).cost for s in (1.0, -1.0))
            assert abs((ahead - behind) / (2.0 * h) - lin.gradient[k]) < 1e-6 * (1.0 + abs(lin.gradient[k]))


def test_residuals_may_ask_it_for_its_functions() -> None:
    curve = CubicTrajectory(fg.SE2, spacing=0.5)
    graph, x = graph_with(fg.SE2, 6)
    seen = curve.places([0.1, 0.7, 1.4], 6).of(x)
    graph.minimize(lambda a, b, c, d, u: curve.pose(a, b, c, d, u), *seen, sigma=1.0, name="pose")
    graph.minimize(lambda a, b, c, d, u: curve.velocity(a, b, c, d, u), *seen, sigma=1.0, name="velocity")
    assert not graph.compile().left_to_python


def test_brackets_of_rotations_are_cross_products(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 3))
    np.testing.assert_allclose(
        np.einsum("ijk,i,j->k", np.swapaxes(fg.SO3.ad(np.eye(3)), 1, 2), a, b), np.cross(a, b), atol=1e-15
    )
    for group in (fg.SE3, fg.SE23, fg.SE2):
        found = np.swapaxes(group.ad(np.eye(group.dim)), 1, 2)
        np.testing.assert_array_equal(found, -np.swapaxes(found, 0, 1))
        jacobi = np.einsum("ijm,mkl->ijkl", found, found)
        total = jacobi + np.einsum("jkil->ijkl", jacobi) + np.einsum("kijl->ijkl", jacobi)
        assert np.abs(total).max() == 0.0


@pytest.mark.parametrize("start", [0.0, 1.7e9, 1690000000.123])
@pytest.mark.parametrize("spacing", [0.01, 0.1, 0.3])
def test_whole_numbers_of_spacings_need_no_pose_more(start: float, spacing: float) -> None:
    """One more would be held by nothing, as seconds since 1970 are rounded to 0.2 us."""
    curve = CubicTrajectory(fg.SE2, start, spacing)
    for count in range(1, 200):
        end = start + count * spacing
        assert curve.controls(end) == count + 3
        assert curve.places([start, end], count + 3).first.tolist() == [0, count - 1]
    with pytest.raises(ModelError, match=f"is outside of {start:.12g} .. {start + spacing:.12g} s"):
        curve.places([start + 1.01 * spacing], 4)


def test_places_and_counts_of_controls() -> None:
    curve = CubicTrajectory(fg.SE2, start=5.0, spacing=0.5)
    assert [curve.controls(end) for end in (5.0, 5.5, 5.6, 8.0)] == [4, 4, 5, 9]
    first, fraction = curve.places([5.0, 5.49, 5.5, 8.0], 9)
    assert first.tolist() == [0, 0, 1, 5]
    np.testing.assert_allclose(fraction, [0.0, 0.98, 0.0, 1.0], atol=1e-9)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda curve: curve.places([6.0, 4.9], 9), "number 1"),
        (lambda curve: curve.places([8.1], 9), "outside of 5 .. 8 s"),
        (lambda curve: curve.places([np.nan], 9), "outside"),
        (lambda curve: curve.places([5.0], 3), "hold no moment"),
        (lambda curve: curve.at(np.zeros((9, 3)), [[5.1], [5.2], [5.3]]), r"moments are \(n,\), found \(3, 1\)"),
        (lambda curve: curve.controls(np.inf), "must be finite"),
        (lambda curve: curve.controls(np.nan), "must be finite"),
    ],
)
def test_moments_outside_are_refused(ask: Any, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        ask(CubicTrajectory(fg.SE2, start=5.0, spacing=0.5))


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.inf, np.nan])
def test_a_spacing_is_positive_and_finite(spacing: float) -> None:
    with pytest.raises(ModelError, match="spacing"):
        CubicTrajectory(fg.SE2, spacing=spacing)


def test_a_long_run_is_found_from_sensors_that_know_no_nodes(rng: np.random.Generator) -> None:
    """A minute of flight: gyro at 50 Hz, positions at 7 Hz, poses now and then, none of them at a knot."""
    curve, end = CubicTrajectory(fg.SE3, spacing=0.5), 60.0
    count = curve.controls(end)
    t = curve.knots(count)
    place = np.stack([8.0 * np.sin(0.3 * t), 5.0 * np.sin(0.5 * t + 1.0), 2.0 + np.cos(0.2 * t)], axis=1)
    turn = fg.SO3.exp(np.stack([0.3 * np.sin(0.7 * t), 0.2 * np.cos(0.9 * t), 0.5 * np.sin(0.25 * t)], axis=1))
    truth = np.concatenate([place, turn], axis=1)
    sampled, fixes, seen = np.arange(0.011, end, 0.02), np.arange(0.05, end, 1.0 / 7.0), np.arange(0.3, end, 5.0)
    gyro = curve.velocity_at(truth, sampled)[:, 3:] + 0.01 * rng.standard_normal((len(sampled), 3))
    positions = curve.at(truth, fixes)[:, :3] + 0.05 * rng.standard_normal((len(fixes), 3))
    poses = fg.SE3.retract(curve.at(truth, seen), 0.01 * rng.standard_normal((len(seen), 6)))
    graph, pose, velocity = fg.Graph(), curve.pose, curve.velocity
    x = graph.variables("x", fg.SE3, count)
    graph.minimize(
        lambda a, b, c, d, u, z: velocity(a, b, c, d, u)[:, 3:] - z,
        *curve.places(sampled, count).of(x), graph.data("gyro", gyro, each=True), sigma=0.01,
    )  # fmt: skip
    graph.minimize(
        lambda a, b, c, d, u, z: pose(a, b, c, d, u)[:, :3] - z,
        *curve.places(fixes, count).of(x), graph.data("fixes", positions, each=True), sigma=0.05,
    )  # fmt: skip
    graph.minimize(
        lambda a, b, c, d, u, z: fg.SE3.local(z, pose(a, b, c, d, u)),
        *curve.places(seen, count).of(x), graph.data("poses", poses, each=True), sigma=0.01,
    )  # fmt: skip
    start = np.tile(fg.SE3.identity(), (count, 1))
    start[:, :3] = np.stack([np.interp(t, fixes, positions[:, k]) for k in range(3)], axis=1)
    solution = GaussNewton().solve(graph, {x: start}, check=True)
    assert not graph.compile().left_to_python
    found, times = solution[x], np.linspace(0.1, end - 0.1, 500)
    error = fg.SE3.local(curve.at(truth, times), curve.at(found, times))
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 0.03
    assert np.sqrt(np.mean(error[:, 3:] ** 2)) < 0.008
    rate = curve.velocity_at(found, times) - curve.velocity_at(truth, times)
    assert np.sqrt(np.mean(rate[:, 3:] ** 2)) < 0.01
    assert np.sqrt(np.mean(rate[:, :3] ** 2)) < 0.15
