"""Whether the best map has been found: the dual of the chordal relaxation, and the way down where it has not.

At a stationary point of the chordal cost (:mod:`unifg.pose_graphs.relaxation`), its multipliers Lambda give the
matrix S = Q - diag(0, Lambda_i) over positions and columns of frames. If S + e I >= 0 on the frames, no poses whatever
cost less than the dual value sum tr(Lambda_i) - e d n. A negative eigenvalue is a way out through frames of one
dimension more (the Riemannian staircase); from there the cost falls, and what is found is moved back to rotations.
D. Rosen, L. Carlone, A. Bandeira, J. Leonard, "SE-Sync", IJRR 38(2-3), 2019, theorem 7 and section 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unifg.errors import GraphError
from unifg.pose_graphs.linear import BlockQuadratic
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.pose_graphs.relaxation import Relaxation
from unifg.typing import Array, BoolArray

__all__ = ["Certificate", "certify"]

ROUNDING = 1e-13  # of the sum of all weights: what sums of squares are worth
RANKS = 5  # dimensions added to those of the world, at most
STEPS = 40  # halvings on the way out of a saddle


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is known about the lowest chordal cost of a pose graph.

    Attributes:
        certified: whether the cost at `poses` is proven to be the lowest, but for `gap`.
        chi2: chordal cost at `poses`, with the weights of the graph.
        gap: by how much another map could be better at most; below `tolerance` it is certified.
        tolerance: what the gap is compared with.
        least_eigenvalue: of the dual matrix on the frames; negative where the relaxation shows a way down.
        poses: (n, storage) stationary point of the chordal cost that was judged, anchors where they were.
        moved: greatest distance [m] and turn [rad] from the poses given to those.
        rank: dimension of the frames in which the staircase ended; that of the world where it was not climbed.
        caveats: what of the graph's weights the chordal cost does not hold.
    """

    certified: bool
    chi2: float
    gap: float
    tolerance: float
    least_eigenvalue: float
    poses: Array
    moved: tuple[float, float]
    rank: int
    caveats: tuple[str, ...]

    def sentence(self) -> str:
        """What may be said, and what not."""
        near = f"{self.moved[0]:.2g} m and {self.moved[1]:.2g} rad from the poses given"
        if self.certified:
            text = f"no map has a lower chordal chi2 than {self.chi2:.6g} (but for {self.gap:.1g}), reached {near}"
        else:
            text = (
                f"not certified: a map with a chordal chi2 as low as {max(self.chi2 - self.gap, 0.0):.6g} is not "
                f"excluded where {self.chi2:.6g} was reached, {near}"
            )
        return "; ".join([text, *self.caveats, "nothing is claimed of other residuals or of robust losses"])


def certify(
    pose_graph: PoseGraph, *, used: BoolArray | None = None, staircase: bool = False, tolerance: float = 1e-6
) -> Certificate:
    """Judge the map near a graph's present poses.

    The nearest minimum of the chordal cost is found first; it is that cost's global optimality that is judged.

    Args:
        pose_graph: with poses that solve it, in whatever residual; relative poses only.
        used: (m,) edges that count, say the inliers of a robust solve; all by default.
        staircase: where there is a way down, follow it.
        tolerance: of the gap, relative to chi2.

    Raises:
        GraphError: the graph has landmarks, several poses of one part are known, or `used` is something else than one
            truth value for each edge.
    """
    chosen = None if used is None else np.asarray(used)
    if chosen is not None and (chosen.shape != (len(pose_graph.edges),) or chosen.dtype != np.bool_):
        raise GraphError(
            f"used has shape {chosen.shape} and holds {chosen.dtype}: expected ({len(pose_graph.edges)},) of bool, "
            "one for each edge"
        )
    # Weights of positions and of frames are added up below: the unit of length is the graph's own, not the file's.
    unit = _length(pose_graph, chosen)
    problem = Relaxation.of(_measured_in(pose_graph, unit), chosen)
    judge = _Judge(problem, tolerance)
    # Seen from the anchor of its part, a pose keeps its digits wherever the map lies.
    shift = pose_graph.poses[problem.anchors][problem.parts, : problem.dim]
    near = pose_graph.poses.copy()
    near[:, : problem.dim] = (near[:, : problem.dim] - shift) / unit
    point = problem.minimize(problem.lift(pose_graph.with_poses(near)))
    verdict = judge(point)
    rank = problem.dim
    if staircase and not verdict.proven:
        point, rank, bound = _climb(problem, judge, point, verdict)
        verdict = judge(point)
        verdict = replace(verdict, gap=min(verdict.gap, max(verdict.cost - bound, 0.0)))
    poses = problem.lower(point, pose_graph)
    poses[:, : problem.dim] = poses[:, : problem.dim] * unit + shift
    poses[problem.anchors] = pose_graph.poses[problem.anchors]
    apart = pose_graph.group.local(pose_graph.poses, poses)
    turned = np.linalg.norm(apart[:, problem.dim :], axis=1)
    shifted = np.linalg.norm(poses[:, : problem.dim] - pose_graph.poses[:, : problem.dim], axis=1)
    moved = float(shifted.max(initial=0.0)), float(turned.max(initial=0.0))
    return Certificate(
        verdict.proven, verdict.cost, verdict.gap, verdict.tolerance, verdict.least, poses, moved, rank, problem.caveats
    )


