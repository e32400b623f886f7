"""Bundle adjustment: the file format, triangulation, and maps up to place and scale."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import null_space

import unifg as fg
from judge import judge
from unifg.files.bal import read_bal, write_bal
from unifg.models.bundle_adjustment import BundleAdjustment, project, triangulate
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array


def scene(cameras: int = 8, size: int = 60, noise: float = 0.5, seed: int = 0) -> BundleAdjustment:
    """Cameras around points, 9 m away, that see most of them."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(size, 3))
    turn, zero = np.linspace(-2.0, 2.0, cameras), np.zeros(cameras)
    moved = np.column_stack([zero, np.cos(3.0 * turn), zero - 9.0])
    poses = np.column_stack([moved, np.cos(turn / 2), zero, -np.sin(turn / 2), zero])
    intrinsics = np.tile([800.0, -0.05, 0.01], (cameras, 1))
    camera, point = np.nonzero(rng.random((cameras, size)) < 0.7)
    pixels = project(poses[camera], intrinsics[camera], points[point])
    return BundleAdjustment(camera, point, pixels + rng.normal(0.0, noise, pixels.shape), poses, intrinsics, points)


def test_the_camera_looks_along_its_negative_axis() -> None:
    """Up and right of the axis is up and right of the centre of the image; Snavely's distortion."""
    pose, point = fg.SE3.identity()[None], np.array([[0.2, 0.1, -1.0]])
    found = project(pose, np.array([[100.0, 0.1, 0.01]]), point)
    squared = 0.05
    np.testing.assert_allclose(found, 100.0 * (1 + 0.1 * squared + 0.01 * squared**2) * np.array([[0.2, 0.1]]))


@pytest.mark.parametrize("sigma", [1e-5, 1e5])
def test_the_size_of_pixel_noise_changes_nothing_but_covariances(sigma: float) -> None:
    """The scale is kept in proportion to it: it neither drowns the pixels nor adds to what is uncertain."""
    problem, found = scene(), []
    for deviation in (1.0, sigma):
        graph, guess = problem.graph(sigma=deviation, calibrated=True)
        solution = LevenbergMarquardt().solve(graph, guess, check=True)
        points = graph.families["points"]
        found.append((solution[points], solution.covariance(points[:2]) / deviation**2))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=1e-3, atol=1e-3 * np.abs(found[0][1]).max())


