"""Pose graphs in the TORO format (ending ``.graph``), read and written: https://openslam-org.github.io/toro.html.

============ =======================================================================================
``VERTEX2``  id x y theta
``EDGE2``    i j dx dy dtheta Ixx Ixy Iyy Itt Ixt Iyt: **not** row by row
``VERTEX3``  id x y z roll pitch yaw
``EDGE3``    i j dx dy dz roll pitch yaw and 21 numbers, the upper triangle row by row, rotations last
============ =======================================================================================

Rotations are R = Rz(yaw) Ry(pitch) Rx(roll). Information of EDGE3 speaks of roll, pitch and yaw errors; they are small
where it matters, and are taken for the rotation vector, as g2o and GTSAM do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unifg.files.contents import LIMITS, Limits
from unifg.files.measured import Format, Tag, parse, write
from unifg.files.text import TextFile
from unifg.lie import SE2, SE3, SO3
from unifg.pose_graphs.information import Repair
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.typing import Array

__all__ = ["read_toro", "write_toro"]

_PLANAR, _SPATIAL = "x y theta", "x y z roll pitch yaw"


def from_angles(numbers: Array) -> Array:
    """SE3 poses (n, 7) from x, y, z, roll, pitch, yaw (n, 6) [m, rad]."""
    return SE3.from_parts(numbers[:, :3], SO3.from_rpy(*numbers[:, 3:].T))


def to_angles(poses: Array) -> Array:
    """The inverse of `from_angles`."""
    return np.column_stack([poses[:, :3], *SO3.to_rpy(poses[:, 3:])])


TORO = (
    Format(
        SE2,
        "VERTEX2",
        _PLANAR,
        "",
        (Tag("EDGE2", "edges", "i j", "dx dy dtheta", 3, order=[0, 1, 3, 5, 2, 4]),),
        (),
        lambda table, numbers, say: numbers.copy(),
        lambda poses: poses,
    ),
    Format(
        SE3,
        "VERTEX3",
        _SPATIAL,
        "",
        (Tag("EDGE3", "edges", "i j", "dx dy dz roll pitch yaw", 6),),
        (),
        lambda table, numbers, say: from_angles(numbers),
        to_angles,
    ),
)


def read_toro(path: str | Path, limits: Limits = LIMITS, *, repair: Repair | None = None) -> PoseGraph:
    """Read a pose graph; gzipped files are unpacked.

    Lines with other tags, such as ``EQUIV``, are counted in ``skipped`` and named in one warning; what else may not be
    meant, and files without vertices, are treated as :func:`unifg.files.g2o.read_g2o` does.

    Args:
        path: the file.
        limits: of what it may hold.
        repair: what to do about indefinite information; see `unifg.pose_graphs.repaired`. By default it stays.

    Raises:
        FileFormatError: as for `unifg.files.g2o.read_g2o`.
    """
    return parse(TextFile.read(path, limits), TORO, repair)


def write_toro(path: str | Path, pose_graph: PoseGraph) -> Path:
    """Write poses and edges; planar ones are read back bit by bit, spatial ones as far as angles allow.

    Args:
        path: file to write; an existing one is replaced, and a name that ends in ``.gz`` is gzipped.
        pose_graph: what to write; TORO knows neither landmarks nor fixed poses, of which one is left out.

    Returns:
        The path written.

    Raises:
        FileFormatError: the pose graph has landmarks, priors or several fixed poses, or a number is not finite.
    """
    return write(path, pose_graph, TORO, "TORO")
