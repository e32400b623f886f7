"""From a log to a map to a drive: readers, ``unifg map``, ``unifg localise``, ``unifg run navigation --log``."""

from __future__ import annotations

import gzip
import json
import logging
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hostile import drive_file
from recorded import cast, corridors, recorded, wheels, write_csv
from unifg.errors import FileFormatError, ScenarioError
from unifg.files.range_log import RangeLog, aligned, read_range_log
from unifg.files.ros_map import load_map
from unifg.files.tum import read_tum
from unifg.lie import SE2
from unifg.models.distance_map import DistanceMap
from unifg.scenarios import log_drive, log_map
from unifg.scenarios.command import main
from unifg.scenarios.commands import replays
from unifg.scenarios.ground.hypotheses import Hypothesis, gathered, mixed
from unifg.scenarios.ground.localiser import Localiser
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.scan_map import field_of, mapped
from unifg.scenarios.range_logs import LogSettings
from unifg.scenarios.scenes.log_scene import log_scene
from unifg.typing import Array

ANYWHERE = Path("log")


@pytest.fixture(scope="module")
def log() -> RangeLog:
    return recorded(*corridors())


@pytest.fixture(scope="module")
def truth(log: RangeLog) -> Array:
    assert log.corrected is not None
    return log.corrected


@pytest.fixture(scope="module")
def made(log: RangeLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a log and the results of ``unifg map`` on it."""
    folder = tmp_path_factory.mktemp("made")
    write_csv(folder / "log.csv", log)
    assert main(["map", str(folder / "log.csv"), "--out", str(folder)]) == 0
    return folder


def apart(poses: Array, truth: Array) -> Array:
    return np.asarray(np.hypot(*(poses - truth)[:, :2].T))


# ---------------------------------------------------------------- readers


def test_a_table_is_read_as_it_was_written(log: RangeLog, tmp_path: Path) -> None:
    write_csv(tmp_path / "log.csv", log)
    read = read_range_log(tmp_path / "log.csv")
    for name in ("time", "angles", "ranges", "odometry", "corrected"):
        np.testing.assert_array_equal(getattr(read, name), getattr(log, name))
    (tmp_path / "log.CSV.gz").write_bytes(gzip.compress((tmp_path / "log.csv").read_bytes()))
    np.testing.assert_array_equal(read_range_log(tmp_path / "log.CSV.gz").ranges, log.ranges)


def test_beams_and_scans_in_any_order_and_unit_are_one_log(
    log: RangeLog, truth: Array, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    back, turned = np.arange(len(log))[::-1], np.arange(len(log.angles))[::-1]
    other = replace(
        log, time=log.time[back], angles=log.angles[turned], ranges=log.ranges[np.ix_(back, turned)],
        odometry=log.odometry[back], corrected=truth[back],
    )  # fmt: skip
    write_csv(tmp_path / "log.csv", other, unit=1e6)
    with caplog.at_level(logging.WARNING):
        read = read_range_log(tmp_path / "log.csv")
    assert "units of 1/1e+06 s" in caplog.text
    np.testing.assert_allclose(read.time, log.time, rtol=1e-12)
    np.testing.assert_array_equal(read.ranges, log.ranges)
    np.testing.assert_array_equal(read.corrected, log.corrected)


def test_a_frequent_longest_range_means_that_nothing_was_hit(log: RangeLog, tmp_path: Path) -> None:
    short = np.where(log.ranges > 8.0, 8.19, log.ranges)
    write_csv(tmp_path / "log.csv", replace(log, ranges=short))
    read = read_range_log(tmp_path / "log.csv")
    assert (np.isinf(read.ranges) == (short == 8.19)).all() and np.isinf(read.ranges).any()
    rare = np.random.default_rng(0).uniform(1.0, 9.0, log.ranges.shape)
    write_csv(tmp_path / "log.csv", replace(log, ranges=rare))
    assert np.isfinite(read_range_log(tmp_path / "log.csv").ranges).all()


def test_who_stands_for_an_hour_counts_in_seconds(log: RangeLog, tmp_path: Path) -> None:
    assert log.corrected is not None
    hour = log.time[-1] + 60.0 * np.arange(1.0, 200.0)
    given = {"ranges": log.ranges, "odometry": log.odometry, "corrected": log.corrected}
    stood: Any = {name: np.concatenate([a, np.repeat(a[-1:], len(hour), 0)]) for name, a in given.items()}
    write_csv(tmp_path / "log.csv", RangeLog("log", np.append(log.time, hour), log.angles, **stood))
    np.testing.assert_allclose(read_range_log(tmp_path / "log.csv").time[: len(log)], log.time)


@pytest.mark.parametrize("maximum", [0.0, -1.0])
def test_a_maximum_that_is_none_hides_no_range(log: RangeLog, tmp_path: Path, maximum: float) -> None:
    seen, step = np.where(np.isfinite(log.ranges), log.ranges, 0.0), log.angles[1] - log.angles[0]
    lines = [
        f"ROBOTLASER1 0 {log.angles[0]} 3.1 {step} {maximum} 0.01 0 {len(row)} {' '.join(map(str, row.tolist()))} 0 "
        f"{k} 0 0 {k} 0 0 0 0 0.1 0.1 0 {k} host {k}\n"
        for k, row in enumerate(seen)
    ]
    (tmp_path / "log.clf").write_text("".join(lines))
    np.testing.assert_array_equal(np.isfinite(read_range_log(tmp_path / "log.clf").ranges), seen > 0.0)


@pytest.mark.parametrize(
    ("ranges", "poses", "said"),
    [
        (1e3, [1.0, 1.0, 1.0], r"half of the ranges are beyond [12]\d\d\d: metres are read"),
        (1.0, [1e3, 1e3, 1.0], r"12\d{4} m are driven in 1\d\d s: metres and seconds are read"),
        (1.0, [1.0, 1.0, 180.0 / math.pi], r"the way goes where headings of degrees point: radians are read"),
    ],
)
def test_other_units_are_no_log(log: RangeLog, tmp_path: Path, ranges: float, poses: list[float], said: str) -> None:
    write_csv(tmp_path / "log.csv", replace(log, ranges=ranges * log.ranges, odometry=log.odometry * poses))
    with pytest.raises(FileFormatError, match=said):
        read_range_log(tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,x,y,0.1\n0,0,0,1\n", "the header has no theta"),
        ("", "the header has no time, x, y, theta"),
        ("time,x,y,theta,0.1\n0,0,0,0,1\n1,0,0\n", "row 2 is not 5 numbers"),
        ("time,x,y,theta,0.1\n0,0,0,zero,1\n", "row 1 is not 5 numbers"),
        ("time,x,y,theta,0.1\n0,0,0,0,1_5\n", "row 1 is not 5 numbers"),
        ("time,x,y,theta,0.1\n0,0,0,0,1\n", "at least two scans"),
        ("time,x,y,theta,0.1\n", "there is no scan in this log"),
        ("time,x,y,theta\n0,0,0,0\n1,0,0,0\n", "the header has no beam;"),
        ("time,x,y,theta,0.1\n0,0,0,0,1\n1,0,0,inf,1\n", "row 2: theta is inf, not finite"),
        ("time,x,y,theta,-5,0,5\n0,0,0,0,1,1,1\n1,0,0,0,1,1,1\n", "beams 10 rad apart are more than a turn"),
        ("time,x,y,theta,-90,90\n0,0,0,0,1,1\n1,0,0,0,1,1\n", "-90 is no direction of a beam"),
        ("time,x,y,theta,0,nan\n0,0,0,0,1,1\n1,0,0,0,1,1\n", "nan is no direction"),
        ("time,x,y,theta,x,0\n0,0,0,0,1,1\n1,0,0,0,1,1\n", "the header has 'x' twice"),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(FileFormatError, match=said):
        read_range_log(tmp_path / "log.csv")


@pytest.mark.parametrize("turning", [0.0, 0.02, 0.3])
def test_headings_in_degrees_are_refused_by_where_the_way_goes(tmp_path: Path, turning: float) -> None:
    """They turned by less than a turn between two scans, and were radians without a word."""
    heading = 0.3 + turning * np.arange(200)
    way = np.cumsum(0.05 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    for factor in (1.0, 180.0 / math.pi):
        poses = np.column_stack([way - 0.05 * np.stack([np.cos(heading), np.sin(heading)], axis=1), factor * heading])
        log = RangeLog("log", 0.1 * np.arange(200.0), np.array([-0.1, 0.1]), np.full((200, 2), 3.0), poses, poses)
        write_csv(tmp_path / "log.csv", log)
        if factor > 1.0 and turning:
            with pytest.raises(FileFormatError, match="where headings of degrees point: radians are read"):
                read_range_log(tmp_path / "log.csv")
        else:
            assert len(read_range_log(tmp_path / "log.csv")) == 200


def test_columns_that_are_left_out_are_named(log: RangeLog, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_csv(tmp_path / "log.csv", log)
    assert read_range_log(tmp_path / "log.csv").corrected is not None and "left out" not in caplog.text
    text = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").write_text(text.replace("corrected_theta", "corrected_heading"))
    assert read_range_log(tmp_path / "log.csv").corrected is None
    assert "names are no directions: 'corrected_x', 'corrected_y', 'corrected_heading'" in caplog.text


def carmen(path: Path, log: RangeLog, laser: Array, robot: Array, odometry: Array | None) -> None:
    """Write FLASER lines, and ODOM lines where there is odometry."""
    lines = []
    for k in range(len(log)):
        if odometry is not None:
            lines.append(f"ODOM {' '.join(map(str, odometry[k].tolist()))} 0 0 0 {k} host {k}")
        ranges = np.where(np.isfinite(log.ranges[k]), log.ranges[k], 81.9)
        numbers = [*ranges.tolist(), *laser[k].tolist(), *robot[k].tolist()]
        lines.append(f"FLASER {len(ranges)} {' '.join(map(str, numbers))} {k} host {k}")
    path.write_text("\n".join(lines) + "\n")


def test_a_carmen_log_says_which_poses_are_corrected(log: RangeLog, truth: Array, tmp_path: Path) -> None:
    path = tmp_path / "log.clf"
    mount = np.array([0.3, 0.0, 0.0])
    carmen(path, log, SE2.compose(log.odometry, mount), log.odometry, None)
    raw = read_range_log(path)
    assert raw.corrected is None and raw.placed, "a mount that is given would be applied to it again"
    np.testing.assert_allclose(raw.odometry, SE2.compose(log.odometry, mount), atol=1e-9)
    assert np.isinf(raw.ranges).any()
    carmen(path, log, truth, log.odometry, None)
    found = read_range_log(path)
    assert found.corrected is not None
    np.testing.assert_allclose(found.corrected, truth)
    np.testing.assert_allclose(found.odometry, log.odometry)
    drifted = wheels(truth, np.random.default_rng(3), scale=0.2)
    carmen(path, log, truth, truth, drifted)
    found = read_range_log(path)
    assert found.corrected is not None
    np.testing.assert_allclose(found.corrected, truth)
    np.testing.assert_allclose(
        SE2.between(found.odometry[0], found.odometry), SE2.between(drifted[0], drifted), atol=1e-9
    )
    carmen(path, log, truth, truth, truth)
    assert read_range_log(path).corrected is None and not read_range_log(path).placed


def test_scans_without_odom_lines_are_left_out(
    log: RangeLog, truth: Array, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The wheels stood still before and after all of them, and plain poses so seemed to be corrected ones."""
    path, half = tmp_path / "log.clf", len(log) // 2
    for wheeled, corrected in ((truth, False), (wheels(truth, np.random.default_rng(3), scale=0.5), True)):
        carmen(path, log, truth, truth, wheeled)
        lines = path.read_text().splitlines()
        path.write_text("\n".join(line for k, line in enumerate(lines) if k < 2 * half or k % 2) + "\n")
        found = read_range_log(path)
        assert (found.corrected is not None) is corrected
        assert len(found) == (half if corrected else len(log))
    assert f"{len(log) - half} of {len(log)} scans left out: no ODOM line then" in caplog.text


def test_poses_are_laid_on_each_other(log: RangeLog, truth: Array) -> None:
    np.testing.assert_allclose(
        aligned(SE2.compose(np.array([3.0, -2.0, 0.7]), truth), truth)[:, :2], truth[:, :2], atol=1e-9
    )
    best = np.sum(apart(aligned(log.odometry, truth), truth) ** 2)
    for nudge in 0.01 * np.eye(3):
        assert best <= np.sum(apart(SE2.compose(nudge, aligned(log.odometry, truth)), truth) ** 2)


def rosbag(folder: Path, log: RangeLog, mount: Array) -> None:
    """Write a rosbag2 in MCAP."""
    writer = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    kind = {name.rpartition("/")[2]: store.types[name] for name in store.types}

    def header(k: int, frame: str) -> Any:
        return kind["Header"](kind["Time"](k, 500_000_000), frame)

    def turned(pose: Array) -> tuple[Any, Any]:
        half = 0.5 * pose[2]
        return (float(pose[0]), float(pose[1]), 0.0), kind["Quaternion"](0.0, 0.0, math.sin(half), math.cos(half))

    with writer.Writer(folder, version=9, storage_plugin=writer.StoragePlugin.MCAP) as bag:
        names = ("sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage")
        scans, wheel, frames = (
            bag.add_connection(topic, name, typestore=store)
            for topic, name in zip(("/scan", "/odom", "/tf_static"), names, strict=True)
        )
        place, turn = turned(mount)
        held = kind["TransformStamped"](header(0, "base"), "laser", kind["Transform"](kind["Vector3"](*place), turn))
        bag.write(frames, 0, store.serialize_cdr(kind["TFMessage"]([held]), names[2]))
        step = float(log.angles[1] - log.angles[0])
        for k in range(len(log)):
            ranges = np.where(np.isnan(log.ranges[k]), 0.0, log.ranges[k]).astype(np.float32)
            scan = kind["LaserScan"](
                header(k, "laser"), float(log.angles[0]), float(log.angles[-1]), step, 0.0, 0.0, 0.1, 30.0, ranges,
                np.zeros(0, dtype=np.float32),
            )  # fmt: skip
            bag.write(scans, k * 10**9, store.serialize_cdr(scan, names[0]))
            place, turn = turned(log.odometry[k])
            pose = kind["PoseWithCovariance"](kind["Pose"](kind["Point"](*place), turn), np.zeros(36))
            still = kind["Twist"](kind["Vector3"](0.0, 0.0, 0.0), kind["Vector3"](0.0, 0.0, 0.0))
            twist = kind["TwistWithCovariance"](still, np.zeros(36))
            bag.write(
                wheel,
                k * 10**9,
                store.serialize_cdr(kind["Odometry"](header(k, "odom"), "base", pose, twist), names[1]),
            )


@pytest.mark.parametrize("of", ["folder", "file"])
def test_recordings_of_ros_are_read(log: RangeLog, tmp_path: Path, of: str) -> None:
    mount = np.array([0.2, -0.1, 0.4])
    rosbag(tmp_path / "bag", log, mount)
    if of == "file":
        pytest.importorskip("mcap_ros2")
    read = read_range_log(tmp_path / "bag" if of == "folder" else next((tmp_path / "bag").glob("*.mcap")))
    np.testing.assert_allclose(read.time, log.time + 0.5)
    np.testing.assert_allclose(read.angles, log.angles, atol=1e-6)
    np.testing.assert_allclose(read.ranges, log.ranges, rtol=1e-6)
    placed = SE2.compose(log.odometry, mount)
    np.testing.assert_allclose(read.odometry[:, :2], placed[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(read.odometry[:, 2] - placed[:, 2]), 1.0, atol=1e-12)


@pytest.mark.parametrize(("name", "package"), [("drive.mcap", "mcap_ros2.decoder"), ("drive.bag", "rosbags.highlevel")])
def test_what_reads_a_recording_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, package: str
) -> None:
    (tmp_path / name).write_bytes(b"")
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["map", str(tmp_path / name), "--out", str(tmp_path)]) == 2
    assert "pip install 'unifg[logs]'" in capsys.readouterr().err
    (tmp_path / "drive.npz").write_bytes(b"")
    assert main(["map", str(tmp_path / name), "--out", str(tmp_path)]) == 2
    assert "drive.npz is read" in capsys.readouterr().err
    if name == "drive.bag":  # the folder of a run
        (tmp_path / name).unlink()
        assert main(["map", str(tmp_path), "--out", str(tmp_path)]) == 2
        assert "drive.npz is read" in capsys.readouterr().err


