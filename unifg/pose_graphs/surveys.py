"""Surveys of landmarks that all others contradict: sightings from one stretch of a drive with an error in common.

Where landmarks were taken for others that lie alike, or a sensor was out of place for a while, all sightings of a
stretch are wrong by one rigid motion between its poses and the landmarks. The test is that of closures between two
stretches (:mod:`unifg.pose_graphs.clusters`), the motion being one of the poses in these sightings alone. Least squares
lay such an error on odometry, as two slips: stretches are looked at that begin and end where single steps of odometry
are contradicted most. The survey without which chi2 falls most is taken out, and the rest is solved again. A step of
odometry or a single sighting that explains as much is not laid on a survey.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np

from unifg.pose_graphs.clusters import AS_MUCH, ODOMETRY, ROUNDS, Map, limit_of, over_stated
from unifg.pose_graphs.pose_graph import PoseGraph, ResidualName, Sightings
from unifg.pose_graphs.verdict import Cluster
from unifg.typing import Array, IntArray

__all__ = ["surveys"]

PEAKS = 8  # steps of odometry at which stretches may begin or end
APART = 3  # steps
FEWEST = 3  # sightings


def surveys(pose_graph: PoseGraph, freedom: int, residual: ResidualName = "log") -> tuple[list[Cluster], PoseGraph]:
    """Surveys that all others contradict, the largest fall first, and the graph without them at its optimum.

    Args:
        pose_graph: with poses from which plain least squares reach its map.
        freedom: its degrees of freedom.
        residual: as for `PoseGraph.graph`.
    """
    found: list[Cluster] = []
    if not pose_graph.sightings:
        return found, pose_graph
    dim, every = pose_graph.group.dim, np.ones(len(pose_graph.edges), dtype=np.bool_)
    count = len(pose_graph.poses) ** 2 // 2  # of stretches, from which the worst are chosen
    places = {kind: np.arange(len(seen)) for kind, seen in pose_graph.sightings.items()}
    now = Map(pose_graph, every, residual)
    while now.innovations.determined and len(found) < ROUNDS:
        best: tuple[float, str, IntArray, float, float] | None = None
        alone = now.alone()
        for kind, seen in now.graph.sightings.items():
            groups = _stretches(now.graph, seen, alone)
            if groups:
                fall, _, leverage, moved = now.surveys(kind, groups)
                k = int(fall.argmax())
                if best is None or fall[k] > best[0]:
                    best = float(fall[k]), kind, groups[k], float(leverage[k]), float(moved[k])
        if best is None:
            break
        fall_of, kind, group, share, deviations = best
        rest = now.chi2 - fall_of
        limit = over_stated(rest, freedom - dim) * limit_of(rest, freedom - dim, dim, count)
        others = max(alone.max(initial=0.0) * ODOMETRY, now.single(kind, group).max() / AS_MUCH)
        if not fall_of > max(limit, others):
            break
        seen = now.graph.sightings[kind]
        kept = np.setdiff1d(np.arange(len(seen)), group)
        left = Map(replace(now.graph, sightings={**now.graph.sightings, kind: seen[kept]}), every, residual)
        if not left.innovations.determined:
            break
        here, there = now.graph, left.graph
        rows = int(np.linalg.matrix_rank(seen.information[group], hermitian=True).sum())
        apart = np.linalg.norm(here.group.local(here.poses, there.poses)[:, here.group.point_dim :], axis=1).max()
        size = here.group.point_dim
        away = np.linalg.norm(here.poses[:, :size] - there.poses[:, :size], axis=1).max()
        chi2 = there.with_poses(here.poses, here.landmarks).chi2(residual), left.chi2
        ends = np.sort(here.ids[seen.pose[group]]), np.sort(here.landmark_ids[seen.landmark[group]])
        stretches = np.stack([end[[0, -1]] for end in ends])
        none = np.zeros(0, dtype=np.intp)
        found.append(
            Cluster(
                "survey", none, stretches, fall_of, share, deviations, (float(away), float(apart)), chi2,
                (kind, places[kind][group]),
            )
        )  # fmt: skip
        places[kind], freedom, now = places[kind][kept], freedom - rows, left
    return found, now.graph


def _stretches(pose_graph: PoseGraph, seen: Sightings, alone: Array) -> list[IntArray]:
    """Groups of sightings of several landmarks that others determine, between steps that are contradicted most."""
    edges, landmarks, size = pose_graph.edges, len(pose_graph.landmarks), seen.measured.shape[1]
    ends = np.maximum(edges.first, edges.second)[edges.odometry]
    begins = np.ones(len(pose_graph.poses) + 1, dtype=np.bool_)  # of runs of odometry
    begins[ends] = False
    against = np.zeros(len(begins))
    np.maximum.at(against, ends, alone[edges.odometry])
    around = np.lib.stride_tricks.sliding_window_view(np.pad(against, APART), 2 * APART + 1).max(axis=1)
    peaks = np.flatnonzero((against > 0.0) & (against == around))
    peaks = np.sort(peaks[np.argsort(-against[peaks], kind="stable")[:PEAKS]])
    runs, groups = np.flatnonzero(begins), list[IntArray]()
    for start, stop in pairwise(runs):
        cuts = np.concatenate([[start], peaks[(peaks > start) & (peaks < stop)], [stop]])
        for a, b in combinations(cuts.tolist(), 2):
            own = np.flatnonzero((seen.pose >= a) & (seen.pose < b))
            others = np.bincount(np.delete(seen.landmark, own), minlength=landmarks)
            own = own[size * others[seen.landmark[own]] >= pose_graph.landmarks.shape[1]]
            if len(own) >= FEWEST and len(np.unique(seen.landmark[own])) > 1:
                groups.append(own)
    return groups
