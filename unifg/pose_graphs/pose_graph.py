"""A pose graph as data: poses, relative measurements, landmarks; and the factor graph it states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from unifg.elimination.components import components
from unifg.errors import GraphError
from unifg.factors.residuals import Residual
from unifg.factors.robust import Loss
from unifg.lie import SE2, SE3, LieGroup, Rn
from unifg.modeling.factors import ManifoldResidual, between
from unifg.modeling.variables import Family
from unifg.pose_graphs.residuals import bearing, bearing_range, chart_between, distance, position, sighting
from unifg.pose_graphs.verdict import Effort, Verdict
from unifg.solution.graph import Graph
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Edges", "Ids", "PoseGraph", "Priors", "ResidualName", "RobustOn", "Sightings"]

Ids: TypeAlias = NDArray[np.int64]
ResidualName: TypeAlias = Literal["log", "g2o"]
RobustOn: TypeAlias = Literal["closures", "all"]

_RELATIVE: dict[str, ManifoldResidual] = {"log": between, "g2o": chart_between}
SEEN: dict[str, ManifoldResidual | Residual] = {
    "point": sighting,
    "bearing": bearing,
    "range": distance,
    "bearing-range": bearing_range,
}

GUESSES: list[Callable[[PoseGraph], Array]] = []
"""First guesses from measurements alone, entered by :mod:`unifg.pose_graphs.initialise`, which stands on this file."""

JUDGES: list[Callable[[PoseGraph, Effort, ResidualName, BoolArray | None, float], Verdict]] = []
"""The verdict on a map, entered by :mod:`unifg.pose_graphs.judging`, which stands on this file."""


class _Measurements:
    """Base of measurements: arrays with a row for each."""

    measured: Array
    information: Array

    def __post_init__(self) -> None:
        """Take positions as signed whole numbers, of which differences are formed, and the rest as real ones.

        Raises:
            GraphError: naming the array that holds something else, or as many rows as no other one.
        """
        for name, value in list(vars(self).items()):
            rows, whole = np.asarray(value), name not in ("measured", "information")
            if rows.size and rows.dtype.kind not in ("iu" if whole else "iuf"):
                raise GraphError(f"{name} must hold {'whole' if whole else 'real'} numbers, found {rows.dtype}")
            object.__setattr__(self, name, rows.astype(np.intp if whole else np.float64, copy=False))
        if len({len(rows) for rows in vars(self).values()}) > 1:
            found = ", ".join(f"{name} {len(rows)}" for name, rows in vars(self).items())
            raise GraphError(f"{type(self).__name__} need as many rows of each array, found {found}")

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.measured)

    def __getitem__(self, chosen: IntArray | BoolArray | slice) -> Self:
        """Some of the measurements, by mask, positions or slice."""
        return type(self)(**{name: rows[chosen] for name, rows in vars(self).items()})


@dataclass(frozen=True, eq=False)
class Edges(_Measurements):
    """Relative measurements between poses.

    Attributes:
        first, second: (m,) positions of the poses in `PoseGraph.poses`.
        measured: (m, storage) pose of the second seen from the first.
        information: (m, d, d), translation before rotation.
    """

    first: IntArray
    second: IntArray
    measured: Array
    information: Array

    @property
    def odometry(self) -> BoolArray:
        """(m,) whether an edge joins neighbours in the order of the file; the rest are loop closures."""
        neighbours: BoolArray = np.abs(self.second - self.first) == 1
        return neighbours


@dataclass(frozen=True, eq=False)
class Sightings(_Measurements):
    """Measurements of landmarks from poses.

    Attributes:
        pose: (k,) positions in `PoseGraph.poses`.
        landmark: (k,) positions in `PoseGraph.landmarks`.
        measured: (k, p).
        information: (k, p, p).
    """

    pose: IntArray
    landmark: IntArray
    measured: Array
    information: Array


@dataclass(frozen=True, eq=False)
class Priors(_Measurements):
    """Absolute measurements of poses.

    Attributes:
        pose: (k,) positions in `PoseGraph.poses`.
        measured: (k, p).
        information: (k, d, d), translation before rotation.
    """

    pose: IntArray
    measured: Array
    information: Array


def group_of(poses: Array) -> LieGroup:
    """SE2 or SE3, whichever (n, storage) poses live in."""
    return SE2 if poses.shape[1] == SE2.storage else SE3


class _Term(NamedTuple):
    """Measurements with their residual, of constants, poses and landmarks, whose positions these are."""

    name: str
    function: ManifoldResidual | Residual
    constants: tuple[Array, ...]
    poses: tuple[IntArray, ...]
    landmarks: tuple[IntArray, ...]
    batch: _Measurements


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses in SE(2) or SE(3) with what has been measured between them.

    Attributes:
        ids: (n,) identifiers of the poses, 64 bits, in the order of the file.
        poses: (n, 3) x, y, heading [m, m, rad], or (n, 7) position [m] and quaternion, as `unifg.SE3`.
        edges: relative measurements.
        landmark_ids: (k,) identifiers of the landmarks.
        landmarks: (k, 2) or (k, 3) points [m].
        sightings: measurements of landmarks by kind: "point" (in the frame of the pose [m]), "bearing" [rad],
            "range" [m], "bearing-range" [rad, m]; the last three in the plane only.
        fixed_ids: identifiers of poses and landmarks that are known.
        skipped: tags a reader did not know, with the number of lines it left out.
        placed: whether the poses were given; False where a reader had measurements only, and put the poses along a
            spanning tree of them.
        remarks: what else a reader found that may not be meant, or has repaired; sentences.
        priors: measurements of single poses by kind: "pose" (k, storage) and, in the plane, "position" (k, 2) [m].
    """

    ids: Ids
    poses: Array
    edges: Edges
    landmark_ids: Ids = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 2)))
    sightings: Mapping[str, Sightings] = field(default_factory=dict)
    fixed_ids: tuple[int, ...] = ()
    skipped: Mapping[str, int] = field(default_factory=dict)
    placed: bool = True
    remarks: tuple[str, ...] = ()
    priors: Mapping[str, Priors] = field(default_factory=dict)

    @property
    def group(self) -> LieGroup:
        """SE2 or SE3, whichever the poses live in."""
        return group_of(self.poses)

    @property
    def closures(self) -> Edges:
        """The loop closures: edges between poses that are not neighbours."""
        return self.edges[~self.edges.odometry]

    def with_poses(self, poses: Array, landmarks: Array | None = None) -> PoseGraph:
        """The same measurements around other values, (n, storage), and landmarks (k, p) where given."""
        return replace(self, poses=poses, landmarks=self.landmarks if landmarks is None else landmarks)

    def graph(
        self, robust: Loss | None = None, residual: ResidualName = "log", robust_on: RobustOn = "closures"
    ) -> tuple[Graph, Family, dict[Family, Array]]:
        """State the factor graph.

        The terms are called ``odometry``, ``closures`` and, by kind, ``point``, ``bearing``, ..., ``pose prior`` and
        ``position prior``. Known poses are fixed; every connected part of the graph without one has its first pose
        fixed where it is, unless priors determine its place.

        Args:
            robust: loss on the whitened residuals of the loop closures.
            residual: ``"log"`` is Log(Z^-1 Xi^-1 Xj), as in GTSAM; ``"g2o"`` is g2o's chart (see
                `unifg.pose_graphs.residuals.chart_between`). Both take the information matrices as the file has them.
            robust_on: ``"all"`` puts the loss on odometry and sightings too. Where odometry may be wrong, so is a guess
                made of it: the graph then names chordal poses and, in the plane, LAGO's as further starts.

        Returns:
            The graph, the family of the poses, called ``poses``, and a guess made of the present values. Landmarks are
            ``graph.families["landmarks"]``.

        Raises:
            GraphError: on an unknown residual or kind of sighting, or a graph without edges.
        """
        along = self.edges.odometry
        edges = {"odometry": self.edges[along], "closures": self.edges[~along]}
        terms = self._terms(residual, {name: part for name, part in edges.items() if len(part)})
        if robust_on not in ("closures", "all"):
            raise GraphError(f"robust_on is {robust_on!r}: expected 'closures' or 'all'")
        everywhere = robust if robust_on == "all" else None
        graph = Graph()
        x = graph.variables("poses", self.group, len(self.poses))
        guess = {x: self.poses.copy()}
        if len(self.landmarks):
            places = graph.variables("landmarks", Rn(self.landmarks.shape[1]), len(self.landmarks))
            guess[places] = self.landmarks.copy()
        for term in terms:
            if len(self.landmarks) or not term.landmarks:
                measured = graph.data(term.name, term.batch.measured, each=True)
                variables = [x[rows] for rows in term.poses] + [places[rows] for rows in term.landmarks]
                graph.minimize(
                    term.function, *term.constants, *variables, measured, information=term.batch.information,
                    robust=robust if term.name == "closures" else everywhere, name=term.name,
                )  # fmt: skip
        fixed, known = self.anchors(priors=True)
        if len(fixed):
            graph.fix(x[fixed], self.poses[fixed], name="anchor")
        if len(known):
            graph.fix(graph.families["landmarks"][known], self.landmarks[known], name="known landmarks")
        if everywhere is not None:
            graph.starts += [partial(_guessed, method, self, x) for method in GUESSES]
        return graph, x, guess

    def verdict(
        self,
        *,
        effort: Effort = "full",
        residual: ResidualName = "log",
        used: BoolArray | None = None,
        tolerance: float = 1e-6,
    ) -> Verdict:
        """Confidence in the map that the present poses are: a record, and a sentence.

        Args:
            effort: "cheap" bounds what another map could gain, and looks for closures that the others contradict or
                do not support; "full" climbs the staircase of the certificate and solves from other first guesses, too.
            residual: as for :meth:`graph`.
            used: (m,) edges that count, say the inliers of a robust solve.
            tolerance: share of chi2 by which maps are told apart.

        Raises:
            GraphError: there is no measurement, or `used` is something else than one truth value for each edge.
        """
        return JUDGES[0](self, effort, residual, used, tolerance)

    def chi2(self, residual: ResidualName = "log") -> float:
        """Sum of r' Omega r over all measurements at the present values: no 1/2, no robust loss."""
        return float(self.squared_errors(residual).sum()) + self.seen_chi2(residual)

    def seen_chi2(self, residual: ResidualName = "log") -> float:
        """Sum of r' Omega r over the sightings and priors at the present values."""
        return sum(float(self._squared(term).sum()) for term in self._terms(residual, {}))

    def squared_errors(self, residual: ResidualName = "log") -> Array:
        """(m,) r' Omega r of every edge at the present values."""
        return self._squared(self._terms(residual, {"edges": self.edges})[0])

    def anchors(self, priors: bool = False) -> tuple[IntArray, IntArray]:
        """Positions of the poses and landmarks held fixed: those known, or the first pose of a connected part.

        A landmark that nothing has measured is held, too, as such a pose is.

        Args:
            priors: whether a part needs no fixed pose that priors determine: one of a whole pose, or positions of so
                many poses as a position has coordinates.
        """
        known = np.array(self.fixed_ids, dtype=np.int64)
        part, count = self.parts(), len(self.poses)
        unseen = ~np.isin(part[count:], part[:count])
        poses = np.flatnonzero(np.isin(self.ids, known))
        landmarks = np.flatnonzero(np.isin(self.landmark_ids, known) | unseen)
        held = np.concatenate([part[poses], part[count + landmarks]])
        if priors and self.priors:
            size, where = self.group.point_dim, np.concatenate([kind.pose for kind in self.priors.values()])
            whole, placed = (  # with information in every direction; about the position, whatever of the heading
                np.concatenate(
                    [
                        np.linalg.matrix_rank(kind.information[:, :k, :k], hermitian=True) == k
                        for kind in self.priors.values()
                    ]
                )
                for k in (self.group.dim, size)
            )
            counts = np.bincount(part[np.unique(where[placed])])
            held = np.concatenate([held, part[where[whole]], np.flatnonzero(counts >= size)])
        present, firsts = np.unique(part[:count], return_index=True)
        loose = firsts[~np.isin(present, held)]
        return np.sort(np.concatenate([poses, loose])), landmarks

    def parts(self) -> IntArray:
        """(n + k,) number of the connected part of every pose, then of every landmark; zero information joins nothing.

        Raises:
            GraphError: a measurement speaks of a pose or landmark that there is not.
        """
        count = len(self.poses)
        _require("an edge", "poses", (self.edges.first, self.edges.second), count)
        for kind, seen in self.sightings.items():
            _require(f"a sighting of kind {kind!r}", "poses", (seen.pose,), count)
            _require(f"a sighting of kind {kind!r}", "landmarks", (seen.landmark,), len(self.landmarks))
        for kind, held in self.priors.items():
            _require(f"a prior of kind {kind!r}", "poses", (held.pose,), count)
        pairs = [(self.edges.first, self.edges.second)]
        pairs += [(seen.pose, count + seen.landmark) for seen in self.sightings.values()]
        tells = [batch.information.any(axis=(1, 2)) for batch in (self.edges, *self.sightings.values())]
        rows, columns = np.concatenate(
            [np.stack(ends)[:, told] for ends, told in zip(pairs, tells, strict=True)], axis=1
        )
        return components(count + len(self.landmarks), rows, columns)

    def _terms(self, residual: str, edges: Mapping[str, Edges]) -> list[_Term]:
        """Terms of some edges, by name, then of all sightings and priors."""
        if residual not in _RELATIVE:
            raise GraphError(f"residual is {residual!r}: expected {' or '.join(map(repr, _RELATIVE))}")
        relative = _RELATIVE[residual]
        if not len(self.edges) and not self.sightings and not self.priors:
            raise GraphError("the pose graph has no measurement: there is nothing to solve")
        terms = [_Term(name, relative, (), (part.first, part.second), (), part) for name, part in edges.items()]
        for kind, seen in self.sightings.items():
            if kind not in SEEN:
                raise GraphError(f"sightings of kind {kind!r}: expected one of {', '.join(map(repr, SEEN))}")
            terms.append(_Term(kind, SEEN[kind], (), (seen.pose,), (seen.landmark,), seen))
        for kind, held in self.priors.items():
            name, rows = f"{kind} prior", (held.pose,)
            if kind == "pose":
                terms.append(_Term(name, relative, (self.group.identity(),), rows, (), held))
            elif kind == "position" and self.group is SE2:
                terms.append(_Term(name, position, (), rows, (), held))
            else:
                where = self.group.name
                raise GraphError(f"priors of kind {kind!r} in {where}: expected 'pose' or, in SE2, 'position'")
        return terms

    def _squared(self, term: _Term) -> Array:
        """(k,) r' Omega r of a term at the present values."""
        function = term.function
        whole = function.on(self.group) if isinstance(function, ManifoldResidual) else function
        points = [self.poses[rows] for rows in term.poses] + [self.landmarks[rows] for rows in term.landmarks]
        error = whole(*term.constants, *points, term.batch.measured)
        result: Array = np.einsum("ni,nij,nj->n", error, term.batch.information, error)
        return result

    def __repr__(self) -> str:
        """Counts."""
        seen = sum(map(len, self.sightings.values()))
        more = f", {len(self.landmarks)} landmarks, {seen} sightings" if len(self.landmarks) else ""
        return f"<PoseGraph: {len(self.poses)} poses in {self.group.name}, {len(self.edges)} edges{more}>"


def _guessed(method: Callable[[PoseGraph], Array], pose_graph: PoseGraph, poses: Family) -> dict[Family, Array]:
    return {poses: method(pose_graph)}


def _require(who: str, what: str, places: tuple[IntArray, ...], count: int) -> None:
    for positions in places:
        wrong = np.flatnonzero((positions < 0) | (positions >= count))
        if len(wrong):
            k = int(wrong[0])
            raise GraphError(f"{who}, number {k}, names position {positions[k]}, and there are {count} {what}", index=k)
