"""Draw the building of the demonstration: a floor of our own making, from tables of walls, doors and furniture.

    python -m tools.draw_building

Tables are in metres and painted onto a grid without any randomness. The rest of the inside of the outer wall is free
floor; what lies outside, and inside shafts, is unknown. The floor has no symmetry, so that a lidar can tell its places
apart.
"""

from __future__ import annotations

import numpy as np

from benchmarks.report import CHECKOUT
from unifg.files.ros_map import OccupancyMap, save_map
from unifg.typing import Array, BoolArray

__all__ = ["draw_building"]

RESOLUTION = 0.05  # [m]
ORIGIN = (-1.0, -1.0, 0.0)  # a margin of one metre around the outer wall
EXTENT = (42.0, 32.0)  # [m]

_OUTLINE = ((0.0, 0.0), (40.0, 0.0), (40.0, 18.0), (36.5, 22.0), (30.0, 22.0), (30.0, 30.0), (0.0, 30.0))
_OUTER, _INNER = 0.3, 0.2  # wall thicknesses [m]

# Centre lines x0, y0, x1, y1 [m] of inner walls.
_WALLS = (
    # The long corridor from west to east (y 13 to 15) and the two that leave it.
    (0.0, 13.0, 27.0, 13.0), (29.2, 13.0, 40.0, 13.0), (0.0, 15.0, 13.0, 15.0), (15.2, 15.0, 40.0, 15.0),
    (13.0, 15.0, 13.0, 30.0), (15.2, 15.0, 15.2, 22.5), (15.2, 24.6, 15.2, 30.0), (15.2, 22.5, 30.0, 22.5),
    (15.2, 24.6, 30.0, 24.6), (27.0, 0.0, 27.0, 13.0), (29.2, 0.0, 29.2, 13.0),
    # South of it: office and store, seminar, laboratory and workshop, offices, kitchen.
    (6.0, 0.0, 6.0, 13.0), (0.0, 6.6, 6.0, 6.6), (14.5, 0.0, 14.5, 13.0), (6.0, 4.2, 14.5, 4.2),
    (14.5, 5.4, 27.0, 5.4), (21.2, 0.0, 21.2, 5.4), (29.2, 7.4, 40.0, 7.4), (35.0, 0.0, 35.0, 7.4),
    # North of it: offices, lecture hall, laboratory, meeting room, the rooms along the upper corridor.
    (5.0, 15.0, 5.0, 20.6), (0.0, 20.6, 13.0, 20.6), (22.0, 15.0, 22.0, 22.5), (30.0, 15.0, 30.0, 22.5),
    (20.3, 24.6, 20.3, 30.0),
)  # fmt: skip

# Enclosed and unknown: x0, y0, x1, y1 [m]; a lift and a duct.
_SHAFTS = ((24.3, 10.6, 27.0, 13.0), (0.0, 20.6, 1.2, 22.0))

# Doors: centre x, y, width [m], the wall's direction, the side to which the leaf stands open, and the end it
# hangs on.
_DOORS = (
    (2.1, 13.0, 1.0, "h", -1, -1), (3.9, 6.6, 0.9, "h", -1, 1), (8.2, 13.0, 1.1, "h", -1, -1),
    (12.9, 4.2, 0.9, "h", -1, 1), (18.4, 13.0, 1.1, "h", -1, 1), (27.0, 9.2, 1.1, "v", -1, -1),
    (16.3, 5.4, 1.0, "h", -1, -1), (27.0, 2.7, 1.0, "v", -1, 1), (29.2, 10.6, 1.1, "v", 1, -1),
    (37.4, 13.0, 1.0, "h", -1, 1), (29.2, 4.8, 1.0, "v", 1, 1), (37.9, 7.4, 0.9, "h", -1, -1),
    (3.6, 15.0, 1.0, "h", 1, 1), (10.8, 15.0, 1.0, "h", 1, -1), (13.0, 22.3, 1.1, "v", -1, -1),
    (13.0, 28.4, 1.1, "v", -1, 1), (20.6, 15.0, 1.0, "h", 1, 1), (24.1, 15.0, 1.0, "h", 1, -1),
    (27.9, 22.5, 1.0, "h", -1, 1), (16.6, 24.6, 1.0, "h", 1, -1), (23.2, 24.6, 1.1, "h", 1, 1),
)  # fmt: skip
_OPENINGS = ((33.6, 15.0, 2.6, "h"),)  # the same without a leaf

