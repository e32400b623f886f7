"""Columns of the KKT matrix that belong to fixed variables: derivatives of the KKT conditions by where these are.

Costs and constraints are linearised over all variables, so that J'J and A need no further evaluation. What curvature
adds is evaluated for the factors alone that a fixed variable shares with an unknown one.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.modeling.terms import ScalarCost
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import curve, require_second, row_weights
from unifg.problem.linearization import Linearization
from unifg.problem.scalars import add_scalars
from unifg.problem.table import COLUMN, COUNT, POSITION, WIDTH, TermArrays
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray


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
        rows.append(program.size + constraints.rows[self._slopes])
        coordinates.append(numbers[constraints.columns[self._slopes]])
        height = program.size + constraints.count
        every = np.concatenate(coordinates) * height + np.concatenate(rows)
        places, self._order = np.unique(every, return_inverse=True)
        self.coordinates, self.rows = np.divmod(places, height)

    def entries(self, program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
        """(E,) numbers.

        Args:
            program: the compiled graph, with its data bound and locked.
            lin: where.
            multipliers: (M,) there.
        """
        require_second(program)
        arrays, values, found = self._arrays, lin.stored, np.zeros(self._pairs)
        for rows, fields in zip(self._fields, (arrays.fields, arrays.scalars), strict=True):
            program.table.fields.take(rows, axis=0, out=fields, mode="clip")  # of machine code that may be another now
        if len(arrays.scalars):
            ignored = np.empty(program.table.scalars), np.zeros(program.columns.width)
            add_scalars(arrays, values, *ignored, found, np.zeros(self._pairs), program.scratch, False)
        for term in self._terms:
            if term.kernel is None and not term.is_bound:
                self._differenced(program, term, lin, multipliers, found)
        every, weights = np.zeros(len(self.rows)), (lin.residual, lin.weights, lin.squares, multipliers)
        own, places = (self._touched, self._own), (*self._squares, self._slopes, self._order)
        add_up(arrays, values, *weights, lin.jacobian, lin.constraint_jacobian, *own, *places, found, every)
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
    terms: TermArrays,
    values: Array,
    residual: Array,
    robust: Array,
    squares: Array,
    multipliers: Array,
    jacobian: Array,
    constraint_jacobian: Array,
    touched: Array,
    own: Array,
    first: IntArray,
    second: IntArray,
    slopes: IntArray,
    order: IntArray,
    pairs: Array,
    out: Array,
) -> None:
    """Add the entries of squares, of second derivatives and of constraints, each to its place.

    Args:
        terms: those with a factor that counts.
        values: stored ones.
        residual: as linearised.
        robust: weights of losses.
        squares: of robust factors.
        multipliers: of the constraint rows.
        jacobian: of the costs.
        constraint_jacobian: of the constraints.
        touched: rows of costs that count.
        own: rows of constraints that do.
        first: entries of the Jacobian whose products count.
        second: those they are multiplied with.
        slopes: entries of the constraint Jacobian.
        order: places of all of these, products, pairs and slopes.
        pairs: second derivatives that are there already; the others are added.
        out: entries to add to.
    """
    curve(terms, values, residual * touched, jacobian, squares, robust, multipliers * own, pairs)
    at = len(first)
    for k in range(at):
        out[order[k]] += jacobian[first[k]] * jacobian[second[k]]
    for k in range(len(pairs)):
        out[order[at + k]] += pairs[k]
    at += len(pairs)
    for k in range(len(slopes)):
        out[order[at + k]] += constraint_jacobian[slopes[k]]
