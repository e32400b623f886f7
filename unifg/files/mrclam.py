"""Logs of the UTIAS multi-robot cooperative localisation and mapping dataset: robots that see barcodes in a room.

A folder holds, in lines of numbers separated by blanks, ``#`` before comments:

================================ ==================================================================================
``Barcodes.dat``                 subject, barcode: what robots (1 to 5) and landmarks (from 6 on) bear
``Landmark_Groundtruth.dat``     subject, x, y [m], and their standard deviations [m]
``Robot1_Odometry.dat``          time [s], forward velocity [m/s], turning velocity [rad/s], held until the next line
``Robot1_Measurement.dat``       time [s], *barcode* (not subject), range [m], bearing [rad]
``Robot1_Groundtruth.dat``       time [s], x, y [m], heading [rad]
================================ ==================================================================================

K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR
30(8), 2011.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unifg.files.contents import LIMITS, Limits, write_rows
from unifg.files.text import Table
from unifg.typing import Array

__all__ = ["NOBODY", "MrclamLog", "read_mrclam", "write_mrclam"]

logger = logging.getLogger("unifg")

NOBODY = -1
"""Subject of a barcode that is nobody's: the camera has misread it."""

_TURN = 2.0 * np.pi


@dataclass(frozen=True, eq=False)
class MrclamLog:
    """Log of one robot, with the ground truth of the room.

    Times are seconds by one clock for all robots of a folder, since 1970 in published logs, and do not run backwards.

    Attributes:
        odometry_time: (n,) [s].
        velocity: (n, 2) forward and turning [m/s, rad/s], each held until the next.
        time: (m,) of sightings [s].
        barcode: (m,) that were read.
        subject: (m,) that bear them; `NOBODY` where none does.
        measured: (m, 2) bearing [rad] and range [m], in this order as everywhere in unifg.
        barcodes: barcode of every subject, robots among them.
        landmark_ids: (k,) subjects that are landmarks.
        landmarks: (k, 2) where they were surveyed [m].
        landmark_sigma: (k, 2) how well [m].
        truth_time: (t,) [s]; empty where no file says so.
        truth: (t, 3) x, y, heading [m, m, rad].
    """

    odometry_time: Array
    velocity: Array
    time: Array
    barcode: NDArray[np.int64]
    subject: NDArray[np.int64]
    measured: Array
    barcodes: dict[int, int]
    landmark_ids: NDArray[np.int64]
    landmarks: Array
    landmark_sigma: Array
    truth_time: Array
    truth: Array


def read_mrclam(folder: str | Path, robot: int = 1, limits: Limits = LIMITS) -> MrclamLog:
    """Read the log of one robot.

    Barcodes that nobody bears, headings beyond a turn, and lines whose time runs backwards, are named in one warning
    each; the latter are sorted.

    Args:
        folder: of the dataset.
        robot: number of the robot, in the names of its files.
        limits: of what each file may hold.

    Raises:
        FileFormatError: a file but for that of the robot's true poses is missing, or a line, named in the message, has
            the wrong number of fields or no finite numbers, names a subject, a barcode or a landmark twice, a range or
            a standard deviation below zero, or a bearing beyond a turn; or there is no odometry.
    """
    folder = Path(folder)
    bearers, owners = _barcodes(Table.read(folder / "Barcodes.dat", 2, "subject barcode", limits))
    surveyed = Table.read(folder / "Landmark_Groundtruth.dat", 1, "subject x y x_sigma y_sigma", limits)
    surveyed.distinct(surveyed.integers[:, 0], "landmark")
    surveyed.refuse(surveyed.numbers[:, 2:].min(axis=1) < 0.0, "a standard deviation is below zero")
    moves = Table.read(folder / f"Robot{robot}_Odometry.dat", 0, "time forward turning", limits)
    moves.require_lines("odometry")
    seen = Table.read(folder / f"Robot{robot}_Measurement.dat", 0, "time barcode range bearing", limits)
    seen.refuse(seen.numbers[:, 2] < 0.0, "the range is below zero")
    seen.refuse(np.abs(seen.numbers[:, 3]) > _TURN, "the bearing is beyond a turn: is it in radians?")
    truth_path, truth = folder / f"Robot{robot}_Groundtruth.dat", np.zeros((0, 4))
    if truth_path.exists():
        poses = Table.read(truth_path, 0, "time x y heading", limits)
        truth = poses.numbers[poses.in_time()]
        if (most := float(np.abs(truth[:, 3]).max(initial=0.0))) > _TURN:  # unwrapped ones are right, too
            logger.warning("%s: headings of up to %g are read as radians: are they degrees?", poses.path, most)
    order, motion = seen.in_time(), moves.numbers[moves.in_time()]
    barcode, sightings = seen.whole(1, "barcode")[order], seen.numbers[order]
    subject = np.array([owners.get(code, NOBODY) for code in barcode.tolist()], dtype=np.int64)
    unknown = subject == NOBODY
    if unknown.any():
        codes = ", ".join(map(str, np.unique(barcode[unknown])[:5]))
        logger.warning("%s: %d sightings of barcodes that nobody bears: %s", seen.path, int(unknown.sum()), codes)
    return MrclamLog(
        motion[:, 0], motion[:, 1:], sightings[:, 0], barcode, subject, sightings[:, [3, 2]], bearers,
        surveyed.integers[:, 0], surveyed.numbers[:, :2], surveyed.numbers[:, 2:], truth[:, 0], truth[:, 1:],
    )  # fmt: skip


def write_mrclam(folder: str | Path, log: MrclamLog, robot: int = 1) -> Path:
    """Write a log so that reading it gives the same numbers, bit by bit; files of other robots stay.

    Args:
        folder: where to write; made if it is not there.
        log: of one robot; its subjects are written as `barcode`, true poses if there are any.
        robot: number in the names of the robot's files.

    Returns:
        The folder.

    Raises:
        FileFormatError: a number is not finite.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    of_robot = f"Robot{robot}_"
    bearers = np.array([*log.barcodes.items()], dtype=np.int64).reshape(-1, 2)
    write_rows(folder / "Barcodes.dat", [bearers], "subject barcode")
    marks = [log.landmark_ids, log.landmarks, log.landmark_sigma]
    write_rows(folder / "Landmark_Groundtruth.dat", marks, "subject x y x_sigma y_sigma")
    write_rows(folder / f"{of_robot}Odometry.dat", [log.odometry_time, log.velocity], "time forward turning")
    sightings = [log.time, log.barcode, log.measured[:, ::-1]]
    write_rows(folder / f"{of_robot}Measurement.dat", sightings, "time barcode range bearing")
    if len(log.truth):
        write_rows(folder / f"{of_robot}Groundtruth.dat", [log.truth_time, log.truth], "time x y heading")
    return folder


def _barcodes(table: Table) -> tuple[dict[int, int], dict[int, int]]:
    """Barcodes by subject, and subjects by barcode."""
    for column, what in enumerate(("subject", "barcode")):
        table.distinct(table.integers[:, column], what)
    bearers = dict(zip(*(part.tolist() for part in table.integers.T), strict=True))
    return bearers, {code: subject for subject, code in bearers.items()}
