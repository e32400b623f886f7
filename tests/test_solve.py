"""The command ``unifg solve``: options, files, pictures and the scene."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from scenes import commands_of, data_of
from unifg.codegen.threads import threads
from unifg.errors import ScenarioError, UnifgError
from unifg.files.g2o import read_g2o, write_g2o
from unifg.files.toro import write_toro
from unifg.files.tum import read_tum
from unifg.pose_graphs import Edges, PoseGraph, Sightings, manhattan, sphere
from unifg.scenarios import command
from unifg.scenarios.pose_graph import SolveSettings, robust_loss, solve_file

FILES = ("scene.html", "graph.png", "graph.g2o", "trajectory.tum", "metrics.json")


@pytest.fixture
def city(tmp_path: Path) -> Path:
    return write_g2o(tmp_path / "city.g2o", manhattan(120, 1).pose_graph)


@pytest.fixture
def dirty(tmp_path: Path) -> Path:
    return write_g2o(tmp_path / "dirty.g2o.gz", manhattan(300, 0, outliers=0.3).pose_graph)


@pytest.fixture
def globe(tmp_path: Path) -> Path:
    return write_g2o(tmp_path / "globe.g2o", sphere(4, 8).pose_graph)


def numbers(folder: Path) -> dict[str, Any]:
    loaded: dict[str, object] = json.loads((folder / "metrics.json").read_text())
    return loaded


@pytest.mark.product(1, of="scenes and pictures")
@pytest.mark.parametrize("name", ["city", "globe"])
def test_writes_every_file_and_says_what_came_out(
    name: str, request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = request.getfixturevalue(name), tmp_path / "out"
    assert command.main(["solve", str(file), "--scene", "--out", str(out)]) == 0
    said = capsys.readouterr()
    for written in FILES:
        assert (out / written).stat().st_size > 0
        assert str(out / written) in said.out.splitlines()
    assert "done in" in said.err and "done in" not in said.out
    before, after, metrics = read_g2o(file), read_g2o(out / "graph.g2o"), numbers(out)
    assert metrics["converged"] is True
    assert metrics["chi2_file"] == pytest.approx(before.chi2()) and metrics["init"] != "auto"
    assert metrics["chi2_start"] < 0.1 * metrics["chi2_file"] and metrics["degrees_of_freedom"] > 0
    assert metrics["chi2"] == pytest.approx(after.chi2())
    assert after.chi2() < 0.5 * before.chi2()
    assert f"{after.chi2():.9g}" in said.out
    trajectory = read_tum(out / "trajectory.tum")
    size = after.group.point_dim
    np.testing.assert_allclose(trajectory.position[:, :size], after.poses[:, :size], atol=1e-8)
    assert set(metrics["seconds"]) == {"read", "initialise", "compile", "solve", "verdict"}


@pytest.mark.parametrize("solver", ["gn", "lm"])
@pytest.mark.parametrize("init", ["file", "odometry", "lago", "chordal"])
def test_every_way_to_the_same_optimum(city: Path, solver: str, init: str) -> None:
    reference = solve_file(SolveSettings(city))
    solved = solve_file(SolveSettings(city, solver=solver, init=init, scene=True))
    assert solved.chi2[2] == pytest.approx(reference.chi2[2], rel=1e-9)
    assert solved.chi2[0] == reference.chi2[0]
    linear = init in ("lago", "chordal")
    assert (solved.chi2[1] < 2.0 * solved.chi2[2]) == linear
    np.testing.assert_array_equal(solved.steps[0], solved.before.poses)
    np.testing.assert_array_equal(solved.steps[-1], solved.after.poses)
    assert solved.step_numbers[-1] == solved.solution.iterations


def test_a_graph_by_two_threads_and_then_one_again(city: Path, globe: Path) -> None:
    """Also when it could not be solved."""
    during = set[int]()

    def watch(done: float, text: str) -> None:
        during.add(threads())

    assert solve_file(SolveSettings(city, threads=2), watch).solution.converged
    assert during == {2} and threads() == 1
    with pytest.raises(ScenarioError, match="lago"):
        solve_file(
            SolveSettings(write_g2o(city.with_name("globe.g2o"), sphere(4, 8).pose_graph), init="lago", threads=2)
        )
    assert threads() == 1
    with pytest.raises(UnifgError, match="threads: '0' is not a whole number of at least 1"):
        solve_file(SolveSettings(city, threads=0))


def test_residuals_have_their_own_optima(globe: Path) -> None:
    log, chart = (solve_file(SolveSettings(globe, residual=name)) for name in ("log", "g2o"))
    assert chart.chi2[2] == pytest.approx(chart.after.chi2("g2o"))
    assert chart.chi2[2] < log.after.chi2("g2o") and log.chi2[2] < chart.after.chi2()


@pytest.mark.product(1, of="large maps")
def test_outliers_are_found_and_named(dirty: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert command.main(["solve", str(dirty), "--robust", "gnc", "--scene", "--out", str(out)]) == 0
    sim, metrics = manhattan(300, 0, outliers=0.3), numbers(out)
    edges = sim.pose_graph.edges
    wrong = {(int(a), int(b)) for a, b in zip(edges.first[sim.outliers], edges.second[sim.outliers], strict=True)}
    found = {tuple(pair) for pair in metrics["outlier_edges"]}
    assert wrong <= found and len(found - wrong) <= 0.05 * len(sim.pose_graph.closures)
    assert metrics["outliers"] == len(metrics["outlier_edges"])
    assert metrics["chi2_inliers"] < 1e-3 * metrics["chi2"]
    printed = capsys.readouterr().out
    assert "TruncatedLeastSquares" in printed
    kept = len(sim.pose_graph.closures) - len(found)
    assert f"Kept {kept} of {len(sim.pose_graph.closures)} in 'closures'" in printed
    assert printed.count("Another answer") == len(metrics["rivals"])
    assert "loop closures taken for outliers" in (out / "scene.html").read_text()


@pytest.mark.parametrize("robust", ["huber", "cauchy:1.5", "tukey:3e4", "dcs:1e4"])
def test_other_losses_solve_clean_graphs(city: Path, robust: str) -> None:
    solved = solve_file(SolveSettings(city, robust=robust, init="chordal"))
    assert solved.solution.converged
    assert solved.chi2[2] < 1.3 * solve_file(SolveSettings(city)).chi2[2]


def test_loss_names_and_parameters() -> None:
    assert robust_loss(None, 3) is None
    assert robust_loss("huber", 3) == fg.Huber(1.345)
    assert robust_loss("dcs:2.5", 3) == fg.DCS(2.5)
    for dim, squared in ((3, 11.345), (6, 16.812)):  # chi-squared tables, 99 %
        loss = robust_loss("gnc", dim)
        assert isinstance(loss, fg.TruncatedLeastSquares)
        assert loss.threshold**2 == pytest.approx(squared, abs=1e-3)
    for bad in ("l2", "huber:", "huber:-1", "huber:x", "gnc:inf"):
        with pytest.raises(ScenarioError, match="--robust"):
            robust_loss(bad, 3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--robust", "l1"], "--robust l1: expected one of huber, cauchy, tukey, dcs, gnc"),
        (["--solver", "sqp"], "invalid choice: 'sqp'"),
        (["--init", "zero"], "invalid choice: 'zero'"),
        (["--residual", "chord"], "invalid choice: 'chord'"),
    ],
)
def test_bad_options_exit_2(
    city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert command.main(["solve", str(city), *words, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err


def test_lago_is_planar(globe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["solve", str(globe), "--init", "lago", "--out", str(tmp_path)]) == 2
    assert "use --init chordal" in capsys.readouterr().err


def test_bad_files_are_messages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["solve", "nowhere.g2o"]) == 2
    assert "nowhere.g2o: no such file" in capsys.readouterr().err
    assert command.main(["solve", __file__, "--threads", "0"]) == 2
    assert "argument --threads: '0' is not a whole number of at least 1" in capsys.readouterr().err
    assert command.main(["solve", str(tmp_path)]) == 2
    assert f"{tmp_path}: is no file; give a pose graph" in capsys.readouterr().err
    for text, message in (
        ("VERTEX_SE2 0 0 0 0\n", "there is no edge"),
        ("VERTEX_SE2 0 0\n", "line 1: VERTEX_SE2: 2 fields, expected 4"),
    ):
        (tmp_path / "bad.g2o").write_text(text)
        assert command.main(["solve", str(tmp_path / "bad.g2o"), "--out", str(tmp_path)]) == 2
        assert message in capsys.readouterr().err.splitlines()[-1]


def test_what_cannot_be_certified_is_solved_and_said(city: Path, tmp_path: Path) -> None:
    known = write_g2o(city, replace(read_g2o(city), fixed_ids=(0, 1)))
    assert command.main(["solve", str(known), "--out", str(tmp_path / "out")]) == 0
    verdict = numbers(tmp_path / "out")["verdict"]
    assert verdict["certificate"] is None and "two poses of one are known" in verdict["uncertified"]


def test_it_ends_in_the_verdict(city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert command.main(["solve", str(city), "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {"metrics.json", "trajectory.tum", "graph.g2o"}
    verdict, said = numbers(out)["verdict"], capsys.readouterr().out.partition("\n\n")[0]
    assert said.splitlines()[-1].split(None, 1) == ["verdict", verdict["sentence"]]
    assert verdict["effort"] == "cheap" and verdict["starts"] == 0 and "bounds" not in said
    assert command.main(["solve", str(city), "--effort", "none", "--out", str(out)]) == 0
    assert numbers(out)["verdict"] is None and "\nverdict " not in capsys.readouterr().out


def folded_loop(path: Path) -> Path:
    """A square whose file has gone round once too often: where Gauss-Newton ends that begins there."""
    side, count = 5, 20
    heading = np.repeat(0.5 * np.pi * np.arange(4), side)
    step = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    truth = np.column_stack([np.cumsum(step, axis=0) - step, heading])
    first = np.arange(count)
    measured = fg.SE2.between(truth, np.roll(truth, -1, axis=0))
    measured = fg.SE2.retract(measured, 0.01 * np.random.default_rng(2).standard_normal((count, 3)))
    edges = Edges(first, (first + 1) % count, measured, np.tile(np.diag([100.0, 100.0, 400.0]), (count, 1, 1)))
    wound = 4.0 * np.pi * first / count
    begun = np.column_stack([np.cos(wound), np.sin(wound), wound])
    return write_g2o(path, PoseGraph(first, begun, edges))


def test_a_folded_map_is_said_and_not_the_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, maps = folded_loop(tmp_path / "loop.g2o"), {}
    for init in ("file", "auto"):
        assert command.main(["solve", str(file), "--init", init, "--out", str(tmp_path / init)]) == 0
        maps[init] = numbers(tmp_path / init), capsys.readouterr().out
    (folded, warned), (right, calm) = maps["file"], maps["auto"]
    assert folded["degrees_of_freedom"] == right["degrees_of_freedom"] == 3
    assert folded["chi2"] > 100.0 * right["chi2"] and right["init"] != "file"
    assert "times as large as stated" in warned and "times as large" not in calm
    assert "3 degrees of freedom" in warned and len(folded["worst_edges"]) == 5 and "worst edges" in warned
    report = solve_file(SolveSettings(file, init="file")).solution.report()
    assert "with 3 degrees of freedom: residuals are" in report and "largest: 'odometry', factor" in report
    assert "largest" not in solve_file(SolveSettings(file)).solution.report()


@pytest.mark.parametrize(("more", "code"), [([], 0), (["--keep-map"], 1), (["--robust", "huber:50"], 0)])
def test_a_better_map_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], code: int) -> None:
    """The map that was solved is certified or replaced; told to keep the worse one, the command fails."""
    file, out = folded_loop(tmp_path / "loop.g2o"), tmp_path / "out"
    right = solve_file(SolveSettings(file)).chi2[2]
    options = ["--init", "file", "--effort", "full", "--out", str(out), *more]
    assert command.main(["solve", str(file), *options]) == code
    said, found = capsys.readouterr().out, numbers(out)
    certificate = found["verdict"]["certificate"]
    assert len(certificate["moved"]) == 2 and certificate["chi2_chordal"] - certificate["dual"] >= 0.0
    if code:
        assert found["chi2"] > 100.0 * right and found["better_cost"] == pytest.approx(0.5 * right, rel=1e-6)
        assert not certificate["certified"] and certificate["better_chi2"] == pytest.approx(right, rel=1e-6)
        assert "better one known" in said and "kept all the same" in said and found["converged"]
    else:
        assert found["chi2"] == pytest.approx(right, rel=1e-6) and found["better_cost"] is None
        assert certificate["better_chi2"] is None and "kept all the same" not in said
        assert certificate["gap"] < 1e-4 * certificate["chi2_chordal"]
        assert (certificate["interval"] is None) == (more != [])


def test_measurements_alone_are_solved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_g2o(tmp_path / "city.g2o", manhattan(120, 1).pose_graph)
    reference = solve_file(SolveSettings(file)).chi2[2]
    bare = tmp_path / "bare.g2o"
    bare.write_text("".join(line for line in file.read_text().splitlines(True) if "VERTEX" not in line))
    for init in ("auto", "file", "chordal"):
        assert command.main(["solve", str(bare), "--init", init, "--out", str(tmp_path / "out")]) == 0
        assert numbers(tmp_path / "out")["chi2_file"] is None
        assert numbers(tmp_path / "out")["chi2"] == pytest.approx(reference, rel=1e-9)
        assert "it has no poses" in capsys.readouterr().out


def test_indefinite_information_is_refused_or_repaired(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = manhattan(60, 1).pose_graph
    graph.edges.information[30, 1, 1] *= -1.0
    file, out = write_g2o(tmp_path / "city.g2o", graph), tmp_path / "out"
    assert command.main(["solve", str(file), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "1 of" in said and f"line {60 + 31} (30 - 31)" in said and "--repair-information zero or project" in said
    for how, words in (("zero", "no say"), ("project", "negative eigenvalues were set to zero")):
        options = ["--repair-information", how, "--out", str(out)]
        assert command.main(["solve", str(file), *options]) in (0, 1)
        assert words in " ".join(numbers(out)["remarks"]) and words in capsys.readouterr().out
    assert numbers(out)["converged"] is True


def test_toro_files_and_landmarks(tmp_path: Path) -> None:
    graph = manhattan(40, 3).pose_graph
    file = write_toro(tmp_path / "city.graph", graph)
    assert solve_file(SolveSettings(file)).chi2[0] == pytest.approx(graph.chi2())
    seen = Sightings(np.arange(40), np.zeros(40, np.intp), np.ones((40, 2)), np.tile(np.eye(2), (40, 1, 1)))
    marked = PoseGraph(
        graph.ids, graph.poses, graph.edges, np.array([99]), np.array([[1.0, 1.0]]), {"point": seen}
    )  # fmt: skip
    out = tmp_path / "out"
    assert command.main(["solve", str(write_g2o(tmp_path / "marked.g2o", marked)), "--scene", "--out", str(out)]) == 0
    after = read_g2o(out / "graph.g2o")
    assert numbers(out)["landmarks"] == 1 and numbers(out)["sightings"] == 40
    assert not np.array_equal(after.landmarks, marked.landmarks)
    assert "landmarks" in (out / "scene.html").read_text()


def test_an_interrupt_keeps_what_there_is(city: Path) -> None:
    def stop(done: float, text: str) -> None:
        if text.startswith("iteration 2"):
            raise KeyboardInterrupt

    solved = solve_file(SolveSettings(city), progress=stop)
    assert solved.interrupted and solved.solution.iterations == 2


def test_the_scene_needs_nothing_else(city: Path, tmp_path: Path) -> None:
    from unifg.scenarios.scenes.graph_scene import LEVERAGES, graph_scene, shown_steps
    from unifg.view.shapes import strips

    solved = solve_file(SolveSettings(city, scene=True))
    text, shown = graph_scene(solved).html(), shown_steps(solved)
    data = data_of(text)
    paths = {str(command["path"]) for command in commands_of(text) if command["type"] == "set_object"}
    assert shown == list(range(len(solved.steps)))
    assert {f"/meshcat/trajectory/{k}" for k in shown} <= paths
    layers = [layer for _, layer, _, _ in LEVERAGES]
    assert all(any(f"/meshcat/{layer}/{k}" in paths for layer in layers) for k in shown)
    assert {"/meshcat/start", "/meshcat/first"} <= paths
    assert command.main(["solve", str(city), "--scene", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "scene.html").read_text()
    assert "default-src 'none'" in page and "@@" not in page.split("<script>")[0]
    assert data["numbers"] == [0, *data["numbers"][1:-1], solved.solution.iterations]
    assert len(data["readouts"][0]["texts"]) == len(shown) == len(data["ticks"])
    switched = {f"/meshcat/{part}" for key in data["legend"] for part in key["parts"]}
    drawn = {"/".join(path.split("/")[:3]) for path in paths}
    assert switched == drawn  # the legend names everything that can be switched off
    assert not re.search(r"(src|href)=\"http", page)
    lines = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [[1.0, 1.0, 0.0], [1.0, 1.0, 3.0]]])
    vertices, faces = strips(lines, 0.2, crossed=True)
    assert vertices.shape == (16, 3) and faces.shape == (8, 3)
    assert np.isfinite(vertices).all()  # also for the vertical line
    np.testing.assert_allclose(np.ptp(vertices[:4], axis=0), [2.2, 0.2, 0.0], atol=1e-12)


@pytest.mark.product(1, of="large maps")
@pytest.mark.data
@pytest.mark.parametrize(("name", "chi2"), [("M3500.g2o.gz", 137.9148782), ("sphere2500.g2o.gz", 1351.4019259)])
def test_published_graphs(shared_data: Path, name: str, chi2: float) -> None:
    solved = solve_file(SolveSettings(shared_data / "pose_graphs" / name))
    assert solved.chi2[2] == pytest.approx(chi2, abs=2e-7)
    assert solved.solution.iterations < 12


def test_numbers_alone_as_good_as_a_map_needs(city: Path, tmp_path: Path) -> None:
    for more in ([], ["--tolerance", "map"], ["--max-iterations", "1"]):
        out = tmp_path / "-".join(["out", *more])
        status = command.main(["solve", str(city), "--init", "file", *more, "--out", str(out)])
        assert status == (1 if "1" in more else 0)
        assert {file.name for file in out.iterdir()} == {"graph.g2o", "trajectory.tum", "metrics.json"}
    exact, near, early = (numbers(tmp_path / name) for name in ("out", "out---tolerance-map", "out---max-iterations-1"))
    assert early["iterations"] == 1 < near["iterations"] < exact["iterations"]
    assert exact["chi2"] <= near["chi2"] <= (1.0 + 2e-5) * exact["chi2"] < early["chi2"]