def test_a_drive_of_the_simulation_is_read(log: RangeLog, tmp_path: Path) -> None:
    (tmp_path / "drive.npz").write_bytes(drive_file())
    read = read_range_log(tmp_path / "drive.npz")
    assert read.corrected is not None and np.isinf(read.ranges[0, 1]) and np.isnan(read.ranges[1, 0])
    np.testing.assert_array_equal(read.odometry[:, 0], [0.0, 0.1])
    for wrong in (drive_file(scan=np.ones((3, 2))), drive_file()[:-40], b"PK", b""):
        (tmp_path / "drive.npz").write_bytes(wrong)
        with pytest.raises(FileFormatError, match=r"is no drive\.npz of `unifg run`"):
            read_range_log(tmp_path / "drive.npz")


# ---------------------------------------------------------------- maps


def test_a_field_is_the_distance_to_the_nearest_point() -> None:
    rng = np.random.default_rng(1)
    points, places = rng.uniform(0.0, 3.0, (40, 2)), rng.uniform(-0.3, 3.3, (500, 2))
    nearest = np.linalg.norm(places[:, None] - points, axis=2).min(axis=1)
    near = nearest < 0.55
    assert np.abs(field_of(points).distance(places) + 0.025 - nearest)[near].max() < 0.05


def test_a_map_of_true_poses_is_the_building(log: RangeLog, truth: Array) -> None:
    building, _ = corridors()
    found = mapped(log.angles, log.ranges, truth)
    rows, columns = np.nonzero(found.occupied)
    field = DistanceMap.from_occupancy(building.occupied, building.resolution, building.origin)
    off = np.abs(field.distance(found.grid_to_world(np.column_stack([columns, rows]).astype(np.float64) + 0.5)))
    assert np.percentile(off, 90) < 0.06
    rows, columns = np.nonzero(found.free)
    inside = field.distance(found.grid_to_world(np.column_stack([columns, rows]).astype(np.float64) + 0.5)) < -0.1
    assert inside.mean() < 0.01 and found.free.sum() > 0.5 * building.free.sum()


