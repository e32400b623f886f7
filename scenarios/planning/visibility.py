"""Shortest ways of a given clearance among discs and walls in the plane: a visibility graph around inflated bodies.

Discs grown by the clearance become polygons drawn around them, ends of walls likewise. Corners that see each other are
joined, and one run of Dijkstra's algorithm from the target gives the way from wherever the vehicle is.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from unifg.scenarios.planning.polyline import segment_distance
from unifg.typing import Array, BoolArray

DISC_CORNERS = 12
END_CORNERS = 8
TOUCH = 1e-6  # [m]; a way may touch what it passes
FARTHEST = -9999  # scipy's word for "no predecessor"


class Ways:
    """Ways to one target through one map.

    Attributes:
        clearance: kept from the surface of every disc and from every wall [m].
    """

    def __init__(
        self, target: Array, discs: Array, walls: Array, clearance: float, bounds: Array | None = None
    ) -> None:
        """Join all corners that see each other and measure their ways to the target.

        Args:
            target: (2,) [m].
            discs: (K, 3) x, y, radius [m].
            walls: (W, 2, 2) segments [m].
            clearance: [m].
            bounds: (2, 2) least and greatest x, y of where a way may lead [m]; None for anywhere.
        """
        self.clearance = clearance
        self._centres, self._reach = discs[:, :2], discs[:, 2] + clearance
        self._walls = walls
        ends = walls.reshape(-1, 2)
        discs_at, discs_out = _around(self._centres, self._reach, DISC_CORNERS)
        ends_at, ends_out = _around(ends, np.full(len(ends), clearance), END_CORNERS)
        nodes, outwards = np.concatenate([discs_at, ends_at]), np.concatenate([discs_out, ends_out])
        within = np.ones(len(nodes), dtype=bool)
        if bounds is not None:
            within = ((nodes >= bounds[0]) & (nodes <= bounds[1])).all(axis=1)
        within[within] = self._see(nodes[within], nodes[within])
        self._nodes = np.concatenate([target[None], nodes[within]])
        self._measure(np.concatenate([np.zeros((1, 2)), outwards[within]]))

    def _measure(self, outwards: Array) -> None:
        """Find the length of the shortest way from every corner to the target and the corner it leads to next.

        A shortest way bends around the corners it passes: only lines that touch the polygons at both ends count.
        """
        nodes = self._nodes
        count = len(nodes)
        first, second = np.triu_indices(count, 1)
        line = nodes[second] - nodes[first]
        length = np.hypot(*line.T)
        inwards = [np.abs((line * outwards[end]).sum(axis=1)) for end in (first, second)]
        touching = (np.maximum(*inwards) <= length + TOUCH) & (length > 0.0)
        first, second, length = first[touching], second[touching], length[touching]
        # The target, node 0, may lie too near to something.
        ours = int(np.searchsorted(first, 1))
        seen = np.concatenate(
            [
                self._see(nodes[first[:ours]], nodes[second[:ours]], nodes[0]),
                self._see(nodes[first[ours:]], nodes[second[ours:]]),
            ]
        )
        first, second, length = first[seen], second[seen], length[seen]
        edges = csr_array((length, (first, second)), shape=(count, count))
        self._remaining, self._next = dijkstra(edges, directed=False, indices=0, return_predecessors=True)

    def way(self, start: Array) -> Array | None:
        """The shortest way (P, 2) [m] from ``start`` (2,) to the target, both included; None when there is none.

        A start nearer to something than the clearance may only move away from it.
        """
        nodes = self._nodes
        reached = self._see(np.broadcast_to(start, nodes.shape), nodes, start)
        lengths = np.where(reached, self._remaining + np.hypot(*(nodes - start).T), np.inf)
        at = int(np.argmin(lengths))
        if not np.isfinite(lengths[at]):
            return None
        places = [start, nodes[at]]
        while (at := int(self._next[at])) != FARTHEST:
            places.append(nodes[at])
        return np.array(places)

    def passes(self, way: Array, slack: float) -> bool:
        """Return True if a way (P, 2), whose first point may be anywhere, keeps the clearance but for ``slack`` [m]."""
        return bool(self._see(way[:-1], way[1:], way[0], slack).all())

    def _see(self, first: Array, second: Array, start: Array | None = None, slack: float = TOUCH) -> BoolArray:
        """Flags of segments (n, 2) to (n, 2) that keep clear, from each body as far as ``start`` does itself."""
        reach, beside = self._reach, np.full(len(self._walls), self.clearance)
        if start is not None:
            reach = np.minimum(reach, np.hypot(*(self._centres - start).T))
            beside = np.minimum(beside, segment_distance(start[None], self._walls)[0])
        own, walls = np.stack([first, second], axis=1), self._walls
        spare = (segment_distance(self._centres, own).T - reach).min(axis=1, initial=np.inf)
        if len(walls):
            ends = [segment_distance(point, walls) for point in (first, second)]
            ends += [segment_distance(walls[:, k], own).T for k in (0, 1)]
            gap = np.where(_cross(own, walls), -np.inf, np.min(ends, axis=0))
            spare = np.minimum(spare, (gap - beside).min(axis=1))
        clear: BoolArray = spare > -slack
        return clear


def _cross(own: Array, walls: Array) -> BoolArray:
    """(n, W) whether segments (n, 2, 2) and walls (W, 2, 2) cross."""

    def side(line: Array, point: Array) -> Array:
        span, offset = line[..., 1, :] - line[..., 0, :], point - line[..., 0, :]
        return span[..., 0] * offset[..., 1] - span[..., 1] * offset[..., 0]

    a, b = own[:, None], walls[None]
    apart = (side(b, a[..., 0, :]) * side(b, a[..., 1, :]) > 0.0) | (
        side(a, b[..., 0, :]) * side(a, b[..., 1, :]) > 0.0
    )
    parallel = np.abs(side(b, a[..., 1, :]) - side(b, a[..., 0, :])) < 1e-12
    return ~apart & ~parallel


def _around(centres: Array, reach: Array, corners: int) -> tuple[Array, Array]:
    """Corners (K * corners, 2) of the regular polygons drawn around circles, and vectors out of them.

    The vectors are so long that a unit vector along a line through the corner that does not enter the polygon has a
    component of at most 1 along them.
    """
    angles = 2.0 * np.pi * (np.arange(corners) + 0.5) / corners
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    placed: Array = centres[:, None] + reach[:, None, None] * rays / np.cos(np.pi / corners)
    outwards = np.tile(rays / np.sin(np.pi / corners), (len(centres), 1))
    return placed.reshape(-1, 2), outwards
