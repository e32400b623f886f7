"""The Hessian of the Lagrangian: Gauss-Newton plus the curvature of every residual and constraint."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from unifg.language.terms import Cost
from unifg.program.curvature import add_curvature
from unifg.program.linearization import Linearization
from unifg.program.program import Program
from unifg.program.table import POSITION
from unifg.program.term import CompiledTerm
from unifg.typing import Array, IntArray


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
    if not second.any():
        return
    if term not in _places:
        _places[term] = _find(program, term)
    factor, row, column, times, place = _places[term]
    np.add.at(entries, place, times * second[factor, row, column])


_places: WeakKeyDictionary[CompiledTerm, tuple[IntArray, IntArray, IntArray, Array, IntArray]] = WeakKeyDictionary()


def _find(program: Program, term: CompiledTerm) -> tuple[IntArray, IntArray, IntArray, Array, IntArray]:
    """Factor, row and column of second derivatives, how often they count, and where in the normal matrix."""
    width = sum(term.dims)
    start, pairs = int(term.place[POSITION]), width * (width + 1) // 2
    where = program.arrays.positions[start : start + term.count * pairs].reshape(term.count, pairs)
    row, column = np.tril_indices(width)
    factor, pair = np.nonzero(where != -1)
    place = where[factor, pair]
    doubled = place < -1
    return factor, row[pair], column[pair], np.where(doubled, 2.0, 1.0), np.where(doubled, -2 - place, place)
