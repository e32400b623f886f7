"""Injected faults between a simulated world and the robot in it.

A fault is stated as ``KIND[=SIZE]@SECONDS[:DURATION]``; without a duration it stays, and without a size it is as large
as usual. Faults of sensors change what arrives, those of actuators and of the plant what is done, and the robot is told
of none.
"""

from __future__ import annotations

import argparse
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unifg.errors import ScenarioError
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.planar import Base
from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.perception.readings import Reading, Scan
from unifg.typing import Array

__all__ = ["DRIVE_FAULTS", "FLIGHT_FAULTS", "SIZES", "DriveFaults", "Fault", "FlightFaults", "one_of"]

DRIVE_FAULTS = (
    "lidar-nan", "lidar-inf", "lidar-max", "lidar-negative", "lidar-frozen", "lidar-dropped", "lidar-delayed",
    "lidar-blind", "beams-missing", "odometry-nan", "odometry-slip", "wheel-dead", "kidnapped", "wrong-map",
    "solver-timeout", "actuator-lag", "actuator-stuck", "lidar-turned", "range-bias", "wheel-scale",
)  # fmt: skip
"""Of the driving robot."""

FLIGHT_FAULTS = ("detector-lost", "detector-false", "thrust-loss", "gust", "solver-timeout", "payload")
"""Of the quadrotor."""

SIZES = {
    "odometry-slip": 1.6,  # wheels that slip turn so many times as far as the robot goes
    "wheel-scale": 1.3,  # wheels measure so many times what they do, of the way and of the turn
    "actuator-lag": 0.3,  # [s]; time constant of a motor that lags
    "lidar-turned": math.radians(10.0),  # [rad] of its mount, to the left; ten beams
    "range-bias": 0.3,  # [m] that is added to every range
    "thrust-loss": 0.1,  # of the thrust that is missing
    "gust": 4.0,  # [m/s^2]
    "payload": 0.4,  # of the vehicle's own mass
}
"""Usual size by kind; the others have none."""