@pytest.mark.parametrize(
    ("kind", "most"),
    [
        ({}, 0.15),
        ({"step": 0.2, "reach": 8.0}, 0.25),
        ({"view": 1.5 * math.pi, "beams": 270, "noise": 0.08, "slips": 3}, 0.15),
    ],
)
@pytest.mark.product(1, of="large maps")
def test_a_map_from_poor_odometry_is_consistent(kind: dict[str, Any], most: float) -> None:
    building, corners = corridors(seed=1)
    log = recorded(building, corners[:7], seed=1, **kind)  # once and a half around
    assert log.corrected is not None
    run, graph = log_map.map_log(log, log_map.MapSettings(ANYWHERE))
    before, after = (apart(aligned(poses, log.corrected), log.corrected) for poses in (log.odometry, run.poses))
    assert np.sqrt(np.mean(after**2)) < most < np.sqrt(np.mean(before**2))
    assert len(run.closures) > 10 and run.share.mean() > 0.95
    assert run.verdict and run.details["loop_closures"] + run.details["outliers"] == len(graph.closures)
    assert run.details["outliers"] <= 0.1 * len(graph.closures)  # measured backwards, more than half would be


def test_a_lidar_that_sees_nothing_leaves_it_to_the_wheels(log: RangeLog) -> None:
    """Not at first, and in a known place for so long that it has nothing left to be registered on."""
    assert log.corrected is not None
    ranges = log.ranges[:140].copy()
    ranges[:3] = ranges[110:132] = np.nan
    part = RangeLog("log", log.time[:140], log.angles, ranges, log.odometry[:140], log.corrected[:140])
    run, _ = log_map.map_log(part, log_map.MapSettings(ANYWHERE))
    assert run.errors is not None and run.errors[0].max() < 1.0
    with pytest.raises(ScenarioError, match="no beam of it came back from within 20 m"):
        log_map.map_log(replace(part, ranges=np.full_like(ranges, np.nan)), log_map.MapSettings(ANYWHERE))


