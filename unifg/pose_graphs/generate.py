"""Made-up pose graphs with known truth, for examples, tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.errors import ModelError, require_kinds
from unifg.lie import SE2, SE3, LieGroup
from unifg.pose_graphs.initialise import odometric
from unifg.pose_graphs.pose_graph import Edges, PoseGraph
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Simulated", "manhattan", "sphere"]

_PLANAR_SIGMA = (0.05, 0.05, 0.02)  # [m, m, rad]
_SPATIAL_SIGMA = (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)  # [m, m, m, rad, rad, rad]


@dataclass(frozen=True, eq=False)
class Simulated:
    """A pose graph and what it was made from.

    Attributes:
        pose_graph: noisy measurements; its poses are those of odometry alone.
        truth: (n, storage) true poses.
        outliers: (m,) whether an edge is a wrong loop closure.
    """

    pose_graph: PoseGraph
    truth: Array
    outliers: BoolArray


def manhattan(count: int = 1000, seed: int = 0, outliers: float = 0.0, block: int = 4) -> Simulated:
    """A robot that drives through the streets of a square city and recognises crossings it has seen.

    It moves a metre per step and turns left, right or not at all at every crossing; the city has as many crossings as
    fit the length of the drive. The idea is E. Olson, J. Leonard, S. Teller, "Fast iterative alignment of pose graphs
    with poor initial estimates", ICRA 2006. Noise is 0.05 m and 0.02 rad in every measurement.

    Args:
        count: number of poses, at least 2.
        seed: of everything random.
        outliers: share of the loop closures that are wrong, in [0, 1).
        block: metres between crossings.

    Raises:
        ModelError: an argument is out of its range.
    """
    require_kinds("manhattan", ModelError, manhattan.__annotations__, locals())
    if count < 2 or block < 1 or seed < 0:
        raise ModelError(
            f"manhattan: count {count} must be at least 2, block {block} at least 1, and seed {seed} not negative"
        )
    rng = np.random.default_rng(seed)
    side = max(2, round((count / (4.0 * block)) ** 0.5))  # each street is driven a few times
    cells = np.zeros((count, 3), dtype=np.int64)  # x and y [m], heading in quarter turns
    cells[0, :2] = block * (side // 2)
    steps = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    for k in range(1, count):
        x, y, heading = cells[k - 1].tolist()
        if x % block == 0 and y % block == 0:
            choices = [
                turned for turn in (0, 1, -1)
                if 0 <= x + steps[turned := (heading + turn) % 4, 0] <= block * side
                and 0 <= y + steps[turned, 1] <= block * side
            ]  # fmt: skip
            heading = choices[int(rng.integers(len(choices)))]
        cells[k] = [*(cells[k - 1, :2] + steps[heading]), heading]
    truth = np.column_stack([cells[:, :2] - cells[0, :2], cells[:, 2] * (np.pi / 2)]).astype(np.float64)
    truth = SE2.retract(truth, np.zeros(3))
    closures = _same_place(cells[:, :2], apart=4 * block)
    return simulated(SE2, truth, closures, outliers, np.array(_PLANAR_SIGMA), rng)


def sphere(
    rings: int = 20, per_ring: int = 25, seed: int = 0, outliers: float = 0.0, radius: float = 10.0
) -> Simulated:
    """A robot that winds its way up a sphere and recognises the ring below (as in the data set sphere2500).

    Noise is 0.05 m and 0.01 rad about every axis.

    Args:
        rings: turns around the sphere, at least 2.
        per_ring: poses per turn, at least 4.
        seed: of everything random.
        outliers: share of the loop closures that are wrong, in [0, 1).
        radius: of the sphere [m].

    Raises:
        ModelError: an argument is out of its range.
    """
    require_kinds("sphere", ModelError, sphere.__annotations__, locals())
    if rings < 2 or per_ring < 4 or seed < 0 or not 0.0 < radius < np.inf:
        raise ModelError(
            f"sphere: rings {rings} >= 2, per_ring {per_ring} >= 4, seed {seed} >= 0 and a finite radius {radius} > 0 "
            "are needed"
        )
    rng = np.random.default_rng(seed)
    count = rings * per_ring
    turn = np.arange(count) / per_ring
    longitude, height = 2.0 * np.pi * turn, np.pi * ((turn + 0.5) / (rings + 1.0) - 0.5)
    outward = np.stack([np.cos(height) * np.cos(longitude), np.cos(height) * np.sin(longitude), np.sin(height)], axis=1)
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros(count)], axis=1)
    matrices = np.tile(np.eye(4), (count, 1, 1))  # x along the ring, z outwards
    matrices[:, :3, :3] = np.stack([east, np.cross(outward, east), outward], axis=2)
    matrices[:, :3, 3] = radius * outward
    truth = SE3.from_matrix(matrices)
    truth = SE3.between(truth[:1], truth)
    above = np.arange(per_ring, count)
    closures = np.stack([above - per_ring, above], axis=1)
    return simulated(SE3, truth, closures, outliers, np.array(_SPATIAL_SIGMA), rng)


def _same_place(cells: Array | IntArray, apart: int) -> IntArray:
    """Pairs (first visit, later visit) of a cell that are at least ``apart`` steps apart, (k, 2)."""
    first: dict[tuple[int, int], int] = {}
    pairs = []
    for k, cell in enumerate(map(tuple, cells.tolist())):
        earlier = first.setdefault(cell, k)
        if k - earlier >= apart:
            pairs.append((earlier, k))
            first[cell] = k
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def simulated(
    group: LieGroup, truth: Array, closures: IntArray, share: float, sigma: Array, rng: np.random.Generator
) -> Simulated:
    """Measure along the way and across the closures, and add wrong closures between random poses."""
    if not 0.0 <= share < 1.0:
        raise ModelError(f"outliers {share} must be a share in [0, 1)")
    count = len(truth)
    along = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    pairs = np.concatenate([along, closures])
    exact = group.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    measured = group.retract(exact, sigma * rng.standard_normal((len(pairs), group.dim)))
    wrong = round(share / (1.0 - share) * len(closures))
    ends = np.sort(np.stack([rng.choice(count, 2, replace=False) for _ in range(wrong)]), axis=1) if wrong else None
    if ends is not None:
        ends[:, 1] = np.where(ends[:, 1] - ends[:, 0] == 1, (ends[:, 1] + 7) % count, ends[:, 1])  # not odometry
        ends = np.sort(ends, axis=1)
        false = group.exp(10.0 * sigma * rng.standard_normal((wrong, group.dim)))  # "the same place", it says
        pairs, measured = np.concatenate([pairs, ends]), np.concatenate([measured, false])
    information = np.tile(np.diag(sigma**-2.0), (len(pairs), 1, 1))
    start = np.tile(group.identity(), (count, 1))
    graph = PoseGraph(np.arange(count, dtype=np.int64), start, Edges(pairs[:, 0], pairs[:, 1], measured, information))
    flags = np.arange(len(pairs)) >= len(pairs) - wrong
    return Simulated(graph.with_poses(odometric(graph)), truth, flags)
