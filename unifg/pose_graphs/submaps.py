"""Maps beyond memory: a pose graph in a folder, cut into submaps of which one at a time is in memory.

Two levels of nested dissection. Poses are cut by where they lie; the ends of edges across the cuts are the separator.
A Gauss-Newton step is that of the whole graph: every submap eliminates its inner poses, what is left of all of them is
solved for the separator, and the steps of the inner poses follow.

It has converged where the relative offset is within the tolerance, of the whole and of the edges of every pose, as
:mod:`unifg.solution.relative_offset` has it; the second is known once the step is.
"""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unifg.atomic_write import replacing, write_atomically
from unifg.codegen.inner import inner
from unifg.elimination.factorization import Factorization
from unifg.elimination.reduction import Reduction
from unifg.elimination.symmetric import Symmetric, distinct, scatter
from unifg.errors import GraphError, require_kinds, require_positive
from unifg.factors.robust import Loss
from unifg.factors.steps import EPSILON
from unifg.factors.whitening import square_roots
from unifg.lie import LieGroup
from unifg.modeling.factors import between
from unifg.pose_graphs.pose_graph import Edges, PoseGraph, group_of
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.graph import Graph
from unifg.solution.relative_offset import ROUNDING
from unifg.solution.status import Status
from unifg.typing import Array, BoolArray, IntArray

logger = logging.getLogger("unifg")

INDEX, SEPARATOR, INFORMATION = "submaps.json", "separator.npz", "information.npz"
POSES, NEXT = "poses.npy", "next.npy"
EDGES = "first", "second", "measured", "information"
ARMIJO, SHORTEST = 1e-4, 2.0**-10
AT_ONCE = 100_000  # edges whose information is looked at


class Optimized(NamedTuple):
    """Outcome of :meth:`Submaps.optimize`.

    Attributes:
        status: CONVERGED, ITERATION_LIMIT or STALLED.
        chi2: sum of r' Omega r, without 1/2; with a loss, of what it makes of them.
        iterations: Gauss-Newton steps taken.
        offset: relative offset of Bates and Watts, of all unknowns together.
    """

    status: Status
    chi2: float
    iterations: int
    offset: float


class _Pass(NamedTuple):
    """Outcome of eliminating the inner poses of all submaps.

    Attributes:
        step: (S, d) of the poses of the separator, zero for fixed ones.
        chi2: where it was linearised.
        squares: sum of r' Omega r there, as losses weigh them.
        decrease: of chi2 by the whole step, by the quadratic model; zero within the rounding of residuals.
        worst: largest relative offset of a single pose where the step before began.
    """

    step: Array
    chi2: float
    squares: float
    decrease: float
    worst: float

    @property
    def offset(self) -> float:
        """Relative offset of the whole."""
        return math.sqrt(self.decrease / self.squares) if self.decrease > 0.0 else 0.0


class _Edges:
    """Edges among some poses as a graph.

    Attributes:
        program: compiled.
    """

    def __init__(self, group: LieGroup, members: IntArray, edges: Edges, robust: Loss | None) -> None:
        graph, ends = Graph(), []
        self._x = graph.variables("x", group, len(members))
        along = np.abs(members[edges.first] - members[edges.second]) == 1
        for name, loss, part in (("odometry", None, edges[along]), ("closures", robust, edges[~along])):
            if len(part):
                own = self._x[part.first], self._x[part.second]
                graph.minimize(between, *own, part.measured, information=part.information, robust=loss, name=name)
                ends.append((part.first, part.second))
        self.program, self._group = CompiledProblem(graph), group
        self._ends = [np.concatenate(both) for both in zip(*ends, strict=True)]

    def linearize(self, poses: Array) -> Linearization:
        """Linearise."""
        return self.program.linearize(self.program.values_from({self._x: poses}))

    def offsets(self, lin: Linearization, step: Array, rounding: float) -> Array:
        """(3, n) over the edges of each pose: |J d|^2 of a step (n, d), |r|^2, and what is rounding of the first."""
        costs, count = self.program.costs, self._x.count
        moved = np.bincount(costs.rows, lin.jacobian * step.ravel()[costs.columns], costs.count)
        noise = np.bincount(costs.rows, (rounding * lin.jacobian) ** 2, costs.count)
        squares = [row.reshape(-1, self._group.dim).sum(axis=1) for row in (moved**2, lin.residual**2, noise)]
        return np.array([sum(np.bincount(end, one, count) for end in self._ends) for one in squares])


