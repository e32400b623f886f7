"""A drive as an MCAP file, for the tools that play recordings of robots (Foxglove, PlotJuggler, ``mcap``).

Container: https://mcap.dev/spec. Messages are JSON in the schemas that Foxglove publishes by name
(https://docs.foxglove.dev/docs/visualization/message-schemas), so that viewers draw them without being told how; what
has no such schema, the numbers of a tick, stands in one of our own that says the unit of each. Frames: ``map``,
``estimate`` (where the robot believes to be, and where its scan is drawn) and ``truth``.
"""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import numpy as np

from unifg.atomic_write import replacing
from unifg.files.ros_map import OccupancyMap
from unifg.scenarios.logs.columns import columns
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.metrics import strict
from unifg.typing import Array

__all__ = ["write_mcap"]

Message: TypeAlias = tuple[str, dict[str, Any]]
"""Topic and content."""

_WORLD, _ESTIMATE, _TRUTH = "map", "estimate", "truth"
_HEIGHT = 0.5  # of what is drawn for obstacles [m]
_UNSIGNED_BYTE = 1  # foxglove.NumericType
_TICK = "unifg.DriveTick"
_TOPICS = {
    "/tf": "foxglove.FrameTransforms",
    "/map": "foxglove.Grid",
    "/goals": "foxglove.PosesInFrame",
    "/route": "foxglove.PosesInFrame",
    "/plan": "foxglove.PosesInFrame",
    "/scan": "foxglove.LaserScan",
    "/obstacles": "foxglove.SceneUpdate",
    "/tracked": "foxglove.SceneUpdate",
    "/tick": _TICK,
}


