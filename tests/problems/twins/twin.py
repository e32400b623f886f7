"""A problem stated twice: as a graph for our backends, and symbol by symbol in casadi.

Every term takes two functions. The first is what a user of unifg writes: batched NumPy, a Numba function of one factor,
or a shipped kernel. The second maps casadi columns to a casadi column, one factor at a time. Nothing is shared between
the two beyond the numbers of the problem, so a wrong derivative, sign or index of ours cannot hide in the judge.

The casadi side is stated in tangent coordinates d about values z, x = z [+] d, so that one statement serves as a judge
(derivatives at d = 0 with z the answer) and as a program for IPOPT (from d = 0 with z the guess) on every manifold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

import unifg as fg
from unifg.modeling.model import AnyResidual
from unifg.modeling.variables import Variable, as_selection, is_variable
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

Exact = Callable[..., Any]
"""Columns of one factor (variables, then constants) to a column of casadi expressions."""


@dataclass(frozen=True)
class Rows:
    """The constraint rows of one term, factor by factor.

    Attributes:
        name: of the term.
        expression: (n m) casadi column.
        lower, upper: (n m).
        stages: (n m) index of the first variable of the row's factor.
        moves: whether the rows are x_next - f(x, u), the form in which fatrop knows the stages.
        coordinates: (n m) tangent coordinates when the term bounds unknowns, else None.
    """

    name: str
    expression: Any
    lower: Array
    upper: Array
    stages: IntArray
    moves: bool = False
    coordinates: IntArray | None = None


class Twin:
    """The two statements, grown term by term.

    Args:
        kind: of problem, for the tables.
        seed: its numbers were drawn from.
        equalities_only: leave bounds and inequalities out of both statements.

    Attributes:
        graph: ours.
        guess: (n, storage) by family; what is fixed has its value there.
        point, step: casadi symbols z and d, by family, one column per member.
        rows: constraints.
        residuals: casadi expressions of the whitened residuals; the cost is half the sum of their squares.
    """

    def __init__(self, kind: str, seed: int, equalities_only: bool = False) -> None:
        """Start empty."""
        self.kind, self.seed, self.equalities_only = kind, seed, equalities_only
        self.graph = fg.Graph()
        self.guess: dict[fg.Family, Array] = {}
        self.point: dict[fg.Family, Any] = {}
        self.step: dict[fg.Family, Any] = {}
        self.rows: list[Rows] = []
        self.residuals: list[Any] = []
        self._moved: dict[fg.Family, list[Any]] = {}
        self._first: dict[fg.Family, int] = {}
        self._held: list[IntArray] = []
        self._size = 0

    @property
    def cost(self) -> Any:
        """Expression of the cost, a casadi scalar."""
        return 0.5 * ca.sumsqr(ca.vertcat(ca.SX(0, 1), *self.residuals))

    @property
    def along(self) -> IntArray:
        """(n,) number of what a tangent coordinate belongs to: one coordinate of one family."""
        dims = [family.manifold.dim for family in self.point]
        first = np.cumsum([0, *dims])
        spans = zip(first, dims, self.point, strict=False)
        return np.concatenate([np.tile(begin + np.arange(dim), family.count) for begin, dim, family in spans])

    @property
    def name(self) -> str:
        """Kind and seed."""
        return f"{self.kind} {self.seed}"

    @property
    def held(self) -> BoolArray:
        """(n,) whether a tangent coordinate is fixed."""
        held = np.zeros(self._size, dtype=bool)
        held[np.concatenate([np.zeros(0, dtype=int), *self._held])] = True
        return held

    def variables(self, name: str, manifold: fg.Manifold, guess: ArrayLike) -> fg.Family:
        """A family with as many members as the guess has rows."""
        values = np.array(guess, dtype=np.float64)
        family = self.graph.variables(name, manifold, len(values))
        self.guess[family] = values
        self.point[family] = ca.SX.sym(name, manifold.storage, family.count)
        self.step[family] = ca.SX.sym(f"d{name}", manifold.dim, family.count)
        self._moved[family] = [
            _retract(manifold, self.point[family][:, k], self.step[family][:, k]) for k in range(family.count)
        ]
        self._first[family] = self._size
        self._size += manifold.dim * family.count
        return family

    def fix(self, variable: Variable, value: ArrayLike) -> None:
        """Give whole members a value, in the guess too."""
        selection = as_selection(variable)
        self.graph.fix(variable, value)
        self.guess[selection.family][selection.indices] = value
        self._held.append(self._coordinates(variable).ravel())

    def minimize(
        self, ours: AnyResidual, exact: Exact, *arguments: Any, sigma: ArrayLike = 1.0, name: str | None = None
    ) -> None:
        """Add 1/2 |r / sigma|^2 for each factor."""
        self.graph.minimize(ours, *arguments, sigma=np.asarray(sigma, dtype=np.float64), name=name)
        for column in self._columns(exact, arguments):
            self.residuals.append(column / ca.DM(np.broadcast_to(sigma, column.shape[0])))

    def require(
        self,
        ours: AnyResidual,
        exact: Exact,
        *arguments: Any,
        lower: float = -np.inf,
        upper: float = np.inf,
        name: str,
        moves: bool = False,
    ) -> None:
        """Require lower <= g <= upper for each factor."""
        if self.equalities_only and lower != upper:
            return
        self.graph.constrain(ours, *arguments, lower=lower, upper=upper, name=name)
        columns = self._columns(exact, arguments)
        first = next(as_selection(a) for a in arguments if is_variable(a) and len(as_selection(a)) == len(columns))
        size = columns[0].shape[0]
        limits = np.full((2, size * len(columns)), [[lower], [upper]])
        stages = np.repeat(first.indices, size)
        self.rows.append(Rows(name, ca.vertcat(*columns), limits[0], limits[1], stages, moves))

    def equal(self, ours: AnyResidual, exact: Exact, *arguments: Any, name: str, moves: bool = False) -> None:
        """Require g = 0 for each factor."""
        self.require(ours, exact, *arguments, lower=0.0, upper=0.0, name=name, moves=moves)

    def bound(self, variable: Variable, *, lower: ArrayLike = -np.inf, upper: ArrayLike = np.inf, name: str) -> None:
        """Limit Rn variables entry by entry."""
        if self.equalities_only:
            return
        selection = as_selection(variable)
        self.graph.bound(variable, lower=np.asarray(lower, float), upper=np.asarray(upper, float), name=name)
        shape = (len(selection), selection.manifold.dim)
        columns = [self._argument(variable, k) for k in range(len(selection))]
        low, high = (np.broadcast_to(np.asarray(limit, float), shape).ravel() for limit in (lower, upper))
        stages, coordinates = np.repeat(selection.indices, shape[1]), self._coordinates(variable).ravel()
        self.rows.append(Rows(name, ca.vertcat(*columns), low, high, stages, False, coordinates))

    def stacked(self, values: dict[fg.Family, Array]) -> Array:
        """Values of all families in the order of the casadi symbols."""
        return np.concatenate([values[family].ravel() for family in self.point])

    def _coordinates(self, variable: Variable) -> IntArray:
        """(n, d) tangent coordinates of a selection."""
        selection = as_selection(variable)
        dim = selection.family.manifold.dim
        columns = np.arange(dim)[selection.tangent]
        return self._first[selection.family] + dim * selection.indices[:, None] + columns

    def _columns(self, exact: Exact, arguments: tuple[Any, ...]) -> list[Any]:
        """The expressions of every factor."""
        count = max(len(as_selection(a)) for a in arguments if is_variable(a))
        return [ca.SX(exact(*(self._argument(a, k) for a in arguments))) for k in range(count)]

    def _argument(self, argument: Any, factor: int) -> Any:
        """Argument of one factor: a column of a variable, its row of a two-axis constant, any other constant whole."""
        if is_variable(argument):
            selection = as_selection(argument)
            index = int(selection.indices[factor if len(selection) > 1 else 0])
            return self._moved[selection.family][index][selection.storage]
        if isinstance(argument, np.ndarray) and argument.ndim == 2:
            return argument[factor if len(argument) > 1 else 0]
        return argument


def rotation_times(q: Any, v: Any) -> Any:
    """A vector turned by a unit quaternion (w, x, y, z)."""
    inner = 2 * ca.cross(q[1:], v)
    return v + q[0] * inner + ca.cross(q[1:], inner)


def quaternion_times(a: Any, b: Any) -> Any:
    """Hamilton's product, scalar first."""
    return ca.vertcat(a[0] * b[0] - ca.dot(a[1:], b[1:]), a[0] * b[1:] + b[0] * a[1:] + ca.cross(a[1:], b[1:]))