class _Submap:
    """A submap in memory: edges between inner poses and its boundary, the poses of the separator that it touches."""

    def __init__(self, file: Path, group: LieGroup, robust: Loss | None) -> None:
        with np.load(file) as known:
            self.inner, self.boundary = known["inner"], known["boundary"]
            edges = Edges(*(known[name] for name in EDGES))
        self.members = np.concatenate([self.inner, self.boundary])
        self.edges = _Edges(group, self.members, edges, robust)
        self._tree = Reduction(self.edges.program.normal, len(self.boundary) * group.dim)

    def linearize(self, poses: Array) -> Linearization:
        """Linearise and eliminate the inner poses.

        Raises:
            GraphError: they are not determined.
        """
        lin = self.edges.linearize(poses)
        if not self._tree.factor(lin.hessian):
            raise GraphError(f"the edges do not determine all poses of the submap that holds pose {self.inner[0]}")
        return lin

    def reduced(self, gradient: Array) -> tuple[Array, Array, float]:
        """Information and gradient left to the boundary, and the decrease of twice the cost by the inner poses."""
        return self._tree.matrix, *self._tree.reduce(gradient)

    def step(self, gradient: Array, boundary: Array) -> Array:
        """(n, d) step of all members, for a given one of the boundary."""
        return self._tree.step(gradient, boundary.ravel()).reshape(len(self.members), -1)


