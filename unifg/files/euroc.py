"""Trajectories in the EuRoC format: CSV lines ``t, x, y, z, qw, qx, qy, qz, ...`` with times in whole nanoseconds.

What follows the quaternion (velocities and biases, in ``state_groundtruth_estimate0/data.csv``) is left out. Format:
M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 35(10), 2016.
"""

from __future__ import annotations

import re
import reprlib
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible, read_text
from unifg.files.text import decimal, norms
from unifg.files.tum import Trajectory

__all__ = ["read_euroc"]

_FIELDS = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
_WHOLE = re.compile(r"[0-9]{1,19}")


def read_euroc(path: str | Path, limits: Limits = LIMITS) -> Trajectory:
    """Read a trajectory; empty lines and lines starting with ``#`` are skipped, quaternions are normalised.

    Times become seconds from the first one: nanoseconds since 1970 have more digits than float64.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.

    Returns:
        The trajectory, in the order of the file, its quaternions with the scalar last.

    Raises:
        FileFormatError: the file is missing, or a line (named in the message) does not begin with whole nanoseconds and
            seven finite numbers with a usable quaternion.
    """
    name, stamps, rows, lines = legible(path), list[int](), list[list[float]](), list[int]()
    for number, line in enumerate(read_text(path, limits).split("\n"), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        place, words = f"{name}, line {number}", [word.strip() for word in line.split(",")]
        if len(words) < len(_FIELDS):
            raise FileFormatError(
                f"{place}: {len(words)} fields between commas, expected {len(_FIELDS)} or more ({', '.join(_FIELDS)})"
            )
        if not _WHOLE.fullmatch(words[0]):
            raise FileFormatError(f"{place}: the time {reprlib.repr(words[0])} is not in whole nanoseconds")
        stamps.append(int(words[0]))
        rows.append(
            [decimal(f"{place}: field {field}", word) for field, word in zip(_FIELDS[1:], words[1:], strict=False)]
        )
        lines.append(number)
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    time = np.array([1e-9 * (stamp - stamps[0]) for stamp in stamps], dtype=np.float64)
    turned = table[:, [4, 5, 6, 3]]
    return Trajectory(time, table[:, :3], turned / norms(turned, lambda row: f"{name}, line {lines[row]}")[:, None])
