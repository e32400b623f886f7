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
``PARAMS_SE3OFFSET``     parameter x y z qx qy qz qw: place of the sensor of ``EDGE_SE3_TRACKXYZ`` on the body
``FIX``                  id ...: known vertices
======================== ================================================================================

GTSAM's ``BR`` lines (pose landmark bearing range and two standard deviations) are read as well. Which *residual* an
information matrix belongs to is not said in a file; see `unifg.pose_graphs.PoseGraph.graph`.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, write_text
from unifg.files.tagged import (
    Block,
    TaggedFile,
    decimal_lines,
    distinct,
    from_triangle,
    positions_of,
    report_isolated,
    report_skipped,
    triangle_names,
    upper_triangle,
)
from unifg.lie import SE3
from unifg.pose_graphs.pose_graph import Edges, PoseGraph, Sightings
from unifg.typing import Array

__all__ = ["parse_g2o", "read_g2o", "write_g2o"]

_POSE = {3: "id x y theta", 7: "id x y z qx qy qz qw"}
_EDGE = {3: "i j dx dy dtheta", 7: "i j dx dy dz qx qy qz qw"}
_SMALLEST_NORM, _LARGEST_NORM = 1e-6, 1e6  # of a quaternion that says something about a rotation
_SMALLEST_SIGMA = 1e-12  # [m] or [rad]
_UNIT = 1e-12  # a squared norm this close to one is one: what was written here is read back unchanged
_KNOWN = {
    "VERTEX_SE2", "EDGE_SE2", "VERTEX_XY", "EDGE_SE2_XY", "EDGE_BEARING_SE2_XY", "EDGE_RANGE_SE2_XY", "BR",
    "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "VERTEX_TRACKXYZ", "EDGE_SE3_TRACKXYZ", "PARAMS_SE3OFFSET", "FIX",
}  # fmt: skip


def read_g2o(path: str | Path, limits: Limits = LIMITS) -> PoseGraph:
    """Read a pose graph; ``#`` begins a comment, lines may come in any order, gzipped files are unpacked.

    Quaternions are normalised. Lines with tags that are not read are counted in ``skipped`` and named in one warning.

    Args:
        path: the file.
        limits: of what it may hold.

    Raises:
        FileFormatError: the file is missing or holds no pose, mixes planar and spatial poses, or a line (named in the
            message) has the wrong number of fields, is not made of finite numbers, repeats a vertex or refers to one
            that is not there.
    """
    return parse_g2o(TaggedFile.read(path, limits))


def parse_g2o(file: TaggedFile) -> PoseGraph:
    """The pose graph of a file that has been read already; see `read_g2o`."""
    skipped = report_skipped(file, _KNOWN)
    planar, spatial = "VERTEX_SE2" in file.texts, "VERTEX_SE3:QUAT" in file.texts
    if planar == spatial:
        what = "both VERTEX_SE2 and VERTEX_SE3:QUAT" if planar else "neither VERTEX_SE2 nor VERTEX_SE3:QUAT"
        raise FileFormatError(f"{file.path}: found {what} lines; a pose graph has poses of one kind")
    size = 3 if planar else 7
    dim = 3 if planar else 6
    tag = "SE2" if planar else "SE3:QUAT"
    vertices = file.block(f"VERTEX_{tag}", 1, _POSE[size])
    poses = vertices.numbers if planar else spatial_poses(file, vertices, vertices.numbers)
    points = file.block("VERTEX_XY", 1, "id x y") if planar else file.block("VERTEX_TRACKXYZ", 1, "id x y z")
    identifiers = np.concatenate([vertices.integers[:, 0], points.integers[:, 0]])
    places = distinct(file, identifiers, np.concatenate([vertices.lines, points.lines]))
    count = len(vertices)
    pose_places = {i: k for i, k in places.items() if k < count}
    point_places = {i: k - count for i, k in places.items() if k >= count}

    edges = file.block(f"EDGE_{tag}", 2, f"{_EDGE[size]} {triangle_names(dim)}")
    measured = edges.numbers[:, :size]
    sightings = {}
    for kind, seen in (_planar_sightings(file) if planar else _spatial_sightings(file)).items():
        block, values, information = seen
        sightings[kind] = Sightings(
            positions_of(file, pose_places, block.integers[:, 0], block.lines, "pose"),
            positions_of(file, point_places, block.integers[:, 1], block.lines, "landmark"),
            values,
            information,
        )
    first, second = (positions_of(file, pose_places, edges.integers[:, k], edges.lines, "pose") for k in (0, 1))
    seen_from = [seen.pose for seen in sightings.values()]
    report_isolated(file, "pose", vertices.integers[:, 0], np.concatenate([first, second, *seen_from]))
    seen_points = [np.zeros(0, dtype=np.intp), *(seen.landmark for seen in sightings.values())]
    report_isolated(file, "landmark", points.integers[:, 0], np.concatenate(seen_points))
    return PoseGraph(
        vertices.integers[:, 0],
        poses,
        Edges(
            first,
            second,
            measured.copy() if planar else spatial_poses(file, edges, measured),
            from_triangle(edges.numbers[:, size:], dim),
        ),
        points.integers[:, 0],
        points.numbers,
        sightings,
        _fixed(file, places),
        skipped,
    )


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
    path, spatial = Path(path), pose_graph.poses.shape[1] == 7
    tag, point = ("SE3:QUAT", "TRACKXYZ") if spatial else ("SE2", "XY")
    ids, landmark_ids, edges = pose_graph.ids, pose_graph.landmark_ids, pose_graph.edges
    lines = decimal_lines(path, f"VERTEX_{tag}", [ids], _scalar_last(pose_graph.poses))
    lines += decimal_lines(path, f"VERTEX_{point}", [landmark_ids], pose_graph.landmarks)
    lines += [f"FIX {identifier}" for identifier in pose_graph.fixed_ids]
    numbers = np.concatenate([_scalar_last(edges.measured), upper_triangle(edges.information)], axis=1)
    lines += decimal_lines(path, f"EDGE_{tag}", [ids[edges.first], ids[edges.second]], numbers)
    for kind, seen in pose_graph.sightings.items():
        names = [ids[seen.pose], landmark_ids[seen.landmark]]
        if kind == "bearing-range":
            if np.any(seen.information[:, 0, 1]):
                raise FileFormatError(f"{path}: sightings 'bearing-range' with correlated errors have no tag in g2o")
            for part, name in enumerate(("BEARING", "RANGE")):
                numbers = np.stack([seen.measured[:, part], seen.information[:, part, part]], axis=1)
                lines += decimal_lines(path, f"EDGE_{name}_SE2_XY", names, numbers)
            continue
        numbers = np.concatenate([seen.measured, upper_triangle(seen.information)], axis=1)
        if kind == "point" and spatial:
            lines.append("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1")
            lines += decimal_lines(path, "EDGE_SE3_TRACKXYZ", [*names, np.zeros(len(seen), dtype=np.int64)], numbers)
        else:
            name = {"point": "EDGE_SE2_XY", "bearing": "EDGE_BEARING_SE2_XY", "range": "EDGE_RANGE_SE2_XY"}[kind]
            lines += decimal_lines(path, name, names, numbers)
    return write_text(path, "\n".join(lines) + "\n")