# Solid boxes: x0, y0, x1, y1 [m].
_BOXES = (
    # Corridors: pilasters, cabinets, a bench, a copier, a display case.
    (6.0, 13.1, 6.3, 13.3), (12.2, 13.1, 12.5, 13.3), (22.1, 13.1, 22.4, 13.3), (31.4, 13.1, 31.7, 13.3),
    (7.6, 14.7, 7.9, 14.9), (17.3, 14.7, 17.6, 14.9), (26.3, 14.7, 26.6, 14.9), (38.2, 14.6, 39.6, 14.9),
    (0.15, 13.6, 0.55, 14.4), (4.3, 13.1, 5.3, 13.5), (14.2, 13.1, 15.8, 13.5), (22.9, 14.5, 23.6, 14.9),
    (13.1, 18.0, 13.5, 19.6), (14.7, 20.4, 15.1, 21.2), (13.1, 25.1, 13.4, 25.4), (14.0, 29.3, 15.1, 29.85),
    (18.0, 24.1, 20.0, 24.5), (25.2, 22.6, 25.5, 22.8), (29.2, 23.0, 29.85, 24.2), (28.7, 6.0, 29.1, 7.4),
    (27.1, 5.6, 27.4, 5.9), (27.1, 11.2, 27.5, 12.0), (27.5, 0.15, 28.6, 0.6),
    # Office and store, south-west.
    (0.15, 9.0, 0.95, 10.8), (1.1, 9.6, 1.55, 10.05), (3.9, 10.2, 5.5, 11.0), (4.5, 9.6, 4.95, 10.05),
    (5.4, 7.2, 5.9, 9.0), (0.15, 6.7, 1.9, 7.1), (0.15, 0.15, 0.65, 5.6), (1.9, 0.15, 5.9, 0.65),
    (1.9, 2.2, 4.4, 2.75), (1.9, 4.2, 3.0, 4.75), (5.35, 2.6, 5.9, 5.2),
    # Seminar room, south: rows of tables, a lectern, a board; the preparation room below it.
    (7.4, 5.6, 9.6, 6.2), (10.8, 5.6, 13.0, 6.2), (7.4, 7.2, 9.6, 7.8), (10.8, 7.2, 13.0, 7.8),
    (7.4, 8.8, 9.6, 9.4), (10.8, 8.8, 12.4, 9.4), (12.9, 11.2, 13.6, 11.8), (14.1, 7.5, 14.4, 10.4),
    (7.9, 6.3, 8.35, 6.7), (11.6, 6.3, 12.05, 6.7), (8.6, 7.9, 9.05, 8.3), (11.0, 9.5, 11.45, 9.9),
    (6.1, 0.15, 9.4, 0.75), (9.4, 0.15, 9.9, 1.0), (6.1, 1.9, 6.7, 3.6), (8.6, 2.1, 11.0, 2.9),
    (13.7, 0.15, 14.4, 1.7),
    # Laboratory: benches, racks, a robot cell; the workshop and the office below it.
    (14.6, 6.4, 15.2, 9.7), (17.4, 7.4, 20.0, 8.5), (22.6, 6.4, 24.6, 7.5), (20.9, 11.0, 23.3, 11.8),
    (15.4, 11.7, 17.2, 12.3), (18.6, 5.5, 21.6, 6.0), (26.3, 5.5, 26.9, 7.6), (17.9, 8.6, 18.35, 9.0),
    (14.6, 0.15, 18.2, 0.9), (19.0, 2.0, 20.4, 3.4), (14.6, 2.6, 15.2, 4.2), (18.6, 4.8, 20.6, 5.3),
    (22.6, 1.6, 24.2, 2.4), (23.1, 1.0, 23.55, 1.45), (21.3, 4.1, 21.8, 5.3), (24.6, 4.8, 26.4, 5.3),
    (24.9, 0.15, 26.2, 0.55),
    # Offices south-east and the kitchen with its counter.
    (31.2, 1.6, 32.8, 2.4), (31.8, 0.95, 32.25, 1.4), (29.3, 0.15, 29.8, 2.6), (33.6, 3.6, 34.4, 5.4),
    (30.6, 6.8, 33.2, 7.3), (36.4, 2.2, 38.0, 3.0), (36.9, 3.1, 37.35, 3.55), (39.3, 0.15, 39.85, 3.8),
    (35.1, 4.6, 35.6, 6.6), (30.6, 7.5, 35.4, 8.1), (39.2, 8.4, 39.85, 12.0), (32.6, 12.2, 34.6, 12.9),
    (30.4, 12.4, 31.2, 12.9),
    # Offices north-west, each with its desks and shelves.
    (0.15, 16.2, 0.75, 19.0), (1.7, 18.9, 3.3, 19.7), (2.2, 18.2, 2.65, 18.65), (4.4, 17.6, 4.9, 20.0),
    (6.2, 17.6, 7.8, 19.2), (6.6, 16.9, 7.05, 17.35), (7.1, 19.4, 7.55, 19.8), (9.6, 18.6, 11.2, 19.4),
    (12.3, 16.0, 12.9, 18.4), (5.1, 15.1, 7.0, 15.55), (8.6, 20.1, 11.8, 20.5), (10.1, 17.9, 10.55, 18.35),
    # Lecture hall: benches in rows, two aisles, a stage in the west.
    (0.15, 26.6, 1.3, 29.85), (1.9, 27.6, 2.7, 28.6), (4.4, 23.2, 4.9, 25.0), (4.4, 26.4, 4.9, 28.9),
    (6.0, 23.2, 6.5, 25.0), (6.0, 26.4, 6.5, 28.9), (7.6, 23.2, 8.1, 25.0), (7.6, 26.4, 8.1, 28.9),
    (9.2, 23.2, 9.7, 25.0), (9.2, 26.4, 9.7, 28.0), (11.0, 20.7, 12.0, 21.2), (2.4, 20.7, 4.8, 21.1),
    # North laboratory and meeting room.
    (15.3, 16.4, 15.9, 19.8), (17.4, 17.4, 19.6, 18.6), (17.4, 20.4, 19.6, 21.4), (21.2, 18.6, 21.9, 22.0),
    (17.9, 16.9, 18.35, 17.3), (16.1, 21.9, 17.6, 22.4), (15.3, 20.6, 15.8, 21.6), (24.0, 18.0, 28.0, 19.4),
    (24.6, 17.4, 25.05, 17.85), (26.2, 17.4, 26.65, 17.85), (24.3, 19.55, 24.75, 20.0),
    (27.1, 19.55, 27.55, 20.0), (28.15, 18.4, 28.6, 18.85), (22.1, 16.4, 22.6, 18.2),
    (29.3, 15.9, 29.9, 18.6), (22.1, 21.9, 24.2, 22.4),
    # Rooms along the upper corridor: library with shelves, office.
    (17.6, 29.3, 20.2, 29.85), (15.3, 27.3, 15.8, 29.6), (17.8, 25.6, 19.4, 26.4),
    (18.4, 26.5, 18.85, 26.95), (20.9, 26.2, 21.4, 29.4), (22.6, 26.6, 23.1, 29.85),
    (24.3, 26.6, 24.8, 29.4), (26.0, 26.6, 26.5, 29.85), (27.9, 27.4, 28.7, 29.0),
    (29.4, 25.2, 29.85, 27.0), (25.4, 24.7, 27.6, 25.15),
    # Lobby: reception, sofas, a plant tub, a vending machine.
    (31.2, 18.6, 31.8, 21.2), (31.8, 20.6, 33.2, 21.2), (36.8, 15.1, 38.8, 15.8), (39.0, 16.2, 39.75, 17.6),
    (30.1, 15.9, 30.9, 16.8),
)  # fmt: skip