@pytest.mark.parametrize("name", ["tower.txt", "tower.txt.gz"])
def test_a_file_holds_the_same_numbers(tmp_path: Path, name: str) -> None:
    problem = scene()
    again = read_bal(write_bal(tmp_path / name, problem))
    for field in fields(BundleAdjustment):
        np.testing.assert_allclose(getattr(again, field.name), getattr(problem, field.name), rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "line 1: expected the numbers"),
        ("2 1", "line 1: expected the numbers"),
        ("1.5 1 0", "line 1: expected the numbers"),
        ("0 1 1\n0 0 1.0 2.0\n1\n2\n3\n", "line 2: there is no camera 0"),
        ("1 1 1\n0 7 1.0 2.0\n" + "1\n" * 12, "line 2: there is no point 7"),
        ("1 1 1\n0 0.5 1.0 2.0\n" + "1\n" * 12, "line 2: there is no point 0.5"),
        ("1 1 1\n0 0 1.0 2.0\n" + "1\n" * 11, "holds 18 numbers, where 1 cameras, 1 points and 1 observations are 19"),
        ("1 1 1\n0 0 1.0 2.0\n" + "1\n" * 11 + "one\n", "line 14: 'one' is no finite number"),
        ("1 1 1\n0 0 nan 2.0\n" + "1\n" * 12, "line 2: 'nan' is no finite number"),
        ("1 1 1\n0 0 1_5 2.0\n" + "1\n" * 12, "line 2: '1_5' is no finite number"),
        ("1 1 1\n0 0 \u0663 2.0\n" + "1\n" * 12, "line 2: '\u0663' is no finite number"),
    ],
)
def test_a_wrong_file_is_named_with_its_line(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "wrong.txt"
    path.write_text(content)
    with pytest.raises(fg.FileFormatError, match=said) as refused:
        read_bal(path)
    assert "wrong.txt" in str(refused.value)


def test_exact_pixels_are_triangulated_exactly_and_what_is_seen_once_stays() -> None:
    problem = scene(noise=0.0)
    once = np.flatnonzero(problem.point != 3)
    lone = replace(
        problem, camera=np.append(problem.camera[once], 0), point=np.append(problem.point[once], 3),
        pixels=np.vstack([problem.pixels[once], [[1.0, 2.0]]]), points=problem.points + 1.0,
    )  # fmt: skip
    found = triangulate(lone)
    others = np.arange(len(found)) != 3
    np.testing.assert_allclose(found[others], problem.points[others], atol=1e-7)
    np.testing.assert_array_equal(found[3], problem.points[3] + 1.0)
    whole = triangulate(replace(lone, points=np.zeros(problem.points.shape, dtype=int)))  # no guess, and no fractions
    np.testing.assert_array_equal(whole[others], found[others])


@pytest.mark.parametrize("distortion", [(-0.2, 0.02), (-0.1, 0.0), (0.3, 0.1), (0.0, 1.0)])
def test_wide_and_strongly_distorted_pixels_are_triangulated_exactly(distortion: tuple[float, float]) -> None:
    problem = scene(noise=0.0)
    near = replace(problem, intrinsics=problem.intrinsics * [1.0, 0.0, 0.0] + [0.0, *distortion])
    near.poses[:, 2] += 5.0  # points up to some 45 degrees beside the axis
    pixels = project(near.poses[near.camera], near.intrinsics[near.camera], near.points[near.point])
    np.testing.assert_allclose(triangulate(replace(near, pixels=pixels)), near.points, atol=1e-7)


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_map_is_found_up_to_place_and_scale(unit: float, calibrated: bool) -> None:
    problem, rng = scene(), np.random.default_rng(1)
    poses = problem.poses * np.array([unit, unit, unit, 1, 1, 1, 1])
    moves = np.vstack([np.zeros(6), rng.normal(0.0, 0.02, (7, 6)) * [unit, unit, unit, 1, 1, 1]])
    focal = 1.0 if calibrated else 1.02
    begun = replace(problem, poses=fg.SE3.retract(poses, moves), intrinsics=problem.intrinsics * [focal, 1.0, 1.0])
    graph, guess = replace(begun, points=triangulate(begun)).graph(sigma=0.5, calibrated=calibrated)
    solution = LevenbergMarquardt().solve(graph, guess, check=True)
    assert 2.0 * solution.cost == pytest.approx(2 * len(problem.pixels) - graph.compile().size, rel=0.25)
    np.testing.assert_allclose(solution["intrinsics"][:, 0], 800.0, rtol=1e-12 if calibrated else 0.02)
    apart = [np.linalg.norm(p[:, None] - p, axis=2) for p in (solution["points"], problem.points)]
    np.testing.assert_allclose(apart[0] / apart[0].mean(), apart[1] / apart[1].mean(), atol=0.02)
    if unit == 1.0:
        assert judge(graph, solution).worst() < 1e-3  # by slopes found apart from the library's


def test_an_uncertain_scale_is_no_part_of_the_covariance() -> None:
    """Against least squares in which two cameras keep their distance exactly, by a step that is left out."""
    problem = scene(size=15, seed=2)
    graph, guess = problem.graph(sigma=0.5, calibrated=True)
    solution = LevenbergMarquardt().solve(graph, guess, check=True)
    poses, points, turned = solution["poses"], solution["points"], 6 * (len(problem.poses) - 1)
    centres = fg.SE3.inverse(poses)[:, :3]
    begun = fg.SE3.inverse(problem.poses)[:, :3]
    other = int(np.linalg.norm(begun - begun[0], axis=1).argmax())

    def seen(step: Array) -> Array:
        moved = fg.SE3.retract(poses, np.concatenate([np.zeros((1, 6)), step[:turned].reshape(-1, 6)]))
        marks = points + step[turned:].reshape(-1, 3)
        return project(moved[problem.camera], problem.intrinsics[problem.camera], marks[problem.point]).ravel() / 0.5

    h = 1e-6 * np.eye(turned + points.size)
    slopes = np.stack([(seen(row) - seen(-row)) / 2e-6 for row in h], axis=1)
    away = np.zeros(turned + points.size)
    apart = centres[other] - centres[0]
    away[6 * (other - 1) : 6 * other] = np.concatenate([apart, np.cross(centres[other], apart)])
    free = null_space(away[None])
    expected = free @ np.linalg.inv(free.T @ slopes.T @ slopes @ free) @ free.T
    found = solution.covariance(graph.families["points"][7])
    np.testing.assert_allclose(found, expected[turned + 21 : turned + 24, turned + 21 : turned + 24], rtol=1e-3)


def test_what_pixels_do_not_tell_is_refused_or_held() -> None:
    problem = scene()
    alone = problem.camera == 0
    with pytest.raises(fg.GraphError, match="two cameras"):
        replace(
            problem, camera=problem.camera[alone], point=problem.point[alone], pixels=problem.pixels[alone],
            poses=problem.poses[:1], intrinsics=problem.intrinsics[:1],
        ).graph()  # fmt: skip
    kept = (problem.point != 0) | (problem.camera == problem.camera[problem.point == 0][0])
    graph, guess = replace(
        problem, camera=problem.camera[kept], point=problem.point[kept], pixels=problem.pixels[kept]
    ).graph(sigma=0.5)
    assert LevenbergMarquardt().solve(graph, guess).converged  # a point that one camera sees
