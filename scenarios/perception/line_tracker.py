"""Tracks of moving discs: a straight line through the last detections of each.

A sensor that names what it sees says what moves, too. Of one that does not every cylinder is followed, and moves once a
line through its last places is steeper than their scatter explains.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from unifg.scenarios.perception.association import places
from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.perception.confirmation import Confirmation
from unifg.scenarios.perception.readings import NOTHING, Reading
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array, IntArray

__all__ = ["LineTracker"]


MEMORY, WATCH = 0.6, 1.0  # [s]; age of the oldest detection that counts, and that tells whether a disc moves
PATIENCE = 1.5  # [s] for which a track that is not seen goes on
LEAST = 6  # detections before a velocity is believed; until then a disc stands
GATE = 0.6  # [m] of a detection from where its track is expected, at most; for unknown association
APART = 0.3  # [m] of a detection from the others of its track, at most; in clutter
SPEED_LIMIT, SLOWEST = 1.5, 0.2  # [m/s] that is believed, and of what moves: corrections make all things seem to
SURE = 5.0  # standard deviations from rest beyond which it does


@dataclass
class _Track:
    name: int
    times: list[float] = field(default_factory=list)
    places: list[Array] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    moves: bool = False
    line: tuple[Array, Array, float] = field(default_factory=lambda: (np.zeros(2), np.zeros(2), 0.0))

    def at(self, time: float) -> Array:
        """(2,) where it is expected [m]."""
        place, velocity, when = self.line
        return place + (time - when) * velocity


class LineTracker:
    """Tracks of what moves, in the frame of the belief."""

    def __init__(self, association: str = "known", confirmation: tuple[int, int] = (1, 1)) -> None:
        """Begin without tracks.

        Args:
            association: "known" trusts the readings' names and flags, "unknown" finds out.
            confirmation: M and N: where it is unknown, cylinders are told of once M of the last N readings show them.
        """
        self._confirmation, self._cluttered = Confirmation(*confirmation), confirmation[0] > 1
        self._known = association == "known"
        self._tracks: list[_Track] = []
        self._count = 0

    def told(self, reading: Reading, state: Array) -> Reading:
        """The reading as a vehicle may know it, without false sightings, as far as these are told apart.

        For unknown association it has names and flags that were found out.

        Args:
            reading: as the sensor gives it.
            state: (10,) predicted for its time.
        """
        if self._known:
            return reading.only(reading.ids != NOTHING)
        rows = np.flatnonzero(reading.kinds == Landmarks.CYLINDER)
        tracks = self._follow(reading, state, rows)
        names, moving = np.full(len(reading.ids), -1, dtype=np.intp), np.zeros(len(reading.ids), dtype=bool)
        names[rows] = [track.name for track in tracks]
        moving[rows] = [track.moves for track in tracks]
        self._confirmation.note(names)
        counts = reading.kinds != Landmarks.CYLINDER
        counts[rows] = [self._confirmation.holds(track.name) and not self._false(track) for track in tracks]
        return replace(reading, ids=names, moving=moving).only(counts)

    def _false(self, track: _Track) -> bool:
        """Test whether, in clutter, the last detection of a track that stands is far from where most of them are."""
        if track.moves or not self._cluttered:
            return False
        return float(np.linalg.norm(track.places[-1] - np.median(track.places, axis=0))) > APART

    def update(self, reading: Reading, state: Array) -> Tracks:
        """Tracks of the discs that move, now.

        Args:
            reading: as it was :meth:`told`.
            state: (10,) believed at its time.
        """
        now = reading.time
        if self._known:
            for track in self._follow(reading, state, np.flatnonzero(reading.moving)):
                track.moves = True
        self._tracks = [track for track in self._tracks if now - track.times[-1] <= PATIENCE]
        moving = [track for track in self._tracks if track.moves]
        if not moving:
            return Tracks.none()
        return Tracks(
            centre=np.array([track.at(now) for track in moving]),
            velocity=np.array([track.line[1] for track in moving]),
            radius=np.array([np.mean(track.radii) for track in moving]),
            identity=np.array([track.name for track in moving], dtype=np.intp),
            unseen=np.array([now - track.times[-1] for track in moving]),
            mover=np.ones(len(moving), dtype=bool),
        )

    def _follow(self, reading: Reading, state: Array, rows: IntArray) -> list[_Track]:
        """The tracks of some detections (r,), each taken in."""
        now, free, followed = reading.time, list(self._tracks), []
        for row, place in zip(rows.tolist(), places(state, reading.bearings[rows], reading.ranges[rows]), strict=True):
            track = self._match(int(reading.ids[row]), place, now, free)
            track.times.append(now)
            track.places.append(place)
            track.radii.append(float(reading.radii[row]))
            self._fit(track, now)
            followed.append(track)
        return followed

    def _match(self, name: int, place: Array, now: float, free: list[_Track]) -> _Track:
        """The track a detection belongs to, taken from those that are free; otherwise a new one."""
        if self._known:
            fitting = [track for track in free if track.name == name]
        else:
            name, self._count = self._count, self._count + 1
            near = [(float(np.linalg.norm(track.at(now) - place)), track.name, track) for track in free]
            fitting = [track for gap, _, track in sorted(near, key=lambda row: row[:2]) if gap <= GATE]
        if fitting:
            free.remove(fitting[0])
            return fitting[0]
        self._tracks.append(_Track(name))
        return self._tracks[-1]

    def _fit(self, track: _Track, now: float) -> None:
        """Least squares of a constant velocity."""
        kept = MEMORY if self._known else max(MEMORY, WATCH)
        first = next(k for k, time in enumerate(track.times) if now - time <= kept)
        del track.times[:first], track.places[:first], track.radii[: max(0, len(track.radii) - 50)]
        if not self._known and not track.moves and len(track.times) >= LEAST:
            _, _, velocity, sigma = _line(track.times, track.places)
            track.moves = float(np.hypot(*velocity)) > max(SLOWEST, SURE * sigma)
        late = next(k for k, time in enumerate(track.times) if now - time <= MEMORY)
        times, places = track.times[late:], track.places[late:]
        if len(times) < LEAST:
            track.line = np.mean(places, axis=0), np.zeros(2), now
            return
        middle, mean, velocity, _ = _line(times, places)
        velocity *= min(1.0, SPEED_LIMIT / max(float(np.hypot(*velocity)), 1e-9))
        track.line = mean + (now - middle) * velocity, velocity, now


def _line(times: list[float], places: list[Array]) -> tuple[float, Array, Array, float]:
    """Mean time [s] and place (2,) [m], velocity (2,) by least squares, and its standard deviation per axis [m/s]."""
    moments, positions = np.array(times), np.array(places)
    middle, mean = moments.mean(), positions.mean(axis=0)
    away = moments - middle
    weight = float(away @ away)
    velocity = away @ (positions - mean) / weight
    left = positions - mean - away[:, None] * velocity
    scatter = float(np.sqrt(np.square(left).sum() / (2 * len(moments) - 4)))
    return float(middle), mean, velocity, scatter / float(np.sqrt(weight))