def _length(pose_graph: PoseGraph, used: BoolArray | None) -> float:
    """The length of a typical step, by which the certificate measures: root of the weighted mean square; 1 for none."""
    dim, edges = pose_graph.group.point_dim, pose_graph.edges if used is None else pose_graph.edges[used]
    with np.errstate(all="ignore"):
        weight = np.trace(edges.information[:, :dim, :dim], axis1=1, axis2=2)
        squared = np.sum(weight * np.sum(edges.measured[:, :dim] ** 2, axis=1)) / np.sum(weight)
    return float(np.sqrt(squared)) if 0.0 < squared < np.inf else 1.0


def _measured_in(pose_graph: PoseGraph, unit: float) -> PoseGraph:
    """The same graph in another unit of length: its costs stay."""
    dim, edges = pose_graph.group.point_dim, pose_graph.edges
    poses, measured = pose_graph.poses.copy(), edges.measured.copy()
    poses[:, :dim] /= unit
    measured[:, :dim] /= unit
    by = np.where(np.arange(pose_graph.group.dim) < dim, unit, 1.0)
    information = edges.information * by[:, None] * by
    return replace(pose_graph, poses=poses, edges=replace(edges, measured=measured, information=information))


@dataclass(frozen=True, eq=False)
class _Verdict:
    """cost, gap and what it must be below; least eigenvalue, and its direction (n, d + 1)."""

    cost: float
    gap: float
    tolerance: float
    least: float
    direction: Array

    @property
    def proven(self) -> bool:
        return self.gap <= self.tolerance


