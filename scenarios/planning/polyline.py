"""Polylines in the plane: distances to their pieces, arc lengths, and points and headings along them."""

from __future__ import annotations

import numpy as np

from unifg.typing import Array


def segment_distance(points: Array, segments: Array) -> Array:
    """Distances from points to segments.

    Args:
        points: (n, 2) [m].
        segments: (W, 2, 2) end points [m].

    Returns:
        (n, W) [m].
    """
    begin, span = segments[:, 0], segments[:, 1] - segments[:, 0]
    offset = points[:, None, :] - begin[None]
    length_squared = np.maximum(np.sum(span**2, axis=1), 1e-300)
    along = np.clip(np.sum(offset * span, axis=2) / length_squared, 0.0, 1.0)
    distance: Array = np.linalg.norm(offset - along[:, :, None] * span, axis=2)
    return distance


def polyline_distance(points: Array, path: Array) -> Array:
    """Distance from points to a polyline.

    Args:
        points: (n, 2) [m].
        path: (P, 2) or (P, 3) vertices; only x and y count [m]. One vertex is a point.

    Returns:
        (n,) distance to the nearest point of the polyline [m].
    """
    begin, end = (path[:, :2],) * 2 if len(path) == 1 else (path[:-1, :2], path[1:, :2])
    distance: Array = segment_distance(points, np.stack([begin, end], axis=1)).min(axis=1)
    return distance


def arc_lengths(points: Array) -> Array:
    """Arc length (P,) [m] at every point of a polyline (P, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def path_length(path: Array) -> float:
    """Length [m] of the polyline through the positions of (P, 2) points or (P, 3) poses."""
    return float(np.hypot(*np.diff(np.asarray(path, dtype=np.float64)[:, :2], axis=0).T).sum())


def at_stations(points: Array, arc: Array, stations: Array) -> Array:
    """Points (Q, k) at arc lengths (Q,) [m] of a polyline (P, k) whose own are ``arc`` (P,)."""
    return np.column_stack([np.interp(stations, arc, column) for column in points.T])


def resample(points: Array, spacing: float) -> Array:
    """Points (Q, 2) [m] about `spacing` [m] apart, evenly by arc length, on a polyline (P, 2)."""
    arc = arc_lengths(points)
    return at_stations(points, arc, np.linspace(0.0, arc[-1], max(1, round(arc[-1] / spacing)) + 1))


def headed(points: Array, goal_heading: float) -> Array:
    """Poses (P, 3) [m, m, rad] whose headings run along the points; the last heading is the goal's."""
    if path_length(points) < 1e-9:
        return np.column_stack([points, np.full(len(points), goal_heading)])
    along = np.gradient(points, axis=0)
    headings = np.arctan2(along[:, 1], along[:, 0])
    headings[-1] = goal_heading
    return np.column_stack([points, headings])


def nearest_piece(points: Array, position: Array) -> tuple[int, float, float]:
    """Piece of a polyline (P, 2) nearest to a position (2,), the share of it up to there, and how far it is [m]."""
    begin, span = points[:-1], np.diff(points, axis=0)
    share = np.clip(((position - begin) * span).sum(axis=1) / np.maximum((span**2).sum(axis=1), 1e-18), 0.0, 1.0)
    gap = np.hypot(*(begin + share[:, None] * span - position).T)
    at = int(np.argmin(gap))
    return at, float(share[at]), float(gap[at])


def curvature(points: Array, arc: Array) -> Array:
    """(P,) [1/m], at every point of a polyline with arc lengths (P,): turn of its two pieces over half their length."""
    if len(points) < 3:
        return np.zeros(len(points))
    span = np.diff(points, axis=0)
    heading = np.unwrap(np.arctan2(span[:, 1], span[:, 0]))
    bend = np.abs(np.diff(heading)) / np.maximum(0.5 * (arc[2:] - arc[:-2]), 1e-6)
    return np.concatenate([[0.0], bend, [0.0]])
