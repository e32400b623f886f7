"""The graph: what is unknown, what is minimised, what must hold.

A statement is looked at before it is kept: the function is called once, weights and limits are compared with what it
returns. One that is refused leaves the graph as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from copy import copy
from dataclasses import replace
from difflib import get_close_matches
from html import escape
from operator import index
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np

from unifg.errors import GraphError
from unifg.factors.residuals import Residual, as_residual
from unifg.factors.robust import Loss
from unifg.lie import Manifold, Rn
from unifg.lie.product import Product
from unifg.modeling.duplicates import doubles, kept
from unifg.modeling.elements import elements_of, on_manifolds
from unifg.modeling.factors import ManifoldResidual
from unifg.modeling.probing import rows_of
from unifg.modeling.quantities import quantity
from unifg.modeling.soft import Soft, slack_of
from unifg.modeling.summary import inventory
from unifg.modeling.terms import Constraint, Cost, Fix, ScalarCost, Term, prepare_arguments
from unifg.modeling.units import SAME as ALIKE
from unifg.modeling.units import compare
from unifg.modeling.variables import (
    RESERVED,
    Data,
    Declared,
    Family,
    ParameterLike,
    Selection,
    Variable,
    as_selection,
    is_variable,
    undeclared,
)
from unifg.modeling.weights import check_limits, check_weights, placed, require_loss
from unifg.typing import Array, ArrayLike, IntArray

AnyResidual: TypeAlias = (
    Callable[[Array], Array]
    | Callable[[Array, Array], Array]
    | Callable[[Array, Array, Array], Array]
    | Callable[[Array, Array, Array, Array], Array]
    | Callable[[Any], Array]
    | Callable[[Any, Any], Array]
    | Callable[[Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any, Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any, Any, Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any, Any, Any, Any, Any, Any], Array]
    | Callable[[Any, Any, Any, Any, Any, Any, Any, Any, Any, Any], Array]
    | Residual
    | ManifoldResidual
)
"""What computes residuals. By the first lines a type checker knows that a lambda's arguments are arrays, by the others
functions may take numbers besides; with ``Callable[..., Array]`` among them, pyright would know nothing of a lambda."""
S = TypeVar("S", bound="Model")
SAME: Final[Any] = object()
"""In the place of what :meth:`Model.replace` leaves as it is, and of a limit that is not given."""


class Model:
    """Variables on Lie groups, costs and constraints over them.

    The objective is ``sum 1/2 |r|^2`` over the costs plus the scalar costs; constraints read
    ``lower <= g(x) <= upper``. A graph holds no values: a solve takes a guess and returns a solution,
    and changes neither the graph nor the guess. ``print(graph)`` lists what it holds.

    Attributes:
        families: variable families by name.
        terms: costs and constraints in the order they were stated.
        fixes: fixed variables.
        starts: further first guesses, for solvers that begin at several: functions that return values by family.
        compiled: what rooms above have made of this statement, dropped with every change; None before.
        edition: how often it has been changed.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.families: dict[str, Family] = {}
        self.terms: list[Term] = []
        self.fixes: list[Fix] = []
        self.starts: list[Callable[[], Mapping[Family, Array]]] = []
        self._data: dict[str, Data] = {}
        self._names: set[str] = set()
        self.compiled: object | None = None
        self.edition = 0

    def variables(
        self, name: str, manifold: Manifold, count: int, *, units: str | None = None, frame: str | None = None
    ) -> Family:
        """Add a family of ``count`` unknowns.

        Args:
            name: unique.
            manifold: of every member.
            count: number of them.
            units: of the tangent coordinates, as in ``"m, m, rad"``, or one for a vector; compared with those of data,
                constants and functions in every term that declares both.
            frame: a name such as ``"map"``, or ``"map_T_base"`` for poses of the base in the map; compared likewise.

        Raises:
            GraphError: when the name is taken, ``count`` is no positive integer, ``manifold`` is no manifold, or the
                units do not fit it.
        """
        require_family(name, manifold, self.families)
        try:
            count = index(count)
        except TypeError:
            raise GraphError(f"family '{name}' needs a whole number of members, found count={count!r}") from None
        if count < 1:
            raise GraphError(f"family '{name}' needs at least one member, found count={count}", family=name)
        family = Family(name, manifold, count, quantity(f"family '{name}'", units, frame, manifold))
        self.families[name] = family
        self._changed()
        return family

    def data(
        self,
        name: str,
        value: ArrayLike,
        *,
        each: bool | None = None,
        units: str | None = None,
        frame: str | None = None,
    ) -> Data:
        """Declare an array that may be replaced between solves.

        Args:
            name: shown in messages.
            value: default; its shape (and whether it is boolean) is kept.
            each: True where the first axis runs over the factors of the terms that use it, False where all factors
                share it; None leaves it to the structure of each term's function.
            units: of the numbers of a row, as in ``"m, m, rad"``; ``wxyz`` or ``xyzw`` for a quaternion.
            frame: as for :meth:`variables`.

        Raises:
            GraphError: when the name is taken, or the value is not made of real numbers or booleans.
        """
        _require_name("data", name)
        if name in self._data:
            raise GraphError(f"data '{name}' exists already: choose another name")
        self._data[name] = Data(name, value, each, quantity(f"data '{name}'", units, frame))
        return self._data[name]

    def minimize(
        self,
        function: AnyResidual,
        *arguments: Any,
        sigma: ParameterLike | None = None,
        information: ParameterLike | None = None,
        robust: Loss | None = None,
        active: Any = None,
        name: str | None = None,
    ) -> str:
        """Add 1/2 |r|^2 weighted by the information matrix, for each factor.

        Args:
            function: batched residual returning (n, m).
            *arguments: families or selections (unknowns), data, and constants passed as they are.
            sigma: standard deviations, scalar, (m,) or (n, m), in the residual's units.
            information: (m, m) or (n, m, m) symmetric positive semi-definite.
            robust: loss on the squared whitened norm.
            active: (n,) booleans, constant or data; inactive factors keep their place and cost nothing.
            name: defaults to the function's name.

        Returns:
            The term's name.

        Raises:
            GraphError: on contradictory or malformed arguments; the graph is as it was.
        """
        return self._add(self._cost(name, function, arguments, sigma, information, robust, active))

    def minimize_scalar(
        self, function: AnyResidual, *arguments: Any, active: Any = None, name: str | None = None
    ) -> str:
        """Add a cost that is not a square: ``function`` returns (n,) values, added as they are.

        Gradient and Hessian are exact where the function can be traced, and come from differences elsewhere.
        Least-squares backends refuse it.
        """
        return self._add(self._scalar_cost(name, function, arguments, active))

    def constrain(
        self,
        function: AnyResidual,
        *arguments: Any,
        lower: ParameterLike = SAME,
        upper: ParameterLike = SAME,
        active: Any = None,
        soft: Soft | ParameterLike | None = None,
        name: str | None = None,
    ) -> str:
        """Require ``lower <= g <= upper``; equal limits make an equality, a limit that is not given is none.

        Multipliers are positive at an active upper limit and negative at an active lower one.

        Args:
            function: batched, returning (n, m).
            *arguments: as for :meth:`minimize`.
            lower: scalar, (m,) or (n, m), constant or data; may be infinite.
            upper: the same.
            active: (n,) booleans, constant or data; inactive factors keep their place and require nothing.
            soft: None for limits that must hold. A price w per unit of violation, of the same shapes, for limits that
                give way where that is cheaper, which above the multiplier of the hard constraint is nowhere; or
                ``fg.Soft(linear=w, quadratic=q)``. ``solution.slack(name)`` is the violation.
            name: defaults to the function's name.

        Raises:
            GraphError: when there is no limit, a lower limit exceeds its upper limit, or anything is malformed; the
                graph is as it was.
        """
        return self._add(self._constraint(name, function, arguments, lower, upper, active, soft))

    def bound(
        self,
        variable: Variable,
        *,
        lower: ParameterLike = SAME,
        upper: ParameterLike = SAME,
        soft: Soft | ParameterLike | None = None,
        name: str | None = None,
    ) -> str:
        """Limit Rn variables, or Rn components of a product, entry by entry; an infinite limit is none.

        ``soft`` is that of :meth:`constrain`.

        Raises:
            GraphError: when the variable does not live in Rn, there is no limit, or the limits do not fit; the graph is
                as it was.
        """
        return self._add(self._bound(name, (variable,), lower, upper, soft))

    def fix(self, variable: Variable, value: ParameterLike, *, name: str | None = None) -> str:
        """Give variables a value; they leave the unknowns and ``dual(name)`` is their reaction.

        Args:
            variable: what to fix.
            value: (storage,) for all members or (n, storage), constant or data.
            name: defaults to the family's name.

        Raises:
            GraphError: when a variable is fixed twice or the value is not on its manifold; the graph is as it was.
        """
        made = self._fix(name, (variable, value))
        self._names.add(made.name)
        self.fixes.append(made)
        self._changed()
        return made.name

    def term(self, name: str) -> Term | Fix:
        """The term or fix of that name.

        Raises:
            GraphError: when there is none.
        """
        for stated in self._stated:
            if stated.name == name:
                return stated
        known = [stated.name for stated in self._stated]
        near = get_close_matches(str(name), known, 1, 0.0)
        listed = ", ".join(f"'{other}'" for other in known) if len(known) <= 12 else f"{len(known)}, as '{near[0]}'"
        raise GraphError(f"no term is called {name!r} (there are: {listed or 'none'})", term=str(name))

    def remove(self, *names: str) -> None:
        """Take terms and fixes out of the graph, and with them the data that nothing else uses.

        Solutions and prepared solvers stay as they are: they speak of the graph as it was.

        Raises:
            GraphError: when one of the names is unknown; nothing is removed then.
        """
        gone = [self.term(name) for name in names]
        self._drop(gone)
        self._names.difference_update(names)
        self.terms[:] = [term for term in self.terms if term not in gone]
        self.fixes[:] = [fix for fix in self.fixes if fix not in gone]
        self._changed()

    def replace(
        self,
        name: str,
        *stated: Any,
        sigma: ParameterLike | None = SAME,
        information: ParameterLike | None = SAME,
        robust: Loss | None = SAME,
        active: Any = SAME,
        lower: ParameterLike = SAME,
        upper: ParameterLike = SAME,
        soft: Soft | ParameterLike | None = SAME,
    ) -> None:
        """State a term anew in its place, under its name and of its kind; what is not given stays as it was.

        ``graph.replace("goal", sigma=0.05)`` changes a weight, ``graph.replace("goal", fg.prior, x[-1], pose)`` what
        is weighed. Data that nothing uses any more leave the graph.

        Args:
            name: of the term, bound or fix.
            *stated: what its statement began with: function and arguments of a cost or constraint, the variable of a
                bound, variable and value of a fix; nothing to keep them.
            sigma: as in :meth:`minimize`; takes the place of an information matrix.
            information: takes the place of sigma.
            robust: None for no loss.
            active: None for all.
            lower: as in :meth:`constrain`.
            upper: the same.
            soft: the same; None makes a soft constraint hard.

        Raises:
            GraphError: when there is no such term, it has no such part, or the new one is refused; the graph is as it
                was.
        """
        old = self.term(name)
        given = {
            "sigma": sigma, "information": information, "robust": robust, "active": active, "lower": lower,
            "upper": upper, "soft": soft,
        }  # fmt: skip
        parts = {key: value for key, value in given.items() if value is not SAME}
        wrong = [key for key in parts if key not in _PARTS[old.kind]]
        if wrong:
            has = ", ".join(_PARTS[old.kind]) or "a variable and a value"
            raise GraphError(f"term '{name}' is a {old.kind}, which has no {wrong[0]}=; it has {has}", term=name)
        if isinstance(old, Fix):
            made: Term | Fix = self._fix(name, stated or (old.selection, old.value), old)
        else:
            made = self._restated(old, stated, parts)
        place: list[Any] = self.fixes if isinstance(old, Fix) else self.terms
        place[place.index(old)] = made
        self._drop([old])
        self._changed()

    def snapshot(self: S) -> S:
        """A statement of its own of the same terms, which changes of this one do not reach."""
        kept = copy(self)
        kept.families, kept.terms, kept.fixes = dict(self.families), list(self.terms), list(self.fixes)
        kept._data, kept._names, kept.starts = dict(self._data), set(self._names), list(self.starts)
        kept.compiled = None
        return kept

    def routes(self) -> dict[str, str]:
        """For each term by name, how it is evaluated and differentiated, as far as that has been found out."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the statement of the problem, not its compiled form."""
        return {**self.__dict__, "compiled": None}

    def __repr__(self) -> str:
        """Counts of families and terms."""
        return f"<Graph: {len(self.families)} families, {len(self.terms)} terms, {len(self.fixes)} fixes>"

    def __str__(self) -> str:
        """A table of families, terms, fixes and data; see :mod:`unifg.modeling.summary`."""
        return inventory(self.families.values(), self.terms, self.fixes, self._data.values(), self.routes())

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return f"<pre>{escape(str(self))}</pre>"

    # ---------------------------------------------------------------- statements, looked at before they are kept

    def _begun(
        self,
        name: str | None,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        active: Any,
        replaced: bool,
        default: str = "",
        scalar: bool = False,
    ) -> dict[str, Any]:
        """Parts that every kind of term has, by their names in :class:`Term`."""
        wrapped = complete(function, arguments, name)
        if wrapped.kernel is not None:  # else a function in Python, which sees what becomes of all that it reaches
            arguments = tuple(
                replace(a, value=kept(a.value)) if isinstance(a, Declared) else kept(a) for a in arguments
            )
        unique = self._unique(name, default or wrapped.name, replaced)
        normal, rows, active, count = self._arguments(unique, wrapped, arguments, active)
        size = rows_of(unique, wrapped, normal, count, scalar=scalar, declared=rows)
        compare(unique, wrapped.name, arguments, wrapped.takes, elements_of(wrapped))
        return {
            "name": unique, "residual": wrapped, "arguments": normal, "active": active, "count": count, "size": size,
            "rows": rows, "given": arguments,
        }  # fmt: skip

    def _cost(
        self,
        name: str | None,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        sigma: ParameterLike | None,
        information: ParameterLike | None,
        robust: Loss | None,
        active: Any,
        replaced: bool = False,
    ) -> Cost:
        with placed(name, arguments):
            if sigma is not None and information is not None:
                raise GraphError(f"term '{name or title(function)}': give sigma or information, not both", term=name)
            parts = self._begun(name, function, arguments, active, replaced)
            unique = parts["name"]
            if robust is not None:
                require_loss(unique, robust)
            weights = check_weights(unique, sigma, information, parts["count"], parts["size"])
            if isinstance(function, ManifoldResidual) and sigma is not None:  # both in tangent coordinates
                first = next(argument for argument in parts["arguments"] if isinstance(argument, Selection))
                compare(unique, "sigma", (first, sigma), ("*", "*"), {1: Rn(parts["size"])})
            self._own_data(unique, *weights)
            return Cost(**parts, sigma=weights[0], information=weights[1], robust=robust)

    def _scalar_cost(
        self,
        name: str | None,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        active: Any,
        replaced: bool = False,
    ) -> ScalarCost:
        with placed(name, arguments):
            return ScalarCost(**self._begun(name, function, arguments, active, replaced, scalar=True))

    def _constraint(
        self,
        name: str | None,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        lower: ParameterLike,
        upper: ParameterLike,
        active: Any,
        soft: Soft | ParameterLike | None,
        replaced: bool = False,
        default: str = "",
    ) -> Constraint:
        is_bound = function is itself
        with placed(name, arguments):
            parts = self._begun(name, function, arguments, active, replaced, default)
            unique, wrapped, shape = parts["name"], parts["residual"], (parts["count"], parts["size"])
            lower, upper = _given("a bound" if is_bound else "a constraint", unique, lower, upper)
            limits = check_limits(unique, lower, upper, *shape)
            self._own_data(unique, *limits)
            if is_bound:
                manifolds = dict.fromkeys((1, 2), Rn(parts["size"]))
                compare(unique, "bound", (*parts["arguments"], lower, upper), ALIKE, manifolds)
            slack = None if soft is None else slack_of(unique, soft, *limits, *shape, wrapped)
            self._own_data(unique, *(slack.soft.data if slack is not None else ()))
            return Constraint(**parts, lower=limits[0], upper=limits[1], is_bound=is_bound, slack=slack)

    def _bound(
        self,
        name: str | None,
        stated: tuple[Any, ...],
        lower: ParameterLike,
        upper: ParameterLike,
        soft: Soft | ParameterLike | None,
        replaced: bool = False,
    ) -> Constraint:
        selection = _one_variable("a bound", stated, name)
        family = selection.family.name
        if not isinstance(selection.manifold, Rn):
            raise GraphError(
                f"bound on family '{family}': {selection.manifold.name} is not Rn; bound a component, or use constrain "
                "with a function",
                term=name,
                family=family,
            )
        return self._constraint(name, itself, (selection,), lower, upper, None, soft, replaced, f"{family} bounds")

    def _fix(self, name: str | None, stated: tuple[Any, ...], replaced: Fix | None = None) -> Fix:
        if len(stated) != 2:
            raise GraphError(f"a fix is stated by a variable and its value, found {len(stated)} arguments", term=name)
        selection, value = _one_variable("a fix", stated[:1], name), stated[1]
        unique = self._unique(name, f"{selection.family.name} fixed", replaced is not None)
        held = undeclared(unique, "the value of a fix", value, 2)
        if not isinstance(held, Data):
            held = np.array(doubles(f"fix '{unique}': value", held, term=unique), ndmin=1)
        self._own(selection, unique)
        self._own_data(unique, held)
        check_fix(unique, selection, held.value if isinstance(held, Data) else held)
        compare(unique, "fix", (selection, value), ALIKE, {1: selection.manifold})
        for other in self.fixes:
            if other is not replaced and _overlap(other.selection, selection):
                _require_once(selection, other.selection.indices, f"by '{other.name}' already")
        members, times = np.unique(selection.indices, return_counts=True)
        _require_once(selection, members[times > 1], "twice")
        return Fix(unique, selection, held)

    def _restated(self, old: Term, stated: tuple[Any, ...], parts: dict[str, Any]) -> Term:
        """A term of the same kind and name with other parts."""
        function, arguments = (stated[0], stated[1:]) if stated else (old.residual, old.given)
        arguments = arguments or old.given
        if isinstance(old, Cost):
            if (parts.get("sigma") is None) != (parts.get("information") is None):  # one takes the other's place
                parts = {"sigma": None, "information": None, **parts}
            kept = {key: parts.get(key, getattr(old, key)) for key in ("sigma", "information", "robust", "active")}
            return self._cost(old.name, function, arguments, **kept, replaced=True)
        if isinstance(old, Constraint):
            kept = {key: parts.get(key, getattr(old, key)) for key in ("lower", "upper", "soft")}
            if old.is_bound:
                return self._bound(old.name, stated or old.arguments, **kept, replaced=True)
            active = parts.get("active", old.active)
            return self._constraint(old.name, function, arguments, **kept, active=active, replaced=True)
        return self._scalar_cost(old.name, function, arguments, parts.get("active", old.active), replaced=True)

    def _add(self, term: Term) -> str:
        self._names.add(term.name)
        self.terms.append(term)
        self._changed()
        return term.name

    def _changed(self) -> None:
        self.compiled = None
        self.edition += 1

    @property
    def _stated(self) -> list[Term | Fix]:
        return [*self.terms, *self.fixes]

    def _drop(self, gone: Sequence[Term | Fix]) -> None:
        """Let data go that only ``gone`` uses."""
        used = {handle for stated in self._stated if stated not in gone for handle in stated.data}
        for handle in {handle for stated in gone for handle in stated.data} - used:
            self._data.pop(handle.name, None)

    def _arguments(
        self, name: str, wrapped: Residual, arguments: tuple[Any, ...], active: Any
    ) -> tuple[tuple[Any, ...], tuple[bool | None, ...], Any, int]:
        normal, rows, active, count = prepare_arguments(name, arguments, active)
        for argument in normal:
            if isinstance(argument, Selection):
                self._own(argument, name)
        self._own_data(name, *normal, active)
        return on_manifolds(name, wrapped, normal, active), rows, active, count

    def _own(self, selection: Selection, term: str) -> None:
        if self.families.get(selection.family.name) is not selection.family:
            raise GraphError(
                f"term '{term}': family '{selection.family.name}' belongs to another graph",
                term=term,
                family=selection.family.name,
            )

    def _own_data(self, term: str, *given: Any) -> None:
        for handle in given:
            if isinstance(handle, Data) and self._data.get(handle.name) is not handle:
                raise GraphError(
                    f"term '{term}': data '{handle.name}' is not of this graph: it is another's, or left with the last "
                    "term that used it; declare it with graph.data",
                    term=term,
                )

    def _unique(self, name: str | None, default: str, replaced: bool = False) -> str:
        if name is not None:
            _require_name("term", name)
            if name in self._names and not replaced:
                raise GraphError(
                    f"the name '{name}' is taken: names identify terms in duals and tables; choose another, or change "
                    "the term with graph.replace",
                    term=name,
                )
            return name
        candidate, number = default, 2
        while candidate in self._names:
            candidate, number = f"{default} {number}", number + 1
        return candidate


