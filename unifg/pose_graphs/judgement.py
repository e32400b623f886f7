"""Judgement of a solved pose graph: residuals against the stated noise, and what nothing determines.

The sum of squared residuals, chi2, is expected to be as large as there are degrees of freedom: rows of measurements
less unknowns. Published information matrices are seldom calibrated, so a ratio is a hint and never a verdict; one that
is far too large is said, one that is too small is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.modeling.summary import counted
from unifg.pose_graphs.information import indefinite
from unifg.pose_graphs.pose_graph import PoseGraph, Priors, ResidualName, Sightings
from unifg.solution.fit import is_far, ratio_sentence
from unifg.typing import Array, IntArray

__all__ = ["Judgement", "judge"]

BLIND = 1e-12  # of the largest eigenvalue of an information matrix
WORST = 5  # edges named


@dataclass(frozen=True, eq=False)
class Judgement:
    """Residuals of a pose graph at its poses, and its structure.

    Attributes:
        chi2: sum of r' Omega r.
        freedom: rows that carry information less unknowns; what chi2 is expected to be. Not positive where the
            measurements only just determine the poses, or do not.
        worst: up to five edges with the largest r' Omega r, as (k, 2) identifiers of their poses.
        worst_chi2: (k,) r' Omega r of those.
        parts: connected parts.
        anchors: identifiers of poses that are held where they are because nothing else holds their part.
        isolated: identifiers of poses without any measurement.
        blind: positions of edges whose information matrix is zero.
        indefinite: positions of edges whose information matrix has a negative eigenvalue.
    """

    chi2: float
    freedom: int
    worst: IntArray
    worst_chi2: Array
    parts: int
    anchors: tuple[int, ...]
    isolated: tuple[int, ...]
    blind: IntArray
    indefinite: IntArray

    @property
    def far(self) -> bool:
        """True if residuals are far larger than stated."""
        return is_far(self.chi2, self.freedom)

    def sentences(self) -> list[str]:
        """Remarks on the solution; empty when there are none."""
        said = []
        if self.far:
            said.append(ratio_sentence(self.chi2, self.freedom))
        if self.freedom < 0:
            said.append(f"{-self.freedom} unknowns more than rows of measurements: some poses are not determined")
        if self.parts > 1:
            said.append(f"{self.parts} parts that nothing connects")
        if self.isolated:
            said.append(f"{counted(len(self.isolated), 'pose')} without any measurement: {_some(self.isolated)}")
        if len(self.blind):
            edges, first = counted(len(self.blind), "edge"), int(self.blind[0])
            said.append(f"{edges} without information, the first in place {first}")
        if len(self.indefinite):
            edges, first = counted(len(self.indefinite), "edge"), int(self.indefinite[0])
            said.append(f"{edges} with indefinite information, the first in place {first}")
        return said


def judge(pose_graph: PoseGraph, residual: ResidualName = "log") -> Judgement:
    """Compare residuals with what is stated, and look for what nothing determines.

    Args:
        pose_graph: at the poses to be judged.
        residual: as for `PoseGraph.graph`.

    Raises:
        GraphError: there is no measurement.
    """
    squared = pose_graph.squared_errors(residual)
    order = np.argsort(-squared, kind="stable")[:WORST]
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
        int(pose_graph.parts().max(initial=-1)) + 1,
        tuple(added.tolist()),
        tuple(ids[~touched].tolist()),
        np.flatnonzero(greatest == 0.0),
        np.flatnonzero(indefinite(edges.information)),
    )


def _some(identifiers: tuple[int, ...]) -> str:
    """The first of them, and how many there are more."""
    first = ", ".join(map(str, identifiers[:3]))
    return first if len(identifiers) <= 3 else f"{first} and {len(identifiers) - 3} more"
