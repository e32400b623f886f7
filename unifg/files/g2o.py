"""Pose graphs in the g2o format, read and written: https://github.com/RainerKuemmerle/g2o/wiki/File-Format.

======================== ================================================================================
``VERTEX_SE2``           id x y theta
``VERTEX_SE3:QUAT``      id x y z qx qy qz qw
``VERTEX_XY``            id x y; ``VERTEX_TRACKXYZ`` id x y z
``EDGE_SE2``             i j dx dy dtheta and the upper triangle of the information matrix, row by row (6 numbers)
``EDGE_SE3:QUAT``        i j dx dy dz qx qy qz qw and 21 numbers, translation before rotation
``EDGE_SE2_XY``          pose landmark x y and 3 numbers
``EDGE_BEARING_SE2_XY``  pose landmark bearing information; ``EDGE_RANGE_SE2_XY`` with a distance
``EDGE_SE3_TRACKXYZ``    pose landmark parameter x y z and 6 numbers
``PARAMS_SE3OFFSET``     parameter x y z qx qy qz qw: place of the sensor on the body
``EDGE_PRIOR_SE2``       pose x y theta and 6 numbers; ``EDGE_PRIOR_SE2_XY`` pose x y and 3 numbers
``EDGE_SE3_PRIOR``       pose parameter x y z qx qy qz qw and 21 numbers; also ``EDGE_PRIOR_SE3``, and without parameter
``FIX``                  id ...: known vertices
``BR``                   GTSAM: pose landmark bearing range and two standard deviations
``ODOMETRY``             GTSAM: i j dx dy dtheta and the upper triangle of the *covariance*, row by row (6 numbers)
``LANDMARK``             GTSAM: pose landmark x y and the upper triangle of the *covariance* (3 numbers)
======================== ================================================================================

Files without any vertex are read, too: the poses are those that the edges join, by rising identifiers, and start along
a spanning tree of the edges. Which *residual* an information matrix belongs to is not said in a file; see
`unifg.pose_graphs.PoseGraph.graph`.
"""

from __future__ import annotations

from pathlib import Path

from unifg.files.contents import LIMITS, Limits
from unifg.files.measured import Format, Tag, parse, spatial_poses, write
from unifg.files.text import TextFile
from unifg.lie import SE2, SE3
from unifg.pose_graphs.information import Repair
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.typing import Array

__all__ = ["read_g2o", "write_g2o"]

_PLANAR, _SPATIAL = "x y theta", "x y z qx qy qz qw"
_PLANAR_STEP, _SPATIAL_STEP = "dx dy dtheta", "dx dy dz qx qy qz qw"


def _scalar_last(poses: Array) -> Array:
    """Spatial poses in the order of the file."""
    return poses[:, [0, 1, 2, 4, 5, 6, 3]]


G2O = (
    Format(
        SE2,
        "VERTEX_SE2",
        _PLANAR,
        "VERTEX_XY",
        (
            Tag("EDGE_SE2", "edges", "i j", _PLANAR_STEP, 3),
            Tag("ODOMETRY", "edges", "i j", _PLANAR_STEP, 3, "covariance"),
            Tag("EDGE_SE2_XY", "point", "pose landmark", "x y", 2),
            Tag("LANDMARK", "point", "pose landmark", "x y", 2, "covariance"),
            Tag("EDGE_BEARING_SE2_XY", "bearing", "pose landmark", "bearing", 1),
            Tag("EDGE_RANGE_SE2_XY", "range", "pose landmark", "range", 1),
            Tag("BR", "bearing-range", "pose landmark", "bearing range", 2, "sigmas"),
            Tag("EDGE_PRIOR_SE2", "pose", "pose", _PLANAR, 3),
            Tag("EDGE_PRIOR_SE2_XY", "position", "pose", "x y", 2),
        ),
        ("FIX",),
        lambda table, numbers, say: numbers.copy(),
        lambda poses: poses,
    ),
    Format(
        SE3,
        "VERTEX_SE3:QUAT",
        _SPATIAL,
        "VERTEX_TRACKXYZ",
        (
            Tag("EDGE_SE3:QUAT", "edges", "i j", _SPATIAL_STEP, 6),
            Tag("EDGE_SE3_TRACKXYZ", "point", "pose landmark parameter", "x y z", 3),
            Tag("EDGE_SE3_PRIOR", "pose", "pose parameter", _SPATIAL, 6),
            Tag("EDGE_PRIOR_SE3", "pose", "pose parameter", _SPATIAL, 6),  # as the other tags are spelled
        ),
        ("FIX", "PARAMS_SE3OFFSET"),
        spatial_poses,
        _scalar_last,
    ),
)


def read_g2o(path: str | Path, limits: Limits = LIMITS, *, repair: Repair | None = None) -> PoseGraph:
    """Read a pose graph; ``#`` begins a comment, lines may come in any order, gzipped files are unpacked.

    Quaternions are normalised. What may not be meant is named in a warning and kept: lines with tags that are not read
    (`PoseGraph.skipped`), indefinite information, edges from a pose to itself and edges that stand in the file twice
    (`PoseGraph.remarks`).

    Args:
        path: the file.
        limits: of what it may hold.
        repair: what to do about indefinite information; see `unifg.pose_graphs.repaired`. By default it stays.

    Raises:
        FileFormatError: the file is missing or holds no pose, mixes planar and spatial poses, or a line (named in the
            message) has the wrong number of fields, is not made of finite numbers, repeats a vertex or refers to one
            that is not there.
    """
    return parse(TextFile.read(path, limits), G2O, repair)


def write_g2o(path: str | Path, pose_graph: PoseGraph) -> Path:
    """Write a pose graph so that reading it gives the same numbers, bit by bit; gzipped if the name ends in ``.gz``.

    Args:
        path: file to write; an existing one is replaced.
        pose_graph: what to write.

    Returns:
        The path written.

    Raises:
        FileFormatError: a number is not finite, or a sighting has no tag (bearing and range with correlation).
    """
    return write(path, pose_graph, G2O, "g2o")