BLIND = 0.3  # [rad] to both sides of straight ahead, where a lidar that is half covered sees nothing
LATE = 0.4  # [s] by which a delayed scan comes late
AXLE = 0.3  # [m] between the wheels
CARRIED = 3.0  # [m]; a robot is carried at least so far
ROOM = 0.5  # [m] from walls where it is put down
PHANTOMS = 3  # things that are not there and are seen


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        kind: what.
        begin: when [s].
        duration: how long [s].
        size: in the unit of its kind; None for the usual one.
    """

    kind: str
    begin: float
    duration: float = math.inf
    size: float | None = None

    def __str__(self) -> str:
        """As it is stated."""
        size = "" if self.size is None else f"={self.size:g}"
        return f"{self.kind}{size}@{self.begin:g}" + (f":{self.duration:g}" if math.isfinite(self.duration) else "")

    def holds(self, time: float) -> bool:
        """Return True if it is active at a time [s]."""
        return self.begin - 1e-9 <= time < self.begin + self.duration - 1e-9


def one_of(kinds: Sequence[str]) -> Callable[[str], Fault]:
    """Reads a fault of one of some kinds from a word of the command line."""

    def read(text: str) -> Fault:
        stated, _, when = text.partition("@")
        kind, _, size = stated.partition("=")
        begin, _, duration = when.partition(":")
        try:
            fault = Fault(kind, float(begin), float(duration or math.inf), float(size) if size else None)
        except ValueError:
            fault = Fault(kind, math.nan)
        if not (0.0 <= fault.begin < math.inf and fault.duration > 0.0 and math.isfinite(fault.size or 0.0)):
            raise argparse.ArgumentTypeError(f"{text!r} is not KIND[=SIZE]@SECONDS[:DURATION], such as {kinds[0]}@5:2")
        if size and kind in kinds and kind not in SIZES:
            raise argparse.ArgumentTypeError(f"a fault {kind!r} has no size: leave '={size}' out")
        if kind == "actuator-lag" and (fault.size or 0.0) < 0.0:
            raise argparse.ArgumentTypeError(f"{text!r}: a motor lags by a time constant of zero or more [s]")
        if kind not in kinds:
            raise argparse.ArgumentTypeError(f"unknown fault {kind!r}: choose {', '.join(kinds)}")
        return fault

    return read


class _Faults:
    """Faults of one run."""

    def __init__(self, faults: Sequence[Fault], seed: int) -> None:
        """Keep them; what is random about them is drawn from a stream of its own."""
        self._faults = tuple(faults)
        self._rng = np.random.default_rng([55, seed])

    def hold(self, kind: str, time: float) -> bool:
        """Return True if a fault of this kind is active at a time [s]."""
        return any(fault.kind == kind and fault.holds(time) for fault in self._faults)

    def size(self, kind: str, time: float) -> float | None:
        """Size of the fault of this kind that is active at a time [s]; None where none is."""
        sizes = (fault.size for fault in self._faults if fault.kind == kind and fault.holds(time))
        return next((SIZES[kind] if size is None else size for size in sizes), None)

    def names(self, time: float) -> str:
        """Those that hold, for pictures."""
        return ", ".join(fault.kind for fault in self._faults if fault.holds(time))


class DriveFaults(_Faults):
    """Faults of a drive."""

    def __init__(
        self, faults: Sequence[Fault], seed: int, base: Base = unicycle.BASE, *, range_max: float = 12.0
    ) -> None:
        """Begin before the first tick.

        Args:
            faults: what goes wrong.
            seed: of what is random about it.
            base: of the robot.
            range_max: of its lidar [m], which says so where it sees nothing.

        Raises:
            ScenarioError: a fault of wheels that the base does not have.
        """
        super().__init__(faults, seed)
        if base is not unicycle.BASE and any(fault.kind == "wheel-dead" for fault in faults):
            raise ScenarioError("the fault 'wheel-dead' is one of a unicycle's two wheels: leave it or --base out")
        self._scans: deque[Scan] = deque(maxlen=100)
        self._frozen: Scan | None = None
        self._driven, self._range_max = np.zeros(base.size), range_max
        self._carried = False

    def scan(self, scan: Scan, now: float) -> Scan | None:
        """Scan that arrives."""
        turned, bias = self.size("lidar-turned", now), self.size("range-bias", now)
        if turned is not None:
            scan = _turned(scan, turned)
        if bias is not None:
            scan = replace(scan, ranges=scan.ranges + bias)
        self._scans.append(scan)
        if not self.hold("lidar-frozen", now):
            self._frozen = scan
        late = [old for old in self._scans if old.time is not None and old.time <= now - LATE + 1e-9]
        arriving = {
            "lidar-dropped": None,
            "lidar-delayed": late[-1] if late else None,
            "beams-missing": replace(scan, angles=scan.angles[:-1], ranges=scan.ranges[:-1]),
            "lidar-frozen": replace(self._frozen or scan, time=now),  # with a stamp that does not tell
            "lidar-blind": replace(scan, ranges=np.where(np.abs(scan.angles) < BLIND, math.nan, scan.ranges)),
            "lidar-nan": replace(scan, ranges=np.full_like(scan.ranges, math.nan)),
            "lidar-inf": replace(scan, ranges=np.full_like(scan.ranges, math.inf)),
            "lidar-max": replace(scan, ranges=np.full_like(scan.ranges, self._range_max)),
            "lidar-negative": replace(scan, ranges=-scan.ranges),
        }
        return next((found for kind, found in arriving.items() if self.hold(kind, now)), scan)

    def odometry(self, measured: Array, now: float) -> Array:
        """Odometry (m,) that arrives."""
        if self.hold("odometry-nan", now):
            return np.full(len(measured), math.nan)
        spin, scale = (
            1.0 if size is None else size
            for size in (self.size(kind, now) for kind in ("odometry-slip", "wheel-scale"))
        )  # one of zero is a wheel that does not count
        return measured * [*[spin] * (len(measured) - 1), 1.0] * scale

    def control(self, asked: Array, now: float, dt: float) -> Array:
        """Controls (m,) that the motors make of those asked for over ``dt`` [s]."""
        done = asked
        lag = self.size("actuator-lag", now)
        if lag:
            done = self._driven + (1.0 - math.exp(-dt / lag)) * (asked - self._driven)
        if self.hold("actuator-stuck", now):
            done = self._driven
        if self.hold("wheel-dead", now):  # the right one
            left = float(done[0] - 0.5 * AXLE * done[1])
            done = np.array([0.5 * left, -left / AXLE])
        self._driven = done
        return done

    def carries(self, now: float) -> bool:
        """Return True, once, when the robot is to be carried away."""
        due = self.hold("kidnapped", now) and not self._carried
        self._carried |= due
        return due

    def elsewhere(self, distance_map: DistanceMap, places: Array, pose: Array) -> Array:
        """Draw a pose (3,) from places (n, 2) [m] far from walls and from ``pose`` (3,), with any heading."""
        room = distance_map.distance(places) > ROOM
        far = np.hypot(*(places - pose[:2]).T) > CARRIED
        chosen = places[room & far]
        chosen = chosen if len(chosen) else places[room]
        place = chosen[int(self._rng.integers(len(chosen)))] if len(chosen) else pose[:2]
        return np.array([*place, self._rng.uniform(-np.pi, np.pi)])


def _turned(scan: Scan, by: float) -> Scan:
    """The scan of a lidar whose mount is turned to the left [rad], to the next beam."""
    beams = round(by / scan.spacing)
    ranges = np.roll(scan.ranges, -beams)
    if not scan.closed and beams:
        ranges[slice(-beams, None) if beams > 0 else slice(-beams)] = math.nan
    return replace(scan, ranges=ranges)


class FlightFaults(_Faults):
    """Faults of a flight."""

    def reading(self, reading: Reading, now: float) -> Reading:
        """Reading that arrives."""
        if self.hold("detector-lost", now):
            return reading.only(np.zeros(0, dtype=np.intp))
        return self._haunted(reading) if self.hold("detector-false", now) else reading

    def _haunted(self, reading: Reading) -> Reading:
        """With cylinders that are not there, at another place in every tick."""
        bearings, ranges = self._rng.uniform(-np.pi, np.pi, PHANTOMS), self._rng.uniform(1.0, 6.0, PHANTOMS)
        return replace(
            reading,
            ids=np.concatenate([reading.ids, 10_000 + self._rng.integers(10_000, size=PHANTOMS)]),
            bearings=np.concatenate([reading.bearings, bearings]),
            ranges=np.concatenate([reading.ranges, ranges]),
            radii=np.concatenate([reading.radii, np.full(PHANTOMS, 0.3)]),
            kinds=np.concatenate([reading.kinds, np.full(PHANTOMS, Landmarks.CYLINDER)]),
            moving=np.concatenate([reading.moving, np.zeros(PHANTOMS, dtype=bool)]),
        )

    def control(self, asked: Array, now: float) -> Array:
        """Body rates and thrust (4,) that the motors make of those asked for."""
        return asked * [1.0, 1.0, 1.0, 1.0 - (self.size("thrust-loss", now) or 0.0)]

    def wind(self, now: float) -> tuple[float, float]:
        """Wind that a gust adds [m/s^2]."""
        return 0.0, self.size("gust", now) or 0.0

    def load(self, now: float) -> float:
        """Mass that is carried, as a share of the vehicle's own."""
        return self.size("payload", now) or 0.0