def quaternion_exp(turn: Any) -> Any:
    """The unit quaternion of a rotation vector; series in the squared half angle, exact to rounding up to pi."""
    s = ca.sumsqr(turn) / 4
    cosine, sinc = ca.SX(1.0), ca.SX(1.0)
    for k in range(14, 0, -1):
        cosine = 1 - s / ((2 * k - 1) * (2 * k)) * cosine
        sinc = 1 - s / ((2 * k) * (2 * k + 1)) * sinc
    return ca.vertcat(cosine, 0.5 * sinc * turn)


def _retract(manifold: fg.Manifold, z: Any, d: Any) -> Any:
    """A retraction that agrees with ``z Exp(d)`` to first order, which is all that a gradient at d = 0 sees."""
    if isinstance(manifold, fg.Rn):
        return z + d
    if manifold is fg.SE2:
        c, s = ca.cos(z[2]), ca.sin(z[2])
        return ca.vertcat(z[0] + c * d[0] - s * d[1], z[1] + s * d[0] + c * d[1], z[2] + d[2])
    if manifold is fg.SO3:
        return quaternion_times(z, quaternion_exp(d))
    if manifold is fg.SE3:
        return ca.vertcat(z[:3] + rotation_times(z[3:], d[:3]), quaternion_times(z[3:], quaternion_exp(d[3:])))
    if isinstance(manifold, fg.Product):
        return ca.vertcat(
            *(_retract(part.manifold, z[part.storage], d[part.tangent]) for part in manifold.components.values())
        )
    raise ValueError(f"no casadi retraction for {manifold.name}: add one")


def driven(
    kind: str, seed: int, equalities_only: bool, line: Array, controls: Array
) -> tuple[Twin, fg.Family, fg.Family]:
    """A problem with states guessed along a line, the first one given, and controls between them."""
    twin = Twin(kind, seed, equalities_only)
    x = twin.variables("x", fg.Rn(line.shape[1]), line)
    u = twin.variables("u", fg.Rn(controls.shape[1]), controls)
    twin.fix(x[0], line[0])
    return twin, x, u
