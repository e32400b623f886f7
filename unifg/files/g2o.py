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

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import fields as fields_of
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, write_text
from unifg.files.fields import norms
from unifg.files.measured import Remarks, placed_along, vertices_of
from unifg.files.tagged import (
    Block,
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
from unifg.lie import SE2, SE3
from unifg.pose_graphs.information import Repair
from unifg.pose_graphs.pose_graph import Edges, PoseGraph, Priors, Sightings
from unifg.typing import Array, IntArray

__all__ = ["parse_g2o", "read_g2o", "write_g2o"]

_POSE = {3: "id x y theta", 7: "id x y z qx qy qz qw"}
_EDGE = {3: "i j dx dy dtheta", 7: "i j dx dy dz qx qy qz qw"}
_SMALLEST_SIGMA = 1e-12  # [m] or [rad]
_PLANAR = {
    "VERTEX_SE2", "EDGE_SE2", "VERTEX_XY", "EDGE_SE2_XY", "EDGE_BEARING_SE2_XY", "EDGE_RANGE_SE2_XY", "BR", "FIX",
    "ODOMETRY", "LANDMARK", "EDGE_PRIOR_SE2", "EDGE_PRIOR_SE2_XY",
}  # fmt: skip
_SPATIAL_PRIORS = ("EDGE_SE3_PRIOR", "EDGE_PRIOR_SE3")  # as g2o spells it, and as its other tags are spelled
_SPATIAL = {
    "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "VERTEX_TRACKXYZ", "EDGE_SE3_TRACKXYZ", "PARAMS_SE3OFFSET", "FIX",
    *_SPATIAL_PRIORS,
}  # fmt: skip


@dataclass(frozen=True)
class _Seen:
    """Measurements of one kind: identifiers (n, 2), or (n, 1) of priors, lines (n,), values (n, p), information."""

    names: NDArray[np.int64]
    lines: IntArray
    values: Array
    information: Array


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
    return parse_g2o(TaggedFile.read(path, limits), repair)


def parse_g2o(file: TaggedFile, repair: Repair | None = None) -> PoseGraph:
    """The pose graph of a file that has been read already; see `read_g2o`."""
    planar, spatial = "VERTEX_SE2" in file, "VERTEX_SE3:QUAT" in file
    given = planar or spatial
    if not given:
        planar, spatial = "EDGE_SE2" in file or "ODOMETRY" in file, "EDGE_SE3:QUAT" in file
    if planar == spatial:
        what = "both VERTEX_SE2 and VERTEX_SE3:QUAT" if planar else "neither VERTEX_SE2 nor VERTEX_SE3:QUAT"
        raise FileFormatError(f"{file.path}: found {what} lines; a pose graph has poses of one kind")
    skipped = report_skipped(file, *((_PLANAR, "in the plane") if planar else (_SPATIAL, "in space")))
    remarks = Remarks(file, repair)
    offsets = _Offsets(file, remarks)
    edges = _planar_edges(file) if planar else _spatial_edges(file, remarks)
    sightings = _planar_sightings(file) if planar else _spatial_sightings(file, offsets)
    priors = _planar_priors(file) if planar else _spatial_priors(file, offsets, remarks)
    if given:
        vertices = file.block("VERTEX_SE2" if planar else "VERTEX_SE3:QUAT", 1, _POSE[3 if planar else 7])
        points = file.block("VERTEX_XY", 1, "id x y") if planar else file.block("VERTEX_TRACKXYZ", 1, "id x y z")
        ids, point_ids = vertices.integers[:, 0], points.integers[:, 0]
        poses = vertices.numbers if planar else spatial_poses(file, vertices, vertices.numbers, remarks.say)
        landmarks = points.numbers
        distinct(file, np.concatenate([ids, point_ids]), np.concatenate([vertices.lines, points.lines]))
    else:
        ids = vertices_of(file, [edges.names.ravel()])
        poses = np.tile(SE2.identity() if planar else SE3.identity(), (len(ids), 1))
        whole = [seen.names[:, 1] for kind, seen in sightings.items() if kind in ("point", "bearing-range")]
        point_ids = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *whole]))
        landmarks = np.zeros((len(point_ids), 2 if planar else 3))
        distinct(file, np.concatenate([ids, point_ids]), np.zeros(len(ids) + len(point_ids), dtype=np.intp))
    places, point_places = Places(file, ids), Places(file, point_ids)
    first, second = (places.of(edges.names[:, k], edges.lines, "pose") for k in (0, 1))
    weights = remarks.weights("edges", edges.information, edges.names, edges.lines)
    joined = Edges(first, second, edges.values, weights)
    remarks.pairs(joined, ids, edges.lines)
    looked = {
        kind: Sightings(
            places.of(seen.names[:, 0], seen.lines, "pose"),
            point_places.of(seen.names[:, 1], seen.lines, "landmark"),
            seen.values,
            remarks.weights(f"sightings '{kind}'", seen.information, seen.names, seen.lines),
        )
        for kind, seen in sightings.items()
    }
    held = {
        kind: Priors(
            places.of(seen.names[:, 0], seen.lines, "pose"),
            seen.values,
            remarks.weights(f"priors '{kind}'", seen.information, np.repeat(seen.names, 2, axis=1), seen.lines),
        )
        for kind, seen in priors.items()
    }
    touched = [first, second, *(s.pose for s in looked.values()), *(prior.pose for prior in held.values())]
    report_isolated(file, "pose", ids, np.concatenate(touched))
    seen_points = [np.zeros(0, dtype=np.intp), *(seen.landmark for seen in looked.values())]
    report_isolated(file, "landmark", point_ids, np.concatenate(seen_points))
    found = PoseGraph(
        ids, poses, joined, point_ids, landmarks, looked, _fixed(file, places, point_places), skipped,
        remarks=tuple(remarks.sentences), priors=held,
    )  # fmt: skip
    return found if given else placed_along(file, found)


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
    for kind, held in pose_graph.priors.items():
        numbers = np.concatenate([_scalar_last(held.measured), upper_triangle(held.information)], axis=1)
        names = [ids[held.pose]]
        if spatial:
            if "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1" not in lines:
                lines.append("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1")
            lines += decimal_lines(path, "EDGE_SE3_PRIOR", [*names, np.zeros(len(held), dtype=np.int64)], numbers)
        else:
            lines += decimal_lines(path, "EDGE_PRIOR_SE2" if kind == "pose" else "EDGE_PRIOR_SE2_XY", names, numbers)
    return write_text(path, "\n".join(lines) + "\n")


