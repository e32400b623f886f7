"""The interpolated signed distance: where it vanishes, what its slope is, what happens outside."""

from __future__ import annotations

import math
from time import thread_time

import numpy as np
import pytest

from unifg.errors import ModelError
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.typing import Array

ORIGIN = (1.5, -2.0, 0.6)


def blocks(seed: int = 0) -> DistanceMap:
    occupied = np.random.default_rng(seed).random((40, 60)) < 0.05
    return DistanceMap.from_occupancy(occupied, 0.05, ORIGIN)


def world(grid: Array, resolution: float = 0.05, origin: tuple[float, float, float] = ORIGIN) -> Array:
    c, s = math.cos(origin[2]), math.sin(origin[2])
    return np.asarray(resolution * grid @ np.array([[c, s], [-s, c]]) + origin[:2])


@pytest.mark.parametrize("yaw", [0.0, 0.6, -2.5])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("face", "side"), [(12.0, -1.0), (20.0, 1.0)])
def test_a_straight_wall_is_zero_at_its_face_and_exact_beside_it(
    face: float, side: float, yaw: float, axis: int
) -> None:
    occupied = np.zeros((30, 30), dtype=bool)
    occupied[(slice(None), slice(12, 20)) if axis == 0 else (slice(12, 20), slice(None))] = True
    origin = (0.3, 0.7, yaw)
    field = DistanceMap.from_occupancy(occupied, 0.05, origin)
    for offset in (0.0, 0.2, 0.5, 1.3, 4.0, -0.3, -1.7):
        grid = np.empty((21, 2))
        grid[:, axis], grid[:, 1 - axis] = face + side * offset, np.linspace(1.0, 29.0, 21)
        distance, gradient = field.distance_and_gradient(world(grid, 0.05, origin))
        assert np.abs(distance - 0.05 * offset).max() < 1e-12
        normal = np.zeros(2)
        normal[axis] = side
        expected = world(normal, 1.0, (0.0, 0.0, yaw))
        if offset not in (0.5,):  # the kink between two squares belongs to either
            assert np.allclose(gradient, expected, atol=1e-9)


def test_the_values_at_cell_centres_are_the_grid() -> None:
    field = blocks()
    rows, columns = np.indices(field.values.shape)
    centres = world(np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2))
    assert np.allclose(field.distance(centres), field.values.ravel(), atol=1e-12)


def test_the_signed_distance_agrees_with_brute_force() -> None:
    occupied = np.random.default_rng(3).random((15, 17)) < 0.2
    field = DistanceMap.from_occupancy(occupied, 0.1, (0.0, 0.0, 0.0))
    cells = np.argwhere(np.ones_like(occupied))
    apart = np.hypot(*(cells[:, None] - cells[None]).transpose(2, 0, 1))
    mask = occupied.ravel()
    outside, inside = apart[:, mask].min(axis=1) - 0.5, 0.5 - apart[:, ~mask].min(axis=1)
    assert np.allclose(field.values.ravel(), 0.1 * np.where(mask, inside, outside))


def test_the_gradient_is_the_derivative_of_the_interpolant() -> None:
    field = blocks(1)
    grid = np.random.default_rng(2).uniform(-5.0, 65.0, size=(4000, 2))
    fraction = (grid - 0.5) % 1.0
    grid = grid[np.all((fraction > 0.01) & (fraction < 0.99), axis=1)]  # away from the kinks
    points = world(grid)
    distance, gradient = field.distance_and_gradient(points)
    assert np.array_equal(distance, field.distance(points))
    step = 1e-6
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = step
        slope = (field.distance(points + shift) - field.distance(points - shift)) / (2.0 * step)
        assert np.abs(slope - gradient[:, axis]).max() < 1e-7
    assert np.abs(gradient).max() > 0.5


def test_outside_the_border_holds_and_the_slope_across_it_vanishes() -> None:
    field = DistanceMap(np.random.default_rng(4).random((5, 6)), 0.05, (1.0, 2.0, 0.0))
    beside = np.array([[1.0 - 3.0, 2.09], [1.3 + 3.0, 2.09], [1.12, 2.0 - 3.0], [1.12, 2.25 + 3.0]])
    inside = np.array([[1.025, 2.09], [1.275, 2.09], [1.12, 2.025], [1.12, 2.225]])
    distance, gradient = field.distance_and_gradient(beside)
    assert np.allclose(distance, field.distance(inside), atol=1e-12)
    assert np.abs(gradient[:2, 0]).max() < 1e-9
    assert np.abs(gradient[2:, 1]).max() < 1e-9
    assert np.abs(gradient[:2, 1]).min() > 1e-3
    corner = field.distance(np.array([[-50.0, -50.0], [50.0, 50.0]]))
    assert np.allclose(corner, [field.values[0, 0], field.values[-1, -1]])


def test_cap_empty_full_and_tiny_grids() -> None:
    occupied = np.zeros((20, 30), dtype=bool)
    far = DistanceMap.from_occupancy(occupied, 0.1, (0.0, 0.0, 0.0))
    assert np.allclose(far.values, 0.1 * math.hypot(20, 30))
    assert np.allclose(DistanceMap.from_occupancy(occupied, 0.1, (0, 0, 0), cap=2.0).values, 2.0)
    assert np.all(DistanceMap.from_occupancy(~occupied, 0.1, (0, 0, 0), cap=2.0).values == -2.0)
    occupied[0, 0] = True
    assert DistanceMap.from_occupancy(occupied, 0.1, (0, 0, 0), cap=0.5).values.max() == 0.5
    single = DistanceMap(np.array([[0.7]]), 0.1, (0.0, 0.0, 0.0))
    assert np.allclose(single.distance(np.array([[3.0, -4.0], [0.05, 0.05]])), 0.7)


def test_nan_in_gives_nan_out_and_batches_keep_their_shape() -> None:
    field = blocks()
    points = world(np.full((2, 3, 2), 20.2))
    points[1, 2] = math.nan
    distance, gradient = field.distance_and_gradient(points)
    assert distance.shape == (2, 3)
    assert gradient.shape == (2, 3, 2)
    assert np.isnan(distance[1, 2])
    assert np.isfinite(distance[0]).all()
    assert field.distance_and_gradient(np.zeros((0, 2)))[1].shape == (0, 2)


@pytest.mark.parametrize("shape", [(4, 3), (4, 1), (3,)])
def test_poses_are_no_points(shape: tuple[int, ...]) -> None:
    """Four poses are as many numbers as six points: the look-up would write past the end of its results."""
    for field in (blocks(), SmoothField(blocks())):
        with pytest.raises(ModelError, match=r"points are \(\.\.\., 2\) arrays, found shape"):
            field.distance(np.zeros(shape))


def test_a_scan_is_cheap() -> None:
    field = blocks()
    points = world(np.random.default_rng(0).uniform(0.0, 40.0, size=(360, 2)))
    spent = []
    for _ in range(300):
        begin = thread_time()
        field.distance_and_gradient(points)
        spent.append(thread_time() - begin)
    assert min(spent) < 200e-6  # about 25 us on an idle machine; the margin is for busy ones
