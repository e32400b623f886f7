"""The quadratic form of a pose graph: chordal costs, over rotations or over frames in a higher space.

With positions p_i in R^r and frames Y_i (r, d) of orthonormal columns, r >= d, the cost of an edge is

    |(Y_j - Y_i R) M|^2 + tau |p_j - p_i - Y_i t|^2

(Frobenius norm), which is quadratic in (p, Y). For r = d and determinant one these are the poses. The weights stand for
those of the logarithm to second order: rotation information Omega about an axis-angle error w gives
|(Exp(w) - I) M|^2 = w' Omega w with M^2 = tr(Omega)/2 I - Omega in space and M^2 = Omega/2 in the plane. D. Rosen,
L. Carlone, A. Bandeira, J. Leonard, "SE-Sync", IJRR 38(2-3), 2019, problem 1; its kappa is M^2 = kappa I.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.pose_graphs.information import bounded_below, indefinite
from unifg.pose_graphs.linear import with_rotations
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Relaxation", "admit", "sheared"]

ISOTROPIC = 1e-6  # of the largest eigenvalue: information matrices are written with six digits


def admit(pose_graph: PoseGraph) -> None:
    """See that a graph can be stated in this form, which can be known before it is solved.

    Raises:
        GraphError: the graph has landmarks, several poses of one part are known, or an information matrix is none.
    """
    if len(pose_graph.landmarks) or pose_graph.priors:
        found = "landmarks" if len(pose_graph.landmarks) else "priors"
        raise GraphError(f"the chordal relaxation holds relative poses only: this graph has {found}")
    information = pose_graph.edges.information
    if not (np.isfinite(information).all() and np.isfinite(pose_graph.edges.measured).all()):
        raise GraphError("the chordal relaxation needs finite measurements and information matrices")
    if (wrong := indefinite(information)).any():
        k = int(np.flatnonzero(wrong)[0])
        raise GraphError(
            f"the information of edge {k} has a negative eigenvalue, of {wrong.sum()} edges in all: see repaired",
            index=k,
        )
    anchors, parts = pose_graph.anchors()[0], pose_graph.parts()
    if len(np.unique(parts[anchors])) < len(anchors):
        raise GraphError("the chordal relaxation moves every connected part freely: two poses of one are known")


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Chordal costs of the edges of a pose graph.

    A point is (n, d + 1, r): of every pose its position, then the columns of its frame, as rows.

    Attributes:
        dim: d, 2 or 3.
        count: n.
        first, second: (m,) positions of the poses.
        by_first, by_second: (m, d + 1, d + 1) A and B of |A z_i + B z_j|^2.
        parts: (n,) number of the connected part of every pose.
        anchors: (parts,) a pose of each.
        caveats: sentences, what of the graph's weights this form cannot hold; empty when it holds all.
        pose_graph: the graph, with the edges that count.
    """

    dim: int
    count: int
    first: IntArray
    second: IntArray
    by_first: Array
    by_second: Array
    parts: IntArray
    anchors: IntArray
    caveats: tuple[str, ...]
    pose_graph: PoseGraph

    @classmethod
    def of(cls, pose_graph: PoseGraph, used: BoolArray | None = None) -> Relaxation:
        """State it; means stand for the weights that it cannot hold.

        Args:
            pose_graph: poses and edges.
            used: (m,) edges that count, say the inliers; all by default.

        Raises:
            GraphError: the graph has landmarks, or several poses of one part are known.
        """
        real = pose_graph.edges.first != pose_graph.edges.second
        kept = replace(pose_graph, edges=pose_graph.edges[real if used is None else used & real])
        edges, anchors, parts = kept.edges, kept.anchors()[0], kept.parts()
        admit(kept)
        dim, caveats = pose_graph.group.point_dim, list[str]()
        if not real.all():
            caveats.append(f"{(~real).sum()} edges from a pose to itself, which cost the same in any map, are left out")
        tau = np.trace(edges.information[:, :dim, :dim], axis1=1, axis2=2) / dim
        caveats += _lost(edges.information, dim, tau)
        by_first, by_second, bent = _weighed(kept, tau, edges.information[:, dim:, dim:])
        if bent:
            caveats.append(
                f"rotation information of {bent} edges is larger about one axis than about the others together: "
                "its mean stands for it"
            )
        count, order = len(pose_graph.poses), np.argsort(parts[anchors])
        ends = edges.first, edges.second
        return cls(dim, count, *ends, by_first, by_second, parts, anchors[order], tuple(caveats), kept)

    def below(self) -> Relaxation:
        """The same with weights that no information matrix lies below (`bounded_below`).

        This cost is at most that of the logarithm: |t| <= |v| and 2 sin(w / 2) <= w.
        """
        weights = bounded_below(self.pose_graph.edges.information, self.dim)
        by_first, by_second, _ = _weighed(self.pose_graph, *weights)
        return replace(self, by_first=by_first, by_second=by_second)

    def lift(self, pose_graph: PoseGraph) -> Array:
        """(n, d + 1, d) the point of a graph's poses."""
        matrices = pose_graph.group.matrix(pose_graph.poses)[:, : self.dim]
        return np.concatenate([matrices[:, None, :, self.dim], np.swapaxes(matrices[:, :, : self.dim], 1, 2)], axis=1)

    def lower(self, point: Array, pose_graph: PoseGraph) -> Array:
        """(n, storage) poses of a point of rank d, frames being rotations."""
        poses = with_rotations(pose_graph.group, pose_graph.poses, np.swapaxes(point[:, 1:], 1, 2))
        poses[:, : self.dim] = point[:, 0]
        return poses

    def errors(self, point: Array) -> Array:
        """(m, d + 1, r) whitened errors of the edges."""
        return self.by_first @ point[self.first] + self.by_second @ point[self.second]

    def cost(self, point: Array) -> float:
        """Sum of the squared errors: chi2 of the chordal residual."""
        return float(np.sum(self.errors(point) ** 2))

    def multipliers(self, point: Array) -> Array:
        """(n, d, d) Lambda_i = sym(G_i Y_i), multipliers of Y_i' Y_i = I, where G is half the gradient (eq. 106)."""
        return sheared(self.product(point), point)

    def product(self, point: Array) -> Array:
        """(n, d + 1, r) the quadratic times a point or a direction: half the slope of the cost."""
        out = np.zeros_like(point)
        _multiply(self.first, self.second, self.by_first, self.by_second, np.ascontiguousarray(point), out)
        return out

    def anchored(self, point: Array, like: Array) -> Array:
        """The same map of rank d, every part moved as a whole to where its anchor is in another."""
        # Columns of frames are rows here, turned from the right.
        turn = np.swapaxes(point[self.anchors, 1:], 1, 2) @ like[self.anchors, 1:]
        moved = point.copy()
        moved[:, 0] -= point[self.anchors, 0][self.parts]
        back: Array = moved @ turn[self.parts]
        back[:, 0] += like[self.anchors, 0][self.parts]
        return back


