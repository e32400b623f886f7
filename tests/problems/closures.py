"""Pose graphs with wrong loop closures, of which one knows which they are."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from unifg.lie import SE2
from unifg.pose_graphs import Edges, PoseGraph
from unifg.typing import BoolArray

Claim: TypeAlias = Literal["same place", "anywhere"]

SPREAD = 10.0  # standard deviations by which a wrong closure misses "the same place"
FARTHEST = 1.0  # [m, rad] it does so at most


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