@pytest.mark.parametrize(
    ("mirrored", "said"),
    [
        (False, ""),
        (True, "scans turn by 0.4. of what the wheels do: are beams or headings mirrored"),
        (None, "wrong: the map explains less than half of the beams"),
    ],
)
def test_a_map_of_absurd_scans_is_doubted(log: RangeLog, mirrored: bool | None, said: str) -> None:
    assert log.corrected is not None
    number = 40 if mirrored is None else 90
    ranges = log.ranges[:number, :: -1 if mirrored else 1]
    if mirrored is None:
        ranges = np.random.default_rng(0).uniform(1.0, 9.0, ranges.shape)
    part = RangeLog("log", log.time[:number], log.angles, ranges, log.odometry[:number], log.corrected[:number])
    run, _ = log_map.map_log(part, log_map.MapSettings(ANYWHERE))
    words = replays.summary(run)
    assert re.search(said, words) if said else not re.search("wrong|mirrored", words)
    assert run.succeeded is (mirrored is not None)
    assert log_scene(run).outcome.startswith("mapped" if run.succeeded else "wrong: the map explains less than half")


def test_closures_along_a_corridor_say_that_they_do_not_know_where() -> None:
    """Two walls alone: nothing tells the places along them apart, and a closure is weak along and strong across."""
    x = np.arange(-20.0, 20.0, 0.02)
    walls = field_of(np.concatenate([np.column_stack([x, np.full_like(x, side)]) for side in (-1.2, 1.2)]))
    angles = math.pi * (np.arange(180) / 180 - 0.5)
    poses = np.column_stack([np.arange(24) * 0.5 % 6.0, np.zeros(24), np.zeros(24)])
    ranges = cast(walls, poses, angles, 8.0)
    mapper = log_map.Mapper(angles, np.zeros(3))
    mapper.add(ranges[0], np.zeros(3))
    for k in range(1, len(poses)):
        mapper.add(ranges[k], SE2.between(poses[k - 1], poses[k]))
    closures = [edge for edge in mapper.edges if edge[1] - edge[0] > 1]
    assert closures
    for _, _, _, covariance in closures:
        assert covariance[0, 0] > 0.7**2 and covariance[1, 1] < 0.2**2


