"""Pose graphs in files of tagged lines: what g2o and TORO have in common, read and written by a table of tags."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unifg.elimination.symmetric import distinct
from unifg.errors import FileFormatError, GraphError
from unifg.files.contents import require_finite, write_text
from unifg.files.text import Table, TextFile, norms
from unifg.lie import SE2, SE3, LieGroup
from unifg.modeling.summary import counted
from unifg.pose_graphs.information import Repair, indefinite, repaired, require_repair
from unifg.pose_graphs.initialise import odometric
from unifg.pose_graphs.pose_graph import Edges, Ids, PoseGraph, Priors, Sightings
from unifg.typing import Array, IntArray

__all__ = ()  # for readers and writers only

logger = logging.getLogger("unifg")

_SMALLEST_SIGMA = 1e-12  # [m] or [rad]
_SENSOR = "PARAMS_SE3OFFSET"
_AT_ORIGIN = f"{_SENSOR} 0 0 0 0 0 0 0 1"
_POSES = {"edges", "pose"}  # kinds of which a pose was measured
_PAIR = {"bearing": 0, "range": 1}  # kinds that bearing-range is written as, and their columns


class Tag(NamedTuple):
    """Lines of measurements.

    Attributes:
        name: the tag.
        kind: "edges", or a kind of sightings or priors.
        names: of the leading integers: vertices, then the parameter of a sensor.
        fields: of what was measured.
        dim: rows of the information matrix.
        weights: what follows: the upper triangle of a matrix, row by row, or standard deviations.
        order: places of the entries row by row, where the file has them in another order.
    """

    name: str
    kind: str
    names: str
    fields: str
    dim: int
    weights: Literal["information", "covariance", "sigmas"] = "information"
    order: Sequence[int] | None = None

    def weight_names(self) -> str:
        """Names of the numbers that stand for the weights."""
        if self.weights == "sigmas":
            return " ".join(f"{field}_sigma" for field in self.fields.split())
        letter, order = "I" if self.weights == "information" else "S", self.order or slice(None)
        entries = np.stack(np.triu_indices(self.dim), axis=1)[order] + 1
        return " ".join(f"{letter}{row}{column}" for row, column in entries.tolist())


class Format(NamedTuple):
    """Tags of one format and dimension; the first of a kind that holds information is written.

    Attributes:
        group: of the poses.
        pose: tag of a pose.
        fields: of a pose.
        point: tag of a landmark; empty where there are none.
        tags: of measurements.
        others: further tags that are read.
        read: poses (n, storage) from a table and n rows of numbers; the function takes remarks.
        written: the inverse.
    """

    group: LieGroup
    pose: str
    fields: str
    point: str
    tags: tuple[Tag, ...]
    others: tuple[str, ...]
    read: Callable[[Table, Array, Callable[[str], None]], Array]
    written: Callable[[Array], Array]


class _Measured(NamedTuple):
    """Measurements of one kind: identifiers and values (n, p) of lines, and information matrices."""

    table: Table
    information: Array


def _positions(identifiers: Ids, table: Table, column: int, what: str) -> IntArray:
    """Positions among distinct identifiers (n,) of those in a column of a table, which must be what is said.

    Raises:
        FileFormatError: an identifier is unknown.
    """
    wanted, order = table.integers[:, column], np.argsort(identifiers, kind="stable")
    found: IntArray = np.append(order, len(order))[np.searchsorted(identifiers, wanted, sorter=order)]
    unknown = (found == len(order)) | (np.append(identifiers, 0)[found] != wanted)
    table.refuse(unknown, lambda k: f"there is no {what} {wanted[k]} in the file")
    return found


class _Remarks:
    """Sentences about the measurements of a file, each of which is logged once; and the repair of information."""

    def __init__(self, path: str, repair: Repair | None) -> None:
        if repair is not None:
            require_repair(repair)
        self.path, self.repair = path, repair
        self.sentences: list[str] = []

    def say(self, sentence: str) -> None:
        """Keep and log a sentence."""
        self.sentences.append(sentence)
        logger.warning("%s: %s", self.path, sentence)

    def weights(self, what: str, measured: _Measured) -> Array:
        """Information matrices (n, d, d) as they are to be used; what they belong to is for the sentence."""
        table, information = measured
        wrong = np.flatnonzero(indefinite(information))
        if not len(wrong):
            return information
        names = table.integers
        places = ", ".join(f"line {table.lines[k]} ({names[k, 0]} - {names[k, -1]})" for k in wrong[:3].tolist())
        done = {
            None: "a graph refuses them; reading with repair='zero' leaves these out, 'project' keeps what is left",
            "zero": "set to zero: these measurements have no say",
            "project": "negative eigenvalues were set to zero",
        }[self.repair]
        self.say(
            f"{len(wrong)} of {len(information)} information matrices of {what} are indefinite: {places}"
            f"{', ...' if len(wrong) > 3 else ''}: {done}"
        )
        return information if self.repair is None else repaired(information, self.repair)

    def pairs(self, edges: Edges, ids: Ids, lines: IntArray) -> None:
        """Remark edges that turn beyond a turn or go from a pose to itself, and those given twice, word by word."""
        planar = edges.measured.shape[1] == SE2.dim
        wide = np.flatnonzero(planar & (np.abs(edges.measured[:, 2]) > 2.0 * np.pi))
        if len(wide):
            k = int(wide[0])
            self.say(
                f"headings change along {counted(len(wide), 'edge')} by more than a turn, first in line {lines[k]} "
                f"({edges.measured[k, 2]:g}): radians are read; convert degrees"
            )
        own = np.flatnonzero(edges.first == edges.second)
        if len(own):
            k = int(own[0])
            joins = "joins its pose with itself" if len(own) == 1 else "join a pose with itself"
            self.say(f"{counted(len(own), 'edge')} {joins}, first in line {lines[k]} ({ids[edges.first[k]]})")
        keys = edges.first * (len(ids) + 1) + edges.second
        order = np.argsort(keys, kind="stable")
        before, after = order[:-1], order[1:]
        alike = keys[before] == keys[after]
        before, after = before[alike], after[alike]
        alike = (edges.measured[before] == edges.measured[after]).all(axis=1)
        alike &= (edges.information[before] == edges.information[after]).all(axis=(1, 2))
        twice = np.sort(after[alike])
        if len(twice):
            k = int(twice[0])
            pair = f"{ids[edges.first[k]]} - {ids[edges.second[k]]}"
            stand = "edge repeats another" if len(twice) == 1 else "edges repeat others"
            self.say(f"{len(twice)} {stand} word by word, first in line {lines[k]} ({pair}): each counts")

    def order(self, edges: Edges, ids: Ids) -> None:
        """Remark poses in an order by which most steps from one identifier to the next count as loop closures."""
        steps = (np.abs(ids[edges.first] - ids[edges.second]) == 1) & ~edges.odometry
        if steps.sum() > edges.odometry.sum():
            self.say(
                f"poses are not in the order of their identifiers: {counted(int(steps.sum()), 'step')} from one to the "
                "next count as loop closures, as odometry joins neighbours in the file; sort its vertices"
            )

    def isolated(self, what: str, identifiers: Ids, used: list[IntArray]) -> None:
        """Log which of the vertices (n,) nothing has measured, given the positions of those that are used."""
        lonely = identifiers[np.bincount(np.concatenate(used), minlength=len(identifiers)) == 0]
        if len(lonely):
            named = ", ".join(map(str, lonely[:5].tolist())) + (", ..." if len(lonely) > 5 else "")
            logger.warning("%s: nothing has measured %d of the %ss: %s", self.path, len(lonely), what, named)


def parse(file: TextFile, formats: tuple[Format, Format], repair: Repair | None) -> PoseGraph:
    """The pose graph of a file.

    Args:
        file: its lines.
        formats: in the plane and in space.
        repair: what to do about indefinite information; None leaves it.

    Raises:
        FileFormatError: as for `unifg.files.g2o.read_g2o`.
        GraphError: for a repair that there is not.
    """
    given, which = _dimension(file, formats)
    form, where = formats[which], ("in the plane", "in space")[which]
    skipped = file.others({form.pose, form.point, *form.others, *(tag.name for tag in form.tags)})
    if skipped:
        named = ", ".join(f"{tag} ({count})" for tag, count in sorted(skipped.items()))
        logger.warning("%s: lines left out because their tags are not read %s: %s", file.path, where, named)
    remarks = _Remarks(file.path, repair)
    measured = _measurements(file, form, remarks)
    edges = measured.pop("edges")
    if given:
        vertices = file.table(form.pose, 1, f"id {form.fields}")
        points = file.table(form.point, 1, "id x y z" if which else "id x y")
        ids, point_ids, landmarks = vertices.integers[:, 0], points.integers[:, 0], points.numbers
        poses = form.read(vertices, vertices.numbers, remarks.say)
        lines = np.concatenate([vertices.lines, points.lines])
    else:
        ids = distinct(edges.table.integers.ravel())
        if not len(ids):
            raise FileFormatError(f"{file.path}: neither poses nor edges between them")
        poses = np.tile(form.group.identity(), (len(ids), 1))
        placeable = [measured[kind].table.integers[:, 1] for kind in ("point", "bearing-range") if kind in measured]
        point_ids = distinct(np.concatenate([np.zeros(0, dtype=np.int64), *placeable]))
        landmarks, lines = np.zeros((len(point_ids), form.group.point_dim)), np.zeros(len(ids) + len(point_ids), int)
    names = np.concatenate([ids, point_ids])
    Table(file.path, lines, names[:, None], np.zeros((len(names), 0))).distinct(names, "vertex")
    first, second = (_positions(ids, edges.table, k, "pose") for k in (0, 1))
    joined = Edges(first, second, edges.table.numbers, remarks.weights("edges", edges))
    remarks.pairs(joined, ids, edges.table.lines)
    remarks.order(joined, ids)
    seen: dict[str, Sightings] = {}
    held: dict[str, Priors] = {}
    for kind, found in measured.items():
        pose, values = _positions(ids, found.table, 0, "pose"), found.table.numbers
        if found.table.integers.shape[1] == 2:
            landmark = _positions(point_ids, found.table, 1, "landmark")
            seen[kind] = Sightings(pose, landmark, values, remarks.weights(f"sightings '{kind}'", found))
        else:
            held[kind] = Priors(pose, values, remarks.weights(f"priors '{kind}'", found))
    measuring = [some.pose for some in seen.values()] + [some.pose for some in held.values()]
    remarks.isolated("pose", ids, [first, second, *measuring])
    remarks.isolated("landmark", point_ids, [first[:0], *(some.landmark for some in seen.values())])
    fixed = _fixed(file, names) if "FIX" in form.others else ()
    graph = PoseGraph(
        ids, poses, joined, point_ids, landmarks, seen, fixed, skipped, remarks=tuple(remarks.sentences), priors=held
    )
    return graph if given else _placed_along(file.path, graph)


def _dimension(file: TextFile, formats: tuple[Format, Format]) -> tuple[bool, int]:
    """True for a file that holds poses; 0 for the plane, 1 for space."""
    found = [form.pose in file for form in formats]
    given = any(found)
    if not given:
        found = [any(tag.kind == "edges" and tag.name in file for tag in form.tags) for form in formats]
    if found[0] == found[1]:
        planar, spatial = (form.pose for form in formats)
        what = f"both {planar} and {spatial}" if given else f"neither {planar} nor {spatial}"
        raise FileFormatError(f"{file.path}: found {what} lines; a pose graph has poses of one kind")
    return given, int(found[1])


def _measurements(file: TextFile, form: Format, remarks: _Remarks) -> dict[str, _Measured]:
    """Measurements by kind; those of a sensor that is not at the origin of the body are moved there."""
    sensors = file.table(_SENSOR if _SENSOR in form.others else "", 1, f"parameter {form.fields}")
    sensors.distinct(sensors.integers[:, 0], "vertex")
    offsets = form.read(sensors, sensors.numbers, remarks.say)
    found: dict[str, list[_Measured]] = {}
    for tag in form.tags:
        if tag.name not in file and (tag.kind != "edges" or "edges" in found):
            continue
        names, size, weights = tag.names.split(), len(tag.fields.split()), tag.weight_names()
        vertices = len(names) - ("parameter" in names)
        rows = file.rows(tag.name)
        if tag.kind == "pose" and len(file.words(rows[0])) == vertices + size + len(weights.split()):
            names = names[:vertices]  # also written without the parameter
        table = file.table(tag.name, len(names), " ".join([*names, tag.fields, weights]), rows)
        values, information = table.numbers[:, :size], _information(table, tag, table.numbers[:, size:])
        values = form.read(table, values, remarks.say) if tag.kind in _POSES else values.copy()
        if len(names) > vertices:
            sensor = offsets[_positions(sensors.integers[:, 0], table, vertices, _SENSOR)]
            if tag.kind == "point":
                values, transport = SE3.act(sensor, values), SE3.matrix(sensor)[:, :3, :3]
            else:
                # The error Log(measured^-1 x offset) is Ad(offset^-1) times that of the body, whose pose was measured
                # as measured offset^-1.
                back = SE3.inverse(sensor)
                values, transport = SE3.compose(values, back), np.swapaxes(SE3.adjoint(back), 1, 2)
            information = _symmetric(transport @ information @ np.swapaxes(transport, 1, 2))
        moved = Table(file.path, table.lines, table.integers[:, :vertices], values)
        found.setdefault(tag.kind, []).append(_Measured(moved, information))
    return {kind: _joined(several) for kind, several in found.items()}


def _joined(several: list[_Measured]) -> _Measured:
    """Measurements of several tags as one."""
    if len(several) == 1:
        return several[0]
    tables = [one.table for one in several]
    parts = [np.concatenate([getattr(table, name) for table in tables]) for name in ("lines", "integers", "numbers")]
    return _Measured(Table(tables[0].path, *parts), np.concatenate([one.information for one in several]))


def _information(table: Table, tag: Tag, numbers: Array) -> Array:
    """Information matrices (n, d, d) from the weights in a file.

    Raises:
        FileFormatError: a standard deviation or covariance, named by its line, is not positive.
    """
    if tag.weights == "sigmas":
        table.refuse(
            numbers.min(axis=1) < _SMALLEST_SIGMA,
            lambda k: (
                f"{tag.name}: standard deviations must be positive, {_SMALLEST_SIGMA:g} at least, found {numbers[k]}"
            ),
        )
        return numbers[:, :, None] ** -2.0 * np.eye(tag.dim)
    rows, columns = np.triu_indices(tag.dim)
    places = np.empty((tag.dim, tag.dim), dtype=np.intp)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows)) if tag.order is None else np.argsort(tag.order)
    matrices = np.take(numbers, places.ravel(), axis=1).reshape(-1, tag.dim, tag.dim)
    if tag.weights == "information":
        return matrices

    def said(what: str) -> Callable[[int], str]:
        return lambda k: f"{tag.name}: the covariance {numbers[k]} {what}"

    table.refuse(~(np.linalg.eigvalsh(matrices)[:, 0] > 0.0), said("is not positive definite"))
    with np.errstate(all="ignore"):
        information = np.linalg.inv(matrices).astype(np.float64, copy=False)
    table.refuse(~np.isfinite(np.abs(information).max(axis=(1, 2))), said("has no inverse"))
    return _symmetric(information)


def _symmetric(matrices: Array) -> Array:
    """Matrices (n, d, d) made symmetric to the bit."""
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, 1, 2)), dtype=np.float64)


def _fixed(file: TextFile, names: Ids) -> tuple[int, ...]:
    """Identifiers on FIX lines, which may hold several."""
    known, fixed = set(names.tolist()), list[int]()
    for row in file.rows("FIX").tolist():
        for word in file.words(row):
            if not word.removeprefix("-").isdecimal() or int(word) not in known:
                raise FileFormatError(f"{file.place(row)}: FIX {word}: there is no such vertex in the file")
            fixed.append(int(word))
    return tuple(fixed)


def _placed_along(path: str, pose_graph: PoseGraph) -> PoseGraph:
    """A graph of measurements alone, its poses along a spanning tree, landmarks where they were first seen.

    Landmarks stand where the first of their sightings puts them, "point" before "bearing-range"; those of which only
    bearings or ranges are known stay as they are.

    Raises:
        FileFormatError: a pose is joined to the others through landmarks only.
    """
    try:
        poses = odometric(pose_graph)
    except GraphError as error:
        raise FileFormatError(f"{path}: there are no poses to start from, and {error}") from None
    landmarks = pose_graph.landmarks.copy()
    for kind in ("bearing-range", "point"):
        if kind in pose_graph.sightings:
            seen = pose_graph.sightings[kind]
            chosen, first = np.unique(seen.landmark, return_index=True)
            spots = seen.measured[first]
            if kind == "bearing-range":
                spots = spots[:, 1:] * np.stack([np.cos(spots[:, 0]), np.sin(spots[:, 0])], axis=1)
            landmarks[chosen] = pose_graph.group.act(poses[seen.pose[first]], spots)
    return replace(pose_graph, poses=poses, landmarks=landmarks, placed=False)


def spatial_poses(table: Table, numbers: Array, say: Callable[[str], None]) -> Array:
    """SE3 poses from x y z qx qy qz qw, quaternions normalised; those of norm one stay as they are, bit by bit.

    Norms farther than 1e-3 from one are remarked through ``say``.

    Raises:
        FileFormatError: a quaternion, named by its line, is nearly zero or huge.
    """
    norm = norms(numbers[:, 3:], table.place, say)
    return np.column_stack([numbers[:, :3], numbers[:, 6] / norm, numbers[:, 3:6] / norm[:, None]])


def write(path: str | Path, pose_graph: PoseGraph, formats: tuple[Format, Format], name: str) -> Path:
    """Write a pose graph; gzipped if the file's name ends in ``.gz``.

    Args:
        path: file to write; an existing one is replaced.
        pose_graph: what to write.
        formats: in the plane and in space.
        name: of the format, for messages.

    Raises:
        FileFormatError: a number is not finite, or the format has no tag for what there is.
    """
    path, form = Path(path), formats[pose_graph.group is SE3]
    counts = {
        "landmarks": len(pose_graph.landmarks),
        "priors": len(pose_graph.priors),
        "fixed poses": len(set(pose_graph.fixed_ids)) - 1,  # one alone says where the map begins
    }
    if not form.point and (lost := [what for what, count in counts.items() if count > 0]):
        raise FileFormatError(f"{path}: {name} files have no {lost[0]}; write g2o")
    ids, edges = pose_graph.ids, pose_graph.edges
    tags = {tag.kind: tag for tag in reversed(form.tags) if tag.weights == "information"}
    lines = _lines(path, form.pose, [ids], form.written(pose_graph.poses))
    lines += _lines(path, form.point, [pose_graph.landmark_ids], pose_graph.landmarks)
    lines += [f"FIX {identifier}" for identifier in pose_graph.fixed_ids if "FIX" in form.others]
    parts = [("edges", [ids[edges.first], ids[edges.second]], edges.measured, edges.information)]
    for kind, seen in pose_graph.sightings.items():
        names = [ids[seen.pose], pose_graph.landmark_ids[seen.landmark]]
        if kind == "bearing-range":
            if np.any(seen.information[:, 0, 1]):
                raise FileFormatError(f"{path}: sightings 'bearing-range' with correlated errors have no tag in {name}")
            for part, k in _PAIR.items():
                parts.append((part, names, seen.measured[:, [k]], seen.information[:, [k]][:, :, [k]]))
        else:
            parts.append((kind, names, seen.measured, seen.information))
    parts += [(kind, [ids[held.pose]], held.measured, held.information) for kind, held in pose_graph.priors.items()]
    for kind, names, measured, information in parts:
        tag = tags[kind]
        rows, columns = np.triu_indices(tag.dim)
        weights = information[:, rows, columns]
        if tag.order is not None:
            weights = weights[:, tag.order]
        if "parameter" in tag.names:
            lines += [] if _AT_ORIGIN in lines else [_AT_ORIGIN]
            names = [*names, np.zeros(len(measured), dtype=np.int64)]
        numbers = form.written(measured) if kind in _POSES else measured
        lines += _lines(path, tag.name, names, np.concatenate([numbers, weights], axis=1))
    return write_text(path, "\n".join(lines) + "\n")


def _lines(path: Path, tag: str, integers: list[NDArray[np.int64]], numbers: Array) -> list[str]:
    """Lines of one tag; the shortest decimals that are read back exactly, whole numbers without a point."""
    require_finite(path, f"{tag} number", numbers)
    names = zip(*(part.tolist() for part in integers), strict=True)
    values = ([repr(value).removesuffix(".0") for value in row] for row in numbers.tolist())
    return [" ".join([tag, *map(str, name), *value]) for name, value in zip(names, values, strict=True)]
