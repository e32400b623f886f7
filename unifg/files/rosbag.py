"""Laser scans and odometry of ROS recordings, by the packages that read them.

MCAP files are read by ``mcap`` with ``mcap-ros2-support``, folders of rosbag2 and rosbags of ROS 1 by ``rosbags``.
Messages: ``sensor_msgs/LaserScan``, ``nav_msgs/Odometry`` and, for where the laser is on the robot,
``tf2_msgs/TFMessage`` on the topic ``/tf_static``.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unifg.errors import FileFormatError, UnifgError
from unifg.files.contents import legible
from unifg.lie import SE2, SE3
from unifg.typing import Array, BoolArray

__all__ = ["Recorded", "read_rosbag"]

logger = logging.getLogger("unifg")

SCAN, ODOMETRY, FRAMES = "LaserScan", "Odometry", "TFMessage"
LEVEL = 0.9  # cosine of the tilt of a laser, below which its plane is not that of the map
BACK = 1.0  # [s] by which stamps run backwards in one drive at most
HOLE = 1.0, 10.0, 0.1  # [s], over the usual interval, and [m] of way, beyond which odometry is not interpolated


class Recorded(NamedTuple):
    """Scans of one laser.

    Attributes:
        time: (n,) of their stamps [s].
        angles: (b,) directions of the beams [rad].
        ranges: (n, b) [m]; NaN below the least range of the laser.
        maximum: of a range [m].
        odometry: (n, 3) poses of the laser by the wheels, interpolated [m, m, rad].
        placed: whether static frames say where on the robot the laser stands.
    """

    time: Array
    angles: Array
    ranges: Array
    maximum: float
    odometry: Array
    placed: bool


def read_rosbag(path: Path) -> Recorded:
    """Read the topic with most scans, and the one with most odometry.

    Scans before, after or in a hole of the odometry, or of another frame or other directions than most, are left out
    with a warning. The laser stands where the static frames say, however many there are between it and the odometry's;
    of one that hangs upside down the beams turn the other way round. A warning says so where none join the two.

    Raises:
        FileFormatError: it cannot be read, holds no scans or no odometry, or the laser does not scan level.
        ImportError: the package that reads it is not installed.
    """
    own = path / "drive.npz" if path.is_dir() else path.with_name("drive.npz")
    hint = f"; of a run of unifg {legible(own)} is read" if path.exists() and own.is_file() else ""
    name, topics, links = legible(path), dict[str, dict[str, list[Any]]](), dict[str, tuple[str, Array]]()
    try:
        for topic, kind, message in _mcap(path) if path.suffix == ".mcap" else _bag(path):
            if kind == FRAMES:
                if topic.endswith("tf_static"):
                    poses = SE3.from_quaternion(_numbers([one.transform for one in message.transforms]), order="xyzw")
                    for one, pose in zip(message.transforms, poses, strict=True):
                        links[one.child_frame_id.lstrip("/")] = one.header.frame_id, pose
            else:
                topics.setdefault(kind, {}).setdefault(topic, []).append(message)
    except MemoryError:
        raise
    except ImportError as error:
        raise ImportError(f"{error}{hint}") from error
    except Exception as error:  # each of these packages lets out whatever its parts raise
        raise FileFormatError(f"{name}: cannot be read ({type(error).__name__}: {error})") from error
    if lacking := [kind for kind in (SCAN, ODOMETRY) if kind not in topics]:
        raise FileFormatError(f"{name}: no message of ROS of the kind {' and '.join(lacking)}{hint}")
    scans, wheels = (max(topics[kind].values(), key=len) for kind in (SCAN, ODOMETRY))
    for kind in (SCAN, ODOMETRY):
        if len(topics[kind]) > 1:
            said = ", ".join(f"{topic} ({len(found)})" for topic, found in topics[kind].items())
            logger.warning("%s: several topics of %s, of which that with most is taken: %s", name, kind, said)
    forms = Counter((scan.header.frame_id, len(scan.ranges), scan.angle_min, scan.angle_increment) for scan in scans)
    (frame, count, first, step), _ = forms.most_common(1)[0]
    if not (math.isfinite(first) and 0.0 < count * abs(step) < math.inf):
        raise FileFormatError(f"{name}: scans of {count} beams from {first:g} rad in steps of {step:g} rad are none")
    (known, poses, holes, robot), every = _odometry(name, wheels), len(scans)
    scans = [
        scan
        for scan in scans
        if known[0] <= _stamp(scan) <= known[-1]
        and not holes[np.searchsorted(known, _stamp(scan))]
        and (scan.header.frame_id, len(scan.ranges)) == (frame, count)
        and abs(scan.angle_min - first) + count * abs(scan.angle_increment - step) < abs(step)
    ]
    if len(scans) < 2:
        raise FileFormatError(f"{name}: {len(scans)} of {every} scans have odometry at their time: are clocks apart?")
    if len(scans) < every:
        logger.warning("%s: %d of %d scans left out: no odometry then, or other beams", name, every - len(scans), every)
    time = np.array([_stamp(scan) for scan in scans])
    columns = (*poses[:, :2].T, np.unwrap(poses[:, 2]))
    at = np.column_stack([np.interp(time, known, column) for column in columns])
    (root, base), (other, laser) = (_hung(links, one) for one in (robot, frame))
    placed = root == other and frame.lstrip("/") != robot.lstrip("/")
    if root != other:
        logger.warning(
            "%s: no static frames lead from %r of the laser to %r of the odometry, which is taken to be %r",
            name, frame, robot, other,
        )  # fmt: skip
    mount = SE3.between(base, laser)
    if abs(level := float(SE3.matrix(mount)[2, 2])) < LEVEL:
        tilt = math.degrees(math.acos(abs(level)))
        raise FileFormatError(f"{name}: the laser {frame!r} is tilted by {tilt:.0f} degrees: scans are to be level")
    ranges = np.array([scan.ranges for scan in scans], dtype=np.float64)
    ranges[ranges < scans[0].range_min] = np.nan
    angles = math.copysign(1.0, level) * (first + step * np.arange(count, dtype=np.float64))
    return Recorded(time, angles, ranges, float(scans[0].range_max), SE2.compose(at, _planar(mount)), placed)


def _odometry(name: str, wheels: list[Any]) -> tuple[Array, Array, BoolArray, str]:
    """Times (n,) and planar poses (n, 3) in order, which of them (n,) end a hole, and the frame of the robot.

    Raises:
        FileFormatError: an attitude is none.
    """
    ((world, robot), _), *others = Counter((one.header.frame_id, one.child_frame_id) for one in wheels).most_common()
    if others:
        wheels = [one for one in wheels if (one.header.frame_id, one.child_frame_id) == (world, robot)]
        logger.warning("%s: odometry of other frames than %r in %r left out", name, robot, world)
    time, numbers = np.array([_stamp(one) for one in wheels]), _numbers([one.pose.pose for one in wheels])
    finite = np.isfinite(numbers.sum(axis=1))
    if not finite.any():
        raise FileFormatError(f"{name}: odometry: no pose is finite")
    if not finite.all():
        logger.warning("%s: %d of %d poses of odometry left out: not finite", name, np.sum(~finite), len(finite))
        time, numbers = time[finite], numbers[finite]
    if (back := float((np.maximum.accumulate(time) - time).max())) > BACK:
        logger.warning("%s: stamps of odometry run backwards by up to %g s: is it more than one drive?", name, back)
    order = np.argsort(time, kind="stable")
    try:
        time, poses = time[order], _planar(SE3.from_quaternion(numbers[order], order="xyzw"))
    except UnifgError as error:
        raise FileFormatError(f"{name}: odometry: {error}") from error
    gaps, (least, usual, way) = np.diff(time, prepend=time[0]), HOLE
    holes = (gaps > max(least, usual * float(np.median(gaps)))) & (
        np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T) > way
    )
    return time, poses, holes, robot


def _mcap(path: Path) -> Iterator[tuple[str, str, Any]]:
    """Topic, kind and content of the messages of an MCAP file that are wanted."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise ImportError(f"reading {path.name} needs mcap and mcap-ros2-support: pip install 'unifg[logs]'") from error
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary: Any = reader.get_summary()
        known, channels = ({}, []) if summary is None else (summary.schemas, summary.channels.values())
        schemas = {0: ""} | {number: schema.name for number, schema in known.items()}  # 0: none
        if not channels or any(one.schema_id not in schemas for one in channels):
            raise FileFormatError("no summary of its channels at the end: `mcap recover` makes one")
        kinds = {one.topic: _kind(schemas[one.schema_id]) for one in channels}
        wanted = [topic for topic, kind in kinds.items() if kind]
        for _, channel, _, message in reader.iter_decoded_messages(topics=wanted):
            yield channel.topic, kinds[channel.topic], message


