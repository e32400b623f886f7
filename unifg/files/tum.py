"""Trajectories in the TUM format: one line ``t tx ty tz qx qy qz qw`` per pose, read by evo and most SLAM tools.

Exactly eight fields separated by single blanks, no trailing blank, the quaternion with its scalar LAST
(xyzw). Planar poses are lifted to z = 0 and a rotation about z. Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, require_finite, write_rows
from unifg.files.text import Table, norms
from unifg.typing import Array, ArrayLike

__all__ = ["read_tum", "write_tum"]

logger = logging.getLogger("unifg")

_LATEST = 1e11  # [s] since 1970, three thousand years
_FIELDS = "t tx ty tz qx qy qz qw"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes:
        time: (n,) [s].
        position: (n, 3) [m].
        quaternion_xyzw: (n, 4), of norm one, scalar last.
    """

    time: Array
    position: Array
    quaternion_xyzw: Array

    def planar(self) -> Array:
        """The poses seen from above: (n, 3) x, y, heading [m, m, rad]; height and tilt are dropped."""
        x, y, z, w = self.quaternion_xyzw.T
        heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return np.column_stack([self.position[:, :2], heading])


def write_tum(path: str | Path, time: ArrayLike, poses: ArrayLike) -> Path:
    """Write poses with nine decimals; planar ones are lifted to z = 0.

    Args:
        path: file to write; an existing one is replaced.
        time: (n,) [s].
        poses: (n, 3) x, y, heading [m, m, rad], or (n, 7) poses of `unifg.SE3`.

    Returns:
        The path written.

    Raises:
        FileFormatError: the arrays do not fit each other, or a number is not finite.
    """
    times, array = np.asarray(time, dtype=np.float64), np.asarray(poses, dtype=np.float64)
    if times.ndim != 1 or array.shape not in ((len(times), 3), (len(times), 7)):
        raise FileFormatError(
            f"{path}: time {times.shape} and poses {array.shape} must be (n,) and (n, 3) or (n, 7) of the same n"
        )
    require_finite(path, "time and pose", np.column_stack([times, array]))
    rows = np.column_stack([times, array[:, :3], array[:, 4:], array[:, 3:4]])  # the scalar goes last
    if array.shape == (len(times), 3):
        zero = np.zeros_like(times)
        half = array[:, 2] / 2.0
        rows = np.column_stack([times, array[:, :2], zero, zero, zero, np.sin(half), np.cos(half)])
    rows = np.round(rows, 9) + 0.0  # the sum turns -0.0 into 0.0
    return write_rows(path, [rows], spelled="{:.9f}".format, separator=" ")


def read_tum(path: str | Path, limits: Limits = LIMITS) -> Trajectory:
    """Read a trajectory; empty lines and lines starting with ``#`` are skipped, quaternions are normalised.

    Warnings name times that run backwards or are no seconds, and a first quaternion whose scalar seems to be first.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.

    Returns:
        The trajectory, in the order of the file.

    Raises:
        FileFormatError: the file is missing or holds no pose, or a line (named in the message) is not eight finite
            numbers with a usable quaternion.
    """
    rows = Table.read(path, 0, _FIELDS, limits)
    rows.require_lines("a pose")
    table = rows.numbers
    rows.remark_order()
    if abs(table[0, 0]) > _LATEST:
        logger.warning("%s: the time %g is read as seconds; divide nanoseconds by 1e9", rows.place(0), table[0, 0])
    if (np.abs(table[0, 4:]) == [1.0, 0.0, 0.0, 0.0]).all():
        logger.warning(
            "%s: the scalar is read last, so that the body lies on its back; is it first here?", rows.place(0)
        )
    return Trajectory(table[:, 0], table[:, 1:4], table[:, 4:] / norms(table[:, 4:], rows.place)[:, None])