class _Judge:
    """The dual matrix of one relaxation: its pattern is analysed once."""

    def __init__(self, problem: Relaxation, tolerance: float) -> None:
        self.problem, self.relative = problem, tolerance
        self.quadratic = BlockQuadratic(
            problem.first, problem.second, problem.count, problem.dim + 1, np.zeros(0, dtype=np.intp)
        )
        self.weight = float(np.sum(problem.by_first**2) + np.sum(problem.by_second**2))
        self.anchor = float(np.max(problem.by_second**2, initial=0.0)) or 1.0

    def __call__(self, point: Array) -> _Verdict:
        problem, dim = self.problem, self.problem.dim
        cost, multipliers = problem.cost(point), problem.multipliers(point)
        tolerance = self.relative * cost + ROUNDING * self.weight
        frames = dim * problem.count
        own = np.zeros((problem.count, dim + 1, dim + 1))
        own[:, 1:, 1:] = -multipliers
        own[problem.anchors, 0, 0] = self.anchor  # shifting all of a part changes nothing: one place may be held
        entries = self.quadratic.entries(problem.by_first, problem.by_second, own)
        system = self.quadratic.factorization
        lifted = np.tile(np.arange(dim + 1) > 0, problem.count).astype(np.float64)
        beyond = max(cost - float(np.trace(multipliers, axis1=1, axis2=2).sum()), 0.0)
        shift = 0.5 * tolerance / frames
        greatest = 1e3 * self.weight
        if not self.weight > 0.0:  # every map costs nothing
            return _Verdict(cost, 0.0, tolerance, 0.0, np.zeros((problem.count, dim + 1)))
        largest = (tolerance - beyond) / frames * (1.0 - 1e-9)  # that still proves what is asked
        while not (system.factor(entries, shift * lifted) and system.definite):
            shift = largest if shift < largest else 10.0 * shift
            if not shift < greatest:
                return _Verdict(cost, np.inf, tolerance, -np.inf, np.zeros((problem.count, dim + 1)))
        proven = beyond + shift * frames
        if proven <= tolerance:
            return _Verdict(cost, proven, tolerance, -shift, np.zeros((problem.count, dim + 1)))
        places = np.flatnonzero(lifted)
        whole = np.zeros(len(lifted))

        def inverse(right: Array) -> Array:
            whole[:] = 0.0
            whole[places] = right.ravel()
            return system.solve(whole)[places]

        from scipy.sparse.linalg import LinearOperator, eigsh  # slow to load, and seldom needed

        operator = LinearOperator((len(places), len(places)), matvec=inverse, dtype=np.float64)
        start = np.random.default_rng(0).standard_normal(len(places))
        values, vectors = eigsh(operator, k=1, which="LA", v0=start, tol=1e-6)
        least = 1.0 / float(values[0]) - shift
        whole[:] = 0.0
        whole[places] = vectors[:, 0]
        direction = system.solve(whole).reshape(problem.count, dim + 1) / float(values[0])
        # The eigenvalue is found to its own tolerance; what is proven is the shift that could be factorised.
        for share in (1.001, 1.01, 1.1):
            nearer = max(-least * share, 0.5 * tolerance / frames)
            if nearer < shift and system.factor(entries, nearer * lifted) and system.definite:
                proven = beyond + nearer * frames
                break
        return _Verdict(cost, proven, tolerance, least, direction)


def _climb(problem: Relaxation, judge: _Judge, point: Array, verdict: _Verdict) -> tuple[Array, int, float]:
    """Follow the way down through more dimensions until there is none, and come back to rotations.

    Returns:
        The point of rank d, the rank reached, and what no map costs less than, as proven there.
    """
    lifted = point
    while not verdict.proven and lifted.shape[2] < problem.dim + RANKS:
        lifted = problem.minimize(_leave(problem, lifted, verdict.direction))
        verdict = judge(lifted)
    returned = problem.minimize(_rounded(problem, lifted, point))
    return (
        (returned if problem.cost(returned) < problem.cost(point) else point),
        lifted.shape[2],
        verdict.cost - verdict.gap,
    )


def _leave(problem: Relaxation, point: Array, direction: Array) -> Array:
    """A point of lower cost with one dimension more, along the direction of negative curvature."""
    lifted = np.concatenate([point, np.zeros((*point.shape[:2], 1))], axis=2)
    cost, step = problem.cost(point), 1.0 / max(float(np.abs(direction[:, 1:]).max()), 1e-300)
    for _ in range(STEPS):
        trial = lifted.copy()
        trial[:, :, -1] += step * direction
        left, _, right = np.linalg.svd(trial[:, 1:], full_matrices=False)
        trial[:, 1:] = left @ right
        if problem.cost(trial) < cost:
            return trial
        step *= 0.5
    return lifted


def _rounded(problem: Relaxation, lifted: Array, like: Array) -> Array:
    """The nearest point of rank d whose frames are rotations, anchors where they were."""
    dim = problem.dim
    columns = lifted[:, 1:].reshape(-1, lifted.shape[2])
    across = np.linalg.svd(columns, full_matrices=False)[2][:dim]
    flat = lifted @ across.T
    if np.sum(np.linalg.det(flat[:, 1:]) < 0.0) > 0.5 * problem.count:
        flat[:, :, 0] *= -1.0
    left, _, right = np.linalg.svd(flat[:, 1:])
    left[np.linalg.det(left @ right) < 0.0, :, -1] *= -1.0
    flat[:, 1:] = left @ right
    # Every part back to where its anchor is; columns of frames are rows here, turned from the right.
    turn = np.swapaxes(flat[problem.anchors, 1:], 1, 2) @ like[problem.anchors, 1:]
    flat[:, 0] -= flat[problem.anchors, 0][problem.parts]
    back: Array = flat @ turn[problem.parts]
    back[:, 0] += like[problem.anchors, 0][problem.parts]
    return back
