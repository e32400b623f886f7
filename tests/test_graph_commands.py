"""Files of pose graphs from the command line: ``unifg convert``, and the advice of ``unifg solve``."""

from pathlib import Path

import numpy as np
import pytest

from unifg.errors import FileFormatError
from unifg.files.g2o import read_g2o, write_g2o
from unifg.files.kitti import read_kitti
from unifg.files.toro import read_toro
from unifg.files.tum import read_tum, write_tum
from unifg.pose_graphs import manhattan, sphere
from unifg.scenarios.command import main
from unifg.scenarios.commands.convert import convert


def test_graphs_keep_what_they_measure(tmp_path: Path) -> None:
    graph = manhattan(30).pose_graph
    write_g2o(tmp_path / "a.g2o", graph)
    assert convert(tmp_path / "a.g2o", tmp_path / "b.graph.gz") == f"30 poses, {len(graph.edges)} edges"
    convert(tmp_path / "b.graph.gz", tmp_path / "c.g2o")
    for again in (read_toro(tmp_path / "b.graph.gz"), read_g2o(tmp_path / "c.g2o")):
        assert again.chi2() == pytest.approx(graph.chi2(), rel=1e-6)


def test_poses_go_through_all_formats_of_trajectories(tmp_path: Path) -> None:
    poses = sphere(rings=3, per_ring=5).pose_graph.poses
    times = 1e9 + 0.1 * np.arange(len(poses))
    write_tum(tmp_path / "a.tum", times, poses)
    assert main(["convert", str(tmp_path / "a.tum"), str(tmp_path / "b.kitti")]) == 0
    np.testing.assert_allclose(read_kitti(tmp_path / "b.kitti")[:, :3], poses[:, :3], atol=1e-8)
    convert(tmp_path / "b.kitti", tmp_path / "c.tum.gz")
    np.testing.assert_allclose(read_tum(tmp_path / "c.tum.gz").position, poses[:, :3], atol=1e-8)
    np.testing.assert_array_equal(read_tum(tmp_path / "c.tum.gz").time, np.arange(len(poses)))
    convert(tmp_path / "a.tum", tmp_path / "d.TUM")
    np.testing.assert_allclose(read_tum(tmp_path / "d.TUM").time, times, rtol=0, atol=1e-6)
    (tmp_path / "e.csv").write_text("#timestamp\n1403636580838555648,4.5,-1.7,0.6,1,0,0,0\n")
    assert convert(tmp_path / "e.csv", tmp_path / "f.tum") == "1 poses; times are seconds from the first one"
    assert convert(tmp_path / "b.kitti", tmp_path / "f.tum").endswith("; their numbers are the times")
    assert convert(tmp_path / "c.tum.gz", tmp_path / "f.tum").endswith(" poses")


def test_what_cannot_be_written_is_refused_before_anything_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_g2o(tmp_path / "a.g2o", manhattan(30).pose_graph)
    convert(tmp_path / "a.g2o", tmp_path / "a.tum")
    with pytest.raises(FileFormatError, match=r"no format ends in '.xyz': choose .g2o, .graph, .tum, .kitti"):
        convert(tmp_path / "a.g2o", tmp_path / "b.xyz")
    assert main(["convert", str(tmp_path / "a.tum"), str(tmp_path / "b.g2o")]) != 0
    assert "it has no measurements" in capsys.readouterr().err
    assert not (tmp_path / "b.g2o").exists()
    assert main(["convert", str(tmp_path / "a.g2o"), str(tmp_path / "none" / "b.g2o")]) == 2
    assert "none/b.g2o: cannot be read or written" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "named"), [(["--init", "file"], True), ([], False)])
def test_a_solve_from_a_stated_guess_that_ends_early_names_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], named: bool
) -> None:
    write_g2o(tmp_path / "a.g2o", sphere(rings=4, per_ring=8).pose_graph)
    options = ["--max-iterations", "1", "--effort", "none", "--out", str(tmp_path / "out")]
    assert main(["solve", str(tmp_path / "a.g2o"), *words, *options]) != 0
    assert ("--init auto instead of --init file" in capsys.readouterr().out) == named
