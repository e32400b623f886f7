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
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.table import ENTRY, WIDTH
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray

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
    suspects = [_still(program, lin, term) for term in program.cost_terms]
    suspects += [np.concatenate(term.columns, axis=1).ravel() for term in program.scalar_terms]
    unknown = program.table.arrays.unknown[np.concatenate([np.zeros(0, dtype=np.int64), *suspects])]
    unknown = unknown[unknown >= 0]
    if not len(unknown):
        return None
    direction = np.zeros(program.size)
    direction[unknown] = np.random.default_rng(0).uniform(-1.0, 1.0, len(unknown))

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


def _still(program: CompiledProblem, lin: Linearization, term: CompiledTerm) -> IntArray:
    """Columns of the factors of a term of which a row has a residual and no slope."""
    start, width = int(term.place[ENTRY]), int(term.place[WIDTH])
    entries = lin.jacobian[start : start + term.count * term.size * width].reshape(term.count, term.size, width)
    still = (~entries.any(axis=2) & (program.rows_of(term, lin.residual, lin.constraints) != 0.0)).any(axis=1)
    columns: IntArray = np.concatenate(term.columns, axis=1)[still].ravel()
    return columns