def _weighed(pose_graph: PoseGraph, tau: Array, turning: Array) -> tuple[Array, Array, int]:
    """A and B of edges with weights (m,) of translation and (m, k, k) of rotation; of how many a mean stands for it."""
    edges, dim = pose_graph.edges, pose_graph.group.point_dim
    mean = np.trace(turning, axis1=1, axis2=2)[:, None, None]
    squared = 0.5 * turning * np.eye(2) if dim == 2 else 0.5 * mean * np.eye(3) - turning
    lengths, axes = np.linalg.eigh(squared)
    bent = lengths[:, 0] < -ISOTROPIC * np.abs(lengths[:, -1])
    lengths[bent] = mean[bent, :, 0] / 6.0
    root = axes @ (np.sqrt(np.maximum(lengths, 0.0))[:, :, None] * np.swapaxes(axes, 1, 2))
    pull = np.sqrt(np.maximum(tau, 0.0))
    matrices = pose_graph.group.matrix(edges.measured)
    by_first = np.zeros((len(edges), dim + 1, dim + 1))
    by_second = np.zeros_like(by_first)
    by_first[:, 0, 0], by_second[:, 0, 0] = -pull, pull
    by_first[:, 0, 1:] = -pull[:, None] * matrices[:, :dim, dim]
    by_first[:, 1:, 1:] = -root @ np.swapaxes(matrices[:, :dim, :dim], 1, 2)
    by_second[:, 1:, 1:] = root
    return by_first, by_second, int(bent.sum())


def _lost(information: Array, dim: int, tau: Array) -> list[str]:
    """Sentences: directions of translation information, and couplings, that the form does not hold."""
    moving, turning = information[:, :dim, :dim], information[:, dim:, dim:]
    caveats = []
    crooked = ~_close(moving, tau[:, None, None] * np.eye(dim))
    if crooked.any():
        caveats.append(
            f"translation information of {crooked.sum()} edges is not the same in all directions: "
            "its mean stands for it"
        )
    # A coupling is small beside what it couples, in whatever units these are.
    coupled = ~_close(information[:, :dim, dim:], 0.0, np.sqrt(_greatest(moving) * _greatest(turning)))
    if coupled.any():
        caveats.append(f"{coupled.sum()} edges couple rotation and translation: the coupling is left out")
    return caveats


def _greatest(blocks: Array) -> Array:
    """(m,) the size of the largest entry of each block."""
    found: Array = np.abs(blocks).max(axis=(1, 2), initial=0.0)
    return found


def _close(found: Array, wanted: Array | float, size: Array | None = None) -> BoolArray:
    """(m,) whether blocks are as wanted, measured by their own size or by another (m,)."""
    return _greatest(found - wanted) <= ISOTROPIC * (_greatest(found) if size is None else size)


def sheared(moved: Array, point: Array) -> Array:
    """(n, d, d) sym(V Y'): what directions V (n, d + 1, r) do to the orthonormality of a point's frames Y."""
    product = moved[:, 1:] @ np.swapaxes(point[:, 1:], 1, 2)
    return 0.5 * (product + np.swapaxes(product, 1, 2))


@compiled
def _multiply(first: IntArray, second: IntArray, by_first: Array, by_second: Array, moved: Array, out: Array) -> None:
    """Add the quadratic's product with a direction to ``out``."""
    above, rank = moved.shape[1], moved.shape[2]
    error = np.empty(rank)
    for k in range(len(first)):
        i, j = first[k], second[k]
        for row in range(above):
            error[:] = 0.0
            for a in range(above):
                left, right = by_first[k, row, a], by_second[k, row, a]
                for c in range(rank):
                    error[c] += left * moved[i, a, c] + right * moved[j, a, c]
            for a in range(above):
                left, right = by_first[k, row, a], by_second[k, row, a]
                for c in range(rank):
                    out[i, a, c] += left * error[c]
                    out[j, a, c] += right * error[c]
