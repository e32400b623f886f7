"""Pose graphs in g2o and TORO files: what is read, what is written, what is refused."""

from __future__ import annotations

import logging
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from unifg.errors import FileFormatError, GraphError
from unifg.files.g2o import read_g2o, write_g2o
from unifg.files.pose_graph import read_pose_graph
from unifg.files.toro import read_toro, write_toro
from unifg.pose_graphs import Edges, PoseGraph, Sightings, indefinite, repaired, sphere

PLANAR = """\
# two poses and a tree
VERTEX_SE2 10 0 0 0
VERTEX_XY 5 2.0 1.0

  EDGE_SE2 10 7   1.0 0.5 0.25   1 2 3 4 5 6
VERTEX_SE2 7 1.0 0.5 0.25
FIX 10
EDGE_SE2_XY 10 5 2.0 1.0 9 1 8
EDGE_BEARING_SE2_XY 7 5 0.5 100
EDGE_RANGE_SE2_XY 7 5 1.5 50
BR 10 5 0.1 2.0 0.5 0.25
"""

SPATIAL = """\
VERTEX_SE3:QUAT 6989586621679009792 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 6989586621679009793 1 2 3 0 0 0.6 0.8
VERTEX_TRACKXYZ 3 1 1 1
EDGE_SE3:QUAT 6989586621679009792 6989586621679009793 1 2 3 0 0 1.2 1.6 """ + " ".join(map(str, range(1, 22)))


def write(folder: Path, text: str, name: str = "graph.g2o") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def same(a: PoseGraph, b: PoseGraph) -> None:
    """Bit by bit."""
    for name in ("ids", "poses", "landmark_ids", "landmarks", "fixed_ids"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    for part in fields(Edges):
        np.testing.assert_array_equal(getattr(a.edges, part.name), getattr(b.edges, part.name))
    assert list(a.sightings) == list(b.sightings)
    for kind, seen in a.sightings.items():
        for part in fields(Sightings):
            np.testing.assert_array_equal(getattr(seen, part.name), getattr(b.sightings[kind], part.name))


def random_graph(rng: np.random.Generator, group: fg.LieGroup) -> PoseGraph:
    count, size, dim = 12, group.point_dim, group.dim
    first, second = rng.integers(0, count, (2, 30)).astype(np.intp)
    root = rng.normal(size=(30, dim, dim))
    information = root @ np.swapaxes(root, 1, 2)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    seen = Sightings(first[:5], second[:5] % 3, rng.normal(size=(5, size)), np.tile(np.eye(size) / 3.0, (5, 1, 1)))
    return PoseGraph(
        rng.choice(10**12, count, replace=False),
        group.random(rng, (count,)),
        Edges(first, second, group.random(rng, (30,)), information),
        rng.choice(10**6, 3, replace=False) + 10**13,
        rng.normal(size=(3, size)),
        {"point": seen},
    )


def without_landmarks(graph: PoseGraph) -> PoseGraph:
    return PoseGraph(graph.ids, graph.poses, graph.edges)


def test_planar_lines_in_any_order(tmp_path: Path) -> None:
    graph = read_g2o(write(tmp_path, PLANAR))
    assert graph.ids.tolist() == [10, 7]
    assert graph.poses.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.5, 0.25]]
    assert (graph.edges.first.tolist(), graph.edges.second.tolist()) == ([0], [1])
    assert graph.edges.information[0].tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]  # row by row
    assert graph.landmark_ids.tolist() == [5]
    assert graph.fixed_ids == (10,)
    assert graph.sightings["point"].information[0].tolist() == [[9, 1], [1, 8]]
    assert graph.sightings["bearing"].information.tolist() == [[[100]]]
    assert graph.sightings["range"].measured.tolist() == [[1.5]]
    assert graph.sightings["bearing-range"].information[0].tolist() == [[4, 0], [0, 16]]
    assert graph.skipped == {}