# ---------------------------------------------------------------- localisation


def test_draws_that_lie_together_are_one_hypothesis() -> None:
    rng = np.random.default_rng(0)
    spread = np.array([0.05, 0.02, 0.01])
    one, other = (np.array(centre) + spread * rng.standard_normal((300, 3)) for centre in ([1, 2, 3.13], [4, 2, 0.5]))
    found = gathered(np.concatenate([one, other]), np.concatenate([np.full(300, 3.0), np.ones(300)]) / 1200)
    assert [round(hypothesis.weight, 2) for hypothesis in found] == [0.75, 0.25]
    np.testing.assert_allclose(found[0].pose, [1.0, 2.0, 3.13], atol=0.02)
    deviation = np.sqrt(np.linalg.eigvalsh(found[1].covariance[:2, :2]))
    np.testing.assert_allclose(deviation, np.hypot([0.02, 0.05], 0.02), rtol=0.15)
    two = [
        Hypothesis(np.array([0.0, 0.0, 0.0]), 0.01 * np.eye(3), 3.0),
        Hypothesis(np.array([2.0, 0.0, 0.0]), 0.01 * np.eye(3)),
    ]
    np.testing.assert_allclose(mixed(two), np.diag([0.01 + 0.25 * 4.0, 0.01, 0.01]), atol=1e-12)


