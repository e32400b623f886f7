"""KITTI trajectories, spatial TUM trajectories, and CARMEN logs."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from unifg.errors import FileFormatError
from unifg.files.carmen import read_carmen
from unifg.files.kitti import read_kitti, write_kitti
from unifg.files.tum import read_tum, write_tum

LOG = """\
# a comment
PARAM robot_length 0.5
ODOM 1.0 2.0 0.5 0.3 -0.1 0 10.0 host 0.5
FLASER 4 1.0 2.0 3.0 80.0 1.1 2.1 0.6 1.2 2.2 0.7 10.1 host 0.6
FLASER 4 1.5 2.5 3.5 81.0 1.2 2.2 0.7 1.3 2.3 0.8 10.2 host 0.7
ROBOTLASER1 0 -1.5 3.0 0.75 30.0 0.01 0 5 1 2 3 4 5 2 0 0 7 8 0.1 9 10 0.2 0.5 0.4 0.3 0.2 0 10.3 host 0.8
NEFF 12
"""


def test_kitti_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = fg.SE3.random(rng, (9,))
    path = write_kitti(tmp_path / "poses.txt", poses)
    lines = path.read_text().splitlines()
    assert (len(lines), len(lines[0].split())) == (9, 12)
    np.testing.assert_allclose(float(lines[3].split()[7]), poses[3, 1], rtol=1e-9)  # y ends the second row
    np.testing.assert_allclose(fg.SE3.matrix(read_kitti(path)), fg.SE3.matrix(poses), atol=2e-9)


def test_kitti_lifts_the_plane(tmp_path: Path) -> None:
    lifted = read_kitti(write_kitti(tmp_path / "poses.txt", [[1.0, 2.0, 0.5]]))
    np.testing.assert_allclose(fg.SE3.log(fg.SE3.from_parts([0, 0, 0], lifted[0, 3:]))[3:], [0, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(lifted[0, :3], [1.0, 2.0, 0.0])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2: 11 fields, expected 12"),
        ("1,0,0,0,0,1,0,0,0,0,1,0", "blanks, not commas"),
        ("1 0 0 0 0 1 0 0 0 0 one 0", "line 2: field r33 is 'one', not a number"),
        ("1 0 0 0 0 1 0 0 0 0 1 1_0", "line 2: field tz is '1_0', not a number"),
        ("1 0 0 0 0 2 0 0 0 0 1 0", "line 2: .* not a rotation matrix"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "line 2: .* not a rotation matrix"),  # a reflection
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "line 2: "),
    ],
)
def test_kitti_refusals(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{line}\n")
    with pytest.raises(FileFormatError, match=message):
        read_kitti(path)


def test_kitti_writes_poses_only(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"shape \(2, 4\)"):
        write_kitti(tmp_path / "p.txt", np.zeros((2, 4)))
    with pytest.raises(FileFormatError, match="pose 1 is not finite"):
        write_kitti(tmp_path / "p.txt", np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))


def test_tum_takes_poses_in_space(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = fg.SE3.random(rng, (5,))
    read = read_tum(write_tum(tmp_path / "t.tum", np.arange(5.0), poses))
    np.testing.assert_allclose(read.position, poses[:, :3], atol=1e-9)
    np.testing.assert_allclose(read.quaternion_xyzw, poses[:, [4, 5, 6, 3]], atol=2e-9)  # the scalar goes last


@pytest.mark.parametrize("packed", [False, True])
def test_carmen_lines(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "robot.log"
    path.write_bytes(gzip.compress(LOG.encode()) if packed else LOG.encode())
    log = read_carmen(path)
    assert log.odometry.pose.tolist() == [[1.0, 2.0, 0.5]]
    assert log.odometry.velocity.tolist() == [[0.3, -0.1]]
    assert log.odometry.time.tolist() == [0.5]
    front, robot = log.scans
    assert (len(front), front.maximum) == (2, math.inf)
    np.testing.assert_allclose(front.angles, np.array([-2, -1, 0, 1]) * math.pi / 4)
    assert front.ranges[1].tolist() == [1.5, 2.5, 3.5, 81.0]
    assert front.pose.tolist() == [[1.1, 2.1, 0.6], [1.2, 2.2, 0.7]]
    assert front.robot[0].tolist() == [1.2, 2.2, 0.7]
    assert (len(robot), robot.maximum, robot.time.tolist()) == (1, 30.0, [0.8])
    np.testing.assert_allclose(robot.angles, [-1.5, -0.75, 0.0, 0.75, 1.5])
    assert (robot.ranges[0].tolist(), robot.pose[0].tolist()) == ([1, 2, 3, 4, 5], [7, 8, 0.1])
    assert log.skipped == {"PARAM": 1, "NEFF": 1}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ODOM 1 2 3 4 5 6 7 host", "line 8: ODOM: 8 fields, expected 9"),
        ("ODOM 1 2 x 4 5 6 7 host 8", "line 8: ODOM: field theta is 'x', not a number"),
        ("ODOM 1 2 1_0 4 5 6 7 host 8", "line 8: ODOM: field theta is '1_0', not a number"),
        ("FLASER 3 1 2 0 0 0 0 0 0 7 host 8", "line 8: FLASER: 12 fields, expected 13"),
        ("FLASER x 1 2 0 0 0 0 0 0 7 host 8", "line 8: FLASER: 'x' is not a number of readings"),
        ("FLASER 2 1 inf 0 0 0 0 0 0 7 host 8", "line 8: FLASER: field r2 is 'inf', not a finite"),
        ("ROBOTLASER1 0 1 2 3", "line 8: ROBOTLASER1: 4 fields are too few"),
        (
            "ROBOTLASER1 0 0 3 9e9 80 0 0 2 1 1 0 0 0 0 0 0 0 0 0 0 0 0 7 host 8",
            "line 8: ROBOTLASER1: 2 beams from 0 rad",
        ),
    ],
)
def test_carmen_refusals(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "robot.log"
    path.write_text(LOG + line + "\n")
    with pytest.raises(FileFormatError, match=message):
        read_carmen(path)


def test_something_else_is_no_log(tmp_path: Path) -> None:
    path = tmp_path / "robot.log"
    path.write_text("VERTEX_SE2 0 0 0 0\n")
    with pytest.raises(FileFormatError, match="is this a CARMEN log"):
        read_carmen(path)


@pytest.mark.data
def test_intel_log(shared_data: Path) -> None:
    log = read_carmen(shared_data / "lidar" / "intel-corrected.log.gz")
    (scans,) = log.scans
    assert (len(log.odometry.pose), scans.ranges.shape) == (14541, (910, 180))
    np.testing.assert_allclose(np.diff(scans.angles), math.radians(1.0))
    assert scans.ranges.min() > 0.0
    assert np.ptp(scans.pose[:, 0]) > 20.0  # the building is about 30 m wide
