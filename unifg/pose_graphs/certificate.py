"""Global optimality of a pose graph's map: the dual of the chordal relaxation, and the way down to a better map.

At a stationary point of the chordal cost (:mod:`unifg.pose_graphs.relaxation`), its multipliers Lambda give the
matrix S = Q - diag(0, Lambda_i) over positions and columns of frames. If S + e I >= 0 on the frames, no poses whatever
cost less than the dual value sum tr(Lambda_i) - e d n. A negative eigenvalue is a way out through frames of one
dimension more (the Riemannian staircase); from there the cost falls, and the result is moved back to rotations.
D. Rosen, L. Carlone, A. Bandeira, J. Leonard, "SE-Sync", IJRR 38(2-3), 2019, theorem 7 and section 4.3.

The dual is held against the cost of the poses that are given. The stationary point only serves to find it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unifg.errors import GraphError
from unifg.pose_graphs.descent import Descent
from unifg.pose_graphs.linear import polar
from unifg.pose_graphs.pose_graph import PoseGraph, ResidualName
from unifg.pose_graphs.relaxation import Relaxation
from unifg.pose_graphs.verdict import Certificate
from unifg.solvers.least_squares import LevenbergMarquardt
from unifg.typing import Array, BoolArray

__all__ = ["certify"]

ROUNDING = 1e-13  # of the sum of all weights: what sums of squares are worth
RANKS = 2, 3  # dimensions added to those of the world, and then to these
CLIMBED = 1e-12  # of the cost, what a descent over more dimensions leaves
STEPS, BESIDE = 40, 0.01  # halvings on the way out of a saddle, and steps along further ways beside the first


def certify(
    pose_graph: PoseGraph,
    *,
    used: BoolArray | None = None,
    staircase: bool = False,
    better: bool = True,
    tolerance: float = 1e-6,
    residual: ResidualName = "log",
) -> Certificate:
    """Bound what a map can gain over a graph's present poses.

    The chordal cost of these poses is compared with the dual of its relaxation. The dual is taken at the stationary
    point of that cost near them. Where the comparison fails, a solve of plain squares begins there, if asked for.

    Args:
        pose_graph: with poses that solve it, in whatever residual; relative poses only.
        used: (m,) edges that count, say the inliers of a robust solve. The interval is left out where it is given:
            it is one of plain squares over all edges.
        staircase: where there is a way down, follow it.
        better: whether to look for a better map where the comparison fails.
        tolerance: of the gap, relative to chi2.
        residual: by which a better map is looked for; the interval is that of the logarithm.

    Raises:
        GraphError: the graph has landmarks, several poses of one part are known, the tolerance is negative, or `used`
            is something else than one truth value for each edge.
    """
    if not tolerance >= 0.0:
        raise GraphError(f"the tolerance must not be negative, found {tolerance}")
    chosen = None if used is None else require_one_for_each(pose_graph, used)
    # Weights of positions and of frames are added up below: the unit of length is the graph's own, not the file's.
    unit = _length(pose_graph, chosen)
    scaled = _measured_in(pose_graph, unit)
    problem = Relaxation.of(scaled, chosen)
    # Seen from the anchor of its part, a pose keeps its digits wherever the map lies.
    shift = pose_graph.poses[problem.anchors][problem.parts, : problem.dim]
    near = pose_graph.poses.copy()
    near[:, : problem.dim] = (near[:, : problem.dim] - shift) / unit
    start = problem.lift(pose_graph.with_poses(near))
    judge = _Judge(problem, tolerance)
    point, verdict, rank, dual = _bound(judge, start, staircase)
    chi2 = problem.cost(start)
    allowed = judge.allowed(chi2)
    poses = problem.lower(point, pose_graph)
    poses[:, : problem.dim] = poses[:, : problem.dim] * unit + shift
    poses[problem.anchors] = pose_graph.poses[problem.anchors]
    apart = pose_graph.group.local(pose_graph.poses, poses)
    turned = np.linalg.norm(apart[:, problem.dim :], axis=1)
    shifted = np.linalg.norm(poses[:, : problem.dim] - pose_graph.poses[:, : problem.dim], axis=1)
    moved = float(shifted.max(initial=0.0)), float(turned.max(initial=0.0))
    interval, missing = None, ""
    if residual != "log" or chosen is not None:
        missing = f"the residual is {residual!r}" if residual != "log" else "edges were chosen, or have a robust loss"
    else:
        least = problem.below()
        whole = float(pose_graph.squared_errors().sum()) if len(pose_graph.edges) else 0.0
        # Where nothing was lost, both are one problem.
        same = np.allclose(least.by_first, problem.by_first, rtol=1e-12, atol=0.0)
        lower = dual if same else _bound(_Judge(least, tolerance), start, staircase)[3]
        interval = min(lower, whole), whole
    found = Certificate(
        chi2 - dual <= allowed, chi2, dual, max(chi2 - dual, 0.0), allowed, verdict.least, poses, moved, rank,
        problem.caveats, interval, missing,
    )  # fmt: skip
    return found if found.certified or not better else _improved(found, pose_graph, chosen, tolerance, residual)


def require_one_for_each(pose_graph: PoseGraph, used: BoolArray | None) -> BoolArray:
    """(m,) truth values of the edges that count, all of them for None.

    Raises:
        GraphError: they are something else than one truth value for each edge.
    """
    count = len(pose_graph.edges)
    chosen = np.ones(count, dtype=np.bool_) if used is None else np.asarray(used)
    if chosen.shape != (count,) or chosen.dtype != np.bool_:
        raise GraphError(
            f"used has shape {chosen.shape} and holds {chosen.dtype}: expected ({count},) of bool, one for each edge"
        )
    return chosen


def _bound(judge: _Judge, start: Array, staircase: bool) -> tuple[Array, _Verdict, int, float]:
    """Stationary point near a start, what is known there, the rank reached, and what no poses cost less than."""
    problem = judge.problem
    point = judge.descent.minimize(start)
    verdict = judge(point)
    rank, dual = problem.dim, verdict.dual
    if staircase and not verdict.proven:
        point, rank, bound = _climb(judge, point, verdict)
        verdict = judge(point)
        dual = max(verdict.dual, bound)
    return point, verdict, rank, max(dual, 0.0)


def _improved(
    found: Certificate, pose_graph: PoseGraph, used: BoolArray | None, tolerance: float, residual: ResidualName
) -> Certificate:
    """Solve plain squares from the stationary point, and hand over the result where it is better."""
    judged = pose_graph if used is None else replace(pose_graph, edges=pose_graph.edges[used])
    here = float(judged.squared_errors(residual).sum())
    graph, x, guess = judged.with_poses(found.poses).graph(residual=residual)
    solution = LevenbergMarquardt().solve(graph, guess)
    there = float(judged.with_poses(solution[x]).squared_errors(residual).sum())
    if not there < (1.0 - tolerance) * here:
        return found
    return replace(found, better=solution[x], better_chi2=(here, there))


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
    """cost of a point, what no point costs less than, how far they may be apart; least eigenvalue, ways down.

    The ways are (n, d + 1, k), the steepest first; their frames are orthonormal.
    """

    cost: float
    dual: float
    tolerance: float
    least: float
    ways: Array

    @property
    def proven(self) -> bool:
        return self.cost - self.dual <= self.tolerance


class _Judge:
    """The dual matrix of one relaxation: its pattern is analysed once."""

    def __init__(self, problem: Relaxation, tolerance: float) -> None:
        self.problem, self.relative, self.descent = problem, tolerance, Descent(problem)
        self._factorization = self.descent.factorization.twin()
        self.weight = float(np.sum(problem.by_first**2) + np.sum(problem.by_second**2))

    def allowed(self, cost: float) -> float:
        """Gap that a cost may have."""
        return self.relative * cost + ROUNDING * self.weight

    def __call__(self, point: Array) -> _Verdict:
        problem, dim = self.problem, self.problem.dim
        cost, multipliers = problem.cost(point), problem.multipliers(point)
        tolerance = self.allowed(cost)
        frames = dim * problem.count
        entries, system, lifted = self.descent.entries(multipliers), self._factorization, self.descent.frames
        value = min(float(np.trace(multipliers, axis1=1, axis2=2).sum()), cost)  # of the dual; more is rounding
        nowhere = np.zeros((problem.count, dim + 1, sum(RANKS)))
        shift = 0.5 * tolerance / frames
        greatest = 1e3 * self.weight
        if not self.weight > 0.0:  # every map costs nothing
            return _Verdict(cost, cost, tolerance, 0.0, nowhere)
        largest = (tolerance - (cost - value)) / frames * (1.0 - 1e-9)  # that still proves what is asked
        while not (system.factor(entries, shift * lifted) and system.definite):
            shift = largest if shift < largest else 10.0 * shift
            if not shift < greatest:
                return _Verdict(cost, -np.inf, tolerance, -np.inf, nowhere)
        dual = value - shift * frames
        if cost - dual <= tolerance:
            return _Verdict(cost, dual, tolerance, -shift, nowhere)
        places = np.flatnonzero(lifted)

        def solved(right: Array) -> Array:
            whole = np.zeros(len(lifted))
            whole[places] = right.ravel()
            return system.solve(whole)

        from scipy.sparse.linalg import LinearOperator, eigsh  # slow to load, and seldom needed

        operator = LinearOperator((len(places), len(places)), matvec=lambda x: solved(x)[places], dtype=np.float64)
        start = np.random.default_rng(0).standard_normal(len(places))
        values, vectors = eigsh(operator, k=min(sum(RANKS), len(places) - 1), which="LA", v0=start, tol=1e-6)
        least = 1.0 / float(values[-1]) - shift
        found = [solved(vectors[:, k]).reshape(problem.count, dim + 1) / values[k] for k in range(len(values))]
        ways = np.stack(found[::-1], axis=2)
        # The eigenvalue is found to its own tolerance; what is proven is the shift that could be factorised.
        for share in (1.001, 1.01, 1.1):
            nearer = max(-least * share, 0.5 * tolerance / frames)
            if nearer < shift and system.factor(entries, nearer * lifted) and system.definite:
                dual = value - nearer * frames
                break
        return _Verdict(cost, dual, tolerance, least, ways)


def _climb(judge: _Judge, point: Array, verdict: _Verdict) -> tuple[Array, int, float]:
    """Follow the ways down through more dimensions until there is none, and come back to rotations.

    Returns:
        The point of rank d, the rank reached, and what no map costs less than, as proven there.
    """
    problem, lifted = judge.problem, point
    for added in RANKS:
        if not verdict.proven:
            lifted = judge.descent(_leave(problem, lifted, verdict.ways[:, :, :added]), CLIMBED)
            verdict = judge(lifted)
    returned = judge.descent.minimize(_rounded(problem, lifted, point))
    return (
        (returned if problem.cost(returned) < problem.cost(point) else point),
        lifted.shape[2],
        verdict.dual,
    )


def _leave(problem: Relaxation, point: Array, ways: Array) -> Array:
    """A point of lower cost with more dimensions: far along the steepest way, a little along the others."""
    lifted = np.concatenate([point, np.zeros((*point.shape[:2], ways.shape[2]))], axis=2)
    cost, step = problem.cost(point), 1.0 / max(float(np.abs(ways[:, 1:, 0]).max()), 1e-300)
    shares = np.where(np.arange(ways.shape[2]) == 0, 1.0, BESIDE)
    for _ in range(STEPS):
        trial = lifted.copy()
        trial[:, :, point.shape[2] :] = step * shares * ways
        trial[:, 1:] = polar(trial[:, 1:])
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
    return problem.anchored(flat, like)