@pytest.mark.parametrize(
    "kind", [{}, {"step": 1.0, "noise": 0.06, "slips": 4}, {"step": 0.2, "reach": 8.0}, {"reach": 50.0, "beams": 361}]
)
@pytest.mark.parametrize("seed", [2, 3])
@pytest.mark.product(1, of="large maps")
def test_a_log_is_followed_to_its_end_on_a_map_of_other_scans(kind: dict[str, Any], seed: int) -> None:
    log = recorded(*corridors(seed=seed), seed=seed, **kind)
    assert log.corrected is not None
    rng = np.random.default_rng(seed)  # corrected poses of real logs are centimetres off, those of the map and these
    truth = log.corrected + [0.02, 0.02, 0.007] * rng.standard_normal(log.corrected.shape)
    occupancy = mapped(log.angles, log.ranges[::2], truth[::2])
    other = replace(
        log, time=log.time[1::2], ranges=log.ranges[1::2], odometry=log.odometry[1::2], corrected=truth[1::2]
    )
    run = log_drive.localise(other, occupancy, log_drive.LocaliseSettings(ANYWHERE, ANYWHERE))
    away = apart(run.poses, truth[1::2])
    assert run.succeeded and away[-1] < 0.1 and np.median(away) < 0.06
    assert 0.3 < np.median(run.nees) < 8.0