def _bag(path: Path) -> Iterator[tuple[str, str, Any]]:
    """The same of a folder of rosbag2, or of a rosbag of ROS 1."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"reading {path.name} needs rosbags: pip install 'unifg[logs]'") from error
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [one for one in reader.connections if _kind(one.msgtype)]
        for connection, _, raw in reader.messages(connections=wanted):
            yield connection.topic, _kind(connection.msgtype), reader.deserialize(raw, connection.msgtype)


def _kind(name: str) -> str:
    """Last part of the name of a message that is wanted, or nothing."""
    last = name.rpartition("/")[2]
    return last if last in (SCAN, ODOMETRY, FRAMES) else ""


def _stamp(message: Any) -> float:
    """Time of a message [s]; ROS 1 and 2 and the packages name nanoseconds in two ways."""
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(getattr(stamp, "nanosec", 0) or getattr(stamp, "nsec", 0))


def _numbers(given: Iterable[Any]) -> Array:
    """(n, 7) x, y, z and quaternions, w last, of poses or transforms."""
    rows = []
    for one in given:
        place = getattr(one, "position", None) or one.translation
        turn = getattr(one, "orientation", None) or one.rotation
        rows.append([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def _planar(poses: Array) -> Array:
    """(..., 3) x, y and heading of poses (..., 7), which is that of their x axis."""
    matrix = SE3.matrix(poses)
    return np.stack([*np.moveaxis(poses[..., :2], -1, 0), np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0])], axis=-1)


def _hung(links: dict[str, tuple[str, Array]], frame: str) -> tuple[str, Array]:
    """The last frame that a frame hangs on, and its pose (7,) there; ROS 1 may begin their names with a slash."""
    pose = SE3.identity()
    for _ in links:  # at most; frames may hang on each other
        if (name := frame.lstrip("/")) in links:
            frame, own = links[name]
            pose = SE3.compose(own, pose)
    return frame.lstrip("/"), pose
