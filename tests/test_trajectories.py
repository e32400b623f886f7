"""Trajectories (TUM, KITTI, EuRoC) and CARMEN logs: what is written is read back, and a bad line is named."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import unifg as fg
from unifg.errors import FileFormatError
from unifg.files.carmen import read_carmen
from unifg.files.euroc import read_euroc
from unifg.files.kitti import read_kitti, write_kitti
from unifg.files.tum import read_tum, write_tum
from unifg.lie import wrap_angle

TUM = "# t tx ty tz qx qy qz qw\n0 0 0 0 0 0 0 1\n"
KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n"
EUROC = """\
#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x
1403636580838555648,4.688319,-1.786938,0.783338,0.6,0,0,0.8,-0.027876

1403636580843555648, 4.688177, -1.786770, 0.787350, 1.2, 0, 0, 1.6
"""
CARMEN = """\
# a comment
PARAM robot_length 0.5
ODOM 1.0 2.0 0.5 0.3 -0.1 0 10.0 host 0.5
FLASER 4 1.0 2.0 3.0 80.0 1.1 2.1 0.6 1.2 2.2 0.7 10.1 host 0.6
FLASER 4 1.5 2.5 3.5 81.0 1.2 2.2 0.7 1.3 2.3 0.8 10.2 host 0.7
ROBOTLASER1 0 -1.5 3.0 0.75 30.0 0.01 0 5 1 2 3 4 5 2 0 0 7 8 0.1 9 10 0.2 0.5 0.4 0.3 0.2 0 10.3 host 0.8
NEFF 12
"""


def put(folder: Path, text: str) -> Path:
    path = folder / "file.txt"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("read", "before", "line", "message"),
    [
        (read_tum, TUM, "1 2 3", "line 3: 3 fields, expected 8"),
        (read_tum, TUM, "1,2,3,4,5,6,7,8", "separated by blanks, not commas"),
        (read_tum, TUM, "1 2 x 4 0 0 0 1", "line 3: field ty is 'x'"),
        (read_tum, TUM, "1 2 1_0 4 0 0 0 1", "line 3: field ty is '1_0', not a number"),
        (read_tum, TUM, "1 2 \u0663 4 0 0 0 1", "line 3: field ty is '\u0663', not a number"),
        (read_tum, TUM, "1 2 nan 4 0 0 0 1", "line 3: field ty is 'nan', not a finite"),
        (read_tum, TUM, "1 2 3 4 0 0 0 0", "line 3: the quaternion .* has norm 0"),
        (read_kitti, KITTI, "1 0 0 0 0 1 0 0 0 0 1", "line 2: 11 fields, expected 12"),
        (read_kitti, KITTI, "1 0 0 0 0 2 0 0 0 0 1 0", "line 2: .* not a rotation matrix"),
        (read_kitti, KITTI, "1 0 0 0 0 1 0 0 0 0 -1 0", "line 2: .* not a rotation matrix"),  # a reflection
        (read_euroc, EUROC, "1,2,3", "line 5: 3 fields between commas, expected 8"),
        (read_euroc, EUROC, "1 0 0 0 1 0 0 0", "line 5: 1 fields between commas"),
        (read_euroc, EUROC, "1.5,0,0,0,1,0,0,0,0", r"line 5: field t is '1\.5', not an integer of 64 bits"),
        (read_euroc, EUROC, "-1,0,0,0,1,0,0,0,0", "line 5: the time is below zero"),
        (read_euroc, EUROC, "1,0,0,0,1,,0,0,0", "line 5: 7 fields, expected 8"),
        (read_euroc, EUROC, "1,0,x,0,1,0,0,0,0", "line 5: field y is 'x', not a number"),
        (read_euroc, EUROC, "1,0,0,inf,1,0,0,0,0", "line 5: field z is 'inf', not a finite number"),
        (read_euroc, EUROC, "1,0,0,0,0,0,0,0,0", "line 5: the quaternion .* has norm 0"),
        (read_carmen, CARMEN, "ODOM 1 2 3 4 5 6 7 host", "line 8: ODOM: 8 fields, expected 9"),
        (read_carmen, CARMEN, "ODOM 1 2 x 4 5 6 7 host 8", "line 8: ODOM: field theta is 'x', not a number"),
        (read_carmen, CARMEN, "FLASER 3 1 2 0 0 0 0 0 0 7 host 8", "line 8: FLASER: 12 fields, expected 13"),
        (read_carmen, CARMEN, "FLASER x 1 2 0 0 0 0 0 0 7 host 8", "line 8: FLASER: 'x' is not a number of readings"),
        (read_carmen, CARMEN, f"FLASER {'9' * 20} 1 2 0 0 0 0 0 0 7 host 8", "line 8: FLASER: 12 fields are too few"),
        (read_carmen, CARMEN, "FLASER 2 1 inf 0 0 0 0 0 0 7 host 8", "line 8: FLASER: field r2 is 'inf', not a finite"),
        (read_carmen, CARMEN, "ROBOTLASER1 0 1 2 3", "line 8: ROBOTLASER1: 4 fields are too few"),
        (
            read_carmen, CARMEN, "ROBOTLASER1 0 0 3 9e9 80 0 0 1 1 0 0 0 0 0 0 0 0 0 0 0 0 0 7 host 8",
            "line 8: ROBOTLASER1: 1 beams from 0",
        ),
        (read_carmen, "", "VERTEX_SE2 0 0 0 0", "is this a CARMEN log"),
    ],
)  # fmt: skip
def test_bad_lines_are_named(
    tmp_path: Path, read: Callable[[Path], object], before: str, line: str, message: str
) -> None:
    with pytest.raises(FileFormatError, match=message):
        read(put(tmp_path, f"{before}{line}\n"))


@pytest.mark.parametrize(("view", "right"), [(3.0, True), (3.75, True), (-3.0, True), (6.0, False), (1.5, False)])
def test_a_field_of_view_that_is_not_that_of_the_beams_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, view: float, right: bool
) -> None:
    """A step of half or twice the right one bent every scan without a word."""
    scans = read_carmen(put(tmp_path, CARMEN.replace("-1.5 3.0 0.75", f"-1.5 {view} 0.75"))).scans
    assert scans[1].angles.tolist() == [-1.5, -0.75, 0.0, 0.75, 1.5]
    said = f"line 6: a field of view of {view:g} rad is not that of 5 beams in steps of 0.75 rad, by which it is read"
    assert (said in caplog.text) != right and len(caplog.messages) == (not right)


# ---------------------------------------------------------------- TUM, KITTI and EuRoC


def test_tum_lines_are_as_other_tools_write_them(tmp_path: Path) -> None:
    half = "0.707106781"
    line = f"0.100000000 1.000000000 -2.000000000 0.000000000 0.000000000 0.000000000 {half} {half}\n"
    assert write_tum(tmp_path / "a.tum", [0.1], [[1.0, -2.0, np.pi / 2]]).read_bytes() == line.encode()
    assert "-0.0" not in write_tum(tmp_path / "a.tum", [0.0], [[-0.0, -1e-12, -1e-12]]).read_text()


@given(arrays(np.float64, (5, 3), elements=st.floats(-100.0, 100.0)))
def test_planar_poses_come_back(tmp_path_factory: pytest.TempPathFactory, poses: np.ndarray) -> None:
    back = read_tum(write_tum(tmp_path_factory.mktemp("tum") / "a.tum", 0.1 * np.arange(5), poses))
    np.testing.assert_allclose(back.time, 0.1 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(back.planar()[:, :2], poses[:, :2], atol=1e-9)
    assert np.abs(wrap_angle(back.planar()[:, 2] - poses[:, 2])).max() < 1e-8
    np.testing.assert_allclose(np.linalg.norm(back.quaternion_xyzw, axis=1), 1.0, atol=1e-14)


def test_tum_skips_comments_and_scales_quaternions(tmp_path: Path) -> None:
    trajectory = read_tum(put(tmp_path, "# t\n\n1 2 3 4 0 0 0 5\n2 0 0 0  0 0 -2 0\n"))
    np.testing.assert_array_equal(trajectory.position, [[2, 3, 4], [0, 0, 0]])
    np.testing.assert_array_equal(trajectory.quaternion_xyzw, [[0, 0, 0, 1], [0, 0, -1, 0]])  # the scalar comes last
    np.testing.assert_allclose(np.abs(trajectory.planar()[:, 2]), [0.0, np.pi])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1403636579763555584 0 0 0 0 0 0 1", "line 1: the time 1.40364e+18 is read as seconds; divide nanoseconds"),
        ("1403636579763.5 0 0 0 0 0 0 1", "is read as seconds"),
        ("0.1 0 0 0 1 0 0 0", "line 1: the scalar is read last, so that the body lies on its back; is it first here?"),
        ("1403636579.763555584 0 0 0 0 0 0 1", ""),
        ("0.1 0 0 0 0.99999 0.001 0 0", ""),
    ],
)
def test_tum_files_of_another_kind_are_remarked(
    line: str, words: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert len(read_tum(put(tmp_path, line + "\n")).time) == 1
    assert words in caplog.text and bool(words) == bool(caplog.text)


def test_spatial_poses_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = fg.SE3.random(rng, (9,))
    read = read_tum(write_tum(tmp_path / "t.tum", np.arange(9.0), poses))
    np.testing.assert_allclose(read.position, poses[:, :3], atol=1e-9)
    np.testing.assert_allclose(read.quaternion_xyzw, poses[:, [4, 5, 6, 3]], atol=2e-9)
    lines = write_kitti(tmp_path / "t.kitti", poses).read_text().splitlines()
    assert (len(lines), len(lines[0].split())) == (9, 12)
    np.testing.assert_allclose(float(lines[3].split()[7]), poses[3, 1], rtol=1e-9)  # y ends the second row
    np.testing.assert_allclose(fg.SE3.matrix(read_kitti(tmp_path / "t.kitti")), fg.SE3.matrix(poses), atol=1e-15)
    poses[:, :3] += [5e5, 5.3e6, 400.0]  # in UTM
    np.testing.assert_array_equal(read_kitti(write_kitti(tmp_path / "t.kitti", poses))[:, :3], poses[:, :3])


def test_kitti_lifts_the_plane(tmp_path: Path) -> None:
    lifted = read_kitti(write_kitti(tmp_path / "poses.txt", [[1.0, 2.0, 0.5]]))
    np.testing.assert_allclose(fg.SE3.log(fg.SE3.from_parts([0, 0, 0], lifted[0, 3:]))[3:], [0, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(lifted[0, :3], [1.0, 2.0, 0.0])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: write_tum(path, [0.0, 1.0], np.array([[0, 0, 0], [0, np.nan, 0]])), "pose 1 is not finite"),
        (lambda path: write_tum(path, [0.0, 1.0], [[0, 0, 0]]), r"\(2,\) and poses \(1, 3\)"),
        (lambda path: write_kitti(path, np.zeros((2, 4))), r"shape \(2, 4\)"),
        (lambda path: write_kitti(path, np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])), "pose 1 is not finite"),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, write: Callable[[Path], object], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        write(tmp_path / "file.txt")
    assert not (tmp_path / "file.txt").exists()


def test_euroc_has_nanoseconds_and_the_scalar_first(tmp_path: Path) -> None:
    found = read_euroc(put(tmp_path, EUROC))
    np.testing.assert_allclose(found.time, [0.0, 0.005], rtol=1e-12)  # as floats, the stamps differ by 512 ns steps
    np.testing.assert_allclose(found.quaternion_xyzw, [[0, 0, 0.8, 0.6]] * 2)
    assert found.position[1].tolist() == [4.688177, -1.786770, 0.787350]


def test_euroc_times_that_run_backwards_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    read_euroc(put(tmp_path, EUROC))
    assert "backwards" not in caplog.text
    found = read_euroc(put(tmp_path, "5000000000,0,0,0,1,0,0,0\n4000000000,0,0,0,1,0,0,0\n"))
    assert found.time.tolist() == [0.0, -1.0] and "time runs backwards, here and 0 times more" in caplog.text


@pytest.mark.parametrize(("unit", "named"), [("", "of 1 are"), ("000", "of 1000 are"), ("000000000", None)])
def test_euroc_times_that_are_no_nanoseconds_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, unit: str, named: str | None
) -> None:
    read_euroc(put(tmp_path, "".join(f"{1403636580 + k}{unit},0,0,0,1,0,0,0\n" for k in range(3))))
    assert ("read as nanoseconds" in caplog.text) is (named is not None) and (named or "") in caplog.text


@pytest.mark.parametrize("read", [read_tum, read_kitti, read_euroc])
def test_a_trajectory_without_poses_is_refused(tmp_path: Path, read: Callable[[Path], object]) -> None:
    for text in ("", "# time and pose\n", "\n\n"):
        with pytest.raises(FileFormatError, match="no line holds a pose"):
            read(put(tmp_path, text))


def test_evo_reads_what_is_written(tmp_path: Path, rng: np.random.Generator) -> None:
    """It asks for exactly eight, or twelve, fields with one blank between them."""
    evo = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    poses = fg.SE3.random(rng, (6,))
    stamped = evo.read_tum_trajectory_file(str(write_tum(tmp_path / "t.tum", np.arange(6.0), poses)))
    np.testing.assert_allclose(stamped.positions_xyz, poses[:, :3], atol=1e-9)
    again = read_tum(tmp_path / "t.tum").quaternion_xyzw
    np.testing.assert_allclose(stamped.orientations_quat_wxyz[:, [1, 2, 3, 0]], again, atol=1e-9)
    matrices = evo.read_kitti_poses_file(str(write_kitti(tmp_path / "t.kitti", poses))).poses_se3
    np.testing.assert_allclose(matrices, fg.SE3.matrix(poses), atol=1e-8)


# ---------------------------------------------------------------- CARMEN


@pytest.mark.parametrize("packed", [False, True])
def test_carmen_lines(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "robot.log"
    path.write_bytes(gzip.compress(CARMEN.encode()) if packed else CARMEN.encode())
    log = read_carmen(path)
    assert log.odometry.pose.tolist() == [[1.0, 2.0, 0.5]] and log.odometry.velocity.tolist() == [[0.3, -0.1]]
    assert log.odometry.time.tolist() == [0.5]
    front, robot = log.scans
    assert (len(front), front.maximum) == (2, math.inf)
    np.testing.assert_allclose(front.angles, np.array([-2, -1, 0, 1]) * math.pi / 4)
    assert front.ranges[1].tolist() == [1.5, 2.5, 3.5, 81.0]
    assert front.pose.tolist() == [[1.1, 2.1, 0.6], [1.2, 2.2, 0.7]] and front.robot[0].tolist() == [1.2, 2.2, 0.7]
    assert (len(robot), robot.maximum, robot.time.tolist()) == (1, 30.0, [0.8])
    np.testing.assert_allclose(robot.angles, [-1.5, -0.75, 0.0, 0.75, 1.5])
    assert (robot.ranges[0].tolist(), robot.pose[0].tolist()) == ([1, 2, 3, 4, 5], [7, 8, 0.1])
    assert log.skipped == {"PARAM": 1, "NEFF": 1}


@pytest.mark.data
def test_intel_log(shared_data: Path) -> None:
    log = read_carmen(shared_data / "lidar" / "intel-corrected.log.gz")
    (scans,) = log.scans
    assert (len(log.odometry.pose), scans.ranges.shape) == (14541, (910, 180))
    np.testing.assert_allclose(np.diff(scans.angles), math.radians(1.0))
    assert scans.ranges.min() > 0.0
    assert np.ptp(scans.pose[:, 0]) > 20.0  # the building is about 30 m wide
