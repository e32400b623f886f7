"""Distances of rows from their limits."""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.typing import Array


@compiled
def outside(constraints: Array, lower: Array, upper: Array, out: Array) -> None:
    """Write the signed distance outside the limits: positive above, negative below, zero inside; NaN stays."""
    for row in range(len(out)):
        above, below = constraints[row] - upper[row], lower[row] - constraints[row]
        out[row] = (0.0 if above <= 0.0 else above) - (0.0 if below <= 0.0 else below)
