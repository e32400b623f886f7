"""Wrong loop closures on published pose graphs: graduated non-convexity, dynamic covariance scaling, and GTSAM's.

``python -m benchmarks.wrong_closures`` prints a Markdown table row by row; it takes about an hour, most of it for M3500
with 30 %. Settings were chosen on the seeds 0 to 2, the table is of seeds from 10 on. Errors are distances from the
answer without wrong closures. A wrong closure within the threshold of that answer cannot be told from a right one by
the loss, whoever minimises it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

import unifg as fg
from benchmarks.gtsam_peer import Peer, available
from benchmarks.pose_graphs import data_folder
from benchmarks.report import table
from unifg.files.g2o import read_g2o
from unifg.lie import SE2
from unifg.pose_graphs import Edges, PoseGraph
from unifg.solvers import GaussNewton, GraduatedNonConvexity
from unifg.typing import Array, BoolArray

Claim: TypeAlias = Literal["same place", "anywhere"]

THRESHOLD = {3: 3.37, 6: 4.10}  # by numbers in a measurement: 99 % of right ones
SPREAD = 10.0  # standard deviations by which a wrong closure misses "the same place"
FARTHEST = 1.0  # [m, rad] it does so at most
CLAIMS: tuple[Claim, ...] = ("same place", "anywhere")
CASES = (
    ("intel", 0.3, 3),
    ("intel", 0.5, 3),
    ("M3500", 0.1, 6),
    ("M3500", 0.3, 3),
    ("smallGrid3D", 0.1, 3),
    ("smallGrid3D", 0.3, 3),
)  # graph, share, seeds
FIRST = 10  # seed
HEAD = ("graph", "wrong", "claim", "seed", "method", "error [m]", "right kept", "wrong kept", "precision", "CPU [s]")


def with_wrong_closures(pose_graph: PoseGraph, share: float, seed: int, claim: Claim) -> tuple[PoseGraph, BoolArray]:
    """Add wrong loop closures between random poses.

    Args:
        pose_graph: the right measurements.
        share: of all loop closures that are wrong afterwards, in [0, 1).
        seed: of everything random.
        claim: what the wrong ones measure: that both poses are the same place, or any distance within the graph.

    Returns:
        The graph, and (m,) whether an edge is wrong.
    """
    rng = np.random.default_rng(seed)
    poses, right, edges = len(pose_graph.poses), len(pose_graph.closures), pose_graph.edges
    count = round(share / (1.0 - share) * right)
    ends = np.sort(np.stack([rng.choice(poses, 2, replace=False) for _ in range(count)]), axis=1)
    neighbours = ends[:, 1] - ends[:, 0] == 1
    ends[neighbours, 1] = (ends[neighbours, 1] + 7) % poses
    ends = np.sort(ends, axis=1)
    information = pose_graph.closures.information[rng.integers(0, right, count)]
    if claim == "same place":
        sigma = np.minimum(SPREAD / np.sqrt(np.einsum("nii->ni", information)), FARTHEST)
        step = sigma * rng.standard_normal((count, pose_graph.group.dim))
    else:
        planar = pose_graph.group is SE2
        reach, turn, size = 0.3 * np.ptp(pose_graph.poses[:, :2]), (3.0 if planar else 1.7), (2 if planar else 3)
        away = rng.uniform(-reach, reach, (count, size))
        step = np.concatenate([away, rng.uniform(-turn, turn, (count, pose_graph.group.dim - size))], axis=1)
    every = Edges(
        np.concatenate([edges.first, ends[:, 0]]),
        np.concatenate([edges.second, ends[:, 1]]),
        np.concatenate([edges.measured, pose_graph.group.exp(step)]),
        np.concatenate([edges.information, information]),
    )
    return replace(pose_graph, edges=every), np.arange(len(every)) >= len(edges)


@dataclass(frozen=True)
class Found:
    """An answer.

    Attributes:
        poses: (n, storage).
        remark: its status, where it has one.
    """

    poses: Array
    remark: str = ""


def by_gtsam(pose_graph: PoseGraph) -> Found:
    """GTSAM's GNC with Gauss-Newton inside, odometry known to be right, truncated least squares."""
    import gtsam

    peer, dim = Peer(pose_graph), pose_graph.group.dim
    edges = pose_graph.edges
    options = gtsam.GncGaussNewtonParams(gtsam.GaussNewtonParams())
    options.setKnownInliers([*np.flatnonzero(edges.odometry).tolist(), len(edges)])
    options.setLossType(gtsam.GncLossType.TLS)
    optimizer = gtsam.GncGaussNewtonOptimizer(peer.graph, peer.start, options)
    optimizer.setInlierCostThresholds(0.5 * THRESHOLD[dim] ** 2)
    found, every = optimizer.optimize(), range(len(pose_graph.poses))
    if pose_graph.group is SE2:
        planar = [found.atPose2(k) for k in every]
        return Found(np.array([[pose.x(), pose.y(), pose.theta()] for pose in planar]))
    spatial = [found.atPose3(k) for k in every]
    turned: list[Any] = [pose.rotation().toQuaternion() for pose in spatial]
    return Found(
        np.array([[*p.translation(), q.w(), q.x(), q.y(), q.z()] for p, q in zip(spatial, turned, strict=True)])
    )


