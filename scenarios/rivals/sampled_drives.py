"""Many drives at once, and where they stand beside a path: what planners that sample share."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.rivals.local_planner import Situation
from unifg.typing import Array

__all__ = ["driven", "nearest_on"]


def driven(pose: Array, controls: Array, dt: float) -> Array:
    """Poses (M, K + 1, 3) of M drives from one pose (3,) under controls (M, K, 2); headings are not wrapped."""
    states = np.empty((len(controls), controls.shape[1] + 1, 3))
    states[:, 0] = pose
    turn = dt * controls[..., 1]
    states[:, 1:, 2] = pose[2] + np.cumsum(turn, axis=1)
    middle, along = states[:, 1:, 2] - 0.5 * turn, dt * controls[..., 0]
    states[:, 1:, 0] = pose[0] + np.cumsum(along * np.cos(middle), axis=1)
    states[:, 1:, 1] = pose[1] + np.cumsum(along * np.sin(middle), axis=1)
    return states


def nearest_on(now: Situation, points: Array) -> tuple[Array, Array]:
    """How far points (M, 2) are from the nearest point of the reference, and what is left of it from there.

    Returns:
        (M,) and (M,) [m].
    """
    x, y = np.ascontiguousarray(points.T)
    closest, left = np.full(len(points), np.inf), np.zeros(len(points))
    arc = now.along()
    # One segment after the other: all at once is an array of a hundred thousand vectors, four times slower.
    for (bx, by), (sx, sy), passed, length in zip(
        now.reference[:-1, :2], np.diff(now.reference[:, :2], axis=0), arc, np.diff(arc), strict=False
    ):
        dx, dy = x - bx, y - by
        share = np.minimum(np.maximum((dx * sx + dy * sy) / max(length**2, 1e-18), 0.0), 1.0)
        gap = np.square(dx - share * sx) + np.square(dy - share * sy)
        closer = gap < closest
        closest = np.where(closer, gap, closest)
        left = np.where(closer, arc[-1] - (passed + share * length), left)
    return np.sqrt(closest), left
