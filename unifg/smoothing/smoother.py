"""Base of incremental and fixed-lag smoothing: families, statements, updates, and queries."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any, NamedTuple, NoReturn

import numpy as np

from unifg.codegen.views import described
from unifg.errors import GraphError, require_kinds
from unifg.factors.robust import Loss
from unifg.lie import Manifold
from unifg.locks import ReentrantLock, synchronized
from unifg.modeling.duplicates import doubles
from unifg.modeling.model import AnyResidual, require_family
from unifg.modeling.variables import Data, ParameterLike, Selection, Variable, as_selection
from unifg.smoothing.batched import Batch, Batches, move_by_python
from unifg.smoothing.factors import Parts, Staged, Types
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.queries import (
    add_factors,
    add_variables,
    covariance_root,
    estimates,
    full_steps,
    total_cost,
)
from unifg.smoothing.state import MADE, PART, PLACE, SLOT, TYPE, State, empty_state
from unifg.smoothing.tree import give_up
from unifg.smoothing.undetermined import enough, sloped
from unifg.smoothing.update import begin, renew
from unifg.typing import Array, ArrayLike, BoolArray, IntArray, Numbers, Records

FIRST_MADE = PLACE[MADE[0]]
VARIABLE_END, FACTOR_END, CLIQUE_END = PLACE["variable_end"], PLACE["factor_end"], PLACE["clique_end"]
UPDATES, SCRATCH, FAILED = PLACE["updates"], PLACE["scratch"], PLACE["failed"]
LOST = (
    "is determined by its factors, but lost to rounding: the problem is too ill-conditioned where it is linear now, as "
    "after first guesses that are radians off, or with weights many orders apart. Begin again with better guesses, or "
    "solve the whole as a fg.Graph"
)
UNDETERMINED = (
    "is not determined by its factors: it, or something it is tied to, needs a prior or another measurement. The "
    "factors are kept; add what is missing and update again"
)
NOT_FINITE = (
    "cannot be found: a residual or its Jacobian is not finite at the present values. The factors are kept; begin "
    "again, with other values or without that factor"
)


class Effort(NamedTuple):
    """Work of one update.

    Attributes:
        eliminated: variables eliminated anew.
        relinearized: variables moved to a new linearisation point.
        substituted: variables given a new step.
        linearized: factors linearised.
        marginalized: variables dropped.
        largest: rows of the largest clique that was made.
    """

    eliminated: int
    relinearized: int
    substituted: int
    linearized: int
    marginalized: int
    largest: int


class Smoother:
    """Base of :class:`Incremental` and :class:`FixedLag`.

    Threads may share one: they wait for each other.

    Attributes:
        families: by name.
        relinearize: largest entry of a variable's step before its linearisation point follows its estimate.
        every: linearisation points are looked at in every so many updates.
        wildfire: change of a step that is passed on to parts of the graph that were not eliminated anew.
    """

    _chronological = False

    def __init__(self, relinearize: float, every: int, wildfire: float) -> None:
        """Start empty."""
        options = {"relinearize": relinearize, "every": every, "wildfire": wildfire}
        require_kinds(type(self).__name__, GraphError, Smoother.__init__.__annotations__, options)
        for name, value in (("relinearize", relinearize), ("wildfire", wildfire)):
            if not value >= 0.0:
                raise GraphError(f"{type(self).__name__}: {name} must not be negative, found {value}")
        if every < 1:
            raise GraphError(f"{type(self).__name__}: every must be at least 1, found {every}")
        self._lock = ReentrantLock()
        self.families: dict[str, GrowingFamily] = {}
        self.relinearize = relinearize
        self.every = every
        self.wildfire = wildfire
        self._types = Types()
        self._parts = Parts()
        self._batches = Batches()
        self._by_python: list[GrowingFamily] = []  # families that NumPy moves
        self._data: dict[str, Data] = {}
        self._staged: list[Staged] = []
        self._words = np.zeros(2 * len(State._fields), dtype=np.int64)
        self._memory = self._words.ctypes.data
        self._hold(empty_state())
        self._order: list[GrowingFamily] = []
        self._written = 0  # types of factors that compiled code knows

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy has arrays of its own, which stand elsewhere, and so have its kernels."""
        self.__dict__.update(state)
        self._memory = self._words.ctypes.data
        self._state.types[: self._written] = np.array(self._types.fields[: self._written], dtype=TYPE)
        parts = np.array(self._parts.fields, dtype=PART) if self._parts.fields else self._state.parts
        self._hold(self._state._replace(parts=parts))

    @synchronized
    def variables(self, name: str, manifold: Manifold, *, keep: bool = False) -> GrowingFamily:
        """Add a family of unknowns, empty at first.

        Args:
            name: unique within the smoother.
            manifold: any, also a product; the library's own, and others stated by compiled functions, are quicker.
            keep: members never leave a fixed lag.

        Raises:
            GraphError: when the name is taken, or ``manifold`` is no manifold.
        """
        require_family(name, manifold, self.families)
        parts = self._parts.of(manifold)
        self._types.scratch = max(self._types.scratch, manifold.storage + manifold.dim * (2 * manifold.dim + 1) + 8)
        family = GrowingFamily(name, manifold, len(self._order), parts, keep)
        for part in getattr(manifold, "components", ()):
            if hasattr(family, part) and not isinstance(getattr(family, part), Selection):
                raise GraphError(
                    f"family '{name}': {name}.{part} means something else in a smoother: give the component '{part}' "
                    f"of {manifold.name} another name",
                    family=name,
                )
        self._hold(self._state._replace(parts=np.array(self._parts.fields, dtype=PART)))
        if self._parts.by_python(parts):
            self._by_python.append(family)
        self.families[name] = family
        self._order.append(family)
        return family

    @synchronized
    def data(self, name: str, value: ArrayLike, *, each: bool | None = None) -> Data:
        """Declare an array for the factors stated with it, which take the value it has then.

        Args:
            name: shown in messages.
            value: numbers or booleans.
            each: as for :meth:`unifg.Graph.data`.

        Raises:
            GraphError: when the name is taken.
        """
        if name in self._data:
            raise GraphError(f"data '{name}' exists already: choose another name")
        self._data[name] = Data(name, value, each)
        return self._data[name]

    @synchronized
    def minimize(
        self,
        function: AnyResidual,
        *arguments: Any,
        sigma: ParameterLike | None = None,
        information: ParameterLike | None = None,
        robust: Loss | None = None,
        active: Any = None,
        name: str | None = None,
    ) -> None:
        """State factors 1/2 |r|^2 weighted by the information matrix; they count from the next update on.

        Args:
            function: any residual that a graph takes. In compiled form (those of unifg, kernels, functions of one
                factor compiled by Numba) it costs microseconds, as a batched NumPy function some hundred.
            *arguments: members (which may get their values in the next update), data and constants; arrays of members
                state one factor for each.
            sigma: standard deviations, scalar, (m,) or (n, m), in the residual's units.
            information: (m, m) or (n, m, m) symmetric positive semi-definite.
            robust: loss on the squared whitened norm; its weight is found when a factor is linearised.
            active: (n,) booleans; factors that are not active are left out.
            name: for messages; defaults to the function's name.

        Raises:
            GraphError: when arguments do not fit.
        """
        staged = self._types.stage(function, arguments, sigma, information, robust, active, name)
        for family in staged.families:
            if self.families.get(family.name) is not family:
                raise GraphError(
                    f"term '{staged.name}': family '{family.name}' belongs to another graph",
                    term=staged.name,
                    family=family.name,
                )
        self._staged.append(staged)

    def minimize_scalar(self, *arguments: Any, **options: Any) -> NoReturn:
        """Refused: see the message."""
        self._refuse("minimize_scalar", "a cost that is no square", "state it as squares with minimize")

    def constrain(self, *arguments: Any, **options: Any) -> NoReturn:
        """Refused: see the message."""
        self._refuse("constrain", "a constraint", "state what is measured with minimize and a small sigma")

    def bound(self, *arguments: Any, **options: Any) -> NoReturn:
        """Refused: see the message."""
        self._refuse("bound", "a constraint", "state a cost that grows outside of the bounds with minimize")

    def fix(self, *arguments: Any, **options: Any) -> NoReturn:
        """Refused: see the message."""
        self._refuse("fix", "a fixed variable", "give the value as a constant to its factors, or as a prior")

    def _refuse(self, method: str, what: str, instead: str) -> NoReturn:
        raise GraphError(
            f"{type(self).__name__}.{method}: {what} is nothing a smoother can take, whose steps are those of least "
            f"squares: {instead}, or solve the whole as a fg.Graph"
        )

    @synchronized
    def estimate(self, variable: Variable, *, best: bool = False) -> Array:
        """(n, storage) estimates of a family or selection.

        Args:
            variable: a family, or some of its members.
            best: substitute back fully, from the roots of the tree down, however little of a change ``wildfire`` would
                have passed on; takes time proportional to the tree above the members, and changes nothing.

        Raises:
            GraphError: when a member has no value, or was marginalised; with ``best``, also if the last update failed.
        """
        if not best:
            return self._values(variable, False)
        self._require_solved()
        selection = as_selection(variable)
        rows, manifold = self._rows(selection), selection.family.manifold
        steps = np.empty(len(rows) * manifold.dim)
        full_steps(self._memory, rows, steps)
        points = self._values(selection.family[selection.indices], True)
        out: Array = np.atleast_2d(manifold.retract(points, steps.reshape(len(rows), manifold.dim)))
        return out if selection.component is None else out[:, selection.storage]

    def linearization_point(self, variable: Variable) -> Array:
        """(n, storage) points at which the factors of a family or selection are linear now."""
        return self._values(variable, True)

    @synchronized
    def _values(self, variable: Variable, points: bool) -> Array:
        selection = as_selection(variable)
        rows = self._rows(selection)
        storage = selection.family.manifold.storage
        flat = np.empty(len(rows) * storage)
        estimates(self._memory, rows, points, flat)
        out = flat.reshape(len(rows), storage)
        return out if selection.component is None else out[:, selection.storage]

    @synchronized
    def covariance(self, *variables: Variable) -> Array:
        """Joint covariance (D, D) of all selected members, in their tangent spaces and the order given.

        It is that of the linear problem at the present linearisation points, conditioned on nothing else.

        Raises:
            GraphError: when a member has no value, or was marginalised; when nothing is selected.
        """
        if not variables:
            raise GraphError("covariance() of what? Name families or members, as covariance(x[-1])")
        selections = [as_selection(variable) for variable in variables]
        rows = np.concatenate([self._rows(selection) for selection in selections])
        self._require_solved()
        root = covariance_root(self._memory, rows)
        result: Array = root.T @ root
        if all(selection.component is None for selection in selections):
            return result
        whole = [np.arange(selection.family.manifold.dim) for selection in selections for _ in range(len(selection))]
        parts = [selection.tangent for selection in selections for _ in range(len(selection))]
        columns = np.concatenate([np.isin(own, own[part]) for own, part in zip(whole, parts, strict=True)])
        return np.asarray(result[np.ix_(columns, columns)])

    @property
    @synchronized
    def cost(self) -> float:
        """Sum of 1/2 rho(|W r|^2) over all factors at the estimates; half of what is often called chi2."""
        return float(total_cost(self._memory)) + self._batches.cost(self._state, self._memory)

    @synchronized
    def __len__(self) -> int:
        """Number of factors that count."""
        return int(self._state.factors["used"][: self._state.counters["factor_end"][0]].sum())

    @synchronized
    def _update(self, values: Mapping[GrowingFamily, Numbers] | None, time: float | None, iterations: int) -> None:
        """Take in new members and staged factors, then bring everything up to date."""
        if type(iterations) is not int or iterations < 1:
            require_kinds("update", GraphError, {"iterations": "int"}, {"iterations": iterations})
            if iterations < 1:
                raise GraphError(f"update: iterations must be at least 1, found {iterations}")
        if not isinstance(values, Mapping | None):
            raise GraphError(f"update: values are given by family, as {{x: [...]}}, found {f'{values!r}'[:80]}")
        new = [self._checked(family, value) for family, value in values.items()] if values else []
        if self._staged:
            self._admit({family: len(array) for family, array in new})
            self._staged = [item for item in self._staged if len(item.data)]
        self._reserve(sum(len(array) for _, array in new), sum(len(item.data) for item in self._staged))
        for family, array in new:
            out = np.empty(len(array), dtype=np.int64)
            stamps = self._stamps(family, len(array), time)
            numbers = add_variables(
                self._memory, *family.parts, family.manifold.dim, family.number, family.count, array, stamps, out
            )
            self._move(None, numbers)
            family.grow(out)
        failed = int(self._counts[FAILED])  # a variable, if the last update failed
        fresh = [np.array([[failed]])] if failed >= 0 else []
        for item in self._staged:
            touched = _touched(item)
            fresh.append(touched)
            number = self._batches.add(_batch(item, touched)) if item.term is not None else 0
            lists, numbers = add_factors(self._memory, item.kind, touched, item.data, number, item.items)
            self._move(lists, numbers)
            if item.limit:
                self._watch(item)
        self._staged.clear()
        for _ in range(iterations):
            self._solve()
        self._require_finite(fresh)

    def _effort(self) -> Effort:
        return Effort(*self._counts[FIRST_MADE : FIRST_MADE + len(MADE)].tolist())

    def _stamps(self, family: GrowingFamily, count: int, time: float | None) -> Array:
        """Ages of new members; they matter only where the order is chronological."""
        return np.zeros(count)

    def _watch(self, item: Staged) -> None:
        """Remember factors with a limit, which have just been added."""

    def _late(self, item: Staged, gone: BoolArray) -> None:
        """Factors with a variable that was marginalised: (n,) which of them."""
        self._staged.remove(item)
        for family, members in zip(item.families, item.members, strict=True):
            if (family.rows(members) == -1).any():
                self._rows(family[members], item.name)

    def _solve(self) -> None:
        """One pass over the tree."""
        state = self._state
        now = self.relinearize if (int(self._counts[UPDATES]) + 1) % self.every == 0 else np.inf
        chain = begin(self._memory, now)
        if self._batches:
            try:
                self._batches.linearize(state, self._memory)
            except BaseException:
                give_up(self._memory, 0)  # the chain is lost; factors are kept
                raise
        failed, lists, numbers = renew(self._memory, chain, self.relinearize, self.wildfire, self._chronological)
        self._move(lists, numbers)
        if failed >= 0:
            finite = isfinite(self.cost) and sloped(self._state)
            self._fail(failed, (LOST if enough(state, failed) else UNDETERMINED) if finite else NOT_FINITE)
        for family in self._by_python:
            move_by_python(self._state, family, self._chronological)

    def _require_finite(self, fresh: list[IntArray]) -> None:
        """Fail where the steps of variables with new factors are not finite."""
        variables, numbers = self._state.variables, self._state.numbers
        value, storage = variables["value"], variables["storage"]
        for rows in fresh:
            steps = numbers[value[rows] + storage[rows]]
            if not isfinite(steps.sum()):  # NumPy takes longer to look at each of a few
                lost = int(rows.ravel()[np.isfinite(steps).argmin()])
                give_up(self._memory, lost)
                self._fail(lost, NOT_FINITE)

    def _fail(self, variable: int, why: str) -> NoReturn:
        """Refuse an update, by the name of a variable."""
        record = self._state.variables[variable]
        family, member = self._order[int(record["family"])], int(record["member"])
        raise GraphError(f"{family.name}[{member}] {why}", family=family.name, index=member)

    def _checked(self, family: GrowingFamily, value: ArrayLike) -> tuple[GrowingFamily, Array]:
        """Values of new members as (n, storage)."""
        if self.families.get(getattr(family, "name", "")) is not family:
            raise GraphError(f"update: {family!r} is not a family of this smoother")
        array = np.array(doubles(f"update: the values of family '{family.name}'", value), ndmin=2, order="C")
        storage = family.manifold.storage
        if array.ndim != 2 or array.shape[1] != storage:
            raise GraphError(
                f"update: values of family '{family.name}' have shape {np.shape(value)}, expected ({storage},) or "
                f"(n, {storage})",
                family=family.name,
            )
        if family.finite and isfinite(array.sum()):
            return family, array  # NumPy is slow at the few numbers of one pose
        valid = np.atleast_1d(family.manifold.is_valid(array))
        if not valid.all():
            index = family.count + int(np.flatnonzero(~valid)[0])
            raise GraphError(
                f"update: the value of {family.name}[{index}] is not on {family.manifold.name}: "
                f"{array[index - family.count]}",
                family=family.name,
                index=index,
            )
        return family, array

    def _admit(self, new: Mapping[GrowingFamily, int]) -> None:
        """Check that all variables of staged factors have values, or get them now."""
        for item in [item for item in self._staged if len(item.data)]:  # others have no active factor
            pairs, late = list(zip(item.families, item.members, strict=True)), False
            for family, members in pairs:
                row, single = family.lowest(members), len(members) == 1
                if row < 0:
                    largest = int(members[0] if single else members.max())
                    if largest >= family.count + new.get(family, 0):
                        raise GraphError(
                            f"term '{item.name}': {family.name}[{largest}] has no value: give it one in this update",
                            term=item.name,
                            family=family.name,
                            index=largest,
                        )
                    late = late or row == -1 or not single
            if late:
                gone = np.zeros(len(item.data), dtype=bool)
                for family, members in pairs:
                    gone |= family.rows(members) == -1
                if gone.any():
                    self._late(item, gone)

    def _reserve(self, variables: int, factors: int) -> None:
        """Make the tables long enough; arenas grow by themselves."""
        state, counts, types = self._state, self._counts.tolist(), len(self._types.fields)
        variables += counts[VARIABLE_END]
        needed = (
            ("variables", variables), ("factors", counts[FACTOR_END] + factors),
            ("cliques", counts[CLIQUE_END] + variables + 1), ("types", types),
        )  # fmt: skip
        grown: dict[str, Any] = {n: longer(getattr(state, n), k) for n, k in needed if k > len(getattr(state, n))}
        if grown:
            state = state._replace(**grown)
        if self._written < types:
            state = state._replace(slots=np.array(self._types.slots, dtype=SLOT))
            state.types[:types] = np.array(self._types.fields, dtype=TYPE)
            self._written = types
        if state is not self._state:
            self._hold(state)
        self._counts[SCRATCH] = self._types.scratch

    def _move(self, lists: IntArray | None, numbers: Array | None) -> None:
        """Keep arenas that have grown."""
        if lists is not None or numbers is not None:
            self._hold(
                self._state._replace(
                    lists=self._state.lists if lists is None else lists,
                    numbers=self._state.numbers if numbers is None else numbers,
                )
            )

    def _hold(self, state: State) -> None:
        """Keep the arrays, and their description for compiled code."""
        self._state, self._words[:] = state, described(state)
        self._counts = state.counters.view(np.int64)

    def _rows(self, selection: Selection, term: str = "") -> IntArray:
        """Rows of the selected members.

        Raises:
            GraphError: when one has no value or was marginalised.
        """
        family = selection.family
        if not isinstance(family, GrowingFamily) or self.families.get(family.name) is not family:
            raise GraphError(f"family '{family.name}' belongs to another graph", family=family.name)
        rows = family.rows(selection.indices)
        if len(rows) and rows.min() < 0:
            k = int(np.argmin(rows))
            member = int(selection.indices[k])
            what = "has no value yet" if rows[k] == -2 else "was marginalised"
            where = f"term '{term}': " if term else ""
            raise GraphError(
                f"{where}{family.name}[{member}] {what}", term=term or None, family=family.name, index=member
            )
        return rows

    def _require_solved(self) -> None:
        if self._state.counters["failed"][0] >= 0:
            raise GraphError("the last update failed: state what is missing and update again")


def _touched(item: Staged) -> IntArray:
    """(n, slots) rows of the variables of staged factors."""
    pairs = zip(item.families, item.members, strict=True)
    if len(item.data) == 1:
        return np.array([[family.lowest(members) for family, members in pairs]])
    return np.stack([np.broadcast_to(family.rows(members), len(item.data)) for family, members in pairs], axis=1)


def _batch(item: Staged, touched: IntArray) -> Batch:
    """The statement of staged factors, with the variables of those that are left."""
    assert item.term is not None
    rows, values = [], []
    for slot, selection in enumerate(item.term.term.selections):
        own = np.full(len(selection), -1)
        own[item.items if len(own) > 1 else slice(None)] = touched[:, slot] if len(own) > 1 else touched[0, slot]
        rows.append(own)
        values.append(np.tile(selection.family.manifold.identity(), (len(own), 1)))
    return Batch(item.term, rows, values, item.reach)


def longer(table: Records, rows: int) -> Records:
    """The same table with twice the rows needed."""
    result = np.zeros(2 * rows, dtype=table.dtype)
    result[: len(table)] = table
    return result