def spatial_poses(file: TaggedFile, block: Block, poses: Array) -> Array:
    """SE3 poses from x y z qx qy qz qw, quaternions normalised; those of norm one stay as they are, bit by bit.

    Raises:
        FileFormatError: a quaternion, named by its line, is nearly zero or huge.
    """
    with np.errstate(over="ignore", under="ignore"):
        squared = np.einsum("ni,ni->n", poses[:, 3:], poses[:, 3:])
    bad = np.flatnonzero(~((squared >= _SMALLEST_NORM**2) & (squared <= _LARGEST_NORM**2)))
    if bad.size:
        k = int(bad[0])
        long = math.hypot(*poses[k, 3:].tolist())
        raise file.refuse(int(block.lines[k]), f"the quaternion {poses[k, 3:]} has norm {long:g}, not one")
    norm = np.where(np.abs(squared - 1.0) <= _UNIT, 1.0, np.sqrt(squared))
    return np.column_stack([poses[:, :3], poses[:, 6] / norm, poses[:, 3:6] / norm[:, None]])


def _scalar_last(poses: Array) -> Array:
    """Spatial poses in the order of the file; planar ones as they are."""
    return poses if poses.shape[1] == 3 else poses[:, [0, 1, 2, 4, 5, 6, 3]]


def _planar_sightings(file: TaggedFile) -> dict[str, tuple[Block, Array, Array]]:
    """Kind to lines, measurements and information matrices."""
    found = {}
    points = file.block("EDGE_SE2_XY", 2, f"pose landmark x y {triangle_names(2)}")
    if len(points):
        found["point"] = points, points.numbers[:, :2].copy(), from_triangle(points.numbers[:, 2:], 2)
    for kind in ("bearing", "range"):
        block = file.block(f"EDGE_{kind.upper()}_SE2_XY", 2, f"pose landmark {kind} I11")
        if len(block):
            found[kind] = block, block.numbers[:, :1].copy(), block.numbers[:, 1:, None].copy()
    both = file.block("BR", 2, "pose landmark bearing range bearing_sigma range_sigma")
    if len(both):
        wrong = np.flatnonzero((both.numbers[:, 2:] < _SMALLEST_SIGMA).any(axis=1))
        if wrong.size:
            sigmas = both.numbers[wrong[0], 2:]
            text = f"BR: standard deviations must be positive, {_SMALLEST_SIGMA:g} at least, found {sigmas}"
            raise file.refuse(int(both.lines[wrong[0]]), text)
        information = np.zeros((len(both), 2, 2))
        information[:, [0, 1], [0, 1]] = both.numbers[:, 2:] ** -2.0
        found["bearing-range"] = both, both.numbers[:, :2].copy(), information
    return found


def _spatial_sightings(file: TaggedFile) -> dict[str, tuple[Block, Array, Array]]:
    """The same in space. A sensor that is not at the origin of the body is moved there, with its information."""
    block = file.block("EDGE_SE3_TRACKXYZ", 3, f"pose landmark parameter x y z {triangle_names(3)}")
    if not len(block):
        return {}
    offsets = file.block("PARAMS_SE3OFFSET", 1, "parameter x y z qx qy qz qw")
    places = distinct(file, offsets.integers[:, 0], offsets.lines)
    body_T_sensor = spatial_poses(file, offsets, offsets.numbers)
    used = body_T_sensor[positions_of(file, places, block.integers[:, 2], block.lines, "PARAMS_SE3OFFSET")]
    turn = SE3.matrix(used)[:, :3, :3]
    information = turn @ from_triangle(block.numbers[:, 3:], 3) @ np.swapaxes(turn, 1, 2)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    return {"point": (block, SE3.act(used, block.numbers[:, :3]), information)}


def _fixed(file: TaggedFile, places: dict[int, int]) -> tuple[int, ...]:
    """Identifiers on FIX lines, which may hold several."""
    fixed: list[int] = []
    for text, line in zip(file.texts.get("FIX", []), file.lines.get("FIX", []), strict=True):
        for word in text.split():
            if not word.isdecimal() or int(word) not in places:
                raise file.refuse(line, f"FIX {word}: there is no such vertex in the file")
            fixed.append(int(word))
    return tuple(fixed)
