"""The moving reference that a controller follows along a path of poses."""

from __future__ import annotations

import math

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.planning.polyline import arc_lengths, at_stations
from unifg.typing import Array, ArrayLike

WINDOW = 2.0  # ahead of the last arc length, where the robot is looked for [m]; so short, a path may cross itself


class PathFollower:
    """The point of a path nearest to a robot that only moves forward, and the poses ahead of it.

    Attributes:
        path: (P, 3) [m, m, rad].
        length: [m].
    """

    def __init__(self, path: ArrayLike) -> None:
        """Measure the path.

        Args:
            path: (P, 3) poses [m, m, rad], P >= 2.
        """
        self.path: Array = np.array(path, dtype=np.float64)
        if self.path.ndim != 2 or self.path.shape[1] != 3 or len(self.path) < 2:
            raise ScenarioError(f"path of shape {self.path.shape}: at least two poses (P, 3) are needed")
        self._arc = arc_lengths(self.path[:, :2])
        self.length = float(self._arc[-1])
        # The goal's heading belongs to the goal alone: on the way there the heading stays that of the path.
        self._headings: Array = np.unwrap(np.append(self.path[:-1, 2], self.path[-2, 2]))

    def project(self, position: ArrayLike, start_arclength: float = 0.0) -> float:
        """Arc length [m] of the nearest point between `start_arclength` and the window's end.

        Args:
            position: (2,) or (3,) [m] of the robot.
            start_arclength: arc length reached before [m]; the result is never less.
        """
        begin = min(max(start_arclength, 0.0), self.length)
        first = min(int(np.searchsorted(self._arc, begin, side="right")) - 1, len(self._arc) - 2)
        last = min(int(np.searchsorted(self._arc, begin + WINDOW)), len(self._arc) - 1)
        tail, head = self.path[first:last, :2], self.path[first + 1 : last + 1, :2]
        span = head - tail
        length = self._arc[first + 1 : last + 1] - self._arc[first:last]
        offset = np.asarray(position, dtype=np.float64)[:2] - tail
        along = np.einsum("ij,ij->i", offset, span) / np.maximum(length, 1e-12)
        along = np.clip(along, np.maximum(begin - self._arc[first:last], 0.0).clip(max=length), length)
        miss = offset - (along / np.maximum(length, 1e-12))[:, None] * span
        nearest = int(np.argmin(np.einsum("ij,ij->i", miss, miss)))
        return min(max(begin, float(self._arc[first + nearest] + along[nearest])), self.length)

    def reference(self, position: ArrayLike, ahead: Array, start_arclength: float = 0.0) -> tuple[Array, float]:
        """Poses ahead of the robot, beginning at its projection on the path.

        Args:
            position: (2,) or (3,) [m] of the robot.
            ahead: (count,) arc lengths from the projection on, not decreasing [m].
            start_arclength: arc length returned by the previous call [m].

        Returns:
            (count, 3) poses [m, m, rad], headings along the path and wrapped to [-pi, pi), at the end of the
            path the goal's pose repeated; and the arc length [m] of the projection, to be handed to the next
            call.
        """
        reached = self.project(position, start_arclength)
        stations = reached + ahead
        poses = at_stations(np.column_stack([self.path[:, :2], self._headings]), self._arc, stations)
        poses[stations >= self.length - 1e-9] = self.path[-1]
        poses[:, 2] = (poses[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
        return poses, reached
