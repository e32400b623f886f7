"""Assumptions of a drive, checked on its log against the true world, and the cause of every contact.

At each tick a ground robot relies on a way out, driven if nothing better is found, and on assumptions under which it
touches nothing: movers keep within their bounds, the true pose lies within k standard deviations and a clearance of the
estimate, walls are on the map or seen, space that no beam has looked into is free, brakes work as the data sheet says,
and nothing runs into a robot at rest (passive safety: Macek, Vasquez, Fraichard and Siegwart, "Towards safe vehicle
navigation in dynamic urban scenarios", 2009). `judged` finds where one was broken. A contact is attributed to what was
broken first in the time in which it could have been avoided, and to the robot where nothing was, or where the way out
had met a known wall before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2
from unifg.models.distance_map import DistanceMap
from unifg.models.planar import base_of
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.typing import Array, BoolArray

__all__ = ["FAULT", "Broken", "Contact", "Judgement", "judged"]

FAULT = "fault of the robot"
BREAKS = "assumption broken"
NEAR = 3.0  # [m] from the robot, within which a disc is judged
ALIKE = 0.1  # [m] between the hulls of a disc and of its track
BRAKES = 0.1  # [m/s] by which a base may be faster than it is told
CARRIED = 5.0  # [m/s]; a faster robot was carried
REST, RESTED = 0.05, 0.5  # [m/s, s] of a robot that is run into
FAR = 1e3  # [m] away, for what is left out
RENEWED = 0.5  # [s] within which a contact with the same thing is no event of its own
TOUCH = 0.01  # [m] inside of a known wall, from which a way out meets it


@dataclass(frozen=True)
class Broken:
    """An assumption that did not hold.

    Attributes:
        tick: at which it was made.
        kind: "mover", "unseen", "overlooked", "pose", "map", "brakes" or "rest".
        words: numbers of it.
    """

    tick: int
    kind: str
    words: str


@dataclass(frozen=True)
class Contact:
    """A contact and its cause.

    Attributes:
        tick: at the end of which it was recorded.
        time: of the tick [s].
        thing: "wall" or "obstacle N".
        cause: begins with "assumption broken" or "fault of the robot".
    """

    tick: int
    time: float
    thing: str
    cause: str


@dataclass(frozen=True)
class Judgement:
    """Result for a drive.

    Attributes:
        contacts: in their order.
        ticks: in which each kind of assumption was broken, by kind.
        beyond_sigma: share of ticks whose true position lies outside of the ellipse of ``sigmas`` deviations.
    """

    contacts: tuple[Contact, ...]
    ticks: dict[str, int]
    beyond_sigma: float


@lru_cache(1)
def judged(log: EpisodeLog) -> Judgement:
    """Check every tick of a drive, and attribute its contacts; the last drive is not checked again."""
    judge = _Judge(log)
    flags = {
        "pose": judge.off > log.assumed.wall_gap, "brakes": judge.too_fast > BRAKES,
        "map": np.array([not judge.mapped(k) for k in range(len(log.time))], dtype=bool),
        "mover": (judge.nearer > 0.0).any(axis=1), "overlooked": judge.overlooked.any(axis=1),
    }  # fmt: skip
    ticks = {kind: int(np.count_nonzero(held)) for kind, held in flags.items()}
    # The contact of the last tick has no row behind it.
    begun = np.maximum(np.diff(np.concatenate([[0], log.contacts, [log.collisions]])), 0)
    contacts: list[Contact] = []
    for k in np.repeat(np.minimum(np.arange(len(begun)), len(log.time) - 1), begun).tolist():
        found = judge.contact(k, {each.thing for each in contacts if log.time[k] - each.time < RENEWED})
        pushed = contacts and found.tick - contacts[-1].tick <= judge.steps  # on, by what it had met before
        contacts.append(replace(found, cause=contacts[-1].cause) if pushed else found)
    return Judgement(tuple(contacts), ticks, float(np.mean(judge.distance > log.assumed.sigmas)))


class _Judge:
    """Quantities of all ticks; K true obstacles, T ticks."""

    def __init__(self, log: EpisodeLog) -> None:
        """Compare beliefs with the truth."""
        self.log, self.assumed = log, log.assumed
        same = log.walls is log.occupancy or np.array_equal(log.walls.occupied, log.occupancy.occupied)
        self._judges_walls = log.collisions > 0 or bool(log.contacts.any()) or not same
        if self._judges_walls:
            self.known = _field(log.occupancy)
            self.true = self.known if same else _field(log.walls)
        error = (log.true_pose - log.estimate)[:, :2]
        cosine, sine = np.cos(log.estimate[:, 2]), np.sin(log.estimate[:, 2])
        turn = np.stack([np.stack([cosine, -sine], axis=1), np.stack([sine, cosine], axis=1)], axis=1)
        spread = turn @ log.covariance[:, :2, :2] @ np.swapaxes(turn, 1, 2)
        within = np.linalg.solve(spread + 1e-12 * np.eye(2), error[:, :, None])[:, :, 0]
        self.distance = np.sqrt(np.maximum((within * error).sum(axis=1), 0.0))  # Mahalanobis
        # Error beyond the ellipse of k deviations [m], along itself.
        self.off = np.hypot(*error.T) * (1.0 - self.assumed.sigmas / np.maximum(self.distance, self.assumed.sigmas))
        self.speed, self.too_fast = self._speeds()
        self.steps = max(1, round(self.assumed.ahead / log.dt))
        shape = log.obstacles.shape[:2]
        self.nearer, self.overlooked = np.full(shape, -np.inf), np.zeros(shape, dtype=bool)
        self.hidden = np.zeros(shape, dtype=bool)
        for tick, thing in np.argwhere(self._gaps_to_discs() < NEAR).tolist():
            self._look_at(tick, thing)

    def _speeds(self) -> tuple[Array, Array]:
        """(T,) true mean speeds after each tick, and by how much they exceed the commands [m/s]."""
        log = self.log
        moved = np.hypot(*np.diff(log.true_pose[:, :2], axis=0).T) / log.dt
        speed = np.append(np.where(moved < CARRIED, moved, 0.0), 0.0)
        kind = base_of(log.base)
        told = np.array([math.hypot(*kind.of(control)[:-1].tolist()) for control in log.control])
        return speed, speed - np.maximum(told, np.concatenate([[0.0], told[:-1]]))

    def _gaps_to_discs(self) -> Array:
        """(T, K) true gaps between hull and discs [m]."""
        log, hull = self.log, self.log.hull
        away = hull.places(log.true_pose)[:, :, None] - log.obstacles[:, None, :, :2]
        apart = np.hypot(away[..., 0], away[..., 1]) + hull.smaller[:, None]
        gaps: Array = apart.min(axis=1) - hull.radius - log.obstacles[:, :, 2]
        return gaps

    def _look_at(self, tick: int, thing: int) -> None:
        """Compare a true disc with its track, or with the beams where there is none."""
        log, (x, y, radius) = self.log, self.log.obstacles[tick, thing].tolist()
        tracks, expected = log.detected[tick], log.expected[tick]
        apart = np.hypot(tracks[:, 0] - x, tracks[:, 1] - y) - np.maximum(tracks[:, 2], radius)
        if not (apart < ALIKE).any():
            seen = self._in_view(tick, x, y, radius)
            self.overlooked[tick, thing], self.hidden[tick, thing] = seen, not seen
            return
        track, later = int(np.argmin(apart)), min(tick + self.steps, len(log.time) - 1)
        place, reach = expected[track, :2], float(expected[track, 3])
        assumed = np.hypot(*(place - log.estimate[later, :2])) - tracks[track, 2] - reach
        true = np.hypot(*(log.obstacles[later, thing, :2] - log.true_pose[later, :2])) - radius
        self.nearer[tick, thing] = assumed - true if later == tick + self.steps else -np.inf

    def _in_view(self, tick: int, x: float, y: float, radius: float) -> bool:
        """Return True if a beam of a tick comes as far as a disc, seen from the true pose."""
        log = self.log
        away = SE2.between(log.true_pose[tick], np.array([x, y, 0.0]))[:2]
        distance, bearing = math.hypot(*away.tolist()), math.atan2(away[1], away[0])
        half = math.asin(min(1.0, 0.5 * radius / max(distance, radius)))
        fan = np.abs(np.remainder(log.scan_angles - bearing + np.pi, 2.0 * np.pi) - np.pi) <= half
        return bool((log.scan[tick][fan] >= distance - radius - ALIKE).any())

    def _wall_gaps(self, field: DistanceMap, poses: Array) -> Array:
        """(...) gaps between the hull at poses (..., 3) and walls [m]."""
        hull = self.log.hull
        gaps: Array = (field.distance(hull.places(poses)) + hull.smaller).min(axis=-1) - hull.radius
        return gaps

    def mapped(self, tick: int) -> bool:
        """Return True if walls are no nearer than on the map, or something as near is tracked."""
        if not self._judges_walls:
            return True
        place, tracks = self.log.true_pose[tick, :2], self.log.detected[tick]
        distance = float(self.true.distance(place))
        if distance > NEAR or float(self.known.distance(place)) - distance <= self.assumed.wall_gap:
            return True
        return bool((np.hypot(*(tracks[:, :2] - place).T) - tracks[:, 2] < distance + ALIKE).any())

    def contact(self, tick: int, but: Collection[str] = ()) -> Contact:
        """Attribute a contact that the row of a tick, or the end of the log, is the first to record.

        Args:
            tick: of the row.
            but: things that were touched just before, or in the same tick by another contact.
        """
        log, rows = self.log, slice(max(tick - 1, 0), tick + 1)
        discs, walls = self._gaps_to_discs()[rows].min(axis=0), self._wall_gaps(self.true, log.true_pose[rows]).min()
        names = [*(f"obstacle {disc}" for disc in range(len(discs))), "wall"]
        gaps = np.append(discs, walls) + [FAR * (name in but) for name in names]  # the nearest of the others
        nearest = int(np.argmin(gaps))
        thing = nearest if nearest < len(discs) else None
        first = max(0, tick - self.steps - 1)
        broken = min(self._broken(thing, first, tick), key=lambda each: each.tick, default=None)
        met = np.flatnonzero(self._wall_gaps(self.known, log.way_out[first : tick + 1]).min(axis=1) < -TOUCH) + first
        if thing is None and len(met) and (broken is None or met[0] <= broken.tick):
            cause = f"{FAULT}: its way out of {log.time[met[0]]:.1f} s meets a known wall"
        elif broken is None:
            cause = f"{FAULT}: no assumption was broken in the {tick - first} ticks before"
        else:
            cause = f"{BREAKS} ({broken.kind}) at {log.time[broken.tick]:.1f} s: {broken.words}"
        return Contact(tick, float(log.time[tick]), names[nearest], cause)

    def _broken(self, thing: int | None, first: int, last: int) -> Sequence[Broken]:
        """Assumptions that were broken in some ticks and can be the cause of a contact with a wall or a disc."""
        log, ticks = self.log, range(first, last + 1)
        told = self.speed - self.too_fast
        found = self._where(
            self.too_fast > BRAKES, range(first, last), "brakes",  # later speeds are those of who was hit
            lambda k: f"{self.speed[k]:.2f} m/s where {told[k]:.2f} was asked of "
            f"brakes of {self.assumed.deceleration:g} m/s^2",
        )  # fmt: skip
        if thing is None:  # of a disc the estimate says nothing: it is seen from the robot
            nearer = self._wall_gaps(self.known, log.estimate) - self._wall_gaps(self.known, log.true_pose)
            misled = np.minimum(self.off, nearer) > self.assumed.wall_gap
            unmapped = np.array([k in ticks and not self.mapped(k) for k in range(len(log.time))])
            return [
                *found,
                *self._where(
                    misled, ticks, "pose",
                    lambda k: f"{100 * nearer[k]:.0f} cm nearer to walls than estimated, "
                    f"{100 * self.off[k]:.0f} cm beyond {self.assumed.sigmas:g} deviations",
                ),
                *self._where(unmapped, ticks, "map", lambda k: "a wall that no map and no beam shows"),
            ]  # fmt: skip
        moved = np.hypot(*np.diff(log.obstacles[:, thing, :2], axis=0, append=log.obstacles[-1:, thing, :2]).T) / log.dt
        rested = range(max(0, last - 1 - round(RESTED / log.dt)), max(1, last - 1))
        if all(self.speed[k] < REST for k in rested) and moved[max(last - 1, 0)] >= REST:
            words = f"a mover of {moved[max(last - 1, 0)]:.2f} m/s ran into the robot at rest"
            found.append(Broken(rested[0], "rest", words))
        return [
            *found,
            *self._where(
                self.nearer[:, thing] > 0.0, ticks, "mover",
                lambda k: f"{100 * self.nearer[k, thing]:.0f} cm nearer after {self.assumed.ahead:.1f} s than its "
                f"bound of {self._bound(k, thing):.2f} m/s, by {moved[k : k + self.steps].max():.2f} m/s",
            ),
            *self._where(self.overlooked[:, thing], ticks, "overlooked", lambda k: "in view and not seen"),
            *self._where(self.hidden[:, thing], ticks, "unseen", lambda k: "in space taken for free that no beam saw"),
        ]  # fmt: skip

    def _bound(self, tick: int, thing: int) -> float:
        """Bound of the speed of the track beside a disc [m/s]."""
        away = np.hypot(*(self.log.detected[tick][:, :2] - self.log.obstacles[tick, thing, :2]).T)
        return float(self.log.expected[tick][int(np.argmin(away)), 2])

    @staticmethod
    def _where(held: BoolArray, ticks: range, kind: str, words: Callable[[int], str]) -> list[Broken]:
        """The first of some ticks in which an assumption was broken."""
        return [Broken(k, kind, words(k)) for k in ticks if held[k]][:1]


def _field(occupancy: OccupancyMap) -> DistanceMap:
    """Distances of a map."""
    return DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