def test_several_hypotheses_are_held_until_a_corridor_ends() -> None:
    """Nothing tells where in a corridor the robot is, until it sees the end: one hypothesis is left, the right one."""
    x, y = np.arange(-20.0, 20.0, 0.02), np.arange(-1.2, 1.2, 0.02)
    sides = [np.column_stack([x, np.full_like(x, side)]) for side in (-1.2, 1.2)]
    around = field_of(np.concatenate([*sides, np.column_stack([np.full_like(y, 20.0), y])]))
    angles = math.pi * (np.arange(180) / 180 - 0.5)
    truth = np.column_stack([0.5 * np.arange(36), np.zeros(36), np.zeros(36)])
    localiser = Localiser(around, np.array([0.8, 0.05, 0.02]), np.array([0.8, 0.1, 0.05]), 180)
    held, spread, off = [], [], []
    for k, ranges in enumerate(cast(around, truth, angles, 6.0)):
        localiser.update(Scan(angles, ranges), np.array([0.5, 0.0]) if k else None, 1.0)
        held.append(localiser.hypotheses)
        spread.append(math.sqrt(localiser.covariance[0, 0]))
        off.append(apart(localiser.pose[None], truth[k : k + 1])[0])
    assert min(held[:25]) > 1 and min(spread[:25]) > 0.4 and max(off[:25]) < 3.0 * max(spread[:25])
    assert held[-1] == 1 and spread[-1] < 0.05 and off[-1] < 0.05
    localiser.update(Scan(angles, ranges), np.zeros(2), 1.0)
    localiser.reset(truth[0], np.array([0.8, 0.1, 0.05]))
    assert localiser.hypotheses == 1


def test_a_scan_that_does_not_fit_makes_hypotheses_of_which_one_has_to_fit_well(log: RangeLog, truth: Array) -> None:
    """A robot that was pushed is found nearby; one before which people stand is not looked for elsewhere."""
    building, rng = corridors()[0], np.random.default_rng(0)
    field = DistanceMap.from_occupancy(building.occupied, building.resolution, building.origin)
    sigma = np.array([0.05, 0.05, 0.03])
    pushed: list[float] = []
    hidden: list[float] = []
    for k in range(10, len(truth), 15):
        ranges = log.ranges[k]
        start = SE2.compose(truth[k], SE2.exp(np.array([0.5, 0.3, 0.3])))
        before = np.where(rng.random(180) < 0.55, 0.6, 1.0) * ranges
        for found, begin, scan in ((pushed, start, ranges), (hidden, truth[k].copy(), before)):
            localiser = Localiser(field, begin, sigma, 180)
            for _ in range(2):
                localiser.update(Scan(log.angles, scan), np.zeros(2), 0.1)
            found.append(apart(localiser.pose[None], truth[k : k + 1])[0])
    assert np.mean(np.array(pushed) < 0.1) > 0.5 and max(hidden) < 0.05


@pytest.mark.product(1, of="large maps")
def test_a_start_that_nobody_knows_is_searched_for(log: RangeLog, truth: Array) -> None:
    occupancy = corridors()[0]
    elsewhere = replace(log, odometry=SE2.compose(np.array([40.0, 10.0, 1.0]), log.odometry), corrected=None)
    run = log_drive.localise(elsewhere, occupancy, log_drive.LocaliseSettings(ANYWHERE, ANYWHERE))
    assert apart(run.poses, truth)[-1] < 0.1
    blind = replace(elsewhere, ranges=np.full_like(log.ranges, np.inf))
    with pytest.raises(ScenarioError, match=r"where it begins on the map is not known, .*--start"):
        log_drive.localise(blind, occupancy, log_drive.LocaliseSettings(ANYWHERE, ANYWHERE))


# ---------------------------------------------------------------- the command


@pytest.mark.product(1, of="large maps")
def test_a_map_is_written_and_localised_on(made: Path, log: RangeLog, capsys: pytest.CaptureFixture[str]) -> None:
    numbers = json.loads((made / "metrics.json").read_text())
    assert numbers["aligned_error_m"]["rms"] < 0.15 and numbers["loop_closures"] > 10
    assert {"map.yaml", "map.pgm", "map.png", "graph.g2o", "trajectory.tum", "scene.html"} <= {
        p.name for p in made.iterdir()
    }
    assert len(read_tum(made / "trajectory.tum").time) == len(log)
    assert load_map(made / "map.yaml").occupied.sum() > 1000
    out = made / "localised"
    assert main(["localise", str(made / "log.csv"), str(made / "map.yaml"), "--out", str(out)]) == 0
    numbers = json.loads((out / "metrics.json").read_text())
    assert numbers["aligned_error_m"]["rms"] < 0.15 and numbers["nees"] < 15.0
    said = capsys.readouterr().out
    assert "end error" in said and "NEES" in said and (out / "localise.png").stat().st_size > 10_000
    assert (
        main(["run", "navigation", "--map", str(made / "map.yaml"), "--log", str(made / "log.csv"), "--out", str(out)])
        == 0
    )
    assert json.loads((out / "metrics.json").read_text())["end_error_m"] == numbers["end_error_m"]


