"""Wrong loop closures on published pose graphs: graduated non-convexity, dynamic covariance scaling, and GTSAM's.

``python -m benchmarks.wrong_closures`` prints a table; it takes some minutes. A wrong closure that fits within the
threshold cannot be told from a right one, so besides the distance to the answer without wrong closures the cost of the
loss is compared with what a start at that answer gives.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

import unifg as fg
from benchmarks.gtsam_peer import available
from benchmarks.pose_graphs import data_folder
from unifg.files.g2o import read_g2o
from unifg.pose_graphs import Edges, PoseGraph
from unifg.solvers import GaussNewton, GraduatedNonConvexity
from unifg.typing import Array, BoolArray

Claim: TypeAlias = Literal["same place", "anywhere"]

THRESHOLD = 3.37  # 99 % of right measurements in the plane
SPREAD = 10.0  # standard deviations by which a wrong closure misses "the same place"
FARTHEST = 1.0  # [m, rad] it does so at most
CASES = (("intel", 0.3), ("intel", 0.5), ("M3500", 0.1), ("M3500", 0.3))


def with_wrong_closures(pose_graph: PoseGraph, share: float, seed: int, claim: Claim) -> tuple[PoseGraph, BoolArray]:
    """Add wrong loop closures between random poses of a planar graph.

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
        step = sigma * rng.standard_normal((count, 3))
    else:
        reach = 0.3 * np.ptp(pose_graph.poses[:, :2])
        step = np.concatenate([rng.uniform(-reach, reach, (count, 2)), rng.uniform(-3.0, 3.0, (count, 1))], axis=1)
    every = Edges(
        np.concatenate([edges.first, ends[:, 0]]),
        np.concatenate([edges.second, ends[:, 1]]),
        np.concatenate([edges.measured, pose_graph.group.exp(step)]),
        np.concatenate([edges.information, information]),
    )
    return replace(pose_graph, edges=every), np.arange(len(every)) >= len(edges)


def by_gtsam(pose_graph: PoseGraph) -> Array:
    """Poses by GTSAM's GncGaussNewtonOptimizer, odometry known to be right."""
    import gtsam

    graph, start, known = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    for k, pose in enumerate(pose_graph.poses):
        start.insert(k, gtsam.Pose2(*pose))
    edges = pose_graph.edges
    for k in range(len(edges)):
        noise = gtsam.noiseModel.Gaussian.Information(edges.information[k])
        measured = gtsam.Pose2(*edges.measured[k])
        graph.add(gtsam.BetweenFactorPose2(int(edges.first[k]), int(edges.second[k]), measured, noise))
        if edges.odometry[k]:
            known.append(k)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*pose_graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    options = gtsam.GncGaussNewtonParams(gtsam.GaussNewtonParams())
    options.setKnownInliers([*known, len(edges)])
    options.setLossType(gtsam.GncLossType.TLS)
    optimizer = gtsam.GncGaussNewtonOptimizer(graph, start, options)
    optimizer.setInlierCostThresholds(0.5 * THRESHOLD**2)
    found = optimizer.optimize()
    poses = [found.atPose2(k) for k in range(len(pose_graph.poses))]
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])


def solved(
    solver: fg.Solver | GraduatedNonConvexity, graph: fg.Graph, guess: Mapping[fg.Family, Array], x: fg.Family
) -> Array:
    """Poses by one of ours."""
    return solver.solve(graph, guess)[x]


def main() -> None:
    """Print one line per graph, share, claim, seed and method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--gtsam", action="store_true", help="run GTSAM's GNC too, which takes longer")
    options = parser.parse_args()
    folder, loss = data_folder(), fg.TruncatedLeastSquares(THRESHOLD)
    if folder is None:
        raise SystemExit("there is no folder of pose graphs: set UNIFG_DATA")
    print("graph share claim seed | method: error [m], right kept, wrong kept, cost - cost from the answer, CPU [s]")
    for name, share in CASES:
        clean = read_g2o(folder / f"{name}.g2o.gz")
        graph, x, guess = clean.graph()
        right = GaussNewton().solve(graph, guess, check=True)[x]
        for claim in ("same place", "anywhere"):
            for seed in range(options.seeds):
                dirty, wrong = with_wrong_closures(clean, share, seed, claim)
                graph, x, guess = dirty.graph(robust=loss)
                best = GaussNewton().solve(graph, {x: right}).cost
                scaled, y, begin = dirty.graph(robust=fg.DCS(THRESHOLD**2 / 3.0))
                methods: dict[str, Callable[[], Array]] = {
                    "GNC": partial(solved, GraduatedNonConvexity(), graph, guess, x),
                    "DCS": partial(solved, GaussNewton(), scaled, begin, y),
                }
                if options.gtsam and available():
                    methods["GTSAM"] = partial(by_gtsam, dirty)
                for method, solve in methods.items():
                    started = time.process_time()
                    found = solve()
                    seconds = time.process_time() - started
                    error = np.linalg.norm(found[:, :2] - right[:, :2], axis=1).max()
                    kept = loss.weight(dirty.with_poses(found).squared_errors()) > 0.0
                    closures = ~dirty.edges.odometry
                    cost = GaussNewton().solve(graph, {x: found}).cost
                    print(
                        f"{name} {share:.0%} {claim} {seed} | {method}: {error:.3f} m, "
                        f"{kept[closures & ~wrong].mean():.3f}, {int(kept[wrong].sum())} of {int(wrong.sum())}, "
                        f"{cost - best:+.2f}, {seconds:.1f} s",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