def spatial_poses(file: TaggedFile, block: Block, poses: Array, say: Callable[[str], None]) -> Array:
    """SE3 poses from x y z qx qy qz qw, quaternions normalised; those of norm one stay as they are, bit by bit.

    Norms farther than 1e-3 from one are remarked through ``say``.

    Raises:
        FileFormatError: a quaternion, named by its line, is nearly zero or huge.
    """
    norm = norms(poses[:, 3:], lambda row: f"{file.path}, line {block.lines[row]}", say)
    return np.column_stack([poses[:, :3], poses[:, 6] / norm, poses[:, 3:6] / norm[:, None]])


def _scalar_last(poses: Array) -> Array:
    """Spatial poses in the order of the file; planar ones as they are."""
    return poses if poses.shape[1] < 7 else poses[:, [0, 1, 2, 4, 5, 6, 3]]


def _planar_edges(file: TaggedFile) -> _Seen:
    """Edges with their information, then GTSAM's with their covariance."""
    edges = file.block("EDGE_SE2", 2, f"{_EDGE[3]} {triangle_names(3)}")
    steps = file.block("ODOMETRY", 2, f"{_EDGE[3]} {triangle_names(3, 'S')}")
    information = from_triangle(edges.numbers[:, 3:], 3)
    if not len(steps):
        return _Seen(edges.integers, edges.lines, edges.numbers[:, :3].copy(), information)
    return _Seen(
        np.concatenate([edges.integers, steps.integers]),
        np.concatenate([edges.lines, steps.lines]),
        np.concatenate([edges.numbers[:, :3], steps.numbers[:, :3]]),
        np.concatenate([information, _inverted(file, steps, steps.numbers[:, 3:], 3)]),
    )


