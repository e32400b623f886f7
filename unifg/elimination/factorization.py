"""Elimination of a block-sparse symmetric system: structure once, numbers as often as needed."""

from __future__ import annotations

from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np

from unifg.codegen.threads import threads
from unifg.elimination import fronts, sharing, substitution
from unifg.elimination.analysis import SLACK, Ordering, Structure, analyse
from unifg.elimination.inverse import invert, locate
from unifg.elimination.off_diagonal_inverse import block_of, blocks_of_pairs, heights, products
from unifg.elimination.plan import (
    FAILED,
    INDEX,
    LARGEST,
    NEGATIVE,
    PANELS,
    PIVOTS,
    POSITIVE,
    ROWS,
    ZERO,
    Plan,
)
from unifg.elimination.symmetric import Symmetric
from unifg.elimination.tree import EliminationTree
from unifg.errors import UnifgError
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Factorization", "Ordering"]
NOTHING = np.zeros(0)
WEAK = 1e-13  # pivots below this, relative to the diagonal, are rounding errors


class Symbolic:
    """Symbolic structure shared by factorisations of one pattern: analysed once, when first needed.

    Attributes:
        pattern: upper triangle of the matrices.
        asked: labels and ordering, as for :class:`Factorization`.
        indptr, indices: the pattern as compiled code reads it.
    """

    def __init__(self, pattern: Symmetric, blocks: IntArray | None, ordering: Ordering, last: int) -> None:
        """Remember what is asked for."""
        self.pattern = pattern
        self.asked = blocks, ordering, last
        self.indptr = pattern.indptr.astype(np.int64, copy=False)
        self.indices = pattern.indices.astype(np.int64, copy=False)
        self._structure: Structure | None = None
        self._lock = Lock()

    @property
    def structure(self) -> Structure:
        """Result of the symbolic analysis; threads that ask at once wait for one of them."""
        with self._lock:
            if self._structure is None:
                self._structure = analyse(self.indptr, self.indices, *self.asked)
            return self._structure


