"""Clusters of loop closures: those that the rest of a graph contradicts, and those that nothing else supports.

Closures between the same two stretches of a drive are a cluster. Where a place was taken for another one, all of them
have one error in common: the later stretch lies elsewhere by a rigid motion e. With A the derivative of their whitened
residuals r by it, J their Jacobian and S the covariance of the map, the sum of squares falls by

    T = (A' r)' (A' A - A' J S J' A)^-1 A' r

where e is free: the test of a mean shift, with as many degrees of freedom as e has numbers (W. Baarda, "A testing
procedure for use in geodetic networks", Netherlands Geodetic Commission 2(5), 1968). It needs as many substitutions as
a pose has numbers, along paths to the root of the elimination tree. The share of A' A that A' J S J' A makes up is the
leverage of the cluster: one where nothing else knows how the two stretches lie. The map moves by e' A' J S J' A e,
squared and in its own standard deviations.

Contradictions are taken out one by one, the largest first, and the rest is solved again; single closures and steps of
odometry are candidates as well. Where two take away nearly the same, the rest cannot tell which of them is wrong. At
the end, each is compared with the map of the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.modeling.variables import Data, Family
from unifg.pose_graphs.pose_graph import Edges, PoseGraph, ResidualName
from unifg.pose_graphs.verdict import Kind
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.term import CompiledTerm
from unifg.solution.chi_squared import upper_quantile
from unifg.solution.conditioning import HARDLY
from unifg.solution.graph import Graph
from unifg.solution.solution import Solution
from unifg.solvers.gating import NEAR, UNCHECKED, Innovations, VarianceFactor, neighbours
from unifg.solvers.least_squares import MAP, GaussNewton, LevenbergMarquardt
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Map", "Partial", "Search", "Suspect", "optimum", "search"]

CHANCE = 1e-3  # that anything is contradicted in a graph without wrong measurements
SPARE = 4.0  # variance that right measurements may have beside that of the others
CALM = 0.1  # least variance, of that stated, that a contradiction is measured by
AS_MUCH = 0.9  # of the largest fall: where two suspects cannot be told apart
ODOMETRY = 1.25  # by how much more a step of odometry has to take away than any closures
ROUNDS = 30  # of taking out
FEW = 10  # Gauss-Newton iterations before damping
FAR = 3.0  # standard deviations by which a map moves without an unsupported cluster
LEVERAGE = 0.99  # share of what a map knows of two stretches that comes from an unsupported cluster, at least


@dataclass(frozen=True, eq=False)
class Suspect:
    """Measurements with an error in common, as the screening sees them.

    Attributes:
        edges: (k,) positions in the graph.
        alike: (l,) the same; for odometry, positions of steps of which one is enough.
        fall: of the sum of squares where the error is free.
        leverage: share of what the map knows of the two stretches that comes from them.
        moved: standard deviations by which the map moves without them; infinite where it falls apart.
        before: positions of what was taken out before.
    """

    edges: IntArray
    alike: IntArray
    fall: float
    leverage: float
    moved: float
    before: IntArray


@dataclass(frozen=True, eq=False)
class Search:
    """Outcome of a search.

    Attributes:
        solved: the graph at its optimum near the given poses.
        maps: graphs at their optima, and chi2 there, by the bytes of (m,) edges that count.
        by_kind: "contradicted" closures, the largest fall first, and of those that cannot be told apart, all; "slipped"
            steps of odometry; "unsupported" closures, those first without which the map moves farthest.
        leverage: (m,) of the cluster of each edge; that of odometry is zero.
        weak: names of unknowns of which less than five digits are known.
        ended: False where more may be contradicted than was taken out, or an unknown is not determined.
        partial: optima of parts of the edges.
    """

    solved: PoseGraph
    maps: dict[bytes, tuple[PoseGraph, float]]
    by_kind: dict[Kind, list[Suspect]]
    leverage: Array
    weak: tuple[str, ...]
    ended: bool
    partial: Partial


def search(pose_graph: PoseGraph, freedom: int, residual: ResidualName = "log") -> Search:
    """Look for closures that the rest contradicts or does not support, and for slipped odometry.

    Args:
        pose_graph: with poses from which plain least squares reach its map.
        freedom: its degrees of freedom.
        residual: as for `PoseGraph.graph`.

    Raises:
        GraphError: there is nothing to solve.
    """
    edges, dim = pose_graph.edges, pose_graph.group.dim
    active, leverage = np.ones(len(edges), dtype=np.bool_), np.zeros(len(edges))
    closures = ~edges.odometry & (edges.first != edges.second)
    partial = Partial(pose_graph, residual)
    now = Map(pose_graph, active, residual, partial)
    solved, weak, maps = now.graph, now.weak(), {active.tobytes(): (now.graph, now.chi2)}
    ended, clusters = now.innovations.determined, list[Suspect]()
    taken: list[list[Suspect]] = []
    while now.innovations.determined:
        clusters = now.suspects(_clusters(edges, closures & active))
        for one in clusters:
            leverage[one.edges] = one.leverage
        alone = now.alone()
        several = [one for one in clusters if len(one.edges) > 1]  # rounding parts the two falls of a single closure
        worst = max([0.0, *(one.fall for one in clusters), *(alone[one.edges].max() for one in several)])
        steps = np.where(edges.odometry, alone, 0.0)
        slip, left = float(steps.max(initial=0.0)), freedom - _rows(edges[~active])
        limit = limit_of(now.chi2 - max(worst, slip), left - dim, dim, len(edges))
        ended = not max(worst, slip) > limit
        if ended or len(taken) == ROUNDS:
            break
        before = np.flatnonzero(~active)
        if slip > ODOMETRY * worst:
            alike = np.flatnonzero(steps >= AS_MUCH * slip)
            taken.append([Suspect(np.array([steps.argmax()]), alike, slip, 0.0, np.nan, before)])
        else:
            single = [
                replace(one, edges=k[None], alike=k[None], fall=float(alone[k]))
                for one in several
                for k in one.edges[alone[one.edges] >= AS_MUCH * worst]
            ]
            found = sorted([*clusters, *single], key=lambda one: -one.fall)
            taken.append([replace(one, before=before) for one in found if one.fall >= AS_MUCH * worst])
        active[taken[-1][0].edges] = False
        rest = Map(now.graph, active, residual)
        if not rest.innovations.determined:  # nothing is left to compare with
            ended, active[taken.pop()[0].edges] = False, True
            break
        now = rest
        maps[active.tobytes()] = now.graph, now.chi2
    contradicted: list[Suspect] = []
    slipped: list[Suspect] = []
    if taken:
        # What agrees with the map of the rest, whose noise may be larger than stated, was not at fault.
        over = over_stated(now.chi2, left)
        out = ~active
        waiting = [*np.flatnonzero(out & edges.odometry)[:, None], *_clusters(edges, closures & out)]
        for group in waiting:
            innovation = float(now.statistics([group])[1][0])
            first, *others = next(picked for picked in taken if np.isin(picked[0].edges, group).any())
            if not innovation > over * limit:
                active[group] = len(group) == 1
                waiting += [*group[:, None]] if len(group) > 1 else []  # opposite errors have nothing in common
            elif edges.odometry[group[0]]:
                slipped.append(first)
            else:
                contradicted.append(replace(first, edges=group, alike=group, fall=innovation))
                contradicted += [one for one in others if not out[one.edges].any() and one.fall > limit]
        if (active & out).any():
            contradicted, slipped = (
                [replace(one, before=one.before[~active[one.before]]) for one in each]
                for each in (contradicted, slipped)
            )
            now = Map(now.graph, active, residual)
            maps[active.tobytes()] = now.graph, now.chi2
    named = np.concatenate([np.zeros(0, dtype=np.intp), *(one.edges for one in contradicted)])
    if taken and now.innovations.determined:
        clusters = now.suspects(_clusters(edges, closures & active))
        ended = ended and all(one.fall <= over * limit for one in clusters)
    unsupported = [
        replace(one, before=np.flatnonzero(~active))
        for one in clusters
        if one.moved > FAR and one.leverage >= LEVERAGE and not np.isin(one.edges, named).any()
    ]
    by_kind: dict[Kind, list[Suspect]] = {
        "contradicted": sorted(contradicted, key=lambda one: -one.fall),
        "slipped": slipped,
        "unsupported": sorted(unsupported, key=lambda one: -one.moved),
    }
    return Search(solved, maps, by_kind, leverage, weak, ended, partial)


def optimum(pose_graph: PoseGraph, active: BoolArray, residual: ResidualName = "log") -> tuple[PoseGraph, float]:
    """Minimum of plain squares of some edges (m,) near the poses of a graph, to within 1e-5 of chi2, and chi2 there."""
    solved = Map(pose_graph, active, residual)
    return solved.graph, solved.chi2


class Partial:
    """Optima of parts of the edges of a graph, near its poses; the structure of all is found once.

    Attributes:
        graph: all edges, at the poses that solves begin from.
        stated: the graph, its poses and their guess; every edge counts unless data say otherwise.
    """

    def __init__(self, pose_graph: PoseGraph, residual: ResidualName) -> None:
        """State it."""
        self.graph = pose_graph
        self.stated = self._stated, self._x, _ = pose_graph.graph(residual=residual)
        self._counting: list[tuple[Data, BoolArray]] = []
        for name in ("odometry", "closures"):
            chosen = pose_graph.edges.odometry == (name == "odometry")
            if chosen.any():
                used = self._stated.data(f"{name} that count", np.ones(int(chosen.sum()), dtype=np.bool_), each=True)
                self._stated.replace(name, active=used)
                self._counting.append((used, chosen))

    def optimum(self, active: BoolArray, start: PoseGraph) -> tuple[PoseGraph, float]:
        """Minimum of plain squares of some edges (m,) near a start, to within 1e-5 of chi2, and chi2 there."""
        data = {used: active[chosen] for used, chosen in self._counting}
        places = [start.poses, start.landmarks]
        guess = dict(zip(self._stated.families.values(), places, strict=False))
        solution, solved = _solved(self.graph, self._stated, self._x, guess, data)
        return solved, 2.0 * solution.cost


def _solved(
    pose_graph: PoseGraph, stated: Graph, x: Family, guess: Mapping[Family, Array], data: Mapping[Data, BoolArray]
) -> tuple[Solution, PoseGraph]:
    """Optimum of a stated graph, to within 1e-5 of chi2, and the pose graph there."""
    solution = GaussNewton(tolerance=MAP, max_iterations=FEW).solve(stated, guess, data=data)
    if not solution.converged:
        solution = LevenbergMarquardt(tolerance=MAP).solve(stated, solution, data=data)
    landmarks = solution[stated.families["landmarks"]] if len(pose_graph.landmarks) else None
    return solution, pose_graph.with_poses(solution[x], landmarks)


def limit_of(squared: float, freedom: int, size: int, count: int) -> float:
    """Fall of the sum of squares that right measurements of ``size`` numbers stay below, one of ``count``."""
    noise = SPARE * VarianceFactor(squared, freedom).unit
    return min(1.0, max(CALM, noise)) * upper_quantile(size, CHANCE / max(count, 1))


def over_stated(squared: float, freedom: int) -> float:
    """Least factor by which noise is larger than stated, one where it may be as stated."""
    return max(1.0, squared / upper_quantile(freedom, 1.0 - CHANCE)) if freedom > 0 else 1.0


def _rows(edges: Edges) -> int:
    """Count of the numbers that edges measure."""
    return int(np.linalg.matrix_rank(edges.information, hermitian=True).sum())


def _clusters(edges: Edges, chosen: BoolArray) -> list[IntArray]:
    """Groups of the chosen edges whose ends lie near each other along the drive."""
    which = np.flatnonzero(chosen)
    ends = np.sort(np.stack([edges.first[which], edges.second[which]], axis=1), axis=1)
    return [which[group] for group in neighbours(ends, NEAR)]


class Map:
    """The optimum of some edges, and what it says of any.

    Attributes:
        graph: all edges, at its poses.
        active: (m,) those that count.
        chi2: their sum of squares.
    """

    def __init__(
        self, pose_graph: PoseGraph, active: BoolArray, residual: ResidualName, whole: Partial | None = None
    ) -> None:
        """Solve; where all edges count, what a `whole` has stated serves as well."""
        part = replace(pose_graph, edges=pose_graph.edges[active])
        stated, x, guess = part.graph(residual=residual) if whole is None else whole.stated
        solution, self.graph = _solved(pose_graph, stated, x, guess, {})
        self.active, self.residual = active.copy(), residual
        self.chi2 = 2.0 * solution.cost
        self._program, self._values = stated.compile(), solution.values

    @cached_property
    def _counting(self) -> tuple[CompiledProblem, Linearization]:
        """Edges that count."""
        return self._program, self._program.linearize(self._values)

    @cached_property
    def _factorization(self) -> Factorization:
        return self._program.systems.normal()

    @cached_property
    def innovations(self) -> Innovations:
        """Innovations of any edges, by those that count."""
        return Innovations(self._program, self._factorization, self._counting[1].hessian)

    def weak(self) -> tuple[str, ...]:
        """Names of unknowns whose pivots are next to nothing, or that of the first that vanishes."""
        program, lin = self._counting
        if self.innovations.determined:
            order = self._factorization.plan.order[: program.size]
            which = order[self._factorization.pivots() <= HARDLY * lin.hessian[program.normal.diagonal][order]]
        else:
            which = np.array([self._factorization.failure])
        names = ["{}[{}]".format(*program.columns.name(int(program.columns.free[k]))) for k in np.sort(which) if k >= 0]
        return tuple(dict.fromkeys(names))

    def alone(self) -> Array:
        """(m,) fall of the sum of squares without each edge alone; zero for those that do not count."""
        edges = self.graph.edges
        found = np.zeros(len(edges))
        program, lin = self._counting
        for term in program.cost_terms:
            if term.name in ("odometry", "closures"):
                where = np.flatnonzero((edges.odometry == (term.name == "odometry")) & self.active)
                loop = edges.first[where] != edges.second[where]
                weight = np.ones(int(loop.sum()))
                found[where[loop]] = self.innovations.without(term, lin, loop, weight)[0]
        return found

    def suspects(self, groups: list[IntArray]) -> list[Suspect]:
        """Statistics of groups of closures that count."""
        if not groups:
            return []
        fall, _, leverage, moved = self.statistics(groups)
        none = np.zeros(0, dtype=np.intp)
        columns = zip(groups, fall.tolist(), leverage.tolist(), moved.tolist(), strict=True)
        return [Suspect(group, group, a, b, c, none) for group, a, b, c in columns]

    def statistics(self, groups: list[IntArray]) -> tuple[Array, Array, Array, Array]:
        """(c,) falls of groups that count, squared innovations of those that do not, leverages, standard deviations.

        Args:
            groups: of edges with an error in common, all of them closures or all odometry.
        """
        edges, group, dim = self.graph.edges, self.graph.group, self.graph.group.dim
        chosen, sizes = np.concatenate(groups), np.array([len(one) for one in groups])
        starts = np.cumsum(sizes) - sizes
        along = bool(edges.odometry[chosen[0]])
        counting = bool(self.active[chosen].all())
        program, lin = self._counting if counting else self._all
        term = next(term for term in program.cost_terms if term.name == ("odometry" if along else "closures"))
        of_term = np.flatnonzero((edges.odometry == along) & (self.active | (not counting)))
        rows = self.innovations.rows(term, lin, np.searchsorted(of_term, chosen))
        turned = edges.first[chosen] > edges.second[chosen]
        late = np.where(turned, edges.first[chosen], edges.second[chosen])
        hinge = np.repeat(late[starts + sizes // 2], sizes)
        across = group.adjoint(group.between(self.graph.poses[late], self.graph.poses[hinge]))
        shift = np.where(turned[:, None, None], rows[1][:, :, :dim], rows[1][:, :, dim:]) @ across
        return self._tested(rows, shift, starts)

    def surveys(self, kind: str, groups: list[IntArray]) -> tuple[Array, Array, Array, Array]:
        """The same of groups of sightings that count, which see all landmarks displaced by one rigid motion."""
        seen, group, dim = self.graph.sightings[kind], self.graph.group, self.graph.group.dim
        chosen, sizes = np.concatenate(groups), np.array([len(one) for one in groups])
        starts = np.cumsum(sizes) - sizes
        rows = self.innovations.rows(self.term(kind), self._counting[1], chosen)
        hinge = np.repeat(seen.pose[chosen][starts + sizes // 2], sizes)
        poses = self.graph.poses
        across = group.adjoint(group.between(poses[seen.pose[chosen]], poses[hinge]))
        return self._tested(rows, rows[1][:, :, :dim] @ across, starts)

    def single(self, kind: str, chosen: IntArray) -> Array:
        """(k,) fall of the sum of squares without each of some sightings alone."""
        term = self.term(kind)
        mask = np.isin(np.arange(term.count), chosen)
        return self.innovations.without(term, self._counting[1], mask, np.ones(len(chosen)))[0]

    def term(self, name: str) -> CompiledTerm:
        """A cost by its name."""
        return next(term for term in self._program.cost_terms if term.name == name)

    def _tested(
        self, rows: tuple[Array, Array, IntArray], shift: Array, starts: IntArray
    ) -> tuple[Array, Array, Array, Array]:
        """Statistics of groups of measurements whose residuals an error in common moves by ``shift``."""
        own, held, pull = self.innovations.common(rows, shift, starts)
        diagonal = np.einsum("cii->ci", own)
        by = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))  # so that the unit of length decides nothing
        lengths, axes = np.linalg.eigh(own * by[:, :, None] * by[:, None, :])
        seen = lengths > UNCHECKED * lengths[:, -1:]
        unit = np.where(seen, 1.0 / np.sqrt(np.where(seen, lengths, 1.0)), 0.0)[:, None, :] * axes * by[:, :, None]
        share, inner = np.linalg.eigh(np.swapaxes(unit, 1, 2) @ held @ unit)
        pulled = np.einsum("cia,ci->ca", unit @ inner, pull) ** 2
        free = 1.0 - share > UNCHECKED
        left = np.where(free, 1.0 - share, np.inf)
        moved = np.sqrt(np.sum(pulled * np.maximum(share, 0.0) / left**2, axis=1))
        return (
            np.sum(pulled / left, axis=1),
            np.sum(pulled / (1.0 + share), axis=1),
            np.clip(share[:, -1], 0.0, 1.0),
            np.where(free.all(axis=1), moved, np.inf),
        )

    @cached_property
    def _all(self) -> tuple[CompiledProblem, Linearization]:
        """All edges at these poses."""
        graph, _, guess = self.graph.graph(residual=self.residual)
        return graph.compile(), graph.compile().linearize(guess)
