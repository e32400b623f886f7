"""Pose graphs with wrong loop closures, of which one knows which they are."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from unifg.lie import SE2, SE3
from unifg.pose_graphs import Edges, PoseGraph, manhattan
from unifg.pose_graphs.generate import Simulated, simulated
from unifg.solvers.gating import neighbours
from unifg.typing import Array, BoolArray, IntArray

Claim: TypeAlias = Literal["same place", "anywhere"]

SPREAD = 10.0  # standard deviations by which a wrong closure misses "the same place"
FARTHEST = 1.0  # [m, rad] it does so at most
FIELDS = ("first", "second", "measured", "information")


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


def drive(count: int = 1500, seed: int = 0, spatial: bool = False, visits: int = 4) -> Simulated:
    """A long drive along streets, in the plane or over hills, that closes few loops: a handful of stretches.

    Args:
        count: of poses, a metre apart.
        seed: of everything random.
        spatial: over hills five metres high.
        visits: stretches at most that are recognised, by every third of their poses.
    """
    rng, city = np.random.default_rng(seed), manhattan(count, seed, block=40)
    closures = city.pose_graph.closures
    ends = np.stack([closures.first, closures.second], axis=1)
    groups = [group for group in neighbours(ends, 10) if len(group) >= 10]
    chosen = rng.permutation(len(groups))[:visits]
    pairs = np.concatenate([ends[np.sort(groups[k])][:30:3] for k in chosen] or [np.zeros((0, 2), dtype=np.intp)])
    truth, group, sigma = city.truth, city.pose_graph.group, np.array([0.02, 0.02, 0.002])
    if spatial:
        matrices = np.tile(np.eye(4), (count, 1, 1))
        turn, slope = truth[:, 2], 0.1 * np.cos(truth[:, 0] / 50.0)
        matrices[:, :3, 0] = np.stack(
            [np.cos(turn) * np.cos(slope), np.sin(turn) * np.cos(slope), np.sin(slope)], axis=1
        )
        matrices[:, :3, 1] = np.stack([-np.sin(turn), np.cos(turn), np.zeros(count)], axis=1)
        matrices[:, :3, 2] = np.cross(matrices[:, :3, 0], matrices[:, :3, 1])
        matrices[:, :2, 3], matrices[:, 2, 3] = truth[:, :2], 5.0 * np.sin(truth[:, 0] / 50.0)
        group, sigma = SE3, np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.002])
        truth = SE3.from_matrix(matrices)
    return simulated(group, truth, pairs, 0.0, sigma, rng)


def with_clusters(
    pose_graph: PoseGraph, claimed: Array, stretches: list[IntArray], seed: int
) -> tuple[PoseGraph, list[IntArray]]:
    """Add closures between stretches, as they would be measured at other poses.

    Args:
        pose_graph: the measurements there are.
        claimed: (n, storage) poses at which the added ones are right.
        stretches: (k, 2) positions of the ends of each cluster.
        seed: of the noise, which is that of the other closures.

    Returns:
        The graph, and the positions of the edges of each cluster.
    """
    rng, edges, group = np.random.default_rng(seed), pose_graph.edges, pose_graph.group
    ends = np.concatenate(stretches)
    information = edges.information[rng.integers(0, len(edges), len(ends))]
    noise = np.linalg.solve(
        np.swapaxes(np.linalg.cholesky(information), 1, 2), rng.standard_normal((len(ends), group.dim, 1))
    )
    measured = group.retract(group.between(claimed[ends[:, 0]], claimed[ends[:, 1]]), noise[:, :, 0])
    added = Edges(ends[:, 0], ends[:, 1], measured, information)
    every = Edges(*(np.concatenate([getattr(one, name) for one in (edges, added)]) for name in FIELDS))
    places = np.split(len(edges) + np.arange(len(ends)), np.cumsum([len(one) for one in stretches])[:-1])
    return replace(pose_graph, edges=every), places


def two_stretches(pose_graph: PoseGraph, rng: np.random.Generator, length: int = 8) -> IntArray:
    """(length, 2) ends of a cluster between two stretches that no closure joins, nor their surroundings."""
    count, closures = len(pose_graph.poses), pose_graph.closures
    while True:
        a, b = np.sort(rng.integers(0, count - 2 * length, 2))
        near = (np.abs(closures.first - a) < 40) & (np.abs(closures.second - b) < 40)
        if b - a > 100 and not near.any():
            return np.stack([a + 2 * np.arange(length), b + 2 * np.arange(length)], axis=1)


def aliased(pose_graph: PoseGraph, poses: Array, count: int, seed: int) -> tuple[PoseGraph, list[IntArray]]:
    """Add clusters of closures that take one stretch for another: each agrees with itself, at another place.

    Args:
        pose_graph: the right measurements.
        poses: (n, storage) the right poses.
        count: of clusters.
        seed: of everything random.

    Returns:
        As :func:`with_clusters`.
    """
    rng, group = np.random.default_rng(seed), pose_graph.group
    found: list[IntArray] = []
    for k in range(count):
        ends, claimed = two_stretches(pose_graph, rng), poses.copy()
        a, b = ends[len(ends) // 2]
        claimed[ends[:, 1]] = group.compose(group.compose(poses[a], group.inverse(poses[b])), poses[ends[:, 1]])
        pose_graph, places = with_clusters(pose_graph, claimed, [ends], seed + k)
        found += places
    return pose_graph, found


def adrift(simulation: Simulated, seed: int) -> tuple[PoseGraph, list[IntArray]]:
    """Add a cluster from the beginning of a drive to its end that nothing contradicts: another drift would do.

    Closures that check the last two fifths are left out. The cluster is as right as any at the poses of dead reckoning
    with another noise.

    Args:
        simulation: the right measurements.
        seed: of everything random.
    """
    clean, count = simulation.pose_graph, len(simulation.truth)
    rng, edges, group = np.random.default_rng(seed), clean.edges, clean.group
    kept = replace(clean, edges=edges[edges.odometry | (np.maximum(edges.first, edges.second) < 0.6 * count)])
    sigma = np.sqrt(np.linalg.inv(edges.information[0]).diagonal())
    other = simulated(group, simulation.truth, np.zeros((0, 2), dtype=np.intp), 0.0, sigma, rng).pose_graph.poses
    start, steps = int(rng.integers(0, count // 5)), 2 * np.arange(8)
    ends = np.stack([start + steps, count - 20 + steps], axis=1)
    return with_clusters(kept, other, [ends], seed)


def slipped(pose_graph: PoseGraph, at: int, by: Array) -> PoseGraph:
    """The same graph where the measurement of one step misses a motion ``by`` (d,).

    Args:
        pose_graph: the right measurements.
        at: position of the edge.
        by: tangent vector.
    """
    measured = pose_graph.edges.measured.copy()
    measured[at] = pose_graph.group.retract(measured[at], by)
    return replace(pose_graph, edges=replace(pose_graph.edges, measured=measured))
