"""The Hessian of the Lagrangian: Gauss-Newton plus the curvature of every residual and constraint."""

from __future__ import annotations

import numpy as np

from unifg.compiled import CompiledTerm
from unifg.curvature import add_curvature
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.table import POSITION
from unifg.terms import Cost
from unifg.typing import Array


def lagrangian_hessian(program: Program, lin: Linearization, multipliers: Array) -> Array:
    """Hessian of the objective plus multipliers' g, in the order of ``Program.normal``.

    Robust costs keep their Gauss-Newton part; terms evaluated by NumPy are differenced in batches.

    Args:
        program: the compiled graph.
        lin: where.
        multipliers: (M,).
    """
    entries = lin.hessian + lin.concavity if len(lin.concavity) else lin.hessian.copy()
    add_curvature(program.arrays, lin.values.flat, lin.residual, multipliers, entries)
    for term in program.batched:
        _add(program, term, lin, multipliers, entries)
    return entries


def constraint_curvature(program: Program, lin: Linearization, multipliers: Array) -> Array:
    """Hessian of multipliers' g alone, in the order of ``Program.normal``; arguments as above."""
    entries = np.zeros(program.normal.nnz)
    add_curvature(program.arrays, lin.values.flat, np.zeros(len(lin.residual)), multipliers, entries)
    for term in program.batched:
        if not isinstance(term.term, Cost):
            _add(program, term, lin, multipliers, entries)
    return entries


def _add(program: Program, term: CompiledTerm, lin: Linearization, multipliers: Array, entries: Array) -> None:
    """Second derivatives of a term without a kernel."""
    if isinstance(term.term, Cost):
        if term.term.robust is not None:
            return
        weights = term.carry_back(program.rows_of(term, lin.residual, lin.constraints))
    else:
        weights = program.rows_of(term, lin.residual, multipliers)
    second = term.second_derivatives(lin.values, weights)
    width = second.shape[1]
    start, pairs = int(term.place[POSITION]), width * (width + 1) // 2
    where = program.arrays.positions[start : start + term.count * pairs].reshape(term.count, pairs)
    row, column = np.tril_indices(width)
    numbers = second[:, row, column]
    np.add.at(entries, where[where >= 0], numbers[where >= 0])
    np.add.at(entries, -2 - where[where < -1], 2.0 * numbers[where < -1])
