"""TUM trajectories: what is written is read back, and a bad line is named."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from unifg.errors import FileFormatError
from unifg.files.tum import read_tum, write_tum
from unifg.lie import wrap_angle


def test_one_line_as_other_tools_write_it(tmp_path: Path) -> None:
    path = write_tum(tmp_path / "a.tum", [0.1], [[1.0, -2.0, np.pi / 2]])
    half = "0.707106781"
    assert path.read_bytes() == (
        f"0.100000000 1.000000000 -2.000000000 0.000000000 0.000000000 0.000000000 {half} {half}\n".encode()
    )


def test_no_negative_zero_and_no_trailing_blank(tmp_path: Path) -> None:
    text = write_tum(tmp_path / "a.tum", [0.0], [[-0.0, -1e-12, -1e-12]]).read_text()
    assert "-0.0" not in text
    assert [len(line.split(" ")) for line in text.splitlines()] == [8]


@given(arrays(np.float64, (5, 3), elements=st.floats(-100.0, 100.0)))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, poses: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    time = 0.1 * np.arange(5)
    back = read_tum(write_tum(path, time, poses))
    np.testing.assert_allclose(back.time, time, atol=1e-9)
    np.testing.assert_allclose(back.planar()[:, :2], poses[:, :2], atol=1e-9)
    assert np.abs(wrap_angle(back.planar()[:, 2] - poses[:, 2])).max() < 1e-8
    np.testing.assert_allclose(np.linalg.norm(back.quaternion_xyzw, axis=1), 1.0, atol=1e-14)


def test_reads_comments_blank_lines_and_scales_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# t tx ty tz qx qy qz qw\n\n1 2 3 4 0 0 0 5\n2 0 0 0  0 0 -2 0\n")
    trajectory = read_tum(path)
    np.testing.assert_array_equal(trajectory.position, [[2, 3, 4], [0, 0, 0]])
    np.testing.assert_array_equal(trajectory.quaternion_xyzw, [[0, 0, 0, 1], [0, 0, -1, 0]])
    np.testing.assert_allclose(np.abs(trajectory.planar()[:, 2]), [0.0, np.pi])


def test_scalar_comes_last(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"0 0 0 0 0 0 {np.sin(0.2)} {np.cos(0.2)}\n")
    assert read_tum(path).planar()[0, 2] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3", "line 3: 3 fields, expected 8"),
        ("1,2,3,4,5,6,7,8", "separated by blanks, not commas"),
        ("1 2 x 4 0 0 0 1", "line 3: field ty is 'x'"),
        ("1 2 1_0 4 0 0 0 1", "line 3: field ty is '1_0', not a number"),
        ("1 2 \u0663 4 0 0 0 1", "line 3: field ty is '\u0663', not a number"),
        ("1 2 nan 4 0 0 0 1", "line 3: field ty is 'nan', not a finite"),
        ("1 2 3 4 0 0 0 0", "line 3: the quaternion .* has norm 0"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(f"# comment\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(FileFormatError, match=message):
        read_tum(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_tum(tmp_path / "none.tum")


def test_refuses_to_write_what_it_could_not_read(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="pose 1 is not finite"):
        write_tum(tmp_path / "a.tum", [0.0, 1.0], np.array([[0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises(FileFormatError, match=r"\(2,\) and poses \(1, 3\)"):
        write_tum(tmp_path / "a.tum", [0.0, 1.0], [[0, 0, 0]])
    assert not (tmp_path / "a.tum").exists()
