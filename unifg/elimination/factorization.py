"""Elimination of a block-sparse symmetric system: structure once, numbers as often as needed."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from unifg.elimination import fronts, substitution
from unifg.elimination.blas import routines
from unifg.elimination.layout import lay_out
from unifg.elimination.ordering import block_graph, indistinguishable, minimum_degree
from unifg.elimination.plan import FAILED, NEGATIVE, POSITIVE, ROWS, SURPRISE, WIDTH, ZERO, Plan
from unifg.elimination.symbolic import supernodes
from unifg.errors import UnifgError
from unifg.sparse import Symmetric
from unifg.typing import Array, BoolArray, IntArray

Ordering: TypeAlias = Literal["auto", "minimum-degree", "nested-dissection", "natural"] | IntArray
ROUTINES = routines()
NOTHING = np.zeros(0)


class Factorization:
    """Signed Cholesky factorisation A = L S L' of matrices of one pattern, by dense fronts on the elimination tree.

    Serves positive definite matrices and, in any order, symmetric quasi-definite ones, [[H + dI, A'], [A, -dI]].

    Attributes:
        pattern: upper triangle of the matrices.
        starts: (nodes + 1,) first scalar of each node.
        plan: arguments of the compiled kernels in `fronts` and `substitution`.
    """

    def __init__(
        self,
        pattern: Symmetric,
        blocks: IntArray | None = None,
        *,
        ordering: Ordering = "auto",
        negative: BoolArray | None = None,
    ) -> None:
        """Analyse the structure.

        Args:
            pattern: upper triangle of the n x n matrix.
            blocks: (n,) non-decreasing label of the node each scalar belongs to; by default scalars that follow each
                other and have the same neighbours are one node.
            ordering: how to order the nodes, or a permutation of them: the nodes in the order of elimination.
            negative: (n,) whether the pivot of each scalar is expected to be negative; see `unexpected`.

        Raises:
            UnifgError: labels or permutation are not what they should be.
        """
        self.pattern = pattern
        self._indptr, self._indices = pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64)
        size = pattern.size
        label = indistinguishable(self._indptr, self._indices) if blocks is None else _labels(blocks, size)
        nodes = int(label[-1]) + 1 if size else 0
        self.starts = np.searchsorted(label, np.arange(nodes + 1))
        weight = np.diff(self.starts)
        pointer, neighbours = block_graph(self._indptr, self._indices, label, nodes)
        if isinstance(ordering, str):
            if ordering == "natural":
                order = np.arange(nodes)
            else:
                order = minimum_degree(pointer, neighbours, weight)
        else:
            order = _permutation(ordering, nodes)
        order, bounds, parent, passed, _ = supernodes(pointer, neighbours, weight, order)
        table, scalar_order, rows, relative, entries, slots, waiting = lay_out(
            self._indptr, self._indices, self.starts, pointer, neighbours, order, bounds, parent, passed
        )
        largest = int((table[:, WIDTH] + table[:, ROWS]).max(initial=0))
        expected = np.zeros(size, np.int8)
        if negative is not None:
            expected[:] = np.where(np.asarray(negative)[scalar_order], -1, 1)
        self.plan = Plan(
            shape=np.array([size, len(parent), largest, 0]),
            routines=ROUTINES,
            fronts=table,
            order=scalar_order,
            rows=rows,
            relative=relative,
            entries=entries,
            slots=slots,
            expected=expected,
            panels=np.zeros(int(table[-1, 3])),
            updates=np.empty(waiting),
            pivots=np.empty(size),
            signs=np.empty(size),
            work=np.empty(size + 64 * largest),
            state=np.array([0, 0, 0, -1, 0, -1]),
        )
        self._ready = False

    def factor(self, data: Array, added: Array | None = None) -> bool:
        """Factorise; False when an entry is not finite or a pivot vanishes (see `failure`).

        Args:
            data: (nnz,) entries in the order of the pattern.
            added: (n,) numbers added to the diagonal.
        """
        self._ready = bool(fronts.factor(self.plan, data, NOTHING if added is None else added))
        return self._ready

    def solve(self, right: Array) -> Array:
        """Solve for one right-hand side (n,) or several (n, k).

        Raises:
            RuntimeError: there is no factorisation.
        """
        self._demand()
        out = np.empty(right.shape)
        if right.ndim == 1:
            substitution.solve(self.plan, right, out)
        else:
            substitution.solve_columns(self.plan, right, out)
        return out

    def refine(self, data: Array, right: Array, *, tolerance: float = 1e-15, steps: int = 10) -> Array:
        """Solve A x = right for a matrix near the factorised one, by iterative refinement.

        After ``factor(data, added)`` this solves the system without ``added``, say [[H, A'], [A, 0]] after
        factorising [[H + dI, A'], [A, -dI]].

        Args:
            data: (nnz,) entries of A.
            right: (n,).
            tolerance: of the residual, relative to max (|A| |x| + |right|).
            steps: corrections at most; fewer when they stop paying.

        Raises:
            RuntimeError: there is no factorisation.
        """
        self._demand()
        out = np.empty(len(right))
        substitution.refine(self.plan, self._indptr, self._indices, data, right, out, tolerance, steps)
        return out

    @property
    def inertia(self) -> tuple[int, int, int]:
        """Positive, negative and vanished pivots of the last factorisation, up to where it stopped."""
        state = self.plan.state
        return int(state[POSITIVE]), int(state[NEGATIVE]), int(state[ZERO])

    @property
    def definite(self) -> bool:
        """Whether the last factorisation succeeded with positive pivots only."""
        return self._ready and self.inertia[1] == 0

    @property
    def failure(self) -> int:
        """Scalar whose pivot vanished or was not finite in the last factorisation, or -1."""
        return int(self.plan.state[FAILED])

    @property
    def unexpected(self) -> int:
        """Scalar of the first pivot whose sign is not the one ``negative`` announced, or -1."""
        return int(self.plan.state[SURPRISE])

    def pivots(self) -> Array:
        """(n,) diagonal D of the factorisation L D L' with unit L, in the order of elimination."""
        self._demand()
        result: Array = self.plan.signs / self.plan.pivots**2
        return result

    def _demand(self) -> None:
        if not self._ready:
            raise RuntimeError("solve called before a successful factor")


def _labels(blocks: IntArray, size: int) -> IntArray:
    """Consecutive labels from 0, checked."""
    blocks = np.asarray(blocks)
    if blocks.shape != (size,):
        raise UnifgError(f"blocks has shape {blocks.shape} where one label per scalar, ({size},), is needed")
    change = np.diff(blocks)
    if (change < 0).any():
        at = int(np.argmax(change < 0)) + 1
        raise UnifgError(f"blocks decreases at scalar {at}; number the nodes in the order of their scalars")
    result = np.zeros(size, np.int64)
    np.cumsum(change != 0, out=result[1:])
    return result


def _permutation(order: IntArray, nodes: int) -> IntArray:
    """A permutation of the nodes, checked."""
    order = np.asarray(order, dtype=np.int64)
    if order.shape != (nodes,) or not np.array_equal(np.sort(order), np.arange(nodes)):
        raise UnifgError(f"ordering is not a permutation of the {nodes} nodes; name each node once")
    return order
