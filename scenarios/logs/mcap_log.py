"""Logs as MCAP files, for the tools that play recordings of robots (Foxglove, PlotJuggler, ``mcap``).

Container: https://mcap.dev/spec. Messages are JSON in the schemas that Foxglove publishes by name
(https://docs.foxglove.dev/docs/visualization/message-schemas), so that viewers draw them without being told how; what
has no such schema, the numbers of a tick, stands in one of our own that says the unit of each. All that is drawn is in
the frame ``map``, but for a scan: it is seen from ``estimate``.
"""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from unifg.atomic_write import replacing
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.logs.columns import columns
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.metrics import strict
from unifg.scenarios.logs.safe_log import SafeLog
from unifg.scenarios.logs.solved_log import SolvedLog
from unifg.typing import Array

__all__ = ["write_mcap"]

Log: TypeAlias = EpisodeLog | FlightLog | SafeLog | SolvedLog
Message: TypeAlias = tuple[str, dict[str, Any]]
"""Topic and content."""

_WORLD, _ESTIMATE = "map", "estimate"
_UNSIGNED_BYTE = 1  # foxglove.NumericType
_TICK = "unifg.Tick"
_PUBLISHED = Path(__file__).with_name("foxglove.json")  # schemas of Foxglove


@dataclass(frozen=True)
class Drawn:
    """Columns of a kind of log that have a place, by what is written of them; the others are numbers of a tick.

    Attributes:
        frames: columns of poses by the name of their frame.
        poses: columns of ways by topic.
        solids: by topic, rows (n, 5) of a log and a tick: x, y, z, radius and height [m], zero of a sphere.
        others: columns that solids are made of, or that are not numbers.
    """

    frames: Mapping[str, str]
    poses: Mapping[str, str] = field(default_factory=dict)
    solids: Mapping[str, Callable[[Any, int], Array]] = field(default_factory=dict)
    others: tuple[str, ...] = ()


def _upright(discs: Array, height: float) -> Array:
    """(n, 5) solids of discs (n, 3)."""
    rows = np.asarray(discs, dtype=np.float64).reshape(-1, 3)
    rest = np.broadcast_to([0.0, height], (len(rows), 2))
    return np.column_stack([rows[:, :2], rest[:, 0], rows[:, 2], rest[:, 1]])


_DRAWN: dict[type, Drawn] = {
    EpisodeLog: Drawn(
        {_ESTIMATE: "estimate", "truth": "true_pose"},
        {"/plan": "horizon", "/route": "route"},
        {
            "/obstacles": lambda log, k: _upright(log.obstacles[k], 0.5),
            "/tracked": lambda log, k: _upright(log.detected[k], 0.5),
        },
        ("scan", "obstacles", "detected"),
    ),
    FlightLog: Drawn(
        {_ESTIMATE: "believed", "truth": "truth"},
        {"/plan": "plans", "/past": "pasts"},
        {
            "/obstacles": lambda log, k: _upright(np.concatenate([log.layout.cylinders, log.movers[k]]), 2.0),
            "/tracked": lambda log, k: _upright(
                np.column_stack([log.landmarks[k]["mean"], log.landmarks[k]["radius"]]), 2.0
            ),
        },
        ("movers", "landmarks"),
    ),
    SafeLog: Drawn(
        {"truth": "states"},
        {"/plan": "plans"},
        {"/obstacles": lambda log, k: np.column_stack([log.bodies[k], log.radii, np.where(log.upright, 3.0, 0.0)])},
        ("bodies",),
    ),
    SolvedLog: Drawn(
        {"truth": "pose", "wanted": "wanted"}, {}, {"/obstacles": lambda log, k: _upright(log.discs, 0.5)}
    ),
}  # fmt: skip


