"""Soft constraints: limits that give way at a price, by slack variables.

A soft constraint reads ``lower <= g(x) + s_lower - s_upper <= upper`` with slacks that are not negative, and the
objective grows by ``w s + 1/2 q s^2`` for each of them. With w above the multiplier that the hard constraint has, the
solution is that of the hard constraint (exact penalty: Nocedal and Wright 2006, section 17.2; Fletcher 1987, section
12.3); where no solution keeps the limits, they give way where that is cheapest. The multiplier is at most w + q s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.factors.residuals import Residual
from unifg.lie import Rn
from unifg.modeling.duplicates import doubles
from unifg.modeling.variables import Data, Family, ParameterLike, undeclared
from unifg.typing import Array, BoolArray

UPPER, LOWER = 1, 2  # sides that give way
SLACK = ": slack"  # after the name of a constraint: that of its slack variables, and of their limit


@dataclass(frozen=True, eq=False)
class Soft:
    """Price of the violation s of a soft constraint: ``linear s + 1/2 quadratic s^2`` for every row.

    Weights are numbers, (m,) for the rows, (n, m) for every factor, or data. A linear price is exact: above the
    multiplier of the hard constraint nothing gives way. A quadratic one alone always gives way a little.

    Attributes:
        linear: in units of cost per unit of the row.
        quadratic: in units of cost per square of that unit.
    """

    linear: ParameterLike = 0.0
    quadratic: ParameterLike = 0.0

    @property
    def data(self) -> list[Data]:
        """Data among the weights."""
        return [weight for weight in (self.linear, self.quadratic) if isinstance(weight, Data)]


class SlackFamily(Family):
    """Slack variables, which no guess needs: a solve begins with what the limits are violated by."""


@dataclass(frozen=True, eq=False)
class Slack:
    """Slack variables of a soft constraint.

    Attributes:
        family: (n, m) numbers for the side that gives way; (n, 2 m) for both, those of the upper limits first.
        sides: `UPPER`, `LOWER` or both.
        soft: their price.
    """

    family: SlackFamily
    sides: int
    soft: Soft

    def signed(self, values: Array) -> Array:
        """(n, m) violation: positive above an upper limit, negative below a lower one."""
        return signed(values, self.sides)

    def stored(self, above: Array, below: Array) -> Array:
        """Values of the family, of (n, m) violations of the upper and the lower limits."""
        if self.sides != UPPER | LOWER:
            return above if self.sides == UPPER else below
        return np.concatenate([above, below], axis=1)


def signed(values: Array, sides: int) -> Array:
    """(n, m) violation that slacks stand for: positive above an upper limit, negative below a lower one."""
    if sides != UPPER | LOWER:
        return values if sides == UPPER else -values
    size = values.shape[1] // 2
    return values[:, :size] - values[:, size:]


def slack_of(
    name: str, soft: Soft | ParameterLike, lower: Any, upper: Any, count: int, size: int, wrapped: Residual
) -> Slack:
    """Slack variables for the limits of a constraint.

    Raises:
        GraphError: naming the term, when a weight has another shape, is negative or not finite, no row has a price, or
            the function is compiled for one factor.
    """
    given = soft if isinstance(soft, Soft) else Soft(soft)
    soft = Soft(*(undeclared(name, "a weight of soft=", weight, 2) for weight in (given.linear, given.quadratic)))
    if wrapped.rows:
        raise GraphError(
            f"term '{name}': soft= takes batched functions, and '{wrapped.name}' is compiled for one factor; write it "
            "batched, or add slack variables of your own",
            term=name,
        )
    if wrapped.search is not None:
        raise GraphError(f"term '{name}': soft= takes no function with a search Jacobian", term=name)
    linear, quadratic = (_weight(name, which, getattr(soft, which), count, size) for which in ("linear", "quadratic"))
    if not ((linear > 0.0) | (quadratic > 0.0)).all():
        raise GraphError(f"term '{name}': soft= gives no price to a row; a price must be positive", term=name)
    sides = UPPER * _anywhere(upper, np.inf) | LOWER * _anywhere(lower, -np.inf)
    width = 2 * size if sides == UPPER | LOWER else size
    kept = Soft(*(w if isinstance(w, Data) else np.array(w, dtype=np.float64) for w in (soft.linear, soft.quadratic)))
    return Slack(SlackFamily(f"{name}{SLACK}", Rn(width), count), sides, kept)


def _weight(name: str, which: str, weight: Any, count: int, size: int) -> Array:
    """(n, m) present weights."""
    value = weight.value if isinstance(weight, Data) else doubles(f"term '{name}': soft=", weight, term=name)
    try:
        found = np.broadcast_to(value, (count, size))
    except ValueError:
        each = "; for one number of each factor give (n, 1): weights[:, None]" if value.shape == (count,) else ""
        raise GraphError(
            f"term '{name}': the {which} weight of soft= has shape {value.shape}, expected (), ({size},) or "
            f"{(count, size)}{each}",
            term=name,
        ) from None
    require_prices(name, which, found)
    return found


def are_prices(found: Array) -> BoolArray:
    """Test which weights are finite and not negative."""
    return np.isfinite(found) & (found >= 0.0)


def require_prices(name: str, which: str, found: Array) -> None:
    """Refuse (n, m) weights that are negative or not finite, by the name of the term."""
    wrong = np.argwhere(~are_prices(found))
    if len(wrong):
        factor, row = map(int, wrong[0])
        raise GraphError(
            f"term '{name}': the {which} weight of soft= is {found[factor, row]!s} in factor {factor}, row {row}; it "
            "must be a finite number, zero or above",
            term=name,
            index=factor,
        )


def _anywhere(limit: Any, none: float) -> bool:
    """Test whether a limit may be one somewhere."""
    return isinstance(limit, Data) or bool((np.asarray(limit) != none).any())