def by_graduation(pose_graph: PoseGraph) -> Found:
    """Ours."""
    graph, x, guess = pose_graph.graph(robust=fg.TruncatedLeastSquares(THRESHOLD[pose_graph.group.dim]))
    solution = GraduatedNonConvexity().solve(graph, guess)
    return Found(solution[x], solution.status.name)


def by_scaling(pose_graph: PoseGraph) -> Found:
    """Dynamic covariance scaling with the same bound, Gauss-Newton from the guess."""
    graph, x, guess = pose_graph.graph(robust=fg.DCS(THRESHOLD[pose_graph.group.dim] ** 2 / 3.0))
    return Found(GaussNewton().solve(graph, guess)[x])


METHODS = {"unifg": by_graduation, "DCS": by_scaling, "GTSAM": by_gtsam}


def rows(
    clean: PoseGraph, name: str, share: float, seed: int, claim: Claim, methods: list[str]
) -> list[tuple[str, ...]]:
    """One row of the table for each method."""
    graph, x, guess = clean.graph()
    right = GaussNewton().solve(graph, guess, check=True)[x]
    dirty, wrong = with_wrong_closures(clean, share, seed, claim)
    closures, dim = ~dirty.edges.odometry, clean.group.dim
    place = 2 if clean.group is SE2 else 3
    result: list[tuple[str, ...]] = []
    for method in methods:
        started = time.process_time()
        found = METHODS[method](dirty)
        seconds = time.process_time() - started
        error = np.linalg.norm(found.poses[:, :place] - right[:, :place], axis=1).max()
        kept = dirty.with_poses(found.poses).squared_errors() <= THRESHOLD[dim] ** 2
        good, bad = kept[closures & ~wrong], kept[wrong]
        precision = good.sum() / max(good.sum() + bad.sum(), 1)
        called = f"{method} ({found.remark})" if found.remark else method
        recall, wrongly = f"{good.mean():.4f}", f"{bad.sum()} of {len(bad)}"
        numbers = (f"{error:.3f}", recall, wrongly, f"{precision:.4f}", f"{seconds:.1f}")
        result.append((name, f"{share:.0%}", claim, str(seed), called, *numbers))
    return result


def main() -> None:
    """Print one row per graph, share, claim, seed and method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=FIRST, help="the first seed")
    parser.add_argument("--seeds", type=int, help="seeds per case, instead of three or six")
    parser.add_argument("--graphs", nargs="+", help="only these, as NAME or NAME:SHARE")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    options = parser.parse_args()
    methods = [m for m in options.methods if m != "GTSAM" or available()]
    folder = data_folder()
    if folder is None:
        raise SystemExit("there is no folder of pose graphs: set UNIFG_DATA")
    print(table(HEAD, [], 5), flush=True)
    for name, share, seeds in CASES:
        if options.graphs and not {name, f"{name}:{share}"} & set(options.graphs):
            continue
        path = folder / f"{name}.g2o.gz"
        clean = read_g2o(path if path.is_file() else folder / f"{name}.g2o")
        for seed in range(options.first, options.first + (options.seeds or seeds)):
            # Half of the seeds with either claim: what the wrong closures measure.
            for row in rows(clean, name, share, seed, CLAIMS[seed % 2], methods):
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
