"""Shares of the factors that threads linearise at once, and where each adds up its part of J'J.

Most entries of J'J are written by one share alone: those between two variables by the factors of both, those on the
diagonal by all factors of a variable, which mostly stand near each other. The first share that writes to an entry does
so in place; others write beside the matrix, and what stands there is added at the end, share by share.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from unifg.codegen.buffers import Buffers
from unifg.codegen.jit import compiled
from unifg.codegen.threads import share
from unifg.codegen.work_queue import entrance
from unifg.elimination.ordering import filled
from unifg.problem import evaluation
from unifg.problem.evaluation import LinearArrays
from unifg.problem.table import COST, COUNT, KIND, POSITION, WIDTH, TermArrays, TermTable
from unifg.typing import Array, IntArray


class Shares:
    """Places and room of one program for one number of shares.

    Attributes:
        count: of shares.
        contested: (C,) entries of J'J that several shares write to.
        positions: as in ``TermArrays``, of entries beside the matrix too.
        buffers: memory for linearisations, with room for these.
        costs, norms, slopes, scratch: of every share; see :func:`unifg.problem.evaluation.linearize_at_once`.
    """

    def __init__(self, table: TermTable, width: int, entries: int, count: int) -> None:
        """Find the places.

        Args:
            table: of the terms.
            width: columns of the tangent space.
            entries: of J'J.
            count: of shares.
        """
        fields, positions = table.arrays.fields, table.arrays.positions
        self.count = count
        self.contested, self.positions = apart(fields, positions, count, entries, False)
        if not table.pairs_at(self.positions):  # loops of fixed size know where the rows of a block begin
            self.contested, self.positions = apart(fields, positions, count, entries, True)
        self.buffers = Buffers([*table.sizes, width, entries + (count - 1) * len(self.contested)])
        self.costs, self.norms = np.empty(count), np.empty((count, len(fields)))
        self.slopes, self.scratch = np.empty((count - 1, width)), np.empty((count, table.scratch))


def linearize_shared(shares: Shares, terms: TermArrays, values: Array, out: LinearArrays) -> float:
    """The pass over all terms, a share of the factors of each for every thread; sums are added up in order."""
    counters = np.zeros(6, np.int64)
    own = shares.costs, shares.norms, shares.slopes, shares.contested, shares.scratch
    given = terms._replace(positions=shares.positions), values, out
    share(_entrance(), (*given, *own, counters.ctypes.data))
    out.norms[:] = np.sqrt(np.square(shares.norms).sum(axis=0))
    return float(shares.costs.sum())


@cache
def _entrance() -> int:
    """Of a linearisation that is shared."""
    return entrance(evaluation.linearize_at_once)


@compiled
def apart(
    fields: IntArray, positions: IntArray, shares: int, entries: int, everything: bool
) -> tuple[IntArray, IntArray]:
    """Entries that several shares write to, and places of all pairs of columns with those beside the matrix.

    Args:
        fields: (T, FIELDS) of the terms.
        positions: as in ``TermArrays``.
        shares: of the factors of every term.
        entries: of J'J.
        everything: take all entries for such.
    """
    first, last = filled(entries, shares), filled(entries, -1)
    for t in range(len(fields)):
        if fields[t, KIND] == COST:
            pairs, count = fields[t, WIDTH] * (fields[t, WIDTH] + 1) // 2, fields[t, COUNT]
            for share in range(shares):
                begin, end = count * share // shares, count * (share + 1) // shares
                for q in range(fields[t, POSITION] + begin * pairs, fields[t, POSITION] + end * pairs):
                    place = positions[q] if positions[q] >= 0 else -2 - positions[q]
                    if place >= 0:
                        first[place], last[place] = min(first[place], share), max(last[place], share)
    rank, many = filled(entries, -1), 0
    for place in range(entries):
        if everything or first[place] < last[place]:
            rank[place] = many
            many += 1
    contested = np.empty(many, np.int64)
    for place in range(entries):
        if rank[place] >= 0:
            contested[rank[place]] = place
            if everything:
                first[place] = 0
    moved = positions.copy()
    for t in range(len(fields)):
        if fields[t, KIND] == COST:
            pairs, count = fields[t, WIDTH] * (fields[t, WIDTH] + 1) // 2, fields[t, COUNT]
            for share in range(1, shares):
                begin, end = count * share // shares, count * (share + 1) // shares
                for q in range(fields[t, POSITION] + begin * pairs, fields[t, POSITION] + end * pairs):
                    place = positions[q] if positions[q] >= 0 else -2 - positions[q]
                    if place >= 0 and rank[place] >= 0 and first[place] < share:
                        beside = entries + (share - 1) * many + rank[place]
                        moved[q] = beside if positions[q] >= 0 else -2 - beside
    return contested, moved
