"""Meshes for scenes: a map extruded into walls, ribbons and tubes where a browser draws hair-thin lines, boxes, rings.

A mesh is a pair (vertices (n, 3) [m], faces (m, 3)). Walls and boxes share no vertices, so that shading keeps edges
sharp.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.plots.shown import every
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = [
    "Mesh",
    "box",
    "column",
    "copies",
    "cover",
    "ellipse_axes",
    "extrude",
    "flat",
    "known_corners",
    "merge",
    "on_ground",
    "quads",
    "ribbon",
    "ring",
    "sphere",
    "strips",
    "thin",
    "tube",
    "wedge",
]

Mesh = tuple[Array, IntArray]

_WALLS_AROUND = 0.5  # [m]; thickness of outer walls that is still shown
_APART = 1e-4  # neighbours nearer than this are one point [m]


def cover(mask: BoolArray) -> IntArray:
    """Disjoint rectangles whose union is the mask: equal runs of neighbouring rows, merged.

    Args:
        mask: (H, W).

    Returns:
        (n, 4) rectangles (row_low, row_high, column_low, column_high) in cells, high ends exclusive.
    """
    padded = np.zeros((mask.shape[0], mask.shape[1] + 2), dtype=np.int8)
    padded[:, 1:-1] = mask
    steps = np.diff(padded, axis=1)
    finished: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], int] = {}
    for row in range(mask.shape[0] + 1):
        runs: list[tuple[int, int]] = []
        if row < mask.shape[0]:
            begins, ends = np.flatnonzero(steps[row] == 1), np.flatnonzero(steps[row] == -1)
            runs = list(zip(begins.tolist(), ends.tolist(), strict=True))
        still = {run: growing.get(run, row) for run in runs}
        finished += [(low, row, *run) for run, low in growing.items() if run not in still]
        growing = still
    return np.array(finished, dtype=np.intp).reshape(-1, 4)


def known_corners(occupancy: OccupancyMap) -> Array:
    """Corners (4, 2) [m] of the part of a map worth looking at, counter-clockwise.

    It holds the free cells and the walls around them: maps made by robots often have stray marks far outside.
    """
    free, known = np.argwhere(occupancy.free), np.argwhere(occupancy.occupied | occupancy.free)
    if not len(free):
        return occupancy.bounds
    margin = round(_WALLS_AROUND / occupancy.resolution)
    low_row, low_column = np.maximum(free.min(axis=0) - margin, known.min(axis=0))
    high_row, high_column = np.minimum(free.max(axis=0) + margin, known.max(axis=0)) + 1
    corners = [
        [low_column, low_row],
        [high_column, low_row],
        [high_column, high_row],
        [low_column, high_row],
    ]
    return occupancy.grid_to_world(np.array(corners, dtype=np.float64))


def flat(occupancy: OccupancyMap, mask: BoolArray, z: float) -> Mesh:
    """The cells of a mask as a level surface at height z [m]."""
    low_row, high_row, low_column, high_column = cover(mask).T
    corners = np.stack(
        [
            np.stack([low_column, low_row], axis=-1),
            np.stack([high_column, low_row], axis=-1),
            np.stack([high_column, high_row], axis=-1),
            np.stack([low_column, high_row], axis=-1),
        ],
        axis=1,
    )
    points = occupancy.grid_to_world(corners.astype(np.float64))
    return quads(np.concatenate([points, np.full((*points.shape[:2], 1), z)], axis=-1))


def extrude(occupancy: OccupancyMap, height: float) -> Mesh:
    """The occupied cells as solid walls from the floor up, without their undersides.

    Args:
        occupancy: the map.
        height: of the walls [m].

    Returns:
        Tops and sides in one mesh, sides merged along each straight run.
    """
    occupied = occupancy.occupied
    sides = [_edges(occupied, forward) for forward in (False, True)]
    turned = [_edges(occupied.T, forward)[:, ::-1, ::-1] for forward in (False, True)]
    ends = occupancy.grid_to_world(np.concatenate(sides + turned).astype(np.float64))
    low = np.concatenate([ends, np.zeros((len(ends), 2, 1))], axis=-1)
    high = np.concatenate([ends, np.full((len(ends), 2, 1), height)], axis=-1)
    walls = quads(np.concatenate([low, high[:, ::-1]], axis=1))
    return merge([flat(occupancy, occupied, height), walls])


def ribbon(points: Array, width: float, z: float) -> Mesh:
    """A level strip along a polyline.

    Args:
        points: (n, 2 or 3) [m], n >= 2; only x and y count, neighbours may coincide.
        width: of the strip [m].
        z: height of the strip [m].

    Returns:
        2 n vertices and 2 (n - 1) faces.
    """
    places = points[:, :2]
    tangent = np.gradient(places, axis=0)
    norm = np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.maximum(norm, 1e-9) * (width / 2.0)
    sides = np.stack([places - across, places + across], axis=1).reshape(-1, 2)
    faces = _repeat([[0, 2, 1], [1, 2, 3]], 2, len(places) - 1)
    return np.column_stack([sides, np.full(len(sides), z)]), faces


def ring(centre: Array, radius: float, width: float, z: float, corners: int = 16) -> Mesh:
    """A level ring of the given inner radius around (2,) [m]."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    vertices = np.stack([centre + radius * circle, centre + (radius + width) * circle], axis=1).reshape(-1, 2)
    faces = _repeat([[0, 1, 2], [1, 3, 2]], 2, corners)
    return np.column_stack([vertices, np.full(len(vertices), z)]), faces


