"""Clearance of the widest way between obstacles on the ground plane, exactly rather than on a grid.

A way of clearance c exists if start and target lie in the same component of the plane without the obstacles grown by
c. Grown discs and segments are convex, so their pairwise overlaps are connected and, by the nerve theorem, closed
curves in their union are sums (modulo 2) of cycles in the graph of overlapping pairs. Start and target are separated
exactly if one of these cycles winds around one of the two points and not around the other. Overlaps are added in the
order of their gaps, as Kruskal's algorithm adds edges; the gap that closes the first separating cycle is the
bottleneck, and half of it is the greatest clearance.
"""

from __future__ import annotations

import bisect
import itertools

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from unifg.scenarios.planning.polyline import segment_distance
from unifg.typing import Array, ArrayLike

__all__ = ["obstacle_distance", "widest_way"]


def obstacle_distance(points: Array, cylinders: Array, walls: Array) -> Array:
    """Distance from points to the nearest surface of an obstacle; negative inside a cylinder.

    Args:
        points: (n, 2) [m].
        cylinders: (M, 3) x, y, radius [m].
        walls: (W, 2, 2) segments [m].

    Returns:
        (n,) [m]; inf without obstacles.
    """
    to_cylinders = np.linalg.norm(points[:, None, :] - cylinders[None, :, :2], axis=2) - cylinders[None, :, 2]
    every = np.concatenate([to_cylinders, segment_distance(points, walls)], axis=1)
    nearest: Array = every.min(axis=1, initial=np.inf)
    return nearest


def widest_way(start: ArrayLike, target: ArrayLike, cylinders: Array, walls: Array) -> float:
    """Greatest clearance with which a point can go from start to target.

    A way of clearance c exists if and only if c is not greater than the value returned.

    Args:
        start: (2,) or (3,), of which x and y count [m].
        target: likewise.
        cylinders: (M, 3) x, y, radius [m].
        walls: (W, 2, 2) segments [m].

    Returns:
        Clearance [m]; at most that of start and target themselves, not positive if no way exists.
    """
    ends = np.stack([np.asarray(start, dtype=np.float64)[:2], np.asarray(target, dtype=np.float64)[:2]])
    # A cylinder's core is a segment of no length: discs and walls are then the same thing, a core with a radius.
    cores = np.concatenate([np.repeat(cylinders[:, None, :2], 2, axis=1), walls])
    radii = np.concatenate([cylinders[:, 2], np.zeros(len(walls))])
    open_ends = float(obstacle_distance(ends, cylinders, walls).min(initial=np.inf))
    edges: list[tuple[float, int, int, int]] = []
    for i, j in itertools.combinations(range(len(cores)), 2):
        first, second = _nearest_points(cores[i], cores[j])
        gap = float(np.linalg.norm(first - second) - radii[i] - radii[j])
        chain = np.stack([cores[i].mean(axis=0), first, second, cores[j].mean(axis=0)])
        edges.append((gap, i, j, _crossings(chain, ends)))
    edges.sort()
    closing = bisect.bisect_left(
        range(1, len(edges) + 1), True, key=lambda count: _separates(edges[:count], len(cores))
    )
    return min(open_ends, 0.5 * edges[closing][0]) if closing < len(edges) else open_ends


def _separates(edges: list[tuple[float, int, int, int]], count: int) -> bool:
    """Return True if a cycle of overlaps among ``count`` cores winds around one end alone.

    Edges lead from one copy of the graph to another where the crossings are odd: such a cycle joins both copies of a
    core.
    """
    _, one, other, odd = np.array(edges).astype(np.intp).T
    begins, ends = np.concatenate([one, one + count]), np.concatenate([other + count * odd, other + count * (1 - odd)])
    copies = coo_array((np.ones(len(begins)), (begins, ends)), shape=(2 * count, 2 * count))
    _, label = connected_components(copies, directed=False)
    return bool((label[:count] == label[count:]).any())


def _nearest_points(first: Array, second: Array) -> tuple[Array, Array]:
    """Points (2,) of two segments (2, 2) nearest to one another; the same point twice where they cross."""
    along, across = first[1] - first[0], second[1] - second[0]
    between = second[0] - first[0]
    turn = along[0] * across[1] - along[1] * across[0]
    if turn != 0.0:
        at = (between[0] * across[1] - between[1] * across[0]) / turn
        other = (between[0] * along[1] - between[1] * along[0]) / turn
        if 0.0 <= at <= 1.0 and 0.0 <= other <= 1.0:
            point = first[0] + at * along
            return point, point
    pairs = [(point, _project(point, second)) for point in first]
    pairs += [(_project(point, first), point) for point in second]
    return min(pairs, key=lambda pair: float(np.linalg.norm(pair[0] - pair[1])))


def _project(point: Array, segment: Array) -> Array:
    """Nearest point (2,) of a segment (2, 2)."""
    span = segment[1] - segment[0]
    along = float((point - segment[0]) @ span) / max(float(span @ span), 1e-300)
    nearest: Array = segment[0] + min(max(along, 0.0), 1.0) * span
    return nearest


def _crossings(chain: Array, ends: Array) -> int:
    """Parity of the crossings of a polyline (n, 2) with the rays from both ends (2, 2) along +x.

    Summed around a closed curve it is 1 exactly if the curve winds around one end and not around the other; no path
    between the ends is needed, and half-open intervals leave no special position.
    """
    count = 0
    for begin, end in itertools.pairwise(chain):
        for x, y in ends:
            if (begin[1] > y) != (end[1] > y):
                crossing = begin[0] + (y - begin[1]) / (end[1] - begin[1]) * (end[0] - begin[0])
                count += int(crossing > x)
    return count % 2
