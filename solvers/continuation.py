"""First guesses for graphs along a trajectory, found by letting the trajectory grow.

Dead reckoning drifts, so that a batch solve from it may end in another minimum, or at no map at all. A graph that
holds the first k members of the trajectory and what they have seen has its minimum near that of k - 1 members:
continuation in time, as incremental smoothers have it, with the solver of the batch. All terms of a graph serve,
and all manifolds.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple, TypeGuard

import numpy as np

from unifg.errors import GraphError
from unifg.lie import LieGroup, Manifold, Rn
from unifg.modeling.factors import prior
from unifg.modeling.terms import Cost
from unifg.modeling.variables import Data, Family
from unifg.problem.columns import Values
from unifg.solution.graph import Graph
from unifg.solution.guess import Guess
from unifg.solution.solution import AnyGuess, values_of
from unifg.solution.solver import Prepared
from unifg.solution.starts import extent
from unifg.solvers.least_squares import LevenbergMarquardt
from unifg.typing import Array, BoolArray, IntArray, Numbers

__all__ = ["best_guess"]

FIRST = 10  # members of the trajectory at first
GROWTHS = np.inf, 1.5, 1.1  # how many times more in each next solve: all at once, in leaps, carefully
GOOD = 2.0  # cost over degrees of freedom, times two, that asks for no other guess
STEPS = 20  # of a solve at most
FAR = 1e3  # times what a guess covers: standard deviation of the prior of what has been reached
NEAR = 1e-3  # the same of what is held


class Plan(NamedTuple):
    """Numbers of the first k members of a trajectory at which something comes in; those that never do have K.

    Attributes:
        members: (count,) of each family.
        factors: (n,) of each cost.
        held: families whose members every factor of some cost shares; they are free in the last solve only.
    """

    members: dict[Family, IntArray]
    factors: dict[str, IntArray]
    held: set[Family]


def best_guess(
    graph: Graph, guess: AnyGuess, *, along: Family | None = None, data: Mapping[Data, Numbers] | None = None
) -> Guess:
    """Do as ``fg.best_guess`` says."""
    program = graph.compile()
    if along is not None and not isinstance(along, Family):
        raise GraphError(f"best_guess: along= is a family, as graph.variables returned it, found {along!r}")
    with program.lock:
        program.bind(data or {})
        start = program.values_from(values_of(guess))
        growth = _Growth(graph, start, along or _longest_chain(graph), dict(data or {}))
        best, least = start, program.evaluate(start).cost
        for factor in GROWTHS:
            found = program.values_from(growth.run(factor))
            cost = program.evaluate(found).cost
            best, least = (found, cost) if cost < least else (best, least)
            if 2.0 * least <= GOOD * max(program.table.residuals - program.size, 1):
                break
    return Guess({family: best[family].copy() for family in graph.families.values()})


def _longest_chain(graph: Graph) -> Family:
    """The family with the most members that costs tie to the next ones."""
    tied: dict[Family, int] = {}
    for term in graph.terms:
        own = [selection for selection in term.selections if isinstance(term, Cost)]
        for one, other in pairwise(own):
            if one.family is other.family and len(one) == len(other):
                tied[one.family] = max(tied.get(one.family, 0), int((other.indices - one.indices == 1).sum()))
    if not tied or not max(tied.values()):
        raise GraphError("best_guess: no cost ties successive members of a family: say along which one, by along=")
    return max(tied, key=lambda family: tied[family])


def _planned(graph: Graph, along: Family) -> Plan:
    """Order in which members and factors come in."""
    count, costs = along.count, [term for term in graph.terms if isinstance(term, Cost)]
    members = {family: np.full(family.count, count - 1) for family in graph.families.values()}
    members[along] = np.arange(count)
    held = {s.family for t in costs for s in t.selections if len(s) == 1 < t.count and s.family is not along}
    last = {term.name: np.full(term.count, -1) for term in costs}
    for term in costs:
        for selection in term.selections:
            if selection.family is along:
                last[term.name] = np.maximum(last[term.name], selection.indices)
    for family in [family for family in members if family not in held and family is not along]:
        seen = [
            (np.broadcast_to(selection.indices, term.count), last[term.name], np.full(term.count, term.size))
            for term in costs for selection in term.selections
            if selection.family is family
        ]  # fmt: skip
        if not seen:
            continue
        member, when, rows = (np.concatenate(part) for part in zip(*seen, strict=True))
        order = np.lexsort((when, member))
        member, when, rows = member[order], when[order], rows[order]
        first = np.flatnonzero(np.diff(member, prepend=-1))
        among = np.repeat(first, np.diff(first, append=len(member)))
        total, needed = np.cumsum(rows), family.manifold.dim
        enough = total - total[among] + rows[among] >= needed + (rows[among] < needed)
        earliest = np.minimum.reduceat(np.where(enough, when, count), first)
        members[family][member[first]] = np.clip(earliest, 0, count - 1)
    factors = {}
    for term in costs:
        latest = [members[s.family][s.indices] for s in term.selections if s.family not in held]
        factors[term.name] = np.max([np.broadcast_to(part, term.count) for part in latest], axis=0, initial=0)
    return Plan(members, factors, held)


class _Growth:
    """A graph of which a part is in."""

    def __init__(self, graph: Graph, start: Values, along: Family, data: dict[Data, Numbers]) -> None:
        """State the graph anew, with a flag for each factor and a prior for each member."""
        self._guess, self._along, self._plan = start, along, _planned(graph, along)
        self._first = {
            f: np.asarray(f.manifold.retract(start[f], np.zeros((f.count, f.manifold.dim))))  # headings within a turn
            for f in graph.families.values()
        }
        self._graph = graph.snapshot()
        self._flags: dict[str, tuple[Data, BoolArray]] = {}
        self._priors: dict[Family, tuple[Data, Data, Array]] = {}
        for term in list(self._graph.terms):
            if term.name not in self._plan.factors:
                self._graph.remove(term.name)
                continue
            active = data.get(term.active, term.active.value) if isinstance(term.active, Data) else term.active
            stated = np.ones(term.count, dtype=bool) if active is None else np.asarray(active, dtype=bool)
            flag = self._graph.data(f"best_guess: {term.name}, in", np.zeros(term.count, dtype=bool))
            self._graph.replace(term.name, active=flag)
            self._flags[term.name] = flag, stated
        for family in self._first:
            size, name = self._size(family), f"best_guess: {family.name}"
            place = self._graph.data(f"{name}, place", self._first[family])
            sigma = self._graph.data(f"{name}, sigma", np.tile(size, (family.count, 1)))
            self._graph.minimize(prior, family, place, sigma=sigma, name=name)
            self._priors[family] = place, sigma, size
        used = {handle for term in self._graph.terms for handle in term.data}
        used |= {handle for fix in self._graph.fixes for handle in fix.data}
        self._given = {handle: value for handle, value in data.items() if handle in used}
        self._run: Prepared = LevenbergMarquardt(max_iterations=STEPS, tolerance=1e-3).prepare(self._graph)

    def run(self, growth: float) -> dict[Family, Array]:
        """Grow to the whole, from the guess."""
        self.values, count, reached = dict(self._first), self._along.count, 0
        while reached < count:
            before, reached = reached, int(min(count, max(FIRST, np.ceil(growth * max(reached, 1)))))
            if growth < np.inf:
                self._bring_in(before, reached)
            self._solve(reached, self._plan.held)
        self._solve(reached, set())
        return self.values

    def _bring_in(self, before: int, reached: int) -> None:
        """Give new members their first values."""
        path, old = self.values[self._along].copy(), self._guess[self._along]
        self.values[self._along] = path
        manifold = self._along.manifold
        for k in range(max(before, 1), reached):
            path[k] = manifold.retract(path[k - 1], manifold.local(old[k - 1], old[k]))
        for family, array in list(self.values.items()):
            when = self._plan.members[family]
            new = np.flatnonzero((when >= before) & (when < reached))
            if family is not self._along and family not in self._plan.held and len(new):
                self.values[family] = moved = array.copy()
                moved[new] = _moved(manifold, old[when[new]], path[when[new]], family.manifold, array[new])

    def _solve(self, reached: int, held: set[Family]) -> None:
        """Minimise what is in."""
        given: dict[Data, Numbers] = dict(self._given)
        for name, (flag, stated) in self._flags.items():
            given[flag] = stated & (self._plan.factors[name] < reached)
        for family, (place, sigma, size) in self._priors.items():
            inside = (self._plan.members[family] < reached) & (family not in held)
            factor = np.where(inside, FAR, NEAR if family in held else 1.0)
            given[place], given[sigma] = self.values[family], factor[:, None] * size
        solution = self._run.solve(self.values, data=given)
        self.values = {family: solution[family] for family in self.values}

    def _size(self, family: Family) -> Array:
        """(d,) what a member may be off by, in its tangent space."""
        along = self._along.manifold
        size = extent(family.manifold, self._guess[family])
        if family is not self._along and _acts(along, family.manifold):
            path = along.act(self._guess[self._along], np.zeros((self._along.count, family.manifold.dim)))
            size = np.maximum(size, extent(family.manifold, path))
        return size


def _acts(group: Manifold, space: Manifold) -> TypeGuard[LieGroup]:
    """Test whether the elements of a group move the points of a space."""
    return isinstance(group, LieGroup) and isinstance(space, Rn) and group.point_dim == space.dim


def _moved(group: Manifold, old: Array, new: Array, space: Manifold, points: Array) -> Array:
    """(n, storage) points carried along with elements of a group, as far as it moves them."""
    if not _acts(group, space):
        return points
    return np.asarray(group.act(group.compose(new, group.inverse(old)), points))
