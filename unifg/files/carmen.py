"""Robot logs of the CARMEN toolkit: odometry and planar laser scans (lines ODOM, FLASER and ROBOTLASER1).

Format: http://carmen.sourceforge.net/logger_playback.html. A line ends in a time, the name of a computer and the time
since the log began:

- ``ODOM x y theta tv rv accel``
- ``FLASER n r1 ... rn x y theta odom_x odom_y odom_theta``: the older kind, which says nothing about directions
- ``ROBOTLASER1 type start_angle field_of_view resolution maximum_range accuracy remission_mode n r1 ... rn m i1 ... im
  x y theta odom_x odom_y odom_theta tv rv forward side turn_axis``
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible, read_text
from unifg.files.fields import decimal
from unifg.typing import Array

__all__ = ["CarmenLog", "Odometry", "Scans", "read_carmen"]

logger = logging.getLogger("unifg")

_READ = ("ODOM", "FLASER", "ROBOTLASER1")
_WIDEST = 8.0 * math.pi  # where the first beam points and how far the others reach [rad]
_ENDING = 3  # time, computer, time since the beginning


@dataclass(frozen=True, eq=False)
class Odometry:
    """Wheel odometry.

    Attributes:
        time: (n,) time of the logger [s].
        pose: (n, 3) x, y, heading [m, m, rad].
        velocity: (n, 2) forward and turning speed [m/s, rad/s].
    """

    time: Array
    pose: Array
    velocity: Array


@dataclass(frozen=True, eq=False)
class Scans:
    """Scans of one laser in one configuration.

    Attributes:
        time: (n,) time of the logger [s].
        angles: (b,) directions of the beams in the frame of the laser [rad].
        ranges: (n, b) distances [m], as they stand in the file.
        pose: (n, 3) of the laser: corrected by SLAM in published logs, odometry otherwise.
        robot: (n, 3) of the robot, from odometry.
        maximum: readings from here on mean that nothing was hit [m]; infinite where the file does not say.
    """

    time: Array
    angles: Array
    ranges: Array
    pose: Array
    robot: Array
    maximum: float

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.time)


@dataclass(frozen=True, eq=False)
class CarmenLog:
    """A log.

    Attributes:
        odometry: all ODOM lines.
        scans: laser scans, by configuration in the order of their first line; most logs have one.
        skipped: kinds of lines that are not read, with their counts.
    """

    odometry: Odometry
    scans: tuple[Scans, ...]
    skipped: dict[str, int]


@dataclass
class _Group:
    """Scans of one configuration while reading."""

    angles: Array
    maximum: float
    rows: list[list[float]] = field(default_factory=list)  # time, poses, ranges


def read_carmen(path: str | Path, field_of_view: float = math.pi, limits: Limits = LIMITS) -> CarmenLog:
    """Read a log, gzipped or not; negative ranges, and times that run backwards, are named in one warning each.

    Args:
        path: the file.
        field_of_view: of FLASER scans [rad]. They start at minus half of it; an odd number of beams reaches the other
            end, an even one stops a step short (180 and 181 beams: one degree; 360 and 361: half a degree).
        limits: of what the file may hold.

    Raises:
        FileFormatError: the file is missing or holds none of the lines that are read, or a line, named in the message,
            is too short or has something else where a number should be.
    """
    name = legible(path)
    motions: list[list[float]] = []
    groups: dict[tuple[float | str, ...], _Group] = {}
    skipped: dict[str, int] = {}
    for number, line in enumerate(read_text(path, limits).split("\n"), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        tag = words[0]
        if tag not in _READ:
            skipped[tag] = skipped.get(tag, 0) + 1
            continue
        try:
            if tag == "ODOM":
                motions.append(_motion(words))
            elif tag == "FLASER":
                _front_laser(words, groups, field_of_view)
            else:
                _robot_laser(words, groups)
        except (FileFormatError, IndexError) as error:
            raise FileFormatError(f"{name}, line {number}: {tag}: {error}") from None
    if not motions and not groups:
        raise FileFormatError(f"{name}: no line begins with {', '.join(_READ)}: is this a CARMEN log?")
    table = np.array(motions, dtype=np.float64).reshape(-1, 6)
    _report(name, table[:, 0], list(groups.values()))
    return CarmenLog(
        Odometry(table[:, 0], table[:, 1:4], table[:, 4:]),
        tuple(_scans(group) for group in groups.values()),
        skipped,
    )


def _report(name: str, odometry: Array, groups: list[_Group]) -> None:
    """Warn of what is readable and cannot be."""
    times = {"ODOM": odometry} | {f"laser {k}": np.array([row[0] for row in g.rows]) for k, g in enumerate(groups)}
    back = {kind: int((np.diff(values) < 0.0).sum()) for kind, values in times.items()}
    if any(back.values()):
        said = ", ".join(f"{count} times in {kind}" for kind, count in back.items() if count)
        logger.warning("%s: time runs backwards: %s", name, said)
    negative = sum(value < 0.0 for group in groups for row in group.rows for value in row[7:])
    if negative:
        logger.warning(
            "%s: %d ranges of scans are negative: lasers say so where they have measured nothing", name, negative
        )


def _motion(words: list[str]) -> list[float]:
    """Time, pose and velocity of an ODOM line."""
    _require(words, 7 + _ENDING)
    return [_number(words[-1]), *map(_number, words[1:6])]


def _front_laser(words: list[str], groups: dict[tuple[float | str, ...], _Group], field_of_view: float) -> None:
    count = _count(words[1])
    _require(words, 2 + count + 6 + _ENDING)
    key = (words[0], count)
    if key not in groups:
        step = field_of_view / max(count - count % 2, 1)
        groups[key] = _Group(-0.5 * field_of_view + step * np.arange(count, dtype=np.float64), math.inf)
    _append(groups[key], words, 2, count, 2 + count)


def _robot_laser(words: list[str], groups: dict[tuple[float | str, ...], _Group]) -> None:
    start, _, step, maximum = (_number(words[k]) for k in (2, 3, 4, 5))
    count = _count(words[8])
    remissions = _count(words[9 + count])
    poses = 10 + count + remissions
    _require(words, poses + 11 + _ENDING)
    key = (words[0], count, start, step, maximum)
    if not abs(start) + count * abs(step) < _WIDEST:
        raise FileFormatError(f"{count} beams from {start:g} rad in steps of {step:g} rad are no scan")
    if key not in groups:
        groups[key] = _Group(start + step * np.arange(count, dtype=np.float64), maximum)
    _append(groups[key], words, 9, count, poses)


def _append(group: _Group, words: list[str], ranges: int, count: int, poses: int) -> None:
    numbers = [*words[poses : poses + 6], *words[ranges : ranges + count]]
    group.rows.append([_number(words[-1]), *map(_number, numbers)])


def _scans(group: _Group) -> Scans:
    table = np.array(group.rows, dtype=np.float64)
    return Scans(table[:, 0], group.angles, table[:, 7:], table[:, 1:4], table[:, 4:7], group.maximum)


def _require(words: list[str], count: int) -> None:
    if len(words) != count:
        raise FileFormatError(f"{len(words)} words, expected {count}")


def _count(word: str) -> int:
    if not word.isdecimal():
        raise FileFormatError(f"{word!r} is not a number of readings")
    return int(word)


def _number(word: str) -> float:
    try:
        value = decimal(word)
    except ValueError:
        raise FileFormatError(f"{word!r} is not a number") from None
    if not math.isfinite(value):
        raise FileFormatError(f"{word} is not a finite number")
    return value