_PARTS = {
    "cost": ("sigma", "information", "robust", "active"),
    "scalar cost": ("active",),
    "equality": ("lower", "upper", "active", "soft"),
    "inequality": ("lower", "upper", "active", "soft"),
    "bound": ("lower", "upper", "soft"),
    "fix": (),
}


def complete(function: AnyResidual, arguments: tuple[Any, ...], name: str | None = None) -> Residual:
    """Give a manifold residual the manifold of its first variable; wrap plain functions.

    Raises:
        GraphError: naming the term and the family when the residual has no meaning on that manifold.
    """
    if not isinstance(function, ManifoldResidual):
        return as_residual(function)
    for argument in arguments:
        if is_variable(argument):
            selection = as_selection(argument)
            try:
                return function.on(selection.manifold)
            except GraphError as error:
                family = selection.family.name
                raise GraphError(
                    f"term '{name or function.name}': {error} (family '{family}')", term=name, family=family
                ) from error
    raise GraphError(f"'{function.name}' has no variable among its arguments: pass a family or a selection", term=name)


def itself(value: Array) -> Array:
    """The residual of a bound."""
    return value


def _overlap(first: Selection, second: Selection) -> bool:
    return first.family is second.family and (
        None in (first.component, second.component) or first.component == second.component
    )


