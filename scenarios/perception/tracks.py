"""Discs followed over time: what both robots know of things that no map shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios.perception.rows import Rows
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["Tracks", "nearest"]


@dataclass(frozen=True)
class Tracks(Rows):
    """Obstacles the robot believes in, world frame.

    Attributes:
        centre: (m, 2) [m].
        velocity: (m, 2) [m/s]; zero for discs that stand still.
        radius: (m,) [m].
        identity: (m,) number of the track, kept for its lifetime.
        unseen: (m,) time since the track was last seen [s].
        mover: (m,) whether it has moved, and not stood in one place since for long; what stands now may go on.
    """

    centre: Array
    velocity: Array
    radius: Array
    identity: IntArray
    unseen: Array
    mover: BoolArray

    @classmethod
    def of_movers(cls, centre: Array, velocity: Array, radius: Array) -> Tracks:
        """Discs that move, numbered in their order and seen just now."""
        count = len(radius)
        return cls(centre, velocity, radius, np.arange(count), np.zeros(count), np.ones(count, dtype=bool))

    @classmethod
    def none(cls) -> Tracks:
        """Nothing has been seen."""
        return cls.of_movers(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))

    def expected_velocity(self, place: Array) -> Array:
        """(m, 2) velocities without what leads away from ``place`` (2,): a mover may turn round [m/s]."""
        towards = place - self.centre
        towards /= np.maximum(np.hypot(*towards.T), 1e-9)[:, None]
        leaving = np.minimum((self.velocity * towards).sum(axis=1), 0.0)
        velocity: Array = self.velocity - leaving[:, None] * towards
        return velocity


def nearest(tracks: Tracks, position: ArrayLike, count: int, horizon: float = 1.5) -> Tracks:
    """The tracks that matter most at a place: those whose hulls are, or will soon be, nearest to it.

    Args:
        tracks: all tracks.
        position: (2,) or (3,), of which x and y count [m].
        count: greatest number of tracks returned.
        horizon: how far ahead moving tracks are followed [s].

    Returns:
        At most ``count`` tracks, nearest first.
    """
    place = np.asarray(position, dtype=np.float64)[:2]
    offset = place - tracks.centre
    travel = horizon * tracks.velocity
    along = np.sum(offset * travel, axis=1) / np.maximum(np.sum(travel**2, axis=1), 1e-12)
    closest = offset - np.clip(along, 0.0, 1.0)[:, None] * travel
    hull = np.linalg.norm(closest, axis=1) - tracks.radius
    return tracks.at(np.argsort(hull, kind="stable")[:count])
