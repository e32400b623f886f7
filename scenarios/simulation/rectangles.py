"""Few rectangles for many cells: the walls of an occupancy grid as shapes a physics engine can hold.

A building map has thousands of occupied cells, most of them parts of straight walls. Each cell that can be
seen or touched is covered by a rectangle grown greedily over occupied cells; rectangles may overlap, their
union never leaves the occupied cells. Cells whose eight neighbours are all occupied need no cover, for no
beam and no robot reaches them.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from unifg.typing import BoolArray, IntArray

__all__ = ["surface_cells", "wall_rectangles"]


def surface_cells(occupied: BoolArray) -> BoolArray:
    """Occupied cells with at least one neighbour, of eight, that is not occupied.

    Args:
        occupied: (H, W) True for solid cells; outside the grid nothing is solid.

    Returns:
        (H, W) True for the cells that can be seen or touched.
    """
    surface: BoolArray = occupied & ~ndimage.binary_erosion(occupied, np.ones((3, 3)))
    return surface


def wall_rectangles(occupied: BoolArray) -> IntArray:
    """Cover the visible occupied cells by greedily grown rectangles.

    Each cell not covered yet grows a rectangle once rows first and once columns first; the one that newly
    covers more cells is kept.

    Args:
        occupied: (H, W) True for solid cells.

    Returns:
        (n, 4) rectangles (row_low, row_high, column_low, column_high) in cells, high ends exclusive.
    """
    pending = surface_cells(occupied)
    rectangles: list[tuple[int, int, int, int]] = []
    for row, column in np.argwhere(pending).tolist():
        if not pending[row, column]:
            continue
        wide = _grow(occupied, row, column)
        low, high, left, right = _grow(occupied.T, column, row)
        tall = (left, right, low, high)
        best = max((wide, tall), key=lambda r: int(pending[r[0] : r[1], r[2] : r[3]].sum()))
        pending[best[0] : best[1], best[2] : best[3]] = False
        rectangles.append(best)
    return np.array(rectangles, dtype=np.intp).reshape(-1, 4)


def _grow(solid: BoolArray, row: int, column: int) -> tuple[int, int, int, int]:
    """Grow along the row both ways, then add whole rows above and below while they are solid."""
    line = solid[row]
    left, right = _solid_run(line, column)
    strip = solid[:, left:right].all(axis=1)
    low, high = _solid_run(np.atleast_1d(strip), row)
    return low, high, left, right


def _solid_run(line: BoolArray, start: int) -> tuple[int, int]:
    """Ends (low, high exclusive) of the run of True values that holds ``start``."""
    after = np.flatnonzero(~line[start:])
    before = np.flatnonzero(~line[:start])
    high = start + int(after[0]) if after.size else line.size
    low = int(before[-1]) + 1 if before.size else 0
    return low, high
