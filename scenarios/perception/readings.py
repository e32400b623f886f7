"""Measurements: one turn of the lidar, and one reading of the quadrotor's sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unifg.lie import SE2, wrap_angle
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["NOTHING", "Reading", "Scan"]


NOTHING = -1  # name of a false sighting
GAP = 0.1  # [rad] between measurements, within which nothing is expected to hide


@dataclass(frozen=True)
class Scan:
    """One turn of the lidar.

    Attributes:
        angles: (B,) beam directions in the body frame, rising [rad].
        ranges: (B,) measured ranges [m]; NaN is a dropout, +inf means nothing within the lidar's range.
        time: when its last beam was taken [s]; None where the sensor does not say.
        turn: for how long the beams were taken, one after the other [s]; 0 for all at one instant.
    """

    angles: Array
    ranges: Array
    time: float | None = None
    turn: float = 0.0

    @property
    def spacing(self) -> float:
        """Angle between neighbouring beams [rad]."""
        return float(np.median(np.diff(self.angles))) if len(self.angles) > 1 else 2.0 * math.pi

    @property
    def closed(self) -> bool:
        """Test whether the last beam is the neighbour of the first: a field of view of a full turn."""
        return bool(self.angles[-1] - self.angles[0] + 1.5 * self.spacing > 2.0 * math.pi)

    @property
    def unseen(self) -> Array:
        """(k, 2) begin and width of the sectors that no beam has looked into [rad].

        They are outside of the field of view, or their beams are lost. Sectors narrower than 0.1 rad, and than three
        beams, are left out.
        """
        seen = np.sort(self.angles[~np.isnan(self.ranges)])
        if not len(seen):
            return np.array([[-math.pi, 2.0 * math.pi]])
        width = np.diff(seen, append=seen[0] + 2.0 * math.pi)
        wide = width > max(GAP, 3.5 * self.spacing)
        return np.column_stack([seen[wide], width[wide]])

    @property
    def blind(self) -> float:
        """Width of the widest sector within the field of view whose beams are all lost [rad]."""
        lost = np.isnan(self.ranges)
        if lost.all():
            return float(len(lost) * self.spacing)
        turned = np.roll(lost, -int(np.argmin(lost))) if self.closed else lost
        ends = np.flatnonzero(~np.concatenate([[False], turned, [False]]))
        return float((np.diff(ends).max() - 1) * self.spacing)

    def deskewed(self, velocity: Array) -> Scan:
        """The scan as it would look from where the last beam was taken.

        Args:
            velocity: (k,) body velocities of the lidar during the turn: forward and turning, of one that slides
                sideways between them [m/s, rad/s].
        """
        if not self.turn or not velocity.any():
            return self
        count = len(self.angles)
        since = self.turn * (np.arange(count) - (count - 1)) / count
        motion = since[:, None] * np.array([*velocity[:-1], *[0.0] * (3 - len(velocity)), velocity[-1]])
        poses = SE2.exp(motion)
        ranges = np.where(self.valid, self.ranges, 1.0)
        points = SE2.act(poses, ranges[:, None] * np.column_stack([np.cos(self.angles), np.sin(self.angles)]))
        bearing = np.where(self.valid, np.arctan2(points[:, 1], points[:, 0]), self.angles + poses[:, 2])
        # Nearly the old directions, and rising as they did: not wrapped anew.
        angles = self.angles + wrap_angle(bearing - self.angles)
        return replace(self, angles=angles, ranges=np.where(self.valid, np.hypot(*points.T), self.ranges), turn=0.0)

    def within(self, reach: float) -> IntArray:
        """Indices of the beams that came back from within a distance [m]."""
        return np.flatnonzero(self.ranges <= reach)

    @property
    def valid(self) -> BoolArray:
        """(B,) True for beams that came back."""
        return np.isfinite(self.ranges)


@dataclass(frozen=True)
class Reading:
    """Everything measured at one instant; K things are seen, in the order of their ids.

    Attributes:
        time: [s].
        ids: (K,) true names: cylinders first, then corners, then movers, `NOTHING` of false sightings. For known
            association only.
        bearings: (K,) in the ground plane from the heading (of R e1) to the axis or corner, in [-pi, pi) [rad].
        ranges: (K,) in the ground plane to the axis or corner [m].
        radii: (K,) of the cylinders [m]; 0 for corners.
        kinds: (K,) ``Landmarks.CYLINDER`` or ``Landmarks.CORNER``.
        moving: (K,) True for what moves by design. For known association only.
        height: above the floor [m].
        tilt: (3,) R' e3, the world's vertical in the body; not normalised.
        rates: (3,) mean body rates over the last step [rad/s]; of a vehicle at rest before the first.
        force: (3,) mean specific force in the body over the last step [m/s^2]: acceleration without gravity's.
    """

    time: float
    ids: IntArray
    bearings: Array
    ranges: Array
    radii: Array
    kinds: IntArray
    moving: BoolArray
    height: float
    tilt: Array
    rates: Array
    force: Array

    def only(self, rows: IntArray | BoolArray) -> Reading:
        """The reading with some of its sightings, by indices or flags (K,)."""
        names = ("ids", "bearings", "ranges", "radii", "kinds", "moving")
        chosen: dict[str, Any] = {name: np.asarray(getattr(self, name))[rows] for name in names}
        return replace(self, **chosen)
