"""Trajectories in the EuRoC format: CSV lines ``t, x, y, z, qw, qx, qy, qz, ...`` with times in whole nanoseconds.

What follows the quaternion (velocities and biases, in ``state_groundtruth_estimate0/data.csv``) is left out. Format:
M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 35(10), 2016.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits
from unifg.files.text import TextFile, norms
from unifg.files.tum import Trajectory

__all__ = ["read_euroc"]

logger = logging.getLogger("unifg")

_SHORTEST = 1e-4  # [s]; what is closer in time was counted in microseconds or more
_FIELDS, _COUNT = "t x y z qw qx qy qz", 8


def read_euroc(path: str | Path, limits: Limits = LIMITS) -> Trajectory:
    """Read a trajectory; empty lines and lines starting with ``#`` are skipped, quaternions are normalised.

    Times become seconds from the first one: nanoseconds since 1970 have more digits than float64. Warnings name times
    that run backwards or are no nanoseconds.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.

    Returns:
        The trajectory, in the order of the file, its quaternions with the scalar last.

    Raises:
        FileFormatError: the file is missing or holds no pose, or a line (named in the message) does not begin with
            whole nanoseconds and seven finite numbers with a usable quaternion.
    """
    file = TextFile.read(path, limits, tagged=False)
    ends = []
    for row, (begin, end) in enumerate(zip(file.begin.tolist(), file.end.tolist(), strict=True)):
        fields = file.content[begin:end].split(b",")
        if len(fields) < _COUNT:
            found = f"{len(fields)} fields between commas, expected {_COUNT} or more ({_FIELDS})"
            raise FileFormatError(f"{file.place(row)}: {found}")
        ends.append(begin + len(b",".join(fields[:_COUNT])))
    content = file.content.replace(b",", b" ")
    table = replace(file, content=content, end=np.array(ends, dtype=np.intp)).table("", 1, _FIELDS)
    table.require_lines("a pose")
    stamps, turned = table.integers[:, 0], table.numbers[:, [4, 5, 6, 3]]
    table.refuse(stamps < 0, "the time is below zero")
    time = 1e-9 * (stamps - stamps[:1]).astype(np.float64)
    steps = np.abs(np.diff(time))
    if steps.any() and (usual := float(np.median(steps[steps > 0.0]))) < _SHORTEST:
        logger.warning(
            "%s: steps of %g are read as nanoseconds; multiply the times if they are in a larger unit",
            table.path, round(1e9 * usual),
        )  # fmt: skip
    replace(table, numbers=time[:, None]).remark_order()
    return Trajectory(time, table.numbers[:, :3], turned / norms(turned, table.place)[:, None])
