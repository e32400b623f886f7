"""Terms of a graph as the user stated them: costs, constraints, and fixed variables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.factors.residuals import Residual
from unifg.factors.robust import Loss
from unifg.modeling.duplicates import doubles
from unifg.modeling.soft import Slack, SlackFamily, Soft
from unifg.modeling.variables import Data, Declared, Family, Selection
from unifg.typing import Array, ArrayLike, BoolArray

Parameter: TypeAlias = ArrayLike | Data


@dataclass(eq=False, repr=False)
class Term:
    """A batch of factors that share one residual function.

    Attributes:
        name: unique name, used in tables, messages and ``dual``.
        residual: the batched function.
        arguments: selections, data and constants in the order the function takes them.
        active: (n,) boolean, constant or data; None means all.
        count: number of factors n.
        size: rows m of each of them.
        rows: for each argument, whether it is declared to have a row for each factor; None where nothing is declared.
        given: the arguments as they were given, with what ``fg.each``, ``fg.shared`` and data declare.
    """

    name: str
    residual: Residual
    arguments: tuple[Any, ...]
    active: BoolArray | Data | None
    count: int
    size: int
    rows: tuple[bool | None, ...] = field(kw_only=True)
    given: tuple[Any, ...] = field(default=(), kw_only=True)

    @property
    def kind(self) -> str:
        """Kind of term, in a word."""
        return "cost"

    @property
    def selections(self) -> list[Selection]:
        """The variable arguments, in order."""
        return [argument for argument in self.arguments if isinstance(argument, Selection)]

    @property
    def families(self) -> list[Family]:
        """Of its variables, each once, in order."""
        return list(dict.fromkeys(selection.family for selection in self.selections))

    @property
    def shaping(self) -> list[Data]:
        """Data that are no arguments of its function: weights, limits, and which factors are active."""
        given = [getattr(self, name, None) for name in ("active", "sigma", "information", "lower", "upper")]
        slack: Slack | None = getattr(self, "slack", None)
        given += slack.soft.data if slack is not None else []
        return list(dict.fromkeys(value for value in given if isinstance(value, Data)))

    @property
    def data(self) -> list[Data]:
        """All data that it reads, each once."""
        return list(dict.fromkeys([*(a for a in self.arguments if isinstance(a, Data)), *self.shaping]))

    def __repr__(self) -> str:
        """Kind, name and size."""
        rows = f"{self.size} row{'s' if self.size != 1 else ''}"
        of = ", ".join(family.name for family in self.families)
        return f"<{self.kind} '{self.name}': {self.count} x {rows}, of {of}>"


@dataclass(eq=False, repr=False)
class Cost(Term):
    """1/2 rho(|W r|^2) with W'W the information matrix.

    Attributes:
        sigma: standard deviations: scalar, (m,) or (n, m).
        information: (m, m) or (n, m, m); excludes ``sigma``.
        robust: loss applied to the squared whitened norm.
    """

    sigma: Parameter | None = None
    information: Parameter | None = None
    robust: Loss | None = None


@dataclass(eq=False, repr=False)
class ScalarCost(Term):
    """A cost that is not a square: (n,) values added to the objective as they are."""

    @property
    def kind(self) -> str:
        """Kind of term, in a word."""
        return "scalar cost"


@dataclass(eq=False, repr=False)
class Constraint(Term):
    """lower <= g(x) <= upper.

    Attributes:
        lower: scalar, (m,) or (n, m); may be -inf.
        upper: same; equal to ``lower`` for an equality.
        is_bound: whether g is the variable itself, whose Jacobian is the identity.
        slack: of a soft constraint.
    """

    lower: Parameter = -np.inf
    upper: Parameter = np.inf
    is_bound: bool = False
    slack: Slack | None = None

    @property
    def soft(self) -> Soft | None:
        """Price of violation; None for a hard constraint."""
        return None if self.slack is None else self.slack.soft

    @property
    def limits_slacks(self) -> bool:
        """Test whether it keeps the slacks of a soft constraint from being negative."""
        return self.is_bound and isinstance(self.selections[0].family, SlackFamily)

    @property
    def kind(self) -> str:
        """Kind of term, in a word: an equality where no data can set the limits apart."""
        if self.is_bound:
            return "bound"
        if isinstance(self.lower, Data) or isinstance(self.upper, Data):
            return "equality" if self.lower is self.upper else "inequality"
        return "equality" if np.all(np.equal(self.lower, self.upper)) else "inequality"


@dataclass(eq=False, repr=False)
class Fix:
    """Variables that take a given value and leave the unknowns.

    Attributes:
        name: its reaction is ``solution.dual(name)``.
        selection: what is fixed.
        value: (storage,) or (n, storage).
    """

    name: str
    selection: Selection
    value: Array | Data

    @property
    def kind(self) -> str:
        """Kind of term, in a word."""
        return "fix"

    @property
    def data(self) -> list[Data]:
        """Data that it reads."""
        return [self.value] if isinstance(self.value, Data) else []

    def __repr__(self) -> str:
        """Fixed members."""
        return f"<fix '{self.name}': {self.selection!r}>"


def prepare_arguments(
    name: str, arguments: tuple[Any, ...], active: Any
) -> tuple[tuple[Any, ...], tuple[bool | None, ...], Any, int]:
    """Normalise a term's arguments and find its number of factors.

    Selections of length 1 are shared; all longer ones, data and constants declared to have a row for each factor, and
    ``active`` must agree.

    Returns:
        Arguments, whether each of them is declared to have a row for each factor, active, number of factors.

    Raises:
        GraphError: when there is no variable among the arguments, or the lengths disagree.
    """
    rows = tuple(a.each if isinstance(a, Data | Declared) else None for a in arguments)
    normal = tuple(a[:] if isinstance(a, Family) else a.value if isinstance(a, Declared) else a for a in arguments)
    lengths: list[tuple[str, int]] = []
    for place, argument in enumerate(normal):
        if isinstance(argument, Selection):
            if argument.count == 0:
                raise GraphError(
                    f"term '{name}': the selection from family '{argument.family.name}' is empty",
                    term=name,
                    family=argument.family.name,
                )
            if argument.count > 1:
                lengths.append((f"family '{argument.family.name}'", argument.count))
        elif rows[place]:
            what = f"data '{argument.name}'" if isinstance(argument, Data) else f"argument {place}, by fg.each,"
            lengths.append((what, len(argument.value if isinstance(argument, Data) else argument)))
        elif isinstance(argument, np.ma.MaskedArray):
            doubles(f"term '{name}': an argument", argument, term=name)
    if not any(isinstance(argument, Selection) for argument in normal):
        raise GraphError(f"term '{name}' has no variable among its arguments: pass a family or a selection", term=name)
    if active is not None:
        active = active.value if isinstance(active, Declared) else active
        if not isinstance(active, Data):
            active = np.array(doubles(f"term '{name}': active=", active, term=name, flags=True))
        value = active.value if isinstance(active, Data) else active
        if value.dtype != bool:
            raise GraphError(
                f"term '{name}': active= must be (n,) booleans, found numbers: compare them, as in values != 0",
                term=name,
            )
        if value.ndim != 1:
            raise GraphError(f"term '{name}': active= must be (n,) booleans, found shape {value.shape}", term=name)
        lengths.append(("active=", len(value)))
    if len({length for _, length in lengths}) > 1:
        found = ", ".join(f"{what} has {length}" for what, length in lengths)
        raise GraphError(
            f"term '{name}': the number of factors is unclear: {found}. Only selections of length 1 are shared",
            term=name,
        )
    return normal, rows, active, lengths[0][1] if lengths else 1