def _spatial_edges(file: TaggedFile, remarks: Remarks) -> _Seen:
    """The same in space, where GTSAM has g2o's tag only."""
    edges = file.block("EDGE_SE3:QUAT", 2, f"{_EDGE[7]} {triangle_names(6)}")
    values = spatial_poses(file, edges, edges.numbers[:, :7], remarks.say)
    return _Seen(edges.integers, edges.lines, values, from_triangle(edges.numbers[:, 7:], 6))


def _inverted(file: TaggedFile, block: Block, triangles: Array, dim: int) -> Array:
    """Information (n, d, d) from the upper triangles of covariances.

    Raises:
        FileFormatError: a covariance, named by its line, is not positive definite.
    """
    covariance = from_triangle(triangles, dim)
    wrong = np.flatnonzero(~(np.linalg.eigvalsh(covariance)[:, 0] > 0.0))
    if wrong.size:
        k = int(wrong[0])
        text = f"{block.tag}: the covariance {triangles[k]} is not positive definite"
        raise file.refuse(int(block.lines[k]), text)
    with np.errstate(all="ignore"):
        information = np.linalg.inv(covariance)
    far = np.flatnonzero(~np.isfinite(information).all(axis=(1, 2)))
    if far.size:
        text = f"{block.tag}: the covariance {triangles[far[0]]} has no inverse"
        raise file.refuse(int(block.lines[far[0]]), text)
    return np.asarray(0.5 * (information + np.swapaxes(information, 1, 2)), dtype=np.float64)


def _planar_sightings(file: TaggedFile) -> dict[str, _Seen]:
    """Measurements of landmarks by kind."""
    found = {}
    points = file.block("EDGE_SE2_XY", 2, f"pose landmark x y {triangle_names(2)}")
    spots = file.block("LANDMARK", 2, f"pose landmark x y {triangle_names(2, 'S')}")
    if len(points) or len(spots):
        found["point"] = _Seen(
            np.concatenate([points.integers, spots.integers]),
            np.concatenate([points.lines, spots.lines]),
            np.concatenate([points.numbers[:, :2], spots.numbers[:, :2]]),
            np.concatenate([from_triangle(points.numbers[:, 2:], 2), _inverted(file, spots, spots.numbers[:, 2:], 2)]),
        )
    for kind in ("bearing", "range"):
        block = file.block(f"EDGE_{kind.upper()}_SE2_XY", 2, f"pose landmark {kind} I11")
        if len(block):
            found[kind] = _Seen(
                block.integers, block.lines, block.numbers[:, :1].copy(), block.numbers[:, 1:, None].copy()
            )
    both = file.block("BR", 2, "pose landmark bearing range bearing_sigma range_sigma")
    if len(both):
        wrong = np.flatnonzero((both.numbers[:, 2:] < _SMALLEST_SIGMA).any(axis=1))
        if wrong.size:
            sigmas = both.numbers[wrong[0], 2:]
            text = f"BR: standard deviations must be positive, {_SMALLEST_SIGMA:g} at least, found {sigmas}"
            raise file.refuse(int(both.lines[wrong[0]]), text)
        information = np.zeros((len(both), 2, 2))
        information[:, [0, 1], [0, 1]] = both.numbers[:, 2:] ** -2.0
        found["bearing-range"] = _Seen(both.integers, both.lines, both.numbers[:, :2].copy(), information)
    return found