def write_mcap(path: str | os.PathLike[str], log: EpisodeLog) -> None:
    """Write a drive as messages, one file that needs no other.

    Map, goals and start come first; then, at each tick's time since the start, transforms, scan, plan, true and tracked
    obstacles, the route where it has changed, and ``/tick``: every column of the log that is a number, a word or a
    small array of a tick, by its name there. JSON knows neither infinity nor "not a number": such a number is null,
    and a beam without a range 0, which viewers draw at the sensor.

    Args:
        path: file to write; it appears whole or not at all.
        log: an episode; one without ticks has the map only.

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
        schemas = {name: _schema(name, log) for name in dict.fromkeys(_TOPICS.values())}
        ids = {
            name: writer.register_schema(name=name, encoding="jsonschema", data=json.dumps(schema).encode())
            for name, schema in schemas.items()
        }
        channels = {
            topic: writer.register_channel(topic=topic, message_encoding="json", schema_id=ids[schema])
            for topic, schema in _TOPICS.items()
        }
        for number, (moment, (topic, content)) in enumerate(_messages(log)):
            stamp = _nanoseconds(moment)
            # allow_nan: a number that slipped through would make a file that viewers refuse
            data = json.dumps(content, allow_nan=False).encode()
            writer.add_message(channels[topic], log_time=stamp, publish_time=stamp, data=data, sequence=number)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves its annotation out


def _messages(log: EpisodeLog) -> Iterator[tuple[float, Message]]:
    """All messages with their times [s], in the order of time."""
    first = float(log.time[0]) if log.ticks else 0.0
    yield first, ("/map", _grid(log.occupancy, first))
    yield first, ("/goals", _poses(log.goals, first))
    if not log.ticks:
        yield first, ("/route", _poses(log.path, first))
    shown: Array | None = None
    for k in range(log.ticks):
        moment = float(log.time[k])
        frames = [_transform(_ESTIMATE, log.estimate[k], moment), _transform(_TRUTH, log.true_pose[k], moment)]
        yield moment, ("/tf", {"transforms": frames})
        yield moment, ("/scan", _scan(log, k))
        yield moment, ("/plan", _poses(log.horizon[k], moment))
        if shown is None or not np.array_equal(log.route[k], shown):
            shown = log.route[k]
            yield moment, ("/route", _poses(shown, moment))
        yield moment, ("/obstacles", _scene("true", _cylinders(log.obstacles[k]), moment))
        yield moment, ("/tracked", _scene("tracked", _cylinders(log.detected[k]), moment))
        yield moment, ("/tick", {name: strict(getattr(log, name)[k]) for name in _plain(log)})


def _plain(log: EpisodeLog) -> list[str]:
    """Columns that no other topic shows."""
    drawn = {"route", "horizon", "scan", "obstacles", "detected"}
    return [name for name in columns(log) if name not in drawn]


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


def _poses(poses: Array, moment: float) -> dict[str, Any]:
    """Poses in the world; those that are not finite are left out."""
    kept = [_pose(pose) for pose in poses if np.isfinite(pose).all()]
    return {"timestamp": _timestamp(moment), "frame_id": _WORLD, "poses": kept}


def _scene(name: str, shapes: Iterable[tuple[str, dict[str, Any]]], moment: float) -> dict[str, Any]:
    """An entity that replaces the one of that name."""
    parts: dict[str, list[dict[str, Any]]] = {kind: [] for kind in _SHAPES}
    for kind, shape in shapes:
        parts[kind].append({**shape, "color": _COLOURS[name]})
    entity = {
        "timestamp": _timestamp(moment),
        "frame_id": _WORLD,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        **parts,
    }
    return {"deletions": [], "entities": [entity]}


_SHAPES = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
_COLOURS = {
    "true": {"r": 0.84, "g": 0.37, "b": 0.0, "a": 0.8},
    "tracked": {"r": 0.0, "g": 0.45, "b": 0.7, "a": 0.4},
}


def _cylinders(discs: Array) -> Iterator[tuple[str, dict[str, Any]]]:
    """Discs (n, 3), those that are somewhere."""
    for x, y, radius in discs[np.isfinite(discs).all(axis=1)]:
        pose = _pose((x, y, 0.0), _HEIGHT / 2)
        size = {"x": 2 * float(radius), "y": 2 * float(radius), "z": _HEIGHT}
        yield "cylinders", {"pose": pose, "size": size, "bottom_scale": 1.0, "top_scale": 1.0}


def _pose(planar: Array | tuple[float, float, float], height: float = 0.0) -> dict[str, Any]:
    x, y, angle = (float(value) for value in planar)
    return {
        "position": {"x": x, "y": y, "z": height},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(angle / 2), "w": math.cos(angle / 2)},
    }


def _nanoseconds(moment: float) -> int:
    return max(round(moment * 1e9), 0)


def _timestamp(moment: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(_nanoseconds(moment), 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _array(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _schema(name: str, log: EpisodeLog) -> dict[str, Any]:
    """JSON schema of a message."""
    if name == _TICK:
        units = {key: column.unit for key, column in columns(log).items()}
        schema = _object(**{key: {"description": units[key]} for key in _plain(log)})
    else:
        schema = _SCHEMAS[name]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": name, **schema}


_NUMBER, _INTEGER, _STRING, _BOOLEAN = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))
_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_QUATERNION)
_COLOUR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_CYLINDER = _object(pose=_POSE, size=_VECTOR, bottom_scale=_NUMBER, top_scale=_NUMBER, color=_COLOUR)
_ENTITY = _object(
    timestamp=_TIME, frame_id=_STRING, id=_STRING, lifetime=_TIME, frame_locked=_BOOLEAN,
    metadata=_array(_object(key=_STRING, value=_STRING)),
    **{kind: _array({"cylinders": _CYLINDER}.get(kind, _object())) for kind in _SHAPES},
)  # fmt: skip
_SCHEMAS = {
    "foxglove.FrameTransforms": _object(
        transforms=_array(
            _object(
                timestamp=_TIME, parent_frame_id=_STRING, child_frame_id=_STRING, translation=_VECTOR,
                rotation=_QUATERNION,
            )
        )
    ),
    "foxglove.Grid": _object(
        timestamp=_TIME, frame_id=_STRING, pose=_POSE, column_count=_INTEGER, cell_size=_object(x=_NUMBER, y=_NUMBER),
        row_stride=_INTEGER, cell_stride=_INTEGER,
        fields=_array(_object(name=_STRING, offset=_INTEGER, type=_INTEGER)),
        data={"type": "string", "contentEncoding": "base64"},
    ),
    "foxglove.PosesInFrame": _object(timestamp=_TIME, frame_id=_STRING, poses=_array(_POSE)),
    "foxglove.LaserScan": _object(
        timestamp=_TIME, frame_id=_STRING, pose=_POSE, start_angle=_NUMBER, end_angle=_NUMBER,
        ranges=_array(_NUMBER), intensities=_array(_NUMBER),
    ),
    "foxglove.SceneUpdate": _object(
        deletions=_array(_object(timestamp=_TIME, type=_INTEGER, id=_STRING)), entities=_array(_ENTITY)
    ),
}  # fmt: skip
