"""Logs of a planar laser and of odometry, from whatever file holds them: CARMEN, CSV, MCAP, rosbag2, drives of unifg.

A CSV file is one table with a header. ``time`` [s], ``x``, ``y`` [m] and ``theta`` [rad] are the odometry;
``corrected_x``, ``corrected_y`` and ``corrected_theta``, where a reference is known, the poses it says; every other
column is a beam, and its name a number: its direction [rad]. A range that is empty, not a number, or not above zero
is a beam that is lost; ``inf`` says that nothing was hit.
"""

from __future__ import annotations

import csv
import io
import logging
import math
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.carmen import CarmenLog, Odometry, Scans, read_carmen
from unifg.files.contents import LIMITS, Limits, legible, read_text, suffix_of
from unifg.files.rosbag import read_rosbag
from unifg.files.text import number_of
from unifg.lie import SE2, wrap_angle
from unifg.typing import Array

__all__ = ["RangeLog", "aligned", "read_range_log"]

logger = logging.getLogger("unifg")

POSE = ("x", "y", "theta")
FIXED = 0.02  # [m, rad] by which the place of a laser on its robot may seem to change, as logs round
PARTED = 1.0  # [m] between wheels and poses of scans, laid on each other, from where on the latter are corrected
SLOWEST = 0.005  # [m/s]; who is slower counts time in thousandths
FASTEST = 100.0  # [m/s]; who is faster counts no metres
FARTHEST = 300.0  # [m], beyond which half of the ranges are in millimetres
AT_MOST = 0.99  # of the longest range
OFTEN, PEAK = 0.005, 3.0  # share of the ranges there, and over those a little shorter, if it means that nothing was hit
LONGEST = 10**6  # characters of a line, which has no blanks
ROUND = 2.0 * math.pi + 0.1  # beyond which a direction is in degrees [rad]
ROSBAGS = (".mcap", ".bag", ".db3")
UNREADABLE = (
    OSError, ValueError, LookupError, TypeError, RuntimeError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class RangeLog:
    """Scans of one laser, in the order of time.

    Attributes:
        name: of the file.
        time: (n,) [s].
        angles: (b,) directions of the beams in the frame of the laser, rising [rad].
        ranges: (n, b) [m]; NaN for a beam that is lost, infinite where nothing was hit.
        odometry: (n, 3) poses of the laser by the wheels [m, m, rad].
        corrected: (n, 3) poses of the laser that the log takes for right; None where it says nothing of the kind.
        placed: whether the log itself says where on the robot the laser stands.
    """

    name: str
    time: Array
    angles: Array
    ranges: Array
    odometry: Array
    corrected: Array | None = None
    placed: bool = False

    def __post_init__(self) -> None:
        """Refuse what is no log.

        Raises:
            FileFormatError: there are less than two scans, a time or a pose is not finite, or a direction is none.
        """
        numbers = np.column_stack([self.time, self.odometry, *([] if self.corrected is None else [self.corrected])])
        if len(self.time) < 2 or not len(self.angles) or not np.isfinite(numbers).all():
            raise FileFormatError(f"{self.name}: at least two scans with finite times and poses make a log")
        if odd := [angle for angle in self.angles.tolist() if not abs(angle) <= ROUND]:
            raise FileFormatError(f"{self.name}: {odd[0]:g} is no direction of a beam; directions are in radians")
        if (width := float(np.ptp(self.angles))) > ROUND:
            raise FileFormatError(f"{self.name}: beams {width:g} rad apart are more than a turn; are they in radians?")

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.time)

    def mounted(self, pose: Array) -> RangeLog:
        """The log of a laser at a pose (3,) on the robot whose odometry this is.

        Raises:
            FileFormatError: the log says itself where the laser stands.
        """
        if self.placed:
            raise FileFormatError(f"{self.name}: says itself where on the robot the laser stands: leave mount out")
        return replace(self, placed=True, odometry=SE2.compose(self.odometry, np.tile(pose, (len(self), 1))))


