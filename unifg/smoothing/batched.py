"""Parts of an update that stay in Python: functions of NumPy, losses of a user's own, manifolds moved by NumPy.

A pass over the tree stops where these are needed, and Python evaluates whole statements at once, as a graph does. A
function therefore sees the batch that was stated, also when some of its factors have been marginalised since: their
variables then stay where they were last seen.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

import numpy as np

from unifg.codegen.vectors import Address
from unifg.factors.autodiff.captured import Captured
from unifg.factors.differences import jacobian
from unifg.factors.whitening import whiten_rows
from unifg.modeling.factors import prior
from unifg.modeling.terms import Cost
from unifg.problem.columns import Columns, Values
from unifg.problem.term import CompiledTerm
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.linear import take_in, waiting
from unifg.smoothing.queries import estimates
from unifg.smoothing.state import State
from unifg.typing import Array, IntArray

logger = logging.getLogger("unifg")
_told: set[str] = set()  # terms whose functions have changed, which is said once


class Batch:
    """The factors of one statement, evaluated together.

    Attributes:
        term: the statement, whose families have as many members as it selects.
        rows: for each of them the variables of the smoother.
        reach: what its function read when it was stated; None where that is known to have changed, or not known.
        values: of all its variables, as last seen.
    """

    def __init__(
        self, term: CompiledTerm, rows: list[IntArray], values: list[Array], reach: Captured | None = None
    ) -> None:
        """Take a statement and where its variables stand."""
        self.term, self.rows, self.reach = term, rows, reach
        families = [selection.family for selection in term.term.selections]
        self.values: Values = Columns(families, ()).values(dict(zip(families, values, strict=True)))

    def __getstate__(self) -> dict[str, Any]:
        """In another process names mean what they mean there."""
        return {**vars(self), "reach": None}

    def _look(self, memory: Address, items: IntArray, points: bool) -> None:
        """Read the variables of some of its factors."""
        for selection, rows in zip(self.term.term.selections, self.rows, strict=True):
            which = items if len(rows) > 1 else np.zeros(1, dtype=np.int64)
            found = np.empty(len(which) * selection.family.manifold.storage)
            estimates(memory, rows[which], points, found)
            self.values[selection.family][which] = found.reshape(len(which), -1)

    def linearize(self, memory: Address, factors: IntArray, items: IntArray) -> None:
        """Evaluate some of its factors at their linearisation points, and hand on what they are."""
        cost = self.term.term
        assert isinstance(cost, Cost)
        with np.errstate(all="ignore"):
            self._look(memory, items, True)
            r = np.array(self.term.residual(self.values))
            J = np.concatenate(self.term.jacobians(self.values), axis=2)
            whiten_rows(self.term.whitening, self.term.whitener, r, J)
            if cost.robust is not None:
                roots = np.sqrt(cost.robust.weight((r * r).sum(axis=1)))
                r *= roots[:, None]
                J *= roots[:, None, None]
        take_in(memory, factors, r[items], J[items])

    def cost(self, memory: Address, items: IntArray) -> float:
        """Sum of 1/2 rho(|W r|^2) of some of its factors at the estimates."""
        cost = self.term.term
        assert isinstance(cost, Cost)
        with np.errstate(all="ignore"):
            self._look(memory, items, False)
            r = np.array(self.term.residual(self.values))
            whiten_rows(self.term.whitening, self.term.whitener, r, np.empty((0, 0, 0)))
            squared = (r * r).sum(axis=1)
            return 0.5 * float((squared if cost.robust is None else cost.robust.value(squared))[items].sum())


class Batches:
    """The statements of one smoother that Python evaluates, by their numbers."""

    def __init__(self) -> None:
        """Hold none."""
        self._held: dict[int, Batch] = {}
        self._next, self._limit = 1, 64

    def __bool__(self) -> bool:
        """Test whether there are any."""
        return bool(self._held)

    def add(self, batch: Batch) -> int:
        """Hold another one and return its number."""
        self._held[self._next] = batch
        self._next += 1
        return self._next - 1

    def linearize(self, state: State, memory: Address) -> None:
        """Evaluate all factors that wait for it."""
        for number, factors, items in self._by_batch(state, waiting(memory)):
            self._held[number].linearize(memory, factors, items)

    def cost(self, state: State, memory: Address) -> float:
        """Of all their factors, at the estimates."""
        found = self._by_batch(state, np.flatnonzero(state.factors["used"]))
        return sum(self._held[number].cost(memory, items) for number, _, items in found)

    def forget(self, state: State) -> None:
        """Let go of statements of which no factor is left, now and then."""
        if len(self._held) > self._limit:
            left = {number for number, _, _ in self._by_batch(state, np.flatnonzero(state.factors["used"]))}
            self._held = {number: batch for number, batch in self._held.items() if number in left}
            self._limit = 64 + 2 * len(self._held)

    def _watch(self, batches: list[Batch]) -> None:
        """Say once for each term if its function reads something else by now than when a factor was stated."""
        for reach in {id(batch.reach): batch.reach for batch in batches if batch.reach is not None}.values():
            if reach.changed:
                for batch in batches:
                    if batch.reach is reach:
                        batch.reach = None
                        tell(batch.term.name)

    def _by_batch(self, state: State, factors: IntArray) -> Iterable[tuple[int, IntArray, IntArray]]:
        """Number of each batch among some factors, those of its own, and which they are within it."""
        numbers = state.factors["batch"][factors]
        asked = np.unique(numbers[numbers > 0]).tolist()
        self._watch([self._held[number] for number in asked])
        for number in asked:
            own = factors[numbers == number]
            yield number, own, state.factors["item"][own]


def tell(name: str) -> None:
    """Say of a term, once, that factors have changed with what its function reads."""
    if name not in _told:
        _told.add(name)
        logger.warning(
            "term '%s': what its function reads has changed since a factor was stated, and the factor with it: "
            "give numbers that belong to a factor as an argument, as in minimize(f, x[0], number)",
            name,
        )


def move_by_python(state: State, family: GrowingFamily, rewritten: bool) -> None:
    """Renew the estimates of a family that NumPy moves, and what priors need to follow them.

    Args:
        state: of its smoother.
        family: whose manifold has no compiled retraction.
        rewritten: whether there are priors that follow points, and need the derivative of Log(x^-1 y) with respect to
            y from point to estimate.
    """
    manifold = family.manifold
    storage, dim = manifold.storage, manifold.dim
    first = state.variables["value"][family.rows(family.alive())][:, None]
    if not len(first):
        return
    steps, moved = first + storage + np.arange(dim), first + storage + 3 * dim + np.arange(storage)
    points = state.numbers[first + np.arange(storage)]
    found = np.asarray(manifold.retract(points, state.numbers[steps]), dtype=np.float64)
    state.numbers[moved] = found
    if rewritten:
        own = prior.on(manifold)
        if own.jacobian is not None:
            slope = own.jacobian(found, points)[0]
        else:
            slope = jacobian(lambda x: own.function(x, points), [found], [manifold])[0]
        state.numbers[moved[:, -1:] + 1 + np.arange(dim * dim)] = slope.reshape(len(found), dim * dim)
