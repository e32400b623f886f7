"""Size of an objective and of the forces of its constraints: units in which a solve goes the same way for any cost."""

from __future__ import annotations

import math

from unifg.codegen.jit import compiled
from unifg.codegen.loops import largest
from unifg.problem.table import BOUND, COST, COUNT, ENTRY, KIND, ROW, ROWS, WIDTH, TermArrays
from unifg.typing import Array, IntArray

LARGE_PULL = 1e3  # times the curvatures: slopes of the cost from which on it is they that count
LEAST_SHARE = 1e-4  # of the largest curvature, below which a mean of all is not believed
SMALL_FORCES = 100.0  # times the cost: multipliers from which on it is they that count


@compiled
def cost_unit(free: IntArray, diagonal: IntArray, hessian: Array, gradient: Array, units: Array) -> float:
    """Geometric mean of the curvatures of the cost along the unknowns.

    Where nothing is curved it is that of the largest slope and of the sum of all. Slopes far above curvatures count,
    too, and a mean far below the largest curvature does not. One where the cost has neither.

    Args:
        free: (n,) columns that are unknown.
        diagonal: (n,) places of their curvatures among the entries of the Hessian.
        hessian: entries of that of Gauss-Newton.
        gradient: (width,) of the cost.
        units: (width,) of the unknowns.
    """
    logarithms, product, count, pull, slopes, steepest = 0.0, 1.0, 0, 0.0, 0.0, 0.0
    for k in range(len(free)):
        unit = units[free[k]]
        slope = abs(gradient[free[k]]) * unit
        pull, slopes = max(pull, slope), slopes + slope
        curvature = hessian[diagonal[k]] * unit**2
        if 0.0 < curvature < math.inf:
            steepest = max(steepest, curvature)
            product *= curvature
            count += 1
            if not 1e-100 < product < 1e100:  # one logarithm for many factors
                logarithms += math.log(product)
                product = 1.0
    if not slopes < math.inf:
        pull = slopes = 0.0
    if count > 0:
        mean = math.exp((logarithms + math.log(product)) / count)
        return max(max(mean, LEAST_SHARE * steepest), pull / LARGE_PULL)
    return math.sqrt(pull * slopes) if pull > 0.0 else 1.0


@compiled
def mean_force(terms: TermArrays, entries: Array, multipliers: Array) -> float:
    """Mean over the constraint rows of the largest force of a row on an unknown, which no unit of the row changes."""
    fields, total = terms.fields, 0.0
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] == COST:
            continue
        width, entry, row = term[WIDTH], term[ENTRY], term[ROW]
        for _ in range(term[COUNT] * term[ROWS]):
            multiplier = abs(multipliers[row])
            if multiplier > 0.0:
                total += multiplier * (1.0 if term[KIND] == BOUND else largest(entries, entry, entry + width))
            row += 1
            entry += width
    return total / max(len(multipliers), 1)
