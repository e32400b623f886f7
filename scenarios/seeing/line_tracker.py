"""Where do the moving discs go? A straight line through the last detections of each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from unifg.scenarios.seeing.association import places
from unifg.scenarios.seeing.readings import Reading
from unifg.scenarios.seeing.tracks import Tracks
from unifg.typing import Array

__all__ = ["LineTracker", "TrackerSettings"]


@dataclass(frozen=True)
class TrackerSettings:
    """How detections become tracks.

    Attributes:
        memory: age of the oldest detection that counts [s].
        patience: for which a track that is not seen goes on [s].
        least: detections before a velocity is believed; until then a disc stands.
        gate: greatest distance of a detection from where its track is expected [m]; for unknown association.
        speed_limit: greatest speed that is believed [m/s].
    """

    memory: float = 0.6
    patience: float = 1.5
    least: int = 6
    gate: float = 0.6
    speed_limit: float = 1.5


@dataclass
class _Track:
    name: int
    times: list[float] = field(default_factory=list)
    places: list[Array] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    line: tuple[Array, Array, float] = field(default_factory=lambda: (np.zeros(2), np.zeros(2), 0.0))

    def at(self, time: float) -> Array:
        """(2,) where it is expected [m]."""
        place, velocity, when = self.line
        expected: Array = place + (time - when) * velocity
        return expected


class LineTracker:
    """Tracks of what the sensor flags as moving, in the frame of the belief."""

    def __init__(self, settings: TrackerSettings | None = None, association: str = "known") -> None:
        """Begin without tracks; ``association`` "known" trusts the readings' names, "unknown" gates."""
        self.settings = settings or TrackerSettings()
        self._known = association == "known"
        self._tracks: list[_Track] = []
        self._count = 0

    def update(self, reading: Reading, state: Array) -> Tracks:
        """Take in a reading made at the believed state (10,); where the discs are now and how they move."""
        s, now = self.settings, reading.time
        rows = np.flatnonzero(reading.moving)
        seen = places(state, reading.bearings[rows], reading.ranges[rows])
        free = list(self._tracks)
        for row, place in zip(rows.tolist(), seen, strict=True):
            track = self._match(int(reading.ids[row]), place, now, free)
            track.times.append(now)
            track.places.append(place)
            track.radii.append(float(reading.radii[row]))
            self._fit(track, now)
        self._tracks = [track for track in self._tracks if now - track.times[-1] <= s.patience]
        if not self._tracks:
            return Tracks.none()
        return Tracks(
            centre=np.array([track.at(now) for track in self._tracks]),
            velocity=np.array([track.line[1] for track in self._tracks]),
            radius=np.array([np.mean(track.radii) for track in self._tracks]),
            identity=np.array([track.name for track in self._tracks], dtype=np.intp),
            unseen=np.array([now - track.times[-1] for track in self._tracks]),
            mover=np.ones(len(self._tracks), dtype=bool),
        )

    def _match(self, name: int, place: Array, now: float, free: list[_Track]) -> _Track:
        """The track a detection belongs to, taken from those that are free; otherwise a new one."""
        if self._known:
            fitting = [track for track in free if track.name == name]
        else:
            name, self._count = self._count, self._count + 1
            near = [(float(np.linalg.norm(track.at(now) - place)), track.name, track) for track in free]
            fitting = [track for gap, _, track in sorted(near, key=lambda row: row[:2]) if gap <= self.settings.gate]
        if fitting:
            free.remove(fitting[0])
            return fitting[0]
        self._tracks.append(_Track(name))
        return self._tracks[-1]

    def _fit(self, track: _Track, now: float) -> None:
        """Least squares of a constant velocity."""
        s = self.settings
        first = next(k for k, time in enumerate(track.times) if now - time <= s.memory)
        del track.times[:first], track.places[:first], track.radii[: max(0, len(track.radii) - 50)]
        if len(track.times) < s.least:
            track.line = np.mean(track.places, axis=0), np.zeros(2), now
            return
        times, places = np.array(track.times), np.array(track.places)
        middle, mean = times.mean(), places.mean(axis=0)
        away = times - middle
        velocity = away @ (places - mean) / (away @ away)
        velocity *= min(1.0, s.speed_limit / max(float(np.hypot(*velocity)), 1e-9))
        track.line = mean + (now - middle) * velocity, velocity, now
