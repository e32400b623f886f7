"""The linear systems of a graph: each structure is found once, whoever asks; numbers belong to who asks.

A solve needs the normal equations, or the KKT matrix [[H, A'], [A, 0]] with the multipliers of the rows that are held
as nodes of their own. So do the covariances of its solution, the judge, ``graph.check`` and the picture of the
elimination tree. Ordering and layout cost more than a factorisation, and are the same for all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property, partial
from threading import Lock
from typing import Any, NamedTuple, TypeVar

import numpy as np

from unifg.codegen.jit import compiled, inlined
from unifg.codegen.views import Form, described, opener
from unifg.elimination.factorization import Factorization
from unifg.elimination.plan import COLUMNS, Plan
from unifg.elimination.saddle import NOTHING, SaddleArrays, SaddlePoint
from unifg.elimination.symmetric import Symmetric
from unifg.problem.evaluation import add_constraints, transposed_times
from unifg.problem.linearization import Rows
from unifg.problem.table import TermArrays
from unifg.typing import Array, BoolArray, IntArray

T = TypeVar("T")
KEPT = 8  # structures of KKT matrices; active rows may change from solve to solve


class Systems:
    """The linear systems of one program.

    What it hands out shares the structure and nothing else, so that backends, solutions and threads never work in the
    memory of another.
    """

    def __init__(self, normal: Symmetric, blocks: IntArray, constraints: Rows) -> None:
        """Know the pattern of the normal equations, the variable of each unknown, and the rows that may be held."""
        self._asked = normal, blocks, constraints
        self._normal = Factorization(normal, blocks)
        self._spare: list[Factorization] = []
        self._held: dict[bytes, KktStructure] = {}
        self._lock = Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the structures are made from."""
        return Systems, self._asked

    def normal(self) -> Factorization:
        """A factorisation for matrices in the pattern ``CompiledProblem.normal``, to keep."""
        return self._normal.twin()

    def borrowed(self) -> AbstractContextManager[Factorization]:
        """The same for one question: its memory serves the next one too."""
        return _Borrowed(self._spare, self.normal)

    def kkt(self, held: BoolArray) -> KktSystem:
        """The KKT matrix with some rows of the constraints (M,) held as equalities, to keep."""
        return KktSystem(self.structure(held))

    def structure(self, held: BoolArray) -> KktStructure:
        """Structure of all KKT matrices with these rows held."""
        key = held.tobytes()
        with self._lock:
            structure = self._held.pop(key, None) or KktStructure.of(*self._asked, held)
            self._held[key] = structure  # the one used last stands last
            while len(self._held) > KEPT:
                del self._held[next(iter(self._held))]
        return structure


class _Borrowed(AbstractContextManager[T]):
    """One that nobody uses now, or a new one; it is spare again afterwards."""

    def __init__(self, spare: list[T], make: Callable[[], T]) -> None:
        self._spare, self._make = spare, make

    def __enter__(self) -> T:
        try:
            self._found = self._spare.pop()
        except IndexError:
            self._found = self._make()
        return self._found

    def __exit__(self, *raised: object) -> None:
        self._spare.append(self._found)


