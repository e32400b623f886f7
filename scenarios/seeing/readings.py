"""What the sensors return: one turn of the lidar, and one reading of the quadrotor's sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Reading", "Scan"]


@dataclass(frozen=True)
class Scan:
    """One turn of the lidar, taken at one instant.

    Attributes:
        angles: (B,) beam directions in the body frame [rad].
        ranges: (B,) measured ranges [m]; NaN is a dropout, +inf means nothing within the lidar's range.
        time: when it was taken [s]; NaN where the sensor does not say.
    """

    angles: Array
    ranges: Array
    time: float = math.nan

    @property
    def valid(self) -> BoolArray:
        """(B,) True for beams that came back."""
        returned: BoolArray = np.isfinite(self.ranges)
        return returned

    def endpoints(self) -> Array:
        """(n, 2) body-frame points [m] of the n beams that came back, in beam order."""
        keep = self.valid
        angles, ranges = self.angles[keep], self.ranges[keep]
        return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)


@dataclass(frozen=True)
class Reading:
    """Everything measured at one instant; K things are seen, in the order of their ids.

    Attributes:
        time: [s].
        ids: (K,) true names: cylinders first, then corners, then movers. For known association only.
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
