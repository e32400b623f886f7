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

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, write_text
from unifg.files.measured import Remarks, placed_along, vertices_of
from unifg.files.tagged import (
    Places,
    TaggedFile,
    decimal_lines,
    distinct,
    from_triangle,
    report_isolated,
    report_skipped,
    triangle_names,
    upper_triangle,
)
from unifg.lie import SE2, SE3, SO3
from unifg.pose_graphs.information import Repair
from unifg.pose_graphs.pose_graph import Edges, PoseGraph
from unifg.typing import Array

__all__ = ["parse_toro", "read_toro", "write_toro"]

_PLANAR_ORDER = [0, 1, 3, 5, 2, 4]  # where the row-by-row entries xx xy xt yy yt tt stand in TORO's list ...
_TO_ROWS = [0, 1, 4, 2, 5, 3]  # ... and TORO's xx xy yy tt xt yt in the row-by-row list


def read_toro(path: str | Path, limits: Limits = LIMITS, *, repair: Repair | None = None) -> PoseGraph:
    """Read a pose graph; gzipped files are unpacked.

    Lines with other tags, such as ``EQUIV``, are counted in ``skipped`` and named in one warning; what else may not be
    meant, and files without vertices, are treated as :func:`unifg.files.g2o.read_g2o` does.

    Args:
        path: the file.
        limits: of what it may hold.
        repair: what to do about indefinite information; see `unifg.pose_graphs.repaired`. By default it stays.

    Raises:
        FileFormatError: the file is missing or holds no pose, mixes planar and spatial poses, or a line (named in the
            message) has the wrong number of fields, is not made of finite numbers, repeats a vertex or refers to one
            that is not there.
    """
    return parse_toro(TaggedFile.read(path, limits), repair)


def parse_toro(file: TaggedFile, repair: Repair | None = None) -> PoseGraph:
    """The pose graph of a file that has been read already; see `read_toro`."""
    planar, spatial = "VERTEX2" in file, "VERTEX3" in file
    given = planar or spatial
    if not given:
        planar, spatial = "EDGE2" in file, "EDGE3" in file
    if planar == spatial:
        what = "both VERTEX2 and VERTEX3" if planar else "neither VERTEX2 nor VERTEX3"
        raise FileFormatError(f"{file.path}: found {what} lines; a pose graph has poses of one kind")
    size, where = ("2", "in the plane") if planar else ("3", "in space")
    skipped = report_skipped(file, {f"VERTEX{size}", f"EDGE{size}"}, where)
    if planar:
        vertices = file.block("VERTEX2", 1, "id x y theta")
        edges = file.block("EDGE2", 2, "i j dx dy dtheta Ixx Ixy Iyy Itt Ixt Iyt")
        poses, measured = vertices.numbers, edges.numbers[:, :3].copy()
        information = from_triangle(edges.numbers[:, 3:][:, _TO_ROWS], 3)
    else:
        vertices = file.block("VERTEX3", 1, "id x y z roll pitch yaw")
        edges = file.block("EDGE3", 2, f"i j dx dy dz roll pitch yaw {triangle_names(6)}")
        poses, measured = from_angles(vertices.numbers), from_angles(edges.numbers[:, :6])
        information = from_triangle(edges.numbers[:, 6:], 6)
    ids = vertices.integers[:, 0] if given else vertices_of(file, [edges.integers.ravel()])
    distinct(file, ids, vertices.lines)
    if not given:
        poses = np.tile(SE2.identity() if planar else SE3.identity(), (len(ids), 1))
    places, remarks = Places(file, ids), Remarks(file, repair)
    first, second = (places.of(edges.integers[:, k], edges.lines, "pose") for k in (0, 1))
    joined = Edges(first, second, measured, remarks.weights("edges", information, edges.integers, edges.lines))
    remarks.pairs(joined, ids, edges.lines)
    report_isolated(file, "pose", ids, np.concatenate([first, second]))
    found = PoseGraph(ids, poses, joined, skipped=skipped, remarks=tuple(remarks.sentences))
    return found if given else placed_along(file, found)


def write_toro(path: str | Path, pose_graph: PoseGraph) -> Path:
    """Write poses and edges; planar ones are read back bit by bit, spatial ones as far as angles allow.

    Args:
        path: file to write; an existing one is replaced, and a name that ends in ``.gz`` is gzipped.
        pose_graph: what to write; TORO knows neither landmarks nor fixed poses.

    Returns:
        The path written.

    Raises:
        FileFormatError: the pose graph has landmarks or priors, or a number is not finite.
    """
    path, edges, ids = Path(path), pose_graph.edges, pose_graph.ids
    if len(pose_graph.landmarks) or pose_graph.priors:
        found = "landmarks" if len(pose_graph.landmarks) else "priors"
        raise FileFormatError(f"{path}: TORO files have no {found}; write g2o")
    triangle = upper_triangle(edges.information)
    poses, measured, name = pose_graph.poses, edges.measured, "2"
    if poses.shape[1] == 7:
        poses, measured, name = to_angles(poses), to_angles(measured), "3"
    else:
        triangle = triangle[:, _PLANAR_ORDER]
    lines = decimal_lines(path, f"VERTEX{name}", [ids], poses)
    numbers = np.concatenate([measured, triangle], axis=1)
    lines += decimal_lines(path, f"EDGE{name}", [ids[edges.first], ids[edges.second]], numbers)
    return write_text(path, "\n".join(lines) + "\n")


def from_angles(numbers: Array) -> Array:
    """SE3 poses (n, 7) from x, y, z, roll, pitch, yaw (n, 6) [m, rad]."""
    return SE3.from_parts(numbers[:, :3], SO3.from_rpy(*numbers[:, 3:].T))


def to_angles(poses: Array) -> Array:
    """The inverse of `from_angles`."""
    return np.column_stack([poses[:, :3], *SO3.to_rpy(poses[:, 3:])])
