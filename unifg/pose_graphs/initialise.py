"""First guesses for pose graphs: along a spanning tree, LAGO in the plane, chordal relaxation anywhere.

All take general information matrices and keep the poses that are fixed (see `PoseGraph.anchors`) where they are.
Comparison of the methods: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM: a
survey on rotation estimation and its use in pose graph optimization", ICRA 2015.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from unifg.errors import GraphError
from unifg.factors.robust import Loss
from unifg.lie import SE2
from unifg.pose_graphs.linear import block_least_squares, with_rotations
from unifg.pose_graphs.pose_graph import GUESSES, PoseGraph, ResidualName
from unifg.pose_graphs.spanning import spanning_tree
from unifg.solvers.continuation import best_guess as grown
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Start", "best_guess", "chordal", "incremental", "lago", "odometric", "starts"]

_CLOSURE_COST = 1e6  # a spanning tree takes loop closures only where there is no odometry
_BLIND_COST = 1e12  # and what carries no information only where there is nothing else
_BLIND = 1e-12  # [1 / rad^2]; an edge with less information about the turn is the last that a tree takes


class Start(NamedTuple):
    """A first guess.

    Attributes:
        name: "file", "odometry" where the poses of the graph came from there, "chordal", "lago" or "incremental".
        poses: (n, storage).
        landmarks: (k, p).
        chi2: sum of r' Omega r, without losses.
        cost: the same with a loss on the closures.
    """

    name: str
    poses: Array
    landmarks: Array
    chi2: float
    cost: float


def starts(pose_graph: PoseGraph, residual: ResidualName = "log", loss: Loss | None = None) -> list[Start]:
    """First guesses and what they cost: the poses the graph has, chordal relaxation, in the plane also LAGO.

    The poses of a file may lie in the basin of a folded map; a relaxation does not know them. Relaxations do not know
    landmarks; where there are some, and no poses in the file, one more guess grows along the odometry.

    Args:
        pose_graph: the graph.
        residual: by which they are compared.
        loss: on the loop closures when they are compared.

    Returns:
        The poses of the graph first. A start that the measurements do not determine is left out.
    """
    kinds = {"chordal": chordal, "lago": lago} if pose_graph.group is SE2 else {"chordal": chordal}
    closures = ~pose_graph.edges.odometry

    def start(name: str, moved: PoseGraph) -> Start:
        squared, seen = moved.squared_errors(residual), moved.seen_chi2(residual)
        chi2 = float(squared.sum()) + seen
        if loss is None:
            return Start(name, moved.poses, moved.landmarks, chi2, chi2)
        cost = float(squared[~closures].sum() + np.sum(loss.value(squared[closures]))) + seen
        return Start(name, moved.poses, moved.landmarks, chi2, cost)

    found = [start("file" if pose_graph.placed else "odometry", pose_graph)]
    for name, method in kinds.items():
        with suppress(GraphError):
            found.append(start(name, pose_graph.with_poses(method(pose_graph))))
    if pose_graph.sightings and not pose_graph.placed:
        with suppress(GraphError):
            found.append(start("incremental", incremental(pose_graph, residual)))
    return found


def best_guess(pose_graph: PoseGraph, residual: ResidualName = "log", loss: Loss | None = None) -> tuple[str, Array]:
    """Whichever of :func:`starts` costs least: its name and poses (n, storage); for the arguments see there."""
    best = min(starts(pose_graph, residual, loss), key=lambda start: start.cost)
    return best.name, best.poses


def incremental(pose_graph: PoseGraph, residual: ResidualName = "log") -> PoseGraph:
    """Poses and landmarks found by solving for longer and longer parts of the trajectory.

    See :func:`unifg.best_guess`.

    Raises:
        GraphError: poses do not follow each other.
    """
    graph, x, guess = pose_graph.graph(residual=residual)
    found, landmarks = grown(graph, guess, along=x).values, graph.families.get("landmarks")
    return pose_graph.with_poses(found[x], None if landmarks is None else found[landmarks])


def odometric(pose_graph: PoseGraph) -> Array:
    """Poses (n, storage) from the measurements of a spanning tree, odometry before loop closures.

    Raises:
        GraphError: a pose is connected to the others through landmarks only.
    """
    group, fixed = pose_graph.group, pose_graph.anchors()[0]
    edges = pose_graph.edges
    cost = np.where(edges.odometry, 1.0, _CLOSURE_COST)
    cost[~edges.information.any(axis=(1, 2))] = _BLIND_COST
    parent, edge, forward = _tree(pose_graph, fixed, cost, shortest=False)
    count = len(pose_graph.poses)
    relative = np.tile(group.identity(), (count + 1, 1))
    inner = np.flatnonzero(edge >= 0)
    measured = edges.measured[edge[inner]]
    along = forward[inner][:, None]
    relative[inner] = np.where(along, measured, group.inverse(measured))
    relative[fixed] = pose_graph.poses[fixed]
    return _accumulated(parent, relative, group.compose)


def lago(pose_graph: PoseGraph) -> Array:
    """Linear approximation for graph optimisation: poses (n, 3) in the plane (Carlone et al. 2014).

    Headings first: along a spanning tree, each measured turn is freed from the whole turns that wrapping has taken from
    its cycle, so that headings are real numbers and their estimate is linear. Positions given headings are linear too.
    The tree is that of the most certain paths: along odometry alone, the noise of a long drive amounts to whole turns.
    L. Carlone, R. Aragues, J. Castellanos, B. Bona, "A fast and accurate approximation for planar pose graph
    optimization", IJRR 33(7), 2014.

    Raises:
        GraphError: the poses are not planar, or the edges do not determine them.
    """
    if pose_graph.group is not SE2:
        raise GraphError("lago is for poses in SE2; use chordal")
    edges, fixed = pose_graph.edges, pose_graph.anchors()[0]
    precision = _rotation_information(edges.information, 2)
    along_tree = _tree_headings(pose_graph, fixed, 1.0 / np.maximum(precision[:, 0, 0], _BLIND))
    turn = edges.measured[:, 2]
    turns = np.round((along_tree[edges.second] - along_tree[edges.first] - turn) / (2.0 * np.pi))
    root = np.sqrt(np.maximum(precision, 0.0))
    headings = block_least_squares(
        edges.first, edges.second, -root, root, root * (turn + 2.0 * np.pi * turns)[:, None, None],
        along_tree[:, None, None], fixed,
    )[:, 0, 0]  # fmt: skip
    poses = pose_graph.poses.copy()
    free = np.setdiff1d(np.arange(len(poses)), fixed)
    poses[free, 2] = headings[free]
    return _positions(pose_graph, SE2.retract(poses, np.zeros(3)), fixed)


def chordal(pose_graph: PoseGraph) -> Array:
    """Chordal relaxation: poses (n, storage) in the plane or in space.

    The sum of kappa |R_j - R_i R_ij|^2 (Frobenius norm) is minimised over all matrices, the minimisers are moved to
    the nearest rotations by SVD, and positions given rotations are linear. The rows of the matrices do not mix, so one
    factorisation serves all. D. Martinec and T. Pajdla, "Robust rotation and translation estimation in multiview
    reconstruction", CVPR 2007; weights kappa as in D. Rosen et al., "SE-Sync", IJRR 38(2-3), 2019: the inverse
    variance of an isotropic rotation error with the same trace.

    Raises:
        GraphError: the edges do not determine the poses.
    """
    group, edges, fixed = pose_graph.group, pose_graph.edges, pose_graph.anchors()[0]
    dim = group.point_dim
    rotations, measured = (group.matrix(poses)[:, :dim, :dim] for poses in (pose_graph.poses, edges.measured))
    angles = group.dim - dim
    precision = _rotation_information(edges.information, dim)
    spread = np.trace(np.linalg.pinv(precision, hermitian=True), axis1=1, axis2=2)
    kappa = np.divide(angles, spread, out=np.zeros(len(edges)), where=spread > 0.0)  # an edge may not see rotations
    root = np.sqrt(kappa)[:, None, None]
    start = np.zeros((len(rotations), dim, dim))
    start[fixed] = np.swapaxes(rotations[fixed], 1, 2)  # blocks are rows of R, as columns
    relaxed = block_least_squares(
        edges.first, edges.second, -root * np.swapaxes(measured, 1, 2), root * np.eye(dim), np.zeros_like(measured),
        start, fixed,
    )  # fmt: skip
    poses = with_rotations(group, pose_graph.poses, np.swapaxes(relaxed, 1, 2))
    poses[fixed] = pose_graph.poses[fixed]
    return _positions(pose_graph, poses, fixed)


def _positions(pose_graph: PoseGraph, poses: Array, fixed: IntArray) -> Array:
    """The best positions for given rotations, with what the rotation errors say about them through correlation.

    In the chart of `chart_between`, R_ij' (R_i' (t_j - t_i) - t_ij) is linear in positions.
    """
    group, edges = pose_graph.group, pose_graph.edges
    dim = group.point_dim
    turned = group.matrix(edges.measured)[:, :dim, :dim]
    to_edge = np.swapaxes(group.matrix(poses[edges.first])[:, :dim, :dim] @ turned, 1, 2)
    target = (np.swapaxes(turned, 1, 2) @ edges.measured[:, :dim, None]).copy()
    error = group.log(group.between(edges.measured, group.between(poses[edges.first], poses[edges.second])))
    inner, cross = edges.information[:, :dim, :dim], edges.information[:, :dim, dim:]
    # Omega_tt |t + Omega_tt^-1 Omega_tr r|^2: the cross term moves the target.
    target -= np.linalg.pinv(inner, hermitian=True) @ cross @ error[:, dim:, None]
    eigenvalues, vectors = np.linalg.eigh(inner)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
    block = root @ to_edge
    start = np.zeros((len(poses), dim, 1))
    start[fixed, :, 0] = poses[fixed, :dim]
    result = poses.copy()
    result[:, :dim] = block_least_squares(edges.first, edges.second, -block, block, root @ target, start, fixed)[..., 0]
    return result


def _rotation_information(information: Array, dim: int) -> Array:
    """Information about the rotation where the first ``dim`` coordinates are free: the Schur complement, (m, k, k)."""
    cross = information[:, dim:, :dim]
    inner = np.linalg.pinv(information[:, :dim, :dim], hermitian=True)
    return information[:, dim:, dim:] - cross @ inner @ np.swapaxes(cross, 1, 2)


def _tree_headings(pose_graph: PoseGraph, fixed: IntArray, variance: Array) -> Array:
    """(n,) headings along the paths of least variance, not wrapped: sums of measured turns from a fixed pose."""
    parent, edge, forward = _tree(pose_graph, fixed, variance, shortest=True)
    count = len(pose_graph.poses)
    total = np.zeros(count + 1)
    inner = np.flatnonzero(edge >= 0)
    total[inner] = np.where(forward[inner], 1.0, -1.0) * pose_graph.edges.measured[edge[inner], 2]
    total[fixed] = pose_graph.poses[fixed, 2]
    return _accumulated(parent, total, np.add)


def _accumulated(parent: IntArray, steps: Array, combine: Callable[[Array, Array], Array]) -> Array:
    """Combine steps from parents (n + 1, ...), that of the root n among them, from the root down: (n, ...).

    Every step begins at the parent, then at the grandparent, ...: as many rounds as the logarithm of the depth.
    """
    count = len(parent) - 1
    while np.any(parent[:count] != count):
        steps[:count] = combine(steps[parent[:count]], steps[:count])
        parent = parent[parent]
    return steps[:count].copy()


def _tree(pose_graph: PoseGraph, fixed: IntArray, cost: Array, shortest: bool) -> tuple[IntArray, IntArray, BoolArray]:
    """A spanning tree whose root, node n, stands above all fixed poses.

    Args:
        pose_graph: the graph.
        fixed: positions of the fixed poses.
        cost: (m,) of every edge, positive.
        shortest: whether the paths from the root are to be short, or the tree as a whole.

    Returns:
        (n + 1,) parents, the root being its own and that of every fixed pose; (n,) the edge to the parent, or -1; and
        (n,) whether that edge was measured from the parent.

    Raises:
        GraphError: a pose cannot be reached.
    """
    edges, count = pose_graph.edges, len(pose_graph.poses)
    parent, edge, forward = spanning_tree(edges.first, edges.second, cost, fixed, count, shortest)
    unreached = np.flatnonzero(parent < 0)
    if unreached.size:
        lost = int(unreached[0])
        raise GraphError(
            f"pose {pose_graph.ids[lost]} is connected to the fixed poses through landmarks only, or not at all: "
            "give its first guess yourself",
            family="poses",
            index=lost,
        )
    return parent, edge, forward


GUESSES += [odometric, chordal, lago]
