"""Verdict on the map of a pose graph: bounds, other basins, and clusters of closures, by the effort that is allowed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np

from unifg.errors import GraphError
from unifg.pose_graphs.certificate import certify, require_one_for_each
from unifg.pose_graphs.clusters import Search, optimum, search
from unifg.pose_graphs.consistency import most_consistent
from unifg.pose_graphs.initialise import odometric, starts
from unifg.pose_graphs.judgement import judge
from unifg.pose_graphs.pose_graph import JUDGES, PoseGraph, ResidualName
from unifg.pose_graphs.surveys import surveys
from unifg.pose_graphs.verdict import NAMED, Certificate, Cluster, Effort, Verdict
from unifg.typing import Array, BoolArray, IntArray

__all__: list[str] = []

SAME = 1e-3  # relative difference of chi2 up to which minima count as one
LOWER = 1e-4  # share of chi2 by which another basin has to be better: it is solved to within 1e-5
ROUNDED = 1e-16  # of all weights: residuals of 1e-8 m and rad, which tell no map from another


def _verdict(
    pose_graph: PoseGraph, effort: Effort, residual: ResidualName, used: BoolArray | None, tolerance: float
) -> Verdict:
    """Compute the verdict; see `PoseGraph.verdict`."""
    if effort not in ("cheap", "full"):
        raise GraphError(f"effort is {effort!r}: expected 'cheap' or 'full'")
    seconds: dict[str, float] = {}
    counts = require_one_for_each(pose_graph, used)
    judged = pose_graph if used is None else replace(pose_graph, edges=pose_graph.edges[counts])
    with _timed(seconds, "residuals"):
        judgement = judge(judged, residual)
    certificate, uncertified = None, ""
    with _timed(seconds, "certificate"):
        full = effort == "full"
        try:
            certificate = certify(
                pose_graph, used=used, staircase=full, better=full, tolerance=tolerance, residual=residual
            )
        except GraphError as reason:
            uncertified = str(reason)
    with _timed(seconds, "clusters"):
        wrong, rest = surveys(judged, judgement.freedom, residual)
        found = search(rest, judge(rest, residual).freedom if wrong else judgement.freedom, residual)
    with _timed(seconds, "solved again"):
        clusters = [*wrong, *_clusters(found, rest, residual)]
    tried, basins, better = 0, 1, None
    if full:
        with _timed(seconds, "basins"):
            whole = np.ones(len(judged.edges), dtype=np.bool_)
            solved = optimum(judged, whole, residual)[0] if wrong else found.solved
            tried, basins, better = _basins(judged, solved, certificate, residual)
    most = None
    if full and not counts.all():
        with _timed(seconds, "other closures"):
            most = most_consistent(pose_graph, counts)
    places, leverage = np.flatnonzero(counts), np.zeros(len(counts))
    leverage[places] = found.leverage
    return Verdict(
        effort,
        judgement,
        certificate,
        uncertified,
        tried,
        basins,
        None if better is None else better[0].poses,
        None if better is None else (judgement.chi2, better[1]),
        tuple(replace(one, edges=places[one.edges]) for one in clusters),
        leverage,
        found.weak,
        found.ended,
        seconds,
        int((~counts).sum()),
        None if most is None else (int(counts[~pose_graph.edges.odometry].sum()), most),
        None if better is None else better[0].landmarks,
    )


def _clusters(found: Search, judged: PoseGraph, residual: ResidualName) -> list[Cluster]:
    """Clusters with the names of their stretches, the first of them solved again without."""
    dim, count = judged.group.point_dim, len(judged.edges)
    errors: dict[bytes, tuple[Array, float]] = {}

    def chi2_of(known: bytes, mask: BoolArray) -> float:
        """Sum of squares of some edges on a known map, whose errors are found once."""
        graph = found.maps[known][0]
        if known not in errors:
            errors[known] = graph.squared_errors(residual), graph.seen_chi2(residual)
        each, seen = errors[known]
        return float(each[mask].sum()) + seen

    def solved(left_out: IntArray) -> tuple[BoolArray, bytes]:
        """Edges that are left, and the name of their map; from a bent map least squares may find another minimum."""
        mask = np.ones(count, dtype=np.bool_)
        mask[left_out] = False
        name = mask.tobytes()
        near = min(found.maps, key=lambda known: chi2_of(known, mask))
        if len(left_out) and near != name:
            found.maps[name] = found.partial.optimum(mask, found.maps[near][0])
            errors.pop(name, None)
        return mask, name

    clusters: list[Cluster] = []
    for kind, suspects in found.by_kind.items():
        for suspect in suspects:
            ends = np.sort(np.stack([judged.edges.first, judged.edges.second])[:, suspect.alike], axis=0)
            stretches = judged.ids[np.stack([ends.min(axis=1), ends.max(axis=1)], axis=1)]
            cluster = Cluster(kind, suspect.alike, stretches, suspect.fall, suspect.leverage, suspect.moved)
            out = np.concatenate([suspect.before, suspect.edges])
            if len(clusters) < NAMED and (len(out) < count or judged.sightings or judged.priors):
                _, name = solved(suspect.before)
                others, without = solved(out)
                here, (there, chi2) = found.maps[name][0], found.maps[without]
                apart = np.linalg.norm(judged.group.local(here.poses, there.poses)[:, dim:], axis=1)
                away = np.linalg.norm(here.poses[:, :dim] - there.poses[:, :dim], axis=1)
                moved = float(away.max()), float(apart.max())
                cluster = replace(cluster, moved=moved, chi2=(chi2_of(name, others), chi2))
            clusters.append(cluster)
    return clusters


def _basins(
    judged: PoseGraph, solved: PoseGraph, certificate: Certificate | None, residual: ResidualName
) -> tuple[int, int, tuple[PoseGraph, float] | None]:
    """Number of further starts, of different minima, and a better map than the given one with its chi2."""
    minima = [(solved, solved.chi2(residual))]
    if certificate is not None and certificate.better is not None:
        found = judged.with_poses(certificate.better)
        minima.append((found, found.chi2(residual)))
    every = np.ones(len(judged.edges), dtype=np.bool_)
    others = [judged.with_poses(start.poses, start.landmarks) for start in starts(judged, residual)[1:]]
    with suppress(GraphError):
        others.append(judged.with_poses(odometric(judged)))
    minima += [optimum(start, every, residual) for start in others]
    values = np.sort([chi2 for _, chi2 in minima])
    best = min(minima, key=lambda one: one[1])
    measured = (judged.edges, *judged.sightings.values(), *judged.priors.values())
    nothing = ROUNDED * sum(float(np.einsum("nii->", part.information)) for part in measured)
    basins = 1 + int((np.diff(values) > SAME * values[1:] + nothing).sum())
    return len(others), basins, best if best[1] < (1.0 - LOWER) * judged.chi2(residual) - nothing else None


@contextmanager
def _timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Add the time of a part."""
    begin = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - begin


JUDGES.append(_verdict)
