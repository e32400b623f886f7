"""Recordings of ROS: frames, clocks and beams of made-up messages, and files that are damaged or incomplete."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from unifg.errors import FileFormatError
from unifg.files import rosbag as recordings
from unifg.files.range_log import read_range_log


def messages(times: list[float], first: float = -1.0, frame: str = "laser") -> list[tuple[str, str, Any]]:
    """Scans of five beams at some times, and odometry along x from 0 to 4 s."""

    def header(time: float) -> Any:
        return SimpleNamespace(stamp=SimpleNamespace(sec=int(time), nanosec=0), frame_id=frame)

    scan = {"ranges": [1.0, 2.0, 0.05, 40.0, 3.0], "range_min": 0.1, "range_max": 30.0, "angle_increment": 0.5}
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    poses = [SimpleNamespace(position=SimpleNamespace(x=float(k), y=0.0, z=0.0), orientation=turn) for k in range(5)]
    return [
        *(("/scan", "LaserScan", SimpleNamespace(header=header(t), angle_min=first, **scan)) for t in times),
        *(
            (
                "/odom",
                "Odometry",
                SimpleNamespace(header=header(p.position.x), child_frame_id="base", pose=SimpleNamespace(pose=p)),
            )
            for p in poses
        ),
    ]


def test_scans_that_nothing_moves_or_of_other_beams_are_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Ranges below the least one, such as of the robot itself, are lost, as REP 117 says."""
    others = [*messages([1.0, 3.0, 4.0, 5.0, 9.0]), *messages([2.0], first=1.0)[:1]]
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter(others))
    read = read_range_log("drive.mcap")
    np.testing.assert_array_equal(read.time, [1.0, 3.0, 4.0])
    np.testing.assert_array_equal(read.odometry[:, 0], read.time)
    np.testing.assert_array_equal(read.ranges[0], [1.0, 2.0, np.nan, np.inf, 3.0])
    assert "3 of 6 scans left out" in caplog.text
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter(messages([1001.0, 1002.0, 1003.0])))
    with pytest.raises(FileFormatError, match=r"drive\.mcap: 0 of 3 scans have odometry at their time"):
        read_range_log("drive.mcap")


def test_scans_and_odometry_that_are_none_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clocks were to blame for scans without a step, and no file for a quaternion of zeros."""
    for key, wrong, said in (
        ("angle_increment", 0.0, "from -1 rad in steps of 0 rad"), ("angle_min", math.inf, "from inf rad in steps of"),
        ("angle_increment", math.nan, "from -1 rad in steps of nan rad"),
    ):  # fmt: skip
        told = messages([1.0, 2.0])
        for _, kind, message in told:
            vars(message).update({key: wrong} if kind == "LaserScan" else {})
        monkeypatch.setattr(recordings, "_mcap", lambda path, told=told: iter(told))
        with pytest.raises(FileFormatError, match=rf"drive\.mcap: scans of 5 beams {said}.* are none"):
            read_range_log("drive.mcap")
    told = messages([1.0, 2.0])
    told[-1][2].pose.pose.orientation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter(told))
    with pytest.raises(FileFormatError, match=r"drive\.mcap: odometry: quaternion \(4,\) .* names no rotation"):
        read_range_log("drive.mcap")


def test_a_pose_of_odometry_that_is_not_finite_is_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """One NaN in an hour of odometry refused the whole recording, without saying where."""
    told = messages([1.0, 2.0])
    told[-2][2].pose.pose.position.y = math.nan
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter(told))
    np.testing.assert_array_equal(read_range_log("drive.mcap").odometry[:, 0], [1.0, 2.0])
    assert "drive.mcap: 1 of 5 poses of odometry left out: not finite" in caplog.text
    for _, kind, message in told:
        if kind == "Odometry":
            message.pose.pose.position.y = math.nan
    with pytest.raises(FileFormatError, match=r"drive\.mcap: odometry: no pose is finite"):
        read_range_log("drive.mcap")


def test_a_laser_is_placed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mount that is given was applied on top of that of the static frames."""
    for frames, said in (([hung("laser", "base", (0.2, 0.0), (0.0, 0.0, 0.0, 1.0))], True), ([], False)):
        told = [*messages([1.0, 2.0]), ("/tf_static", "TFMessage", SimpleNamespace(transforms=frames))]
        monkeypatch.setattr(recordings, "_mcap", lambda path, told=told: iter(told))
        log = read_range_log("drive.mcap")
        assert log.placed is said
        if said:
            with pytest.raises(FileFormatError, match=r"drive\.mcap: says itself where .* leave mount out"):
                log.mounted(np.array([0.2, 0.0, 0.0]))
        else:
            assert log.mounted(np.array([0.2, 0.0, 0.0])).placed
    told = messages([1.0, 2.0])
    for _, kind, message in told:
        vars(message).update({"child_frame_id": "/laser"} if kind == "Odometry" else {})
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter(told))
    assert not read_range_log("drive.mcap").placed, "one name for both says nothing of a mount"


