"""History of a solve: one row per iteration, and on demand the norm of each factor.

A factor of a cost has the norm of its whitened residual, before any robust loss; a factor of a constraint or a bound
the norm of what lies outside its limits, in the constraint's own units; a factor of a scalar cost the magnitude of its
value. The square root of the sum of squares over a term (for scalar costs the sum) is what ``Iteration.terms`` shows.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from html import escape

import numpy as np

from unifg.errors import GraphError, UnifgError
from unifg.modeling.variables import Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.typing import Array, Figure


class FactorNorms(dict[str, Array]):
    """Norms (n,) of the factors of every term, by its name, in the order of the graph; zero for inactive factors."""

    def __missing__(self, term: str) -> Array:
        """Refuse a name.

        Raises:
            GraphError: no term has it.
        """
        raise GraphError(f"no term is called '{term}' (there are: {', '.join(self) or 'none'})", term=term)

    def __repr__(self) -> str:
        """Terms with their numbers of factors."""
        return f"<FactorNorms {', '.join(f'{name}: {len(part)}' for name, part in self.items())}>"


def factor_norms(program: CompiledProblem, lin: Linearization, outside: Array) -> FactorNorms:
    """The norms at a linearisation, in new arrays.

    Args:
        program: the compiled graph.
        lin: where.
        outside: (M,) violation there, see :meth:`unifg.problem.compiled_problem.CompiledProblem.violation`.
    """
    robust = {term.name: np.sqrt(lin.squares[part]) for term, part in program.table.robust}
    parts: dict[str, Array] = {}
    for term in program.terms:
        name = term.name
        if name in robust:
            parts[name] = robust[name]
        elif name in lin.scalars:
            parts[name] = np.abs(lin.scalars[name])
        else:
            rows = program.rows_of(term, lin.residual, outside)
            parts[name] = np.sqrt(np.einsum("nm,nm->n", rows, rows))
    return FactorNorms(parts)


class Deferred:
    """Norms of one iterate, worked out when they are first asked for, as long as the iterate is at hand."""

    def __init__(self, measure: Callable[[], FactorNorms]) -> None:
        """Nothing is computed yet."""
        self._measure: Callable[[], FactorNorms] | None = measure
        self._found: FactorNorms | None = None

    def __call__(self) -> FactorNorms | None:
        """The norms, None when nobody asked in time."""
        if self._found is None and self._measure is not None:
            self._found = self._measure()
        return self._found

    def close(self) -> None:
        """Let go of the iterate; what has been asked for stays."""
        self._measure = None


@dataclass(frozen=True)
class Iteration:
    """State after one iteration; row 0 is the start.

    Attributes:
        number: 0 at the start.
        cost: objective.
        stationarity, violation, complementarity: KKT numbers with the multipliers of this iteration; far from the end,
            the relative offset of least squares is a lower bound.
        step_norm: Euclidean norm of the tangent step taken.
        step_length: fraction of the computed step that was taken.
        seconds: since the solve began.
        terms: residual norm of every term (for constraints, of the violation).
        details: what the backend adds: damping, penalty, QP route and iterations, ...
        values: copies of the values of every family, None unless the solver has ``keep_values``.
        deferred: where :attr:`residuals` come from.
    """

    number: int
    cost: float
    stationarity: float
    violation: float
    complementarity: float
    step_norm: float
    step_length: float
    seconds: float
    terms: dict[str, float]
    details: dict[str, float | int | str] = field(default_factory=dict)
    values: dict[Family, Array] | None = field(default=None, repr=False, compare=False)
    deferred: Deferred | None = field(default=None, repr=False, compare=False)

    @property
    def residuals(self) -> FactorNorms:
        """(n,) residual norms of the factors of every term, by its name.

        They are at hand while a callback looks at the row, and stay if it asked for them. All rows keep theirs with
        ``keep_residuals=True``; those of the last iterate are always in :attr:`unifg.Solution.residuals`.

        Raises:
            UnifgError: when they were not kept.
        """
        found = self.deferred() if self.deferred is not None else None
        if found is None:
            raise UnifgError(
                f"the residuals of the factors in iteration {self.number} were not kept: solve with "
                "keep_residuals=True, or ask for them in the callback",
                index=self.number,
            )
        return found


class History(list[Iteration]):
    """Rows of a solve, the first being the start."""

    def plot(self) -> Figure:
        """Cost, KKT numbers and steps over the iterations; what must become small on a logarithmic axis.

        Raises:
            ViewError: there are no rows.
        """
        from unifg.plots.descent import draw_descent  # only who draws loads it

        kkt = {name: self.column(name) for name in ("stationarity", "violation", "complementarity")}
        return draw_descent(self.column("cost"), kkt | {"step": self.column("step_norm")})

    def __str__(self) -> str:
        """Table with a line for every row."""
        return "\n".join([HEADER, *map(line, self)])

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return f"<pre>{escape(str(self))}</pre>"

    def column(self, name: str) -> Array:
        """(k,) numbers of one attribute of all rows."""
        return np.array([getattr(row, name) for row in self], dtype=np.float64)


def subproblems(rows: Iterable[Iteration]) -> dict[str, int]:
    """Number of quadratic programs by the solver whose answer was taken; empty for backends without any."""
    return dict(Counter(str(row.details["qp"]) for row in rows if "qp" in row.details))


logger = logging.getLogger("unifg")
HEADER = (
    f"{'iter':>4} {'cost':>13} {'station.':>9} {'violation':>9} {'complem.':>9} {'|step|':>9} {'length':>7}  details"
)


def show(text: str) -> None:
    """Log a line, or write it to standard error where logging would drop it."""
    if logger.hasHandlers() and logger.isEnabledFor(logging.INFO):
        logger.info(text)
    else:
        logging.StreamHandler().emit(logger.makeRecord(logger.name, logging.INFO, "", 0, text, (), None))


def line(row: Iteration) -> str:
    """One line of the table that ``verbose=True`` logs."""
    details = "  ".join(f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.details.items())
    return (
        f"{row.number:4d} {row.cost:13.6e} {row.stationarity:9.2e} {row.violation:9.2e} {row.complementarity:9.2e} "
        f"{row.step_norm:9.2e} {row.step_length:7.3g}  {details}"
    )