def read_range_log(path: str | Path, limits: Limits = LIMITS) -> RangeLog:
    """Read a log: CARMEN or ``.csv``, gzipped or not; MCAP, rosbag2 (a folder), rosbag; ``.npz`` of a drive.

    Of several lasers, that with most scans is taken. Of a CARMEN log whose scans bear corrected poses, the odometry is
    that of the robot, or of the ODOM lines where the robot's poses are corrected, too. Times in milliseconds or smaller
    units become seconds. Without a stated maximum, the longest range means that nothing was hit where it is frequent.

    Args:
        path: the file.
        limits: of what it may hold.

    Raises:
        FileFormatError: the file cannot be read, or its numbers would be absurd in metres, radians and seconds.
        ImportError: a package that reads it is not installed; the message names it.
    """
    path = Path(path)
    if suffix_of(path) == ".csv":
        return _table(path, limits)
    name = legible(path.name)
    if path.suffix == ".npz":
        return _drive(path, limits)
    if path.is_dir() or path.suffix in ROSBAGS:
        recorded = read_rosbag(path)
        return replace(_in_order(name, *recorded[:5], None), placed=recorded.placed)
    log = read_carmen(path, limits=limits)
    if not log.scans:
        raise FileFormatError(f"{name}: there is no scan in this log")
    scans = max(log.scans, key=len)
    if len(log.scans) > 1:
        logger.warning("%s: %d kinds of scans, of which %d of one kind are taken", name, len(log.scans), len(scans))
    odometry, corrected, placed = _poses(log, scans)
    seen = np.isfinite(odometry[:, 0])
    if not seen.all():
        logger.warning("%s: %d of %d scans left out: no ODOM line then", name, len(seen) - seen.sum(), len(seen))
    odometry, corrected = odometry[seen], None if corrected is None else corrected[seen]
    found = _in_order(name, scans.time[seen], scans.angles, scans.ranges[seen], scans.maximum, odometry, corrected)
    return replace(found, placed=placed)


def _drive(path: Path, limits: Limits) -> RangeLog:
    """The log of a simulated drive: dead reckoning is its odometry, true poses are the corrected ones."""
    try:
        with path.open("rb") as own, zipfile.ZipFile(own) as parts, np.load(own, allow_pickle=False) as file:
            if sum(part.file_size for part in parts.infolist()) > limits.unpacked:
                raise FileFormatError(f"{legible(path)} holds more than {limits.unpacked} bytes")
            columns = ("time", "scan_angles", "scan", "dead_reckoning", "true_pose")
            time, angles, ranges, wheels, truth = (np.asarray(file[name], dtype=np.float64) for name in columns)
        count, beams = len(time), len(angles)
        if (ranges.shape, wheels.shape, truth.shape) != ((count, beams), (count, 3), (count, 3)):
            raise FileFormatError(f"{legible(path)} is no drive.npz of `unifg run`: its columns do not fit each other")
    except UNREADABLE as e:
        raise FileFormatError(f"{legible(path)} is no drive.npz of `unifg run`: {e}") from e
    return _in_order(legible(path.name), time, angles, ranges, math.inf, wheels, truth)


def aligned(poses: Array, onto: Array) -> Array:
    """Poses (n, 3) moved as one whole to where their places are nearest to others (n, 3), by least squares."""
    middle, other = poses[:, :2].mean(axis=0), onto[:, :2].mean(axis=0)
    product = (poses[:, :2] - middle).T @ (onto[:, :2] - other)
    turn = float(np.arctan2(product[0, 1] - product[1, 0], product[0, 0] + product[1, 1]))
    whole = np.array([*(other - SE2.act(np.array([0.0, 0.0, turn]), middle[None])[0]), turn])
    return SE2.compose(whole, poses)


def _poses(log: CarmenLog, scans: Scans) -> tuple[Array, Array | None, bool]:
    """Odometry of the laser (n, 3), its corrected poses where these are, and whether it is off the robot's middle."""
    mounts = SE2.between(scans.robot, scans.pose)
    off = mounts - mounts[0]
    off[:, 2] = wrap_angle(off[:, 2])
    if np.abs(off).max() > FIXED:
        return scans.robot, scans.pose, False
    placed = bool(np.abs(mounts[0]).max() > FIXED)
    if len(log.odometry.time) < 2:
        return scans.pose, None, placed
    wheels = SE2.compose(_between_times(log.odometry, scans.time), mounts[0])
    seen = np.isfinite(wheels[:, 0])
    parted = np.abs(aligned(wheels[seen], scans.pose[seen]) - scans.pose[seen])[:, :2].max() if seen.any() else 0.0
    return (wheels, scans.pose, placed) if parted > PARTED else (scans.pose, None, placed)


def _between_times(odometry: Odometry, time: Array) -> Array:
    """Poses (n, 3) at some times (n,), straight between those that are known, NaN before and after all of them."""
    order = np.argsort(odometry.time, kind="stable")
    x, y, heading = odometry.pose[order].T
    columns = (x, y, np.unwrap(heading))
    return np.column_stack([np.interp(time, odometry.time[order], column, np.nan, np.nan) for column in columns])