def wedge(length: float, z: float) -> Mesh:
    """A level arrow head of that length [m] around the origin, pointing along x."""
    outline = np.array([[0.6, 0.0], [-0.4, 0.42], [-0.15, 0.0], [-0.4, -0.42]]) * length
    return np.column_stack([outline, np.full(4, z)]), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.intp)


def merge(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in meshes[:-1]])
    faces = [faces + offset for (_, faces), offset in zip(meshes, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def strips(lines: Array, width: float, crossed: bool) -> Mesh:
    """Straight lines (k, 2, 3) as level strips of that width [m]; crossed with upright ones to be seen from all sides.

    Returns:
        4 k or 8 k vertices, and faces.
    """
    along = lines[:, 1] - lines[:, 0]
    level = np.cross(along, [0.0, 0.0, 1.0])
    vertical = np.linalg.norm(level, axis=1, keepdims=True) < 1e-9 * np.linalg.norm(along, axis=1, keepdims=True)
    level = np.where(vertical, np.array([1.0, 0.0, 0.0]), level)
    sides = [level]
    if crossed:
        sides.append(np.cross(level, along))
    corners = []
    for side in sides:
        arm = 0.5 * width * side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
        # A little longer than the line: the joints of a bent path close.
        end = 0.5 * width * along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        low, high = lines[:, 0] - end, lines[:, 1] + end
        corners.append(np.stack([low - arm, low + arm, high + arm, high - arm], axis=1))
    return quads(np.concatenate(corners))


def tube(points: Array, radius: float, sides: int = 3) -> Mesh:
    """A tube of few sides along a polyline, open at its ends.

    Args:
        points: (n, 3) [m], n >= 2; neighbours may coincide.
        radius: [m].
        sides: of the cross section.

    Returns:
        ``sides`` n vertices and 2 ``sides`` (n - 1) faces.
    """
    tangent = np.gradient(points, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    # Any two directions across the tangent do, as long as they turn little from point to point.
    away = np.array([0.0, 0.0, 1.0]) if np.abs(tangent[:, 2]).max() < 0.9 else np.array([0.31, 0.95, 0.0])
    first = np.cross(away, tangent)
    norm = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(norm > 1e-6, first / np.maximum(norm, 1e-9), [0.0, 1.0, 0.0])
    second = np.cross(tangent, first)
    angles = np.pi / 2.0 + 2.0 * np.pi / sides * np.arange(sides)
    around = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    vertices = (points[:, None] + radius * around).reshape(-1, 3)
    faces = []
    for k in range(sides):
        after = (k + 1) % sides
        faces += [[k, after, sides + k], [after, sides + after, sides + k]]
    return vertices, _repeat(faces, sides, len(points) - 1)


def box(centre: ArrayLike, size: ArrayLike) -> Mesh:
    """A box (3,) [m] around a centre (3,) [m], its faces apart, so that shading keeps edges sharp."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.full((4, 3), sign)
            side[:, [(axis + 1) % 3, (axis + 2) % 3]] = signs if sign > 0.0 else signs[::-1]
            sides.append(side)
    return quads(np.asarray(centre) + 0.5 * np.asarray(size) * np.stack(sides))


def copies(mesh: Mesh, places: Array, turns: Array) -> Mesh:
    """A mesh again and again, as one.

    Args:
        mesh: around the origin, v vertices.
        places: (n, 3) [m].
        turns: (n, 3, 3), what its axes become there; they may stretch it.

    Returns:
        n v vertices.
    """
    vertices, faces = mesh
    every = np.einsum("nij,vj->nvi", turns, vertices) + places[:, None]
    step = len(vertices) * np.arange(len(places), dtype=np.intp)[:, None, None]
    return every.reshape(-1, 3), (faces + step).reshape(-1, 3)


def sphere(bands: int = 6, corners: int = 10) -> Mesh:
    """A sphere of radius 1 of few faces."""
    polar, around = np.linspace(0.0, np.pi, bands + 1), np.linspace(0.0, 2.0 * np.pi, corners + 1)[:-1]
    level = np.repeat(np.cos(polar), corners)
    reach = np.repeat(np.sin(polar), corners)
    turn = np.tile(around, bands + 1)
    vertices = np.column_stack([reach * np.cos(turn), reach * np.sin(turn), level])
    low = (corners * np.arange(bands)[:, None] + np.arange(corners)).ravel()
    after = (corners * np.arange(bands)[:, None] + (np.arange(corners) + 1) % corners).ravel()
    faces = np.concatenate(
        [np.stack([low, low + corners, after], axis=1), np.stack([after, low + corners, after + corners], axis=1)]
    )
    return vertices, faces


def column(corners: int = 48, bottom: float = 1.0) -> Mesh:
    """An upright cylinder of radius 1 from z = 0 to z = 1, or a cone below its top, which is apart from its side."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners + 1)
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(corners + 1)])
    up, low = np.array([0.0, 0.0, 1.0]), bottom * rim
    sides = quads(np.stack([low[:-1], low[1:], rim[1:] + up, rim[:-1] + up], axis=1))
    top = np.concatenate([up[None], rim[:-1] + up])
    step = np.arange(corners)
    fan = np.column_stack([np.zeros(corners, dtype=np.intp), step + 1, (step + 1) % corners + 1])
    return merge([sides, (top, fan)])


def on_ground(rows: Array) -> Array:
    """Places (n, 3) [m] on the ground of rows that begin with x and y."""
    return np.column_stack([rows[:, :2], np.zeros(len(rows))])


def thin(points: Array, most: int) -> Array:
    """At most that many of the points of a polyline, its ends among them, after repeated neighbours are left out."""
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > _APART
    kept: Array = points[np.concatenate([[True], apart])]
    return kept[every(len(kept), most)]


def ellipse_axes(covariance: Array, sigmas: float) -> tuple[float, float, float]:
    """Half axes [m] and direction of the longer one [rad] of a covariance (2, 2) [m^2] at some standard deviations."""
    variances, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    short, long = sigmas * np.sqrt(np.maximum(variances, 0.0))
    return float(long), float(short), math.atan2(vectors[1, 1], vectors[0, 1])


def quads(corners: Array) -> Mesh:
    """Quadrilaterals (n, 4, 3) as two triangles each."""
    return corners.reshape(-1, 3), _repeat([[0, 1, 2], [0, 2, 3]], 4, len(corners))


def _edges(solid: BoolArray, forward: bool) -> IntArray:
    """Edges (n, 2, 2), ends as (column, row), of solid runs that border the next or the previous row."""
    beyond = np.zeros_like(solid)
    if forward:
        beyond[:-1] = solid[1:]
    else:
        beyond[1:] = solid[:-1]
    padded = np.zeros((solid.shape[0], solid.shape[1] + 2), dtype=np.int8)
    padded[:, 1:-1] = solid & ~beyond
    steps = np.diff(padded, axis=1)
    rows, begins = np.nonzero(steps == 1)
    _, ends = np.nonzero(steps == -1)
    rows = rows + int(forward)
    return np.stack([np.stack([begins, rows], axis=-1), np.stack([ends, rows], axis=-1)], axis=1)


def _repeat(faces: list[list[int]], stride: int, count: int) -> IntArray:
    """The same faces ``count`` times, each time ``stride`` vertices on."""
    begin = stride * np.arange(count, dtype=np.intp)[:, None, None]
    return (begin + np.array(faces, dtype=np.intp)).reshape(-1, 3)
