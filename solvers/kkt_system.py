"""The KKT matrix [[H, A'], [A, 0]] of a graph, with the multipliers of equality factors as nodes of their own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.plan import Plan
from unifg.elimination.saddle import SaddlePoint
from unifg.elimination.symmetric import Symmetric
from unifg.machine.jit import compiled
from unifg.program.passes import transposed_times
from unifg.program.program import Program
from unifg.program.table import Terms
from unifg.typing import Array, BoolArray, IntArray


class KktArrays(NamedTuple):
    """What compiled code needs.

    Attributes:
        plan: of the elimination.
        size: unknowns and equality rows.
        rows: (E,) equality rows among the constraints.
        normal: where the entries of ``Program.normal`` go.
        normal_row: row of each of them.
        normal_column: column of each of them.
        entries: which entries of the constraint Jacobian belong to equality rows and unknowns.
        places: where they go.
    """

    plan: Plan
    size: IntArray
    rows: IntArray
    normal: IntArray
    normal_row: IntArray
    normal_column: IntArray
    entries: IntArray
    places: IntArray


class KktSystem:
    """Structure of the KKT matrix for given equality rows.

    Attributes:
        equality: (M,) which rows are equalities.
        factorization: of the matrix, in which every pivot of a multiplier is expected to be negative.
        saddle: the same, for solving without a shift.
        arrays: for compiled code.
    """

    def __init__(self, program: Program, equality: BoolArray) -> None:
        """Number the multipliers after the unknowns, factor by factor."""
        n, constraints = program.size, program.constraints
        self.equality = equality.copy()
        rows = np.flatnonzero(equality)
        number = np.full(constraints.count, -1, dtype=np.int64)
        number[rows] = n + np.arange(len(rows))
        chosen = number[constraints.free_rows] >= 0
        columns, multipliers = constraints.free_columns[chosen], number[constraints.free_rows[chosen]]
        normal = program.normal
        normal_columns = np.repeat(np.arange(n), np.diff(normal.indptr))
        self.pattern = Symmetric(n + len(rows), [(normal.indices, normal_columns), (columns, multipliers)])
        factor = np.zeros(constraints.count, dtype=np.int64)
        for k, (term, part) in enumerate(zip(program.constraint_terms, program.slices, strict=True)):
            factor[part] = (k << 40) + np.arange(part.stop - part.start) // term.size
        _, label = np.unique(factor[rows], return_inverse=True)
        last = int(program.blocks[-1]) + 1 if n else 0
        self.factorization = Factorization(
            self.pattern,
            np.concatenate([program.blocks, last + label.ravel()]),
            negative=np.arange(n + len(rows)) >= n,
        )
        self.saddle = SaddlePoint(self.factorization, n)
        self.arrays = KktArrays(
            self.factorization.plan,
            np.array([n, len(rows)]),
            rows,
            self.pattern.positions(normal.indices, normal_columns).astype(np.int64),
            normal.indices.astype(np.int64),
            normal_columns.astype(np.int64),
            constraints.free[chosen].astype(np.int64),
            self.pattern.positions(columns, multipliers).astype(np.int64),
        )


def stacked(arrays: KktArrays) -> tuple[Plan, IntArray]:
    """The plan for entries that come as those of ``normal``, then those of ``entries``, with no need to be filled in.

    Returns:
        The plan, and pairs (later, earlier) of stacked entries that mean the same entry of the matrix: only the last
        of them counts, so the earlier ones must be added to it, pair after pair.
    """
    slots = arrays.plan.slots[np.concatenate([arrays.normal, arrays.places])]
    _, inverse, counts = np.unique(slots, return_inverse=True, return_counts=True)
    last: dict[int, int] = {}
    pairs = []
    for k in np.flatnonzero(counts[inverse] > 1).tolist():
        if int(slots[k]) in last:
            pairs.append((k, last[int(slots[k])]))
        last[int(slots[k])] = k
    return arrays.plan._replace(slots=slots), np.array(pairs, dtype=np.int64).ravel()


@compiled
def fill(kkt: KktArrays, hessian: Array, constraint_jacobian: Array, data: Array) -> None:
    """Write the entries of the matrix."""
    data[:] = 0.0
    for k in range(len(kkt.normal)):
        data[kkt.normal[k]] = hessian[k]
    for k in range(len(kkt.entries)):
        data[kkt.places[k]] += constraint_jacobian[kkt.entries[k]]


@compiled
def aim(
    terms: Terms,
    free: IntArray,
    rows: IntArray,
    gradient: Array,
    constraints: Array,
    constraint_jacobian: Array,
    multipliers: Array,
    bend: Array,
    right: Array,
) -> None:
    """Write the right-hand side: what is left of stationarity, and of equalities moved by ``bend`` (M,)."""
    full, n = np.zeros(len(gradient)), len(free)
    transposed_times(terms, False, constraint_jacobian, multipliers, full)
    for k in range(n):
        right[k] = -(gradient[free[k]] + full[free[k]])
    for k in range(len(rows)):
        right[n + k] = terms.lower[rows[k]] - (constraints[rows[k]] + bend[rows[k]])