def test_spatial_identifiers_of_64_bits_and_quaternions(tmp_path: Path) -> None:
    graph = read_g2o(write(tmp_path, SPATIAL))
    assert graph.ids.tolist() == [6989586621679009792, 6989586621679009793]  # equal as floats
    assert graph.edges.second.tolist() == [1]
    np.testing.assert_allclose(graph.poses[1], [1, 2, 3, 0.8, 0, 0, 0.6])  # scalar first in SE3
    np.testing.assert_allclose(graph.edges.measured[0], graph.poses[1], atol=1e-15)  # normalised
    assert graph.edges.information[0, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert graph.edges.information[0, 3:, 3:].tolist() == [[16, 17, 18], [17, 19, 20], [18, 20, 21]]


def test_a_sensor_off_the_body_is_moved_there(tmp_path: Path, rng: np.random.Generator) -> None:
    pose, offset = fg.SE3.random(rng, (2,))
    landmark, measured = rng.normal(size=(2, 3))
    root = rng.normal(size=(3, 3))
    information = root @ root.T
    error = fg.SE3.act(fg.SE3.inverse(fg.SE3.compose(pose, offset)), landmark) - measured

    def numbers(x: np.ndarray) -> str:
        return " ".join(map(repr, x.tolist()))

    def spatial(x: np.ndarray) -> str:
        return numbers(x[[0, 1, 2, 4, 5, 6, 3]])

    text = (
        f"VERTEX_SE3:QUAT 0 {spatial(pose)}\nVERTEX_TRACKXYZ 1 {numbers(landmark)}\n"
        f"PARAMS_SE3OFFSET 4 {spatial(offset)}\n"
        f"EDGE_SE3_TRACKXYZ 0 1 4 {numbers(measured)} {numbers(information[np.triu_indices(3)])}\n"
    )
    graph = read_g2o(write(tmp_path, text))
    np.testing.assert_allclose(graph.chi2(), error @ information @ error)


@pytest.mark.parametrize("ending", ["g2o", "g2o.gz"])
@pytest.mark.parametrize("group", [fg.SE2, fg.SE3], ids=lambda group: group.name)
def test_round_trip_is_exact(tmp_path: Path, rng: np.random.Generator, group: fg.LieGroup, ending: str) -> None:
    graph = random_graph(rng, group)
    graph = replace(graph, fixed_ids=(int(graph.ids[3]), int(graph.landmark_ids[1])))
    path = write_g2o(tmp_path / f"graph.{ending}", graph)
    assert path.read_bytes().startswith(b"\x1f\x8b") == ending.endswith("gz")
    same(read_g2o(path), graph)
    same(read_g2o(path.rename(tmp_path / "graph.txt")), graph)  # packed or not, whatever its name


def test_every_sighting_survives(tmp_path: Path) -> None:
    graph = read_g2o(write(tmp_path, PLANAR))
    again = read_g2o(write_g2o(tmp_path / "again.g2o", graph))
    # Bearing and range of one line come back as two measurements of the same.
    assert len(again.sightings["bearing"]) == len(again.sightings["range"]) == 2
    np.testing.assert_allclose(again.chi2(), graph.chi2(), rtol=1e-14)


def test_vertices_below_zero_can_be_known(tmp_path: Path) -> None:
    known = "VERTEX_SE2 -1 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 -1 1 1 0 0 1 0 0 1 0 1\nFIX -1\n"
    assert read_g2o(write(tmp_path, known)).fixed_ids == (-1,)


def test_unknown_tags_are_counted_and_named_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = PLANAR + "VERTEX_CAM 1 2 3\nEDGE_SOMETHING\nVERTEX_CAM 4 5 6\n"
    with caplog.at_level(logging.WARNING, "unifg"):
        graph = read_g2o(write(tmp_path, text))
    assert graph.skipped == {"VERTEX_CAM": 2, "EDGE_SOMETHING": 1}
    (said,) = [record.getMessage() for record in caplog.records if "tags are not read" in record.getMessage()]
    assert "EDGE_SOMETHING (1), VERTEX_CAM (2)" in said


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE_SE2 10 7 1 0 0 1 0 0 1 0", r"line 12: EDGE_SE2: 10 fields, expected 11"),
        ("EDGE_SE2 10 7 1 0 0 1 0 0 1 0 0 0", r"line 12: EDGE_SE2: 12 fields"),
        ("EDGE_SE2 10 7 1 0 x 1 0 0 1 0 0", r"line 12: EDGE_SE2: field dtheta is 'x', not a number"),
        ("EDGE_SE2 10 7 1 0 nan 1 0 0 1 0 0", r"line 12: EDGE_SE2: field dtheta is 'nan', not a finite"),
        ("EDGE_SE2 10 7.5 1 0 0 1 0 0 1 0 0", r"line 12: EDGE_SE2: field j is '7.5', not an integer"),
        ("EDGE_SE2 10 99999999999999999999 1 0 0 1 0 0 1 0 0", r"line 12: EDGE_SE2: field j .* 64 bits"),
        ("EDGE_SE2 10 8 1 0 0 1 0 0 1 0 0", r"line 12: there is no pose 8 in the file"),
        ("EDGE_SE2 10 5 1 0 0 1 0 0 1 0 0", r"line 12: there is no pose 5 in the file"),  # a landmark
        ("EDGE_SE2_XY 10 7 1 0 1 0 1", r"line 12: there is no landmark 7"),
        ("VERTEX_SE2 7 0 0 0", r"line 12: vertex 7 is defined twice, first in line 6"),
        ("VERTEX_XY 7 0 0", r"vertex 7 is defined twice"),
        ("VERTEX_SE2,1,0,0,0", r"nothing"),  # an unknown tag: no error
        ("FIX 11", r"line 12: FIX 11: there is no such vertex"),
        ("BR 10 5 0 1 0 1", r"line 12: BR: standard deviations must be positive"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1", r"both VERTEX_SE2 and VERTEX_SE3:QUAT"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, line: str, message: str) -> None:
    path = write(tmp_path, PLANAR + line + "\n")
    if message == "nothing":
        assert read_g2o(path).skipped == {"VERTEX_SE2,1,0,0,0": 1}
        return
    with pytest.raises(FileFormatError, match=message) as error:
        read_g2o(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", "neither VERTEX_SE2"),
        (b"\xff\xfe", "as text"),
        (b"\x1f\x8b\x08zz", "cannot be"),
        (b"VERTEX_SE2 0 0 0\nVERTEX_SE2 1 0 0 0 0\n", "line 1: VERTEX_SE2: 3 fields"),  # as many fields as needed
        (b"VERTEX_SE3:QUAT 1 0 0 0 0 0 0 0\n", "line 1: the quaternion .* has norm 0"),
        (b"VERTEX_SE2 -2 0 0 0\nVERTEX_SE2 -1 0 0 0\nEDGE_SE2 -2 0 1 0 0 1 0 0 1 0 1\n", "line 3: there is no pose 0"),
    ],
)
def test_files_that_are_none(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "graph.g2o"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_g2o(path)


def test_numbers_that_are_not_finite_are_not_written(tmp_path: Path, rng: np.random.Generator) -> None:
    graph = random_graph(rng, fg.SE2)
    graph.edges.measured[4, 1] = np.inf
    with pytest.raises(FileFormatError, match=r"EDGE_SE2 .* is not finite"):
        write_g2o(tmp_path / "graph.g2o", graph)


def test_toro_has_its_own_order_of_information(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write(tmp_path, "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEQUIV 0 1\nEDGE2 0 1 1 0 0 11 12 22 33 13 23\n")
    graph = read_toro(path)
    assert graph.edges.information[0].tolist() == [[11, 12, 13], [12, 22, 23], [13, 23, 33]]
    assert graph.skipped == {"EQUIV": 1}
    graph = without_landmarks(random_graph(rng, fg.SE2))
    same(read_toro(write_toro(path, graph)), graph)


def test_toro_in_space(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write(tmp_path, "VERTEX3 0 0 0 0 0 0 1.5707963267948966\nVERTEX3 1 0 0 0 0.1 -0.2 0.3\n")
    poses = read_toro(path).poses
    np.testing.assert_allclose(fg.SE3.act(poses[0], [1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-15)  # yaw is about z
    np.testing.assert_allclose(fg.SE3.log(poses[1])[3:], [0.1, -0.2, 0.3], atol=0.05)
    graph = without_landmarks(random_graph(rng, fg.SE3))
    again = read_toro(write_toro(path, graph))
    np.testing.assert_allclose(fg.SE3.matrix(again.poses), fg.SE3.matrix(graph.poses), atol=1e-14)
    np.testing.assert_array_equal(again.edges.information, graph.edges.information)


def test_toro_refuses_what_it_cannot_say(tmp_path: Path, rng: np.random.Generator) -> None:
    with pytest.raises(FileFormatError, match="no landmarks"):
        write_toro(tmp_path / "g.graph", random_graph(rng, fg.SE2))
    with pytest.raises(FileFormatError, match="line 2: EDGE2: 4 fields"):
        read_toro(write(tmp_path, "VERTEX2 0 0 0 0\nEDGE2 0 0 1 0\n"))


def test_formats_are_told_apart_by_their_tags(tmp_path: Path) -> None:
    assert len(read_pose_graph(write(tmp_path, PLANAR, "a.graph")).poses) == 2
    assert len(read_pose_graph(write(tmp_path, "VERTEX2 0 0 0 0\n", "b.g2o")).poses) == 1


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "poses", "edges"),
    [
        ("M3500.g2o.gz", 3500, 5453),
        ("intel.g2o.gz", 1728, 2512),
        ("sphere2500.g2o.gz", 2500, 4949),
        ("parking-garage.g2o.gz", 1661, 6275),
        ("rpgo_robot_a.g2o", 50, 52),
        ("gtsam_w100.graph", 100, 300),
        ("gtsam_noisyToyGraph.txt", 4, 5),
        ("gtsam_pose2example.txt", 11, 12),
        ("gtsam_pose3example-offdiagonal.txt", 2, 1),
    ],
)
def test_published_files(shared_data: Path, tmp_path: Path, name: str, poses: int, edges: int) -> None:
    graph = read_pose_graph(shared_data / "pose_graphs" / name)
    assert (len(graph.poses), len(graph.edges)) == (poses, edges)
    assert np.all(np.linalg.eigvalsh(graph.edges.information) > -1e-9) or "w100" in name
    same(read_g2o(write_g2o(tmp_path / "again.g2o", graph)), graph)


STEPS = "EDGE_SE2 {} {} 1 0 0.5 100 0 0 100 0 400\n"


def test_measurements_alone_are_enough(tmp_path: Path) -> None:
    text = "".join(STEPS.format(k, k + 1) for k in (12, 10, 11)) + "EDGE_SE2 10 13 9 9 0 1 0 0 1 0 1\n"
    graph = read_g2o(write(tmp_path, text))
    assert graph.ids.tolist() == [10, 11, 12, 13] and not graph.placed
    assert graph.edges.odometry.tolist() == [True, True, True, False]
    assert graph.poses[0].tolist() == [0, 0, 0]
    np.testing.assert_allclose(graph.poses[1:3], [[1, 0, 0.5], [1 + np.cos(0.5), np.sin(0.5), 1.0]])
    assert graph.squared_errors()[:3] == pytest.approx(0.0, abs=1e-20)
    assert read_g2o(write_g2o(tmp_path / "again.g2o", graph)).placed
    sim = sphere(3, 5).pose_graph
    lines = [line for line in write_g2o(tmp_path / "s.g2o", sim).read_text().splitlines() if "VERTEX" not in line]
    spatial = read_g2o(write(tmp_path, "\n".join(lines)))
    np.testing.assert_allclose(
        spatial.chi2(), sim.chi2(), rtol=1e-9
    )  # the poses of a simulated graph are the same tree
    toro = read_toro(write(tmp_path, "EDGE2 3 4 1 0 0.5 100 0 100 400 0 0\nEDGE2 4 5 1 0 0.5 100 0 100 400 0 0\n"))
    assert toro.ids.tolist() == [3, 4, 5] and toro.poses[2, 2] == 1.0 and not toro.placed


def test_landmarks_alone_hold_no_poses_together(tmp_path: Path) -> None:
    seen = "EDGE_SE2_XY {} 9 1 0 1 0 1\n"
    text = STEPS.format(0, 1) + STEPS.format(3, 4) + seen.format(1) + seen.format(3)
    with pytest.raises(FileFormatError, match=r"no poses to start from, and pose 3 is connected .* landmarks"):
        read_g2o(write(tmp_path, text))
    with pytest.raises(FileFormatError, match="there is no landmark 9"):
        read_g2o(write(tmp_path, STEPS.format(0, 1) + "EDGE_RANGE_SE2_XY 0 9 1 1\n"))  # nobody knows where
    with pytest.raises(FileFormatError, match="vertex 1 is defined twice"):
        read_g2o(write(tmp_path, STEPS.format(0, 1) + "EDGE_SE2_XY 0 1 1 0 1 0 1\n"))


def test_tags_of_gtsam_hold_covariances(tmp_path: Path) -> None:
    text = "ODOMETRY 0 1 1 0 0 0.01 0 0 0.04 0.01 0.25\nODOMETRY 1 3 1 0 0.5 0.01 0 0 0.04 0 0.25\n"
    text += "LANDMARK 1 2 2 1 0.5 0 2\n"
    graph = read_g2o(write(tmp_path, text))
    assert graph.ids.tolist() == [0, 1, 3] and graph.landmark_ids.tolist() == [2] and graph.edges.odometry.all()
    np.testing.assert_allclose(graph.landmarks, [[3.0, 1.0]])
    covariance = np.array([[0.01, 0, 0], [0, 0.04, 0.01], [0, 0.01, 0.25]])
    np.testing.assert_allclose(graph.edges.information[0], np.linalg.inv(covariance))
    np.testing.assert_allclose(graph.sightings["point"].information[0], np.diag([2.0, 0.5]))
    for line, message in (
        ("LANDMARK 1 2 2 1 0.5 3 2\n", "line 4: LANDMARK: the covariance .* not positive definite"),
        ("ODOMETRY 3 4 1 0 0 0 0 0 1 0 1\n", "line 4: ODOMETRY: the covariance"),
    ):
        with pytest.raises(FileFormatError, match=message):
            read_g2o(write(tmp_path, text + line))


def test_information_in_whole_numbers_is_projected_beyond_them() -> None:
    np.testing.assert_allclose(repaired(np.array([[[1, 2], [2, 1]]]), "project"), np.full((1, 2, 2), 1.5))


def test_indefinite_information_is_named_and_repaired(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = STEPS.format(0, 1) + "EDGE_SE2 1 2 1 0 0.5 2 0 0 -1 0 3\n" + STEPS.format(2, 3)
    path = write(tmp_path, text)
    with caplog.at_level(logging.WARNING, "unifg"):
        left = read_g2o(path)
    assert "1 of 3 information matrices of edges are indefinite: line 2 (1 - 2)" in caplog.text
    assert left.edges.information[1, 1, 1] == -1.0 and "repair='zero'" in left.remarks[0]
    zero, kept = (read_g2o(path, repair=how) for how in ("zero", "project"))
    assert not zero.edges.information[1].any() and "no say" in zero.remarks[0]
    np.testing.assert_allclose(kept.edges.information[1], np.diag([2.0, 0.0, 3.0]), atol=1e-15)
    np.testing.assert_array_equal(zero.edges.information[[0, 2]], left.edges.information[[0, 2]])
    assert not indefinite(kept.edges.information).any()
    clean = write(tmp_path, STEPS.format(0, 1))
    assert read_g2o(clean, repair="zero").remarks == ()
    with pytest.raises(GraphError, match="'zero' or 'project'"):
        read_g2o(path, repair="remove")  # type: ignore[arg-type]


def test_edges_that_may_not_be_meant_are_remarked(tmp_path: Path) -> None:
    text = STEPS.format(0, 1) + STEPS.format(1, 2) + STEPS.format(1, 1) + STEPS.format(0, 1)
    graph = read_g2o(write(tmp_path, text + "EDGE_SE2 0 1 1 0 0.6 100 0 0 100 0 400\n"))  # measured twice, and so kept
    assert len(graph.edges) == 5
    own, twice = graph.remarks
    assert "1 edge joins its pose with itself, first in line 3 (1)" in own
    assert "1 edge repeats another word by word, first in line 4 (0 - 1)" in twice


def test_vertices_out_of_the_order_of_their_identifiers_are_remarked(tmp_path: Path) -> None:
    steps = "".join(STEPS.format(k, k + 1) for k in range(5))
    for names, said in (([0, 1, 2, 3, 4, 5], 0), ([5, 4, 3, 2, 1, 0], 0), ([0, 3, 1, 4, 2, 5], 1)):
        graph = read_g2o(write(tmp_path, "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in names) + steps))
        assert len(graph.remarks) == said and len(graph.closures) == 5 * said
    assert "5 steps from one to the next count as loop closures" in graph.remarks[0]
    assert read_g2o(write(tmp_path, steps)).remarks == ()


def test_many_tags_and_lines_of_any_form(tmp_path: Path) -> None:
    many = "".join(f"TAG{k} 1\nTAG{k % 7} 2\n" for k in range(90))
    text = f"  # comment\n\n\t{PLANAR.strip()}\n{many}VERTEX_SE2\t99  1e0 +2. -.5e1"
    graph = read_g2o(write(tmp_path, text))
    assert graph.poses[-1].tolist() == [1.0, 2.0, -5.0]
    assert sum(graph.skipped.values()) == 180 and graph.skipped["TAG0"] == 14 and graph.skipped["TAG89"] == 1
    with pytest.raises(FileFormatError, match=r"field theta is '1\\xa02', not a number"):
        read_g2o(write(tmp_path, "VERTEX_SE2 0 0 0 1\u00a02\n"))


@pytest.mark.parametrize(
    ("text", "extra", "tag"),
    [
        (PLANAR, "EDGE_SE3:QUAT 10 7 1 2 3 0 0 0 1 " + " ".join(["1"] * 21), "EDGE_SE3:QUAT"),
        (SPATIAL, "\nEDGE_SE2 6989586621679009792 6989586621679009793 1 0 0 1 0 0 1 0 1", "EDGE_SE2"),
        (SPATIAL, "\nEDGE_PRIOR_SE2 6989586621679009792 1 0 0 1 0 0 1 0 1", "EDGE_PRIOR_SE2"),
    ],
)
def test_lines_of_the_other_dimension_are_counted_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str, extra: str, tag: str
) -> None:
    with caplog.at_level(logging.WARNING, "unifg"):
        graph = read_g2o(write(tmp_path, text + extra + "\n"))
    assert graph.skipped == {tag: 1}
    assert f"{tag} (1)" in caplog.text


@pytest.mark.parametrize("norm", [1.002, 0.5])
def test_quaternions_far_from_norm_one_are_remarked(tmp_path: Path, norm: float) -> None:
    lines = f"VERTEX_SE3:QUAT 0 0 0 0 0 0 {0.6 * norm} {0.8 * norm}\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1.0009\n"
    graph = read_g2o(write(tmp_path, lines))
    (remark,) = graph.remarks
    assert "1 of 2 quaternions" in remark and "line 1" in remark and f"{norm:g}" in remark
    np.testing.assert_allclose(graph.poses[0, 3:], [0.8, 0.0, 0.0, 0.6])
    np.testing.assert_allclose(graph.poses[1, 3:], [1.0, 0.0, 0.0, 0.0])


def test_trajectories_name_quaternions_far_from_norm_one(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    from unifg.files.kitti import read_kitti
    from unifg.files.tum import read_tum

    with caplog.at_level(logging.WARNING, "unifg"):
        read_tum(write(tmp_path, "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1.0009\n2 1 2 3 0 0 0 2\n", "a.tum"))
    assert "1 of 3 quaternions" in caplog.text and "line 3" in caplog.text
    caplog.clear()
    scaled = " ".join(f"{1.002 * v}" for v in (1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7))
    with caplog.at_level(logging.WARNING, "unifg"):
        read_kitti(write(tmp_path, "1 0 0 5 0 1 0 6 0 0 1 7\n" + scaled + "\n", "a.txt"))
    assert "1 of 2 rotation matrices" in caplog.text and "line 2" in caplog.text


PRIORS = """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
EDGE_SE2 0 1 1 0 0 100 0 0 100 0 100
EDGE_PRIOR_SE2 0 5 6 0.5 100 0 0 100 0 100
"""


def test_a_prior_holds_the_map_where_it_says(tmp_path: Path) -> None:
    path = write(tmp_path, PRIORS)
    graph = read_g2o(path)
    assert not graph.skipped and not len(graph.anchors(priors=True)[0])
    problem, x, guess = graph.graph()
    solution = fg.solve(problem, guess)
    np.testing.assert_allclose(solution[x][0], [5.0, 6.0, 0.5], atol=1e-7)
    np.testing.assert_allclose(solution[x][1], fg.SE2.compose([5.0, 6.0, 0.5], [1.0, 0.0, 0.0]), atol=1e-7)
    assert graph.chi2("g2o") == pytest.approx(100.0 * (61.0 + 0.25))
    assert graph.with_poses(solution[x]).chi2() == pytest.approx(0.0, abs=1e-9)
    again = read_g2o(write_g2o(tmp_path / "again.g2o", graph))
    same(again, graph)
    np.testing.assert_array_equal(again.priors["pose"].measured, graph.priors["pose"].measured)
    np.testing.assert_array_equal(again.priors["pose"].information, graph.priors["pose"].information)


def test_headings_alone_hold_no_map(tmp_path: Path) -> None:
    """Priors of the heading, as of a compass, say nothing of where the map lies: the first pose does."""
    compass = "".join(f"EDGE_PRIOR_SE2 {k} 0 0 0 0 0 0 0 0 100\n" for k in (0, 1))
    graph = read_g2o(write(tmp_path, PRIORS.replace("EDGE_PRIOR_SE2 0 5 6 0.5 100 0 0 100 0 100\n", compass)))
    assert graph.anchors(priors=True)[0].tolist() == [0]
    problem, x, guess = graph.graph()
    solution = fg.solve(problem, guess)
    assert solution.status is fg.Status.CONVERGED
    np.testing.assert_allclose(solution[x], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], atol=1e-7)


def test_positions_in_the_plane_hold_it_by_two_poses(tmp_path: Path) -> None:
    one = PRIORS.replace("EDGE_PRIOR_SE2 0 5 6 0.5 100 0 0 100 0 100", "EDGE_PRIOR_SE2_XY 0 5 6 1 0 1")
    graph = read_g2o(write(tmp_path, one))
    assert graph.anchors(priors=True)[0].tolist() == [0]  # nothing measures the heading
    graph = read_g2o(write(tmp_path, one + "EDGE_PRIOR_SE2_XY 1 5 7 1 0 1\n"))
    assert not len(graph.anchors(priors=True)[0])
    problem, x, guess = graph.graph()
    solution = fg.solve(problem, guess)
    np.testing.assert_allclose(solution[x], [[5.0, 6.0, np.pi / 2], [5.0, 7.0, np.pi / 2]], atol=1e-6)
    np.testing.assert_array_equal(read_g2o(write_g2o(tmp_path / "b.g2o", graph)).priors["position"].pose, [0, 1])


@pytest.mark.parametrize("tag", ["EDGE_SE3_PRIOR", "EDGE_PRIOR_SE3"])
@pytest.mark.parametrize("parameter", [True, False])
def test_priors_in_space_are_read_in_both_spellings(
    tmp_path: Path, rng: np.random.Generator, tag: str, parameter: bool
) -> None:
    root = rng.normal(size=(6, 6))
    information = root @ root.T + np.eye(6)
    triangle = " ".join(repr(v) for v in information[np.triu_indices(6)].tolist())
    offset, pose = fg.SE3.random(rng), fg.SE3.random(rng)
    words = {name: " ".join(map(repr, fg.SE3.to_quaternion(x, order="xyzw").tolist())) for name, x in
             (("offset", offset), ("pose", pose))}  # fmt: skip
    lines = ["VERTEX_SE3:QUAT 4 0 0 0 0 0 0 1", f"{tag} 4 {'9 ' if parameter else ''}{words['pose']} {triangle}"]
    if parameter:
        lines.append(f"PARAMS_SE3OFFSET 9 {words['offset']}")
    graph = read_g2o(write(tmp_path, "\n".join(lines)))
    prior = graph.priors["pose"]
    at = offset if parameter else fg.SE3.identity()
    np.testing.assert_allclose(prior.measured[0], fg.SE3.compose(pose, fg.SE3.inverse(at)), atol=1e-12)
    x = fg.SE3.retract(prior.measured[0], 0.3 * rng.normal(size=6))
    error = fg.SE3.local(pose, fg.SE3.compose(x, at))  # where the sensor is, against where it was measured
    assert graph.with_poses(x[None]).chi2() == pytest.approx(error @ information @ error, rel=1e-9)
    again = read_g2o(write_g2o(tmp_path / "again.g2o", graph))
    np.testing.assert_array_equal(again.priors["pose"].information, prior.information)


def test_what_is_wrong_with_a_prior_is_named_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="line 5: there is no pose 7"):
        read_g2o(write(tmp_path, PRIORS + "EDGE_PRIOR_SE2 7 0 0 0 1 0 0 1 0 1\n"))
    with pytest.raises(FileFormatError, match="line 5: there is no PARAMS_SE3OFFSET 3"):
        text = SPATIAL + "\nEDGE_SE3_PRIOR 6989586621679009792 3 0 0 0 0 0 0 1 " + "1 " * 21
        read_g2o(write(tmp_path, text))
    with pytest.raises(FileFormatError, match="TORO files have no"):
        write_toro(tmp_path / "a.graph", read_g2o(write(tmp_path, PRIORS)))
    ends = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n" + STEPS.format(0, 1) + "FIX 0\n"
    write_toro(tmp_path / "a.graph", read_g2o(write(tmp_path, ends)))
    with pytest.raises(FileFormatError, match="TORO files have no fixed poses; write g2o"):
        write_toro(tmp_path / "a.graph", read_g2o(write(tmp_path, ends + "FIX 1\n")))