class KktArrays(NamedTuple):
    """Arrays for compiled code.

    Attributes:
        plan: of the elimination.
        size: unknowns and held rows.
        rows: (E,) held rows among the constraints.
        normal: where the entries of ``CompiledProblem.normal`` go.
        normal_row: row of each of them.
        normal_column: column of each of them.
        entries: which entries of the constraint Jacobian belong to held rows and unknowns.
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


@dataclass(frozen=True, eq=False)
class KktStructure:
    """Structure shared by KKT matrices with the same rows held.

    Attributes:
        held: (M,) which rows.
        unknowns: number of them.
        factorization: of the matrix; only its structure is used.
        arrays: all of :class:`KktArrays` but the plan, in its order.
        spare: systems that nobody uses now.
    """

    held: BoolArray
    unknowns: int
    factorization: Factorization
    arrays: tuple[IntArray, ...]
    spare: list[KktSystem] = field(default_factory=list)

    def borrowed(self) -> AbstractContextManager[KktSystem]:
        """A system for one question: its memory, and its factor if nobody has replaced it, serve the next one too."""
        return _Borrowed(self.spare, partial(KktSystem, self))

    @staticmethod
    def of(normal: Symmetric, blocks: IntArray, constraints: Rows, held: BoolArray) -> KktStructure:
        """Number the multipliers after the unknowns; the rows of one factor are one node."""
        n, rows = normal.size, np.flatnonzero(held)
        number = np.full(constraints.count, -1, dtype=np.int64)
        number[rows] = n + np.arange(len(rows))
        chosen = number[constraints.free_rows] >= 0
        columns, multipliers = constraints.free_columns[chosen], number[constraints.free_rows[chosen]]
        pattern = Symmetric(n + len(rows), [(normal.indices, normal.columns), (columns, multipliers)])
        label = np.unique(constraints.factors[rows], return_inverse=True)[1].ravel()
        last = int(blocks[-1]) + 1 if n else 0
        return KktStructure(
            held.copy(),
            n,
            Factorization(pattern, np.concatenate([blocks, last + label])),
            (
                np.array([n, len(rows)]),
                rows,
                pattern.positions(normal.indices, normal.columns).astype(np.int64),
                normal.indices.astype(np.int64),
                normal.columns.astype(np.int64),
                constraints.free[chosen].astype(np.int64),
                pattern.positions(columns, multipliers).astype(np.int64),
            ),
        )


class KktSystem:
    """A KKT matrix with numbers of its own.

    Attributes:
        held: (M,) which rows of the constraints are.
        pattern: upper triangle of the matrix, unknowns first.
        factorization: of the matrix.
        saddle: the same, for solving without a shift.
        loaded: entries that it was factorised with by :meth:`load`.
    """

    def __init__(self, structure: KktStructure) -> None:
        """Take part in a structure."""
        self._structure = structure
        self.held = structure.held
        self.factorization = structure.factorization.twin()
        self.pattern = self.factorization.pattern
        self.saddle = SaddlePoint(self.factorization, structure.unknowns)
        self.loaded: Array | None = None

    def load(self, data: Array, near: Array = NOTHING) -> bool:
        """Factorise ``data`` (nnz,), unless it was the last to be; False when an entry is not finite.

        Args:
            data: entries in the order of the pattern.
            near: as of :meth:`SaddlePoint.factor`.
        """
        if self.loaded is not data:
            self.loaded = None
            if not self.saddle.factor(data, near):
                return False
            self.loaded = data
        return True

    def without(self, entries: Array, out: BoolArray) -> Array:
        """Entries of the matrix with rows of the identity, negative for multipliers, in the place of some (size,)."""
        data = np.empty_like(entries)
        leave_out(self.pattern.indptr, self.pattern.indices, entries, out, self._structure.unknowns, data)
        return data

    @cached_property
    def arrays(self) -> KktArrays:
        """For compiled code."""
        return KktArrays(self.factorization.plan, *self._structure.arrays)

    @cached_property
    def address(self) -> int:
        """Address at which :class:`Opened` is described, for :func:`opened`."""
        self._words = described([*self.arrays.plan, *self._structure.arrays, *self.saddle.arrays])
        return int(self._words.ctypes.data)


class Opened(NamedTuple):
    """The arrays of a :class:`KktSystem` for compiled code, by one address."""

    kkt: KktArrays
    saddle: SaddleArrays


_LONG, _SHORT, _DOUBLE = map(np.dtype, (np.int64, np.int32, np.float64))
_PLAN = _LONG, (_LONG, COLUMNS), _LONG, *[_SHORT] * 4, *[_DOUBLE] * 4, _LONG, _LONG
_KKT, _SADDLE = (Form(Plan, _PLAN), *[_LONG] * 7), (*[_LONG] * 4, *[_DOUBLE] * 3)
_open = opener(Opened, (Form(KktArrays, _KKT), Form(SaddleArrays, _SADDLE)))


@inlined
def opened(address: int) -> Opened:
    """The arrays whose description stands at an address."""
    return _open(address)


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
def fill_stacked(
    terms: TermArrays, entries: IntArray, doubles: IntArray, constraint_jacobian: Array, weights: Array, normal: int,
    sides: bool, data: Array,
) -> None:  # fmt: skip
    """Write what follows the ``normal`` entries of H in the order of :func:`stacked`.

    Args:
        terms: of the program.
        entries: of the constraint Jacobian, as of :class:`KktArrays`.
        doubles: pairs of :func:`stacked`.
        constraint_jacobian: entries of A.
        weights: (M,) of A' diag(weights) A, which is added to H if ``sides`` says so.
        normal: number of entries of H, which stand in ``data``.
        sides: see above.
        data: the stacked entries.
    """
    for k in range(len(entries)):
        data[normal + k] = constraint_jacobian[entries[k]]
    if sides:
        add_constraints(terms, constraint_jacobian, weights, data)
    for k in range(len(doubles) // 2):
        data[doubles[2 * k]] += data[doubles[2 * k + 1]]


@compiled
def leave_out(indptr: IntArray, indices: IntArray, entries: Array, out: BoolArray, unknowns: int, data: Array) -> None:
    """Write the entries of a matrix without some rows and columns, which become those of the identity."""
    for column in range(len(out)):
        for k in range(indptr[column], indptr[column + 1]):
            data[k] = 0.0 if out[column] or out[indices[k]] else entries[k]
        if out[column]:
            data[indptr[column + 1] - 1] = 1.0 if column < unknowns else -1.0


@compiled
def aim(
    terms: TermArrays,
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