class Factorization:
    """Signed Cholesky factorisation A = L S L' of matrices of one pattern, by dense fronts on the elimination tree.

    Serves positive definite matrices and, in any order, symmetric quasi-definite ones, [[H + dI, A'], [A, -dI]].
    Structure is analysed when first needed, once; others of the same pattern share it, see :meth:`twin`.

    Attributes:
        pattern: upper triangle of the matrices.
        symbolic: what twins share.
    """

    def __init__(
        self,
        pattern: Symmetric,
        blocks: IntArray | None = None,
        *,
        ordering: Ordering = "auto",
        last: int = 0,
    ) -> None:
        """Remember the structure.

        Args:
            pattern: upper triangle of the n x n matrix.
            blocks: (n,) non-decreasing label of the node each scalar belongs to; by default scalars that follow each
                other and have the same neighbours are one node.
            ordering: how to order the nodes, or a permutation of them: the nodes in the order of elimination. "auto"
                takes the cheapest of minimum degree, nested dissection (large graphs; METIS' too, where the extra
                ``unifg[metis]`` is installed) and a chain of stages.
            last: scalars at the end that are eliminated after all others, see :meth:`last_block`; with "auto" alone.
        """
        self._begin(Symbolic(pattern, blocks, ordering, last))

    def _begin(self, symbolic: Symbolic) -> None:
        self.symbolic, self.pattern = symbolic, symbolic.pattern
        self._plan: Plan | None = None
        self._ready = False
        self._inverse: tuple[Array, BoolArray] | None = None  # panels, fronts filled in

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the structure asked for, without numbers: a plan holds addresses of this process."""
        return _rebuilt, (self.pattern, *self.symbolic.asked)

    def twin(self) -> Factorization:
        """Another factorisation of this pattern, with numbers of its own: the analysis is shared."""
        other = Factorization.__new__(Factorization)
        other._begin(self.symbolic)
        return other

    @property
    def structure(self) -> Structure:
        """Result of the symbolic analysis.

        Raises:
            UnifgError: labels or permutation are not what they should be.
        """
        return self.symbolic.structure

    @property
    def plan(self) -> Plan:
        """Arguments of the compiled kernels `fronts.factor` and `substitution.solve`."""
        if self._plan is None:
            self._plan = self.structure.with_memory()
        return self._plan

    def factor(self, data: Array, added: Array | None = None) -> bool:
        """Factorise; False when an entry is not finite or a pivot vanishes (see `failure`).

        Args:
            data: (nnz,) entries in the order of the pattern.
            added: (n,) numbers added to the diagonal.

        Raises:
            UnifgError: an array has the wrong shape, or the structure asked for makes no sense.
        """
        data = _numbers(data, self.pattern.nnz, "data")
        added = NOTHING if added is None else _numbers(added, self.pattern.size, "added")
        self._forget()
        self._ready = bool((sharing.factor_at_once if self._shared else fronts.factor)(self.plan, data, added))
        return self._ready

    def adopt(self, success: bool) -> None:
        """Take over what a compiled caller has factorised through `plan`.

        Args:
            success: what ``fronts.factor`` answered.
        """
        self._forget()
        self._ready = success

    def solve(self, right: Array) -> Array:
        """Solve for one right-hand side (n,) or several (n, k).

        Raises:
            UnifgError: there is no factorisation, or the right-hand side has the wrong shape.
        """
        self._demand("solve")
        if right.ndim == 1:
            right = _numbers(right, self.pattern.size, "the right-hand side")
            out = np.empty(len(right))
            substitution.solve(self.plan, right, out)
            return out
        rows = np.array(right.T, dtype=np.float64, order="C")
        if rows.ndim != 2 or rows.shape[1] != self.pattern.size:
            raise UnifgError(f"right-hand sides have shape {right.shape}; expected ({self.pattern.size}, k)")
        substitution.solve_columns(self.plan, rows, rows)
        return rows.T

    def refine(self, data: Array, right: Array, *, tolerance: float = 1e-15, steps: int = 10) -> Array:
        """Solve A x = right for a matrix near the factorised one, by iterative refinement.

        After ``factor(data, added)`` this solves the system without ``added``, say [[H, A'], [A, 0]] after
        factorising [[H + dI, A'], [A, -dI]]; :mod:`unifg.elimination.saddle` chooses what to add.

        Args:
            data: (nnz,) entries of A.
            right: (n,).
            tolerance: of the residual, relative to max (|A| |x| + |right|).
            steps: corrections at most; fewer when they stop paying.

        Raises:
            UnifgError: there is no factorisation, or an array has the wrong shape.
        """
        self._demand("refine")
        data = _numbers(data, self.pattern.nnz, "data")
        right = _numbers(right, self.pattern.size, "the right-hand side")
        out, left = np.empty(len(right)), np.empty(len(right))
        pattern, own, rows = (self.symbolic.indptr, self.symbolic.indices), np.ones(len(right)), len(right)
        substitution.refine(self.plan, *pattern, data, right, own, rows, out, left, tolerance, 0.0, steps)
        return out

    @property
    def inertia(self) -> tuple[int, int, int]:
        """Positive, negative and vanished pivots of the last factorisation, up to where it stopped."""
        state = self.plan.state
        return int(state[POSITIVE]), int(state[NEGATIVE]), int(state[ZERO])

    @property
    def definite(self) -> bool:
        """True if the last factorisation succeeded with positive pivots only."""
        return self._ready and self.inertia[1] == 0

    def weakest(self, diagonal: Array) -> float:
        """Smallest pivot relative to the (n,) diagonal of the matrix; 0 where it is not definite."""
        if not self.definite:
            return 0.0
        plan = self.plan
        return float(fronts.weakest(plan.order, plan.signs, plan.pivots, diagonal, self.pattern.size))

    @property
    def failure(self) -> int:
        """Scalar whose pivot vanished or was not finite in the last factorisation, or -1."""
        return int(self.plan.state[FAILED])

    def pivots(self) -> Array:
        """(n,) diagonal D of the factorisation L D L' with unit L, in the order of elimination.

        Raises:
            UnifgError: there is no factorisation.
        """
        self._demand("pivots")
        return (self.plan.signs / self.plan.pivots**2)[: self.pattern.size]

    def last_block(self) -> Array:
        """(k, k) Schur complement of the ``last`` scalars.

        Raises:
            UnifgError: there is no factorisation.
        """
        self._demand("last_block")
        plan, count = self.plan, self.symbolic.asked[2]
        chosen = self._position[self.pattern.size - count :]
        place = np.full(self.pattern.size, -1)
        place[chosen] = np.arange(count)
        upper = np.zeros((count, count))
        for s in np.unique(self._owner[chosen]).tolist():
            first, width, rows, panel, stride, *_ = plan.fronts[s].tolist()
            index = int(plan.fronts[s, INDEX])
            own = np.arange(first, first + width)
            block = plan.numbers[panel : panel + width * stride].reshape(width, stride)[:, : width + rows].copy()
            block[:, :width] = np.triu(block[:, :width], 1) + np.diag(1.0 / plan.pivots[own])
            here = place[np.append(own, plan.rows[index : index + rows])]
            kept = here >= 0  # a front may begin with others
            upper[np.ix_(here[:width][kept[:width]], here[kept])] = block[np.ix_(kept[:width], kept)]
        return upper.T @ (plan.signs[chosen, None] * upper)

    @property
    def tree(self) -> EliminationTree:
        """The elimination tree, to look at and to print."""
        plan, _, starts, order, bounds, parent, kind = self.structure
        node = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        begins = plan.fronts[:, INDEX]
        separators = []
        for s in range(len(parent)):
            given = node[plan.order[plan.rows[begins[s] : begins[s + 1]]]]
            separators.append(given[np.flatnonzero(np.diff(given, prepend=-1))])
        return EliminationTree(
            parent, plan.fronts[:-1, PIVOTS], plan.fronts[:-1, ROWS], order, bounds, tuple(separators), kind
        )

    def selected_inverse(self) -> Array:
        """(nnz,) entries of the inverse at the places of the pattern, at the cost of about two factorisations.

        Raises:
            UnifgError: there is no factorisation.
        """
        return self._filled(None)[self.plan.slots]

    def inverse_block(self, rows: IntArray) -> Array:
        """(k, k) block of the inverse: the joint covariance of some scalars when A is an information matrix.

        Scalars that share a front are read off the tree, and only the path from them to the root is computed; of others
        the paths to their roots are climbed.

        Raises:
            UnifgError: there is no factorisation.
        """
        self._demand("inverse_block")
        rows = np.asarray(rows, dtype=np.int64)
        chosen = self._position[rows]
        places = np.zeros((len(rows), len(rows)), np.int64)
        if locate(self.plan, self._owner, chosen, places):
            return self._filled(chosen)[places]
        return block_of(self.plan, self._parent, self._owner, self._heights, chosen, self._clean)

    def inverse_blocks(self, first: IntArray, second: IntArray) -> Array:
        """(n, k + m, k + m) blocks of the inverse: joint covariances of n pairs of nodes anywhere in the tree.

        Of each node the path to its root is climbed; a first node that stays the same, as the present pose beside
        many candidates, is climbed from once.

        Args:
            first: (n, k) scalars of a node in each row.
            second: (n, m) the same of another one.

        Raises:
            UnifgError: there is no factorisation.
        """
        self._demand("inverse_blocks")
        return blocks_of_pairs(
            self.plan, self._parent, self._owner, self._heights, self._position[np.asarray(first, dtype=np.int64)],
            self._position[np.asarray(second, dtype=np.int64)], self._clean,
        )  # fmt: skip

    def products(self, starts: IntArray, rows: IntArray, values: Array) -> Array:
        """(c, d, d) products B' A^-1 B with matrices B (n, d) that have few rows which are not zero.

        Only the paths from these rows to the root are looked at.

        Args:
            starts: (c + 1,) first entry of each matrix, and the end of the last one.
            rows: (k,) scalars; of one that occurs twice in a matrix, the sum counts.
            values: (k, d) of these rows.

        Raises:
            UnifgError: there is no factorisation.
        """
        self._demand("products")
        return products(
            self.plan, self._parent, self._owner, np.asarray(starts, dtype=np.int64),
            self._position[np.asarray(rows, dtype=np.int64)], np.ascontiguousarray(values, dtype=np.float64),
            self._clean,
        )  # fmt: skip

    def diagonal_blocks(self) -> list[Array]:
        """Marginal covariance (d, d) of every node, all in about the time of two factorisations.

        Raises:
            UnifgError: there is no factorisation.
        """
        panels = self._filled(None)
        plan, starts, position = self.plan, self.structure.starts, self._position
        sizes, result = np.diff(starts), [NOTHING] * (len(starts) - 1)
        front = plan.fronts[self._owner]  # one row per scalar
        for size in np.unique(sizes).tolist():
            chosen = np.flatnonzero(sizes == size)
            first = position[starts[chosen]]  # scalars of a node stay together
            table = front[first]
            i, j = np.triu_indices(size)
            base = table[:, 3] + (first - table[:, 0]) * (table[:, 4] + 1)
            blocks = np.empty((len(chosen), size, size))
            blocks[:, i, j] = panels[base[:, None] + i * table[:, 4, None] + j]
            blocks[:, j, i] = blocks[:, i, j]
            for node, block in zip(chosen.tolist(), blocks, strict=True):
                result[node] = block
        return result

    @cached_property
    def _position(self) -> IntArray:
        """Of each scalar in the order of elimination."""
        position = np.empty(self.pattern.size, np.int64)
        position[self.plan.order] = np.arange(self.pattern.size)
        return position

    @cached_property
    def _parent(self) -> IntArray:
        return np.asarray(self.structure.parent, dtype=np.int64)

    @cached_property
    def _heights(self) -> IntArray:
        return heights(self.plan, self._parent)

    @cached_property
    def _clean(self) -> Array:
        return np.zeros(len(self.plan.work))

    @cached_property
    def _owner(self) -> IntArray:
        """Front that eliminates each scalar, in the order of elimination."""
        widths = self.plan.fronts[:-1, PIVOTS]
        return np.repeat(np.arange(len(widths)), widths)

    def _filled(self, scalars: IntArray | None) -> Array:
        """Panels of the inverse, filled in for the fronts of some scalars (in elimination order) or for all."""
        self._demand("the inverse")
        owner, parent = self._owner, self.structure.parent
        if self._inverse is None:
            largest = int(self.plan.shape[LARGEST])
            size = int(self.plan.shape[PANELS]) + 6 * largest * (largest + 4) + SLACK
            self._inverse = np.zeros(size), np.zeros(len(parent), dtype=np.bool_)
        panels, done = self._inverse
        wanted = np.zeros(len(parent), dtype=np.bool_)
        if scalars is None:
            wanted[:] = True
        else:
            for s in np.unique(owner[scalars]).tolist():
                while s >= 0 and not wanted[s]:
                    wanted[s] = True
                    s = int(parent[s])
        wanted &= ~done
        if wanted.any():
            invert(self.plan, owner, wanted, panels, int(self.plan.shape[PANELS]))
            done |= wanted
        return panels

    @property
    def _shared(self) -> bool:
        """True if several threads work on it."""
        return len(self.plan.part) > 0 and threads() > 1

    def _forget(self) -> None:
        self._ready = False
        if self._inverse is not None:
            self._inverse[1][:] = False

    def _demand(self, what: str) -> None:
        if not self._ready:
            raise UnifgError(f"{what} called before a successful factor: call factor, and look whether it returns True")


def _rebuilt(pattern: Symmetric, blocks: IntArray | None, ordering: Ordering, last: int) -> Factorization:
    return Factorization(pattern, blocks, ordering=ordering, last=last)


def _numbers(array: Array, size: int, name: str) -> Array:
    """Contiguous doubles of the right length: compiled kernels check nothing."""
    if array.dtype != np.float64 or not array.flags.c_contiguous:
        array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != (size,):
        raise UnifgError(f"{name} has shape {array.shape}; expected ({size},)")
    return array
