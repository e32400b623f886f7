"""One problem in other units: of its cost, of its constraint rows, of its Euclidean unknowns; or elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.modeling.variables import Family, Selection
from unifg.typing import Array


@dataclass(frozen=True)
class Units:
    """Numbers by which parts of a problem are multiplied.

    Attributes:
        cost: of all costs.
        rows: of constraint rows and their limits, bounds of unknowns apart.
        unknowns: of all unknowns, which are Euclidean.
        offset: what is added to all unknowns, in the new units.
        backwards: whether the terms are stated in the reverse order.
    """

    cost: float = 1.0
    rows: float = 1.0
    unknowns: float = 1.0
    offset: float = 0.0
    backwards: bool = False

    def moved(self, values: Any) -> Array:
        """Values of unknowns in the new units."""
        return self.unknowns * np.asarray(values, dtype=float) + self.offset


def scaled(graph: fg.Graph, guess: Mapping[Family, Any], units: Units) -> tuple[fg.Graph, dict[Family, Array]]:
    """The same problem with its numbers multiplied, and the guess that corresponds.

    Args:
        graph: of Euclidean unknowns, with constants in the place of data and without robust losses.
        guess: for it.
        units: what is multiplied.
    """
    result = fg.Graph()
    families = {
        family: result.variables(name, family.manifold, family.count) for name, family in graph.families.items()
    }
    for fix in graph.fixes:
        at = families[fix.selection.family][fix.selection.indices]
        result.fix(at, units.moved(fix.value), name=fix.name)
    for term in reversed(graph.terms) if units.backwards else graph.terms:
        arguments = [_moved(argument, families) for argument in term.arguments]
        flags = [isinstance(argument, Selection | Family) for argument in term.arguments]
        if isinstance(term, Constraint) and term.is_bound:
            limits = {"lower": units.moved(term.lower), "upper": units.moved(term.upper)}
            result.bound(arguments[0], name=term.name, **limits)
        elif isinstance(term, Constraint):
            function = _wrapped(term.residual.function, flags, units.rows, units)
            lower, upper = (units.rows * np.asarray(limit) for limit in (term.lower, term.upper))
            result.constrain(function, *arguments, lower=lower, upper=upper, name=term.name)
        elif isinstance(term, ScalarCost):
            function = _wrapped(term.residual.function, flags, units.cost, units)
            result.minimize_scalar(function, *arguments, name=term.name)
        else:
            assert isinstance(term, Cost)
            assert term.information is None and term.robust is None
            sigma = np.asarray(1.0 if term.sigma is None else term.sigma) / np.sqrt(units.cost)
            function = _wrapped(term.residual.function, flags, 1.0, units)
            result.minimize(function, *arguments, sigma=sigma, name=term.name)
    return result, {
        families[family]: np.broadcast_to(units.moved(values), (family.count, family.manifold.storage))
        for family, values in guess.items()
    }


def _moved(argument: Any, families: dict[Family, Family]) -> Any:
    if isinstance(argument, Family):
        return families[argument]
    if isinstance(argument, Selection):
        return families[argument.family][argument.indices]
    return argument


def _wrapped(function: Callable[..., Any], flags: list[bool], size: float, units: Units) -> Callable[..., Any]:
    """A function of other units than the one it calls."""

    def wrapped(*arguments: Any) -> Any:
        back = [(a - units.offset) / units.unknowns if flag else a for a, flag in zip(arguments, flags, strict=True)]
        return size * function(*back)

    return wrapped
