"""Discs followed over time: what both robots know of things that no map shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from unifg.scenarios.perception.rows import Rows
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["Tracks", "nearest", "to_and_fro"]

Number: TypeAlias = Array | float


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
        sweep: (m, 6) of a mover both ends of where it was lately [m], and if it is known to go to and fro between them
            the way it has made of a round trip from the first [m], and its speed [m/s]; else not a number.
        wave: (m, 6) the same of one that may go to and fro; not a number where nothing like that was seen.
        weights: (m, 4) of a mover: that it goes to and fro, goes on, stands; and that it yields, whichever it does.
    """

    centre: Array
    velocity: Array
    radius: Array
    identity: IntArray
    unseen: Array
    mover: BoolArray
    sweep: Array = field(default_factory=lambda: np.zeros((0, 6)))
    wave: Array = field(default_factory=lambda: np.zeros((0, 6)))
    weights: Array = field(default_factory=lambda: np.zeros((0, 4)))

    def __post_init__(self) -> None:
        """Know no motion but going on unless it is given."""
        unknown = np.full(6, np.nan)
        for name, row in (("sweep", unknown), ("wave", unknown), ("weights", np.array([0.0, 1.0, 0.0, 0.0]))):
            if len(getattr(self, name)) < len(self.radius):
                object.__setattr__(self, name, np.tile(row, (len(self.radius), 1)))

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

    @property
    def sweeps(self) -> BoolArray:
        """(m,) whether it is known to go to and fro, and where."""
        return np.isfinite(self.sweep[:, 5])

    def swept(self, times: Array) -> Array:
        """(N, m, 2) places of movers that go to and fro at times (N,) from now [m]."""
        first, last, made, speed = np.split(self.sweep, [2, 4, 5], axis=1)
        length = np.hypot(*(last - first).T)
        along = to_and_fro(0.0, length, made[:, 0], speed[:, 0], times[:, None])
        places: Array = first + (along / length)[..., None] * (last - first)
        return places

    def beside(self, place: Array) -> Array:
        """(..., m, 2) places nearest to ``place`` (..., 2) where movers were lately; their centres if unknown."""
        first, way = self.sweep[:, :2], self.sweep[:, 2:4] - self.sweep[:, :2]
        length = np.maximum((way**2).sum(axis=1), 1e-12)
        share = np.clip(((place[..., None, :] - first) * way).sum(axis=-1) / length, 0.0, 1.0)
        return np.where(np.isnan(self.sweep[:, :1]), self.centre, first + share[..., None] * way)


def to_and_fro(first: Number, last: Number, made: Number, speed: Number, times: Number) -> Array:
    """Places on a line at times from now [s] of what goes to and fro there, ``made`` past the first end [m]."""
    way = (made + speed * times) % (2.0 * (last - first))
    return first + np.minimum(way, 2.0 * (last - first) - way)


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
    closest = np.where(tracks.sweeps[:, None], place - tracks.beside(place), closest)
    hull = np.linalg.norm(closest, axis=1) - tracks.radius
    return tracks.at(np.argsort(hull, kind="stable")[:count])