def title(function: Any) -> str:
    """Name of a residual."""
    return getattr(function, "name", None) or getattr(function, "__name__", None) or "residual"


def require_family(name: str, manifold: Manifold, taken: Container[str]) -> None:
    """Refuse what is no name, or taken, and what is no manifold, or has components that could not be selected."""
    _require_name("family", name)
    if name in taken:
        raise GraphError(f"family '{name}' exists already: choose another name", family=name)
    if isinstance(manifold, type) or not hasattr(manifold, "name"):
        raise GraphError(
            f"family '{name}' needs a manifold such as fg.SE2 or fg.Rn(3), found {manifold!r}", family=name
        )
    hidden = [part for part in getattr(manifold, "components", ()) if part in RESERVED]
    if isinstance(manifold, Product) and hidden:
        raise GraphError(
            f"family '{name}': the component '{hidden[0]}' of {manifold.name} could not be selected, because "
            f"{name}.{hidden[0]} means something else: give it another name",
            family=name,
        )


def _require_name(what: str, name: Any) -> None:
    if not isinstance(name, str) or not name:
        raise GraphError(f"the name of a {what} must be a text that is not empty, found {name!r}")


def _given(what: str, name: str, lower: ParameterLike, upper: ParameterLike) -> tuple[ParameterLike, ParameterLike]:
    """Limits with infinity for the one that is not given; that neither is, is a mistake."""
    if lower is SAME and upper is SAME:
        raise GraphError(f"term '{name}': {what} without limits says nothing: give lower=, upper= or both", term=name)
    return (-np.inf if lower is SAME else lower), (np.inf if upper is SAME else upper)


