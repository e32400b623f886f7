"""Trajectories in the EuRoC format, and what evo makes of those that are written here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from unifg.errors import FileFormatError
from unifg.files.euroc import read_euroc
from unifg.files.kitti import write_kitti
from unifg.files.tum import read_tum, write_tum

TEXT = """#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x
1403636580838555648,4.688319,-1.786938,0.783338,0.6,0,0,0.8,-0.027876

1403636580843555648, 4.688177, -1.786770, 0.787350, 1.2, 0, 0, 1.6
"""


def test_nanoseconds_and_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text(TEXT)
    found = read_euroc(path)
    np.testing.assert_allclose(found.time, [0.0, 0.005], rtol=1e-12)  # as floats, the stamps differ by 512 ns steps
    np.testing.assert_allclose(found.quaternion_xyzw, [[0, 0, 0.8, 0.6]] * 2)
    assert found.position[1].tolist() == [4.688177, -1.786770, 0.787350]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,2,3", "line 5: 3 fields between commas, expected 8"),
        ("1 0 0 0 1 0 0 0", "line 5: 1 fields between commas"),
        ("1.5,0,0,0,1,0,0,0", r"line 5: the time '1\.5' is not in whole nanoseconds"),
        ("1,0,x,0,1,0,0,0", "line 5: field y is 'x', not a number"),
        ("1,0,0,inf,1,0,0,0", "line 5: field z is 'inf', not a finite number"),
        ("1,0,0,0,0,0,0,0", "line 5: the quaternion .* has norm 0"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "data.csv"
    path.write_text(TEXT + line + "\n")
    with pytest.raises(FileFormatError, match=message):
        read_euroc(path)


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
