"""Beams that the map explains, because they end near a surface; the others have met something new.

The share of those that are explained tells whether the robot is where it believes to be. The others are places that a
plan has to keep clear of, whatever shape they belong to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unifg.models.distance_map import DistanceMap
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array, IntArray

__all__ = ["Explained", "PointWatch", "explained"]

THRESHOLD = 0.13  # [m] from a mapped surface: noise of the beam, error of the pose, cells of the map
GROWTH = 0.015  # [rad]; error of the heading
FARTHEST = 10.0  # [m]
POINT_RANGE = 5.0  # [m]; points farther off are not planned with
BESIDE_DISC = 0.12  # [m] from the rim of a tracked disc, within which a point is part of it
AGAIN = 0.12  # [m] from a point of the scan before: what is seen once only may be clutter
APART = 0.12  # [m] between points that are kept
RADIUS = 0.03  # [m] of what stands for a point


@dataclass(frozen=True)
class Explained:
    """The end-points of a scan, those beams that came back from within 10 m.

    Attributes:
        points: (n, 2) world [m].
        ranges: (n,) [m].
        beams: (n,) their places in the scan.
        excess: (n,) by how much each is farther from the nearest surface than an end of a beam may be, in open space
            positive, inside of something negative [m].
        give: (n,) how far it may be [m].
    """

    points: Array
    ranges: Array
    beams: IntArray
    excess: Array
    give: Array

    @property
    def share(self) -> float:
        """Of the beams that the map explains; 0 where there are none."""
        known = (self.excess <= 0.0) & (self.excess >= -2.0 * self.give)
        return float(known.mean()) if len(known) else 0.0


def explained(distance_map: DistanceMap, scan: Scan, pose: Array) -> Explained:
    """Hold a scan, taken at a pose (3,) [m, m, rad], against the map."""
    beams = scan.within(FARTHEST)
    ranges, bearing = scan.ranges[beams], scan.angles[beams] + pose[2]
    points = pose[:2] + ranges[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    give = THRESHOLD + GROWTH * ranges
    excess = distance_map.distance(points) - give
    beyond = np.hypot(
        *(points - _clamped(distance_map, points)).T
    )  # of the map's edge, where the field goes on as it is
    return Explained(points, ranges, beams, np.where(beyond > give, beyond, excess), give)


def _clamped(distance_map: DistanceMap, points: Array) -> Array:
    """The places on the map nearest to points (n, 2) [m]."""
    height, width = distance_map.values.shape
    x, y, yaw = distance_map.origin
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    inside = np.clip((points - (x, y)) @ turn, 0.0, np.array([width, height]) * distance_map.resolution)
    clamped: Array = inside @ turn.T + (x, y)
    return clamped


class PointWatch:
    """Points that neither the map nor a tracked disc explains, seen in two scans in a row by neighbouring beams.

    Attributes:
        points: (k, 2) world, thinned out [m].
    """

    def __init__(self) -> None:
        """Begin with none."""
        self.points = np.zeros((0, 2))
        self._before = np.zeros((0, 2))

    def update(self, seen: Explained, tracks: Tracks, count: int) -> Array:
        """Take in a scan of ``count`` beams, with the discs that are tracked after it."""
        new = (seen.excess > 0.0) & (seen.ranges <= POINT_RANGE)
        points, beams = seen.points[new], seen.beams[new]
        beside = np.zeros(len(points), dtype=bool)
        if len(points) > 1:
            close = ((np.roll(beams, -1) - beams) % count <= 2) & (
                np.hypot(*(np.roll(points, -1, axis=0) - points).T) < 3.0 * APART
            )
            beside = close | np.roll(close, 1)
        points = points[beside]
        gaps = np.hypot(*np.moveaxis(points[:, None] - self._before[None], 2, 0))
        fresh = points[gaps.min(axis=1, initial=np.inf) <= AGAIN]
        self._before = points
        for centre, radius in zip(tracks.centre, tracks.radius.tolist(), strict=True):
            fresh = fresh[np.hypot(*(fresh - centre).T) > radius + BESIDE_DISC]
        self.points = thinned(fresh, APART)
        return self.points

    def tracks(self) -> Tracks:
        """The points as small discs that stand."""
        count = len(self.points)
        still = Tracks.of_movers(self.points, np.zeros((count, 2)), np.full(count, RADIUS))
        return replace(still, identity=-1 - still.identity, mover=np.zeros(count, dtype=bool))


def thinned(points: Array, apart: float) -> Array:
    """Of points (n, 2) one for each square of side ``apart`` [m] that holds any: the first."""
    _, first = np.unique(np.floor(points / apart).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]