class _Offsets:
    """Places of sensors on the body."""

    def __init__(self, file: TaggedFile, remarks: Remarks) -> None:
        """Read them."""
        block = file.block("PARAMS_SE3OFFSET", 1, "parameter x y z qx qy qz qw")
        distinct(file, block.integers[:, 0], block.lines)
        self._places = Places(file, block.integers[:, 0])
        self._poses = spatial_poses(file, block, block.numbers, remarks.say)

    def of(self, parameters: NDArray[np.int64], lines: IntArray) -> Array:
        """(n, 7) body_T_sensor of parameters (n,) named in lines (n,)."""
        return self._poses[self._places.of(parameters, lines, "PARAMS_SE3OFFSET")]


def _spatial_sightings(file: TaggedFile, offsets: _Offsets) -> dict[str, _Seen]:
    """The same in space. A sensor that is not at the origin of the body is moved there, with its information."""
    block = file.block("EDGE_SE3_TRACKXYZ", 3, f"pose landmark parameter x y z {triangle_names(3)}")
    if not len(block):
        return {}
    used = offsets.of(block.integers[:, 2], block.lines)
    turn = SE3.matrix(used)[:, :3, :3]
    information = _transported(turn, from_triangle(block.numbers[:, 3:], 3))
    return {"point": _Seen(block.integers[:, :2], block.lines, SE3.act(used, block.numbers[:, :3]), information)}


def _transported(by: Array, information: Array) -> Array:
    """(n, d, d) information of errors ``by.T e``, symmetric to the bit."""
    moved = by @ information @ np.swapaxes(by, 1, 2)
    return np.asarray(0.5 * (moved + np.swapaxes(moved, 1, 2)), dtype=np.float64)


def _planar_priors(file: TaggedFile) -> dict[str, _Seen]:
    """Measurements of single poses by kind."""
    found = {}
    for kind, tag, names, size, dim in (
        ("pose", "EDGE_PRIOR_SE2", "pose x y theta", 3, 3),
        ("position", "EDGE_PRIOR_SE2_XY", "pose x y", 2, 2),
    ):
        block = file.block(tag, 1, f"{names} {triangle_names(dim)}")
        if len(block):
            information = from_triangle(block.numbers[:, size:], dim)
            found[kind] = _Seen(block.integers, block.lines, block.numbers[:, :size].copy(), information)
    return found


def _spatial_priors(file: TaggedFile, offsets: _Offsets, remarks: Remarks) -> dict[str, _Seen]:
    """The same in space.

    The error Log(measured^-1 x offset) of a sensor is Ad(offset^-1) times that of the body, whose pose was measured as
    measured offset^-1.
    """
    fields = f"x y z qx qy qz qw {triangle_names(6)}"
    parts = []
    for tag in _SPATIAL_PRIORS:
        with_offset = any(len(words) != 29 for _, words in islice(file.words(tag), 1))  # 29 are those of no parameter
        block = file.block(tag, 1 + with_offset, f"pose {'parameter ' if with_offset else ''}{fields}")
        measured = spatial_poses(file, block, block.numbers[:, :7], remarks.say)
        information = from_triangle(block.numbers[:, 7:], 6)
        if with_offset:
            back = SE3.inverse(offsets.of(block.integers[:, 1], block.lines))
            measured = SE3.compose(measured, back)
            information = _transported(np.swapaxes(SE3.adjoint(back), 1, 2), information)
        parts.append(_Seen(block.integers[:, :1], block.lines, measured, information))
    joined = [np.concatenate([getattr(part, name.name) for part in parts]) for name in fields_of(_Seen)]
    return {"pose": _Seen(*joined)} if len(joined[0]) else {}


def _fixed(file: TaggedFile, *places: Places) -> tuple[int, ...]:
    """Identifiers on FIX lines, which may hold several."""
    fixed: list[int] = []
    for line, words in file.words("FIX"):
        for word in words:
            known = word.isdecimal() and len(word) <= 19 and int(word) < 2**63
            wanted = np.array([int(word) if known else -1])
            if not known or not any(part.find(wanted)[0] >= 0 for part in places):
                raise file.refuse(line, f"FIX {word}: there is no such vertex in the file")
            fixed.append(int(word))
    return tuple(fixed)
