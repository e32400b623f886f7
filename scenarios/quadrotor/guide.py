"""Reference of the controller: a shortest way through what is known, at a speed that bends allow.

Space that has not been seen counts as free. The widest clearance that leaves a way is used. A way is kept as long as
it passes and no other is much shorter, so that small corrections of the map do not send the vehicle to and fro.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios.options import Positive, Settings
from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.planning.polyline import arc_lengths, at_stations, curvature, nearest_piece, path_length, resample
from unifg.scenarios.planning.visibility import Ways
from unifg.typing import Array

SPACING = 0.1  # [m] between points of a smoothed way
MOVED = 0.05  # [m]; a landmark that moved less leaves the way as it is
STRAYED = 0.6  # [m] from the way, beyond which it is planned again
SHORTER = 0.5  # [m] by which another way must be shorter
GIVE = 0.1  # [m] of the clearance that a kept way may have lost
SLOWEST = 0.3  # [m/s] at which a reference begins, so that a vehicle at rest is drawn along
SMOOTHING = 5  # points of a smoothing window


@dataclass(frozen=True)
class GuideSettings(Settings):
    """Settings of the reference.

    Attributes:
        speed: cruise [m/s].
        acceleration: along the way [m/s^2].
        lateral: acceleration in bends [m/s^2].
        climb: vertical speed [m/s].
        clearances: of the vehicle's centre from cylinders and walls [m], the one to be preferred first.
    """

    speed: Positive[float] = 2.0
    acceleration: Positive[float] = 2.0
    lateral: Positive[float] = 3.0
    climb: Positive[float] = 0.8
    clearances: Positive[tuple[float, ...]] = (0.6, 0.5, 0.42, 0.36)


@dataclass(frozen=True)
class Reference:
    """Positions and velocities at the nodes of the horizon.

    Attributes:
        positions: (N + 1, 3) [m].
        velocities: (N + 1, 3) [m/s].
        way: (P, 2) what they follow to the target [m].
        open: whether a way is known; otherwise the reference stays where the vehicle is.
    """

    positions: Array
    velocities: Array
    way: Array
    open: bool


class Guide:
    """Plans ways to one target and samples them.

    Attributes:
        target: (3,) [m].
    """

    def __init__(
        self,
        target: Array,
        walls: Array,
        settings: GuideSettings | None = None,
        bounds: Array | None = None,
    ) -> None:
        """Know the target (3,), the walls (W, 2, 2) and, if any, the bounds (2, 2) of where a way may lead [m]."""
        self.target, self.walls, self.bounds = np.asarray(target, dtype=np.float64), walls, bounds
        self.settings = settings or GuideSettings()
        self._discs = np.zeros((0, 3))
        self._way: Array | None = None
        self._ways: Ways | None = None

    def reference(self, state: Array, landmarks: Landmarks, count: int, dt: float) -> Reference:
        """The reference from the present state (10,) for ``count`` nodes ``dt`` [s] apart."""
        known = landmarks.cylinders
        discs = np.column_stack([known.positions, known.radii])
        position = state[:3]
        self._renew(position[:2], discs)
        way = self._way
        if way is None:
            still = np.tile(position, (count, 1))
            return Reference(still, np.zeros((count, 3)), position[None, :2], False)
        return self._sample(state, way, count, dt)

    def _renew(self, position: Array, discs: Array) -> None:
        """Plan again where the map has changed or the vehicle has left the way."""
        same = len(discs) == len(self._discs) and np.abs(discs - self._discs).max(initial=0.0) < MOVED
        if same and self._way is not None and nearest_piece(self._way, position)[2] < STRAYED:
            return
        if not same or self._ways is None:
            self._discs = discs
            another = self._widest(position)
        else:
            another = self._ways.way(position) if self._ways is not None else None
        kept = None if self._way is None else _onwards(self._way, position)
        if another is None or self._ways is None:
            self._way = None
        elif kept is None or not self._ways.passes(kept, GIVE) or path_length(another) < path_length(kept) - SHORTER:
            self._way = smoothed(another)

    def _widest(self, position: Array) -> Array | None:
        """The shortest way at the first clearance that leaves one."""
        for clearance in self.settings.clearances:
            self._ways = Ways(self.target[:2], self._discs, self.walls, clearance, self.bounds)
            found = self._ways.way(position)
            if found is not None:
                return found
        return None

    def _sample(self, state: Array, way: Array, count: int, dt: float) -> Reference:
        """Follow the way from beside the vehicle, as fast as it may."""
        s = self.settings
        arc = arc_lengths(way)
        piece, share, _ = nearest_piece(way, state[:2])
        begin = float(arc[piece] + share * (arc[piece + 1] - arc[piece]))
        tangent = np.gradient(way, arc, axis=0) if len(way) > 1 else np.zeros((1, 2))
        tangent /= np.maximum(np.hypot(*tangent.T), 1e-9)[:, None]
        along = at_stations(tangent, arc, np.array([begin]))[0]
        now = max(float(along @ state[7:9]), SLOWEST)
        stations = begin + np.linspace(0.0, arc[-1] - begin, max(2, 2 + int((arc[-1] - begin) / SPACING)))
        squared = np.minimum(self._allowed(way, arc, stations), now**2 + 2.0 * s.acceleration * (stations - begin))
        speed = np.sqrt(np.maximum(squared, 0.0))
        # Each piece is flown with constant acceleration.
        lengths = np.diff(stations)
        clock = np.concatenate([[0.0], np.cumsum(lengths / np.maximum(0.5 * (speed[1:] + speed[:-1]), 1e-2))])
        rising = np.diff(speed**2) / (2.0 * np.maximum(lengths, 1e-9))
        times = dt * np.arange(count)
        at = np.clip(np.searchsorted(clock, times, side="right") - 1, 0, len(lengths) - 1)
        since = np.minimum(times, clock[-1]) - clock[at]
        reached = np.minimum(stations[at] + speed[at] * since + 0.5 * rising[at] * since**2, stations[at + 1])
        rate = np.where(times < clock[-1], np.maximum(speed[at] + rising[at] * since, 0.0), 0.0)
        positions, velocities = np.zeros((count, 3)), np.zeros((count, 3))
        positions[:, :2] = at_stations(way, arc, reached)
        velocities[:, :2] = rate[:, None] * at_stations(tangent, arc, reached)
        rise = self.target[2] - state[2]
        climbed = np.clip(rise, -s.climb * times, s.climb * times)
        positions[:, 2] = state[2] + climbed
        velocities[:, 2] = np.where(np.abs(climbed) < abs(rise), np.sign(rise) * s.climb, 0.0)
        return Reference(positions, velocities, way, True)

    def _allowed(self, way: Array, arc: Array, stations: Array) -> Array:
        """Squares of the greatest speeds at stations, from the bends, the cruise and the stop at the end."""
        s = self.settings
        squared = np.minimum(s.speed**2, s.lateral / np.maximum(curvature(way, arc), 1e-6))
        squared[-1] = 0.0
        # What lies ahead must be reachable by braking.
        reachable = (
            np.minimum.accumulate((squared + 2.0 * s.acceleration * arc)[::-1])[::-1] - 2.0 * s.acceleration * arc
        )
        return np.interp(stations, arc, reachable)


def smoothed(way: Array) -> Array:
    """Points (Q, 2) ``SPACING`` apart on a polyline (P, 2), with its corners rounded; the ends stay."""
    length = path_length(way)
    if length < SPACING:
        return way[[0, -1]] if length > 0.0 else np.stack([way[0], way[0] + [1e-6, 0.0]])
    points = resample(way, SPACING)
    half = SMOOTHING // 2
    if len(points) <= 2 * half:
        return points
    # Odd reflection leaves straight pieces and the ends as they are.
    before, behind = 2.0 * points[0] - points[half:0:-1], 2.0 * points[-1] - points[-2 : -2 - half : -1]
    padded = np.concatenate([before, points, behind])
    kernel = np.full(SMOOTHING, 1.0 / SMOOTHING)
    return np.column_stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)])


def _onwards(way: Array, position: Array) -> Array:
    """Rest of a way, from ``position`` on."""
    at, _, _ = nearest_piece(way, position)
    return np.concatenate([position[None], way[at + 1 :]])