def test_frames_that_do_not_meet_are_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Without /tf_static the laser stood where the odometry is, without a word."""
    for child, said in (("base", True), ("/laser", False)):
        told = messages([1.0, 2.0])
        for _, kind, message in told:
            vars(message).update({"child_frame_id": child} if kind == "Odometry" else {})
        monkeypatch.setattr(recordings, "_mcap", lambda path, told=told: iter(told))
        caplog.clear()
        read_range_log("drive.mcap")
        assert ("no static frames lead from 'laser' of the laser to 'base' of the odometry" in caplog.text) is said


def test_scans_in_a_hole_of_odometry_are_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Over 40 s without odometry the way was a straight line; a robot that stands may be silent as long."""
    for moved, left in ((100.0, [1.0, 3.0, 44.0]), (0.0, [1.0, 3.0, 20.0, 44.0])):
        told = messages([1.0, 3.0, 20.0, 44.0])
        late = messages([])
        for _, _, message in late:
            message.header.stamp.sec += 43
            message.pose.pose = SimpleNamespace(**vars(message.pose.pose))
            message.pose.pose.position = SimpleNamespace(x=4.0 + moved, y=0.0, z=0.0)
        monkeypatch.setattr(recordings, "_mcap", lambda path, told=told + late: iter(told))
        assert read_range_log("drive.mcap").time.tolist() == left
    assert "1 of 4 scans left out: no odometry then" in caplog.text


def test_drives_and_topics_that_are_mixed_are_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Two drives of one simulated clock were one that jumped; of several odometries one was taken without a word."""
    told = messages([1.0, 2.0])
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter([*told, *messages([])]))
    read_range_log("drive.mcap")
    assert "stamps of odometry run backwards by up to 4 s" in caplog.text
    caplog.clear()
    other = messages([])[1:4]
    for _, _, message in other:
        message.child_frame_id = "arm"
        message.pose.pose = SimpleNamespace(**vars(message.pose.pose))
        message.pose.pose.position = SimpleNamespace(x=50.0, y=0.0, z=0.0)
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter([*told, *other, ("/ekf", *messages([])[0][1:])]))
    np.testing.assert_array_equal(read_range_log("drive.mcap").odometry[:, 0], [1.0, 2.0])
    assert "odometry of other frames than 'base' in 'laser' left out" in caplog.text
    assert "several topics of Odometry, of which that with most is taken: /odom (8), /ekf (1)" in caplog.text


def test_a_laser_that_does_not_scan_level_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one that stands on its side, rounding decided to which side its beams turn."""
    for turn in ((0.5**0.5, 0.0, 0.0, 0.5**0.5), (0.0, 0.5**0.5, 0.0, 0.5**0.5)):
        told = [*messages([1.0, 2.0]), ("/tf_static", "TFMessage", SimpleNamespace(transforms=[
            hung("laser", "base", (0.2, 0.0), turn)
        ]))]  # fmt: skip
        monkeypatch.setattr(recordings, "_mcap", lambda path, told=told: iter(told))
        with pytest.raises(FileFormatError, match=r"drive\.mcap: the laser 'laser' is tilted by 90 degrees"):
            read_range_log("drive.mcap")


