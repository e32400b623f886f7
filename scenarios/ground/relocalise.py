"""Search of the whole map for the pose of the robot: a scan against the distance field from many poses.

Every free place of a coarse grid is tried with every heading of a fan; those whose beams end nearest to surfaces are
refined by matching on the beams that count, and the best of them is believed if most of its beams end at surfaces and
pass none, and no other place fits nearly as well. The search is done in portions of a fixed size, so that no tick takes
long: large ones while the robot rests, small ones while it drives and doubts where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unifg.codegen.jit import compiled
from unifg.files.ros_map import OccupancyMap
from unifg.lie import wrap_angle
from unifg.models.distance_map import DistanceMap, bilinear
from unifg.scenarios.monitoring.validation import first_true
from unifg.scenarios.perception.explaining import FARTHEST
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array

__all__ = ["Found", "Relocaliser", "fit", "nearest_fit", "refine"]

SPACING = 0.2  # [m] between places
FAN = 2.0 * np.pi * np.arange(48) / 48  # headings [rad]
BEAMS = 45  # of the scan that are held against the map
CUT = 0.5  # [m]; a beam farther from everything costs no more
PORTION, BESIDE = 1500, 150  # places of one tick: at rest, and beside a drive
CANDIDATES = 24  # poses that are refined
AS_LONG = 60  # places that take as long as one refinement
SEPARATE = 0.5  # [m] or [rad], apart from which two candidates are two places
STEPS = 12  # of the refinement
END = 0.08  # [m] from a surface, within which a beam ends as it should
PIERCED = 0.03  # [m] that a beam may be inside of a wall before its end
ALONG = np.linspace(0.1, 0.95, 18)  # shares of a beam at which it is looked at
BELIEVED = 0.82  # share of the beams that have to end and to pass as they should
STEP, TURN = 0.1, 0.04  # [m], [rad] between poses where a neighbourhood is searched
RIVAL = 0.35  # [m] from the best place, from where another is another
ALIKE = 0.02  # [m] that beams may end worse at a place that is like the best
FARTHER = 0.005  # [m] that a beam may end worse, per metre nearer to where the robot is believed to be
CLEARLY = 0.1  # by which the next best place has to fit worse


@dataclass(frozen=True)
class Found:
    """Result of a search.

    Attributes:
        pose: (3,) [m, m, rad]; None where it is not known.
        share: of the beams that fit there.
        cause: why it is not known.
        rivals: poses (3,) that cannot be told apart, the best first.
    """

    pose: Array | None
    share: float
    cause: str
    rivals: tuple[Array, ...] = ()


class Relocaliser:
    """Searches one map, portion by portion."""

    def __init__(self, occupancy: OccupancyMap, distance_map: DistanceMap, robot_radius: float) -> None:
        """List the places where a robot can stand."""
        self._map, self._radius = distance_map, robot_radius
        stride = max(1, round(SPACING / occupancy.resolution))
        cells = np.argwhere(occupancy.free[::stride, ::stride])[:, ::-1].astype(np.float64) * stride
        places = occupancy.grid_to_world(cells + 0.5)
        self.places: Array = places[distance_map.distance(places) > robot_radius]
        _try_all(distance_map.table, np.zeros((0, 2)), np.zeros((1, 1, 2)), np.zeros((0, 2)))  # compiled before need
        self.begin(None)

    def begin(self, scan: Scan | None) -> None:
        """Search anew, with a scan; None for not at all."""
        self._scan, self._at = scan, 0
        if scan is not None:
            self._cost, self._heading = np.full(len(self.places), np.inf), np.zeros(len(self.places))
            self._apart: list[Array] | None = None
            self._kept: list[tuple[float, Array]] = []

    @property
    def searching(self) -> bool:
        """True while a search goes on."""
        return self._scan is not None

    def search(self, portion: int = PORTION) -> Found | None:
        """Go on with the search, by a number of places; what it has found, once it is at its end."""
        scan = self._scan
        if scan is None:
            return None
        if self._at < len(self.places):
            chosen = slice(self._at, self._at + portion)
            best = np.empty((len(self.places[chosen]), 2))
            _try_all(self._map.table, self.places[chosen], _tips(scan), best)
            self._cost[chosen], self._heading[chosen] = best[:, 0], FAN[best[:, 1].astype(np.intp)]
            self._at += portion
            if self._at < len(self.places):
                return None
        if self._apart is None:
            self._apart = self._best_apart()
        for _ in range(min(portion // AS_LONG, len(self._apart))):
            pose = refine(self._map, scan, self._apart.pop(0))
            room = self._map.distance(pose[None, :2])[0] > self._radius - END  # neither in a wall nor off the map
            if room and not any(_same(pose, other) for _, other in self._kept):
                self._kept.append((fit(self._map, scan, pose), pose))
        if self._apart:
            return None
        self._scan = None
        return _decided(self._kept)

    def _best_apart(self) -> list[Array]:
        """Poses (3,) that are to be refined, the best first, each another place."""
        order = np.argsort(self._cost, kind="stable")[: 20 * CANDIDATES]
        found: list[Array] = []
        for index in order[np.isfinite(self._cost[order])].tolist():
            pose = np.array([*self.places[index], self._heading[index]])
            if len(found) < CANDIDATES and not any(_same(pose, other) for other in found):
                found.append(pose)
        return found


def _decided(fitting: Sequence[tuple[float, Array]]) -> Found:
    """Result of refined poses (3,), each after the share of the beams that fit there."""
    kept = sorted(fitting, key=lambda row: -row[0])
    share, best = kept[0] if kept else (0.0, None)
    rivals = tuple(pose for other, pose in kept if other > share - CLEARLY)
    cause = first_true(
        (best is None, "no place on the map"),
        (share < BELIEVED, "no place on the map fits the scan"),
        (len(rivals) > 1, "several places on the map look alike"),
    )
    return Found(None if cause else best, share, cause, rivals if share >= BELIEVED else ())


def fit(distance_map: DistanceMap, scan: Scan, pose: Array) -> float:
    """Share of the beams that end at a surface and have passed none, seen from a pose (3,)."""
    beams = scan.within(FARTHEST)
    ranges, bearing = scan.ranges[beams], scan.angles[beams] + pose[2]
    ray = ranges[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    ends = np.abs(distance_map.distance(pose[:2] + ray)) <= END
    passes = distance_map.distance(pose[:2] + ALONG[:, None, None] * ray).min(axis=0) >= -PIERCED
    return float((ends & passes).mean())


def refine(distance_map: DistanceMap, scan: Scan, pose: Array) -> Array:
    """Gauss-Newton on the beams that end near a surface, whose reach shrinks as the match improves, (3,)."""
    beams = scan.within(FARTHEST)
    ranges, angles = scan.ranges[beams], scan.angles[beams]
    for step in range(STEPS):
        bearing = angles + pose[2]
        ray = ranges[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
        distance, gradient = distance_map.distance_and_gradient(pose[:2] + ray)
        reach = max(CUT * 0.8**step, 0.15)
        weight = np.where(np.abs(distance) < reach, 1.0, 0.0)
        turned = gradient[:, 1] * ray[:, 0] - gradient[:, 0] * ray[:, 1]
        J = np.column_stack([gradient, turned]) * weight[:, None]
        change = np.linalg.solve(J.T @ J + 1e-3 * np.eye(3), -J.T @ (weight * distance))
        pose = pose + np.clip(change, -0.2, 0.2)
    return np.array([pose[0], pose[1], float(wrap_angle(pose[2]))])


def nearest_fit(distance_map: DistanceMap, scan: Scan, about: Array, reach: float, turn: float) -> tuple[Array, Array]:
    """Pose (3,) that fits best within a reach [m] and a turn [rad] of another (3,), and the way to a rival (2,) [m].

    The way is zero where beams end much farther from surfaces at every other place: in a corridor it leads along it.
    """
    side = np.linspace(-reach, reach, 2 * max(1, round(reach / STEP)) + 1)
    fan = about[2] + np.linspace(-turn, turn, 2 * max(1, round(turn / TURN)) + 1)
    places = np.ascontiguousarray(np.stack(np.meshgrid(side, side), axis=2).reshape(-1, 2) + about[:2])
    best = np.empty((len(places), 2))
    _try_all(distance_map.table, places, _tips(scan, fan), best)
    # of places that fit alike, as along a corridor, the nearest
    cost = best[:, 0] + FARTHER * np.hypot(*(places - about[:2]).T)
    least = int(np.argmin(cost))
    aside = places - places[least]
    rival = int(np.argmin(np.where(np.hypot(*aside.T) > RIVAL, best[:, 0], np.inf)))
    alike = best[rival, 0] < best[least, 0] + ALIKE
    return np.array([*places[least], fan[int(best[least, 1])]]), aside[rival] if alike else np.zeros(2)


def _tips(scan: Scan, fan: Array = FAN) -> Array:
    """(H, n, 2) ends of beams spread over the turn, for every heading of a fan, seen from the robot [m]."""
    beams = scan.within(FARTHEST)
    chosen = beams[np.linspace(0, len(beams) - 1, min(BEAMS, len(beams))).round().astype(np.intp)]
    angles, ranges = fan[:, None] + scan.angles[chosen], scan.ranges[chosen]
    return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=2)


def _same(one: Array, other: Array) -> bool:
    """Test whether two poses (3,) are one place."""
    away = float(np.hypot(*(one - other)[:2]))
    return away < SEPARATE and abs(float(wrap_angle(one[2] - other[2]))) < SEPARATE


@compiled
def _try_all(table: Array, places: Array, tips: Array, best: Array) -> None:
    """Of every place the least mean distance of beams to surfaces, cut off, and the index of that heading."""
    count = tips.shape[1]
    for i in range(len(places)):
        least, which = np.inf, 0
        for k in range(len(tips)):
            total = 0.0
            for j in range(count):
                away = abs(bilinear(table, places[i, 0] + tips[k, j, 0], places[i, 1] + tips[k, j, 1])[0])
                total += min(away, CUT)
                if total >= least:
                    break
            if total < least:
                least, which = total, k
        best[i, 0], best[i, 1] = least / max(count, 1), which
