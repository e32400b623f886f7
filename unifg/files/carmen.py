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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits
from unifg.files.text import TextFile, decimal
from unifg.typing import Array, IntArray

__all__ = ["read_carmen"]

logger = logging.getLogger("unifg")

_READ = ("ODOM", "FLASER", "ROBOTLASER1")
_WIDEST = 8.0 * math.pi  # where the first beam points and how far the others reach [rad]
_LASER = ("type", "start_angle", "field_of_view", "resolution", "maximum_range", "accuracy", "remission_mode")
_POSES, _ENDING = "x y theta odom_x odom_y odom_theta", "time - since"  # fields called - are not read


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


def read_carmen(path: str | Path, field_of_view: float = math.pi, limits: Limits = LIMITS) -> CarmenLog:
    """Read a log, gzipped or not.

    Negative ranges, times that run backwards, and a field of view that is not that of the beams, are named in one
    warning each.

    Args:
        path: the file.
        field_of_view: of FLASER scans [rad]. They start at minus half of it; an odd number of beams reaches the other
            end, an even one stops a step short (180 and 181 beams: one degree; 360 and 361: half a degree).
        limits: of what the file may hold.

    Raises:
        FileFormatError: the file is missing or holds none of the lines that are read, or a line, named in the message,
            is too short or has something else where a number should be.
    """
    file = TextFile.read(path, limits)
    if not any(tag in file for tag in _READ):
        raise FileFormatError(f"{file.path}: no line begins with {', '.join(_READ)}: is this a CARMEN log?")
    motions = file.table("ODOM", 0, f"x y theta tv rv - {_ENDING}")
    groups: dict[tuple[str | float, ...], list[int]] = {}
    for row in np.flatnonzero(np.isin(file.kind, [file.tags.get(tag, -1) for tag in _READ[1:]])).tolist():
        groups.setdefault(_configuration(file, row), []).append(row)
    scans = [_scans(file, key, np.array(rows), field_of_view) for key, rows in groups.items()]
    back = {"ODOM": motions.numbers[:, -1]} | {f"laser {k}": laser.time for k, laser in enumerate(scans)}
    said = [f"{count} times in {kind}" for kind, time in back.items() if (count := (np.diff(time) < 0.0).sum())]
    if said:
        logger.warning("%s: time runs backwards: %s", file.path, ", ".join(said))
    negative = sum(int((laser.ranges < 0.0).sum()) for laser in scans)
    if negative:
        logger.warning(
            "%s: %d ranges of scans are negative: lasers say so where they have measured nothing", file.path, negative
        )
    odometry = Odometry(motions.numbers[:, -1], motions.numbers[:, :3], motions.numbers[:, 3:5])
    return CarmenLog(odometry, tuple(scans), file.others(set(_READ)))


def _configuration(file: TextFile, row: int) -> tuple[str | float, ...]:
    """Tag, readings and remissions of a scan and, where they stand there, start, field of view, step, maximum range.

    Raises:
        FileFormatError: the line is too short, or has something else in the place of these.
    """
    words, front = file.words(row), file.kind[row] == file.tags.get("FLASER")
    tag, first = ("FLASER", 0) if front else ("ROBOTLASER1", len(_LASER))
    place = f"{file.place(row)}: {tag}"

    def readings(at: int) -> int:
        if at < len(words) and not words[at].isdecimal():
            raise FileFormatError(f"{place}: {words[at]!r} is not a number of readings")
        if at >= len(words) or at + int(words[at]) >= len(words):
            raise FileFormatError(f"{place}: {len(words)} fields are too few")
        return int(words[at])

    count = readings(first)
    if front:
        return tag, count, 0
    remissions = readings(first + 1 + count)
    start, view, step, maximum = (decimal(f"{place}: field {_LASER[k]}", words[k]) for k in (1, 2, 3, 4))
    if not abs(start) + count * abs(step) < _WIDEST:
        raise FileFormatError(f"{place}: {count} beams from {start:g} rad in steps of {step:g} rad are no scan")
    return tag, count, remissions, start, view, step, maximum


def _scans(file: TextFile, key: tuple[Any, ...], rows: IntArray, field_of_view: float) -> Scans:
    """The scans of one configuration."""
    tag, count, remissions, *laser = key
    ranges = " ".join(f"r{k}" for k in range(1, count + 1))
    if laser:
        start, view, step, maximum = laser
        if abs(abs(view) - (count - 0.5) * abs(step)) > 1.6 * abs(step):  # loggers count beams or the steps between
            logger.warning(
                "%s: a field of view of %g rad is not that of %d beams in steps of %g rad, by which it is read",
                file.place(int(rows[0])), view, count, step,
            )  # fmt: skip
        head, tail, ignored = f"{'- ' * len(_LASER)}-", "- - - - -", f"- {'- ' * remissions}"
    else:
        step = field_of_view / max(count - count % 2, 1)
        start, maximum, head, tail, ignored = -0.5 * field_of_view, math.inf, "-", "", ""
    numbers = file.table(tag, 0, f"{head} {ranges} {ignored} {_POSES} {tail} {_ENDING}", rows).numbers
    first = len(head.split())
    poses = first + count + len(ignored.split())
    return Scans(
        numbers[:, -1], start + step * np.arange(count, dtype=np.float64), numbers[:, first : first + count],
        numbers[:, poses : poses + 3], numbers[:, poses + 3 : poses + 6], maximum,
    )  # fmt: skip
