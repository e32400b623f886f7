"""Ta's primal and dual linear graphs (Ta et al. 2014, section IV and Fig. 2), to look at and to solve.

The primal linear graph is eq. 18 written as factors over tangent steps: every cost as linear rows, every equality as
linear rows that must hold, and with the exact Hessian one more factor for each constraint with a multiplier, its
curvature. The dual linear graph is eq. 19: one variable for the multipliers of each constraint, and for each primal
variable that a constraint touches one factor, which says that the gradients there add up to nothing:

    sum_j A_j' lambda_j = - gradient of the unconstrained factors at the step

Eq. 19 as printed lacks the minus, which the Lagrangian and eq. 18 require. Both are solved by variable elimination
(:mod:`unifg.solvers.constrained_elimination`). For equalities only. Plain NumPy, one factor at a time: a reference for
the engine, not a replacement.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric
from unifg.errors import GraphError
from unifg.solvers.constrained_elimination import Elimination, eliminate
from unifg.solvers.linear_factors import Factor, Kind, LinearFactor
from unifg.solvers.linear_graph_drawing import draw
from unifg.typing import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class LinearGraph:
    """Linear and quadratic factors over named vectors.

    Attributes:
        title: what it is.
        sizes: dimension of each variable, by name.
        factors: in the order they were made.
    """

    title: str
    sizes: Mapping[str, int]
    factors: Sequence[Factor] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            GraphError: when a factor names a variable that does not exist.
        """
        for factor in self.factors:
            unknown = [name for name in factor.variables if name not in self.sizes]
            if unknown:
                raise GraphError(f"{self.title}: factor '{factor.name}' has no variable '{unknown[0]}' to stand on")

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables."""
        return tuple(self.sizes)

    @property
    def constraints(self) -> tuple[LinearFactor, ...]:
        """Factors whose rows must hold."""
        return tuple(f for f in self.factors if isinstance(f, LinearFactor) and f.kind == "constraint")

    @property
    def unconstrained(self) -> tuple[Factor, ...]:
        """All others."""
        return tuple(f for f in self.factors if f.kind != "constraint")

    def factor(self, name: str, kind: Kind | None = None) -> Factor:
        """The first factor of that name (and kind).

        Raises:
            GraphError: when there is none.
        """
        for factor in self.factors:
            if factor.name == name and kind in (None, factor.kind):
                return factor
        raise GraphError(f"{self.title}: no factor is called '{name}'" + ("" if kind is None else f" ({kind})"))

    def factors_of(self, variable: str) -> tuple[Factor, ...]:
        """Factors that stand on a variable."""
        return tuple(factor for factor in self.factors if variable in factor.variables)

    def engine_order(self) -> tuple[str, ...]:
        """The order in which the engine would eliminate the variables."""
        number = {name: k for k, name in enumerate(self.sizes)}
        if not number:
            return ()
        pairs = [
            sorted((number[a], number[b])) for factor in self.factors for a, b in combinations(factor.variables, 2)
        ]
        first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
        sizes = np.array(list(self.sizes.values()))
        starts = np.concatenate([[0], np.cumsum(sizes)])
        factorization = Factorization(
            Symmetric.of_blocks(starts, first, second), np.repeat(np.arange(len(sizes)), sizes)
        )
        names = self.variables
        return tuple(names[int(node)] for node in factorization.tree.order)

    def eliminate(
        self, order: Iterable[str] | None = None, *, undetermined: Literal["refuse", "zero"] = "refuse"
    ) -> Elimination:
        """Eliminate the variables, by default in the engine's order.

        Arguments and errors as for :func:`unifg.solvers.constrained_elimination.eliminate`.
        """
        names = tuple(order) if order is not None else self.engine_order()
        if sorted(names) != sorted(self.variables):
            raise GraphError(f"{self.title}: the order must name each of its {len(self.sizes)} variables once")
        return eliminate(self.sizes, self.factors, names, undetermined=undetermined)

    def draw(self, ax: Axes) -> None:
        """Draw on a matplotlib axes: circles are variables, crosses constraints, squares all other factors."""
        draw(self.variables, self.factors, ax)
        ax.set_title(self.title)

    def __str__(self) -> str:
        """Variables with their dimensions, then the factors, a line each."""
        head = f"{self.title}: {len(self.sizes)} variables, {len(self.factors)} factors"
        variables = "  variables: " + ", ".join(f"{name} ({size})" for name, size in self.sizes.items())
        return "\n".join([head, variables, *(f"  {factor}" for factor in self.factors)])


def dual_graph(primal: LinearGraph, step: Mapping[str, Array]) -> LinearGraph:
    """The graph of the multipliers, given the step that solves the primal graph (Ta eq. 19 with its minus).

    Args:
        primal: a graph with constraints.
        step: (d_v,) per variable.
    """
    sizes = {factor.name: factor.rows for factor in primal.constraints}
    blocks: dict[str, dict[str, Array]] = {}
    for factor in primal.constraints:
        for variable, block in factor.blocks.items():
            blocks.setdefault(variable, {})[factor.name] = block.T
    right = {variable: np.zeros(primal.sizes[variable]) for variable in blocks}
    for other in primal.unconstrained:
        for variable, gradient in other.gradient_at(step).items():
            if variable in right:
                right[variable] -= gradient
    factors = [
        LinearFactor(variable, "balance", own, right[variable], max(float(np.abs(b).max()) for b in own.values()))
        for variable, own in blocks.items()
    ]
    return LinearGraph("dual linear graph", sizes, tuple(factors))