def _one_variable(what: str, stated: tuple[Any, ...], name: str | None) -> Selection:
    if len(stated) != 1 or not is_variable(stated[0]):
        found = ", ".join(f"{argument!r}"[:60] for argument in stated)
        raise GraphError(f"{what} takes one family or selection, found {found or 'nothing'}", term=name)
    return as_selection(stated[0])


def _require_once(selection: Selection, others: IntArray, how: str) -> None:
    """Refuse to fix what is fixed."""
    twice = np.intersect1d(others, selection.indices)
    if len(twice):
        raise GraphError(
            f"{selection.family.name}[{twice[0]}] is fixed {how}", family=selection.family.name, index=int(twice[0])
        )


def check_fix(name: str, selection: Selection, value: Array) -> None:
    """Raise unless ``value`` lies on the manifold of the fixed variables."""
    family, storage = selection.family.name, selection.manifold.storage
    if value.shape not in ((storage,), (len(selection), storage)):
        raise GraphError(
            f"fix '{name}': value has shape {value.shape}, expected ({storage},) or ({len(selection)}, {storage})",
            term=name,
            family=family,
        )
    valid = np.atleast_1d(selection.manifold.is_valid(value))
    if not valid.all():
        index = int(np.flatnonzero(~valid)[0])
        raise GraphError(
            f"fix '{name}': the value for {family}[{selection.indices[index]}] is not on {selection.manifold.name}: "
            f"{np.atleast_2d(value)[index]}",
            term=name,
            family=family,
            index=int(selection.indices[index]),
        )
