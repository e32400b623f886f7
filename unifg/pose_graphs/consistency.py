"""Loop closures that agree with each other pair by pair: a first stage that needs no guess but odometry.

Two closures and the odometry between their ends make a loop, which two right ones close but for noise. Of the graph
whose nodes are closures and whose edges are such pairs, a large clique is kept: a wrong closure would have to agree
with every other. J. Mangelson, D. Dominic, R. Eustice, R. Vasudevan, "Pairwise consistent measurement set maximization
for robust multi-robot map merging", ICRA 2018. The largest clique is hard to find; a greedy search from closures that
agree with most others finds one that nothing could join: B. Pattabiraman, M. Patwary, A. Gebremedhin, W. Liao,
A. Choudhary, "Fast algorithms for the maximum clique problem on massive graphs with applications to overlapping
community detection", Internet Mathematics 11(4-5), 2015. As many classes as it takes to have no two consistent closures
in one class are a bound on the largest clique, by which :func:`most_consistent` judges the answer of a robust solve.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from unifg.errors import GraphError, require_kinds
from unifg.factors.whitening import quick_roots
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.solution.chi_squared import upper_quantile
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["most_consistent", "pairwise_consistent"]

TRIES = 30  # closures from which a clique is grown
REFUSED = 0.01  # probability that any two of all right closures are taken for inconsistent
MOST = 3000  # closures that are compared for a bound, each with each


def pairwise_consistent(pose_graph: PoseGraph, probability: float = 0.9999, tries: int = TRIES) -> BoolArray:
    """Edges to keep: odometry, and a large set of closures of which every two are consistent.

    Drift is linearised at odometry: along drives whose heading is lost, right closures seem inconsistent. Closures
    between parts that odometry does not connect, such as the drives of two robots, are compared with others between the
    same parts. Edges whose information is singular say too little to be tested, and stay. Wrong closures that agree
    with each other, such as those of a street that looks like another, pass where they are more than the right ones.

    Args:
        pose_graph: relative poses; those in the graph do not matter.
        probability: that the loop of two right closures passes the chi-squared test. Every two of a thousand have to,
            so 0.99 loses a third of the right ones; with more nines, more wrong ones pass where odometry has drifted.
        tries: searches for a clique, each from another closure.

    Returns:
        (m,) True for the edges to be kept.

    Raises:
        GraphError: for a probability outside (0, 1), no tries, or arguments of another kind.
    """
    given = {"pose_graph": pose_graph, "probability": probability, "tries": tries}
    require_kinds("pairwise_consistent", GraphError, pairwise_consistent.__annotations__, given, PoseGraph)
    if not 0.0 < probability < 1.0 or tries < 1:
        raise GraphError(f"probability {probability} must be in (0, 1) and tries {tries} at least 1")
    certain, closures = _certain(pose_graph)
    keep: BoolArray = np.ones(len(certain), dtype=np.bool_)
    keep[closures] = False
    for own, agreeing in _agreements(pose_graph, certain, closures, probability):
        keep[own[_clique(agreeing, tries)]] = True
    return keep


def most_consistent(pose_graph: PoseGraph, used: BoolArray) -> int | None:
    """Bound on the number of loop closures of which every two are consistent with each other and with odometry.

    The closures that are used are among them, as the present poses show. All right closures of a graph are such a set
    with a probability of 99 %, so there are no more right ones than this. Drift is linearised at odometry and at the
    poses, and closures that either takes for consistent count as such.

    Args:
        pose_graph: at the answer of a robust solve.
        used: (m,) edges that it counts.

    Returns:
        The bound. None where odometry is left out, where there are more than 3000 closures, or where closures that are
        used seem inconsistent: the drive is too long for its drift to be linearised.
    """
    odometry, (certain, closures) = pose_graph.edges.odometry, _certain(pose_graph)
    count = len(closures)
    if count > MOST or not used[odometry].all():
        return None
    total, probability = int((~odometry).sum()) - count, 1.0 - REFUSED / max(count * (count - 1) // 2, 1)
    at_odometry, at_poses = (
        _agreements(pose_graph, certain, closures, probability, at) for at in (None, pose_graph.poses)
    )
    for (own, agreeing), (_, also) in zip(at_odometry, at_poses, strict=True):
        agreeing |= also
        kept = np.flatnonzero(used[own])
        if agreeing[np.ix_(kept, kept)].sum() < len(kept) * (len(kept) - 1):
            return None
        total += _classes(agreeing)
    return total


def _certain(pose_graph: PoseGraph) -> tuple[BoolArray, IntArray]:
    """Edges (m,) with information in every direction, and those of them that close loops between two poses (k,)."""
    edges, roots = pose_graph.edges, np.empty((1, pose_graph.group.dim**2))
    found = [quick_roots(np.ascontiguousarray(one[None]), roots) for one in edges.information]
    certain: BoolArray = np.array(found, dtype=np.bool_)
    return certain, np.flatnonzero(~edges.odometry & certain & (edges.first != edges.second))


def _agreements(
    pose_graph: PoseGraph, certain: BoolArray, closures: IntArray, probability: float, at: Array | None = None
) -> Iterator[tuple[IntArray, BoolArray]]:
    """Closures (k,) between each two parts that odometry connects, and which of them are consistent (k, k).

    Args:
        pose_graph: relative poses.
        certain: edges with information in every direction.
        closures: to compare.
        probability: that the loop of two right closures passes.
        at: (n, storage) poses at which drift is linearised; without them, those of odometry.
    """
    if not len(closures):
        return
    group, edges, dim = pose_graph.group, pose_graph.edges, pose_graph.group.dim
    poses, drift, gone, part = _drift(pose_graph, certain, at)
    first, second, measured = edges.first[closures], edges.second[closures], edges.measured[closures]
    covariance = np.linalg.inv(edges.information[closures]).astype(np.float64, copy=False)
    # Seen from the first end, whichever that is in the file.
    turned = first > second
    adjoint = group.adjoint(measured[turned])
    covariance[turned] = adjoint @ covariance[turned] @ np.swapaxes(adjoint, 1, 2)
    first, second = np.minimum(first, second), np.maximum(first, second)
    measured[turned] = group.inverse(measured[turned])
    # Where a closure carries the world to, seen from the world; the identity, had odometry not drifted.
    end = group.compose(poses[first], measured)
    offset = group.compose(end, group.inverse(poses[second]))
    across = group.adjoint(end)
    covariance = across @ covariance @ np.swapaxes(across, 1, 2)
    moved = gone[second] - gone[first]
    pairs = part[first] * (int(part.max(initial=0)) + 1) + part[second]
    bound = upper_quantile(dim, 1.0 - probability)
    for one in np.unique(pairs):
        own = np.flatnonzero(pairs == one)
        agreeing = np.zeros((len(own), len(own)), dtype=np.bool_)
        for k in range(len(own) - 1):
            a, others = own[k], own[k + 1 :]
            error = group.log(group.compose(offset[a], group.inverse(offset[others]))) - moved[a] + moved[others]
            spread = covariance[a] + covariance[others]
            for ends in (first, second):  # the way between closures that do not overlap counts twice: on the safe side
                spread += drift[np.maximum(ends[a], ends[others])] - drift[np.minimum(ends[a], ends[others])]
            squared = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[:, :, None])[:, :, 0])
            agreeing[k, k + 1 :] = (squared >= 0.0) & (squared <= bound)
        agreeing |= agreeing.T
        yield closures[own], agreeing


def _drift(pose_graph: PoseGraph, certain: BoolArray, at: Array | None) -> tuple[Array, Array, Array, IntArray]:
    """Along odometry, seen from the start: poses, the covariance and the sum of its errors, and parts.

    Errors that are seen from one place add up, so the drift between two poses is the difference of their covariances.

    Returns:
        Poses (n, storage), those of odometry where none are given; covariances (n, d, d), errors (n, d), parts (n,).
    """
    group, edges, count = pose_graph.group, pose_graph.edges, len(pose_graph.poses)
    step = np.full(count, -1, dtype=np.intp)  # the edge from the pose before
    along = np.flatnonzero(edges.odometry & certain)[::-1]
    step[np.maximum(edges.first[along], edges.second[along])] = along
    forward = edges.first[step] < edges.second[step]
    noise = np.linalg.inv(np.where(step[:, None, None] >= 0, edges.information[step], np.eye(group.dim)))
    moved = np.where(forward[:, None], edges.measured[step], group.inverse(edges.measured[step]))
    back = group.adjoint(edges.measured[step])
    noise = np.where(forward[:, None, None], noise, back @ noise @ np.swapaxes(back, 1, 2))
    poses = at
    if poses is None:
        poses = np.tile(group.identity(), (count, 1))
        for k in np.flatnonzero(step >= 0):
            poses[k] = group.compose(poses[k - 1], moved[k])
    ends = group.compose(poses[np.arange(count) - 1], moved)
    seen = group.adjoint(ends)
    added = np.where(step[:, None, None] >= 0, seen @ noise @ np.swapaxes(seen, 1, 2), 0.0)
    errors = np.where(step[:, None] >= 0, group.log(group.compose(ends, group.inverse(poses))), 0.0)
    return poses, np.cumsum(added, axis=0), np.cumsum(errors, axis=0), np.cumsum(step < 0)


def _clique(agreeing: BoolArray, tries: int) -> IntArray:
    """Nodes of a large clique: grown from each of the nodes of most neighbours, by those of most neighbours first."""
    degree = agreeing.sum(axis=1)
    order = np.argsort(-degree, kind="stable")
    ranked = agreeing[order][:, order]  # so that the first of the candidates is the best
    best = np.zeros(0, dtype=np.intp)
    for begin in range(min(tries, len(order))):
        if degree[order[begin]] + 1 <= len(best):
            break
        members, candidates = [begin], ranked[begin].copy()
        while candidates.any():
            member = int(candidates.argmax())
            members.append(member)
            candidates &= ranked[member]
        if len(members) > len(best):
            best = np.array(members, dtype=np.intp)
    return order[best]


def _classes(agreeing: BoolArray) -> int:
    """Number of classes, greedily made, of which none holds two nodes that agree: no clique is larger."""
    count, taken = 0, np.zeros_like(agreeing)  # by class: nodes that agree with one of it
    for node in np.argsort(-agreeing.sum(axis=1), kind="stable"):
        free = np.flatnonzero(~taken[:count, node])
        place = int(free[0]) if len(free) else count
        count = max(count, place + 1)
        taken[place] |= agreeing[node]
    return count