class Submaps:
    """A pose graph in a folder.

    Attributes:
        folder: that of :meth:`split`.
        count: number of submaps.
        robust: loss on loop closures.
    """

    def __init__(self, folder: str | Path, robust: Loss | None = None) -> None:
        """Open what :meth:`split` has written.

        Args:
            folder: with the submaps.
            robust: loss on the whitened residuals of the loop closures, in :meth:`optimize` and :meth:`covariance`.

        Raises:
            GraphError: the folder holds no submaps.
        """
        self.folder, self.robust = Path(folder), robust
        try:
            known = json.loads((self.folder / INDEX).read_text(encoding="utf-8"))
            self.count = int(known["submaps"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise GraphError(f"{folder}: no submaps here; Submaps.split(pose_graph, folder) writes them") from error
        self._group = group_of(self.poses)
        with np.load(self.folder / SEPARATOR) as file:
            self._shared, self._fixed = file["shared"], file["fixed"]
            self._across = Edges(*(file[name] for name in EDGES))
        self._boundaries = [self._places(k) for k in range(self.count)]
        self._optimized = False

    @classmethod
    def split(
        cls, pose_graph: PoseGraph, folder: str | Path, largest: int = 50_000, robust: Loss | None = None
    ) -> Submaps:
        """Write a pose graph to a folder as submaps.

        Its arrays may be those of ``np.load(..., mmap_mode="r")``. Poses are cut where they lie, so the present ones
        should be near the map: an earlier one, or positions of a satellite receiver.

        Args:
            pose_graph: poses and edges; known poses are kept, and the first one of every part without.
            folder: to be made where there is none.
            largest: number of poses of a submap at most.
            robust: as of the class.

        Raises:
            GraphError: sightings or priors, which submaps do not know; no edges; a submap of no pose; NaN; information
                that is none; a pose that only edges without information reach. What the folder held stays.
        """
        require_kinds("split", GraphError, cls.split.__annotations__, {"largest": largest})
        if pose_graph.sightings or pose_graph.priors:
            raise GraphError("submaps are of poses and edges: solve sightings and priors with PoseGraph.graph()")
        if not len(pose_graph.edges) or largest < 1:
            raise GraphError(f"found {len(pose_graph.edges)} edges and submaps of {largest} poses: nothing to split")
        home, edges, poses = Path(folder), pose_graph.edges, pose_graph.poses
        for what, numbers in (("pose", poses), ("edge", edges.measured)):
            if not np.isfinite(numbers).all():
                at = int(np.flatnonzero(~np.isfinite(numbers).all(axis=1))[0])
                raise GraphError(f"{what} {at} is not finite: {numbers[at]}", index=at)
        _require_information(edges.information)
        tied = pose_graph.parts()
        if len(apart := np.flatnonzero(tied[edges.first] != tied[edges.second])):
            at, to = int(apart[0]), int(edges.second[apart[0]])
            raise GraphError(f"the edges do not determine pose {to}: edge {at} to it has no information", index=at)
        home.mkdir(parents=True, exist_ok=True)
        for old in (home / INDEX, home / INFORMATION, *home.glob("[0-9]*.npz")):
            old.unlink(missing_ok=True)
        part = _cut(np.asarray(poses[:, : pose_graph.group.point_dim]), largest)
        fixed, shared = np.zeros(len(poses), np.bool_), np.zeros(len(poses), np.bool_)
        fixed[pose_graph.anchors()[0]] = True
        first, second = part[edges.first], part[edges.second]
        shared[np.where(first < second, edges.first, edges.second)[first != second]] = True
        shared |= fixed
        part[~shared] = np.unique(part[~shared], return_inverse=True)[1]
        part[shared] = -1
        owner = np.maximum(part[edges.first], part[edges.second])  # an edge has inner poses of one submap
        count = int(part.max()) + 1
        members, rows = _groups(part, count), _groups(owner, count)
        for k, (interior, own) in enumerate(zip(members, rows, strict=True), -1):
            ends = np.concatenate([edges.first[own], edges.second[own]])
            boundary = np.zeros(0, np.int64) if k < 0 else distinct(ends[shared[ends]])
            present = np.concatenate([interior, boundary])
            by_name = np.argsort(present)
            at_first, at_second = by_name[np.searchsorted(present[by_name], ends)].reshape(2, -1)
            names: dict[str, Any] = (
                {"inner": interior, "boundary": boundary} if k >= 0 else {"shared": interior, "fixed": fixed[interior]}
            )
            measured, information = edges.measured[own], edges.information[own]
            with replacing(home / SEPARATOR if k < 0 else home / f"{k}.npz") as file:
                np.savez(file, first=at_first, second=at_second, measured=measured, information=information, **names)
        with replacing(home / POSES) as file:
            np.save(file, poses)
        write_atomically(home / INDEX, json.dumps({"submaps": count}))
        return cls(home, robust)

    @property
    def poses(self) -> Array:
        """(n, storage) present poses, in the order of the pose graph, read from the disk as they are used."""
        found: Array = np.load(self.folder / POSES, mmap_mode="r")
        return found

    def optimize(self, *, tolerance: float = 1e-6, max_iterations: int = 50) -> Optimized:
        """Gauss-Newton steps of the whole graph from the present poses, halved until chi2 falls.

        A submap is read once for each step. Ended by hand, it leaves the poses of the last step, from where the next
        call goes on.

        Args:
            tolerance: of the relative offset.
            max_iterations: steps at most.

        Raises:
            GraphError: the edges do not determine the poses; a tolerance that is not positive, or a negative number.
            OSError: the disk is full.
        """
        options = {"tolerance": tolerance, "max_iterations": max_iterations}
        require_kinds("optimize", GraphError, Submaps.optimize.__annotations__, options)
        require_positive("optimize", GraphError, tolerance=tolerance)
        if max_iterations < 0:
            raise GraphError(f"optimize: max_iterations must not be negative, found {max_iterations}")
        self._optimized = False
        (self.folder / INFORMATION).unlink(missing_ok=True)
        result = self._optimize(tolerance, max_iterations)
        np.savez(self.folder / INFORMATION, information=self._separator.information, robust=repr(self.robust))
        self._optimized = True
        return result

    def _optimize(self, tolerance: float, most: int) -> Optimized:
        now, taken = self._eliminated(), 0
        while True:
            logger.info("submaps: %d steps, chi2 %.9g, offset %.1e", taken, now.chi2, now.offset)
            if taken >= most:
                return Optimized(Status.ITERATION_LIMIT, now.chi2, taken, now.offset)
            length, trial = 1.0, self._eliminated(now.step, 1.0)
            done = now.offset <= tolerance and trial.worst <= tolerance
            while not trial.chi2 <= now.chi2 * (1.0 + ROUNDING * EPSILON) - ARMIJO * length * now.decrease:
                length *= 0.5
                if done or length < SHORTEST:
                    self._eliminated()  # what is left of the submaps belongs to the poses
                    return Optimized(Status.CONVERGED if done else Status.STALLED, now.chi2, taken, now.offset)
                trial = self._eliminated(now.step, length)
            os.replace(self.folder / NEXT, self.folder / POSES)
            now, taken = trial, taken + 1
            if done:
                return Optimized(Status.CONVERGED, now.chi2, taken, now.offset)

    def covariance(self, pose: int) -> Array:
        """(d, d) marginal covariance of a pose, over its tangent space, at the present poses; zero for a fixed one.

        Raises:
            GraphError: there is no such pose, nothing has been optimised yet, or with another loss.
        """
        count, dim = len(self.poses), self._group.dim
        require_kinds("covariance", GraphError, {"pose": "int"}, {"pose": pose})
        if not 0 <= pose < count:
            raise GraphError(f"pose {pose} of {count}")
        place = int(np.searchsorted(self._shared, pose))
        if place < len(self._shared) and self._shared[place] == pose:
            return self._known().covariance(np.array([place]))
        for k in range(self.count):
            with np.load(self.folder / f"{k}.npz") as file:
                interior = file["inner"]
            at = int(np.searchsorted(interior, pose))
            if at < len(interior) and interior[at] == pose:
                break
        submap, places = self._submap(k), self._boundaries[k]
        submap.linearize(self.poses[submap.members])
        own, reach = np.empty((dim, dim)), np.empty((dim, len(places) * dim))
        for axis in range(dim):
            unit = np.zeros((len(submap.members), dim))
            unit[at, axis] = 1.0
            reach[axis] = submap.reduced(unit.ravel())[1]
            own[axis] = -submap.step(unit.ravel(), np.zeros((len(places), dim)))[at]
        return own + reach @ self._known().covariance(places) @ reach.T

    def _known(self) -> _Separator:
        """The separator at the present poses."""
        if not self._optimized:
            try:
                with np.load(self.folder / INFORMATION) as file:
                    self._separator.information[:], robust = file["information"], str(file["robust"])
            except OSError:
                raise GraphError(f"{self.folder}: no covariances yet; optimize() comes first") from None
            if robust != repr(self.robust):
                raise GraphError(f"{self.folder}: optimized with robust={robust}, opened with {self.robust!r}")
            self._separator.factor()
            self._optimized = True
        return self._separator

    def _places(self, k: int) -> IntArray:
        """Boundary of a submap, as positions in the separator."""
        with np.load(self.folder / f"{k}.npz") as file:
            found: IntArray = np.searchsorted(self._shared, file["boundary"])
        return found

    def _eliminated(self, step: Array | None = None, length: float = 1.0) -> _Pass:
        """Take a step from the present poses, which writes the next ones, and eliminate all inner poses there."""
        separator, poses, group = self._separator, self.poses, self._group
        shared, decrease, worst = np.array(poses[self._shared]), 0.0, 0.0
        rounding = ROUNDING * EPSILON * max(1.0, float(np.abs(poses[:, : group.point_dim]).max()))
        if step is not None:
            offsets = separator.offsets(shared, step, rounding)
            shutil.copyfile(self.folder / POSES, self.folder / NEXT)  # a full disk is found here, not in mapped memory
            following = np.load(self.folder / NEXT, mmap_mode="r+")
            following[self._shared] = shared = group.retract(shared, length * step)
        chi2, squares, slopes = separator.begin(shared)
        for k, places in enumerate(self._boundaries):
            submap = self._submap(k)
            own, count = np.array(poses[submap.members]), len(submap.inner)
            lin = submap.linearize(own)
            if step is not None:
                whole = submap.step(lin.gradient, step[places])
                found = submap.edges.offsets(lin, whole, rounding)
                offsets[:, places] += found[:, count:]
                worst = max(worst, _largest(found[:, :count]))
                own = group.retract(own, length * whole)
                own[count:] = shared[places]
                following[submap.inner] = own[:count]
                lin = submap.linearize(own)
            matrix, gradient, inside = submap.reduced(lin.gradient)
            separator.add(places, matrix, gradient)
            chi2, decrease = chi2 + 2.0 * lin.cost, decrease + inside
            squares, slopes = squares + inner(lin.residual, lin.residual), slopes + inner(lin.jacobian, lin.jacobian)
        if step is not None:
            following.flush()
            worst = max(worst, _largest(offsets))
        found, outside = separator.solve()
        decrease += outside
        return _Pass(found, chi2, squares, decrease if decrease > 2.0 * rounding**2 * slopes else 0.0, worst)

    @cached_property
    def _separator(self) -> _Separator:
        return _Separator(self._group, self._shared, self._fixed, self._across, self._boundaries, self.robust)

    def _submap(self, k: int) -> _Submap:
        return _Submap(self.folder / f"{k}.npz", self._group, self.robust)


class _Separator:
    """The poses of the separator: edges between them, and what is left of the submaps."""

    def __init__(
        self,
        group: LieGroup,
        members: IntArray,
        fixed: BoolArray,
        edges: Edges,
        boundaries: Sequence[IntArray],
        robust: Loss | None,
    ) -> None:
        """Find the structure."""
        free, dim = np.flatnonzero(~fixed), group.dim
        number = np.full(len(fixed), -1)
        number[free] = np.arange(len(free))
        self._columns = (dim * number[:, None] + np.arange(dim)) * (number >= 0)[:, None] - (number < 0)[:, None]
        pairs = [np.sort(np.stack([number[edges.first], number[edges.second]]), axis=0)]
        for boundary in boundaries:
            own = number[boundary][number[boundary] >= 0]
            pairs.append(own[np.stack(np.triu_indices(len(own)))])
        first, second = np.concatenate(pairs, axis=1)
        starts, known = dim * np.arange(len(free) + 1), first >= 0
        self._pattern = Symmetric.of_blocks(starts, first[known], second[known])
        self._tree = Factorization(self._pattern, np.repeat(np.arange(len(free)), dim))
        self.information, self._gradient = np.zeros(self._pattern.nnz), np.zeros(self._pattern.size)
        self._edges: _Edges | None = None
        self._ends = distinct(np.concatenate([edges.first, edges.second]))
        if len(edges):
            first, second = (np.searchsorted(self._ends, end) for end in (edges.first, edges.second))
            edges = replace(edges, first=first, second=second)
            self._edges = _Edges(group, members[self._ends], edges, robust)

    def offsets(self, poses: Array, step: Array, rounding: float) -> Array:
        """(3, S) as of :meth:`_Edges.offsets`, of the edges of the separator."""
        result = np.zeros((3, len(poses)))
        if self._edges is not None:
            lin = self._edges.linearize(poses[self._ends])
            result[:, self._ends] = self._edges.offsets(lin, step[self._ends], rounding)
        return result

    def begin(self, poses: Array) -> tuple[float, float, float]:
        """Linearise the edges, of which nothing else is there yet; chi2, and the sums of squares and squared slopes."""
        self.information[:], self._gradient[:] = 0.0, 0.0
        if self._edges is None:
            return 0.0, 0.0, 0.0
        lin = self._edges.linearize(poses[self._ends])
        pattern, column = self._edges.program.normal, self._columns[self._ends].ravel()
        rows, columns = column[pattern.indices], column[pattern.columns]
        free = (rows >= 0) & (columns >= 0)
        slots = self._pattern.positions(rows[free], columns[free])
        self.information[:] = scatter(slots, lin.hessian[free], self._pattern.nnz)
        self._gradient[column[column >= 0]] = lin.gradient[column >= 0]
        return 2.0 * lin.cost, inner(lin.residual, lin.residual), inner(lin.jacobian, lin.jacobian)

    def add(self, boundary: IntArray, matrix: Array, gradient: Array) -> None:
        """Add what is left of a submap; positions of its boundary are sorted."""
        columns = self._columns[boundary].ravel()
        free = np.flatnonzero(columns >= 0)
        columns = columns[free]
        self._gradient[columns] += gradient[free]
        for k, column in enumerate(columns.tolist()):
            begin, end = self._pattern.indptr[column : column + 2]
            at = begin + np.searchsorted(self._pattern.indices[begin:end], columns[: k + 1])
            self.information[at] += matrix[free[: k + 1], free[k]]

    def solve(self) -> tuple[Array, float]:
        """(S, d) step of all poses, and the decrease of chi2.

        Raises:
            GraphError: they are not determined.
        """
        self.factor()
        found = -self._tree.solve(self._gradient) if len(self._gradient) else self._gradient
        step = np.append(found, 0.0)[self._columns]  # the last one for fixed poses
        return step, -float(found @ self._gradient)

    def factor(self) -> None:
        """Factorise."""
        if len(self._gradient) and not (self._tree.factor(self.information) and self._tree.definite):
            raise GraphError("the edges do not determine the poses where submaps meet")

    def covariance(self, places: IntArray) -> Array:
        """Joint covariance of some poses, zero for fixed ones."""
        columns = self._columns[places].ravel()
        result, free = np.zeros((len(columns), len(columns))), np.flatnonzero(columns >= 0)
        if len(free):
            result[np.ix_(free, free)] = self._tree.inverse_block(columns[free])
        return result


def _require_information(information: Array) -> None:
    """Refuse what a graph refuses, by the number of the edge: submaps count edges by numbers of their own."""
    for begin in range(0, len(information), AT_ONCE):
        some = information[begin : begin + AT_ONCE]
        try:
            square_roots("edges", some, len(some), information.shape[-1])
        except GraphError as error:
            at = begin + (error.index or 0)
            raise GraphError(
                f"edge {at}: its information must be finite, symmetric and positive semi-definite, found "
                f"{information[at].tolist()}",
                index=at,
            ) from error


def _largest(offsets: Array) -> float:
    """Largest relative offset of a pose, of (3, n) as of :meth:`_Edges.offsets`."""
    moved, squares, noise = offsets
    above = moved > noise
    return float(np.sqrt(moved[above] / np.maximum(squares[above], noise[above])).max(initial=0.0))


def _cut(places: Array, largest: int) -> IntArray:
    """(n,) part of each place: halved across the longer side, until parts are small enough."""
    part, count = np.zeros(len(places), np.int64), 0
    waiting = [np.arange(len(places))]
    while waiting:
        members = waiting.pop()
        if len(members) <= largest:
            part[members], count = count, count + 1
            continue
        own, half = places[members], len(members) // 2
        axis = int(np.ptp(own, axis=0).argmax())
        order = np.argpartition(own[:, axis], half)
        waiting += [members[order[half:]], members[order[:half]]]
    return part


def _groups(labels: IntArray, count: int) -> list[IntArray]:
    """Positions of the labels -1, 0, ..., count - 1, in ascending order."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(count)))
