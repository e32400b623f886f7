"""Judgement of a solved pose graph: residuals against the stated noise, and what nothing determines.

The sum of squared residuals, chi2, is expected to be as large as there are degrees of freedom: rows of measurements
less unknowns. Published information matrices are seldom calibrated, so a ratio is a hint and never a verdict; one that
is far too large is said, one that is too small is not.
"""

from __future__ import annotations

import numpy as np

from unifg.errors import GraphError
from unifg.pose_graphs.information import indefinite
from unifg.pose_graphs.pose_graph import PoseGraph, Priors, ResidualName, Sightings
from unifg.pose_graphs.verdict import NAMED, Judgement

__all__ = ["judge"]

BLIND = 1e-12  # of the largest eigenvalue of an information matrix


def judge(pose_graph: PoseGraph, residual: ResidualName = "log") -> Judgement:
    """Compare residuals with what is stated, and look for what nothing determines.

    Args:
        pose_graph: at the poses to be judged.
        residual: as for `PoseGraph.graph`.

    Raises:
        GraphError: there is no measurement, one is of a pose that there is not, or chi2 is not finite.
    """
    parts = pose_graph.parts()
    squared = pose_graph.squared_errors(residual)
    if not np.isfinite(squared).all():
        raise GraphError(f"edge {int(np.argmin(np.isfinite(squared)))}: r' Omega r is not finite at these poses")
    order = np.argsort(-squared, kind="stable")[:NAMED]
    order = order[squared[order] > 0.0]
    edges, ids = pose_graph.edges, pose_graph.ids
    lengths = np.linalg.eigvalsh(edges.information) if len(edges) else np.zeros((0, pose_graph.group.dim))
    greatest = np.abs(lengths).max(axis=1, initial=0.0)
    seen = lengths > BLIND * greatest[:, None]
    rows = int(seen.sum())
    touched = np.zeros(len(ids), dtype=bool)
    touched[edges.first[greatest > 0.0]] = touched[edges.second[greatest > 0.0]] = True
    others: list[Sightings | Priors] = [*pose_graph.sightings.values(), *pose_graph.priors.values()]
    for kind in others:
        rows += int(np.linalg.matrix_rank(kind.information, hermitian=True).sum())
        touched[kind.pose] = True
    anchors, known = pose_graph.anchors(priors=True)
    added = ids[anchors][~np.isin(ids[anchors], np.array(pose_graph.fixed_ids, dtype=np.int64))]
    unknown = (len(ids) - len(anchors)) * pose_graph.group.dim
    unknown += (len(pose_graph.landmarks) - len(known)) * pose_graph.group.point_dim
    return Judgement(
        float(squared.sum()) + pose_graph.seen_chi2(residual),
        rows - unknown,
        np.stack([ids[edges.first[order]], ids[edges.second[order]]], axis=1),
        squared[order],
        int(parts.max(initial=-1)) + 1,
        tuple(added.tolist()),
        tuple(ids[~touched].tolist()),
        np.flatnonzero(greatest == 0.0),
        np.flatnonzero(indefinite(edges.information)),
        pose_graph.group.dim,
    )
