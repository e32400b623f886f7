"""The Powell-Hestenes-Rockafellar terms of the augmented Lagrangian, row by row.

The term of a row with multiplier lambda and penalty rho is (lambda+^2 - lambda^2) / (2 rho), where lambda+ is the
multiplier the dual step would produce. An inactive inequality contributes nothing (Bazzana's eq. 19 read literally
would keep penalising it).
"""

from __future__ import annotations

from unifg.machine.jit import compiled
from unifg.typing import Array


@compiled
def update(constraints: Array, lower: Array, upper: Array, multipliers: Array, penalty: Array, out: Array) -> None:
    """Write lambda+: the first-order dual update, zero for inactive rows."""
    for row in range(len(out)):
        above = multipliers[row] + penalty[row] * (constraints[row] - upper[row])
        below = multipliers[row] + penalty[row] * (constraints[row] - lower[row])
        out[row] = (above if above > 0.0 else 0.0) + (below if below < 0.0 else 0.0)
        if constraints[row] != constraints[row]:
            out[row] = constraints[row]  # NaN stays visible


@compiled
def barrier(constraints: Array, lower: Array, upper: Array, multipliers: Array, penalty: Array) -> float:
    """Sum of the terms."""
    total = 0.0
    for row in range(len(constraints)):
        above = multipliers[row] + penalty[row] * (constraints[row] - upper[row])
        below = multipliers[row] + penalty[row] * (constraints[row] - lower[row])
        after = (above if above > 0.0 else 0.0) + (below if below < 0.0 else 0.0)
        if constraints[row] != constraints[row]:
            after = constraints[row]
        total += (after * after - multipliers[row] * multipliers[row]) / (2.0 * penalty[row])
    return total
