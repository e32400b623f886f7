"""Everything the compiled elimination needs, as plain arrays: indices found once, and the memory it works in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unifg.typing import Array, IntArray

# Columns of ``Plan.fronts``.
FIRST, WIDTH, ROWS, PANEL, UPDATE, INDEX, ENTRY, CHILD, SIBLING = range(9)
COLUMNS = 9
# Entries of ``Plan.shape``.
SCALARS, FRONTS, LARGEST, CHAIN = range(4)
# Entries of ``Plan.state``.
POSITIVE, NEGATIVE, ZERO, FAILED, SURPRISES, SURPRISE = range(6)


class Plan(NamedTuple):
    """Arguments of the compiled kernels `factor`, `solve` and `factor_solve`.

    A front holds ``width`` pivots and ``rows`` scalars that are eliminated later. Its panel is a (width, width + rows)
    array, rows contiguous, of which the entries on and right of the diagonal are the factor: with P the panel's part,
    A = sum P' S P. Scalars are numbered in the order of elimination; fronts are in postorder.

    Attributes:
        shape: scalars, fronts, scalars of the largest front, whether the tree is a chain.
        routines: addresses of the BLAS routines of `blas`.
        fronts: (S, 9): first pivot, width, rows, offset of the panel, of the update matrix, of the row indices, of the
            entries; first child and next sibling or -1. One more row closes the offsets.
        order: (n,) original scalar of each eliminated one.
        rows: scalars of the update rows of all fronts.
        relative: where these rows are found in the parent's front.
        entries: numbers of the entries of the pattern, front by front.
        slots: where each of them goes in ``panels``.
        expected: (n,) sign each pivot should have, 0 when any will do.
        panels: the factor.
        updates: update matrices on their way to the parent.
        pivots: (n,) inverse of the diagonal of the factor.
        signs: (n,) S.
        work: (n + largest front) for solves.
        state: positive, negative, vanished pivots, failed scalar or -1, unexpected signs and the first of them or -1.
    """

    shape: IntArray
    routines: IntArray
    fronts: IntArray
    order: IntArray
    rows: NDArray[np.int32]
    relative: NDArray[np.int32]
    entries: NDArray[np.int32]
    slots: NDArray[np.int32]
    expected: NDArray[np.int8]
    panels: Array
    updates: Array
    pivots: Array
    signs: Array
    work: Array
    state: IntArray
