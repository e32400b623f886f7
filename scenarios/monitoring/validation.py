"""Validation of sensor samples.

A sample is let in if it can be one of the sensor that it comes from: there, of the right size, finite, of the right
sign, new, not too old. Others are dropped and counted by what is wrong with them; nothing is raised, whatever arrives.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from unifg.scenarios.perception.readings import Reading, Scan
from unifg.typing import Array, BoolArray

__all__ = ["Validator", "first_true"]

EARLY = 1e-6  # [s] by which a stamp may lie ahead of the clock
MIN_RANGE, MAX_RANGE = 0.01, 10.0  # [m]; a beam from nearer has met nothing, a longer one says nothing about the map
AT_MOST = 0.99  # of the lidar's own range; a longer reading means that nothing was hit
MIN_BEAMS = 20  # between these that a scan must have
MAX_AGE = 0.15  # [s]; an older scan says where the robot was, not where it is
MOVED = (0.005, 0.005)  # [m, rad] after which a scan that repeats the last one, bit by bit, is none
MAX_SPEED = (5.0, 10.0)  # [m/s, rad/s] that wheels can report
MAX_SPECIFIC_FORCE = (500.0, 50.0)  # [m/s^2], and body rate [rad/s], that a reading can hold


class Validator:
    """Looks at samples.

    Attributes:
        dropped: how many were not let in, by what was wrong with them.
        refused: what was wrong with the last sample of each sensor; no entry where it was let in.
    """

    def __init__(self, beams: int = 0, range_max: float = math.inf) -> None:
        """Expect scans of so many beams, of a lidar with some range [m]."""
        self.dropped: Counter[str] = Counter()
        self.refused: dict[str, str] = {}
        self._beams, self._reach = beams, AT_MOST * range_max
        self._last: Array | None = None
        self._time = -math.inf
        self._since: Array = np.zeros(2)

    # ------------------------------------------------------------------ lidar

    def scan(self, scan: Scan | None, now: float) -> Scan | None:
        """A scan whose beams all can be measurements, those that cannot as dropouts; None where it is none.

        Args:
            scan: as it arrived; None where none did.
            now: [s]. A scan whose stamp is None counts as new.
        """
        found, wrong = self._look(scan, now)
        self._note("lidar", wrong)
        return found

    def _look(self, scan: Scan | None, now: float) -> tuple[Scan | None, str]:
        if scan is None:
            return None, "no scan came"
        ranges, angles = _numbers(scan.ranges, (self._beams,)), _numbers(scan.angles, (self._beams,))
        if ranges is None or angles is None or not np.isfinite(angles).all():
            return None, "not the size of a scan"
        stamp = now if scan.time is None else _number(scan.time)
        measured = np.isfinite(ranges) & (ranges >= MIN_RANGE) & (ranges <= min(MAX_RANGE, self._reach))
        wrong = first_true(
            (math.isnan(stamp), "its time is not a number"),
            (stamp > now + EARLY, "from the future"),
            (now - stamp > MAX_AGE + EARLY, "too old"),
            (scan.time is not None and stamp <= self._time, "not newer than the last"),
            (self._repeats(ranges), "the last one once more"),
            (measured.sum() < MIN_BEAMS, _emptiness(ranges, MIN_RANGE)),
        )
        if wrong:
            return None, wrong
        self._last, self._since[:] = ranges.copy(), 0.0
        self._time = stamp
        turn = _number(scan.turn)
        turn = turn if 0.0 <= turn <= MAX_AGE else 0.0
        return Scan(angles, np.where(ranges >= MIN_RANGE, ranges, np.nan), stamp, turn), ""

    def _repeats(self, ranges: Array) -> bool:
        """Return True if noise has not changed a single beam though the robot has moved."""
        if self._last is None or not (self._since > MOVED).any():
            return False
        return np.array_equal(ranges, self._last, equal_nan=True)

    # ----------------------------------------------------------------- wheels

    def odometry(self, measured: Array | None, applied: Array, dt: float) -> Array:
        """The wheels' controls (m,); where they are none, those that were asked for.

        Args:
            measured: as they arrived; None where none did.
            applied: (m,) asked for since the last tick.
            dt: duration [s].
        """
        size, (speed, turning) = len(applied), MAX_SPEED
        found = _numbers(measured, (size,))
        numbers = np.zeros(size) if found is None else found
        wrong = first_true(
            (measured is None, "none came"),
            (found is None, f"not {size} numbers"),
            (not np.isfinite(numbers).all(), "not finite"),
            (bool((np.abs(numbers) > [*[speed] * (size - 1), turning]).any()), "faster than any wheel"),
        )
        self._note("wheels", wrong)
        velocities = applied if wrong else numbers
        self._since += np.array([np.abs(velocities[:-1]).max(), abs(velocities[-1])]) * dt
        return velocities

    # ---------------------------------------------------------------- reading

    def reading(self, reading: Reading | None, now: float, applied: Array) -> Reading:
        """A reading that can be used: without sightings that are none, with what was asked for in place of bad rates.

        Height, tilt and force that are not finite count as not measured further on.

        Args:
            reading: as it arrived; None where none did.
            now: [s].
            applied: (4,) body rates [rad/s] and thrust [N] since the last tick.
        """
        sightings, wrong = _sightings(reading)
        self._note("detector", wrong)
        force, rates = MAX_SPECIFIC_FORCE
        inertial = reading is not None and _bounded(reading.rates, 3, rates) and _bounded(reading.force, 3, force)
        self._note("inertial unit", "" if inertial else "not three numbers that can be")
        if reading is None:
            nothing = np.full(3, np.nan)
            return replace(_NOTHING, time=now, tilt=nothing, rates=applied[:3].copy(), force=nothing)
        height, tilt = _number(reading.height), _numbers(reading.tilt, (3,))
        self._note("altimeter", "" if math.isfinite(height) else "not finite")
        seen = replace(sightings, time=now, height=height, tilt=np.full(3, np.nan) if tilt is None else tilt)
        if inertial:
            return replace(seen, rates=np.asarray(reading.rates), force=np.asarray(reading.force))
        return replace(seen, rates=applied[:3].copy(), force=np.full(3, np.nan))

    def _note(self, sensor: str, wrong: str) -> None:
        self.refused.pop(sensor, None)
        if wrong:
            self.refused[sensor] = wrong
            self.dropped[f"{sensor}: {wrong}"] += 1


def first_true(*reasons: tuple[bool, str]) -> str:
    """Words of the first reason that is given, "" for none."""
    return next((words for given, words in reasons if given), "")


_EMPTY = np.zeros(0)
_NOTHING = Reading(
    0.0, np.zeros(0, dtype=np.intp), _EMPTY, _EMPTY, _EMPTY, np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool),
    math.nan, np.full(3, math.nan), np.zeros(3), np.full(3, math.nan),
)  # fmt: skip


def _sightings(reading: Reading | None) -> tuple[Reading, str]:
    """A reading with those sightings only that can be, and what was wrong with the others."""
    if reading is None:
        return _NOTHING, "nothing came"
    try:
        ids, kinds = np.asarray(reading.ids, dtype=np.intp), np.asarray(reading.kinds, dtype=np.intp)
        moving = np.asarray(reading.moving, dtype=bool)
        bearings, ranges, radii = (
            np.asarray(v, dtype=np.float64) for v in (reading.bearings, reading.ranges, reading.radii)
        )
    except (TypeError, ValueError, OverflowError):
        return _NOTHING, "not numbers"
    if any(np.shape(column) != (np.size(ids),) for column in (ids, bearings, ranges, radii, kinds, moving)):
        return _NOTHING, "columns of several lengths"
    good: BoolArray = (
        np.isfinite(bearings) & np.isfinite(ranges) & np.isfinite(radii) & (ranges >= 0.0) & (radii >= 0.0)
    )
    if good.all():
        return reading, ""
    return reading.only(good), "sightings that cannot be"


def _emptiness(ranges: Array, min_range: float) -> str:
    """Why a scan holds next to nothing."""
    kinds = {
        "no beam came back (not numbers)": np.isnan(ranges).sum(),
        "no beam came back (out of range)": (ranges > 0.0).sum(),
        "beams shorter than can be": (ranges < min_range).sum(),
    }
    return max(kinds, key=lambda kind: kinds[kind])


def _numbers(value: object, shape: tuple[int, ...]) -> Array | None:
    """An array of that shape, or None."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.shape == shape else None


def _number(value: object) -> float:
    """A number; NaN for what is none."""
    number = _numbers(value, ())
    return math.nan if number is None else float(number)


def _bounded(value: object, count: int, most: float) -> bool:
    """Return True for so many finite numbers, none beyond a bound."""
    numbers = _numbers(value, (count,))
    return numbers is not None and bool((np.abs(numbers) <= most).all())
