"""Everything the compiled elimination needs, as plain arrays: indices found once, and the memory it works in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unifg.typing import Array, IntArray

# Columns of ``Plan.fronts``.
FIRST, PIVOTS, ROWS, PANEL, STRIDE, UPDATE, UPDATE_STRIDE, DIRECT, INDEX, ADJACENT, CHILD, SIBLING = range(12)
COLUMNS = 12
# Entries of ``Plan.shape``.
SCALARS, FRONTS, LARGEST, PANELS = range(4)
# Entries of ``Plan.state``.
POSITIVE, NEGATIVE, ZERO, FAILED = range(4)


class Plan(NamedTuple):
    """Arguments of the compiled kernels `factor` and `solve`.

    A front eliminates its pivots and passes an update matrix on the ``rows`` scalars it shares with later fronts. Its
    panel is a (pivots, pivots + rows) matrix of which the entries on and right of the diagonal are the factor:
    A = sum P' S P. Scalars are numbered in the order of elimination; fronts are in postorder.

    Attributes:
        shape: scalars, fronts, scalars of the largest front, numbers in all panels.
        fronts: (S + 1, 12) per front: first pivot, pivots, rows, offset of the panel, length of its rows; offset of
            the update matrix and length of its rows; whether that is the leading part of the parent's panel; offset
            of the row indices, whether they are simply the next scalars; first child and next sibling or -1.
        order: (n,) original scalar of each eliminated one.
        rows: scalars of the update rows of all fronts.
        relative: where these rows are found in the parent's front.
        runs: how many rows from this one on follow each other there.
        slots: (nnz,) where the entries of the pattern go in ``numbers``.
        numbers: panels, then update matrices.
        pivots: (n,) inverse of the diagonal of the factor.
        signs: (n,) S.
        work: (n + largest front) for solves.
        state: positive, negative, vanished pivots, failed scalar or -1.
        part: (S,) part of each front, see :mod:`unifg.elimination.subtrees`; empty where the work is not shared out.
    """

    shape: IntArray
    fronts: IntArray
    order: IntArray
    rows: NDArray[np.int32]
    relative: NDArray[np.int32]
    runs: NDArray[np.int32]
    slots: NDArray[np.int32]
    numbers: Array
    pivots: Array
    signs: Array
    work: Array
    state: IntArray
    part: IntArray
