"""Normal matrices of pose graphs, real ones and large synthetic ones."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from test_elimination import backward_error, full, solving
from unifg.elimination.factorization import Factorization, Ordering
from unifg.elimination.symmetric import Symmetric, scatter
from unifg.typing import Array, IntArray

Graph = tuple[int, IntArray, IntArray, Array, Array]  # poses, first, second, first Jacobian, information


def rotation(q: Array) -> Array:
    """(n, 3, 3) from quaternions x y z w."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def adjoint_of_inverse(z: Array) -> Array:
    """(n, d, d) Ad(Z^-1), translation first, of measurements x y theta or x y z qx qy qz qw."""
    n = len(z)
    if z.shape[1] == 3:
        c, s = np.cos(z[:, 2]), np.sin(z[:, 2])
        turn = np.moveaxis(np.array([[c, s], [-s, c]]), 2, 0)
        t = -(turn @ z[:, :2, None])[:, :, 0]
        result = np.zeros((n, 3, 3))
        result[:, :2, :2], result[:, 2, 2] = turn, 1.0
        result[:, 0, 2], result[:, 1, 2] = t[:, 1], -t[:, 0]
        return result
    turn = rotation(z[:, 3:]).transpose(0, 2, 1)
    t = -(turn @ z[:, :3, None])[:, :, 0]
    cross = np.cross(np.eye(3)[None], t[:, None, :]).transpose(0, 2, 1)
    result = np.zeros((n, 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = turn
    result[:, :3, 3:] = -cross.transpose(0, 2, 1) @ turn
    return result


def read(path: Path) -> Graph:
    """Edges of a .g2o file, linearised where every residual is zero."""
    ends, measured, information = [], [], []
    with gzip.open(path, "rt") as file:
        for line in file:
            word, *rest = line.split()
            if word.startswith("EDGE_SE"):
                size = 3 if "SE2" in word else 7
                ends.append([int(rest[0]), int(rest[1])])
                measured.append([float(v) for v in rest[2 : 2 + size]])
                information.append([float(v) for v in rest[2 + size :]])
    names, joined = np.unique(np.array(ends), return_inverse=True)
    first, second = joined.reshape(-1, 2).T
    z = np.array(measured)
    d = 3 if z.shape[1] == 3 else 6
    omega = np.zeros((len(z), d, d))
    i, j = np.triu_indices(d)
    omega[:, i, j] = omega[:, j, i] = np.array(information)
    return len(names), first, second, -adjoint_of_inverse(z), omega


def normal(graph: Graph) -> tuple[Symmetric, Array, IntArray]:
    """J' Omega J with a unit prior on the first pose."""
    poses, first, second, jacobian, omega = graph
    d = omega.shape[1]
    weighted = jacobian.transpose(0, 2, 1) @ omega
    pieces = [(first, first, weighted @ jacobian), (second, second, omega)]
    swap = first > second
    mixed = np.where(swap[:, None, None], weighted.transpose(0, 2, 1), weighted)
    pieces.append((np.minimum(first, second), np.maximum(first, second), mixed))
    pieces.append((np.zeros(1, dtype=int), np.zeros(1, dtype=int), np.eye(d)[None]))
    rows, columns, numbers = [], [], []
    for a, b, block in pieces:
        row = np.broadcast_to((a * d)[:, None, None] + np.arange(d)[:, None], block.shape)
        column = np.broadcast_to((b * d)[:, None, None] + np.arange(d), block.shape)
        upper = row <= column
        rows.append(row[upper])
        columns.append(column[upper])
        numbers.append(block[upper])
    row, column = np.concatenate(rows), np.concatenate(columns)
    pattern = Symmetric(poses * d, [(row, column)])
    data = scatter(pattern.positions(row, column), np.concatenate(numbers), pattern.nnz)
    return pattern, data, np.repeat(np.arange(poses), d)


def wander(rng: np.random.Generator, poses: int) -> Graph:
    """A walk on a square grid, joined to an earlier visit of the place it comes to."""
    side = int(np.sqrt(poses))
    at, seen, first, second = np.array([side // 2, side // 2]), dict[tuple[int, int], int](), [], []
    for k in range(poses):
        place = (int(at[0]), int(at[1]))
        if k:
            first.append(k - 1)
            second.append(k)
        if place in seen and seen[place] < k - 1:
            first.append(seen[place])
            second.append(k)
        seen[place] = k
        step = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[rng.integers(4)]
        at = np.clip(at + step, 0, side - 1)
    z = np.column_stack([rng.normal(size=(len(first), 2)), rng.uniform(-3.0, 3.0, len(first))])
    omega = np.tile(np.diag([10.0, 10.0, 40.0]), (len(first), 1, 1))
    return poses, np.array(first), np.array(second), -adjoint_of_inverse(z), omega


@pytest.mark.data
@pytest.mark.parametrize("name", ["intel", "M3500", "parking-garage", "sphere2500"])
def test_real_pose_graphs(shared_data: Path, rng: np.random.Generator, name: str) -> None:
    path = shared_data / "pose_graphs" / f"{name}.g2o.gz"
    if not path.exists():
        pytest.skip(f"{path.name} is not among the shared data")
    pattern, data, label = normal(read(path))
    matrix = full(pattern, data)
    right = rng.normal(size=pattern.size)
    flops: dict[object, float] = {}
    orderings: list[Ordering] = ["auto", "minimum-degree", "nested-dissection"]
    for ordering in orderings:
        factorization = Factorization(pattern, label, ordering=ordering)
        assert factorization.factor(data)
        assert factorization.definite
        assert backward_error(matrix, factorization.solve(right), right) < 1e-12
        flops[str(ordering)] = factorization.tree.flops
    assert flops["auto"] <= 1.1 * min(flops.values())
    unlabelled = Factorization(pattern)
    assert unlabelled.factor(data)
    assert unlabelled.tree.flops < 1.5 * flops["auto"]


def test_large_planar_graph(rng: np.random.Generator) -> None:
    """Work and fill grow nearly linearly with the poses of a planar graph."""
    work, fill = [], []
    for poses in (4000, 16000):
        pattern, data, label = normal(wander(rng, poses))
        factorization = solving(rng, pattern, data, 1e-12, label)
        tree = factorization.tree
        assert tree.height < poses // 20
        work.append(tree.flops)
        fill.append(tree.fill)
    assert fill[1] < 8 * fill[0]
    assert work[1] < 16 * work[0]


def test_volume_is_dissected(rng: np.random.Generator) -> None:
    """In a three-dimensional lattice nested dissection beats minimum degree, and is chosen."""
    side = 9
    number = np.arange(side**3).reshape(side, side, side)
    pairs = [(np.delete(number, -1, axis).ravel(), np.delete(number, 0, axis).ravel()) for axis in range(3)]
    first, second = np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
    quaternion = rng.normal(size=(len(first), 4))
    jacobian = -adjoint_of_inverse(np.column_stack([rng.normal(size=(len(first), 3)), quaternion]))
    pattern, data, label = normal((side**3, first, second, jacobian, np.tile(np.eye(6), (len(first), 1, 1))))
    factorization = solving(rng, pattern, data, 1e-12, label)
    assert factorization.tree.kind == "nested-dissection"
    assert factorization.tree.flops < Factorization(pattern, label, ordering="minimum-degree").tree.flops
