"""What happened during a solve: one row per iteration."""

from __future__ import annotations

from dataclasses import dataclass, field

from unifg.answers.factor_norms import Deferred, FactorNorms
from unifg.errors import UnifgError
from unifg.language.variables import Family
from unifg.typing import Array


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
        """(n,) residual norms of the factors of every term, by its name; see :mod:`unifg.answers.factor_norms`.

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


HEADER = (
    f"{'iter':>4} {'cost':>13} {'station.':>9} {'violation':>9} {'complem.':>9} {'|step|':>9} {'length':>7}  details"
)


def line(row: Iteration) -> str:
    """One line of the table that ``verbose=True`` logs."""
    details = "  ".join(f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.details.items())
    return (
        f"{row.number:4d} {row.cost:13.6e} {row.stationarity:9.2e} {row.violation:9.2e} {row.complementarity:9.2e} "
        f"{row.step_norm:9.2e} {row.step_length:7.3g}  {details}"
    )
