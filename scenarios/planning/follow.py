"""The moving reference that a controller follows along a path of poses."""

from __future__ import annotations

import math

import numpy as np

from unifg.lie import wrap_angle
from unifg.scenarios.planning.polyline import arc_lengths, at_stations
from unifg.typing import Array, ArrayLike

RELEASE = 0.1  # [m] before a change of sense, where what comes after it is followed
LEVER = 0.3  # [m/rad], of a heading beside a path that was planned with headings
WINDOW = 2.0  # ahead of the last arc length, where the robot is looked for [m]; so short, a path may cross itself


class PathFollower:
    """The point of a path nearest to a robot that only moves forward, and the poses ahead of it.

    A path with a spacing was planned with its headings: it may lead on in reverse, which it is followed to only once
    the robot is where its sense changes, and it may turn on the spot.

    Attributes:
        path: (P, 3) [m, m, rad].
        length: [m].
    """

    def __init__(self, path: ArrayLike, spacing: float = 0.0) -> None:
        """Measure the path.

        Args:
            path: (P, 3) poses [m, m, rad], P >= 2.
            spacing: between its poses, as metres at full speed, of a path planned with its headings; 0 for others.
        """
        self.path: Array = np.array(path, dtype=np.float64)
        count = len(self.path)
        self._arc = arc_lengths(self.path[:, :2])
        if spacing:
            self._arc = spacing * np.arange(count, dtype=np.float64)
        self.length = float(self._arc[-1])
        # The goal's heading belongs to the goal alone: on the way there the heading stays that of the path.
        last = self.path[-1 if spacing else -2, 2]
        self._headings: Array = np.unwrap(np.append(self.path[:-1, 2], last))
        self._places = np.column_stack([self.path[:, :2], (LEVER if spacing else 0.0) * self._headings])
        self._lever, self._gates = LEVER if spacing else 0.0, np.array([self.length])
        self._lengths = np.diff(self._arc)
        self._norms = np.linalg.norm(np.diff(self._places, axis=0), axis=1) if spacing else self._lengths
        if spacing:
            way, heading = np.diff(self.path[:, :2], axis=0), self.path[:-1, 2]
            ahead = way[:, 0] * np.cos(heading) + way[:, 1] * np.sin(heading)
            moving = np.flatnonzero(np.abs(ahead) > 0.1 * spacing)
            turned = np.sign(ahead[moving[1:]]) != np.sign(ahead[moving[:-1]])
            self._gates = np.append(self._arc[moving[1:][turned]], self.length)

    def _gate(self, reached: float) -> float:
        """Arc length [m] of the next change of sense, or of the end, from an arc length on."""
        beyond = self._gates[self._gates > reached + RELEASE]
        return float(beyond[0]) if len(beyond) else self.length

    def project(self, position: ArrayLike, start_arclength: float = 0.0) -> float:
        """Arc length [m] of the nearest point between `start_arclength` and the window's end.

        Args:
            position: (2,) or (3,) [m] of the robot.
            start_arclength: arc length reached before [m]; the result is never less.
        """
        begin = min(max(start_arclength, 0.0), self.length)
        first = min(int(np.searchsorted(self._arc, begin, side="right")) - 1, len(self._arc) - 2)
        last = int(np.searchsorted(self._arc, min(begin + WINDOW, self._gate(begin))))
        last = min(max(last, first + 1), len(self._arc) - 1)
        tail, head = self._places[first:last], self._places[first + 1 : last + 1]
        span = head - tail
        length, norm = self._lengths[first:last], np.maximum(self._norms[first:last], 1e-12)
        place = np.zeros(3)
        place[: np.size(position)] = position
        near = float(self._headings[first])
        place[2] = self._lever * (near + wrap_angle(place[2] - near))
        offset = place - tail
        along = np.einsum("ij,ij->i", offset, span) / norm * (length / norm)
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
        stations: Array = reached + ahead
        np.minimum(stations, self._gate(reached), out=stations)
        poses = at_stations(np.column_stack([self.path[:, :2], self._headings]), self._arc, stations)
        poses[stations >= self.length - 1e-9] = self.path[-1]
        poses[:, 2] = (poses[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
        return poses, reached