def write_mcap(path: str | os.PathLike[str], log: Log) -> None:
    """Write a log as messages, one file that needs no other.

    Map and goals of a drive come first; then, at each tick's time since the start, transforms, ways, scan, true and
    tracked obstacles - a way or obstacles that stay as they are only once - and ``/tick``: every column of the log that
    no other topic shows, by its name there. JSON knows neither infinity nor "not a number": such a number is null, and
    a beam without a range 0, which viewers draw at the sensor.

    Args:
        path: file to write; it appears whole or not at all.
        log: of a drive, a flight or a solved plan; one of a drive without ticks has the map only.

    Raises:
        ImportError: mcap is not installed.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise ImportError("writing MCAP needs the package mcap: pip install 'unifg[mcap]'") from error
    with replacing(path) as own, open(own, "wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="unifg")
        schemas, channels = dict[str, int](), dict[str, int]()
        numbers = {name: {"description": columns(log)[name].unit} for name in _plain(log)}
        known: dict[str, Any] = json.loads(_PUBLISHED.read_text(encoding="utf-8"))
        known[_TICK] = {"type": "object", "properties": numbers}
        for number, (moment, (topic, content)) in enumerate(_messages(log)):
            name = _SCHEMA_OF.get(topic, "foxglove.PosesInFrame")
            if name not in schemas:
                schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": name, **known[name]}
                data = json.dumps(schema).encode()
                schemas[name] = writer.register_schema(name=name, encoding="jsonschema", data=data)
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schemas[name])
            stamp = _nanoseconds(moment)
            # allow_nan: a number that slipped through would make a file that viewers refuse
            data = json.dumps(content, allow_nan=False).encode()
            writer.add_message(channels[topic], log_time=stamp, publish_time=stamp, data=data, sequence=number)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves its annotation out


def _messages(log: Log) -> Iterator[tuple[float, Message]]:
    """All messages with their times [s], in the order of time."""
    first, drawn, units = float(log.time[0]) if len(log.time) else 0.0, _DRAWN[type(log)], columns(log)
    if isinstance(log, EpisodeLog):
        yield first, ("/map", _grid(log.occupancy, first))
        yield first, ("/goals", _poses(log.goals, first))
        if not log.ticks:
            yield first, ("/route", _poses(log.path, first))
    shown: dict[str, Array] = {}
    for k, moment in enumerate(log.time.tolist()):
        frames = [_transform(child, getattr(log, name)[k], moment) for child, name in drawn.frames.items()]
        yield moment, ("/tf", {"transforms": frames})
        if isinstance(log, EpisodeLog):
            yield moment, ("/scan", _scan(log, k))
        for topic, name in drawn.poses.items():
            if _anew(shown, topic, getattr(log, name)[k], units[name].lasting):
                yield moment, (topic, _poses(shown[topic], moment, "rad" in units[name].unit))
        for topic, solids in drawn.solids.items():
            if _anew(shown, topic, solids(log, k), not isinstance(log, EpisodeLog)):
                yield moment, (topic, _scene(topic, shown[topic], moment))
        yield moment, ("/tick", {name: strict(getattr(log, name)[k]) for name in _plain(log)})


def _anew(shown: dict[str, Array], topic: str, rows: Array, lasting: bool) -> bool:
    """Take what a topic shows; False where it lasts and is shown already."""
    same = lasting and topic in shown and np.array_equal(shown[topic], rows, equal_nan=True)
    shown[topic] = rows
    return not same


def _plain(log: Log) -> list[str]:
    """Columns that no other topic shows, or that stand in both."""
    drawn = _DRAWN[type(log)]
    without = {*drawn.poses.values(), *drawn.others}
    return [name for name in columns(log) if name not in without]


def _grid(occupancy: OccupancyMap, moment: float) -> dict[str, Any]:
    """The map as a grid of bytes: 100 occupied, 0 free, 255 unknown, as in ROS's occupancy grids."""
    cells = np.full(occupancy.shape, 255, dtype=np.uint8)
    cells[occupancy.free] = 0
    cells[occupancy.occupied] = 100
    return {
        "timestamp": _timestamp(moment),
        "frame_id": _WORLD,
        "pose": _pose(occupancy.origin),
        "column_count": occupancy.shape[1],
        "cell_size": {"x": occupancy.resolution, "y": occupancy.resolution},
        "row_stride": occupancy.shape[1],
        "cell_stride": 1,
        "fields": [{"name": "occupancy", "offset": 0, "type": _UNSIGNED_BYTE}],
        "data": base64.b64encode(cells.tobytes()).decode(),
    }


