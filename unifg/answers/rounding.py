"""What rounding leaves of a gradient whose residuals are differenced: no test can ask for more.

A function value f of a few operations is wrong by eps |f|, and a difference over h makes eps |f| / h of that. Summed
over the factors that touch an unknown, with the weight w of each row in the gradient of the Lagrangian, this is

    sum eps |w_a r_a| / h:

w r of a whitened cost is |W r|^2, of a constraint lambda g. Terms with attached Jacobians and kernels with their own
add nothing. Roundings inside a function are not seen from outside; :mod:`unifg.kernels.steps` chooses steps that keep
them small.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.kernels.steps import EPSILON, FIRST, step_for
from unifg.machine.jit import compiled
from unifg.program.extents import extents
from unifg.program.linearization import Linearization
from unifg.program.program import Program
from unifg.program.table import COLUMN, COST, COUNT, DIFFERENCED, KIND, ROW, ROWS, WIDTH, Terms
from unifg.typing import Array, IntArray


def gradient_rounding(program: Program, lin: Linearization, multipliers: Array) -> Array:
    """(size,) by how much the entries of the gradient of the Lagrangian may be wrong; empty without differences.

    Args:
        program: the compiled graph.
        lin: where.
        multipliers: (M,) one per constraint row.
    """
    if not program.differenced:
        return np.zeros(0)
    total = np.zeros(program.columns.width)
    if program.table.differenced:
        first, last, _ = extents(program)
        _add(
            program.arrays,
            lin.residual,
            lin.constraints,
            multipliers,
            total,
            program.columns.values(lin.values).flat,
            first,
            last,
        )
    if program.scalar_terms:
        total += lin.rounding
    return total[program.columns.free]


@compiled
def _add(
    terms: Terms,
    residual: Array,
    constraints: Array,
    multipliers: Array,
    total: Array,
    values: Array,
    first: IntArray,
    last: IntArray,
) -> None:
    """Add the rounding of every differenced term over the full tangent space."""
    fields, columns = terms.fields, terms.columns
    for t in range(len(fields)):
        term = fields[t]
        if term[DIFFERENCED] == 0:
            continue
        m, width = term[ROWS], term[WIDTH]
        for i in range(term[COUNT]):
            row, size = term[ROW] + i * m, 0.0
            for a in range(row, row + m):
                size += residual[a] ** 2 if term[KIND] == COST else abs(multipliers[a] * constraints[a])
            if size == 0.0 or not math.isfinite(size):
                continue
            for d in range(width):
                column, largest = columns[term[COLUMN] + i * width + d], 0.0
                for k in range(first[column], last[column]):
                    largest = max(largest, abs(values[k]))
                total[column] += EPSILON * size / step_for(largest, FIRST)
