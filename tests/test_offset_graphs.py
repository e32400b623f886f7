"""Pose graphs, marginals and smoothers in map coordinates: read, initialised and solved as at the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from unifg.files.g2o import read_g2o, write_g2o
from unifg.pose_graphs import PoseGraph, chordal, lago, manhattan, odometric, sphere
from unifg.solvers import GaussNewton
from unifg.typing import Array

FAR = (1e3, 1e5, 5e6)  # [m]
GRID = 2.0**-20  # [m]; every offset represents it
EXACT = 1e-7  # [m]; a hundred spacings of 5e6 m
PLANE, SPACE = manhattan(150, seed=1).pose_graph, sphere(5, 8).pose_graph


def shifted(poses: Array, axes: int, offset: float) -> Array:
    result = np.array(poses)
    result[..., :axes] = np.round(result[..., :axes] / GRID) * GRID + offset
    return result


def solved(pose_graph: PoseGraph, axes: int, offset: float, path: Path, start: str) -> tuple[fg.Solution, Array, Array]:
    """The solution from a file, its poses with the offset taken away, and the marginals."""
    write_g2o(path, pose_graph.with_poses(shifted(pose_graph.poses, axes, offset)))
    read = read_g2o(path)
    first = {"file": lambda graph: graph.poses, "lago": lago, "chordal": chordal, "odometric": odometric}[start]
    graph, x, guess = read.with_poses(first(read)).graph()
    solution = GaussNewton().solve(graph, guess)
    poses = np.array(solution[x])
    poses[:, :axes] -= offset
    return solution, poses, np.asarray(solution.marginals(x[1:]))


@pytest.mark.parametrize(
    ("pose_graph", "axes", "start"),
    [
        *((PLANE, 2, start) for start in ("file", "lago", "chordal", "odometric")),
        *((SPACE, 3, start) for start in ("file", "chordal", "odometric")),
    ],
    ids=lambda given: given if isinstance(given, str) else "",
)
def test_pose_graphs(pose_graph: PoseGraph, axes: int, start: str, tmp_path: Path) -> None:
    first, poses, marginals = solved(pose_graph, axes, 0.0, tmp_path / "graph.g2o", start)
    assert first.converged
    for offset in FAR:
        solution, moved, spread = solved(pose_graph, axes, offset, tmp_path / "graph.g2o", start)
        assert solution.status is first.status
        assert abs(solution.iterations - first.iterations) <= 2
        np.testing.assert_allclose(moved, poses, atol=EXACT)
        np.testing.assert_allclose(spread, marginals, atol=1e-7 * np.abs(marginals).max())


@pytest.mark.parametrize("kind", [fg.Incremental, lambda: fg.FixedLag(8)], ids=["Incremental", "FixedLag"])
def test_smoothers(kind: type[fg.Incremental]) -> None:
    found = []
    for offset in (0.0, *FAR):
        smoother, rng = kind(), np.random.default_rng(0)
        x = smoother.variables("x", fg.SE2)
        start, moved = np.array([offset, offset, 0.0]), np.array([1.0, 0.0, np.pi / 6])
        smoother.minimize(fg.prior, x[0], start, sigma=[0.01, 0.01, 0.001])
        smoother.update({x: start})
        effort = []
        for k in range(24):
            measured = moved + rng.normal(size=3) * [0.05, 0.05, 0.02]
            smoother.minimize(fg.between, x[k], x[k + 1], measured, sigma=[0.05, 0.05, 0.02])
            if k > 3 and k % 4 == 0:
                smoother.minimize(fg.between, x[k - 3], x[k + 1], [0.1, 3.6, 2.0 * np.pi / 3.0], sigma=0.1)
            guess = fg.SE2.compose(smoother.estimate(x[-1])[0], measured)
            effort.append(smoother.update({x: guess}).eliminated)
        last = np.array(smoother.estimate(x[-1])[0])
        last[:2] -= offset
        found.append((last, smoother.covariance(x[-1]), effort))
    for last, covariance, effort in found[1:]:
        np.testing.assert_allclose(last, found[0][0], atol=EXACT)
        np.testing.assert_allclose(covariance, found[0][1], atol=1e-7 * np.abs(found[0][1]).max())
        assert effort == found[0][2]