def hung(child: str, parent: str, place: tuple[float, float], turn: tuple[float, float, float, float]) -> Any:
    """A static frame; the quaternion has its scalar last."""
    where = SimpleNamespace(
        translation=SimpleNamespace(**dict(zip("xyz", (*place, 0.3), strict=True))),
        rotation=SimpleNamespace(**dict(zip("xyzw", turn, strict=True))),
    )
    return SimpleNamespace(child_frame_id=child, header=SimpleNamespace(frame_id=parent), transform=where)


@pytest.mark.parametrize("base", ["base", "foot"])
def test_frames_are_followed_to_the_odometry(monkeypatch: pytest.MonkeyPatch, base: str) -> None:
    """A plate half a turn about on the robot, ahead on it the laser, upside down: about its x axis.

    The odometry may be of a frame that hangs on the robot itself.
    """
    frames = [
        hung("laser", "/plate", (0.2, 0.0), (1.0, 0.0, 0.0, 0.0)),
        hung("plate", "robot", (-0.5, 0.1), (0.0, 0.0, 1.0, 0.0)),
        hung("base", "robot", (0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        hung("foot", "robot", (-0.1, 0.0), (0.0, 0.0, 0.0, 1.0)),
    ]
    told = messages([1.0, 2.0], frame="/laser") + messages([3.0], frame="behind")
    for _, kind, message in told:
        if kind == "Odometry":
            message.child_frame_id = base
    told.append(("/tf_static", "TFMessage", SimpleNamespace(transforms=frames)))
    monkeypatch.setattr(recordings, "_mcap", lambda path: iter(told))
    read = read_range_log("drive.mcap")
    ahead = -0.7 + 0.1 * (base == "foot")
    np.testing.assert_allclose(read.odometry[:, :2], [[1.0 + ahead, 0.1], [2.0 + ahead, 0.1]], atol=1e-12)
    np.testing.assert_allclose(np.abs(read.odometry[:, 2]), np.pi)
    np.testing.assert_allclose(read.angles, [-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(read.ranges[0], [3.0, np.inf, np.nan, 2.0, 1.0])


def test_a_broken_recording_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\nnothing")
    with pytest.raises(FileFormatError, match=r"drive\.bag: cannot be read"):
        read_range_log(tmp_path / "drive.bag")


@pytest.mark.parametrize("wrong", ["no schema", "no summary", "no channels", "no schemas", "damaged"])
def test_what_is_wrong_with_an_mcap_file_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    """A channel without a schema, of no message of ROS, was an error; damaged chunks were read as they are."""
    mcap = pytest.importorskip("mcap.writer")
    decoder = SimpleNamespace(decoder_for=lambda encoding, schema: lambda data: json.loads(data, object_hook=held))
    package = SimpleNamespace(DecoderFactory=lambda: decoder)
    monkeypatch.setitem(sys.modules, "mcap_ros2", SimpleNamespace(decoder=package))
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", package)

    def held(words: dict[str, Any]) -> Any:
        return SimpleNamespace(**words)

    path, bare = tmp_path / "drive.mcap", {"use_statistics": False, "use_summary_offsets": False}
    bare |= {"repeat_channels": False, "repeat_schemas": False, "index_types": mcap.IndexType.NONE}
    with path.open("wb") as file:
        none = mcap.CompressionType.NONE
        only = f"repeat_{wrong.removeprefix('no ')}"
        left = {key: value for key, value in bare.items() if wrong == "no summary" or key == only}
        writer = mcap.Writer(file, compression=none, **left)
        writer.start()
        writer.add_message(writer.register_channel("/note", "json", 0), log_time=0, publish_time=0, data=b"{}")
        for topic, kind, message in messages([1.0, 2.0]):
            schema = writer.register_schema(f"x/msg/{kind}", "json", b"{}")
            data = json.dumps(message, default=vars).encode()
            writer.add_message(writer.register_channel(topic, "json", schema), log_time=1, publish_time=1, data=data)
        writer.finish()
    if wrong == "no schema":
        assert len(read_range_log(path)) == 2
        return
    if wrong == "damaged":
        path.write_bytes(path.read_bytes().replace(b"40.0", b"20.0", 1))
    words = "CRCValidationError" if wrong == "damaged" else "no summary of its channels"
    with pytest.raises(FileFormatError, match=rf"drive\.mcap: cannot be read \(.*{words}"):
        read_range_log(path)