@pytest.mark.product(1, of="large maps")
def test_a_recorded_drive_needs_a_map_and_a_localiser(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "navigation", "--log", str(made / "log.csv"), "--out", str(made / "none")]
    assert main(words) == 2 and "give --map" in capsys.readouterr().err
    assert main([*words, "--map", str(made / "map.yaml"), "--localiser", "my:Filter"]) == 2
    assert "choose graph, amcl" in capsys.readouterr().err
    idle = ["--goal=1,2,3", "--fault", "lidar-blind@3", "--coupling", "joint", "--speed", "2"]
    assert main([*words, "--map", str(made / "map.yaml"), *idle]) == 2
    assert "leave out: goals, coupling, controller, faults" in capsys.readouterr().err
    for obstacles in (["--obstacles", "3"], ["--set", "obstacles=3"]):  # as many as are placed unasked
        assert main([*words, "--map", str(made / "map.yaml"), *obstacles]) == 2
        assert "leave out: obstacles" in capsys.readouterr().err


@pytest.mark.product(1, of="large maps")
def test_odometry_is_made_of_corrected_poses(made: Path) -> None:
    simulated = LogSettings(made / "log.csv", simulated_odometry=True)
    one, again, other = (replace(simulated, seed=seed).opened() for seed in (4, 4, 5))
    assert one.corrected is not None
    np.testing.assert_array_equal(one.odometry, again.odometry)
    assert 0.1 < apart(one.odometry, one.corrected)[-1] and not np.allclose(one.odometry, other.odometry)
    plain = LogSettings(made / "log.csv").opened().odometry
    mounted = LogSettings(made / "log.csv", mount=(0.3, 0.0, 0.2)).opened().odometry
    np.testing.assert_allclose(SE2.between(plain, mounted), np.tile([0.3, 0.0, 0.2], (len(plain), 1)), atol=1e-12)


@pytest.mark.product(1, of="large maps")
def test_an_image_that_a_run_has_written_is_none_of_another_run(
    log: RangeLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = RangeLog("log", log.time[:3], log.angles, log.ranges[:3], log.odometry[:3])
    write_csv(tmp_path / "log.csv", replace(few, corrected=few.odometry))
    for _ in range(2):
        assert main(["map", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert str(tmp_path / "out" / "map.pgm") in said.out and "has not written" not in said.err


def test_an_interrupt_leaves_the_map_so_far(log: RangeLog) -> None:
    def stop(done: float, text: str) -> None:
        if done > 0.3:
            raise KeyboardInterrupt

    run, _ = log_map.map_log(log, log_map.MapSettings(ANYWHERE), stop)
    assert (log_scene(run).outcome, log_scene(run).good) == ("interrupted", False)
    assert run.interrupted and 10 < len(run.poses) < 0.5 * len(log)
    followed = log_drive.localise(log, corridors()[0], log_drive.LocaliseSettings(ANYWHERE, ANYWHERE), stop)
    assert followed.interrupted and 10 < len(followed.poses) < 0.5 * len(log)


@pytest.mark.data
@pytest.mark.product(1, of="large maps")
def test_the_log_of_a_lab_becomes_a_map(shared_data: Path) -> None:
    whole = read_range_log(shared_data / "lidar" / "intel-corrected.log.gz")
    part = slice(0, 240)
    truth = whole.odometry[part]
    odometry = wheels(truth, np.random.default_rng(0))
    log = RangeLog("lab", whole.time[part], whole.angles, whole.ranges[part], odometry, truth)
    run, _ = log_map.map_log(log, log_map.MapSettings(ANYWHERE))
    off = apart(aligned(run.poses, truth), truth)
    assert np.sqrt(np.mean(off**2)) < 0.08
    followed = log_drive.localise(log, run.occupancy, log_drive.LocaliseSettings(ANYWHERE, ANYWHERE))
    assert apart(followed.poses, run.poses)[-1] < 0.1
