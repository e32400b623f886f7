"""Columns of the KKT matrix that belong to fixed variables: derivatives of the KKT conditions by where these are.

Costs and constraints are linearised over all variables, so that J'J and A need no further evaluation. What curvature
adds is evaluated for the factors alone that a fixed variable shares with an unknown one.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.views import described
from unifg.modeling.terms import ScalarCost
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import Block, block_of, curve, opened_block, require_second, row_weights
from unifg.problem.linearization import Linearization
from unifg.problem.scalars import add_scalars
from unifg.problem.table import COLUMN, COUNT, POSITION, WIDTH, opened_terms
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, BoolArray, IntArray


class FixedColumns:
    """Places of the entries, found once, and their numbers at a linearisation.

    Attributes:
        coordinates: (E,) of the fixed variables, ascending.
        rows: (E,) in the KKT system, unknowns and then all constraint rows, ascending for each coordinate.
    """

    def __init__(self, program: CompiledProblem, numbers: IntArray) -> None:
        """Find the entries.

        Args:
            program: the compiled graph.
            numbers: (width,) coordinate of every full tangent column, -1 for those that are not asked about.
        """
        unknown, arrays, costs, constraints = (
            program.columns.unknown, program.arrays, program.costs, program.constraints,
        )  # fmt: skip
        fixed = np.flatnonzero(numbers[costs.columns] >= 0)
        first, last = (np.searchsorted(costs.rows, costs.rows[fixed], side) for side in ("left", "right"))
        ends = np.cumsum(last - first)
        beside = np.arange(ends[-1] if len(ends) else 0) + np.repeat(first - ends + last - first, last - first)
        kept = unknown[costs.columns[beside]] >= 0
        self._squares = np.repeat(fixed, last - first)[kept], beside[kept]
        self._slopes = np.flatnonzero(numbers[constraints.columns] >= 0)
        rows = [unknown[costs.columns[self._squares[1]]]]
        coordinates = [numbers[costs.columns[self._squares[0]]]]
        self._positions = np.full(len(arrays.positions), -1, dtype=arrays.positions.dtype)
        self._touched, self._own = (np.zeros(part.count) for part in (costs, constraints))
        self._pairs, self._terms = 0, list[CompiledTerm]()
        for term in program.terms:
            start, count, width = (int(term.place[field]) for field in (COLUMN, COUNT, WIDTH))
            columns = arrays.columns[start : start + count * width].reshape(count, width)
            ends_of = [columns[:, part] for part in np.tril_indices(width)]
            found = [(numbers[a] >= 0) & (unknown[b] >= 0) for a, b in (ends_of, ends_of[::-1])]
            pairs = found[0] | found[1]
            if not pairs.any():
                continue
            self._terms.append(term)
            if not isinstance(term.term, ScalarCost):
                program.rows_of(term, self._touched, self._own)[pairs.any(axis=1)] = 1.0
            place = int(term.place[POSITION]) + np.flatnonzero(pairs)
            self._positions[place] = self._pairs + np.arange(len(place))
            self._pairs += len(place)
            rows.append(unknown[np.where(found[0], *ends_of[::-1])[pairs]])
            coordinates.append(numbers[np.where(found[0], *ends_of)[pairs]])
        fields = np.array([program.table.row_of(term) for term in self._terms], dtype=int)
        self._fields = fields[fields < len(arrays.fields)], fields[fields >= len(arrays.fields)]
        own = [program.table.fields[rows] for rows in self._fields]
        self._arrays = arrays._replace(fields=own[0], scalars=own[1], positions=self._positions)
        self._words = described(self._arrays)
        self._address = int(self._words.ctypes.data)
        rows.append(program.size + constraints.rows[self._slopes])
        coordinates.append(numbers[constraints.columns[self._slopes]])
        height = program.size + constraints.count
        every = np.concatenate(coordinates) * height + np.concatenate(rows)
        places, self._order = np.unique(every, return_inverse=True)
        self.coordinates, self.rows = np.divmod(places, height)

    def entries(self, program: CompiledProblem, lin: Linearization, multipliers: Array, out: BoolArray) -> Array:
        """(E,) numbers.

        Args:
            program: the compiled graph, with its data bound and locked.
            lin: where.
            multipliers: (M,) there.
            out: rows of the KKT system whose numbers are zero.
        """
        require_second(program)
        arrays, found = self._arrays, np.zeros(self._pairs)
        if len(arrays.scalars):
            program.table.fields.take(self._fields[1], axis=0, out=arrays.scalars, mode="clip")
            ignored = np.empty(program.table.scalars), np.zeros(program.columns.width)
            add_scalars(arrays, lin.stored, *ignored, found, np.zeros(self._pairs), program.scratch, False)
        for term in self._terms:
            if term.kernel is None and not term.is_bound:
                self._differenced(program, term, lin, multipliers, found)
        every, places = np.zeros(len(self.rows)), (*self._squares, self._slopes, self._order)
        fields, own = (program.table.fields, self._fields[0]), (self._touched, self._own)
        given = self._address, *fields, block_of(program, lin), multipliers, *own, *places, found, self.rows, out
        add_up(*given, every)
        return every

    def _differenced(
        self, program: CompiledProblem, term: CompiledTerm, lin: Linearization, multipliers: Array, found: Array
    ) -> None:
        """Add the curvature of a term that Python evaluates."""
        if isinstance(term.term, ScalarCost):
            blocks = term.scalar_derivatives(lin.values)[1]
        else:
            blocks = term.second_derivatives(lin.values, row_weights(program, term, lin, multipliers))
        of_pairs = blocks[:, *np.tril_indices(blocks.shape[1])].ravel()
        places = self._positions[int(term.place[POSITION]) :][: len(of_pairs)]
        np.add.at(found, places[places >= 0], of_pairs[places >= 0])


@compiled
def add_up(
    terms_at: int,
    fields: IntArray,
    taken: IntArray,
    block: Block,
    multipliers: Array,
    touched: Array,
    own: Array,
    first: IntArray,
    second: IntArray,
    slopes: IntArray,
    order: IntArray,
    pairs: Array,
    rows: IntArray,
    left_out: BoolArray,
    out: Array,
) -> None:
    """Add the entries of squares, of second derivatives and of constraints, each to its place.

    Args:
        terms_at: address of those with a factor that counts.
        fields: of all terms, whose machine code may be another now.
        taken: which of them these are.
        block: linearisation.
        multipliers: of the constraint rows.
        touched: rows of costs that count.
        own: rows of constraints that do.
        first: entries of the Jacobian whose products count.
        second: those they are multiplied with.
        slopes: entries of the constraint Jacobian.
        order: places of all of these, products, pairs and slopes.
        pairs: second derivatives that are there already; the others are added.
        rows: of the entries in the KKT system.
        left_out: those whose entries are zero.
        out: entries to add to.
    """
    terms, (values, residual, jacobian, squares, weights, _, slope, _, _, _) = (
        opened_terms(terms_at),
        opened_block(block),
    )
    for k in range(len(taken)):
        for field in range(fields.shape[1]):
            terms.fields[k, field] = fields[taken[k], field]
    curve(terms, values, residual * touched, jacobian, squares, weights, multipliers * own, pairs)
    at = len(first)
    for k in range(at):
        out[order[k]] += jacobian[first[k]] * jacobian[second[k]]
    for k in range(len(pairs)):
        out[order[at + k]] += pairs[k]
    at += len(pairs)
    for k in range(len(slopes)):
        out[order[at + k]] += slope[slopes[k]]
    for k in range(len(out)):
        if left_out[rows[k]]:
            out[k] = 0.0
