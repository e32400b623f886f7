"""Outcomes of the comparisons in traces, remembered for the answers that were verified.

Between two comparisons that come out alike, a trace is one smooth formula: an answer on formulas that were verified
before needs no verification of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.calls import matrix, vector
from unifg.codegen.jit import compiled
from unifg.problem.evaluation import run_kernel
from unifg.problem.table import ACTIVE, COUNT, TermTable
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, IntArray

REMEMBERED = 4096  # outcomes of a factor's comparisons, of each term
PROBES = 64  # of the table of outcomes


class Branches:
    """Hash table of the outcomes at verified answers."""

    def __init__(self, table: TermTable, terms: Sequence[CompiledTerm], scratch: Array) -> None:
        """Compile the comparisons in the traces of some terms."""
        self._table, self._scratch = table, scratch
        self._compared, watched = list[object](), list[tuple[int, int, int]]()
        for term in terms:
            assert term.trace is not None
            if (comparisons := term.trace.kernel.expression.conditions) is not None:
                self._compared.append(comparisons)  # owns the machine code
                watched.append((table.row_of(term), comparisons.residual().address, len(comparisons.rows)))
        self._watched = np.array(watched, dtype=np.int64).reshape(-1, 3)
        self._outcomes = np.empty(max((count for *_, count in watched), default=0))
        self._seen = np.zeros(REMEMBERED * len(watched), dtype=np.uint64)

    def __bool__(self) -> bool:
        """Test whether there are comparisons."""
        return len(self._watched) > 0

    def new(self, stored: Array, verified: bool) -> bool:
        """Test whether the comparisons of a factor come out as those of no factor did at a verified answer.

        Args:
            stored: values of an answer.
            verified: whether its outcomes are to be remembered.
        """
        table, arrays = self._table, self._table.arrays
        return _new_outcomes(
            table.fields, self._watched, arrays.gather, arrays.sizes, arrays.parameters, arrays.active,
            stored, self._scratch, self._outcomes, self._seen, verified,
        )  # fmt: skip


@compiled
def _new_outcomes(
    fields: IntArray, watched: IntArray, gather: IntArray, sizes: IntArray, parameters: Array, active: IntArray,
    values: Array, scratch: Array, outcomes: Array, seen: NDArray[np.uint64], enter: bool,
) -> bool:  # fmt: skip
    """Test for outcomes that the table has not; they may be entered into it."""
    new = False
    for t in range(len(watched)):
        term, count = fields[watched[t, 0]], watched[t, 2]
        for i in range(term[COUNT]):
            if term[ACTIVE] >= 0 and active[term[ACTIVE] + i] == 0:
                continue
            r, no_slopes = vector(outcomes, 0, count), matrix(scratch, 0, 0, 0)
            run_kernel(term, watched[t, 1], i, gather, sizes, parameters, values, scratch, r, no_slopes)
            key = np.uint64(14695981039346656037) ^ np.uint64(t)  # FNV-1a
            for j in range(count):
                bit = np.uint64(2) if outcomes[j] > 0.5 else np.uint64(1)
                key = (key ^ bit) * np.uint64(1099511628211)
            key |= np.uint64(1)  # zero is an empty place
            place = np.int64(key >> np.uint64(32)) % len(seen)
            for _ in range(PROBES):
                if seen[place] == key:
                    break
                if seen[place] == np.uint64(0):
                    if enter:
                        seen[place] = key
                    new = True
                    break
                place = (place + 1) % len(seen)
    return new