# Round things: centre x, y, radius [m]; columns, round tables, plants.
_DISCS = (
    (34.9, 19.2, 0.3), (34.9, 16.6, 0.3), (37.6, 17.2, 0.45), (33.9, 21.4, 0.3), (32.4, 10.2, 0.6),
    (35.6, 10.8, 0.55), (36.9, 9.2, 0.5), (31.6, 9.7, 0.22), (33.2, 10.7, 0.22), (35.1, 11.5, 0.22),
    (3.0, 23.2, 0.25), (10.6, 26.9, 0.25), (3.2, 29.4, 0.3), (23.4, 9.3, 0.3), (16.6, 10.4, 0.45),
    (3.2, 7.6, 0.3), (12.5, 29.5, 0.25), (28.6, 12.6, 0.2),
)  # fmt: skip


def draw_building() -> OccupancyMap:
    """Draw the same floor from the tables of this file; `save_map` of it is the shipped map."""
    shape = (round(EXTENT[1] / RESOLUTION), round(EXTENT[0] / RESOLUTION))
    rows, columns = np.indices(shape)
    x: Array = np.asarray((columns + 0.5) * RESOLUTION + ORIGIN[0], dtype=np.float64)
    y: Array = np.asarray((rows + 0.5) * RESOLUTION + ORIGIN[1], dtype=np.float64)
    corners = np.array(_OUTLINE)
    free = _inside(corners, x, y)
    occupied = np.zeros(shape, dtype=bool)

    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        occupied |= _stroke(x, y, x0, y0, x1, y1, _OUTER)
    for x0, y0, x1, y1 in _WALLS:
        occupied |= _stroke(x, y, x0, y0, x1, y1, _INNER)
    for x0, y0, x1, y1 in _SHAFTS:
        box = ((x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0))
        for segment in box:
            occupied |= _stroke(x, y, *segment, _INNER)
        free[_box(x0, y0, x1, y1)] = False
    for x0, y0, width, direction in (*((a, b, w, d) for a, b, w, d, _, _ in _DOORS), *_OPENINGS):
        half_x, half_y = (width / 2, _INNER / 2) if direction == "h" else (_INNER / 2, width / 2)
        occupied[_box(x0 - half_x, y0 - half_y, x0 + half_x, y0 + half_y)] = False
    for x0, y0, width, direction, side, end in _DOORS:
        hinge, tip = end * width / 2, side * width
        # The leaf stands beside the opening, one cell thick, so the opening keeps its width.
        across = sorted((hinge, hinge + end * RESOLUTION))
        along = sorted((side * _INNER / 2, tip))
        (u0, u1), (v0, v1) = (across, along) if direction == "h" else (along, across)
        occupied[_box(x0 + u0, y0 + v0, x0 + u1, y0 + v1)] = True
    for x0, y0, x1, y1 in _BOXES:
        occupied[_box(x0, y0, x1, y1)] = True
    for x0, y0, radius in _DISCS:
        occupied |= np.hypot(x - x0, y - y0) < radius
    return OccupancyMap(occupied, free & ~occupied, RESOLUTION, ORIGIN, "building")


