"""Descent from a kink: stationary by derivatives, though every step lowers the Lagrangian by its length.

The slope of a norm at zero is taken to be zero, so a landmark that is guessed on the pose that measured a distance to
it seems to be at rest. Rows that have a residual and no slope are suspects, and scalar costs are. Along a random
direction of their unknowns the Lagrangian is compared ahead and behind: where both are lower, half the step has to
lower it by about half as much. At a minimum with a kink it rises; at a saddle half the step lowers it by a quarter.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from unifg.codegen.inner import inner
from unifg.codegen.jit import compiled
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.table import COLUMN, COST, COUNT, ENTRY, KIND, ROW, ROWS, WIDTH, TermArrays
from unifg.typing import Array, BoolArray

LENGTHS = (1e-3, 1e-6, 1e-9, 1e-12)  # of steps: long ones for what is rounded, short ones beside stiff terms
HALF = 0.4  # share of the fall that half the step must have, at least
ROUNDINGS = 1e3


def beside_a_kink(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Values | None:
    """Values on the way down from a kink; None where there is none.

    Args:
        program: problem.
        lin: linearisation at an answer.
        multipliers: (M,) of its constraints.
    """
    suspect = np.zeros(program.size, dtype=np.bool_)
    if not _mark(program.arrays, lin.residual, lin.jacobian, suspect):
        return None
    direction = np.zeros(program.size)
    direction[suspect] = np.random.default_rng(0).uniform(-1.0, 1.0, np.count_nonzero(suspect))

    def change(length: float) -> float:
        there = program.evaluate(program.retract(lin.values, length * direction))
        return there.cost - lin.cost + inner(multipliers, there.constraints - lin.constraints)

    least = -ROUNDINGS * np.finfo(float).eps * (abs(lin.cost) + inner(np.abs(multipliers), np.abs(lin.constraints)))
    with suppress(Exception):  # of functions that are not defined beside the answer
        for length in LENGTHS:
            sides = {side: change(side) for side in (length, -length)}
            if all(fall < least and change(0.5 * side) <= HALF * fall for side, fall in sides.items()):
                return program.retract(lin.values, min(sides, key=sides.__getitem__) * direction)
    return None


@compiled
def _mark(terms: TermArrays, residual: Array, jacobian: Array, suspect: BoolArray) -> bool:
    """Mark the unknowns of suspects; test whether there is one."""
    fields, scalars, found = terms.fields, terms.scalars, False
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] != COST:
            continue
        m, width, row, entry, column = term[ROWS], term[WIDTH], term[ROW], term[ENTRY], term[COLUMN]
        for _ in range(term[COUNT]):
            still = False
            for a in range(m):
                flat = residual[row + a] != 0.0
                for d in range(entry + a * width, entry + (a + 1) * width):
                    flat = flat and jacobian[d] == 0.0
                still = still or flat
            found = (still and _mark_factor(terms, column, width, suspect)) or found
            row += m
            entry += m * width
            column += width
    for t in range(len(scalars)):
        for i in range(scalars[t, COUNT]):
            column = scalars[t, COLUMN] + i * scalars[t, WIDTH]
            found = _mark_factor(terms, column, scalars[t, WIDTH], suspect) or found
    return found


@compiled
def _mark_factor(terms: TermArrays, column: int, width: int, suspect: BoolArray) -> bool:
    """Mark the unknowns of a factor; test whether it has any."""
    found = False
    for d in range(column, column + width):
        unknown = terms.unknown[terms.columns[d]]
        if unknown >= 0:
            suspect[unknown] = found = True
    return found
