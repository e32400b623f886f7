"""All terms of a graph as arrays that compiled loops can walk: one row of integers per term.

The rows say where everything stands: machine code, variables, parameters, whitening, rows of the stacked residual,
entries of the Jacobian, columns, and the places of J'J in the matrix of the normal equations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import NumbaError

from unifg.codegen.bisect import first_not_below
from unifg.codegen.jit import compiled, inlined
from unifg.codegen.native import Source
from unifg.codegen.views import opener
from unifg.elimination.symmetric import Symmetric
from unifg.errors import GraphError
from unifg.factors.autodiff.expression import Expression
from unifg.factors.kernel import Kernel
from unifg.factors.robust import Loss, form_of
from unifg.factors.steps import Part, as_table, movable_parts
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.problem.columns import Columns
from unifg.problem.pose_pairs import PLANE, SPACE, loops_of, paired
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray

(
    KIND,  # COST, CONSTRAINT, BOUND or SCALAR
    ADDRESS,  # of the kernel; 0: NumPy has evaluated the term already
    COUNT,  # factors
    ROWS,  # of one factor
    SLOTS,  # variables of one factor
    STORAGE,  # numbers that store them
    WIDTH,  # tangent columns of those that are not constants here
    KERNEL_WIDTH,  # tangent columns that the kernel writes
    GATHER,  # first start of a variable in TermArrays.gather
    SIZE,  # first storage size in TermArrays.sizes
    KEEP,  # first column to keep in TermArrays.sizes; -1: all
    PARAMETER,  # first parameter of factor 0
    PARAMETERS,  # of one factor
    SPREAD,  # from the parameters of one factor to the next; 0: shared
    TABLE,  # address of the shared table
    TABLE_SIZE,
    WHITEN,  # bit 0: one whitener for each factor; DIAGONAL, FULL
    WHITENER,  # first whitener
    ACTIVE,  # first flag; -1: all active
    WEIGHT,  # first robust weight; -1: not robust
    ROW,  # first row of the stacked residual; of scalar costs, first value
    ENTRY,  # first entry of the stacked Jacobian
    COLUMN,  # first column in TermArrays.columns
    POSITION,  # first place in TermArrays.positions
    PAIRED,  # rows of factors whose products have loops of their own (unifg.problem.pose_pairs); 0: none
    PAIR_WHITENING,  # address of the one that whitens them
    PAIR_ADDING,  # address of the one that adds up their products
    PART,  # first row of TermArrays.parts
    PARTS,  # of the variables; 0: linear, or without a compiled retraction
    SECOND,  # address of the kernel's second derivatives; 0: to be differenced
    DIFFERENCING,  # address of the function that makes them then
    DIFFERENCED,  # whether the Jacobian is made of differences
    LOSS,  # which robust loss, or one of the words below
    LOSS_AT,  # where its two parameters stand in TermArrays.parameters
    SLACKS,  # whether it limits the slacks of a soft constraint
    FIELDS,
) = range(36)

COST, CONSTRAINT, BOUND, SCALAR = range(4)
PYTHON, HELD = -1, -2  # losses whose formulas are Python; HELD: line searches keep the weights of a linearisation


class TermArrays(NamedTuple):
    """Arrays for compiled loops.

    Attributes:
        fields: (T, FIELDS) one row per term, in the order of the program.
        scalars: (S, FIELDS) the same of costs that are no squares.
        gather: where each variable of each factor starts in the stored values; negative: constants.
        sizes: storage sizes of variables, and columns kept.
        columns: (n, D) full tangent columns of each factor, term after term.
        unknown: full column to unknown, or -1.
        positions: place of every pair (d, e <= d) of columns in the normal matrix; -1: fixed; -2 - p: the pair stands
            for both triangles, because both columns are the same unknown.
        parts: (L, 6) of the variables of every term, as :class:`unifg.factors.steps.Part` has them.
        active: flags.
        parameters: of kernels, constants in the place of variables, and those of losses.
        whiteners: reciprocal standard deviations and upper triangular square roots.
        lower, upper: (M,) limits of constraints.
    """

    fields: IntArray
    scalars: IntArray
    gather: IntArray
    sizes: IntArray
    columns: IntArray
    unknown: IntArray
    positions: IntArray
    parts: IntArray
    active: IntArray
    parameters: Array
    whiteners: Array
    lower: Array
    upper: Array


_LONG, _DOUBLE = np.dtype(np.int64), np.dtype(np.float64)
_PLACES = *[_LONG] * 4, np.dtype(np.int32), (_LONG, len(Part._fields) + 1), np.dtype(np.uint8)
_open = opener(TermArrays, ((_LONG, FIELDS), (_LONG, FIELDS), *_PLACES, *[_DOUBLE] * 4))


@inlined
def opened_terms(address: int) -> TermArrays:
    """The arrays that :func:`unifg.codegen.views.described` has described at an address."""
    return _open(address)


class TermTable:
    """Builds :class:`TermArrays` once and renews what data can change.

    It owns the kernels whose addresses stand in its rows, whatever becomes of the terms meanwhile.

    Attributes:
        arrays: for the compiled loops.
        fields: (T + S, FIELDS) one row per term, those of costs that are no squares last.
        residuals, weights: number of rows of all costs, number of robust factors.
        scalars: number of factors of costs that are no squares.
        constraints: number of constraint rows.
        entries, constraint_entries: lengths of the stacked Jacobians.
        blocks: rows of one factor times its columns, of all constraints but bounds.
        sizes: lengths of the stacked residual, its Jacobian, the stacked constraints and theirs.
        scratch: how many numbers the loops need for one factor.
        differenced: whether the Jacobian of any term is made of differences.
        robust: robust terms and their slices of weights.
        weighed: those of them whose losses are Python, with these.
        holding: whether any loss holds its weights during line searches.
    """

    def __init__(
        self, terms: Sequence[CompiledTerm], scalars: Sequence[CompiledTerm], columns: Columns, normal: Symmetric
    ) -> None:
        """Lay everything out; numbers come with :meth:`bind`."""
        self._terms = [*terms, *scalars]
        self._owned: dict[CompiledTerm, Kernel | None] = {}
        self._differencing: Callable[[], int] | None = None
        self._columns = columns
        self.fields = fields = np.zeros((len(self._terms), FIELDS), dtype=np.int64)
        gather, sizes, tangent = [], [], []
        parts: list[tuple[int, ...]] = []
        starts = {"gather": 0, "sizes": 0, "tangent": 0, "positions": 0, "parameters": 0, "whiteners": 0, "active": 0}
        self.residuals = self.weights = self.scalars = self.constraints = self.entries = self.constraint_entries = 0
        self.scratch = 1
        self.differenced = any(term.differenced for term in terms)
        self.robust: list[tuple[CompiledTerm, slice]] = []
        self.weighed: list[tuple[Loss, slice]] = []
        losses: dict[int, tuple[float, float]] = {}
        for row, term in zip(fields, self._terms, strict=True):
            layout = term.layout(starts["parameters"])
            count, m, width = layout.count, layout.rows, layout.columns.shape[1]
            row[COUNT], row[ROWS], row[WIDTH] = count, m, width
            row[SLOTS], row[STORAGE], row[KERNEL_WIDTH] = len(layout.sizes), sum(layout.sizes), layout.kernel_width
            row[GATHER], row[SIZE], row[COLUMN] = starts["gather"], starts["sizes"], starts["tangent"]
            row[KEEP] = -1 if layout.keep is None else starts["sizes"] + len(layout.sizes)
            row[POSITION], row[PARAMETER], row[WHITENER] = (
                starts["positions"],
                starts["parameters"],
                starts["whiteners"],
            )
            row[ACTIVE], row[WEIGHT] = -1, -1
            row[PART] = len(parts)
            if term.kernel is not None and (term.trace is not None or not term.kernel.linear):
                parts += movable_parts(term.kernel.manifolds)
            row[PARTS] = len(parts) - row[PART]
            row[DIFFERENCED] = term.differenced
            gather.append(layout.gather.ravel())
            sizes += [*layout.sizes, *(layout.keep or [])]
            tangent.append(layout.columns.ravel())
            starts["gather"] += layout.gather.size
            starts["sizes"] = len(sizes)
            starts["tangent"] += layout.columns.size
            starts["positions"] += count * (width * (width + 1) // 2)
            starts["parameters"] += term.parameters.size
            starts["whiteners"] += term.whitener.size
            self.scratch = max(self.scratch, sum(layout.sizes) + m * layout.kernel_width)
            row[PARAMETERS], row[SPREAD], row[WHITEN] = term.parameter_count, term.parameter_spread, term.whitening
            entries = count * m * width
            if isinstance(term.term, Cost):
                row[KIND], row[ROW], row[ENTRY] = COST, self.residuals, self.entries
                self.residuals += count * m
                self.entries += entries
                if term.term.robust is not None:
                    row[WEIGHT] = self.weights
                    own = slice(self.weights, self.weights + count)
                    self.robust.append((term, own))
                    self.weights += count
                    form = form_of(term.term.robust)
                    if form is None:
                        form = HELD if term.term.robust.held else PYTHON, 0.0, 0.0
                        self.weighed.append((term.term.robust, own))
                    row[LOSS], row[LOSS_AT] = form[0], starts["parameters"]
                    losses[starts["parameters"]] = form[1:]
                    starts["parameters"] += 2
            elif isinstance(term.term, ScalarCost):
                row[KIND], row[ROW] = SCALAR, self.scalars
                self.scalars += count
            else:
                assert isinstance(term.term, Constraint)
                row[KIND] = BOUND if term.is_bound else CONSTRAINT
                row[SLACKS] = term.term.limits_slacks
                row[ROW], row[ENTRY] = self.constraints, self.constraint_entries
                self.constraints += count * m
                self.constraint_entries += entries
            term.place = row
            if term.trace is not None:
                self.renew(term)
            else:
                self._take(term)
        self.holding = HELD in fields[:, LOSS]
        self.blocks = int((fields[:, ROWS] * fields[:, WIDTH])[fields[:, KIND] == CONSTRAINT].sum())
        self.sizes = self.residuals, self.entries, self.constraints, self.constraint_entries
        counts = fields[:, COUNT]
        self._active_starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.arrays = TermArrays(
            fields[: len(terms)],
            fields[len(terms) :],
            _joined(gather),
            np.array(sizes or [0], dtype=np.int64),
            _joined(tangent),
            columns.unknown.astype(np.int64),
            np.empty(starts["positions"], dtype=np.int32),
            as_table(parts),
            np.ones(int(counts.sum()), dtype=np.uint8),
            np.empty(max(starts["parameters"], 1)),
            np.empty(max(starts["whiteners"], 1)),
            np.empty(self.constraints),
            np.empty(self.constraints),
        )
        for place, pair in losses.items():
            self.arrays.parameters[place : place + 2] = pair
        locate(fields, self.arrays.columns, self.arrays.unknown, normal.indptr, normal.indices, self.arrays.positions)
        for row, term in zip(fields, self._terms, strict=True):
            row[PAIRED] = self._paired(row, term, self.arrays.positions)
            row[[PAIR_WHITENING, PAIR_ADDING]] = loops_of(int(row[PAIRED])) if row[PAIRED] else (0, 0)

    def pairs_at(self, positions: IntArray) -> bool:
        """Test whether terms whose loops are of fixed size could have them at other places, too."""
        rows = zip(self.fields, self._terms, strict=True)
        return all(self._paired(row, term, positions) == row[PAIRED] for row, term in rows if row[PAIRED])

    def _paired(self, row: IntArray, term: CompiledTerm, positions: IntArray) -> int:
        """Rows of a factor of a term whose loops are of fixed size; 0 where they are not."""
        rows, count, width = (int(row[field]) for field in (ROWS, COUNT, WIDTH))
        if row[KIND] != COST or rows not in (PLANE, SPACE) or list(term.dims) != [rows, rows] or row[KEEP] >= 0:
            return 0
        pairs = width * (width + 1) // 2
        columns = self.arrays.columns[row[COLUMN] : row[COLUMN] + count * width].reshape(count, width)
        places = positions[row[POSITION] : row[POSITION] + count * pairs].reshape(count, pairs)
        return rows if paired(columns, places, rows) else 0

    def __setstate__(self, state: dict[str, Any]) -> None:
        """In a copy the rows of the terms are those of the copy.

        It describes a linearisation and runs nothing: addresses belong to what it is a copy of.
        """
        self.__dict__.update(state)
        self._owned = {}
        arrays = self.arrays
        self.fields = np.concatenate([arrays.fields, arrays.scalars])
        self.fields[:, [ADDRESS, SECOND, DIFFERENCING, PAIR_WHITENING, PAIR_ADDING, TABLE, TABLE_SIZE]] = 0
        first = len(arrays.fields)
        self.arrays = arrays._replace(fields=self.fields[:first], scalars=self.fields[first:])
        for row, term in zip(self.fields, self._terms, strict=True):
            term.place = row

    def renew(self, term: CompiledTerm) -> None:
        """Take the machine code of a traced term; the numbers of its parameters have not changed."""
        assert term.kernel is not None
        term.place[PARTS] = 0 if term.kernel.linear else len(movable_parts(term.kernel.manifolds))
        self._take(term)

    def row_of(self, term: CompiledTerm) -> int:
        """Number of the row of a term in ``fields``."""
        return self._terms.index(term)

    @property
    def kernels(self) -> list[Kernel]:
        """Those whose addresses stand in the rows."""
        return [kernel for kernel in self._owned.values() if kernel is not None]

    @property
    def sources(self) -> dict[int, Source]:
        """Functions of the derived kernels, by the addresses of their machine code."""
        expressions = [getattr(kernel, "expression", None) for kernel in self.kernels]
        return {a: s for e in expressions if isinstance(e, Expression) for a, s in e.sources().items()}

    def without(self, terms: Sequence[CompiledTerm]) -> TermArrays:
        """The arrays for a pass in which residuals and Jacobians of some terms are there already."""
        fields = self.arrays.fields.copy()
        for term in terms:
            fields[(fields[:, [KIND, ROW]] == term.place[[KIND, ROW]]).all(axis=1), ADDRESS] = 0
        return self.arrays._replace(fields=fields)

    def give_up(self, term: CompiledTerm) -> None:
        """Leave a term that was traced to its own function; its rows, entries and parameters stay where they are."""
        term.place[PARTS] = 0 if term.kernel is None else len(movable_parts(term.kernel.manifolds))
        term.place[DIFFERENCED] = self.differenced = True
        self._take(term)

    def _take(self, term: CompiledTerm) -> None:
        """Write where the machine code of a term and its table stand, and only then let go of what stood there."""
        row, kernel = term.place, term.kernel
        first = second = table = size = 0
        if kernel is not None:
            wanted = self._differencing is not None or row[KIND] == SCALAR or not kernel.derived
            try:
                first, second = kernel.address, kernel.second_address if wanted else 0
            except NumbaError as error:
                raise GraphError(
                    f"term '{term.name}': Numba cannot compile its function, which gets variables, parameters, and the "
                    f"rows to write to: {str(error).strip()}", term=term.name,
                ) from error  # fmt: skip
            if self._differencing is not None and second == 0 and row[PARTS] > 0:
                row[DIFFERENCING] = self._differencing()
            table, size = kernel.table.ctypes.data, kernel.table.size
        row[[ADDRESS, SECOND, TABLE, TABLE_SIZE]] = first, second, table, size
        self._owned[term] = kernel

    def require_second(self, differencing: Callable[[], int]) -> None:
        """Have second derivatives of kernels generated, which not every solver needs.

        Args:
            differencing: address of what differences kernels that have none.
        """
        if self._differencing is None:
            self._differencing = differencing
            for term in self._terms:
                self._take(term)

    def bind(self, rebound: Sequence[CompiledTerm], lower: Array, upper: Array) -> None:
        """Copy limits and everything that some terms have bound; their parameters live here from then on."""
        arrays = self.arrays
        arrays.lower[:], arrays.upper[:] = lower, upper
        for row, term, start in zip(self.fields, self._terms, self._active_starts, strict=False):
            if term not in rebound:
                continue
            parameters = arrays.parameters[row[PARAMETER] : row[PARAMETER] + term.parameters.size]
            parameters[:] = term.parameters
            term.settle(parameters)
            arrays.whiteners[row[WHITENER] : row[WHITENER] + term.whitener.size] = term.whitener.ravel()
            row[ACTIVE] = -1
            if term.active is not None and not term.is_bound:
                row[ACTIVE] = start
                arrays.active[start : start + term.count] = term.active


def _joined(parts: list[IntArray]) -> IntArray:
    """One int64 array, also of nothing."""
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts]).astype(np.int64, copy=False)


@compiled
def locate(
    fields: IntArray, columns: IntArray, unknown: IntArray, indptr: IntArray, indices: IntArray, positions: IntArray
) -> None:
    """Find every pair of columns of every factor in a matrix compressed by columns.

    Unknowns of one variable stand side by side: the next pair is one row further on, or as far down the next column.
    """
    at = low = column_before = 0
    for t in range(len(fields)):
        width = fields[t, WIDTH]
        for i in range(fields[t, COUNT]):
            column = fields[t, COLUMN] + i * width
            for d in range(width):
                for e in range(d + 1):
                    a, b = unknown[columns[column + d]], unknown[columns[column + e]]
                    positions[at] = -1
                    if a >= 0 and b >= 0:
                        beside, wanted = max(a, b), min(a, b)
                        begin, high = indptr[beside], indptr[beside + 1] - 1
                        low = low + 1 if beside == column_before else begin + low - indptr[column_before]
                        if low > high or indices[low] != wanted:
                            low = first_not_below(indices, begin, high, wanted)
                        column_before = beside
                        positions[at] = -2 - low if a == b and d != e else low
                    at += 1


def require_touched(terms: Sequence[CompiledTerm], columns: Columns) -> None:
    """Raise unless every unknown is part of some term.

    Raises:
        GraphError: naming the first variable that is not.
    """
    touched = np.zeros(columns.width, dtype=bool)
    for term in terms:
        for part in term.columns:
            touched[part] = True
    idle = columns.free[~touched[columns.free]]
    if len(idle):
        family, index = columns.name(int(idle[0]))
        raise GraphError(
            f"{family}[{index}] is in no cost or constraint and is not fixed: {len(idle)} tangent coordinates "
            "are free to be anything; add a term, fix it, or make the family shorter",
            family=family,
            index=index,
        )


def block_pattern(terms: Sequence[CompiledTerm], variable: IntArray, starts: IntArray) -> Symmetric:
    """Pattern of a Hessian: every two variables of a factor share a block.

    Args:
        terms: of the factors.
        variable: of every full column, as of :meth:`Columns.nodes`.
        starts: first unknown of each variable, as of the same.
    """
    first, second = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for term in terms:
        members = [variable[part[:, 0]] for part in term.columns]
        for k, a in enumerate(members):
            for b in members[:k]:
                first.append(np.minimum(a, b))
                second.append(np.maximum(a, b))
    return Symmetric.of_blocks(starts, np.concatenate(first), np.concatenate(second))


def rows_in_stack(term: CompiledTerm) -> slice:
    """Rows of a term among those of all costs, or of all constraints."""
    start = int(term.place[ROW])
    return slice(start, start + term.count * term.size)