def _box(x0: float, y0: float, x1: float, y1: float) -> tuple[slice, slice]:
    """Rows and columns covered by a box in metres, its sides rounded to cell borders."""
    left, right = (round((value - ORIGIN[0]) / RESOLUTION) for value in (x0, x1))
    bottom, top = (round((value - ORIGIN[1]) / RESOLUTION) for value in (y0, y1))
    return slice(bottom, top), slice(left, right)


def _stroke(x: Array, y: Array, x0: float, y0: float, x1: float, y1: float, width: float) -> BoolArray:
    """Cells nearer than half the width to a segment, with square ends along the axes."""
    if x0 == x1 or y0 == y1:
        half = width / 2
        filled = np.zeros(x.shape, dtype=bool)
        filled[_box(min(x0, x1) - half, min(y0, y1) - half, max(x0, x1) + half, max(y0, y1) + half)] = True
        return filled
    dx, dy = x1 - x0, y1 - y0
    along = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
    return np.asarray(np.hypot(x - x0 - along * dx, y - y0 - along * dy) < width / 2)


def _inside(corners: Array, x: Array, y: Array) -> BoolArray:
    """Points within a polygon (n, 2), by the even-odd rule."""
    inside = np.zeros(x.shape, dtype=bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


if __name__ == "__main__":
    save_map(CHECKOUT / "scenarios" / "simulation" / "building.yaml", draw_building())