def _in_order(
    name: str, time: Array, angles: Array, ranges: Array, maximum: float, odometry: Array, corrected: Array | None
) -> RangeLog:
    """The log in the order of time and of beams, in seconds, with readings that mean something."""
    if not len(time):
        raise FileFormatError(f"{name}: there is no scan in this log")
    order, beams = np.argsort(time, kind="stable"), np.argsort(angles, kind="stable")
    time, odometry, ranges = time[order], odometry[order], ranges[np.ix_(order, beams)]
    corrected = None if corrected is None else corrected[order]
    steps = np.hypot(*np.diff(odometry[:, :2], axis=0).T)
    drove = 2.0 * len(steps) * steps >= steps.sum()  # who stands for hours says nothing of the unit
    way, lasted = steps[drove].sum(), np.diff(time)[drove].sum()
    unit = 1.0
    while way > 1.0 and way < SLOWEST * lasted / unit:
        unit *= 1e3
    if unit > 1.0:
        logger.warning("%s: nothing would move in these times: taken for units of 1/%g s", name, unit)
    with np.errstate(invalid="ignore"):
        ranges = np.where(ranges > 0.0, ranges, np.nan)  # NaN stays
        seen, stated = ranges[np.isfinite(ranges)], 0.0 < maximum < math.inf
        top = maximum if stated else seen.max(initial=0.0)
        longest, shorter = (int((seen > share * top).sum()) for share in (AT_MOST, 2.0 * AT_MOST - 1.0))
        if stated or longest > max(OFTEN * len(seen), PEAK * (shorter - longest)):
            ranges = np.where(ranges > AT_MOST * top, np.inf, ranges)
    turns, half = np.abs(np.diff(odometry[:, 2])), np.median(seen) if len(seen) else 0.0
    driven = np.arctan2(*np.diff(odometry[:, 1::-1], axis=0).T)
    ahead = [  # 1 for who drives where headings point, or away from it, in radians, and in degrees
        float(steps @ np.cos(2.0 * (driven - heading))) / max(float(steps.sum()), SLOWEST)
        for heading in (odometry[:-1, 2], np.radians(odometry[:-1, 2]))
    ]
    whole = bool(np.ptp(odometry[:, 2]) > ROUND)
    units = (
        (whole and ahead[0] < 0.5 and ahead[1] > 0.9, "the way goes where headings of degrees point: radians"),
        (way > max(1.0, FASTEST * lasted / unit), f"{way:g} m are driven in {lasted / unit:g} s: metres and seconds"),
        ((turns > ROUND).sum() > 1, f"headings turn by up to {turns.max(initial=0.0):g} between two scans: radians"),
        (half > FARTHEST, f"half of the ranges are beyond {half:g}: metres"),
    )
    if odd := [said for wrong, said in units if wrong]:
        raise FileFormatError(f"{name}: {odd[0]} are read; convert the log")
    return RangeLog(name, time / unit, angles[beams], ranges, odometry, corrected)


def _table(path: Path, limits: Limits) -> RangeLog:
    """The log of a CSV file."""
    name, lines = (
        legible(path.name),
        list(csv.reader(io.StringIO(read_text(path, replace(limits, digits=LONGEST)), newline=""))),
    )
    header = [word.strip() for word in lines[0]] if lines else []
    beams = [k for k, word in enumerate(header) if number_of(word) is not None]
    if missing := [word for word in ("time", *POSE) if word not in header] + ["beam"] * (not beams):
        raise FileFormatError(f"{name}: the header has no {', '.join(missing)}; it needs time, x, y, theta and beams")
    if twice := [word for k, word in enumerate(header) if word in header[:k]]:
        raise FileFormatError(f"{name}: the header has {twice[0]!r} twice; leave one of the columns out")
    rows = [line for line in lines[1:] if line]
    values = np.empty((len(rows), len(header)))
    for number, row in enumerate(rows):
        found = [number_of(word or "nan") for word in row]
        if len(row) != len(header) or None in found:
            raise FileFormatError(f"{name}: row {number + 1} is not {len(header)} numbers, as in the header")
        values[number] = found
    poses = ["time", *POSE]
    corrected = [f"corrected_{word}" for word in POSE]
    columns = {word: k for k, word in enumerate(header)}
    reference = values[:, [columns[word] for word in corrected]] if set(corrected) <= set(header) else None
    poses += corrected if reference is not None else []
    if left := [word for k, word in enumerate(header) if word not in poses and k not in beams]:
        logger.warning("%s: columns left out, whose names are no directions: %s", name, ", ".join(map(repr, left[:5])))
    for word in poses:
        if (lost := np.flatnonzero(~np.isfinite(values[:, columns[word]]))).size:
            raise FileFormatError(f"{name}: row {lost[0] + 1}: {word} is {values[lost[0], columns[word]]}, not finite")
    angles, odometry = np.array([float(header[k]) for k in beams]), values[:, [columns[word] for word in POSE]]
    return _in_order(name, values[:, columns["time"]], angles, values[:, beams], np.inf, odometry, reference)