def _scan(log: EpisodeLog, k: int) -> dict[str, Any]:
    """The scan of a tick, seen from the estimate."""
    angles, ranges = log.scan_angles, log.scan[k]
    return {
        "timestamp": _timestamp(float(log.time[k])),
        "frame_id": _ESTIMATE,
        "pose": _pose((0.0, 0.0, 0.0)),
        "start_angle": float(angles[0]) if len(angles) else 0.0,
        "end_angle": float(angles[-1]) if len(angles) else 0.0,
        "ranges": np.where(np.isfinite(ranges), ranges, 0.0).tolist(),
        "intensities": [],
    }


def _transform(child: str, pose: Array, moment: float) -> dict[str, Any]:
    placed = _pose(pose)
    return {
        "timestamp": _timestamp(moment),
        "parent_frame_id": _WORLD,
        "child_frame_id": child,
        "translation": placed["position"],
        "rotation": placed["orientation"],
    }


def _poses(poses: Array, moment: float, planar: bool = True) -> dict[str, Any]:
    """Poses, or positions, in the world; those that are not finite are left out."""
    kept = [_pose(pose if planar else (*pose, 1.0, 0.0, 0.0, 0.0)) for pose in poses if np.isfinite(pose).all()]
    return {"timestamp": _timestamp(moment), "frame_id": _WORLD, "poses": kept}


def _scene(topic: str, solids: Array, moment: float) -> dict[str, Any]:
    """An entity that replaces the one of that topic: solids (n, 5), those that are somewhere."""
    parts: dict[str, list[dict[str, Any]]] = {kind: [] for kind in _SHAPES}
    for x, y, z, radius, height in solids[np.isfinite(solids).all(axis=1)].tolist():
        size = {"x": 2 * radius, "y": 2 * radius, "z": height or 2 * radius}
        solid = {"pose": _pose((x, y, z + height / 2, 1.0, 0.0, 0.0, 0.0)), "size": size, "color": _COLOURS[topic]}
        if height:
            parts["cylinders"].append(solid | {"bottom_scale": 1.0, "top_scale": 1.0})
        else:
            parts["spheres"].append(solid)
    entity = {
        "timestamp": _timestamp(moment),
        "frame_id": _WORLD,
        "id": topic.strip("/"),
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        **parts,
    }
    return {"deletions": [], "entities": [entity]}


_SHAPES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
_COLOURS = {
    "/obstacles": {"r": 0.84, "g": 0.37, "b": 0.0, "a": 0.8},
    "/tracked": {"r": 0.0, "g": 0.45, "b": 0.7, "a": 0.4},
}


def _pose(row: Iterable[float]) -> dict[str, Any]:
    """A pose in the plane, x, y, angle, or in space, position and quaternion (w, x, y, z)."""
    x, y, z, *turn = (float(value) for value in row)
    if not turn:
        z, turn = 0.0, [math.cos(z / 2), 0.0, 0.0, math.sin(z / 2)]
    return {
        "position": {"x": x, "y": y, "z": z},
        "orientation": {"x": turn[1], "y": turn[2], "z": turn[3], "w": turn[0]},
    }


def _nanoseconds(moment: float) -> int:
    return max(round(moment * 1e9), 0)


def _timestamp(moment: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(_nanoseconds(moment), 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


_SCHEMA_OF = {
    "/tf": "foxglove.FrameTransforms", "/map": "foxglove.Grid", "/scan": "foxglove.LaserScan", "/tick": _TICK,
    "/obstacles": "foxglove.SceneUpdate", "/tracked": "foxglove.SceneUpdate",
}  # fmt: skip
"""Schemas of topics; that of all others is a list of poses."""
