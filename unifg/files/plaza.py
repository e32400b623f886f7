"""Logs of a lawn mower with radio ranges to beacons (Plaza): two text files of numbers separated by blanks.

- ``Plaza1_DR.txt``: time [s], distance [m] and turn [rad] since the line before
- ``Plaza1_TD.txt``: time [s], number of the sender on the robot, number of the beacon, range [m]

J. Djugash, B. Hamner, S. Roth, "Navigating with ranging radios: five data sets with ground truth", Journal of Field
Robotics 26(9), 2009.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unifg.files.contents import LIMITS, Limits, write_rows
from unifg.files.text import Table
from unifg.typing import Array

__all__ = ["PlazaLog", "read_plaza", "write_plaza"]


@dataclass(frozen=True, eq=False)
class PlazaLog:
    """Odometry and ranges of a log by one clock; times do not run backwards.

    Attributes:
        odometry_time: (n,) [s].
        steps: (n, 2) distance and turn since the time before [m, rad].
        time: (m,) of the ranges [s].
        sender: (m,) numbers of antennas on the robot.
        beacon: (m,) numbers of the beacons.
        measured: (m,) ranges [m].
    """

    odometry_time: Array
    steps: Array
    time: Array
    sender: NDArray[np.int64]
    beacon: NDArray[np.int64]
    measured: Array


def read_plaza(odometry: str | Path, ranges: str | Path, limits: Limits = LIMITS) -> PlazaLog:
    """Read a log; lines whose time runs backwards are sorted, and named in one warning for each file.

    Args:
        odometry: the file of dead reckoning, gzipped or not.
        ranges: the file of ranges.
        limits: of what each may hold.

    Raises:
        FileFormatError: a file is missing, or a line, named in the message, has the wrong number of fields, no finite
            numbers, a sender or beacon that is no whole number, or a range below zero; or there is no odometry.
    """
    moves = Table.read(odometry, 0, "time distance turn", limits)
    moves.require_lines("odometry")
    seen = Table.read(ranges, 0, "time sender beacon range", limits)
    seen.refuse(seen.numbers[:, 3] < 0.0, "the range is below zero")
    motion, order = moves.numbers[moves.in_time()], seen.in_time()
    return PlazaLog(
        motion[:, 0], motion[:, 1:], seen.numbers[order, 0],
        seen.whole(1, "sender")[order], seen.whole(2, "beacon")[order], seen.numbers[order, 3],
    )  # fmt: skip


def write_plaza(odometry: str | Path, ranges: str | Path, log: PlazaLog) -> None:
    """Write a log so that reading it gives the same numbers, bit by bit.

    Args:
        odometry: file to write; an existing one is replaced.
        ranges: as well.
        log: what to write.

    Raises:
        FileFormatError: a number is not finite, or arrays that belong together differ in length.
    """
    write_rows(odometry, [log.odometry_time, log.steps], "time distance turn")
    write_rows(ranges, [log.time, log.sender, log.beacon, log.measured], "time sender beacon range")
