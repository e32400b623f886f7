"""Distances of rows from their limits."""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.typing import Array, IntArray


@compiled
def outside(constraints: Array, lower: Array, upper: Array, out: Array) -> None:
    """Write the signed distance outside the limits: positive above, negative below, zero inside; NaN stays."""
    for row in range(len(out)):
        above, below = constraints[row] - upper[row], lower[row] - constraints[row]
        out[row] = (0.0 if above <= 0.0 else above) - (0.0 if below <= 0.0 else below)


@compiled
def clip(values: Array, places: IntArray, rows: IntArray, lower: Array, upper: Array) -> None:
    """Bring values that have a bound within it; NaN stays.

    Args:
        values: stored ones.
        places: (B,) of those with a bound.
        rows: (B,) constraint row of each.
        lower: (M,) limits.
        upper: the same.
    """
    for k in range(len(places)):
        value, row = values[places[k]], rows[k]
        value = lower[row] if value < lower[row] else value
        values[places[k]] = upper[row] if value > upper[row] else value
