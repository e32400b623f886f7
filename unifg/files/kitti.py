"""Trajectories in the KITTI format: one line per pose, the 3 x 4 matrix [R t] row by row, without times.

Format: the README of https://www.cvlibs.net/datasets/kitti/eval_odometry.php.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, require_finite, write_rows
from unifg.files.text import NEAR, Table
from unifg.lie import SE2, SE3
from unifg.typing import Array, ArrayLike

__all__ = ["read_kitti", "write_kitti"]

logger = logging.getLogger("unifg")

_FIELDS = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
_ROTATION = 1e-2  # largest |R'R - I| that rounding and single precision excuse


def read_kitti(path: str | Path, limits: Limits = LIMITS) -> Array:
    """Read poses; empty lines and comments are skipped, matrices are moved to the nearest rotation.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.

    Returns:
        (n, 7) poses of `unifg.SE3`.

    Raises:
        FileFormatError: the file is missing or holds no pose, or a line (named in the message) is not twelve finite
            numbers with a rotation among them.
    """
    rows = Table.read(path, 0, _FIELDS, limits)
    rows.require_lines("a pose")
    matrices = rows.numbers.reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    with np.errstate(all="ignore"):
        off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2), initial=0.0)
        right = (off < _ROTATION) & (np.linalg.det(rotations) > 0.0)
    rows.refuse(~right, "columns 1 to 3, 5 to 7, 9 to 11 are not a rotation matrix")
    if (far := np.flatnonzero(off > 2.0 * NEAR)).size:  # of R'R, which is twice as far as R
        logger.warning(
            "%d of %d rotation matrices are farther than %g from a rotation, and the nearest is taken; first: %s",
            len(far), len(off), NEAR, rows.place(int(far[0])),
        )  # fmt: skip
    full = np.tile(np.eye(4), (len(matrices), 1, 1))
    full[:, :3] = matrices
    return SE3.from_matrix(full)


def write_kitti(path: str | Path, poses: ArrayLike) -> Path:
    """Write poses so that the same numbers are read; planar ones are lifted to z = 0.

    Args:
        path: file to write; an existing one is replaced.
        poses: (n, 7) of `unifg.SE3`, or (n, 3) of `unifg.SE2`.

    Returns:
        The path written.

    Raises:
        FileFormatError: the array has another shape, or a number is not finite.
    """
    array = np.asarray(poses, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in (3, 7):
        raise FileFormatError(f"{path}: poses have shape {array.shape}, expected (n, 7) or (n, 3)")
    require_finite(path, "pose", array)
    rows = np.zeros((len(array), 3, 4))
    if array.shape[1] == 7:
        rows[:] = SE3.matrix(array)[:, :3]
    else:
        rows[:, 2, 2] = 1.0
        rows[:, :2, [0, 1, 3]] = SE2.matrix(array)[:, :2]
    return write_rows(path, [rows.reshape(-1, 12) + 0.0], separator=" ")  # no -0.0
