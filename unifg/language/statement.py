"""The graph: what is unknown, what is minimised, what must hold."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.residuals import Function, Residual, as_residual, residual
from unifg.kernels.robust import Loss
from unifg.language.factors import ManifoldResidual
from unifg.language.terms import Constraint, Cost, Fix, Parameter, ScalarCost, Term, prepare_arguments
from unifg.language.variables import Data, Family, Selection, Variable, as_selection, is_variable
from unifg.lie import Manifold, Rn
from unifg.typing import Array, ArrayLike

AnyResidual: TypeAlias = Function | Residual | ManifoldResidual


class Statement:
    """Variables on Lie groups, costs and constraints over them.

    The objective is ``sum 1/2 |r|^2`` over the costs plus the scalar costs; constraints read
    ``lower <= g(x) <= upper``. A graph holds no values: a solve takes a guess and returns a solution,
    and changes neither the graph nor the guess.

    Attributes:
        families: variable families by name.
        terms: costs and constraints in the order they were stated.
        fixes: fixed variables.
        compiled: what rooms above have made of this statement, dropped with every change; None before.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.families: dict[str, Family] = {}
        self.terms: list[Term] = []
        self.fixes: list[Fix] = []
        self._data: dict[str, Data] = {}
        self._names: set[str] = set()
        self.compiled: object | None = None

    def variables(self, name: str, manifold: Manifold, count: int) -> Family:
        """Add a family of ``count`` unknowns.

        Raises:
            GraphError: when the name is taken or ``count`` is not positive.
        """
        if name in self.families:
            raise GraphError(f"family '{name}' exists already: choose another name", family=name)
        if count < 1:
            raise GraphError(f"family '{name}' needs at least one member, found count={count}", family=name)
        family = Family(name, manifold, int(count))
        self.families[name] = family
        self.compiled = None
        return family

    def data(self, name: str, value: ArrayLike, *, each: bool = False) -> Data:
        """Declare an array that may be replaced between solves.

        Args:
            name: shown in messages.
            value: default; its shape (and whether it is boolean) is kept.
            each: whether the first axis runs over the factors of the terms that use it; otherwise all
                factors share it.
        """
        if name in self._data:
            raise GraphError(f"data '{name}' exists already: choose another name")
        handle = Data(name, value, each)
        self._data[name] = handle
        return handle

    def minimize(
        self,
        function: AnyResidual,
        *arguments: Any,
        sigma: Parameter | None = None,
        information: Parameter | None = None,
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
            GraphError: on contradictory or malformed arguments.
        """
        if sigma is not None and information is not None:
            raise GraphError(f"term '{name or function}': give sigma or information, not both", term=name)
        wrapped = complete(function, arguments, name)
        unique = self._unique(name, wrapped.name)
        normal, active, count = self._arguments(unique, arguments, active)
        return self._add(Cost(unique, wrapped, normal, active, count, sigma, information, robust))

    def minimize_scalar(
        self, function: AnyResidual, *arguments: Any, active: Any = None, name: str | None = None
    ) -> str:
        """Add a cost that is not a square: ``function`` returns (n,) values, added as they are.

        Gradient and Hessian are exact where the function can be traced, and come from differences elsewhere.
        Least-squares backends refuse it.
        """
        wrapped = complete(function, arguments, name)
        unique = self._unique(name, wrapped.name)
        normal, active, count = self._arguments(unique, arguments, active)
        return self._add(ScalarCost(unique, wrapped, normal, active, count))

    def constrain(
        self,
        function: AnyResidual,
        *arguments: Any,
        lower: Parameter = -np.inf,
        upper: Parameter = np.inf,
        active: Any = None,
        name: str | None = None,
    ) -> str:
        """Require ``lower <= g <= upper``; equal limits make an equality.

        Multipliers are positive at an active upper limit and negative at an active lower one.

        Raises:
            GraphError: when a lower limit exceeds its upper limit.
        """
        wrapped = complete(function, arguments, name)
        unique = self._unique(name, wrapped.name)
        normal, active, count = self._arguments(unique, arguments, active)
        check_limits(unique, lower, upper)
        return self._add(Constraint(unique, wrapped, normal, active, count, lower, upper))

    def bound(
        self,
        variable: Variable,
        *,
        lower: Parameter = -np.inf,
        upper: Parameter = np.inf,
        name: str | None = None,
    ) -> str:
        """Limit Rn variables, or Rn components of a product, entry by entry.

        Raises:
            GraphError: when the variable does not live in Rn.
        """
        selection = as_selection(variable)
        if not isinstance(selection.manifold, Rn):
            raise GraphError(
                f"bound on family '{selection.family.name}': {selection.manifold.name} is not Rn; bound a component, "
                "or use constrain with a function",
                family=selection.family.name,
            )
        unique = self._unique(name, f"{selection.family.name} bounds")
        normal, active, count = self._arguments(unique, (selection,), None)
        check_limits(unique, lower, upper)
        return self._add(Constraint(unique, residual(itself), normal, active, count, lower, upper, is_bound=True))

    def fix(self, variable: Variable, value: ArrayLike | Data, *, name: str | None = None) -> str:
        """Give variables a value; they leave the unknowns and ``dual(name)`` is their reaction.

        Args:
            variable: what to fix.
            value: (storage,) for all members or (n, storage), constant or data.
            name: defaults to the family's name.

        Raises:
            GraphError: when a variable is fixed twice or the value is not on its manifold.
        """
        selection = as_selection(variable)
        unique = self._unique(name, f"{selection.family.name} fixed")
        held: Array | Data = value if isinstance(value, Data) else np.atleast_1d(np.asarray(value, dtype=np.float64))
        check_fix(unique, selection, held.value if isinstance(held, Data) else held)
        for other in self.fixes:
            if other.selection.family is selection.family and _overlap(other.selection, selection):
                twice = np.intersect1d(other.selection.indices, selection.indices)
                if len(twice):
                    raise GraphError(
                        f"{selection.family.name}[{twice[0]}] is fixed by '{other.name}' already",
                        family=selection.family.name,
                        index=int(twice[0]),
                    )
        self._own(selection, unique)
        self._names.add(unique)
        self.fixes.append(Fix(unique, selection, held))
        self.compiled = None
        return unique

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the statement of the problem, not its compiled form."""
        return {**self.__dict__, "compiled": None}

    def __repr__(self) -> str:
        """Counts of families and terms."""
        return f"<Graph: {len(self.families)} families, {len(self.terms)} terms, {len(self.fixes)} fixes>"

    def _add(self, term: Term) -> str:
        self._names.add(term.name)
        self.terms.append(term)
        self.compiled = None
        return term.name

    def _arguments(self, name: str, arguments: tuple[Any, ...], active: Any) -> tuple[tuple[Any, ...], Any, int]:
        normal, active, count = prepare_arguments(name, arguments, active)
        for argument in normal:
            if isinstance(argument, Selection):
                self._own(argument, name)
        return normal, active, count

    def _own(self, selection: Selection, term: str) -> None:
        if self.families.get(selection.family.name) is not selection.family:
            raise GraphError(
                f"term '{term}': family '{selection.family.name}' belongs to another graph",
                term=term,
                family=selection.family.name,
            )

    def _unique(self, name: str | None, default: str) -> str:
        if name is not None:
            if name in self._names:
                raise GraphError(f"the name '{name}' is taken: names identify terms in duals and tables", term=name)
            return name
        candidate, number = default, 2
        while candidate in self._names:
            candidate, number = f"{default} {number}", number + 1
        return candidate


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
    return first.component is None or second.component is None or first.component == second.component


def check_limits(name: str, lower: Parameter, upper: Parameter) -> None:
    """Raise when limits are NaN, do not fit each other, or cross."""
    low, high = (np.asarray(p.value if isinstance(p, Data) else p, dtype=np.float64) for p in (lower, upper))
    if np.isnan(low).any() or np.isnan(high).any():
        raise GraphError(f"term '{name}': a limit is NaN", term=name)
    try:
        crossed = np.argwhere(np.atleast_1d(low > high))
    except ValueError as error:
        raise GraphError(f"term '{name}': lower {low.shape} and upper {high.shape} do not fit", term=name) from error
    if len(crossed):
        place = tuple(int(i) for i in crossed[0])
        raise GraphError(
            f"term '{name}': lower exceeds upper at {place}: "
            f"{np.broadcast_to(low, np.broadcast_shapes(low.shape, high.shape, (1,)))[place]:g} > "
            f"{np.broadcast_to(high, np.broadcast_shapes(low.shape, high.shape, (1,)))[place]:g}",
            term=name,
            index=place[0],
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
